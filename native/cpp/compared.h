// SPDX-License-Identifier: Apache-2.0
// One trial from readings to the factor of its rows: `solve`, `compare_poses` and `fold_poses` one
// after the other, with the whitening between them, and full Gauss-Newton steps from there, so that
// a small fit is one call. Each is the kernel of its own call, and gives its bits.
#pragma once

#include "compare.h"
#include "fold_poses.h"
#include "solve.h"
#include "triangles.h"

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

// All that stays the same at every deviation of a trial.
struct ComparedTrial {
    const int64_t *structure;
    const double *numbers;
    const int64_t *entries;
    const loopcal::Strided *arrays;  // e, q, T of the start, and the four arrays of the map
    const loopcal::ComparedPoses &measured;
    const double *factor;
    int8_t *is_finite;
    int64_t n, max_iterations;
};

// Close the loops from T and joints of a start, and fold the rows there.
inline int fold_at(const ComparedTrial &in, const loopcal::Strided &T_start,
                   const loopcal::Strided *joints, const loopcal::SolvedPoses &solved) {
    const loopcal::Strided *arrays = in.arrays, none{nullptr, 0, 0};
    SolveInput input{arrays[0], arrays[1],         T_start, none,    joints, 1,
                     in.n,      in.max_iterations, nullptr, nullptr, none,   none, loopcal::APART};
    SolveOutput output{solved.T,          solved.joints, solved.residual,
                       solved.iterations, solved.status, solved.sign};
    int outcome = solve(in.structure, in.numbers, input, output);
    if (outcome != loopcal::DONE) return outcome;
    const loopcal::ComparedPoses &measured = in.measured;
    int64_t count = measured.count, rows = count * measured.height;
    Arena arena(Arena::need<double>(16 * count) + Arena::need<double>(42 * count) +
                Arena::need<double>(7 * rows) + Arena::need<int64_t>(rows));
    if (!arena.ok()) return loopcal::NO_MEMORY;
    double *T = arena.take<double>(16 * count), *difference = arena.take<double>(42 * count);
    double *slopes = difference + 6 * count, *by_twist = arena.take<double>(7 * rows);
    int64_t *pose = arena.take<int64_t>(rows);
    for (int64_t i = 0; i < count; i++)
        std::memcpy(T + 16 * i, solved.T + 16 * measured.pose[i], 16 * sizeof(double));
    const loopcal::Strided compared[2] = {{T, 0, 16}, {measured.reference, 0, 12}};
    outcome = compare_poses(compared, difference, slopes, 1, count);
    if (outcome != loopcal::DONE) return outcome;
    double *residual = by_twist + 6 * rows;
    whiten_differences(measured, difference, slopes, pose, by_twist, residual);
    const loopcal::TwistRows observed{rows, pose, {by_twist, 0, 0}, {residual, 0, 0}};
    const loopcal::Strided at[7] = {arrays[0], arrays[1], {solved.T, 0, 16}, arrays[3],
                                    arrays[4], arrays[5], arrays[6]};
    return fold_poses(in.structure, in.numbers, in.entries, at, solved.strided, &observed,
                      in.factor, solved.factor, in.is_finite, 1, in.n);
}

// --- steps --------------------------------------------------------------------------------------

inline double square_length(const double *from, int64_t count, int64_t stride) {
    double sum = 0.0;
    for (int64_t i = 0; i < count; i++) sum += from[i * stride] * from[i * stride];
    return sum;
}

// Whether all poses are closed, on the side of their start, and all derivatives are finite.
inline bool is_usable(const ComparedTrial &in, const loopcal::SolvedPoses &solved,
                      const loopcal::Steps &steps) {
    for (int64_t i = 0; i < in.n; i++) {
        bool is_near = solved.sign[i] == steps.sign[i] && !(solved.residual[i] > steps.widest);
        if (solved.status[i] != 0 || !is_near || !in.is_finite[i]) return false;
    }
    return true;
}

// |P z|^2, and rows [P | P z] where they are asked for.
inline double penalize(const loopcal::Steps &steps, const double *z, int64_t p, double *rows) {
    double sum = 0.0;
    for (int64_t i = 0; i < steps.height; i++) {
        const double *row = steps.penalty + i * p;
        double product = 0.0;
        for (int64_t j = 0; j < p; j++) product += row[j] * z[j];
        if (rows) {
            std::memcpy(rows + i * (p + 1), row, size_t(p) * sizeof(double));
            rows[i * (p + 1) + p] = product;
        }
        sum += product * product;
    }
    return sum;
}

