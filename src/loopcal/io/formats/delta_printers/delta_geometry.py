# SPDX-License-Identifier: Apache-2.0
"""The geometry of a linear delta in the mm and degrees of printer firmware, and its robot file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from loopcal.errors import FileError
from loopcal.io.formats.program_format import ExportSource, ImportOptions, format_head, get_record
from loopcal.mechanism.families.linear_delta import LinearDelta

NOMINAL_ANGLES = (210.0, 330.0, 90.0)
"""Angles of the towers in firmware, before any correction [deg]."""


@dataclass(frozen=True)
class DeltaGeometry:
    """Radius, tower angles, arms and end stops [mm, deg].

    A stop is the height of the nozzle over the bed, in the center, with the carriage of this tower
    at its end stop.
    """

    radius: float
    angles: tuple[float, ...]
    arms: tuple[float, ...]
    stops: tuple[float, ...]


ROBOT = """\
radius: {radius}
angles: {angles}     # of the towers; the third defines the x axis and stays fixed
arms: {arms}
stops: {stops}       # height of the nozzle, in the center, with the carriage at its end stop
readings: drop       # carriage positions count down from the end stops
home: {{z: 0}}
workspace: {{x: {side}, y: {side}, z: [0, {top:g}]}}     # assumed; replace by the real workspace
{arms_sd}{fixed}"""
ARMS = "tolerances: {{arms: {{sd: {sd:.7g}}}}}     # measured by hand: prior knowledge\n"
FIXED = "fixed: [arm*.length]     # heights alone do not determine the arms; distances do\n"


def format_robot(
    geometry: DeltaGeometry, options: ImportOptions, path: Path, program: str, has_distances: bool
) -> str:
    """Return the robot file of a delta.

    Its arms are fixed unless distances determine them, or the options state how accurately they
    were measured by hand.
    """
    if not min(geometry.arms) > geometry.radius > 0:
        sentence = f"the delta radius is {geometry.radius:g} mm and the shortest arm"
        act = "the radius must be positive and every arm longer than it; correct them"
        raise FileError(f"{sentence} {min(geometry.arms):g} mm; {act}", path)
    half = round(0.5 * geometry.radius)
    head = format_head(path, program, "linear-delta", options.name, ("mm", "deg"))
    is_taped = options.sigma_tape is not None
    return head + ROBOT.format(
        radius=geometry.radius,
        angles=list(geometry.angles),
        arms=list(geometry.arms),
        stops=list(geometry.stops),
        side=[-half, half],
        top=half,
        arms_sd=ARMS.format(sd=options.choose_noise("tape") * 1e3) if is_taped else "",
        fixed="" if has_distances or is_taped else FIXED,
    )


def get_geometry(source: ExportSource, format_name: str, decimals: int) -> DeltaGeometry:
    """Return the geometry of a robot of the family linear-delta; DataError for another.

    Parameters
    ----------
    decimals : that the firmware stores, the most that people type.
    """
    get_record(source, LinearDelta, format_name, "a robot of the family linear-delta")
    values = source.values()

    def convert(name: str, factor: float) -> float:
        return source.round_number(values[name] * factor, name, 1.0 / factor, decimals)

    def list_towers(name: str, factor: float) -> tuple[float, ...]:
        return tuple(convert(name.format(k), factor) for k in (1, 2, 3))

    return DeltaGeometry(
        convert("radius", 1e3),
        list_towers("tower{}.angle", math.degrees(1)),
        list_towers("arm{}.length", 1e3),
        list_towers("tower{}.stop", 1e3),
    )
