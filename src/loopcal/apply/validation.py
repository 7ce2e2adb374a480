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
from typing import Any, ClassVar

import numpy as np

from loopcal.apply.calibration_options import check_limit
from loopcal.apply.conformity import Conformity, judge_limits, report_conformity
from loopcal.diagnose import row_errors
from loopcal.diagnose.blunders import Blunder, Explanation, check_held_out_rows, name_blunders
from loopcal.diagnose.conventions.convention_check import find_moved_setups
from loopcal.diagnose.measured_points import report_base_targets
from loopcal.errors import DataError, suggest_names
from loopcal.estimate.fit_linearization import FitUncertainty, collect_uncertainty
from loopcal.estimate.posterior import ModelDiscrepancy
from loopcal.estimate.residual_test import SIGMA_AS_STATED, NoiseKnowledge
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Severity, report_finding
from loopcal.findings.wording import list_names
from loopcal.measure.data_checks import check_actuators
from loopcal.measure.fitted_rows import FittedRows
from loopcal.measure.kinds.kind import SCALES
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.elimination import UnknownRoot
from loopcal.numerics.statistics import compute_f_quantile, find_distinct
from loopcal.results.description import Field, fields
from loopcal.results.result import DrawnResult
from loopcal.results.storage import restore
from loopcal.results.tables import to_quantity
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import SI_SYMBOLS, Unit

# Number of rows below which an error cannot be judged. At 4 rows the rms of noise alone varies by
# a third.
FEW_ROWS = 5
GREW = 1.1  # factor by which an error must grow to be called larger
NOISE_LEVEL = 1e-3  # probability that noise alone exceeds what is called the noise
DOMINATES = 2.0  # factor by which blunders that dominate an rms error raise it
# Standard deviations of the noise within which the setup must be known where a row is predicted:
# otherwise it measures its frame or target, and not the machine.
SETUP_KNOWN = 10.0
REFUSED_SHARE = 0.5  # share of reused rows from which data are refused for validation
ERRORS = ("before", "after")  # errors whose differences are stored
# First word of the names of the stored arrays, `held_out_<before or after>_<quantity>`.
PREFIX = "held_out"


@dataclass(frozen=True)
class ErrorChange:
    """The rms error of one quantity before and after calibration."""

    # before, after, noise_floor: [m], [rad] or [sigma]
    before: float
    after: float
    noise_floor: float
    values: int  # number of measured components
    noise: NoiseKnowledge = SIGMA_AS_STATED

    @property
    def times(self) -> float:
        """How many times smaller the error became; infinite where it vanished, NaN if unknown."""
        if not (np.isfinite(self.before) and np.isfinite(self.after)):
            return np.nan
        if self.after > 0.0:
            return self.before / self.after
        return np.inf if self.before > 0.0 else 1.0

    @property
    def growth(self) -> float:
        """How many times larger the error became; infinite where there was none before."""
        return self.after / self.before if self.before > 0.0 else np.inf

    @property
    def largest_noise(self) -> float:
        """The rms that noise alone exceeds with the probability `NOISE_LEVEL`."""
        square = compute_f_quantile(max(self.values, 1), self.noise.known_degrees, NOISE_LEVEL)
        return self.noise_floor * self.noise.scale * float(np.sqrt(square))

    @property
    def is_noise(self) -> bool:
        """Whether noise alone explains the error before and after."""
        return max(self.before, self.after) <= self.largest_noise

    @property
    def has_grown(self) -> bool:
        """Whether the error became larger by more than a tenth, and noise does not explain it."""
        return self.after > GREW * self.before and self.after > self.largest_noise


