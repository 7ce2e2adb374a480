// SPDX-License-Identifier: Apache-2.0
// Closure linearized at states, the solved joints of each limb eliminated; see closure.py.
#pragma once

#include "blocks.h"
#include "limb.h"

namespace INSTRUCTION_SET {

struct LinearizeWork {
    Frames frames;
    Lanes *triangle, *betas, *rows;
};

// Columns of one limb: solved joints, freedoms of all nodes, slots, all joints. Written row by row to
// work.rows, without the columns' sorting.
template <class Number, int ENDING>
void linearize_limb(const Program &program, const Group &group, int k, const Number *placed,
                    const Lanes *T, const Lanes *theta, const LinearizeWork &work) {
    Limb<Number, ENDING> limb(group, k, placed, work.frames, program.size, T, theta, 1, true);
    int r = group.rows, u = group.unknown;
    int width = u + program.twists + group.slots + group.joints + 1;
    for (int j = 0; j < u; j++) limb.joint((int)group.solved[j], work.triangle + j * r);
    int count = u < r - 1 ? u : r - 1;
    for (int j = 0; j < count; j++) {
        Lanes *v = work.triangle + j * r + j;
        Reflector h = make_reflector(v, r - j);
        work.betas[j] = h.beta;
        for (int c = j + 1; c < u; c++)
            reflect_column(v, h.beta, work.triangle + c * r + j, r - j);
        for (int i = 0; i < r; i++)
            work.rows[i * width + j] =
                i < j ? work.triangle[j * r + i] : i == j ? h.alpha : Lanes{};
    }
    for (int j = count; j < u; j++)
        for (int i = 0; i < r; i++) work.rows[i * width + j] = work.triangle[j * r + i];
    Lanes column[6];
    for (int c = u; c < width; c++) {
        int of = c - u;
        if (of < program.twists) {
            const int64_t *touches = group.touches + k * group.touched;
            for (int i = 0; i < r; i++) column[i] = Lanes{};
            for (int f = 0; f < group.touched; f++)
                if (touches[f] == of) limb.touch(f, column);
        } else if ((of -= program.twists) < group.slots)
            limb.slot(of, column);
        else
            limb.joint(of - group.slots, column);
        for (int j = 0; j < count; j++)
            reflect_column(work.triangle + j * r + j, work.betas[j], column + j, r - j);
        for (int i = 0; i < r; i++) work.rows[i * width + c] = column[i];
    }
}

template <class Number>
void linearize_block(const Program &program, const Number *placed, const Lanes *T,
                     const Lanes *theta, const int64_t *row, int used, double *const *out,
                     const LinearizeWork &work) {
    for (int g = 0; g < program.groups; g++) {
        const Group &group = program.group[g];
        int width = group.unknown + program.twists + group.slots + group.joints + 1;
        int64_t numbers = (int64_t)group.rows * width;
        for (int k = 0; k < group.limbs; k++) {
            if (group.ending == RIGID)
                linearize_limb<Number, RIGID>(program, group, k, placed, T, theta, work);
            else if (group.ending == BALL)
                linearize_limb<Number, BALL>(program, group, k, placed, T, theta, work);
            else
                linearize_limb<Number, DISTANCE>(program, group, k, placed, T, theta, work);
            double *to[W];
            for (int lane = 0; lane < W; lane++)
                to[lane] = out[g] + (row[lane] * group.limbs + k) * numbers;
            write_rows(work.rows, numbers, used, to);
            placed += group.placed();
            theta += group.joints + 1;
        }
    }
}

// out : for each group (t, n, limbs, rows, width), see linearize_limb.
inline int linearize(const int64_t *structure, const double *numbers, const loopcal::Strided &e, const loopcal::Strided &q,
                     const loopcal::Strided &T, const loopcal::Strided *joints, double *const *out, int64_t t, int64_t n) {
    ProgramMemory memory(structure);
    if (!memory.ok()) return 1;
    Program program(structure, numbers, memory.groups, memory.order);
    Division division(t, n);
    int joint_count = 0;
    size_t most = 0, triangle = 1;
    for (int g = 0; g < program.groups; g++) {
        const Group &group = program.group[g];
        size_t width = group.unknown + program.twists + group.slots + group.joints + 1;
        if (group.joints > joint_count) joint_count = group.joints;
        if (group.rows * width > most) most = group.rows * width;
        if ((size_t)group.unknown * group.rows > triangle) triangle = group.unknown * group.rows;
    }
    Arena arena(Frames::need(joint_count) + PlacedUnit::need(program) + Arena::need<Lanes>(triangle) +
                Arena::need<Lanes>(joint_count + 2) + Arena::need<Lanes>(most) +
                Arena::need<Lanes>(program.joint_values()) + Arena::need<Lanes>(12 * program.nodes));
    if (!arena.ok()) return 1;
    PlacedUnit placed;
    placed.prepare(program, division, arena);
    Frames frames(arena, joint_count);
    Lanes *triangles = arena.take<Lanes>(triangle), *betas = arena.take<Lanes>(joint_count + 2);
    LinearizeWork work{frames, triangles, betas, arena.take<Lanes>(most)};
    Lanes *theta = arena.take<Lanes>(program.joint_values()), *nodes = arena.take<Lanes>(12 * program.nodes);
    for (int64_t block = 0; block < division.blocks(); block++) {
        int64_t trial[W], pose[W], row[W];
        int used = division.locate(block, trial, pose);
        for (int lane = 0; lane < W; lane++) row[lane] = trial[lane] * n + pose[lane];
        placed.place(block / division.blocks_of_unit(), e);
        gather_joints(program, joints, q, trial, pose, theta);
        gather_nodes(program, T, joints + program.groups, trial, pose, nodes);
        if (division.by_trials)
            linearize_block(program, placed.lanes(), nodes, theta, row, used, out, work);
        else
            linearize_block(program, placed.numbers(), nodes, theta, row, used, out, work);
    }
    return 0;
}

}  // namespace INSTRUCTION_SET
