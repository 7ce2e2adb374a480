# SPDX-License-Identifier: Apache-2.0
"""List other interpretations of measurements: other units, orders, signs and columns.

An interpretation is the data read in another way, in the same kinds: the values are written as the
stated convention would write them, so that one evaluation judges all interpretations. The rules use
what a kind declares (its columns with their dimensions, its orientation form, its targets); the
zenith angle of a bearing is the only exception.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.findings import Finding, report_finding
from loopcal.geometry.orientation_forms import OrientationForm, parse_orientation
from loopcal.measure.kinds import Bearing, Component, Kind, Pose
from loopcal.measure.measurements import Measurements
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

DEGREES = 180.0 / np.pi

FACTORS: Mapping[Dimension, tuple[float, ...]] = {
    Dimension.LENGTH: (1e3, 1e-3, 25.4, 1.0 / 25.4, 10.0, 0.1),
    Dimension.ANGLE: (
        DEGREES,
        1.0 / DEGREES,
        1e3,
        1e-3,
        1e3 / DEGREES,
        DEGREES / 1e3,
        60.0,
        1.0 / 60.0,
        0.9,
        1.0 / 0.9,
    ),
}
"""Factors by which the true values are larger than the written ones where a unit is wrong: m, mm,
um, cm, inch; rad, deg, mrad, arcmin, gon.
"""

SINGLE_COLUMN_FACTORS = (1e3, 1e-3, 25.4, 1.0 / 25.4, DEGREES, 1.0 / DEGREES, 0.9, 1.0 / 0.9)
"""Those of them that are also tested for single columns."""


@dataclass(frozen=True, eq=False)
class Interpretation:
    """One other way to read measurements.

    Attributes
    ----------
    slip : kind of the slip, such as `unit`; its code in the catalog is `conventions.<slip>`.
    details : what is read differently, such as quantity and factor.
    source : file or kind that it concerns; empty where it concerns all data.
    observation : index of the observations; None where the actuator readings are read differently.
    values : measured values (r, c), or readings (n, a), as the stated convention would write them
        [SI].
    shrinks : whether values become smaller, so that they might no longer carry information.
    """

    slip: str
    details: Mapping[str, Any]
    source: str
    observation: int | None
    values: FloatArray
    shrinks: bool = field(default=False, kw_only=True)

    @property
    def code(self) -> str:
        """Code of the slip in the catalog."""
        return f"conventions.{self.slip}"

    @property
    def finding(self) -> Finding:
        """The interpretation as a finding."""
        return report_finding(self.code, source=self.source, **self.details)

    @property
    def key(self) -> tuple[Any, ...]:
        """Identity of the interpretation, for other rows of the same data."""
        return (self.slip, self.source, *self.details.items())

    def __repr__(self) -> str:
        return f"<Interpretation: {self.finding}>"

    def measured(self, data: Measurements) -> tuple[FloatArray, ...]:
        """Return the measured values of every kind under this interpretation."""
        return tuple(
            self.values if i == self.observation else o.measured
            for i, o in enumerate(data.observations)
        )

    def apply(self, data: Measurements) -> Measurements:
        """Return the measurements under this interpretation; covariances stay as stated."""
        if self.observation is None:
            return replace(data, readings=self.values)
        pairs = zip(data.observations, self.measured(data), strict=True)
        return replace(data, observations=tuple(replace(o, measured=values) for o, values in pairs))


class _Reading(NamedTuple):
    """Slip, details, values, and whether the values shrink."""

    slip: str
    details: dict[str, Any]
    values: FloatArray
    shrinks: bool = False


class _OrientationColumns(NamedTuple):
    """Columns of a kind that hold a whole orientation, and a position."""

    form: OrientationForm
    angles: list[int]
    position: list[int]

    def rotation(self, values: FloatArray) -> FloatArray:
        return self.form.to_matrix(values[:, self.angles])

    def write(
        self, values: FloatArray, rotation: FloatArray, position: FloatArray | None = None
    ) -> FloatArray:
        """Return the columns with another rotation, and another position."""
        changed = np.array(values)
        changed[:, self.angles] = self.form.from_matrix(rotation)
        if position is not None:
            changed[:, self.position] = position
        return changed


def list_interpretations(
    data: Measurements, sources: Sequence[str] = ()
) -> Iterator[Interpretation]:
    """Yield all other interpretations of measured values, the likelier slip of each family first.

    An interpretation that the kind itself rules out (a negative distance, an impossible tilt), or
    that changes no number, is omitted.

    Parameters
    ----------
    data : as written. sources : origin of the rows of each of its observations, such as files;
        default: not known.
    """
    several = len(data.observations) > 1
    for i, rows in enumerate(data.observations):
        if not len(rows):
            continue
        unique = sum(other.kind.name == rows.kind.name for other in data.observations) == 1
        source = ""
        if several:
            source = f"kind {rows.kind.name!r}" if unique else _source_of(i, data, sources)
        for slip, details, values, shrinks in _interpret_kind(rows.kind, rows.measured):
            meant = np.isfinite(values) | np.isnan(rows.measured)
            same = np.allclose(values, rows.measured, rtol=1e-12, atol=0.0, equal_nan=True)
            if meant.all() and not same and not rows.kind.find_invalid_rows(values):
                yield Interpretation(slip, details, source, i, values, shrinks=shrinks)


def list_reading_interpretations(
    data: Measurements,
    names: tuple[str, ...],
    dimensions: tuple[Dimension, ...],
    sources: Sequence[str] = (),
) -> Iterator[Interpretation]:
    """Yield all other interpretations of the readings of actuators with these names and dimensions;
    see `list_interpretations`.
    """
    q = data.readings

    def reading(slip: str, values: FloatArray, **details: Any) -> Interpretation:
        return Interpretation(slip, details, "", None, values)

    for source, poses in _sources_of_readings(data, sources):
        for dimension in dict.fromkeys(dimensions):
            chosen = poses[:, None] & np.array([d is dimension for d in dimensions])
            for factor in FACTORS.get(dimension, ()):
                details = _unit_details("readings", dimension, factor)
                values = np.where(chosen, factor * q, q)
                yield Interpretation("unit", details, source, None, values, shrinks=factor < 1.0)
    if len(names) > 1:
        yield reading("reading-sign", -q, actuators=names)
    for j, name in enumerate(names):
        sign = np.where(np.arange(len(names)) == j, -1.0, 1.0)
        yield reading("reading-sign", sign * q, actuators=(name,))
    for a, b in combinations(range(len(names)), 2):
        yield reading("swapped-readings", _swap(q, [a], [b]), actuators=(names[a], names[b]))
    if len(names) > 2:
        yield reading("reversed-readings", q[:, ::-1])
    for shift, neighbor in ((1, "above"), (-1, "below")):
        yield reading("shifted-readings", np.roll(q, shift, axis=0), neighbor=neighbor)


def _source_of(i: int, data: Measurements, sources: Sequence[str]) -> str:
    """Origin of the rows of an observation, different from those of the others."""
    if len(sources) == len(data.observations) and sources.count(sources[i]) == 1:
        return sources[i]
    return f"part {i + 1} of the data"


def _sources_of_readings(
    data: Measurements, sources: Sequence[str]
) -> Iterator[tuple[str, BoolArray]]:
    """Yield source and poses (n,): all of them, and those that only the rows of one source measure,
    where sources have separate poses.
    """
    yield "", np.ones(data.n_poses, dtype=bool)
    measures = np.zeros((len(data.observations), data.n_poses), dtype=bool)
    for poses, rows in zip(measures, data.observations, strict=True):
        poses[rows.rows.ravel()] = True
    for i, poses in enumerate(measures & (measures.sum(axis=0) == 1)):
        if poses.any() and np.array_equal(poses, measures[i]) and len(measures) > 1:
            yield _source_of(i, data, sources), poses


def _interpret_kind(kind: Kind, values: FloatArray) -> Iterator[_Reading]:
    """Yield the interpretations of a kind, family by family."""
    for rule in (_units, _rotations, _signs, _swaps):
        yield from rule(kind, values)


def _unit_details(quantity: str, dimension: Dimension, factor: float) -> dict[str, Any]:
    return {"quantity": quantity, "dimension": dimension.value, "factor": factor}


def _units(kind: Kind, values: FloatArray) -> Iterator[_Reading]:
    if not kind.changes_with_pose and not kind.sensed_joints:
        return  # gaps to a touched surface are 0 in every unit

    def scaled(quantity: str, dimension: Dimension, chosen: BoolArray, factor: float) -> _Reading:
        changed = np.where(chosen, factor * values, values)
        return _Reading("unit", _unit_details(quantity, dimension, factor), changed, factor < 1.0)

    for dimension, quantity in ((Dimension.LENGTH, "lengths"), (Dimension.ANGLE, "angles")):
        chosen = np.array([column.dimension is dimension for column in kind.columns])
        if chosen.any():
            for factor in FACTORS[dimension]:
                yield scaled(quantity, dimension, chosen, factor)
    named = _columns_by_name(kind)
    for name, columns in named.items():
        dimension = kind.columns[columns[0]].dimension
        if sum(kind.columns[other[0]].dimension is dimension for other in named.values()) > 1:
            chosen = np.isin(np.arange(len(kind.columns)), columns)
            for factor in FACTORS.get(dimension, ()):
                if factor in SINGLE_COLUMN_FACTORS:
                    yield scaled(name, dimension, chosen, factor)


def _rotations(kind: Kind, values: FloatArray) -> Iterator[_Reading]:
    columns = _orientation_columns(kind)
    if columns is None:
        return
    if len(columns.angles) == 4:
        last = np.array(values)
        last[:, columns.angles] = values[:, [columns.angles[i] for i in (3, 0, 1, 2)]]
        yield _Reading("scalar-last", {}, last)
    else:
        eulers = [f"euler-{order}" for order in geometry.EULER_ORDERS]
        for name in ("rotation-vector", "tilt-torsion", *eulers):
            if name != columns.form.name:
                rotation = parse_orientation(name).to_matrix(values[:, columns.angles])
                changed = columns.write(values, rotation)
                yield _Reading("orientation-form", {"form": name}, changed)
    back = np.swapaxes(columns.rotation(values), -1, -2)
    yield _Reading("inverted-rotations", {}, columns.write(values, back))
    if columns.position:
        position = -(back @ values[:, columns.position, None])[..., 0]
        yield _Reading("inverted-poses", {}, columns.write(values, back, position))
        for k, axis in enumerate("xyz"):
            mirror = np.where(np.arange(3) == k, -1.0, 1.0)
            rotation = mirror[:, None] * columns.rotation(values) * mirror
            changed = columns.write(values, rotation, mirror * values[:, columns.position])
            yield _Reading("left-handed-frame", {"axis": axis}, changed)


def _signs(kind: Kind, values: FloatArray) -> Iterator[_Reading]:
    for name, columns in _columns_by_name(kind).items():
        changed = np.array(values)
        changed[:, columns] *= -1.0
        yield _Reading("sign", {"column": name}, changed)
    angles = [i for i, column in enumerate(kind.columns) if column.dimension is Dimension.ANGLE]
    if len(angles) > 1:
        changed = np.array(values)
        changed[:, angles] *= -1.0
        yield _Reading("angle-signs", {}, changed)
    if isinstance(kind, Bearing):
        changed = np.array(values)
        changed[:, 1::2] = 0.5 * np.pi - values[:, 1::2]
        yield _Reading("zenith-angles", {}, changed)


def _swaps(kind: Kind, values: FloatArray) -> Iterator[_Reading]:
    named = _columns_by_name(kind)
    dimension = {c.name.rsplit(".", 1)[-1]: c.dimension for c in kind.columns}
    if len(kind.target_columns) == 1 and kind.sensed_joints:
        dimension = {c.name: c.dimension for c in kind.columns}
    for a, b in combinations(named, 2):
        if dimension[a] is dimension[b]:
            changed = _swap(values, named[a], named[b])
            yield _Reading("swapped-columns", {"columns": (a, b)}, changed)
    for (a, first), (b, second) in combinations(kind.target_columns.items(), 2):
        changed = _swap(values, first, second)
        yield _Reading("swapped-targets", {"targets": (a, b)}, changed)


def _columns_by_name(kind: Kind) -> dict[str, list[int]]:
    """Columns of the same meaning in all targets, by name: x of every target."""
    named: dict[str, list[int]] = {}
    single = len(kind.target_columns) == 1
    for places in kind.target_columns.values():
        for place in places:
            name = kind.columns[place].name
            named.setdefault(name if single else name.rsplit(".", 1)[-1], []).append(place)
    return named


def _swap(
    values: FloatArray, first: list[int] | tuple[int, ...], second: list[int] | tuple[int, ...]
) -> FloatArray:
    changed = np.array(values)
    changed[:, [*first, *second]] = values[:, [*second, *first]]
    return changed


def _orientation_columns(kind: Kind) -> _OrientationColumns | None:
    """Columns of a whole orientation; None for a kind without."""
    if isinstance(kind, Pose):
        n = len(kind.columns) - 3
        return _OrientationColumns(kind.form, list(range(n)), [n, n + 1, n + 2])
    if (
        isinstance(kind, Component)
        and kind.form is not None
        and set(kind.form.columns) <= set(kind.components)
    ):
        index: Callable[[str], int] = kind.components.index
        has_position = {"x", "y", "z"} <= set(kind.components)
        return _OrientationColumns(
            kind.form,
            [index(n) for n in kind.form.columns],
            [index(n) for n in "xyz"] if has_position else [],
        )
    return None
