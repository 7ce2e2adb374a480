# SPDX-License-Identifier: Apache-2.0
"""Validation: errors on measured poses before and after calibration, best on held-out poses.

Two errors are distinguished. The prediction error is what the model predicts at the measured
readings, minus what was measured. The commanded error is the pose of the machine, commanded with
this geometry, minus the commanded pose. The commanded poses are those that the geometry before
calibration predicts at the measured readings, so the machine's answer before calibration was
measured. After calibration the readings change slightly; the machine is assumed to differ from the
identified model as it does at the measured readings. The part of the commanded error that no
actuator can remove is reported as not compensable.

"Before" is a baseline of the setup alone: the geometry before calibration with the frames, targets,
surfaces and offsets that fit it best, on the same rows to which the calibration was fitted. So it
contains no error of the setup, and before and after differ by the geometry only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply.conformity import Conformity, judge_limits, report_conformity
from loopcal.apply.held_out_blunders import find_blunders, report_blunders
from loopcal.apply.validation_findings import (
    ErrorChange,
    check_limit,
    check_limits,
    describe_frame,
    group_setup,
    owner_of,
    report_few_rows,
    report_left_out,
    report_moved_setup,
    report_setup,
)
from loopcal.diagnose import (
    Blunder,
    KindErrors,
    NoiseFloor,
    PoseErrors,
    PredictionComparison,
    compare_predictions,
    compute_noise_floor,
    compute_row_errors,
    report_base_targets,
)
from loopcal.errors import DataError, suggest_names
from loopcal.estimate.inference.fit_uncertainty import FitUncertainty, collect_uncertainty
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Severity
from loopcal.findings.wording import round_to_digits
from loopcal.measure import Measurements, check_actuators
from loopcal.mechanism import Mechanism
from loopcal.presentation import TableResult, draw
from loopcal.units import Unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Validation(TableResult):
    """Errors on measured poses before and after calibration, over the r rows of all kinds.

    Positions are compared target by target in the frame of their instrument, see `frame`.

    Attributes
    ----------
    poses : (r,) labels of the rows.
    before, after : prediction errors by quantity. commanded_before, commanded_after : errors of the
        commanded machine. not_compensable : the part of `commanded_after` that no actuator removes.
    noise_floor : the errors that the measurement noise alone causes.
    unreachable : labels of poses that one of the two geometries cannot reach; no statistic contains
        them.
    limit_position, limit_angle : limits [m], [rad] on the largest prediction error of a position
        and of an orientation after calibration; None for no limit.
    units : of each quantity, in which it is shown.
    findings : limits that are exceeded (failures), and notes.
    alignment : names of frames, targets and surfaces: `kept` from the fit, `fitted` to these rows.
    kinds : prediction errors divided by sigma, of each kind and, last, of all.
    setup_count : number of setup parameters that were fitted to these rows.
    absorbed : number of residuals that estimated poses take up, where a reading is missing.
    judged : number of poses whose rows or redundant readings are compared.
    blunders : poses that neither the calibration nor the others explain. They are part of all
        statistics; `without_blunders` are the statistics without them, None where there are none.
    conformity : by quantity with a limit, the largest true error and the probability that it keeps
        the limit; none where no row measures the quantity, or nobody stated the noise.
    """

    poses: tuple[str, ...]
    before: PoseErrors
    after: PoseErrors
    commanded_before: PoseErrors
    commanded_after: PoseErrors
    not_compensable: PoseErrors
    noise_floor: NoiseFloor
    unreachable: tuple[str, ...]
    limit_position: float | None
    limit_angle: float | None
    units: Mapping[str, Unit]
    findings: tuple[Finding, ...] = ()
    alignment: Mapping[str, tuple[str, ...]] = field(
        default_factory=lambda: {"kept": (), "fitted": ()}
    )
    kinds: tuple[KindErrors, ...] = ()
    setup_count: int = 0
    absorbed: int = 0
    judged: int = 0
    blunders: tuple[Blunder, ...] = ()
    without_blunders: Validation | None = None
    conformity: Mapping[str, Conformity] = field(default_factory=dict)

    @property
    def failures(self) -> tuple[Finding, ...]:
        """Findings of limits that are exceeded or cannot be checked."""
        return tuple(f for f in self.findings if f.severity is Severity.FAILURE)

    @property
    def passed(self) -> bool:
        """Whether every limit is kept."""
        return not self.failures

    @property
    def quantities(self) -> tuple[str, ...]:
        """What the rows measure: "position", "orientation", "length" and others."""
        return tuple(self.after.quantities)

    @property
    def has_several_kinds(self) -> bool:
        """Whether several kinds of measurement are mixed; then only errors divided by sigma can be
        compared.
        """
        return len(self.kinds) > 2

    @property
    def values_left(self) -> int:
        """Measured values that are left to check the geometry: all, less one for each setup
        parameter that was fitted to them, and less those that estimated poses take up. With none
        left every geometry predicts these rows.
        """
        return self.kinds[-1].count - self.setup_count - self.absorbed

    @property
    def frame(self) -> str:
        """In which frame the errors are, in words: the stated one, or the setup that was fitted."""
        return describe_frame(self.after, (*self.alignment["kept"], *self.alignment["fitted"]))

    def improvement(self, index: str = "position", statistic: str = "rms") -> float:
        """Return how many times smaller a statistic of the prediction error became."""
        before, after = (
            getattr(errors.statistics(index), statistic) for errors in (self.before, self.after)
        )
        return ErrorChange(before, after, 0.0, 1).times

    def changes(self) -> dict[str, ErrorChange]:
        """Return the change of the rms error of each quantity.

        The key is "weighted", the error of all kinds divided by sigma, where kinds are mixed or
        only actuator readings are compared.
        """
        if self.has_several_kinds or not self.quantities:
            weighted = self.kinds[-1]
            return {"weighted": ErrorChange(weighted.before, weighted.after, 1.0, weighted.count)}
        return {
            quantity: ErrorChange(
                self.before.statistics(quantity).rms,
                errors.statistics.rms,
                self.noise_floor.rms[quantity],
                int(np.isfinite(errors.components).sum()),
            )
            for quantity, errors in self.after.quantities.items()
        }

    def improvements(self) -> dict[str, float]:
        """Return how many times smaller (rms) the error of each quantity became; see `changes`."""
        return {quantity: change.times for quantity, change in self.changes().items()}

    def errors(self) -> dict[str, PoseErrors]:
        """Return the errors by name."""
        return {
            "predicted before": self.before,
            "predicted after": self.after,
            "commanded before": self.commanded_before,
            "commanded after": self.commanded_after,
            "not compensable": self.not_compensable,
        }

    def plot(self) -> Figure:
        """Draw the errors by pose before and after calibration, with the noise floor and limits."""
        return draw("draw_validation", self)

    def __str__(self) -> str:
        """Return one line for each quantity, and the findings."""
        rows, poses = len(self.poses), self.judged
        words = f"{rows} {'row' if rows == 1 else 'rows'}, {self.frame}"
        if not rows:
            words = f"the actuator readings of {poses} {'pose' if poses == 1 else 'poses'}"
        lines = [f"Validation on {words}:", *self.describe_rms()]
        return "\n".join([*lines, *(f"{f.severity.value}: {f}" for f in self.findings)])

    def describe_rms(self) -> list[str]:
        """Return one line for each quantity: its rms before and after, and the noise floor."""
        lines = []
        for quantity, change in self.changes().items():
            unit = self.units.get(quantity)
            factor, symbol = (1.0, "sigma") if unit is None else (unit.factor_to_si, unit.symbol)
            name = "all kinds" if unit is None else quantity
            values = (change.before, change.after, change.noise_floor)
            before, after, floor = (
                f"{round_to_digits(value / factor)} {symbol}" for value in values
            )
            lines.append(
                f"  {name} (rms): {before} before, {after} after calibration (noise floor {floor})"
            )
        return lines

    __repr__ = __str__

    def to_dict(self) -> dict[str, Any]:
        """Return the result by name for JSON, SI."""
        named = ("before", "after", "commanded_before", "commanded_after", "not_compensable")
        return {
            "poses": self.poses,
            **{name: getattr(self, name) for name in named},
            "noise_floor": self.noise_floor,
            "failed": self.unreachable,
            "limit_position": self.limit_position,
            "limit_angle": self.limit_angle,
            "conformity": dict(self.conformity),
            "passed": self.passed,
            "reasons": [str(finding) for finding in self.failures],
            "notes": [str(f) for f in self.findings if f.severity is not Severity.FAILURE],
            "findings": self.findings,
            "blunders": self.blunders,
            "without_blunders": self._without_blunders(),
            "frame": self.frame,
            "alignment": self.alignment,
            "kinds": [vars(kind) for kind in self.kinds],
            "setup_count": self.setup_count,
            "absorbed": self.absorbed,
            "judged": self.judged,
        }

    def _without_blunders(self) -> dict[str, Any] | None:
        """Return the errors without blunders for JSON; None without any."""
        rest = self.without_blunders
        names = ("poses", "before", "after", "noise_floor", "kinds", "judged")
        return None if rest is None else {name: getattr(rest, name) for name in names}


def validate(
    fit: Identification | Mechanism,
    data: Measurements,
    limit_position: float | None = None,
    limit_angle: float | None = None,
    before: Mechanism | None = None,
    nuisance_values: Mapping[str, float] | None = None,
    refit: Sequence[str] = (),
    nuisance_values_before: Mapping[str, float] | None = None,
    uncertainty: FitUncertainty | None = None,
) -> Validation:
    """Compare a calibrated robot with measurements, best with some that were not fitted.

    Parameters
    ----------
    fit : the identification, or a calibrated robot. data : the held-out measurements.
    limit_position, limit_angle : largest allowed prediction errors [m], [rad].
    before : the geometry to compare with, which is also that of the controller; default: the one
        that `fit` started from (of a robot: its nominal values).
    nuisance_values : values [SI] by name of frames, targets and surfaces to keep; default: those of
        `fit`.
    refit : names of some of them, such as `tracker*`, to fit to these rows instead.
    nuisance_values_before : the same for the geometry before calibration; default: the values with
        which `fit` began.
    uncertainty : of the calibration, with which poses that do not fit are recognized; default: that
        of `fit`; of a robot, none.

    Raises
    ------
    DataError : a limit below 0; the data belong to
        another robot, contain no row, or every pose is unreachable.
    """
    check_limit("limit_position", limit_position)
    check_limit("limit_angle", limit_angle)
    robot = fit.robot if isinstance(fit, Identification) else fit
    old = before or (fit.initial if isinstance(fit, Identification) else fit.nominal)
    check_actuators(data, robot)
    values_before, values = _choose_setup(fit, before, nuisance_values_before, nuisance_values)
    _check_refit(refit, data)
    kept_before, kept = _keep_setup(values_before, refit), _keep_setup(values, refit)
    compared = compare_predictions(old, robot, data, kept_before, kept)
    limits = {"position": limit_position, "orientation": limit_angle}
    result = _summarize(robot, compared, limits)
    if uncertainty is None and isinstance(fit, Identification):
        uncertainty = collect_uncertainty(fit)
    blunders = find_blunders(robot, compared, uncertainty)
    rest = None
    if blunders:
        named = {label for blunder in blunders for label in blunder.poses}
        wrong = np.array([label in named for label in data.labels])
        rest = _summarize(robot, compared.without(wrong), limits)
    left_out = ~compared.usable & compared.predictable
    share = max(result.values_left, 0) / max(result.kinds[-1].count, 1)
    conformity = judge_limits(compared.data.observations, result.after, limits, share)
    return replace(
        result,
        unreachable=tuple(data.labels[i] for i in np.flatnonzero(left_out)),
        findings=(
            *check_limits(result.after, compared.rows, limits, result.units),
            *report_conformity(conformity, limits, result.after, result.units),
            *report_blunders(blunders, result, rest),
            *report_base_targets(data),
            *report_moved_setup(robot, compared, kept),
            *report_left_out(data, compared),
            *report_few_rows(result.after),
            *report_setup(compared.before, compared.after),
        ),
        blunders=blunders,
        without_blunders=rest,
        conformity=conformity,
    )


def _summarize(
    robot: Mechanism, compared: PredictionComparison, limits: Mapping[str, float | None]
) -> Validation:
    """Return the errors of a comparison, without findings."""
    rows = compared.data.observations
    errors_before = compared.before.residuals(rows)
    errors_after = compared.after.residuals(rows)
    missed = compared.before.differences(rows, compared.reached)
    after = compute_row_errors(rows, errors_after)
    return Validation(
        poses=compared.rows,
        before=compute_row_errors(rows, errors_before),
        after=after,
        commanded_before=compute_row_errors(rows, [-r for r in errors_before]),
        commanded_after=compute_row_errors(
            rows, [m - r for m, r in zip(missed, errors_after, strict=True)]
        ),
        not_compensable=compute_row_errors(rows, missed),
        noise_floor=compute_noise_floor(rows),
        unreachable=(),
        limit_position=limits["position"],
        limit_angle=limits["orientation"],
        units={name: robot.get_unit(e.dimension) for name, e in after.quantities.items()},
        alignment=group_setup(compared.after),
        kinds=compared.kind_errors(),
        setup_count=compared.after.fitted_count,
        absorbed=int(compared.absorbed.sum()),
        judged=compared.count_judged(),
    )


def _choose_setup(
    fit: Identification | Mechanism,
    before: Mechanism | None,
    values_before: Mapping[str, float] | None,
    values: Mapping[str, float] | None,
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """Return setup parameters [SI] for the geometry before and for the calibrated one.

    Those that are not given are those of the fit; a robot has none.
    """
    nuisance = fit.nuisance if isinstance(fit, Identification) else None
    if values_before is None:
        started = before is None and values is None and nuisance is not None
        values_before = nuisance.starts if started and nuisance is not None else {}
    if values is None:
        values = {} if nuisance is None else nuisance.values
    return values_before, values


def _check_refit(refit: Sequence[str], data: Measurements) -> None:
    """Raise DataError for a name in `refit` that belongs to nothing in the data."""
    owners = {owner_of(name) for name in data.nuisance_parameters.table.names}
    for pattern in refit:
        if not any(fnmatchcase(owner, pattern) for owner in owners):
            listed = ", ".join(sorted(owners)) or "none"
            raise DataError(
                f"no frame, target or surface of these data is called {pattern!r}"
                f"{suggest_names(pattern, owners)}; the data have: {listed}"
            )


def _keep_setup(values: Mapping[str, float], refit: Sequence[str]) -> dict[str, float]:
    """Return the setup parameters that are not to be fitted again."""
    return {
        name: value
        for name, value in values.items()
        if not any(fnmatchcase(owner_of(name), pattern) for pattern in refit)
    }
