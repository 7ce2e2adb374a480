/* SPDX-License-Identifier: Apache-2.0 */
/* HEAD */

/* Numbers are in m, rad; a pose is the rotation by rows, then the position of the platform in the
 * base. A state is where the machine is: begin with kinematics_home, and pass the last state on, from
 * which the next solution begins. A call that fails leaves state and output as they are. */
#ifndef LOOPCAL_KINEMATICS_H
#define LOOPCAL_KINEMATICS_H

#ifdef __cplusplus
extern "C" {
#endif

enum {
    KINEMATICS_OK,
    KINEMATICS_UNREACHABLE, /* no closed loops were found near the state, or no readings for them */
    KINEMATICS_OTHER_MODE,  /* the loops close on the other side of a singularity */
    KINEMATICS_SINGULAR     /* at a singularity, or an input is not a number */
};

typedef struct {
    double body[KINEMATICS_BODIES][12], joint[KINEMATICS_JOINTS];
    int sign, bend;
} kinematics_state;

/* Set a state to the home pose. */
void kinematics_home(kinematics_state *state);

/* Find the pose at these readings of the drives. */
int kinematics_forward(const double readings[KINEMATICS_READINGS], kinematics_state *state,
                       double pose[12]);

/* Find the readings at these coordinates. */
int kinematics_inverse(const double coordinates[KINEMATICS_COORDINATES], kinematics_state *state,
                       double readings[KINEMATICS_READINGS]);

/* Write the coordinates of a pose. */
void kinematics_coordinates(const double pose[12], double coordinates[KINEMATICS_COORDINATES]);

/* Write the twist of the platform (rotation, velocity of its origin, in the base) by each reading. */
int kinematics_jacobian(const kinematics_state *state, double by_reading[6][KINEMATICS_READINGS]);

#if KINEMATICS_PARAMETERS > 0
/* Set all parameters, in SI units. No other call may run at the same time. */
void kinematics_set_parameters(const double values[KINEMATICS_PARAMETERS]);
#endif

#ifdef __cplusplus
}
#endif

#endif
#ifndef KINEMATICS_DECLARATIONS

#include <math.h>

/* Storage of the equations: `static` where a thread has a small stack and no other one calls. */
#ifndef KINEMATICS_WORK
#define KINEMATICS_WORK
#endif

#define PI 3.14159265358979323846
#define BODIES KINEMATICS_BODIES
#define JOINTS KINEMATICS_JOINTS

/* Tables that parameters move are constant, unless the file has parameters. */
#if KINEMATICS_PARAMETERS > 0
#define TABLE static
#else
#define TABLE static const
#endif

enum { DISTANCE, BALL, RIGID };
enum { X, Y, Z, PHI, THETA, PSI, ROLL, PITCHING, YAW };

/* A chain of joints from a body (-1 is the base) to another one; the rod is its last joint. */
struct limb {
    int ending, on, to, joints, link, joint, rows, row[6], driven, is_alone, is_exact;
    double length, sigma;
};

/* A reading as a sum of driven joints: offset, gain, curve, sin1, cos1, sin2, cos2; pieces of a
 * table; a triangle l^2 = level - reach cos(angle - lead). Without a reading the sum is fixed. */
struct transmission {
    double term[7], frequency, fixed, begin;
    struct triangle { double level, reach, lead, side, middle; } triangle;
    int reading, piece, pieces;
};

/* What parameters move: a link along and about its axes, or a number of the tables. */
enum { PITCH_OF_JOINT, LENGTH_OF_LIMB, TERM_OF_SUM };
struct moved_link {
    int link;
    double nominal[12], displacement[6];
};
struct moved_number {
    int what, index, term;
    double identified;
};
/* A parameter's change of axis `axis` of a moved link, or of a moved number where axis is -1. */
struct effect {
    int parameter, index, axis;
    double coefficient;
};

/* A mechanism on the platform of another one. */
struct stage {
    int parent, body, carries_end;
    double mount[12];
};

/* TABLES */

/* --- Kinematics of any closed-loop machine, from the tables above. C99; no allocation, no
 * variables outside of functions, a bounded number of steps.
 *
 * A limb is a chain link, joint, link, .., ending from the base or a body to another body. Newton's
 * method closes all limbs at once: unknown are the twists of the bodies and the joints. One step is
 * a Householder reduction of all rows; rows that cannot all close are closed by least squares. */

#define LIMIT 60      /* Newton steps of one solution */
/* A step of this length, relative to the size, is the last one. */
#define SHORT (STAYS_OPEN ? 1e-12 : 1e-9)
#define CLOSED 1e-9   /* residual of closed loops, relative to the size */
#define ROUNDING 1e-13
#define LONG 0.5      /* longest step, relative to the size */
#define WIDTH (COLUMNS + KINEMATICS_READINGS)
#define ROWS (CLOSURE_ROWS + SUMS + KINEMATICS_COORDINATES + DRIVES)
/* Weight of sums, coordinates and closed stages where other loops stay open: these hold. */
#define TIGHT (STAYS_OPEN ? 1e5 : 1.0)
#define SOFT 1e-5     /* weight of short steps of drives that the coordinates do not determine */

enum task { FORWARD, INVERSE, SLOPES };

/* What a solution is sought for: values of the sums of driven joints, or coordinates. */
struct goal {
    enum task task;
    const double *value, *shift; /* of coordinates [m]; 0 for none */
};

/* Rows of all equations, J step + residual = 0; the residual is the last column. */
struct equations {
    double row[ROWS][WIDTH];
    int rows, columns;
    int of_body[BODIES][6], of_joint[JOINTS], of_drive[DRIVES];
    double norm;
};

