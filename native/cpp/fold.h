// SPDX-License-Identifier: Apache-2.0
// Rows are folded into a triangular factor by Householder reflections, ROWS rows at a time.
//
// Reflection k takes row k of the factor and column k of a block of rows, [r; x], to [alpha; 0]:
// v = [r - alpha; x], and with beta = 1 / (v'v / 2) every later column loses v beta (v' column).
// Two layouts compute the same operations in the same order, so that they give the same bits:
//   by trials  : a lane for each trial; the entries of a block are columns of ROWS vectors,
//   by columns : one trial, a lane for each column.
// Many rows of one trial are divided into PARTS, a lane for each part, whose factors are folded in
// the end. The number of rows alone decides, not the trials of the call nor the lanes.
#pragma once

#include "lanes.h"

namespace INSTRUCTION_SET {

constexpr int ROWS = 12;  // of a block: their entries of one column fit the registers

constexpr int PARTS = 8;
constexpr int64_t MANY = 32;  // rows for each column: below, the factors of the parts cost too much

// Columns whose squares sum to less are zero: products of still smaller numbers lose all digits.
constexpr double FLOOR = 1e-200;

// x' column, by three sums that do not wait for each other
template <class Real> INLINE Real inner(const Real *x, const Real *column) {
    Real a = x[0] * column[0], b = x[1] * column[1], c = x[2] * column[2];
    for (int i = 3; i < ROWS; i += 3) {
        a = a + x[i] * column[i];
        b = b + x[i + 1] * column[i + 1];
        c = c + x[i + 2] * column[i + 2];
    }
    return (a + b) + c;
}

template <class Real> struct Reflection {
    Real alpha, v0, beta;
};

// Reflect [r; x]; where x is near zero, change nothing (x is then zeroed).
template <class Real> INLINE Reflection<Real> reflect(Real r, Real *x) {
    Real square = inner(x, x), zero = constant<Real>(0.0), one = constant<Real>(1.0);
    // a sum that is NaN acts
    auto works = (square >= FLOOR) | (square != square);
    for (int i = 0; i < ROWS; i++) x[i] = select(works, x[i], zero);
    Real alpha = with_sign_of(root(r * r + square), zero - r);
    Real v0 = r - alpha;
    Real half = select(works, (zero - alpha) * v0, one);
    return {select(works, alpha, r), select(works, v0, zero), one / half};
}

// Row i of the packed upper triangle begins with its diagonal.
INLINE int64_t packed(int64_t i, int64_t p) { return i * p - i * (i - 1) / 2; }

// --- by trials: factor packed, block [p][ROWS] -----------------------------------------------

INLINE void fold_block(Lanes *factor, Lanes *block, int64_t p) {
    for (int64_t k = 0; k < p; k++) {
        Lanes *row = factor + packed(k, p), *x = block + k * ROWS;
        Lanes v[ROWS];
        for (int i = 0; i < ROWS; i++) v[i] = x[i];
        Reflection<Lanes> h = reflect(row[0], v);
        row[0] = h.alpha;
        for (int64_t j = 1; j < p - k; j++) {
            Lanes *column = x + j * ROWS;
            Lanes s = h.beta * (h.v0 * row[j] + inner(v, column));
            row[j] = row[j] - h.v0 * s;
            for (int i = 0; i < ROWS; i++) column[i] = column[i] - v[i] * s;
        }
    }
}

inline size_t need_by_trials(int64_t p) {
    return Arena::need<Lanes>(packed(p, p)) + Arena::need<Lanes>(p * ROWS);
}

// Factors of `count` <= W trials, one after the other; lanes without a trial repeat the last one.
inline void load_factors(const double *factor, int64_t count, int64_t p, Lanes *R) {
    const double *of_lane[W];
    for (int lane = 0; lane < W; lane++)
        of_lane[lane] = factor + (lane < count ? lane : count - 1) * p * p;
    for (int64_t i = 0; i < p; i++) {
        Lanes *row = R + packed(i, p) - i;
        for (int64_t j = i; j < p; j++) {
            Lanes value;
            for (int lane = 0; lane < W; lane++) value[lane] = of_lane[lane][i * p + j];
            row[j] = value;
        }
    }
}

inline void store_factors(const Lanes *R, int64_t count, int64_t p, double *out) {
    for (int64_t i = 0; i < p; i++) {
        double *to[W];
        for (int64_t lane = 0; lane < W; lane++) to[lane] = out + lane * p * p + i * p + i;
        for (int64_t lane = 0; lane < count; lane++)
            std::memset(to[lane] - i, 0, sizeof(double) * (size_t)i);
        write_rows(R + packed(i, p), p - i, (int)count, to);
    }
}

// Fold `count` <= W trials. rows : m x p of each trial, `stride` apart. left : rows from the first
// one of the first trial to the end of the memory; those beyond are zero.
inline void fold_trials(const double *factor, const double *rows, double *out, int64_t count,
                        int64_t m, int64_t p, int64_t stride, int64_t left, Arena &arena) {
    Lanes *R = arena.take<Lanes>(packed(p, p)), *block = arena.take<Lanes>(p * ROWS);
    const double *rows_of[W];
    int64_t rows_left[W];
    for (int lane = 0; lane < W; lane++) {  // lanes without a trial repeat the last one
        int64_t trial = lane < count ? lane : count - 1;
        rows_of[lane] = rows + trial * stride;
        rows_left[lane] = p && trial ? left - trial * (stride / p) : left;
    }
    load_factors(factor, count, p, R);
    for (int64_t first = 0; first < m; first += ROWS) {
        int64_t height = m - first < ROWS ? m - first : ROWS;
        for (int64_t j = 0; j < p; j++)
            for (int64_t i = height; i < ROWS; i++) block[j * ROWS + i] = Lanes{};
        for (int64_t i = 0; i < height; i++) {
            int64_t offset = (first + i) * p;
            bool is_whole = true;
            for (int lane = 0; lane < W; lane++) is_whole &= first + i < rows_left[lane];
            if (!is_whole) {
                for (int64_t j = 0; j < p; j++) {
                    Lanes value{};
                    for (int lane = 0; lane < W; lane++)
                        if (first + i < rows_left[lane]) value[lane] = rows_of[lane][offset + j];
                    block[j * ROWS + i] = value;
                }
                continue;
            }
            for (int64_t j = 0; j < p; j++) {
                Lanes value;
                for (int lane = 0; lane < W; lane++) value[lane] = rows_of[lane][offset + j];
                block[j * ROWS + i] = value;
            }
        }
        fold_block(R, block, p);
    }
    store_factors(R, count, p, out);
}

// --- by columns: factor [p][width], block [ROWS][width], width a multiple of W ----------------

inline int64_t padded(int64_t p) { return (p + W - 1) / W * W; }

inline size_t need_by_columns(int64_t p) {
    return Arena::need<double>(p * padded(p)) + Arena::need<double>(ROWS * padded(p));
}

// The first `count` columns are reflected. Before, row k < `begun` of the block becomes row k of the
// factor, which is zero.
INLINE void fold_block_by_columns(double *factor, double *block, int64_t count, int64_t width,
                                  int64_t begun) {
    for (int64_t k = 0; k < count; k++) {
        double *row = factor + k * width, v[ROWS];
        if (k < begun) {
            std::memcpy(row, block + k * width, sizeof(double) * (size_t)width);
            std::memset(block + k * width, 0, sizeof(double) * (size_t)width);
        }
        for (int i = 0; i < ROWS; i++) v[i] = block[i * width + k];
        Reflection<double> h = reflect(row[k], v);
        // columns before k are zero in all these rows
        Lanes wide[ROWS];
        for (int i = 0; i < ROWS; i++) wide[i] = splat(v[i]);
        for (int64_t j = k / W * W; j < width; j += W) {
            Lanes column[ROWS], old = load(row + j);
            for (int i = 0; i < ROWS; i++) column[i] = load(block + i * width + j);
            Lanes s = h.beta * (h.v0 * old + inner(wide, column));
            store(row + j, old - h.v0 * s);
            for (int i = 0; i < ROWS; i++) store(block + i * width + j, column[i] - wide[i] * s);
        }
        row[k] = h.alpha;
        for (int i = 0; i < ROWS; i++) block[i * width + k] = 0.0;
    }
}

inline void fold_trial(const double *factor, const double *rows, double *out, int64_t m, int64_t p,
                       Arena &arena) {
    int64_t width = padded(p);
    double *R = arena.take<double>(p * width), *block = arena.take<double>(ROWS * width);
    for (int64_t i = 0; i < p; i++)
        for (int64_t j = 0; j < width; j++)
            R[i * width + j] = j >= i && j < p ? factor[i * p + j] : 0.0;
    for (int64_t first = 0; first < m; first += ROWS) {
        int64_t height = m - first < ROWS ? m - first : ROWS;
        std::memset(block, 0, sizeof(double) * (size_t)(ROWS * width));
        for (int64_t i = 0; i < height; i++)
            std::memcpy(block + i * width, rows + (first + i) * p, sizeof(double) * (size_t)p);
        fold_block_by_columns(R, block, p, width, 0);
    }
    for (int64_t i = 0; i < p; i++)
        for (int64_t j = 0; j < p; j++) out[i * p + j] = j < i ? 0.0 : R[i * width + j];
}

// --- by parts ---------------------------------------------------------------------------------

// Rows of a part of m: whole blocks.
inline int64_t part_height(int64_t m) { return (m + PARTS * ROWS - 1) / (PARTS * ROWS) * ROWS; }

inline size_t need_by_parts(int64_t p) { return Arena::need<double>(PARTS * p * p); }

// Fold many rows of one trial; false without memory.
inline bool fold_parts(const double *factor, const double *rows, double *out, int64_t m, int64_t p) {
    Arena memory(need_by_parts(p));
    if (!memory.ok()) return false;
    double *factors = memory.take<double>(PARTS * p * p);
    std::memset(factors, 0, sizeof(double) * (size_t)(PARTS * p * p));
    int64_t height = part_height(m);
    for (int64_t first = 0; first < PARTS; first += W) {
        int64_t count = PARTS - first < W ? PARTS - first : W, begin = first * height;
        if (begin >= m) break;
        Arena arena(need_by_trials(p));
        if (!arena.ok()) return false;
        double *of_parts = factors + first * p * p;
        fold_trials(of_parts, rows + begin * p, of_parts, count, height, p, height * p, m - begin, arena);
    }
    Arena arena(need_by_columns(p));
    if (!arena.ok()) return false;
    fold_trial(factor, factors, out, PARTS * p, p, arena);
    return true;
}

// --- the call ---------------------------------------------------------------------------------

inline int fold(const double *factor, const double *rows, double *out, int64_t t, int64_t m,
                int64_t p, int64_t stride) {
    if (m >= MANY * p && p > 0) {
        for (int64_t i = 0; i < t; i++)
            if (!fold_parts(factor + i * p * p, rows + i * stride, out + i * p * p, m, p)) return 1;
        return 0;
    }
    size_t trials = need_by_trials(p), columns = need_by_columns(p);
    for (int64_t first = 0; first < t; first += W) {
        int64_t count = t - first < W ? t - first : W;
        const double *from = factor + first * p * p, *given = rows + first * stride;
        double *to = out + first * p * p;
        if (count * 2 > W) {
            Arena arena(trials);
            if (!arena.ok()) return 1;
            int64_t left = p ? m + (count - 1) * (stride / p) : m;
            fold_trials(from, given, to, count, m, p, stride, left, arena);
            continue;
        }
        for (int64_t i = 0; i < count; i++) {
            Arena arena(columns);
            if (!arena.ok()) return 1;
            fold_trial(from + i * p * p, given + i * stride, to + i * p * p, m, p, arena);
        }
    }
    return 0;
}

}  // namespace INSTRUCTION_SET
