# SPDX-License-Identifier: Apache-2.0
"""Errors that the drives have at every pose by itself: repeatability, backlash, errors of gears.

With whitened rows e of a fit, of which nothing estimated explains r = M e (nu degrees of freedom),
an error of variance tau^2 of every reading at every pose adds tau^2 Z Z' to their covariance, Z the
whitened derivatives by the readings, which are zero but for those of the pose of a row. The size of

    q = r'Z Z'r / (r'r + nu0),    nu0 degrees of freedom of the stated sigmas

is compared with its mean and variance without such errors, which follow from the traces of
K = M Z Z'M and K^2. tau maximizes the restricted likelihood of the rows. Backlash is an error
of the sign of travel from the pose before: a linear effect, see `residual_patterns`.
Sources: Patterson and Thompson, Recovery of inter-block information when block sizes are unequal,
Biometrika 58 (1971); docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal.diagnose.outliers import find_outliers
from loopcal.diagnose.residual_patterns import (
    FEWEST_LEFT,
    ResidualRows,
    collect_residual_rows,
    order_by_time,
    scale_to_range,
    span_columns,
    test_effect,
)
from loopcal.estimate.fit_linearization import FitLinearization, linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.linearization import evaluate_rows
from loopcal.estimate.residual_test import choose_severity, count_sigma_degrees
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.numerics.statistics import compute_chi_square_tail, compute_single_level
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

LEVEL = 0.01
"""Probability that independent errors of the instrument show errors of the drives."""

DOUBTED = 0.1
"""The same where residuals contradict the stated noise: then either that is wrong, or the drives
have errors, and their pattern decides.
"""

FEWEST_VALUES = 2
"""Measured values of a pose without which its errors have no pattern, such as single heights."""

OUTLYING = 0.1
"""Largest share of the poses that may be outliers in place of errors of the drives."""

SIZES = np.geomspace(0.03, 300.0, 41)
"""Sizes of the errors that are compared, in units in which they double the variance of the rows."""


@dataclass(frozen=True, eq=False)
class DriveErrors:
    """Errors of the readings that every pose has by itself.

    sigma : (a,) their standard deviations [SI]. findings : which errors, and the probability that
    independent errors of the instrument show them.
    """

    sigma: FloatArray
    findings: tuple[Finding, ...]

    def explain_better(self, fit: Identification) -> bool:
        """Return whether they are less likely to be chance than the patterns of residuals that a
        fit, with its uncertainty adjusted, states.
        """
        patterns = (f for f in fit.findings if f.code.startswith("residuals."))
        chance = min((f.data.get("p_value", 1.0) for f in patterns), default=1.0)
        return any(f.data["p_value"] < chance for f in self.findings)

    def add_to(self, fit: Identification) -> Identification:
        """Return a fit with readings of these standard deviations, which says so."""
        posterior = replace(fit.posterior, reading_sigma=self.sigma)
        return replace(fit, posterior=posterior, findings=(*fit.findings, *self.findings))


@dataclass(frozen=True, eq=False)
class ReadingColumns:
    """Whitened derivatives of R rows by the a readings of their poses [1 / SI].

    values : (R, a). poses : (R,) pose of each row. count : n of all poses.
    """

    values: FloatArray
    poses: IntArray
    count: int

    def project(self, columns: FloatArray) -> FloatArray:
        """Return Z' columns (n, a, c) of columns (R, c)."""
        total = np.zeros((self.count, self.values.shape[1], columns.shape[1]))
        np.add.at(total, self.poses, self.values[:, :, None] * columns[:, None, :])
        return total

    def expand(self, errors: FloatArray) -> FloatArray:
        """Return Z errors (R, c) of errors (n, a, c) of the readings."""
        return np.einsum("ra,rac->rc", self.values, errors[self.poses])

    def square(self) -> FloatArray:
        """Return the blocks (n, a, a) of Z'Z."""
        return self.project(self.values)


