// SPDX-License-Identifier: Apache-2.0
// What the kernels of one instruction set offer; dispatch.cpp passes it on as a C interface.
#pragma once

#include <cstdint>

namespace loopcal {

// Return values of the functions.
enum Outcome { DONE = 0, NO_MEMORY = 1, TASK_FAILED = 2 };

struct Kernels {
    int (*fold)(const double *factor, const double *rows, double *out, int64_t t, int64_t m,
                int64_t p, int64_t stride);
};

}  // namespace loopcal
