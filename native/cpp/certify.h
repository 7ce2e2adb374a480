// SPDX-License-Identifier: Apache-2.0
// Whether Newton's method from a start provably converges to known solutions; see certificate.py,
// whose words are used here.
#pragma once

#include "blocks.h"

namespace INSTRUCTION_SET {

constexpr double CONTRACTION = 0.6, ANGLE = 0.75, DECREASE = 0.99;

// The start of one trial: `Begin` of certificate.py as `pack_begin` writes it.
struct Begin {
    double T[12], tip[6][3], attachment[6][3], distance[6], inverse[6][6], swing[6], bend[3], unit,
        sign;
};

INLINE Mask reaches(const Begin &begin, double size, const Lanes *T) {
    Lanes rows[6][6], distance[6], stretch[6], stretched{};
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

// begin : (t | 1) starts, `stride` doubles apart. goal : (t, n, 4, 4). sign : (t, n).
inline int certify(const double *begin, int64_t stride, const double *goal, double size, int64_t t,
                   int64_t n, int8_t *sign) {
    for (int64_t i = 0; i < t; i++) {
        Begin own;
        std::memcpy(&own, begin + i * stride, sizeof own);
        for (int64_t first = 0; first < n; first += W) {
            int64_t trial[W], pose[W];
            for (int lane = 0; lane < W; lane++) {
                trial[lane] = i;
                pose[lane] = first + lane < n ? first + lane : n - 1;
            }
            Lanes T[12];
            gather_platform({goal, 16 * n, 16}, trial, pose, T);
            Mask is = reaches(own, size, T);
            for (int lane = 0; lane < W && first + lane < n; lane++)
                sign[i * n + first + lane] = is[lane] ? (int8_t)own.sign : 0;
        }
    }
    return loopcal::DONE;
}

}  // namespace INSTRUCTION_SET
