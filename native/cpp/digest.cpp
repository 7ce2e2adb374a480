// SPDX-License-Identifier: Apache-2.0
// Prints a digest of what every function of the engine computes by each instruction set of this
// machine: equal lines mean equal bits. `.ci/native` compares compilers and processors with it.
//
// The inputs are drawn by integer arithmetic, so that they are the same everywhere: a platform with
// limbs of every ending, displaced in every slot. Most rows do not close, so that thirty steps
// amplify any difference; some are not finite.
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <vector>

#include "interface.h"

extern "C" {
const char *loopcal_instruction_set(int i, int *works);
int loopcal_fold(int, const double *, const double *, double *, int64_t, int64_t, int64_t, int64_t);
int loopcal_linearize(int, const int64_t *, const double *, const loopcal::Strided *,
                      const loopcal::Strided *, double *const *, int64_t, int64_t);
int loopcal_differentiate(int, const int64_t *, const double *, const int64_t *,
                          const loopcal::Strided *, const loopcal::Strided *, double *, double *,
                          int64_t, int64_t);
int loopcal_fold_poses(int, const int64_t *, const double *, const int64_t *, const loopcal::Strided *,
                       const loopcal::Strided *, const loopcal::TwistRows *, const double *,
                       double *, int8_t *, int64_t, int64_t);
int loopcal_certify(int, const int64_t *, const double *, const loopcal::Strided *, int64_t, int64_t,
                    int8_t *);
int loopcal_reach(int, const int64_t *, const double *, const loopcal::Strided *, const int64_t *,
                  const double *, int64_t, int64_t, const loopcal::ReachOutput *);
int loopcal_compare_poses(int, const loopcal::Strided *, double *, double *, int64_t, int64_t);
int loopcal_solve_triangles(int, const double *, const double *, double *, double *, int64_t,
                            int64_t);
int loopcal_locate_points(int, const loopcal::Strided *, const double *, const int64_t *, double *,
                          double *, int64_t, int64_t, int64_t);
int loopcal_eliminate_blocks(int, const loopcal::BlockStructure *, int64_t, const loopcal::BlockRows *,
                             int64_t, int64_t, int64_t, int64_t, double, double *, double *, double *,
                             double *, int8_t *);
int loopcal_solve(int, const int64_t *, const double *, const loopcal::Strided *,
                  const loopcal::Strided *, int64_t, int64_t, int64_t, int, loopcal::Task, void *,
                  double *, double *const *, double *, int64_t *, int8_t *, int8_t *);
}

namespace {

typedef std::vector<double> Reals;

struct Random {
    uint64_t state = 88172645463325252ull;
    double operator()() {  // in (-1, 1)
        state ^= state << 13, state ^= state >> 7, state ^= state << 17;
        return (double)(int64_t)(state >> 11) / (double)(1ll << 52) - 1.0;
    }
    Reals reals(size_t count, double size) {
        Reals out(count);
        for (double &value : out) value = size * (*this)();
        return out;
    }
};

struct Digest {  // FNV-1a
    uint64_t value = 14695981039346656037ull;
    template <class Number> void add(const std::vector<Number> &numbers) {
        for (Number number : numbers) {
            if (number != number) number = 0;  // the bits of NaN are not defined
            const unsigned char *bytes = reinterpret_cast<const unsigned char *>(&number);
            for (size_t i = 0; i < sizeof number; i++) value = (value ^ bytes[i]) * 1099511628211ull;
        }
    }
};

struct GroupShape {
    const char *joints;
    int ending, rows, driven;  // place of the driven joint; the rod is the one behind the last
};

const GroupShape SHAPES[] = {{"RRPRRR", 0, 6, 2}, {"RRP", 1, 3, 2}, {"", 2, 1, 0}};
const GroupShape RODS[] = {{"P", 2, 1, 0}, {"", 2, 1, 0}, {"", 2, 1, 0}};  // with a closed form each
const GroupShape DRIVEN[] = {{"", 2, 1, 0}, {"", 2, 1, 0}, {"", 2, 1, 0}};
constexpr int GROUPS = 3, LIMBS = 2, DRIVES = GROUPS * LIMBS;

void add_rotation(Random &random, Reals &to) {  // of a quaternion, by operations of IEEE 754 alone
    double a = 1.0, b = 0.5 * random(), c = 0.5 * random(), d = 0.5 * random();
    double s = 1.0 / std::sqrt(a * a + b * b + c * c + d * d);
    a *= s, b *= s, c *= s, d *= s;
    const double R[] = {1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c),
                        2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b),
                        2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)};
    to.insert(to.end(), R, R + 9);
}

