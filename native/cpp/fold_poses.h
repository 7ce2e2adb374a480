// SPDX-License-Identifier: Apache-2.0
// Rows of poses, [G D | r] with D of sensitivity.h, folded into triangular factors as they are
// made. G are the derivatives of whitened residuals r by the platform's twist.
//
// By trials, neither D nor the rows are written to memory: a lane makes and folds those of its
// trial. A trial alone has its poses in lanes, and its rows are written for `fold`. Both compute
// the same operations in the same order, so that they give the same bits.
#pragma once

#include "fold.h"
#include "sensitivity.h"

namespace INSTRUCTION_SET {

// All that the rows of poses are made of.
struct PoseRows {
    const Program &program;
    const InputMap &map;
    const loopcal::Strided *arrays, *joints;
    const loopcal::TwistRows &rows;
    int8_t *is_finite;
    int64_t t, n;

    int64_t parameters() const { return map.parameters(); }
    int64_t width() const { return map.parameters() + 1; }
    const double *by_twist(int64_t trial) const { return rows.by_twist.data + trial * rows.by_twist.trial; }
    const double *residual(int64_t trial) const { return rows.residual.data + trial * rows.residual.trial; }
};

// Where any derivative of a lane is infinite or NaN, all become zero. Returns which lanes were finite.
INLINE Mask clear_infinite(Lanes *derivatives, int64_t count) {
    Lanes sum{};
    for (int64_t i = 0; i < count; i++) sum = sum + derivatives[i] * 0.0;
    Mask finite = sum == 0.0;
    if (any(~finite))
        for (int64_t i = 0; i < count; i++) derivatives[i] = select(finite, derivatives[i], Lanes{});
    return finite;
}

// g'D of one column
INLINE Lanes multiply_twist(const Lanes *g, const Lanes *derivatives, int64_t stride) {
    Lanes sum = g[0] * derivatives[0];
    for (int f = 1; f < 6; f++) sum = sum + g[f] * derivatives[f * stride];
    return sum;
}

inline void note_finite(const PoseRows &in, const Differentiator &at, Mask finite) {
    for (int lane = 0; lane < at.used; lane++)
        in.is_finite[at.trial[lane] * in.n + at.pose[lane]] = finite[lane] != 0;
}

// --- by trials --------------------------------------------------------------------------------

inline void fold_poses_by_trials(const PoseRows &in, Differentiator &at, int64_t first, int64_t count,
                                 const double *factor, double *out, Arena &arena) {
    int64_t p = in.parameters(), width = in.width();
    Lanes *R = arena.take<Lanes>(packed(width, width)), *block = arena.take<Lanes>(width * ROWS);
    load_factors(factor, count, width, R);
    const double *by_twist[W], *residual[W];
    for (int lane = 0; lane < W; lane++) {
        int64_t trial = first + (lane < count ? lane : count - 1);
        by_twist[lane] = in.by_twist(trial), residual[lane] = in.residual(trial);
    }
    int filled = 0;
    for (int64_t row = 0; row < in.rows.count;) {
        int64_t pose = in.rows.pose[row];
        at.differentiate(first / W * in.n + pose);
        Mask finite = clear_infinite(at.by_parameter, 6 * p);
        note_finite(in, at, finite);
        for (; row < in.rows.count && in.rows.pose[row] == pose; row++) {
            Lanes g[6], *column = block + filled;
            for (int f = 0; f < 6; f++) g[f] = gather(by_twist, 6 * row + f);
            for (int64_t j = 0; j < p; j++, column += ROWS)
                *column = multiply_twist(g, at.by_parameter + j, p);
            *column = select(finite, gather(residual, row), Lanes{});
            if (++filled < ROWS) continue;
            fold_block(R, block, width);
            filled = 0;
        }
    }
    if (filled) {
        for (int64_t j = 0; j < width; j++)
            for (int i = filled; i < ROWS; i++) block[j * ROWS + i] = Lanes{};
        fold_block(R, block, width);
    }
    store_factors(R, count, width, out);
}

// --- a trial alone ----------------------------------------------------------------------------

// Write the rows (count, p + 1) of a trial.
inline void write_rows(const PoseRows &in, Differentiator &at, int64_t blocks_of_trial, int64_t trial,
                       Lanes *of_pose, double *rows) {
    int64_t p = in.parameters(), width = in.width(), vectors = padded(p) / W, row = 0;
    const double *by_twist = in.by_twist(trial), *residual = in.residual(trial);
    double *lane_numbers = reinterpret_cast<double *>(of_pose);
    Lanes *line = of_pose + 6 * vectors;
    for (int64_t block = 0; block < blocks_of_trial && row < in.rows.count; block++) {
        if (in.rows.pose[row] / W > block) continue;
        at.differentiate(trial * blocks_of_trial + block);
        Mask finite = clear_infinite(at.by_parameter, 6 * p);
        note_finite(in, at, finite);
        for (int lane = 0; lane < at.used; lane++) {
            if (row == in.rows.count || in.rows.pose[row] != at.pose[lane]) continue;
            for (int f = 0; f < 6; f++)
                for (int64_t j = 0; j < p; j++)
                    lane_numbers[f * padded(p) + j] = at.by_parameter[f * p + j][lane];
            for (; row < in.rows.count && in.rows.pose[row] == at.pose[lane]; row++) {
                Lanes g[6];
                for (int f = 0; f < 6; f++) g[f] = splat(by_twist[6 * row + f]);
                for (int64_t j = 0; j < vectors; j++)
                    line[j] = multiply_twist(g, of_pose + j, vectors);
                std::memcpy(rows + row * width, line, sizeof(double) * (size_t)p);
                rows[row * width + p] = finite[lane] ? residual[row] : 0.0;
            }
        }
    }
}

// --- the call ---------------------------------------------------------------------------------

// arrays : as for `differentiate`. Poses without rows are not differentiated and count as finite.
inline int fold_poses(const int64_t *structure, const double *numbers, const int64_t *entries,
                      const loopcal::Strided *arrays, const loopcal::Strided *joints,
                      const loopcal::TwistRows *rows, const double *factor, double *out,
                      int8_t *is_finite, int64_t t, int64_t n) {
    Arena memory(Arena::need<Group>((size_t)structure[0]));
    if (!memory.ok()) return 1;
    Program program(structure, numbers, memory.take<Group>((size_t)structure[0]));
    InputMap map{entries, arrays[3], arrays[4], arrays[5], arrays[6]};
    PoseRows in{program, map, arrays, joints, *rows, is_finite, t, n};
    int64_t m = rows->count, width = in.width(), size = width * width;
    std::memset(is_finite, 1, (size_t)(t * n));
    Division by_trials(t, n, true), by_poses(t, n, false);
    bool are_many = m >= MANY * width;  // as in `fold`
    int64_t alone = are_many ? 0 : (t % W) * 2 > W ? t : t / W * W;  // first trial of those alone
    if (alone > 0) {
        Arena arena(Differentiator::need(program, map));
        if (!arena.ok()) return 1;
        Differentiator at(program, map, by_trials, arrays, joints, arena);
        for (int64_t first = 0; first < alone; first += W) {
            Arena own(need_by_trials(width));
            if (!own.ok()) return 1;
            int64_t count = alone - first < W ? alone - first : W;
            fold_poses_by_trials(in, at, first, count, factor + first * size, out + first * size, own);
        }
    }
    if (alone == t) return 0;
    size_t vectors = (size_t)(padded(in.parameters()) / W);
    Arena arena(Differentiator::need(program, map) + Arena::need<Lanes>(7 * vectors) +
                Arena::need<double>(m * width));
    if (!arena.ok()) return 1;
    Differentiator at(program, map, by_poses, arrays, joints, arena);
    Lanes *of_pose = arena.take<Lanes>(7 * vectors);
    for (size_t i = 0; i < 7 * vectors; i++) of_pose[i] = Lanes{};
    double *written = arena.take<double>(m * width);
    for (int64_t trial = alone; trial < t; trial++) {
        write_rows(in, at, by_poses.blocks_of_unit(), trial, of_pose, written);
        int done = fold(factor + trial * size, written, out + trial * size, 1, m, width, m * width);
        if (done) return done;
    }
    return 0;
}

}  // namespace INSTRUCTION_SET
