# SPDX-License-Identifier: Apache-2.0
"""URDF with loop closures: read as a robot of the family limbs; its joint origins are corrected.

The platform is the body that carries a frame (a link on a fixed joint), or the one that the options
name; that frame becomes the platform frame. Parameters are the shifts of each joint across its
axis, in its own frame, and the zeros of the motors. Written back, a shift d changes the origin's
xyz by R d, and a motor's zero turns its rpy about the axis; a slide's zero shifts xyz. The rest of
the text stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError, FileError, MechanismError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.io.core.read_back import require_same, require_same_numbers
from loopcal.io.core.yaml_text import quote_scalar
from loopcal.io.formats import urdf_tree
from loopcal.io.formats.program_format import (
    Exported,
    ExportSource,
    Format,
    Imported,
    ImportOptions,
    format_head,
    get_byte_order_mark,
    get_record,
    report_changes,
)
from loopcal.io.formats.urdf_tree import Urdf, read_joint_graph
from loopcal.mechanism.families.limb_records import Prismatic, Revolute, matrix_from_place
from loopcal.mechanism.families.limbs import Limbs
from loopcal.mechanism.joint_graph import (
    GraphJoint,
    JointGraph,
    LimbPaths,
    choose_coordinates,
    find_limb_paths,
    get_other_body,
    orient_path,
)
from loopcal.typing import FloatArray

ZERO = 1e-15
"""Numbers below this are rounding and written as 0 [m, rad]."""

PLACED = 1e-9
"""Accepted difference between the places of a joint in URDF and robot file [m, 1]."""

COORDINATES = {"rx": "roll", "ry": "pitch", "rz": "yaw", "x": "x", "y": "y", "z": "z"}
POSE = ("x", "y", "z", "roll", "pitch", "yaw")

REMARK = "Limbs are named after their first joint, joints as in the URDF."
ROBOT = """\
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