@dataclass(frozen=True, eq=False, repr=False)
class Validation(DrawnResult):
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
    limit_position, limit_angle : limits [m], [rad] on the largest prediction error after
        calibration; None for no limit.
    units : of each quantity, in which it is shown.
    findings : limits that are exceeded (failures), and notes.
    alignment : names of frames, targets and surfaces: `kept` from the fit, `fitted` to these rows.
    kinds : prediction errors divided by sigma, of each kind and, last, of all.
    setup_count : number of setup parameters that were fitted to these rows.
    absorbed : number of residuals that estimated poses take up, where a reading is missing.
    judged : number of poses whose rows or redundant readings are compared.
    noise : what the calibration knows of the noise of these rows.
    blunders : poses that neither the calibration nor the others explain. They are part of all
        statistics; `without_blunders` are the statistics without them, None where there are none.
    conformity : by quantity with a limit, the largest true error and the probability that it keeps
        the limit; none where no row measures the quantity, or nobody stated the noise.
    """

    poses: tuple[str, ...]
    before: row_errors.PoseErrors
    after: row_errors.PoseErrors
    commanded_before: row_errors.PoseErrors
    commanded_after: row_errors.PoseErrors
    not_compensable: row_errors.PoseErrors
    noise_floor: row_errors.NoiseFloor
    unreachable: tuple[str, ...]
    limit_position: float | None
    limit_angle: float | None
    units: Mapping[str, Unit]
    findings: tuple[Finding, ...] = ()
    alignment: Mapping[str, tuple[str, ...]] = field(
        default_factory=lambda: {"kept": (), "fitted": ()}
    )
    kinds: tuple[row_errors.KindErrors, ...] = ()
    setup_count: int = 0
    absorbed: int = 0
    judged: int = 0
    blunders: tuple[Blunder, ...] = ()
    without_blunders: Validation | None = None
    conformity: Mapping[str, Conformity] = field(default_factory=dict)
    noise: NoiseKnowledge = SIGMA_AS_STATED

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("poses", "before", "after", "commanded_before", "commanded_after"),
        *fields("not_compensable", "noise_floor", failed="unreachable"),
        *fields("limit_position", "limit_angle", "conformity", "passed"),
        *fields(
            reasons=lambda v: list(map(str, v.failures)),
            notes=lambda v: [str(f) for f in v.findings if f.severity is not Severity.FAILURE],
        ),
        *fields("findings", "blunders", without_blunders=lambda v: v._list_without_blunders()),
        *fields("frame", "alignment", "kinds", "setup_count", "absorbed", "judged", "noise"),
        *(
            Field(name, lambda v, i=i: [row[i] for row in v.list_sizes()], "row")
            for i, name in enumerate(("pose", "target", "quantity", "unit", "before", "after"))
        ),
    )

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
        """Whether kinds of measurement are mixed: only errors divided by sigma are comparable."""
        return len(self.kinds) > 2

    @property
    def values_left(self) -> int:
        """Measured values that check the geometry: all, less one for each setup parameter that was
        fitted to them, and less those that estimated poses take up. With none left every geometry
        predicts these rows.
        """
        return self.kinds[-1].count - self.setup_count - self.absorbed

    @property
    def frame(self) -> str:
        """In which frame the errors are, in words: the stated one, or the setup that was fitted."""
        return describe_frame(self.after, (*self.alignment["kept"], *self.alignment["fitted"]))

    def changes(self) -> dict[str, ErrorChange]:
        """Return the change of the rms error of each quantity.

        The key is "weighted", the error of all kinds divided by sigma, where kinds are mixed or
        only actuator readings are compared.
        """
        if self.has_several_kinds or not self.quantities:
            weighted = self.kinds[-1]
            rms = (weighted.before, weighted.after, 1.0, weighted.count)
            return {"weighted": ErrorChange(*rms, self.noise)}
        return {
            quantity: ErrorChange(
                self.before.statistics(quantity).rms,
                errors.statistics.rms,
                self.noise_floor.rms[quantity],
                int(np.isfinite(errors.components).sum()),
                self.noise,
            )
            for quantity, errors in self.after.quantities.items()
        }

    def errors(self) -> dict[str, row_errors.PoseErrors]:
        """Return the errors by name."""
        return {
            "predicted before": self.before,
            "predicted after": self.after,
            "commanded before": self.commanded_before,
            "commanded after": self.commanded_after,
            "not compensable": self.not_compensable,
        }

    def list_sizes(self) -> list[tuple[str, str, str, str, float, float]]:
        """Return pose, target, quantity, unit, and sizes before and after [SI] of every error."""
        return [
            (self.poses[i], target, quantity, SI_SYMBOLS[after.dimension], *sizes)
            for quantity, after in self.after.quantities.items()
            for i, target, *sizes in zip(
                after.rows,
                after.targets,
                self.before[quantity].size.tolist(),
                after.size.tolist(),
                strict=True,
            )
        ]

    @property
    def checked(self) -> Validation:
        """What is said of the geometry: without blunders, which say nothing of it."""
        return self.without_blunders or self

    def _list_without_blunders(self) -> dict[str, Any] | None:
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
    are_rows_known: bool = False,
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
    are_rows_known : whether the caller knows which of the rows were fitted; otherwise a finding
        names those that the identification was made from.

    Raises
    ------
    DataError : a limit below 0; data of another robot or without rows, or no pose is reachable.
    """
    check_limit("limit_position", limit_position)
    check_limit("limit_angle", limit_angle)
    robot, old, nuisance = fit, before, None
    noise = SIGMA_AS_STATED if uncertainty is None else uncertainty.noise
    reused = []
    if isinstance(fit, Identification):
        robot, old, nuisance = fit.robot, before or fit.initial, fit.nuisance
        uncertainty = collect_uncertainty(fit) if uncertainty is None else uncertainty
        noise = NoiseKnowledge.of(fit.residual_test)
        reused = [] if are_rows_known else _report_reused(fit.posterior.fitted_rows, data)
    if not isinstance(robot, Mechanism):
        raise TypeError("fit is neither an identification nor a robot")
    check_actuators(data, robot)
    if nuisance_values_before is None:
        is_usual = before is None and nuisance_values is None and nuisance is not None
        nuisance_values_before = nuisance.starts if is_usual and nuisance is not None else {}
    if nuisance_values is None:
        nuisance_values = {} if nuisance is None else nuisance.values
    refitted = match_owners(refit, data)
    kept_before, kept = (
        {name: value for name, value in values.items() if owner_of(name) not in refitted}
        for values in (nuisance_values_before, nuisance_values)
    )
    compared = row_errors.compare_predictions(old or robot.nominal, robot, data, kept_before, kept)
    is_open, unpredicted = _find_unpredicted(compared, uncertainty)
    if unpredicted:
        pairs = zip(compared.data.observations, is_open, strict=True)
        data = replace(compared.data, observations=tuple(o.take(~of_kind) for o, of_kind in pairs))
        if not data.n_rows and robot.redundancy is None:
            raise DataError(unpredicted[0])
        compared = row_errors.compare_predictions(
            old or robot.nominal, robot, data, kept_before, kept
        )
    limits = {"position": limit_position, "orientation": limit_angle}
    slow = None if uncertainty is None else uncertainty.posterior.discrepancy
    result = _summarize(robot, compared, limits, noise, slow)
    # compared poses that do not fit the calibrated robot; without its uncertainty the noise and
    # the other poses decide
    usable, after = compared.data.take(compared.usable), compared.after
    values = dict(zip(after.setup.table.names, after.values[0].tolist(), strict=True))
    check = check_held_out_rows(robot, usable, values, after.kept, uncertainty)
    blunders, rest = () if check is None else name_blunders(check, usable), None
    if blunders:
        named = {label for blunder in blunders for label in blunder.poses}
        wrong = np.array([label in named for label in data.labels])
        rest = _summarize(robot, compared.without(wrong), limits, noise, slow)
    left_out = ~compared.usable & compared.predictable
    left = np.sqrt(max(result.values_left, 0) / max(result.kinds[-1].count, 1))
    conformity = judge_limits(
        compared.data.observations, result.after, limits, left * noise.scale, noise.degrees
    )
    return replace(
        result,
        unreachable=tuple(data.labels[i] for i in np.flatnonzero(left_out)),
        findings=(
            *report_conformity(conformity, limits, result.after, result.units, result.poses),
            *_report_blunders(blunders, result, rest),
            *unpredicted,
            *reused,
            *report_base_targets(data),
            *_report_moved_setup(robot, compared, kept),
            *_report_left_out(data, compared),
            *(
                report_finding("validation.few-rows", quantity=quantity, count=count)
                for quantity, errors in result.after.quantities.items()
                if 0 < (count := len(find_distinct(errors.rows))) < FEW_ROWS
            ),
            *_report_setup(compared.before, compared.after),
        ),
        blunders=blunders,
        without_blunders=rest,
        conformity=conformity,
    )


