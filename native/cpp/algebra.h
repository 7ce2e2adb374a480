// SPDX-License-Identifier: Apache-2.0
// Sines, vectors and rotations in lanes. Vectors have 3 entries, matrices 9, row by row; an
// argument of type Number is Lanes or double (the same for all lanes).
#pragma once

#include "lanes.h"

namespace INSTRUCTION_SET {

// Sine and cosine to 1.2 units in the last place for |x| < 1e6, and to 1.2 units in the last place
// of x beyond; NaN beyond 1e15. Coefficients: fdlibm (Sun Microsystems, 1993), k_sin.c and k_cos.c.
INLINE Lanes sine_of_reduced(Lanes r, Lanes z) {
    Lanes s = 8.33333333332248946124e-03 +
              z * (-1.98412698298579493134e-04 +
                   z * (2.75573137070700676789e-06 +
                        z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)));
    return r + (z * r) * (-1.66666666666666324348e-01 + z * s);
}

INLINE void sine_and_cosine(Lanes x, Lanes &sine, Lanes &cosine) {
    constexpr double WHOLE = 6755399441055744.0;  // 1.5 * 2^52: its sum has no fraction left
    Lanes shifted = x * 0x1.45f306dc9c883p-1 + WHOLE;  // 2 / pi
    Mask quadrant = (Mask)shifted;
    Lanes turns = shifted - WHOLE;
    // pi / 2 in two parts, the first of 33 bits, so that its product is exact
    Lanes r = (x - turns * 1.57079632673412561417e+00) - turns * 6.07710050650619224932e-11;
    r = select(magnitude(x) <= 1e15, r, splat(__builtin_nan("")));
    Lanes z = r * r;
    Lanes s = sine_of_reduced(r, z);
    Lanes c = z * (4.16666666666666019037e-02 +
                   z * (-1.38888888888741095749e-03 +
                        z * (2.48015872894767294178e-05 +
                             z * (-2.75573143513906633035e-07 +
                                  z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)))));
    Lanes half = 0.5 * z, w = 1.0 - half;
    c = w + (((1.0 - w) - half) + z * c);
    Mask odd = (quadrant & 1) != 0;
    Lanes first = select(odd, c, s), second = select(odd, s, c);
    sine = select((quadrant & 2) != 0, -first, first);
    cosine = select(((quadrant + 1) & 2) != 0, -second, second);
}

// The sine alone; without a reduction where no lane needs one, which gives the same bits.
INLINE Lanes sine_of(Lanes x) {
    if (!any(~(magnitude(x) < 0.785))) return sine_of_reduced(x, x * x);
    Lanes sine, cosine;
    sine_and_cosine(x, sine, cosine);
    return sine;
}

template <class Number>
INLINE void multiply_vector(const Lanes *a, const Number *v, Lanes *out) {
    for (int i = 0; i < 3; i++) out[i] = a[3 * i] * v[0] + a[3 * i + 1] * v[1] + a[3 * i + 2] * v[2];
}

template <class Number>
INLINE void multiply_matrix(const Lanes *a, const Number *b, Lanes *out) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
}

