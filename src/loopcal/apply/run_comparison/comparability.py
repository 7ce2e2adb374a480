# SPDX-License-Identifier: Apache-2.0
"""Refuse calibrations whose numbers cannot be compared, and say why."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from loopcal.apply.run_comparison.stored_run import StoredRun
from loopcal.diagnose.value_comparison import EQUAL, refuse_other_dimensions
from loopcal.errors import DataError
from loopcal.findings import report_finding
from loopcal.mechanism import Mechanism
from loopcal.units import Dimension

NEEDED = ("path", "result", "robot", "arrays", "load_posterior")
"""Attributes by which an argument is recognized as a run."""


def check_runs(runs: Sequence[StoredRun]) -> None:
    """Refuse too few runs, the same one twice, and what is no run.

    Raises
    ------
    DataError : `runs.too-few`, `runs.given-twice` or `runs.no-calibration`.
    """
    is_list = isinstance(runs, Sequence) and not isinstance(runs, str)
    if not is_list or not all(hasattr(run, name) for run in runs for name in NEEDED):
        raise DataError("runs: give a list of runs, such as [load_run('may'), load_run('june')]")
    if len(runs) < 2:
        raise DataError(report_finding("runs.too-few", count=len(runs)))
    known = set()
    for run in runs:
        place = run.path.resolve()
        if place in known:
            raise DataError(report_finding("runs.given-twice", run=str(run.path)))
        known.add(place)
        if not run.result.get("fit", {}).get("parameters"):
            raise DataError(report_finding("runs.no-calibration", run=str(run.path)))


def refuse_incomparable(
    first: StoredRun, second: StoredRun, names: tuple[str, str], is_same_data: bool
) -> None:
    """Refuse two runs whose parameters do not mean the same.

    Parameters
    ----------
    names : of both runs. is_same_data : whether both were fitted to the same rows; then they may
        identify different parameters, because only methods and models are compared.

    Raises
    ------
    DataError : `runs.other-...`; EstimationError : `comparison.other-dimensions`.
    """
    words: dict[str, Any] = dict(zip(("first", "second"), names, strict=True))
    mine, theirs = first.robot, second.robot
    if name := _find_lonely(mine.parameters.names, theirs.parameters.names):
        place = names[0] if name in mine.parameters.names else names[1]
        raise DataError(report_finding("runs.other-parameters", **words, name=name, place=place))
    for what, first_text, second_text in _list_structure(mine, theirs):
        if first_text != second_text:
            data: dict[str, Any] = {"what": what, "mine": first_text, "theirs": second_text}
            raise DataError(report_finding("runs.other-mechanism", **words, **data))
    free = [list_free(run) for run in (first, second)]
    if not is_same_data and (name := _find_lonely(*free)):
        place = names[0] if name in free[0] else names[1]
        raise DataError(report_finding("runs.other-free", **words, name=name, place=place))
    for i, name in enumerate(mine.parameters.names):
        if name in free[0] or name in free[1]:
            continue
        dimension = mine.parameters.dimensions[i]
        size = mine.size if dimension is Dimension.LENGTH else 1.0
        values = [float(robot.values[i]) for robot in (mine, theirs)]
        if abs(values[0] - values[1]) > EQUAL * size:
            shown = [mine.to_quantity(value, dimension) for value in values]
            data = {"name": name, "mine": shown[0], "theirs": shown[1]}
            raise DataError(report_finding("runs.other-fixed-value", **words, **data))
    refuse_other_dimensions(mine, theirs, names)


def _find_lonely(first: Sequence[str], second: Sequence[str]) -> str:
    """Return the first name that only one of two lists has; empty without any."""
    different = [n for n in (*first, *second) if (n in first) != (n in second)]
    return different[0] if different else ""


def list_free(run: StoredRun) -> tuple[str, ...]:
    """Return the names of the parameters that a run identified."""
    return tuple(row["name"] for row in run.result["fit"]["parameters"])


def _list_structure(first: Mechanism, second: Mechanism) -> list[tuple[str, str, str]]:
    """Return what must be equal, in words, and its text in both robots."""
    table = second.parameters
    theirs = [table.dimensions[table.index(name)] for name in first.parameters.names]
    pairs = zip(first.parameters.names, first.parameters.dimensions, theirs, strict=True)
    return [
        ("actuators", _name_actuators(first), _name_actuators(second)),
        ("controlled coordinates", ", ".join(first.controlled), ", ".join(second.controlled)),
        *((f"physical dimensions of {n}", a.value, b.value) for n, a, b in pairs),
    ]


def _name_actuators(robot: Mechanism) -> str:
    """Return the actuators with their physical dimensions."""
    return ", ".join(f"{a.name} ({a.dimension.value})" for a in robot.actuators)
