// SPDX-License-Identifier: Apache-2.0
// The iteration of `solve`: blocks of rows until each has converged, is near its goal, or failed.
#pragma once

#include "limbs.h"
#include "workspace.h"

namespace INSTRUCTION_SET {

class Solver {
  public:
    Solver(const Program &program, const SolveInput &input, const SolveOutput &output,
           const Division &division, const Equations &equations, const Workspace &space)
        : program_(program), in_(input), out_(output), division_(division), equations_(equations),
          rods_(program), space_(space) {}

    // Rows solved together where a task is asked, which is called once for all of them.
    static constexpr int64_t ROWS_OF_TASK = 2048;
    // Blocks that are solved together elsewhere, so that rods are evaluated in pairs.
    static constexpr int64_t PAIR = 2;

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

    // The poses of a trial one after the other, each from the solution of the one before.
    int run_chains(RowBlock &block) {
        for (int64_t b = 0; b < division_.blocks(); b++) {
            bool continues = b % division_.blocks_of_unit() != 0;
            Lanes status = continues ? block.status : Lanes{};
            Mask converged = status == double(CONVERGED);
            begin(block, b, !continues);
            if (continues && in_.order == loopcal::ENDING) {
                block.alive &= converged;
                block.status = select(converged, block.status, status);
            }
            if (any(block.alive))
                if (int outcome = iterate(&block, 1)) return outcome;
            write(block);
        }
        return 0;
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

    void begin(RowBlock &block, int64_t number, bool anew = true) {
        block.used = division_.locate(number, block.trial, block.pose);
        start(block, number / division_.blocks_of_unit(), anew);
    }

    // Begin with the rows that a block has located in a unit, `anew` or from where the block is.
    void start(RowBlock &block, int64_t unit, bool anew = true) {
        // blocks of one chunk belong to fewer than `unit_count` units
        block.unit = unit;
        block.placed = space_.unit + unit % space_.units;
        block.placed->place(unit, in_.e);
        if (anew) gather_nodes(program_, in_.T, in_.joints + program_.groups, block.trial, block.pose, block.now);
        const loopcal::Strided none{}, *joints = anew ? in_.joints : nullptr;
        // driven joints whose sums are given go on from where they are
        const loopcal::Strided &q = anew || !program_.frees_drives ? in_.q : none;
        gather_joints(program_, joints, q, block.trial, block.pose, block.now + 12 * program_.nodes);
        for (int lane = 0; lane < W; lane++) block.alive[lane] = lane < block.used ? -1 : 0;
        block.share = splat(1.0);
        block.applied = splat(__builtin_inf());
        block.at_rounding = block.steps = Lanes{};
        block.status = splat(EXHAUSTED);
    }

    // The first evaluation of all blocks, or that of the coordinates tried, by which better ones
    // replace the present ones.
    int evaluate_all(RowBlock *blocks, int64_t count, bool first) {
        if (rods_.apply() && !in_.task) {
            if (division_.by_trials)
                evaluate_rods<Lanes>(blocks, count, first);
            else
                evaluate_rods<double>(blocks, count, first);
            return 0;
        }
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
            Demands demands;
            demands.conditions = (int)answer.conditions;
            int64_t last = asked;
            for (int lane = 0; in_.task && lane < W; lane++) {
                if (blocks[b].alive[lane]) last = asked++;
                demands.residual[lane] = answer.residual + last * answer.conditions;
                demands.slopes[lane] = answer.slopes + last * answer.conditions * 6;
            }
            for (int lane = 0; program_.sums && lane < W; lane++) {
                demands.weights[lane] = locate(in_.weights, blocks[b].trial[lane], 0);
                demands.values[lane] = locate(in_.values, blocks[b].trial[lane], blocks[b].pose[lane]);
            }
            if (first)
                evaluate(blocks[b], blocks[b].now, demands, Mask{}, blocks[b].step, blocks[b].measures);
            else
                try_coordinates(blocks[b], demands);
        }
        return 0;
    }

    void try_coordinates(RowBlock &block, const Demands &demands) const {
        block.tried = block.measures;
        evaluate(block, block.next, demands, find_tiny(block), block.further, block.tried);
        accept(block);
    }

    void evaluate(const RowBlock &block, const Lanes *coordinates, const Demands &demands,
                  Mask may_stay, Lanes *step, Measures &measures) const {
        const PlacedUnit &placed = *block.placed;
        if (division_.by_trials)
            equations_.evaluate(placed.lanes(), coordinates, demands, may_stay, block.alive, step, measures);
        else
            equations_.evaluate(placed.numbers(), coordinates, demands, may_stay, block.alive, step, measures);
    }

