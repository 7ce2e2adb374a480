// SPDX-License-Identifier: Apache-2.0
// Driven rods closed at platforms that coordinates state, and whether their readings lead there from
// the start; see targets.py, whose words are used here.
#pragma once

#include "certify.h"
#include "interface.h"
#include "solve.h"

namespace INSTRUCTION_SET {

// columns : of x, y, z and the turns about z, y, and x or z in a row of `values`, -1 for none; then
// whether the last turn is about z. base : rotation (9) and position (3) of what is not stated.
struct Target {
    loopcal::Strided values;
    const int64_t *columns;
    double base[12];

    INLINE void place(const int64_t *trial, const int64_t *pose, Lanes *T) const {
        const double *from[W];
        for (int lane = 0; lane < W; lane++) from[lane] = locate(values, trial[lane], pose[lane]);
        Lanes turn[3] = {};
        bool turns = false;
        for (int i = 0; i < 3; i++) {
            T[9 + i] = columns[i] < 0 ? splat(base[9 + i]) : gather(from, columns[i]);
            if (columns[3 + i] < 0) continue;
            turn[i] = gather(from, columns[3 + i]);
            turns = true;
        }
        if (!turns) {
            widen(base, T, 9);
            return;
        }
        if (columns[6]) turn[2] = turn[2] - turn[0];
        Lanes s[3], c[3];
        for (int i = 0; i < 3; i++) sine_and_cosine(turn[i], s[i], c[i]);
        Lanes x[3] = {c[0] * c[1], s[0] * c[1], -s[1]}, y[3] = {-s[0], c[0], Lanes{}};
        Lanes z[3] = {c[0] * s[1], s[0] * s[1], c[1]};
        for (int i = 0; i < 3; i++) {
            Lanes &first = columns[6] ? x[i] : y[i], &second = columns[6] ? y[i] : z[i];
            Lanes turned = c[2] * first + s[2] * second;
            second = c[2] * second - s[2] * first;
            first = turned;
            T[3 * i] = x[i], T[3 * i + 1] = y[i], T[3 * i + 2] = z[i];
        }
    }
};

class TargetCloser {
  public:
    TargetCloser(const Program &program, const RodEquations &equations, Solver &solver, RowBlock &block,
                 const Target &target, const loopcal::ReachOutput &out, int64_t n)
        : program_(program), equations_(equations), solver_(solver), block_(block), target_(target),
          out_(out), n_(n) {}

    // All poses of a trial, of which `pending` keeps those that the certificate leaves open.
    void close(int64_t trial, const Begin &begin, double sign, const double *placed) {
        int64_t pending[2 * W];
        int open = 0;
        for (int64_t first = 0; first < n_; first += W) {
            int64_t trials[W], pose[W];
            int used = n_ - first < W ? (int)(n_ - first) : W;
            for (int lane = 0; lane < W; lane++)
                trials[lane] = trial, pose[lane] = first + (lane < used ? lane : used - 1);
            Lanes T[12], distance[6];
            target_.place(trials, pose, T);
            Mask proven = reaches(begin, program_.size, T, distance);
            write(trial * n_ + first, used, placed, T, distance);
            write_bytes(proven & 1, used, out_.arrives + trial * n_ + first);
            Lanes sign_there = select(proven, splat(begin.sign), Lanes{});
            write_bytes(__builtin_convertvector(sign_there, Mask), used, out_.sign + trial * n_ + first);
            if (any(~proven))
                for (int lane = 0; lane < used; lane++)
                    if (!proven[lane]) pending[open++] = first + lane;
            bool is_last = first + W >= n_;
            while (open >= W || (is_last && open)) {
                int count = open < W ? open : W;
                follow(trial, sign, placed, pending, count);
                for (int i = count; i < open; i++) pending[i - count] = pending[i];
                open -= count;
            }
        }
    }

