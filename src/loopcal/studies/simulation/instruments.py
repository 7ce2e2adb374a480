# SPDX-License-Identifier: Apache-2.0
"""The instrument of a cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal.errors import DataError, suggest_names
from loopcal.measure import Instrument, Kind, Trials
from loopcal.mechanism import Mechanism
from loopcal.planning.plane_line_sensors import find_line_axes, make_plane_line_instrument
from loopcal.studies.specification.levels import InstrumentLevel, NoiseLevel, PosesLevel
from loopcal.typing import FloatArray
from loopcal.workflow.instrument_description import InstrumentDescription, build_instrument

SURFACES = {"plane", "line"}
"""Kinds of an instrument for points of planes and perpendicular lines."""


def make_instrument(level: InstrumentLevel, noise: NoiseLevel) -> Instrument:
    """Return the instrument of a level, with its sigmas times the factor of the noise.

    Raises
    ------
    DataError : as `build_instrument`, or an unused column that it does not measure.
    """
    instrument = build_instrument(
        InstrumentDescription(
            kinds=level.kinds,
            components=level.components,
            orientation=level.orientation,
            sigma_position=noise.factor * level.sigma_position,
            sigma_angle=noise.factor * level.sigma_angle,
            unknown_frames=level.unknown_frames,
            distribution=level.distribution,
        )
    )
    known = [name for sensor in instrument.sensors for name in list_column_names(sensor.kind)]
    for name in level.unused:
        if name not in known:
            hint = suggest_names(name, known)
            raise DataError(f"{name!r} is not measured{hint}; unused may name {', '.join(known)}")
    if set(level.unused) >= set(known):
        raise DataError("all measured columns are unused; leave at least one")
    return instrument


def place_instrument(
    instrument: Instrument, robot: Mechanism, level: PosesLevel, coordinates: FloatArray
) -> Instrument:
    """Return an instrument at its poses (n, c): on the planes and lines of their groups, where the
    level puts them there.

    Raises
    ------
    DataError : points on planes and lines, and an instrument for something else.
    """
    if not level.is_on_surfaces:
        return instrument
    check_surfaces(instrument)
    noise = {sensor.kind.name: sensor.noise for sensor in instrument.sensors}
    axis = find_line_axes(robot, coordinates, level.groups)
    points = np.arange(len(coordinates)).reshape(level.groups, -1)
    return make_plane_line_instrument(robot, axis, points, lambda name, _: noise[name])


def check_surfaces(instrument: Instrument) -> None:
    """Raise DataError where an instrument does not touch planes and lines."""
    kinds = [sensor.kind.name for sensor in instrument.sensors]
    if set(kinds) != SURFACES:
        raise DataError(
            "points on planes and lines need an instrument of the kinds plane and line, not "
            f"{', '.join(kinds)}; write 'kinds: [plane, line]'"
        )


def list_column_names(kind: Kind) -> list[str]:
    """Return the names of the columns of a kind."""
    return [column.name for column in kind.columns]


def hide_columns(trials: Trials, unused: tuple[str, ...]) -> Trials:
    """Return trials in which unused columns are not measured."""
    if not unused:
        return trials
    measured = []
    for sensor, values in zip(trials.instrument.sensors, trials.measured, strict=True):
        is_hidden = np.array([name in unused for name in list_column_names(sensor.kind)])
        measured.append(np.where(is_hidden, np.nan, values))
    return replace(trials, measured=tuple(measured))
