# SPDX-License-Identifier: Apache-2.0
"""How well the poses of a calibrated machine are known, anywhere in its workspace.

    covariance = D C D' + J_q S_q J_q'        expanded uncertainty U = k sqrt(diag), k = 2

with the error model D = d twist / d parameter, the covariance C of the parameters and the variances
S_q of the readings where the actuators have a sigma. A direction of which nothing is known makes
those components infinite that it moves, and no others. Directions that only move a frame as a whole
are left out, and the result says so. JCGM 100; derivation: docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from loopcal import geometry
from loopcal.diagnose import NO_MOTION, FrameMotions, find_frame_motions, twist_weights
from loopcal.errors import EstimationError
from loopcal.estimate.inference.posterior import Posterior
from loopcal.estimate.result import Identification
from loopcal.mechanism import (
    Mechanism,
    Solution,
    differentiate_pose,
    forward,
    inverse,
    sample_workspace,
)
from loopcal.typing import BoolArray, FloatArray

COVERAGE = 2.0
"""Factor k of the expanded uncertainty: about 95 % of normal errors."""

COMPONENTS = ("rx", "ry", "rz", "x", "y", "z")
BLOCK = 1024
"""Poses whose sensitivities are held at once."""

Axes = Literal["base", "platform"]
Gauge = Literal["left out", "infinite"]
Point = Literal["tool", "platform"]


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """Uncertainty of n poses; components are COMPONENTS, a small rotation and the displacement of
    the point.

    Attributes
    ----------
    T : (n, 4, 4) platform poses of the calibrated robot; NaN where it does not reach.
    covariance : (n, 6, 6) [rad, m]; infinite on the diagonal (and NaN beside it) where nothing is
        known.
    frame : in words: the axes, the point, and what was left out.
    """

    T: FloatArray
    covariance: FloatArray
    frame: str

    @property
    def sd(self) -> FloatArray:
        """(n, 6) standard deviations [rad, m]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def expanded(self) -> FloatArray:
        """(n, 6) U = 2 sd of each component alone, about 95 % [rad, m]."""
        return COVERAGE * self.sd

    @property
    def position(self) -> FloatArray:
        """(n,) root mean square of the distance by which the point is off [m]."""
        return np.sqrt((self.sd[:, 3:] ** 2).sum(axis=1))

    @property
    def orientation(self) -> FloatArray:
        """(n,) root mean square of the angle by which the platform is turned [rad]."""
        return np.sqrt((self.sd[:, :3] ** 2).sum(axis=1))

    def to_dict(self) -> dict[str, Any]:
        """Return frame, factor and expanded uncertainties for JSON, SI."""
        return {
            "frame": self.frame,
            "coverage_factor": COVERAGE,
            "components": list(COMPONENTS),
            "expanded": self.expanded,
            "position_rms": self.position,
            "orientation_rms": self.orientation,
        }


def pose_uncertainty(
    fit: Identification | Posterior,
    poses: ArrayLike | Solution,
    frame: Axes = "base",
    gauge: Gauge = "left out",
    point: Point = "tool",
) -> PoseUncertainty:
    """Return how well poses of the calibrated robot are known.

    Parameters
    ----------
    fit : the identification, or the posterior of a run folder.
    poses : (n, 4, 4) T_base_platform, (n, c) controlled coordinates [m, rad], or a solution of the
        calibrated robot.
    frame : axes in which components are given. gauge : "left out" leaves out those directions
        without data that move the base or platform frame as a whole (the frame then is the one that
        the estimate defines); "infinite" does not.
    point : whose displacement it is, the tool's or the platform's origin.

    Returns
    -------
    PoseUncertainty; NaN where a pose is out of reach or no interval can be given.

    Raises
    ------
    EstimationError
        An option that is not allowed.
    """
    for name, value, allowed in (
        ("frame", frame, Axes),
        ("gauge", gauge, Gauge),
        ("point", point, Point),
    ):
        if value not in get_args(allowed):
            raise EstimationError(
                f"{name} is {value!r}; it must be one of {', '.join(map(repr, get_args(allowed)))}"
            )
    known = fit.posterior if isinstance(fit, Identification) else fit
    robot = known.robot
    found = poses if isinstance(poses, Solution) else inverse(robot, poses)
    motions = find_frame_motions(known)
    roots = _roots(known, motions, gauge)
    parts = []
    for first in range(0, len(found.q), BLOCK):
        rows = np.arange(first, min(first + BLOCK, len(found.q)))
        parts.append(
            _covariance(
                known, found.take(rows), roots, transport(robot, found.T[rows], frame, point)
            )
        )
    T = np.where(found.converged[:, None, None], found.T, np.nan)
    return PoseUncertainty(T, np.concatenate(parts), _frame_words(motions, frame, gauge, point))


