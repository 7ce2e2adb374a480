// SPDX-License-Identifier: Apache-2.0
// A mechanism as flat arrays, as library.py writes it (see `flatten_program` there), and its links
// displaced by the parameters of a trial.
#pragma once

#include "algebra.h"

namespace INSTRUCTION_SET {

enum Ending { RIGID = 0, BALL = 1, DISTANCE = 2 };
constexpr int PITCH = 6, LENGTH = 7;  // values of Slot.axis beside those of a twist
constexpr int DRIVEN = 6;             // freedom of a limb that is joint 0, if it is driven
constexpr int LINK = 21;              // numbers of a placed link: rotation, slope, origin
constexpr int ROD = 2 * LINK + 1;     // numbers of a placed limb that is a rod alone

// Limbs of one structure; see loopcal.engine.Group. Arrays belong to the caller.
struct Group {
    int limbs, joints, ending, rows, slots, unknown;
    int64_t first_column;      // of e
    int carried, touched;      // freedoms of the bodies at which limbs begin; all unknowns of nodes
    const int64_t *freedom;    // `touched`: freedoms of the first bodies, then of those at which limbs
                               // end, then DRIVEN + joint of each driven joint whose sums are given
    const int64_t *ends;       // (limbs, 2): the bodies at which they begin and end, -1 for the base
    const int64_t *touches;    // (limbs, touched): columns of the unknowns of all nodes
    const int64_t *row;        // rows of the ending that count
    const int64_t *turns;      // joints: 1 for R, 0 for P
    const int64_t *solved;     // `unknown` joints that closure determines
    const int64_t *actuator;   // (joints + 1, limbs): column of q or -1
    const int64_t *slot;       // (slots, 2): element and axis
    const int64_t *rotates;    // links: whether their rotation can differ from the identity
    const int64_t *displaced;  // links: whether a slot rotates them
    const int64_t *advances;   // joints: whether their pitch can differ from zero
    const double *links;       // (limbs, joints + 2, 12): rotation, origin
    const double *pitch;       // (limbs, joints)
    const double *length;      // (limbs,)

    int placed() const { return LINK * (joints + 2) + joints + 1; }  // numbers of a placed limb
};

// How one node is eliminated: `rows` of the closure rows that touch it, columns of which its own
// `count` come first, then those of its neighbors.
struct Elimination {
    int count, rows, columns;
    const int64_t *row, *column;
};

struct Program {
    int groups, freedoms, displacements, drives, free;
    bool frees_drives;         // whether driven joints are unknown, as one more node, and their
    int sums;                  // sums are given, so many
    int freedom[6];
    int nodes, twists;         // the platform and other bodies, and the unknowns of all nodes
    const int64_t *place;      // (twists,): their places in a step
    int eliminations;          // 0 where the platform is the only node
    int padding, task_place;   // rows of zeros behind those of closure and of sums; where the
                               // platform's rows of a task come among those that eliminate it
    Elimination *elimination;  // in their order, the platform last
    const double *sigma;  // (drives,), null without redundancy
    double size;
    Group *group;
    bool may_stay_open;  // whether a least-squares solution counts as closed

