# SPDX-License-Identifier: Apache-2.0
"""Examine a fit in one call: outliers, heavy tails, lack of fit, common errors, correlations,
expected gain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, ClassVar

import numpy as np

from loopcal.diagnose import error_causes, error_frames
from loopcal.diagnose.adjusted_uncertainty import HeavyTails, check_heavy_tails
from loopcal.diagnose.model_discrepancy import LackOfFit, check_lack_of_fit
from loopcal.diagnose.outliers import OutlierCheck, find_outliers
from loopcal.diagnose.residual_patterns import CAUSE, linearize_examined
from loopcal.diagnose.value_comparison import compare_with_truth
from loopcal.errors import EstimationError
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.residual_test import FEWEST_DEGREES, SIGNIFICANCE
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.transmission import SOURCE
from loopcal.numerics.elimination import find_connected_groups
from loopcal.numerics.statistics import compute_f_tail, find_distinct
from loopcal.plain_text import represent
from loopcal.results.description import Field, fields
from loopcal.results.result import Result
from loopcal.results.tables import Block, choose_unit, to_quantity
from loopcal.typing import Progress, report_no_progress
from loopcal.units import Dimension

STRONG = 0.9  # correlation above which one error is mostly another (81 % of its variance)


@dataclass(frozen=True)
class CorrelatedGroup:
    """Parameters that correlations of estimates above STRONG link, directly or in a chain."""

    names: tuple[str, ...]  # in the order of the table
    pair: tuple[str, str]  # the two most strongly correlated ones
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
    group = find_connected_groups(np.argwhere(linked), len(rho))
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

    finding: Finding  # the expected errors, or the reason why there are none
    position_before: float = np.nan  # root mean square over poses [m]
    position_after: float = np.nan
    angle_before: float = np.nan  # of the orientation [rad]
    angle_after: float = np.nan
    is_worthwhile: bool | None = None  # whether either becomes smaller; None where it is not known

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("position_before", "position_after", "angle_before", "angle_after", "finding"),
        calibrate="is_worthwhile",
    )


def estimate_calibration_gain(
    fit: Identification, data: Measurements, frame: str = error_frames.FITTED
) -> CalibrationGain:
    """Compare the errors expected after calibration with those that the stated spreads allow.

    data : the measurements that were fitted, or other readings. frame : in which the errors are
        stated, see `choose_error_frame`; "relative" means relative to the home pose.
    """
    free = fit.free_parameters
    missing, is_contradicted = int(free.assumed.sum()), fit.residual_test.failed
    unknown = report_finding("model.gain-unknown", missing=missing, is_contradicted=is_contradicted)
    if missing or is_contradicted:
        return CalibrationGain(unknown)
    solution = error_frames.locate_measured_poses(fit, data, MOST_POSES)
    # S with S S' the covariance of the estimate; undetermined directions keep their tolerance
    posterior = fit.posterior.without_discrepancy
    variance = np.where(np.isinf(posterior.variance), 1.0, posterior.variance)
    factor = posterior.directions * np.sqrt(variance)
    if not len(solution.q) or np.isnan(factor).any():
        return CalibrationGain(unknown)
    effects = error_frames.linearize_tool_errors(fit.posterior, solution, frame)
    D, own = effects.by_parameters, (effects.by_frame, effects.by_discrepancy)
    expected = (D * (free.tolerance / posterior.unit)) @ free.correlation_root()
    squares = map(
        error_frames.compute_mean_squares, (expected, np.concatenate([D @ factor, *own], axis=2))
    )
    # before and after, by orientation and position: 0 where they are rounding, such as the
    # orientation of a delta
    limits = (ROUNDING, ROUNDING * fit.robot.size)
    angles, positions = (
        tuple(root * (root > limit) for root in map(float, np.sqrt(pair)))
        for pair, limit in zip(zip(*squares, strict=True), limits, strict=True)
    )
    pairs = {Dimension.LENGTH: positions, Dimension.ANGLE: angles}
    is_worthwhile = any(before > GAIN * after for before, after in pairs.values() if before > 0.0)
    units = {d: choose_unit(fit.robot.get_unit(d), [min(pair)]) for d, pair in pairs.items()}
    position, orientation = (
        tuple(to_quantity(size, unit) for size in pairs[dimension])
        if pairs[dimension][0] > 0.0
        else None
        for dimension, unit in units.items()
    )
    finding = report_finding(
        "model.expected-gain" if is_worthwhile else "model.no-expected-gain",
        position=position,
        orientation=orientation,
        **effects.reference.data,
    )
    (before, after), (angle_before, angle_after) = positions, angles
    return CalibrationGain(finding, before, after, angle_before, angle_after, is_worthwhile)


@dataclass(frozen=True, eq=False)
class FitExamination(Result):
    """The results of all examinations of a fit by its own data.

    Attributes
    ----------
    outliers : poses that do not fit the others. lack_of_fit : the test against repeated poses.
    correlated : groups of strongly correlated parameters. gain : expected errors before and after.
    tails : the test of the other residuals for heavy tails. causes : of the outliers, where the fit
        names none.
    """

    outliers: OutlierCheck
    lack_of_fit: LackOfFit
    correlated: tuple[CorrelatedGroup, ...]
    gain: CalibrationGain
    tails: HeavyTails
    causes: tuple[Finding, ...] = ()

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("outliers", "lack_of_fit", "correlated"),
        worth="gain",
        heavy_tails="tails",
        findings="findings",
    )

    __repr__ = represent

    def page(self) -> list[Block]:
        """Return the findings."""
        lines = (f"{f.severity.value}: {f}" for f in self.findings)
        return ["\n".join(lines) or "no findings"]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, the most important ones first."""
        findings = [*self.outliers.findings, *self.causes, *self.tails.findings]
        if self.gain.is_worthwhile is not None:
            findings.insert(len(findings) if self.gain.is_worthwhile else 0, self.gain.finding)
        lack = self.lack_of_fit
        findings += [f for f in lack.findings if lack.groups or f.code == "residuals.no-repeats"]
        return (*findings, *(group.finding for group in self.correlated))


