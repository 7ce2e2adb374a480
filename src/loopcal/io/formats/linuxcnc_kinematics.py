# SPDX-License-Identifier: Apache-2.0
"""A kinematics component of LinuxCNC (halcompile) with the complete model of an identified robot.

It wraps the C file of `loopcal.io.formats.c_kinematics`. LinuxCNC's axes x, y, z, a, b, c are the
platform's x, y, z, roll, pitch, yaw, joints are readings; lengths are in the robot file's unit,
which has to be that of the machine, angles in degrees. Each parameter whose effect is linear is a
pin. Source: the documentation of halcompile and of kinematics modules (LinuxCNC 2.9).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from loopcal.errors import DataError
from loopcal.findings import report_finding
from loopcal.io.formats.c_kinematics import fill_template, list_movable
from loopcal.io.formats.program_format import Exported, ExportSource, Format
from loopcal.mechanism.kinematics import compute_readings
from loopcal.mechanism.model import Mechanism
from loopcal.units import UNITS, Dimension

NAME = "loopcalkins"
"""Name of the component, which its file must have."""
AXES = {"x": "tran.x", "y": "tran.y", "z": "tran.z", "roll": "a", "pitch": "b", "yaw": "c"}
"""Coordinate -> member of LinuxCNC's pose."""

TEMPLATE = '''component {name} "Kinematics of {robot}, identified by loopcal";
description """
Install it:
.nf
    sudo halcompile --install {name}.comp
.fi
In the INI file, with lengths in {unit}:
.nf
{ini}
.fi
In a HAL file, to change a parameter without compiling:
.nf
    setp {name}.{example} ...
.fi
""";
license "Apache-2.0";
option singleton yes;
{pins}
;;
#define KINEMATICS_WORK static /* real-time threads have small stacks */
{code}
#include "kinematics.h"

static const double JOINT_UNIT[KINEMATICS_READINGS] = {joint_units};
static const double AXIS_UNIT[KINEMATICS_COORDINATES] = {axis_units};
static kinematics_state state;
static int is_begun;

/* Take the pins; parameters are computed again only where one of them changed. */
static void update(void)
{{
#if KINEMATICS_PARAMETERS > 0
    struct __comp_state *__comp_inst = __comp_first_inst; /* whose pins these are */
    static double known[KINEMATICS_PARAMETERS];
    const double now[KINEMATICS_PARAMETERS] = {{
{values}
    }};
    int i, is_new = !is_begun;
    for (i = 0; i < KINEMATICS_PARAMETERS; i++) {{
        is_new |= known[i] != now[i];
        known[i] = now[i];
    }}
    if (is_new)
        kinematics_set_parameters(now);
#endif
    if (!is_begun)
        kinematics_home(&state);
    is_begun = 1;
}}

KINEMATICS_TYPE kinematicsType(void)
{{
    return KINEMATICS_BOTH;
}}

int kinematicsForward(const double *joint, struct EmcPose *world,
                      const KINEMATICS_FORWARD_FLAGS *fflags, KINEMATICS_INVERSE_FLAGS *iflags)
{{
    double readings[KINEMATICS_READINGS], pose[12], c[KINEMATICS_COORDINATES];
    int i;
    (void)fflags;
    (void)iflags;
    update();
    for (i = 0; i < KINEMATICS_READINGS; i++)
        readings[i] = joint[i] * JOINT_UNIT[i];
    if (kinematics_forward(readings, &state, pose) != KINEMATICS_OK)
        return -1;
    kinematics_coordinates(pose, c);
{to_world}
    return 0;
}}

int kinematicsInverse(const struct EmcPose *world, double *joint,
                      const KINEMATICS_INVERSE_FLAGS *iflags, KINEMATICS_FORWARD_FLAGS *fflags)
{{
    double readings[KINEMATICS_READINGS], c[KINEMATICS_COORDINATES];
    int i;
    (void)fflags;
    (void)iflags;
    update();
{from_world}
    if (kinematics_inverse(c, &state, readings) != KINEMATICS_OK)
        return -1;
    for (i = 0; i < KINEMATICS_READINGS; i++)
        joint[i] = readings[i] / JOINT_UNIT[i];
    return 0;
}}

KINS_NOT_SWITCHABLE
EXPORT_SYMBOL(kinematicsType);
EXPORT_SYMBOL(kinematicsForward);
EXPORT_SYMBOL(kinematicsInverse);
'''


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the component.

    DataError : the robot is commanded in a tilt, which LinuxCNC has no axes for.
    """
    del into
    robot = source.robot
    others = [name for name in robot.controlled if name not in AXES]
    if others:
        found = report_finding("files.no-axis", robot=robot.name, names=tuple(others))
        raise DataError(found)
    places, unit = list_movable(robot), robot.get_unit(Dimension.LENGTH)
    units = {Dimension.LENGTH: unit, Dimension.ANGLE: UNITS["deg"]}
    commanded = [actuator for actuator in robot.actuators if actuator.reference is None]
    scales = [units[actuator.dimension].factor_to_si for actuator in commanded]
    table = robot.parameters
    pins, values = [], []
    for place in places:
        own = robot.get_unit(table.dimensions[place])
        number = float(robot.values[place] / own.factor_to_si)
        pins.append(f'pin in float {table.names[place]} = {number!r} "in {own.symbol}";')
        name = _name_variable(table.names[place])
        values.append(f"        {name} * {own.factor_to_si!r},")
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
    text = TEMPLATE.format(
        name=NAME,
        robot=robot.name.replace('"', "'"),
        unit=unit.symbol,
        ini="\n".join(_list_settings(robot)),
        example=table.names[places[0]] if places else "...",
        pins="\n".join(pins or ["pin out bit ready = 1;"]),
        code=fill_template(robot, places),
        joint_units="{" + ", ".join(map(repr, scales)) + "}",
        axis_units="{" + ", ".join(map(repr, axis_units)) + "}",
        values="\n".join(values),
        to_world="\n".join(to_world),
        from_world="\n".join(from_world),
    )
    return Exported(text, ())


def _name_variable(pin: str) -> str:
    """Return the name of a pin's value in C, as halcompile makes it."""
    return pin.replace(".", "_").replace("-", "_")


def _list_settings(robot: Mechanism) -> list[str]:
    """Return the lines of the INI file that the machine needs."""
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    commanded = [a.reference is None for a in robot.actuators]
    lines = ["    [KINS]", f"    KINEMATICS = {NAME}", f"    JOINTS = {sum(commanded)}"]
    for i, (actuator, reading) in enumerate(
        (a, r) for a, r, use in zip(robot.actuators, home, commanded, strict=True) if use
    ):
        own = robot.get_unit(actuator.dimension)
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
