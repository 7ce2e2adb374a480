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
from loopcal.io.formats.urdf_closures import UrdfMechanism, read_mechanism
from loopcal.io.formats.urdf_limbs import format_limb, format_pose
from loopcal.io.formats.urdf_tree import Urdf
from loopcal.mechanism.families.limb_records import Prismatic, Revolute, matrix_from_place
from loopcal.mechanism.families.limbs import Limbs
from loopcal.mechanism.joint_graph import (
    LimbPaths,
    choose_coordinates,
    count_repeated_closures,
    find_limb_paths,
    list_nearby,
    list_possible_platforms,
)
from loopcal.typing import FloatArray

LARGE = 30.0
"""Largest distance of two joints of a link that is plausible [m]; URDF has no other unit."""

MIMICS = 1e-9
"""Largest difference between a joint and the one that it mimics [rad, m]."""

PLACED = 1e-9
"""Accepted difference between the places of a joint in URDF and robot file [m, 1]."""

COORDINATES = {"rx": "roll", "ry": "pitch", "rz": "yaw", "x": "x", "y": "y", "z": "z"}

REMARK = "Limbs are named after their first joint, joints as in the URDF."
ROBOT = """\
freedoms: [{freedoms}]
controlled: [{controlled}]
actuators:
{actuators}
limbs:
{limbs}
{parameters}home: {home}
"""


def read(path: Path, options: ImportOptions) -> Imported:
    """Read a URDF and its closures.

    Raises
    ------
    FileError : the file is not valid, its loops do not close, or its limbs branch.
    """
    urdf = urdf_tree.read(path)
    closures: Path | None = options.closures or path.with_suffix(".yaml")
    assert closures is not None
    if options.closures is None and not closures.exists():
        if not urdf.constraints:
            raise FileError(report_finding("files.closures-missing"), path)
        closures = None
    mechanism = read_mechanism(urdf, closures)
    platform, frame = _find_platform(mechanism, options.platform)
    try:
        paths = find_limb_paths(mechanism.graph, platform)
    except MechanismError as error:
        finding = error.args[0]
        joints = finding.data.get("joints", ("",))
        raise urdf.error(finding, joints[-1]) from None
    graph, T_body_frame = paths.graph, mechanism.locate(frame)[1]
    _check_mimics(urdf, paths)
    motion = graph.find_motions(paths.home)
    twists = graph.find_twists(paths.home, platform, T_body_frame)
    home = graph.get_place(graph.place(paths.home[None]), platform)[0] @ T_body_frame
    drives = (f"  {quote_scalar(name)}: {_format_drive(urdf, name)}" for name in graph.motors)
    closing = closures.name if closures is not None else "its constraints"
    what = f"a URDF with loop closures in {closing}"
    limbs = [format_limb(paths, limb, T_body_frame) for limb in paths.limbs]
    parameters = "".join(limb.parameters for limb in limbs)
    head = format_head(path, what, "limbs", options.name, ("m", "rad"), REMARK)
    text = head + ROBOT.format(
        freedoms=", ".join(paths.freedoms),
        controlled=", ".join(COORDINATES[n] for n in choose_coordinates(twists @ motion)),
        actuators="\n".join(drives),
        limbs="".join(limb.text for limb in limbs),
        parameters=f"parameters:\n{parameters}\n" if parameters else "",
        home=format_pose(home),
    )
    return Imported(text, None, tuple(_report_structure(mechanism, paths, frame)))


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
    return Exported(text, partial(_check_written, urdf=urdf), findings)


def _check_written(path: Path, urdf: Urdf) -> None:
    """Read a written URDF; raise LoopcalError where its joints have other places."""
    read = urdf_tree.read(path)
    require_same("joints", list(urdf.joints), list(read.joints))
    for name, place in urdf.places.items():
        require_same_numbers(f"origin of {name}", place.origin, read.places[name].origin)
    require_same("the text is complete", True, read.text == urdf.text)


def _list_origins(record: Limbs, urdf: Urdf) -> Iterator[tuple[str, list[str], str]]:
    """Yield URDF joint, names of the shifts along its axes, and its motor.

    Raises
    ------
    FileError : a limb begins at another place than in the robot file.
    """
    named = [parameter.name for parameter in record.parameters]
    for limb in record.limbs:
        first = limb.chain[0] if limb.chain else None
        if first is not None and first.name in urdf.joints:
            _check_place(urdf, first.name, matrix_from_place(first.at))
        driven = (j for j in limb.chain if isinstance(j, Revolute | Prismatic))
        motors = {joint.name: joint.actuated for joint in driven if joint.actuated}
        prefix = f"{limb.name}."
        names = [entry.name or entry.of for entry in limb.errors] + list(motors)
        names += [n.removeprefix(prefix)[:-2] for n in named if n.startswith(prefix)]
        for name in dict.fromkeys(names):
            if name in urdf.places:
                shifts = [f"{limb.name}.{name}.{axis}" for axis in "xyz"]
                yield name, shifts, motors.get(name) or ""


