# SPDX-License-Identifier: Apache-2.0
"""Nuisance parameters: the unknown frames, targets, surfaces and offsets of measurements.

A kind states its nuisance parameters once, each with a scope. Every session and every group gets a
set of its own. A parameter is called `tracker.x`, or `monday.tracker.x` in the session monday.
Kinds that use the same name share the parameter.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Literal, Self

import numpy as np

from loopcal.errors import DataError, suggest_names
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.observations import Observations, StatedSize
from loopcal.mechanism.model import Mechanism
from loopcal.parameters import Parameter, ParameterTable
from loopcal.plain_text import represent
from loopcal.typing import FloatArray, IntArray
from loopcal.units import SD_RANGE, UNITS, Dimension, Unit, is_sd

if TYPE_CHECKING:
    from loopcal.measure.instrument import Sensor

ALL = "machine"  # scope of a parameter that all rows share


@dataclass(frozen=True)
class StatedValue:
    """A prior or a fixed value of one nuisance parameter.

    Parameters
    ----------
    name : full name, such as `monday.tracker.x`; without a session (`tracker.x`) that of the
        parameter in every session.
    sd : standard deviation of a prior [SI]; 0 fixes the parameter, infinity leaves it to the data.
    nominal : fixed value, or center of the prior [SI]; default: the nominal value of the kind.
    is_undetermined : whether it is fixed because no motion of the machine determines it.
    scope : "all" where all sessions share one value of an offset or another common error of an
        instrument, such as `tracker.scale`; by default every session has its own.
    size : how a certificate states `sd`, for the uncertainty budget.

    Raises
    ------
    DataError : the standard deviation is negative, a number is not finite, or another scope.
    """

    name: str
    sd: float = 0.0
    nominal: float | None = None
    is_undetermined: bool = False
    scope: Literal["session", "all"] = "session"
    size: StatedSize | None = None

    def __post_init__(self) -> None:
        if self.scope not in ("session", "all"):
            raise DataError(f"the scope of {self.name!r} is {self.scope!r}. Give session or all")
        if self.sd not in (0.0, np.inf) and not is_sd(self.sd):
            raise DataError(
                f"the standard deviation of {self.name!r} is {self.sd}. Give a number above 0, "
                f"{SD_RANGE}, or 0 to fix the parameter"
            )
        if self.nominal is not None and not np.isfinite(self.nominal):
            raise DataError(f"the value of {self.name!r} is {self.nominal}. Give a finite number")


@dataclass(frozen=True, eq=False)
class NuisanceParameters:
    """All nuisance parameters of measurements."""

    # the U parameters; a spread is a prior, a parameter without one is estimated from the data
    # alone, a fixed one keeps its value
    table: ParameterTable
    indices: tuple[IntArray, ...]  # for each kind (r, u) the parameters that each row uses
    # for each kind (r, u) the parts of these that each row takes, such as its progress in a drift;
    # None where all are 1
    factors: tuple[FloatArray | None, ...] = ()

    def __len__(self) -> int:
        return len(self.table)

    __repr__ = represent

    def select(self, kind: int, values: FloatArray) -> FloatArray:
        """Return values (t, r, u) for the rows of one kind, from those of all parameters (t, U)."""
        factor, used = self.factor(kind), values[:, self.indices[kind]]
        return used if factor is None else used * factor

    def factor(self, kind: int) -> FloatArray | None:
        """Return the entry of `factors` of a kind."""
        return self.factors[kind] if self.factors else None

    def values(self, stated: Mapping[str, float] | None = None) -> FloatArray:
        """Return values (U,): nominal, or as stated by name; DataError for an unknown name."""
        values = np.array(self.table.nominal)
        for name, value in (stated or {}).items():
            values[self._index(name)] = value
        return values

    def with_prior(self, pattern: str, sd: float) -> Self:
        """Return a copy with a prior of this `sd` [SI] on parameters such as `tracker.*`."""
        if not is_sd(sd):
            raise DataError(
                f"the standard deviation of {pattern!r} is {sd}. Give a number above 0, or fix the "
                f"parameter (allowed: {SD_RANGE})"
            )
        return self._changed(pattern, tolerance=sd)

    def with_fixed(self, pattern: str) -> Self:
        """Return a copy with parameters such as `tracker.r?` fixed at their nominal values."""
        return self._changed(pattern, free=False)

    def with_nominal(self, values: FloatArray) -> Self:
        """Return a copy with other nominal values (U,)."""
        pairs = zip(self.table.entries, np.asarray(values).tolist(), strict=True)
        entries = tuple(replace(p, nominal=value) for p, value in pairs)
        return replace(self, table=ParameterTable(entries))

    def _changed(self, pattern: str, **change: float | bool) -> Self:
        matches = [fnmatchcase(name, pattern) for name in self.table.names]
        if not any(matches):
            self._index(pattern)
        pairs = zip(self.table.entries, matches, strict=True)
        entries = tuple(replace(p, **change) if matching else p for p, matching in pairs)
        return replace(self, table=ParameterTable(entries))

    def _index(self, name: str) -> int:
        if name not in self.table.names:
            names = ", ".join(self.table.names[:12]) or "none"
            raise DataError(
                f"these measurements have no setup parameter {name!r}"
                f"{suggest_names(name, self.table.names)}; they have {names}"
            )
        return self.table.index(name)


def collect_nuisance_parameters(
    observations: Iterable[Observations | Sensor],
    labels: tuple[str, ...],
    stated_values: Iterable[StatedValue] = (),
) -> NuisanceParameters:
    """Return the nuisance parameters of measurements; DataError where two kinds share the name of a
    parameter and state it differently.

    observations : of `Measurements`, or sensors with explicit rows (`Sensor.assign_rows`).
    labels : names of the poses. stated_values : priors and fixed values, of any names.
    """
    entries: dict[str, Parameter] = {}
    references: dict[str, FloatArray] = {}
    in_sessions: dict[str, list[str]] = {}  # own name -> full names
    stated_values = tuple(stated_values)
    common = {value.name for value in stated_values if value.scope == "all"}
    indices, factors = [], []
    for rows in observations:
        kind = rows.kind
        takes_parts = kind.is_drift.any()
        factors.append(
            np.where(kind.is_drift, rows.drift_part[:, None], 1.0) if takes_parts else None
        )
        _check_names(kind, references, common)
        owners = {
            scope: _list_owners(rows, scope, labels)
            for scope in {p.scope for p in kind.nuisance_parameters}
        }
        keys = list(zip(*owners.values(), strict=True)) if owners else [()] * len(rows.session)
        own = [replace(p, scope=ALL) if p.name in common else p for p in kind.nuisance_parameters]
        names = {}
        for key in dict.fromkeys(keys):
            owner = dict(zip(owners, key, strict=True)) | {ALL: ""}
            names[key] = [_enter(entries, p, owner[p.scope], kind) for p in own]
            for parameter, name in zip(own, names[key], strict=True):
                in_sessions.setdefault(parameter.name, []).append(name)
        order = {name: i for i, name in enumerate(entries)}
        used = {key: tuple(order[name] for name in names[key]) for key in names}
        shape = (len(keys), len(kind.nuisance_parameters))
        of_rows = [used[key] for key in keys]
        indices.append(np.array(of_rows, dtype=np.intp).reshape(shape))
    for stated in stated_values:
        names = [stated.name] if stated.name in entries else in_sessions.get(stated.name, [])
        for name in names:
            entry = entries[name]
            entries[name] = replace(
                entry,
                nominal=entry.nominal if stated.nominal is None else stated.nominal,
                tolerance=stated.sd if 0.0 < stated.sd < np.inf else entry.tolerance,
                free=entry.free and stated.sd > 0.0,
            )
    table = ParameterTable(tuple(entries.values()))
    return NuisanceParameters(table, tuple(indices), tuple(factors))


def choose_setup_unit(robot: Mechanism, parameter: Parameter) -> Unit:
    """Return the unit in which a setup parameter is shown: that of the robot, ppm for a scale."""
    if parameter.dimension is Dimension.RATIO:
        return UNITS["ppm"]
    return robot.get_unit(parameter.dimension)


def _list_owners(rows: Observations | Sensor, scope: str, labels: tuple[str, ...]) -> list[str]:
    """Return the owner of a parameter of this scope, row by row."""
    if scope == "session":
        return rows.session.tolist()
    if scope == "group":
        # a group belongs to its session, unless the session has no name
        pairs = zip(rows.session.tolist(), rows.group.tolist(), strict=True)
        return [".".join(name for name in pair if name) for pair in pairs]
    if scope == "pose" and rows.rows is not None:
        return [labels[int(i)] for i in rows.rows.reshape(len(rows.rows), -1)[:, 0]]
    return [""] * len(rows.session)


def _enter(entries: dict[str, Parameter], parameter: Parameter, owner: str, kind: Kind) -> str:
    """Enter a parameter by its full name, unless it exists; refuse one that differs."""
    name = f"{owner}.{parameter.name}" if owner else parameter.name
    entry = replace(parameter, name=name)
    existing = entries.setdefault(name, entry)
    if existing is not entry and existing != entry:
        raise DataError(
            f"the kind {kind.name!r} defines the parameter {name!r} as {entry.nominal:.9g} (scope "
            f"{entry.scope}), another kind defines it as {existing.nominal:.9g} (scope "
            f"{existing.scope}). Give it alike, or use another name"
        )
    return name


def _check_names(kind: Kind, references: dict[str, FloatArray], common: Collection[str]) -> None:
    """Refuse two parameters of one name, another reference than the kinds before, which it enters,
    and frames, targets and surfaces that all sessions have in `common`.
    """
    names = [p.name for p in kind.nuisance_parameters]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise DataError(
            f"the kind {kind.name!r} has two parameters called {repeated!r}. Give frames, targets "
            "and surfaces different names"
        )
    for name, value in kind.references.items():
        if not np.array_equal(references.setdefault(name, value), value):
            raise DataError(
                f"the kind {kind.name!r} gives another orientation or place of {name!r} than the "
                "kind before. Give them alike, or use another name"
            )
    for item, of_item in kind.own_items.items():
        may_be_common = (kind.bias_item, *kind.common_items)
        for name in (p.name for p in of_item.parameters if item not in may_be_common):
            if name in common:
                raise DataError(
                    f"the scope of {name!r} is all, but sessions share only offsets and common "
                    "errors of an instrument, such as its scale. Leave it out"
                )
