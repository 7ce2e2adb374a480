# SPDX-License-Identifier: Apache-2.0
"""How golden results are written, read and compared.

A result is a nested dict; it is stored flat, `part/part/name` -> value. Strings, whole numbers and
truth values must be equal. Numbers are compared by where they stand. Every tolerance is a bound of
rounding or of the end of a descent, so that it holds for every kernel of linear algebra and both
engines:

    all            1e-9 of the largest of the array. Rows are positions of a meter, known to 1e-15
                   by kinematics, over a noise of 5 um: 2e-10 standard deviations
    .../estimate   1e-9 of the `sd` beside it, or of the `scale` beside it where the sd is infinite,
                   missing or zero; plus what the solution adds by rounding: 2.2e-16 times
                   `condition` times the norm of the residuals, the root of `cost`
    .../sd         1e-9 of each element
    .../p_value    1e-9, times the root of `degrees` beside it, which is more than chi-square times
                   its density
    .../condition  1e-9, plus the rounding of the smallest singular value: 2.2e-16 times itself
    .../errors     of parameters: plus 2.2e-16 times the ratio of the largest to the smallest of
                   the `singular_values` up to `rank`
    .../kinematic  1e-12 of the largest of all there, at least of 1, the robot's size: 4500
                   roundings. Errors of a fit with `conditions`, which are shares of first errors
                   of 1e-4 of the size, have 2.2e-16 times the largest condition times 1e4
    .../indices    2e-9: squares of singular values
    .../unseen     1e-5: combinations omit parts below 1e-6
    .../squares    1e-6: the shares of kinds change to first order with the estimate
    .../change     1e-6: a difference of two fits
    .../local      1e-8: nuisance parameters have an iteration of their own, which ends where a step
                   changes the residuals by less than 1e-7 of their norm
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

FIXTURE = Path(__file__).with_name("results.json")
TOLERANCE, KINEMATIC, ROUNDING = 1e-9, 1e-12, float(np.finfo(float).eps)
LOOSE = {"indices": 2e-9, "unseen": 1e-5, "squares": 1e-6, "change": 1e-6, "local": 1e-8}
SIZE_OVER_ERROR = 1e4
"""Size of a robot over the first errors of its parameters, in results with `conditions`."""

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


def differences(golden: Flat, found: Flat) -> Iterator[str]:
    """Yield a sentence for every value that is not what it was."""
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
        if (off := distance(path, was, now, golden)) > 1.0:
            yield f"{path}: differs by {off:.3g} times its tolerance"


def distance(path: str, was: np.ndarray, now: np.ndarray, golden: Flat) -> float:
    """Return the largest difference in units of its tolerance, infinite where NaN or infinite ones
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
    largest = np.abs(was[finite]).max()
    allowed = np.broadcast_to(_allowed(path, was, largest, golden), was.shape)[finite]
    off = np.abs(now[finite] - was[finite])
    return float(np.max(np.where(off == 0.0, 0.0, off / np.maximum(allowed, np.finfo(float).tiny))))


def _allowed(path: str, was: np.ndarray, largest: float, golden: Flat) -> np.ndarray:
    """Return the allowed difference of every element."""
    parts = path.split("/")
    tolerance = max([TOLERANCE, *(LOOSE[part] for part in parts if part in LOOSE)])
    if "kinematic" in parts:
        solved = golden.get(path[: path.index("kinematic")] + "conditions")
        rounding = 0.0 if solved is None else ROUNDING * SIZE_OVER_ERROR * np.max(solved)
        return max(KINEMATIC, rounding) * np.maximum(largest, 1.0)
    if parts[-1] == "estimate":
        sd, scale = (
            np.array(golden[path.removesuffix("estimate") + name], dtype=float)
            for name in ("sd", "scale")
        )
        tolerance += _round_solution(golden, path.removesuffix("fit/estimate"))
        return tolerance * np.where(np.isfinite(sd) & (sd > 0.0), sd, scale)
    if parts[-1] == "sd":
        return tolerance * np.abs(was)
    if parts[-1] == "p_value":
        degrees = golden.get(path.removesuffix("p_value") + "degrees", 1.0)
        return np.asarray(TOLERANCE * np.sqrt(np.maximum(degrees, 1.0)))
    if parts[-1] == "condition":
        return np.asarray((TOLERANCE + ROUNDING * largest) * largest)
    if path == "errors" and "singular_values" in golden:
        s = np.abs(golden["singular_values"])
        tolerance += ROUNDING * s[0] / s[golden["rank"] - 1]
    return np.asarray(tolerance * largest)


def _round_solution(golden: Flat, at: str) -> float:
    """Return how far rounding moves the estimate of a fit, in standard deviations: a solution by
    orthogonal transformations is exact for rows that differ by a rounding.
    """
    if f"{at}condition" not in golden:
        return 0.0
    return ROUNDING * golden[f"{at}condition"] * np.sqrt(golden[f"{at}cost"])


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


def write(results: Mapping[str, Flat]) -> None:
    """Write the fixture, one value a line so that changes can be read in git; NaN and Infinity as
    Python's json has them.
    """
    cases = []
    for case, flat in results.items():
        values = [
            f"  {json.dumps(k)}: {json.dumps(v, separators=(',', ':'))}" for k, v in flat.items()
        ]
        cases.append(f"{json.dumps(case)}: {{\n" + ",\n".join(values) + "\n}")
    FIXTURE.write_text("{\n" + ",\n".join(cases) + "\n}\n")


def read() -> dict[str, Flat]:
    """Read the results of the fixture, case by case."""
    return json.loads(FIXTURE.read_text())


def collect(chosen: tuple[str, ...]) -> None:
    """Compute all cases anew, or those whose names begin with `chosen`, and write the fixture."""
    from tests.golden.cases import CASES

    kept = {n: flat for n, flat in (read() if chosen else {}).items() if not n.startswith(chosen)}
    write({name: kept.get(name) or flatten(case()) for name, case in CASES.items()})


if __name__ == "__main__":
    collect(tuple(sys.argv[1:]))
