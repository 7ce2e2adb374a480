# SPDX-License-Identifier: Apache-2.0
"""The unit in which each parameter's deviation is counted: its tolerance, or a stated default where
it has none.

Rank, null directions, the smallest deviation and every filter are decided in these units, so they
are part of the result and said in the output.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.mechanism import Mechanism
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension, find_unit

DEFAULT = 1e-3
"""Tolerance where none is stated: this share of the robot's size for lengths, this many radians,
this ratio.
"""


@dataclass(frozen=True, eq=False)
class FreeParameters:
    """The free parameters of a robot as the estimators see them: e = nominal + tolerance * z.

    Attributes
    ----------
    robot : Mechanism; fixed parameters keep its values.
    places : (p,) positions of the free parameters in the robot's table.
    nominal, tolerance : (p,) [SI].
    assumed : (p,) where the tolerance is the default.
    """

    robot: Mechanism
    places: np.ndarray
    nominal: FloatArray
    tolerance: FloatArray
    assumed: np.ndarray

    def __len__(self) -> int:
        return len(self.places)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The free parameters in order."""
        return tuple(self.robot.parameters.entries[i] for i in self.places)

    @property
    def names(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(parameter.name for parameter in self.parameters)

    def values(self, deviation: FloatArray) -> FloatArray:
        """Return all parameter values (t, p of the robot) at deviations z (t, p)."""
        values = np.repeat(self.robot.values[None], len(deviation), axis=0)
        values[:, self.places] = self.nominal + self.tolerance * deviation
        return values

    def deviation(self, values: FloatArray) -> FloatArray:
        """Return the deviations z (t, p) of all parameter values (t, p of the robot)."""
        return (values[:, self.places] - self.nominal) / self.tolerance

    def display(self) -> tuple[FloatArray, tuple[str, ...]]:
        """Return factor to SI (p,) and symbol of the unit in which each parameter is shown: that of
        the robot's file.
        """
        symbols = [
            self.robot.units.get(q.dimension, DISPLAY_UNITS[q.dimension].symbol)
            for q in self.parameters
        ]
        return np.array([find_unit(symbol).factor_to_si for symbol in symbols]), tuple(symbols)

    def note(self) -> str | None:
        """Return the sentence that says which tolerances were assumed; None where all are stated."""
        count = int(self.assumed.sum())
        if count == 0:
            return None
        shown = []
        for dimension in Dimension:
            chosen = [
                i
                for i, p in enumerate(self.parameters)
                if self.assumed[i] and p.dimension is dimension
            ]
            if chosen:
                symbol = self.robot.units.get(dimension, DISPLAY_UNITS[dimension].symbol)
                value = self.tolerance[chosen[0]] / find_unit(symbol).factor_to_si
                shown.append(f"{value:.4g} {symbol} for {dimension.value}s")
        return (
            f"{count} of {len(self)} parameters have no tolerance; assumed: {', '.join(shown)}"
            f" (a thousandth of the robot's size, of a radian, of one)"
        )


def select_free_parameters(robot: Mechanism) -> FreeParameters:
    """Return the free parameters of a robot with the unit of each."""
    table = robot.parameters
    places = np.flatnonzero(table.free)
    default = {Dimension.LENGTH: DEFAULT * robot.size}
    assumed = np.isnan(table.tolerance[places])
    fallback = np.array([default.get(table.dimensions[i], DEFAULT) for i in places])
    tolerance = np.where(assumed, fallback, table.tolerance[places])
    return FreeParameters(robot, places, table.nominal[places], tolerance, assumed)
