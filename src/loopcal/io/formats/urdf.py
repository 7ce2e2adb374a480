# SPDX-License-Identifier: Apache-2.0
"""URDF with loop closures: read as a robot of the family limbs, and its joints' origins corrected
in the text.

The platform is the body that carries a frame (a link on a fixed joint), or the one asked for; that
frame becomes the platform frame. Unknowns are the shifts of each joint across its axis, in its own
frame, and the zeros of the motors. Written back, a shift d changes the origin's xyz by R d, and a
motor's zero turns its rpy about the axis; a slide's zero shifts xyz. Nothing else in the text
changes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError, FileError
from loopcal.io.formats import urdf_limbs, urdf_loops, urdf_tree
from loopcal.io.formats.program_format import (
    UNCHANGED,
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    byte_order_mark,
    record_of,
)
from loopcal.io.formats.urdf_limbs import Cut, oriented, other_end
from loopcal.io.formats.urdf_loops import Edge, Loops
from loopcal.io.formats.urdf_tree import Urdf
from loopcal.mechanism.families.limb_records import Prismatic, Revolute, place_matrix
from loopcal.mechanism.families.limbs import Limbs
from loopcal.typing import FloatArray

ZERO = 1e-15
"""Numbers below this are rounding and written as 0 [m, rad]."""

PLACED = 1e-9
"""How far a joint may be from where the robot file has it [m, 1]."""

COORDINATES = {"rx": "roll", "ry": "pitch", "rz": "yaw", "x": "x", "y": "y", "z": "z"}
POSE = ("x", "y", "z", "roll", "pitch", "yaw")

ROBOT = """\
# Read from {origin}, a URDF with loop closures. Limbs are called by their first joint, joints as in
# the URDF.
format: 1
family: limbs
name: {name}
source: {source}
units: {{length: m, angle: rad}}

