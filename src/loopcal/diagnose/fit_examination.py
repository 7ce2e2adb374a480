# SPDX-License-Identifier: Apache-2.0
"""Examine a fit in one call: outliers, heavy tails, lack of fit, common errors, correlations,
expected gain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from loopcal.diagnose.adjusted_uncertainty import HeavyTails, check_heavy_tails
from loopcal.diagnose.cluster_covariance import ClusterCheck, check_clusters
from loopcal.diagnose.error_frames import (
    FITTED,
    compute_mean_squares,
    linearize_tool_errors,
    locate_measured_poses,
)
from loopcal.diagnose.model_discrepancy import LackOfFit, check_lack_of_fit
from loopcal.diagnose.outliers import OutlierCheck, find_outliers
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import prepare_fitted_data
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.transmission import transmit_readings
from loopcal.numerics.statistics import find_distinct
from loopcal.results.description import Field, fields
from loopcal.results.result import Result
from loopcal.typing import FloatArray, Progress, report_no_progress
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.results.tables import Block


# Correlation above which the error of one parameter is mostly that of another (81 % of its
# variance).
STRONG = 0.9


@dataclass(frozen=True)
class CorrelatedGroup:
    """Parameters that correlations of estimates above STRONG link, directly or in a chain."""

    names: tuple[str, ...]  # in the order of the table
    # pair, correlation: the two most strongly correlated ones
    pair: tuple[str, str]
    correlation: float

    FIELDS: ClassVar[tuple[Field, ...]] = fields("*", "finding")

    @property
    def finding(self) -> Finding:
        """The group as a finding."""
        return report_finding("residuals.correlated-parameters", **vars(self))


def find_correlated_groups(fit: Identification) -> tuple[CorrelatedGroup, ...]:
    """Return the groups of strongly correlated parameters, the largest correlation first."""
    sd = fit.standard_deviations
    finite = np.isfinite(sd) & (sd > 0.0)
    scale = np.where(finite, 1.0 / np.where(finite, sd, 1.0), np.nan)
    rho = np.where(finite[:, None] & finite, fit.covariance, np.nan) * scale[:, None] * scale
    linked = np.where(np.isnan(rho), 0.0, np.abs(rho)) > STRONG
    np.fill_diagonal(linked, val=False)
    group = np.arange(len(rho))
    for i, j in np.argwhere(linked):
        group[group == group[j]] = group[i]
    groups = []
    for number in find_distinct(group[linked.any(axis=1)]):
        places = np.flatnonzero(group == number)
        inner = np.where(linked[np.ix_(places, places)], np.abs(rho[np.ix_(places, places)]), 0.0)
        a, b = (places[k] for k in np.unravel_index(int(np.argmax(inner)), inner.shape))
        a, b = min(a, b), max(a, b)
        names = tuple(fit.names[i] for i in places)
        groups.append(CorrelatedGroup(names, (fit.names[a], fit.names[b]), float(rho[a, b])))
    return tuple(sorted(groups, key=lambda g: -abs(g.correlation)))


GAIN = 1.1  # factor by which an expected error must become smaller to count as an improvement
# Expected errors below this share of the robot's size, or this angle [rad], are rounding.
ROUNDING = 1e-12
MOST_POSES = 200  # largest number of poses at which errors are predicted, evenly chosen


@dataclass(frozen=True)
class CalibrationGain:
    """Expected errors of the platform at the measured poses."""

    # position_before, position_after: expected position error, root mean square over poses [m]
    position_before: float
    position_after: float
    # angle_before, angle_after: the same of the orientation [rad]
    angle_before: float
    angle_after: float
    is_worthwhile: bool | None  # whether either becomes smaller; None where it cannot be predicted
    finding: Finding  # the expected errors, or the reason why there are none

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("position_before", "position_after", "angle_before", "angle_after", "finding"),
        calibrate="is_worthwhile",
    )


def estimate_calibration_gain(
    fit: Identification, data: Measurements, frame: str = FITTED
) -> CalibrationGain:
    """Compare the errors expected after calibration with those that the stated tolerances allow.
    data : the measurements that were fitted, or other readings. frame : in which the errors are
        stated, see `choose_error_frame`; "relative" means relative to the home pose.
    """

    def predict_nothing(code: str, **data: Any) -> CalibrationGain:
        nan = float("nan")
        return CalibrationGain(nan, nan, nan, nan, None, report_finding(code, **data))

    free = fit.free_parameters
    if free.assumed.any():
        return predict_nothing("model.gain-needs-tolerances", missing=int(free.assumed.sum()))
    if fit.residual_test.failed:
        return predict_nothing("model.gain-needs-consistent-noise")
    solution = locate_measured_poses(fit, data, MOST_POSES)
    # S with S S' the covariance of the estimate; undetermined directions keep their tolerance
    posterior = fit.posterior.without_discrepancy
    variance = np.where(np.isinf(posterior.variance), 1.0, posterior.variance)
    factor = posterior.directions * np.sqrt(variance)
    if not len(solution.q) or np.isnan(factor).any():
        return predict_nothing("model.gain-without-intervals")
    effects = linearize_tool_errors(fit.posterior, solution, frame)
    D, own = effects.by_parameters, (effects.by_frame, effects.by_discrepancy)
    size = fit.robot.size
    angle_before, position_before = _rms_errors(
        (D * (free.tolerance / posterior.unit)) @ free.correlation_root(), size
    )
    angle_after, position_after = _rms_errors(np.concatenate([D @ factor, *own], axis=2), size)
    pairs = ((position_before, position_after), (angle_before, angle_after))
    is_worthwhile = any(before > GAIN * after for before, after in pairs if before > 0.0)
    finding = report_finding(
        "model.expected-gain" if is_worthwhile else "model.no-expected-gain",
        position=_quantities(fit.robot, Dimension.LENGTH, *pairs[0]),
        orientation=_quantities(fit.robot, Dimension.ANGLE, *pairs[1]),
        **effects.reference.data,
    )
    return CalibrationGain(
        position_before, position_after, angle_before, angle_after, is_worthwhile, finding
    )


def _rms_errors(factor: FloatArray, size: float) -> tuple[float, float]:
    """Return root mean squares of orientation [rad] and position [m] from factors (n, 6, k).

    They are 0 where they are rounding, such as the orientation of a delta of this size [m].
    """
    orientation, position = (float(np.sqrt(square)) for square in compute_mean_squares(factor))
    return orientation * (orientation > ROUNDING), position * (position > ROUNDING * size)


def _quantities(
    robot: Mechanism, dimension: Dimension, before: float, after: float
) -> tuple[Quantity, Quantity] | None:
    """Return errors before and after in the unit of the robot's file; None where they are zero."""
    if not before > 0.0:
        return None
    return robot.to_quantity(before, dimension), robot.to_quantity(after, dimension)


