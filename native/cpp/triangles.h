// SPDX-License-Identifier: Apache-2.0
// Upper triangular systems, see loopcal.engine.solve_triangles. Sums run in one order for every
// instruction set.
#pragma once

#include "interface.h"
#include "lanes.h"

namespace INSTRUCTION_SET {

// triangle : (t, p, p) R. right, x : (t, p), R x = right. growth : (t,) largest entry of M^-1 1,
// where M has |r_ii| on its diagonal and -|r_ij| beside it. y : (p,). width : of the rows of R.
// Two systems share each entry that is read: their chains of sums run side by side.
INLINE void solve_triangle(const double *R, const double *right, double *x, double *y,
                           double *growth, int64_t p, int64_t width) {
    double most = 0.0;
    for (int64_t i = p - 1; i >= 0; i--) {
        const double *row = R + i * width;
        double known = right[i], size = 1.0;
        for (int64_t j = i + 1; j < p; j++) {
            known -= row[j] * x[j];
            size += magnitude(row[j]) * y[j];
        }
        x[i] = known / row[i];
        y[i] = size / magnitude(row[i]);
        most = larger(most, y[i]);
    }
    *growth = most;
}

int solve_triangles(const double *triangle, const double *right, double *x, double *growth,
                    int64_t t, int64_t p) {
    Arena arena(Arena::need<double>(p));
    if (!arena.ok()) return loopcal::NO_MEMORY;
    double *y = arena.take<double>(p);
    for (int64_t i = 0; i < t; i++)
        solve_triangle(triangle + i * p * p, right + i * p, x + i * p, y, growth + i, p, p);
    return loopcal::DONE;
}

}  // namespace INSTRUCTION_SET
