// SPDX-License-Identifier: Apache-2.0
// What a call of `solve` reads and writes, and its memory.
#pragma once

#include "rods.h"

namespace INSTRUCTION_SET {

// One block of rows between two steps.
struct RowBlock {
    Lanes *now, *step;      // coordinates, Newton step from there
    Lanes *next, *further;  // the same of the coordinates tried
    Measures measures, tried;
    Lanes share, applied, at_rounding, status, steps, fraction, length;
    Mask alive;
    int64_t trial[W], pose[W];
    int used;
    int64_t unit;
    PlacedUnit *placed;
};

struct SolveInput {
    loopcal::Strided e, q, T, goal;
    const loopcal::Strided *joints;  // of each group, then T of each node but the platform
    int64_t t, n, max_iterations;
    loopcal::Task task;
    void *context;
    loopcal::Strided weights, values;  // of sums of driven joints
    loopcal::Order order;
};

struct SolveOutput {
    double *T, *const *joints, *residual;  // joints as in SolveInput
    int64_t *iterations;
    int8_t *status, *sign;
};

// The memory of a solver: blocks that are solved together, and the links placed for their units.
struct Workspace {
    RowBlock *block = nullptr;
    PlacedUnit *unit = nullptr;
    int64_t *rows = nullptr, blocks, units;
    double *poses = nullptr;
    Lanes *reduced = nullptr, *low = nullptr, *front = nullptr, *twists = nullptr,
          *drives = nullptr;

    static int most_joints(const Program &program) {
        int most = 0;
        for (int g = 0; g < program.groups; g++)
            if (program.group[g].joints > most) most = program.group[g].joints;
        return most;
    }

    Workspace(const Program &program, const Division &division, int most_conditions,
              int64_t block_count, int64_t unit_count)
        : blocks(block_count), units(unit_count), reduced_(NewtonWork::reduced_of(program)),
          low_((size_t)Equations::low_rows(program, most_conditions) * (program.twists + 1)),
          front_(program.largest_elimination(most_conditions, 1)),
          steps_((size_t)program.step_size()),
          values_(12 * (size_t)program.nodes + program.joint_values()), twists_(program.twists + 1),
          drives_(program.drives + 1),
          joints_(most_joints(program)),
          arena_(need(program)) {
        if (!arena_.ok()) return;
        reduced = arena_.take<Lanes>(reduced_);
        low = arena_.take<Lanes>(low_);
        front = arena_.take<Lanes>(front_);
        twists = arena_.take<Lanes>(twists_);
        drives = arena_.take<Lanes>(drives_);
        block = arena_.take<RowBlock>(blocks);
        unit = arena_.take<PlacedUnit>(units);
        rows = arena_.take<int64_t>(blocks * W);
        poses = arena_.take<double>(12 * blocks * W);
        for (int64_t u = 0; u < units; u++) unit[u].prepare(program, division, arena_);
        for (int64_t b = 0; b < blocks; b++) {
            block[b].now = arena_.take<Lanes>(values_);
            block[b].next = arena_.take<Lanes>(values_);
            block[b].step = arena_.take<Lanes>(steps_);
            block[b].further = arena_.take<Lanes>(steps_);
        }
    }

    bool ok() const { return arena_.ok(); }

    NewtonWork take_work() { return {Frames(arena_, joints_), reduced, low, front, twists, drives}; }

  private:
    size_t need(const Program &program) const {
        return Frames::need(joints_) + Arena::need<Lanes>(reduced_) + Arena::need<Lanes>(low_) +
               Arena::need<Lanes>(front_) + Arena::need<Lanes>(twists_) + Arena::need<Lanes>(drives_) +
               Arena::need<RowBlock>(blocks) +
               Arena::need<PlacedUnit>(units) + Arena::need<int64_t>(blocks * W) +
               Arena::need<double>(12 * blocks * W) + units * PlacedUnit::need(program) +
               blocks * 2 * (Arena::need<Lanes>(values_) + Arena::need<Lanes>(steps_));
    }

    size_t reduced_, low_, front_, steps_, values_, twists_, drives_;
    int joints_;
    Arena arena_;
};

}  // namespace INSTRUCTION_SET