def _summarize(
    robot: Mechanism,
    compared: row_errors.PredictionComparison,
    limits: Mapping[str, float | None],
    noise: NoiseKnowledge,
    slow: ModelDiscrepancy | None,
) -> Validation:
    """Return the errors of a comparison, without findings; `slow` errors are those of the fit."""
    rows = compared.data.observations
    before, after = compared.before.residuals(rows), compared.after.residuals(rows)
    missed = compared.before.differences(rows, compared.reached)
    reached = [m - r for m, r in zip(missed, after, strict=True)]
    errors = row_errors.compute_row_errors(rows, after)
    kinds = compared.kind_errors()
    if slow is not None:
        numbers = (compared.measure_slow_gain(slow.errors), float(slow.degrees.min()))
        every = replace(kinds[-1], slow=numbers[0], slow_degrees=numbers[1])
        kinds = (*kinds[:-1], every)
    return Validation(
        poses=compared.rows,
        before=row_errors.compute_row_errors(rows, before),
        after=errors,
        commanded_before=row_errors.compute_row_errors(rows, [-r for r in before]),
        commanded_after=row_errors.compute_row_errors(rows, reached),
        not_compensable=row_errors.compute_row_errors(rows, missed),
        noise_floor=row_errors.compute_noise_floor(rows),
        unreachable=(),
        limit_position=limits["position"],
        limit_angle=limits["orientation"],
        units=find_error_units(robot, errors),
        alignment=group_setup(compared.after),
        kinds=kinds,
        setup_count=compared.after.fitted_count,
        absorbed=int(compared.absorbed.sum()),
        judged=compared.count_judged(),
        noise=noise,
    )


