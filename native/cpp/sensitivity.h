// SPDX-License-Identifier: Apache-2.0
// Derivatives of the platform in parameters and readings; see sensitivity.py. A closure row is a
// wrench on the limb's tip; its product with the velocity of a column is the entry.
#pragma once

#include "blocks.h"
#include "limb.h"

namespace INSTRUCTION_SET {

// How parameters and readings move displacements and driven joints; see loopcal.engine.ParameterMap.
// structure : parameters, functions, and of each limb the number of its entries and, for each, the
// column (a slot, or slots + joint), the parameter, the coefficient, and the number in `basis` or -1
// for a displacement; sorted by column.
struct InputMap {
    const int64_t *structure;
    loopcal::Strided displacements, joints, basis, readings;

    int64_t parameters() const { return structure[0]; }
};

// What the rows of one block see: the map's numbers of each lane.
struct LaneMap {
    const double *displacements[W], *joints[W], *basis[W], *readings[W];
    bool shares_trial;

    void locate_lanes(const InputMap &map, const int64_t *trial, const int64_t *pose, bool shared) {
        shares_trial = shared;
        for (int lane = 0; lane < W; lane++) {
            displacements[lane] = locate(map.displacements, trial[lane], 0);
            joints[lane] = locate(map.joints, trial[lane], 0);
            basis[lane] = locate(map.basis, trial[lane], pose[lane]);
            readings[lane] = locate(map.readings, trial[lane], pose[lane]);
        }
    }
    Lanes coefficient(const int64_t *entry) const {
        const double *const *from = entry[3] < 0 ? displacements : joints;
        Lanes value = shares_trial ? splat(from[0][entry[2]]) : gather(from, entry[2]);
        return entry[3] < 0 ? value : gather(basis, entry[3]) * value;
    }
};

// Moments and forces of a limb's closure rows, and what columns of the limb make of them.
template <class Number, int ENDING> struct Wrenches {
    const Limb<Number, ENDING> &limb;
    const Lanes *shares;  // (rows of the ending) of the closure row
    Lanes moment[3], force[3], local_moment[3] = {}, local_force[3] = {};
    int moment_of = -1, force_of = -1;  // links whose axes the local vectors have

    INLINE Wrenches(const Limb<Number, ENDING> &of, const Lanes *taken) : limb(of), shares(taken) {
        const Group &group = of.group;
        for (int i = 0; i < 3; i++) moment[i] = force[i] = Lanes{};
        if (ENDING == DISTANCE) {
            for (int i = 0; i < 3; i++) force[i] = taken[0] * of.direction[i];
        } else {
            for (int i = 0; i < group.rows; i++) {
                int row = (int)group.row[i];
                if (ENDING == BALL)
                    force[row] = taken[i];
                else if (row < 3)
                    moment[row] = of.size * taken[i];
                else
                    force[row - 3] = taken[i];
            }
        }
    }

    INLINE void moment_at(const Lanes *at, Lanes *out) const {
        cross(at, force, out);
        for (int i = 0; i < 3; i++) out[i] = moment[i] + out[i];
    }
    INLINE void moment_at_origin(int j, Lanes *out) const {
        Lanes at[3];
        for (int i = 0; i < 3; i++) at[i] = limb.tip[i] - limb.frames.origins[3 * j + i];
        moment_at(at, out);
    }

    INLINE void take_to_link(int j, const Lanes *vector, Lanes *out) const {
        const Lanes *axes = limb.get_axes(j);
        for (int i = 0; i < 3; i++)
            out[i] = axes ? axes[i] * vector[0] + axes[3 + i] * vector[1] + axes[6 + i] * vector[2] : vector[i];
    }

    INLINE Lanes joint(int j) const {
        const Group &group = limb.group;
        if (j == group.joints) return ENDING == DISTANCE ? -shares[0] : Lanes{};
        const Lanes *axis = limb.frames.axes + 3 * j;
        Lanes along = -dot(axis, force);
        if (!group.turns[j]) return along;
        Lanes about[3];
        moment_at_origin(j, about);
        Lanes turn = -dot(axis, about);
        return group.advances[j] ? turn + limb.pitch()[j] * along : turn;
    }

    INLINE Lanes slot(int s) {
        const Group &group = limb.group;
        int j = (int)group.slot[2 * s], axis = (int)group.slot[2 * s + 1], last = group.joints + 1;
        if (axis == LENGTH) return -shares[0];
        if (axis == PITCH)
            return -limb.theta[j * limb.stride] * dot(limb.frames.axes + 3 * j, force);
        Lanes sum;
        if (axis < 3) {
            if (moment_of != j) {
                Lanes about[3];
                if (j == last)
                    for (int i = 0; i < 3; i++) about[i] = moment[i];
                else
                    moment_at_origin(j, about);
                take_to_link(j, about, local_moment);
                moment_of = j;
            }
            const Number *slope = limb.link(j) + 9 + axis;
            sum = local_moment[0] * slope[0] + local_moment[1] * slope[3] + local_moment[2] * slope[6];
        } else {
            if (force_of != j) {
                take_to_link(j, force, local_force);
                force_of = j;
            }
            const double *frame = limb.nominal + 12 * j + axis - 3;
            sum = local_force[0] * frame[0] + local_force[1] * frame[3] + local_force[2] * frame[6];
        }
        return j == last ? sum : -sum;
    }
};

// Differentiates blocks of rows, one after the other.
class Differentiator {
  public:
    Lanes *by_parameter, *by_reading;  // (6, p) and (6, a) of the last block
    int64_t trial[W], pose[W];
    int used;

