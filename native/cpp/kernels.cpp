// SPDX-License-Identifier: Apache-2.0
// The kernels of one instruction set. The build compiles this file once for each set, with
// INSTRUCTION_SET (a namespace) and LANES (doubles of a vector).
#include "certify.h"
#include "compare.h"
#include "compared.h"
#include "eliminate.h"
#include "fold.h"
#include "fold_poses.h"
#include "interface.h"
#include "linearize.h"
#include "points.h"
#include "sensitivity.h"
#include "solve.h"
#include "targets.h"
#include "triangles.h"

namespace INSTRUCTION_SET {

// arrays : e, q, T
static int call_linearize(const int64_t *structure, const double *numbers,
                          const loopcal::Strided *arrays, const loopcal::Strided *joints,
                          double *const *out, int64_t t, int64_t n) {
    return linearize(structure, numbers, arrays[0], arrays[1], arrays[2], joints, out, t, n);
}

// arrays : e, q, T, goal, and of sums of driven joints weights and values
static int call_solve(const int64_t *structure, const double *numbers,
                      const loopcal::Strided *arrays, const loopcal::Strided *joints, int64_t t,
                      int64_t n, int64_t max_iterations, int order, loopcal::Task task,
                      void *context, double *T, double *const *joints_out, double *residual, int64_t *iterations,
                      int8_t *status, int8_t *sign) {
    SolveInput input{arrays[0], arrays[1], arrays[2], arrays[3], joints, t, n, max_iterations,
                     task,      context,   arrays[4], arrays[5], (loopcal::Order)order};
    SolveOutput output{T, joints_out, residual, iterations, status, sign};
    return solve(structure, numbers, input, output);
}

extern const loopcal::Kernels kernels;
const loopcal::Kernels kernels = {fold,          call_linearize, certify,         reach,     differentiate,
                                   fold_poses,    fold_compared,  compare_poses,   solve_triangles,
                                   locate_points, eliminate_blocks, call_solve};

}  // namespace INSTRUCTION_SET
