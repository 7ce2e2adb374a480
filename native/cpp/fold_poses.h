// SPDX-License-Identifier: Apache-2.0
// Rows of poses, [G D | r] with D of sensitivity.h, folded into triangular factors as they are
// made. G are the derivatives of whitened residuals r by the platform's twist.
//
// By trials, neither D nor the rows are written to memory: a lane makes and folds those of its
// trial. Many poses of one trial are divided into the PARTS of `fold`, of which a lane makes and
// folds one. Where parts cannot go pose by pose at the same time, and for few poses of a trial
// alone, neighboring poses share lanes, and their rows are written for `fold`. All compute the same
// operations in the same order, so that they give the same bits.
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
    Lanes sum[4] = {};  // that do not wait for each other; all of them are 0 or NaN
    for (int64_t i = 0; i < count; i++) sum[i % 4] = sum[i % 4] + derivatives[i] * 0.0;
    Mask finite = (sum[0] + sum[1]) + (sum[2] + sum[3]) == 0.0;
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

// --- by parts ---------------------------------------------------------------------------------

// Whether the rows of all parts, `height` each, change to another pose at the same time.
inline bool parts_agree(const loopcal::TwistRows &rows, int64_t height) {
    for (int64_t first = height; first < rows.count; first += height)
        for (int64_t i = 1; i < height && first + i < rows.count; i++)
            if ((rows.pose[i] == rows.pose[i - 1]) != (rows.pose[first + i] == rows.pose[first + i - 1]))
                return false;
    return true;
}

// The factors of parts `part` to `part` + W of a trial, one in each lane.
inline void fold_poses_of_parts(const PoseRows &in, Differentiator &at, int64_t trial, int64_t part,
                                int64_t height, double *factors, Arena &arena) {
    int64_t p = in.parameters(), width = in.width(), m = in.rows.count, row[W], pose[W];
    int64_t count = PARTS - part < W ? PARTS - part : W;
    Lanes *R = arena.take<Lanes>(packed(width, width)), *block = arena.take<Lanes>(width * ROWS);
    for (int64_t i = 0; i < packed(width, width); i++) R[i] = Lanes{};
    int filled = 0;
    Mask finite{};
    for (int64_t i = 0; i < height; i++) {
        const double *by_twist[W], *residual[W];
        Mask is_row{};
        for (int lane = 0; lane < W; lane++) {  // lanes without a part repeat the last one
            row[lane] = (part + (lane < count ? lane : count - 1)) * height + i;
            is_row[lane] = row[lane] < m ? -1 : 0;
            if (!is_row[lane]) row[lane] = m - 1;
            pose[lane] = in.rows.pose[row[lane]];
            by_twist[lane] = in.by_twist(trial) + 6 * row[lane];
            residual[lane] = in.residual(trial) + row[lane];
        }
        if (!i || in.rows.pose[i] != in.rows.pose[i - 1]) {
            at.differentiate_poses(trial, pose);
            finite = clear_infinite(at.by_parameter, 6 * p);
            note_finite(in, at, finite);
        }
        Lanes g[6], *column = block + filled;
        for (int f = 0; f < 6; f++) g[f] = gather(by_twist, f);
        for (int64_t j = 0; j < p; j++, column += ROWS)
            *column = select(is_row, multiply_twist(g, at.by_parameter + j, p), Lanes{});
        *column = select(is_row & finite, gather(residual, 0), Lanes{});
        if (++filled < ROWS) continue;
        fold_block(R, block, width);
        filled = 0;
    }
    store_factors(R, count, width, factors + part * width * width);
}

// Fold many rows of one trial as `fold` does; false without memory.
inline bool fold_poses_by_parts(const PoseRows &in, Differentiator &at, int64_t trial, int64_t height,
                                const double *factor, double *out) {
    int64_t width = in.width(), size = width * width;
    Arena memory(need_by_parts(width));
    if (!memory.ok()) return false;
    double *factors = memory.take<double>(PARTS * size);
    std::memset(factors, 0, sizeof(double) * (size_t)(PARTS * size));
    for (int64_t part = 0; part < PARTS && part * height < in.rows.count; part += W) {
        Arena arena(need_by_trials(width));
        if (!arena.ok()) return false;
        fold_poses_of_parts(in, at, trial, part, height, factors, arena);
    }
    Arena arena(need_by_columns(width));
    if (!arena.ok()) return false;
    fold_trial(factor, factors, out, PARTS * width, width, arena);
    return true;
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
    ProgramMemory memory(structure);
    if (!memory.ok()) return 1;
    Program program(structure, numbers, memory.groups, memory.order);
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
    if (are_many && parts_agree(*rows, part_height(m))) {
        Arena arena(Differentiator::need(program, map));
        if (!arena.ok()) return 1;
        Differentiator at(program, map, by_poses, arrays, joints, arena);
        for (int64_t i = 0; i < t; i++)
            if (!fold_poses_by_parts(in, at, i, part_height(m), factor + i * size, out + i * size)) return 1;
        return 0;
    }
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
