// SPDX-License-Identifier: Apache-2.0
// What the kernels of one instruction set offer; dispatch.cpp passes it on as a C interface.
#pragma once

#include <cstdint>

namespace loopcal {

// Return values of the functions.
enum Outcome { DONE = 0, NO_MEMORY = 1, TASK_FAILED = 2 };

// Whether poses begin at the start, or each at the solution of the one before; then a trial may end at
// the first pose that does not converge, whose status the others get.
enum Order { APART = 0, CHAINED = 1, ENDING = 2 };

constexpr int MOST_CONDITIONS = 64;  // of a task, for each row; library.py refuses more

struct TaskAnswer {
    const double *residual, *slopes;  // (count, conditions), (count, conditions, 6)
    int64_t conditions;
};

// Conditions on `count` poses (count, 3, 4) of these rows; a value other than 0 ends the call.
typedef int (*Task)(void *context, int64_t count, const double *poses, const int64_t *rows,
                    TaskAnswer *answer);

// An array (t | 1, n | 1, ..): strides of its first axes in doubles, 0 for an axis of length 1.
struct Strided {
    const double *data;
    int64_t trial, pose;
};

// Whitened rows of poses: derivatives (t | 1, count, 6) by the platform's twist and residuals
// (t, count), `trial` numbers apart. pose : of each row, ascending.
struct TwistRows {
    int64_t count;
    const int64_t *pose;
    Strided by_twist, residual;
};

// `count` blocks of `own` unknowns each, and the results of t trials. path : (count, width) numbers of
// their unknowns, then of those of their ancestors. parent : number of the structure of the parents, -1
// for none; parent_place : (count,) places there. inverse : (t, count, own, own). solution : (t, count,
// own, width - own + p + 1).
struct BlockStructure {
    int64_t count, own, width, parent;
    const int64_t *path, *parent_place;
    double *inverse, *solution;
};

// `count` sets of `height` rows of blocks of one structure, see loopcal.engine.BlockRows. place :
// (count,) block of each set; columns : (count, used). Rows are `pose` numbers apart.
struct BlockRows {
    int64_t structure, count, height, used;
    const int64_t *place, *columns;
    Strided by_unknowns, machine;
};

// T (t, n, 4, 4), joints of each group, and (t, n): residual, status, sign, whether the joints lead
// there.
struct ReachOutput {
    double *T, *const *joints, *residual;
    int8_t *status, *sign, *arrives;
};

// Measured poses of one trial: numbers (count,) ascending, rotations and translations (count, 12) as
// of compare.h, and whiteners (count, height, 6) of the differences.
struct ComparedPoses {
    int64_t count, height;
    const int64_t *pose;
    const double *reference, *whitener;
};

// Moves e, q and the numbers of the map to a deviation (p,); a value other than 0 ends the call.
typedef int (*Move)(const double *deviation);

// Full Gauss-Newton steps of one trial, see loopcal.engine.Steps. penalty : (height, p). sign : (n,)
// that poses must keep. Results: `taken` steps, -1 where the first poses cannot be used, deviations
// (most + 1, p), costs (most + 1,), and the change of the residuals by the last step.
struct Steps {
    int64_t most, height;
    double widest, relative, absolute, further, slowest, accepted, rounding, singular;
    const double *penalty;
    const int8_t *sign;
    Move move;
    double *deviation, *cost;
    double change;
    int64_t taken;
};

// T (n, 4, 4), joints as of the start, and (n,): residual, iterations, status, sign. strided : the
// joints again, as input. factor : (p + 1, p + 1).
struct SolvedPoses {
    double *T, *const *joints, *residual;
    int64_t *iterations;
    int8_t *status, *sign;
    const Strided *strided;
    double *factor;
};

struct Kernels {
    int (*fold)(const double *factor, const double *rows, double *out, int64_t t, int64_t m,
                int64_t p, int64_t stride);
    // structure, numbers : see library.py. joints, out : one for each group.
    int (*linearize)(const int64_t *structure, const double *numbers, const Strided *arrays,
                     const Strided *joints, double *const *out, int64_t t, int64_t n);
    // arrays : see certify.h
    int (*certify)(const int64_t *structure, const double *numbers, const Strided *arrays, int64_t t,
                   int64_t n, int8_t *sign);
    // arrays, columns, base : see targets.h
    int (*reach)(const int64_t *structure, const double *numbers, const Strided *arrays,
                 const int64_t *columns, const double *base, int64_t t, int64_t n,
                 const ReachOutput *out);
    // arrays : see sensitivity.h
    int (*differentiate)(const int64_t *structure, const double *numbers, const int64_t *entries,
                         const Strided *arrays, const Strided *joints, double *by_parameter,
                         double *by_reading, int64_t t, int64_t n);
    // factor, out : (t, p + 1, p + 1). is_finite : (t, n), 1 where all derivatives are; see fold_poses.h
    int (*fold_poses)(const int64_t *structure, const double *numbers, const int64_t *entries,
                      const Strided *arrays, const Strided *joints, const TwistRows *rows,
                      const double *factor, double *out, int8_t *is_finite, int64_t t, int64_t n);
    // arrays : e, q, T of the start and the numbers of the map; see compared.h
    int (*fold_compared)(const int64_t *structure, const double *numbers, const int64_t *entries,
                         const Strided *arrays, const Strided *joints, const ComparedPoses *measured,
                         const SolvedPoses *solved, const double *factor, int8_t *is_finite,
                         int64_t n, int64_t max_iterations, Steps *steps);
    // arrays : see compare.h
    int (*compare_poses)(const Strided *arrays, double *residual, double *by_twist, int64_t t,
                         int64_t n);
    // see triangles.h
    int (*solve_triangles)(const double *triangle, const double *right, double *x, double *growth,
                           int64_t t, int64_t p);
    // arrays, stated, columns : see points.h
    int (*locate_points)(const Strided *arrays, const double *stated, const int64_t *columns, double *x,
                         double *slopes, int64_t t, int64_t n, int64_t k);
    // see eliminate.h
    int (*eliminate_blocks)(const BlockStructure *structures, int64_t count, const BlockRows *parts,
                            int64_t pieces, int64_t t, int64_t unknowns, int64_t right, double limit,
                            double *factor, double *values, double *length, double *explained,
                            int8_t *is_regular);
    int (*solve)(const int64_t *structure, const double *numbers, const Strided *arrays,
                 const Strided *joints, int64_t t, int64_t n, int64_t max_iterations, int order,
                 Task task, void *context, double *T, double *const *joints_out, double *residual,
                 int64_t *iterations, int8_t *status, int8_t *sign);
};

}  // namespace loopcal