def find_drive_errors(linear: FitLinearization) -> DriveErrors | None:
    """Return the errors of the drives that the residuals of a fit with exact readings show; None
    where they show none, or cannot.
    """
    fit, poses = linear.fit, linear.solution.linearized
    test = fit.residual_test  # with unknown sigmas, kinds of different noise show a pattern, too
    is_tested = fit.converged and test.intervals and test.noise == "given"
    if not is_tested or poses is None or {fit.options.loss, fit.options.prior} != {None}:
        return None
    rows = collect_residual_rows(linear)
    if rows is None or len(rows.residual) < FEWEST_VALUES * linear.data.n_poses:
        return None
    columns = differentiate_by_readings(linear, rows)
    if columns is None:
        return None
    unit = list_units(linear)
    level = DOUBTED if test.exceeds_sigma else compute_single_level(LEVEL, 2)
    rows, backlash, findings = _find_backlash(linear, rows, columns, unit, level)
    known = count_sigma_degrees(test.noise, fit.options.sigma_uncertainty)
    scaled = ReadingColumns(columns.values * unit, columns.poses, columns.count)
    p_value, sigma = test_independent_errors(rows, scaled, known), np.zeros_like(unit)
    if p_value < level:
        sigma = estimate_size(rows, scaled, known) * unit
        largest = int(np.argmax(sigma))
        size = fit.robot.to_quantity(float(sigma[largest]), fit.robot.actuators[largest].dimension)
        severity = choose_severity(p_value)
        found = report_finding(
            "residuals.drive-errors", size=size, p_value=p_value, severity=severity
        )
        findings.append(found)
    return DriveErrors(np.hypot(sigma, backlash), tuple(findings)) if findings else None


def are_outliers(fit: Identification, data: Measurements) -> bool:
    """Return whether errors of the drives vanish without the poses that do not fit, of which there
    are few: then these are wrong, and not the drives.
    """
    suspects = find_outliers(fit, data).suspects
    if not 0 < len(suspects) <= max(OUTLYING * data.n_poses, 1.0):
        return False
    excluded = (*fit.options.excluded_poses, *suspects)
    fewer = identify(fit.initial, data, options=replace(fit.options, excluded_poses=excluded))
    return fewer.converged and find_drive_errors(linearize_fit(fewer, data)) is None


def list_units(linear: FitLinearization) -> FloatArray:
    """Return the units (a,) [SI] in which errors of different drives count alike: lengths, and
    angles that turn the size of the robot by them.
    """
    robot = linear.fit.robot
    is_angle = [actuator.dimension is Dimension.ANGLE for actuator in robot.actuators]
    return np.where(is_angle, 1.0 / robot.size, 1.0)


def differentiate_by_readings(
    linear: FitLinearization, rows: ResidualRows
) -> ReadingColumns | None:
    """Return the derivatives of the rows by the readings of their poses; None where rows compare
    poses, or sense joints, which follow the readings in another way.
    """
    poses, states, robot = linear.solution.linearized, linear.solution.states, linear.fit.robot
    assert poses is not None
    assert states is not None
    kinds = [r for r in linear.problem.rows if len(r.poses)]
    if any(r.kind.sensed_joints or r.kind.poses_per_row > 1 for r in kinds):
        return None
    readings = linear.data.readings[None]
    S = differentiate_pose(robot, robot.values[None], readings, states.state).readings[0]
    values = np.zeros((len(rows.residual), S.shape[-1]))
    places = np.zeros(len(rows.residual), dtype=np.int64)
    for number, r in enumerate(kinds):
        evaluated, white = evaluate_rows(r, poses, np.zeros(1, np.int64), linear.solution.nuisance)
        Z = r.whiten_columns(white, evaluated.jacobian)[0] @ S[r.poses]
        own = rows.kind == number
        values[own] = Z[rows.row[own], rows.column[own]]
        places[own] = r.poses[rows.row[own]]
    return ReadingColumns(values, places, len(S))


