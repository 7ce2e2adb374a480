# SPDX-License-Identifier: Apache-2.0
"""What loopcal reads back from the result.json of a run: the declared form of its keys.

A run states far more than this. Keys that are not declared here are for people and other programs,
and are not checked. A number that is not finite is null in the file.
"""

from __future__ import annotations

import json
import math
import os
import re
import struct
import tokenize
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import astuple, make_dataclass
from functools import cache
from pathlib import Path
from types import GenericAlias
from typing import Any, BinaryIO, Literal, NamedTuple

import numpy as np

from loopcal.errors import FileError
from loopcal.findings import report_finding
from loopcal.io.core.limits import ARRAYS_COUNT, ARRAYS_SIZE, TABLE_SIZE, FileLimit
from loopcal.io.core.records import read_record
from loopcal.io.core.text_file import open_bytes, read_json, sha256
from loopcal.io.core.yaml_file import YamlFile
from loopcal.mechanism.model import Mechanism
from loopcal.units import UNITS

RESULT = "result.json"
FORMAT = 2
"""Format of result.json; runs of format 1 lack `files`, and may lack keys that came later."""

REPEAT = "restore the run folder from a copy, or repeat the calibration"
"""What to do about a damaged run."""

_SURROGATE = re.compile("[\ud800-\udfff]")
"""Half a character: part of a file name that is not UTF-8."""


Number = float | None
PARAMETERS: list[Any] = [{"name": str, "plus_minus": Number, "estimate?": Number, "unit?": str}]
SOURCE: dict[str, Any] = {
    "kind": str,
    "name": str,
    "evaluation": str,
    "degrees": Number,
    "position": Number,
    "orientation": Number,
    "parameters": {"*": Number},
    "halved": ({"position_rms": Number, "orientation_rms": Number, "worst_parameter_sd": Number},),
}
BUDGET: dict[str, Any] = {
    "position": {"rms": Number},
    "orientation": {"rms": Number},
    "parameters": {"*": Number},
    "worst_parameter": str,
    "poses": int,
    "over": str,
    "finding": {"text": str},
    "sources?": ([SOURCE],),  # earlier versions state none
}
STATED: dict[str, Any] = {
    "format": Literal[1, 2],
    "made_by": {"command": [str], "inputs": {"*": {"path": str, "sha256": str}}},
    "fit": {
        "parameters": PARAMETERS,
        "status": str,
        "local?": PARAMETERS,  # setup parameters
        "dropped?": ([str],),
        "sigma_scale?": Number,
    },
    "verdict?": (Literal["calibrated", "reservations", "not_calibrated", "undecided"],),
    "passed?": (bool,),
    "reasons?": [str],
    "split?": ({"held_out": [str]},),
    "expected_error?": (BUDGET,),
    "nulls?": {"*": str},
    "files?": {"*": str},
}
"""What loopcal reads back from result.json: types by key, `[of]` for a list, `(of,)` for a value
that may be null, `*` for any key. A key with a question mark may be absent.
"""


def make_type(form: Any) -> Any:
    """Return the type of a form of content; a mapping is a record that ignores other keys."""
    if isinstance(form, list):
        return GenericAlias(tuple, (make_type(form[0]), ...))
    if isinstance(form, tuple):
        return make_type(form[0]) | None
    if not isinstance(form, dict):
        return form
    if "*" in form:
        return GenericAlias(dict, (str, make_type(form["*"])))
    needed = [(key, make_type(of)) for key, of in form.items() if "?" not in key]
    others = [(key.rstrip("?"), make_type(of), None) for key, of in form.items() if "?" in key]
    return make_dataclass("Stated", [*needed, *others], namespace={"OTHER_KEYS": True})


@cache
def get_record() -> Any:
    """Return the record of STATED, which is made where the first result is read."""
    return make_type(STATED)


NEEDED = ("verdict", "passed", "reasons", "split", "files")
"""Keys that every run of format 2 states, beside those that every run states."""
NEVER_NULL = ("verdict", "passed")

ROUNDING = 1e-14
"""Relative difference of an estimate in its unit and in SI."""

LARGEST = 1e100
"""Errors and variances of a budget are smaller; their squares are numbers."""


