# SPDX-License-Identifier: Apache-2.0
"""The table of parameters: every number that calibration may change, by name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from loopcal.errors import MechanismError
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

SCOPES = ("machine", "session", "group", "pose")


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes
    ----------
    name : e.g. `leg3.base.x`.
    dimension : length [m], angle [rad] or ratio [1].
    nominal : value by design [SI].
    tolerance : standard deviation of the true value about the nominal one [SI]; None if unknown.
    free : False keeps it at its nominal value.
    scope : the rows that share a value: those of the machine, a session, a group or a pose.
    """

    name: str
    dimension: Dimension
    nominal: float
    tolerance: float | None = None
    free: bool = True
    scope: str = "machine"


@dataclass(frozen=True)
class ParameterTable:
    """Parameters in a fixed order; arrays over it are (p,) and read-only."""

    entries: tuple[Parameter, ...]
    _places: dict[str, int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        places: dict[str, int] = {}
        for i, entry in enumerate(self.entries):
            if entry.name in places:
                raise MechanismError(
                    f"duplicate parameter {entry.name!r}; give every parameter its own name"
                )
            places[entry.name] = i
        object.__setattr__(self, "_places", places)

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(p.name for p in self.entries)

    @property
    def dimensions(self) -> tuple[Dimension, ...]:
        """Dimensions in order."""
        return tuple(p.dimension for p in self.entries)

    @property
    def nominal(self) -> FloatArray:
        """Nominal values (p,) [SI]."""
        return _frozen(p.nominal for p in self.entries)

    @property
    def tolerance(self) -> FloatArray:
        """Tolerances (p,) as standard deviations [SI], NaN if none is stated."""
        return _frozen(np.nan if p.tolerance is None else p.tolerance for p in self.entries)

    @property
    def free(self) -> BoolArray:
        """Parameters (p,) to be identified."""
        free = np.array([p.free for p in self.entries], dtype=bool)
        free.setflags(write=False)
        return free

    def index(self, name: str) -> int:
        """Return the position of a parameter; raises MechanismError with similar names."""
        if name in self._places:
            return self._places[name]
        near = difflib.get_close_matches(name, self.names, n=3) or self.names[:3]
        raise MechanismError(f"unknown parameter {name!r}; similar names are {', '.join(near)}")

    def with_free(self, names: Iterable[str]) -> ParameterTable:
        """Return the same table with only these parameters free."""
        chosen = {self.names[self.index(name)] for name in names}
        return ParameterTable(tuple(replace(p, free=p.name in chosen) for p in self.entries))


def _frozen(values: Iterable[float]) -> FloatArray:
    array = np.array(list(values), dtype=float)
    array.setflags(write=False)
    return array