def examine_fit(
    fit: Identification,
    data: Measurements,
    progress: Progress = report_no_progress,
    frame: str = error_frames.FITTED,
    linear: FitLinearization | None = None,
) -> FitExamination:
    """Examine a fit with the data it was made from.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    progress : receives the rounds of the search for outliers, which takes longest, and that the
        other tests begin.
    frame : in which expected errors are stated, see `choose_error_frame`.
    linear : the linearized fit, see `linearize_fit`.
    """
    outliers, causes = find_outliers(fit, data, progress=progress), ()
    sizes: list[Finding] = []
    progress(0, 1, "testing for heavy tails")
    if fit.converged and fit.residual_test.intervals:
        linear = linearize_examined(fit, data, linear)
    known = [f for f in fit.findings if f.code == CAUSE]
    if outliers.suspects and not known and linear is not None:
        explained = error_causes.explain_residuals(linear, is_doubted=True)
        causes = tuple(cause.finding for cause in explained.causes)
        sizes = error_causes.measure_picture_errors(linear, explained)
    found = [f.data["cause"] for f in (*known, *causes)]
    if error_causes.OUTLIERS in found:
        sizes = error_causes.find_swapped_pictures(fit, data, outliers.suspects)
    shown = outliers
    if (
        outliers.suspects
        and found
        and {error_causes.OUTLIERS, error_causes.ZOOMED}.isdisjoint(found)
    ):
        name = next(f.data["name"] for f in (*known, *causes))
        explained = report_finding(
            "outliers.explained", poses=outliers.suspects, cause=found[0], name=name
        )
        shown = replace(outliers, outliers=(), ambiguous=(), summary=(explained,))
    return FitExamination(
        shown,
        check_lack_of_fit(fit, data),
        find_correlated_groups(fit),
        estimate_calibration_gain(fit, data, frame),
        check_heavy_tails(fit, data, outliers.suspects, linear),
        (*causes, *sizes),
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
    _, drives = robot.present
    # values of the driven joints, or of their sums; a condition has none
    own, joint = ~drives.fixed_rows, np.full_like(reading, np.nan)
    values = [drives.transmit(q[None])[0][:, own] for q in (recorded, estimated)]
    joint[:, drives.constants[own, SOURCE].astype(int)] = values[0] - values[1]
    joint[~compared] = np.nan
    limbs = robot.assembly.limbs
    turning = {joint.actuator for limb in limbs for joint in limb.joints if joint.kind == "R"}
    dimensions = [
        Dimension.LENGTH if turning.isdisjoint(a.driven_joints) else Dimension.ANGLE
        for a in robot.actuators
    ]
    errors = []
    for i, actuator in enumerate(robot.actuators):
        if not np.isfinite(joint[:, i]).any():
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


# Whether the geometry from which a fit starts is as good as the fit. Where the start is the truth
# and the noise is as stated, the gain chi_square(start) - chi_square(fit) has a chi-square
# distribution with as many degrees of freedom as fitted directions. Where the noise is not stated,
# or contradicts the residuals of the fit, the gain per direction over the residual per degree of
# freedom has an F distribution.
#
# Klipper's fit of a delta printer minimizes w * sum(height error^2) + sum(distance error^2) with w
# = number of distances / (number of heights / 2) where there are distances, and 1 otherwise, over
# radius, two tower angles and three end stops, and over the arms where there are distances (source:
# the module `delta_calibrate` of Klipper). With sigmas of 1 mm / sqrt(w) and 1 mm this is the chi-
# square in mm^2 of `identify`, so the stored values can be checked against the optimum.

# Share of the start's cost below which a gain is rounding: the last digits of a file.
NO_GAIN = 1e-3
MM = 1e-3
SMALL = 0.01  # changes below this are not listed [mm, deg]


class StartVerdict(Enum):
    """The start values of a fit, compared with the fit."""

    BEST = "best"
    WITHIN_NOISE = "within noise"
    WITHIN_ERRORS = "within noise and other errors"
    NOT_CALIBRATED = "not calibrated"
    OPEN = "open"


@dataclass(frozen=True)
class StartCheck:
    """The geometry from which a fit started, compared with the fit."""

    verdict: StartVerdict
    before: float  # rms of the residuals of the start in units of the stated sigma [1]
    after: float  # and of the fit
    p_value: float  # of such a gain if the start is the truth; NaN where there is no test
    finding: Finding  # the result

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        verdict="verdict.value", before="", after="", p_value="", finding=""
    )