// Whether all singular values of R (p, p) are certainly above a share of the largest, by the
// largest entry of M^-1 1 (see triangles.h), else by the length of R^-1; column : (p,).
inline bool is_regular(const double *R, double growth, double share, int64_t p, double *column) {
    double square = 0.0, inverse = 0.0, width = double(p);
    for (int64_t i = 0; i < p; i++) {
        square += square_length(R + i * (p + 1), p, 1);
        if (!(magnitude(R[i * (p + 2)]) > 0.0)) return false;
    }
    double needed = share * root(square);
    if (needed * root(width) * growth < 1.0) return true;
    for (int64_t k = 0; k < p; k++) {
        for (int64_t i = k; i >= 0; i--) {
            double known = i == k ? 1.0 : 0.0;
            for (int64_t j = i + 1; j <= k; j++) known -= R[i * (p + 1) + j] * column[j];
            column[i] = known / R[i * (p + 2)];
        }
        inverse += square_length(column, k + 1, 1);
    }
    return needed * root(inverse) < 1.0;
}

// Take full steps while each brings its share of the decrease that the linear model predicts, until
// one is negligible: the rules of loopcal.estimate.descent. The result of step k is solved[k % 2].
inline int take_steps(const ComparedTrial &in, const loopcal::SolvedPoses *solved,
                      loopcal::Steps &steps) {
    int64_t p = in.entries[0], width = p + 1, corner = width * width;
    Arena arena(Arena::need<double>(corner + 3 * p) + Arena::need<double>(steps.height * width));
    if (!arena.ok()) return loopcal::NO_MEMORY;
    double *joint = arena.take<double>(corner + 3 * p), *rows = arena.take<double>(steps.height * width);
    double *right = joint + corner, *x = right + p, *work = x + p, arrival = __builtin_inf();
    for (;; steps.taken++) {
        const loopcal::SolvedPoses &here = solved[steps.taken % 2];
        double *z = steps.deviation + steps.taken * p, *next = z + p, growth;
        double cost = steps.cost[steps.taken], penalty = penalize(steps, z, p, rows);
        if (fold(here.factor, rows, joint, 1, steps.height, width, 0)) return loopcal::NO_MEMORY;
        for (int64_t i = 0; i < p; i++) right[i] = -joint[i * width + p];
        solve_triangle(joint, right, x, work, &growth, p, width);
        if (!is_regular(joint, growth, steps.singular, p, work)) return loopcal::DONE;
        double gain = square_length(right, p, 1), change = root(gain);
        double limit = steps.relative * root(cost), ratio = change / larger(arrival, 2.2250738585072014e-308);
        double remaining = change * ratio / larger(1.0 - ratio, steps.slowest);
        bool is_last = change <= limit && remaining <= steps.further * limit;
        double spread = 1.0 + root(square_length(z, p, 1));
        is_last |= root(square_length(x, p, 1)) <= steps.absolute * spread;
        if (is_last || steps.taken == steps.most) return loopcal::DONE;
        for (int64_t i = 0; i < p; i++) next[i] = z[i] + x[i];
        if (steps.move(next)) return loopcal::TASK_FAILED;
        const loopcal::SolvedPoses &there = solved[(steps.taken + 1) % 2];
        int outcome = fold_at(in, {here.T, 0, 16}, here.strided, there);
        if (outcome != loopcal::DONE) return outcome;
        double after = square_length(there.factor + p, width, width), before = cost + penalty;
        double gained = before - (after + penalize(steps, next, p, nullptr)) + steps.rounding * before;
        double needed = (gain > 0.0 ? steps.accepted : 2.0) * gain;
        if (!is_usable(in, there, steps) || !(gained >= needed)) return loopcal::DONE;
        steps.cost[steps.taken + 1] = after;
        steps.change = arrival = change;
    }
}

// arrays : e, q, T of the start, and the four arrays of the map of `differentiate`, of one trial.
// joints : of the start. measured, solved (2,), steps : see interface.h.
int fold_compared(const int64_t *structure, const double *numbers, const int64_t *entries,
                  const loopcal::Strided *arrays, const loopcal::Strided *joints,
                  const loopcal::ComparedPoses *measured, const loopcal::SolvedPoses *solved,
                  const double *factor, int8_t *is_finite, int64_t n, int64_t max_iterations,
                  loopcal::Steps *steps) {
    const ComparedTrial in{structure, numbers, entries, arrays,        *measured,
                           factor,    is_finite, n,     max_iterations};
    int outcome = fold_at(in, arrays[2], joints, solved[0]);
    if (outcome != loopcal::DONE || !is_usable(in, solved[0], *steps)) return outcome;
    steps->taken = 0;
    if (!steps->most) return outcome;
    int64_t width = entries[0] + 1;
    steps->cost[0] = square_length(solved[0].factor + width - 1, width, width);
    return take_steps(in, solved, *steps);
}

}  // namespace INSTRUCTION_SET