def find_error_units(robot: Mechanism, errors: row_errors.PoseErrors) -> dict[str, Unit]:
    """Return the unit of each quantity of errors, that in which a robot shows its dimension."""
    return {name: robot.get_unit(e.dimension) for name, e in errors.quantities.items()}


# Setup parameters: frames, targets, surfaces and offsets.


def owner_of(name: str) -> str:
    """Return the frame, target or surface of a setup parameter: `tracker` of `tracker.x`; the scale
    of an instrument is no coordinate of its frame, and belongs to itself.
    """
    owner, _, axis = name.rpartition(".")
    return name if axis in SCALES else owner


def group_setup(prediction: row_errors.PosePredictions) -> dict[str, tuple[str, ...]]:
    """Return the frames, targets and surfaces that are kept, and those fitted to the rows."""
    groups: dict[str, dict[str, None]] = {"kept": {}, "fitted": {}}
    for name in prediction.setup.table.names:
        groups["kept" if name in prediction.kept else "fitted"][owner_of(name)] = None
    return {key: tuple(owners) for key, owners in groups.items()}


def describe_frame(errors: row_errors.PoseErrors, setup: Sequence[str]) -> str:
    """Return the frame of errors in words; without any `setup` that was estimated, positions and
    orientations are those in the stated frame of the instrument.
    """
    if setup:
        return f"after the best fit of {list_names(setup, 6)}"
    if {"position", "orientation"} & errors.quantities.keys():
        return "in the stated frame"
    return "without any frame"


def _report_setup(
    first: row_errors.PosePredictions, last: row_errors.PosePredictions
) -> list[Finding]:
    """Report where the setup parameters come from."""
    before, after = group_setup(first), group_setup(last)
    codes = {
        "validation.setup-kept": after["kept"],
        "validation.setup-fitted-before": tuple(
            name for name in after["kept"] if name in before["fitted"]
        ),
        "validation.setup-fitted": after["fitted"],
    }
    return [report_finding(code, names=names) for code, names in codes.items() if names]


def _report_moved_setup(
    robot: Mechanism, compared: row_errors.PredictionComparison, kept: Mapping[str, float]
) -> list[Finding]:
    """Report kept frames, targets and surfaces that were apparently moved after the fit."""
    data, rows = compared.data, compared.data.observations
    entries = data.nuisance_parameters.table.entries
    owner = {p.name: owner_of(p.name) for p in entries}

    def measure_errors(refit: tuple[str, ...]) -> tuple[float, int]:
        """Return the whitened rms error with these fitted again, and the equations left over."""
        moved = frozenset(refit)
        values = {name: v for name, v in kept.items() if owner.get(name) not in moved}
        try:
            prediction = row_errors.predict_poses(
                robot, data, compared.solution, compared.usable, values
            )
        except DataError:  # too few rows to fit it
            return float("nan"), 0
        total = 0.0
        for o, residual in zip(rows, prediction.residuals(rows), strict=True):
            present = np.where(o.present, residual, 0.0)
            total += float(((o.whitener @ present[..., None]) ** 2).sum())
        fitted = sum(p.free and owner[p.name] in moved for p in entries)
        left = sum(o.n_residuals for o in rows) - fitted
        return float(np.sqrt(total / max(left, 1))), left

    names = dict.fromkeys(owner[p.name] for p in entries if p.free and p.name in kept)
    moved = find_moved_setups(tuple(names), measure_errors)
    if moved is None:
        return []
    return [report_finding("validation.setup-moved", names=moved[0], times=moved[1])]


