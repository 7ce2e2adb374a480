// SPDX-License-Identifier: Apache-2.0
// Newton's method with step control, W rows at a time; see newton.py, whose words are used here.
#pragma once

#include "blocks.h"
#include "interface.h"
#include "limb.h"

namespace INSTRUCTION_SET {

enum Status { CONVERGED = 0, STALLED = 1, EXHAUSTED = 2, NOT_FINITE = 3, NEAR_GOAL = 8 };
constexpr int64_t ITERATIONS = 60;  // unless a caller states them
constexpr double RESIDUAL = 1e-13, STEP = 1e-7, NEAR = 1e-2, NEARER = 0.1, SINGULAR = 1e-11;

// What one evaluation gives beside the step.
struct Measures {
    Lanes residual, reducible, length, sign, pivot;
};

// Memory that evaluations of all blocks share.
struct NewtonWork {
    Frames frames;
    Lanes *reduced;  // of each limb: columns (unknown | freedoms | sigma | residual) of `rows`
    Lanes *low;      // columns (freedoms | residual) of the rows without joints
    Lanes *front;    // what an elimination of a node factorizes
    Lanes *twists;   // of all nodes
    Lanes *drives;   // values of the driven joints

    static size_t reduced_of(const Program &program) {
        size_t count = 0;
        for (int g = 0; g < program.groups; g++) {
            const Group &group = program.group[g];
            count += (size_t)group.limbs * group.rows * (group.unknown + group.touched + 2);
        }
        return count;
    }
};

// What is asked for beside closure, of each lane. Conditions on the pose: residual (conditions) and
// slopes (conditions, 6). Sums of driven joints: weights (sums, drives) and values (sums).
struct Demands {
    int conditions;
    const double *residual[W], *slopes[W], *weights[W], *values[W];
};

// The largest part of a twist, an angle times the robot's size.
INLINE Lanes measure_twist(const Lanes *twist, double size) {
    Lanes angle{}, shift{};
    for (int i = 0; i < 3; i++) {
        angle = larger(angle, magnitude(twist[i]));
        shift = larger(shift, magnitude(twist[3 + i]));
    }
    return larger(angle * size, shift);
}

class Equations {
  public:
    Equations(const Program &program, const NewtonWork &work)
        : program_(program), work_(work), redundant_(program.sigma && !program.free),
          step_size_(program.step_size()),
          coordinate_size_(12 * program.nodes + program.joint_values()) {}

    int step_size() const { return step_size_; }
    int coordinate_size() const { return coordinate_size_; }

    static int low_rows(const Program &program, int conditions) {
        if (program.eliminations) return program.closed_rows() + conditions;
        int count = conditions + program.sums;
        for (int g = 0; g < program.groups; g++) {
            const Group &group = program.group[g];
            if (group.rows > group.unknown) count += group.limbs * (group.rows - group.unknown);
        }
        return count < program.freedoms ? program.freedoms : count;
    }

