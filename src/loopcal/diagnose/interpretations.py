# SPDX-License-Identifier: Apache-2.0
"""What a file may have meant instead of what it says: other units, orders, signs and columns, as
changed measurements.

A hypothesis is the data read another way, in the same kinds: whatever was meant, the numbers are
written as the stated convention would write them, so that one and the same evaluation judges all.
The rules look at what a kind declares (its columns with their dimensions, its form of orientation,
its sights) and know no kind by name but for the zenith angle.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.geometry.orientation_forms import OrientationForm, parse_orientation
from loopcal.measure.kinds import Bearing, Component, Kind, Pose
from loopcal.measure.measurements import Measurements
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

TURN = 180.0 / np.pi

FACTORS: Mapping[Dimension, tuple[tuple[float, str], ...]] = {
    Dimension.LENGTH: (
        (1e3, "1000 times larger (m written as mm, or mm as um)"),
        (1e-3, "1000 times smaller (mm written as m, or um as mm)"),
        (25.4, "25.4 times larger (inches written as mm)"),
        (1.0 / 25.4, "25.4 times smaller (mm written as inches)"),
        (10.0, "10 times larger (cm written as mm)"),
        (0.1, "10 times smaller (mm written as cm)"),
    ),
    Dimension.ANGLE: (
        (TURN, "57.3 times larger (rad written as deg)"),
        (1.0 / TURN, "57.3 times smaller (deg written as rad)"),
        (1e3, "1000 times larger (rad written as mrad)"),
        (1e-3, "1000 times smaller (mrad written as rad)"),
        (1e3 / TURN, "17.5 times larger (deg written as mrad)"),
        (TURN / 1e3, "17.5 times smaller (mrad written as deg)"),
        (60.0, "60 times larger (deg written as arcmin)"),
        (1.0 / 60.0, "60 times smaller (arcmin written as deg)"),
        (0.9, "10/9 times smaller (gon written as deg)"),
        (1.0 / 0.9, "10/9 times larger (deg written as gon)"),
    ),
}
"""How many times larger the numbers were meant, by dimension, with the slip of the pen that does
it.
"""

OF_ONE_COLUMN = (1e3, 1e-3, 25.4, 1.0 / 25.4, TURN, 1.0 / TURN, 0.9, 1.0 / 0.9)
"""Those of them that are tried of single columns, too."""

UNIT_CURE = "correct the unit in the header"


@dataclass(frozen=True, eq=False)
class Interpretation:
    """One other way to read measurements.

    Attributes
    ----------
    words : what is read otherwise, and how; follows "with".
    cure : what to do if it is so.
    kind : place of the kind among the observations; None where the readings are read otherwise.
    values : measured values (r, c) of that kind, or readings (n, a), as the stated convention would
        write them [SI].
    shrinks : whether values become smaller, so that they might say nothing any more.
    """

    words: str
    cure: str
    kind: int | None
    values: FloatArray
    shrinks: bool = False

    def measured(self, data: Measurements) -> tuple[FloatArray, ...]:
        """Measured values of every kind under this hypothesis."""
        return tuple(
            self.values if i == self.kind else o.measured for i, o in enumerate(data.observations)
        )

    def applied(self, data: Measurements) -> Measurements:
        """The measurements under this hypothesis; covariances stay as stated."""
        if self.kind is None:
            return replace(data, readings=self.values)
        pairs = zip(data.observations, self.measured(data), strict=True)
        return replace(data, observations=tuple(replace(o, measured=values) for o, values in pairs))


class _Turned(NamedTuple):
    """Where a kind's columns hold a whole orientation and a position."""

    form: OrientationForm
    angles: list[int]
    position: list[int]

    def rotation(self, values: FloatArray) -> FloatArray:
        return self.form.to_matrix(values[:, self.angles])

    def written(
        self, values: FloatArray, rotation: FloatArray, position: FloatArray | None = None
    ) -> FloatArray:
        """Columns with another rotation, and another position."""
        changed = np.array(values)
        changed[:, self.angles] = self.form.from_matrix(rotation)
        if position is not None:
            changed[:, self.position] = position
        return changed


def list_interpretations(data: Measurements, parts: Sequence[str] = ()) -> Iterator[Interpretation]:
    """All other ways to read measurements, the likelier slip of each family first.

    A way that a kind itself doubts (a negative distance, tilts no direction has), or that changes
    no number, is left out.

    Parameters
    ----------
    data : as written. parts : where the rows of each of its observations come from, such as files;
        default: not known.
    """
    several = len(data.observations) > 1
    for i, rows in enumerate(data.observations):
        if not len(rows):
            continue
        alone = sum(other.kind.name == rows.kind.name for other in data.observations) == 1
        of = (
            f" of {f'kind {rows.kind.name!r}' if alone else _part(i, data, parts)}"
            if several
            else ""
        )
        for words, cure, values, shrinks in _of_kind(rows.kind, rows.measured):
            meant = np.isfinite(values) | np.isnan(rows.measured)
            same = np.allclose(values, rows.measured, rtol=1e-12, atol=0.0, equal_nan=True)
            if meant.all() and not same and not rows.kind.find_invalid_rows(values):
                yield Interpretation(words.format(of=of), cure, i, values, shrinks)