def read_result(path: Path) -> dict[str, Any]:
    """Return the content of result.json of a run, of which `STATED` is checked; FileError
    where it is no run, made by a newer loopcal, or damaged.
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
    file = YamlFile(path, "", {}, plain)
    stated = read_record(file, plain, get_record(), None, word=report_damage)
    if problem := _find_contradiction(stated.expected_error):
        raise report_damage(path, problem)
    return content


def refuse_other_parameters(
    result: Mapping[str, Any], count: int, robot: Mechanism, path: Path
) -> None:
    """Refuse a robot, read from `path`, that lacks parameters that a result identified, of `count`
    in all. Others may be free, too, because a choice of the model identifies some of them.
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
    """Refuse a result, read from `path`, whose rows under `fit`, of this `key`, state other
    estimates than the array [SI] of its run.
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


def _find_contradiction(budget: Any) -> str | None:
    """Return what of the budget of a result cannot be true; None where everything can."""
    if budget is None:
        return None
    tables = {"expected_error.parameters": budget.parameters}
    numbers = [budget.position.rms, budget.orientation.rms]
    for i, source in enumerate(budget.sources or ()):
        tables[f"expected_error.sources entry {i + 1}.parameters"] = source.parameters
        numbers += [source.position, source.orientation]
        numbers += () if source.halved is None else astuple(source.halved)
    for name, table in tables.items():
        if budget.worst_parameter and budget.worst_parameter not in table:
            return f"{name!r} lacks the worst parameter {budget.worst_parameter!r}"
        numbers += table.values()
    for number in numbers:
        if number is not None and not 0.0 <= number < LARGEST:
            return f"'expected_error' states {number:g}, which is no size of an error"
    return None


# The arrays of a run folder: an archive of NumPy's, read without trust in what it says of itself.

WHAT = "archive of arrays"
KINDS = "biufU"
"""Kinds of NumPy's types that a run contains: truth values, numbers and text."""

FAULTS = (
    zipfile.BadZipFile,
    NotImplementedError,
    RuntimeError,
    EOFError,
    OSError,
    SyntaxError,
    tokenize.TokenError,
)
"""What Python's and NumPy's readers raise about damaged archives, in addition to ValueError."""

END = struct.Struct("<4s4H2LH")
"""The last record of an archive: among others its signature, count of members and bytes of their
directory.
"""


def read_arrays(
    path: Path, size: FileLimit = ARRAYS_SIZE, count: FileLimit = ARRAYS_COUNT
) -> dict[str, np.ndarray]:
    """Return name -> array, read-only, of a file that `numpy.savez` wrote.

    FileError : not an ordinary file, not readable, or beyond a limit. ValueError : damaged.
    """
    with open_bytes(path, WHAT) as stream:
        size.check(os.fstat(stream.fileno()).st_size, WHAT, path)
        count.check(_count_members(stream), WHAT, path)
        try:
            with zipfile.ZipFile(stream) as archive:
                members = archive.infolist()
                count.check(len(members), WHAT, path)
                size.check(sum(member.file_size for member in members), WHAT, path)
                return {
                    member.filename.removesuffix(".npy"): _read_member(archive, member)
                    for member in members
                }
        except FAULTS as error:
            raise ValueError(str(error) or "it ends too early") from error