@dataclass(frozen=True)
class StoredAnswer(Result):
    """A stored geometry and the optimum of the firmware's cost, from the same probes."""

    stored: float  # its cost [mm^2]
    best: float
    # parameter, stored value, best value and unit, of those that differ
    moved: tuple[tuple[str, float, float, str], ...]

    @property
    def finding(self) -> Finding:
        """The comparison as a finding."""
        if self.stored - self.best <= NO_GAIN * self.stored:  # the decimals of a file
            return report_finding("residuals.stored-is-optimum", stored=self.stored, best=self.best)
        return report_finding("residuals.stored-not-optimum", **vars(self))


def check_start_values(fit: Identification) -> StartCheck:
    """Compare the geometry from which a fit started with the fit, on the fitted measurements."""
    first, last = float(fit.history.cost[0]), float(fit.history.cost[-1])
    rows = sum(int(np.isfinite(r.raw).sum()) for r in fit.residuals)
    before, after = np.sqrt(first / rows), np.sqrt(last / rows)

    def judged(verdict: StartVerdict, p_value: float, code: str, **data: Any) -> StartCheck:
        finding = report_finding(f"residuals.start-{code}", **data)
        return StartCheck(verdict, before, after, p_value, finding)

    if not fit.converged:
        return judged(StartVerdict.OPEN, float("nan"), "not-comparable")
    gain = max(first - last, 0.0)
    if gain <= NO_GAIN * first:
        return judged(StartVerdict.BEST, 1.0, "is-best")
    test = fit.residual_test
    # the stated noise explains the residuals of the fit, or none are left
    is_consistent = test.noise == "given" and not test.failed
    p_value = float("nan")  # of a larger gain by the noise that the fit states; without any, none
    if test.sigma_scale > 0.0:
        each = gain / fit.rank / test.sigma_scale**2
        p_value = float(compute_f_tail(fit.rank, test.noise_degrees, each))
    is_beyond_noise = p_value < SIGNIFICANCE
    if is_beyond_noise and any(part.is_added for part in fit.posterior.parts):
        # errors that the residuals show beside noise explain a gain, too
        p_value = max(p_value, compare_with_truth(fit, fit.initial.values).p_value)
    ratio = float(before / after) if after > 0.0 else None
    if p_value < SIGNIFICANCE:
        return judged(StartVerdict.NOT_CALIBRATED, p_value, "not-calibrated", ratio=ratio)
    if test.dof < FEWEST_DEGREES and not is_consistent:
        return judged(StartVerdict.OPEN, p_value, "needs-sigma", ratio=ratio)
    if test.failed:
        return judged(StartVerdict.OPEN, p_value, "undecided", ratio=ratio)
    if is_beyond_noise:
        return judged(StartVerdict.WITHIN_ERRORS, p_value, "within-errors", ratio=ratio)
    return judged(StartVerdict.WITHIN_NOISE, p_value, "within-noise", ratio=ratio)


def compare_stored_geometry(robot: Mechanism, measured: Measurements) -> StoredAnswer | None:
    """Compare the stored geometry of a printer with the optimum of the firmware's cost; None where
    the probes do not determine one.

    measured : heights and distances; their sigmas do not matter.
    """
    count = {o.kind.poses_per_row: len(o) for o in measured.observations}
    w = 2.0 * count[2] / count[1] if count.get(1) and count.get(2) else 1.0
    sigma = {1: MM / np.sqrt(w), 2: MM}
    weighted = tuple(
        Observations.from_sigma(o.kind, o.rows, o.measured, sigma[o.kind.poses_per_row])
        for o in measured.observations
    )
    try:
        fit = identify(robot, replace(measured, observations=weighted), LeastSquares())
    except EstimationError:
        return None  # fewer probes than parameters, or a geometry that cannot reach them
    if not fit.converged or fit.rank < len(fit.names):
        return None
    units = [robot.get_unit(dimension) for dimension in fit.free_parameters.dimensions]
    scale = np.array([unit.factor_to_si for unit in units])
    stored = fit.initial.values[fit.free_parameters.places] / scale
    best, symbols = fit.estimate / scale, [unit.symbol for unit in units]
    return StoredAnswer(
        float(fit.history.cost[0]),
        float(fit.history.cost[-1]),
        tuple(
            (name, float(first), float(last), symbol)
            for name, first, last, symbol in zip(fit.names, stored, best, symbols, strict=True)
            if abs(last - first) > SMALL
        ),
    )
