# SPDX-License-Identifier: Apache-2.0
"""Results of a study with random numbers in place of the computed ones, and their verdicts.

A verdict that follows from numbers answers "does not agree" for some of them, and "agrees" for
others. `collect_answers` gives every verdict of a study many random results.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from loopcal.mechanism.model import Mechanism
from loopcal.papers.published import Verdict, last_digit

SPREADS = (20.0, 1.0, 0.1, 1e-3)
"""Standard deviations of the logarithms of random factors: any numbers, and similar ones. Whole
numbers and truth values are drawn anew where it is 1 or more.
"""


def randomize(value: Any, rng: np.random.Generator, spread: float, keep: tuple[type, ...]) -> Any:
    """Return the value with random numbers; shapes, names and types stay, as do types `keep`."""

    def draw(x: Any) -> Any:
        return randomize(x, rng, spread, keep)

    if isinstance(value, keep):
        return value
    if isinstance(value, np.ndarray):
        return _randomize_array(value, rng, spread)
    if isinstance(value, (bool, int, float, np.number, np.bool_)):
        return _randomize_array(np.array(value), rng, spread).item()
    if isinstance(value, str):
        return _randomize_text(value, rng, spread)
    if hasattr(value, "_fields"):  # a named tuple
        return type(value)(*map(draw, value))
    if type(value) in {list, tuple}:
        return type(value)(map(draw, value))
    if is_dataclass(value) and not isinstance(value, type):
        return replace(
            value, **{f.name: draw(getattr(value, f.name)) for f in fields(value) if f.init}
        )
    if isinstance(value, Mapping):
        return {key: draw(x) for key, x in value.items()}
    return value


def _randomize_array(value: np.ndarray, rng: np.random.Generator, spread: float) -> np.ndarray:
    if value.dtype == bool:
        return rng.integers(0, 2, value.shape).astype(bool) if spread >= 1.0 else value
    if np.issubdtype(value.dtype, np.integer):
        most = max(2 * int(value.max(initial=0)), 10)
        return rng.integers(0, most, value.shape) if spread >= 1.0 else value
    number = np.where(np.isfinite(value), value, 1.0)
    sign = rng.choice([-1.0, 1.0], value.shape) if spread >= 1.0 and (number < 0).any() else 1.0
    drawn = sign * number * np.exp(spread * (rng.normal() + rng.normal(size=value.shape)))
    lost = ~np.isfinite(value).all() & (rng.uniform(size=value.shape) < rng.uniform())
    return np.where(lost, np.inf, drawn)


def _randomize_text(value: str, rng: np.random.Generator, spread: float) -> str:
    try:
        unit, number = last_digit(value), float(value)
    except (ArithmeticError, ValueError):
        return value
    count = max(round(abs(number) / unit * float(np.exp(spread * rng.normal()))), 1)
    places = max(-round(float(np.log10(unit))), 0)
    return f"{'-' if number < 0.0 else ''}{count * unit:.{places}f}"


def collect_answers(
    judge: Callable[[Any], tuple[Verdict, ...]],
    results: Any,
    draws: int = 60,
    keep: tuple[type, ...] = (),
) -> dict[str, set[bool | None]]:
    """Return the answers of every claim, by its place and name, on random results."""
    answers: dict[str, set[bool | None]] = defaultdict(set)
    for i in range(draws):
        rng, spread = np.random.default_rng([0, i]), SPREADS[i % len(SPREADS)]
        drawn = randomize(results, rng, spread, (Mechanism, *keep))
        with np.errstate(all="ignore"):
            for place, verdict in enumerate(judge(drawn)):
                answers[f"{place} {verdict.name}"].add(verdict.agrees)
    return dict(answers)
