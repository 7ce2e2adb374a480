# SPDX-License-Identifier: Apache-2.0
"""A mechanism: its structure compiled for the engine, its parameters, and their maps onto
displacements.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from loopcal.engine import Program, State
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Actuator, Assembly, SharedMap
from loopcal.mechanism.limb_maps import LimbMap, build_limb_maps
from loopcal.parameters import ParameterTable
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension


class Status(IntEnum):
    """How a row of a solution ended."""

    CONVERGED = 0
    UNREACHABLE = 1
    NOT_CONVERGED = 2
    NOT_FINITE = 3
    OTHER_MODE = 4

    @property
    def sentence(self) -> str:
        """What it means, for people."""
        return _SENTENCES[self]


_SENTENCES = {
    Status.CONVERGED: "closed",
    Status.UNREACHABLE: "the loops cannot be closed there: the nearest position leaves a gap",
    Status.NOT_CONVERGED: "no solution within the allowed number of steps; try another start",
    Status.NOT_FINITE: "the row holds NaN or infinity, or the mechanism is singular there",
    Status.OTHER_MODE: "closed, but in another assembly mode than the start",
}


@dataclass(frozen=True)
class SlotMap:
    """From parameter values to displacements e and transmission terms tau.

    slots(v) = M (v - nominal) + sum over shared maps of [g(v) - g(nominal)]; the first
    `n_displacements` slots are e, the others the terms of the actuators, (a, 8) row by row.

    Attributes
    ----------
    matrix : (s, p). shared : with, for each, the positions of its inputs and outputs.
        n_displacements : length of e.
    terms : (a, 8) nominal transmission terms. frequency : (a,) of their harmonics.
    """

    matrix: FloatArray
    shared: tuple[tuple[SharedMap, tuple[int, ...], tuple[int, ...]], ...]
    nominal: FloatArray
    n_displacements: int
    terms: FloatArray
    frequency: FloatArray

    def __call__(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values (t, p) -> e (t, n_displacements), tau (t, a, 8)."""
        slots = np.zeros((len(values), len(self.matrix)))
        change = values - self.nominal
        # element by element, so that a trial's result does not depend on its neighbours
        for places, columns, coefficients in self._layers:
            slots[:, places] += change[:, columns] * coefficients
        for shared, inputs, outputs in self.shared:
            change = shared.value(values[:, inputs]) - shared.value(self.nominal[None, inputs])
            for place, column in zip(outputs, change.T, strict=True):
                slots[:, place] += column
        e, tau = slots[:, : self.n_displacements], slots[:, self.n_displacements :]
        return e, self.terms + tau.reshape(-1, *self.terms.shape)

    @cached_property
    def _layers(self) -> list[tuple[IntArray, IntArray, FloatArray]]:
        """The matrix as (slots, parameters, coefficients), each slot once in a layer."""
        rows, columns = np.nonzero(self.matrix)
        nth = np.arange(len(rows)) - np.searchsorted(rows, rows)
        layers = (nth == i for i in range(nth.max(initial=-1) + 1))
        return [
            (rows[layer], columns[layer], self.matrix[rows[layer], columns[layer]])
            for layer in layers
        ]

    @cached_property
    def touches(self) -> BoolArray:
        """Which parameters may move which slots, (s, p)."""
        touches = self.matrix != 0
        for _, inputs, outputs in self.shared:
            touches[np.ix_(outputs, inputs)] = True
        return touches

    def jacobian(self, values: FloatArray) -> FloatArray:
        """d slots / d values, (t, s, p)."""
        J = np.repeat(self.matrix[None], len(values), axis=0)
        for shared, inputs, outputs in self.shared:
            slopes = shared.jacobian(values[:, inputs])
            for o, place in enumerate(outputs):
                for i, column in enumerate(inputs):
                    J[:, place, column] += slopes[:, o, i]
        return J


@dataclass(frozen=True)
class Mechanism:
    """A robot with closed loops, ready to compute.

    Attributes
    ----------
    assembly : the generic description it was compiled from. record : the family record (None if
        built by hand).
    parameters : the unknowns. values : (p,) their present values [SI], read-only.
    size : characteristic length [m]; angles times size compare with lengths.
    home : (4, 4) T_base_platform of the home pose; home_readings : (a,) [m or rad].
    units : display unit of each dimension, as the robot's file states them.
    notes : sentences worth telling (a rod that spins about itself, a held joint).
    """

    assembly: Assembly
    parameters: ParameterTable
    values: FloatArray
    program: Program
    slots: SlotMap
    size: float
    home_state: State
    units: Mapping[Dimension, str]
    notes: tuple[str, ...] = ()
    record: Any = None

    @property
    def name(self) -> str:
        """Name of the robot."""
        return self.assembly.name

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Actuators in the order of the readings."""
        return self.assembly.actuators

    @property
    def freedoms(self) -> tuple[str, ...]:
        """The platform's freedoms."""
        return self.assembly.freedoms

    @property
    def controlled(self) -> tuple[str, ...]:
        """Coordinates the machine is commanded in."""
        return self.assembly.controlled

    @property
    def tool(self) -> FloatArray:
        """T_platform_tool (4, 4)."""
        return self.assembly.tool

    @property
    def home(self) -> FloatArray:
        """T_base_platform (4, 4) of the home pose."""
        return self.home_state.T[0, 0]

    @cached_property
    def limb_maps(self) -> tuple[tuple[LimbMap, ...], ...]:
        """What stands in the equations of each limb, group by group."""
        return build_limb_maps(self.program, self.slots.matrix, self.slots.touches)

    @property
    def nominal(self) -> Mechanism:
        """The same robot at its nominal values."""
        return self.with_values(self.parameters.nominal)

    def with_values(self, values: ArrayLike) -> Mechanism:
        """The same robot with other parameter values (p,) [SI]; raises MechanismError for a wrong
        count or NaN.
        """
        new = np.array(values, dtype=float)
        if new.shape != (len(self.parameters),):
            raise MechanismError(
                f"{self.name} has {len(self.parameters)} parameters, but {new.shape} values were "
                "given"
            )
        if not np.isfinite(new).all():
            bad = self.parameters.names[int(np.flatnonzero(~np.isfinite(new))[0])]
            raise MechanismError(f"the value of {bad} is not finite; give a number")
        new.setflags(write=False)
        return replace(self, values=new)
