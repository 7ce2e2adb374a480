# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of poses over the workspace, compared with that of the measured poses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from loopcal.apply.accuracy import Axes, PoseUncertainty, pose_uncertainty
from loopcal.diagnose.error_frames import FITTED, solve_home
from loopcal.estimate.inference.posterior import Posterior
from loopcal.estimate.result import Identification
from loopcal.mechanism import forward, resolve_poses
from loopcal.presentation import TableResult, draw
from loopcal.typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class AccuracyMap(TableResult):
    """Uncertainty over the workspace, and at the measured poses.

    Attributes
    ----------
    coordinates : (n, c) controlled coordinates [m, rad]; `names` names them.
    uncertainty : of these n poses. measured : of the measured poses.
    """

    names: tuple[str, ...]
    coordinates: FloatArray
    uncertainty: PoseUncertainty
    measured: PoseUncertainty

    @property
    def position_ratio(self) -> FloatArray:
        """(n,) position uncertainty divided by the largest at the measured poses.

        Above 1 the map extrapolates.
        """
        return _ratio(self.uncertainty.position, self.measured.position)

    @property
    def orientation_ratio(self) -> FloatArray:
        """(n,) orientation uncertainty divided by the largest at the measured poses."""
        return _ratio(self.uncertainty.orientation, self.measured.orientation)

    @property
    def extrapolated(self) -> BoolArray:
        """(n,) poses that are less certain than every measured pose."""
        return (self.position_ratio > 1.0) | (self.orientation_ratio > 1.0)

    def plot(self) -> Figure:
        """Draw the uncertainty in slices of the workspace, beside the measured poses."""
        return draw("draw_accuracy_map", self)

    def __str__(self) -> str:
        """Return medians and maxima, and how many poses are extrapolated."""
        n = len(self.coordinates)
        lines = [f"Pose uncertainty (rms) at {n} poses: {self.uncertainty.frame}"]
        for name, factor, symbol in (("position", 1e3, "mm"), ("orientation", 1e3, "mrad")):
            values, measured = (
                factor * getattr(u, name) for u in (self.uncertainty, self.measured)
            )
            ratio = getattr(self, f"{name}_ratio")
            lines.append(
                f"{name:<12} median {np.nanmedian(values):.3g} {symbol}, largest "
                f"{np.nanmax(values):.3g} {symbol}; largest at measured poses "
                f"{np.nanmax(measured):.3g} {symbol} (ratio up to {np.nanmax(ratio):.3g})"
            )
        lines.append(
            f"{int(self.extrapolated.sum())} of {n} poses are less certain than every measured pose"
        )
        return "\n".join(lines)

    __repr__ = __str__

    def to_dict(self) -> dict[str, Any]:
        """Return the map by name for JSON, SI."""
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
    poses: ArrayLike | int = 400,
    seed: int = 0,
    axes: Axes = "base",
    frame: str = FITTED,
) -> AccuracyMap:
    """Compute the uncertainty of poses over the workspace, and compare it with the measured poses.

    Parameters
    ----------
    fit : the identification, or the posterior of a run folder.
    measured : (m, a) readings of the measured poses, as in `Measurements.readings` [m, rad].
    poses : (n, c) controlled coordinates, for instance a grid, or the number of poses to draw from
        the robot's workspace.
    seed : of that draw. axes : of the components. frame : see `pose_uncertainty`; "relative" means
        relative to the home pose.

    Raises
    ------
    MechanismError : poses are to be drawn, and the robot states no workspace.
    """
    robot = (fit.posterior if isinstance(fit, Identification) else fit).robot
    coordinates = resolve_poses(robot, poses, seed)
    home = solve_home(robot)
    compute = partial(
        pose_uncertainty, fit, axes=axes, frame=frame, origin=home, origin_name="home"
    )
    return AccuracyMap(
        names=robot.controlled,
        coordinates=coordinates,
        uncertainty=compute(poses=coordinates),
        measured=compute(poses=forward(robot, measured)),
    )


def _ratio(values: FloatArray, reference: FloatArray) -> FloatArray:
    """Return values over the largest reference; 1 where both are infinite or both are zero."""
    largest = float(np.nanmax(reference))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(values == largest, 1.0, values / largest)
