# SPDX-License-Identifier: Apache-2.0
"""Classify directions that the data do not determine by what they do to poses: nothing, a motion of
the base or platform frame, or a change of poses.

A direction n moves the platform by the twist D(x) n at the pose x. It is a motion of the base frame
where it equals (w, c + w x t) for one w and c at all poses, and one of the platform frame where it
equals (R w, R c). Such a direction is a gauge freedom: it changes no dimension of the machine, only
where its frames are placed. The poses are some of the stated workspace, and some about home. All
statements on undetermined combinations follow from this one place. Bodies beside the platform, such
as the other finger of a gripper, are outputs as well: what moves none but them is named with them.
See docs/theory/observability.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.estimate.free_parameters import Combination, FreeParameters
from loopcal.estimate.information import frame_twists
from loopcal.estimate.linearization import spread_states
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.simulation import draw_conditions
from loopcal.mechanism.actuation import solve_at_pose
from loopcal.mechanism.chains import locate_bodies
from loopcal.mechanism.kinematics import compute_readings, find_directly_reachable, forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_bodies, differentiate_pose
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import check_limits, draw_coordinates, workspace_ranges
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

# Poses at which motions are compared, in the workspace and about home each: 144 equations for the
# 12 numbers of two frames and the directions in question.
PROBES = 24
# Range of the readings of the poses about home to each side, in robot sizes and radians.
SPREAD_LENGTH, SPREAD_ANGLE = 0.05, 0.1
# Shares of this range that are tried, until half of the poses are reached.
SHARES = (1.0, 0.1, 0.01)
# Share of the motion by all parameters below which a motion counts as none: the square root of
# double rounding.
NO_MOTION = 1e-8
# Share of the motions by its single parameters up to which the motion of a combination is none, or
# is that of a frame. Null directions of the last linearization, at the values after the last step,
# leave 1e-10 or less in complete models; of spreads of 0.1 mm this share is 0.1 nm.
SAME_MOTION = 1e-6


@dataclass(frozen=True, eq=False)
class GaugeFreedoms:
    """Effect of the unobservable directions on poses."""

    frames: tuple[str, ...] = ()  # names of the moved frames: (), ("base",), ("platform",) or both
    count: int = 0  # number of independent combinations that move frames, and nothing else
    # (12, g) motions of the two frames by these combinations, in the units of
    # `loopcal.estimate.information.frame_twists`, each of length one
    motions: FloatArray = field(default_factory=lambda: np.zeros((12, 0)))
    has_scale: bool = False  # whether a further combination enlarges all poses by one factor
    still: int = 0  # number of independent combinations that change no pose
    changing: int = 0  # number of the others, which change poses relative to both frames
    # rotation [rad] and displacement of the tool [m] by the latter after the best fit of both
    # frames: root mean square over poses, where every parameter deviates by its spread
    effect: tuple[float, float] = (0.0, 0.0)
    where: str = "the workspace"  # or "poses about home", where the robot states no workspace
    # number of independent combinations that change no pose of the platform but move other bodies,
    # beside their own frames, and these bodies
    moving: int = 0
    bodies: tuple[str, ...] = ()


class SampledMotions(NamedTuple):
    """Poses T (n, 4, 4), and their twists D (n, 6, p) by all parameters [per SI]."""

    T: FloatArray
    D: FloatArray
    in_workspace: int  # number of the poses in the stated workspace, which are the last ones
    bodies: Mapping[str, tuple[FloatArray, FloatArray]]  # the same of every other body


@lru_cache(maxsize=2)  # a report asks several times for one calibrated robot
def sample_motions(robot: Mechanism) -> SampledMotions:
    """Return motions of a robot about home, and in its workspace where the robot states one."""
    T, D = observe_motions(robot, first := _vary(robot, probe_readings(robot)))
    try:
        ranges = workspace_ranges(robot)
    except MechanismError:
        return SampledMotions(T, D, 0, observe_bodies(robot, first))
    drawn = draw_coordinates(np.random.default_rng(0), robot.controlled, ranges, PROBES)
    solution = inverse(robot, drawn)
    allowed = check_limits(robot, robot.values[None], solution.q[None], solution.state)[0][0]
    inside = _vary(robot, solution.q[solution.converged & allowed])
    workspace = observe_motions(robot, inside)
    return SampledMotions(
        np.concatenate([T, workspace[0]]),
        np.concatenate([D, workspace[1]]),
        len(workspace[0]),
        observe_bodies(robot, np.concatenate([first, inside])),
    )


def _vary(robot: Mechanism, readings: FloatArray) -> FloatArray:
    """Return readings (n, 2 a) at conditions from their ranges, with drawn directions of approach:
    what shows only there, such as a compliance or a backlash, changes poses, too.
    """
    sides = np.random.default_rng(0).choice((-1.0, 1.0), readings.shape)
    return np.concatenate([draw_conditions(robot, readings, 0), sides], axis=1)


class WeighedMotions(NamedTuple):
    """Motions at sampled poses, rotations times the robot's size, see `weigh_motions`."""

    sample: SampledMotions
    by_parameters: FloatArray  # (6 n, p) in spreads
    base: FloatArray  # (6 n, 6) by the base frame
    platform: FloatArray  # (6 n, 6) by the platform frame
    # (p,) length of the motion by each parameter, at least the median: the scale of combinations
    scale: FloatArray


