# SPDX-License-Identifier: Apache-2.0
"""Pose accuracy and pose repeatability by ISO 9283:1998, sections 7.2.1 and 7.2.2, with intervals.

A commanded pose is visited n times along the same path. With the attained minus the commanded
position d_j, and the small rotation (a_j, b_j, c_j) from the commanded to the attained orientation:

    AP_p = |mean d|                     RP_l = mean l + 3 S_l,  l_j = |d_j - mean d|
    AP_a = mean a                       RP_a = 3 S_a

The commanded pose is the one that the geometry of the robot file predicts at the readings, and the
difference is stated in the frame of the instrument. Where that frame is not known, it is fitted to
these poses; AP is then what remains after the best fit, while RP does not change to first order.

Intervals of 95 %, for normal errors: of AP_p from the noncentral chi-square distribution of the
squared mean over its variance, of RP_l from drawn visits with the same scatter (the ratio of their
RP_l to the true one hardly depends on it), of AP_a from Student's t and of RP_a from chi-square.
Derivation and measured coverage: docs/theory/accuracy.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from loopcal.apply.validation import describe_frame, group_setup
from loopcal.diagnose.row_errors import compare_predictions, compute_noise_floor, compute_row_errors
from loopcal.errors import DataError
from loopcal.estimate.residual_test import coverage_factor
from loopcal.findings import Finding, report_finding
from loopcal.measure.data_checks import check_actuators
from loopcal.measure.kinds.kind import ErrorGroup
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.readings import find_reading_tolerance, find_repeats
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.statistics import compute_chi_square_quantile
from loopcal.results.description import Field, fields
from loopcal.results.result import DrawnResult
from loopcal.typing import FloatArray
from loopcal.units import SI_SYMBOLS, Dimension

POSITION, ORIENTATION = "position", "orientation"
DIMENSIONS = {POSITION: Dimension.LENGTH, ORIENTATION: Dimension.ANGLE}
TAIL = 0.025  # probability beyond each bound of an interval
STANDARD_VISITS = 30  # visits of each pose that ISO 9283 asks for
# Share of RP that the expanded uncertainty of the instrument, U = 2 u, may be (ISO 9283, 6.4).
LARGEST_NOISE = 0.25
EXPANSION = 2.0
FEWEST_VISITS = 2  # visits without which there is no scatter
NORMAL = 1.959963984540054  # quantile of the normal distribution for intervals of 95 %
SMALLEST_SHARE = 0.05  # share of the variance that the direction of the mean has at least
DRAWS = 1000  # drawn sets of visits for the interval of RP_l
MANY = 20  # times as many visits give the true RP_l of a scatter
# Columns of the data frame.
COLUMNS = ("pose", "target", "direction", "quantity", "component", "unit", "AP", "AP_low")
COLUMNS += ("AP_high", "RP", "RP_low", "RP_high", "visits")


class Estimate(NamedTuple):
    """A value [m] or [rad] with its interval of 95 %."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class VisitedPose:
    """Pose accuracy and repeatability of one target at one commanded pose."""

    visits: int  # their number
    mean: FloatArray  # (c,) attained minus commanded values
    # accuracy, repeatability: AP_p and RP_l of a position; None for an orientation
    accuracy: Estimate | None
    repeatability: Estimate | None
    # accuracies, repeatabilities: AP and RP of each component
    accuracies: tuple[Estimate, ...]
    repeatabilities: tuple[Estimate, ...]
    pose: str = ""  # label of its first visit
    # target, direction: names of the target and of the direction of approach (the group of the
    # rows); empty for the only one
    target: str = ""
    direction: str = ""
    components: tuple[str, ...] = ()  # names of the measured ones, such as ("x", "y", "z")
    commanded: int = 0  # number of the commanded pose

    def list_accuracies(self) -> tuple[Estimate, ...]:
        """Return AP_p of a position, and the AP of each component of an orientation."""
        return self.accuracies if self.accuracy is None else (self.accuracy,)

    def list_repeatabilities(self) -> tuple[Estimate, ...]:
        """Return RP_l of a position, and the RP of each component of an orientation."""
        return self.repeatabilities if self.repeatability is None else (self.repeatability,)

    def to_dict(self) -> dict[str, Any]:
        """Return the content by name for JSON, SI."""
        whole = {"AP_p": self.accuracy, "RP_l": self.repeatability}
        of_each = {"AP": self.accuracies, "RP": self.repeatabilities}
        return {
            **{name: getattr(self, name) for name in ("pose", "target", "direction", "visits")},
            **{name: estimate for name, estimate in whole.items() if estimate is not None},
            **{n: dict(zip(self.components, each, strict=True)) for n, each in of_each.items()},
        }