struct Machine {
    std::vector<int64_t> structure;
    Reals numbers;
    int64_t displacements = 0;
    std::vector<size_t> values, rows;  // of each group: joint values, numbers of its rows

    // with `sums`, driven joints are unknown, and as many sums of them are given
    Machine(Random &random, bool free, int freedoms, const GroupShape *shapes, bool sums = false) {
        const int64_t driven = sums ? DRIVES : 0, touched = freedoms + sums;
        structure = {GROUPS, 1, freedoms, 0, DRIVES, 0, free, sums, driven, 0, 1, 2, 3, 4, 5};
        numbers = {0.4};
        int64_t drive = 0, unknown = 0;
        for (int g = 0; g < GROUPS; g++) {
            const GroupShape &shape = shapes[g];
            int64_t joints = 0;
            while (shape.joints[joints]) joints++;
            std::vector<int64_t> solved, slots, body;
            for (int64_t j = 0; j <= joints; j++)
                if (free ? j < joints || shape.driven == joints : j < joints && j != shape.driven)
                    solved.push_back(j);
            for (int64_t j = 0; j < joints + 2; j++)
                for (int64_t axis = 0; axis < 6; axis++) slots.insert(slots.end(), {j, axis});
            if (joints) slots.insert(slots.end(), {0, 6});
            if (shape.ending == 2) slots.insert(slots.end(), {joints, 7});
            int64_t count = (int64_t)slots.size() / 2;
            structure.insert(structure.end(), {LIMBS, joints, shape.ending, shape.rows, count,
                                               (int64_t)solved.size(), displacements, 0, touched});
            for (int f = 0; f < freedoms; f++) structure.push_back(f);
            if (sums) structure.push_back(6 + shape.driven);
            for (int k = 0; k < LIMBS; k++) structure.insert(structure.end(), {-1, 0});
            for (int k = 0; k < LIMBS; k++) {
                for (int f = 0; f < freedoms; f++) structure.push_back(f);
                if (sums) structure.push_back(freedoms + drive + k);
            }
            unknown += LIMBS * (int64_t)solved.size();
            displacements += LIMBS * count;
            for (int i = 0; i < shape.rows; i++) structure.push_back(i);
            for (int64_t j = 0; j < joints; j++) structure.push_back(shape.joints[j] == 'R');
            structure.insert(structure.end(), solved.begin(), solved.end());
            for (int64_t j = 0; j <= joints; j++)
                for (int k = 0; k < LIMBS; k++)
                    structure.push_back(j == shape.driven ? drive + k : -1);
            drive += LIMBS;
            structure.insert(structure.end(), slots.begin(), slots.end());
            structure.insert(structure.end(), 2 * (joints + 2), 1);
            for (int64_t j = 0; j < joints; j++) structure.push_back(j == 0);
            for (int i = 0; i < LIMBS * (joints + 2); i++) {
                add_rotation(random, numbers);
                for (int axis = 0; axis < 3; axis++) numbers.push_back(0.3 * random());
            }
            for (int i = 0; i < LIMBS * joints; i++) numbers.push_back(i % joints ? 0.0 : 0.01);
            for (int i = 0; i < LIMBS; i++) numbers.push_back(0.5 + 0.1 * random());
            values.push_back((size_t)(LIMBS * (joints + 1)));
            rows.push_back((size_t)(LIMBS * shape.rows * ((int64_t)solved.size() + freedoms + count + joints + 1)));
        }
        structure[3] = displacements;
        structure.insert(structure.end(), {0, freedoms + driven});  // may_stay_open, twists
        for (int f = 0; f < freedoms; f++) structure.push_back(f);
        for (int64_t j = 0; j < driven; j++) structure.push_back(6 + unknown + j);
        structure.insert(structure.end(), {0, 0});
        if (!sums) return;
        // driven joints are eliminated first, by all rows, then the platform by those that are left
        structure.insert(structure.end(), {DRIVES, 2 * DRIVES, DRIVES + freedoms});
        for (int64_t i = 0; i < 2 * DRIVES; i++) structure.push_back(i);
        for (int64_t i = 0; i < DRIVES + freedoms; i++) structure.push_back((freedoms + i) % (DRIVES + freedoms));
        structure.insert(structure.end(), {freedoms, DRIVES, freedoms});
        for (int64_t i = 0; i < DRIVES; i++) structure.push_back(DRIVES + i);
        for (int64_t i = 0; i < freedoms; i++) structure.push_back(i);
    }
};

