# SPDX-License-Identifier: Apache-2.0
"""The description of a result: its numbers by name, with units and dimensions.

A class states `FIELDS`, and `LABELS` of their dimensions. JSON, data frames, datasets and tables
follow from them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import fields as dataclass_fields
from types import MappingProxyType
from typing import Any

import numpy as np

from loopcal.units import SI_SYMBOLS, Dimension

# Second dimension of a matrix over the rows of the main table, such as a covariance.
OTHER = "other"
OWN = "*"  # name of a field that stands for all fields of the dataclass in JSON

Source = str | Callable[[Any], Any]
"""Path of attributes, such as `spectrum.rank`, or a function of the result."""


@dataclass(frozen=True)
class Field:
    """One number, array or text of a result.

    name : of the variable of a dataset and column of a data frame. of : where the result has it;
        default: the attribute `name`. Of a tuple of objects, the rest of a path yields one value
        for each, as in `candidates.rank`.
    axes : names of its dimensions, with blanks between; a field without any is in JSON only.
    unit : its symbol, or a tuple of one for each entry along the last axis. units : source of such
        units, as symbols or dimensions.
    key : in JSON; default: the name of a field without axes. None: not in JSON.
    is_optional : whether JSON lacks the key where the value is None. is_stored : whether it is one
        of the arrays in files, see `loopcal.results.storage`.
    title : heading in a table for people; default `name`. show : formats a value there; default
        `digits` significant digits.
    """

    name: str
    of: Source = ""
    axes: str = ""
    unit: str | tuple[str, ...] = ""
    units: Source = ""
    key: str | None = ""
    is_optional: bool = False
    is_stored: bool = False
    title: str = ""
    digits: int = 6
    show: Callable[[Any], str] | None = None

    @property
    def json_key(self) -> str | None:
        """The key in JSON; None where JSON does not have it."""
        return (None if self.axes else self.name) if self.key == "" else self.key

    def get(self, result: Any) -> Any:
        """Return the value that a result has."""
        return look_up(result, self.of or self.name)


def fields(*names: str, **paths: Source) -> tuple[Field, ...]:
    """Return fields of JSON: attributes of these names, then keys with their sources."""
    return (*map(Field, names), *(Field(key, of) for key, of in paths.items()))


def label_axes(**sources: Source | Sequence[Any]) -> Mapping[str, Source | Sequence[Any]]:
    """Return the names along axes, or their sources, by axis."""
    return MappingProxyType(sources)


def within(path: str, described: Sequence[Field]) -> tuple[Field, ...]:
    """Return the fields of the object at `path` as fields of the object that has it."""
    return tuple(replace(f, of=_extend(path, f.of or f.name)) for f in described)


def each(path: str, axis: str, described: Sequence[Field], *names: str) -> tuple[Field, ...]:
    """Return fields of these names of the objects at `path` as fields along an axis."""
    return tuple(replace(f, axes=axis, key=None) for f in within(path, pick(described, *names)))


def pick(described: Sequence[Field], *names: str) -> list[Field]:
    """Return the fields of these names in this order."""
    by_name = {field.name: field for field in described}
    return [by_name[name] for name in names]


def _extend(path: str, of: Source) -> Source:
    """Return the source of a field of the object, or of each of the objects, at `path`."""
    if isinstance(of, str):
        return f"{path}.{of}"

    def compute(result: Any) -> Any:
        owner = look_up(result, path)
        return [of(row) for row in owner] if type(owner) in (tuple, list) else of(owner)

    return compute


def look_up(value: Any, of: Source) -> Any:
    """Return what a source yields of a value: an attribute, or the value of a key of a mapping;
    None where the path leads over None.
    """
    if callable(of):
        return of(value)
    name, _, rest = of.partition(".")
    value = value[name] if isinstance(value, Mapping) else getattr(value, name)
    if not rest or value is None:
        return value
    if type(value) in (tuple, list):
        return [look_up(entry, rest) for entry in value]
    return look_up(value, rest)


def describe_json(value: Any, described: Sequence[Field]) -> dict[str, Any]:
    """Return the content for JSON by key, as objects; `OWN` are all fields of a dataclass."""
    content = {}
    for field in described:
        if field.name == OWN:
            content |= {own.name: getattr(value, own.name) for own in dataclass_fields(value)}
        elif (key := field.json_key) is not None:
            content[key] = field.get(value)
            if field.is_optional and content[key] is None:
                del content[key]
    return content


@dataclass(frozen=True, eq=False)
class Variable:
    """An array of a result with named dimensions; `unit` is "", a symbol or one for each entry
    along the last axis.
    """

    name: str
    dimensions: tuple[str, ...]
    values: np.ndarray
    unit: str | tuple[str, ...] = ""


@dataclass(frozen=True, eq=False)
class Records:
    """The arrays of a result.

    variables : the arrays. labels : dimension -> names along it.

    The first dimension of the first variable is that of the rows of the main table. Variables along
    it are columns of that table, an array with a second dimension has a column for each label of
    it, but a matrix (second dimension `OTHER`) has none.
    """

    variables: tuple[Variable, ...]
    labels: Mapping[str, Sequence[Any]]

    def list_columns(self) -> dict[str, np.ndarray]:
        """Return heading -> values of the main table, beginning with the labels of its rows."""
        main = self.variables[0].dimensions[0]
        columns = {main: np.asarray(self.labels[main])}
        for variable in self.variables:
            name, values, unit = variable.name, variable.values, variable.unit
            if variable.dimensions == (main,):
                columns[_add_unit(name, unit)] = values
            elif variable.dimensions[:-1] == (main,) and variable.dimensions[1] != OTHER:
                for i, label in enumerate(self.labels[variable.dimensions[1]]):
                    symbol = unit if isinstance(unit, str) else unit[i]
                    columns[_add_unit(f"{name} {label}", symbol)] = values[:, i]
        return columns


def collect_records(
    result: Any, described: Sequence[Field], labels: Mapping[str, Source | Sequence[Any]]
) -> Records:
    """Return the fields with axes as arrays.

    labels : source of the names along an axis, or the names; numbers from 1 for other axes.
    """
    variables, shown = [], {}
    for field in described:
        if not field.axes:
            continue
        values, dimensions = field.get(result), tuple(field.axes.split())
        if values is None:
            continue
        values = np.asarray(values)
        if values.dtype == object:  # names in place of numbers that some entries lack
            values = values.astype(float)
        unit = field.unit
        if field.units:
            found = look_up(result, field.units)
            unit = tuple(SI_SYMBOLS[u] if isinstance(u, Dimension) else u for u in found)
        variables.append(Variable(field.name, dimensions, values, unit))
        for axis, count in zip(dimensions, values.shape, strict=True):
            if axis not in shown:
                of = labels.get(axis)
                names = look_up(result, of) if isinstance(of, str) or callable(of) else of
                shown[axis] = range(1, count + 1) if names is None else names
    return Records(tuple(variables), {axis: list(names) for axis, names in shown.items()})


def _add_unit(name: str, unit: str | tuple[str, ...]) -> str:
    """Return the heading of a column."""
    return f"{name} [{unit}]" if unit and isinstance(unit, str) else name
