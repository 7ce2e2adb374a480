# SPDX-License-Identifier: Apache-2.0
"""The free parameters of a robot, each in units of its spread.

Rank, null space, the smallest deviation and every penalty depend on these units, so they are part
of the result. Where no spread is stated, a default one scales the parameter.

The null space consists of combinations of them that change no measured value. Its basis is brought
to a sparse form, in which each combination has a leading parameter of its own, by elimination with
pivoting. Coefficients are changes in the units of the robot's file.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from loopcal.estimate.smooth_errors import SmoothErrors
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.mechanism.model import Mechanism, ParameterUnits
from loopcal.mechanism.over_constraint import refuse_breaking_parameters
from loopcal.parameters import Parameter
from loopcal.plain_text import represent
from loopcal.results.description import Field, fields
from loopcal.results.result import Result
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

DEFAULT_TOLERANCE = 1e-3
"""Spread where none is stated: this share of the robot's size for lengths, this many radians for
angles, this value for ratios.
"""


@dataclass(frozen=True, eq=False)
class FreeParameters:
    """The free parameters as estimation uses them: value = nominal + tolerance * z.

    robot : Mechanism; fixed parameters keep its values.
    places : (p,) positions of the free parameters in the robot's table.
    nominal, tolerance : (p,) [SI].
    assumed : (p,) True where the tolerance is the default one.
    correlation : (p, p) of the deviations z by the spreads; None where they are independent,
        because the robot states no common errors.
    errors : errors of the poses whose coefficients follow as more columns, to see what data say of
        them; they are zero in every fit.
    """

    robot: Mechanism
    places: IntArray
    nominal: FloatArray
    tolerance: FloatArray
    assumed: BoolArray
    correlation: FloatArray | None = None
    errors: SmoothErrors | None = None

    def __len__(self) -> int:
        return len(self.places) + (0 if self.errors is None else self.errors.count)

    __repr__ = represent

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The free parameters in order."""
        return tuple(self.robot.parameters.entries[i] for i in self.places)

    @property
    def dimensions(self) -> tuple[Dimension, ...]:
        """Dimensions in order."""
        return tuple(parameter.dimension for parameter in self.parameters)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def columns(self) -> ParameterUnits:
        """The free parameters in units of their tolerance, as columns of derivatives."""
        return ParameterUnits(self.robot.slots, self.places, self.tolerance)

    def values(self, deviation: FloatArray) -> FloatArray:
        """Return all values (t, p of the robot) [SI] at deviations z (t, p)."""
        values = np.repeat(self.robot.values[None], len(deviation), axis=0)
        values[:, self.places] = self.nominal + self.tolerance * deviation[:, : len(self.places)]
        return values

    def deviation(self, values: FloatArray) -> FloatArray:
        """Return the deviations z (t, p) of all values (t, p of the robot) [SI]."""
        z = np.zeros((len(values), len(self)))
        z[:, : len(self.places)] = (values[:, self.places] - self.nominal) / self.tolerance
        return z

    def correlation_root(self) -> FloatArray:
        """Return the Cholesky factor (p, p) of the correlation of the deviations z."""
        if self.correlation is None:
            return np.eye(len(self))
        return np.asarray(np.linalg.cholesky(self.correlation), dtype=np.float64)

    def prior_rows(self) -> FloatArray:
        """Return independent rows (k, p) of unit variance by deviations z, that the stated
        spreads amount to: the inverse of the Cholesky factor.
        """
        inverse = np.asarray(np.linalg.inv(self.correlation_root()), dtype=np.float64)
        return inverse[~self.assumed]

    def display(self) -> tuple[FloatArray, tuple[str, ...]]:
        """Return the factor to SI (p,) and the symbol of the unit in which each one is shown: that
        of the robot's file.
        """
        units = [self.robot.get_unit(parameter.dimension) for parameter in self.parameters]
        return np.array([unit.factor_to_si for unit in units]), tuple(u.symbol for u in units)

    def list_assumed(self, factor: float = 1.0) -> tuple[Quantity, ...]:
        """Return the default spread of each dimension that has one, times a factor."""
        assumed = []
        for dimension in Dimension:
            chosen = [p.dimension is dimension for p in self.parameters] & self.assumed
            if chosen.any():
                value = self.robot.to_quantity(factor * float(self.tolerance[chosen][0]), dimension)
                assumed.append(Quantity(value.value, "") if value.unit == "1" else value)
        return tuple(assumed)

    def findings(self) -> tuple[Finding, ...]:
        """Return a finding on default spreads; nothing where all spreads are stated."""
        count, assumed = int(self.assumed.sum()), self.list_assumed()
        if count == 0:
            return ()
        code = "fit.default-tolerances"
        return (report_finding(code, count=count, total=len(self), assumed=assumed),)


def select_free_parameters(robot: Mechanism) -> FreeParameters:
    """Return the free parameters of a robot with their spreads, stated or default.

    MechanismError
        The robot is over-constrained, and its loops do not close with other values of some.
    """
    refuse_breaking_parameters(robot)
    table = robot.parameters
    places = np.flatnonzero(table.free)
    stated = table.tolerance[places]
    assumed = np.isnan(stated)
    tolerance = stated
    if assumed.any():
        lengths = (
            Dimension.LENGTH,
            *map(Dimension.LENGTH.per, (Dimension.TEMPERATURE, Dimension.TIME)),
        )
        default = dict.fromkeys(lengths, DEFAULT_TOLERANCE * robot.size)
        dimensions = table.dimensions
        fallback = np.array([default.get(dimensions[i], DEFAULT_TOLERANCE) for i in places])
        tolerance = np.where(assumed, fallback, stated)
    correlation = table.correlation()[np.ix_(places, places)] if table.common else None
    return FreeParameters(robot, places, table.nominal[places], tolerance, assumed, correlation)