// A map with a parameter for every slot of a limb, which moves it in both limbs of a group, and two
// functions of the pose for every drive.
std::vector<int64_t> list_entries(int64_t *parameters) {
    std::vector<int64_t> out = {0, 2};
    int64_t place = 0, parameter = 0, drive = 0;
    for (const GroupShape &shape : SHAPES) {
        int64_t joints = 0;
        while (shape.joints[joints]) joints++;
        int64_t slots = 6 * (joints + 2) + (joints > 0) + (shape.ending == 2);
        for (int k = 0; k < LIMBS; k++, drive++) {
            out.push_back(slots + 2);
            for (int64_t s = 0; s < slots; s++)
                out.insert(out.end(), {s, parameter + s, place++, -1});
            for (int64_t f = 0; f < 2; f++)
                out.insert(out.end(), {slots + shape.driven, parameter + f, 2 * drive + f, 2 * drive + f});
        }
        parameter += slots;
    }
    *parameters = out[0] = parameter;
    return out;
}

void add_kinematics(int set, bool free, int freedoms, int64_t t, int64_t n, Digest &digest,
                    const GroupShape *shapes = SHAPES) {
    Random random;
    Machine machine(random, free, freedoms, shapes);
    Reals e = random.reals((size_t)(t * machine.displacements), 1e-3);
    Reals q = random.reals((size_t)(t * n * DRIVES), 0.1), T;
    q[1] = INFINITY, q[q.size() - 1] = 1e4;
    add_rotation(random, T);
    T = {T[0], T[1], T[2], 0.1, T[3], T[4], T[5], 0.2, T[6], T[7], T[8], 0.4, 0, 0, 0, 1};
    std::vector<Reals> start, joints, rows;
    std::vector<loopcal::Strided> given, solved;
    std::vector<double *> joints_out, rows_out;
    for (int g = 0; g < GROUPS; g++) {
        start.push_back(random.reals(machine.values[(size_t)g], 0.5));
        joints.emplace_back((size_t)(t * n) * machine.values[(size_t)g]);
        rows.emplace_back((size_t)(t * n) * machine.rows[(size_t)g]);
    }
    for (size_t g = 0; g < GROUPS; g++) {
        int64_t values = (int64_t)machine.values[g];
        given.push_back({start[g].data(), 0, 0});
        solved.push_back({joints[g].data(), n * values, values});
        joints_out.push_back(joints[g].data());
        rows_out.push_back(rows[g].data());
    }
    Reals poses((size_t)(16 * t * n)), residual((size_t)(t * n));
    std::vector<int64_t> iterations((size_t)(t * n));
    std::vector<int8_t> status((size_t)(t * n)), sign((size_t)(t * n));
    loopcal::Strided arrays[] = {{e.data(), machine.displacements, 0},
                                 {q.data(), n * DRIVES, DRIVES}, {T.data(), 0, 0}, {nullptr, 0, 0},
                                 {nullptr, 0, 0}, {nullptr, 0, 0}};
    loopcal_solve(set, machine.structure.data(), machine.numbers.data(), arrays, given.data(), t, n,
                  30, loopcal::APART, nullptr, nullptr, poses.data(), joints_out.data(), residual.data(),
                  iterations.data(), status.data(), sign.data());
    arrays[2] = {poses.data(), 16 * n, 16};
    loopcal_linearize(set, machine.structure.data(), machine.numbers.data(), arrays, solved.data(),
                      rows_out.data(), t, n);
    if (!free) {
        int64_t parameters = 0;
        std::vector<int64_t> entries = list_entries(&parameters);
        Reals scales = random.reals((size_t)(t * machine.displacements), 1.0);
        Reals terms = random.reals((size_t)(t * 2 * DRIVES), 1.0);
        Reals basis = random.reals((size_t)(n * 2 * DRIVES), 1.0), gains = random.reals(DRIVES, 1.0);
        Reals twists((size_t)(6 * t * n * parameters)), driven((size_t)(6 * t * n * DRIVES));
        loopcal::Strided mapped[] = {arrays[0], arrays[1], arrays[2],
                                     {scales.data(), machine.displacements, 0},
                                     {terms.data(), 2 * DRIVES, 0}, {basis.data(), 0, 2 * DRIVES},
                                     {gains.data(), 0, 0}};
        loopcal_differentiate(set, machine.structure.data(), machine.numbers.data(), entries.data(),
                              mapped, solved.data(), twists.data(), driven.data(), t, n);
        digest.add(twists), digest.add(driven);
        constexpr int64_t EACH = 5;  // rows of a pose
        std::vector<int64_t> pose;
        for (int64_t i = 0; i < EACH * n; i++) pose.push_back(i / EACH);
        Reals by_twist = random.reals((size_t)(6 * t * EACH * n), 1.0);
        Reals white = random.reals((size_t)(t * EACH * n), 1.0);
        loopcal::TwistRows observed = {EACH * n, pose.data(), {by_twist.data(), 6 * EACH * n, 0},
                                       {white.data(), EACH * n, 0}};
        Reals factor((size_t)(t * (parameters + 1) * (parameters + 1)));
        std::vector<int8_t> finite((size_t)(t * n));
        loopcal_fold_poses(set, machine.structure.data(), machine.numbers.data(), entries.data(),
                           mapped, solved.data(), &observed, factor.data(), factor.data(),
                           finite.data(), t, n);
        digest.add(factor), digest.add(finite);
    }
    digest.add(poses), digest.add(residual), digest.add(iterations);
    digest.add(status), digest.add(sign);
    for (size_t g = 0; g < GROUPS; g++) digest.add(joints[g]), digest.add(rows[g]);
}