    static size_t need(const Program &program, const InputMap &map) {
        Sizes size(program, map);
        return Frames::need(size.joints) + PlacedUnit::need(program) +
               Arena::need<Lanes>(program.joint_values()) + Arena::need<Lanes>(12 * program.nodes) +
               Arena::need<Lanes>(size.triangle) +
               Arena::need<Lanes>(size.closed * (size.closed + program.twists + 1)) +
               Arena::need<Lanes>(program.largest_elimination(0, (int)size.closed)) +
               Arena::need<Lanes>(12 * size.closed) + Arena::need<Lanes>(6 * size.closed) + Arena::need<Lanes>(size.values) +
               Arena::need<bool>(size.values) +
               Arena::need<Lanes>(6 * (size_t)map.parameters()) +
               Arena::need<Lanes>(6 * (size_t)program.drives);
    }

    Differentiator(const Program &program, const InputMap &map, const Division &division,
                   const loopcal::Strided *arrays, const loopcal::Strided *joints, Arena &arena)
        : program_(program), map_(map), division_(division), arrays_(arrays), joints_(joints),
          size_(program, map), frames_(arena, size_.joints) {
        placed_.prepare(program, division, arena);
        theta_ = arena.take<Lanes>(program.joint_values());
        nodes_ = arena.take<Lanes>(12 * program.nodes);
        triangle_ = arena.take<Lanes>(size_.triangle);
        matrix_ = arena.take<Lanes>(size_.closed * (size_.closed + program.twists + 1));
        front_ = arena.take<Lanes>(program.largest_elimination(0, (int)size_.closed));
        rows_ = arena.take<Lanes>(12 * size_.closed);
        inverse_ = arena.take<Lanes>(6 * size_.closed);
        values_ = arena.take<Lanes>(size_.values);
        by_parameter = arena.take<Lanes>(6 * (size_t)map.parameters());
        by_reading = arena.take<Lanes>(6 * (size_t)program.drives);
        begins_ = arena.take<bool>(size_.values);
        find_first_products();
    }

    void differentiate(int64_t block) {
        used = division_.locate(block, trial, pose);
        differentiate_located(block / division_.blocks_of_unit());
    }

