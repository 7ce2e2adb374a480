# SPDX-License-Identifier: Apache-2.0
"""Watch a calibrated machine: whether a few new rows, measured now and then, still fit a run.

A check of c rows gives, with its instrument's frame and all else of its session eliminated,

    E (delta + d) = e + noise of unit variance

for the errors delta of the calibration (parameters, setup that stays, slow errors), known with
their covariance, and the change d of the parameters since. Checks since the calibration are stacked
and become the rows of a `ParameterChanges`, by which the change is tested and explained. A sudden
change is clearest in the newest check, a slow one in many: the newest 1, 2, 4, ... and all of them
are tested. With w such tests at each of n checks a year, the alarm is given at the level of one of
n w tests, so the stated rate bounds the probability of any false alarm within a year.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from loopcal.apply.validation import (
    REFUSED_SHARE,
    find_error_units,
    match_owners,
    owner_of,
    report_reused_rows,
)
from loopcal.diagnose.blunders import Predictor
from loopcal.diagnose.row_errors import PoseErrors, compare_predictions, compute_row_errors
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.fit_linearization import FitUncertainty
from loopcal.estimate.recalibration import ErrorPart, JudgedChange, ParameterChanges, judge_change
from loopcal.estimate.residual_test import DOUBT
from loopcal.findings import Finding, report_finding
from loopcal.measure.data_checks import check_actuators
from loopcal.measure.fitted_rows import FittedRows, collect_fitted_rows
from loopcal.measure.kinds.kind import SCALES
from loopcal.measure.measurements import Measurements
from loopcal.measure.readings import fill_in_reading_sigma
from loopcal.numerics.elimination import eliminate_columns
from loopcal.numerics.statistics import compute_f_tail, find_distinct
from loopcal.results.description import Field, each, fields, label_axes, pick
from loopcal.results.result import DrawnResult
from loopcal.results.tables import Block, Column, build_table, choose_unit, format_in
from loopcal.typing import FloatArray
from loopcal.units import Unit

if TYPE_CHECKING:
    from loopcal.io.runs.run_folder import Run

A_YEAR, FALSE_ALARMS = 52, 0.05
"""Checks a year, and the probability of any false alarm within it."""
FEWEST_POSES, MOST_POSES = 3, 20  # of a check, of which each is left out in turn


@dataclass(frozen=True)
class Check:
    """One check, tested together with those before it."""

    name: str
    poses: int
    # number of newest checks that show a change most clearly; 0 where the rows of this check
    # contradict the calibration in a way that no change of the parameters explains
    together: int
    # probability of a change as clear in any test of this check, if the machine has not changed
    p_value: float
    alarm: bool
    errors: Mapping[str, float]  # quantity -> rms prediction error of its rows [SI]

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("name", title="check"),
        Field("poses"),
        Field("together", title="tested together"),
        Field(
            "p_value", title="p if unchanged", show=lambda p: f"{p:.1e}" if p < 0.01 else f"{p:.2f}"
        ),
        Field("alarm", show=lambda alarm: "yes" if alarm else "no"),
        Field("errors"),
    )


@dataclass(frozen=True, eq=False, repr=False)
class CheckUp(DrawnResult):
    """A calibration against checks in the order of time.

    Attributes
    ----------
    checks : see `Check`. false_alarms : probability of any false alarm within a year of `a_year`
        checks. refitted : frames and other setup that each check determines for itself.
    units : of each quantity, in which its error is shown.
    cause : parameters or limbs whose change explains the newest check, and no pose or setup does.
    findings : whether the machine has changed, by the newest check.
    """

    checks: tuple[Check, ...]
    false_alarms: float
    a_year: int
    refitted: tuple[str, ...]
    units: Mapping[str, Unit]
    cause: tuple[str, ...]
    findings: tuple[Finding, ...]

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("checks", "false_alarms", "a_year", "level", "refitted", "moved", "cause"),
        *fields("findings"),
        *each("checks", "check", Check.FIELDS, "poses", "together", "p_value", "alarm"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(check="checks.name")

    def page(self) -> list[Block]:
        """Return the findings and the table of the checks."""
        columns: list[Any] = pick(Check.FIELDS, "name", "poses", "together", "p_value", "alarm")
        for name, stated in self.units.items():
            unit = choose_unit(stated, (check.errors.get(name) for check in self.checks))
            heading = Column(f"{name} error, rms", unit.symbol)
            columns.append((heading, lambda c, q=name, u=unit: format_in(u, c.errors.get(q), 3)))
        table = build_table("Checks since the calibration", self.checks, *columns)
        return [*map(str, self.findings), "", table]

    @property
    def level(self) -> float:
        """Probability, without a change, of the alarm at one check."""
        return self.false_alarms / self.a_year

    @property
    def moved(self) -> bool:
        """Whether the newest check says that the machine has changed."""
        return self.checks[-1].alarm

    def __str__(self) -> str:
        """Return the findings, one on each line."""
        return "\n".join(f"{f.severity.value}: {f}" for f in self.findings)


class CheckRows(NamedTuple):
    """Rows E of a check, and what the calibration knows of their errors.

    by_parameters : (k, p) derivative by the parameters [1 / SI]. value : (k,) e.
    known : (k, q) derivative by independent errors of the calibration of unit variance.
    rest, rest_degrees : chi-square of what neither of them causes, and its degrees of freedom.
    kept, refitted : names of the setup with its values in the run, and of that which the check
        determines itself.
    """

    by_parameters: FloatArray
    value: FloatArray
    known: FloatArray
    rest: float
    rest_degrees: int
    kept: tuple[str, ...]
    refitted: tuple[str, ...]


def check_up(
    run: Run,
    checks: Mapping[str, Measurements],
    *,
    false_alarms: float = FALSE_ALARMS,
    a_year: int = A_YEAR,
    refit: tuple[str, ...] = (),
) -> CheckUp:
    """Test whether a machine has changed since its calibration, by checks of a few poses each.

    Parameters
    ----------
    run : of the calibration, as from `load_run`. checks : name -> measurements, in order of time.
    false_alarms : probability of any false alarm within a year, above 0 and below 1.
    a_year : number of checks within it.
    refit : names of targets or surfaces, such as `ball*`, that moved since the calibration. The
        frame and the scale of an instrument are determined by each check in any case.

    Raises
    ------
    DataError : no check, a wrong rate, rows of the calibration, or a check of another robot.
    EstimationError : the run does not contain its uncertainty.
    """
    if not checks or not 0.0 < false_alarms < 1.0 or a_year < 1:
        raise DataError.of("checks.options", rate=false_alarms, a_year=a_year)
    uncertainty = run.load_uncertainty()
    if uncertainty is None or not np.isfinite(uncertainty.spread).all():
        raise EstimationError.of("checks.no-uncertainty")
    level = false_alarms / a_year
    rows: list[CheckRows] = []
    done: list[Check] = []
    units: dict[str, Unit] = {}
    notes: list[Finding] = []
    data = judged = None
    refit, seen = tuple(sorted(match_owners(refit, *checks.values()))), FittedRows()
    for name, given in checks.items():
        poses = np.concatenate([np.zeros(0, int), *(o.rows.ravel() for o in given.observations)])
        data = given.take(find_distinct(poses)) if poses.size else given  # those with a value
        reused = report_reused_rows(run.fitted_rows, data)
        notes += [] if reused is None else [reused]
        again = seen.find_in(data)
        if again.count and again.count >= REFUSED_SHARE * again.total:
            raise DataError.of("checks.rows-repeated", check=name, **again._asdict())
        seen = seen.joined(collect_fitted_rows(data))
        made, errors = _collect_rows(run, uncertainty, data, refit)
        rows.append(made)
        units |= find_error_units(run.robot, errors)
        judged, together, p_value = _judge(uncertainty, rows, false_alarms, a_year)
        rms = {quantity: e.statistics.rms for quantity, e in errors.quantities.items()}
        done.append(Check(name, data.n_poses, together, p_value, p_value < level, rms))
    assert data is not None
    assert judged is not None
    last = done[-1]
    said: dict[str, Any] = {"check": last.name, "together": last.together, **judged.data}
    said["failed"] = run.failure is not None
    said |= {"p_value": last.p_value, "level": false_alarms, "a_year": a_year}
    finding = report_finding("checks.machine-unchanged", **said)
    if last.alarm:

        def test(data: Measurements, names: tuple[str, ...] = ()) -> float:
            """Return the probability of a change as clear in some rows of the newest check, which
            determine also the setup of these names.
            """
            made, _ = _collect_rows(run, uncertainty, data, (*refit, *names))
            return _judge(uncertainty, [made], false_alarms, a_year)[2]

        code = "checks.machine-changed" if last.together else "checks.unexplained"
        other = _explain_otherwise(last.name, data, rows[-1].kept, test, level)
        finding = other or report_finding(code, **said)
    cause = judged.cause.names if finding.code == "checks.machine-changed" else ()
    findings = (finding, *notes)
    return CheckUp(tuple(done), false_alarms, a_year, rows[-1].refitted, units, cause, findings)


def _collect_rows(
    run: Run, uncertainty: FitUncertainty, data: Measurements, refit: tuple[str, ...]
) -> tuple[CheckRows, PoseErrors]:
    """Return the rows of a check, and its prediction errors."""
    robot = uncertainty.posterior.robot
    check_actuators(data, robot)
    table = data.nuisance_parameters.table
    # where an instrument stands, and its scale, are those of the check
    anew = {*refit, *(owner_of(name) for name in table.names if name.endswith((".rx", *SCALES)))}
    known = run.nuisance_values.keys() & set(uncertainty.names) & set(table.names)
    kept = {name: run.nuisance_values[name] for name in known if owner_of(name) not in anew}
    compared = compare_predictions(robot, robot, data, kept, kept)
    data, after = fill_in_reading_sigma(robot, compared.data), compared.after
    names = after.setup.table.names
    values = dict(zip(names, after.values[0].tolist(), strict=True))
    predictor = Predictor(robot, values, after.kept, uncertainty, ())
    one = np.zeros(data.n_poses, dtype=np.intp)  # all poses are one block
    ((_, columns, residual),) = predictor.iterate_rows(data, one)
    is_own = np.zeros(columns.shape[2], dtype=bool)
    for i, entry in enumerate(after.setup.table.entries):
        is_own[i] = entry.free and entry.name not in after.kept
    stacked = np.column_stack([columns[0][:, is_own], columns[0][:, ~is_own], -residual[0]])
    count = int(is_own.sum())
    absent = np.zeros((max(count - len(stacked), 0), stacked.shape[1]))
    free = eliminate_columns(np.concatenate([stacked, absent]), count).rest
    free = free[free.any(axis=1)]
    left = np.asarray(np.linalg.qr(free, mode="r"))
    rest_degrees = max(len(free) - free.shape[1] + 1, 0)
    rest = float(left[-1, -1] ** 2) if rest_degrees else 0.0
    left, p, first = left[: free.shape[1] - 1], len(uncertainty.posterior.unit), len(names) - count
    owners = [
        tuple(dict.fromkeys(owner_of(name) for i, name in enumerate(names) if is_own[i] == which))
        for which in (False, True)
    ]
    known = left[:, :-1] @ predictor.predict(data)[~is_own]
    slope = left[:, first : first + p] / uncertainty.posterior.unit
    rows = CheckRows(slope, left[:, -1], known, rest, rest_degrees, *owners)
    return rows, compute_row_errors(data.observations, after.residuals(data.observations))


def _combine(
    uncertainty: FitUncertainty, rows: list[CheckRows]
) -> tuple[ParameterChanges, float, int]:
    """Return what some checks together say of a change of the parameters; of the rest of their
    rows, which no change of them explains, the chi-square and its degrees of freedom.
    """
    posterior, degrees = uncertainty.posterior, uncertainty.noise.known_degrees
    p, q = len(posterior.unit), rows[0].known.shape[1]
    stacked = np.concatenate(
        [np.column_stack([c.by_parameters * posterior.unit, c.known, c.value]) for c in rows]
    )
    triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
    few = triangle[: p + q]
    # e = known y + slope d + noise, and 0 = y + errors of unit variance: what is left without y
    known = np.vstack([few[:, p:-1], np.eye(q)])
    left = np.linalg.qr(known, mode="complete")[0][:, q:].T
    noise, known = left[:, : len(few)], left[:, len(few) :]
    slope, value = noise @ few[:, :p], noise @ few[:, -1]
    errors = (ErrorPart(noise, degrees), ErrorPart(known, degrees))
    names = tuple(posterior.robot.parameters.names[i] for i in posterior.places)
    whole = ParameterChanges(names, posterior.unit, slope / posterior.unit, value, errors)
    changes = whole.select(list(range(p)))
    rest = whole.chi_square - changes.chi_square + float((triangle[p + q :, -1] ** 2).sum())
    rest += sum(check.rest for check in rows)
    count = len(stacked) - changes.degrees + sum(check.rest_degrees for check in rows)
    return changes, max(rest, 0.0), count


def _judge(
    uncertainty: FitUncertainty, rows: list[CheckRows], false_alarms: float, a_year: int
) -> tuple[JudgedChange, int, float]:
    """Return the clearest change that the newest checks show, and how many of them show it; or 0
    where what no change explains is clearer. Then the probability among all tests of this check.
    """
    sizes = [2**i for i in range(len(rows).bit_length()) if 2**i < len(rows)] + [len(rows)]
    combined = [_combine(uncertainty, rows[-size:]) for size in sizes]
    changes = [changes for changes, *_ in combined]
    if not changes[-1].degrees:
        raise DataError.of("checks.nothing-determined")
    bounds = [each.bound_probability() for each in changes]
    best = int(np.argmin(np.nan_to_num(bounds, nan=np.inf)))
    tests, robot = len(sizes) + 1, uncertainty.posterior.robot
    judged = judge_change(changes[best], robot, tests * a_year, false_alarms)
    p_value, together = judged.p_value, sizes[best]
    _, rest, count = combined[0]
    if count:
        p_rest = float(compute_f_tail(count, uncertainty.noise.known_degrees, rest / count))
        p_value, together = min((p_value, together), (p_rest, 0))
    return judged, together, min(tests * p_value, 1.0)


def _explain_otherwise(
    check: str, data: Measurements, kept: tuple[str, ...], test: Callable[..., float], level: float
) -> Finding | None:
    """Return what else than the machine explains the alarm of the newest check: one wrong pose,
    without which all agrees, or setup that moved; None where neither does.
    """
    if FEWEST_POSES <= data.n_poses <= MOST_POSES:
        others = (np.arange(data.n_poses) != i for i in range(data.n_poses))
        left = np.array([test(data.take(chosen)) for chosen in others])
        best = int(np.argmax(left))
        if left[best] >= DOUBT and (left >= level).sum() == 1:
            return report_finding("checks.wrong-pose", pose=data.labels[best], check=check)
    for names in (*((name,) for name in kept), kept):
        if names and test(data, names) >= level:
            return report_finding("checks.setup-moved", names=names, check=check)
    return None
