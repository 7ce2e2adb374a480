# SPDX-License-Identifier: Apache-2.0
"""Results of a study with random numbers in place of the computed ones, and their verdicts.

A verdict that follows from numbers answers "does not agree" for some of them. `collect_answers`
gives every verdict of a study many random results.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from loopcal.mechanism import Mechanism
from loopcal.papers.printed import last_digit
from loopcal.papers.reproduction import Verdict


def randomize(value: Any, rng: np.random.Generator, keep: tuple[type, ...] = (Mechanism,)) -> Any:
    """Return a value with all numbers in it replaced by random ones; shapes, names and types stay.

    Numbers printed as text stay text with as many digits. A number changes by a factor that is
    log-normal and may be negative; whole numbers and truth values are drawn anew.
    """
    if isinstance(value, keep):
        return value
    if isinstance(value, np.ndarray):
        return _randomize_array(value, rng)
    if isinstance(value, (bool, np.bool_)):
        return bool(rng.integers(2))
    if isinstance(value, (int, np.integer)):
        return int(rng.integers(0, max(2 * int(value), 10)))
    if isinstance(value, (float, np.floating)):
        return float(_randomize_array(np.array(value), rng))
    if isinstance(value, str):
        return _randomize_text(value, rng)
    if is_dataclass(value) and not isinstance(value, type):
        drawn = {f.name: randomize(getattr(value, f.name), rng, keep)
                 for f in fields(value) if f.init}  # fmt: skip
        return replace(value, **drawn)
    if isinstance(value, Mapping):
        return {key: randomize(one, rng, keep) for key, one in value.items()}
    if isinstance(value, (tuple, list)) and type(value) in (tuple, list):
        return type(value)(randomize(one, rng, keep) for one in value)
    return value


def collect_answers(
    judge: Callable[[Any], tuple[Verdict, ...]], results: Any, draws: int, seed: int = 0
) -> dict[str, list[bool | None]]:
    """Return the answers of every claim, by its text without numbers, on random results."""
    answers: dict[str, list[bool | None]] = defaultdict(list)
    for i in range(draws):
        drawn = randomize(results, np.random.default_rng([seed, i]))
        with np.errstate(all="ignore"):
            for place, verdict in enumerate(judge(drawn)):
                answers[f"{place} {verdict.name}"].append(verdict.agrees)
    return dict(answers)


def _randomize_array(value: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if value.dtype == bool:
        return rng.integers(0, 2, value.shape).astype(bool)
    if np.issubdtype(value.dtype, np.integer):
        return rng.integers(0, max(2 * int(value.max(initial=0)), 10), value.shape)
    if not np.issubdtype(value.dtype, np.floating):
        return value
    size = np.where(np.isfinite(value), np.abs(value), 1.0)
    sign = rng.choice([-1.0, 1.0], value.shape) if (value < 0.0).any() else 1.0
    common = np.exp(rng.normal(0.0, 1.0))
    return sign * size * common * np.exp(rng.normal(0.0, 1.0, value.shape))


def _randomize_text(value: str, rng: np.random.Generator) -> str:
    try:
        unit, number = last_digit(value), float(value)
    except (ArithmeticError, ValueError):
        return value
    count = max(round(abs(number) / unit * float(np.exp(rng.normal()))), 1)
    places = max(-int(np.floor(np.log10(unit) + 0.5)), 0)
    return f"{'-' if number < 0.0 else ''}{count * unit:.{places}f}"