INLINE Lanes dot(const Lanes *a, const Lanes *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

INLINE void cross(const Lanes *a, const Lanes *b, Lanes *out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

// I + a hat(w) + b hat(w)^2
INLINE void rotation_polynomial(const Lanes *w, Lanes a, Lanes b, Lanes *out) {
    Lanes bx = b * w[0], by = b * w[1], bz = b * w[2], rest = 1.0 - b * dot(w, w);
    Lanes ax = a * w[0], ay = a * w[1], az = a * w[2];
    Lanes bxy = bx * w[1], bxz = bx * w[2], byz = by * w[2];
    out[0] = rest + bx * w[0];
    out[1] = bxy - az;
    out[2] = bxz + ay;
    out[3] = bxy + az;
    out[4] = rest + by * w[1];
    out[5] = byz - ax;
    out[6] = bxz - ay;
    out[7] = byz + ax;
    out[8] = rest + bz * w[2];
}

constexpr double SMALLEST = 1e-300;  // least divisor, see householder.py

// exp(hat(w)) by Rodrigues' formula
INLINE void exponential(const Lanes *w, Lanes *out) {
    Lanes t = root(dot(w, w) + SMALLEST), half = sine_of(0.5 * t) / (0.5 * t);
    rotation_polynomial(w, sine_of(t) / t, 0.5 * half * half, out);
}

// J with exp(hat(w + d)) = exp(hat(J d)) exp(hat(w)) to first order in d
INLINE void left_jacobian(const Lanes *w, Lanes *out) {
    Lanes t2 = dot(w, w), t = root(t2), one = splat(1.0);
    Mask none = t == 0.0, small = t < 0.02;
    Lanes divisor = select(none, one, 0.5 * t);
    Lanes half = select(none, one, sine_of(divisor) / divisor);
    Lanes tail = select(small, 1.0 / 6.0 - t2 / 120.0, (t - sine_of(t)) / select(small, one, t2 * t));
    rotation_polynomial(w, 0.5 * half * half, tail, out);
}

// --- Householder, see householder.py: columns of `rows` entries, one after the other --------------

// Functions with a count as template argument compute the same as those with a count at run time.

// a'b by two sums that do not wait for each other nor for the first entries
template <int FIXED = 0> INLINE Lanes inner_product(const Lanes *a, const Lanes *b, int count) {
    const int n = FIXED ? FIXED : count;
    Lanes first = a[0] * b[0];
    if (n == 1) return first;
    Lanes odd = a[1] * b[1];
    if (n == 2) return odd + first;
    Lanes even = a[2] * b[2];
    for (int i = 3; i < n; i += 2) {
        odd = odd + a[i] * b[i];
        if (i + 1 < n) even = even + a[i + 1] * b[i + 1];
    }
    return (odd + even) + first;
}

struct Reflector {
    Lanes alpha, beta;
};

// The reflection that takes column[0..count) to [alpha, 0, ..]; its vector replaces the column.
template <int FIXED = 0> INLINE Reflector make_reflector(Lanes *column, int count) {
    Lanes alpha = with_sign_of(root(inner_product<FIXED>(column, column, count)), -column[0]);
    column[0] = column[0] - alpha;
    return {alpha, 1.0 / larger(-(alpha * column[0]), splat(SMALLEST))};
}

template <int FIXED = 0>
INLINE void reflect_column(const Lanes *v, Lanes beta, Lanes *column, int count) {
    const int n = FIXED ? FIXED : count;
    Lanes s = beta * inner_product<FIXED>(v, column, count);
    for (int i = 0; i < n; i++) column[i] = column[i] - v[i] * s;
}

// Reflection j of a matrix and all further ones, up to reflection `COLUMNS` - 1
template <int ROWS, int TOTAL, int COLUMNS, int J = 0>
INLINE void triangularize_from(Lanes *matrix, Lanes &sign) {
    if constexpr (J < (COLUMNS < ROWS - 1 ? COLUMNS : ROWS - 1)) {
        Lanes *at = matrix + J * ROWS + J, v[ROWS - J];
        for (int i = 0; i < ROWS - J; i++) v[i] = at[i];
        Reflector h = make_reflector<ROWS - J>(v, 0);
        for (int c = 1; c < TOTAL - J; c++) reflect_column<ROWS - J>(v, h.beta, at + c * ROWS, 0);
        at[0] = h.alpha;
        for (int i = 1; i < ROWS - J; i++) at[i] = v[i];
        sign = select(h.alpha != 0.0, -sign, sign);
        triangularize_from<ROWS, TOTAL, COLUMNS, J + 1>(matrix, sign);
    }
}

// Triangularize the first `columns` of `total` columns; below their diagonals remain the vectors.
// Returns the determinant of the reflections; the diagonal is that of the factor.
INLINE Lanes triangularize(Lanes *matrix, int rows, int total, int columns) {
    Lanes sign = splat(1.0);
    if (rows == 6 && total == 7 && columns == 6) {  // platforms of six freedoms
        triangularize_from<6, 7, 6>(matrix, sign);
        return sign;
    }
    if (rows == 6 && total == 12 && columns == 6) {  // their inverses
        triangularize_from<6, 12, 6>(matrix, sign);
        return sign;
    }
    if (rows == 3 && total == 5 && columns == 2) {  // shares of two joints that end in a ball
        triangularize_from<3, 5, 2>(matrix, sign);
        return sign;
    }
    if (rows == 3 && total == 4 && columns == 3) {  // of three
        triangularize_from<3, 4, 3>(matrix, sign);
        return sign;
    }
    if (rows == 3 && total == 9 && columns == 2) {  // limbs of two joints that end in a ball
        triangularize_from<3, 9, 2>(matrix, sign);
        return sign;
    }
    int count = columns < rows - 1 ? columns : rows - 1;
    for (int j = 0; j < count; j++) {
        Lanes *v = matrix + j * rows + j;
        Reflector h = make_reflector(v, rows - j);
        for (int c = j + 1; c < total; c++)
            reflect_column(v, h.beta, matrix + c * rows + j, rows - j);
        v[0] = h.alpha;
        sign = select(h.alpha != 0.0, -sign, sign);
    }
    return sign;
}

}  // namespace INSTRUCTION_SET