freedoms: [{freedoms}]
controlled: [{controlled}]
actuators:
{actuators}
limbs:
{limbs}
home: {home}
"""
LIMB = """\
  - name: {name}
    chain:
{chain}
    ending: {ending}
    tip: {tip}
    attach: {attach}
    errors:
{errors}
"""


def read(path: Path, reading: ImportOptions) -> Imported:
    """Read a URDF and its closures; FileError for what is broken, does not close, or branches."""
    urdf = urdf_tree.read(path)
    closures = reading.closures or path.with_suffix(".yaml")
    if not closures.exists():
        raise FileError(
            "a URDF is a tree and says nothing of its loops; name the file of closures, as "
            "--closures loops.yaml",
            path,
        )
    loops = urdf_loops.read(urdf, closures)
    platform, frame = _platform(urdf, loops, reading.platform)
    found = urdf_limbs.cut(loops, platform)
    loops = found.loops
    T_body_frame = geometry.invert_pose(urdf.in_body(platform)) @ urdf.in_body(frame)
    motion = loops.motions()
    turns = any(name.startswith("r") for name in found.freedoms)
    home = loops.places[platform] @ T_body_frame
    twists = loops.twists(platform, home[:3, 3]) @ motion
    names = _chosen(twists, motion.shape[1])
    text = ROBOT.format(
        origin=path.name,
        name=json.dumps(reading.name),
        source=json.dumps(f"{path.name} with {closures.name}"),
        freedoms=", ".join(found.freedoms),
        controlled=", ".join(COORDINATES[name] for name in names),
        actuators="\n".join(
            f"  {json.dumps(name)}: {_drive(loops, name)}" for name in loops.motors
        ),
        limbs="".join(_limb(loops, limb, T_body_frame, turns) for limb in found.limbs),
        home=_pose(home),
    )
    return Imported(text, None, tuple(_notes(loops, found, motion.shape[1], frame)))


def write(source: ExportSource, into: Path | None) -> Exported:
    """The URDF with corrected origins; DataError without one, FileError where its joints stand
    elsewhere.
    """
    record: Limbs = record_of(source, Limbs, "urdf", "a robot of the family limbs")
    if into is None:
        raise DataError(
            "a URDF holds more than a robot file; name the one to correct, as --into robot.urdf"
        )
    urdf, notes, said = urdf_tree.read(into), [], set()
    nominal = source.robot.parameters.nominal.tolist()
    off = {
        name: value - was
        for (name, value), was in zip(source.values().items(), nominal, strict=True)
    }
    for name, names, motor in _places(record, urdf):
        shift = np.array([off.get(parameter, 0.0) for parameter in names])
        zero = off.get(f"{motor}.offset", 0.0)
        said |= {*names, f"{motor}.offset"}
        if not shift.any() and zero == 0.0:
            continue
        found = urdf.joints[name]
        turn = zero if found.kind == "R" else 0.0
        moved = found.origin @ geometry.make_pose(
            geometry.exp_so3(turn * found.axis), shift + (zero - turn) * found.axis
        )
        urdf = urdf.with_origin(name, moved, turned=turn != 0.0)
        size = float(np.linalg.norm(moved[:3, 3] - found.origin[:3, 3]))
        words = f", turned by {turn:.6g} rad" if turn else ""
        notes.append(f"line {found.line}: joint {name} moved by {size * 1e3:.6g} mm{words}")
    others = [name for name, change in off.items() if change and name not in said]
    if others:
        notes.append(
            f"not said by the URDF: {len(others)} parameters such as {others[0]}; use json or csv "
            "for them"
        )
    return Exported(byte_order_mark(into) + urdf.text, tuple(notes or [UNCHANGED]))


def _places(record: Limbs, urdf: Urdf) -> Iterator[tuple[str, list[str], str]]:
    """URDF joint, names of the shifts along its axes, and its motor; FileError where a limb begins
    elsewhere than here.
    """
    for limb in record.limbs:
        first = limb.chain[0]
        if first.name in urdf.joints:
            found = urdf.joints[first.name]
            if (
                np.abs(urdf.in_body(found.parent) @ found.origin - place_matrix(first.at)).max()
                > PLACED
            ):
                words = f"joint {first.name!r} stands elsewhere in the robot file; export into the URDF that it came from"
                raise urdf.error(words, first.name)
        motors = {
            j.name: j.actuated
            for j in limb.chain
            if isinstance(j, Revolute | Prismatic) and j.actuated
        }
        for name in dict.fromkeys([entry.name or entry.of for entry in limb.errors] + list(motors)):
            if name in urdf.joints:
                yield name, [f"{limb.name}.{name}.{axis}" for axis in "xyz"], motors.get(name) or ""


def _platform(urdf: Urdf, loops: Loops, asked: str | None) -> tuple[str, str]:
    """The platform's body, and the link whose frame is the platform frame."""
    links = {*urdf.carrier, urdf.root}
    if asked is not None:
        if asked not in links or urdf.body(asked) not in loops.bodies[1:]:
            raise FileError(
                f"--platform {asked!r} is no moving link of this URDF; name one of "
                f"{', '.join(loops.bodies[1:])}",
                urdf.path,
            )
        return urdf.body(asked), asked
    framed = [
        j.child
        for j in urdf.joints.values()
        if not j.kind and urdf.body(j.parent) in loops.bodies[1:]
    ]
    if len(framed) != 1:
        what = (
            "no moving body carries a frame"
            if not framed
            else f"{', '.join(framed)} are frames on moving bodies"
        )
        raise FileError(
            f"{what}, so the platform is not clear; name its link, as --platform {loops.bodies[-1]}",
            urdf.path,
        )
    return urdf.body(framed[0]), framed[0]


def _chosen(twists: FloatArray, mobility: int) -> list[str]:
    """Coordinates that move independently, positions first; chosen one by one by what they add."""
    chosen: list[str] = []
    for name in ("x", "y", "z", "rx", "ry", "rz"):
        rows = twists[[urdf_limbs.FREEDOMS.index(n) for n in (*chosen, name)]]
        s = np.linalg.svd(rows, compute_uv=False)
        if len(chosen) < mobility and s[-1] > 1e-3 * np.abs(twists).max():
            chosen.append(name)
    return chosen


def _drive(loops: Loops, name: str) -> str:
    joint = loops.urdf.joints[name]
    stroke = "" if joint.limits is None else f", stroke: [{joint.limits[0]!r}, {joint.limits[1]!r}]"
    return f"{{reads: {'angle' if joint.kind == 'R' else 'length'}, unknown: [offset]{stroke}}}"