def _roots(known: Posterior, motions: FrameMotions, gauge: Gauge) -> tuple[FloatArray, FloatArray]:
    """Directions times their standard deviations (p, r), and those of infinite variance (p, o),
    both in tolerances.
    """
    directions = known.directions.copy()
    if gauge == "left out":
        directions[:, ~known.seen] = motions.kept
    open_ = np.isinf(known.variance)
    return directions[:, ~open_] * np.sqrt(known.variance[~open_]), directions[:, open_]


def _covariance(
    known: Posterior, found: Solution, roots: tuple[FloatArray, FloatArray], H: FloatArray
) -> FloatArray:
    """Covariance (n, 6, 6) of some poses; H (n, 6, 6) takes base twists to the point and axes asked
    for.
    """
    robot = known.robot
    S = differentiate_pose(robot, robot.values[None], found.q[None], found.state)
    D = H @ (S.parameters[0][:, :, known.places] * known.unit)
    finite, open_ = roots
    spread = [D @ finite]
    sigma = np.array([a.sigma or 0.0 for a in robot.actuators])
    if sigma.any():
        spread.append(H @ (S.readings[0] * sigma))
    root = np.concatenate(spread, axis=2)
    covariance = root @ root.swapaxes(1, 2)
    if open_.shape[1]:
        weight = twist_weights(robot)
        limit = NO_MOTION * np.linalg.norm(D * weight[:, None], axis=(1, 2))
        moved = np.linalg.norm(D @ open_, axis=2) * weight > limit[:, None]
        covariance[moved[:, :, None] | moved[:, None, :]] = np.nan
        pose, component = np.nonzero(moved)
        covariance[pose, component, component] = np.inf
    covariance[~found.converged] = np.nan
    return covariance


def transport(robot: Mechanism, T: FloatArray, frame: Axes, point: Point) -> FloatArray:
    """(n, 6, 6) from twists of the platform's origin in base axes to those of the point in the
    axes.
    """
    R = T[:, :3, :3]
    arm = R @ robot.tool[:3, 3] if point == "tool" else np.zeros((len(T), 3))
    H = np.zeros((len(T), 6, 6))
    H[:, :3, :3] = H[:, 3:, 3:] = np.eye(3)
    H[:, 3:, :3] = -geometry.hat(arm)
    if frame == "platform":
        turn = np.zeros_like(H)
        turn[:, :3, :3] = turn[:, 3:, 3:] = R.swapaxes(1, 2)
        H = turn @ H
    return H


def _frame_words(motions: FrameMotions, frame: Axes, gauge: Gauge, point: Point) -> str:
    """Name axes, point and frame."""
    text = f"{'tool point' if point == 'tool' else 'platform origin'}, {frame} axes"
    if not motions.count or gauge == "infinite":
        return f"{text}, in the base frame of the robot file"
    several = motions.count > 1
    which = " and the ".join(motions.frames)
    one = len(motions.frames) == 1
    return (
        f"{text}; the {which} frame{'' if one else 's'} fitted to the parameters: {motions.count}"
        f" combination{'s' if several else ''} of them that only {'move' if several else 'moves'} "
        f"{'it' if one else 'these'}"
        f" cannot be known from these data and {'are' if several else 'is'} left out"
    )


