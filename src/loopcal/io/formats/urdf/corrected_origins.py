# SPDX-License-Identifier: Apache-2.0
"""Corrected origins of a URDF: from the parameters of the robot that was read from it.

A shift d across the axis of a joint changes the xyz of its origin by R d, and a motor's zero turns
its rpy about the axis; a slide's zero shifts xyz. The rest of the text stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.findings import Quantity, report_finding
from loopcal.io.formats.program_format import (
    Exported,
    ExportSource,
    get_byte_order_mark,
    get_record,
    report_changes,
)
from loopcal.io.formats.urdf import tree as urdf_tree
from loopcal.io.formats.urdf.tree import Urdf
from loopcal.mechanism.families.limb_records import Prismatic, Revolute, matrix_from_place
from loopcal.mechanism.families.limbs import Limbs
from loopcal.mechanism.families.stages import PlacedStages
from loopcal.typing import FloatArray

PLACED = 1e-9
"""Accepted difference between the places of a joint in URDF and robot file [m, 1]."""


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the URDF with corrected origins.

    Raises
    ------
    DataError : no URDF is given. FileError : its joints have other places than the robot's.
    """
    record = get_record(
        source, (Limbs, PlacedStages), "urdf", "a robot of the family limbs or stages"
    )
    if into is None:
        raise DataError(report_finding("files.urdf-needed"))
    urdf, changes, expressed = urdf_tree.read(into), [], set()
    nominal = source.robot.parameters.nominal.tolist()
    values = zip(source.values().items(), nominal, strict=True)
    deviations = {name: value - before for (name, value), before in values}
    for name, shifts, offset in _list_origins(record, urdf):
        shift = np.array([deviations.get(parameter, 0.0) for parameter in shifts])
        zero = deviations.get(offset, 0.0)
        expressed |= {*shifts, offset}
        if not shift.any() and zero == 0.0:
            continue
        joint = urdf.places[name]
        turn = zero if joint.kind == "R" else 0.0
        R = geometry.exp_so3(turn * joint.axis)
        moved = joint.origin @ geometry.make_pose(R, shift + (zero - turn) * joint.axis)
        urdf = urdf.with_origin(name, moved, turned=turn != 0.0)
        distance = float(np.linalg.norm(moved[:3, 3] - joint.origin[:3, 3]))
        changes.append(
            report_finding(
                "files.joint-moved",
                line=joint.line,
                joint=name,
                distance=Quantity(distance * 1e3, "mm"),
                turn=Quantity(turn, "rad"),
            )
        )
    others = tuple(name for name, d in deviations.items() if d and name not in expressed)
    rest = (report_finding("files.not-expressed", format="the URDF", names=others),)
    text = get_byte_order_mark(into) + urdf.text
    findings = (*report_changes(changes), *(rest if others else ()))
    return Exported(text, findings)


def _list_origins(record: Limbs | PlacedStages, urdf: Urdf) -> Iterator[tuple[str, list[str], str]]:
    """Yield URDF joint, names of the shifts along its axes, and of the offset of its motor.

    Raises
    ------
    FileError : a limb begins at another place than in the robot file.
    """
    if isinstance(record, Limbs):
        yield from _list_limb_origins(record, urdf, "", np.eye(4))
        return
    for i, (stage, robot) in enumerate(zip(record.stages, record.robots, strict=True)):
        mount = stage.mount.matrix if i == 0 else None
        if isinstance(robot, Limbs):
            yield from _list_limb_origins(robot, urdf, f"{stage.name}.", mount)
        elif stage.joint is not None:
            drive = stage.joint.drive or stage.name
            if isinstance(drive, str) and drive in urdf.joints:
                if mount is not None:
                    _check_place(urdf, drive, mount @ matrix_from_place(stage.joint.at))
                shifts = [f"{stage.name}.{axis}" for axis in "xyz"]
                yield drive, shifts, f"{stage.name}.offset"


def _list_limb_origins(
    record: Limbs, urdf: Urdf, prefix: str, mount: FloatArray | None
) -> Iterator[tuple[str, list[str], str]]:
    """Yield the same of one robot of limbs.

    `prefix` begins the names of its parameters; mount (4, 4) is its base in the root of the URDF,
    None where another stage carries it.
    """
    named = [parameter.name for parameter in record.parameters]
    for limb in record.limbs:
        first = limb.chain[0] if limb.chain else None
        if first is not None and first.name in urdf.joints and mount is not None:
            _check_place(urdf, first.name, mount @ matrix_from_place(first.at))
        driven = (j for j in limb.chain if isinstance(j, Revolute | Prismatic))
        motors = {joint.name: joint.actuated for joint in driven if joint.actuated}
        start = f"{limb.name}."
        names = [entry.name or entry.of for entry in limb.errors] + list(motors)
        names += [n.removeprefix(start)[:-2] for n in named if n.startswith(start)]
        for name in dict.fromkeys(names):
            if name in urdf.places:
                shifts = [f"{prefix}{limb.name}.{name}.{axis}" for axis in "xyz"]
                yield name, shifts, f"{prefix}{motors.get(name) or ''}.offset"


def _check_place(urdf: Urdf, name: str, stated: FloatArray) -> None:
    """Refuse a URDF in which the first joint of a limb has another place; raises FileError."""
    joint = urdf.joints[name]
    if urdf.find_body(joint.parent) != urdf.root:
        return  # a closure carries it
    place = urdf.place_in_body(joint.parent) @ joint.origin
    # a repaired loop has its axes elsewhere, by no more than the digits of the file explain
    rounding = sum(sum(other.rounding) for other in urdf.places.values())
    if np.abs(place - stated).max() > PLACED + rounding:
        sentence = f"joint {name!r} has another place in the robot file"
        raise urdf.error(f"{sentence}; export into the URDF it was read from", name)