    // The Newton step at coordinates and its measures. Where a row `may_stay` (its last step was
    // a rounding error) and it closes, the step is zero, and sign and pivot stay.
    template <class Number>
    void evaluate(const Number *placed, const Lanes *coordinates, const Demands &demands,
                  Mask may_stay, Mask alive, Lanes *step, Measures &measures) const {
        int m = program_.twists, conditions = demands.conditions;
        int rows = low_rows(program_, conditions);
        Lanes inner{}, sign = splat(1.0), pivot = splat(1.0), *reduced = work_.reduced;
        const Lanes *theta = coordinates + 12 * program_.nodes;
        int filled = 0;
        if (program_.eliminations)  // a limb writes the columns of the nodes that it touches
            for (int i = 0; i < rows * (m + 1); i++) work_.low[i] = Lanes{};
        for (int g = 0; g < program_.groups; g++) {
            const Group &group = program_.group[g];
            for (int k = 0; k < group.limbs; k++) {
                if (group.ending == RIGID)
                    eliminate<Number, RIGID>(group, k, placed, coordinates, theta, reduced, rows,
                                             filled, inner, sign, pivot);
                else if (group.ending == BALL)
                    eliminate<Number, BALL>(group, k, placed, coordinates, theta, reduced, rows,
                                            filled, inner, sign, pivot);
                else
                    eliminate<Number, DISTANCE>(group, k, placed, coordinates, theta, reduced, rows,
                                                filled, inner, sign, pivot);
                placed += group.placed();
                theta += group.joints + 1;
                reduced += group.rows * (group.unknown + group.touched + 2);
                if (group.rows > group.unknown) filled += group.rows - group.unknown;
            }
        }
        Lanes *low = work_.low;
        if (program_.sums) {
            sum_drives(coordinates + 12 * program_.nodes, demands, rows, low + filled);
            filled += program_.sums;
        }
        filled += program_.padding;
        for (int i = 0; i < conditions; i++, filled++) {
            for (int f = 0; f < program_.freedoms; f++)
                low[f * rows + filled] = gather(demands.slopes, 6 * i + program_.freedom[f]);
            low[m * rows + filled] = gather(demands.residual, i);
        }
        for (; filled < rows; filled++)
            for (int f = 0; f <= m; f++) low[f * rows + filled] = Lanes{};
        Lanes square{};
        for (int i = 0; i < rows; i++) square = square + low[m * rows + i] * low[m * rows + i];
        Lanes norm = root(inner + square);
        Mask stays = may_stay & (norm <= RESIDUAL * program_.size);
        int count = step_size();
        measures.residual = norm;
        if (!any(alive & ~stays)) {
            for (int i = 0; i < count; i++) step[i] = Lanes{};
            measures.reducible = norm;
            measures.length = Lanes{};
            return;
        }
        Lanes left{}, own[6], *y = program_.eliminations ? work_.twists : own;
        if (program_.eliminations)
            sign = sign * solve_nodes(rows, conditions, y, left);
        else
            sign = sign * solve_platform(rows, y, left);
        for (int i = 0; i < 6 * program_.nodes; i++) step[i] = Lanes{};
        for (int f = 0; f < m; f++) step[program_.place[f]] = y[f];
        solve_joints(y, step + 6 * program_.nodes);
        Lanes length = measure_step(step);
        for (int i = 0; i < count; i++) step[i] = select(stays, Lanes{}, step[i]);
        measures.reducible = select(stays, norm, root(inner + left));
        measures.length = select(stays, Lanes{}, length);
        measures.sign = select(stays, measures.sign, sign);
        measures.pivot = select(stays, measures.pivot, pivot);
    }

    // Coordinates a fraction of the step beyond.
    void move(const Lanes *from, const Lanes *step, Lanes fraction, Lanes *to) const {
        const Lanes *driven = step + step_size_ - program_.drives;
        for (int n = 0; n < program_.nodes; n++, from += 12, to += 12, step += 6) {
            Lanes twist[6], turn[9];
            for (int i = 0; i < 6; i++) twist[i] = fraction * step[i];
            exponential(twist, turn);
            multiply_matrix(turn, from, to);
            for (int i = 0; i < 3; i++) to[9 + i] = from[9 + i] + twist[3 + i];
        }
        for (int g = 0; g < program_.groups; g++) {
            const Group &group = program_.group[g];
            for (int k = 0; k < group.limbs; k++) {
                for (int j = 0; j <= group.joints; j++) to[j] = from[j];
                for (int j = 0; j < group.unknown; j++) {
                    int at = (int)group.solved[j];
                    to[at] = from[at] + fraction * step[j];
                }
                for (int j = 0; j <= group.joints && program_.frees_drives; j++) {
                    int64_t drive = group.actuator[j * group.limbs + k];
                    if (drive >= 0) to[j] = to[j] + fraction * driven[drive];
                }
                from += group.joints + 1, to += group.joints + 1, step += group.unknown;
            }
        }
    }

