# SPDX-License-Identifier: Apache-2.0
"""Interpret directions of the parameters that the data do not determine.

A direction n moves the platform by the twist D(x) n at the pose x. It is a motion of the base frame
where it equals (w, c + w x t) for one w and c at all poses, and one of the platform frame where it
equals (R w, R c). Such a direction is a gauge freedom: it changes no dimension of the machine, only
where its frames are placed. See docs/theory/gauge.md and uncertainty.md.

Fits of one machine may differ by millimeters along unobservable directions without any effect on
the measurements, so the plain difference between parameters and their true values means little.
With the deviations z in tolerances and an orthonormal basis N of the unobservable directions, the
comparable part of the error is, to first order,

    e = (1 - N N') (z_estimate - z_truth)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from loopcal import geometry
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.null_space import Combination
from loopcal.estimate.inference.posterior import Posterior
from loopcal.estimate.information import ObservedPoses, observe_poses
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.mechanism import (
    Mechanism,
    Status,
    compute_readings,
    differentiate_pose,
    forward_trials,
)
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

PROBES = 24
"""Poses at which motions are compared: 144 equations for the 12 numbers of two frames and the
directions in question.
"""

SPREAD_LENGTH, SPREAD_ANGLE = 0.05, 0.1
"""Range of the readings of these poses to each side of home, in robot sizes and radians."""

NO_MOTION = 1e-8
"""Share of the motion by all parameters below which a motion counts as none: the square root of
double rounding.
"""

SAME_MOTION = 1e-6
"""Relative difference below which two motions count as equal."""


@dataclass(frozen=True, eq=False)
class FrameMotions:
    """The d unobservable directions, and the frames that their combinations move.

    Attributes
    ----------
    kept : (p, d) the directions without the combinations that move frames; columns are zero where
        nothing else remains.
    frames : names of the moved frames: (), ("base",), ("platform",) or both. count : number of
        independent combinations that move frames.
    """

    kept: FloatArray
    frames: tuple[str, ...]
    count: int


@dataclass(frozen=True, eq=False)
class TruthComparison:
    """Errors of the free parameters of a fit; arrays (p,) in the order of `names`.

    Attributes
    ----------
    names : of the free parameters.
    raw : estimate minus truth [SI].
    error : the same without the unobservable directions [SI].
    tolerances : `error` in tolerances [1].
    dropped : the unobservable directions, as combinations of parameters.
    """

    names: tuple[str, ...]
    raw: FloatArray
    error: FloatArray
    tolerances: FloatArray
    dropped: tuple[Combination, ...]

    @property
    def rms(self) -> float:
        """Root mean square of the error in tolerances over the compared directions; NaN without
        any.
        """
        count = len(self.names) - len(self.dropped)
        return float(np.sqrt(np.sum(self.tolerances**2) / count)) if count else float("nan")

    @property
    def finding(self) -> Finding:
        """The compared directions, and those that the data do not determine."""
        return report_finding(
            "identifiability.compared-with-truth",
            parameters=len(self.names),
            compared=len(self.names) - len(self.dropped),
            excluded=tuple(dict(one.finding.data) for one in self.dropped),
        )

    def __repr__(self) -> str:
        p, d = len(self.names), len(self.dropped)
        return (
            f"<TruthComparison: {p} parameters, {p - d} directions, rms {self.rms:.3g} tolerances>"
        )

    def to_dict(self) -> dict[str, object]:
        """Return the attributes, the root mean square and the finding, SI."""
        return {**vars(self), "rms": self.rms, "finding": self.finding}


def compare_with_truth(fit: Identification, truth: ArrayLike) -> TruthComparison:
    """Compare the parameters of a fit with true ones in the directions that its data determine.

    Parameters
    ----------
    fit : Identification
    truth : (parameters of the robot,) or (free parameters,) [SI]
        True values of the robot's table, or of its free parameters only, in that order.

    Raises
    ------
    EstimationError
        The number of true values is different, or one of them is not finite.
    """
    true = np.asarray(truth, dtype=np.float64)
    p, total = len(fit.names), len(fit.robot.parameters)
    if true.shape not in ((p,), (total,)) or not np.isfinite(true).all():
        problem = "" if np.isfinite(true).all() else " and numbers that are not finite"
        raise EstimationError(
            f"the truth has shape {true.shape}{problem}; give {total} values for all parameters of "
            f"{fit.robot.name!r}, or {p} for the free ones"
        )
    true = true[fit.free_parameters.places] if len(true) == total else true
    raw = fit.estimate - true
    z = raw / fit.tolerance
    posterior = fit.posterior
    unobservable = posterior.directions[:, ~posterior.determined]
    basis = np.linalg.qr((posterior.unit / fit.tolerance)[:, None] * unobservable)[0]
    z = z - basis @ (basis.T @ z)
    return TruthComparison(fit.names, raw, z * fit.tolerance, z, fit.unidentifiable)


def find_frame_motions(posterior: Posterior) -> FrameMotions:
    """Separate motions of frames from the directions that the data of a fit do not determine."""
    null = posterior.directions[:, ~posterior.determined]
    if null.shape[1] == 0:
        return FrameMotions(null, (), 0)
    D, base, platform = _posterior_motions(posterior)
    limit = NO_MOTION * float(np.linalg.norm(D))
    moved = D @ null
    both = np.concatenate([base, platform], axis=1)
    _, s, vt = np.linalg.svd(_without_span(both, moved), full_matrices=False)
    gauge = vt[s <= limit].T
    moving = moved @ gauge
    count = int((np.linalg.svd(moving, compute_uv=False) > limit).sum()) if gauge.shape[1] else 0
    frames = _moved_frames(moving, base, platform, limit) if count else ()
    infinite = np.isinf(posterior.variance[~posterior.determined])
    return FrameMotions(null @ _gauge_projector(gauge, infinite), frames, count)


def twist_weights(robot: Mechanism) -> FloatArray:
    """Return (6,) factors that make rotations [rad] comparable with displacements [m]: the robot's
    size, and one.
    """
    return np.array([robot.size] * 3 + [1.0] * 3)


def probe_workspace(free: FreeParameters, joints: Iterable[str] = ()) -> ObservedPoses:
    """Return poses about home with evenly spread readings, without those out of reach."""
    at = observe_poses(free, _probe_readings(free.robot), joints)
    return observe_poses(free, at.readings[at.is_reached], joints)


def interpret_combinations(
    free: FreeParameters, combinations: tuple[Combination, ...], directions: FloatArray
) -> tuple[Combination, ...]:
    """Return combinations with the motion of the robot that each of them stands for.

    Parameters
    ----------
    directions : (d, p) the combinations in tolerances.
    """
    if not combinations:
        return combinations
    at = probe_workspace(free)
    if not len(at.readings):
        return combinations
    weight = twist_weights(free.robot)[:, None]
    base, platform = _frame_twists(at.T[0])
    frames = {
        "platform": (weight * platform).reshape(-1, 6),
        "base": (weight * base).reshape(-1, 6),
    }
    twists = at.twists[0]
    moves = (weight * twists).reshape(-1, twists.shape[-1])
    limit = NO_MOTION * float(np.linalg.norm(moves))
    interpreted = []
    for combination, n in zip(combinations, directions, strict=True):
        motion = _describe_motion(moves @ (n / np.linalg.norm(n)), frames, limit, free.robot.size)
        interpreted.append(replace(combination, meaning="" if motion is None else motion))
    return tuple(interpreted)


def _gauge_projector(gauge: FloatArray, infinite: BoolArray) -> FloatArray:
    """Projector (d, d) along `gauge` (d, g) that first removes coordinates of infinite variance.

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


