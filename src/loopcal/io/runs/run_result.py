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
from collections.abc import Mapping
from dataclasses import astuple, make_dataclass
from functools import cache
from pathlib import Path
from types import GenericAlias
from typing import Any, BinaryIO, Literal

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

_SURROGATE = re.compile("[\ud800-\udfff]")
"""Half a character: part of a file name that is not UTF-8."""


Number = float | None
PARAMETERS: list[Any] = [{"name": str, "plus_minus": Number, "estimate?": Number, "unit?": str}]
SOURCE: dict[str, Any] = {
    "kind": str,
    "name": str,
    "evaluation": str,
    "degrees": Number,
    "stated?": ({"value": float, "unit": str, "distribution": str, "divisor": float, "u": float},),
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
VOLUME: dict[str, Any] = {
    "simultaneous": float,
    "pointwise": float,
    "frame": str,
    "findings": [{"code": str, "text": str}],
    "conformity?": (
        {
            "decision": Literal["conforms", "does not conform", "neither conforms nor fails"],
            **dict.fromkeys(("estimate", "expanded", "limit", "guard_band"), float),
            **dict.fromkeys(("acceptance_limit", "rejection_limit", "level"), float),
            **dict.fromkeys(("probability", "most_probable"), float),
        },
    ),
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
        "noise_degrees?": Number,
        "noise?": str,
        "p_value?": Number,
        "sigma_uncertainty?": Number,
    },
    "verdict?": (Literal["calibrated", "reservations", "not_calibrated", "undecided"],),
    "passed?": (bool,),
    "reasons?": [str],
    "split?": ({"held_out": [str]},),
    "expected_error?": (BUDGET,),
    "volume?": (VOLUME,),
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
    action = "restore the run folder from a copy, or repeat the calibration"
    content = read_json(path, "run result", f"this file of a run is damaged; {action}", TABLE_SIZE)
    if not isinstance(content, dict):
        raise report_damage(path, "it contains no mapping")
    number = content.get("format")
    if isinstance(number, int) and number > FORMAT:
        sentence = f"this run has format {number}, but this loopcal reads formats up to {FORMAT}"
        raise FileError(f"{sentence}. Use a newer loopcal, or repeat the calibration", path)
    for key in NEEDED if number == FORMAT else ():
        if key not in content or (key in NEVER_NULL and content[key] is None):
            raise report_damage(path, f"it has no {key!r}")
    text, plain = json.dumps(content, ensure_ascii=False), content
    if _SURROGATE.search(text):
        plain = json.loads(_SURROGATE.sub("?", text))
    file = YamlFile(path, "", plain)
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
            return f"'expected_error' is {number:g}, which is not a size of an error"
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
"""The last record of an archive, with its signature, members and bytes of the directory."""


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
        raise ValueError("it is not an archive, or its end is missing")
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
            raise ValueError(f"{name!r} has another size than its header")
        values = np.frombuffer(stream.read(), kind)
    return values.reshape(shape, order="F" if is_fortran else "C")


# What loopcal reads back from the arrays.npz of a run: the declared form of its arrays.

FORMS: Mapping[str, str] = {
    "nominal": "finite p",
    "estimate": "finite p",
    "sd": "number p",
    "covariance": "number p p",
    "initial": "finite a",
    "local_estimate": "finite u",
    "local_start": "finite u",
    "local_sd": "number u",
    "local_slope": "finite u p",
    "local_root": "finite u e",
    "posterior_unit": "finite p",
    "posterior_directions": "finite p p",
    "posterior_variance": "number p",
    "posterior_seen": "logical p",
    "posterior_source": "text s",
    "posterior_degrees": "number s",
    "posterior_root": "number p c",
    "posterior_part": "whole c",
    "frames_unfixed": "finite 12 motions",
    "frames_readings": "finite poses q",
    "frames_names": "text i",
    "frames_T": "finite i 4 4",
    "frames_by_parameters": "finite i 6 p",
    "frames_own": "finite i 6 6",
    "discrepancy_root": "finite p m",
    "discrepancy_degrees": "number n",
    "discrepancy_directions": "finite p p",
    "discrepancy_variance": "number p",
    "discrepancy_test": "number 4",
    "discrepancy_mean": "finite j",
    "discrepancy_axes": "finite j j",
    "discrepancy_left": "finite j",
    "discrepancy_tool": "finite 3",
    "discrepancy_rotation": "finite 3 3",
    "discrepancy_origin": "finite 6",
    "discrepancy_length": "number 6",
    "discrepancy_centers": "finite k 6",
    "discrepancy_whitening": "finite k k",
    "discrepancy_amplitude": "finite 6 n",
    "posterior_shown_noise": "number 3",
    "posterior_reading_sigma": "finite q",
    "information_rows": "finite d p",
    "information_deviations": "finite d",
    "information_noise": "number 2",
    "heights_poses": "text h",
    "heights_points": "finite h 2",
    "heights_before": "finite h",
    "heights_after": "finite h",
    "heights_held_out": "logical h",
}
"""Arrays by name: what each entry is, and the axes; a letter is one size in all arrays."""
FITTED = "number rows values"
"""Form of the fitted rows of a kind, `fitted_<number>_<kind>`."""

FIRST = ("nominal", "estimate", "sd")
"""Arrays of every run; runs of format 1 may lack the others."""

GROUPS = (
    "frames_",
    "discrepancy_",
    "information_",
    "heights_",
    "posterior_shown_",
    "posterior_reading_",
)
"""Beginnings of names of which a run has all arrays or none."""

FITTED_NAME = re.compile(r"fitted_\d+_.+", re.DOTALL)
TYPES = {"finite": "f", "number": "f", "whole": "i", "logical": "b", "text": "U"}
"""Word for an entry -> letter of its type in NumPy."""


def read_run_arrays(path: Path, digest: str | None) -> dict[str, np.ndarray]:
    """Return the arrays of a run by name; FileError for damage, or an array of another form.

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
    """Return which array is missing or has another form, so that none of another version of
    loopcal is computed with; None where all have theirs.

    arrays : name -> array. is_complete : False for format 1.
    """
    present = tuple(group for group in GROUPS if any(name.startswith(group) for name in arrays))
    for name in (name for name in FORMS if name not in arrays):
        is_needed = name.startswith(present) if name.startswith(GROUPS) else is_complete
        if is_needed or name in FIRST:
            return f"the array {name!r} is missing"
    fitted = {name: FITTED for name in arrays if name.startswith("fitted_")}
    if unknown := [name for name in fitted if not FITTED_NAME.fullmatch(name)]:
        return f"the array {unknown[0]!r} is unknown"
    sizes: dict[str, int] = {}
    for name, form in {**FORMS, **fitted}.items():
        if name in arrays and not _has_form(arrays[name], form, sizes):
            shape = " x ".join(map(str, arrays[name].shape)) or "one"
            stated = f"{shape} of {arrays[name].dtype}"
            return f"the array {name!r} ({stated}) has another form than {form!r}"
    return None


def _has_form(array: np.ndarray, form: str, sizes: dict[str, int]) -> bool:
    """Return whether an array has a form; `sizes` are those of letters, to which it adds its own.

    Of an array without entries, only the first axis counts.
    """
    word, *axes = form.split()
    if array.ndim != len(axes) or array.dtype.kind != TYPES[word]:
        return False
    if word == "text" and not _is_text(array):
        return False
    if array.dtype.kind == "f" and array.dtype != float:
        return False
    if word == "finite" and not np.isfinite(array).all():
        return False
    for size, axis in zip(array.shape, axes if array.size else axes[:1], strict=False):
        if (match := re.fullmatch(r"(\d*)([a-z]?)", axis)) is None:
            continue  # a word is any size
        factor = int(match[1] or 1)
        if size != factor * (sizes.setdefault(match[2], size // factor) if match[2] else 1):
            return False
    return True


def _is_text(array: np.ndarray) -> bool:
    """Return whether all characters are some that UTF-8 can hold; NumPy stores any four bytes."""
    if array.dtype.itemsize == 0 or array.size == 0:
        return True
    codes = np.ascontiguousarray(array).view(np.uint32)
    return bool(np.all((codes < 0xD800) | ((codes > 0xDFFF) & (codes < 0x110000))))
