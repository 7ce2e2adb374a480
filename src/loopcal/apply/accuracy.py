# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of the poses of a calibrated machine, anywhere in its workspace.

    covariance = D C D' + J_q S_q J_q'        expanded uncertainty U = k sqrt(diag)

with the error model D = d twist / d parameter, the covariance C of the parameters, and the
variances S_q of the readings where the actuators have a sigma. D refers to a frame, see
`loopcal.diagnose.error_frames`: motions of the base and platform frames that the measurements do
not determine are no errors, and the result says so. A direction that the data do not determine
makes those components infinite that it moves in this frame, and no others. k is 2 where the noise
is known, and that of Student's t for the effective degrees of freedom where it was estimated. JCGM
100; derivation: docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from loopcal import geometry
from loopcal.checks import check_choice
from loopcal.diagnose import error_frames
from loopcal.diagnose.fit_examination import ROUNDING
from loopcal.diagnose.gauge_freedoms import NO_MOTION, twist_weights
from loopcal.engine import State
from loopcal.errors import EstimationError
from loopcal.estimate.identification import (
    IdentifiedTrials,
    compute_trial_posterior,
    identify_trials,
)
from loopcal.estimate.penalties import LeastSquares, Method
from loopcal.estimate.posterior import NOISE, Posterior, combine_degrees
from loopcal.estimate.residual_test import LEVEL, coverage_factor
from loopcal.estimate.result import Identification
from loopcal.findings import Finding
from loopcal.measure.instrument import Instrument
from loopcal.measure.simulation import Trials, sample_truth, simulate_trials
from loopcal.mechanism.assembly import AXES, TWIST_UNITS
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import list_dimensions
from loopcal.mechanism.solutions import Solution, forward, inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import resolve_poses
from loopcal.numerics.statistics import compute_f_quantile
from loopcal.results.description import Field, fields, label_axes, within
from loopcal.results.result import DrawnResult, TableResult
from loopcal.typing import BoolArray, FloatArray, Progress, report_no_progress

BLOCK = 1024  # poses whose sensitivities are in memory at once
BATCH = 250  # trials that are identified at once; progress is reported between them

Axes = Literal["base", "platform"]
Point = Literal["tool", "platform"]


