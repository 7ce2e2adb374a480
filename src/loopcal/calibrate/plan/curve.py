# SPDX-License-Identifier: Apache-2.0
"""How many units: the criterion of good designs against their size, and the smallest size that meets a target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.calibrate.plan.criteria import Criterion
from loopcal.calibrate.plan.design import Design, Start
from loopcal.calibrate.plan.fedorov import fedorov_exchange
from loopcal.calibrate.plan.relaxation import relaxed_design
from loopcal.linalg import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Curve:
    """Values of designs by their number of units.

    Attributes
    ----------
    numbers : (k,) units, ascending. values : (k,) of the criterion. bounds : (k,) that no design of so many units beats.
    designs : k designs.
    """

    numbers: IntArray
    values: FloatArray
    bounds: FloatArray
    designs: tuple[Design, ...]


def design_curve(
    rows: FloatArray,
    numbers: Sequence[int],
    criterion: Criterion,
    start: Start,
    seed: int = 0,
    starts: int = 3,
    repeats: bool = False,
) -> Curve:
    """Return designs of several sizes with their values and bounds; arguments as of `fedorov_exchange`."""
    sizes = sorted(set(numbers))
    designs = tuple(fedorov_exchange(rows, n, criterion, start, seed, starts, repeats) for n in sizes)
    bounds = np.array([relaxed_design(rows, n, criterion, start, repeats=repeats).bound for n in sizes])
    return Curve(np.array(sizes), np.array([design.value for design in designs]), bounds, designs)
