// SPDX-License-Identifier: Apache-2.0
// The iteration of `solve`: blocks of rows until each has converged, is near its goal, or failed.
#pragma once

#include "limbs.h"

namespace INSTRUCTION_SET {

// One block of rows between two steps.
struct RowBlock {
    Lanes *now, *step, *next;  // coordinates, Newton step from there, coordinates tried
    Measures measures;
    Lanes share, applied, at_rounding, status, steps, fraction, length;
    Mask alive;
    int64_t trial[W], pose[W];
    int used;
    int64_t unit;
    PlacedUnit *placed;
};

struct SolveInput {
    loopcal::Strided e, q, T, goal;
    const loopcal::Strided *joints;
    int64_t t, n, max_iterations;
    loopcal::Task task;
    void *context;
};

struct SolveOutput {
    double *T, *const *joints, *residual;
    int64_t *iterations;
    int8_t *status, *sign;
};

// The memory of a solver: blocks that are solved together, and the links placed for their units.
struct Workspace {
    RowBlock *block = nullptr;
    PlacedUnit *unit = nullptr;
    int64_t *rows = nullptr, blocks, units;
    double *poses = nullptr;
    Lanes *reduced = nullptr, *low = nullptr, *trial_step = nullptr;

    static int most_joints(const Program &program) {
        int most = 0;
        for (int g = 0; g < program.groups; g++)
            if (program.group[g].joints > most) most = program.group[g].joints;
        return most;
    }

    Workspace(const Program &program, const Division &division, int most_conditions,
              int64_t block_count, int64_t unit_count)
        : blocks(block_count), units(unit_count), reduced_(NewtonWork::reduced_of(program)),
          low_((size_t)Equations::low_rows(program, most_conditions) * (program.freedoms + 1)),
          steps_(6 + (size_t)program.unknown_joints()),
          values_(12 + (size_t)program.joint_values()), joints_(most_joints(program)),
          arena_(need(program)) {
        if (!arena_.ok()) return;
        reduced = arena_.take<Lanes>(reduced_);
        low = arena_.take<Lanes>(low_);
        trial_step = arena_.take<Lanes>(steps_);
        block = arena_.take<RowBlock>(blocks);
        unit = arena_.take<PlacedUnit>(units);
        rows = arena_.take<int64_t>(blocks * W);
        poses = arena_.take<double>(12 * blocks * W);
        for (int64_t u = 0; u < units; u++) unit[u].prepare(program, division, arena_);
        for (int64_t b = 0; b < blocks; b++) {
            block[b].now = arena_.take<Lanes>(values_);
            block[b].next = arena_.take<Lanes>(values_);
            block[b].step = arena_.take<Lanes>(steps_);
        }
    }

    bool ok() const { return arena_.ok(); }

    NewtonWork take_work() { return {Frames(arena_, joints_), reduced, low}; }

  private:
    size_t need(const Program &program) const {
        return Frames::need(joints_) + Arena::need<Lanes>(reduced_) + Arena::need<Lanes>(low_) +
               Arena::need<Lanes>(steps_) + Arena::need<RowBlock>(blocks) +
               Arena::need<PlacedUnit>(units) + Arena::need<int64_t>(blocks * W) +
               Arena::need<double>(12 * blocks * W) + units * PlacedUnit::need(program) +
               blocks * (2 * Arena::need<Lanes>(values_) + Arena::need<Lanes>(steps_));
    }

    size_t reduced_, low_, steps_, values_;
    int joints_;
    Arena arena_;
};

class Solver {
  public:
    Solver(const Program &program, const SolveInput &input, const SolveOutput &output,
           const Division &division, const Equations &equations, const Workspace &space)
        : program_(program), in_(input), out_(output), division_(division), equations_(equations),
          space_(space) {}

    // Rows solved together where a task is asked, which is called once for all of them.
    static constexpr int64_t ROWS_OF_TASK = 2048;

