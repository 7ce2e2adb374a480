// SPDX-License-Identifier: Apache-2.0
// What the processor has, asked by its own instruction. `__builtin_cpu_supports` would need a part
// of the compiler's library that some linkers do not find (clang on Windows) or never initialize.
#pragma once

#if defined(__x86_64__)
#include <cpuid.h>

namespace processor {

// Bits of leaf 7, register ebx: AVX2 with both sets of bit operations, and five sets of AVX-512.
constexpr unsigned AVX2 = bit_AVX2 | bit_BMI | bit_BMI2;
constexpr unsigned AVX512 =
    bit_AVX512F | bit_AVX512DQ | bit_AVX512CD | bit_AVX512BW | bit_AVX512VL;
// Registers that the operating system saves: SSE and AVX; in addition masks and 512 bits.
constexpr unsigned SAVES_AVX = 0x06, SAVES_AVX512 = 0xe6;

// Tells whether the processor has these bits, and the system saves these registers.
inline bool has(unsigned features, unsigned saved) {
    unsigned a, b, c, d, low, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_OSXSAVE) || !(c & bit_FMA)) return false;
    __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    if ((low & saved) != saved || !__get_cpuid_count(7, 0, &a, &b, &c, &d)) return false;
    return (b & features) == features;
}

inline bool has_v3() { return has(AVX2, SAVES_AVX); }
inline bool has_v4() { return has(AVX2 | AVX512, SAVES_AVX512); }

}  // namespace processor
#endif
