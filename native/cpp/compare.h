// SPDX-License-Identifier: Apache-2.0
// Differences of poses as rotation vectors and translations, and their derivatives: the logarithm
// of loopcal.geometry.rotations, W poses at once.
#pragma once

#include "interface.h"
#include "lanes.h"

namespace INSTRUCTION_SET {

// atan(y / x) for x, y >= 0, not both zero, to 2 units in the last place. Source: S. Moshier,
// "Methods and Programs for Mathematical Functions", 1989 (Cephes, atan.c).
INLINE Lanes angle_of(Lanes y, Lanes x) {
    Mask is_steep = y > 2.41421356237309504880 * x;     // tan(3 pi / 8)
    Mask is_middle = ~is_steep & (y > 0.66 * x);
    Lanes up = select(is_steep, -x, select(is_middle, y - x, y));
    Lanes down = select(is_steep, y, select(is_middle, y + x, x));
    Lanes r = up / down, z = r * r;
    Lanes p = splat(-8.750608600031904122785e-1);
    p = p * z - 1.615753718733365076637e1;
    p = p * z - 7.500855792314704667340e1;
    p = p * z - 1.228866684490136173410e2;
    p = p * z - 6.485021904942025371773e1;
    Lanes q = z + 2.485846490142306297962e1;
    q = q * z + 1.650270098316988542046e2;
    q = q * z + 4.328810604912902668951e2;
    q = q * z + 4.853903996359136964868e2;
    q = q * z + 1.945506571482613964425e2;
    Lanes angle = r * (z * (p / q)) + r;
    // pi / 2 and pi / 4 in two parts
    constexpr double HALF_PI = 1.57079632679489661923, REST = 6.123233995736765886130e-17;
    Lanes first = select(is_steep, splat(HALF_PI), select(is_middle, splat(0.5 * HALF_PI), splat(0)));
    Lanes rest = select(is_steep, splat(REST), select(is_middle, splat(0.5 * REST), splat(0)));
    return first + (angle + rest);
}

// The unit quaternion (scalar first, not negative) of a rotation, as `matrix_to_quaternion`.
INLINE void quaternion_of(const Lanes R[3][3], Lanes quaternion[4]) {
    Lanes trace = R[0][0] + R[1][1] + R[2][2];
    Lanes d[4] = {1.0 + trace, 1.0 + 2.0 * R[0][0] - trace, 1.0 + 2.0 * R[1][1] - trace,
                  1.0 + 2.0 * R[2][2] - trace};
    Lanes wx = R[2][1] - R[1][2], wy = R[0][2] - R[2][0], wz = R[1][0] - R[0][1];
    Lanes xy = R[0][1] + R[1][0], xz = R[0][2] + R[2][0], yz = R[1][2] + R[2][1];
    const Lanes rows[4][4] = {
        {d[0], wx, wy, wz}, {wx, d[1], xy, xz}, {wy, xy, d[2], yz}, {wz, xz, yz, d[3]}};
    Mask first = d[0] >= d[1], second = d[2] >= d[3];
    Mask lower = select(first, d[0], d[1]) >= select(second, d[2], d[3]);
    Lanes square = splat(0);
    for (int i = 0; i < 4; i++) {
        quaternion[i] = select(lower, select(first, rows[0][i], rows[1][i]),
                               select(second, rows[2][i], rows[3][i]));
        square += quaternion[i] * quaternion[i];
    }
    Lanes scale = select(quaternion[0] < 0.0, splat(-1.0), splat(1.0)) / root(square);
    for (int i = 0; i < 4; i++) quaternion[i] *= scale;
}

// arrays : T (t | 1, n | 1, 16) and rotations and translations (t | 1, n | 1, 12).
// residual : (t, n, 6) rotation vectors and translations of T less those.
// by_twist : (t, n, 6, 6) its derivative by a twist of T.
int compare_poses(const loopcal::Strided *arrays, double *residual, double *by_twist, int64_t t,
                  int64_t n) {
    constexpr double TINY = 1e-200;
    const loopcal::Strided &poses = arrays[0], &references = arrays[1];
    std::memset(by_twist, 0, size_t(t * n) * 36 * sizeof(double));
    for (int64_t first = 0; first < t * n; first += W) {
        int64_t count = t * n - first < W ? t * n - first : W;
        double in[24][W], out[15][W];
        for (int64_t k = 0; k < W; k++) {
            int64_t row = first + (k < count ? k : 0), trial = row / n, pose = row % n;
            const double *T = poses.data + trial * poses.trial + pose * poses.pose;
            const double *M = references.data + trial * references.trial + pose * references.pose;
            for (int i = 0; i < 12; i++) in[i][k] = T[i];
            for (int i = 0; i < 12; i++) in[12 + i][k] = M[i];
        }
        Lanes R[3][3], q[4];
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++)
                R[i][j] = load(in[4 * i]) * load(in[12 + 3 * j]) +
                          load(in[4 * i + 1]) * load(in[13 + 3 * j]) +
                          load(in[4 * i + 2]) * load(in[14 + 3 * j]);
        quaternion_of(R, q);
        Lanes length = root(q[1] * q[1] + q[2] * q[2] + q[3] * q[3] + TINY);
        Lanes half = angle_of(length, q[0]), scale = 2.0 * half / length, w[3];
        for (int i = 0; i < 3; i++) {
            w[i] = scale * q[i + 1];
            store(out[i], w[i]);
            store(out[3 + i], load(in[4 * i + 3]) - load(in[21 + i]));
        }
        // I - hat(w) / 2 + (1 - (a / 2) cot(a / 2)) / a^2 hat(w)^2; cot(a / 2) = scalar / length
        Lanes square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2] + TINY;
        Lanes second = (1.0 - half * (q[0] / length)) / square;
        for (int i = 0; i < 3; i++) {
            int j = (i + 1) % 3, k = (i + 2) % 3;
            Lanes both = second * w[i] * w[j], turn = 0.5 * w[k];
            store(out[6 + 4 * i], 1.0 - second * w[j] * w[j] - second * w[k] * w[k]);
            store(out[6 + 3 * i + j], both + turn);
            store(out[6 + 3 * j + i], both - turn);
        }
        for (int64_t k = 0; k < count; k++) {
            double *r = residual + 6 * (first + k), *D = by_twist + 36 * (first + k);
            for (int i = 0; i < 6; i++) r[i] = out[i][k];
            for (int i = 0; i < 3; i++) {
                for (int j = 0; j < 3; j++) D[6 * i + j] = out[6 + 3 * i + j][k];
                D[21 + 7 * i] = 1.0;
            }
        }
    }
    return loopcal::DONE;
}

}  // namespace INSTRUCTION_SET