def fix_all(robot: Mechanism) -> FreeParameters:
    """Return no free parameter: the robot as it is, for fits of poses and setup alone."""
    nothing = np.zeros(0)
    return FreeParameters(robot, nothing.astype(np.int64), nothing, nothing, nothing > 0.0)


def free_only(robot: Mechanism, names: Iterable[str]) -> Mechanism:
    """Return the robot with only these parameters free."""
    return replace(robot, parameters=robot.parameters.with_free(names))


NEGLIGIBLE = 1e-6
"""Part of a combination, in spreads and relative to its largest, that is rounding and left out.
"""

MINOR = 0.1
"""The same for a weak direction, which has a small part of nearly every parameter."""

TIE = 1e-6
"""Relative difference below which two candidates for a pivot are equal. Symmetric parameters differ
by rounding, 1e-13 in practice, which is another one for every engine and processor.
"""


@dataclass(frozen=True, eq=False)
class Combination(Result):
    """A combined change of parameters that changes no measured value, or hardly any.

    Attributes
    ----------
    names : (k,) strongest first. changes : (k,) changes that belong together, in `units` (symbols).
    weights : (k,) the same in spreads, of length one over all parameters.
    singular_value : change of the whitened residuals per spread along the direction, in standard
        deviations of the noise; 0 for a null direction.
    meaning : what the robot does with such a change; empty where it is no rigid motion.
    nuisance : frames, targets and surfaces of the measurements that change with it.
    direction : (p,) all parameters, in spreads, with the parts that are left out.
    """

    names: tuple[str, ...]
    changes: FloatArray
    units: tuple[str, ...]
    weights: FloatArray = field(default_factory=lambda: np.zeros(0))
    singular_value: float = 0.0
    meaning: str = ""
    nuisance: tuple[str, ...] = ()
    direction: FloatArray = field(default_factory=lambda: np.zeros(0))

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("names", "changes", "units", "weights", "singular_value"),
        meaning=lambda combination: str(combination.meaning),
        nuisance="nuisance",
        sentence=str,
    )

    @property
    def is_harmless(self) -> bool:
        """Whether it is known that no pose depends on it."""
        return getattr(self.meaning, "code", "") == "identifiability.no-motion"

    @property
    def finding(self) -> Finding:
        """That the data do not determine this combination, or hardly."""
        weak = self.singular_value > 0.0
        return report_finding(
            "fit.hardly-observable" if weak else "fit.unidentifiable",
            names=self.names,
            changes=tuple(self.changes.tolist()),
            units=self.units,
            weights=tuple(self.weights.tolist()),
            singular_value=self.singular_value,
            meaning=str(self.meaning),
            nuisance=self.nuisance,
        )


def describe_null_space(free: FreeParameters, null_space: FloatArray) -> tuple[Combination, ...]:
    """Return the combinations that span a null space (p, d) of deviations in spreads."""
    return tuple(describe_direction(free, direction) for direction in sparsify_basis(null_space))


def describe_direction(
    free: FreeParameters, direction: FloatArray, singular_value: float = 0.0
) -> Combination:
    """Return a direction (p,) of deviations in spreads by names; small parts are left out."""
    factor, symbols = free.display()
    size = np.abs(direction)
    chosen = np.flatnonzero(size > (MINOR if singular_value > 0.0 else NEGLIGIBLE) * size.max())
    # parts that differ by rounding stay in the order of the robot's parameters
    order = chosen[np.argsort(-np.round(size[chosen] / size.max(), 9), kind="stable")]
    changes = direction[order] * free.tolerance[order] / factor[order]
    sign = np.sign(changes[0])
    return Combination(
        names=tuple(free.names[i] for i in order),
        changes=changes / changes[0],
        units=tuple(symbols[i] for i in order),
        weights=sign * direction[order] / np.linalg.norm(direction),
        singular_value=singular_value,
        direction=direction,
    )


def sparsify_basis(null_space: FloatArray) -> FloatArray:
    """Return a basis (d, p) of the space (p, d) in which each vector has a parameter of its own.

    It depends on the space alone, not on the basis that spans it.
    """
    if null_space.shape[1] == 0:
        return np.zeros((0, len(null_space)))
    from scipy.linalg import lu_factor, lu_solve

    pivots = choose_pivots(null_space.T, first=True)
    return lu_solve(lu_factor(null_space[pivots].T), null_space.T)


def choose_pivots(columns: FloatArray, first: bool) -> IntArray:
    """Return d well-conditioned columns of (d, p), ascending, by elimination with pivoting.

    Of columns that are equally large, the first one is taken, or the last one.
    """
    rest, chosen = columns, []
    for _ in range(len(columns)):
        size = np.linalg.norm(rest, axis=0)
        size[chosen] = 0.0
        equal = np.flatnonzero(size >= (1.0 - TIE) * size.max())
        pivot = int(equal[0 if first else -1])
        chosen.append(pivot)
        direction = rest[:, pivot] / size[pivot]
        rest = rest - direction[:, None] * (direction @ rest)
    return np.sort(np.array(chosen, dtype=np.int64))