  private:
    void write(int64_t row, int used, const double *placed, const Lanes *T, const Lanes *distance) const {
        Lanes square{}, theta[6];
        for (int k = 0; k < 6; k++) {
            double length = placed[k * ROD + 2 * LINK];
            theta[k] = distance[k] - length;
            Lanes left = distance[k] - (length + theta[k]);
            square = square + left * left;
        }
        Lanes residual = root(square), status = judge_closed(residual, program_.size);
        int64_t rows[W];
        double *to[W];
        for (int lane = 0; lane < W; lane++) rows[lane] = row + lane;
        write_platforms(T, rows, used, out_.T);
        write_bytes(__builtin_convertvector(status, Mask), used, out_.status + row);
        if (used == W)
            store(out_.residual + row, residual);
        else
            for (int lane = 0; lane < used; lane++) out_.residual[row + lane] = residual[lane];
        const Lanes *value = theta;
        for (int g = 0; g < program_.groups; g++) {
            int limbs = program_.group[g].limbs;
            for (int lane = 0; lane < W; lane++) to[lane] = out_.joints[g] + (row + lane) * limbs;
            write_rows(value, limbs, used, to);
            value += limbs;
        }
    }

    // The sign at poses of a trial that nothing is known of, and where it is that of the start,
    // whether Newton's method comes near them.
    void follow(int64_t trial, double begun, const double *placed, const int64_t *pose, int count) {
        int64_t trials[W], poses[W];
        for (int lane = 0; lane < W; lane++)
            trials[lane] = trial, poses[lane] = pose[lane < count ? lane : count - 1];
        Lanes T[12];
        gather_platform({out_.T, 16 * n_, 16}, trials, poses, T);
        equations_.factorize(placed, T, factor_);
        bool is_hopeless = true;
        for (int lane = 0; lane < count; lane++) {
            double sign = factor_.sign[lane];
            out_.sign[trial * n_ + poses[lane]] = (int8_t)((sign > 0.0) - (sign < 0.0));
            is_hopeless &= sign != begun;
        }
        if (is_hopeless) return;
        Mask arrives = solver_.come_near(block_, trial, poses, count) & (factor_.sign == begun);
        for (int lane = 0; lane < count; lane++)
            out_.arrives[trial * n_ + poses[lane]] = arrives[lane] != 0;
    }

    const Program &program_;
    const RodEquations &equations_;
    Solver &solver_;
    RowBlock &block_;
    const Target &target_;
    const loopcal::ReachOutput &out_;
    int64_t n_;
    SharedFactor factor_;
};

// arrays : e, start, values of the target, closure sign of the start.
inline int reach(const int64_t *structure, const double *numbers, const loopcal::Strided *arrays,
                 const int64_t *columns, const double *base, int64_t t, int64_t n,
                 const loopcal::ReachOutput *output) {
    const loopcal::ReachOutput &out = *output;
    ProgramMemory memory(structure);
    if (!memory.ok()) return loopcal::NO_MEMORY;
    Program program(structure, numbers, memory.groups, memory.order);
    Division division(t, n, false);
    // Newton's method begins at the start, with the lengths that lead to the goal
    loopcal::Strided lengths[6], goal{out.T, 16 * n, 16};
    for (int g = 0; g < program.groups; g++) {
        int64_t limbs = program.group[g].limbs;
        lengths[g] = {out.joints[g], limbs * n, limbs};
    }
    SolveInput input{arrays[0], {}, arrays[1], goal, lengths, t, n, ITERATIONS, nullptr, nullptr};
    SolveOutput none{};
    Workspace space(program, division, 0, 1, 1);
    if (!space.ok()) return loopcal::NO_MEMORY;
    NewtonWork work = space.take_work();
    Equations equations(program, work);
    Solver solver(program, input, none, division, equations, space);
    Target target{arrays[2], columns, {}};
    read_platform(base, target.base);
    RodEquations rods(program);
    TargetCloser closer(program, rods, solver, *space.block, target, out, n);
    Begin begin;
    PlacedUnit &placed = *space.unit;
    for (int64_t i = 0; i < t; i++) {
        placed.place(i, arrays[0]);
        if (!i || arrays[0].trial || arrays[1].trial) {
            double platform[12];
            read_platform(locate(arrays[1], i, 0), platform);
            begin.prepare(program, rods, placed.numbers(), platform);
        }
        closer.close(i, begin, *locate(arrays[3], i, 0), placed.numbers());
    }
    return loopcal::DONE;
}

}  // namespace INSTRUCTION_SET
