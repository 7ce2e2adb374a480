// SPDX-License-Identifier: Apache-2.0
// Points of the platform in a frame of an instrument, and their derivatives, W rows at once; see
// loopcal.engine.locate_points.
#pragma once

#include "blocks.h"
#include "interface.h"

namespace INSTRUCTION_SET {

// arrays : T (t | 1, n | 1, 16), values of the frame (t | 1, n | 1, 6) or null, points (t | 1, n | 1,
// 3 k). stated : (16,) the frame from whose orientation its rotation vector counts. columns : first
// ones of the frame and of the points, -1 for none, and the width of the rows.
// x : (t, n, k, 3). slopes : (t, n, k, 3, width).
//
// With columns f_i of the frame's rotation, arm a = R p and lever l = a + t - t_f, x_i = f_i'l; its
// derivatives are [a x f_i | f_i] by the platform's twist, [f_i x l | -f_i] by that of the frame, and
// f_i'R by the point.
inline int locate_points(const loopcal::Strided *arrays, const double *stated, const int64_t *columns,
                         double *x, double *slopes, int64_t t, int64_t n, int64_t k) {
    const int64_t of_frame = columns[0], of_points = columns[1], width = columns[2];
    Arena arena(Arena::need<Lanes>(3 * width));
    if (!arena.ok()) return loopcal::NO_MEMORY;
    Lanes *row = arena.take<Lanes>(3 * width);
    for (int64_t i = 0; i < 3 * width; i++) row[i] = Lanes{};
    for (int64_t first = 0; first < t * n; first += W) {
        int used = t * n - first < W ? (int)(t * n - first) : W;
        const double *from[3][W];
        for (int lane = 0; lane < W; lane++) {
            int64_t at = first + (lane < used ? lane : 0);
            for (int i = 0; i < 3; i++)
                from[i][lane] = arrays[i].data + at / n * arrays[i].trial + at % n * arrays[i].pose;
        }
        Lanes R[9], shift[3], F[9], J[9] = {};
        for (int i = 0; i < 3; i++) {
            shift[i] = gather(from[0], 4 * i + 3) - stated[4 * i + 3];
            for (int j = 0; j < 3; j++) {
                R[3 * i + j] = gather(from[0], 4 * i + j);
                F[3 * i + j] = splat(stated[4 * i + j]);
            }
        }
        if (arrays[1].data) {
            double given[9];
            for (int i = 0; i < 9; i++) given[i] = stated[4 * (i / 3) + i % 3];
            Lanes w[3], turned[9];
            for (int i = 0; i < 3; i++) {
                w[i] = gather(from[1], i);
                shift[i] = gather(from[0], 4 * i + 3) - gather(from[1], 3 + i);
            }
            exponential(w, turned);
            multiply_matrix(turned, given, F);
            left_jacobian(w, J);
        }
        for (int64_t point = 0; point < k; point++) {
            Lanes p[3], arm[3], lever[3], out[3];
            for (int i = 0; i < 3; i++) p[i] = gather(from[2], 3 * point + i);
            multiply_vector(R, p, arm);
            for (int i = 0; i < 3; i++) lever[i] = arm[i] + shift[i];
            for (int i = 0; i < 3; i++) {
                const Lanes f[3] = {F[i], F[3 + i], F[6 + i]};
                Lanes *at = row + i * width, turn[3];
                out[i] = dot(f, lever);
                cross(arm, f, at);
                for (int j = 0; j < 3; j++) at[3 + j] = f[j];
                if (of_frame >= 0) {
                    cross(f, lever, turn);
                    for (int j = 0; j < 3; j++) {
                        at[of_frame + j] = turn[0] * J[j] + turn[1] * J[3 + j] + turn[2] * J[6 + j];
                        at[of_frame + 3 + j] = -f[j];
                    }
                }
                if (of_points >= 0)
                    for (int j = 0; j < 3; j++)
                        at[of_points + 3 * point + j] = f[0] * R[j] + f[1] * R[3 + j] + f[2] * R[6 + j];
            }
            double *of_x[W], *of_row[W];
            for (int lane = 0; lane < W; lane++) {
                int64_t at = (first + (lane < used ? lane : 0)) * k + point;
                of_x[lane] = x + 3 * at, of_row[lane] = slopes + 3 * width * at;
            }
            write_rows(out, 3, used, of_x);
            write_rows(row, 3 * width, used, of_row);
            if (of_points >= 0)  // the next point has other columns
                for (int i = 0; i < 9; i++)
                    row[i / 3 * width + of_points + 3 * point + i % 3] = Lanes{};
        }
    }
    return loopcal::DONE;
}

}  // namespace INSTRUCTION_SET