// Poses at sums of driven joints, which other trials weigh otherwise, apart or one after the other.
void add_sums(int set, int64_t t, int64_t n, int order, Digest &digest) {
    Random random;
    Machine machine(random, false, 6, SHAPES, true);
    Reals e = random.reals((size_t)(t * machine.displacements), 1e-3), q = random.reals(DRIVES, 0.1), T;
    Reals weights = random.reals((size_t)(t * DRIVES * DRIVES), 1.0), values = random.reals((size_t)(t * n * DRIVES), 0.1);
    values[1] = INFINITY;
    add_rotation(random, T);
    T = {T[0], T[1], T[2], 0.1, T[3], T[4], T[5], 0.2, T[6], T[7], T[8], 0.4, 0, 0, 0, 1};
    std::vector<Reals> start, joints;
    for (size_t value : machine.values) start.push_back(random.reals(value, 0.5)), joints.emplace_back((size_t)(t * n) * value);
    std::vector<loopcal::Strided> given;
    std::vector<double *> out;
    for (const Reals &of_group : start) given.push_back({of_group.data(), 0, 0});
    for (Reals &of_group : joints) out.push_back(of_group.data());
    Reals poses((size_t)(16 * t * n)), residual((size_t)(t * n));
    std::vector<int64_t> iterations((size_t)(t * n));
    std::vector<int8_t> status((size_t)(t * n)), sign((size_t)(t * n));
    loopcal::Strided arrays[] = {{e.data(), machine.displacements, 0}, {q.data(), 0, 0}, {T.data(), 0, 0}, {nullptr, 0, 0},
                                 {weights.data(), DRIVES * DRIVES, 0}, {values.data(), n * DRIVES, DRIVES}};
    loopcal_solve(set, machine.structure.data(), machine.numbers.data(), arrays, given.data(), t, n,
                  30, order, nullptr, nullptr, poses.data(), out.data(), residual.data(),
                  iterations.data(), status.data(), sign.data());
    digest.add(poses), digest.add(residual), digest.add(iterations), digest.add(status), digest.add(sign);
    for (const Reals &of_group : joints) digest.add(of_group);
}

