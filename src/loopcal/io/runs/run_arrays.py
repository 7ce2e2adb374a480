# SPDX-License-Identifier: Apache-2.0
"""What loopcal reads back from the arrays.npz of a run: the declared form of its arrays.

Sizes are numbers, or letters that stand for the same number in every array: p identified and a all
parameters of the robot, u setup parameters, i instruments, s sources and c columns of the parts of
the covariance, d directions that the data determine, k centers and m = 6 k coefficients of a model
discrepancy, h heights. Residuals and histories are for people and other programs, and are not
checked.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from loopcal.io.core.text_file import sha256
from loopcal.io.runs.arrays_file import read_arrays
from loopcal.io.runs.run_result import report_damage

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
    """Return the arrays of a run by name, of which `RULES` are checked.

    Parameters
    ----------
    path : of arrays.npz. digest : its SHA-256 that result.json states; None in format 1.

    Raises
    ------
    FileError : damaged; with the file and the array.
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

    Parameters
    ----------
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
    for name in arrays:
        if name.startswith("fitted_") and (problem := _find_bad_rows(name, arrays[name])):
            return problem
    return _find_contradiction(arrays)


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


def _find_bad_rows(name: str, array: np.ndarray) -> str | None:
    """Return what is wrong with an array of fitted rows; None where nothing is."""
    if FITTED_NAME.fullmatch(name) is None:
        return f"the array {name!r} is unknown"
    problem = _find_misfit(name, array, FITTED, {})
    if problem is None and not np.isfinite(array).any(axis=1).all():
        return f"a row of the array {name!r} holds no number"
    return problem


def _find_contradiction(arrays: Mapping[str, np.ndarray]) -> str | None:
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