def _weigh(robot: Mechanism, places: IntArray, unit: FloatArray) -> WeighedMotions:
    """Return motions by the parameters at places (p,) of the table, in a unit (p,)."""
    sample = sample_motions(robot)
    twists = sample.D[:, :, places] * unit
    motions, base, platform = weigh_motions(sample.T, robot.size, twists)
    own = np.linalg.norm(motions, axis=0)
    floor = np.median(own[own > NO_MOTION * own.max(initial=0.0)]) if own.any() else 1.0
    return WeighedMotions(sample, motions, base, platform, np.maximum(own, floor))


def find_gauge_freedoms(
    robot: Mechanism, places: IntArray, unit: FloatArray, null: FloatArray
) -> GaugeFreedoms:
    """Classify independent directions (p, d) that data do not determine, of the parameters at
    places (p,) of the table, in a unit (p,).

    Without a pose that the robot reaches all of them count as changing poses, by an unknown effect.
    """
    if null.shape[1] == 0:
        return GaugeFreedoms()
    weighed = _weigh(robot, places, unit)
    T = weighed.sample.T
    if not len(T):
        return GaugeFreedoms(changing=null.shape[1], effect=(np.nan, np.nan))
    base, platform = weighed.base, weighed.platform
    # in this basis, a combination of length one is made of motions of length one by its parameters
    basis = np.linalg.qr(weighed.scale[:, None] * null)[0]
    moved = (weighed.by_parameters / weighed.scale) @ basis
    rest = _without_span([base, platform], moved)
    _, s, vt = np.linalg.svd(np.linalg.qr(rest, mode="r"))
    changing = int((s > SAME_MOTION).sum())
    _, s, combine = np.linalg.svd(moved @ vt[changing:].T, full_matrices=False)
    moving = moved @ vt[changing:].T @ combine[s > SAME_MOTION].T
    count = moving.shape[1]
    beside, bodies = _find_moved_bodies(robot, weighed, places, unit, null)
    frames = find_moving_frames(moving, base, platform, SAME_MOTION) if count else ()
    motion = np.linalg.lstsq(np.concatenate([base, platform], axis=1), moving, rcond=NO_MOTION)[0]
    growth = np.zeros((len(T), 6, 1))
    growth[:, 3:, 0] = T[:, :3, 3]
    grown = _without_span([base, platform, growth.reshape(-1, 1)], moved)
    with_scale = int((np.linalg.svd(grown, compute_uv=False) > SAME_MOTION).sum())
    return GaugeFreedoms(
        frames,
        count,
        motion / np.linalg.norm(motion, axis=0),
        has_scale=with_scale < changing,
        still=null.shape[1] - changing - count,
        changing=changing,
        effect=_measure_effect(robot, weighed, null) if changing else (0.0, 0.0),
        where="the workspace" if weighed.sample.in_workspace else "poses about home",
        moving=beside,
        bodies=bodies,
    )