# Poses and quantities of which little or nothing is compared.


def _report_left_out(
    data: Measurements, compared: row_errors.PredictionComparison
) -> list[Finding]:
    """Report poses with rows that no statistic contains, and poses that were estimated."""
    has_rows = np.zeros(data.n_poses, dtype=bool)
    for o in data.observations:
        has_rows[o.rows[o.weight > 0.0]] = True
    absorbed: dict[str, Any] = {"absorbed": int(compared.absorbed.sum())}
    cases: tuple[tuple[str, BoolArray, dict[str, Any]], ...] = (
        ("unreachable-poses", ~compared.usable & compared.predictable, {}),
        ("missing-readings", has_rows & ~compared.predictable, {}),
        ("poses-estimated", compared.estimated & compared.usable, absorbed),
    )
    return [
        report_finding(
            f"validation.{code}",
            names=tuple(f"pose {data.labels[i]}" for i in np.flatnonzero(poses)),
            **more,
        )
        for code, poses, more in cases
        if poses.any()
    ]


# Rows that the fitted ones do not predict, because they leave a frame or target open.


def _find_unpredicted(
    compared: row_errors.PredictionComparison, uncertainty: FitUncertainty | None
) -> tuple[list[BoolArray], list[Finding]]:
    """Return the rows (r,) of every kind whose setup the fit does not know: at a known machine it
    moves their prediction by more than `SETUP_KNOWN` standard deviations of the noise; and the
    finding of their poses and setup.
    """
    after, setup, places = compared.after, compared.after.setup, {}
    if uncertainty is not None:
        places = {name: i for i, name in enumerate(uncertainty.names) if name in after.kept}
    root = UnknownRoot.make_empty(len(setup))
    if uncertainty is not None and places:
        known = [places.get(name, -1) for name in setup.table.names]
        root = uncertainty.root.take(np.array(known))
        root = root._replace(values=root.values / uncertainty.noise_scale)
    sizes = after.setup_deviations(compared.data.observations, root)
    is_open, poses = [of_kind > SETUP_KNOWN for of_kind in sizes], dict[str, None]()
    is_used = np.zeros((2, len(setup)), dtype=bool)  # by others, and by these rows
    for o, used, opened in zip(compared.data.observations, setup.indices, is_open, strict=False):
        poses |= dict.fromkeys(compared.data.labels[i] for i in o.rows[opened].ravel())
        for own, which in zip(is_used, (~opened, opened), strict=True):
            own[used[which].ravel()] = True
    if not poses:
        return is_open, []
    alone = is_used[1] & ~is_used[0]
    chosen = np.flatnonzero(alone if alone.any() else is_used[1])
    owners = dict.fromkeys(owner_of(setup.table.names[i]) for i in chosen)
    code = "validation.setup-undetermined"
    return is_open, [report_finding(code, poses=tuple(poses), names=tuple(owners))]


# Held-out poses that neither the calibration nor the others explain.


def _report_blunders(
    blunders: tuple[Blunder, ...], errors: Validation, rest: Validation | None
) -> list[Finding]:
    """Return a finding for each blunder, and whether they dominate the errors of all poses.

    rest : the errors without the blunders.
    """
    largest = _find_largest(blunders, errors)
    findings = [b.report(**result) for b, result in zip(blunders, largest, strict=True)]
    if rest is None:
        return findings
    poses = tuple(label for blunder in blunders for label in blunder.poses)
    for quantity, unit in errors.units.items():
        every, without = (e.after.statistics(quantity).rms for e in (errors, rest))
        if every > DOMINATES * without or np.isnan(without):
            error, left = (None if np.isnan(x) else to_quantity(x, unit) for x in (every, without))
            stated: dict[str, Any] = {"poses": poses, "quantity": quantity, "error": error}
            code = "validation.blunders-dominate"
            return [*findings, report_finding(code, **stated, without=left)]
    return findings


def _find_largest(blunders: Sequence[Blunder], errors: Validation) -> list[dict[str, Any]]:
    """Return quantity, target and error of the largest error of each blunder, compared with the
    noise; empty where only actuator readings are compared.
    """
    of_row = []  # blunders of each row, which may compare several poses
    for poses in errors.poses:
        labels = set(poses.split("/"))
        of_row.append([i for i, blunder in enumerate(blunders) if labels & set(blunder.poses)])
    results: list[dict[str, Any]] = [{"quantity": "", "target": "", "error": ""} for _ in blunders]
    worst = [0.0] * len(blunders)
    for quantity, of_rows in errors.after.quantities.items():
        floor, unit = errors.noise_floor.rms[quantity], errors.units[quantity]
        entries = zip(of_rows.rows.tolist(), of_rows.size.tolist(), of_rows.targets, strict=True)
        for row, size, target in entries:
            for i in of_row[row]:
                if size > worst[i] * floor:
                    worst[i] = size / floor
                    error = to_quantity(size, unit)
                    results[i] = {"quantity": quantity, "target": target, "error": error}
    return results


