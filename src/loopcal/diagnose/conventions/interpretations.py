# SPDX-License-Identifier: Apache-2.0
"""List other interpretations of measurements: other units, orders, signs and columns.

An interpretation is a function from data to data of the same kinds: it writes the values as the
stated convention would write them, so that one evaluation judges all interpretations. The rules
(`RULES`, and `list_reading_interpretations`) use what a kind declares: its columns with their
dimensions, its orientation form, its targets; the zenith angle of a bearing is the only exception.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.findings import Finding, report_finding
from loopcal.geometry.orientation_forms import OrientationForm, parse_orientation
from loopcal.measure.kinds import Bearing, Component, Kind, Pose
from loopcal.measure.measurements import Measurements
from loopcal.mechanism import Actuator
from loopcal.typing import BoolArray, FloatArray
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


Change = Callable[[FloatArray], FloatArray]
"""From written values (r, c), or readings (n, a), to those that the stated convention would write
[SI].
"""

Slip = tuple[str, dict[str, Any], Change]
"""Kind of a slip, what is read differently, and how."""


@dataclass(frozen=True, eq=False)
class Interpretation:
    """One other way to read measurements.

    Attributes
    ----------
    slip : kind of the slip, such as `unit`; its code in the catalog is `conventions.<slip>`.
    details : what is read differently, such as quantity and factor.
    source : file or kind that it concerns; empty where it concerns all data.
    observation : index of the observations; None where the actuator readings are read differently.
    change : of the measured values, row by row, or of the readings of all poses.
    """

    slip: str
    details: Mapping[str, Any]
    source: str
    observation: int | None
    change: Change

    @property
    def shrinks(self) -> bool:
        """Whether values become smaller, so that they might no longer carry information."""
        return bool(self.details.get("factor", 1.0) < 1.0)

    @property
    def code(self) -> str:
        """Code of the slip in the catalog."""
        return f"conventions.{self.slip}"

    @property
    def finding(self) -> Finding:
        """The interpretation as a finding."""
        return report_finding(self.code, source=self.source, **self.details)

    def describe(self) -> dict[str, Any]:
        """Return code, source and details, for the data of another finding."""
        return {"code": self.code, "source": self.source, **self.details}

    def __repr__(self) -> str:
        return f"<Interpretation: {self.finding}>"

    def apply(self, data: Measurements) -> Measurements:
        """Return the measurements under this interpretation; covariances stay as stated."""
        if self.observation is None:
            return replace(data, readings=self.change(data.readings))
        observations = list(data.observations)
        rows = observations[self.observation]
        observations[self.observation] = replace(rows, measured=self.change(rows.measured))
        return replace(data, observations=tuple(observations))


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
            source = f"kind {kind.name!r}" if unique else _source_of(i, data)
        for slip, details, change in chain.from_iterable(rule(kind) for rule in RULES):
            values = change(measured)
            meant = np.isfinite(values) | np.isnan(measured)
            same = np.allclose(values, measured, rtol=1e-12, atol=0.0, equal_nan=True)
            if meant.all() and not same and not kind.find_invalid_rows(values):
                yield Interpretation(slip, details, source, i, change)


def list_reading_interpretations(
    data: Measurements, actuators: Sequence[Actuator]
) -> Iterator[Interpretation]:
    """Yield all other interpretations of the readings of actuators; see `list_interpretations`."""
    names = tuple(actuator.name for actuator in actuators)
    columns = list(range(len(names)))
    for source, poses in _sources_of_readings(data):
        for dimension in dict.fromkeys(actuator.dimension for actuator in actuators):
            chosen = poses[:, None] & np.array([a.dimension is dimension for a in actuators])
            for factor in FACTORS.get(dimension, ()):
                details = _unit_details("readings", dimension, factor)
                yield Interpretation("unit", details, source, None, _scale_where(chosen, factor))
    slips: list[Slip] = []
    if len(names) > 1:
        slips.append(("reading-sign", {"actuators": names}, _scale(columns, -1.0)))
    slips += [("reading-sign", {"actuators": (names[j],)}, _scale([j], -1.0)) for j in columns]
    slips += [
        ("swapped-readings", {"actuators": (names[a], names[b])}, _permute([a, b], [b, a]))
        for a, b in combinations(columns, 2)
    ]
    if len(names) > 2:
        slips.append(("reversed-readings", {}, _permute(columns, columns[::-1])))
    for shift, neighbor in ((1, "above"), (-1, "below")):
        slips.append(
            ("shifted-readings", {"neighbor": neighbor}, partial(np.roll, shift=shift, axis=0))
        )
    yield from (Interpretation(slip, details, "", None, change) for slip, details, change in slips)


def _source_of(i: int, data: Measurements) -> str:
    """Return the source of an observation, such as a file, different from those of the others."""
    sources = [rows.source for rows in data.observations]
    if sources[i] and sources.count(sources[i]) == 1:
        return sources[i]
    return f"part {i + 1} of the data"


def _sources_of_readings(data: Measurements) -> Iterator[tuple[str, BoolArray]]:
    """Yield source and poses (n,): all of them, and those that only the rows of one source measure,
    where sources have separate poses.
    """
    yield "", np.ones(data.n_poses, dtype=bool)
    measures = np.zeros((len(data.observations), data.n_poses), dtype=bool)
    for poses, rows in zip(measures, data.observations, strict=True):
        poses[rows.rows.ravel()] = True
    for i, poses in enumerate(measures & (measures.sum(axis=0) == 1)):
        if poses.any() and np.array_equal(poses, measures[i]) and len(measures) > 1:
            yield _source_of(i, data), poses


def _unit_details(quantity: str, dimension: Dimension, factor: float) -> dict[str, Any]:
    return {"quantity": quantity, "dimension": dimension.value, "factor": factor}


def _scale(columns: list[int], factor: float) -> Change:
    """Return the change that multiplies columns by a factor."""

    def change(values: FloatArray) -> FloatArray:
        changed = np.array(values)
        changed[:, columns] *= factor
        return changed

    return change


def _scale_where(chosen: BoolArray, factor: float) -> Change:
    """Return the change that multiplies chosen values (n, a) by a factor."""
    return lambda values: np.where(chosen, factor * values, values)


def _permute(columns: list[int], sources: list[int]) -> Change:
    """Return the change that takes the values of columns from other columns."""

    def change(values: FloatArray) -> FloatArray:
        changed = np.array(values)
        changed[:, columns] = values[:, sources]
        return changed

    return change


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
            yield "unit", _unit_details(name, d, factor), _scale(columns, factor)


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
        yield "scalar-last", {}, _permute(angles, [angles[i] for i in (3, 0, 1, 2)])
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
        yield "sign", {"column": name}, _scale(columns, -1.0)
    angles = [i for i, column in enumerate(kind.columns) if column.dimension is Dimension.ANGLE]
    if len(angles) > 1:
        yield "angle-signs", {}, _scale(angles, -1.0)
    if isinstance(kind, Bearing):
        elevation = np.arange(len(kind.columns)) % 2 == 1
        yield "zenith-angles", {}, lambda v: np.where(elevation, 0.5 * np.pi - v, v)


def _list_swaps(kind: Kind) -> Iterator[Slip]:
    named = _columns_by_name(kind)
    for a, b in combinations(named, 2):
        if kind.columns[named[a][0]].dimension is kind.columns[named[b][0]].dimension:
            change = _permute([*named[a], *named[b]], [*named[b], *named[a]])
            yield "swapped-columns", {"columns": (a, b)}, change
    for (a, first), (b, second) in combinations(kind.target_columns.items(), 2):
        change = _permute([*first, *second], [*second, *first])
        yield "swapped-targets", {"targets": (a, b)}, change


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
