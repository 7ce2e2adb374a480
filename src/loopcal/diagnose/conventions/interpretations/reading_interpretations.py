# SPDX-License-Identifier: Apache-2.0
"""Interpretations of actuator readings: other units, factors, signs, orders and rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import combinations, permutations

import numpy as np

from loopcal.diagnose.conventions.changes import permute_columns, scale_chosen, scale_columns
from loopcal.diagnose.conventions.interpretations.interpretation import (
    Interpretation,
    Slip,
    name_source,
)
from loopcal.diagnose.conventions.interpretations.value_interpretations import (
    FACTORS,
    describe_unit,
)
from loopcal.measure.measurements import Measurements
from loopcal.mechanism import Actuator
from loopcal.typing import BoolArray, FloatArray

GEAR_FACTORS = (2.0, 0.5, 1.5, 1.0 / 1.5)
"""Factors by which true readings are larger than the written ones where microsteps, a gear or a
pulley are stated wrongly.
"""

NEGLIGIBLE = 1e-6
"""Reading of the home pose [m or rad] that counts as 0."""

MOST_PERMUTED = 4
"""Number of actuators up to which all orders are tested."""


def list_reading_interpretations(
    data: Measurements, actuators: Sequence[Actuator], home: FloatArray | None = None
) -> Iterator[Interpretation]:
    """Yield all other interpretations of the readings of actuators, the likelier slips first.

    Parameters
    ----------
    data : the measurements. actuators : of the robot.
    home : (a,), optional [SI]. Readings of the home pose; wrong gear factors are also counted from
        there, as for a machine that is homed to a reading other than 0.
    """
    for source, poses in _list_sources(data):
        for dimension in dict.fromkeys(actuator.dimension for actuator in actuators):
            chosen = poses[:, None] & np.array([a.dimension is dimension for a in actuators])
            for factor in FACTORS.get(dimension, ()):
                details = describe_unit("readings", dimension, factor)
                yield Interpretation("unit", details, source, None, scale_chosen(chosen, factor))
    for j, actuator in enumerate(actuators if len(actuators) > 1 else ()):
        for factor in FACTORS.get(actuator.dimension, ()):
            details = describe_unit(f"readings of {actuator.name}", actuator.dimension, factor)
            yield Interpretation("unit", details, "", None, scale_columns([j], factor))
    for rule in (_list_signs(actuators), _list_orders(actuators), _list_gears(actuators, home)):
        for slip, details, change in rule:
            yield Interpretation(slip, details, "", None, change)
    for shift, neighbor in ((1, "above"), (-1, "below")):
        change = partial(np.roll, shift=shift, axis=0)
        yield Interpretation("shifted-readings", {"neighbor": neighbor}, "", None, change)


def list_orders(count: int) -> list[tuple[int, ...]]:
    """Return other orders of `count` actuators.

    All orders of up to `MOST_PERMUTED`. For more: each two swapped, neighbors swapped in all pairs,
    odd before even numbers and the reverse of that, and the cyclic orders in both directions.
    """
    numbers = tuple(range(count))
    if count <= MOST_PERMUTED:
        return [order for order in permutations(numbers) if order != numbers]
    orders = []
    for a, b in combinations(numbers, 2):
        order = list(numbers)
        order[a], order[b] = b, a
        orders.append(tuple(order))
    orders += [(numbers[k:] + numbers[:k])[::step] for step in (-1, 1) for k in numbers]
    if count % 2 == 0:
        orders.append(tuple(i + 1 - 2 * (i % 2) for i in numbers))
        half = count // 2
        orders.append(numbers[::2] + numbers[1::2])
        orders.append(tuple(half * (i % 2) + i // 2 for i in numbers))
    return [order for order in dict.fromkeys(orders) if order != numbers]


def _list_signs(actuators: Sequence[Actuator]) -> Iterator[Slip]:
    names, columns = tuple(a.name for a in actuators), range(len(actuators))
    if len(names) > 1:
        yield "reading-sign", {"actuators": names}, scale_columns(columns, -1.0)
    for j in columns:
        yield "reading-sign", {"actuators": (names[j],)}, scale_columns([j], -1.0)


def _list_orders(actuators: Sequence[Actuator]) -> Iterator[Slip]:
    """Yield permutations of actuators of one dimension."""
    names, dimensions = [a.name for a in actuators], [a.dimension for a in actuators]
    columns = tuple(range(len(actuators)))
    for order in list_orders(len(actuators)):
        moved = [i for i in columns if order[i] != i]
        if any(dimensions[i] is not dimensions[order[i]] for i in moved):
            continue
        change = permute_columns(columns, order)
        if len(moved) == 2:
            yield "swapped-readings", {"actuators": tuple(names[i] for i in moved)}, change
        elif order == columns[::-1]:
            yield "reversed-readings", {}, change
        else:
            details = {
                "actuators": tuple(names[i] for i in moved),
                "order": tuple(names[order[i]] for i in moved),
            }
            yield "permuted-readings", details, change


def _list_gears(actuators: Sequence[Actuator], home: FloatArray | None) -> Iterator[Slip]:
    """Yield wrong factors of all actuators and of single ones, counted from 0 and from home."""
    names = tuple(a.name for a in actuators)
    groups = [tuple(range(len(names))), *((j,) for j in range(len(names)) if len(names) > 1)]
    zeros = [("zero", np.zeros(len(names)))]
    if home is not None:
        zeros.append(("home", np.asarray(home)))
    for origin, zero in zeros:
        for columns in groups:
            if origin == "home" and not np.any(np.abs(zero[list(columns)]) > NEGLIGIBLE):
                continue  # the same as from 0
            for factor in GEAR_FACTORS:
                details = {
                    "actuators": tuple(names[j] for j in columns),
                    "factor": factor,
                    "origin": origin,
                }
                yield "gear-factor", details, scale_columns(columns, factor, zero[list(columns)])


def _list_sources(data: Measurements) -> Iterator[tuple[str, BoolArray]]:
    """Yield source and poses (n,): all of them, and those that only the rows of one source measure,
    where sources have separate poses.
    """
    yield "", np.ones(data.n_poses, dtype=bool)
    measures = np.zeros((len(data.observations), data.n_poses), dtype=bool)
    for poses, rows in zip(measures, data.observations, strict=True):
        poses[rows.rows.ravel()] = True
    for i, poses in enumerate(measures & (measures.sum(axis=0) == 1)):
        if poses.any() and np.array_equal(poses, measures[i]) and len(measures) > 1:
            yield name_source(i, data), poses