    // Any poses of one trial, where trials do not share lanes.
    void differentiate_poses(int64_t of_trial, const int64_t *poses) {
        used = W;
        for (int lane = 0; lane < W; lane++) trial[lane] = of_trial, pose[lane] = poses[lane];
        differentiate_located(of_trial);
    }

  private:
    void differentiate_located(int64_t unit) {
        placed_.place(unit, arrays_[0]);
        gather_joints(program_, joints_, arrays_[1], trial, pose, theta_);
        gather_nodes(program_, arrays_[2], joints_ + program_.groups, trial, pose, nodes_);
        numbers_.locate_lanes(map_, trial, pose, !division_.by_trials);
        if (division_.by_trials)
            close_limbs(placed_.lanes());
        else
            close_limbs(placed_.numbers());
        invert();
        multiply();
    }

    struct Sizes {  // of what a block needs
        int joints = 0;
        size_t closed = 0, values = 0, triangle = 1;

        Sizes(const Program &program, const InputMap &map) {
            const int64_t *entries = map.structure + 2;
            for (int g = 0; g < program.groups; g++) {
                const Group &group = program.group[g];
                size_t rows = group.rows > group.unknown ? group.rows - group.unknown : 0;
                size_t square = (size_t)group.rows * (group.rows + group.unknown);
                if (group.joints > joints) joints = group.joints;
                if (square > triangle) triangle = square;
                for (int k = 0; k < group.limbs; k++, entries += 1 + 4 * entries[0])
                    values += rows * (size_t)(entries[0] + group.joints + 1);
            }
            closed = program.closed_rows();  // rows of zeros where there are too few
        }
    };

    template <class Number> void close_limbs(const Number *placed) {
        const int64_t *entries = map_.structure + 2;
        const Lanes *theta = theta_;
        Lanes *values = values_;
        for (size_t i = 0; i < 12 * size_.closed; i++) rows_[i] = Lanes{};
        for (size_t i = 0; i < 6 * size_.closed; i++) inverse_[i] = Lanes{};
        size_t first = 0;
        for (int g = 0; g < program_.groups; g++) {
            const Group &group = program_.group[g];
            for (int k = 0; k < group.limbs; k++) {
                if (group.ending == RIGID)
                    close_limb<Number, RIGID>(group, k, placed, theta, entries, first, values);
                else if (group.ending == BALL)
                    close_limb<Number, BALL>(group, k, placed, theta, entries, first, values);
                else
                    close_limb<Number, DISTANCE>(group, k, placed, theta, entries, first, values);
                placed += group.placed();
                theta += group.joints + 1;
                entries += 1 + 4 * entries[0];
            }
        }
    }

    // Write the rows of a limb against the freedoms that it touches to rows_ (12 numbers each) and those against the
    // entries of the map and the driven joints to `values`, which moves on, as `first` does.
    template <class Number, int ENDING>
    void close_limb(const Group &group, int k, const Number *placed, const Lanes *theta,
                    const int64_t *entries, size_t &first, Lanes *&values) {
        Limb<Number, ENDING> limb(group, k, placed, frames_, program_.size, nodes_, theta, 1, true);
        int r = group.rows, u = group.unknown;
        for (int j = 0; j < u; j++) limb.joint((int)group.solved[j], triangle_ + j * r);
        Lanes *unit = triangle_ + u * r;
        for (int i = 0; i < r * r; i++) unit[i] = splat(i % (r + 1) ? 0.0 : 1.0);
        if (u) triangularize(triangle_, r, u + r, u);
        for (int i = u; i < r; i++, first++) {
            Lanes shares[6], at_center[3], at_carrier[3], arm[3];
            for (int c = 0; c < r; c++) shares[c] = unit[c * r + i];
            Wrenches<Number, ENDING> wrench(limb, shares);
            wrench.moment_at(limb.arm, at_center);
            if (limb.carrier) {
                for (int c = 0; c < 3; c++) arm[c] = limb.tip[c] - limb.carrier[9 + c];
                wrench.moment_at(arm, at_carrier);
            }
            for (int f = 0; f < group.touched; f++) {
                int freedom = (int)group.freedom[f];
                if (f < group.carried)  // it moves the tip
                    rows_[12 * first + f] = freedom < 3 ? -at_carrier[freedom] : -wrench.force[freedom - 3];
                else
                    rows_[12 * first + f] = freedom < 3 ? at_center[freedom] : wrench.force[freedom - 3];
            }
            int64_t column = -1;
            Lanes value{};
            for (int64_t z = 0; z < entries[0]; z++) {
                const int64_t *entry = entries + 1 + 4 * z;
                if (entry[0] != column) {
                    column = entry[0];
                    value = column < group.slots ? wrench.slot((int)column)
                                                 : wrench.joint((int)column - group.slots);
                }
                *values++ = value * numbers_.coefficient(entry);
            }
            bool weighted = !program_.sigma;
            for (int j = 0; j <= group.joints; j++) {
                int64_t drive = group.actuator[j * group.limbs + k];
                if (drive < 0) continue;
                Lanes slope = wrench.joint(j);
                *values++ = slope * gather(numbers_.readings, drive);
                if (!weighted) inverse_[first] = 1.0 / (magnitude(slope) * program_.sigma[drive]);
                weighted = true;
            }
        }
    }