def _count_members(stream: BinaryIO) -> int:
    """Return the number of members that the end of an archive states."""
    length = stream.seek(0, os.SEEK_END)
    if length < END.size:
        raise ValueError("it is too short")
    stream.seek(length - END.size)
    signature, *counts = END.unpack(stream.read(END.size))
    if signature != b"PK\5\6":
        raise ValueError("it is no archive, or its end is missing")
    stream.seek(0)
    return int(counts[3])


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Return one array; ValueError where its header does not agree with its bytes."""
    name = member.filename
    if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
        raise ValueError(f"{name!r} is compressed")
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        if version != (1, 0):
            raise ValueError(f"{name!r} has another version than 1.0")
        shape, is_fortran, kind = np.lib.format.read_array_header_1_0(stream)
        if kind.kind not in KINDS or kind.itemsize == 0:
            raise ValueError(f"{name!r} contains neither numbers nor text")
        if math.prod(shape) * kind.itemsize != member.file_size - stream.tell():
            raise ValueError(f"{name!r} has another size than its header states")
        values = np.frombuffer(stream.read(), kind)
    return values.reshape(shape, order="F" if is_fortran else "C")


# What loopcal reads back from the arrays.npz of a run: the declared form of its arrays.

Test = Callable[[np.ndarray], Any]


class Values(NamedTuple):
    """What the entries of an array may be: letters of their types of numpy, words, and a test."""

    types: str
    words: str
    test: Test = np.ones_like


FINITE = Values("f", "finite numbers", np.isfinite)
POSITIVE = Values("f", "finite positive numbers", lambda v: np.isfinite(v) & (v > 0.0))
NOT_NEGATIVE = Values("f", "numbers that are not negative", lambda v: ~(v < 0.0))
NUMBERS = Values("f", "numbers of double precision")
WHOLE = Values("i", "whole numbers that are not negative", lambda v: v >= 0)
LOGICAL = Values("b", "true or false")


def _is_text(array: np.ndarray) -> bool:
    """Return whether all characters are some that UTF-8 can hold; numpy stores any four bytes."""
    if array.dtype.itemsize == 0 or array.size == 0:
        return True
    codes = np.ascontiguousarray(array).view(np.uint32)
    return bool(np.all((codes < 0xD800) | ((codes > 0xDFFF) & (codes < 0x110000))))


TEXT = Values("U", "text", _is_text)


class ArrayRule(NamedTuple):
    """Form of an array: its sizes, in words, and its values."""

    sizes: str
    values: Values = FINITE


FIT: Mapping[str, ArrayRule] = {
    "nominal": ArrayRule("p"),
    "estimate": ArrayRule("p"),
    "sd": ArrayRule("p", NOT_NEGATIVE),
}
LATER: Mapping[str, ArrayRule] = {
    "covariance": ArrayRule("p p", NUMBERS),
    "initial": ArrayRule("a"),
    "local_estimate": ArrayRule("u"),
    "local_start": ArrayRule("u"),
    "local_sd": ArrayRule("u", NOT_NEGATIVE),
    "local_slope": ArrayRule("u p"),
    "local_root": ArrayRule("u u"),
    "posterior_unit": ArrayRule("p", POSITIVE),
    "posterior_directions": ArrayRule("p p"),
    "posterior_variance": ArrayRule("p", NOT_NEGATIVE),
    "posterior_seen": ArrayRule("p", LOGICAL),
    "posterior_source": ArrayRule("s", TEXT),
    "posterior_degrees": ArrayRule("s", NOT_NEGATIVE),
    "posterior_root": ArrayRule("p c", NUMBERS),
    "posterior_part": ArrayRule("c", WHOLE),
}
FRAMES: Mapping[str, ArrayRule] = {
    "frames_unfixed": ArrayRule("12 motions"),
    "frames_readings": ArrayRule("poses actuators"),
    "frames_names": ArrayRule("i", TEXT),
    "frames_T": ArrayRule("i 4 4"),
    "frames_by_parameters": ArrayRule("i 6 columns"),
    "frames_own": ArrayRule("i 6 6"),
}
DISCREPANCY: Mapping[str, ArrayRule] = {
    "discrepancy_root": ArrayRule("p m"),
    "discrepancy_degrees": ArrayRule("2", NOT_NEGATIVE),
    "discrepancy_directions": ArrayRule("p p"),
    "discrepancy_variance": ArrayRule("p", NOT_NEGATIVE),
    "discrepancy_tool": ArrayRule("3"),
    "discrepancy_rotation": ArrayRule("3 3"),
    "discrepancy_origin": ArrayRule("6"),
    "discrepancy_length": ArrayRule("6", NOT_NEGATIVE),
    "discrepancy_centers": ArrayRule("k 6"),
    "discrepancy_whitening": ArrayRule("k k"),
    "discrepancy_amplitude": ArrayRule("6", NOT_NEGATIVE),
}
NOISE: Mapping[str, ArrayRule] = {"posterior_shown_noise": ArrayRule("3", NUMBERS)}
INFORMATION: Mapping[str, ArrayRule] = {
    "information_rows": ArrayRule("d p"),
    "information_deviations": ArrayRule("d"),
    "information_noise": ArrayRule("2", NUMBERS),
}
HEIGHTS: Mapping[str, ArrayRule] = {
    "heights_poses": ArrayRule("h", TEXT),
    "heights_points": ArrayRule("h 2"),
    "heights_before": ArrayRule("h"),
    "heights_after": ArrayRule("h"),
    "heights_held_out": ArrayRule("h", LOGICAL),
}
FITTED = ArrayRule("rows values", NUMBERS)
"""Rules of arrays by name. Runs of format 1 may lack LATER; of the other groups, a run holds all
arrays or none. `fitted_<number>_<kind>` are the fitted rows, one array for each kind.
"""

RULES = {**FIT, **LATER, **FRAMES, **DISCREPANCY, **NOISE, **INFORMATION, **HEIGHTS}
FITTED_NAME = re.compile(r"fitted_\d+_.+", re.DOTALL)


def read_run_arrays(path: Path, digest: str | None) -> dict[str, np.ndarray]:
    """Return the arrays of a run by name, of which `RULES` are checked; FileError names the array.

    `digest` is the SHA-256 of arrays.npz that result.json states; None in format 1.
    """
    if digest is not None and sha256(path) != digest:
        raise report_damage(path, "it is not the file that result.json names")
    try:
        arrays = read_arrays(path)
    except ValueError as error:
        raise report_damage(path, f"it cannot be read ({error})") from error
    if problem := find_problem(arrays, is_complete=digest is not None):
        raise report_damage(path, problem)
    return arrays


def find_problem(arrays: Mapping[str, np.ndarray], is_complete: bool = True) -> str | None:
    """Return what is wrong with the arrays of a run; None where nothing is.

    arrays : name -> array. is_complete : whether LATER are needed, as from format 2 on.
    """
    needed = [*FIT, *(LATER if is_complete else ())]
    for group in (FRAMES, DISCREPANCY, NOISE, INFORMATION, HEIGHTS):
        needed += group if any(name in arrays for name in group) else ()
    if missing := [name for name in needed if name not in arrays]:
        return f"the array {missing[0]!r} is missing"
    sizes: dict[str, tuple[int, str]] = {}
    for name, rule in RULES.items():
        if name in arrays and (problem := _find_misfit(name, arrays[name], rule, sizes)):
            return problem
    for name in (name for name in arrays if name.startswith("fitted_")):
        if FITTED_NAME.fullmatch(name) is None:
            return f"the array {name!r} is unknown"
        if problem := _find_misfit(name, arrays[name], FITTED, {}):
            return problem
        if not np.isfinite(arrays[name]).any(axis=1).all():
            return f"a row of the array {name!r} holds no number"
    return _find_array_contradiction(arrays)


def _find_misfit(
    name: str, array: np.ndarray, rule: ArrayRule, sizes: dict[str, tuple[int, str]]
) -> str | None:
    """Return how an array breaks its rule; None where it does not.

    `sizes` are the numbers that letters stand for, with the array that showed each; the array adds
    its own.
    """
    expected = rule.sizes.split()
    if array.ndim != len(expected):
        return f"the array {name!r} has {array.ndim} axes, but {len(expected)} are needed"
    for size, symbol in zip(array.shape, expected, strict=True):
        known, source = (int(symbol), "") if symbol.isdigit() else sizes.get(symbol, (size, ""))
        if size != known:
            by = f", as in {source!r}" if source else ""
            return f"the array {name!r} has {size} entries on an axis, but {known} are needed{by}"
        if len(symbol) == 1 and not symbol.isdigit():
            sizes.setdefault(symbol, (size, name))
    values = rule.values
    if array.dtype.kind not in values.types or (values.types == "f" and array.dtype != float):
        return f"the array {name!r} holds {array.dtype}, but {values.words} are needed"
    if not np.all(values.test(array)):
        return f"the array {name!r} holds something else than {values.words}"
    return None


def _find_array_contradiction(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Return which arrays of the right form cannot belong together; None where all can."""
    part, source = arrays.get("posterior_part"), arrays.get("posterior_source")
    if part is not None and source is not None and (part >= len(source)).any():
        return "the array 'posterior_part' counts more sources than 'posterior_source'"
    names = arrays.get("frames_names")
    if names is not None and len(set(names.tolist())) < len(names):
        return "the array 'frames_names' names an instrument twice"
    if names is not None and len(names):
        columns, p = arrays["frames_by_parameters"].shape[2], len(arrays["estimate"])
        if columns != p:
            return f"the array 'frames_by_parameters' has {columns} columns, but {p} are needed"
    if "discrepancy_root" in arrays:
        m, k = arrays["discrepancy_root"].shape[1], len(arrays["discrepancy_centers"])
        if m != 6 * k:
            return f"the array 'discrepancy_root' has {m} columns, but {6 * k} are needed"
    return None
