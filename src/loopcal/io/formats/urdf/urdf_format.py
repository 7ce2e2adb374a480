# SPDX-License-Identifier: Apache-2.0
"""URDF with loop closures: read as a robot of the family limbs; its joint origins are corrected.

The platform is the body that carries a frame (a link on a fixed joint), or the one that the options
name; that frame becomes the platform frame. Parameters are the shifts of each joint across its
axis, in its own frame, and the zeros of the motors. Written back, a shift d changes the origin's
xyz by R d, and a motor's zero turns its rpy about the axis; a slide's zero shifts xyz. The rest of
the text stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError, FileError, MechanismError
from loopcal.findings import Finding, Quantity, report_finding
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
from loopcal.io.formats.urdf import tree as urdf_tree
from loopcal.io.formats.urdf.closures import UrdfMechanism, read_mechanism
from loopcal.io.formats.urdf.robot_text import (
    choose_family,
    choose_link,
    format_robot,
    list_stage_names,
)
from loopcal.io.formats.urdf.tree import Urdf
from loopcal.mechanism.families.limb_records import Prismatic, Revolute, matrix_from_place
from loopcal.mechanism.families.limbs import Limbs
from loopcal.mechanism.families.stages import PlacedStages
from loopcal.mechanism.joint_graph.loops import count_repeated_closures, list_nearby
from loopcal.mechanism.joint_graph.paths import (
    ClosedStage,
    StagePaths,
    find_stage_paths,
    list_possible_platforms,
)
from loopcal.typing import FloatArray

# Corrected origins of a URDF: from the parameters of the robot that was read from it.

PLACED = 1e-9
"""Accepted difference between the places of a joint in URDF and robot file [m, 1]."""


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the URDF with corrected origins; DataError where none is given, FileError where its
    joints have other places.
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
    """Yield URDF joint, names of the shifts along its axes, and of the offset of its motor;
    FileError where a limb begins at another place than in the robot file.
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
    """Yield the same of one robot of limbs; `prefix` begins the names of its parameters, mount (4,
    4) is its base in the root of the URDF, None where another stage carries it.
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


LARGE = 30.0
"""Largest distance of two joints of a link that is plausible [m]; URDF has no other unit."""

MIMICS = 1e-9
"""Largest difference between a joint and the one that it mimics [rad, m]."""

REMARKS = {
    "limbs": "Limbs are named after their first joint, joints as in the URDF.",
    "stages": "Stages are named after their joint, those with loops after the link that they "
    "carry, limbs after their first joint, joints as in the URDF.",
}
"""What people should know about the names, by the family of the robot file."""


def read(path: Path, options: ImportOptions) -> Imported:
    """Read a URDF and its closures; FileError where it is not valid, its loops do not close, or
    its limbs branch.
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

    def locate_frame(body: str) -> FloatArray:
        return mechanism.locate(frame if body == platform else choose_link(mechanism, body))[1]

    try:
        paths = find_stage_paths(
            mechanism.graph, platform, locate_frame, mechanism.measure_rounding
        )
        if paths.outside and options.platform is None:
            finding = report_finding(
                "files.motors-outside", motors=paths.outside, platform=platform
            )
            raise MechanismError(finding)
    except MechanismError as error:
        finding = _name_links(mechanism, error.args[0])
        raise urdf.error(finding, _find_origin(urdf, finding.data.get("joints", ()))) from None
    _check_mimics(urdf, paths)
    closing = closures.name if closures is not None else "its constraints"
    what = f"a URDF with loop closures in {closing}"
    family = choose_family(paths)
    remark = REMARKS[family]
    head = format_head(path, what, family, options.name, ("m", "rad"), remark)
    text = head + format_robot(mechanism, paths, frame)
    findings = tuple(_report_structure(mechanism, paths, frame))
    return Imported(text, None, findings, _doubt_closures(mechanism, paths))


