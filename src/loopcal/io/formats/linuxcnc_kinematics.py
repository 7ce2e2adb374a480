# SPDX-License-Identifier: Apache-2.0
"""A kinematics component of LinuxCNC (halcompile) with the complete model of an identified robot.

`kinematics.comp` beside this file wraps the C file of `loopcal.io.formats.c_kinematics`. LinuxCNC's
axes x, y, z, a, b, c are the platform's x, y, z, roll, pitch, yaw, joints are readings; lengths are
in the robot file's unit, which has to be that of the machine, angles in degrees. Each parameter
whose effect is linear is a pin. Source: the documentation of halcompile and of kinematics modules
(LinuxCNC 2.9).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np

from loopcal.errors import DataError
from loopcal.io.formats.c_kinematics import fill_template, list_movable, note_lost_terms
from loopcal.io.formats.program_format import Exported, ExportSource, Format
from loopcal.mechanism.kinematics import compute_readings
from loopcal.mechanism.model import Mechanism
from loopcal.units import UNITS, Dimension, Unit

NAME = "loopcalkins"  # name of the component, which its file must have
# Characters of the name of a pin, of which HAL allows 47 with the component's name.
LONGEST = 47 - len(f"{NAME}.")
# Coordinate -> member of LinuxCNC's pose.
AXES = {"x": "tran.x", "y": "tran.y", "z": "tran.z", "roll": "a", "pitch": "b", "yaw": "c"}


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the component.

    DataError : the robot is commanded in a tilt, which LinuxCNC has no axes for.
    """
    robot = source.robot
    others = [name for name in robot.controlled if name not in AXES]
    if others:
        raise DataError.of("files.no-axis", robot=robot.name, names=tuple(others))
    places, unit = list_movable(robot), robot.get_unit(Dimension.LENGTH)
    units = {Dimension.LENGTH: unit, Dimension.ANGLE: UNITS["deg"]}
    commanded = [actuator for actuator in robot.actuators if actuator.reference is None]
    scales = [units[actuator.dimension].factor_to_si for actuator in commanded]
    table = robot.parameters
    template = files("loopcal.io.formats").joinpath("kinematics.comp").read_text("utf-8")
    code = fill_template(robot, places)
    names = _name_pins([table.names[place] for place in places], template + code)
    pins, values = [], []
    for place, pin in zip(places, names, strict=True):
        own = robot.get_unit(table.dimensions[place])
        number = float(robot.values[place] / own.factor_to_si)
        what = _quote(f"{table.names[place]} in {own.symbol}")
        pins.append(f"pin in float {pin} = {number!r} {what};")
        values.append(f"        {_name_variable(pin)} * {own.factor_to_si!r},")
    axis_units = [
        units[Dimension.LENGTH if name in "xyz" else Dimension.ANGLE].factor_to_si
        for name in robot.controlled
    ]
    to_world = [
        f"    world->{AXES[name]} = c[{i}] / AXIS_UNIT[{i}];"
        for i, name in enumerate(robot.controlled)
    ]
    from_world = [
        f"    c[{i}] = world->{AXES[name]} * AXIS_UNIT[{i}];"
        for i, name in enumerate(robot.controlled)
    ]
    text = template.format(
        name=NAME,
        title=_quote(f"Kinematics of {robot.name}, identified by loopcal"),
        unit=unit.symbol,
        ini="\n".join(_list_settings(robot, units)),
        example=names[0] if names else "...",
        pins="\n".join(pins or ["pin out bit ready = 1;"]),
        code=code,
        joint_units="{" + ", ".join(map(repr, scales)) + "}",
        axis_units="{" + ", ".join(map(repr, axis_units)) + "}",
        values="\n".join(values),
        to_world="\n".join(to_world),
        from_world="\n".join(from_world),
    )
    return Exported(text, note_lost_terms(robot, FORMAT.name))


def _quote(text: str) -> str:
    """Return a text as a string of C, in which some marks have a meaning."""
    return '"' + re.sub(r'["\\?]', "'", text) + '"'


def _name_pins(parameters: Sequence[str], code: str) -> list[str]:
    """Return the name of each parameter's pin: of letters, digits, points and hyphens, short enough
    for HAL, and in C, where pins are macros, unlike each other and the words of the code.
    """
    taken = set(re.findall(r"\w+", code))
    pins = []
    for parameter in parameters:
        plain = re.sub(r"[^A-Za-z0-9.]+", "-", parameter)
        own = re.sub(r"[.-]*\.[.-]*", ".", plain)[-LONGEST:].strip(".-")
        own = own if own[:1].isalpha() else f"pin{own}"
        name, i = own[:LONGEST].rstrip(".-"), 2
        while _name_variable(name) in taken:
            ending = f"-{i}"
            name, i = own[: LONGEST - len(ending)].rstrip(".-") + ending, i + 1
        taken.add(_name_variable(name))
        pins.append(name)
    return pins


def _name_variable(pin: str) -> str:
    """Return the name of a pin's value in C, as halcompile makes it."""
    return pin.replace(".", "_").replace("-", "_")


def _list_settings(robot: Mechanism, units: Mapping[Dimension, Unit]) -> list[str]:
    """Return the lines of the INI file that the machine needs."""
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    commanded = robot.is_commanded
    lines = ["    [KINS]", f"    KINEMATICS = {NAME}", f"    JOINTS = {sum(commanded)}"]
    for i, (actuator, reading) in enumerate(
        (a, r) for a, r, use in zip(robot.actuators, home, commanded, strict=True) if use
    ):
        own = units[actuator.dimension]
        kind = "LINEAR" if actuator.dimension is Dimension.LENGTH else "ANGULAR"
        low, high = actuator.stroke or (-np.inf, np.inf)
        lines += [f"    [JOINT_{i}]", f"    TYPE = {kind}"]
        lines += [f"    HOME = {reading / own.factor_to_si:.9f}"]
        for name, limit in (("MIN_LIMIT", low), ("MAX_LIMIT", high)):
            if np.isfinite(limit):
                lines.append(f"    {name} = {limit / own.factor_to_si:.6f}")
    return lines


FORMAT = Format(
    "linuxcnc-kinematics",
    "LinuxCNC component with the complete model",
    (".comp",),
    None,
    write,
    False,
)