static double dot(const double *a, const double *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* A pose is 12 numbers: a rotation by rows, then a position. */
static void turn(const double *pose, const double *v, double *out)
{
    int i;
    for (i = 0; i < 3; i++)
        out[i] = dot(pose + 3 * i, v);
}

static void compose(const double *a, const double *b, double *out)
{
    int i, j, k;
    double p[3];
    for (i = 0; i < 3; i++)
        for (j = 0; j < 3; j++) {
            out[3 * i + j] = 0.0;
            for (k = 0; k < 3; k++)
                out[3 * i + j] += a[3 * i + k] * b[3 * k + j];
        }
    turn(a, b + 9, p);
    for (i = 0; i < 3; i++)
        out[9 + i] = p[i] + a[9 + i];
}

/* Turn a pose about its own origin by a rotation vector of the base, and shift it. */
static void move_body(double *pose, const double *twist)
{
    double angle = sqrt(dot(twist, twist)), half = 0.5 * angle, a, b, R[9], old[9];
    int i, j, k;
    a = angle > 1e-150 ? sin(angle) / angle : 1.0;
    b = angle > 1e-150 ? 0.5 * (sin(half) / half) * (sin(half) / half) : 0.5;
    for (i = 0; i < 3; i++)
        for (j = 0; j < 3; j++)
            R[3 * i + j] = b * twist[i] * twist[j];
    for (i = 0; i < 3; i++)
        R[4 * i] += cos(angle);
    for (i = 0; i < 3; i++) {
        R[3 * i + (i + 1) % 3] -= a * twist[(i + 2) % 3];
        R[3 * i + (i + 2) % 3] += a * twist[(i + 1) % 3];
    }
    for (i = 0; i < 9; i++)
        old[i] = pose[i];
    for (i = 0; i < 3; i++) {
        for (j = 0; j < 3; j++) {
            pose[3 * i + j] = 0.0;
            for (k = 0; k < 3; k++)
                pose[3 * i + j] += R[3 * i + k] * old[3 * k + j];
        }
        pose[9 + i] += twist[3 + i];
    }
}

#if KINEMATICS_PARAMETERS > 0
static double *find_number(const struct moved_number *m)
{
    switch (m->what) {
    case PITCH_OF_JOINT: return &PITCH[m->index];
    case LENGTH_OF_LIMB: return &LIMB[m->index].length;
    default: return &TRANSMISSION[m->index].term[m->term];
    }
}

void kinematics_set_parameters(const double values[KINEMATICS_PARAMETERS])
{
    double move[MOVED_LINKS + 1][6], twist[6], change; /* C has no empty arrays */
    int i, k;
    for (i = 0; i < MOVED_LINKS; i++)
        for (k = 0; k < 6; k++)
            move[i][k] = MOVED_LINK[i].displacement[k];
    for (i = 0; i < MOVED_NUMBERS; i++)
        *find_number(&MOVED_NUMBER[i]) = MOVED_NUMBER[i].identified;
    for (i = 0; i < EFFECTS; i++) {
        const struct effect *e = &EFFECT[i];
        change = e->coefficient * (values[e->parameter] - IDENTIFIED[e->parameter]);
        if (e->axis < 0)
            *find_number(&MOVED_NUMBER[e->index]) += change;
        else
            move[e->index][e->axis] += change;
    }
    for (i = 0; i < MOVED_LINKS; i++) {
        double *link = LINK[MOVED_LINK[i].link];
        for (k = 0; k < 12; k++)
            link[k] = MOVED_LINK[i].nominal[k];
        turn(MOVED_LINK[i].nominal, move[i], twist);
        turn(MOVED_LINK[i].nominal, move[i] + 3, twist + 3);
        move_body(link, twist);
    }
}
#endif

/* --- Readings of drives and the sums of driven joints that they give. */

static double transmit(int i, double r, double *slope)
{
    const struct transmission *t = &TRANSMISSION[i];
    double w = t->frequency * r, value = t->term[0] + r * (t->term[1] + r * t->term[2]);
    *slope = t->term[1] + 2.0 * r * t->term[2];
    if (t->frequency != 0.0) {
        value += t->term[3] * sin(w) + t->term[4] * cos(w);
        value += t->term[5] * sin(2.0 * w) + t->term[6] * cos(2.0 * w);
        *slope += t->frequency * (t->term[3] * cos(w) - t->term[4] * sin(w));
        *slope += 2.0 * t->frequency * (t->term[5] * cos(2.0 * w) - t->term[6] * sin(2.0 * w));
    }
#if PIECES > 0
    if (t->pieces > 0) {
        const double *piece = PIECE[t->piece], *last = PIECE[t->piece + t->pieces - 1];
        double inside = r, x, rate;
        if (inside < piece[0])
            inside = piece[0];
        if (inside > last[1])
            inside = last[1];
        while (piece != last && inside >= piece[1])
            piece += 6;
        x = inside - piece[0];
        rate = piece[4] + x * (2.0 * piece[3] + x * 3.0 * piece[2]);
        value += piece[5] + x * (piece[4] + x * (piece[3] + x * piece[2])) + rate * (r - inside);
        *slope += rate;
    }
#endif
    return value;
}

/* Return the sum that reading i gives: of a triangle the angle, NaN where it has none. */
static double read_sum(int i, const double *readings)
{
    const struct transmission *t = &TRANSMISSION[i];
    double slope, value;
    if (t->reading < 0)
        return t->fixed;
    value = transmit(i, readings[t->reading], &slope);
#if TRIANGLES
    if (t->triangle.reach > 0.0) {
        double angle = value < 0.0 ? NAN : acos((t->triangle.level - value * value) / t->triangle.reach);
        double lead = t->triangle.lead + t->triangle.side * angle - t->triangle.middle;
        value = t->triangle.middle + remainder(lead, 2.0 * PI);
    }
#endif
    return value;
}

/* Return the reading i that gives a sum, by Newton's method from `begin`; NaN where none does. */
static double find_reading(int i, double sum, double begin)
{
    const struct transmission *t = &TRANSMISSION[i];
    double r = begin, slope, step = 0.0;
    int k;
#if TRIANGLES
    if (t->triangle.reach > 0.0)
        sum = sqrt(t->triangle.level - t->triangle.reach * cos(sum - t->triangle.lead));
#endif
    if (t->term[1] != 0.0 && t->pieces == 0)
        r = (sum - t->term[0]) / t->term[1];
#if PIECES > 0
    for (k = 0; k < t->pieces; k++) {
        /* on the line between the ends of the piece that the sum lies in */
        const double *piece = PIECE[t->piece + k];
        double low = transmit(i, piece[0], &slope), high = transmit(i, piece[1], &slope);
        if ((low <= sum) != (high <= sum))
            r = piece[0] + (piece[1] - piece[0]) * (sum - low) / (high - low);
    }
#endif
    for (k = 0; k < 20; k++) {
        step = (transmit(i, r, &slope) - sum) / slope;
        r -= step;
        if (fabs(step) <= 1e-15 * (1.0 + fabs(r)))
            break;
    }
    return fabs(step) <= 1e-9 * (1.0 + fabs(r)) ? r : NAN;
}

/* --- Equations. */

static const double ORIGIN[12] = {1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0};

/* Where a limb is: rotation and position of its tip, the axis of each joint, and a point on it. */
struct chain {
    double tip[12], axis[MOST_JOINTS + 1][3], point[MOST_JOINTS + 1][3];
};

static void follow(const struct limb *limb, const kinematics_state *s, struct chain *c)
{
    const double *begin = limb->on < 0 ? ORIGIN : s->body[limb->on];
    double along[12], next[12], value, a, b;
    int i, j, k;
    compose(begin, LINK[limb->link], c->tip);
    for (j = 0; j < limb->joints; j++) {
        value = s->joint[limb->joint + j];
        for (i = 0; i < 3; i++)
            c->axis[j][i] = c->tip[3 * i + 2];
        for (k = 0; k < 12; k++)
            along[k] = c->tip[k];
        if (TURNS[limb->joint + j]) {
            for (i = 0; i < 3; i++) {
                a = cos(value) * c->tip[3 * i] + sin(value) * c->tip[3 * i + 1];
                b = cos(value) * c->tip[3 * i + 1] - sin(value) * c->tip[3 * i];
                along[3 * i] = a;
                along[3 * i + 1] = b;
                along[9 + i] += PITCH[limb->joint + j] * value * c->axis[j][i];
            }
        } else {
            for (i = 0; i < 3; i++)
                along[9 + i] += value * c->axis[j][i];
        }
        for (i = 0; i < 3; i++)
            c->point[j][i] = along[9 + i];
        compose(along, LINK[limb->link + j + 1], next);
        for (k = 0; k < 12; k++)
            c->tip[k] = next[k];
    }
}

/* Add to column `column` of a limb's rows what a turn about `axis` with the arm `arm` and a shift
 * `shift` of its attachment change, `sign` times; of its tip with -sign. */
static void add_column(struct equations *e, const struct limb *limb, int first, int column,
                       const double *gap, double sign, const double *axis, const double *arm,
                       const double *shift)
{
    double moved[3] = {0, 0, 0}, part[6];
    int i, n;
    if (column < 0)
        return;
    if (axis)
        cross(axis, arm, moved);
    for (i = 0; i < 3; i++) {
        moved[i] = sign * (moved[i] + (shift ? shift[i] : 0.0));
        part[i] = axis ? sign * SIZE * axis[i] : 0.0;
        part[3 + i] = moved[i];
    }
    if (limb->ending == DISTANCE)
        e->row[first][column] += dot(gap, moved);
    else
        for (n = 0; n < limb->rows; n++)
            e->row[first + n][column] += part[limb->row[n]];
}

static void add_twists(struct equations *e, const struct limb *limb, int first, int body,
                       const double *gap, double sign, const double *arm)
{
    double unit[3];
    int f;
    for (f = 0; f < 6; f++) {
        unit[0] = unit[1] = unit[2] = 0.0;
        unit[f % 3] = 1.0;
        add_column(e, limb, first, e->of_body[body][f], gap, sign, f < 3 ? unit : 0, arm,
                   f < 3 ? 0 : unit);
    }
}

/* Write the rows of one limb from row `first`. */
static void write_limb(struct equations *e, int number, const kinematics_state *s, int first)
{
    const struct limb *limb = &LIMB[number];
    const double *end = limb->to < 0 ? ORIGIN : s->body[limb->to], *attachment;
    double arm[3], gap[3], residual[6] = {0}, R[9], back[3], shift[3], trace, distance = 1.0;
    struct chain c;
    int i, j, k, n, column;
    follow(limb, s, &c);
    attachment = LINK[limb->link + limb->joints + 1];
    turn(end, attachment + 9, arm);
    for (i = 0; i < 3; i++)
        residual[3 + i] = gap[i] = arm[i] + end[9 + i] - c.tip[9 + i];
    if (limb->ending == DISTANCE) {
        distance = sqrt(dot(gap, gap));
        for (i = 0; i < 3; i++)
            gap[i] /= distance;
        residual[0] = distance - limb->length - s->joint[limb->joint + limb->joints];
    } else if (limb->ending == RIGID) {
        double held[12];
        compose(end, attachment, held);
        for (i = 0; i < 3; i++)
            for (j = 0; j < 3; j++)
                R[3 * i + j] = dot(held + 3 * i, c.tip + 3 * j);
        trace = 1.0 + R[0] + R[4] + R[8];
        for (i = 0; i < 3; i++) {
            j = (i + 1) % 3;
            k = (i + 2) % 3;
            residual[i] = 2.0 * SIZE * (R[3 * k + j] - R[3 * j + k]) / (trace > 1e-3 ? trace : 1e-3);
        }
    }
    for (n = 0; n < limb->rows; n++)
        e->row[first + n][COLUMNS] = residual[limb->ending == DISTANCE ? 0 : limb->row[n]];
    if (limb->to >= 0)
        add_twists(e, limb, first, limb->to, gap, 1.0, arm);
    if (limb->on >= 0) {
        for (i = 0; i < 3; i++)
            back[i] = c.tip[9 + i] - s->body[limb->on][9 + i];
        add_twists(e, limb, first, limb->on, gap, -1.0, back);
    }
    for (j = 0; j <= limb->joints; j++) {
        column = e->of_joint[limb->joint + j];
        if (column < 0)
            continue;
        if (j == limb->joints) {
            e->row[first][column] -= 1.0;
            continue;
        }
        for (i = 0; i < 3; i++) {
            back[i] = c.tip[9 + i] - c.point[j][i];
            shift[i] = (TURNS[limb->joint + j] ? PITCH[limb->joint + j] : 1.0) * c.axis[j][i];
        }
        add_column(e, limb, first, column, gap, -1.0, TURNS[limb->joint + j] ? c.axis[j] : 0, back,
                   shift);
    }
    if (limb->sigma > 0.0) {
        /* more drives than freedoms: the row in standard deviations of its drive */
        double slope = 1.0, across[3];
        j = limb->driven;
        if (j < limb->joints) {
            for (i = 0; i < 3; i++)
                back[i] = c.tip[9 + i] - c.point[j][i];
            cross(c.axis[j], back, across);
            slope = (TURNS[limb->joint + j] ? PITCH[limb->joint + j] : 1.0) * dot(gap, c.axis[j]);
            slope += TURNS[limb->joint + j] ? dot(gap, across) : 0.0;
        }
        for (j = 0; j <= COLUMNS; j++)
            e->row[first][j] /= fabs(slope) * limb->sigma;
    }
    if (STAYS_OPEN && limb->is_exact)
        for (n = 0; n < limb->rows; n++)
            for (j = 0; j <= COLUMNS; j++)
                e->row[first + n][j] *= TIGHT;
}

/* Write the base and the platform of each stage in the base of the machine. */
static void place_stages(const kinematics_state *s, double (*base)[12], double (*platform)[12])
{
    int b;
    for (b = 0; b < STAGES; b++) {
        compose(STAGE[b].parent < 0 ? ORIGIN : platform[STAGE[b].parent], STAGE[b].mount, base[b]);
        compose(base[b], s->body[STAGE[b].body], platform[b]);
    }
}

/* Write how coordinate n of a pose differs from `wanted` [m], and its slope by a twist (6). */
static double compare(int n, const double *pose, const double *wanted, double *slope)
{
    const int name = COORDINATE[n];
    int i;
    for (i = 0; i < 6; i++)
        slope[i] = 0.0;
    if (name < 3) {
        slope[3 + name] = 1.0;
        return pose[9 + name] - wanted[n];
    }
    if (name == PHI || name == THETA) {
        /* the components of the platform's normal across the wanted normal: regular at no tilt */
        double phi = wanted[PLACE_OF_PHI], theta = wanted[PLACE_OF_THETA];
        double across[3], normal[3], turned[3];
        across[0] = name == PHI ? cos(theta) * cos(phi) : -sin(phi);
        across[1] = name == PHI ? cos(theta) * sin(phi) : cos(phi);
        across[2] = name == PHI ? -sin(theta) : 0.0;
        for (i = 0; i < 3; i++)
            normal[i] = pose[3 * i + 2];
        cross(normal, across, turned);
        for (i = 0; i < 3; i++)
            slope[i] = SIZE * turned[i];
        return SIZE * dot(across, normal);
    }
    if (name == PSI) {
        for (i = 0; i < 3; i++)
            slope[i] = SIZE * (pose[3 * i + 2] + (i == 2)) / (1.0 + pose[8]);
        return SIZE * remainder(atan2(pose[3] - pose[1], pose[0] + pose[4]) - wanted[n], 2.0 * PI);
    } else {
        double pitch = atan2(-pose[6], hypot(pose[7], pose[8])), yaw = atan2(pose[3], pose[0]);
        double angle;
        if (name == ROLL) {
            angle = atan2(pose[7], pose[8]);
            slope[0] = SIZE * cos(yaw) / cos(pitch);
            slope[1] = SIZE * sin(yaw) / cos(pitch);
        } else if (name == PITCHING) {
            angle = pitch;
            slope[0] = -SIZE * sin(yaw);
            slope[1] = SIZE * cos(yaw);
        } else {
            angle = yaw;
            slope[0] = SIZE * cos(yaw) * tan(pitch);
            slope[1] = SIZE * sin(yaw) * tan(pitch);
            slope[2] = SIZE;
        }
        return SIZE * remainder(angle - wanted[n], 2.0 * PI);
    }
}

/* Write the coordinates of the machine at this state minus the wanted ones, from row `row`. */
static void write_coordinates(struct equations *e, const kinematics_state *s, int row,
                              struct goal goal)
{
    double base[STAGES][12], platform[STAGES][12], slope[6], arm[3], twist[6], part[3], unit[3];
    const double *end = platform[STAGES - 1];
    int n, b, f, i, column;
    place_stages(s, base, platform);
    for (n = 0; n < KINEMATICS_COORDINATES; n++) {
        e->row[row + n][COLUMNS] = compare(n, end, goal.value, slope);
        if (goal.shift)
            e->row[row + n][COLUMNS] += goal.shift[n];
        for (b = 0; b < STAGES; b++) {
            if (!STAGE[b].carries_end)
                continue;
            for (i = 0; i < 3; i++)
                arm[i] = end[9 + i] - platform[b][9 + i];
            for (f = 0; f < 6; f++) {
                column = e->of_body[STAGE[b].body][f];
                if (column < 0)
                    continue;
                unit[0] = unit[1] = unit[2] = 0.0;
                unit[f % 3] = 1.0;
                turn(base[b], unit, f < 3 ? twist : twist + 3);
                if (f < 3) {
                    cross(twist, arm, part);
                    for (i = 0; i < 3; i++)
                        twist[3 + i] = part[i];
                } else {
                    twist[0] = twist[1] = twist[2] = 0.0;
                }
                e->row[row + n][column] += dot(slope, twist) + dot(slope + 3, twist + 3);
            }
        }
        for (i = 0; i <= COLUMNS; i++)
            e->row[row + n][i] *= TIGHT;
    }
}

#if PLATFORM_IS_GIVEN
/* Set the coordinates of a pose; angles that are not among them are zero, and without any angle the
 * rotation stays. */
static void set_platform(double *pose, const double *coordinates)
{
    double angle[YAW + 1] = {0}, first, second, third;
    int n, i, has_turns = 0, has_tilt = 0;
    for (n = 0; n < KINEMATICS_COORDINATES; n++)
        if (COORDINATE[n] < 3) {
            pose[9 + COORDINATE[n]] = coordinates[n];
        } else {
            angle[COORDINATE[n]] = coordinates[n];
            has_turns = 1;
            has_tilt |= COORDINATE[n] <= PSI;
        }
    if (!has_turns)
        return;
    /* R = Rz(first) Ry(second) R(third) with the last turn about x, of a torsion about z */
    first = angle[has_tilt ? PHI : YAW];
    second = angle[has_tilt ? THETA : PITCHING];
    third = has_tilt ? angle[PSI] - first : angle[ROLL];
    {
        const double x[3] = {cos(first) * cos(second), sin(first) * cos(second), -sin(second)};
        const double y[3] = {-sin(first), cos(first), 0.0};
        const double z[3] = {cos(first) * sin(second), sin(first) * sin(second), cos(second)};
        for (i = 0; i < 3; i++) {
            pose[3 * i] = has_tilt ? cos(third) * x[i] + sin(third) * y[i] : x[i];
            pose[3 * i + 1] = cos(third) * y[i] + sin(third) * (has_tilt ? -x[i] : z[i]);
            pose[3 * i + 2] = has_tilt ? z[i] : cos(third) * z[i] - sin(third) * y[i];
        }
    }
}
#endif

/* Number the unknowns of a task. */
static void number_unknowns(struct equations *e, enum task task)
{
    int body, f, j, d;
    e->columns = 0;
    for (body = 0; body < BODIES; body++)
        for (f = 0; f < 6; f++) {
            int is_given = task == INVERSE && PLATFORM_IS_GIVEN && body == STAGE[STAGES - 1].body;
            e->of_body[body][f] = MOVES[body][f] && !is_given ? e->columns++ : -1;
        }
    for (d = 0; d < DRIVES; d++)
        e->of_drive[d] = task != FORWARD || HAS_SUMS ? e->columns++ : -1;
    for (j = 0; j < JOINTS; j++) {
        if (DRIVE[j] >= 0)
            e->of_joint[j] = e->of_drive[DRIVE[j]];
        else
            e->of_joint[j] = PASSIVE[j] ? e->columns++ : -1;
    }
}

static void write_equations(struct equations *e, const kinematics_state *s, struct goal goal)
{
    double square = 0.0;
    int i, j, limb;
    number_unknowns(e, goal.task);
    for (i = 0; i < ROWS; i++)
        for (j = 0; j <= COLUMNS; j++)
            e->row[i][j] = 0.0;
    e->rows = 0;
    for (limb = 0; limb < LIMBS; limb++) {
        write_limb(e, limb, s, e->rows);
        e->rows += LIMB[limb].rows;
    }
    for (i = 0; i < SUMS; i++) {
        int is_fixed = TRANSMISSION[i].reading < 0;
        if (goal.task == FORWARD ? !HAS_SUMS : goal.task == INVERSE && !is_fixed)
            continue;
        e->row[e->rows][COLUMNS] = goal.task == INVERSE ? -TRANSMISSION[i].fixed : -goal.value[i];
        for (j = 0; j < DRIVES; j++) {
            e->row[e->rows][e->of_drive[j]] = TIGHT * TRUST[i] * WEIGHT[i][j];
            e->row[e->rows][COLUMNS] += WEIGHT[i][j] * s->joint[JOINT_OF_DRIVE[j]];
        }
        e->row[e->rows][COLUMNS] *= TIGHT * TRUST[i];
        e->rows++;
    }
    if (goal.task == INVERSE && !PLATFORM_IS_GIVEN) {
        write_coordinates(e, s, e->rows, goal);
        e->rows += KINEMATICS_COORDINATES;
    }
    if (goal.task == INVERSE && HAS_SPARE_DRIVES)
        for (i = 0; i < DRIVES; i++)
            e->row[e->rows++][e->of_drive[i]] = SOFT * SIZE / SPAN[i];
    for (i = 0; i < e->rows; i++)
        square += e->row[i][COLUMNS] * e->row[i][COLUMNS];
    e->norm = sqrt(square);
}

/* Reduce rows to an upper triangle of `columns` columns by Householder reflections, those on the
 * right with them; return the sign of its determinant. */
static int triangularize(double (*a)[WIDTH], int rows, int columns, int right)
{
    double square, head, scale, sum;
    int i, j, k, sign = 1;
    for (k = 0; k < columns && k < rows; k++) {
        square = 0.0;
        for (i = k + 1; i < rows; i++)
            square += a[i][k] * a[i][k];
        if (square > 0.0) {
            head = a[k][k];
            scale = sqrt(head * head + square);
            if (head > 0.0)
                scale = -scale;
            a[k][k] = head - scale; /* the reflection's vector stands below the diagonal */
            for (j = k + 1; j < right; j++) {
                sum = 0.0;
                for (i = k; i < rows; i++)
                    sum += a[i][k] * a[i][j];
                sum /= scale * a[k][k];
                for (i = k; i < rows; i++)
                    a[i][j] += sum * a[i][k];
            }
            a[k][k] = scale;
            sign = -sign;
        }
        if (!(a[k][k] > 0.0))
            sign = -sign;
    }
    return sign;
}

/* Find the step; return the part of the residual that it removes, negative where the equations are
 * singular or not finite. */
static double find_step(struct equations *e, double *step)
{
    double square = 0.0, largest = 0.0, smallest = HUGE_VAL, size;
    int i, j, n = e->columns;
    for (i = 0; i < e->rows; i++)
        e->row[i][n] = e->row[i][COLUMNS];
    triangularize(e->row, e->rows, n, n + 1);
    for (i = 0; i < n; i++) {
        square += e->row[i][n] * e->row[i][n];
        size = fabs(e->row[i][i]);
        largest = size > largest ? size : largest;
        smallest = size < smallest ? size : smallest;
    }
    if (!(smallest > 1e-14 * largest) || !(square < HUGE_VAL))
        return -1.0;
    for (i = n - 1; i >= 0; i--) {
        step[i] = -e->row[i][n];
        for (j = i + 1; j < n; j++)
            step[i] -= e->row[i][j] * step[j];
        step[i] /= e->row[i][i];
    }
    return sqrt(square);
}

/* --- Solutions. */

/* Move a state by a share of a step; return the length of the whole step [m]. */
static double move_state(const struct equations *e, const double *step, double share,
                         kinematics_state *s)
{
    double twist[6], length = 0.0, part;
    int body, f, j;
    for (body = 0; body < BODIES; body++) {
        for (f = 0; f < 6; f++) {
            twist[f] = e->of_body[body][f] < 0 ? 0.0 : step[e->of_body[body][f]];
            part = fabs(twist[f]) * (f < 3 ? SIZE : 1.0);
            length = part > length ? part : length;
            twist[f] *= share;
        }
        move_body(s->body[body], twist);
    }
    for (j = 0; j < JOINTS; j++)
        if (e->of_joint[j] >= 0) {
            part = fabs(step[e->of_joint[j]]) * (TURNS[j] ? SIZE : 1.0);
            length = part > length ? part : length;
            s->joint[j] += share * step[e->of_joint[j]];
        }
    return length;
}

/* Set the platforms of stages without loops, which follow from the joints. */
static void place_serial_stages(kinematics_state *s)
{
    int limb, i, j;
    for (limb = 0; limb < LIMBS; limb++)
        if (LIMB[limb].is_alone) {
            struct chain c;
            const double *held = LINK[LIMB[limb].link + LIMB[limb].joints + 1];
            double inverse[12];
            follow(&LIMB[limb], s, &c);
            for (i = 0; i < 3; i++) {
                inverse[9 + i] = 0.0;
                for (j = 0; j < 3; j++) {
                    inverse[3 * i + j] = held[3 * j + i];
                    inverse[9 + i] -= held[3 * j + i] * held[9 + j];
                }
            }
            compose(c.tip, inverse, s->body[LIMB[limb].to]);
        }
}

/* Newton's method with step control from a state, which is changed. */
static int solve(struct goal goal, kinematics_state *s)
{
    KINEMATICS_WORK struct equations now, next;
    kinematics_state trial;
    double step[COLUMNS + 1], ignored[COLUMNS + 1], share = 1.0, length, fraction, removed, left;
    int k;
    if (goal.task == FORWARD && !HAS_SUMS)
        for (k = 0; k < JOINTS; k++)
            if (DRIVE[k] >= 0)
                s->joint[k] = goal.value[DRIVE[k]];
#if PLATFORM_IS_GIVEN
    if (goal.task == INVERSE)
        set_platform(s->body[STAGE[STAGES - 1].body], goal.value);
#endif
    place_serial_stages(s);
    write_equations(&now, s, goal);
    removed = find_step(&now, step);
    for (k = 0; k < LIMIT; k++) {
        if (removed < 0.0 || !(now.norm < HUGE_VAL))
            return KINEMATICS_SINGULAR;
        trial = *s;
        length = move_state(&now, step, 0.0, &trial);
        fraction = share * (length > LONG * SIZE ? LONG * SIZE / length : 1.0);
        trial = *s;
        move_state(&now, step, fraction, &trial);
        place_serial_stages(&trial);
        write_equations(&next, &trial, goal);
        if (fraction * length <= SHORT * SIZE && share == 1.0) {
            if (!(next.norm <= CLOSED * SIZE) && !MAY_STAY_OPEN)
                return KINEMATICS_UNREACHABLE;
            *s = trial;
            return KINEMATICS_OK;
        }
        left = find_step(&next, ignored);
        if (next.norm <= (1.0 - 1e-4 * fraction) * now.norm || (left >= 0.0 && left <= 0.5 * removed)
            || (left >= 0.0 && left <= TIGHT * ROUNDING * SIZE)) {
            int i;
            *s = trial;
            now = next;
            removed = left;
            for (i = 0; i < now.columns; i++)
                step[i] = ignored[i];
            share = share > 0.25 ? 1.0 : 4.0 * share;
        } else {
            share *= 0.25;
            if (share < 1e-5)
                return KINEMATICS_UNREACHABLE;
        }
    }
    return KINEMATICS_UNREACHABLE;
}

/* Return the sign of the determinant of a task's equations, which changes at singularities only;
 * 0 where they are not square. */
static int find_sign(enum task task, const kinematics_state *s)
{
    static const double any[SUMS + KINEMATICS_COORDINATES + KINEMATICS_READINGS] = {0};
    KINEMATICS_WORK struct equations e;
    struct goal goal;
    goal.task = task;
    goal.value = any;
    goal.shift = 0;
    write_equations(&e, s, goal);
    return e.rows == e.columns ? triangularize(e.row, e.rows, e.columns, e.columns) : 0;
}

/* Solve from a state; where that fails, along the straight path of values from `begin`. */
static int solve_along(enum task task, const double *begin, const double *end, int count,
                       const int *turns, kinematics_state *s)
{
    double via[SUMS + KINEMATICS_COORDINATES], change;
    int parts, k, i, status = KINEMATICS_UNREACHABLE;
    struct goal goal;
    goal.task = task;
    goal.value = via;
    goal.shift = 0;
    for (parts = 1; parts <= 64; parts *= 8) {
        kinematics_state now = *s;
        for (k = 1; k <= parts; k++) {
            for (i = 0; i < count; i++) {
                change = end[i] - begin[i];
                if (turns && turns[i])
                    change = remainder(change, 2.0 * PI);
                via[i] = k == parts ? end[i] : begin[i] + change * k / parts;
            }
            status = solve(goal, &now);
            if (status != KINEMATICS_OK)
                break;
        }
        if (status == KINEMATICS_OK && find_sign(FORWARD, &now) != s->sign)
            status = KINEMATICS_OTHER_MODE;
        if (status == KINEMATICS_OK && PLATFORM_IS_GIVEN && find_sign(INVERSE, &now) != s->bend)
            status = KINEMATICS_OTHER_MODE;
        if (status == KINEMATICS_OK) {
            now.sign = s->sign;
            now.bend = s->bend;
            *s = now;
            break;
        }
    }
    return status;
}

static void read_state(const kinematics_state *s, double *sums, double *coordinates)
{
    double base[STAGES][12], platform[STAGES][12];
    int i, j;
    for (i = 0; i < SUMS; i++) {
        sums[i] = 0.0;
        for (j = 0; j < DRIVES; j++)
            sums[i] += WEIGHT[i][j] * s->joint[JOINT_OF_DRIVE[j]];
    }
    place_stages(s, base, platform);
    kinematics_coordinates(platform[STAGES - 1], coordinates);
}

/* Return the change of a sum by its reading. */
static double differentiate_sum(int i, double sum, double reading)
{
    double slope, value = transmit(i, reading, &slope);
#if TRIANGLES
    const struct transmission *t = &TRANSMISSION[i];
    if (t->triangle.reach > 0.0)
        return slope * 2.0 * value / (t->triangle.reach * sin(sum - t->triangle.lead));
#endif
    (void)value;
    (void)sum;
    return slope;
}

/* Find the readings of sums; return 0 where there are none. */
static int find_readings(const double *sums, double *readings)
{
    double found;
    int i;
    for (i = 0; i < SUMS; i++)
        if (TRANSMISSION[i].reading >= 0) {
            found = find_reading(i, sums[i], TRANSMISSION[i].begin);
            if (!(fabs(found) < HUGE_VAL))
                return 0;
            readings[TRANSMISSION[i].reading] = found;
        }
    return 1;
}

#if STAYS_OPEN
/* Change the coordinates sought until the readings found lead to the wanted ones: with readings
 * held, loops that stay open rest elsewhere than with readings free. */
static int lead_to(const double *wanted, kinematics_state *s)
{
    double sums[SUMS], shift[KINEMATICS_COORDINATES] = {0}, slope[6], change, worst, before = HUGE_VAL;
    double base[STAGES][12], platform[STAGES][12], ignored[KINEMATICS_COORDINATES];
    struct goal forward, inverse;
    int n;
    forward.task = FORWARD;
    forward.value = sums;
    forward.shift = 0;
    inverse.task = INVERSE;
    inverse.value = wanted;
    inverse.shift = shift;
    for (;; before = worst) {
        kinematics_state driven = *s;
        read_state(s, sums, ignored);
        if (solve(forward, &driven) != KINEMATICS_OK)
            return KINEMATICS_UNREACHABLE;
        place_stages(&driven, base, platform);
        worst = 0.0;
        for (n = 0; n < KINEMATICS_COORDINATES; n++) {
            change = compare(n, platform[STAGES - 1], wanted, slope);
            shift[n] += change;
            worst = fabs(change) > worst ? fabs(change) : worst;
        }
        if (worst <= ROUNDING * SIZE || !(worst < 0.5 * before)) {
            *s = driven;
            return worst <= CLOSED * SIZE ? KINEMATICS_OK : KINEMATICS_UNREACHABLE;
        }
        if (solve(inverse, s) != KINEMATICS_OK)
            return KINEMATICS_UNREACHABLE;
    }
}

/* Replace derivatives that neglect the gaps of open loops by differences, scaled by them. */
static int differentiate_open(const kinematics_state *s, const double *sums,
                              double by_reading[6][KINEMATICS_READINGS])
{
    double readings[KINEMATICS_READINGS] = {0}, pose[2][12], turned[3][3], step, largest, held;
    int r, f, i, j, k;
    if (!find_readings(sums, readings))
        return KINEMATICS_SINGULAR;
    for (r = 0; r < KINEMATICS_READINGS; r++) {
        largest = 0.0;
        for (f = 0; f < 6; f++)
            largest = fmax(largest, fabs(by_reading[f][r]) * (f < 3 ? SIZE : 1.0));
        if (largest == 0.0)
            continue;
        step = 1e-4 * SIZE / largest;
        held = readings[r];
        for (k = 0; k < 2; k++) {
            kinematics_state near = *s;
            readings[r] = held + (k ? step : -step);
            if (kinematics_forward(readings, &near, pose[k]) != KINEMATICS_OK)
                return KINEMATICS_SINGULAR;
        }
        readings[r] = held;
        for (i = 0; i < 3; i++)
            for (j = 0; j < 3; j++)
                turned[i][j] = dot(pose[1] + 3 * i, pose[0] + 3 * j);
        for (i = 0; i < 3; i++) {
            j = (i + 1) % 3;
            k = (i + 2) % 3;
            by_reading[i][r] = 0.5 * (turned[k][j] - turned[j][k]) / (2.0 * step);
            by_reading[3 + i][r] = (pose[1][9 + i] - pose[0][9 + i]) / (2.0 * step);
        }
    }
    return KINEMATICS_OK;
}
#endif

int kinematics_jacobian(const kinematics_state *s, double by_reading[6][KINEMATICS_READINGS])
{
    double sums[SUMS], coordinates[KINEMATICS_COORDINATES], twist[6], part[3];
    double base[STAGES][12], platform[STAGES][12];
    KINEMATICS_WORK struct equations e;
    struct goal goal;
    int i, j, k, r, b, f, n, first;
    read_state(s, sums, coordinates);
    goal.task = SLOPES;
    goal.value = sums;
    goal.shift = 0;
    write_equations(&e, s, goal);
    n = e.columns;
    first = e.rows - SUMS;
    for (i = 0; i < e.rows; i++)
        for (r = 0; r < KINEMATICS_READINGS; r++)
            e.row[i][n + r] = 0.0;
    for (i = 0; i < SUMS; i++) {
        const struct transmission *t = &TRANSMISSION[i];
        if (t->reading >= 0)
            e.row[first + i][n + t->reading] =
                TIGHT * TRUST[i] * differentiate_sum(i, sums[i], find_reading(i, sums[i], t->begin));
    }
    triangularize(e.row, e.rows, n, n + KINEMATICS_READINGS);
    place_stages(s, base, platform);
    for (r = 0; r < KINEMATICS_READINGS; r++) {
        for (i = n - 1; i >= 0; i--) {
            for (j = i + 1; j < n; j++)
                e.row[i][n + r] -= e.row[i][j] * e.row[j][n + r];
            e.row[i][n + r] /= e.row[i][i];
            if (!(fabs(e.row[i][n + r]) < HUGE_VAL))
                return KINEMATICS_SINGULAR;
        }
        for (f = 0; f < 6; f++)
            by_reading[f][r] = 0.0;
        for (b = 0; b < STAGES; b++) {
            if (!STAGE[b].carries_end)
                continue;
            for (f = 0; f < 6; f++) {
                k = e.of_body[STAGE[b].body][f];
                twist[f] = k < 0 ? 0.0 : e.row[k][n + r];
            }
            turn(base[b], twist, part);
            for (i = 0; i < 3; i++)
                by_reading[i][r] += part[i];
            for (i = 0; i < 3; i++)
                twist[i] = platform[STAGES - 1][9 + i] - platform[b][9 + i];
            for (i = 0; i < 3; i++)
                by_reading[3 + i][r] += part[(i + 1) % 3] * twist[(i + 2) % 3]
                    - part[(i + 2) % 3] * twist[(i + 1) % 3] + dot(base[b] + 3 * i, twist + 3);
        }
    }
#if STAYS_OPEN
    return differentiate_open(s, sums, by_reading);
#else
    return KINEMATICS_OK;
#endif
}

void kinematics_home(kinematics_state *s)
{
    *s = HOME;
    s->sign = find_sign(FORWARD, s);
    s->bend = find_sign(INVERSE, s);
}

void kinematics_coordinates(const double pose[12], double coordinates[KINEMATICS_COORDINATES])
{
    int n;
    for (n = 0; n < KINEMATICS_COORDINATES; n++)
        switch (COORDINATE[n]) {
        case ROLL: coordinates[n] = atan2(pose[7], pose[8]); break;
        case PITCHING: coordinates[n] = atan2(-pose[6], hypot(pose[7], pose[8])); break;
        case YAW: coordinates[n] = atan2(pose[3], pose[0]); break;
        case PHI: coordinates[n] = atan2(pose[5], pose[2]); break;
        case THETA: coordinates[n] = atan2(hypot(pose[2], pose[5]), pose[8]); break;
        case PSI: coordinates[n] = atan2(pose[3] - pose[1], pose[0] + pose[4]); break;
        default: coordinates[n] = pose[9 + COORDINATE[n]]; break;
        }
}

int kinematics_forward(const double readings[KINEMATICS_READINGS], kinematics_state *s,
                       double pose[12])
{
    double begin[SUMS], end[SUMS], coordinates[KINEMATICS_COORDINATES];
    double base[STAGES][12], platform[STAGES][12];
    kinematics_state now = *s;
    int i, j, status;
    read_state(s, begin, coordinates);
    for (i = 0; i < SUMS; i++) {
        end[i] = read_sum(i, readings);
        if (!(fabs(end[i]) < HUGE_VAL))
            return KINEMATICS_UNREACHABLE;
    }
    status = solve_along(FORWARD, begin, end, SUMS, 0, &now);
    if (status != KINEMATICS_OK)
        return status;
    *s = now;
    place_stages(s, base, platform);
    for (i = 0, j = STAGES - 1; i < 12; i++)
        pose[i] = platform[j][i];
    return status;
}

int kinematics_inverse(const double coordinates[KINEMATICS_COORDINATES], kinematics_state *s,
                       double readings[KINEMATICS_READINGS])
{
    double sums[SUMS], begin[KINEMATICS_COORDINATES], found[KINEMATICS_READINGS] = {0};
    kinematics_state now = *s;
    int i, n, status, turns[KINEMATICS_COORDINATES];
    for (n = 0; n < KINEMATICS_COORDINATES; n++) {
        turns[n] = COORDINATE[n] >= 3;
        if (!(fabs(coordinates[n]) < HUGE_VAL))
            return KINEMATICS_UNREACHABLE;
    }
    read_state(s, sums, begin);
    status = solve_along(INVERSE, begin, coordinates, KINEMATICS_COORDINATES, turns, &now);
#if STAYS_OPEN
    if (status == KINEMATICS_OK)
        status = lead_to(coordinates, &now);
#endif
    if (status != KINEMATICS_OK)
        return status;
    read_state(&now, sums, begin);
    if (!find_readings(sums, found))
        return KINEMATICS_UNREACHABLE;
    for (i = 0; i < KINEMATICS_READINGS; i++)
        readings[i] = found[i];
    *s = now;
    return status;
}

#ifdef KINEMATICS_TEST
#include <stdio.h>

/* TESTS */

/* Return the largest difference of n numbers. */
static double differ(const double *a, const double *b, int n)
{
    double worst = 0.0;
    int i;
    for (i = 0; i < n; i++)
        if (!(fabs(a[i] - b[i]) <= worst))
            worst = fabs(a[i] - b[i]);
    return worst;
}

int main(void)
{
    double readings[KINEMATICS_READINGS], pose[12], slopes[6][KINEMATICS_READINGS];
    const double nothing[KINEMATICS_READINGS] = {0};
    double gap, largest = 0.0, worst = 0.0, of_slopes = 0.0;
    int n, i, failed = 0;
    for (n = 0; n < TESTS; n++) {
        kinematics_state s;
        kinematics_home(&s);
        if (kinematics_inverse(TEST_COORDINATES[n], &s, readings) != KINEMATICS_OK
            || kinematics_forward(readings, &s, pose) != KINEMATICS_OK) {
            failed++;
            continue;
        }
        gap = differ(pose, TEST_POSES[n], 12);
        worst = gap > worst ? gap : worst;
        kinematics_home(&s);
        if (kinematics_forward(TEST_READINGS[n], &s, pose) != KINEMATICS_OK
            || kinematics_jacobian(&s, slopes) != KINEMATICS_OK) {
            failed++;
            continue;
        }
        gap = differ(pose, TEST_POSES[n], 12);
        worst = gap > worst ? gap : worst;
        for (i = 0; i < 6; i++) {
            gap = differ(slopes[i], TEST_SLOPES[n][i], KINEMATICS_READINGS);
            of_slopes = gap > of_slopes ? gap : of_slopes;
            gap = differ(slopes[i], nothing, KINEMATICS_READINGS);
            largest = gap > largest ? gap : largest;
        }
    }
    printf("%d poses, %d failed; differences at most %.1e of poses, %.1e of derivatives\n", TESTS,
           failed, worst, of_slopes / largest);
    return failed > 0 || !(worst <= AGREEMENT) || !(of_slopes <= AGREEMENT_OF_SLOPES * largest);
}
#endif
#endif
