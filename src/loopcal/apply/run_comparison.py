# SPDX-License-Identifier: Apache-2.0
"""Several calibrations side by side: parameters, changes of the machine, and held-out errors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from loopcal.apply.validation import (
    find_error_units,
    report_reused_rows,
    restore_validation,
    validate,
)
from loopcal.diagnose.row_errors import PoseErrors, Statistics, join_errors
from loopcal.diagnose.value_comparison import EQUAL, refuse_other_dimensions
from loopcal.errors import DataError, FileError
from loopcal.estimate.recalibration import (
    CHANGE_LEVEL,
    ChangeCause,
    compare_information,
    judge_change,
)
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.statistics import compute_single_level
from loopcal.plain_text import represent
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import DrawnResult
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import UNITS, Dimension, Unit, find_unit

if TYPE_CHECKING:
    from loopcal.io.runs.run_folder import Run

NEEDED = ("path", "result", "robot", "arrays", "load_posterior")  # attributes of a run


@dataclass(frozen=True)
class RunErrors:
    """Statistics of the errors of a run after calibration [SI], by quantity."""

    run: str  # name
    # at the held-out poses of the run itself, which other runs do not share
    own: Mapping[str, Statistics]
    # at the poses that are common to all runs; empty where there are none
    common: Mapping[str, Statistics]


@dataclass(frozen=True, eq=False)
class PairComparison:
    """A run against the first one."""

    # first, second: names of the runs
    first: str
    second: str
    data: str  # "independent", "same", "shared" (some rows are common) or "unknown"
    shared: int  # number of common fitted rows
    finding: Finding  # the result with its code
    names: tuple[str, ...]
    # shift, shift_sd: (p,) change of each parameter of `names` and its standard deviation, while
    # all others may have changed as well [SI]; NaN where the data do not determine it, or where
    # nothing is tested
    shift: FloatArray
    shift_sd: FloatArray
    # (p,) which shifts are larger than the noise explains, at the level for all parameters of all
    # runs together
    significant: BoolArray
    # chi_square, degrees: of the change in all directions that both data sets determine; p_value:
    # of any change, see `ParameterChanges.compute_probability`; NaN and 0 where it is not tested
    chi_square: float = math.nan
    degrees: int = 0
    p_value: float = math.nan
    moved: bool | None = None  # whether the machine has changed; None where it is not tested
    # what explains the change
    cause: ChangeCause = field(default_factory=lambda: ChangeCause("none"))
    # cause_shift, cause_sd: change of its parameters [SI]
    cause_shift: FloatArray = field(default_factory=lambda: np.zeros(0))
    cause_sd: FloatArray = field(default_factory=lambda: np.zeros(0))

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("first", "second", "data", "shared", "names", "shift", "shift_sd", "significant"),
        *("chi_square", "degrees", "p_value", "moved", "cause", "cause_shift", "cause_sd"),
        "finding",
    )

    __repr__ = represent

    def find_shift(self, name: str) -> tuple[float, float, bool]:
        """Return a parameter's shift, its sd [SI], and whether it is significant, or NaN."""
        if name not in self.names:
            return math.nan, math.nan, False
        i = self.names.index(name)
        return float(self.shift[i]), float(self.shift_sd[i]), bool(self.significant[i])


@dataclass(frozen=True)
class RunSummary:
    """A run as one column of a comparison."""

    name: str  # of its folder
    # robot, method, verdict: as result.json states them
    robot: str
    method: str
    verdict: str
    # estimates, plus_minus: parameter -> estimate and half-width of its 95 % interval [SI]; None
    # where there is no interval. A parameter that this run kept fixed is absent
    estimates: dict[str, float]
    plus_minus: dict[str, float | None]


