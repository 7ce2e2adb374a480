// SPDX-License-Identifier: Apache-2.0
// Whether Newton's method from a start provably converges to known solutions: the proof is that of
// docs/theory/kinematics.md, whose words are used here.
#pragma once

#include "rods.h"

namespace INSTRUCTION_SET {

constexpr double CONTRACTION = 0.6, ANGLE = 0.75, DECREASE = 0.99;
constexpr int SQUARINGS = 30;

// The spectral norm of a matrix, squared: s with G = C'C and s(G)^2 = s(G^2), where the trace of
// G^(2^i) exceeds its spectral norm by less and less; above it by 2e-9 of itself at most.
inline double square_norm(const double (&C)[6][6]) {
    double G[6][6], next[6][6], traces[SQUARINGS];
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) {
            G[i][j] = 0.0;
            for (int k = 0; k < 6; k++) G[i][j] += C[k][i] * C[k][j];
        }
    for (int s = 0; s < SQUARINGS; s++) {
        double trace = 0.0;
        for (int i = 0; i < 6; i++) trace += G[i][i];
        traces[s] = trace;
        for (int i = 0; i < 6; i++)
            for (int j = 0; j < 6; j++) G[i][j] /= trace;
        for (int i = 0; i < 6; i++)
            for (int j = 0; j < 6; j++) {
                next[i][j] = 0.0;
                for (int k = 0; k < 6; k++) next[i][j] += G[i][k] * G[k][j];
            }
        std::memcpy(G, next, sizeof G);
    }
    double norm = traces[SQUARINGS - 1];
    for (int s = SQUARINGS - 2; s >= 0; s--) norm = traces[s] * root(norm);
    return norm;
}

// The start of one trial.
struct Begin {
    double T[12], tip[6][3], attachment[6][3], distance[6], inverse[6][6], swing[6], bend[3], unit,
        sign;

    // placed : the links of a program that has driven rods. platform : rotation and position.
    void prepare(const Program &program, const RodEquations &equations, const double *placed,
                 const double *platform) {
        double square[6], sum = 0.0;
        Lanes lanes[12];
        for (int i = 0; i < 12; i++) T[i] = platform[i], lanes[i] = splat(platform[i]);
        for (int k = 0; k < 6; k++, placed += ROD) {
            for (int i = 0; i < 3; i++) tip[k][i] = placed[18 + i], attachment[k][i] = placed[LINK + 18 + i];
            const double *a = attachment[k];
            square[k] = a[0] * a[0] + a[1] * a[1] + a[2] * a[2];
            sum += square[k];
        }
        unit = root(sum / 3.0);
        SharedFactor factor;
        equations.factorize(placed - 6 * ROD, lanes, factor);
        sign = factor.sign[0];
        for (int k = 0; k < 6; k++) {
            Lanes column[6] = {}, y[6];
            column[k] = splat(-1.0);
            factor.solve(column, y);
            distance[k] = factor.distance[k][0];
            // a turn is measured by `unit`, the length by which it becomes a displacement
            for (int i = 0; i < 6; i++) {
                int f = program.freedom[i];
                inverse[f][k] = f < 3 ? y[i][0] * unit : y[i][0];
            }
        }
        bend[0] = bend[1] = bend[2] = 0.0;
        for (int k = 0; k < 6; k++) {
            double ratio = root(square[k]) / unit, s2 = 1.0 + square[k] / (unit * unit);
            swing[k] = root(s2);
            bend[0] += ratio / unit * (ratio / unit);
            bend[1] += 2.0 * (ratio * ratio) * swing[k] / unit;
            bend[2] += s2 * s2;
        }
        double norm = square_norm(inverse);
        for (int i = 0; i < 3; i++) bend[i] = norm * bend[i];
    }
};

