# SPDX-License-Identifier: Apache-2.0
"""Interpretations of measured values: other units, orders, signs and columns.

The rules (`RULES`) use what a kind declares: its columns with their dimensions, its orientation
form, its targets; the zenith angle of a bearing is the only exception.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, combinations
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.diagnose.conventions.changes import Change, permute_columns, scale_columns
from loopcal.diagnose.conventions.interpretations.interpretation import (
    Interpretation,
    Slip,
    name_source,
)
from loopcal.geometry.orientation_forms import OrientationForm, parse_orientation
from loopcal.measure.kinds import Bearing, Component, Kind, Pose
from loopcal.measure.measurements import Measurements
from loopcal.typing import FloatArray
from loopcal.units import Dimension

DEGREES = 180.0 / np.pi

FACTORS: Mapping[Dimension, tuple[float, ...]] = {
    Dimension.LENGTH: (1e3, 1e-3, 25.4, 1.0 / 25.4, 10.0, 0.1),
    Dimension.ANGLE: (
        *(DEGREES, 1.0 / DEGREES, 1e3, 1e-3, 1e3 / DEGREES, DEGREES / 1e3),
        *(60.0, 1.0 / 60.0, 0.9, 1.0 / 0.9),
    ),
}
"""Factors by which the true values are larger than the written ones where a unit is wrong: m, mm,
um, cm, inch; rad, deg, mrad, arcmin, gon.
"""

SINGLE_COLUMN_FACTORS = (1e3, 1e-3, 25.4, 1.0 / 25.4, DEGREES, 1.0 / DEGREES, 0.9, 1.0 / 0.9)
"""Those of them that are also tested for single columns."""


def list_interpretations(data: Measurements) -> Iterator[Interpretation]:
    """Yield all other interpretations of measured values, the likelier slip of each family first.

    An interpretation that the kind itself rules out (a negative distance, an impossible tilt), or
    that changes no number, is omitted.
    """
    several = len(data.observations) > 1
    for i, rows in enumerate(data.observations):
        if not len(rows):
            continue
        kind, measured, source = rows.kind, rows.measured, ""
        if several:
            unique = sum(other.kind.name == kind.name for other in data.observations) == 1
            source = f"kind {kind.name!r}" if unique else name_source(i, data)
        for slip, details, change in chain.from_iterable(rule(kind) for rule in RULES):
            values = change(measured)
            meant = np.isfinite(values) | np.isnan(measured)
            same = np.allclose(values, measured, rtol=1e-12, atol=0.0, equal_nan=True)
            if meant.all() and not same and not kind.find_invalid_rows(values):
                yield Interpretation(slip, details, source, i, change)


def describe_unit(quantity: str, dimension: Dimension, factor: float) -> dict[str, Any]:
    """Return the details of a wrong unit."""
    return {"quantity": quantity, "dimension": dimension.value, "factor": factor}


def _list_units(kind: Kind) -> Iterator[Slip]:
    if not kind.changes_with_pose and not kind.sensed_joints:
        return  # gaps to a touched surface are 0 in every unit
    groups = [
        (name, d, [i for i, column in enumerate(kind.columns) if column.dimension is d], FACTORS[d])
        for d, name in ((Dimension.LENGTH, "lengths"), (Dimension.ANGLE, "angles"))
    ]
    named = _columns_by_name(kind)
    dimensions = [kind.columns[columns[0]].dimension for columns in named.values()]
    for (name, columns), d in zip(named.items(), dimensions, strict=True):
        if dimensions.count(d) > 1:
            factors = tuple(f for f in FACTORS.get(d, ()) if f in SINGLE_COLUMN_FACTORS)
            groups.append((name, d, columns, factors))
    for name, d, columns, factors in groups:
        for factor in factors if columns else ():
            yield "unit", describe_unit(name, d, factor), scale_columns(columns, factor)


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

    def read_as(name: str) -> Change:
        return lambda values: parse_orientation(name).to_matrix(values[:, angles])

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
                yield "orientation-form", {"form": name}, rewrite(read_as(name))
    yield "inverted-rotations", {}, rewrite(back)
    if position:
        inverse = rewrite(back, lambda v: -(back(v) @ v[:, position, None])[..., 0])
        yield "inverted-poses", {}, inverse
        for k, axis in enumerate("xyz"):
            sign = np.where(np.arange(3) == k, -1.0, 1.0)
            yield "left-handed-frame", {"axis": axis}, mirror(sign)


def _list_signs(kind: Kind) -> Iterator[Slip]:
    for name, columns in _columns_by_name(kind).items():
        yield "sign", {"column": name}, scale_columns(columns, -1.0)
    angles = [i for i, column in enumerate(kind.columns) if column.dimension is Dimension.ANGLE]
    if len(angles) > 1:
        yield "angle-signs", {}, scale_columns(angles, -1.0)
    if isinstance(kind, Bearing):
        elevation = np.arange(len(kind.columns)) % 2 == 1
        yield "zenith-angles", {}, lambda v: np.where(elevation, 0.5 * np.pi - v, v)


def _list_swaps(kind: Kind) -> Iterator[Slip]:
    named = _columns_by_name(kind)
    dimension = {name: kind.columns[columns[0]].dimension for name, columns in named.items()}
    for d in dict.fromkeys(dimension.values()):
        alike = {name: columns for name, columns in named.items() if dimension[name] is d}
        yield from _list_orders(alike, "columns")
    yield from _list_orders(dict(kind.target_columns), "targets")


def _list_orders(groups: Mapping[str, Sequence[int]], noun: str) -> Iterator[Slip]:
    """Yield groups of columns in other orders: each two swapped, and the cyclic orders in both
    directions.
    """
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


RULES = (_list_units, _list_rotations, _list_signs, _list_swaps)
"""From a kind to the slips of one family, the likelier families first."""


def _columns_by_name(kind: Kind) -> dict[str, list[int]]:
    """Return columns of the same meaning in all targets, by name: x of every target."""
    named: dict[str, list[int]] = {}
    single = len(kind.target_columns) == 1
    for places in kind.target_columns.values():
        for place in places:
            name = kind.columns[place].name
            named.setdefault(name if single else name.rsplit(".", 1)[-1], []).append(place)
    return named


def _orientation_columns(kind: Kind) -> tuple[OrientationForm, list[int], list[int]] | None:
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