@dataclass(frozen=True, eq=False, repr=False)
class Repeatability(DrawnResult):
    """Pose accuracy and repeatability of a machine.

    Attributes
    ----------
    frame : in which frame the differences are, in words.
    poses : by quantity, "position" and "orientation", one entry for each pose, target, direction.
    variations : (pose, target) -> largest distance of the mean positions of two directions of
        approach (vAP_p) [m], where there are several.
    findings : what limits these numbers.
    """

    frame: str
    poses: Mapping[str, tuple[VisitedPose, ...]]
    variations: Mapping[tuple[str, str], float]
    findings: tuple[Finding, ...]

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(standard=lambda _: "ISO 9283:1998", frame=""),
        *(
            Field(name, lambda result, name=name: result.poses.get(name), is_optional=True)
            for name in DIMENSIONS
        ),
        *fields(
            variations=lambda result: [
                {"pose": pose, "target": target, "vAP_p": value}
                for (pose, target), value in result.variations.items()
            ],
            findings="",
        ),
        *(
            Field(name, lambda result, i=i: [row[i] for row in result.list_rows()], "row")
            for i, name in enumerate(COLUMNS)
        ),
    )

    def list_rows(self) -> list[tuple[Any, ...]]:
        """Return AP and RP with their intervals, one row for each pose and component [SI]."""
        listed = []
        for quantity, poses in self.poses.items():
            unit = SI_SYMBOLS[DIMENSIONS[quantity]]
            for pose in poses:
                rows = list(
                    zip(pose.components, pose.accuracies, pose.repeatabilities, strict=True)
                )
                if pose.accuracy is not None and pose.repeatability is not None:
                    rows.insert(0, ("all", pose.accuracy, pose.repeatability))
                named = (pose.pose, pose.target, pose.direction, quantity)
                listed += [
                    (*named, component, unit, *accuracy, *repeatability, pose.visits)
                    for component, accuracy, repeatability in rows
                ]
        return listed


def assess_repeatability(
    robot: Mechanism, data: Measurements, nuisance_values: Mapping[str, float] | None = None
) -> Repeatability:
    """Compute pose accuracy and repeatability by ISO 9283 from repeated visits.

    Visits of a pose have the same readings to a thousandth of their range, as they have where a
    file states commanded coordinates. The commanded pose is that of their mean, so jitter of the
    recorded readings is part of the repeatability. Each instrument is assessed on its own, such as
    gauges of one axis each.

    Parameters
    ----------
    robot : its geometry is that of the controller. data : poses or positions, each visited several
        times. nuisance_values : values [SI] by name of frames and targets to keep; others are
        fitted to these rows.

    Raises
    ------
    DataError : no position or orientation is measured, or no pose is visited twice.
    """
    check_actuators(data, robot)
    kept = tuple(
        o
        for o in data.observations
        if o.kind.poses_per_row == 1
        and {g.quantity for g in o.kind.error_groups} & DIMENSIONS.keys()
    )
    if not kept:
        raise DataError.of("repeatability.nothing-measured")
    # commanded poses are far apart, whatever the noise of the instrument is
    member = find_repeats(data.readings, find_reading_tolerance(data.readings, ()))
    sums = np.zeros((int(member.max()) + 1, data.readings.shape[1]))
    np.add.at(sums, member, data.readings)
    mean = sums / np.bincount(member)[:, None]
    data = replace(data, observations=kept, readings=mean[member])
    compared = compare_predictions(robot, robot, data, nuisance_values, nuisance_values)
    rows = compared.data.observations
    residuals = compared.after.residuals(rows)
    poses: dict[str, list[VisitedPose]] = {quantity: [] for quantity in DIMENSIONS}
    variations: dict[tuple[str, str], float] = {}
    for o, residual in zip(rows, residuals, strict=True):
        for group in o.kind.error_groups:
            if group.quantity in DIMENSIONS:
                visited = _describe_poses(o, residual, group, compared.data)
                poses[group.quantity] += visited
                if group.quantity == POSITION:
                    for key, value in _find_variations(visited).items():
                        variations[key] = max(value, variations.get(key, 0.0))
    if not any(poses.values()):
        raise DataError.of("repeatability.no-repeats")
    setup = group_setup(compared.after)
    errors = compute_row_errors(rows, residuals)
    described = {quantity: tuple(of) for quantity, of in poses.items() if of}
    return Repeatability(
        frame=describe_frame(errors, (*setup["kept"], *setup["fitted"])),
        poses=described,
        variations=variations,
        findings=_report(described, setup["fitted"], compute_noise_floor(rows).rms),
    )


