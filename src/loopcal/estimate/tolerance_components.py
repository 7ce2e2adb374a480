# SPDX-License-Identifier: Apache-2.0
"""Parts of the spreads that can be wider than stated: what deviates together, a limb, a type of
parameter, a single parameter.

The deviations z from nominal, in spreads, have the stated covariance C (1 for independent ones).
A component adds its variance to some of them, so that the prior becomes

    z ~ N(0, factor^2 (C + sum_j variance_j E_j E_j'))

with one column of ones over the parameters of E_j where they deviate together (a shift), and a unit
column for each of them where they deviate independently (a group, or a single parameter).
"""

from __future__ import annotations

import string
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.residual_test import SIGNIFICANCE
from loopcal.numerics.decomposition import Decomposition
from loopcal.numerics.statistics import compute_chi_square_tail
from loopcal.typing import BoolArray, FloatArray

# The most probable factor on all spreads, and how well the data determine it.

LARGEST_FACTOR = 1e6
"""Factor on spreads up to which the most probable one is searched."""

GRID = np.log(LARGEST_FACTOR) * np.linspace(0.0, 1.0, 20) ** 1.5
"""Logarithms of factors among which the minimum is bracketed."""

NEWTON_STEPS = 6
"""Steps at most that refine a minimum inside its bracket; four are enough but for rounding."""

By = Literal["auto", "global", "groups", "heavy-tailed"]
"""What may get a factor of its own; see `InflatedTolerances`."""


@dataclass(frozen=True)
class InflatedTolerances:
    """Inflate the expected spreads by the factors that the data make most probable, at least 1.

    The noise that the rows show (`estimate_excess_noise`) counts, so that a wrong sigma, wrong rows
    or an incomplete model do not inflate the spreads.

    Called with a decomposition, the rule returns the factor on all spreads. `identify` also
    chooses the `loopcal.estimate.tolerance_components` that it allows.

    Parameters
    ----------
    by : "global": one factor on all spreads. "groups": also factors of their own for limbs and
        types of parameters, and shifts that parameters of one type share. "heavy-tailed": also
        single parameters. "auto", the default: all of these.

    Raises
    ------
    EstimationError : another word.
    """

    name: ClassVar[str] = "inflated-tolerances"
    by: By = "auto"

    def __post_init__(self) -> None:
        if self.by not in get_args(By):
            raise EstimationError(
                f"inflated spreads by {self.by!r}. Give 'global', 'groups', 'heavy-tailed' or "
                "'auto'"
            )

    def __call__(self, decomposition: Decomposition) -> FloatArray:
        """Return the factor (t,) on all spreads."""
        return find_most_probable_factor(
            decomposition.divided(estimate_excess_noise(decomposition))
        )


def find_most_probable_factor(decomposition: Decomposition) -> FloatArray:
    """Return the factor (t,) on all spreads, at least 1, that makes the data most probable.

    The smallest L on a grid is refined by Newton's method in the logarithm of factor^2:

        L' = sum f_i (1 - r_i),   L'' = sum f_i ((1 - f_i) (1 - r_i) + f_i r_i)

    with f_i = 1 - 1 / d_i and r_i = c_i^2 / d_i.
    """
    counts = are_penalized(decomposition)
    s, c = decomposition.singular_values, decomposition.projections
    square, projected = np.where(counts, s, 0.0) ** 2, np.where(counts, c, 0.0) ** 2
    d = 1.0 + np.exp(2.0 * GRID)[:, None] * square[:, None, :]
    best = np.argmin((np.log(d) + projected[:, None, :] / d).sum(axis=2), axis=1)
    x, low, high = (2.0 * GRID[np.clip(best + shift, 0, len(GRID) - 1)] for shift in (0, -1, 1))
    for _ in range(NEWTON_STEPS):
        d = 1.0 + np.exp(x)[:, None] * square
        ratio = projected / d
        f, excess = 1.0 - 1.0 / d, 1.0 - ratio
        slope = (f * excess).sum(axis=1)
        if (slope >= 0.0)[best == 0].all() and (best == 0).all():
            return np.ones(len(x))
        curvature = (f * (excess + f * (ratio - excess))).sum(axis=1)
        # the minimum is on the side towards which L falls
        low, high = np.where(slope < 0.0, x, low), np.where(slope > 0.0, x, high)
        step = slope / np.where(curvature > 0.0, curvature, np.inf)
        before, x = x, np.where(curvature > 0.0, np.clip(x - step, low, high), 0.5 * (low + high))
        if np.abs(x - before).max() < 1e-6:  # the error is the square of this
            break
    return np.asarray(np.exp(0.5 * x))


