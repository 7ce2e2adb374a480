# SPDX-License-Identifier: Apache-2.0
"""The nine numbers of a linear delta, in the mm and degrees that printer firmware speaks, to and
from a robot file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from loopcal.errors import FileError
from loopcal.io.formats.program_format import ExportSource, record_of
from loopcal.mechanism.families.linear_delta import LinearDelta

DECIMALS = 6
"""Decimals of what is written [mm, deg]: those that Klipper itself saves; a nanometre."""

NOMINAL_ANGLES = (210.0, 330.0, 90.0)
"""Where firmware has its towers before any correction [deg]."""

Three = tuple[float, float, float]


@dataclass(frozen=True)
class DeltaNumbers:
    """Radius, tower angles, arms and end stops [mm, deg]: the stop is the height of the nozzle over
    the bed, in the centre, with this tower's carriage at its end stop.
    """

    radius: float
    angles: Three
    arms: Three
    stops: Three


ROBOT = """\
# Read from {origin}, {program}.
format: 1
family: linear-delta
name: {name}
source: {source}
units: {{length: mm, angle: deg}}

radius: {radius}
angles: {angles}     # of the towers; the third says where the x axis is and is never changed
arms: {arms}
stops: {stops}       # height of the nozzle, in the centre, with the carriage at its end stop
readings: drop       # carriage positions count down from the end stops
home: {{z: 0}}
workspace: {{x: {side}, y: {side}, z: [0, {top:g}]}}     # taken; say how far the nozzle really goes
{fixed}"""
FIXED = (
    "fixed: [arm*.length]     # heights alone cannot tell the arms from the rest; distances can\n"
)


def robot_text(found: DeltaNumbers, name: str, path: Path, program: str, arms_known: bool) -> str:
    """The robot file of a delta, with its arms fixed unless they can be identified."""
    if not min(found.arms) > found.radius > 0:
        raise FileError(
            f"the delta radius is {found.radius:g} mm and the shortest arm {min(found.arms):g} mm; "
            "the radius must be positive and every arm longer than it",
            path,
        )
    return ROBOT.format(
        origin=path.name.replace("\n", " "),
        program=program,
        name=json.dumps(name),
        source=json.dumps(f"{path.name}, {program}"),
        radius=found.radius,
        angles=list(found.angles),
        arms=list(found.arms),
        stops=list(found.stops),
        side=[-round(0.5 * found.radius), round(0.5 * found.radius)],
        top=round(0.5 * found.radius),
        fixed="" if arms_known else FIXED,
    )


def numbers_of(source: ExportSource, format_name: str) -> DeltaNumbers:
    """The numbers of a robot of the family linear-delta; DataError for another."""
    record_of(source, LinearDelta, format_name, "a robot of the family linear-delta")
    value = source.values()

    def towers(name: str, factor: float) -> Three:
        return three([value[name.format(k)] * factor for k in (1, 2, 3)])

    return DeltaNumbers(
        value["radius"] * 1e3,
        towers("tower{}.angle", math.degrees(1)),
        towers("arm{}.length", 1e3),
        towers("tower{}.stop", 1e3),
    )


def written(value: float) -> str:
    """A number as it is written."""
    return f"{value:.{DECIMALS}f}"


def same(one: float, other: float) -> bool:
    """Whether two numbers are written alike."""
    return written(one) == written(other)


def three(values: Sequence[float]) -> Three:
    """Three numbers, one for each tower."""
    a, b, c = values
    return a, b, c
