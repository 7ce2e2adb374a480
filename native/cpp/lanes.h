// SPDX-License-Identifier: Apache-2.0
// A vector of LANES doubles by the vector extensions of GCC and Clang, and what they lack.
//
// Every file of kernels is compiled once for each instruction set, in a namespace of its own
// (INSTRUCTION_SET): functions of one set never stand in for those of another. Therefore no
// template of the standard library is used here; the linker would keep one copy for all sets.
//
// Lanes never mix: each lane holds another trial or pose, and all operations are those of IEEE 754
// in the order that is written (no contraction, no reassociation). So a lane has the same bits for
// every instruction set, number of lanes and compiler.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>

#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#define INLINE inline __attribute__((always_inline))

namespace INSTRUCTION_SET {

constexpr int W = LANES;
typedef double Lanes __attribute__((vector_size(8 * LANES)));
typedef int64_t Mask __attribute__((vector_size(8 * LANES)));  // -1 for true, 0 for false

INLINE Lanes load(const double *from) {
    Lanes value;
    std::memcpy(&value, from, sizeof value);
    return value;
}

INLINE void store(double *to, Lanes value) { std::memcpy(to, &value, sizeof value); }

INLINE Lanes splat(double value) { return value - Lanes{}; }

INLINE Lanes root(Lanes a) {
#if defined(__AVX512F__) && LANES == 8
    return (Lanes)_mm512_maskz_sqrt_pd(255, (__m512d)a);
#elif defined(__AVX__) && LANES == 4
    return (Lanes)_mm256_sqrt_pd((__m256d)a);
#elif defined(__SSE2__) && LANES == 2
    return (Lanes)_mm_sqrt_pd((__m128d)a);
#elif defined(__aarch64__) && LANES == 2
    return (Lanes)vsqrtq_f64((float64x2_t)a);
#else
    Lanes out;
    for (int i = 0; i < W; i++) out[i] = __builtin_sqrt(a[i]);
    return out;
#endif
}

INLINE Lanes select(Mask is, Lanes yes, Lanes no) { return is ? yes : no; }
INLINE double select(bool is, double yes, double no) { return is ? yes : no; }
INLINE double root(double a) { return __builtin_sqrt(a); }

constexpr int64_t SIGN_BIT = INT64_MIN;

INLINE Lanes magnitude(Lanes a) { return (Lanes)((Mask)a & ~SIGN_BIT); }
INLINE Lanes with_sign_of(Lanes size, Lanes sign) {
    return (Lanes)(((Mask)size & ~SIGN_BIT) | ((Mask)sign & SIGN_BIT));
}
INLINE double magnitude(double a) { return __builtin_fabs(a); }
INLINE double with_sign_of(double size, double sign) { return __builtin_copysign(size, sign); }

// NaN in either argument gives NaN, as numpy.maximum and numpy.minimum do
template <class Real> INLINE Real larger(Real a, Real b) {
    return select((a > b) | (a != a), a, b);
}
template <class Real> INLINE Real smaller(Real a, Real b) {
    return select((a < b) | (a != a), a, b);
}

// -1, 0, 1, or NaN
INLINE Lanes signum(Lanes a) {
    Lanes one = select(a > 0.0, splat(1.0), select(a < 0.0, splat(-1.0), splat(0.0)));
    return select(a != a, a, one);
}

INLINE bool any(Mask a) {
    int64_t all = 0;
    for (int i = 0; i < W; i++) all |= a[i];
    return all != 0;
}

template <class Real> INLINE Real constant(double value);
template <> INLINE double constant<double>(double value) { return value; }
template <> INLINE Lanes constant<Lanes>(double value) { return splat(value); }

// --- between rows of memory and lanes ---------------------------------------------------------

#if !defined(__has_builtin)
#define __has_builtin(name) 0
#endif
#if __has_builtin(__builtin_shufflevector) && (LANES == 2 || LANES == 4 || LANES == 8)
#define TRANSPOSES 1
// Exchange an off-diagonal block of `SIZE` numbers of two vectors that are `SIZE` rows apart.
template <int SIZE> INLINE void exchange(Lanes &a, Lanes &b) {
    Lanes x = a, y = b;
#if LANES == 2
    a = __builtin_shufflevector(x, y, 0, 2);
    b = __builtin_shufflevector(x, y, 1, 3);
#elif LANES == 4
    if (SIZE == 1) {
        a = __builtin_shufflevector(x, y, 0, 4, 2, 6);
        b = __builtin_shufflevector(x, y, 1, 5, 3, 7);
    } else {
        a = __builtin_shufflevector(x, y, 0, 1, 4, 5);
        b = __builtin_shufflevector(x, y, 2, 3, 6, 7);
    }
#else
    if (SIZE == 1) {
        a = __builtin_shufflevector(x, y, 0, 8, 2, 10, 4, 12, 6, 14);
        b = __builtin_shufflevector(x, y, 1, 9, 3, 11, 5, 13, 7, 15);
    } else if (SIZE == 2) {
        a = __builtin_shufflevector(x, y, 0, 1, 8, 9, 4, 5, 12, 13);
        b = __builtin_shufflevector(x, y, 2, 3, 10, 11, 6, 7, 14, 15);
    } else {
        a = __builtin_shufflevector(x, y, 0, 1, 2, 3, 8, 9, 10, 11);
        b = __builtin_shufflevector(x, y, 4, 5, 6, 7, 12, 13, 14, 15);
    }
#endif
}

template <int SIZE = 1> INLINE void transpose(Lanes *square) {
    if constexpr (SIZE < W) {
        for (int i = 0; i < W; i++)
            if (!(i & SIZE)) exchange<SIZE>(square[i], square[i + SIZE]);
        transpose<2 * SIZE>(square);
    }
}

template <int SIZE = W / 2>
INLINE void store_first(const double *from, int64_t count, double *to) {
    if constexpr (SIZE > 0) {
        if (count & SIZE) std::memcpy(to, from, sizeof(double) * SIZE), from += SIZE, to += SIZE;
        store_first<SIZE / 2>(from, count, to);
    }
}
#endif

// Write `count` numbers of each of the first `used` lanes to the row of the lane.
INLINE void write_rows(const Lanes *from, int64_t count, int used, double *const *to) {
#if defined(TRANSPOSES)
    for (int64_t i = 0; i < count; i += W) {
        Lanes square[W];
        int64_t left = count - i;
        for (int k = 0; k < W; k++) square[k] = from[i + (k < left ? k : left - 1)];
        transpose(square);
        if (left >= W) {
            for (int lane = 0; lane < used; lane++) store(to[lane] + i, square[lane]);
            continue;
        }
        double numbers[W * W];
        for (int lane = 0; lane < used; lane++) {
            store(numbers + W * lane, square[lane]);
            store_first(numbers + W * lane, left, to[lane] + i);
        }
    }
#else
    for (int lane = 0; lane < used; lane++)
        for (int64_t i = 0; i < count; i++) to[lane][i] = from[i][lane];
#endif
}

// Memory for the vectors of one call. `ok` is false where there is not enough.
class Arena {
  public:
    explicit Arena(size_t bytes) {
        size_t whole = (bytes + 127) / 64 * 64;
#if defined(_WIN32)
        base_ = static_cast<char *>(_aligned_malloc(whole, 64));
#else
        base_ = static_cast<char *>(std::aligned_alloc(64, whole));
#endif
        left_ = base_ ? whole : 0;
        next_ = base_;
    }
    ~Arena() {
#if defined(_WIN32)
        _aligned_free(base_);
#else
        std::free(base_);
#endif
    }
    Arena(const Arena &) = delete;
    Arena &operator=(const Arena &) = delete;

    bool ok() const { return base_ != nullptr; }

    // The callers compute the size beforehand; running out is a mistake of this library.
    template <class Value> Value *take(size_t count) {
        size_t bytes = (count * sizeof(Value) + 63) / 64 * 64;
        if (bytes > left_) __builtin_trap();
        char *out = next_;
        next_ += bytes;
        left_ -= bytes;
        return reinterpret_cast<Value *>(out);
    }

    template <class Value> static constexpr size_t need(size_t count) {
        return (count * sizeof(Value) + 63) / 64 * 64;
    }

  private:
    char *base_, *next_;
    size_t left_;
};

}  // namespace INSTRUCTION_SET