@dataclass(frozen=True, eq=False)
class FitExamination(Result):
    """The results of all examinations of a fit by its own data.

    Attributes
    ----------
    outliers : poses that do not fit the others. lack_of_fit : the test against repeated poses.
    clusters : the uncertainty that allows for common errors of a day, session or pose.
    correlated : groups of strongly correlated parameters. gain : expected errors before and after.
    tails : the test of the other residuals for heavy tails.
    """

    outliers: OutlierCheck
    lack_of_fit: LackOfFit
    clusters: ClusterCheck
    correlated: tuple[CorrelatedGroup, ...]
    gain: CalibrationGain
    tails: HeavyTails

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("outliers", "lack_of_fit", "clusters", "correlated"),
        worth="gain",
        heavy_tails="tails",
        findings="findings",
    )

    def page(self) -> list[Block]:
        """Return the findings."""
        lines = (f"{f.severity.value}: {f}" for f in self.findings)
        return ["\n".join(lines) or "no findings"]

    def __repr__(self) -> str:
        names = ", ".join(finding.code for finding in self.findings) or "none"
        return f"<FitExamination: findings: {names}>"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, the most important ones first."""
        findings = [*self.outliers.findings, *self.tails.findings]
        if self.gain.is_worthwhile is not None:
            findings.insert(len(findings) if self.gain.is_worthwhile else 0, self.gain.finding)
        if self.lack_of_fit.groups:
            findings += self.lack_of_fit.findings
        findings.append(self.clusters.finding)
        return (*findings, *(group.finding for group in self.correlated))


def examine_fit(
    fit: Identification,
    data: Measurements,
    progress: Progress = report_no_progress,
    frame: str = FITTED,
) -> FitExamination:
    """Examine a fit with the data it was made from.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    progress : receives the rounds of the search for outliers, which takes longest, and that the
        other tests begin.
    frame : in which expected errors are stated, see `choose_error_frame`.
    """
    prepared = prepare_fitted_data(fit, data)
    outliers = find_outliers(fit, data, progress=progress)
    progress(0, 1, "testing for common errors and heavy tails")
    linear = None
    if fit.converged and fit.residual_test.intervals:
        linear = linearize_fit(fit, prepared)
    return FitExamination(
        outliers,
        check_lack_of_fit(fit, data),
        check_clusters(fit, data, frame, linear),
        find_correlated_groups(fit),
        estimate_calibration_gain(fit, data, frame),
        check_heavy_tails(fit, data, outliers.suspects, linear),
    )


@dataclass(frozen=True)
class ReadingError:
    """Recorded minus estimated readings of one actuator.

    reading, joint : root mean square of the reading and of the driven joint [SI].
    largest : of the joint, by size, with its sign [SI]. pose : label of its pose.
    """

    name: str
    count: int
    reading: float
    reading_dimension: Dimension
    joint: float
    joint_dimension: Dimension
    largest: float
    pose: str


def compute_reading_errors(
    fit: Identification, data: Measurements
) -> tuple[ReadingError, ...] | None:
    """Compare recorded readings with the estimated ones; None where the readings are exact."""
    if fit.poses is None:
        return None
    robot, estimated, sigma = fit.robot, fit.poses.readings, fit.poses.sigma
    recorded = data.readings
    compared = np.isfinite(sigma) & (sigma > 0.0) & np.isfinite(recorded) & np.isfinite(estimated)
    reading = np.where(compared, recorded - estimated, np.nan)
    _, tau = robot.slots(robot.values[None])
    # values (n, a) of the driven joints, or of their sums
    joint_values = [
        transmit_readings(q[None], tau, robot.slots.frequency)[0] for q in (recorded, estimated)
    ]
    joint = np.where(compared, joint_values[0] - joint_values[1], np.nan)
    limbs = robot.assembly.limbs
    turning = {joint.actuator for limb in limbs for joint in limb.joints if joint.kind == "R"}
    dimensions = [
        Dimension.LENGTH if turning.isdisjoint(a.driven_joints) else Dimension.ANGLE
        for a in robot.actuators
    ]
    errors = []
    for i, actuator in enumerate(robot.actuators):
        if not compared[:, i].any():
            continue
        worst = int(np.nanargmax(np.abs(joint[:, i])))
        errors.append(
            ReadingError(
                name=actuator.name,
                count=int(compared[:, i].sum()),
                reading=float(np.sqrt(np.nanmean(reading[:, i] ** 2))),
                reading_dimension=actuator.dimension,
                joint=float(np.sqrt(np.nanmean(joint[:, i] ** 2))),
                joint_dimension=dimensions[i],
                largest=float(joint[worst, i]),
                pose=fit.poses.labels[worst],
            )
        )
    return tuple(errors) or None
