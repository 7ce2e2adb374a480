// SPDX-License-Identifier: Apache-2.0
// Newton's method where six driven rods hold a platform of six freedoms: what `Equations` computes,
// by the same operations, without what only other mechanisms need.
#pragma once

#include "newton.h"

namespace INSTRUCTION_SET {

// The end of a rod relative to its tip, and what moves it.
struct Rod {
    Lanes moment[3], direction[3], distance;

    // placed : its two links and its length. T : rotation (9) and position (3) of the platform.
    template <class Number> INLINE Rod(const Number *placed, const Lanes *T) {
        Lanes arm[3], gap[3];
        multiply_vector(T, placed + LINK + 18, arm);
        for (int i = 0; i < 3; i++) gap[i] = arm[i] + T[9 + i] - placed[18 + i];
        distance = root(dot(gap, gap));
        Lanes inverse = 1.0 / distance;
        for (int i = 0; i < 3; i++) direction[i] = gap[i] * inverse;
        cross(arm, direction, moment);
    }

    INLINE const Lanes &freedom(int f) const { return f < 3 ? moment[f] : direction[f - 3]; }
};

// The Jacobian of the rods at a platform that all rows of a unit start from: its reflectors, its
// factor by columns, and what `evaluate` derives from them.
struct SharedFactor {
    Lanes factor[36], v[5][6], beta[5], inverse[6], distance[6], sign;

    // y with factor . y = -right, both in the order of rows and freedoms; right becomes Q' right.
    INLINE void solve(Lanes *right, Lanes *y) const {
        for (int j = 0; j < 5; j++) reflect_column(v[j] + j, beta[j], right + j, 6 - j);
        for (int f = 5; f >= 0; f--) {
            Lanes known{};
            for (int c = f + 1; c < 6; c++) known = known + factor[6 * c + f] * y[c];
            y[f] = (-right[f] - known) * inverse[f];
        }
    }
};

// The rows of a block for an evaluation: the links of its unit, coordinates, which rows may stay
// and which are alive, and where the Newton step and its measures go.
template <class Number> struct RodRows {
    const Number *placed;
    const Lanes *coordinates;
    Mask may_stay, alive;
    Lanes *step;
    Measures *measures;
};

class RodEquations {
  public:
    explicit RodEquations(const Program &program) : program_(program) {
        int limbs = 0;
        apply_ = !program.sigma && !program.free && !program.frees_drives;
        for (int g = 0; g < program.groups; g++) {
            const Group &group = program.group[g];
            apply_ = apply_ && group.ending == DISTANCE && !group.joints && !group.unknown;
            limbs += group.limbs;
        }
        apply_ = apply_ && limbs == 6 && program.freedoms == 6 && program.nodes == 1;
    }

    // Whether the mechanism has six freedoms and six limbs, each a rod of given length.
    bool apply() const { return apply_; }

    // The factor at coordinates that differ between rows by the lengths of rods only.
    template <class Number> void factorize(const Number *placed, const Lanes *T, SharedFactor &out) const {
        Lanes *matrix = out.factor;
        for (int row = 0; row < 6; row++, placed += ROD) {
            Rod rod(placed, T);
            for (int f = 0; f < 6; f++) matrix[6 * f + row] = rod.freedom(program_.freedom[f]);
            out.distance[row] = rod.distance;
        }
        out.sign = splat(1.0);
        for (int j = 0; j < 5; j++) {
            for (int i = j; i < 6; i++) out.v[j][i] = matrix[6 * j + i];
            Reflector h = make_reflector(out.v[j] + j, 6 - j);
            for (int c = j + 1; c < 6; c++)
                reflect_column(out.v[j] + j, h.beta, matrix + 6 * c + j, 6 - j);
            matrix[6 * j + j] = h.alpha;
            out.beta[j] = h.beta;
            out.sign = select(h.alpha != 0.0, -out.sign, out.sign);
        }
        for (int f = 0; f < 6; f++) {
            out.sign = out.sign * signum(matrix[7 * f]);
            out.inverse[f] = 1.0 / matrix[7 * f];
        }
    }

    // What `evaluate` gives there.
    template <class Number>
    void evaluate_shared(const Number *placed, const SharedFactor &at, const Lanes *coordinates,
                         Lanes *step, Measures &measures) const {
        Lanes right[6], y[6], square{}, left{};
        for (int row = 0; row < 6; row++, placed += ROD) {
            right[row] = at.distance[row] - (placed[2 * LINK] + coordinates[12 + row]);
            square = square + right[row] * right[row];
        }
        measures.residual = root(square);
        at.solve(right, y);
        for (int f = 0; f < 6; f++) step[program_.freedom[f]] = y[f];
        for (int i = 0; i < 6; i++) left = left + right[i] * right[i];
        measures.reducible = root(left);
        measures.length = measure_twist(step, program_.size);
        measures.sign = at.sign;
        measures.pivot = splat(1.0);
    }