    // inverse_ (6, closed rows): inverse of the rows against the freedoms, or with redundant
    // actuators the least-squares one.
    void invert() {
        if (program_.eliminations) return invert_nodes();
        int c = (int)size_.closed, m = program_.freedoms;
        for (int f = 0; f < m; f++)
            for (int i = 0; i < c; i++) matrix_[f * c + i] = rows_[12 * i + f];
        for (int i = 0; i < c * c; i++) matrix_[m * c + i] = splat(i % (c + 1) ? 0.0 : 1.0);
        if (program_.sigma) {
            for (int f = 0; f < m; f++)
                for (int i = 0; i < c; i++) matrix_[f * c + i] = matrix_[f * c + i] * inverse_[i];
            for (int i = 0; i < c; i++) matrix_[(m + i) * c + i] = inverse_[i];
        }
        triangularize(matrix_, c, m + c, m);
        for (int i = 0; i < c; i++)
            for (int f = m - 1; f >= 0; f--) {
                Lanes known = matrix_[(m + i) * c + f];
                for (int h = f + 1; h < m; h++)
                    known = known - matrix_[h * c + f] * inverse_[h * c + i];
                inverse_[f * c + i] = known / matrix_[f * c + f];
            }
    }

    // The rows of the platform of the inverse of all nodes, which is eliminated last.
    void invert_nodes() {
        int c = (int)size_.closed, M = program_.twists, row = 0;
        for (int i = 0; i < c * M; i++) matrix_[i] = Lanes{};
        for (int i = 0; i < c * c; i++) matrix_[M * c + i] = splat(i % (c + 1) ? 0.0 : 1.0);
        for (int g = 0; g < program_.groups; g++) {
            const Group &group = program_.group[g];
            for (int k = 0; k < group.limbs; k++)
                for (int i = group.unknown; i < group.rows; i++, row++)
                    for (int f = 0; f < group.touched; f++)
                        matrix_[group.touches[k * group.touched + f] * c + row] = rows_[12 * row + f];
        }
        eliminate_nodes(program_, matrix_, c, 0, c, front_);
        const Elimination &last = program_.elimination[program_.eliminations - 1];
        for (int i = 0; i < c; i++)
            for (int f = last.count - 1; f >= 0; f--) {
                Lanes known = matrix_[(M + i) * c + last.row[f]];
                for (int h = f + 1; h < last.count; h++)
                    known = known - matrix_[last.column[h] * c + last.row[f]] * inverse_[h * c + i];
                inverse_[f * c + i] = known / matrix_[last.column[f] * c + last.row[f]];
            }
    }

