// SPDX-License-Identifier: Apache-2.0
// The C interface. This file is compiled for the baseline of the platform: it asks the processor
// what it has before any other code runs.
#include "interface.h"
#include "processor.h"

namespace baseline {
extern const loopcal::Kernels kernels;
}
#if defined(WITH_V3)
namespace v3 {
extern const loopcal::Kernels kernels;
}
#endif
#if defined(WITH_V4)
namespace v4 {
extern const loopcal::Kernels kernels;
}
#endif

#if defined(_WIN32)
#define EXPORT extern "C" __declspec(dllexport)
#else
#define EXPORT extern "C" __attribute__((visibility("default")))
#endif

namespace {

constexpr int ABI = 13;  // changes with every change of the C interface; library.py states it, too

struct Set {
    const char *name;
    const loopcal::Kernels *kernels;
};

// All sets of this library, the fastest first; kernels is null where the processor lacks one.
const Set *list_sets() {
    static const Set sets[] = {
#if defined(WITH_V4)
        {"v4", processor::has_v4() ? &v4::kernels : nullptr},
#endif
#if defined(WITH_V3)
        {"v3", processor::has_v3() ? &v3::kernels : nullptr},
#endif
        {"baseline", &baseline::kernels},
        {nullptr, nullptr},
    };
    return sets;
}

}  // namespace

EXPORT int loopcal_abi() { return ABI; }

// Name of instruction set i, null beyond the last one; *works tells whether this processor has it.
EXPORT const char *loopcal_instruction_set(int i, int *works) {
    const Set *sets = list_sets();
    for (int k = 0; k <= i; k++)
        if (!sets[k].name) return nullptr;
    *works = sets[i].kernels != nullptr;
    return sets[i].name;
}

EXPORT int loopcal_fold(int set, const double *factor, const double *rows, double *out, int64_t t,
                        int64_t m, int64_t p, int64_t stride) {
    return list_sets()[set].kernels->fold(factor, rows, out, t, m, p, stride);
}

EXPORT int loopcal_certify(int set, const int64_t *structure, const double *numbers,
                           const loopcal::Strided *arrays, int64_t t, int64_t n, int8_t *sign) {
    return list_sets()[set].kernels->certify(structure, numbers, arrays, t, n, sign);
}

EXPORT int loopcal_reach(int set, const int64_t *structure, const double *numbers,
                         const loopcal::Strided *arrays, const int64_t *columns,
                         const double *base, int64_t t, int64_t n,
                         const loopcal::ReachOutput *out) {
    return list_sets()[set].kernels->reach(structure, numbers, arrays, columns, base, t, n, out);
}

EXPORT int loopcal_linearize(int set, const int64_t *structure, const double *numbers,
                             const loopcal::Strided *arrays, const loopcal::Strided *joints,
                             double *const *out, int64_t t, int64_t n) {
    return list_sets()[set].kernels->linearize(structure, numbers, arrays, joints, out, t, n);
}

EXPORT int loopcal_differentiate(int set, const int64_t *structure, const double *numbers,
                                 const int64_t *entries, const loopcal::Strided *arrays,
                                 const loopcal::Strided *joints, double *by_parameter,
                                 double *by_reading, int64_t t, int64_t n) {
    return list_sets()[set].kernels->differentiate(structure, numbers, entries, arrays, joints,
                                                   by_parameter, by_reading, t, n);
}

EXPORT int loopcal_fold_poses(int set, const int64_t *structure, const double *numbers,
                              const int64_t *entries, const loopcal::Strided *arrays,
                              const loopcal::Strided *joints, const loopcal::TwistRows *rows,
                              const double *factor, double *out, int8_t *is_finite, int64_t t,
                              int64_t n) {
    return list_sets()[set].kernels->fold_poses(structure, numbers, entries, arrays, joints, rows,
                                                factor, out, is_finite, t, n);
}

EXPORT int loopcal_fold_compared(int set, const int64_t *structure, const double *numbers,
                                 const int64_t *entries, const loopcal::Strided *arrays,
                                 const loopcal::Strided *joints,
                                 const loopcal::ComparedPoses *measured,
                                 const loopcal::SolvedPoses *solved, const double *factor,
                                 int8_t *is_finite, int64_t n, int64_t max_iterations,
                                 loopcal::Steps *steps) {
    return list_sets()[set].kernels->fold_compared(structure, numbers, entries, arrays, joints,
                                                   measured, solved, factor, is_finite, n,
                                                   max_iterations, steps);
}

EXPORT int loopcal_compare_poses(int set, const loopcal::Strided *arrays, double *residual,
                                 double *by_twist, int64_t t, int64_t n) {
    return list_sets()[set].kernels->compare_poses(arrays, residual, by_twist, t, n);
}

EXPORT int loopcal_solve_triangles(int set, const double *triangle, const double *right, double *x,
                                   double *growth, int64_t t, int64_t p) {
    return list_sets()[set].kernels->solve_triangles(triangle, right, x, growth, t, p);
}

EXPORT int loopcal_locate_points(int set, const loopcal::Strided *arrays, const double *stated,
                                 const int64_t *columns, double *x, double *slopes, int64_t t, int64_t n,
                                 int64_t k) {
    return list_sets()[set].kernels->locate_points(arrays, stated, columns, x, slopes, t, n, k);
}

EXPORT int loopcal_eliminate_blocks(int set, const loopcal::BlockStructure *structures, int64_t count,
                                    const loopcal::BlockRows *parts, int64_t pieces, int64_t t,
                                    int64_t unknowns, int64_t right, double limit, double *factor,
                                    double *values, double *length, double *explained,
                                    int8_t *is_regular) {
    return list_sets()[set].kernels->eliminate_blocks(structures, count, parts, pieces, t, unknowns, right,
                                                      limit, factor, values, length, explained,
                                                      is_regular);
}

EXPORT int loopcal_solve(int set, const int64_t *structure, const double *numbers,
                         const loopcal::Strided *arrays, const loopcal::Strided *joints, int64_t t,
                         int64_t n, int64_t max_iterations, int order, loopcal::Task task,
                         void *context, double *T, double *const *joints_out, double *residual,
                         int64_t *iterations, int8_t *status, int8_t *sign) {
    return list_sets()[set].kernels->solve(structure, numbers, arrays, joints, t, n, max_iterations,
                                           order, task, context, T, joints_out, residual, iterations,
                                           status, sign);
}
