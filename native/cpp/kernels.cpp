// SPDX-License-Identifier: Apache-2.0
// The kernels of one instruction set. The build compiles this file once for each set, with
// INSTRUCTION_SET (a namespace) and LANES (doubles of a vector).
#include "fold.h"
#include "interface.h"

namespace INSTRUCTION_SET {

extern const loopcal::Kernels kernels;
const loopcal::Kernels kernels = {fold};

}  // namespace INSTRUCTION_SET