// Poses of driven rods, of which a part is proven, and a part is solved for.
void add_targets(int set, int64_t t, int64_t n, bool torsion, Digest &digest) {
    Random random;
    Machine machine(random, false, 6, DRIVEN);
    Reals e = random.reals((size_t)(t * machine.displacements), 1e-3), begin, sign = {1.0};
    add_rotation(random, begin);
    begin = {begin[0], begin[1], begin[2], 0.1, begin[3], begin[4], begin[5], 0.2,
             begin[6], begin[7], begin[8], 0.4, 0, 0, 0, 1};
    Reals values = random.reals((size_t)(t * n * 6), 0.4), T((size_t)(16 * t * n)), residual((size_t)(t * n));
    values[7] = INFINITY, values[20] = 1e17;
    std::vector<Reals> joints(GROUPS, Reals((size_t)(t * n) * LIMBS));
    double *joints_out[] = {joints[0].data(), joints[1].data(), joints[2].data()};
    std::vector<int8_t> status((size_t)(t * n)), signs(status), arrives(status), proven(status);
    const int64_t columns[] = {0, 1, -1, 3, 4, 5, torsion};
    loopcal::Strided arrays[] = {{e.data(), machine.displacements, 0},
                                 {begin.data(), 0, 0}, {values.data(), 6 * n, 6}, {sign.data(), 0, 0}};
    for (double value : {1.0, -1.0}) {
        sign[0] = value;
        loopcal::ReachOutput out{T.data(), joints_out, residual.data(), status.data(), signs.data(), arrives.data()};
        loopcal_reach(set, machine.structure.data(), machine.numbers.data(), arrays, columns, begin.data(), t, n, &out);
        digest.add(T), digest.add(residual), digest.add(status), digest.add(signs), digest.add(arrives);
        for (const Reals &of_group : joints) digest.add(of_group);
    }
    loopcal::Strided goal[] = {arrays[0], arrays[1], {T.data(), 16 * n, 16}};
    loopcal_certify(set, machine.structure.data(), machine.numbers.data(), goal, t, n, proven.data());
    digest.add(proven);
}

void add_factors(int set, int64_t t, int64_t m, int64_t p, Digest &digest) {
    Random random;
    Reals factor((size_t)(t * p * p)), rows = random.reals((size_t)(t * m * p), 10.0);
    for (size_t i = 0; i < rows.size() / 3; i++) rows[i] *= i % 3 ? 1.0 : 0.0;
    loopcal_fold(set, factor.data(), rows.data(), factor.data(), t, m, p, m * p);
    loopcal_fold(set, factor.data(), rows.data(), factor.data(), t, m / 2, p, m * p);
    digest.add(factor);
    Reals right = random.reals((size_t)(t * p), 1.0), x((size_t)(t * p)), growth((size_t)t);
    loopcal_solve_triangles(set, factor.data(), right.data(), x.data(), growth.data(), t, p);
    digest.add(x), digest.add(growth);
}

void add_comparisons(int set, int64_t n, Digest &digest) {
    Random random;
    Reals poses, references, residual((size_t)(6 * n)), by_twist((size_t)(36 * n));
    for (int64_t i = 0; i < n; i++) {
        Reals R;
        add_rotation(random, R);
        for (int row = 0; row < 3; row++) {
            poses.insert(poses.end(), R.begin() + 3 * row, R.begin() + 3 * row + 3);
            poses.push_back(random());
        }
        poses.insert(poses.end(), {0, 0, 0, 1});
        if (i % 3) R.clear(), add_rotation(random, R);
        for (int j = 3; j < 9 && i % 5 == 4; j++) R[(size_t)j] = -R[(size_t)j];  // far apart
        references.insert(references.end(), R.begin(), R.end());
        for (int axis = 0; axis < 3; axis++) references.push_back(random());
    }
    loopcal::Strided arrays[] = {{poses.data(), 0, 16}, {references.data(), 0, 12}};
    loopcal_compare_poses(set, arrays, residual.data(), by_twist.data(), 1, n);
    digest.add(residual), digest.add(by_twist);
}

