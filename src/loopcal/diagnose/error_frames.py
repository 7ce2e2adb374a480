# SPDX-License-Identifier: Apache-2.0
"""Frames in which errors of poses are stated: the one place that refers a pose error to a frame.

With D (6, p) the twist of a pose by the parameters and M (6, 12) that by motions of the base and
platform frames, the error of a pose in any of these frames is

    D de - M (G de + K eta)

    fitted        G = N pinv(A) D_ref, A = M_ref N: what is left after the best rigid fit of the
                  motions N that the measurements do not determine, over the reference poses
    base          G = 0: the base frame of the robot file
    an instrument G de + K eta is the error of its frame, with independent errors eta of variance 1
    relative      G takes the error of the first pose away, as a motion of the base

In the last two, motions of the platform that the measurements do not determine are fitted, too.
Rotations are multiplied by the robot's size in the fit, and displacements are those of the tool.
Derivation: docs/theory/observability.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.checks import check_choice
from loopcal.diagnose import gauge_freedoms
from loopcal.errors import EstimationError
from loopcal.estimate.information import MOTIONS, frame_twists
from loopcal.estimate.posterior import Posterior
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.kinematics import compute_readings
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import Solution, forward
from loopcal.numerics.statistics import choose_evenly
from loopcal.typing import FloatArray

Over = Literal["measured", "home", "predicted"]
# Frames that exist for every calibration; the others are the names of its instruments' frames.
FITTED, BASE, RELATIVE = "fitted", "base", "relative"
# Singular values of the motions of frames, relative to the largest, up to which a motion does not
# move the reference poses, or the errors do not contain it: the square root of double rounding.
FIT_TOLERANCE = 1e-8


class ErrorFrame(NamedTuple):
    """A frame in which errors of poses are stated."""

    name: str  # "fitted", "base", "relative", or the name of the frame of an instrument
    size: float  # of the robot [m]
    # (12, p) G, also by the errors of a model discrepancy, see `list_error_twists`
    by_parameters: FloatArray
    own: FloatArray  # (12, k) K
    # frames of which motions are fitted: (), ("base",), ("platform",) or both
    fitted: tuple[str, ...] = ()
    # frames that the measurements do not determine, and that are not fitted
    undetermined: tuple[str, ...] = ()
    origin: str = ""  # name of the pose to which others are relative; "" in other frames
    # the poses over which frames are fitted: "measured", "home" (poses about home) or "predicted"
    # (the poses whose errors are stated)
    over: Over = "measured"

    def relate(self, twists: FloatArray, T: FloatArray) -> FloatArray:
        """Return twists (n, 6, p) of poses T (n, 4, 4) by the parameters, relative to the frame."""
        return twists - frame_twists(T, self.size) @ self.by_parameters

    def own_errors(self, T: FloatArray) -> FloatArray:
        """Return twists (n, 6, k) of poses by errors of the frame itself, of variance 1."""
        return -frame_twists(T, self.size) @ self.own

    def describe(self, point: str = "tool", axes: str = "base") -> Finding:
        """Return point, axes and frame in words; without axes for errors that are distances."""
        return report_finding(
            "accuracy.frame",
            point=point,
            axes=axes,
            frame=self.name,
            fitted=self.fitted,
            over=self.over,
            undetermined=self.undetermined,
            origin=self.origin,
        )


class ReferencePoses(NamedTuple):
    """Poses over which frames are fitted."""

    T: FloatArray  # (m, 4, 4)
    twists: FloatArray  # (m, 6, p)
    over: Over


class FrameFit(NamedTuple):
    """The best rigid fit of some motions of frames over m reference poses."""

    poses: FloatArray  # (m, 4, 4)
    motions: FloatArray  # (12, k) those that move these poses
    size: float  # of the robot [m]
    solution: FloatArray  # (12, 6 m) motion that fits stacked twists of these poses best

    def __call__(self, twists: FloatArray) -> FloatArray:
        """Return the motions (12, r) that fit twists (m, 6, r) of the reference poses best."""
        return self.solution @ twists.reshape(self.solution.shape[1], twists.shape[-1])

    def remove(self, twists: FloatArray, T: FloatArray, reference: FloatArray) -> FloatArray:
        """Return errors (t, n, 6) of t machines at poses T (n, 4, 4) without the motions that fit
        their errors `reference` (t, m, 6) at the reference poses best.
        """
        motion = self(np.moveaxis(reference, 0, -1))
        return twists - np.moveaxis(frame_twists(T, self.size) @ motion, -1, 0)


def fit_frames(robot: Mechanism, T: FloatArray, motions: FloatArray) -> FrameFit:
    """Return the best fit of motions (12, k) over reference poses T (m, 4, 4).

    Rotations count times the robot's size, and displacements are those of the tool.
    """
    arm, m = T[:, :3, :3] @ robot.tool[:3, 3], len(T)
    weight = gauge_freedoms.twist_weights(robot.size)[:, None] * geometry.transport_matrix(arm)
    by_frames = (weight @ frame_twists(T, robot.size)).reshape(6 * m, MOTIONS)
    u, s, vt = np.linalg.svd(by_frames @ motions, full_matrices=False)
    # where the orientation is constant, opposite motions of both frames move nothing
    used = s > FIT_TOLERANCE * np.linalg.norm(by_frames)
    moving = motions @ vt[used].T
    count = np.count_nonzero(used)  # none where the motions are errors of rounding
    inverse = (u[:, used] / s[used]).T.reshape(count, m, 1, 6)
    solution = moving @ np.matmul(inverse, weight).reshape(count, 6 * m)
    return FrameFit(T, moving, robot.size, solution)


def fit_unfixed_frames(posterior: Posterior) -> FrameFit:
    """Return the fit of the motions of frames that a calibration does not determine, over its
    measured poses.
    """
    T = reference_poses(posterior).T
    return fit_frames(posterior.robot, T, list_unfixed_motions(posterior))


def choose_error_frame(
    posterior: Posterior,
    frame: str = FITTED,
    origin: Solution | None = None,
    origin_name: str = "1",
) -> ErrorFrame:
    """Return a frame for the errors of poses of a calibrated robot.

    frame : "fitted" fits the motions of the base and platform frames that the measurements do not
        determine, and is the base frame of the robot file where they determine all; "base" is that
        base frame in any case; "relative" is the first pose; otherwise the frame of an instrument.
    origin : pose (1,) of the calibrated robot to which others are relative. origin_name : its name.
    """
    robot = posterior.robot
    instruments = {} if posterior.frames is None else posterior.frames.instruments
    check_choice("frame", frame, (FITTED, BASE, RELATIVE, *instruments))
    motions = list_unfixed_motions(posterior)
    if frame in (FITTED, BASE) and not motions.shape[1]:
        own = posterior.discrepancy
        p = len(posterior.unit) + (0 if own is None else own.errors.count)
        by_parameters, by_itself = np.zeros((MOTIONS, p)), np.zeros((MOTIONS, 0))
        over: Over = "measured" if _names_readings(posterior) else "home"
        return ErrorFrame(frame, posterior.robot.size, by_parameters, by_itself, over=over)
    reference = reference_poses(posterior)
    if frame in (FITTED, BASE):
        return refer_errors(robot, frame, reference, motions)
    if frame != RELATIVE:
        # the motions of the base that move it like the frame of the instrument
        instrument = instruments[frame]
        of_frame = frame_twists(instrument.T, robot.size)[:, :6]
        by_parameters = _as_base_motion(of_frame, instrument.by_parameters * posterior.unit)
        if posterior.discrepancy is not None:  # the frame does not follow errors of the poses
            nothing = np.zeros((MOTIONS, posterior.discrepancy.errors.count))
            by_parameters = np.concatenate([by_parameters, nothing], axis=1)
        by_frames = np.diag(np.repeat([1.0, 0.0], 6))
        if instrument.by_motions is not None:
            by_frames = _as_base_motion(of_frame, instrument.by_motions)
        own_errors = _as_base_motion(of_frame, instrument.own)
        followed = FollowedMotion(by_frames, by_parameters, own_errors)
        return refer_errors(robot, frame, reference, motions, followed)
    if origin is None or not origin.converged.all():
        raise EstimationError(
            f"the robot does not reach pose {origin_name!r}, to which errors should be relative. "
            "Use another pose, or another frame"
        )
    S = differentiate_pose(robot, robot.values[None], origin.q[None], origin.state)
    sigma = robot.stated_sigma
    twists = list_error_twists(posterior, origin.T, S.parameters[0][..., posterior.places])[0]
    by_readings = (S.readings[0, 0] * sigma)[:, sigma > 0.0]
    followed = follow_pose(robot, origin.T[0], twists, by_readings, origin_name)
    return refer_errors(robot, RELATIVE, reference, motions, followed)


@dataclass(frozen=True, eq=False)
class FollowedMotion:
    """Motions of both frames that a pose or an instrument makes, to which errors are relative."""

    by_frames: FloatArray  # (12, 12) by motions of the base and platform frames
    by_parameters: FloatArray  # (12, p)
    own: FloatArray  # (12, k) by errors of its own, of variance 1
    name: str = ""  # of the pose; else ""


def refer_errors(
    robot: Mechanism,
    frame: str,
    reference: ReferencePoses,
    motions: FloatArray,
    followed: FollowedMotion | None = None,
) -> ErrorFrame:
    """Return the frame in which errors are stated.

    reference : poses over which frames are fitted. motions : (12, k) that the measurements do not
        determine; those that `followed` leaves are fitted, unless the frame is "base".
    """
    T, twists, over = reference
    still, unmoved, exact = (np.zeros((MOTIONS, n)) for n in (MOTIONS, twists.shape[2], 0))
    begin = followed or FollowedMotion(still, unmoved, exact)
    M = frame_twists(T, robot.size)
    fit = fit_frames(robot, T, motions - begin.by_frames @ motions)
    extra = fit(twists - M @ begin.by_parameters)
    moved = _moved_frames(fit, extra, twists)
    if frame == BASE or not moved:
        return ErrorFrame(
            frame, robot.size, begin.by_parameters, begin.own, (), moved, begin.name, over
        )
    by_parameters, own = begin.by_parameters + extra, begin.own - fit(M @ begin.own)
    return ErrorFrame(frame, robot.size, by_parameters, own, moved, (), begin.name, over)


def follow_pose(
    robot: Mechanism, T: FloatArray, twists: FloatArray, own: FloatArray, name: str
) -> FollowedMotion:
    """Return the motions of the base that move a pose T (4, 4) like motions of both frames, like
    its twists (6, p) by the parameters, and like its own errors (6, k).
    """
    M = frame_twists(T, robot.size)
    by_frames, by_parameters, by_own = (
        _as_base_motion(M[:, :6], columns) for columns in (M, twists, own)
    )
    return FollowedMotion(by_frames, by_parameters, by_own, name)


def solve_home(robot: Mechanism) -> Solution:
    """Return the home pose (1,) of a robot, to which errors may be relative."""
    return forward(robot, compute_readings(robot, robot.values[None], robot.home_state)[0])


def list_unfixed_motions(posterior: Posterior) -> FloatArray:
    """Return an orthonormal basis (12, k) of the motions of frames that a fit does not determine:
    those of its measurements, and of the directions that it does not determine.
    """
    known = np.zeros((MOTIONS, 0)) if posterior.frames is None else posterior.frames.unfixed
    if posterior.determined.all():
        return known
    of_null = (posterior.places, posterior.unit, posterior.undetermined)
    moved = gauge_freedoms.find_gauge_freedoms(posterior.robot, *of_null).motions
    u, s, _ = np.linalg.svd(np.concatenate([known, moved], axis=1), full_matrices=False)
    return u[:, s > FIT_TOLERANCE]


def reference_poses(posterior: Posterior) -> ReferencePoses:
    """Return the poses over which frames are fitted: the measured poses, or poses about home where
    a run folder does not name these.
    """
    robot, frames = posterior.robot, posterior.frames
    if frames is not None and _names_readings(posterior):
        readings, where = frames.readings, "measured"
    else:
        readings, where = gauge_freedoms.probe_readings(robot), "home"
    T, D = gauge_freedoms.observe_motions(robot, readings)
    return ReferencePoses(T, list_error_twists(posterior, T, D[:, :, posterior.places]), where)


def list_error_twists(posterior: Posterior, T: FloatArray, D: FloatArray) -> FloatArray:
    """Return twists (n, 6, p + m) of poses T (n, 4, 4) by the parameters, D (n, 6, p) [per SI], in
    the units of the posterior, and by the m independent errors of its model discrepancy.
    """
    by_parameters, own = D * posterior.unit, posterior.discrepancy
    if own is None:
        return by_parameters
    return np.concatenate([by_parameters, own.twists(T, D)], axis=2)


def _names_readings(posterior: Posterior) -> bool:
    """Return whether a posterior names the readings of the measured poses."""
    return posterior.frames is not None and len(posterior.frames.readings) > 0


def _moved_frames(fit: FrameFit, motion: FloatArray, twists: FloatArray) -> tuple[str, ...]:
    """Return which frames a motion (12, p) that fits twists (m, 6, p) moves: the fewest."""
    motions, base, platform = gauge_freedoms.weigh_motions(fit.poses, fit.size, twists)
    moved = np.concatenate([base, platform], axis=1) @ motion
    length = float(np.linalg.norm(moved))
    if not length > FIT_TOLERANCE * np.linalg.norm(motions):
        return ()
    return gauge_freedoms.find_moving_frames(moved, base, platform, FIT_TOLERANCE * length)


def _as_base_motion(by_base: FloatArray, twists: FloatArray) -> FloatArray:
    """Return the motions of both frames (12, k) that are motions of the base only, and that give
    twists (6, k); `by_base` (6, 6) are the twists by motions of the base.
    """
    motion = np.asarray(np.linalg.solve(by_base, twists), dtype=np.float64)
    return np.concatenate([motion, np.zeros_like(motion)])


# Measured poses, evenly chosen, by which two uncertainties are compared: ratios over more poses
# hardly differ.
MOST_POSES = 1000


class ToolErrors(NamedTuple):
    """Twists (n, 6, ..) of the tool point in a frame: by the parameters in the units of the
    posterior without its discrepancy, by independent errors of the frame itself, by the readings in
    their sigmas, and by independent errors of the model discrepancy, the last 6 of which are of
    each pose alone.
    """

    by_parameters: FloatArray
    by_frame: FloatArray
    by_readings: FloatArray
    by_discrepancy: FloatArray
    # (n,) of the effect of all parameters on the platform in the base frame, rotations times the
    # robot's size
    size: FloatArray
    reference: Finding


def linearize_tool_errors(
    posterior: Posterior, solution: Solution, frame: str | ErrorFrame, H: FloatArray | None = None
) -> ToolErrors:
    """Return the derivatives of the errors of the tool at poses that the robot reaches, and the
    frame in words.

    frame : or its name, see `choose_error_frame`; "relative" means relative to the home pose.
    H : (n, 6, 6) from twists of the platform origin in base axes to those of another point or of
        other axes; default: to those of the tool.
    """
    robot = posterior.robot
    if isinstance(frame, str):
        frame = choose_error_frame(posterior, frame, solve_home(robot), "home")
    S = differentiate_pose(robot, robot.values[None], solution.q[None], solution.state)
    D = list_error_twists(posterior, solution.T, S.parameters[0][..., posterior.places])
    H = geometry.transport_matrix(solution.T[:, :3, :3] @ robot.tool[:3, 3]) if H is None else H
    p, by_errors = len(posterior.unit), H @ frame.relate(D, solution.T)
    by_discrepancy = by_errors[..., p:]
    if posterior.discrepancy is not None:
        rest = H @ posterior.discrepancy.errors.rest(solution.T)
        by_discrepancy = np.concatenate([by_discrepancy, rest], axis=2)
    return ToolErrors(
        by_errors[..., :p],
        H @ frame.own_errors(solution.T),
        H @ (S.readings[0] * posterior.repeatability),
        by_discrepancy,
        np.linalg.norm(D[..., :p] * gauge_freedoms.twist_weights(robot.size)[:, None], axis=(1, 2)),
        frame.describe(axes=""),
    )


def compute_mean_squares(twists: FloatArray) -> tuple[float, float]:
    """Return the mean over poses of the squares of rotations [rad^2] and displacements [m^2] of
    twists (n, 6, k) by independent errors of variance 1.
    """
    squares = (twists**2).sum(axis=2)
    return float(squares[:, :3].sum(axis=1).mean()), float(squares[:, 3:].sum(axis=1).mean())


def locate_measured_poses(
    fit: Identification, data: Measurements, most: int | None = None
) -> Solution:
    """Return the measured poses that the calibrated robot reaches, or `most`, evenly chosen."""
    readings = data.readings if fit.poses is None else fit.poses.readings[fit.poses.kept]
    readings = readings[np.isfinite(readings).all(axis=1)]
    if most is not None:
        readings = readings[choose_evenly(len(readings), most)]
    solution = forward(fit.robot, readings)
    return solution.take(np.flatnonzero(solution.converged))