def _find_backlash(
    linear: FitLinearization, rows: ResidualRows, columns: ReadingColumns, unit: FloatArray,
    level: float,
) -> tuple[ResidualRows, FloatArray, list[Finding]]:  # fmt: skip
    """Return rows as if the fit had also estimated the backlash that they show, half of it (a,)
    [SI] for each actuator, and the finding. The order of the rows is that of travel.
    """
    readings, robot = linear.data.readings, linear.fit.robot
    nothing = np.zeros(len(unit))
    times = [o.context.get("time") for o in linear.data.observations if len(o)]
    time = (
        times[0] if len(times) == 1 and len(linear.data.observations[0]) == len(readings) else None
    )
    order = order_by_time(time, len(readings))
    direction = np.zeros_like(readings)
    direction[order[1:]] = np.sign(np.diff(readings[order], axis=0))
    x = np.apply_along_axis(scale_to_range, 0, readings)

    def shift(errors: FloatArray) -> FloatArray:
        return columns.values * errors[columns.poses] * unit

    effect = shift(direction)
    # the direction of travel goes with the reading: a pose at an end was reached towards it
    known = rows.with_effects(np.concatenate([shift(x**k) for k in (1, 2, 3)], axis=1))
    basis = span_columns(known.project(effect))
    q = basis.shape[1]
    if q < len(unit) or known.degrees < (1.0 + FEWEST_LEFT) * q:
        return rows, nothing, []
    p_value = test_effect(known, basis)
    if not p_value < level:
        return rows, nothing, []
    half, *_ = np.linalg.lstsq(known.project(effect), known.residual, rcond=None)
    largest = int(np.argmax(np.abs(half)))
    actuator = robot.actuators[largest]
    size = robot.to_quantity(2.0 * float(abs(half[largest]) * unit[largest]), actuator.dimension)
    finding = report_finding(
        "residuals.backlash", name=actuator.name, size=size, p_value=p_value,
        severity=choose_severity(p_value),
    )  # fmt: skip
    return rows.with_effects(effect), np.abs(half) * unit, [finding]


def test_independent_errors(rows: ResidualRows, columns: ReadingColumns, known: float) -> float:
    """Return the probability of a larger q for independent errors of the instrument alone.

    known : nu0, degrees of freedom of the stated sigmas; infinite where these are exact.
    """
    U, nu = rows.basis, rows.degrees
    own = columns.project(U)  # Z'U
    square = columns.project(rows.residual[:, None])
    total, gram = float((columns.values**2).sum()), columns.square()
    inner = np.einsum("nac,nad->cd", own, own)
    spread = columns.expand(own)
    first = total - float(np.trace(inner))
    second = float((gram**2).sum()) - 2.0 * float((spread**2).sum()) + float((inner**2).sum())
    if not first > 1e-9 * total:
        return 1.0
    if np.isinf(known):
        ratio, mean, variance = float((square**2).sum()), first, 2.0 * second
    else:
        n = nu + known
        ratio = float((square**2).sum()) / (rows.square + known) * n
        mean, variance = first, 2.0 * (n * second - first**2) / (n + 2.0)
    if not variance > 0.0:
        return 1.0
    degrees = 2.0 * mean**2 / variance
    return float(compute_chi_square_tail(degrees, degrees * ratio / mean))


def estimate_size(rows: ResidualRows, columns: ReadingColumns, known: float) -> float:
    """Return the standard deviation tau [SI, scaled] of the errors of the readings at which the
    restricted likelihood of the rows is largest, their noise at its best size.
    """
    both, q = np.column_stack([rows.basis, rows.residual]), rows.basis.shape[1]
    B, (c, Q) = columns.project(both), np.linalg.eigh(columns.square())
    B, c = Q.swapaxes(1, 2) @ B, np.maximum(c, 0.0)[..., None]
    unit = float(np.sqrt(len(both) / (columns.values**2).sum()))
    best, size = -np.inf, 0.0
    for tau in SIZES * unit:
        # (1 + tau^2 Z Z')^(-1/2) = 1 - Z Q diag(g) Q'Z', with g c = 1 - (1 + tau^2 c)^(-1/2)
        root = np.sqrt(1.0 + tau**2 * c)
        white = both - columns.expand(Q @ (tau**2 / (root * (1.0 + root)) * B))
        diagonal = np.abs(np.diag(np.linalg.qr(white, mode="r")))
        square, n, scale = float(diagonal[-1] ** 2), rows.degrees + known, 1.0
        if np.isfinite(known):
            scale = (square + known) / n
            square = n * np.log(scale)
        log_det = 2.0 * float(np.log(root).sum() + np.log(diagonal[:q]).sum())
        if -0.5 * (log_det + square) > best:
            best, size = -0.5 * (log_det + square), tau * np.sqrt(scale)
    return float(size)
