// SPDX-License-Identifier: Apache-2.0
// One trial from readings to the factor of its rows: `solve`, `compare_poses` and `fold_poses` one
// after the other, with the whitening between them, so that a step of a small fit is one call. Each
// is the kernel of its own call, and gives its bits.
#pragma once

#include "compare.h"
#include "fold_poses.h"
#include "solve.h"

namespace INSTRUCTION_SET {

// Rows (height of each measured pose) and derivatives by the platform's twist: W D and W r of
// whiteners W, differences r of poses and their derivatives D. Sums run in the order of columns.
inline void whiten_differences(const loopcal::ComparedPoses &measured, const double *difference,
                               const double *slopes, int64_t *pose, double *by_twist,
                               double *residual) {
    const double *w = measured.whitener;
    for (int64_t i = 0; i < measured.count; i++, difference += 6, slopes += 36)
        for (int64_t k = 0; k < measured.height; k++, w += 6) {
            double sum = 0.0, row[6] = {};
            for (int j = 0; j < 6; j++) {
                sum += w[j] * difference[j];
                for (int f = 0; f < 6; f++) row[f] += w[j] * slopes[6 * j + f];
            }
            *pose++ = measured.pose[i];
            *residual++ = sum;
            std::memcpy(by_twist, row, sizeof row);
            by_twist += 6;
        }
}

// arrays : e, q, T of the start, and the four arrays of the map of `differentiate`, of one trial.
// joints, joints_out : of the start and of the result. measured : see interface.h.
int fold_compared(const int64_t *structure, const double *numbers, const int64_t *entries,
                  const loopcal::Strided *arrays, const loopcal::Strided *joints,
                  const loopcal::ComparedPoses *measured, const loopcal::SolvedPoses *solved,
                  const double *factor, double *out, int8_t *is_finite, int64_t n,
                  int64_t max_iterations) {
    loopcal::Strided none{nullptr, 0, 0};
    SolveInput input{arrays[0], arrays[1], arrays[2], none,    joints, 1,
                     n,         max_iterations, nullptr, nullptr, none,   none, loopcal::APART};
    SolveOutput output{solved->T,          solved->joints, solved->residual,
                       solved->iterations, solved->status, solved->sign};
    int outcome = solve(structure, numbers, input, output);
    if (outcome != loopcal::DONE) return outcome;
    int64_t count = measured->count, rows = count * measured->height;
    Arena arena(Arena::need<double>(16 * count) + Arena::need<double>(42 * count) +
                Arena::need<double>(7 * rows) + Arena::need<int64_t>(rows));
    if (!arena.ok()) return loopcal::NO_MEMORY;
    double *T = arena.take<double>(16 * count), *difference = arena.take<double>(42 * count);
    double *slopes = difference + 6 * count, *by_twist = arena.take<double>(7 * rows);
    int64_t *pose = arena.take<int64_t>(rows);
    for (int64_t i = 0; i < count; i++)
        std::memcpy(T + 16 * i, solved->T + 16 * measured->pose[i], 16 * sizeof(double));
    const loopcal::Strided compared[2] = {{T, 0, 16}, {measured->reference, 0, 12}};
    outcome = compare_poses(compared, difference, slopes, 1, count);
    if (outcome != loopcal::DONE) return outcome;
    double *residual = by_twist + 6 * rows;
    whiten_differences(*measured, difference, slopes, pose, by_twist, residual);
    const loopcal::TwistRows observed{rows, pose, {by_twist, 0, 0}, {residual, 0, 0}};
    const loopcal::Strided at[7] = {arrays[0], arrays[1], {solved->T, 0, 16}, arrays[3],
                                    arrays[4], arrays[5], arrays[6]};
    return fold_poses(structure, numbers, entries, at, solved->strided, &observed, factor, out,
                      is_finite, 1, n);
}

}  // namespace INSTRUCTION_SET