    // The Newton steps of N blocks, whose operations do not wait for each other; see
    // `Equations::evaluate`.
    template <int N, class Number> void evaluate(const RodRows<Number> *rows) const {
        double closed = RESIDUAL * program_.size;
        Mask moving{};
        for (int b = 0; b < N; b++) moving |= rows[b].alive & ~rows[b].may_stay;
        if (!any(moving)) {
            Lanes norm[N];
            Mask open{};
            for (int b = 0; b < N; b++) {
                norm[b] = measure(rows[b]);
                open |= rows[b].alive & ~(norm[b] <= closed);
            }
            if (!any(open)) {
                for (int b = 0; b < N; b++) {
                    for (int i = 0; i < 6; i++) rows[b].step[i] = Lanes{};
                    rows[b].measures->residual = rows[b].measures->reducible = norm[b];
                    rows[b].measures->length = Lanes{};
                }
                return;
            }
        }
        Lanes matrix[N][42], norm[N], sign[N];
        for (int row = 0; row < 6; row++)
            for (int b = 0; b < N; b++) {
                const Number *placed = rows[b].placed + row * ROD;
                Rod rod(placed, rows[b].coordinates);
                for (int f = 0; f < 6; f++) matrix[b][6 * f + row] = rod.freedom(program_.freedom[f]);
                matrix[b][36 + row] = rod.distance - (placed[2 * LINK] + rows[b].coordinates[12 + row]);
            }
        for (int b = 0; b < N; b++) {
            norm[b] = measure_residual(matrix[b] + 36);
            sign[b] = splat(1.0);
        }
        triangularize_all<N>(matrix, sign);
        for (int b = 0; b < N; b++) finish(rows[b], matrix[b], norm[b], sign[b]);
    }

  private:
    template <class Number> Lanes measure(const RodRows<Number> &rows) const {
        Lanes residual[6];
        for (int row = 0; row < 6; row++) {
            const Number *placed = rows.placed + row * ROD;
            Rod rod(placed, rows.coordinates);
            residual[row] = rod.distance - (placed[2 * LINK] + rows.coordinates[12 + row]);
        }
        return measure_residual(residual);
    }

    INLINE static Lanes measure_residual(const Lanes *residual) {
        Lanes square{};
        for (int i = 0; i < 6; i++) square = square + residual[i] * residual[i];
        return root(square);
    }

    // Reflections J and following of N matrices (6, 7), column by column in turns.
    template <int N, int J = 0> INLINE static void triangularize_all(Lanes (*matrix)[42], Lanes *sign) {
        if constexpr (J < 5) {
            Lanes v[N][6 - J];
            Reflector h[N];
            for (int b = 0; b < N; b++) {
                for (int i = 0; i < 6 - J; i++) v[b][i] = matrix[b][7 * J + i];
                h[b] = make_reflector<6 - J>(v[b], 0);
                matrix[b][7 * J] = h[b].alpha;
                sign[b] = select(h[b].alpha != 0.0, -sign[b], sign[b]);
            }
            for (int c = 1; c < 7 - J; c++)
                for (int b = 0; b < N; b++)
                    reflect_column<6 - J>(v[b], h[b].beta, matrix[b] + 7 * J + 6 * c, 0);
            triangularize_all<N, J + 1>(matrix, sign);
        }
    }

    template <class Number>
    INLINE void finish(const RodRows<Number> &rows, const Lanes *matrix, Lanes norm, Lanes sign) const {
        Measures &measures = *rows.measures;
        Mask stays = rows.may_stay & (norm <= RESIDUAL * program_.size);
        Lanes y[6], inverse[6], left{}, step[6];
        for (int f = 0; f < 6; f++) {
            sign = sign * signum(matrix[7 * f]);
            inverse[f] = 1.0 / matrix[7 * f];
        }
        for (int f = 5; f >= 0; f--) {
            Lanes known{};
            for (int c = f + 1; c < 6; c++) known = known + matrix[6 * c + f] * y[c];
            y[f] = (-matrix[36 + f] - known) * inverse[f];
        }
        for (int i = 0; i < 6; i++) left = left + matrix[36 + i] * matrix[36 + i];
        for (int f = 0; f < 6; f++) step[program_.freedom[f]] = y[f];
        Lanes length = measure_twist(step, program_.size);
        for (int i = 0; i < 6; i++) rows.step[i] = select(stays, Lanes{}, step[i]);
        measures.residual = norm;
        measures.reducible = select(stays, norm, root(left));
        measures.length = select(stays, Lanes{}, length);
        measures.sign = select(stays, measures.sign, sign);
        measures.pivot = select(stays, measures.pivot, splat(1.0));
    }

    const Program &program_;
    bool apply_;
};

}  // namespace INSTRUCTION_SET