def _describe_poses(
    o: Observations, residual: FloatArray, group: ErrorGroup, data: Measurements
) -> list[VisitedPose]:
    """Return the characteristics of one target at poses that one instrument visited twice or more.

    o : its rows. residual : (r, m) predicted minus measured values. group : which of them are the
    components of one error.
    """
    attained = np.where(o.present, -residual, np.nan)[:, list(group.columns)]
    visits: dict[tuple[int, str], list[int]] = {}
    for row in np.flatnonzero(np.isfinite(attained).any(axis=1)).tolist():
        key = (int(data.repeats[o.rows[row]]), str(o.group[row]))
        visits.setdefault(key, []).append(row)
    entries = []
    for (commanded, direction), chosen in visits.items():
        columns = np.isfinite(attained[chosen]).all(axis=0)
        if len(chosen) >= FEWEST_VISITS and columns.any():
            entry = replace(
                describe_visits(attained[chosen][:, columns], group.quantity == POSITION),
                pose=data.labels[o.rows[chosen[0]]],
                target=group.target,
                direction=direction,
                components=tuple(np.array(group.components)[columns].tolist()),
                commanded=commanded,
            )
            entries.append(entry)
    return entries


def describe_visits(attained: FloatArray, is_position: bool) -> VisitedPose:
    """Return the characteristics of n visits of one pose.

    attained : (n, c) attained minus commanded values of the measured components [m] or [rad].
    is_position : whether the components are those of one displacement.
    """
    n = len(attained)
    mean, sd = attained.mean(axis=0), attained.std(axis=0, ddof=1)
    half = coverage_factor(n - 1) * sd / np.sqrt(n)
    low, high = (np.sqrt((n - 1) / compute_chi_square_quantile(n - 1, p)) for p in (TAIL, 1 - TAIL))
    return VisitedPose(
        visits=n,
        mean=mean,
        accuracy=_estimate_accuracy(attained) if is_position else None,
        repeatability=_estimate_repeatability(attained) if is_position else None,
        accuracies=tuple(
            Estimate(m, m - h, m + h) for m, h in zip(mean.tolist(), half.tolist(), strict=True)
        ),
        repeatabilities=tuple(
            Estimate(r, float(low * r), float(high * r)) for r in (3.0 * sd).tolist()
        ),
    )


def compute_repeatability(attained: FloatArray) -> FloatArray:
    """Return RP_l = mean l + 3 S_l of sets (.., n, c) of n attained positions [m]."""
    lengths = np.linalg.norm(attained - attained.mean(axis=-2, keepdims=True), axis=-1)
    return np.asarray(lengths.mean(axis=-1) + 3.0 * lengths.std(axis=-1, ddof=1))