    // begins_ : of each product that `multiply` adds, whether it is the first one of its column. A
    // column without products is zero, and so are the rows that are no freedoms.
    void find_first_products() {
        int64_t p = map_.parameters(), a = program_.drives;
        for (int64_t i = 0; i < 6 * p; i++) by_parameter[i] = Lanes{};
        for (int64_t i = 0; i < 6 * a; i++) by_reading[i] = Lanes{};
        bool *begins = begins_;
        // a mark in the columns themselves: they are of use only later
        visit([&](Lanes *to, int64_t, size_t) {
            *begins++ = (*to)[0] == 0.0;
            *to = splat(1.0);
        });
        for (int64_t i = 0; i < p; i++) by_parameter[i] = Lanes{};
        for (int64_t i = 0; i < a; i++) by_reading[i] = Lanes{};
    }

    void multiply() {
        const Lanes *value = values_;
        const bool *begins = begins_;
        visit([&](Lanes *to, int64_t stride, size_t row) {
            const Lanes *inverse = inverse_ + row, factor = *value++;
            bool begins_here = *begins++;
            for (int f = 0; f < program_.freedoms; f++, inverse += size_.closed) {
                Lanes *entry = to + program_.freedom[f] * stride, before{};
                if (!begins_here) before = *entry;
                *entry = before - *inverse * factor;
            }
        });
    }

    // Call `act` with the column, the stride of its rows and the closed row of every product, in the
    // order of values_.
    template <class Act> INLINE void visit(Act act) {
        int64_t p = map_.parameters(), a = program_.drives;
        const int64_t *entries = map_.structure + 2;
        size_t row = 0;
        for (int g = 0; g < program_.groups; g++) {
            const Group &group = program_.group[g];
            for (int k = 0; k < group.limbs; k++, entries += 1 + 4 * entries[0])
                for (int i = group.unknown; i < group.rows; i++, row++) {
                    for (int64_t z = 0; z < entries[0]; z++) act(by_parameter + entries[2 + 4 * z], p, row);
                    for (int j = 0; j <= group.joints; j++) {
                        int64_t drive = group.actuator[j * group.limbs + k];
                        if (drive >= 0) act(by_reading + drive, a, row);
                    }
                }
        }
    }

    const Program &program_;
    const InputMap &map_;
    const Division &division_;
    const loopcal::Strided *arrays_, *joints_;
    Sizes size_;
    Frames frames_;
    PlacedUnit placed_;
    LaneMap numbers_;
    Lanes *theta_, *nodes_, *triangle_, *matrix_, *front_, *rows_, *inverse_, *values_;
    bool *begins_;
};

INLINE void write_lanes(const Lanes *from, int64_t count, const Differentiator &rows, int64_t n, double *out) {
    double *to[W];
    for (int lane = 0; lane < W; lane++)
        to[lane] = out + (rows.trial[lane] * n + rows.pose[lane]) * count;
    write_rows(from, count, rows.used, to);
}

// arrays : e, q, T, then the numbers of the map: displacements, joints, basis, readings.
inline int differentiate(const int64_t *structure, const double *numbers, const int64_t *entries,
                         const loopcal::Strided *arrays, const loopcal::Strided *joints,
                         double *by_parameter, double *by_reading, int64_t t, int64_t n) {
    ProgramMemory memory(structure);
    if (!memory.ok()) return 1;
    Program program(structure, numbers, memory.groups, memory.order);
    InputMap map{entries, arrays[3], arrays[4], arrays[5], arrays[6]};
    Division division(t, n);
    Arena arena(Differentiator::need(program, map));
    if (!arena.ok()) return 1;
    Differentiator rows(program, map, division, arrays, joints, arena);
    for (int64_t block = 0; block < division.blocks(); block++) {
        rows.differentiate(block);
        write_lanes(rows.by_parameter, 6 * map.parameters(), rows, n, by_parameter);
        write_lanes(rows.by_reading, 6 * program.drives, rows, n, by_reading);
    }
    return 0;
}

}  // namespace INSTRUCTION_SET
