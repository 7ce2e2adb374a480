# SPDX-License-Identifier: Apache-2.0
"""What loopcal reads back from the result.json of a run: the declared form of its keys.

A run states far more than this. Keys that are not declared here are for people and other programs,
and are not checked. A number that is not finite is null in the file.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from loopcal.errors import FileError
from loopcal.findings import report_finding
from loopcal.io.core.json_text import read_json
from loopcal.io.core.limits import TABLE_SIZE
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import YamlFile
from loopcal.mechanism import Mechanism
from loopcal.units import UNITS

RESULT = "result.json"
FORMAT = 2
"""Format of result.json; runs of format 1 lack `files`, and may lack keys that came later."""

REPEAT = "restore the run folder from a copy, or repeat the calibration"
"""What to do about a damaged run."""

_SURROGATE = re.compile("[\ud800-\udfff]")
"""Half a character: part of a file name that is not UTF-8."""


@dataclass(frozen=True, eq=False, repr=False)
class _Part:
    """A mapping in result.json, of which only the fields are read."""

    OTHER_KEYS: ClassVar[bool] = True


@dataclass(frozen=True, eq=False, repr=False)
class StoredParameter(_Part):
    """An entry of `fit.parameters` or, for setup parameters, of `fit.local`."""

    name: str
    plus_minus: float | None
    estimate: float | None = None
    unit: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class StoredFit(_Part):
    """The identification under `fit`."""

    parameters: tuple[StoredParameter, ...]
    status: str
    local: tuple[StoredParameter, ...] = ()
    dropped: tuple[str, ...] | None = None
    sigma_scale: float | None = None


@dataclass(frozen=True, eq=False, repr=False)
class StoredSplit(_Part):
    """The held-out poses under `split`."""

    held_out: tuple[str, ...]


@dataclass(frozen=True, eq=False, repr=False)
class StoredInput(_Part):
    """An input file under `made_by.inputs`."""

    path: str
    sha256: str


@dataclass(frozen=True, eq=False, repr=False)
class StoredOrigin(_Part):
    """The provenance under `made_by`."""

    command: tuple[str, ...]
    inputs: dict[str, StoredInput]


@dataclass(frozen=True, eq=False, repr=False)
class StoredErrors(_Part):
    """The errors of poses under `expected_error.position` and `.orientation`."""

    rms: float | None


@dataclass(frozen=True, eq=False, repr=False)
class StoredHalf(_Part):
    """What half the sigma of a source leaves, under `halved`."""

    position_rms: float | None
    orientation_rms: float | None
    worst_parameter_sd: float | None


@dataclass(frozen=True, eq=False, repr=False)
class StoredSource(_Part):
    """A source of errors under `expected_error.sources`."""

    kind: str
    name: str
    evaluation: str
    degrees: float | None
    position: float | None
    orientation: float | None
    parameters: dict[str, float | None]
    halved: StoredHalf | None


@dataclass(frozen=True, eq=False, repr=False)
class StoredSentence(_Part):
    """A finding, of which the sentence is read."""

    text: str


@dataclass(frozen=True, eq=False, repr=False)
class StoredBudget(_Part):
    """The uncertainty budget under `expected_error`; earlier versions state no `sources`."""

    position: StoredErrors
    orientation: StoredErrors
    parameters: dict[str, float | None]
    worst_parameter: str
    poses: int
    over: str
    finding: StoredSentence
    sources: tuple[StoredSource, ...] | None = None


@dataclass(frozen=True, eq=False, repr=False)
class StoredResult(_Part):
    """What loopcal reads back from result.json."""

    format: Literal[1, 2]
    made_by: StoredOrigin
    fit: StoredFit
    verdict: Literal["calibrated", "reservations", "not_calibrated", "undecided"] | None = None
    passed: bool | None = None
    reasons: tuple[str, ...] = ()
    split: StoredSplit | None = None
    expected_error: StoredBudget | None = None
    nulls: dict[str, str] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)


NEEDED = ("verdict", "passed", "reasons", "split", "files")
"""Keys that every run of format 2 states, beside those that every run states."""
NEVER_NULL = ("verdict", "passed")

ROUNDING = 1e-14
"""Relative difference of an estimate in its unit and in SI."""

LARGEST = 1e100
"""Errors and variances of a budget are smaller; their squares are numbers."""


def read_result(path: Path) -> dict[str, Any]:
    """Return the content of result.json of a run, of which `StoredResult` is checked.

    Raises
    ------
    FileError : not a run, made by a newer loopcal, or damaged; with the file and the key.
    """
    content = read_json(path, "run result", f"this file of a run is damaged; {REPEAT}", TABLE_SIZE)
    if not isinstance(content, dict):
        raise report_damage(path, "it contains no mapping")
    number = content.get("format")
    if isinstance(number, int) and number > FORMAT:
        sentence = f"this run has format {number}, but this loopcal reads formats up to {FORMAT}"
        raise FileError(f"{sentence}; use a newer loopcal, or repeat the calibration", path)
    for key in NEEDED if number == FORMAT else ():
        if key not in content or (key in NEVER_NULL and content[key] is None):
            raise report_damage(path, f"it states no {key!r}")
    text, plain = json.dumps(content, ensure_ascii=False), content
    if _SURROGATE.search(text):
        plain = json.loads(_SURROGATE.sub("?", text))
    stated = read_record(
        YamlFile(path, "", {}, plain), plain, StoredResult, None, word=report_damage
    )
    if problem := _find_contradiction(stated):
        raise report_damage(path, problem)
    return content


def refuse_other_parameters(
    result: Mapping[str, Any], count: int, robot: Mechanism, path: Path
) -> None:
    """Refuse a robot file of a run that lacks identified parameters.

    Parameters
    ----------
    result : of `read_result`, which states the identified parameters. count : number of all
        parameters before the calibration. robot : read from the file `path`; others may be free,
        too, because a choice of the model identifies some of them.

    Raises
    ------
    FileError : `files.run-robot-changed`.
    """
    stated = [row["name"] for row in result["fit"]["parameters"]]
    identified, table = set(stated), robot.parameters
    names = [name for name, is_free in zip(table.names, table.free, strict=True) if is_free]
    if [name for name in names if name in identified] == stated and count == len(table):
        return
    different = sorted(identified - set(names)) or names
    raise FileError(
        report_finding("files.run-robot-changed", result=RESULT, name=different[0]), path
    )


def refuse_other_estimates(
    path: Path, result: Mapping[str, Any], key: str, array: np.ndarray, name: str
) -> None:
    """Refuse a result that states other estimates than the arrays of its run.

    Parameters
    ----------
    path : of result.json, whose content is `result`. key : of its rows under `fit`.
    array : the estimates [SI]; `name` is that of the array.

    Raises
    ------
    FileError : `files.run-damaged`.
    """
    rows, holds = result["fit"].get(key, ()), f"but the array {name!r} of the run holds"
    if len(array) != len(rows):
        raise report_damage(path, f"'fit.{key}' has {len(rows)} entries, {holds} {len(array)}")
    for row, value in zip(rows, array.tolist(), strict=True):
        if row.get("estimate") is None or "unit" not in row:  # of an earlier version
            continue
        factor = UNITS[row["unit"]].factor_to_si if row["unit"] in UNITS else math.nan
        if not math.isclose(row["estimate"] * factor, value, rel_tol=ROUNDING):
            stated = f"{row['estimate']!r} {row['unit']} for {row['name']}"
            raise report_damage(path, f"'fit.{key}' states {stated}, {holds} {value!r} [SI]")


def report_damage(path: Path, problem: str) -> FileError:
    """Return the error of a file of a run that is damaged; `problem` says how."""
    return FileError(report_finding("files.run-damaged", problem=problem), path)


def _find_contradiction(stated: StoredResult) -> str | None:
    """Return what of a result cannot be true; None where everything can."""
    budget = stated.expected_error
    if budget is None:
        return None
    tables = {"expected_error.parameters": budget.parameters}
    numbers = [budget.position.rms, budget.orientation.rms]
    for i, source in enumerate(budget.sources or ()):
        tables[f"expected_error.sources entry {i + 1}.parameters"] = source.parameters
        numbers += [source.position, source.orientation, *_list_halved(source.halved)]
    for name, table in tables.items():
        if budget.worst_parameter and budget.worst_parameter not in table:
            return f"{name!r} lacks the worst parameter {budget.worst_parameter!r}"
        numbers += table.values()
    for number in numbers:
        if number is not None and not 0.0 <= number < LARGEST:
            return f"'expected_error' states {number:g}, which is no size of an error"
    return None


def _list_halved(halved: StoredHalf | None) -> tuple[float | None, ...]:
    """Return the numbers of a source with half its sigma."""
    return () if halved is None else dataclasses.astuple(halved)
