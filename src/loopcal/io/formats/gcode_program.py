# SPDX-License-Identifier: Apache-2.0
"""G-code that moves a machine to the poses of a plan: RS-274, as LinuxCNC and others read it.

    G21 G90 G94 G40 G49 G61     millimeters, absolute, feed per minute, exact path
    G53 G1 X.. Y.. Z.. A.. B.. C.. F..    one straight move for each stop, in machine coordinates
    M0 or G4 P..                wait for the measurement

X Y Z are the platform's origin in the base frame. A B C are roll, pitch and yaw in degrees, with
R = Rz(C) Ry(B) Rx(A), as in the kinematics genhexkins of LinuxCNC. All words change evenly along a
move, as on the paths that a plan checks. Source: LinuxCNC, "G-Codes" (G4, G53, G61, G94, M0).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from loopcal.errors import DataError
from loopcal.io.core.csv_table import read_table, require_columns
from loopcal.io.data.columns import FIT, HELD_OUT, USE_COLUMN
from loopcal.io.formats.program_format import DECIMALS, format_short
from loopcal.io.runs.plan_folder import SHEET, VIA
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import get_dimension
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit

# Controlled coordinate -> word of RS-274.
WORDS = {"x": "X", "y": "Y", "z": "Z", "roll": "A", "pitch": "B", "yaw": "C"}
DEFAULT_FEED = 0.005  # feed of moves [m/s], 300 mm per minute, whatever the unit of the program is
SETTING_DECIMALS = 3  # decimals of the feed and the pause in a program
UNIT_CODES = {"mm": "G21", "in": "G20"}


Stops = tuple[Sequence[str], Sequence[str], FloatArray]
"""Labels of the poses (or "home"), uses (fit, held-out or via), and coordinates (n, c) [m, rad]."""


def read_stops(path: str | Path, robot: Mechanism) -> Stops:
    """Read the stops of a plan: its folder, or its sheet plan.csv.

    FileError : it is of another robot. DataError : a controlled coordinate has no word.
    """
    path = Path(path)
    file = path / SHEET if path.is_dir() else path
    table = read_table(file)
    why = f"a coordinate of {robot.name}. Name the folder of a plan, or its {SHEET}"
    require_columns(table, ("pose", USE_COLUMN.name, *robot.controlled), why)
    uses = table.text(USE_COLUMN.name)
    for row, use in enumerate(uses):
        if use not in (FIT, HELD_OUT, VIA):
            raise table.row_error(row, f"the use {use!r} is not {FIT}, {HELD_OUT} or {VIA}")
    columns = [table.numbers(n, get_dimension(n), empty=False) for n in robot.controlled]
    _require_words(robot)
    labels: Sequence[str] = table.pose_names()
    if "camera" in table.units:
        cameras = table.text("camera")
        labels = [f"{label} from {at}" for label, at in zip(labels, cameras, strict=True)]
    return labels, uses, np.column_stack(columns)


def format_gcode(
    robot: Mechanism,
    stops: Stops,
    home: FloatArray,
    feed: float = DEFAULT_FEED,
    pause: float | None = None,
    unit: Literal["mm", "in"] = "mm",
) -> str:
    """Return a program that starts at home, visits all stops in order, and returns to home.

    home : (c,) of `loopcal.planning.path.check_route`, which has checked all of these paths.
    feed : of moves [m/s], and of moves that only rotate the same number in degrees per minute.
    pause : time at each pose [s], None until the operator continues. unit : of lengths.
    """

    def format_positive(name: str, value: float, unit: str) -> str:
        if not 0.0 < round(value, SETTING_DECIMALS) < math.inf:
            sentence = f"the {name} is {value:g} {unit}. Give a finite number"
            raise DataError(f"{sentence} of at least {10.0**-SETTING_DECIMALS:g} {unit}")
        return format_short(value, SETTING_DECIMALS)

    poses = sum(use != VIA for use in stops[1])
    shown_feed = format_positive("feed", feed * 60.0 / find_unit(unit).factor_to_si, f"{unit}/min")
    wait = "M0" if pause is None else f"G4 P{format_positive('pause', pause, 's')}"

    def move(coordinates: FloatArray) -> str:
        return f"{format_move(robot, coordinates, unit)} F{shown_feed}"

    lines = [
        f"({_clean(robot.name)}: {poses} poses of a plan, in its order, and back to home)",
        "(X Y Z: origin of the platform frame in the base frame, in machine coordinates, G53.)",
        "(Work offsets and the tool length do not count.)",
        *(
            ["(A B C: roll, pitch, yaw in degrees, R = Rz Ry Rx.)"]
            if "roll" in robot.controlled
            else []
        ),
        f"(Lengths in {unit}. loopcal has checked the paths from home, not the way to home.)",
        f"{UNIT_CODES[unit]} G90 G94 G40 G49 G61",
        "(MSG, the next move goes to home: check that the way is free)",
        "M0",
        move(home),
    ]
    for label, use, coordinates in zip(*stops, strict=True):
        if use == VIA:
            lines += ["(via home)", move(coordinates)]
            continue
        lines += [f"(pose {_clean(label)})", move(coordinates)]
        lines += [f"(MSG, measure pose {_clean(label)})", wait]
    return "\n".join([*lines, "(back to home)", move(home), "M2"]) + "\n"


def format_move(robot: Mechanism, coordinates: FloatArray, unit: Literal["mm", "in"]) -> str:
    """Return a straight move to controlled coordinates (c,) [m, rad], without a feed; DataError
    where one has no word.
    """
    _require_words(robot)
    symbols = {Dimension.LENGTH: unit, Dimension.ANGLE: "deg"}
    factors = [find_unit(symbols[get_dimension(name)]).factor_to_si for name in robot.controlled]
    triples = zip(robot.controlled, coordinates.tolist(), factors, strict=True)
    words = (f"{WORDS[name]}{format_short(value / f, DECIMALS)}" for name, value, f in triples)
    return f"G53 G1 {' '.join(words)}"


def _require_words(robot: Mechanism) -> None:
    """Raise DataError where a controlled coordinate has no word."""
    if others := tuple(name for name in robot.controlled if name not in WORDS):
        code = "files.no-gcode-word"
        raise DataError.of(code, robot=robot.name, names=others, words=tuple(WORDS))


def _clean(text: str) -> str:
    """Return text that a comment of RS-274 can hold: without brackets and further lines."""
    return re.sub(r"[^\x20-\x7e]|[()]", "_", text)