def _estimate_accuracy(attained: FloatArray) -> Estimate:
    """Return AP_p with an interval, from the noncentral chi-square distribution.

    n |mean|^2 has the mean n |true mean|^2 + trace of the covariance, and far from zero the
    variance of the scatter along the mean. So, over that variance, it is compared with a noncentral
    chi-square of trace over this variance degrees of freedom, which is exact for equal variances.
    That the variance is estimated widens the interval as Student's t does.
    """
    from scipy.special import chndtr, chndtrinc

    n, mean = len(attained), attained.mean(axis=0)
    size = float(np.linalg.norm(mean))
    covariance = np.atleast_2d(np.cov(attained.T))
    trace = float(np.trace(covariance))
    if trace == 0.0:
        return Estimate(size, size, size)
    along = float(mean @ covariance @ mean) / size**2 if size > 0.0 else 0.0
    unit = max(along, SMALLEST_SHARE * trace)
    factor, degrees = float(coverage_factor(n - 1)), trace / unit
    unit *= (factor / NORMAL) ** 2 / n
    statistic = size**2 / unit
    low, high = (
        float(np.sqrt(chndtrinc(statistic, degrees, p) * unit))
        if chndtr(statistic, degrees, 0.0) > p
        else 0.0
        for p in (1.0 - TAIL, TAIL)
    )
    return Estimate(size, low, max(high, NORMAL * float(np.sqrt(unit))))


def _estimate_repeatability(attained: FloatArray) -> Estimate:
    """Return RP_l with an interval, from drawn visits with the same scatter."""
    n = len(attained)
    value = float(compute_repeatability(attained))
    covariance = np.atleast_2d(np.cov(attained.T))
    variances, _ = np.linalg.eigh(covariance)
    if variances[-1] <= 0.0:
        return Estimate(value, value, value)
    root = np.sqrt(np.maximum(variances, 0.0))
    stream = np.random.default_rng(0)
    true = float(compute_repeatability(stream.standard_normal((MANY * DRAWS, len(root))) * root))
    drawn = compute_repeatability(stream.standard_normal((DRAWS, n, len(root))) * root)
    low, high = np.quantile(drawn / true, [TAIL, 1.0 - TAIL])
    return Estimate(value, value / float(high), value / float(low))


def _find_variations(poses: Sequence[VisitedPose]) -> dict[tuple[str, str], float]:
    """Return vAP_p of one target at poses that were approached from several directions; the labels
    of one commanded pose differ, so it has that of its first direction.
    """
    groups: dict[int, list[VisitedPose]] = {}
    for pose in poses:
        groups.setdefault(pose.commanded, []).append(pose)
    variations = {}
    for of in groups.values():
        if len(of) > 1 and len({p.components for p in of}) == 1:
            means = np.array([p.mean for p in of])
            distances = np.linalg.norm(means[:, None] - means[None], axis=2)
            variations[of[0].pose, of[0].target] = float(distances.max())
    return variations


def _report(
    poses: Mapping[str, Sequence[VisitedPose]], fitted: tuple[str, ...], noise: Mapping[str, float]
) -> tuple[Finding, ...]:
    """Return what limits the numbers."""
    findings = []
    if fitted:
        findings.append(report_finding("repeatability.frame-fitted", names=fitted))
    visits = min(pose.visits for of in poses.values() for pose in of)
    if visits < STANDARD_VISITS:
        findings.append(
            report_finding("repeatability.few-visits", visits=visits, standard=STANDARD_VISITS)
        )
    for quantity, of in poses.items():
        squares = [sum(r.value**2 for r in p.list_repeatabilities()) for p in of]
        repeatability, expanded = float(np.sqrt(np.mean(squares))), EXPANSION * noise[quantity]
        if expanded > LARGEST_NOISE * repeatability > 0.0:
            findings.append(
                report_finding(
                    "repeatability.instrument-noise",
                    quantity=quantity,
                    share=expanded / repeatability,
                    largest=LARGEST_NOISE,
                )
            )
    return tuple(findings)