@dataclass(frozen=True, eq=False, repr=False)
class RunComparison(DrawnResult):
    """Calibrations side by side; the first one is the reference of all others.

    Attributes
    ----------
    runs : in the given order. parameters : names of all identified parameters.
    units : of each parameter, in which it is shown.
    pairs : each run but the first against the first.
    errors : of each run at held-out poses. error_units : quantity -> unit in which they are shown.
    common_poses : number of poses that are common to all.
    findings : results of the pairs, runs that failed, and notes.
    """

    runs: tuple[RunSummary, ...]
    parameters: tuple[str, ...]
    units: tuple[Unit, ...]
    pairs: tuple[PairComparison, ...]
    errors: tuple[RunErrors, ...]
    error_units: Mapping[str, Unit]
    common_poses: int
    findings: tuple[Finding, ...]

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(runs="", parameters="", units="units.symbol", pairs="", errors=""),
        *fields("common_poses", "moved", "findings"),
        Field("unit", "units.symbol", "parameter"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="parameters")

    def list_fields(self) -> Iterator[Field]:
        """Yield the fields, among them the estimates and the shifts of each run in shown units."""
        yield from self.FIELDS
        factor = [unit.factor_to_si for unit in self.units]

        def show(name: str, values: Iterable[float | None]) -> Field:
            return Field(name, lambda _: np.array(list(values), float) / factor, "parameter")

        for run in self.runs:
            yield show(f"{run.name} estimate", map(run.estimates.get, self.parameters))
            yield show(f"{run.name} plus_minus", map(run.plus_minus.get, self.parameters))
        for pair in self.pairs:
            shift, sd, significant = zip(*map(pair.find_shift, self.parameters), strict=True)
            yield show(f"{pair.second} shift", shift)
            yield show(f"{pair.second} shift_sd", sd)
            yield Field(f"{pair.second} significant", lambda _, s=significant: s, "parameter")

    @property
    def moved(self) -> bool | None:
        """Whether any machine differs from that of the first run; None where nothing was tested."""
        answers = [pair.moved for pair in self.pairs if pair.moved is not None]
        return any(answers) if answers else None


def compare_runs(runs: Sequence[Run], data: Measurements | None = None) -> RunComparison:
    """Compare calibrations side by side: sessions of one machine, several machines, or methods.

    The first run is the reference. Where the data of two runs are independent, whether the machine
    has changed is tested in the directions that both data sets determine, and what explains the
    change is named. The false-alarm rate is 5 % for all runs together. Runs of the same rows are
    compared without a test: their errors are correlated.

    Parameters
    ----------
    runs : two or more, as from `load_run`.
    data : other measurements, at which the errors of all runs are compared.

    Raises
    ------
    DataError, EstimationError
        Too few runs, one of them twice, or runs that cannot be compared: other parameters,
        mechanisms, free parameters or fixed values.

    Examples
    --------
    >>> import loopcal as lc
    >>> comparison = lc.compare_runs([lc.load_run("may"), lc.load_run("june")])  # doctest: +SKIP
    >>> comparison.moved  # doctest: +SKIP
    False
    """
    _check_runs(runs)
    folders = [run.path.resolve().name for run in runs]
    names = [
        str(run.path) if folders.count(folder) > 1 else folder
        for folder, run in zip(folders, runs, strict=True)
    ]
    first = runs[0]
    findings, pairs = [], []
    for name, run in zip(names[1:], runs[1:], strict=True):
        words = {"first": names[0], "second": name}
        relation = _relate_data(first, run)
        _refuse_incomparable(first, run, words, relation[0] == "same")
        pairs.append(_compare_pair(first, run, words, relation, len(runs) - 1))
        findings.append(pairs[-1].finding)
    findings += [
        report_finding("runs.failed-run", run=name)
        for name, run in zip(names, runs, strict=True)
        if run.failure is not None
    ]
    if data is None:
        held_out = _find_common_poses(runs)
        poses = len(held_out)
        common = [_read_errors(run, held_out) for run in runs]
    else:
        poses = data.n_poses
        common = [_validate(run, data, findings) for run in runs]
    own = [_read_errors(run) for run in runs]
    errors = tuple(
        RunErrors(name, *({q: e.statistics for q, e in of.quantities.items()} for of in both))
        for name, *both in zip(names, own, common, strict=True)
    )
    if not poses and all(run_errors.own for run_errors in errors):
        findings.append(report_finding("runs.no-common-poses"))
    parameters = tuple(dict.fromkeys(n for run in runs for n in _list_free(run)))
    table = first.robot.parameters
    dimensions = [table.dimensions[table.index(name)] for name in parameters]
    units = tuple(find_unit(first.robot.get_unit(d).symbol) for d in dimensions)
    summaries = tuple(_summarize(name, run) for name, run in zip(names, runs, strict=True))
    return RunComparison(
        summaries,
        parameters,
        units,
        tuple(pairs),
        errors,
        find_error_units(first.robot, join_errors([*own, *common])),
        poses,
        tuple(findings),
    )


def _summarize(name: str, run: Run) -> RunSummary:
    fit = run.result["fit"]
    estimates, plus_minus = {}, {}
    for row in fit["parameters"]:
        place = run.robot.parameters.index(row["name"])
        unit, half = UNITS[row["unit"]], row["plus_minus"]
        estimates[row["name"]] = float(run.robot.values[place])
        plus_minus[row["name"]] = None if half is None else half * unit.factor_to_si
    verdict = str(run.result["verdict"]).replace("_", " ")
    return RunSummary(name, run.robot.name, fit.get("method", ""), verdict, estimates, plus_minus)


