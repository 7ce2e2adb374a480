// SPDX-License-Identifier: Apache-2.0
// Closure limb by limb where the platform is given, in closed form; see limbs.py.
#pragma once

#include "newton.h"

namespace INSTRUCTION_SET {

constexpr double OPEN = 1e-9;

// Whether every limb ends in a distance and its rod or a prismatic joint is unknown.
inline bool have_closed_form(const Program &program) {
    if (program.nodes > 1) return false;
    for (int g = 0; g < program.groups; g++) {
        const Group &group = program.group[g];
        if (group.ending != DISTANCE || group.unknown != 1) return false;
        int64_t j = group.solved[0];
        if (j < group.joints && group.turns[j]) return false;
    }
    return true;
}

// The status of limbs that are closed to this residual.
INLINE Lanes judge_closed(Lanes residual, double size) {
    Lanes closed = select(residual <= OPEN * size, splat(CONVERGED), splat(STALLED));
    return select(residual * 0.0 == 0.0, closed, splat(NOT_FINITE));
}

class LimbCloser {
  public:
    LimbCloser(const Program &program, const Frames &frames) : program_(program), frames_(frames) {}

    // Set the unknown joints in theta; T : rotation (9) and position (3) of the platform.
    template <class Number>
    void close(const Number *placed, const Lanes *T, Lanes *theta, Lanes &residual, Lanes &sign) const {
        Lanes square{};
        sign = splat(1.0);
        for (int g = 0; g < program_.groups; g++) {
            const Group &group = program_.group[g];
            for (int k = 0; k < group.limbs; k++) {
                close_limb(group, k, placed, T, theta, square, sign);
                placed += group.placed();
                theta += group.joints + 1;
            }
        }
        residual = root(square);
    }

  private:
    template <class Number>
    INLINE void close_limb(const Group &group, int k, const Number *placed, const Lanes *T,
                           Lanes *theta, Lanes &square, Lanes &sign) const {
        Limb<Number, DISTANCE> limb(group, k, placed, frames_, program_.size, T, theta, 1, false);
        int j = (int)group.solved[0];
        if (j == group.joints) {
            theta[j] = limb.distance - limb.length();
            Lanes left = limb.distance - (limb.length() + theta[j]);
            square = square + left * left;
            sign = -sign;
            return;
        }
        // a step along the axis changes the gap until its length is the reach
        const Lanes *axis = frames_.axes + 3 * j;
        Lanes along = dot(axis, limb.gap), reach = limb.length() + theta[group.joints], gap[3];
        Lanes rest = along * along - dot(limb.gap, limb.gap) + reach * reach;
        Lanes after = with_sign_of(root(larger(rest, Lanes{})), along), step = along - after;
        theta[j] = theta[j] + step;
        for (int i = 0; i < 3; i++) gap[i] = limb.gap[i] - step * axis[i];
        Lanes left = root(dot(gap, gap)) - reach;
        square = square + left * left;
        sign = sign * -signum(after);
    }

    const Program &program_;
    const Frames &frames_;
};

}  // namespace INSTRUCTION_SET