    // The same as in `evaluate_all` for rods, two blocks at a time.
    template <class Number> void evaluate_rods(RowBlock *blocks, int64_t count, bool first) {
        RodRows<Number> rows[PAIR];
        RowBlock *of[PAIR];
        int waiting = 0;
        for (int64_t b = 0; b < count; b++) {
            RowBlock &block = blocks[b];
            if (any(block.alive)) {
                if (first && !in_.T.pose && in_.order == loopcal::APART) {
                    evaluate_shared<Number>(block);
                    continue;
                }
                block.tried = block.measures;
                of[waiting] = &block;
                rows[waiting++] = {block.placed->links<Number>(), first ? block.now : block.next,
                                   first ? Mask{} : find_tiny(block), block.alive,
                                   first ? block.step : block.further,
                                   first ? &block.measures : &block.tried};
            }
            if (!waiting || (waiting < PAIR && b + 1 < count)) continue;
            if (waiting == PAIR)
                rods_.evaluate<PAIR>(rows);
            else
                rods_.evaluate<1>(rows);
            for (int i = 0; i < waiting && !first; i++) accept(*of[i]);
            waiting = 0;
        }
    }

    // The first evaluation of rows that start from one pose of their trial.
    template <class Number> void evaluate_shared(RowBlock &block) {
        const Number *placed = block.placed->links<Number>();
        if (shared_unit_ != block.unit) {
            shared_unit_ = block.unit;
            rods_.factorize(placed, block.now, shared_);
        }
        rods_.evaluate_shared(placed, shared_, block.now, block.step, block.measures);
    }

    // Which rows have tried a step that is a rounding error.
    Mask find_tiny(const RowBlock &block) const { return block.length <= STEP * program_.size; }

    // End the rows that have converged, are near their goal, or can go no further.
    void end_rows(RowBlock &block) const {
        double size = program_.size;
        const Measures &now = block.measures;
        Mask settled = (now.reducible <= RESIDUAL * size) &
                       ((block.applied <= STEP * size) | (block.at_rounding > 2.0));
        Lanes zero = now.reducible * 0.0 + now.length * 0.0;  // NaN where one is not finite
        for (int i = 0; i < 12 * program_.nodes; i++) zero = zero + block.now[i] * 0.0;  // some are in no equation
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

    void accept(RowBlock &block) const {
        double size = program_.size;
        const Measures &now = block.measures, &trial = block.tried;
        const Lanes *step = block.further;
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
        int64_t row[W];
        double *to[W];
        for (int lane = 0; lane < W; lane++)
            row[lane] = block.trial[lane] * division_.n + block.pose[lane];
        write_platforms(block.now, row, block.used, out_.T);
        for (int i = 1; i < program_.nodes; i++)
            write_platforms(block.now + 12 * i, row, block.used, out_.joints[program_.groups + i - 1]);
        const Lanes *theta = block.now + 12 * program_.nodes;
        for (int g = 0; g < program_.groups; g++) {
            int values = program_.group[g].limbs * (program_.group[g].joints + 1);
            for (int lane = 0; lane < W; lane++) to[lane] = out_.joints[g] + row[lane] * values;
            write_rows(theta, values, block.used, to);
            theta += values;
        }
        for (int lane = 0; lane < block.used; lane++) {
            double sign = block.measures.sign[lane];
            out_.residual[row[lane]] = block.measures.residual[lane];
            out_.iterations[row[lane]] = (int64_t)block.steps[lane];
            out_.status[row[lane]] = (int8_t)block.status[lane];
            out_.sign[row[lane]] = (int8_t)((sign > 0.0) - (sign < 0.0));
        }
    }

  private:
    const Program &program_;
    const SolveInput &in_;
    const SolveOutput &out_;
    const Division &division_;
    const Equations &equations_;
    const RodEquations rods_;
    const Workspace &space_;
    SharedFactor shared_;
    int64_t shared_unit_ = -1;
};

inline int solve(const int64_t *structure, const double *numbers, const SolveInput &input,
                 const SolveOutput &output) {
    ProgramMemory memory(structure);
    if (!memory.ok()) return loopcal::NO_MEMORY;
    Program program(structure, numbers, memory.groups, memory.order);
    bool is_chain = input.order != loopcal::APART;
    Division division = is_chain ? Division(input.t, input.n, true) : Division(input.t, input.n);
    int64_t blocks = 1, units = 1;
    if (input.task) {
        blocks = Solver::ROWS_OF_TASK / W < division.blocks() ? Solver::ROWS_OF_TASK / W : division.blocks();
        units = blocks / division.blocks_of_unit() + 2;
    }
    if (!input.task && division.blocks() > 1 && !is_chain) {
        blocks = Solver::PAIR;
        units = blocks / division.blocks_of_unit() + 2;
    }
    Workspace space(program, division, input.task ? loopcal::MOST_CONDITIONS : 0, blocks, units);
    if (!space.ok()) return loopcal::NO_MEMORY;
    NewtonWork work = space.take_work();
    Equations equations(program, work);
    Solver solver(program, input, output, division, equations, space);
    if (!program.freedoms && program.free && have_closed_form(program))
        return solver.close_limbs(*space.block, work.frames);
    return is_chain ? solver.run_chains(*space.block) : solver.run();
}

}  // namespace INSTRUCTION_SET
