# SPDX-License-Identifier: Apache-2.0
"""Parts of the tolerances that can be wider than stated: what deviates together, a limb, a type of
parameter, a single parameter.

The deviations z from nominal, in tolerances, have the stated covariance C (1 for independent ones).
A component adds its variance to some of them, so that the prior becomes

    z ~ N(0, factor^2 (C + sum_j variance_j E_j E_j'))

with one column of ones over the parameters of E_j where they deviate together (a shift), and a unit
column for each of them where they deviate independently (a group, or a single parameter).
"""

from __future__ import annotations

import string
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.methods.inflated_tolerances import By
from loopcal.typing import FloatArray

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
    """A part of the tolerances that is wider than stated.

    Attributes
    ----------
    kind : "shift", "group" or "single". name : of the limb, type or parameter.
    places : positions of its free parameters. variance : that it adds, in squared tolerances.
    """

    kind: Kind
    name: str
    places: tuple[int, ...]
    variance: float = 0.0

    @property
    def factor(self) -> float:
        """Standard deviation of each of its parameters, in stated tolerances."""
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
    """Return the covariance (p, p) of the deviations in tolerances, without the common factor."""
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
    Parameters without a stated tolerance belong to none.
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