    // `memory` for as many groups as whole[0] states, `order` for one node more than whole[1] does
    Program(const int64_t *whole, const double *real, Group *memory, Elimination *order)
        : group(memory) {
        const int64_t *i = whole;
        groups = (int)*i++, nodes = (int)*i++;
        freedoms = (int)*i++, displacements = (int)*i++, drives = (int)*i++;
        bool has_sigma = *i++ != 0;
        free = (int)*i++;
        frees_drives = *i++ != 0, sums = (int)*i++;
        for (int f = 0; f < 6; f++) freedom[f] = (int)*i++;
        size = *real++;
        sigma = has_sigma ? real : nullptr;
        if (has_sigma) real += drives;
        for (int g = 0; g < groups; g++) {
            Group &o = group[g];
            o.limbs = (int)*i++, o.joints = (int)*i++, o.ending = (int)*i++, o.rows = (int)*i++;
            o.slots = (int)*i++, o.unknown = (int)*i++, o.first_column = *i++;
            o.carried = (int)*i++, o.touched = (int)*i++;
            o.freedom = i, i += o.touched;
            o.ends = i, i += 2 * o.limbs;
            o.touches = i, i += o.limbs * o.touched;
            o.row = i, i += o.rows;
            o.turns = i, i += o.joints;
            o.solved = i, i += o.unknown;
            o.actuator = i, i += (o.joints + 1) * o.limbs;
            o.slot = i, i += 2 * o.slots;
            o.rotates = i, i += o.joints + 2;
            o.displaced = i, i += o.joints + 2;
            o.advances = i, i += o.joints;
            o.links = real, real += o.limbs * (o.joints + 2) * 12;
            o.pitch = real, real += o.limbs * o.joints;
            o.length = real, real += o.limbs;
        }
        may_stay_open = *i++ != 0 || has_sigma;
        twists = (int)*i++;
        place = i, i += twists;
        padding = (int)*i++, task_place = (int)*i++;
        eliminations = nodes > 1 || frees_drives ? nodes + frees_drives : 0;
        elimination = order;
        for (int n = 0; n < eliminations; n++) {
            Elimination &o = order[n];
            o.count = (int)*i++, o.rows = (int)*i++, o.columns = (int)*i++;
            o.row = i, i += o.rows;
            o.column = i, i += o.columns;
        }
    }

    // The largest matrix that an elimination factorizes, with rows of a task and right sides.
    size_t largest_elimination(int conditions, int sides) const {
        size_t most = 1;
        for (int n = 0; n < eliminations; n++) {
            size_t rows = (size_t)elimination[n].rows + (n + 1 == eliminations ? conditions : 0);
            size_t count = rows * (elimination[n].columns + sides);
            if (count > most) most = count;
        }
        return most;
    }

    int placed() const {
        int count = 0;
        for (int g = 0; g < groups; g++) count += group[g].limbs * group[g].placed();
        return count;
    }

    // The row of a matrix, with `conditions` rows of a task at its end, that is row i of elimination n.
    int find_row(int n, int i, int rows, int conditions) const {
        const Elimination &node = elimination[n];
        if (n + 1 < eliminations || i < task_place) return (int)node.row[i];
        if (i < task_place + conditions) return rows - conditions + i - task_place;
        return (int)node.row[i - conditions];
    }

    // Rows of closure without joints, of sums, and those of zeros of nodes that have too few.
    int closed_rows() const {
        int count = 0;
        for (int g = 0; g < groups; g++)
            if (group[g].rows > group[g].unknown)
                count += group[g].limbs * (group[g].rows - group[g].unknown);
        count += sums + padding;
        return eliminations || count > freedoms ? count : freedoms;
    }

    int joint_values() const {
        int count = 0;
        for (int g = 0; g < groups; g++) count += group[g].limbs * (group[g].joints + 1);
        return count;
    }

    int unknown_joints() const {
        int count = 0;
        for (int g = 0; g < groups; g++) count += group[g].limbs * group[g].unknown;
        return count;
    }