void add_points(int set, int64_t n, int64_t k, Digest &digest) {
    Random random;
    Reals poses, frames = random.reals((size_t)(6 * n), 2.0), points = random.reals((size_t)(3 * n * k), 1.0);
    Reals stated, x((size_t)(3 * n * k));
    for (int64_t i = 0; i <= n; i++) {
        Reals R, &to = i < n ? poses : stated;
        add_rotation(random, R);
        for (int row = 0; row < 3; row++) {
            to.insert(to.end(), R.begin() + 3 * row, R.begin() + 3 * row + 3);
            to.push_back(random());
        }
        to.insert(to.end(), {0, 0, 0, 1});
    }
    for (bool framed : {true, false}) {
        const int64_t columns[] = {framed ? 6 : -1, framed ? 12 : 6, (framed ? 12 : 6) + 3 * k};
        Reals slopes((size_t)(3 * n * k * columns[2]));
        loopcal::Strided arrays[] = {{poses.data(), 0, 16},
                                     {framed ? frames.data() : nullptr, 0, 6},
                                     {points.data(), 0, 3 * k}};
        loopcal_locate_points(set, arrays, stated.data(), columns, x.data(), slopes.data(), 1, n, k);
        digest.add(x), digest.add(slopes);
    }
}

// Two sessions of two unknowns, with two groups of three each, in `t` trials.
void add_blocks(int set, int64_t t, int64_t height, int64_t right, Digest &digest) {
    Random random;
    const int64_t sessions[] = {0, 1, 2, 3}, none[] = {-1, -1}, session_of[] = {0, 0, 1, 1};
    const int64_t groups[] = {4, 5, 6, 0, 1, 7, 8, 9, 0, 1, 10, 11, 12, 2, 3, 13, 14, 15, 2, 3};
    const int64_t place[] = {0, 1, 2, 3}, columns[] = {0, 1, 2, 3, 4, 4, 3, 2, 1, 0, 0, 1, 2, 3, 4, 0, 1, 2, 3, 4};
    Reals inverse((size_t)(t * 44)), solution((size_t)(t * (4 * right + 12 * (2 + right))));
    double *inverses = inverse.data(), *solutions = solution.data();
    const loopcal::BlockStructure structures[] = {
        {2, 2, 2, -1, sessions, none, inverses, solutions},
        {4, 3, 5, 0, groups, session_of, inverses + 8 * t, solutions + 4 * right * t}};
    Reals by_unknowns = random.reals((size_t)(t * 4 * height * 5), 1.0);
    Reals machine = random.reals((size_t)(t * 4 * height * right), 1.0);
    const loopcal::BlockRows rows{1, 4, height, 5, place, columns, {by_unknowns.data(), 20 * height, 5},
                                  {machine.data(), 4 * height * right, right}};
    Reals factor((size_t)(t * right * right)), values((size_t)(t * 16 * right)), length((size_t)(16 * t));
    Reals explained((size_t)t);
    std::vector<int8_t> is_regular((size_t)t);
    loopcal_eliminate_blocks(set, structures, 2, &rows, 1, t, 16, right, 1e-10, factor.data(), values.data(),
                             length.data(), explained.data(), is_regular.data());
    for (const Reals *numbers : {&inverse, &solution, &factor, &values, &length, &explained})
        digest.add(*numbers);
    digest.add(is_regular);
}

}  // namespace

int main() {
    int works = 0;
    for (int set = 0; const char *name = loopcal_instruction_set(set, &works); set++) {
        if (!works) continue;
        Digest digest;
        for (bool free : {false, true})
            for (int64_t n : {1, 3, 21}) add_kinematics(set, free, 6, 13, n, digest);
        add_kinematics(set, false, 6, 1, 50, digest);
        for (const GroupShape *shapes : {SHAPES, RODS}) add_kinematics(set, true, 0, 5, 21, digest, shapes);
        for (int order : {loopcal::APART, loopcal::CHAINED, loopcal::ENDING})
            for (int64_t n : {3, 21}) add_sums(set, 5, n, order, digest);
        for (bool torsion : {false, true}) add_targets(set, 5, 45, torsion, digest);
        for (int64_t n : {1, 13, 50}) add_comparisons(set, n, digest);
        for (int64_t k : {1, 3}) add_points(set, 21, k, digest);
        for (int64_t height : {5, 40, 80}) add_blocks(set, 3, height, 9, digest);
        for (int64_t p : {1, 7, 43}) add_factors(set, 11, 50, p, digest);
        add_factors(set, 3, 1000, 7, digest);
        std::printf("%016llx %s\n", (unsigned long long)digest.value, name);
    }
}
