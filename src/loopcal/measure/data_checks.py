# SPDX-License-Identifier: Apache-2.0
"""What measurements must satisfy beside their robot: refused with the evidence, unless the caller
overrides it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import fields
from typing import Any, NamedTuple, cast

import numpy as np

from loopcal.errors import DataError
from loopcal.findings import Quantity, report_finding
from loopcal.measure.kinds import Kind
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism import Mechanism
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import DISPLAY_UNITS, find_unit

STILL, PLANNED = 10.0, 100.0
"""Standard deviations of the noise within which readings stay that never move, and beyond which a
target is moved.
"""


def check_actuators(measurements: Measurements, robot: Mechanism) -> None:
    """Refuse readings that do not have one column for each actuator.

    Raises
    ------
    DataError
        Naming the actuators.
    """
    found, names = measurements.readings.shape[1], [actuator.name for actuator in robot.actuators]
    if found != len(names):
        raise DataError(
            f"the readings have {found} columns, but {robot.name!r} has {len(names)} actuators: "
            f"{', '.join(names)}"
        )


def check_strokes(
    measurements: Measurements, robot: Mechanism, *, allow: bool = False, override: str = ""
) -> None:
    """Refuse readings outside the stroke of their actuator.

    Parameters
    ----------
    measurements : Measurements
    robot : Mechanism
    allow : bool
        True accepts them.
    override : str
        How a user of the caller says so (a flag or argument); closes the message.

    Raises
    ------
    DataError
        Naming the pose, the actuator, the reading, the stroke and how many there are.
    """
    check_actuators(measurements, robot)
    if allow:
        return
    strokes = [actuator.stroke or (-np.inf, np.inf) for actuator in robot.actuators]
    low, high = np.array(strokes).T
    outside = np.argwhere((measurements.readings < low) | (measurements.readings > high))
    if len(outside):
        pose, column = (int(i) for i in outside[0])
        actuator = robot.actuators[column]
        shown = find_unit(robot.units[actuator.dimension])
        value, least, most = (
            f"{number / shown.factor_to_si:.7g}"
            for number in (measurements.readings[pose, column], *strokes[column])
        )
        others = "" if len(outside) == 1 else f" ({len(outside)} readings are outside)"
        raise DataError(
            f"pose {measurements.labels[pose]!r}: {actuator.name} reads {value} {shown}, outside "
            "its stroke of"
            f" {least} to {most} {shown}{others}; correct the reading, its unit or the stroke"
            + _or_use(override)
        )


def check_duplicates(
    measurements: Measurements,
    *,
    allow: bool = False,
    override: str = "",
    places: Sequence[Sequence[str]] = (),
) -> None:
    """Refuse a row that repeats another one to the last bit: the same readings, the same kind, the
    same values.

    Two rows of one measurement pretend to twice the information. True repeats differ in their
    noise; a coarse instrument that shows the same number again is what `allow` is for.

    Parameters
    ----------
    measurements : Measurements
    allow : bool
        True accepts them.
    override : str
        How a user of the caller says so; closes the message.
    places : sequence of sequence of str
        Where each row of each of the observations stands, such as `data.csv:12`; for the message.

    Raises
    ------
    DataError
        Naming the two poses, and where the rows stand.
    """
    if allow:
        return
    stands = dict(zip(map(id, measurements.observations), places, strict=False))
    for alike in _alike(measurements.observations):
        rows = alike[0]
        poses = np.concatenate([part.rows.reshape(len(part), -1) for part in alike])
        texts = [
            np.concatenate([getattr(part, name) for part in alike]) for name in ("session", "group")
        ]
        owners = [np.unique(text, return_inverse=True)[1].reshape(-1, 1) for text in texts]
        measured = np.concatenate([part.measured for part in alike])
        content = np.concatenate(
            [measurements.readings[poses].reshape(len(poses), -1), measured, *owners], axis=1
        )
        _, first, kinds = np.unique(
            np.nan_to_num(content, nan=1e300), axis=0, return_index=True, return_inverse=True
        )
        again = np.flatnonzero(first[kinds.ravel()] != np.arange(len(poses)))
        if len(again):
            second = int(again[0])
            pair = (int(first[kinds.ravel()[second]]), second)
            names = [measurements.labels[poses[i, 0]] for i in pair]
            lines = [place for part in alike for place in stands.get(id(part), ())]
            where = f" ({lines[pair[0]]} and {lines[pair[1]]})" if lines else ""
            raise DataError(
                f"poses {names[0]!r} and {names[1]!r}{where} have the same readings and the same "
                f"{rows.kind.name} values to"
                " the last digit; remove one of them" + _or_use(override)
            )


def _alike(observations: tuple[Observations, ...]) -> list[list[Observations]]:
    """Observations in groups of equal kinds and settings, as two files of one instrument give them."""
    found: list[list[Observations]] = []
    for rows in observations:
        there = next((group for group in found if _same(group[0].kind, rows.kind)), None)
        if there is None:
            found.append([rows])
        else:
            there.append(rows)
    return found


def _same(one: Kind, other: Kind) -> bool:
    """Whether two kinds are of one class and all their settings are equal."""
    settings = [field.name for field in fields(cast(Any, one)) if field.init]
    return type(one) is type(other) and all(
        np.array_equal(getattr(one, s), getattr(other, s)) for s in settings
    )


def check_targets_move(measurements: Measurements, T: FloatArray, *, allow: bool = False) -> None:
    """Refuse a target that no pose moves: its readings stay within the noise, though the robot
    carried it about.

    A reflector that stands on the floor, a frozen display, a column of another target give such
    readings, and whatever is fitted to them is wrong.

    Parameters
    ----------
    measurements : Measurements
    T : (n, 4, 4)
        T_base_platform of each pose, by the nominal robot.
    allow : bool
        True accepts them.

    Raises
    ------
    DataError
        Naming the target, how far it moved and how far it should have.
    """
    if allow:
        return
    for still in _stays(measurements):
        rows, kind = still.rows, still.rows.kind
        expected = kind.measure(
            T[None, rows.rows], np.zeros((1, len(rows), len(kind.noise_columns)))
        )[0]
        planned = np.ptp(expected[still.here][:, still.places], axis=0)
        if np.any(planned > PLANNED * still.noise):
            worst = int(np.argmax(planned / still.noise))
            shown = DISPLAY_UNITS[kind.columns[still.places[worst]].dimension]
            moved, should = (
                Quantity(float(range_[worst]) / shown.factor_to_si, str(shown))
                for range_ in (still.moved, planned)
            )
            raise DataError(
                report_finding(
                    "conventions.target-never-moves",
                    target=still.target,
                    kind=kind.name,
                    moved=moved,
                    expected=should,
                )
            )


def stays(measurements: Measurements) -> bool:
    """Whether any target's readings stay within the noise, so that `check_targets_move` has something to
    look at.
    """
    return any(True for _ in _stays(measurements))


class _Still(NamedTuple):
    """A target whose readings stay within the noise: its rows (here), columns, range of each (k,)
    and noise (k,) [SI].
    """

    rows: Observations
    target: str
    here: BoolArray
    places: list[int]
    moved: FloatArray
    noise: FloatArray


def _stays(measurements: Measurements) -> Iterator[_Still]:
    for rows in measurements.observations:
        kind = rows.kind
        if (
            not kind.changes_with_pose
            or kind.poses_per_row > 1
            or kind.sensed_joints
            or len(rows) < 3
        ):
            continue
        sigma = np.sqrt(np.einsum("rii->ri", rows.covariance)).max(axis=0)
        each = sigma if len(sigma) == len(kind.columns) else np.full(len(kind.columns), sigma.max())
        for session in np.unique(rows.session):
            for target, columns in kind.target_columns.items():
                places = list(columns)
                here = (rows.session == session) & ~np.any(
                    np.isnan(rows.measured[:, places]), axis=1
                )
                if np.count_nonzero(here) < 3:
                    continue
                moved = np.ptp(rows.measured[here][:, places], axis=0)
                if np.all(moved < STILL * each[places]):
                    yield _Still(rows, target, here, places, moved, each[places])


def _or_use(override: str) -> str:
    return f", or use {override}" if override else ""
