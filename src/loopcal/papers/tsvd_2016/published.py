# SPDX-License-Identifier: Apache-2.0
"""The printed numbers and names of the paper, as far as our text of it goes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property

from loopcal.papers.printed import Printed, read_content
from loopcal.typing import FloatArray

MM = 1e-3
NOISE_COLUMNS = ("X [mm]", "Y [mm]", "Z [mm]", "phi [rad]", "theta [rad]", "psi [rad]")


@dataclass(frozen=True)
class Published:
    """See published.yaml.

    Attributes
    ----------
    source : what we have of the paper. noise : Appendix 1. counts : numbers that the text states.
    parameters : names as printed, by manipulator.
    """

    source: str
    noise: Printed
    counts: Printed
    parameters: Mapping[str, str]

    @cached_property
    def noise_si(self) -> FloatArray:
        """(36, 6) Appendix 1 [m, rad]."""
        values = self.noise.values.copy()
        values[:, :3] *= MM
        values.setflags(write=False)
        return values


@cache
def read_published() -> Published:
    """Read published.yaml."""
    content = read_content(__file__)
    return Published(
        source=content["source"],
        noise=Printed.parse(content["appendix_1"]),
        counts=Printed.parse(content["counts"]),
        parameters=content["parameters"],
    )
