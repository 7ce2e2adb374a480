# SPDX-License-Identifier: Apache-2.0
"""Interpret directions that the data do not determine as motions of the base or platform frame.

A direction n moves the platform by the twist D(x) n at the pose x. It is a motion of the base frame
where it equals (w, c + w x t) for one w and c at all poses, and one of the platform frame where it
equals (R w, R c). Such a direction is a gauge freedom: it changes no dimension of the machine, only
where its frames are placed. See docs/theory/gauge.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal import geometry
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import spread_states
from loopcal.estimate.null_space import Combination
from loopcal.estimate.posterior import Posterior
from loopcal.estimate.result import Identification
from loopcal.estimate.unfixed_motions import frame_twists
from loopcal.findings import Finding, report_finding
from loopcal.mechanism.kinematics import compute_readings, find_directly_reachable, forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.states import Status
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

# Poses at which motions are compared: 144 equations for the 12 numbers of two frames and the
# directions in question.
PROBES = 24
# Range of the readings of these poses to each side of home, in robot sizes and radians.
SPREAD_LENGTH, SPREAD_ANGLE = 0.05, 0.1
# Shares of this range that are tried, until half of the poses are reached.
SHARES = (1.0, 0.1, 0.01)
# Share of the motion by all parameters below which a motion counts as none: the square root of
# double rounding.
NO_MOTION = 1e-8
SAME_MOTION = 1e-6  # relative difference below which two motions count as equal


@dataclass(frozen=True, eq=False)
class GaugeFreedoms:
    """The d unobservable directions, and the frames that their combinations move."""

    # (p, d) the directions without the combinations that move frames; columns are zero where
    # nothing else remains
    kept: FloatArray
    frames: tuple[str, ...]  # names of the moved frames: (), ("base",), ("platform",) or both
    count: int  # number of independent combinations that move frames
    # (12, g) motions of the two frames by these combinations, in the units of
    # `loopcal.estimate.unfixed_motions.frame_twists`, each of length one
    motions: FloatArray
    has_scale: bool = False  # whether a further combination enlarges all poses by one factor


def find_gauge_freedoms(posterior: Posterior) -> GaugeFreedoms:
    """Separate motions of frames from the directions that the data of a fit do not determine."""
    null = posterior.directions[:, ~posterior.determined]
    if null.shape[1] == 0:
        return GaugeFreedoms(null, (), 0, np.zeros((12, 0)))
    robot = posterior.robot
    T, D = observe_motions(robot, probe_readings(robot))
    if not len(T):
        return GaugeFreedoms(null, (), 0, np.zeros((12, 0)))
    twists = D[:, :, posterior.places] * posterior.unit
    motions, base, platform = weigh_motions(T, robot.size, twists)
    total = float(np.linalg.norm(motions))
    moved = motions @ null
    _, s, vt = np.linalg.svd(_without_span([base, platform], moved), full_matrices=False)
    # directions are those of the last linearization, motions those after the last step of the fit
    gauge = vt[s <= SAME_MOTION * total].T
    moving = moved @ gauge
    _, s, combine = np.linalg.svd(moving, full_matrices=False)
    moving = moving @ combine[s > NO_MOTION * total].T
    count = moving.shape[1]
    frames = find_moving_frames(moving, base, platform, SAME_MOTION * total) if count else ()
    infinite = np.isinf(posterior.variance[~posterior.determined])
    kept = null @ _gauge_projector(gauge, infinite)
    both = np.concatenate([base, platform], axis=1)
    motion = np.linalg.lstsq(both, moving, rcond=NO_MOTION)[0]
    explained = motion / np.linalg.norm(motion, axis=0)
    growth = np.zeros((len(T), 6, 1))
    growth[:, 3:, 0] = T[:, :3, 3]
    rest = _without_span([base, platform, growth.reshape(-1, 1)], moved)
    with_scale = np.linalg.svd(rest, compute_uv=False) <= SAME_MOTION * total
    return GaugeFreedoms(kept, frames, count, explained, bool(with_scale.sum() > gauge.shape[1]))


def twist_weights(size: float) -> FloatArray:
    """Return (6,) factors that make rotations [rad] comparable with displacements [m]: the robot's
    size, and one.
    """
    return np.array([size] * 3 + [1.0] * 3)


def observe_motions(robot: Mechanism, readings: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the poses T (n, 4, 4) that a robot reaches at readings (m, a), and their twists
    (n, 6, p) by all parameters [per SI].
    """
    state = forward_trials(robot, robot.values[None], readings[None])
    D = differentiate_pose(robot, robot.values[None], readings[None], state).parameters[0]
    usable = (state.status[0] == Status.CONVERGED) & np.isfinite(D).all(axis=(1, 2))
    return state.T[0, usable], D[usable]


def interpret_combinations(
    free: FreeParameters, combinations: tuple[Combination, ...]
) -> tuple[Combination, ...]:
    """Return combinations with the motion of the robot that each of them stands for."""
    if not combinations:
        return combinations
    robot = free.robot
    T, D = observe_motions(robot, probe_readings(robot))
    if not len(T):
        return combinations
    motions, base, platform = weigh_motions(T, robot.size, D[:, :, free.places] * free.tolerance)
    frames = {"platform": platform, "base": base}
    limit = NO_MOTION * float(np.linalg.norm(motions))
    interpreted = []
    for combination in combinations:
        n = combination.direction
        moved = motions @ (n / np.linalg.norm(n))
        motion = _describe_motion(moved, frames, limit, robot.size)
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


def _gauge_projector(gauge: FloatArray, infinite: BoolArray) -> FloatArray:
    """Return the projector (d, d) along `gauge` (d, g); coordinates of infinite variance go first.

    The choice of the frame that is fitted is a convention; this one leaves nothing infinite that a
    motion of a frame can remove.
    """
    d = len(gauge)
    u, s, vt = np.linalg.svd(gauge[infinite], full_matrices=True)
    rank = int((s > NO_MOTION).sum())
    first, second = gauge @ vt[:rank].T, gauge @ vt[rank:].T
    projector = np.eye(d)
    projector[:, infinite] -= (first / s[:rank]) @ u[:, :rank].T
    basis = np.linalg.qr(second)[0]
    return projector - basis @ (basis.T @ projector)


def probe_readings(robot: Mechanism) -> FloatArray:
    """Return readings (n, a) about those of home that the robot reaches, at most `PROBES`.

    The range shrinks until half of them are reached. Those that Newton's method does not reach from
    home are left out: following a path to each of them would take longer than all the rest.
    """
    if robot.program.sigma is not None:
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
    from loopcal.mechanism.actuation import solve_at_pose

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
    length = np.linalg.norm(moved)
    if length <= limit:
        return report_finding("identifiability.no-motion")
    for name, frame in frames.items():
        if np.linalg.norm(_without_span([frame], moved)) <= SAME_MOTION * length:
            motion = np.linalg.lstsq(frame, moved, rcond=NO_MOTION)[0]
            return _describe_frame_motion(name, np.asarray(motion, dtype=np.float64), size)
    if np.linalg.norm(_without_span(list(frames.values()), moved)) <= SAME_MOTION * length:
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
