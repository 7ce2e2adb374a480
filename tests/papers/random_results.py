# SPDX-License-Identifier: Apache-2.0
"""Results of a study with random numbers in place of the computed ones, and their verdicts.

A verdict that follows from numbers answers "does not agree" for some of them, and "agrees" for
others. `collect_answers` gives every verdict of a study many random results.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from loopcal.mechanism.model import Mechanism
from loopcal.papers.printed import last_digit
from loopcal.papers.reproduction import Verdict

SPREADS = (20.0, 1.0, 0.1, 1e-3)
"""Standard deviations of the logarithms of random factors: any numbers, and similar ones."""


@dataclass(frozen=True)
class Randomizer:
    """Replaces all numbers in a value by random ones; shapes, names and types stay.

    Attributes
    ----------
    rng : source of random numbers. spread : standard deviation of the logarithm of the random
        factors. Whole numbers and truth values are drawn anew where it is 1 or more.
    keep : types that stay as they are.
    """

    rng: np.random.Generator
    spread: float = 1.0
    keep: tuple[type, ...] = (Mechanism,)

    def randomize(self, value: Any) -> Any:
        """Return the value with random numbers; numbers printed as text stay text."""
        if isinstance(value, self.keep):
            return value
        if isinstance(value, np.ndarray):
            return self._randomize_array(value)
        if isinstance(value, (bool, int, float, np.number, np.bool_)):
            return self._randomize_array(np.array(value)).item()
        if isinstance(value, str):
            return self._randomize_text(value)
        if type(value) is list:
            return [self.randomize(x) for x in value]
        if type(value) is tuple:
            return tuple(map(self.randomize, value))
        if is_dataclass(value) and not isinstance(value, type):
            stored = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
            return replace(value, **{key: self.randomize(x) for key, x in stored.items()})
        if isinstance(value, Mapping):
            return {key: self.randomize(x) for key, x in value.items()}
        return value

    def _randomize_array(self, value: np.ndarray) -> np.ndarray:
        rng, spread = self.rng, self.spread
        if value.dtype == bool:
            return rng.integers(0, 2, value.shape).astype(bool) if spread >= 1.0 else value
        if np.issubdtype(value.dtype, np.integer):
            most = max(2 * int(value.max(initial=0)), 10)
            return rng.integers(0, most, value.shape) if spread >= 1.0 else value
        if not np.issubdtype(value.dtype, np.floating):
            return value
        number = np.where(np.isfinite(value), value, 1.0)
        sign = rng.choice([-1.0, 1.0], value.shape) if spread >= 1.0 and (number < 0).any() else 1.0
        drawn = sign * number * np.exp(spread * (rng.normal() + rng.normal(size=value.shape)))
        lost = ~np.isfinite(value).all() & (rng.uniform(size=value.shape) < rng.uniform())
        return np.where(lost, np.inf, drawn)

    def _randomize_text(self, value: str) -> str:
        try:
            unit, number = last_digit(value), float(value)
        except (ArithmeticError, ValueError):
            return value
        count = max(round(abs(number) / unit * float(np.exp(self.spread * self.rng.normal()))), 1)
        places = max(-round(float(np.log10(unit))), 0)
        return f"{'-' if number < 0.0 else ''}{count * unit:.{places}f}"


def collect_answers(
    judge: Callable[[Any], tuple[Verdict, ...]],
    results: Any,
    draws: int = 60,
    keep: tuple[type, ...] = (),
) -> dict[str, set[bool | None]]:
    """Return the answers of every claim, by its place and name, on random results.

    Parameters
    ----------
    judge : from results to verdicts. draws : their number. keep : types that are not changed.
    """
    answers: dict[str, set[bool | None]] = defaultdict(set)
    for i in range(draws):
        rng = np.random.default_rng([0, i])
        drawn = Randomizer(rng, SPREADS[i % len(SPREADS)], (Mechanism, *keep)).randomize(results)
        with np.errstate(all="ignore"):
            for place, verdict in enumerate(judge(drawn)):
                answers[f"{place} {verdict.name}"].add(verdict.agrees)
    return dict(answers)
