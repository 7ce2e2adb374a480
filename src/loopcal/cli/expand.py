# SPDX-License-Identifier: Apache-2.0
"""What a robot file expands into, whatever its family: limbs with their links and joints,
transmissions, and how parameters enter. Numbers are in the units of the file; each link is placed
in the frame before it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from loopcal.cli import show
from loopcal.units import Dimension, Unit

if TYPE_CHECKING:
    import numpy as np

    from loopcal.mechanism import Address, Limb, Mechanism

Units = Mapping[Dimension, Unit]
JOINTS = {"R": ("turns about z", Dimension.ANGLE), "P": ("slides along z", Dimension.LENGTH)}
POWERS = {"gain": 1, "curve": 2}


def assembly(robot: Mechanism) -> None:
    """Print the tables of an assembly."""
    units = show.units_of(robot)
    words = f"lengths in {units[Dimension.LENGTH]}, angles in {units[Dimension.ANGLE]}"
    place = ("x", "y", "z", "roll", "pitch", "yaw")
    values = _at_home(robot)
    rows = [
        row for i, limb in enumerate(robot.assembly.limbs) for row in _limb(limb, values[i], units)
    ]
    rows += [("platform", "home", "T_base_platform", *_place(robot.assembly.home, units), "")]
    rows += [("platform", "tool", "T_platform_tool", *_place(robot.assembly.tool, units), "")]
    show.table(
        f"Limbs, from base to platform ({words})",
        ("limb", "element", "is", *place, "at home"),
        rows,
        text_columns=3,
    )
    rows = [
        row for actuator in robot.actuators for row in _transmission(robot, actuator.name, units)
    ]
    show.table(
        "Transmissions: reading to joint value",
        ("actuator", "drives", "term", "value", "unit"),
        rows,
        text_columns=3,
    )
    show.table(
        "Maps: how parameters enter",
        ("parameter", "moves", "by", "unit"),
        _maps(robot, units),
        text_columns=2,
    )


def _at_home(robot: Mechanism) -> dict[int, np.ndarray]:
    """Return number of a limb -> values of its joints [m, rad] with the platform at home."""
    groups = zip(robot.program.groups, robot.home_state.joints, strict=True)
    return {i: joints[0, 0, k] for group, joints in groups for k, i in enumerate(group.limbs)}


def _limb(limb: Limb, values: np.ndarray, units: Units) -> list[tuple[str, ...]]:
    """Return the rows of a limb whose joints stand at `values`."""
    rows = []
    for i, link in enumerate(limb.links):
        rows.append((limb.name, link.name, "link", *_place(link.transform, units), ""))
        if i < len(limb.joints):
            joint = limb.joints[i]
            words, dimension = JOINTS[joint.kind]
            driven = f", driven by {joint.actuator}" if joint.actuator else ""
            pitch = (
                f", {_shown(joint.pitch, units[Dimension.LENGTH])} {units[Dimension.LENGTH]} in a "
                "radian"
                if joint.pitch
                else ""
            )
            home = f"{_shown(float(values[i]), units[dimension])} {units[dimension]}"
            rows.append(
                (limb.name, joint.name, f"{joint.kind} {words}{pitch}{driven}", *[""] * 6, home)
            )
    length = units[Dimension.LENGTH]
    rod = f", {_shown(limb.length, length)} {length}" if limb.ending == "distance" else ""
    driven = f", driven by {limb.actuator}" if limb.actuator else ""
    rows.append((limb.name, "ending", f"{limb.ending}{rod}{driven}", *[""] * 6, ""))
    rows.append(
        (
            limb.name,
            limb.attachment.name,
            "on the platform",
            *_place(limb.attachment.transform, units),
            "",
        )
    )
    return rows


def _place(T: np.ndarray, units: Units) -> tuple[str, ...]:
    """Return x y z roll pitch yaw of a transform (4, 4) as text."""
    from loopcal import geometry

    angles = geometry.matrix_to_euler(T[:3, :3], "xyz")
    lengths = tuple(_shown(float(x), units[Dimension.LENGTH]) for x in T[:3, 3])
    return lengths + tuple(_shown(float(a), units[Dimension.ANGLE]) for a in angles)


def _transmission(robot: Mechanism, name: str, units: Units) -> list[tuple[str, ...]]:
    """Return the rows of an actuator: the terms that are not zero."""
    actuator = next(a for a in robot.actuators if a.name == name)
    driven = [
        f"{limb.name}/{j.name}"
        for limb in robot.assembly.limbs
        for j in limb.joints
        if j.actuator == name
    ]
    driven += [f"{limb.name}/rod" for limb in robot.assembly.limbs if limb.actuator == name]
    reading, joint = units[actuator.dimension], units[_joint_dimension(robot, name)]
    rows = []
    for term, value in {"gain": 1.0, **actuator.terms}.items():
        if value:
            power = POWERS.get(term, 0)
            number = value * reading.factor_to_si**power / joint.factor_to_si
            rows.append(
                (
                    name,
                    ", ".join(driven),
                    term,
                    show.number(number, digits=9),
                    _per(joint, reading, power),
                )
            )
    return rows


def _per(joint: Unit, reading: Unit, power: int) -> str:
    """Return the unit of a term."""
    if power == 0 or (power == 1 and joint == reading):
        return "1" if power else joint.symbol
    return f"{joint}/{reading}" + (f"^{power}" if power > 1 else "")


def _maps(robot: Mechanism, units: Units) -> list[tuple[str, ...]]:
    """Return the rows of all maps; a shared one has a function in the place of a number."""
    rows = []
    table = robot.parameters
    for entry in robot.assembly.maps:
        parameter = units[table.dimensions[table.index(entry.parameter)]]
        factor, symbol = _moved(robot, entry.address, units)
        number = entry.coefficient * parameter.factor_to_si / factor
        unit = (
            "1"
            if parameter.symbol == symbol
            else f"{symbol}/{parameter}"
            if "/" not in symbol
            else f"({symbol})/{parameter}"
        )
        rows.append((entry.parameter, str(entry.address), show.number(number), unit))
    for shared in robot.assembly.shared:
        outputs = ", ".join(str(address) for address in shared.outputs)
        rows.append((" ".join(shared.inputs), outputs, type(shared).__name__, ""))
    return rows


def _moved(robot: Mechanism, address: Address, units: Units) -> tuple[float, str]:
    """Return factor to SI and symbol of what an address moves."""
    length = units[Dimension.LENGTH]
    if address.element == "transmission":
        reading = units[next(a.dimension for a in robot.actuators if a.name == address.owner)]
        joint, power = units[_joint_dimension(robot, address.owner)], POWERS.get(address.axis, 0)
        return joint.factor_to_si / reading.factor_to_si**power, _per(joint, reading, power)
    if address.axis == "pitch":
        return length.factor_to_si, f"{length}/rad"
    unit = units[Dimension.ANGLE] if address.axis in ("rx", "ry", "rz") else length
    return unit.factor_to_si, unit.symbol


def _joint_dimension(robot: Mechanism, actuator: str) -> Dimension:
    """Return the dimension of the joint that an actuator drives."""
    kinds = [
        joint.kind
        for limb in robot.assembly.limbs
        for joint in limb.joints
        if joint.actuator == actuator
    ]
    return JOINTS[kinds[0]][1] if kinds else Dimension.LENGTH


def _shown(value: float, unit: Unit) -> str:
    """Return a number in a unit, to nine digits."""
    return show.number(value / unit.factor_to_si, digits=9)
