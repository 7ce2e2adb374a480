# SPDX-License-Identifier: Apache-2.0
"""Interpretations: other ways to read measurements, as pure functions from data to data.

An interpretation writes the values as the stated convention would write them, so that one
evaluation judges all interpretations, whether of measured values, of actuator readings, of both, or
of the setup items that are known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations, permutations
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.findings import Finding, report_finding
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Bearing
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.assembly import Actuator
from loopcal.plain_text import represent
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

# From written values (r, c), or readings (n, a), to those that the stated convention would write
# [SI].
Change = Callable[[FloatArray], FloatArray]
Slip = tuple[str, dict[str, Any], Change]  # kind of a slip, what is read differently, and how


@dataclass(frozen=True, eq=False)
class Interpretation:
    """One other way to read measurements."""

    slip: str  # kind of the slip, such as `unit`; its code in the catalog is `conventions.<slip>`
    details: Mapping[str, Any]  # what is read differently, such as quantity and factor
    apply: Callable[[Measurements], Measurements]  # covariances stay as stated
    source: str = ""  # file or kind that it concerns; empty where it concerns all data
    of_values: bool = False  # whether it leaves the actuator readings as they are
    parts: tuple[Interpretation, ...] = ()  # the two of a combination

    @property
    def finding(self) -> Finding:
        """The interpretation as a finding."""
        return report_finding(**self.describe())

    def describe(self) -> dict[str, Any]:
        """Return code, source and details, for the data of another finding."""
        return {"code": f"conventions.{self.slip}", "source": self.source, **self.details}

    __repr__ = represent


def with_measured(data: Measurements, i: int, measured: FloatArray) -> Measurements:
    """Return measurements with other values (r, c) of one kind."""
    observations = list(data.observations)
    observations[i] = replace(observations[i], measured=measured)
    return replace(data, observations=tuple(observations))


def combine(first: Interpretation, second: Interpretation) -> Interpretation:
    """Return the combination of two interpretations, the first applied first."""
    parts = (first, second)
    return Interpretation(
        "combination",
        {"parts": tuple(part.describe() for part in parts)},
        lambda data: second.apply(first.apply(data)),
        of_values=first.of_values and second.of_values,
        parts=parts,
    )


def interpret_readings(
    slip: str, details: Mapping[str, Any], change: Change, source: str = ""
) -> Interpretation:
    """Return the interpretation that changes the actuator readings of all poses."""
    return Interpretation(
        slip, details, lambda data: replace(data, readings=change(data.readings)), source
    )


def change_columns(
    columns: Sequence[int], compute: Callable[[FloatArray], FloatArray | float]
) -> Change:
    """Return the change that computes columns from all values of a row."""
    chosen = list(columns)

    def change(values: FloatArray) -> FloatArray:
        changed = np.array(values)
        changed[:, chosen] = compute(values)
        return changed

    return change


def scale_columns(columns: Sequence[int], factor: float, zero: FloatArray | float = 0.0) -> Change:
    """Return the change that multiplies columns by a factor, counted from `zero` (k,) or ()."""
    chosen = list(columns)
    return change_columns(chosen, lambda values: zero + factor * (values[:, chosen] - zero))


def permute_columns(columns: Sequence[int], sources: Sequence[int]) -> Change:
    """Return the change that takes the values of columns from other columns."""
    taken = list(sources)
    return change_columns(columns, lambda values: values[:, taken])


# Interpretations of measured values: other units, orders, signs and columns.

DEGREES = 180.0 / np.pi
# Factors by which the true values are larger than the written ones where a unit is wrong: m, mm,
# um, cm, inch; rad, deg, mrad, arcmin, gon.
FACTORS: Mapping[Dimension, tuple[float, ...]] = {
    Dimension.LENGTH: (1e3, 1e-3, 25.4, 1.0 / 25.4, 10.0, 0.1),
    Dimension.ANGLE: (
        *(DEGREES, 1.0 / DEGREES, 1e3, 1e-3, 1e3 / DEGREES, DEGREES / 1e3),
        *(60.0, 1.0 / 60.0, 0.9, 1.0 / 0.9),
    ),
}
# Those of them that are also tested for single columns.
SINGLE_COLUMN_FACTORS = (1e3, 1e-3, 25.4, 1.0 / 25.4, DEGREES, 1.0 / DEGREES, 0.9, 1.0 / 0.9)


def list_interpretations(data: Measurements) -> Iterator[Interpretation]:
    """Yield all other interpretations of measured values, the likelier slip of each family first,
    without those that the kind rules out (a negative distance, an impossible tilt), or that change
    no number.
    """

    def apply(data: Measurements, i: int, change: Change) -> Measurements:
        return with_measured(data, i, change(data.observations[i].measured))

    names = [rows.kind.name for rows in data.observations]
    for i, rows in enumerate(data.observations):
        if not len(rows):
            continue
        kind, measured, source = rows.kind, rows.measured, ""
        if len(names) > 1:
            is_unique = names.count(kind.name) == 1
            source = f"kind {kind.name!r}" if is_unique else name_source(i, data)
        for slip, details, change in chain.from_iterable(rule(kind) for rule in RULES):
            values = change(measured)
            meant = np.isfinite(values) | np.isnan(measured)
            same = np.allclose(values, measured, rtol=1e-12, atol=0.0, equal_nan=True)
            if meant.all() and not same and not kind.find_invalid_rows(values):
                yield Interpretation(
                    slip, details, partial(apply, i=i, change=change), source, of_values=True
                )


def name_source(i: int, data: Measurements) -> str:
    """Return the source of an observation, such as a file, different from those of the others."""
    sources = [rows.source for rows in data.observations]
    if sources[i] and sources.count(sources[i]) == 1:
        return sources[i]
    return f"part {i + 1} of the data"


def _describe_unit(quantity: str, dimension: Dimension, factor: float) -> dict[str, Any]:
    return {"quantity": quantity, "dimension": dimension.value, "factor": factor}


def _list_units(kind: Kind) -> Iterator[Slip]:
    if not kind.changes_with_pose and not kind.sensed_joints:
        return  # gaps to a touched surface are 0 in every unit
    groups = [
        (name, d, [i for i, column in enumerate(kind.columns) if column.dimension is d], FACTORS[d])
        for d, name in ((Dimension.LENGTH, "lengths"), (Dimension.ANGLE, "angles"))
    ]
    for named in _list_names(kind):
        dimensions = [kind.columns[columns[0]].dimension for columns in named.values()]
        for (name, columns), d in zip(named.items(), dimensions, strict=True):
            if dimensions.count(d) > 1:
                factors = tuple(f for f in FACTORS.get(d, ()) if f in SINGLE_COLUMN_FACTORS)
                groups.append((name, d, columns, factors))
    for name, d, columns, factors in groups:
        for factor in factors if columns else ():
            yield "unit", _describe_unit(name, d, factor), scale_columns(columns, factor)


def _list_rotations(kind: Kind) -> Iterator[Slip]:
    whole = _orientation_columns(kind)
    if whole is None:
        return
    form, angles, position = whole

    def rewrite(rotation: Change, move: Change | None = None) -> Change:
        """Return the change to another rotation (r, 3, 3) and another position (r, 3)."""

        def change(values: FloatArray) -> FloatArray:
            changed = np.array(values)
            changed[:, angles] = form.from_matrix(rotation(values))
            if move is not None:
                changed[:, position] = move(values)
            return changed

        return change

    def back(values: FloatArray) -> FloatArray:
        return np.swapaxes(form.to_matrix(values[:, angles]), -1, -2)

    def mirror(sign: FloatArray) -> Change:
        return rewrite(
            lambda values: sign[:, None] * form.to_matrix(values[:, angles]) * sign,
            lambda values: sign * values[:, position],
        )

    if len(angles) == 4:
        yield "scalar-last", {}, permute_columns(angles, [angles[i] for i in (3, 0, 1, 2)])
    else:
        eulers = [f"euler-{order}" for order in geometry.EULER_ORDERS]
        for name in ("rotation-vector", "tilt-torsion", *eulers):
            if name != form.name:
                other = geometry.parse_orientation(name)
                read = rewrite(lambda v, other=other: other.to_matrix(v[:, angles]))
                yield "orientation-form", {"form": name}, read
    yield "inverted-rotations", {}, rewrite(back)
    if position:
        inverse = rewrite(back, lambda v: -(back(v) @ v[:, position, None])[..., 0])
        yield "inverted-poses", {}, inverse
        for k, axis in enumerate("xyz"):
            sign = np.where(np.arange(3) == k, -1.0, 1.0)
            yield "left-handed-frame", {"axis": axis}, mirror(sign)


def _list_signs(kind: Kind) -> Iterator[Slip]:
    for name, columns in chain.from_iterable(named.items() for named in _list_names(kind)):
        yield "sign", {"column": name}, scale_columns(columns, -1.0)
    angles = [i for i, column in enumerate(kind.columns) if column.dimension is Dimension.ANGLE]
    if len(angles) > 1:
        yield "angle-signs", {}, scale_columns(angles, -1.0)
    if isinstance(kind, Bearing):
        elevation = np.arange(len(kind.columns)) % 2 == 1
        yield "zenith-angles", {}, lambda v: np.where(elevation, 0.5 * np.pi - v, v)


def _list_swaps(kind: Kind) -> Iterator[Slip]:
    for named in _list_names(kind):
        dimension = {name: kind.columns[columns[0]].dimension for name, columns in named.items()}
        for d in dict.fromkeys(dimension.values()):
            alike = {name: columns for name, columns in named.items() if dimension[name] is d}
            yield from _list_orders(alike, "columns")
    yield from _list_orders(dict(kind.target_columns), "targets")


def _list_orders(groups: Mapping[str, Sequence[int]], noun: str) -> Iterator[Slip]:
    """Yield groups of columns in other orders: each two swapped, and the cyclic orders."""
    names, n = tuple(groups), len(groups)
    for a, b in combinations(names, 2):
        change = permute_columns([*groups[a], *groups[b]], [*groups[b], *groups[a]])
        yield f"swapped-{noun}", {noun: (a, b)}, change
    turned = [(names[k:] + names[:k])[::step] for step in (1, -1) for k in range(n)]
    for order in dict.fromkeys(turned):
        if sum(a != b for a, b in zip(order, names, strict=True)) > 2:
            sources = [i for name in order for i in groups[name]]
            change = permute_columns([i for name in names for i in groups[name]], sources)
            yield f"permuted-{noun}", {noun: names, "order": order}, change


# From a kind to the slips of one family, the likelier families first.
RULES = (_list_units, _list_rotations, _list_signs, _list_swaps)


def _list_names(kind: Kind) -> Iterator[dict[str, list[int]]]:
    """Yield columns by name: x of every target together, and, of several targets, x of each."""
    named: dict[str, list[int]] = {}
    several = len(kind.target_columns) > 1
    for places in kind.target_columns.values():
        for place in places:
            name = kind.columns[place].name
            named.setdefault(name.rsplit(".", 1)[-1] if several else name, []).append(place)
    yield named
    for places in kind.target_columns.values() if several else ():
        yield {kind.columns[place].name: [place] for place in places}


def _orientation_columns(
    kind: Kind,
) -> tuple[geometry.OrientationForm, list[int], list[int]] | None:
    """Return form and columns of a whole orientation, and the columns of the position if there are
    any; None for a kind without orientation.
    """
    if isinstance(kind, Pose):
        n = len(kind.columns) - 3
        return kind.form, list(range(n)), [n, n + 1, n + 2]
    if not isinstance(kind, Component) or kind.form is None:
        return None
    names = kind.components
    if not set(kind.form.columns) <= set(names):
        return None
    position = [names.index(n) for n in "xyz"] if {"x", "y", "z"} <= set(names) else []
    return kind.form, [names.index(n) for n in kind.form.columns], position


# Interpretations of actuator readings: other units, factors, signs, orders and rows.

# Factors by which true readings are larger than the written ones where microsteps, a gear or a
# pulley are stated wrongly.
GEAR_FACTORS = (2.0, 0.5, 1.5, 1.0 / 1.5)
NEGLIGIBLE = 1e-6  # reading of the home pose [m or rad] that counts as 0
MOST_PERMUTED = 4  # number of actuators up to which all orders are tested


def list_reading_interpretations(
    data: Measurements, actuators: Sequence[Actuator], home: FloatArray | None = None
) -> Iterator[Interpretation]:
    """Yield all other interpretations of the readings of actuators, the likelier slips first.

    home : (a,) readings of the home pose [SI], from which wrong gear factors are counted, too.
    """
    for source, poses in _list_sources(data):
        for dimension in dict.fromkeys(actuator.dimension for actuator in actuators):
            chosen = poses[:, None] & np.array([a.dimension is dimension for a in actuators])
            for factor in FACTORS.get(dimension, ()):
                details = _describe_unit("readings", dimension, factor)
                times = np.where(chosen, factor, 1.0)
                yield interpret_readings("unit", details, partial(np.multiply, times), source)
    for slip, details, change in chain(
        _list_reading_slips(actuators), _list_gears(actuators, home)
    ):
        yield interpret_readings(slip, details, change)
    for shift, neighbor in ((1, "above"), (-1, "below")):
        change = partial(np.roll, shift=shift, axis=0)
        yield interpret_readings("shifted-readings", {"neighbor": neighbor}, change)


def _group_actuators(count: int) -> list[tuple[int, ...]]:
    """Return all actuators together, and each by itself."""
    return [tuple(range(count)), *((j,) for j in range(count) if count > 1)]


def _list_reading_slips(actuators: Sequence[Actuator]) -> Iterator[Slip]:
    """Yield other units, signs and orders of actuators."""
    names, dimensions = tuple(a.name for a in actuators), [a.dimension for a in actuators]
    columns = tuple(range(len(names)))
    groups = _group_actuators(len(names))
    for (j,) in groups[1:]:
        for factor in FACTORS.get(dimensions[j], ()):
            details = _describe_unit(f"readings of {names[j]}", dimensions[j], factor)
            yield "unit", details, scale_columns([j], factor)
    for group in groups:
        details = {"actuators": tuple(names[j] for j in group)}
        yield "reading-sign", details, scale_columns(group, -1.0)
    for order in list_orders(len(names)):
        moved = [i for i in columns if order[i] != i]
        if any(dimensions[i] is not dimensions[order[i]] for i in moved):
            continue
        change, those = permute_columns(columns, order), tuple(names[i] for i in moved)
        if len(moved) == 2:
            yield "swapped-readings", {"actuators": those}, change
        elif order == columns[::-1]:
            yield "reversed-readings", {}, change
        else:
            details = {"actuators": those, "order": tuple(names[order[i]] for i in moved)}
            yield "permuted-readings", details, change


def list_orders(count: int) -> list[tuple[int, ...]]:
    """Return other orders of `count` actuators: all of up to `MOST_PERMUTED`. For more: each two
    swapped, neighbors swapped in all pairs, odd before even numbers and the reverse, and the cyclic
    orders in both directions.
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


def _list_gears(actuators: Sequence[Actuator], home: FloatArray | None) -> Iterator[Slip]:
    """Yield wrong factors of all actuators and of single ones, counted from 0 and from home."""
    zeros = {"zero": np.zeros(len(actuators))} | ({} if home is None else {"home": home})
    for origin, zero in zeros.items():
        for group in _group_actuators(len(actuators)):
            start = zero[list(group)]
            if origin == "home" and not np.any(np.abs(start) > NEGLIGIBLE):
                continue  # the same as from 0
            names = tuple(actuators[j].name for j in group)
            for factor in GEAR_FACTORS:
                details = {"actuators": names, "factor": factor, "origin": origin}
                yield "gear-factor", details, scale_columns(group, factor, start)


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
