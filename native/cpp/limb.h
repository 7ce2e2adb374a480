// SPDX-License-Identifier: Apache-2.0
// The closure residual of one limb and its derivatives; mirrors `Chain` of closure.py.
#pragma once

#include "program.h"

namespace INSTRUCTION_SET {

// Where a limb keeps its frames; `joints` is the largest number of joints of a limb.
struct Frames {
    Lanes *axes, *origins, *before, *base;  // base : a pose of no rotation at the origin

    static size_t need(int joints) {
        return Arena::need<Lanes>(12) + Arena::need<Lanes>(3 * (joints + 1)) + Arena::need<Lanes>(3 * (joints + 2)) +
               Arena::need<Lanes>(9 * (joints + 2));
    }
    Frames(Arena &arena, int joints)
        : axes(arena.take<Lanes>(3 * (joints + 1))), origins(arena.take<Lanes>(3 * (joints + 2))),
          before(arena.take<Lanes>(9 * (joints + 2))), base(arena.take<Lanes>(12)) {
        for (int i = 0; i < 12; i++) base[i] = splat(i == 0 || i == 4 || i == 8 ? 1.0 : 0.0);
    }
};

INLINE void widen(const Lanes *from, Lanes *to, int count) {
    for (int i = 0; i < count; i++) to[i] = from[i];
}
INLINE void widen(const double *from, Lanes *to, int count) {
    for (int i = 0; i < count; i++) to[i] = splat(from[i]);
}

// Number is Lanes where each lane has a trial of its own, double where all lanes share one.
// ENDING as in Group. The rows of a column are written to `out`, as many as group.rows.
template <class Number, int ENDING> struct Limb {
    const Group &group;
    const Number *placed;   // of this limb
    const double *nominal;  // links of this limb
    const Frames &frames;
    double size;
    const Lanes *platform;  // rotation (9) of the body on which it ends
    const Lanes *carrier;   // rotation (9) and position (3) of the body on which it begins, or null
    const Lanes *theta;     // joints + 1 values, `stride` apart
    int stride;
    Lanes tip[3], turned[9], arm[3], gap[3], distance, direction[3], moment[3];

    const Number *link(int j) const { return placed + LINK * j; }
    const Number *pitch() const { return placed + LINK * (group.joints + 2); }
    const Number &length() const { return pitch()[group.joints]; }
    // The rotation before link j, null for that of the base.
    const Lanes *get_axes(int j) const {
        return j == 0 ? carrier : j == group.joints + 1 ? platform : frames.before + 9 * j;
    }

    // T : rotation (9) and position (3) of all nodes. limb : its number in the group.
    INLINE Limb(const Group &g, int limb, const Number *numbers, const Frames &f, double s,
                const Lanes *nodes, const Lanes *values, int step, bool keeps_rotations)
        : group(g), placed(numbers), nominal(g.links + limb * (g.joints + 2) * 12), frames(f),
          size(s), theta(values), stride(step) {
        int64_t on = g.ends[2 * limb], to = g.ends[2 * limb + 1];
        const Lanes *T = platform = to < 0 ? f.base : nodes + 12 * to;
        carrier = on < 0 ? nullptr : nodes + 12 * on;
        Lanes rotation[9], point[3], moved[3];
        if (carrier) {
            multiply_matrix(carrier, link(0), rotation);
            multiply_vector(carrier, link(0) + 18, point);
            for (int i = 0; i < 3; i++) point[i] = point[i] + carrier[9 + i];
        } else {
            widen(link(0), rotation, 9);
            widen(link(0) + 18, point, 3);
        }
        for (int i = 0; i < 3; i++) f.origins[i] = point[i];
        for (int j = 0; j < g.joints; j++) {
            Lanes *axis = f.axes + 3 * j, value = values[j * step];
            for (int i = 0; i < 3; i++) axis[i] = rotation[3 * i + 2];
            if (!g.turns[j]) {
                for (int i = 0; i < 3; i++) point[i] = point[i] + value * axis[i];
            } else {
                if (g.advances[j]) {
                    Lanes advance = pitch()[j] * value;
                    for (int i = 0; i < 3; i++) point[i] = point[i] + advance * axis[i];
                }
                Lanes sine, cosine;
                sine_and_cosine(value, sine, cosine);
                for (int i = 0; i < 3; i++) {
                    Lanes x = rotation[3 * i], y = rotation[3 * i + 1];
                    rotation[3 * i] = cosine * x + sine * y;
                    rotation[3 * i + 1] = cosine * y - sine * x;
                }
            }
            if (keeps_rotations)
                for (int i = 0; i < 9; i++) f.before[9 * (j + 1) + i] = rotation[i];
            multiply_vector(rotation, link(j + 1) + 18, moved);
            for (int i = 0; i < 3; i++) {
                point[i] = point[i] + moved[i];
                f.origins[3 * (j + 1) + i] = point[i];
            }
            if (g.rotates[j + 1]) {
                Lanes next[9];
                multiply_matrix(rotation, link(j + 1), next);
                for (int i = 0; i < 9; i++) rotation[i] = next[i];
            }
        }
        multiply_vector(T, link(g.joints + 1) + 18, arm);
        for (int i = 0; i < 3; i++) {
            tip[i] = point[i];
            gap[i] = arm[i] + T[9 + i] - point[i];
        }
        if (ENDING == RIGID)
            for (int i = 0; i < 9; i++) turned[i] = rotation[i];
        if (ENDING == DISTANCE) {
            distance = root(dot(gap, gap));
            Lanes inverse = 1.0 / distance;
            for (int i = 0; i < 3; i++) direction[i] = gap[i] * inverse;
            cross(arm, direction, moment);
        }
    }

    INLINE void choose(const Lanes *whole, Lanes *out) const {
        for (int i = 0; i < group.rows; i++) out[i] = whole[group.row[i]];
    }

    INLINE void residual(Lanes *out) const {
        if (ENDING == DISTANCE) {
            out[0] = distance - (length() + theta[group.joints * stride]);
        } else if (ENDING == BALL) {
            choose(gap, out);
        } else {
            Lanes attachment[9], whole[6];
            multiply_matrix(platform, link(group.joints + 1), attachment);
            Lanes R[9];  // attachment . turned'
            for (int i = 0; i < 3; i++)
                for (int j = 0; j < 3; j++) R[3 * i + j] = dot(attachment + 3 * i, turned + 3 * j);
            Lanes scale = 2.0 * size / larger(1.0 + R[0] + R[4] + R[8], splat(1e-3));
            whole[0] = scale * (R[7] - R[5]);
            whole[1] = scale * (R[2] - R[6]);
            whole[2] = scale * (R[3] - R[1]);
            for (int i = 0; i < 3; i++) whole[3 + i] = gap[i];
            choose(whole, out);
        }
    }

    // The attachment moves along `along` against the tip.
    INLINE void shift(const Lanes *along, Lanes *out) const {
        if (ENDING == DISTANCE) {
            out[0] = dot(direction, along);
        } else if (ENDING == BALL) {
            choose(along, out);
        } else {
            Lanes whole[6] = {Lanes{}, Lanes{}, Lanes{}, along[0], along[1], along[2]};
            choose(whole, out);
        }
    }

    // It turns about `axis`, attachment or tip at `at` from the center.
    INLINE void turn(const Lanes *axis, const Lanes *at, Lanes *out) const {
        Lanes whole[6];
        cross(axis, at, whole + 3);
        if (ENDING != RIGID) return shift(whole + 3, out);
        for (int i = 0; i < 3; i++) whole[i] = size * axis[i];
        choose(whole, out);
    }

    INLINE void freedom(int f, Lanes *out) const {
        if (ENDING == DISTANCE) {
            out[0] = f < 3 ? moment[f] : direction[f - 3];
            return;
        }
        Lanes axis[3] = {};
        axis[f % 3] = splat(1.0);
        if (f < 3)
            turn(axis, arm, out);
        else
            shift(axis, out);
    }

    // Column c of the unknowns of nodes that the limb touches.
    INLINE void touch(int c, Lanes *out) const {
        int f = (int)group.freedom[c];
        if (f >= DRIVEN) return joint(f - DRIVEN, out);
        if (c >= group.carried) return freedom(f, out);
        Lanes axis[3] = {}, at[3];
        axis[f % 3] = splat(1.0);
        if (f < 3) {
            for (int i = 0; i < 3; i++) at[i] = tip[i] - carrier[9 + i];
            turn(axis, at, out);
        } else {
            shift(axis, out);
        }
        negate(out);
    }

    INLINE void negate(Lanes *out) const {
        for (int i = 0; i < group.rows; i++) out[i] = -out[i];
    }

    INLINE void joint(int j, Lanes *out) const {
        if (j == group.joints) {
            for (int i = 0; i < group.rows; i++) out[i] = splat(ENDING == DISTANCE ? -1.0 : 0.0);
            return;
        }
        const Lanes *axis = frames.axes + 3 * j;
        if (!group.turns[j]) {
            shift(axis, out);
            return negate(out);
        }
        Lanes at[3], along[3], more[6] = {};
        for (int i = 0; i < 3; i++) at[i] = tip[i] - frames.origins[3 * j + i];
        turn(axis, at, out);
        negate(out);
        if (!group.advances[j]) return;
        for (int i = 0; i < 3; i++) along[i] = pitch()[j] * axis[i];
        shift(along, more);
        for (int i = 0; i < group.rows; i++) out[i] = out[i] - more[i];
    }

    INLINE void slot(int s, Lanes *out) const {
        int j = (int)group.slot[2 * s], axis = (int)group.slot[2 * s + 1], last = group.joints + 1;
        if (axis == LENGTH) {
            for (int i = 0; i < group.rows; i++) out[i] = splat(-1.0);
            return;
        }
        Lanes along[3], at[3] = {};
        if (axis == PITCH) {
            for (int i = 0; i < 3; i++) along[i] = theta[j * stride] * frames.axes[3 * j + i];
            shift(along, out);
            return negate(out);
        }
        // a column of the slope of the link's rotation, or of its nominal rotation
        Number local[3];
        for (int i = 0; i < 3; i++) {
            if (axis < 3)
                local[i] = link(j)[9 + 3 * i + axis];
            else
                local[i] = Number{} + nominal[12 * j + 3 * i + axis - 3];
        }
        if (const Lanes *axes = get_axes(j))
            multiply_vector(axes, local, along);
        else
            widen(local, along, 3);
        if (j != last)
            for (int i = 0; i < 3; i++) at[i] = tip[i] - frames.origins[3 * j + i];
        if (axis >= 3)
            shift(along, out);
        else
            turn(along, at, out);
        if (j != last) negate(out);
    }
};

}  // namespace INSTRUCTION_SET