def _doubt_closures(mechanism: UrdfMechanism, paths: StagePaths) -> Finding | None:
    """Return that rigid closures probably stand for pins, where motors exceed the mobility."""
    motors, mobility = len(paths.graph.motors), paths.motions.mobility
    if not mechanism.rigid_closures or motors <= mobility:
        return None
    return report_finding(
        "files.closure-rigid", closures=mechanism.rigid_closures, motors=motors, mobility=mobility
    )


def _find_platform(mechanism: UrdfMechanism, name: str | None) -> tuple[str, str]:
    """Return the platform's body, and the link whose frame is the platform frame.

    It is the link that is named; else the only frame (a link on a fixed joint that closes no loop)
    on a moving body, of several the only one on a body at an end of the mechanism that limbs join
    to what carries it; else that body. Several ends, such as the feet of a humanoid, are listed.
    """
    urdf, graph = mechanism.urdf, mechanism.graph
    moving = graph.bodies[1:]
    fixed = (joint.child for joint in urdf.joints.values() if not joint.kind)
    frames = [link for link in fixed if link not in mechanism.frames]
    frames = [link for link in frames if mechanism.locate(link)[0] in moving]
    possible = list_possible_platforms(graph)
    suited = [link for link in frames if mechanism.locate(link)[0] in possible]
    named = {mechanism.locate(link)[0] for link in suited}
    # of each possible body its frames, or its link
    others = (choose_link(mechanism, body) for body in possible or moving if body not in named)
    links = (*suited, *others)
    if name is not None:
        known = name in {*urdf.carrier, urdf.root}
        body = mechanism.locate(name)[0] if known else None
        if body not in moving:
            finding = report_finding("files.platform-unknown", platform=name, links=links)
            raise FileError(finding, urdf.path)
        return str(body), name
    chosen = frames if len(frames) == 1 else suited
    if len(chosen) == 1:
        return mechanism.locate(chosen[0])[0], chosen[0]
    if not chosen and len(possible) == 1:
        return possible[0], choose_link(mechanism, possible[0])
    finding = report_finding("files.platform-unclear", frames=tuple(frames), links=links)
    raise FileError(finding, urdf.path)


def _find_origin(urdf: Urdf, names: Sequence[str]) -> str:
    """Return the last joint of the file among joints of a mechanism; empty where there is none.

    Parts of a replaced joint end in _X, _Y or _Z; a closure has the name of a link.
    """
    for name in reversed(names):
        carrier = urdf.carrier.get(name)
        for joint in (name, name[:-2], carrier.name if carrier is not None else ""):
            if joint in urdf.places:
                return joint
    return ""


def _name_links(mechanism: UrdfMechanism, finding: Finding) -> Finding:
    """Return a refusal that names the links of the file instead of the bodies that they form."""
    bodies = {"body", "body_a", "body_b", "platform"}
    data = {
        key: choose_link(mechanism, value) if key in bodies else value
        for key, value in finding.data.items()
    }
    if "platforms" in data:
        data["platforms"] = tuple(choose_link(mechanism, body) for body in data["platforms"])
    return replace(finding, data=data)


def _check_mimics(urdf: Urdf, paths: StagePaths) -> None:
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


def _report_structure(mechanism: UrdfMechanism, paths: StagePaths, frame: str) -> Iterator[Finding]:
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
    repair = paths.repair
    if repair.gap or repair.angle:
        yield report_finding(
            "files.loops-rounded",
            gap=Quantity(repair.gap * 1e3, "mm"),
            angle=Quantity(repair.angle, "rad"),
            turn=Quantity(repair.turn, "rad"),
        )
    if len(paths.stages) > 1:
        names = list_stage_names(mechanism, paths)
        loops = (isinstance(stage, ClosedStage) for stage in paths.stages)
        closed = tuple(name for name, is_loop in zip(names, loops, strict=True) if is_loop)
        yield report_finding("files.urdf-stages", count=len(names), stages=names, closed=closed)
    if graph.size > LARGE:
        yield report_finding("files.urdf-large", size=Quantity(graph.size, "m"))
    if motions.idle:
        yield report_finding("files.idle-motions", count=motions.idle, joints=motions.moved)
    if paths.outside:
        yield report_finding("files.motors-left-out", motors=paths.outside, frame=frame)
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