def _check_place(urdf: Urdf, name: str, stated: FloatArray) -> None:
    """Refuse a URDF in which the first joint of a limb has another place; raises FileError."""
    joint = urdf.joints[name]
    if urdf.find_body(joint.parent) != urdf.root:
        return  # a closure carries it
    place = urdf.place_in_body(joint.parent) @ joint.origin
    if np.abs(place - stated).max() > PLACED:
        sentence = f"joint {name!r} has another place in the robot file"
        raise urdf.error(f"{sentence}; export into the URDF it was read from", name)


def _find_platform(mechanism: UrdfMechanism, name: str | None) -> tuple[str, str]:
    """Return the platform's body, and the link whose frame is the platform frame.

    It is the link that is named; else the only frame (a link on a fixed joint that closes no loop)
    on a moving body, of several the only one on a body that limbs join to the base; else that body.
    """
    urdf, graph = mechanism.urdf, mechanism.graph
    moving = graph.bodies[1:]
    possible = list_possible_platforms(graph)
    links = tuple(link for body in possible or moving for link in mechanism.list_links(body))
    if name is not None:
        known = name in {*urdf.carrier, urdf.root}
        body = mechanism.locate(name)[0] if known else None
        if body not in moving:
            finding = report_finding("files.platform-unknown", platform=name, links=links)
            raise FileError(finding, urdf.path)
        return str(body), name
    fixed = (joint.child for joint in urdf.joints.values() if not joint.kind)
    frames = [link for link in fixed if link not in mechanism.frames]
    frames = [link for link in frames if mechanism.locate(link)[0] in moving]
    suited = [link for link in frames if mechanism.locate(link)[0] in possible]
    chosen = frames if len(frames) == 1 else suited
    if len(chosen) == 1:
        return mechanism.locate(chosen[0])[0], chosen[0]
    if not chosen and len(possible) == 1:
        return possible[0], mechanism.list_links(possible[0])[0]
    finding = report_finding("files.platform-unclear", frames=tuple(frames), links=links)
    raise FileError(finding, urdf.path)


def _check_mimics(urdf: Urdf, paths: LimbPaths) -> None:
    """Refuse a joint that mimics another where the loops do not make it so; raises FileError."""
    graph = paths.graph
    near = list_nearby(graph, paths.home)
    for joint in urdf.joints.values():
        if joint.mimic is None or joint.name in paths.dangling or not joint.kind:
            continue
        followed, factor, offset = joint.mimic
        if {joint.name, followed} <= {*graph.names}:
            i, j = graph.names.index(joint.name), graph.names.index(followed)
            gap = near[:, i] - factor * near[:, j] - offset
            turns = np.round(gap[0] / (2 * np.pi)) * 2 * np.pi if joint.kind == "R" else 0.0
            if len(near) > 1 and np.abs(gap - turns).max() < MIMICS:
                continue
        finding = report_finding("files.joint-mimics", joint=joint.name, followed=followed)
        raise urdf.error(finding, joint.name)


def _format_drive(urdf: Urdf, name: str) -> str:
    """Return one drive of the robot file."""
    joint = urdf.joints[name]
    stroke = "" if joint.limits is None else f", stroke: [{joint.limits[0]!r}, {joint.limits[1]!r}]"
    return f"{{reads: {'angle' if joint.kind == 'R' else 'length'}, unknown: [offset]{stroke}}}"


def _report_structure(mechanism: UrdfMechanism, paths: LimbPaths, frame: str) -> Iterator[Finding]:
    """Yield the size of the mechanism, its home, and what the robot file does not express."""
    graph, motions = paths.graph, paths.motions
    yield report_finding(
        "files.urdf-structure",
        bodies=len(graph.bodies),
        links=len(mechanism.urdf.carrier) + 1,
        joints=len(graph.joints),
        loops=len(graph.closing),
        motors=len(graph.motors),
        mobility=motions.mobility,
    )
    residual = float(np.abs(graph.linearize(paths.home[None])[0]).max(initial=0.0)) * graph.size
    yield report_finding(
        "files.urdf-home", residual=f"{residual:.1g} m", frame=frame, freedoms=paths.freedoms
    )
    if graph.size > LARGE:
        yield report_finding("files.urdf-large", size=Quantity(graph.size, "m"))
    if motions.idle:
        yield report_finding("files.idle-motions", count=motions.idle, joints=motions.moved)
    if paths.dangling:
        yield report_finding("files.joints-dangling", joints=paths.dangling)
    if paths.replaced:
        yield report_finding("files.joints-replaced", joints=paths.replaced)
    if motions.mobility != len(graph.motors):
        yield report_finding(
            "files.motors-differ",
            mobility=motions.mobility,
            motors=len(graph.motors),
            repeated=count_repeated_closures(graph, paths.home),
        )


FORMAT = Format(
    "urdf",
    "URDF with loop closures",
    (".urdf",),
    read,
    write,
    read_options=("closures", "platform"),
)