class PoseDegrees(NamedTuple):
    """Effective degrees of freedom (Welch-Satterthwaite) of the components (n, 6), and of the
    lengths (n,) of the displacement and of the rotation.
    """

    components: FloatArray
    position: FloatArray
    orientation: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class PoseUncertainty(TableResult):
    """Uncertainty of n poses.

    The components are those of `AXES`: a small rotation, then the displacement of the point.

    Attributes
    ----------
    T : (n, 4, 4) platform poses of the calibrated robot; NaN where a pose is unreachable.
    covariance : (n, 6, 6) [rad, m]; infinite on the diagonal (and NaN beside it) where the data do
        not determine a component.
    reference : point, axes and frame to which the numbers refer, as a finding `accuracy.frame`.
    degrees : effective degrees of freedom of the size of the uncertainty; infinite where the noise
        is known.
    """

    T: FloatArray
    covariance: FloatArray
    reference: Finding
    degrees: PoseDegrees

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("frame", "coverage_factor", "degrees", components=lambda _: AXES),
        Field("position", axes="pose", unit="m", key="position_rms"),
        Field("orientation", axes="pose", unit="rad", key="orientation_rms"),
        Field("sd", axes="pose component", unit=TWIST_UNITS),
        Field("expanded", axes="pose component", unit=TWIST_UNITS, key="expanded"),
        *fields(position_95="expanded_position", orientation_95="expanded_orientation"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(component=AXES)

    @property
    def frame(self) -> str:
        """Point, axes and frame in words."""
        return str(self.reference)

    @property
    def sd(self) -> FloatArray:
        """(n, 6) standard deviations [rad, m]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def coverage_factor(self) -> FloatArray:
        """(n, 6) factor k of each component for a coverage of 95 %, of Student's t."""
        return coverage_factor(self.degrees.components)

    @property
    def expanded(self) -> FloatArray:
        """(n, 6) expanded uncertainty U = k sd of each component, 95 % [rad, m]."""
        return self.coverage_factor * self.sd

    @property
    def expanded_position(self) -> FloatArray:
        """(n,) length that 95 % of the displacements of the point do not exceed [m]."""
        return expand_length(self.covariance[:, 3:, 3:], self.degrees.position)

    @property
    def expanded_orientation(self) -> FloatArray:
        """(n,) angle that 95 % of the rotations of the platform do not exceed [rad]."""
        return expand_length(self.covariance[:, :3, :3], self.degrees.orientation)

    @property
    def position(self) -> FloatArray:
        """(n,) root mean square of the displacement of the point [m]."""
        return np.sqrt((self.sd[:, 3:] ** 2).sum(axis=1))

    @property
    def orientation(self) -> FloatArray:
        """(n,) root mean square of the rotation of the platform [rad]."""
        return np.sqrt((self.sd[:, :3] ** 2).sum(axis=1))


def pose_uncertainty(
    fit: Identification | Posterior,
    poses: ArrayLike | Solution,
    axes: Axes = "base",
    frame: str = error_frames.FITTED,
    point: Point = "tool",
    origin: Solution | None = None,
    origin_name: str = "1",
) -> PoseUncertainty:
    """Compute the uncertainty of poses of the calibrated robot.

    Parameters
    ----------
    fit : the identification, or the posterior of a run folder.
    poses : (n, 4, 4) T_base_platform, (n, c) controlled coordinates [m, rad], or a solution of the
        calibrated robot. Readings are not poses: pass `forward(fit.robot, readings)` for them.
    axes : of the components.
    frame : in which the errors are stated. "fitted": after the best rigid fit, over the measured
        poses, of the base and platform frames as far as the measurements do not determine them.
        "base": in the base frame of the robot file. "relative": relative to the pose `origin`. Or
        the name of the frame of an instrument, such as "tracker".
    point : the point whose displacement is meant: that of the tool, or the platform's origin.
    origin : solution of one pose; default: the first of `poses`. origin_name : its name.

    Returns
    -------
    PoseUncertainty; NaN where a pose is unreachable or no interval can be given.

    Raises
    ------
    EstimationError : an option that is not allowed, or an unreachable `origin`.
    """
    check_choice("axes", axes, get_args(Axes))
    check_choice("point", point, get_args(Point))
    posterior = fit.posterior if isinstance(fit, Identification) else fit
    robot = posterior.robot
    solution = poses if isinstance(poses, Solution) else inverse(robot, poses)
    if frame == error_frames.RELATIVE and origin is None:
        origin = solution.take(np.arange(1))
    chosen = error_frames.choose_error_frame(posterior, frame, origin, origin_name)
    blocks = []
    for first in range(0, len(solution.q), BLOCK):
        rows = np.arange(first, min(first + BLOCK, len(solution.q)))
        H = transport(robot, solution.T[rows], axes, point)
        blocks.append(_compute_covariance(posterior, solution.take(rows), chosen, H))
    T = np.where(solution.converged[:, None, None], solution.T, np.nan)
    covariance, *degrees = (np.concatenate(arrays) for arrays in zip(*blocks, strict=True))
    return PoseUncertainty(T, covariance, chosen.describe(point, axes), PoseDegrees(*degrees))


def _compute_covariance(
    posterior: Posterior, solution: Solution, frame: error_frames.ErrorFrame, H: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the covariance (n, 6, 6) of poses, and its degrees of freedom as `PoseDegrees`.

    H (n, 6, 6) takes twists in base axes to the wanted point and axes.
    """
    errors, squares = error_frames.linearize_tool_errors(posterior, solution, frame, H), []
    if (slow := posterior.discrepancy) is not None:
        squares += slow.split_squares(errors.by_discrepancy[..., : -len(slow.degrees)])
        posterior = posterior.without_discrepancy
    D, others = errors.by_parameters, (errors.by_frame, errors.by_discrepancy, errors.by_readings)
    covariance = combine_errors(
        posterior.robot,
        D[None],
        posterior.directions[None],
        posterior.variance[None],
        errors.size[None],
        tuple(part[None] for part in others),
    )[0]
    covariance[~solution.converged] = np.nan
    # variances (n, 6) and degrees of freedom of the parts
    for part in posterior.parts:
        square = ((D @ (part.root / posterior.unit[:, None])) ** 2).sum(axis=2)
        if part.source == NOISE:  # errors of the frame itself count as noise
            square += (errors.by_frame**2).sum(axis=2)
        squares.append((square, part.degrees))
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    position, orientation = (
        combine_degrees(
            variance[:, chosen].sum(axis=1), [(s[:, chosen].sum(axis=1), nu) for s, nu in squares]
        )
        for chosen in (slice(3, 6), slice(0, 3))
    )
    return covariance, combine_degrees(variance, squares), position, orientation


def combine_errors(
    robot: Mechanism,
    D: FloatArray,
    directions: FloatArray,
    variance: FloatArray,
    size: FloatArray,
    others: tuple[FloatArray, ...] = (),
) -> FloatArray:
    """Return the covariance (t, n, 6, 6) of the errors of n poses of t machines; infinite on the
    diagonal (and NaN beside it) where the data do not determine a component.

    D : (t, n, 6, p) errors by the parameters in their units, of a point in a frame.
    directions, variance : (t, p, p), (t, p) as in `Posterior`.
    size : (t, n) of the effect of all parameters, rotations times the robot's size.
    others : (t, n, 6, k) effects of other independent errors of variance 1.
    """
    is_infinite = np.isinf(variance)
    known = directions * np.sqrt(np.where(is_infinite, 0.0, variance))[:, None, :]
    root = np.concatenate([D @ known[:, None], *others], axis=3)
    # such as at the pose to which errors are relative
    is_rounding = (
        np.linalg.norm(root, axis=3) < ROUNDING * twist_weights(robot.size)[[3, 3, 3, 0, 0, 0]]
    )
    root[is_rounding] = 0.0
    covariance = root @ root.swapaxes(2, 3)
    if is_infinite.any():
        unknown = np.where(is_infinite[:, None, :], directions, 0.0)
        moved = np.linalg.norm(D @ unknown[:, None], axis=3) * twist_weights(robot.size)
        lost = moved > NO_MOTION * size[..., None]
        covariance[lost[..., :, None] | lost[..., None, :]] = np.nan
        trial, pose, component = np.nonzero(lost)
        covariance[trial, pose, component, component] = np.inf
    return covariance


def expand_length(covariance: FloatArray, left: FloatArray) -> FloatArray:
    """Return lengths (n,) that a vector of covariance (n, 3, 3) exceeds in 5 % of cases.

    The square of a normal vector is a sum of weighted chi-square variables; its distribution is
    that of `c` times a chi-square variable of h degrees of freedom with the same mean and variance
    (Satterthwaite, Biometrics Bulletin 2(6) 110, 1946, doi 10.2307/3002019). With one direction it
    is exact. Where the size of the covariance has `left` (n,) degrees of freedom, it is that of
    c h F(h, left).
    """
    mean = np.trace(covariance, axis1=1, axis2=2)
    square = (covariance * covariance).sum(axis=(1, 2))
    usable = np.isfinite(square) & (square > 0.0)
    degrees = np.where(usable, mean, 1.0) ** 2 / np.where(usable, square, 1.0)
    quantile = compute_f_quantile(degrees, np.where(usable, left, np.inf), 1.0 - LEVEL)
    length = np.sqrt(np.where(usable, mean, 0.0) * quantile)
    return np.where(usable, length, np.where(mean > 0.0, np.inf, mean))


def transport(robot: Mechanism, T: FloatArray, axes: Axes, point: Point) -> FloatArray:
    """Return (n, 6, 6) from twists of the platform origin, in base axes, to those of `point`."""
    R = T[:, :3, :3]
    arm = R @ robot.tool[:3, 3] if point == "tool" else np.zeros((len(T), 3))
    return geometry.transport_matrix(arm, R.swapaxes(1, 2) if axes == "platform" else None)


@dataclass(frozen=True, eq=False, repr=False)
class AccuracyMap(DrawnResult):
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

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("names"),
        Field(
            "commanded",
            "coordinates",
            "pose coordinate",
            units=lambda accuracy: list_dimensions(accuracy.names),
        ),
        Field("coordinates"),
        Field("extrapolated", axes="pose"),
        *within("uncertainty", PoseUncertainty.FIELDS),
        *fields("position_ratio", "orientation_ratio"),
        *fields(extrapolated=lambda accuracy: int(accuracy.extrapolated.sum())),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(component=AXES, coordinate="names")
    CAPTION: ClassVar[str] = "Poses of the map"

    @property
    def position_ratio(self) -> FloatArray:
        """(n,) uncertainty over the largest one at measured poses; above 1 the map extrapolates."""
        return _ratio(self.uncertainty.position, self.measured.position)

    @property
    def orientation_ratio(self) -> FloatArray:
        """(n,) orientation uncertainty divided by the largest at the measured poses."""
        return _ratio(self.uncertainty.orientation, self.measured.orientation)

    @property
    def extrapolated(self) -> BoolArray:
        """(n,) poses that are less certain than every measured pose."""
        return (self.position_ratio > 1.0) | (self.orientation_ratio > 1.0)

    def __str__(self) -> str:
        n = len(self.coordinates)
        lines = [f"Pose uncertainty (rms) at {n} poses: {self.uncertainty.frame}"]
        for name, symbol in (("position", "mm"), ("orientation", "mrad")):
            values, measured = (1e3 * getattr(u, name) for u in (self.uncertainty, self.measured))
            ratio = getattr(self, f"{name}_ratio")
            lines.append(
                f"{name:<12} median {np.nanmedian(values):.3g} {symbol}, largest "
                f"{np.nanmax(values):.3g} {symbol}; largest at measured poses "
                f"{np.nanmax(measured):.3g} {symbol} (ratio up to {np.nanmax(ratio):.3g})"
            )
        count = int(self.extrapolated.sum())
        return "\n".join(
            [*lines, f"{count} of {n} poses are less certain than every measured pose"]
        )


def accuracy_map(
    fit: Identification | Posterior,
    measured: ArrayLike,
    poses: ArrayLike | int = 400,
    seed: int = 0,
    axes: Axes = "base",
    frame: str = error_frames.FITTED,
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
    home = error_frames.solve_home(robot)
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


@dataclass(frozen=True, eq=False, repr=False)
class AccuracySimulation(TableResult):
    """Predicted and observed errors of n poses.

    Attributes
    ----------
    predicted : of the fit of the first trial, with its frame: platform origin, base axes.
    observed : (n, 6) root mean square error [rad, m].
    trials, failed : number of fits that converged, and that did not.
    """

    predicted: PoseUncertainty
    observed: FloatArray
    trials: int
    failed: int

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("predicted", "predicted.sd", "pose component", TWIST_UNITS),
        Field("observed", axes="pose component", unit=TWIST_UNITS),
        Field("ratio", axes="pose component", unit="1"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(component=AXES)

    def __str__(self) -> str:
        return f"{self.trials} trials, {self.failed} did not converge; {self.predicted.frame}"

    @property
    def ratio(self) -> FloatArray:
        """(n, 6) observed over predicted; NaN where the prediction is infinite or zero."""
        sd = self.predicted.sd
        valid = np.isfinite(sd) & (sd > 0.0)
        return np.divide(self.observed, sd, out=np.full(sd.shape, np.nan), where=valid)


def simulate_accuracy(
    robot: Mechanism,
    commanded: ArrayLike,
    instrument: Instrument,
    poses: ArrayLike,
    method: Method | None = None,
    trials: int = 2000,
    seed: int = 0,
    progress: Progress = report_no_progress,
) -> AccuracySimulation:
    """Compare predicted with observed errors of poses.

    Parameters
    ----------
    robot : its spreads are those of the true errors, which each trial draws anew.
    commanded : measured poses, (m, 4, 4) or (m, c). instrument : with what they are measured.
    poses : compared poses, (n, 4, 4) or (n, c), at the readings of the nominal robot.
    method : default least squares. trials : their number. seed : of all random streams.
    progress : receives the trials that are done.

    Raises
    ------
    EstimationError : no trial converged.
    """
    truth = sample_truth(robot, trials, seed)
    measured = simulate_trials(robot, truth, commanded, instrument, seed)
    compared = inverse(robot.nominal, poses)
    method = method or LeastSquares()
    posterior, squares, converged = None, np.zeros((len(compared.q), 6)), 0
    for first in range(0, trials, BATCH):
        progress(first, trials, "calibrating simulated machines")
        chosen = slice(first, first + BATCH)
        batch = replace(
            measured,
            measured=tuple(values[chosen] for values in measured.measured),
            truth=truth[chosen],
            T=measured.T[chosen],
            reached=measured.reached[chosen],
            recorded=None if measured.recorded is None else measured.recorded[chosen],
        )
        fits = identify_trials(robot, batch, method)
        valid, errors = _compare_with_truth(fits, batch, compared.q, compared.state)
        if posterior is None and valid.any():
            posterior = compute_trial_posterior(fits, batch, int(np.flatnonzero(valid)[0]))
        if posterior is None:
            continue
        frames = error_frames.fit_unfixed_frames(posterior)
        if frames.motions.shape[1]:
            closed, reference = _compare_with_truth(fits, batch, measured.readings)
            valid &= closed
            errors = frames.remove(errors, compared.T, reference)
        errors = errors[valid]
        squares += (errors**2).sum(axis=0)
        converged += len(errors)
    if posterior is None:
        raise EstimationError(f"none of the {trials} trials converged. Check poses and method")
    predicted = pose_uncertainty(posterior, forward(posterior.robot, compared.q), point="platform")
    observed = np.sqrt(squares / converged)
    return AccuracySimulation(predicted, observed, converged, trials - converged)


def _compare_with_truth(
    fits: IdentifiedTrials, trials: Trials, readings: FloatArray, start: State | None = None
) -> tuple[BoolArray, FloatArray]:
    """Return which trials (t,) have a fit and all poses at readings, and their errors (t, n, 6)."""
    states = [
        forward_trials(fits.free_parameters.robot, values, readings[None], start)
        for values in (fits.values, trials.truth)
    ]
    is_closed = [(state.status == Status.CONVERGED).all(axis=1) for state in states]
    valid = fits.converged & is_closed[0] & is_closed[1]
    return valid, geometry.pose_difference(states[0].T, states[1].T)