    int run() {
        for (int64_t first = 0; first < division_.blocks(); first += space_.blocks) {
            int64_t left = division_.blocks() - first;
            int outcome = solve_chunk(left < space_.blocks ? left : space_.blocks, first);
            if (outcome) return outcome;
        }
        return 0;
    }

    // Which of up to W poses of a trial come close to their goals, of which `count` matter.
    Mask come_near(RowBlock &block, int64_t trial, const int64_t *poses, int count) {
        for (int lane = 0; lane < W; lane++) {
            block.trial[lane] = trial;
            block.pose[lane] = poses[lane < count ? lane : count - 1];
        }
        block.used = count;
        start(block, trial);
        iterate(&block, 1);
        return block.status == double(NEAR_GOAL);
    }

    int close_limbs(RowBlock &block, const Frames &frames) {
        LimbCloser limbs(program_, frames);
        for (int64_t b = 0; b < division_.blocks(); b++) close(block, b, limbs);
        return 0;
    }

  private:
    int solve_chunk(int64_t count, int64_t first) {
        RowBlock *blocks = space_.block;
        for (int64_t b = 0; b < count; b++) begin(blocks[b], first + b);
        if (int outcome = iterate(blocks, count)) return outcome;
        for (int64_t b = 0; b < count; b++) write(blocks[b]);
        return 0;
    }

    // Iterate until every row of these blocks has ended, or is out of iterations.
    int iterate(RowBlock *blocks, int64_t count) {
        if (int outcome = evaluate_all(blocks, count, true)) return outcome;
        for (int64_t i = 0; i < in_.max_iterations; i++) {
            bool is_left = false;
            for (int64_t b = 0; b < count; b++) {
                if (!any(blocks[b].alive)) continue;
                end_rows(blocks[b]);
                if (!any(blocks[b].alive)) continue;
                is_left = true;
                try_step(blocks[b]);
            }
            if (!is_left) break;
            if (int outcome = evaluate_all(blocks, count, false)) return outcome;
        }
        return 0;
    }

    void begin(RowBlock &block, int64_t number) {
        block.used = division_.locate(number, block.trial, block.pose);
        start(block, number / division_.blocks_of_unit());
    }

    // Begin with the rows that a block has located in a unit.
    void start(RowBlock &block, int64_t unit) {
        // blocks of one chunk belong to fewer than `unit_count` units
        block.unit = unit;
        block.placed = space_.unit + unit % space_.units;
        block.placed->place(unit, in_.e);
        gather_platform(in_.T, block.trial, block.pose, block.now);
        gather_joints(program_, in_.joints, in_.q, block.trial, block.pose, block.now + 12);
        for (int lane = 0; lane < W; lane++) block.alive[lane] = lane < block.used ? -1 : 0;
        block.share = splat(1.0);
        block.applied = splat(__builtin_inf());
        block.at_rounding = block.steps = Lanes{};
        block.status = splat(EXHAUSTED);
    }

    // The first evaluation of all blocks, or that of the coordinates tried, by which better ones
    // replace the present ones.
    int evaluate_all(RowBlock *blocks, int64_t count, bool first) {
        loopcal::TaskAnswer answer{};
        if (in_.task) {
            int64_t asked = 0;
            for (int64_t b = 0; b < count; b++) {
                const RowBlock &block = blocks[b];
                const Lanes *T = first ? block.now : block.next;
                for (int lane = 0; lane < W; lane++) {
                    if (!block.alive[lane]) continue;
                    double *pose = space_.poses + 12 * asked;
                    for (int i = 0; i < 3; i++) {
                        for (int j = 0; j < 3; j++) pose[4 * i + j] = T[3 * i + j][lane];
                        pose[4 * i + 3] = T[9 + i][lane];
                    }
                    space_.rows[asked++] = block.trial[lane] * division_.n + block.pose[lane];
                }
            }
            if (in_.task(in_.context, asked, space_.poses, space_.rows, &answer)) return loopcal::TASK_FAILED;
        }
        int64_t asked = 0;
        for (int64_t b = 0; b < count; b++) {
            if (!any(blocks[b].alive)) continue;
            TaskRows task{(int)answer.conditions, {}, {}};
            int64_t last = asked;
            for (int lane = 0; in_.task && lane < W; lane++) {
                if (blocks[b].alive[lane]) last = asked++;
                task.residual[lane] = answer.residual + last * answer.conditions;
                task.slopes[lane] = answer.slopes + last * answer.conditions * 6;
            }
            if (first && !in_.task && !in_.T.pose && equations_.has_rods())
                evaluate_shared(blocks[b]);
            else if (first)
                evaluate(blocks[b], blocks[b].now, in_.task ? &task : nullptr, Mask{},
                         blocks[b].step, blocks[b].measures);
            else
                accept(blocks[b], in_.task ? &task : nullptr);
        }
        return 0;
    }

