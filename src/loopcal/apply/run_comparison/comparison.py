# SPDX-License-Identifier: Apache-2.0
"""Several calibrations side by side: parameters, changes of the machine, and held-out errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from loopcal.apply.run_comparison.comparability import check_runs, list_free, refuse_incomparable
from loopcal.apply.run_comparison.held_out_errors import RunErrors, collect_errors
from loopcal.apply.run_comparison.pair_comparison import PairComparison, compare_pair, relate_data
from loopcal.apply.run_comparison.stored_run import StoredRun
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements
from loopcal.presentation import TableResult, draw
from loopcal.units import UNITS, Unit, find_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class RunSummary:
    """A run as one column of a comparison.

    Attributes
    ----------
    name : of its folder. robot, method, verdict : as result.json states them.
    estimates, plus_minus : parameter -> estimate and half-width of its 95 % interval [SI]; None
        where there is no interval. A parameter that this run kept fixed is absent.
    """

    name: str
    robot: str
    method: str
    verdict: str
    estimates: dict[str, float]
    plus_minus: dict[str, float | None]


@dataclass(frozen=True, eq=False)
class RunComparison(TableResult):
    """Calibrations side by side; the first one is the reference of all others.

    Attributes
    ----------
    runs : in the given order. parameters : names of all identified parameters.
    units : of each parameter, in which it is shown.
    pairs : each run but the first against the first.
    errors : of each run at held-out poses. common_poses : number of poses that are common to all.
    findings : results of the pairs, runs that failed, and notes.
    """

    runs: tuple[RunSummary, ...]
    parameters: tuple[str, ...]
    units: tuple[Unit, ...]
    pairs: tuple[PairComparison, ...]
    errors: tuple[RunErrors, ...]
    common_poses: int
    findings: tuple[Finding, ...]

    @property
    def moved(self) -> bool | None:
        """Whether any machine differs from that of the first run; None where nothing was tested."""
        answers = [pair.moved for pair in self.pairs if pair.moved is not None]
        return any(answers) if answers else None

    def plot(self) -> Figure:
        """Draw the tested shift of each parameter from the first run, in standard deviations."""
        return draw("draw_run_shifts", self)

    def __str__(self) -> str:
        """Return the findings, one on each line."""
        names = ", ".join(run.name for run in self.runs)
        lines = [f"{f.severity.value}: {f}" for f in self.findings]
        return "\n".join([f"Comparison of {names}:", *lines])

    __repr__ = __str__

    def to_dict(self) -> dict[str, Any]:
        """Return the result by name for JSON, SI; `units` are those in which people see it."""
        return {
            "runs": self.runs,
            "parameters": self.parameters,
            "units": [unit.symbol for unit in self.units],
            "pairs": self.pairs,
            "errors": self.errors,
            "common_poses": self.common_poses,
            "moved": self.moved,
            "findings": self.findings,
        }


def compare_runs(runs: Sequence[StoredRun], data: Measurements | None = None) -> RunComparison:
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
    check_runs(runs)
    names = _name_runs(runs)
    first = runs[0]
    findings, pairs = [], []
    for name, run in zip(names[1:], runs[1:], strict=True):
        relation = relate_data(first, run)
        refuse_incomparable(first, run, (names[0], name), relation.kind == "same")
        pairs.append(compare_pair(first, run, (names[0], name), relation, len(runs) - 1))
        findings.append(pairs[-1].finding)
    findings += [
        report_finding("runs.failed-run", run=name)
        for name, run in zip(names, runs, strict=True)
        if run.failure is not None
    ]
    errors, poses, notes = collect_errors(runs, names, data)
    findings += notes
    if not poses and all(run_errors.own for run_errors in errors):
        findings.append(report_finding("runs.no-common-poses"))
    parameters = tuple(dict.fromkeys(n for run in runs for n in list_free(run)))
    table = first.robot.parameters
    dimensions = [table.dimensions[table.index(name)] for name in parameters]
    units = tuple(find_unit(first.robot.get_unit(d).symbol) for d in dimensions)
    summaries = tuple(_summarize(name, run) for name, run in zip(names, runs, strict=True))
    return RunComparison(summaries, parameters, units, tuple(pairs), errors, poses, tuple(findings))


def _name_runs(runs: Sequence[StoredRun]) -> tuple[str, ...]:
    """Return the names of the folders, or their paths where a name is not unique."""
    names = [run.path.resolve().name for run in runs]
    return tuple(
        str(run.path) if names.count(name) > 1 else name
        for name, run in zip(names, runs, strict=True)
    )


def _summarize(name: str, run: StoredRun) -> RunSummary:
    """Return the column of a run."""
    fit = run.result["fit"]
    estimates, plus_minus = {}, {}
    for row in fit["parameters"]:
        place = run.robot.parameters.index(row["name"])
        unit, half = UNITS.get(row.get("unit", "")), row["plus_minus"]
        estimates[row["name"]] = float(run.robot.values[place])
        # runs of earlier versions may state no unit, and then no interval is known
        plus_minus[row["name"]] = None if half is None or unit is None else half * unit.factor_to_si
    verdict = str(run.result.get("verdict", "")).replace("_", " ")
    return RunSummary(name, run.robot.name, fit.get("method", ""), verdict, estimates, plus_minus)
