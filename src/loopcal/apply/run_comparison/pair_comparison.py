# SPDX-License-Identifier: Apache-2.0
"""Two calibrations: whether the machine has changed, and by what.

The test needs independent data. Runs that were fitted to common rows have correlated errors; their
differences are stated, but not tested.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from loopcal.apply.run_comparison.stored_run import StoredRun, find_row_noise
from loopcal.diagnose.machine_changes import (
    ChangeCause,
    ParameterChanges,
    compare_information,
    estimate_cause,
    explain_change,
)
from loopcal.estimate.inference.posterior import Posterior
from loopcal.findings import Finding, report_finding
from loopcal.numerics.multiple_tests import compute_single_level
from loopcal.typing import BoolArray, FloatArray

CHANGE_LEVEL = 0.05
"""Probability that any of the compared machines is declared changed although none is."""

CAUSE_LEVEL = 0.01
"""Probability of rejecting the true cause of a change."""

TOO_WELL = 1e-3
"""Probability of a chi-square as small as that of runs which share rows in another form."""

COVERED = 1.96
"""Standard deviations of the half-width of a 95 % interval of a change."""


@dataclass(frozen=True, eq=False)
class PairComparison:
    """A run against the first one.

    Attributes
    ----------
    first, second : names of the runs.
    data : "independent", "same", "shared" (some rows are common) or "unknown".
    shared : number of common fitted rows.
    shift, shift_sd : (p,) change of each parameter of `names` and its standard deviation, while all
        others may have changed as well [SI]; NaN where the data do not determine it, or where
        nothing is tested.
    significant : (p,) which shifts are larger than the noise explains, at the level for all
        parameters of all runs together.
    chi_square, degrees, p_value : of the change in all directions that both data sets determine;
        NaN and 0 where it is not tested.
    moved : whether the machine has changed; None where it is not tested.
    cause : what explains the change. cause_shift, cause_sd : change of its parameters [SI].
    finding : the result with its code.
    """

    JSON_FIELDS: ClassVar[tuple[str, ...]] = (
        "first",
        "second",
        "data",
        "shared",
        "names",
        "shift",
        "shift_sd",
        "significant",
        "chi_square",
        "degrees",
        "p_value",
        "moved",
        "cause",
        "cause_shift",
        "cause_sd",
        "finding",
    )

    first: str
    second: str
    data: str
    shared: int
    names: tuple[str, ...]
    shift: FloatArray
    shift_sd: FloatArray
    significant: BoolArray
    chi_square: float
    degrees: int
    p_value: float
    moved: bool | None
    cause: ChangeCause
    cause_shift: FloatArray
    cause_sd: FloatArray
    finding: Finding

    def __repr__(self) -> str:
        return f"<PairComparison: {self.finding}>"


@dataclass(frozen=True)
class DataRelation:
    """How the fitted rows of two runs are related: `kind` as in `PairComparison.data`."""

    kind: str
    shared: int = 0
    total: int = 0


def relate_data(first: StoredRun, second: StoredRun) -> DataRelation:
    """Return whether two runs were fitted to common rows."""
    mine, theirs = first.fitted_rows, second.fitted_rows
    if mine is None or theirs is None:
        return DataRelation("unknown")
    noise = {**find_row_noise(first), **find_row_noise(second)}
    readings = len(first.robot.actuators)
    shared = min(
        rows.count_shared(other_rows, readings, noise)
        for rows, other_rows in ((mine, theirs), (theirs, mine))
    )
    total = max(len(mine), len(theirs))
    kind = "independent" if not shared else "same" if shared == total else "shared"
    return DataRelation(kind, shared, total)


def compare_pair(
    first: StoredRun, second: StoredRun, names: tuple[str, str], relation: DataRelation, tests: int
) -> PairComparison:
    """Compare a run with the first one.

    Parameters
    ----------
    names : of both runs. relation : of their data. tests : number of runs that are compared with
        the first one.
    """
    words: dict[str, Any] = dict(zip(("first", "second"), names, strict=True))
    if relation.kind == "same":
        finding = report_finding("runs.same-data", **words, shared=relation.shared)
        return _leave_open(first, names, relation, finding)
    if relation.kind == "shared":
        data: dict[str, Any] = {"shared": relation.shared, "total": relation.total}
        finding = report_finding("runs.rows-shared", **words, **data)
        return _leave_open(first, names, relation, finding)
    for name, run in zip(names, (first, second), strict=True):
        if reason := _find_obstacle(run):
            finding = report_finding("runs.not-tested", **words, run=name, reason=reason)
            return _leave_open(first, names, relation, finding)
    posteriors = (first.load_posterior(), second.load_posterior())
    changes = compare_information(*posteriors)
    if not changes.degrees:
        finding = report_finding("runs.not-tested", **words, run="", reason="nothing")
        return _leave_open(first, names, relation, finding)
    return _test(posteriors[0], changes, words, relation, tests)


def _test(
    earlier: Posterior,
    changes: ParameterChanges,
    words: Mapping[str, str],
    relation: DataRelation,
    tests: int,
) -> PairComparison:
    """Return the test of a change, and what explains it."""
    level = compute_single_level(CHANGE_LEVEL, tests)
    p_value = changes.compute_p_value(changes.chi_square, changes.degrees)
    moved = p_value < level
    cause, nothing = ChangeCause("none"), np.zeros(0)
    cause_shift, cause_sd = nothing, nothing
    numbers: dict[str, Any] = {"chi_square": changes.chi_square, "degrees": float(changes.degrees)}
    if moved:
        cause = explain_change(changes, CAUSE_LEVEL)
        if cause.parameters:
            cause_shift, cause_sd = estimate_cause(changes, cause)
        more = _word_cause(earlier, cause, cause_shift, cause_sd)
        judged = {**numbers, "p_value": p_value, "level": CHANGE_LEVEL, **more}
        finding = report_finding("runs.machine-changed", **words, **judged)
    elif p_value > 1.0 - TOO_WELL:
        judged = {**numbers, "probability": 1.0 - p_value}
        finding = report_finding("runs.agree-too-well", **words, **judged)
    else:
        judged = {**numbers, "p_value": p_value, "level": CHANGE_LEVEL}
        finding = report_finding("runs.machine-unchanged", **words, **judged)
    shift, sd = changes.estimate_shifts()
    single = compute_single_level(CHANGE_LEVEL, tests * int(np.isfinite(shift).sum()))
    return PairComparison(
        words["first"],
        words["second"],
        relation.kind,
        relation.shared,
        changes.names,
        shift,
        sd,
        np.nan_to_num(changes.test_shifts(), nan=1.0) < single,
        changes.chi_square,
        changes.degrees,
        p_value,
        bool(moved),
        cause,
        cause_shift,
        cause_sd,
        finding,
    )


def _word_cause(
    earlier: Posterior, cause: ChangeCause, shift: FloatArray, sd: FloatArray
) -> dict[str, Any]:
    """Return what a finding states of a cause."""
    change = ""
    if cause.kind == "parameter":
        robot, name = earlier.robot, cause.names[0]
        unit = robot.get_unit(robot.parameters.dimensions[robot.parameters.index(name)])
        value, half = (float(x[0]) / unit.factor_to_si for x in (shift, COVERED * sd))
        change = f"{value:+.3g} {unit.symbol} +/- {half:.2g} {unit.symbol}"
    alternatives = tuple(" and ".join(names) for names in cause.alternatives)
    return {
        "kind": cause.kind,
        "names": cause.names,
        "change": change,
        "alternatives": alternatives,
    }


def _find_obstacle(run: StoredRun) -> str:
    """Return why a run cannot be tested, as in `runs.not-tested`; empty where it can."""
    if run.fitted_rows is None or "information_rows" not in run.arrays:
        return "older"
    if run.result["fit"]["status"] != "converged":
        return "diverged"
    information = run.load_posterior().information
    return "" if information is not None and information.variance > 0.0 else "intervals"


def _leave_open(
    run: StoredRun, names: tuple[str, str], relation: DataRelation, finding: Finding
) -> PairComparison:
    """Return a comparison without a test."""
    free = tuple(row["name"] for row in run.result["fit"]["parameters"])
    unknown = np.full(len(free), np.nan)
    return PairComparison(
        *names,
        relation.kind,
        relation.shared,
        free,
        unknown,
        unknown,
        np.zeros(len(free), dtype=bool),
        float("nan"),
        0,
        float("nan"),
        None,
        ChangeCause("none"),
        np.zeros(0),
        np.zeros(0),
        finding,
    )