def _find_moved_bodies(
    robot: Mechanism, weighed: WeighedMotions, places: IntArray, unit: FloatArray, null: FloatArray
) -> tuple[int, tuple[str, ...]]:
    """Return how many more independent combinations of directions (p, d) move bodies than move the
    platform, where every body may have another frame; and these bodies.
    """
    if not weighed.sample.bodies:
        return 0, ()
    from scipy.linalg import block_diag

    bodies = {"": (weighed.sample.T, weighed.sample.D), **weighed.sample.bodies}
    each = {
        name: weigh_motions(T, robot.size, D[:, :, places] * unit)
        for name, (T, D) in bodies.items()
    }

    def count(names: Sequence[str]) -> int:
        motions, base = (np.concatenate([each[n][i] for n in names]) for i in (0, 1))
        own = np.asarray(block_diag(*[each[n][2] for n in names]), dtype=np.float64)
        scale = np.maximum(np.linalg.norm(motions, axis=0), weighed.scale)
        moved = (motions / scale) @ np.linalg.qr(scale[:, None] * null)[0]
        rest = _without_span([base, own], moved)
        return int((np.linalg.svd(rest, compute_uv=False) > SAME_MOTION).sum())

    alone = count([""])
    moved = tuple(name for name in weighed.sample.bodies if count(["", name]) > alone)
    return (count(list(bodies)) - alone if moved else 0), moved


def _measure_effect(
    robot: Mechanism, weighed: WeighedMotions, null: FloatArray
) -> tuple[float, float]:
    """Return `GaugeFreedoms.effect` of directions (p, d), over the workspace where one is known."""
    moved = weighed.by_parameters @ np.linalg.qr(null)[0]
    rest = _without_span([weighed.base, weighed.platform], moved)
    chosen = slice(-weighed.sample.in_workspace or None, None)
    T = weighed.sample.T[chosen]
    twists = rest.reshape(-1, 6, null.shape[1])[chosen] / twist_weights(robot.size)[:, None]
    at_tool = geometry.transport_matrix(T[:, :3, :3] @ robot.tool[:3, 3]) @ twists
    rotation, displacement = np.sqrt((at_tool**2).sum(axis=2).reshape(-1, 2, 3).sum(2).mean(0))
    kept = SAME_MOTION * np.hypot(rotation * robot.size, displacement)  # a smaller one is rounding
    return (
        float(rotation) if rotation * robot.size > kept else 0.0,
        float(displacement) if displacement > kept else 0.0,
    )


def report_undetermined(
    free: FreeParameters,
    unidentifiable: tuple[Combination, ...],
    codes: tuple[str, str] = ("identifiability.frames-only", "identifiability.changes-poses"),
    is_readings_alone: bool = False,
) -> tuple[list[Finding], tuple[Combination, ...]]:
    """Return how many undetermined combinations are harmless, and how many change poses by how
    much; and the combinations that do.

    A combination with a meaning, such as the place of a frame, changes no pose. Where all have one,
    but together change poses, the parameters of all are named.

    codes : of the two findings.
    """
    null = np.stack([combination.direction for combination in unidentifiable], axis=1)
    freedoms = find_gauge_freedoms(free.robot, free.places, free.tolerance, null)
    findings = []
    if is_readings_alone:
        others = freedoms.changing - freedoms.has_scale
        parts = (
            {"what": "frames", "frames": freedoms.frames, "count": freedoms.count},
            {"what": "scale", "frames": (), "count": int(freedoms.has_scale)},
            {"what": "others", "frames": (), "count": others},
        )
        kept = tuple(part for part in parts if part["count"])
        findings.append(report_finding("identifiability.readings-gauge", parts=kept))
    if freedoms.count or freedoms.still:
        harmless: dict[str, Any] = {"count": freedoms.count, "frames": freedoms.frames}
        harmless |= {"still": freedoms.still, "bodies": freedoms.bodies}
        findings.append(report_finding(codes[0], **harmless))
    if freedoms.moving:
        beside = {"count": freedoms.moving, "bodies": freedoms.bodies}
        findings.append(report_finding("identifiability.moves-bodies", **beside))
    if not freedoms.changing:
        return findings, ()
    changing = tuple(c for c in unidentifiable if not c.meaning)
    names = dict.fromkeys(name for c in changing or unidentifiable for name in c.names)
    to_quantity, (rotation, displacement) = free.robot.to_quantity, freedoms.effect
    sizes = ((displacement, Dimension.LENGTH), (rotation, Dimension.ANGLE))
    changed: dict[str, Any] = {
        "count": freedoms.changing,
        "names": tuple(names),
        "sizes": tuple(to_quantity(*size) for size in sizes if size[0] > 0.0),
        "where": freedoms.where,
    }
    return [*findings, report_finding(codes[1], **changed)], changing