def _list_free(run: Run) -> tuple[str, ...]:
    """Return the names of the parameters that a run identified."""
    return tuple(row["name"] for row in run.result["fit"]["parameters"])


# Refuse calibrations whose numbers cannot be compared, and say why.


def _check_runs(runs: Sequence[Run]) -> None:
    """Refuse too few runs, the same one twice, and what is no run."""
    is_list = isinstance(runs, Sequence) and not isinstance(runs, str)
    if not is_list or not all(hasattr(run, name) for run in runs for name in NEEDED):
        raise DataError("runs: give a list of runs, such as [load_run('may'), load_run('june')]")
    if len(runs) < 2:
        raise DataError.of("runs.too-few", count=len(runs))
    known = set()
    for run in runs:
        place = run.path.resolve()
        if place in known:
            raise DataError.of("runs.given-twice", run=str(run.path))
        known.add(place)
        if not run.result.get("fit", {}).get("parameters"):
            raise DataError.of("runs.no-calibration", run=str(run.path))


def _refuse_incomparable(
    first: Run, second: Run, words: Mapping[str, Any], is_same_data: bool
) -> None:
    """Refuse two runs whose parameters do not mean the same.

    words : names of both. is_same_data : whether both were fitted to the same rows; then they may
        identify different parameters, because only methods and models are compared.
    """

    def refuse_lonely(code: str, mine: Sequence[str], theirs: Sequence[str]) -> None:
        for name in (n for n in (*mine, *theirs) if (n in mine) != (n in theirs)):
            place = words["first" if name in mine else "second"]
            raise DataError.of(code, **words, name=name, place=place)

    mine, theirs = first.robot, second.robot
    refuse_lonely("runs.other-parameters", mine.parameters.names, theirs.parameters.names)
    structure = _list_structure(theirs)
    for what, text in _list_structure(mine).items():
        if text != structure[what]:
            data: dict[str, Any] = {"what": what, "mine": text, "theirs": structure[what]}
            raise DataError.of("runs.other-mechanism", **words, **data)
    free = [_list_free(run) for run in (first, second)]
    if not is_same_data:
        refuse_lonely("runs.other-free", *free)
    for i, name in enumerate(mine.parameters.names):
        if name in free[0] or name in free[1]:
            continue
        dimension = mine.parameters.dimensions[i]
        size = mine.size if dimension is Dimension.LENGTH else 1.0
        values = [float(robot.values[i]) for robot in (mine, theirs)]
        if abs(values[0] - values[1]) > EQUAL * size:
            shown = [mine.to_quantity(value, dimension) for value in values]
            data = {"name": name, "mine": shown[0], "theirs": shown[1]}
            raise DataError.of("runs.other-fixed-value", **words, **data)
    refuse_other_dimensions(mine, theirs, (words["first"], words["second"]))


def _list_structure(robot: Mechanism) -> dict[str, str]:
    """Return what must be equal in two robots of the same parameters: name and text."""
    table = robot.parameters
    return {
        "actuators": ", ".join(f"{a.name} ({a.dimension.value})" for a in robot.actuators),
        "controlled coordinates": ", ".join(robot.controlled),
        **{
            f"physical dimensions of {name}": dimension.value
            for name, dimension in zip(table.names, table.dimensions, strict=True)
        },
    }


# The errors of calibrations at the same held-out poses.


def _validate(run: Run, data: Measurements, findings: list[Finding]) -> PoseErrors:
    """Return the errors of a run at other measurements; add a finding on rows that it fitted."""
    reused = report_reused_rows(run.fitted_rows, data)
    findings += [] if reused is None else [reused]
    validation = validate(
        run.robot,
        data,
        before=run.initial_robot,
        nuisance_values=run.nuisance_values,
        nuisance_values_before=run.initial_nuisance_values,
        uncertainty=run.load_uncertainty(),
    )
    return validation.after


def _find_common_poses(runs: Sequence[Run]) -> tuple[str, ...]:
    """Return the poses that all runs of the same files held out: names of poses of different files
    do not mean the same.
    """
    digests = []
    for run in runs:
        files = run.result["made_by"]["inputs"]
        of_data = [r for r in files if r.partition("-")[0] in ("data", "poses")]
        digests.append(sorted(files[role]["sha256"] for role in of_data))
    if not digests[0] or any(digest != digests[0] for digest in digests):
        return ()
    first, *others = (run.held_out for run in runs)
    return tuple(label for label in first if all(label in other for other in others))


