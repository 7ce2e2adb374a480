# SPDX-License-Identifier: Apache-2.0
"""The table of parameters: every number that calibration may change, by name."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from loopcal.errors import DataError, MechanismError, suggest_names
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    name : e.g. `leg3.base.x`.
    dimension : length [m], angle [rad] or ratio [1].
    nominal : value by design [SI].
    tolerance : standard deviation of the true value about the nominal one [SI]; None if unknown.
        An error that it has in common with others is not included, see `CommonError`.
    free : False keeps it at its nominal value.
    scope : the rows that share a value: those of the machine, a session, a group or a pose.
    positive : whether only values above zero exist, as of the length of a rod.
    """

    name: str
    dimension: Dimension
    nominal: float
    tolerance: float | None = None
    free: bool = True
    scope: str = "machine"
    positive: bool = False


@dataclass(frozen=True)
class CommonError:
    """An error that several parameters share: that of one batch of arms, or of a common zero.

    Each of them deviates by its own error, of its own spread, plus the same common error.

    name : e.g. `batch of rods`. parameters : names of those that share it, of one dimension.
    tolerance : standard deviation of the common error [SI].
    """

    name: str
    parameters: tuple[str, ...]
    tolerance: float


@dataclass(frozen=True)
class ParameterTable:
    """Parameters in a fixed order; arrays over it are (p,) and read-only.

    entries : the parameters. common : errors that several of them share.
    """

    entries: tuple[Parameter, ...]
    common: tuple[CommonError, ...] = ()

    def __post_init__(self) -> None:
        if len(self._places) < len(self.entries):
            duplicate = next(name for name in self.names if self.names.count(name) > 1)
            raise MechanismError(
                f"duplicate parameter {duplicate!r}. Give every parameter its own name"
            )

    def __len__(self) -> int:
        return len(self.entries)

    def __repr__(self) -> str:
        shown = ", ".join(self.names[:6]) + ", .." * (len(self) > 6)
        return f"<ParameterTable: {len(self)} parameters ({shown})>"

    @cached_property
    def _places(self) -> dict[str, int]:
        return {entry.name: i for i, entry in enumerate(self.entries)}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(p.name for p in self.entries)

    @cached_property
    def dimensions(self) -> tuple[Dimension, ...]:
        """Dimensions in order."""
        return tuple(p.dimension for p in self.entries)

    @cached_property
    def nominal(self) -> FloatArray:
        """Nominal values (p,) [SI]."""
        return _freeze(np.array([p.nominal for p in self.entries], dtype=float))

    @cached_property
    def tolerance(self) -> FloatArray:
        """Spreads (p,) as standard deviations [SI], NaN if none is stated.

        They are those of the whole deviation: sqrt(own^2 + sum of common^2).
        """
        own = np.array([p.tolerance for p in self.entries], dtype=float)  # None becomes NaN
        common = (self.common_effects**2).sum(axis=1)
        return _freeze(np.asarray(np.sqrt(own**2 + common)) if self.common else own)

    @cached_property
    def common_effects(self) -> FloatArray:
        """(p, k) standard deviations [SI] of the k common errors in each parameter; 0 elsewhere."""
        effects = np.zeros((len(self), len(self.common)))
        for i, error in enumerate(self.common):
            effects[[self.index(name) for name in error.parameters], i] = error.tolerance
        return _freeze(effects)

    def correlation(self) -> FloatArray:
        """Return the correlations (p, p) of the deviations: those that common errors cause."""
        share = (
            self.common_effects / np.where(np.isnan(self.tolerance), 1.0, self.tolerance)[:, None]
        )
        correlation = np.asarray(share @ share.T)
        np.fill_diagonal(correlation, 1.0)
        return correlation

    @cached_property
    def free(self) -> BoolArray:
        """Parameters (p,) to be identified."""
        return _freeze(np.array([p.free for p in self.entries], dtype=bool))

    @cached_property
    def positive(self) -> BoolArray:
        """Parameters (p,) whose values must be above zero."""
        return _freeze(np.array([p.positive for p in self.entries], dtype=bool))

    def index(self, name: str) -> int:
        """Return the position of a parameter; raises MechanismError with similar names."""
        if name in self._places:
            return self._places[name]
        hint = suggest_names(name, self.names) or f"; there are {', '.join(self.names[:3])}, ..."
        raise MechanismError(f"unknown parameter {name!r}{hint}")

    def with_free(self, names: Iterable[str]) -> ParameterTable:
        """Return the same table with only these parameters free."""
        chosen = {self.names[self.index(name)] for name in names}
        return replace(self, entries=tuple(replace(p, free=p.name in chosen) for p in self.entries))


def _freeze(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return the array, made read-only."""
    array.setflags(write=False)
    return array


def match_names(names: Sequence[str], pattern: str) -> list[str]:
    """Return the names of parameters that fit a name or a pattern, such as `leg*.length`.

    Raises DataError: none does.
    """
    fitting = [name for name in names if fnmatchcase(name, pattern)]
    if not fitting:
        raise DataError(
            f"no parameter has the name {pattern!r}{suggest_names(pattern, names)}. Correct the "
            "name: a pattern such as 'leg*.length' names several"
        )
    return fitting