def list_reading_interpretations(
    data: Measurements,
    names: tuple[str, ...],
    dimensions: tuple[Dimension, ...],
    parts: Sequence[str] = (),
) -> Iterator[Interpretation]:
    """All other ways to read the readings of actuators with these names and dimensions; see
    `hypotheses`.
    """
    q = data.readings
    for of, poses in _readings_of(data, parts):
        for dimension in dict.fromkeys(dimensions):
            chosen = poses[:, None] & np.array([d is dimension for d in dimensions])
            for factor, words in FACTORS.get(dimension, ()):
                yield Interpretation(
                    f"readings{of} {words}",
                    UNIT_CURE,
                    None,
                    np.where(chosen, factor * q, q),
                    factor < 1.0,
                )
    cure = "turn the sign of these readings, or the direction of the actuator in the robot file"
    if len(names) > 1:
        yield Interpretation("all readings of the other sign (drop for rise)", cure, None, -q)
    for j, name in enumerate(names):
        sign = np.where(np.arange(len(names)) == j, -1.0, 1.0)
        yield Interpretation(f"readings of {name} of the other sign", cure, None, sign * q)
    for a, b in combinations(range(len(names)), 2):
        swapped = _swapped(q, [a], [b])
        yield Interpretation(
            f"readings of {names[a]} and {names[b]} swapped", "swap their headers", None, swapped
        )
    if len(names) > 2:
        yield Interpretation(
            "readings in the opposite order", "turn the order of their headers", None, q[:, ::-1]
        )
    for shift, which in ((1, "above"), (-1, "below")):
        words = f"every row belonging to the readings of the row {which}"
        yield Interpretation(
            words, "move the columns of the readings by one row", None, np.roll(q, shift, axis=0)
        )


def _part(i: int, data: Measurements, parts: Sequence[str]) -> str:
    """Where the rows of an observation come from, told from those of the others."""
    if len(parts) == len(data.observations) and parts.count(parts[i]) == 1:
        return parts[i]
    return f"part {i + 1} of the data"


def _readings_of(data: Measurements, parts: Sequence[str]) -> Iterator[tuple[str, BoolArray]]:
    """Words and poses (n,): all of them, and those that only the rows of one part see, where parts
    have poses of their own.
    """
    yield "", np.ones(data.n_poses, dtype=bool)
    sees = np.zeros((len(data.observations), data.n_poses), dtype=bool)
    for here, rows in zip(sees, data.observations, strict=True):
        here[rows.rows.ravel()] = True
    for i, here in enumerate(sees & (sees.sum(axis=0) == 1)):
        if here.any() and np.array_equal(here, sees[i]) and len(sees) > 1:
            yield f" of {_part(i, data, parts)}", here


def _of_kind(kind: Kind, values: FloatArray) -> Iterator[tuple[str, str, FloatArray, bool]]:
    """Words, cure, columns and whether they shrink, family by family."""
    for rule in (_units, _rotations, _signs, _swaps):
        yield from rule(kind, values)


def _units(kind: Kind, values: FloatArray) -> Iterator[tuple[str, str, FloatArray, bool]]:
    if not kind.changes_with_pose and not kind.sensed_joints:
        return  # gaps to a touched surface are 0, whatever the unit
    for dimension, called in ((Dimension.LENGTH, "lengths"), (Dimension.ANGLE, "angles")):
        chosen = np.array([column.dimension is dimension for column in kind.columns])
        if chosen.any():
            for factor, words in FACTORS[dimension]:
                yield (
                    f"{called}{{of}} {words}",
                    UNIT_CURE,
                    np.where(chosen, factor * values, values),
                    factor < 1.0,
                )
    named = _alike(kind)
    for name, columns in named.items():
        dimension = kind.columns[columns[0]].dimension
        if sum(kind.columns[other[0]].dimension is dimension for other in named.values()) > 1:
            chosen = np.isin(np.arange(len(kind.columns)), columns)
            for factor, words in FACTORS.get(dimension, ()):
                if factor in OF_ONE_COLUMN:
                    yield (
                        f"{name}{{of}} {words}",
                        UNIT_CURE,
                        np.where(chosen, factor * values, values),
                        factor < 1.0,
                    )