def _read_errors(run: Run, poses: Sequence[str] | None = None) -> PoseErrors:
    """Return the stored errors at held-out poses: at all, or in rows that measure only `poses`.

    FileError : the run states something else than errors.
    """
    stored = run.result.get("validation")
    try:
        validation = stored and restore_validation(stored, run.arrays, run.robot)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        problem = "'validation' is not what a calibration writes"
        raise FileError.of("files.run-damaged", run.path, problem=problem) from error
    if not validation:
        return PoseErrors()
    labels = validation.poses
    chosen = set(labels if poses is None else poses)
    rows = [
        i for i, each in enumerate(labels) if each in chosen or chosen.issuperset(each.split("/"))
    ]
    return validation.after.take(np.array(rows, dtype=np.intp))


# Two calibrations: whether the machine has changed, and by what.


def _relate_data(first: Run, second: Run) -> tuple[str, int, int]:
    """Return `PairComparison.data` of two runs, with the numbers of common rows and of all."""
    mine, theirs = first.fitted_rows, second.fitted_rows
    if mine is None or theirs is None:
        return "unknown", 0, 0
    noise = {**_find_row_noise(first), **_find_row_noise(second)}
    readings = len(first.robot.actuators)
    shared = min(
        rows.count_shared(other_rows, readings, noise)
        for rows, other_rows in ((mine, theirs), (theirs, mine))
    )
    total = max(len(mine), len(theirs))
    return "independent" if not shared else "same" if shared == total else "shared", shared, total


def _find_row_noise(run: Run) -> dict[str, FloatArray]:
    """Return the noise of each kind [SI]: the median of residuals divided by whitened ones."""
    result = {}
    for name, raw in run.arrays.items():
        if not name.startswith("residual_"):
            continue
        whitened = run.arrays.get(name.replace("residual_", "whitened_", 1))
        if whitened is None or whitened.shape != raw.shape or raw.ndim != 2 or not len(raw):
            continue
        usable = np.isfinite(raw) & np.isfinite(whitened) & (whitened != 0.0)
        ratio = np.abs(raw) / np.where(usable, np.abs(whitened), np.inf)
        medians = np.ma.median(np.ma.array(ratio, mask=~usable), axis=0)
        result[name.split("_", 2)[2]] = medians.filled(0.0)
    return result


def _compare_pair(
    first: Run, second: Run, words: Mapping[str, str], relation: tuple[str, int, int], tests: int
) -> PairComparison:
    """Compare a run with the first one.

    words : names of both. relation : of their data. tests : number of runs that are compared.
    """
    kind, shared, total = relation
    data: dict[str, Any]
    if kind == "same":
        code, data = "runs.same-data", {"shared": shared}
    elif kind == "shared":
        code, data = "runs.rows-shared", {"shared": shared, "total": total}
    else:
        obstacles = zip(words.values(), map(_find_obstacle, (first, second)), strict=True)
        run, reason = next((each for each in obstacles if each[1]), ("", "nothing"))
        code, data = "runs.not-tested", {"run": run, "reason": reason}
    names, finding = _list_free(first), report_finding(code, **words, **data)
    unknown, none = np.full(len(names), np.nan), np.zeros(len(names), dtype=bool)
    pair = PairComparison(
        words["first"], words["second"], kind, shared, finding, names, unknown, unknown, none
    )
    if data.get("reason") != "nothing":
        return pair
    earlier = first.load_posterior()
    changes = compare_information(earlier, second.load_posterior())
    if not changes.degrees:
        return pair
    judged = judge_change(changes, earlier.robot, tests)
    shifts, sd = changes.estimate_shifts()
    single = compute_single_level(CHANGE_LEVEL, tests * int(np.isfinite(shifts).sum()))
    return replace(
        pair,
        finding=report_finding(f"runs.{judged.code}", **words, **judged.data),
        names=changes.names,
        shift=shifts,
        shift_sd=sd,
        significant=np.nan_to_num(changes.test_shifts(), nan=1.0) < single,
        chi_square=changes.chi_square,
        degrees=changes.degrees,
        p_value=judged.p_value,
        moved=judged.moved,
        cause=judged.cause,
        cause_shift=judged.shift,
        cause_sd=judged.sd,
    )


def _find_obstacle(run: Run) -> str:
    """Return why a run cannot be tested, as in `runs.not-tested`; empty where it can."""
    if run.fitted_rows is None:
        return "rows"
    if run.result["fit"]["status"] != "converged":
        return "diverged"
    information = run.load_posterior().information
    return "" if information is not None and information.variance > 0.0 else "intervals"