def _probe_readings(robot: Mechanism) -> FloatArray:
    """Readings (PROBES, a) about those of home."""
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    spread = [
        SPREAD_LENGTH * robot.size if a.dimension is Dimension.LENGTH else SPREAD_ANGLE
        for a in robot.actuators
    ]
    return home + np.random.default_rng(0).uniform(-1.0, 1.0, (PROBES, len(home))) * spread


def _frame_twists(T: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Twists (n, 6, 6) at poses (n, 4, 4) by motions of the base frame and the platform frame."""
    R, t = T[:, :3, :3], T[:, :3, 3]
    zero, eye = np.zeros_like(R), np.broadcast_to(np.eye(3), R.shape)
    base = np.concatenate(
        [np.concatenate([eye, zero], 2), np.concatenate([-geometry.hat(t), eye], 2)], axis=1
    )
    platform = np.concatenate([np.concatenate([R, zero], 2), np.concatenate([zero, R], 2)], axis=1)
    return base, platform


def _posterior_motions(posterior: Posterior) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weighted motions (6 n, p), (6 n, 6), (6 n, 6) by the coordinates of the posterior, by the
    base frame and by the platform frame.
    """
    robot, q = posterior.robot, _probe_readings(posterior.robot)
    values = robot.values[None]
    state = forward_trials(robot, values, q[None])
    usable = state.status[0] == Status.CONVERGED
    D = differentiate_pose(robot, values, q[None], state).parameters[0]
    usable &= np.isfinite(D).all(axis=(1, 2))
    base, platform = _frame_twists(state.T[0, usable])
    weight = twist_weights(robot)[:, None]
    of_parameters = (D[usable][:, :, posterior.places] * posterior.unit) * weight
    return (
        of_parameters.reshape(-1, of_parameters.shape[-1]),
        (base * weight).reshape(-1, 6),
        (platform * weight).reshape(-1, 6),
    )


def _without_span(frames: FloatArray, moved: FloatArray) -> FloatArray:
    """Part of the motions `moved` that no motion of the frames explains."""
    u, s, _ = np.linalg.svd(frames, full_matrices=False)
    basis = u[:, s > NO_MOTION * s[0]]
    return moved - basis @ (basis.T @ moved)


def _moved_frames(
    moving: FloatArray, base: FloatArray, platform: FloatArray, limit: float
) -> tuple[str, ...]:
    """Names of the frames that explain the motions; only one where it suffices."""
    for name, frame in (("base", base), ("platform", platform)):
        if np.linalg.norm(_without_span(frame, moving)) <= limit:
            return (name,)
    return ("base", "platform")


def _describe_motion(
    moved: FloatArray, frames: dict[str, FloatArray], limit: float, size: float
) -> Finding | None:
    """Finding on a motion (6 n,); None where it is not rigid."""
    if np.linalg.norm(moved) <= limit:
        return report_finding("identifiability.no-motion")
    for name, frame in frames.items():
        motion = _fit_motion(frame, moved)
        if np.linalg.norm(frame @ motion - moved) <= SAME_MOTION * np.linalg.norm(moved):
            return _describe_frame_motion(name, motion, size)
    both = np.concatenate(list(frames.values()), axis=1)
    residual = both @ _fit_motion(both, moved) - moved
    if np.linalg.norm(residual) <= SAME_MOTION * np.linalg.norm(moved):
        return report_finding("identifiability.both-frames-move")
    return None


def _fit_motion(frame: FloatArray, moved: FloatArray) -> FloatArray:
    """Smallest motion (c,) of least squares."""
    return np.asarray(np.linalg.lstsq(frame, moved, rcond=NO_MOTION)[0], dtype=np.float64)


def _describe_frame_motion(frame: str, motion: FloatArray, size: float) -> Finding:
    """Finding on a twist (6,): a translation, a rotation about an axis, or both.

    Data: `frame`; `motion`, a translation, rotation or screw; `axis`, its direction;
    `through_origin`, whether the axis of a rotation passes through the origin of the frame.
    """
    w, c = motion[:3], motion[3:]
    turn = float(np.linalg.norm(w))
    code = "identifiability.frame-moves"
    if turn * size <= SAME_MOTION * np.linalg.norm(c):
        axis = _axis_name(c)
        return report_finding(
            code, frame=frame, motion="translation", axis=axis, through_origin=True
        )
    arm = float(np.linalg.norm(np.cross(w, c))) / turn**2
    along = abs(float(w @ c)) / turn**2
    return report_finding(
        code,
        frame=frame,
        motion="rotation" if along <= SAME_MOTION * size else "screw",
        axis=_axis_name(w),
        through_origin=arm <= SAME_MOTION * size,
    )


def _axis_name(vector: FloatArray) -> str:
    """A direction as x, y or z, or by its components."""
    unit = vector / np.linalg.norm(vector)
    largest = int(np.argmax(np.abs(unit)))
    if np.linalg.norm(np.delete(unit, largest)) <= SAME_MOTION:
        return "xyz"[largest]
    shown = np.where(np.abs(unit) <= SAME_MOTION, 0.0, unit * np.sign(unit[largest]))
    return "(" + ", ".join(f"{x:.3g}" for x in shown) + ")"
