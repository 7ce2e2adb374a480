# SPDX-License-Identifier: Apache-2.0
"""The printed numbers of the paper, and whether its quotients follow from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

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
        low, high = self.possible
        half = 0.5 * last_digit(self.stated)
        return low - half <= float(self.stated) <= high + half


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
    )