@dataclass(frozen=True, eq=False)
class AccuracyMap:
    """Uncertainty over the workspace, beside that at the measured poses.

    Attributes
    ----------
    coordinates : (n, c) controlled coordinates [m, rad]; `names` names them.
    uncertainty : of these n poses. measured : of the poses that were measured.
    """

    names: tuple[str, ...]
    coordinates: FloatArray
    uncertainty: PoseUncertainty
    measured: PoseUncertainty

    @property
    def position_ratio(self) -> FloatArray:
        """(n,) position uncertainty over the largest at any measured pose: above 1 is
        extrapolation.
        """
        return _ratio(self.uncertainty.position, self.measured.position)

    @property
    def orientation_ratio(self) -> FloatArray:
        """(n,) orientation uncertainty over the largest at any measured pose: above 1 is
        extrapolation.
        """
        return _ratio(self.uncertainty.orientation, self.measured.orientation)

    @property
    def extrapolated(self) -> BoolArray:
        """(n,) poses less well known than every measured one."""
        return (self.position_ratio > 1.0) | (self.orientation_ratio > 1.0)

    def __str__(self) -> str:
        found = self.uncertainty
        lines = [f"pose uncertainty (rms) at {len(self.coordinates)} poses: {found.frame}"]
        for name, factor, symbol in (("position", 1e3, "mm"), ("orientation", 1e3, "mrad")):
            here, there = factor * getattr(found, name), factor * getattr(self.measured, name)
            lines.append(
                f"{name:<12} median {np.nanmedian(here):.3g}, largest {np.nanmax(here):.3g} "
                f"{symbol}; at measured poses largest"
                f" {np.nanmax(there):.3g} {symbol}; ratio up to "
                f"{np.nanmax(getattr(self, name + '_ratio')):.3g}"
            )
        lines.append(
            f"{int(self.extrapolated.sum())} of {len(self.coordinates)} poses are known less well "
            "than any measured one"
        )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return all by name for JSON, SI."""
        return {
            "names": list(self.names),
            "coordinates": self.coordinates,
            **self.uncertainty.to_dict(),
            "position_ratio": self.position_ratio,
            "orientation_ratio": self.orientation_ratio,
            "extrapolated": int(self.extrapolated.sum()),
        }


def accuracy_map(
    fit: Identification | Posterior,
    measured: ArrayLike,
    where: ArrayLike | int = 400,
    seed: int = 0,
    frame: Axes = "base",
) -> AccuracyMap:
    """Return the uncertainty of poses over the workspace, with the extrapolation visible.

    Parameters
    ----------
    fit : the identification, or the posterior of a run folder.
    measured : (m, a) readings of the measured poses, as in `Measurements.readings` [m, rad].
    where : (n, c) controlled coordinates, a grid for instance, or the number of poses to draw from
        the robot's workspace.
    seed : of that draw. frame : axes of the components.

    Raises
    ------
    MechanismError
        Poses are to be drawn, and the robot states no workspace.
    """
    robot = (fit.posterior if isinstance(fit, Identification) else fit).robot
    coordinates = (
        sample_workspace(robot, where, seed).coordinates
        if isinstance(where, int)
        else np.asarray(where, dtype=np.float64)
    )
    return AccuracyMap(
        names=robot.controlled,
        coordinates=coordinates,
        uncertainty=pose_uncertainty(fit, coordinates, frame),
        measured=pose_uncertainty(fit, forward(robot, measured), frame),
    )


def _ratio(here: FloatArray, there: FloatArray) -> FloatArray:
    """Over the largest that is there; one where both are infinite or both zero."""
    most = float(np.nanmax(there))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(here == most, 1.0, here / most)
