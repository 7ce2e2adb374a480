# SPDX-License-Identifier: Apache-2.0
"""The numbers of a result by name, with units and dimensions: for tables of every sort."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import numpy as np

OTHER = "other"
"""Second dimension of a matrix over the rows of the main table, such as a covariance."""


@dataclass(frozen=True, eq=False)
class Variable:
    """An array with named dimensions.

    Attributes
    ----------
    name : of the array. dimensions : of its axes. values : the array.
    unit : its symbol, or one for each entry along the last axis; empty for words.
    """

    name: str
    dimensions: tuple[str, ...]
    values: Any
    unit: str | tuple[str, ...] = ""


@dataclass(frozen=True, eq=False)
class Records:
    """The arrays of a result.

    Attributes
    ----------
    variables : the arrays. labels : dimension -> names along it; numbers from 1 for others.
    main : dimension of the rows of the main table. Variables along it are columns of that table, an
        array with a second dimension has a column for each label of it, but a matrix (second
        dimension `OTHER`) has none.
    """

    main: str
    variables: tuple[Variable, ...]
    labels: Mapping[str, Sequence[Any]]

    def list_columns(self) -> dict[str, np.ndarray]:
        """Return heading -> values of the main table, beginning with the labels of its rows."""
        columns = {self.main: np.asarray(self.labels[self.main])}
        for variable in self.variables:
            values = np.asarray(variable.values)
            if variable.dimensions == (self.main,):
                columns[_add_unit(variable.name, variable.unit)] = values
            elif variable.dimensions[:-1] == (self.main,) and variable.dimensions[1] != OTHER:
                names = self.labels[variable.dimensions[1]]
                for i, name in enumerate(names):
                    unit = variable.unit if isinstance(variable.unit, str) else variable.unit[i]
                    columns[_add_unit(f"{variable.name} {name}".strip(), unit)] = values[:, i]
        return columns


def _add_unit(name: str, unit: str | tuple[str, ...]) -> str:
    """Return the heading of a column."""
    return f"{name} [{unit}]" if unit and isinstance(unit, str) else name


def number_from_one(count: int) -> list[int]:
    """Return labels of entries without names."""
    return list(range(1, count + 1))


@singledispatch
def collect_records(result: object) -> Records:
    """Return the numbers of a result."""
    raise TypeError(f"{type(result).__name__} has no records")