def twist_weights(size: float) -> FloatArray:
    """Return (6,) factors that turn rotations [rad] into displacements [m]: the size, and one."""
    return np.array([size] * 3 + [1.0] * 3)


def observe_motions(robot: Mechanism, readings: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the poses T (n, 4, 4) that a robot reaches at readings (m, a), and their twists
    (n, 6, p) by all parameters [per SI].
    """
    state = forward_trials(robot, robot.values[None], readings[None])
    D = differentiate_pose(robot, robot.values[None], readings[None], state).parameters[0]
    usable = (state.status[0] == Status.CONVERGED) & np.isfinite(D).all(axis=(1, 2))
    return state.T[0, usable], D[usable]


def observe_bodies(
    robot: Mechanism, readings: FloatArray
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the same of bodies beside the platform (`bodies:`, platforms of stages), by name."""
    values, q = robot.values[None], readings[None]
    state = forward_trials(robot, values, q)
    poses = locate_bodies(robot, state)
    names = list(poses)[: len(robot.stages) - 1 if robot.stages else None]
    twists = differentiate_bodies(robot, values, q, state, names)
    each = {name: moved.parameters[0] for name, moved in twists.items()}
    usable = state.status[0] == Status.CONVERGED
    kept = {name: usable & np.isfinite(D).all(axis=(1, 2)) for name, D in each.items()}
    return {name: (poses[name][0, kept[name]], D[kept[name]]) for name, D in each.items()}


def interpret_combinations(
    free: FreeParameters, combinations: tuple[Combination, ...]
) -> tuple[Combination, ...]:
    """Return combinations with the motion of the robot that each of them stands for."""
    if not combinations:
        return combinations
    robot = free.robot
    weighed = _weigh(robot, free.places, free.tolerance)
    if not len(weighed.sample.T):
        return combinations
    frames = {"platform": weighed.platform, "base": weighed.base}
    interpreted = []
    for combination in combinations:
        n = combination.direction
        limit = SAME_MOTION * float(np.linalg.norm(weighed.scale * n))
        motion = _describe_motion(weighed.by_parameters @ n, frames, limit, robot.size)
        of_it = weighed, free.places, free.tolerance, n[:, None]
        if motion is not None and (bodies := _find_moved_bodies(robot, *of_it)[1]):
            motion = report_finding("identifiability.only-bodies-move", bodies=bodies)
        interpreted.append(replace(combination, meaning="" if motion is None else motion))
    return tuple(interpreted)


def interpret_fit(fit: Identification) -> Identification:
    """Return a fit whose unidentifiable combinations, and their findings, name their motions."""
    free = replace(fit.free_parameters, robot=fit.robot)
    combinations = interpret_combinations(free, fit.unidentifiable)
    named = iter(combination.finding for combination in combinations)
    codes = {combination.finding.code for combination in fit.unidentifiable}
    findings = tuple(next(named) if f.code in codes else f for f in fit.findings)
    return replace(fit, unidentifiable=combinations, findings=findings)


def probe_readings(robot: Mechanism) -> FloatArray:
    """Return readings (n, a) about those of home that the robot reaches, at most `PROBES`.

    The range shrinks until half of them are reached. Those that Newton's method does not reach from
    home are left out: following a path to each of them would take longer than all the rest.
    """
    if robot.redundancy is not None:
        return _probe_redundant(robot)
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    spread = [
        SPREAD_LENGTH * robot.size if a.dimension is Dimension.LENGTH else SPREAD_ANGLE
        for a in robot.actuators
    ]
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (PROBES, len(home))) * spread
    readings, reached = home[None], np.ones(1, dtype=bool)
    for share in SHARES:
        readings = home + share * drawn
        reached = find_directly_reachable(robot, robot.values[None], readings[None])[0]
        if reached.mean() >= 0.5:
            break
    return readings[reached]


