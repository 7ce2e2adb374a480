# SPDX-License-Identifier: Apache-2.0
"""Errors that the drives have at every pose by itself: repeatability, backlash, errors of gears.

An error of variance tau^2 of every reading at every pose is a component of the variance of the
whitened rows, with their derivatives by the readings as columns, which are zero but for those of
the pose of a row (`numerics.statistics.Remainder`). Backlash is an error
of the sign of travel from the pose before: a linear effect, see `residual_patterns`.
Sources: Patterson and Thompson, Recovery of inter-block information when block sizes are unequal,
Biometrika 58 (1971); docs/theory/residual-patterns.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal.diagnose.residual_patterns import (
    READING,
    Cause,
    Effect,
    ExplainedResiduals,
    ResidualRows,
    order_by_time,
    scale_to_range,
    test_effect,
)
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.linearization import evaluate_rows
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.numerics.split_columns import SplitColumns, span_columns
from loopcal.numerics.statistics import find_distinct
from loopcal.typing import FloatArray
from loopcal.units import Dimension

DOUBTED = 0.1
"""Probability of an effect of travel by noise, beside effects of the readings, above which travel
is not its cause.
"""

FEWEST_VALUES = 2
"""Measured values of a pose without which its errors have no pattern, such as single heights."""

DRIVES, BACKLASH = "drives", "backlash"


@dataclass(frozen=True, eq=False)
class DriveErrors:
    """Errors of the readings that every pose has by itself.

    sigma : (a,) their standard deviations [SI]. findings : which errors, and the probability that
    independent errors of the instrument show them.
    """

    sigma: FloatArray
    findings: tuple[Finding, ...]

    def add_to_readings(self, data: Measurements) -> Measurements:
        """Return measurements with readings of these standard deviations."""
        return replace(data, reading_sigma=np.broadcast_to(self.sigma, data.readings.shape))

    def add_to(self, fit: Identification) -> Identification:
        """Return a fit with readings of these standard deviations, which says so."""
        posterior = replace(fit.posterior, reading_sigma=self.sigma)
        return replace(fit, posterior=posterior, findings=(*fit.findings, *self.findings))


def can_show_drives(linear: FitLinearization, rows: ResidualRows) -> bool:
    """Return whether rows of a fit with exact readings can show errors of the drives."""
    fit = linear.fit
    test = fit.residual_test  # with unknown sigmas, kinds of different noise show a pattern, too
    is_tested = fit.converged and test.intervals and test.noise == "given"
    is_plain = {fit.options.loss, fit.options.prior} == {None}
    is_plain &= linear.solution.linearized is not None  # the poses were kept
    return is_tested and is_plain and len(rows.residual) >= FEWEST_VALUES * linear.data.n_poses


def measure_drive_errors(
    linear: FitLinearization, explained: ExplainedResiduals
) -> DriveErrors | None:
    """Return the errors of the drives that cause residuals of a fit; None where none do."""
    rows, robot = explained.rows, linear.fit.robot
    causes = {c.source: c for c in explained.causes if c.source in (DRIVES, BACKLASH)}
    if rows is None or not causes:
        return None
    unit = list_units(linear)
    sigma, backlash, findings = np.zeros_like(unit), np.zeros_like(unit), []
    if (cause := causes.get(BACKLASH)) is not None:
        backlash, findings = _measure_backlash(linear, rows.take_poses(linear.data), cause)
    if (cause := causes.get(DRIVES)) is not None and cause.effect and cause.size:
        sigma = np.sqrt(cause.size.variance) * cause.effect.unit[0] * unit
        largest = int(np.argmax(sigma))
        size = robot.to_quantity(float(sigma[largest]), robot.actuators[largest].dimension)
        found = report_finding(
            "residuals.drive-errors", size=size, p_value=cause.p_value, severity=cause.severity
        )
        findings.append(found)
    return DriveErrors(np.hypot(sigma, backlash), tuple(findings)) if findings else None


def list_units(linear: FitLinearization) -> FloatArray:
    """Return the units (a,) [SI] in which errors of different drives count alike: lengths, and
    angles that turn the size of the robot by them.
    """
    robot = linear.fit.robot
    is_angle = [actuator.dimension is Dimension.ANGLE for actuator in robot.actuators]
    return np.where(is_angle, 1.0 / robot.size, 1.0)


def list_drive_effects(linear: FitLinearization, rows: ResidualRows) -> list[Effect]:
    """Return the effects of errors of each reading at each pose of the rows, of the direction in
    which it was approached, and cubic ones of its value, in the `list_units`; none where rows
    compare poses, or sense joints, which follow the readings in another way.
    """
    poses, states, robot = linear.solution.linearized, linear.solution.states, linear.fit.robot
    kinds = [r for r in linear.problem.rows if len(r.poses)]
    if any(r.kind.sensed_joints or r.kind.poses_per_row > 1 for r in kinds):
        return []
    assert poses is not None
    assert states is not None
    readings = linear.data.readings[None]
    S = differentiate_pose(robot, robot.values[None], readings, states.state).readings[0]
    values, places = np.zeros((len(rows.residual), S.shape[-1])), rows.locate_poses(linear.data)
    for number, r in enumerate(kinds):
        evaluated, white = evaluate_rows(r, poses, np.zeros(1, np.int64), linear.solution.nuisance)
        Z = r.whiten_columns(white, evaluated.jacobian)[0] @ S[r.poses]
        own = rows.kind == number
        values[own] = Z[rows.row[own], rows.column[own]]
    values *= list_units(linear)
    chosen = find_distinct(places)
    of_poses = (places[:, None] == chosen)[:, :, None] * values[:, None, :]
    times = [o.context.get("time") for o in linear.data.observations if len(o)]
    is_alike = len(times) == 1 and len(linear.data.observations[0]) == len(S)
    order = order_by_time(times[0] if is_alike else None, len(S))
    direction = np.zeros_like(linear.data.readings)
    direction[order[1:]] = np.sign(np.diff(linear.data.readings[order], axis=0))
    x = np.apply_along_axis(scale_to_range, 0, linear.data.readings)
    along = np.concatenate([values * (x**k)[places] for k in (1, 2, 3)], axis=1)
    listed = {DRIVES: of_poses.reshape(len(values), -1), BACKLASH: values * direction[places]}
    label = (("reading", Dimension.LENGTH),)
    return [Effect(k, "", c, label * c.shape[1]) for k, c in (*listed.items(), (READING, along))]


def _measure_backlash(
    linear: FitLinearization, rows: ResidualRows, cause: Cause
) -> tuple[FloatArray, list[Finding]]:
    """Return half the backlash (a,) [SI] of each actuator that rows show, and the finding."""
    robot, unit = linear.fit.robot, list_units(linear)
    _, travel, along = list_drive_effects(linear, rows)
    # the direction of travel goes with the reading: a pose at an end was reached towards it
    known, effect = rows.with_effects(along.columns), travel.columns
    if test_effect(known, travel) > DOUBTED:
        return np.zeros(len(unit)), []
    if span_columns(SplitColumns.of(known.project(effect))).shape[1] < len(unit):
        return np.zeros(len(unit)), []
    half, *_ = np.linalg.lstsq(known.project(effect), known.residual, rcond=None)
    largest = int(np.argmax(np.abs(half)))
    actuator = robot.actuators[largest]
    size = robot.to_quantity(2.0 * float(abs(half[largest]) * unit[largest]), actuator.dimension)
    finding = report_finding(
        "residuals.backlash", name=actuator.name, size=size, p_value=cause.p_value,
        severity=cause.severity,
    )  # fmt: skip
    return np.abs(half) * unit, [finding]
