# SPDX-License-Identifier: Apache-2.0
"""How golden results are written, read and compared.

A result is a nested dict; it is stored flat, `part/part/name` -> value. Strings, whole numbers and
truth values must be equal. Numbers are compared by where they stand, all with one relative
tolerance (1e-9) but for kinematics:

    .../estimate       difference over the `sd` beside it, or over the `scale` beside it where the
                       sd is infinite, missing or zero
    .../sd             element by element
    .../p_value        difference
    .../unseen         as all others, but 1e-5: combinations omit parts below 1e-6
    .../squares/...    as all others, but 1e-6: the shares of kinds change to first order with the
                       estimate
    .../kinematic/...  difference over the largest of all there, at least 1 (lengths are shares of
                       the robot's size): 1e-12
    .../condition      as all others, but 1e-8: it divides by the smallest singular value
    .../local/...      ten times the tolerances of estimate and sd: nuisance parameters have an
                       iteration of their own
    change/change      as all others, but 1e-6: a difference of two fits
    all others         difference over the largest of the array, such as the largest singular value
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

FIXTURE = Path(__file__).with_name("results.json")
TOLERANCE, KINEMATIC = 1e-9, 1e-12
LOOSE = {"unseen": 1e-5, "squares": 1e-6, "change": 1e-6, "condition": 1e-8, "local": 1e-8}

Flat = dict[str, Any]


def flatten(result: Mapping[str, Any], at: str = "") -> Flat:
    """Return a nested result as path -> plain value, as JSON has it."""
    flat: Flat = {}
    for name, value in result.items():
        path = f"{at}/{name}" if at else str(name)
        flat |= flatten(value, path) if isinstance(value, Mapping) else {path: plain(value)}
    return flat


def plain(value: Any) -> Any:
    """Return arrays and numpy's numbers as lists and Python's numbers; floats stay exact (17
    significant digits).
    """
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return value


def differences(
    golden: Flat, found: Flat, factor: float = 1.0, pattern: str = "*"
) -> Iterator[str]:
    """Yield a sentence for every value that is not what it was; tolerances of paths that match
    `pattern` are multiplied by `factor`.
    """
    for path in sorted(golden.keys() ^ found.keys()):
        yield f"{path}: {'is missing' if path in golden else 'is new'}"
    for path in sorted(golden.keys() & found.keys()):
        a, b = golden[path], found[path]
        if not (is_numeric(a) and is_numeric(b)):
            if a != b:
                yield f"{path}: {_short(b)} was {_short(a)}"
            continue
        was, now = np.array(a, dtype=float), np.array(b, dtype=float)
        if was.shape != now.shape:
            yield f"{path}: shape {now.shape} was {was.shape}"
            continue
        allowed = factor if fnmatchcase(path, pattern) else 1.0
        if (off := distance(path, was, now, golden)) > allowed:
            yield f"{path}: differs by {off:.3g} times its tolerance"


def distance(path: str, was: np.ndarray, now: np.ndarray, golden: Flat) -> float:
    """Return the largest difference in units of its tolerance; infinite where NaN or infinite ones
    are not the same.
    """
    finite = np.isfinite(was)
    if (
        not np.array_equal(was[~finite], now[~finite], equal_nan=True)
        or not np.isfinite(now[finite]).all()
    ):
        return np.inf
    if not finite.any():
        return 0.0
    allowed = np.broadcast_to(_allowed(path, was, finite, golden), was.shape)[finite]
    off = np.abs(now[finite] - was[finite])
    return float(np.max(np.where(off == 0.0, 0.0, off / np.maximum(allowed, np.finfo(float).tiny))))


def _allowed(path: str, was: np.ndarray, finite: np.ndarray, golden: Flat) -> np.ndarray:
    """Return the allowed difference of every element."""
    parts, largest = path.split("/"), np.abs(was[finite]).max()
    tolerance = max([TOLERANCE, *(LOOSE[part] for part in parts if part in LOOSE)])
    if "kinematic" in parts:
        return KINEMATIC * np.maximum(largest, 1.0)
    if parts[-1] == "estimate":
        sd, scale = (
            np.array(golden[path.removesuffix("estimate") + name], dtype=float)
            for name in ("sd", "scale")
        )
        return tolerance * np.where(np.isfinite(sd) & (sd > 0.0), sd, scale)
    if parts[-1] == "sd":
        return tolerance * np.abs(was)
    if parts[-1] == "p_value":
        return np.asarray(TOLERANCE)
    return tolerance * largest


def is_numeric(value: Any) -> bool:
    """Return whether a value is a float, or nested lists with a float in them and nothing but
    numbers.
    """
    leaves = list(_leaves(value))
    return any(isinstance(x, float) for x in leaves) and all(
        isinstance(x, int | float) and not isinstance(x, bool) for x in leaves
    )


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, list):
        for one in value:
            yield from _leaves(one)
    else:
        yield value


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 200 else f"{text[:200]}..."


def write(
    information: Mapping[str, Any], results: Mapping[str, Flat], path: Path = FIXTURE
) -> None:
    """Write the fixture, one value a line so that changes can be read in git; NaN and Infinity as
    Python's json has them.
    """
    lines = ["{", f'"information": {json.dumps(dict(information))},', '"results": {']
    for i, (case, flat) in enumerate(results.items()):
        lines.append(f"{json.dumps(case)}: {{")
        values = [
            f"  {json.dumps(name)}: {json.dumps(value, separators=(',', ':'))}"
            for name, value in flat.items()
        ]
        lines.append(",\n".join(values))
        lines.append("}" + ("," if i + 1 < len(results) else ""))
    path.write_text("\n".join([*lines, "}", "}", ""]))


def read(path: Path = FIXTURE) -> dict[str, Flat]:
    """Read the results of the fixture, case by case."""
    return json.loads(path.read_text())["results"]