    // Whether full steps lead close to the platform of a goal: rotation (9) and position (3).
    Mask lead_to(const Lanes *coordinates, const Lanes *step, Lanes step_length,
                 const Lanes *goal) const {
        double size = program_.size;
        Lanes turn[9], rotation[9], square{}, at[3];
        exponential(step, turn);
        multiply_matrix(turn, coordinates, rotation);
        for (int i = 0; i < 9; i++) {
            Lanes gap = rotation[i] - goal[i];
            square = square + gap * gap;
        }
        for (int i = 0; i < 3; i++) at[i] = coordinates[9 + i] + step[3 + i] - goal[9 + i];
        square = 0.5 * size * size * square + dot(at, at);
        Lanes length = smaller(splat(NEAR * size), NEARER * step_length);
        return (step_length <= 0.5 * size) & (square <= length * length);
    }

  private:
    // Eliminate the joints of one limb; its rows without joints are added to work.low.
    template <class Number, int ENDING>
    INLINE void eliminate(const Group &group, int k, const Number *placed, const Lanes *T,
                          const Lanes *theta, Lanes *reduced, int rows, int filled, Lanes &inner,
                          Lanes &sign, Lanes &pivot) const {
        Limb<Number, ENDING> limb(group, k, placed, work_.frames, program_.size, T, theta, 1, false);
        int r = group.rows, u = group.unknown, m = group.touched;
        const int64_t *touches = group.touches + k * m;
        Lanes *column = reduced;
        for (int j = 0; j < u; j++, column += r) limb.joint((int)group.solved[j], column);
        for (int f = 0; f < m; f++, column += r) limb.touch(f, column);
        if (redundant_) {
            int j = 0;
            while (j < group.joints && group.actuator[j * group.limbs] < 0) j++;
            limb.joint(j, column);
            double sigma = program_.sigma[group.actuator[j * group.limbs + k]];
            for (int i = 0; i < r; i++) column[i] = column[i] * sigma;
            column += r;
        }
        limb.residual(column);
        int total = u + m + redundant_ + 1;
        if (u) {
            sign = sign * triangularize(reduced, r, total, u);
            Lanes least = splat(__builtin_inf()), largest = splat(1e-300);
            int diagonal = u < r ? u : r;
            for (int j = 0; j < diagonal; j++) {
                Lanes entry = reduced[j * r + j], size = magnitude(entry);
                sign = sign * signum(entry);
                least = smaller(least, size);
                largest = larger(largest, size);
            }
            pivot = smaller(pivot, least / largest);
            for (int i = 0; i < diagonal; i++) inner = inner + column[i] * column[i];
        }
        for (int i = u; i < r; i++) {
            Lanes *low = work_.low + filled + i - u, scale = splat(1.0);
            if (redundant_) scale = magnitude(reduced[(u + m) * r + i]);
            for (int f = 0; f < m; f++) {
                Lanes entry = reduced[(u + f) * r + i], &to = low[touches[f] * rows];
                if (redundant_) entry = entry / scale;
                to = group.freedom[f] < DRIVEN ? entry : to + entry;  // joints may share a drive
            }
            low[program_.twists * rows] = redundant_ ? column[i] / scale : column[i];
        }
    }

    // The rows of the sums of driven joints at joint values theta, the first one at `low`.
    void sum_drives(const Lanes *theta, const Demands &demands, int rows, Lanes *low) const {
        Lanes *q = work_.drives;
        for (int g = 0; g < program_.groups; g++) {
            const Group &group = program_.group[g];
            for (int k = 0; k < group.limbs; k++, theta += group.joints + 1)
                for (int j = 0; j <= group.joints; j++) {
                    int64_t drive = group.actuator[j * group.limbs + k];
                    if (drive >= 0) q[drive] = theta[j];
                }
        }
        int drives = program_.drives, first = program_.twists - drives;
        for (int i = 0; i < program_.sums; i++, low++) {
            Lanes sum{};
            for (int j = 0; j < drives; j++) {
                Lanes weight = low[(first + j) * rows] = gather(demands.weights, i * drives + j);
                sum = sum + weight * q[j];
            }
            low[program_.twists * rows] = sum - gather(demands.values, i);
        }
    }

