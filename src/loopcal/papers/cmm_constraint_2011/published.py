# SPDX-License-Identifier: Apache-2.0
"""The printed numbers of the paper, and whether its quotients follow from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from math import hypot

from loopcal.papers.printed import last_digit, read_content

MM = 1e-3


@dataclass(frozen=True)
class Stated:
    """A number before and after, and its stated improvement.

    Attributes
    ----------
    before, after : as printed, or "". stated : percentage or factor, as printed. unit : of
        before and after.
    """

    stated: str
    before: str = ""
    after: str = ""
    unit: str = ""

    @property
    def reduction(self) -> float:
        """Percentage by which it falls."""
        return 100.0 * (1.0 - float(self.after) / float(self.before))

    @property
    def factor(self) -> float:
        """Before over after."""
        return float(self.before) / float(self.after)

    @property
    def possible(self) -> tuple[float, float]:
        """Least and largest factor of numbers that round to the printed ones."""
        (b, h), (c, k) = (
            (float(text), 0.5 * last_digit(text)) for text in (self.before, self.after)
        )
        return (b - h) / (c + k), (b + h) / (c - k)

    @property
    def follows(self) -> bool:
        """Whether the stated factor, itself rounded, is possible."""
        return self.excess == 0.0

    @property
    def excess(self) -> float:
        """By how much the stated factor is outside of the possible ones."""
        return compute_excess(self.stated, self.possible)


@dataclass(frozen=True)
class Published:
    """See published.yaml.

    Attributes
    ----------
    source : what we have of the paper. parameters, simulated, measured : counts. sets, noises : as
        printed, in mm.
    repeatability, accuracy : of the measuring machine [m]. figure_5, table_4 : improvements.
    """

    source: str
    parameters: int
    simulated: int
    measured: int
    sets: tuple[str, ...]
    noises: tuple[str, ...]
    repeatability: float
    accuracy: float
    figure_5: Mapping[str, Stated]
    table_4: Mapping[str, Stated]
    conclusion: Mapping[str, str]

    def compute_rms_factors(self, name: str) -> tuple[float, float]:
        """Return the least and the largest factor of root mean squares, rms^2 = mean^2 + sd^2, of
        means and standard deviations that round to those of Table 4.
        """
        mean, sd = (self.table_4[f"{name}, {what}"] for what in ("mean", "standard deviation"))
        before = _bound_rms(mean.before, sd.before)
        after = _bound_rms(mean.after, sd.after)
        return before[0] / after[1], before[1] / after[0]


def compute_excess(stated: str, possible: tuple[float, float]) -> float:
    """Return by how much a stated number, itself rounded, is outside of what is possible."""
    half = 0.5 * last_digit(stated)
    low, high = possible
    return max(low - half - float(stated), float(stated) - high - half, 0.0)


def _bound_rms(mean: str, sd: str) -> tuple[float, float]:
    """Return the least and the largest root mean square of a rounded mean and sd."""
    halves = 0.5 * last_digit(mean), 0.5 * last_digit(sd)
    low, high = (
        hypot(float(mean) + sign * halves[0], float(sd) + sign * halves[1]) for sign in (-1, 1)
    )
    return low, high


@cache
def read_published() -> Published:
    """Read published.yaml."""
    content = read_content(__file__)
    return Published(
        source=content["source"],
        parameters=int(content["parameters"]),
        simulated=int(content["points"]["simulated"]),
        measured=int(content["points"]["measured"]),
        sets=tuple(content["sets"].split()),
        noises=tuple(content["noises"].split()),
        repeatability=float(content["accuracy"]["repeatability"]) * MM,
        accuracy=float(content["accuracy"]["accuracy"]) * MM,
        figure_5={name: Stated(**given) for name, given in content["figure_5"].items()},
        table_4={name: Stated(**given) for name, given in content["table_4"].items()},
        conclusion=content["conclusion"],
    )