    void evaluate(const RowBlock &block, const Lanes *coordinates, const TaskRows *task,
                  Mask may_stay, Lanes *step, Measures &measures) const {
        const PlacedUnit &placed = *block.placed;
        if (division_.by_trials)
            equations_.evaluate(placed.lanes(), coordinates, task, may_stay, block.alive, step, measures);
        else
            equations_.evaluate(placed.numbers(), coordinates, task, may_stay, block.alive, step, measures);
    }

    // The first evaluation of rows that start from one pose of their trial.
    void evaluate_shared(RowBlock &block) {
        const PlacedUnit &placed = *block.placed;
        if (shared_unit_ != block.unit) {
            shared_unit_ = block.unit;
            if (division_.by_trials)
                equations_.factorize(placed.lanes(), block.now, shared_);
            else
                equations_.factorize(placed.numbers(), block.now, shared_);
        }
        if (division_.by_trials)
            equations_.evaluate_shared(placed.lanes(), shared_, block.now, block.step, block.measures);
        else
            equations_.evaluate_shared(placed.numbers(), shared_, block.now, block.step, block.measures);
    }

    // End the rows that have converged, are near their goal, or can go no further.
    void end_rows(RowBlock &block) const {
        double size = program_.size;
        const Measures &now = block.measures;
        Mask settled = (now.reducible <= RESIDUAL * size) &
                       ((block.applied <= STEP * size) | (block.at_rounding > 2.0));
        Lanes zero = now.reducible * 0.0 + now.length * 0.0;  // NaN where one is not finite
        for (int i = 0; i < 12; i++) zero = zero + block.now[i] * 0.0;  // some are in no equation
        Mask broken = ~((zero == 0.0) & (now.pivot > SINGULAR));
        Mask end = settled | broken | (block.share < 1e-5), near{};
        if (in_.goal.data) {
            Lanes goal[12];
            gather_platform(in_.goal, block.trial, block.pose, goal);
            near = equations_.lead_to(block.now, block.step, now.length, goal) & ~end;
            end |= near;
        }
        Mask closed = settled;
        if (!program_.may_stay_open) closed &= now.residual <= 1e4 * RESIDUAL * size;
        Lanes reason = select(closed, splat(CONVERGED), splat(STALLED));
        reason = select(broken, splat(NOT_FINITE), reason);
        reason = select(near, splat(NEAR_GOAL), reason);
        block.status = select(block.alive & end, reason, block.status);
        block.alive &= ~end;
    }

    void try_step(RowBlock &block) const {
        Lanes limit = 0.5 * program_.size / larger(block.measures.length, splat(1e-300));
        block.fraction = block.share * smaller(splat(1.0), limit);
        block.length = block.fraction * block.measures.length;
        equations_.move(block.now, block.step, block.fraction, block.next);
    }

