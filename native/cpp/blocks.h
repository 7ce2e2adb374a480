// SPDX-License-Identifier: Apache-2.0
// Rows (trial, pose) in lanes: W poses of one trial, or one pose of W trials.
#pragma once

#include "interface.h"
#include "program.h"

namespace INSTRUCTION_SET {

INLINE const double *locate(const loopcal::Strided &array, int64_t trial, int64_t pose) {
    return array.data + trial * array.trial + pose * array.pose;
}

// How t trials of n poses are divided into blocks of W lanes. Trials share lanes where there are
// fewer poses than lanes.
struct Division {
    int64_t t, n;
    bool by_trials;

    Division(int64_t trials, int64_t poses) : Division(trials, poses, poses < W && trials > 1) {}
    Division(int64_t trials, int64_t poses, bool trials_share_lanes)
        : t(trials), n(poses), by_trials(trials_share_lanes) {}

    int64_t units() const { return by_trials ? (t + W - 1) / W : t; }  // that share placed links
    int64_t blocks_of_unit() const { return by_trials ? n : (n + W - 1) / W; }
    int64_t blocks() const { return units() * blocks_of_unit(); }

    // Trial and pose of a lane; idle lanes repeat the last row. Returns how many lanes are in use.
    int locate(int64_t block, int64_t *trial, int64_t *pose) const {
        int64_t unit = block / blocks_of_unit(), rest = block % blocks_of_unit();
        int64_t first = (by_trials ? unit : rest) * W, end = by_trials ? t : n;
        for (int lane = 0; lane < W; lane++) {
            int64_t moving = first + lane < end ? first + lane : end - 1;
            trial[lane] = by_trials ? moving : unit;
            pose[lane] = by_trials ? rest : moving;
        }
        return (int)(end - first < W ? end - first : W);
    }
};

// The placed links of one unit: in lanes, or as numbers that all lanes share.
class PlacedUnit {
  public:
    static size_t need(const Program &program) {
        return Arena::need<Lanes>(program.placed()) + Arena::need<double>(program.placed());
    }
    void prepare(const Program &program, const Division &division, Arena &arena) {
        program_ = &program, division_ = &division, unit_ = -1;
        lanes_ = arena.take<Lanes>(program.placed());
        numbers_ = arena.take<double>(program.placed());
    }

    const Lanes *lanes() const { return lanes_; }
    const double *numbers() const { return numbers_; }
    template <class Number> const Number *links() const {
        if constexpr (sizeof(Number) == sizeof(double))
            return numbers_;
        else
            return lanes_;
    }

    void place(int64_t unit, const loopcal::Strided &e) {
        if (unit == unit_ || (unit_ >= 0 && !e.trial)) return;
        unit_ = unit;
        const double *of_lane[W];
        for (int lane = 0; lane < W; lane++) {
            int64_t trial = division_->by_trials ? unit * W + lane : unit;
            of_lane[lane] = locate(e, trial < division_->t ? trial : division_->t - 1, 0);
        }
        place_links(*program_, of_lane, lanes_);
        if (!division_->by_trials)
            for (int i = 0; i < program_->placed(); i++) numbers_[i] = lanes_[i][0];
    }

  private:
    const Program *program_;
    const Division *division_;
    Lanes *lanes_;
    double *numbers_;
    int64_t unit_;
};

INLINE Lanes gather(const double *const *from, int64_t offset) {
    Lanes out;
    for (int lane = 0; lane < W; lane++) out[lane] = from[lane][offset];
    return out;
}

// Joint values of a block, group by group and limb by limb: those of a state (null joints leave
// them) with the driven ones from q (a null q leaves them). theta : (joints + 1) values of each limb.
inline void gather_joints(const Program &program, const loopcal::Strided *joints, const loopcal::Strided &q,
                          const int64_t *trial, const int64_t *pose, Lanes *theta) {
    const double *drive[W];
    if (q.data)
        for (int lane = 0; lane < W; lane++) drive[lane] = locate(q, trial[lane], pose[lane]);
    for (int g = 0; g < program.groups; g++) {
        const Group &group = program.group[g];
        const double *from[W];
        for (int lane = 0; joints && lane < W; lane++) from[lane] = locate(joints[g], trial[lane], pose[lane]);
        int values = group.joints + 1;
        for (int k = 0; k < group.limbs; k++)
            for (int j = 0; j < values; j++, theta++) {
                int64_t column = group.actuator[j * group.limbs + k];
                if (q.data && group.actuator[j * group.limbs] >= 0)
                    *theta = gather(drive, column);
                else if (joints)
                    *theta = gather(from, k * values + j);
            }
    }
}

// Rotation (9) and position (3) of the platform from T (.., 4, 4).
inline void gather_platform(const loopcal::Strided &T, const int64_t *trial, const int64_t *pose, Lanes *out) {
    const double *from[W];
    for (int lane = 0; lane < W; lane++) from[lane] = locate(T, trial[lane], pose[lane]);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) out[3 * i + j] = gather(from, 4 * i + j);
        out[9 + i] = gather(from, 4 * i + 3);
    }
}

// The poses of all nodes, of the platform's T and those of the others.
inline void gather_nodes(const Program &program, const loopcal::Strided &T, const loopcal::Strided *others,
                         const int64_t *trial, const int64_t *pose, Lanes *out) {
    gather_platform(T, trial, pose, out);
    for (int i = 1; i < program.nodes; i++) gather_platform(others[i - 1], trial, pose, out + 12 * i);
}

// Write rotations (9) and positions (3) to the rows of T (rows, 4, 4).
INLINE void write_platforms(const Lanes *from, const int64_t *row, int used, double *T) {
    Lanes whole[16] = {};
    double *to[W];
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) whole[4 * i + j] = from[3 * i + j];
        whole[4 * i + 3] = from[9 + i];
    }
    whole[15] = splat(1.0);
    for (int lane = 0; lane < W; lane++) to[lane] = T + 16 * row[lane];
    write_rows(whole, 16, used, to);
}

// Write a number of each of the first `used` lanes to rows that follow each other, as a byte.
INLINE void write_bytes(Mask from, int used, void *to) {
    typedef int8_t Bytes __attribute__((vector_size(LANES)));
    Bytes bytes = __builtin_convertvector(from, Bytes);
    if (used == W)
        std::memcpy(to, &bytes, W);
    else
        for (int lane = 0; lane < used; lane++) static_cast<int8_t *>(to)[lane] = bytes[lane];
}

// Rotation (9) and position (3) of one T (4, 4).
inline void read_platform(const double *T, double *out) {
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) out[3 * i + j] = T[4 * i + j];
        out[9 + i] = T[4 * i + 3];
    }
}

}  // namespace INSTRUCTION_SET