def _rotations(kind: Kind, values: FloatArray) -> Iterator[tuple[str, str, FloatArray, bool]]:
    at = _turned(kind)
    if at is None:
        return
    if len(at.angles) == 4:
        last = np.array(values)
        last[:, at.angles] = values[:, [at.angles[i] for i in (3, 0, 1, 2)]]
        yield "quaternions{of} read scalar last", "write the scalar first", last, False
    else:
        names = [
            "rotation-vector",
            "tilt-torsion",
            *(f"euler-{order}" for order in geometry.EULER_ORDERS),
        ]
        for name in names:
            if name != at.form.name:
                rotation = parse_orientation(name).to_matrix(values[:, at.angles])
                yield (
                    f"rotations{{of}} read as {name}",
                    f"write 'orientation: {name}'",
                    at.written(values, rotation),
                    False,
                )
    back = np.swapaxes(at.rotation(values), -1, -2)
    cure = "write rotations of the tool in the frame, not of the frame in the tool"
    yield "rotations{of} inverted", cure, at.written(values, back), False
    if at.position:
        position = -(back @ values[:, at.position, None])[..., 0]
        cure = "write poses of the tool in the frame, not of the frame in the tool"
        yield "poses{of} inverted", cure, at.written(values, back, position), False
        for k, axis in enumerate("xyz"):
            mirror = np.where(np.arange(3) == k, -1.0, 1.0)
            rotation = mirror[:, None] * at.rotation(values) * mirror
            words, cure = (
                f"frame{{of}} left-handed ({axis} turned)",
                f"turn the {axis} axis of the instrument's frame",
            )
            yield words, cure, at.written(values, rotation, mirror * values[:, at.position]), False


def _signs(kind: Kind, values: FloatArray) -> Iterator[tuple[str, str, FloatArray, bool]]:
    for name, columns in _alike(kind).items():
        changed = np.array(values)
        changed[:, columns] *= -1.0
        yield (
            f"{name}{{of}} of the other sign (drop for rise)",
            f"turn the sign of {name}",
            changed,
            False,
        )
    angles = [i for i, column in enumerate(kind.columns) if column.dimension is Dimension.ANGLE]
    if len(angles) > 1:
        changed = np.array(values)
        changed[:, angles] *= -1.0
        yield "all angles{of} of the other sign", "turn the sign of the angles", changed, False
    if isinstance(kind, Bearing):
        changed = np.array(values)
        changed[:, 1::2] = 0.5 * np.pi - values[:, 1::2]
        yield (
            "elevations{of} read as zenith angles",
            "write elevations above the horizontal",
            changed,
            False,
        )


def _swaps(kind: Kind, values: FloatArray) -> Iterator[tuple[str, str, FloatArray, bool]]:
    alike, dimension = _alike(kind), {c.name.rsplit(".", 1)[-1]: c.dimension for c in kind.columns}
    if len(kind.target_columns) == 1 and kind.sensed_joints:
        dimension = {c.name: c.dimension for c in kind.columns}
    for a, b in combinations(alike, 2):
        if dimension[a] is dimension[b]:
            yield (
                f"columns {a} and {b}{{of}} swapped",
                "swap their headers",
                _swapped(values, alike[a], alike[b]),
                False,
            )
    for (a, first), (b, second) in combinations(kind.target_columns.items(), 2):
        yield (
            f"targets {a!r} and {b!r}{{of}} swapped",
            "swap their headers",
            _swapped(values, first, second),
            False,
        )


def _alike(kind: Kind) -> dict[str, list[int]]:
    """Columns of the same meaning in all sights, by name: x of every target."""
    found: dict[str, list[int]] = {}
    single = len(kind.target_columns) == 1
    for places in kind.target_columns.values():
        for place in places:
            name = kind.columns[place].name
            found.setdefault(name if single else name.rsplit(".", 1)[-1], []).append(place)
    return found


def _swapped(
    values: FloatArray, first: list[int] | tuple[int, ...], second: list[int] | tuple[int, ...]
) -> FloatArray:
    changed = np.array(values)
    changed[:, [*first, *second]] = values[:, [*second, *first]]
    return changed


def _turned(kind: Kind) -> _Turned | None:
    """Where a kind holds a whole orientation; None for one that does not."""
    if isinstance(kind, Pose):
        n = len(kind.columns) - 3
        return _Turned(kind.form, list(range(n)), [n, n + 1, n + 2])
    if (
        isinstance(kind, Component)
        and kind.form is not None
        and set(kind.form.columns) <= set(kind.components)
    ):
        index: Callable[[str], int] = kind.components.index
        whole = {"x", "y", "z"} <= set(kind.components)
        return _Turned(
            kind.form,
            [index(n) for n in kind.form.columns],
            [index(n) for n in "xyz"] if whole else [],
        )
    return None
