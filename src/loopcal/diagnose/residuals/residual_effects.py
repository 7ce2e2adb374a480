# SPDX-License-Identifier: Apache-2.0
"""Effects that the residuals of a fit may depend on: time, temperature, session, actuator reading.

An effect adds to each measured component a sum of stated functions of a quantity, with an unknown
size for each function and component. Targets that are measured together share it. The whitened rows
of one function and component are one column; its size is the range of the effect [SI].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.residuals.residual_rows import ResidualRows, order_rows
from loopcal.measure import Measurements, Observations
from loopcal.measure.kinds.error_groups import list_error_groups
from loopcal.mechanism import Mechanism
from loopcal.numerics.sorted_values import find_distinct
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

ORDER, TIME, TEMPERATURE, SESSION, READING = "order", "time", "temperature", "session", "reading"
"""What residuals may depend on."""


class EffectColumn(NamedTuple):
    """One function of the quantity, for one measured component.

    Attributes
    ----------
    component : its name, such as "z". dimension : of its size.
    """

    component: str
    dimension: Dimension


class Effect(NamedTuple):
    """A dependence of the measured values on one quantity.

    Attributes
    ----------
    source : what it depends on, such as "time". name : of the temperature or actuator, else empty.
    columns : (R, c) whitened rows by the sizes. labels : what the c columns are.
    """

    source: str
    name: str
    columns: FloatArray
    labels: tuple[EffectColumn, ...]


def list_effects(rows: ResidualRows, data: Measurements, robot: Mechanism) -> tuple[Effect, ...]:
    """Return the effects that measurements can have.

    Linear in time, or in the order of measurement where the rows state no time, linear in each
    temperature, a difference between sessions, and quadratic in each actuator reading.

    Parameters
    ----------
    rows : of a fit. data : its measurements, without excluded poses. robot : names the actuators.
    """
    observations = [o for o in data.observations if len(o)]
    total, shifts = len(rows.residual), _shift_components(rows, observations)
    trend, has_time = _list_trends(observations)
    effects = [_build(total, shifts, trend, TIME if has_time else ORDER)]
    names = dict.fromkeys(name for o in observations for name in o.context if name != TIME)
    for name in names:
        functions = [
            [scale_to_range(o.context[name])] if name in o.context else [] for o in observations
        ]
        effects.append(_build(total, shifts, functions, TEMPERATURE, name))
    functions = [
        [(o.session == name).astype(float) for name in find_distinct(o.session)]
        for o in observations
    ]
    effects.append(_build(total, shifts, functions, SESSION))
    for i, actuator in enumerate(robot.actuators):
        functions = []
        for o in observations:
            x = scale_to_range(data.readings[o.rows.reshape(len(o), -1)[:, 0], i])
            functions.append([x, 4.0 * x**2])
        effects.append(_build(total, shifts, functions, READING, actuator.name))
    return tuple(effects)


def scale_to_range(values: FloatArray) -> FloatArray:
    """Return values (r,) moved and scaled to the range -0.5 to 0.5; 0 where they are missing, or
    all equal.
    """
    known = np.isfinite(values)
    if not known.any() or not np.ptp(values[known]) > 0.0:
        return np.zeros(len(values))
    low, high = values[known].min(), values[known].max()
    return np.where(known, (values - 0.5 * (low + high)) / (high - low), 0.0)


def _list_trends(observations: Sequence[Observations]) -> tuple[list[list[FloatArray]], bool]:
    """Return the time of the rows of each kind, or their order, and whether it is the time."""
    has_time = all(TIME in o.context and np.isfinite(o.context[TIME]).all() for o in observations)
    functions = []
    for o in observations:
        values = o.context[TIME] if has_time else order_rows(o).astype(float)
        functions.append([scale_to_range(values)])
    return functions, has_time


class _ShiftedRows(NamedTuple):
    """How an offset of each measured component shifts the whitened rows of a kind.

    places : (k,) of these rows among all. row : (k,) number of the row of the kind. shifts : for
    each component, the change (k,) by a unit of it.
    """

    places: IntArray
    row: IntArray
    shifts: tuple[tuple[EffectColumn, FloatArray], ...]


def _shift_components(
    rows: ResidualRows, observations: Sequence[Observations]
) -> tuple[_ShiftedRows, ...]:
    """Return the shifts of the rows of each kind."""
    kinds = []
    for number, o in enumerate(observations):
        chosen = np.flatnonzero(rows.kind == number)
        whitener = o.whitener[rows.row[chosen], rows.column[chosen]]
        shifts = (
            (label, whitener[:, members].sum(axis=1)) for label, members in list_components(o)
        )
        kinds.append(_ShiftedRows(chosen, rows.row[chosen], tuple(shifts)))
    return tuple(kinds)


def _build(
    count: int,
    kinds: Sequence[_ShiftedRows],
    functions: Sequence[Sequence[FloatArray]],
    source: str,
    name: str = "",
) -> Effect:
    """Return an effect on `count` rows from functions (r,) of the rows of each kind, less their
    means: an offset of all rows is no such effect.
    """
    columns, labels = [np.zeros((count, 0))], []
    for kind, of_kind in zip(kinds, functions, strict=True):
        centered = [(function - function.mean())[kind.row] for function in of_kind]
        for label, shift in kind.shifts:
            for function in centered:
                column = np.zeros(count)
                column[kind.places] = -shift * function
                if column.any():
                    columns.append(column[:, None])
                    labels.append(label)
    return Effect(source, name, np.concatenate(columns, axis=1), tuple(labels))


def list_components(rows: Observations) -> Iterator[tuple[EffectColumn, list[int]]]:
    """Give the measured components of a kind, with their columns: x of all targets is one."""
    members: dict[EffectColumn, list[int]] = {}
    for group in list_error_groups(rows.kind):
        for name, column in zip(group.components, group.columns, strict=True):
            members.setdefault(EffectColumn(name, group.dimension), []).append(column)
    yield from members.items()