    // A step: a twist of each node, the unknown joints, and the driven ones if they are unknown.
    int step_size() const { return 6 * nodes + unknown_joints() + (frees_drives ? drives : 0); }
};

// Eliminate the nodes of a matrix of `rows` and of the columns of all twists and `sides` right sides;
// `conditions` rows behind those of closure are of the platform alone. The triangular rows of a node
// are the first ones that its elimination names. Returns the sign of the determinant.
inline Lanes eliminate_nodes(const Program &program, Lanes *matrix, int rows, int conditions,
                             int sides, Lanes *front) {
    Lanes sign = splat(1.0);
    for (int n = 0; n < program.eliminations; n++) {
        const Elimination &node = program.elimination[n];
        int height = node.rows + (n + 1 == program.eliminations ? conditions : 0);
        int width = node.columns + sides;
        auto find_row = [&](int i) { return program.find_row(n, i, rows, conditions); };
        auto find_column = [&](int c) {
            return c < node.columns ? (int)node.column[c] : program.twists + c - node.columns;
        };
        for (int c = 0; c < width; c++) {
            const Lanes *from = matrix + (size_t)find_column(c) * rows;
            for (int i = 0; i < height; i++) front[c * height + i] = from[find_row(i)];
        }
        sign = sign * triangularize(front, height, width, node.count);
        for (int f = 0; f < node.count; f++) sign = sign * signum(front[f * height + f]);
        for (int c = 0; c < width; c++) {
            Lanes *to = matrix + (size_t)find_column(c) * rows;
            int last = c < node.count ? c + 1 : height;
            for (int i = 0; i < last; i++) to[find_row(i)] = front[c * height + i];
        }
    }
    return sign;
}

// The memory of a program's groups and nodes.
class ProgramMemory {
  public:
    explicit ProgramMemory(const int64_t *structure)
        : arena_(Arena::need<Group>((size_t)structure[0]) + Arena::need<Elimination>((size_t)structure[1] + 1)) {
        if (!ok()) return;
        groups = arena_.take<Group>((size_t)structure[0]);
        order = arena_.take<Elimination>((size_t)structure[1] + 1);  // one for driven joints
    }
    bool ok() const { return arena_.ok(); }
    Group *groups = nullptr;
    Elimination *order = nullptr;

  private:
    Arena arena_;
};

// placed = nominal . translation(d) . rotation(exp(w)) for every link of every limb, with lanes for
// trials. e : the displacements of each lane.
inline void place_links(const Program &program, const double *const *e, Lanes *placed) {
    for (int g = 0; g < program.groups; g++) {
        const Group &group = program.group[g];
        int links = group.joints + 2;
        for (int k = 0; k < group.limbs; k++, placed += group.placed()) {
            Lanes *pitch = placed + LINK * links, *length = pitch + group.joints;
            const double *nominal = group.links + k * links * 12;
            for (int j = 0; j < group.joints; j++) pitch[j] = splat(group.pitch[k * group.joints + j]);
            *length = splat(group.length[k]);
            // moves are gathered in the place of rotation (turns) and slope (shifts)
            for (int i = 0; i < LINK * links; i++) placed[i] = Lanes{};
            for (int s = 0; s < group.slots; s++) {
                int64_t element = group.slot[2 * s], axis = group.slot[2 * s + 1];
                Lanes value;
                int64_t column = group.first_column + (int64_t)k * group.slots + s;
                for (int lane = 0; lane < W; lane++) value[lane] = e[lane][column];
                if (axis == PITCH)
                    pitch[element] = pitch[element] + value;
                else if (axis == LENGTH)
                    *length = *length + value;
                else
                    placed[LINK * element + axis] = placed[LINK * element + axis] + value;
            }
            for (int j = 0; j < links; j++) {
                Lanes *link = placed + LINK * j, *slope = link + 9, *origin = link + 18;
                const double *n = nominal + 12 * j;
                Lanes w[3] = {link[0], link[1], link[2]}, d[3] = {link[3], link[4], link[5]};
                Lanes base[9], turn[9];
                for (int i = 0; i < 9; i++) base[i] = splat(n[i]);
                for (int i = 0; i < 3; i++)
                    origin[i] = n[9 + i] + (n[3 * i] * d[0] + n[3 * i + 1] * d[1] + n[3 * i + 2] * d[2]);
                if (group.displaced[j]) {
                    exponential(w, turn);
                    multiply_matrix(base, turn, link);
                    left_jacobian(w, turn);
                    multiply_matrix(base, turn, slope);
                } else {
                    for (int i = 0; i < 9; i++) link[i] = base[i], slope[i] = Lanes{};
                }
            }
        }
    }
}

}  // namespace INSTRUCTION_SET