def match_owners(patterns: Sequence[str], *data: Measurements) -> set[str]:
    """Return the frames, targets and surfaces of measurements that patterns such as `tracker*`
    name; refuse one that names none.
    """
    tables = [each.nuisance_parameters.table for each in data]
    owners = {owner_of(name) for table in tables for name in table.names}
    for pattern in patterns:
        if not any(fnmatchcase(owner, pattern) for owner in owners):
            listed = ", ".join(sorted(owners)) or "none"
            raise DataError(
                f"no frame, target or surface of these data has the name {pattern!r}"
                f"{suggest_names(pattern, owners)}; the data have: {listed}"
            )
    return {o for o in owners if any(fnmatchcase(o, pattern) for pattern in patterns)}


def report_reused_rows(fitted: FittedRows | None, data: Measurements) -> Finding | None:
    """Return the finding that some rows for validation belong to a calibration, whose rows are
    `fitted`; None where no row does, or they are not known. Refuse half of the rows or more.
    """
    for finding in _report_reused(fitted, data):
        if finding.data["count"] >= REFUSED_SHARE * finding.data["total"]:
            raise DataError(replace(finding, severity=Severity.REFUSAL))
        return finding
    return None


def _report_reused(fitted: FittedRows | None, data: Measurements) -> list[Finding]:
    reused = (fitted or FittedRows()).find_in(data)
    stated: dict[str, Any] = reused._asdict()
    finding = report_finding("validation.rows-reused", Severity.WARNING, **stated)
    return [finding] if reused.count else []


# A validation in a run folder: its numbers in result.json, and its differences as arrays.


def store_differences(validation: Validation) -> dict[str, FloatArray]:
    """Return the differences (e, 3) [SI] of the errors before and after, by name."""
    return {
        f"{PREFIX}_{name}_{quantity}": errors.components
        for name in ERRORS
        for quantity, errors in getattr(validation, name).quantities.items()
    }


def restore_validation(
    content: Mapping[str, Any], arrays: Mapping[str, np.ndarray], robot: Mechanism
) -> Validation:
    """Return the numbers of a stored validation.

    Findings stay sentences of `content`. Only the errors before and after have differences by
    component; of the others, the first component is the size.

    content : `Validation.to_dict()` of the run. arrays : of the run. robot : for units.
    """
    errors = {
        name: _restore_errors(content[name], arrays, f"{PREFIX}_{name}")
        for name in (*ERRORS, "commanded_before", "commanded_after", "not_compensable")
    }
    rest = content["without_blunders"]
    if rest is not None:
        unknown = {"commanded_before": {}, "commanded_after": {}, "not_compensable": {}}
        unknown |= {"blunders": (), "without_blunders": None, "failed": (), "conformity": {}}
        rest = restore_validation({**content, **unknown, **rest}, {}, robot)
    return restore(
        Validation,
        content,
        **errors,
        units=find_error_units(robot, errors["after"]),
        noise_floor=restore(row_errors.NoiseFloor, {"metrics": content["noise_floor"]}),
        findings=(),
        blunders=tuple(
            restore(Blunder, blunder, explanation=Explanation("none"))
            for blunder in content["blunders"]
        ),
        without_blunders=rest,
    )


def _restore_errors(
    content: Mapping[str, Any], arrays: Mapping[str, np.ndarray], name: str
) -> row_errors.PoseErrors:
    quantities = {}
    for quantity, stored in content.items():
        components = arrays.get(f"{name}_{quantity}")
        if components is None:
            size = np.array(stored["errors"], dtype=float)
            components = np.column_stack([size, np.full((len(size), 2), np.nan)])
        own = {"components": components, "measured": tuple(stored["components"])}
        quantities[quantity] = errors = restore(row_errors.QuantityErrors, stored, **own)
        if not len(components) == len(errors.rows) == len(errors.targets):
            raise ValueError("errors, rows and targets of different numbers")
    return row_errors.PoseErrors(quantities)