def estimate_excess_noise(decomposition: Decomposition) -> FloatArray:
    """Return the factor (t,) on sigma that the part outside the range shows.

    It is 1 unless that part is larger than the noise beyond doubt.
    """
    left = (decomposition.rows - decomposition.rank).astype(np.float64)
    larger = compute_chi_square_tail(left, decomposition.unexplained) < SIGNIFICANCE
    return np.sqrt(np.where(larger, decomposition.unexplained / np.maximum(left, 1.0), 1.0))


def are_penalized(decomposition: Decomposition) -> BoolArray:
    """Return which directions (t, p) a prior penalizes."""
    unpenalized = decomposition.unpenalized
    if unpenalized is None:
        return np.ones(decomposition.singular_values.shape, dtype=bool)
    return ~unpenalized


Kind = Literal["shift", "group", "single"]

KINDS: dict[By, tuple[Kind, ...]] = {
    "global": (),
    "groups": ("shift", "group"),
    "heavy-tailed": ("single",),
    "auto": ("shift", "group", "single"),
}
"""Which components each setting of `InflatedTolerances` allows."""

WITHOUT_DIGITS = str.maketrans("", "", string.digits)
"""Translation that removes the digits of a text."""


@dataclass(frozen=True)
class ToleranceComponent:
    """A part of the spreads that is wider than stated.

    kind : "shift", "group" or "single". name : of the limb, type or parameter.
    places : positions of its free parameters. variance : that it adds, in squared tolerances.
    """

    kind: Kind
    name: str
    places: tuple[int, ...]
    variance: float = 0.0

    @property
    def factor(self) -> float:
        """Standard deviation of each of its parameters, in stated spreads."""
        return float(np.sqrt(1.0 + self.variance))

    def to_row(self, names: Sequence[str]) -> dict[str, object]:
        """Return kind, name, names of the parameters and factor, for findings and JSON."""
        members = [names[i] for i in self.places]
        return {"kind": self.kind, "name": self.name, "names": members, "factor": self.factor}

    def columns(self, parameters: int) -> FloatArray:
        """Return E (p, k)."""
        unit = np.eye(parameters)[:, list(self.places)]
        return unit.sum(axis=1, keepdims=True) if self.kind == "shift" else unit


def compute_prior_covariance(
    parameters: int, correlation: FloatArray | None, components: Iterable[ToleranceComponent]
) -> FloatArray:
    """Return the covariance (p, p) of the deviations in spreads, without the common factor."""
    covariance = np.eye(parameters) if correlation is None else np.array(correlation)
    for component in components:
        columns = component.columns(parameters)
        covariance += component.variance * (columns @ columns.T)
    return covariance


def compute_symmetric_root(covariance: FloatArray) -> FloatArray:
    """Return the symmetric square root (p, p) of a covariance."""
    square, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(square, 0.0))) @ vectors.T)


def list_components(free: FreeParameters, by: By) -> tuple[ToleranceComponent, ...]:
    """Return the components that a setting allows, with variance 0.

    A limb and a type have two parameters or more, but not all; of equal ones the first counts.
    Parameters without a stated spread belong to none.
    """
    kinds, stated, names = KINDS[by], np.flatnonzero(~free.assumed).tolist(), free.names
    result: list[ToleranceComponent] = []
    if "shift" in kinds:
        result += list_shifts(free)
        types = {shift.name: shift.places for shift in result}
        limb_of = free.robot.assembly.limb_by_parameter
        limbs = _collect(stated, [limb_of.get(name, "") for name in names])
        dimensions = _collect(stated, [p.dimension.value for p in free.parameters])
        groups = {
            places: name
            for sets in (dimensions, limbs, types)
            for name, places in sets.items()
            if 1 < len(places) < len(stated)
        }
        result += [ToleranceComponent("group", name, places) for places, name in groups.items()]
    if "single" in kinds:
        result += [ToleranceComponent("single", names[i], (i,)) for i in stated]
    return tuple(result)


def list_shifts(free: FreeParameters) -> list[ToleranceComponent]:
    """Return the shifts that the parameters of a type can share, with variance 0."""
    types = _collect(np.flatnonzero(~free.assumed).tolist(), [name_type(n) for n in free.names])
    return [ToleranceComponent("shift", *item) for item in types.items() if len(item[1]) > 1]


def name_type(name: str) -> str:
    """Return the type of a parameter: its name without limb and numbers.

    Examples
    --------
    >>> name_type("leg3.base.x"), name_type("thB2x"), name_type("radius")
    ('base.x', 'thBx', 'radius')
    """
    head, point, rest = name.partition(".")
    return (rest if point else head).translate(WITHOUT_DIGITS)


def _collect(stated: Iterable[int], labels: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Return the places that share a label; those without one are left out."""
    members: dict[str, list[int]] = {}
    for i in stated:
        if labels[i]:
            members.setdefault(labels[i], []).append(i)
    return {label: tuple(places) for label, places in members.items()}