def read(path: Path, options: ImportOptions) -> Imported:
    """Read a URDF and its closures.

    Raises
    ------
    FileError : the file is not valid, its loops do not close, or its limbs branch.
    """
    urdf = urdf_tree.read(path)
    closures = options.closures or path.with_suffix(".yaml")
    if not closures.exists():
        raise FileError(report_finding("files.closures-missing"), path)
    graph = read_joint_graph(urdf, closures)
    platform, frame = _find_platform(urdf, graph, options.platform)
    try:
        paths = find_limb_paths(graph, platform)
    except MechanismError as error:
        finding = error.args[0]
        joints = finding.data.get("joints", ("",))
        raise urdf.error(finding, joints[-1]) from None
    graph = paths.graph
    T_body_frame = geometry.invert_pose(urdf.place_in_body(platform)) @ urdf.place_in_body(frame)
    motion = graph.motions()
    turns = any(name.startswith("r") for name in paths.freedoms)
    home = graph.places[platform] @ T_body_frame
    coordinates = choose_coordinates(graph.twists(platform, home[:3, 3]) @ motion)
    drives = (f"  {quote_scalar(name)}: {_format_drive(urdf, name)}" for name in graph.motors)
    what = f"a URDF with loop closures in {closures.name}"
    head = format_head(path, what, "limbs", options.name, ("m", "rad"), REMARK)
    text = head + ROBOT.format(
        freedoms=", ".join(paths.freedoms),
        controlled=", ".join(COORDINATES[name] for name in coordinates),
        actuators="\n".join(drives),
        limbs="".join(_format_limb(graph, limb, T_body_frame, turns) for limb in paths.limbs),
        home=_format_pose(home),
    )
    return Imported(text, None, tuple(_report_structure(urdf, paths, motion.shape[1], frame)))


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the URDF with corrected origins.

    Raises
    ------
    DataError : no URDF is given. FileError : its joints have other places than the robot's.
    """
    record: Limbs = get_record(source, Limbs, "urdf", "a robot of the family limbs")
    if into is None:
        raise DataError(report_finding("files.urdf-needed"))
    urdf, changes, expressed = urdf_tree.read(into), [], set()
    nominal = source.robot.parameters.nominal.tolist()
    values = zip(source.values().items(), nominal, strict=True)
    deviations = {name: value - before for (name, value), before in values}
    for name, shifts, motor in _list_origins(record, urdf):
        shift = np.array([deviations.get(parameter, 0.0) for parameter in shifts])
        zero = deviations.get(f"{motor}.offset", 0.0)
        expressed |= {*shifts, f"{motor}.offset"}
        if not shift.any() and zero == 0.0:
            continue
        joint = urdf.joints[name]
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
    return Exported(text, partial(_check_written, urdf=urdf), findings)


def _check_written(path: Path, urdf: Urdf) -> None:
    """Read a written URDF; raise LoopcalError where its joints have other places."""
    read = urdf_tree.read(path)
    require_same("joints", list(urdf.joints), list(read.joints))
    for name, joint in urdf.joints.items():
        require_same_numbers(f"origin of {name}", joint.origin, read.joints[name].origin)
    require_same("the text is complete", True, read.text == urdf.text)


def _list_origins(record: Limbs, urdf: Urdf) -> Iterator[tuple[str, list[str], str]]:
    """Yield URDF joint, names of the shifts along its axes, and its motor.

    Raises
    ------
    FileError : a limb begins at another place than in the robot file.
    """
    for limb in record.limbs:
        first = limb.chain[0]
        if first.name in urdf.joints:
            joint = urdf.joints[first.name]
            place = urdf.place_in_body(joint.parent) @ joint.origin
            if np.abs(place - matrix_from_place(first.at)).max() > PLACED:
                sentence = f"joint {first.name!r} has another place in the robot file"
                raise urdf.error(f"{sentence}; export into the URDF it was read from", first.name)
        driven = (j for j in limb.chain if isinstance(j, Revolute | Prismatic))
        motors = {joint.name: joint.actuated for joint in driven if joint.actuated}
        names = [entry.name or entry.of for entry in limb.errors] + list(motors)
        for name in dict.fromkeys(names):
            if name in urdf.joints:
                shifts = [f"{limb.name}.{name}.{axis}" for axis in "xyz"]
                yield name, shifts, motors.get(name) or ""


def _find_platform(urdf: Urdf, graph: JointGraph, name: str | None) -> tuple[str, str]:
    """Return the platform's body, and the link whose frame is the platform frame."""
    moving = graph.bodies[1:]
    if name is not None:
        body = urdf.find_body(name) if name in {*urdf.carrier, urdf.root} else None
        if body not in moving:
            finding = report_finding("files.platform-unknown", platform=name, links=moving)
            raise FileError(finding, urdf.path)
        return str(body), name
    fixed = (joint for joint in urdf.joints.values() if not joint.kind)
    frames = tuple(joint.child for joint in fixed if urdf.find_body(joint.parent) in moving)
    if len(frames) != 1:
        finding = report_finding("files.platform-unclear", frames=frames, links=moving)
        raise FileError(finding, urdf.path)
    return urdf.find_body(frames[0]), frames[0]


def _format_drive(urdf: Urdf, name: str) -> str:
    """Return one drive of the robot file."""
    joint = urdf.joints[name]
    stroke = "" if joint.limits is None else f", stroke: [{joint.limits[0]!r}, {joint.limits[1]!r}]"
    return f"{{reads: {'angle' if joint.kind == 'R' else 'length'}, unknown: [offset]{stroke}}}"