// Whether the platforms T are proven; `distance` of the ends of the rods there.
INLINE Mask reaches(const Begin &begin, double size, const Lanes *T, Lanes *distance) {
    Lanes rows[6][6], stretch[6], stretched{};
    double inverse_unit = 1.0 / begin.unit, swings = 0.0;
    for (int k = 0; k < 6; k++) {
        Lanes arm[3], gap[3];
        multiply_vector(T, begin.attachment[k], arm);
        for (int i = 0; i < 3; i++) gap[i] = arm[i] + T[9 + i] - begin.tip[k][i];
        distance[k] = root(dot(gap, gap));
        Lanes inverse = 1.0 / distance[k];
        for (int i = 0; i < 3; i++) rows[k][3 + i] = gap[i] * inverse;
        cross(arm, rows[k] + 3, rows[k]);
        for (int i = 0; i < 3; i++) rows[k][i] = rows[k][i] * inverse_unit;
        stretch[k] = distance[k] - begin.distance[k];
        stretched = stretched + stretch[k] * stretch[k];
        swings += begin.swing[k] * begin.swing[k];
    }
    Lanes step[6], length{}, turn[9], first[9], turned[9], apart{}, missed{};
    for (int i = 0; i < 6; i++) {
        step[i] = begin.inverse[i][0] * stretch[0];
        for (int k = 1; k < 6; k++) step[i] = step[i] + begin.inverse[i][k] * stretch[k];
        if (i < 3) step[i] = step[i] * inverse_unit;
        length = larger(length, i < 3 ? magnitude(step[i]) * size : magnitude(step[i]));
    }
    exponential(step, turn);
    for (int i = 0; i < 9; i++) first[i] = splat(begin.T[i]);
    multiply_matrix(turn, first, turned);
    for (int i = 0; i < 9; i++) {
        Lanes gap = turned[i] - T[i];
        apart = apart + gap * gap;
    }
    for (int i = 0; i < 3; i++) {
        Lanes gap = begin.T[9 + i] + step[3 + i] - T[9 + i];
        missed = missed + gap * gap;
    }
    double angle = ANGLE * begin.unit;
    Lanes error2 = angle * angle * apart + missed, error = root(error2);
    Lanes shortest = distance[0] - begin.swing[0] * error;
    for (int k = 1; k < 6; k++) shortest = smaller(shortest, distance[k] - begin.swing[k] * error);
    Lanes h = 1.0 / shortest, bend = begin.bend[0] + (begin.bend[1] + begin.bend[2] * h) * h;
    Lanes off[6][6], square{};
    for (int i = 0; i < 6; i++)
        for (int f = 0; f < 6; f++) {
            Lanes sum = begin.inverse[i][0] * rows[0][f];
            for (int k = 1; k < 6; k++) sum = sum + begin.inverse[i][k] * rows[k][f];
            off[i][f] = i == f ? sum - 1.0 : sum;
        }
    for (int f = 0; f < 6; f++)
        for (int g = 0; g <= f; g++) {
            Lanes sum = off[0][f] * off[0][g];
            for (int i = 1; i < 6; i++) sum = sum + off[i][f] * off[i][g];
            square = square + (f == g ? 1.0 : 2.0) * (sum * sum);
        }
    Lanes deviation = root(root(square));
    return (shortest > 0.0) & (apart <= 1.0) & (length <= 0.5 * size) &
           (swings * error2 <= DECREASE * DECREASE * stretched) &
           (root(bend) * error <= CONTRACTION * (1.0 - deviation));
}

// arrays : e, start, goal (t, n, 4, 4). sign : (t, n).
inline int certify(const int64_t *structure, const double *numbers, const loopcal::Strided *arrays,
                   int64_t t, int64_t n, int8_t *sign) {
    ProgramMemory memory(structure);
    if (!memory.ok()) return loopcal::NO_MEMORY;
    Program program(structure, numbers, memory.groups, memory.order);
    Division division(t, n, false);
    Arena arena(PlacedUnit::need(program));
    if (!arena.ok()) return loopcal::NO_MEMORY;
    RodEquations equations(program);
    PlacedUnit placed;
    placed.prepare(program, division, arena);
    Begin begin;
    for (int64_t i = 0; i < t; i++) {
        if (!i || arrays[0].trial || arrays[1].trial) {
            double platform[12];
            read_platform(locate(arrays[1], i, 0), platform);
            placed.place(i, arrays[0]);
            begin.prepare(program, equations, placed.numbers(), platform);
        }
        for (int64_t first = 0; first < n; first += W) {
            int64_t trial[W], pose[W];
            int used = division.locate(i * division.blocks_of_unit() + first / W, trial, pose);
            Lanes T[12], distance[6];
            gather_platform(arrays[2], trial, pose, T);
            Mask is = reaches(begin, program.size, T, distance);
            for (int lane = 0; lane < used; lane++)
                sign[i * n + first + lane] = is[lane] ? (int8_t)begin.sign : 0;
        }
    }
    return loopcal::DONE;
}

}  // namespace INSTRUCTION_SET