    void accept(RowBlock &block, const TaskRows *task) {
        double size = program_.size;
        Mask tiny = block.length <= STEP * size;
        Measures trial = block.measures;
        Lanes *step = space_.trial_step;
        evaluate(block, block.next, task, tiny, step, trial);
        const Measures &now = block.measures;
        Mask low = trial.reducible <= RESIDUAL * size;
        Mask better = low | (trial.residual <= (1.0 - 1e-4 * block.fraction) * now.residual) |
                      (trial.reducible <= 0.5 * now.reducible);
        better &= block.alive;
        block.applied = select(better, block.length, block.applied);
        block.at_rounding = select(better & low, block.at_rounding + 1.0, Lanes{});
        block.share = select(better, smaller(splat(1.0), 4.0 * block.share), 0.25 * block.share);
        block.steps = select(block.alive, block.steps + 1.0, block.steps);
        for (int i = 0; i < equations_.coordinate_size(); i++)
            block.now[i] = select(better, block.next[i], block.now[i]);
        for (int i = 0; i < equations_.step_size(); i++)
            block.step[i] = select(better, step[i], block.step[i]);
        block.measures.residual = select(better, trial.residual, now.residual);
        block.measures.reducible = select(better, trial.reducible, now.reducible);
        block.measures.length = select(better, trial.length, now.length);
        block.measures.sign = select(better, trial.sign, now.sign);
        block.measures.pivot = select(better, trial.pivot, now.pivot);
    }

    // A block whose limbs have a closed form with the platform of the start.
    void close(RowBlock &block, int64_t number, const LimbCloser &limbs) {
        begin(block, number);
        Measures &now = block.measures;
        if (division_.by_trials)
            limbs.close(block.placed->lanes(), block.now, block.now + 12, now.residual, now.sign);
        else
            limbs.close(block.placed->numbers(), block.now, block.now + 12, now.residual, now.sign);
        block.status = judge_closed(now.residual, program_.size);
        write(block);
    }

    void write(const RowBlock &block) const {
        for (int lane = 0; lane < block.used; lane++) {
            int64_t row = block.trial[lane] * division_.n + block.pose[lane];
            double *T = out_.T + 16 * row;
            for (int i = 0; i < 3; i++) {
                for (int j = 0; j < 3; j++) T[4 * i + j] = block.now[3 * i + j][lane];
                T[4 * i + 3] = block.now[9 + i][lane];
                T[12 + i] = 0.0;
            }
            T[15] = 1.0;
            const Lanes *theta = block.now + 12;
            for (int g = 0; g < program_.groups; g++) {
                int values = program_.group[g].limbs * (program_.group[g].joints + 1);
                double *to = out_.joints[g] + row * values;
                for (int i = 0; i < values; i++) to[i] = theta[i][lane];
                theta += values;
            }
            double sign = block.measures.sign[lane];
            out_.residual[row] = block.measures.residual[lane];
            out_.iterations[row] = (int64_t)block.steps[lane];
            out_.status[row] = (int8_t)block.status[lane];
            out_.sign[row] = (int8_t)((sign > 0.0) - (sign < 0.0));
        }
    }

  private:
    const Program &program_;
    const SolveInput &in_;
    const SolveOutput &out_;
    const Division &division_;
    const Equations &equations_;
    const Workspace &space_;
    SharedFactor shared_;
    int64_t shared_unit_ = -1;
};

inline int solve(const int64_t *structure, const double *numbers, const SolveInput &input,
                 const SolveOutput &output) {
    Arena memory(Arena::need<Group>((size_t)structure[0]));
    if (!memory.ok()) return loopcal::NO_MEMORY;
    Program program(structure, numbers, memory.take<Group>((size_t)structure[0]));
    Division division(input.t, input.n);
    int64_t blocks = 1, units = 1;
    if (input.task) {
        blocks = Solver::ROWS_OF_TASK / W < division.blocks() ? Solver::ROWS_OF_TASK / W : division.blocks();
        units = blocks / division.blocks_of_unit() + 2;
    }
    Workspace space(program, division, input.task ? loopcal::MOST_CONDITIONS : 0, blocks, units);
    if (!space.ok()) return loopcal::NO_MEMORY;
    NewtonWork work = space.take_work();
    Equations equations(program, work);
    Solver solver(program, input, output, division, equations, space);
    if (!program.freedoms && program.free && have_closed_form(program))
        return solver.close_limbs(*space.block, work.frames);
    return solver.run();
}

}  // namespace INSTRUCTION_SET