def _format_limb(
    graph: JointGraph, limb: tuple[GraphJoint, ...], T_body_frame: FloatArray, turns: bool
) -> str:
    """Return one limb of the robot file.

    On a platform that does not turn, its last joint is the point that it turns about.
    """
    chain, errors, body = [], [], graph.base
    pending: FloatArray = np.eye(4)
    tip: FloatArray = np.eye(4)
    path = orient_path(limb, graph.base)
    for joint in path:
        forward = joint.body_a == body
        place = pending @ (joint.T_a if forward else joint.T_b)
        axis = joint.axis if forward else -joint.axis
        is_tip = joint is path[-1] and not turns
        if is_tip:
            tip = place
        else:
            chain.append(_format_joint(graph, joint, place, axis))
        if forward:
            name = f"tip, name: {quote_scalar(joint.name)}" if is_tip else quote_scalar(joint.name)
            errors.append(f"      - {{of: {name}, shift: [{_list_across(axis)}]}}")
        pending = geometry.invert_pose(joint.T_b if forward else joint.T_a)
        body = get_other_body(joint, body)
    last = path[-1]
    attach: FloatArray = geometry.invert_pose(pending @ T_body_frame)
    if last.is_pin:
        # the far end of the pin, a joint of its own in the URDF
        far = f"of: platform, name: {quote_scalar(last.far)}"
        errors.append(f"      - {{{far}, shift: [{_list_across(last.axis)}]}}")
    elif turns:
        tip, attach = pending @ T_body_frame, np.eye(4)
    return LIMB.format(
        name=quote_scalar(limb[0].name),
        chain="\n".join(chain),
        ending="rigid" if turns else "ball",
        tip=_format_pose(tip),
        attach=_format_pose(attach),
        errors="\n".join(errors),
    )


def _format_joint(graph: JointGraph, joint: GraphJoint, place: FloatArray, axis: FloatArray) -> str:
    """Return one joint of a limb."""
    start = float(graph.get_pin_angle(joint) if joint.is_pin else graph.values[joint.name])
    motor = f", actuated: {quote_scalar(joint.name)}" if joint.name in graph.motors else ""
    head = f"joint: {joint.kind}, name: {quote_scalar(joint.name)}"
    where = f"at: {_format_pose(place)}, axis: {_format_list(axis)}"
    return f"      - {{{head}, {where}, start: {start!r}{motor}}}"


def _list_across(axis: FloatArray) -> str:
    """Return the axes of the joint's frame that are not the joint's."""
    return ", ".join(a for a, part in zip("xyz", axis, strict=True) if abs(part) < 1 - 1e-9)


def _report_structure(urdf: Urdf, paths: LimbPaths, mobility: int, frame: str) -> Iterator[Finding]:
    """Yield the size of the mechanism, its home, and what the robot file does not express."""
    graph = paths.graph
    yield report_finding(
        "files.urdf-structure",
        bodies=len(graph.bodies),
        links=len(urdf.carrier) + 1,
        joints=len(graph.joints),
        loops=len(graph.pins),
        motors=len(graph.motors),
        mobility=mobility,
    )
    residual = float(np.abs(graph.linearize_closure()[0]).max(initial=0.0))
    yield report_finding(
        "files.urdf-home", residual=f"{residual:.1g} m", frame=frame, freedoms=paths.freedoms
    )
    if paths.replaced:
        yield report_finding("files.joints-replaced", joints=paths.replaced)
    if mobility != len(graph.motors):
        yield report_finding("files.motors-differ", mobility=mobility, motors=len(graph.motors))


def _format_pose(T: FloatArray) -> str:
    """Return a pose as a flow mapping without zeros."""
    values = [*T[:3, 3], *geometry.matrix_to_euler(T[:3, :3], "xyz")]
    pairs = zip(POSE, values, strict=True)
    shown = [f"{name}: {float(value)!r}" for name, value in pairs if abs(value) > ZERO]
    return f"{{{', '.join(shown)}}}" if shown else "[0, 0, 0]"


def _format_list(vector: Any) -> str:
    return f"[{', '.join(repr(float(v)) if abs(v) > ZERO else '0' for v in vector)}]"


FORMAT = Format(
    "urdf",
    "URDF with loop closures",
    (".urdf",),
    read,
    write,
    read_options=("closures", "platform"),
)