def _limb(loops: Loops, limb: tuple[Edge, ...], T_body_frame: FloatArray, turns: bool) -> str:
    """One limb of the robot file; on a platform that does not turn its last joint is the point that
    it turns about.
    """
    chain, errors, body = [], [], loops.base
    pending: FloatArray = np.eye(4)
    tip: FloatArray = np.eye(4)
    path = oriented(limb, loops.base)
    for edge in path:
        forward = edge.one == body
        place = pending @ (edge.T_one if forward else edge.T_other)
        axis = edge.axis if forward else -edge.axis
        ends = edge is path[-1] and not turns
        if ends:
            tip = place
        else:
            chain.append(_joint(loops, edge, place, axis))
        if forward:
            name = f"tip, name: {json.dumps(edge.name)}" if ends else json.dumps(edge.name)
            errors.append(f"      - {{of: {name}, shift: [{', '.join(_across(axis))}]}}")
        pending = geometry.invert_pose(edge.T_other if forward else edge.T_one)
        body = other_end(edge, body)
    last = path[-1]
    attach: FloatArray = geometry.invert_pose(pending @ T_body_frame)
    if last.pin:
        # the far end of the pin, a joint of its own in the URDF
        errors.append(
            f"      - {{of: platform, name: {json.dumps(last.far)}, shift: "
            f"[{', '.join(_across(last.axis))}]}}"
        )
    elif turns:
        tip, attach = pending @ T_body_frame, np.eye(4)
    return LIMB.format(
        name=json.dumps(limb[0].name),
        chain="\n".join(chain),
        ending="rigid" if turns else "ball",
        tip=_pose(tip),
        attach=_pose(attach),
        errors="\n".join(errors),
    )


def _joint(loops: Loops, edge: Edge, place: FloatArray, axis: FloatArray) -> str:
    value = float(loops.pin_value(edge) if edge.pin else loops.values[edge.name])
    motor = f", actuated: {json.dumps(edge.name)}" if edge.name in loops.motors else ""
    words = f"{{joint: {edge.kind}, name: {json.dumps(edge.name)}, at: {_pose(place)}, axis: {_list(axis)}"
    return f"      - {words}, start: {value!r}{motor}}}"


def _across(axis: FloatArray) -> list[str]:
    """Axes of the joint's frame that are not the joint's."""
    return [a for a, part in zip("xyz", axis, strict=True) if abs(part) < 1 - 1e-9]


def _notes(loops: Loops, found: Cut, mobility: int, frame: str) -> Iterator[str]:
    residual = np.abs(loops.closure()[0]).max(initial=0.0)
    links = len(loops.urdf.carrier) + 1
    yield (
        f"{len(loops.bodies)} rigid bodies with the base (of {links} links), {len(loops.edges)} "
        "joints "
        f"({len(loops.pins)} close loops), {len(loops.motors)} motors, mobility {mobility}"
    )
    yield f"closure residual at home {residual:.1g} m; platform frame {frame}, which moves in {' '.join(found.freedoms)}"
    if found.replaced:
        yield (
            f"joints {', '.join(found.replaced)} branch from the limbs; all they do is keep the "
            "platform from turning, which "
            "the freedoms say in their place, so their origins are not identified"
        )
    if mobility != len(loops.motors):
        yield f"mobility {mobility} and {len(loops.motors)} motors differ"


def _pose(T: FloatArray) -> str:
    """A pose as a flow mapping; what is zero is left out."""
    values = [*T[:3, 3], *geometry.matrix_to_euler(T[:3, :3], "xyz")]
    shown = [
        f"{name}: {float(value)!r}"
        for name, value in zip(POSE, values, strict=True)
        if abs(value) > ZERO
    ]
    return f"{{{', '.join(shown)}}}" if shown else "[0, 0, 0]"


def _list(vector: Any) -> str:
    return f"[{', '.join(repr(float(v)) if abs(v) > ZERO else '0' for v in vector)}]"


FORMAT = Format(
    "urdf", "URDF with loop closures", (".urdf",), read, write, reads=("closures", "platform")
)