def _probe_redundant(robot: Mechanism) -> FloatArray:
    """Return readings (n, a) of redundant actuators at poses about home.

    Drawn readings would contradict each other, and those of home do so where the values are not
    those that home was computed with.
    """
    scale = np.array([SPREAD_ANGLE] * 3 + [SPREAD_LENGTH * robot.size] * 3)
    twists = np.zeros((1, PROBES, 6))
    places = list(robot.program.freedoms)
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (PROBES, len(places)))
    twists[0][:, places] = drawn * scale[places]
    T = geometry.apply_twist(robot.home_state.T[0, 0], twists)
    begin = spread_states(robot.home_state, 1, PROBES)
    state, readings = solve_at_pose(robot, robot.values[None], T, begin)
    readings = readings[0][(state.status[0] == Status.CONVERGED)]
    return readings[find_directly_reachable(robot, robot.values[None], readings[None])[0]]


def weigh_motions(
    T: FloatArray, size: float, twists: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return motions at poses (n, 4, 4), rotations times the robot's size: (6 n, p) by `twists`
    (n, 6, p), and (6 n, 6) by the base and by the platform frame, see `frame_twists`.
    """
    M, weight = frame_twists(T, size), twist_weights(size)[:, None]
    motions, base, platform = (
        (weight * D).reshape(-1, D.shape[-1]) for D in (twists, M[:, :, :6], M[:, :, 6:])
    )
    return motions, base, platform


def find_moving_frames(
    moved: FloatArray, base: FloatArray, platform: FloatArray, limit: float
) -> tuple[str, ...]:
    """Return the frames whose motions (6 n, 6) explain motions (6 n, k) up to a limit: only one
    where it suffices.
    """
    for name, frame in (("base", base), ("platform", platform)):
        if np.linalg.norm(_without_span([frame], moved)) <= limit:
            return (name,)
    return ("base", "platform")


def _without_span(frames: Sequence[FloatArray], moved: FloatArray) -> FloatArray:
    """Return the part of the motions `moved` that no motion of the frames explains."""
    u, s, _ = np.linalg.svd(np.concatenate(frames, axis=1), full_matrices=False)
    basis = u[:, s > NO_MOTION * s[0]]
    return moved - basis @ (basis.T @ moved)


def _describe_motion(
    moved: FloatArray, frames: dict[str, FloatArray], limit: float, size: float
) -> Finding | None:
    """Return a finding on a motion (6 n,); None where it is not rigid."""
    if np.linalg.norm(moved) <= limit:
        return report_finding("identifiability.no-motion")
    for name, frame in frames.items():
        if np.linalg.norm(_without_span([frame], moved)) <= limit:
            motion = np.linalg.lstsq(frame, moved, rcond=NO_MOTION)[0]
            return _describe_frame_motion(name, np.asarray(motion, dtype=np.float64), size)
    if np.linalg.norm(_without_span(list(frames.values()), moved)) <= limit:
        return report_finding("identifiability.both-frames-move")
    return None


def _describe_frame_motion(frame: str, motion: FloatArray, size: float) -> Finding:
    """Return a finding on a twist (6,) as in `frame_twists`: a translation, a rotation about an
    axis, or both.

    Data: `frame`; `motion`, a translation, rotation or screw; `axis`, its direction;
    `through_origin`, whether the axis of a rotation passes through the origin of the frame.
    """
    w, c = motion[:3] / size, motion[3:]
    turn = float(np.linalg.norm(w))
    if turn * size <= SAME_MOTION * np.linalg.norm(c):
        kind, axis, through_origin = "translation", c, True
    else:
        along = abs(float(w @ c)) / turn**2
        kind, axis = "rotation" if along <= SAME_MOTION * size else "screw", w
        through_origin = float(np.linalg.norm(np.cross(w, c))) / turn**2 <= SAME_MOTION * size
    unit = axis / np.linalg.norm(axis)
    largest = int(np.argmax(np.abs(unit)))
    name = "xyz"[largest]
    if np.linalg.norm(np.delete(unit, largest)) > SAME_MOTION:
        shown = np.where(np.abs(unit) <= SAME_MOTION, 0.0, unit * np.sign(unit[largest]))
        name = "(" + ", ".join(f"{x:.3g}" for x in shown) + ")"
    return report_finding(
        "identifiability.frame-moves",
        frame=frame,
        motion=kind,
        axis=name,
        through_origin=through_origin,
    )