    // The twist y of the platform alone, what its rows remove of the residual, and their sign.
    Lanes solve_platform(int rows, Lanes *y, Lanes &left) const {
        int m = program_.freedoms;
        Lanes *low = work_.low, inverse[6];
        Lanes sign = triangularize(low, rows, m + 1, m);
        for (int f = 0; f < m; f++) sign = sign * signum(low[f * rows + f]);
        for (int f = 0; f < m; f++) inverse[f] = 1.0 / low[f * rows + f];
        for (int f = m - 1; f >= 0; f--) {
            Lanes known{};
            for (int c = f + 1; c < m; c++) known = known + low[c * rows + f] * y[c];
            y[f] = (-low[m * rows + f] - known) * inverse[f];
        }
        for (int i = 0; i < m; i++) left = left + low[m * rows + i] * low[m * rows + i];
        return sign;
    }

    // The same for all nodes, the last one eliminated first.
    Lanes solve_nodes(int rows, int conditions, Lanes *y, Lanes &left) const {
        Lanes *low = work_.low;
        Lanes sign = eliminate_nodes(program_, low, rows, conditions, 1, work_.front);
        const Lanes *right = low + program_.twists * rows;
        for (int n = program_.eliminations - 1; n >= 0; n--) {
            const Elimination &node = program_.elimination[n];
            for (int f = node.count - 1; f >= 0; f--) {
                int row = program_.find_row(n, f, rows, conditions);
                Lanes known{};
                for (int c = f + 1; c < node.columns; c++)
                    known = known + low[node.column[c] * rows + row] * y[node.column[c]];
                y[node.column[f]] = (-right[row] - known) / low[node.column[f] * rows + row];
                left = left + right[row] * right[row];
            }
        }
        return sign;
    }

    // The steps of the joints that follow from the steps y of the nodes.
    void solve_joints(const Lanes *y, Lanes *step) const {
        const Lanes *reduced = work_.reduced;
        for (int g = 0; g < program_.groups; g++) {
            const Group &group = program_.group[g];
            int r = group.rows, u = group.unknown, m = group.touched;
            for (int k = 0; k < group.limbs; k++) {
                const int64_t *touches = group.touches + k * m;
                const Lanes *right = reduced + (u + m + redundant_) * r;
                for (int j = u - 1; j >= 0; j--) {
                    if (j >= r) {  // more joints than rows: nothing determines them
                        step[j] = splat(__builtin_nan(""));
                        continue;
                    }
                    Lanes rest = right[j];
                    for (int f = 0; f < m; f++) rest = rest + reduced[(u + f) * r + j] * y[touches[f]];
                    Lanes known{};
                    for (int c = j + 1; c < u; c++) known = known + reduced[c * r + j] * step[c];
                    step[j] = (-rest - known) / reduced[j * r + j];
                }
                step += u;
                reduced += r * (u + m + 2);
            }
        }
    }

    // The largest part of a step, an angle times the robot's size.
    Lanes measure_step(const Lanes *step) const {
        const Lanes *driven = step + step_size_ - program_.drives;
        Lanes length = measure_twist(step, program_.size);
        step += 6;
        for (int n = 1; n < program_.nodes; n++, step += 6)
            length = larger(length, measure_twist(step, program_.size));
        for (int g = 0; g < program_.groups; g++) {
            const Group &group = program_.group[g];
            auto measure = [&](int j, Lanes moved) {
                bool turns = j < group.joints && group.turns[j];
                length = larger(length, magnitude(moved) * (turns ? program_.size : 1.0));
            };
            for (int k = 0; k < group.limbs; k++) {
                for (int j = 0; j < group.unknown; j++) measure((int)group.solved[j], *step++);
                for (int j = 0; j <= group.joints && program_.frees_drives; j++) {
                    int64_t drive = group.actuator[j * group.limbs + k];
                    if (drive >= 0) measure(j, driven[drive]);
                }
            }
        }
        return length;
    }

    const Program &program_;
    const NewtonWork &work_;
    bool redundant_;
    int step_size_, coordinate_size_;
};

}  // namespace INSTRUCTION_SET
