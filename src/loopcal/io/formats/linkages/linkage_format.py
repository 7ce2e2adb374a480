# SPDX-License-Identifier: Apache-2.0
"""Files of links and joints: read as a robot of limbs or stages; their origins are corrected.

The platform is the body that carries a frame (a link on a fixed joint), or the one that the options
name; that frame becomes the platform frame. Parameters are the shifts of each joint across its
axis, in its own frame, and the zeros of the motors. Written back, a shift d changes the place of an
origin by R d, and a motor's zero turns it about the axis; a slide's zero shifts it. The rest of the
text stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError, FileError, MechanismError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.io.core.yaml_file import format_yaml
from loopcal.io.formats.linkages.closures import Linkage, find_closures, read_mechanism
from loopcal.io.formats.linkages.tree import Constraint, LinkTree, TreeJoint, derive_end
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
from loopcal.mechanism.assembly import BASE, PLATFORM
from loopcal.mechanism.families.limbs import Limbs, Prismatic, Revolute, matrix_from_place
from loopcal.mechanism.families.stages import PlacedStages
from loopcal.mechanism.joint_graph.graph import GraphJoint, choose_coordinates
from loopcal.mechanism.joint_graph.loops import JointGraph, count_repeated_closures, get_value
from loopcal.mechanism.joint_graph.paths import (
    ClosedStage,
    GraphLimb,
    SerialStage,
    StagePaths,
    find_stage_paths,
    list_possible_platforms,
)
from loopcal.typing import FloatArray

# Corrected origins of a file: from the parameters of the robot that was read from it.

PLACED = 1e-9
"""Accepted difference between the places of a joint in the file and the robot file [m, 1]."""


def make_format(
    what: str, about: str, endings: tuple[str, ...], read_tree: Callable[[Path], LinkTree]
) -> Format:
    """Return the format of files that `read_tree` reads; `what` is one of them: "an SDF"."""
    name = what.rsplit(maxsplit=1)[-1]

    def read_file(path: Path, options: ImportOptions) -> Imported:
        return read(read_tree(path), options, what)

    def write_file(source: ExportSource, into: Path | None) -> Exported:
        return write(source, into, read_tree, name)

    used = {"closures": "", "platform": ""}
    return Format(name.lower(), about, endings, read_file, write_file, read_options=used)


def write(
    source: ExportSource, into: Path | None, read_tree: Callable[[Path], LinkTree], what: str
) -> Exported:
    """Return the file with corrected origins; DataError where none is given, FileError where its
    joints have other places.
    """
    families = Limbs, PlacedStages
    record = get_record(source, families, what.lower(), "a robot of the family limbs or stages")
    if into is None:
        raise DataError.of("files.urdf-needed")
    tree, changes, expressed = read_tree(into), [], set()
    nominal = source.robot.parameters.nominal.tolist()
    values = zip(source.values().items(), nominal, strict=True)
    deviations = {name: value - before for (name, value), before in values}
    origins: dict[str, FloatArray] = {}
    for place, shifts, offsets in _list_origins(record, tree):
        shift = np.array([deviations.get(parameter, 0.0) for parameter in shifts])
        zero = sum(share * deviations.get(offset, 0.0) for offset, share in offsets.items())
        expressed |= {*shifts, *offsets}
        if not shift.any() and zero == 0.0:
            continue
        joint = tree.places[place]
        turn = zero if joint.kind == "R" else 0.0
        R = geometry.exp_so3(turn * joint.axis)
        moved = joint.origin @ geometry.make_pose(R, shift + (zero - turn) * joint.axis)
        origins[place] = moved
        distance = float(np.linalg.norm(moved[:3, 3] - joint.origin[:3, 3]))
        changes.append(
            report_finding(
                "files.joint-moved",
                line=joint.line,
                joint=place,
                distance=Quantity(distance * 1e3, "mm"),
                turn=Quantity(turn, "rad"),
            )
        )
    others = tuple(name for name, d in deviations.items() if d and name not in expressed)
    rest = (report_finding("files.not-expressed", format=f"the {what}", names=others),)
    moved = tree.with_origins(origins)
    if origins and any(constraint.derived for constraint in tree.constraints):
        moved = _draw_closed(moved, [actuator.name for actuator in source.robot.actuators])
    text = tree.rewrite(tree, moved) if origins else tree.text
    findings = (*report_changes(changes), *(rest if others else ()))
    return Exported(get_byte_order_mark(into) + text, findings)


def _draw_closed(moved: LinkTree, motors: Sequence[str]) -> LinkTree:
    """Return a tree that is drawn with its loops closed, and all motors at zero.

    One end of a derived constraint is where the drawn pose puts it. So the pose in which these
    constraints are closed becomes the drawn one: only the zeros of passive joints differ, and the
    first axis of a universal joint, which is written in the frame of its child.
    """
    tree = replace(moved, motors=dict.fromkeys(motors, 0))
    mechanism = read_mechanism(tree, find_closures(tree.path))
    names = [constraint.name for constraint in moved.constraints if constraint.derived]
    derived = {f"{name}{part}" for name in names for part in ("", "_1", "_2")}
    closing = tuple(joint for joint in mechanism.graph.closing if joint.name in derived)
    graph = replace(mechanism.graph, closing=closing)
    q = graph.close(np.zeros((1, len(graph.tree))), graph.is_driven)
    if not np.isfinite(q).all():
        raise moved.error(report_finding("files.drawn-open"), "")
    placement, links = graph.place(q), {}
    for link in (moved.root, *moved.carrier):
        body, T = mechanism.locate(link)
        if body in graph.bodies:
            links[link] = graph.get_place(placement, body)[0] @ T

    def draw(joint: TreeJoint) -> TreeJoint:
        T = geometry.invert_pose(links[joint.parent]) @ links[joint.child]
        if np.abs(T - joint.origin).max() < ZERO:
            return joint
        axis = T[:3, :3].T @ joint.origin[:3, :3] @ joint.axis
        return replace(joint, origin=T, axis=axis if joint.kind == "U" else joint.axis)

    def derive(constraint: Constraint) -> Constraint:
        near, far = constraint.ends
        if not constraint.derived or not {near.parent, far.parent} <= links.keys():
            return constraint
        T = derive_end(links, near.parent, far.parent, far.origin)
        axis = T[:3, :3].T @ near.origin[:3, :3] @ constraint.axes[0]
        axes = (axis if constraint.kind == "U" else constraint.axes[0], constraint.axes[1])
        return replace(constraint, ends=(replace(near, origin=T), far), axes=axes)

    joints = moved.joints.values()
    known = [j for j in joints if j.kind and {j.parent, j.child} <= links.keys()]
    constraints = tuple(map(derive, moved.constraints))
    return replace(moved.with_joints(map(draw, known)), constraints=constraints)


def _list_origins(
    record: Limbs | PlacedStages, tree: LinkTree
) -> Iterator[tuple[str, list[str], Mapping[str, float]]]:
    """Yield URDF joint, names of the shifts along its axes, and offsets that change its zero, each
    with the change per unit; FileError where a limb begins at another place than in the robot file.
    """
    if isinstance(record, Limbs):
        yield from _list_limb_origins(record, tree, "", np.eye(4))
        return
    for i, (stage, robot) in enumerate(zip(record.stages, record.robots, strict=True)):
        mount = stage.mount.matrix if i == 0 else None
        if isinstance(robot, Limbs):
            yield from _list_limb_origins(robot, tree, f"{stage.name}.", mount)
        elif stage.joint is not None:
            drive = stage.joint.drive or stage.name
            if isinstance(drive, str) and drive in tree.joints:
                if mount is not None:
                    _check_place(tree, drive, mount @ matrix_from_place(stage.joint.at))
                shifts = [f"{stage.name}.{axis}" for axis in "xyz"]
                yield drive, shifts, {f"{stage.name}.offset": 1.0}


def _list_limb_origins(
    record: Limbs, tree: LinkTree, prefix: str, mount: FloatArray | None
) -> Iterator[tuple[str, list[str], Mapping[str, float]]]:
    """Yield the same of one robot of limbs; `prefix` begins the names of its parameters, mount (4,
    4) is its base in the root of the URDF, None where another stage carries it.
    """
    named = [parameter.name for parameter in record.parameters]
    coupled: dict[str, Mapping[str, float]] = {}
    for key, coupling in record.couplings.items():
        weights = {**coupling.sum, **getattr(coupling, "radius", {})}
        for joint in [name for name in weights if name.endswith(f".{key}")]:
            own = weights.pop(joint)
            coupled[joint] = {key: 1 / own} | {name: -w / own for name, w in weights.items()}
    for limb in record.limbs:
        first = limb.chain[0] if limb.chain else None
        if first is not None and first.name in tree.joints and mount is not None:
            _check_place(tree, first.name, mount @ matrix_from_place(first.at))
        driven = (j for j in limb.chain if isinstance(j, Revolute | Prismatic))
        motors = {joint.name: joint.actuated for joint in driven if joint.actuated}
        start = f"{limb.name}."
        names = [entry.name or entry.of for entry in limb.errors] + list(motors)
        names += [n.removeprefix(start)[:-2] for n in (*named, *coupled) if n.startswith(start)]
        for name in dict.fromkeys(names):
            if name in tree.places:
                shifts = [f"{prefix}{limb.name}.{name}.{axis}" for axis in "xyz"]
                laws = {motors[name]: 1.0} if name in motors else coupled.get(start + name, {})
                yield name, shifts, {f"{prefix}{n}.offset": share for n, share in laws.items()}


def _check_place(tree: LinkTree, name: str, stated: FloatArray) -> None:
    """Refuse a URDF in which the first joint of a limb has another place; raises FileError."""
    joint = tree.joints[name]
    if tree.find_body(joint.parent) != tree.root:
        return  # a closure carries it
    place = tree.place_in_body(joint.parent) @ joint.origin
    # a repaired loop has its axes elsewhere, by no more than the digits of the file explain
    rounding = sum(sum(other.rounding) for other in tree.places.values())
    if np.abs(place - stated).max() > PLACED + rounding:
        sentence = f"joint {name!r} has another place in the robot file"
        raise tree.error(f"{sentence}. Export into the file of origin", name)


LARGE = 30.0
"""Largest distance of two joints of a link that is plausible [m]; URDF has no other unit."""

REMARKS = {
    "limbs": "Limbs have the name of their first joint, joints their name in the file.",
    "stages": "Stages have the name of their joint, stages with loops the name of the link that "
    "they carry, limbs the name of their first joint, joints their name in the file.",
}
"""What people should know about the names, by the family of the robot file."""


def read(tree: LinkTree, options: ImportOptions, what: str) -> Imported:
    """Return the robot of a file and its closures; FileError where its loops do not close."""
    path, closures = tree.path, options.closures or find_closures(tree.path)
    if closures is None and not tree.constraints and not tree.motors:
        raise FileError.of("files.closures-missing", path, what=what)
    mechanism = read_mechanism(tree, closures)
    platform, frame = _find_platform(mechanism, options.platform)

    def locate_frame(body: str) -> FloatArray:
        return mechanism.locate(frame if body == platform else choose_link(mechanism, body))[1]

    try:
        paths = find_stage_paths(
            mechanism.graph, platform, locate_frame, mechanism.measure_rounding
        )
        if paths.outside and options.platform is None:
            raise MechanismError.of("files.motors-outside", motors=paths.outside, platform=platform)
    except MechanismError as error:
        # the refusal names links of the file instead of the bodies that they form
        bodies = {"body", "body_a", "body_b", "platform"}
        data = error.args[0].data.items()
        named = {k: choose_link(mechanism, v) if k in bodies else v for k, v in data}
        finding = replace(error.args[0], data=named)
        joints = finding.data.get("joints", ())
        _check_couplings(mechanism, joints)
        # the last joint of the file among them; parts of a replaced joint end in _X, _Y or _Z, and
        # a closure has the name of a link
        origins = (
            origin
            for name in reversed(joints)
            for origin in (name, name[:-2], tree.carrier[name].name if name in tree.carrier else "")
        )
        place = next((origin for origin in origins if origin in tree.places), "")
        raise tree.error(finding, place) from None
    moving = [name for j in paths.graph.joints for name in (j.name, j.origin_a, j.origin_b)]
    _check_couplings(mechanism, moving)
    closing = closures.name if closures is not None else "its constraints"
    what = f"{what} with loop closures in {closing}"
    family = choose_family(paths)
    remark = REMARKS[family]
    head = format_head(path, what, family, options.name, ("m", "rad"), remark)
    text = head + format_yaml(describe_robot(mechanism, paths, frame))
    findings = (*tree.notes, *_report_structure(mechanism, paths, frame))
    # motors are missing, or rigid closures probably stand for pins if motors exceed the mobility
    motors, mobility, doubt = len(paths.graph.motors), paths.motions.mobility, None
    if motors < mobility:
        doubt = report_finding("files.motors-missing", motors=motors, mobility=mobility)
    elif (rigid := mechanism.rigid_closures) and motors > mobility:
        code = "files.closure-rigid"
        doubt = report_finding(code, closures=rigid, motors=motors, mobility=mobility)
    return Imported(text, None, findings, doubt)


def _find_platform(mechanism: Linkage, name: str | None) -> tuple[str, str]:
    """Return the platform's body, and the link whose frame is the platform frame.

    It is the link that is named; else the only frame (a link on a fixed joint that closes no loop)
    on a moving body, of several the only one on a body at an end of the mechanism that limbs join
    to what carries it; else that body. Several ends, such as the feet of a humanoid, are listed.
    """
    tree, graph = mechanism.tree, mechanism.graph
    moving = graph.bodies[1:]
    fixed = (
        joint.child
        for joint in tree.joints.values()
        if not joint.kind and joint.parent not in tree.hidden
    )
    frames = [link for link in fixed if link not in mechanism.frames]
    frames = [link for link in frames if mechanism.locate(link)[0] in moving]
    possible = list_possible_platforms(graph)
    suited = [link for link in frames if mechanism.locate(link)[0] in possible]
    named = {mechanism.locate(link)[0] for link in suited}
    # of each possible body its frames, or its link
    others = (choose_link(mechanism, body) for body in possible or moving if body not in named)
    links = (*suited, *others)
    if name is not None:
        known = name in {*tree.carrier, tree.root}
        body = mechanism.locate(name)[0] if known else None
        if body not in moving:
            raise FileError.of("files.platform-unknown", tree.path, platform=name, links=links)
        return str(body), name
    chosen = frames if len(frames) == 1 else suited
    if len(chosen) == 1:
        return mechanism.locate(chosen[0])[0], chosen[0]
    if not chosen and len(possible) == 1:
        return possible[0], choose_link(mechanism, possible[0])
    raise FileError.of("files.platform-unclear", tree.path, frames=tuple(frames), links=links)


def _check_couplings(mechanism: Linkage, names: Collection[str]) -> None:
    """Refuse a joint, of those named, that cannot follow another one; raises FileError."""
    for coupling in mechanism.couplings:
        if coupling.joint in names:
            finding = report_finding(
                "files.joint-mimics",
                joint=coupling.joint,
                followed=coupling.leader,
                factor=coupling.factor,
            )
            raise mechanism.tree.error(finding, coupling.joint)


def _report_structure(mechanism: Linkage, paths: StagePaths, frame: str) -> Iterator[Finding]:
    """Yield the size of the mechanism, its home, and what the robot file does not express."""
    graph, motions = paths.graph, paths.motions
    yield report_finding(
        "files.urdf-structure",
        bodies=len(graph.bodies),
        links=len(mechanism.tree.carrier) + 1,
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
        loops = (isinstance(s, ClosedStage) and s.graph.closing for s in paths.stages)
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
    if motions.mobility != len(graph.motors):
        yield report_finding(
            "files.motors-differ",
            mobility=motions.mobility,
            motors=len(graph.motors),
            repeated=count_repeated_closures(graph, paths.home),
        )


# The content of a robot file: of the family limbs for one stage, whose bodies have the names of
# links, of the family stages for several, whose serial joints have the names of the URDF; closed
# loops have the name of the link that carries what follows. Its frame is the platform of the
# stage, for the last the platform frame.

ZERO = 1e-15
"""Numbers below this are rounding and written as 0 [m, rad]."""

POSE = ("x", "y", "z", "roll", "pitch", "yaw")

Content = dict[str, Any]
"""Keys and values of a part of a robot file."""


def describe_limb(
    paths: ClosedStage, limb: GraphLimb, bodies: Mapping[str, str]
) -> tuple[Content, list[Content]]:
    """Return one limb of the robot file, and the entries of `parameters:` that it needs.

    `bodies` are the names of bodies in the robot file. The limb ends in a point where its last
    joint is a ball joint.
    """
    name, last = limb.joints[0].name, limb.joints[-1]
    on, to = (bodies[body] for body in (limb.on, limb.to))
    chain: list[Content] = []
    errors: list[Content] = []
    parameters: list[Content] = []
    pending: FloatArray = np.eye(4)
    before: GraphJoint | None = None
    ends_in_point = last.kind == "S"
    tip: FloatArray = np.eye(4)
    for joint in limb.joints:
        place = pending @ joint.T_a
        is_tip = joint is last and ends_in_point
        element = ("tip" if chain else on) if is_tip else joint.name
        if before is not None and before.origin_b:
            # the shifts of a far origin as shifts of the next place
            for axis in before.shifts:
                shares = zip("xyz", _clear(-place["xyz".index(axis), :3]), strict=True)
                maps = [
                    {"limb": name, "element": element, "axis": letter, "coefficient": share}
                    for letter, share in shares
                    if share
                ]
                far = {"name": f"{name}.{before.origin_b}.{axis}", "length": 0, "maps": maps}
                parameters.append(far)
        if joint.origin_a:
            errors.append(_describe_shifts(element, joint.origin_a, joint.shifts))
        if is_tip:
            tip = place
        else:
            chain.append(_describe_limb_joint(paths, joint, place))
        pending, before = geometry.invert_pose(joint.T_b), joint
    attach: FloatArray = geometry.invert_pose(
        pending @ (paths.frame if to == PLATFORM else np.eye(4))
    )
    if last.origin_b:
        errors.append(_describe_shifts(to, last.origin_b, last.shifts))
    elif not ends_in_point:
        tip, attach = geometry.invert_pose(attach), np.eye(4)
    return {
        "name": name,
        **({} if on == BASE else {"on": on}),
        **({} if to == PLATFORM else {"to": to}),
        "chain": chain,
        "ending": "ball" if ends_in_point else "rigid",
        "tip": describe_pose(tip),
        "attach": describe_pose(attach),
        "errors": errors,
    }, parameters


def describe_pose(T: FloatArray) -> Content | list[float]:
    """Return a pose as a mapping without zeros."""
    values = [*T[:3, 3], *geometry.matrix_to_euler(T[:3, :3], "xyz")]
    shown = {n: v for n, v in zip(POSE, _clear(values), strict=True) if v}
    return shown or [0.0, 0.0, 0.0]


def _describe_moved(key: str, T: FloatArray) -> Content:
    """Return a pose (4, 4) by its key, nothing where it is the identity but for rounding."""
    pose = describe_pose(T)
    return {key: pose} if isinstance(pose, dict) else {}


def _clear(numbers: Iterable[float]) -> list[float]:
    """Return numbers without rounding near 0."""
    return [float(v) if abs(v) > ZERO else 0.0 for v in numbers]


def _describe_shifts(element: str, origin: str, axes: str) -> Content:
    """Return one entry of `errors:`."""
    name = {} if element == origin else {"name": origin}
    return {"of": element, **name, "shift": list(axes)}


def _describe_limb_joint(paths: ClosedStage, joint: GraphJoint, place: FloatArray) -> Content:
    """Return a joint of a limb."""
    content = {"joint": joint.kind, "name": joint.name, "at": describe_pose(place)}
    if joint.kind == "S":
        T = paths.graph.relate(paths.graph.place(paths.home[None]), joint)
        roll, pitch, yaw = geometry.matrix_to_euler(T[:3, :3], "xyz")
        return {**content, "start": _clear((yaw, pitch, roll))}
    start = get_value(paths.graph, paths.home, joint)
    motor = {"actuated": joint.drive} if _is_actuated(paths, joint) else {}
    return {**content, "axis": _clear(joint.axis), "start": start, **motor}


def _is_actuated(paths: ClosedStage, joint: GraphJoint) -> bool:
    """Return whether a joint has the value of a driven one."""
    lead, *law = paths.used.find_lead(joint)
    return joint.drive in paths.used.motors and (joint.kind, *law) == (lead.kind, 1.0, 0.0)


def _describe_couplings(paths: ClosedStage) -> Content:
    """Return the couplings of joints, each named after the one that follows."""
    graph = paths.used
    moved = [(limb.joints[0].name, joint) for limb in paths.limbs for joint in limb.joints]
    names = {joint.name: f"{limb}.{joint.name}" for limb, joint in moved}
    names |= {joint.name: drive for drive, joint in graph.leads.items() if drive in graph.motors}
    couplings = {}
    for _, joint in moved:
        lead, factor, offset = graph.find_lead(joint)
        if lead.name == joint.name or _is_actuated(paths, joint):
            continue
        scale = 1 / factor if (joint.kind, lead.kind) == ("R", "P") else 1.0
        weights = {names[joint.name]: scale, names[lead.name]: -factor * scale}
        turning = [n for n, of in zip(weights, (joint, lead), strict=True) if of.kind == "R"]
        law: Content = {"sum": weights, "offset": offset * scale, "unknown": ["offset"]}
        if len(turning) < 2:  # slides, and rotary joints by their path per radian
            law |= {"of": "length", "radius": {n: weights.pop(n) for n in turning}}
        couplings[joint.name] = law
    return {"couplings": couplings} if couplings else {}


def choose_family(paths: StagePaths) -> str:
    """Return the family of the robot file: stages, unless the only stage stands in the base."""
    first, *others = paths.stages
    is_closed = isinstance(first, ClosedStage) and np.array_equal(first.mount, np.eye(4))
    return "limbs" if is_closed and not others else "stages"


def describe_robot(mechanism: Linkage, paths: StagePaths, frame: str) -> Content:
    """Return a robot file without its head; `frame` is the link that is the platform frame."""
    tree, T_body_frame = mechanism.tree, mechanism.locate(frame)[1]
    tool = geometry.invert_pose(paths.stages[-1].frame) @ T_body_frame
    ending = _describe_moved("tool", tool)
    if choose_family(paths) == "limbs":
        assert isinstance(paths.stages[0], ClosedStage)
        return _describe_limbs(mechanism, paths.stages[0]) | ending
    carriers = [np.eye(4), *(geometry.invert_pose(stage.frame) for stage in paths.stages[:-1])]
    named = zip(list_stage_names(mechanism, paths), paths.stages, strict=True)
    stages: list[Content] = []
    # `before` is the body that carries a stage in the platform of the stage before
    for (name, stage), before in zip(named, carriers, strict=True):
        if isinstance(stage, ClosedStage):
            mount = _describe_moved("mount", before @ stage.mount)
            loops = _describe_limbs(mechanism, stage)
            stages.append({"name": name, **mount, "family": "limbs", **loops})
            continue
        joint, tip = stage.joint, geometry.invert_pose(stage.joint.T_b) @ stage.frame
        driven = {
            "kind": joint.kind,
            "at": describe_pose(before @ joint.T_a),
            "axis": _clear(joint.axis),
            **_describe_moved("tip", tip),
            "drive": joint.drive,
            "start": stage.start,
            **_describe_stroke(tree.joints[joint.drive]),
            "errors": [*joint.shifts, "offset"],
        }
        stages.append({"name": name, "joint": driven})
    controlled = _choose_coordinates(
        paths.graph, paths.home, paths.platform, paths.stages[-1].frame
    )
    return {"controlled": controlled, "stages": stages, **ending}


def choose_link(mechanism: Linkage, body: str) -> str:
    """Return the link of a rigid body that has most movable joints, of those that the file names:
    closures cut links in parts.
    """
    movable = [joint for joint in mechanism.tree.joints.values() if joint.kind]
    ends = [link for joint in movable for link in (joint.parent, joint.child)]
    hidden = mechanism.tree.hidden
    return max(mechanism.list_links(body), key=lambda link: (link not in hidden, ends.count(link)))


def list_stage_names(mechanism: Linkage, paths: StagePaths) -> tuple[str, ...]:
    """Return names of the stages: of a joint its own, of a loop that of the link it carries."""
    return _make_unique(
        stage.joint.name
        if isinstance(stage, SerialStage)
        else choose_link(mechanism, stage.platform)
        for stage in paths.stages
    )


def _make_unique(stated: Iterable[str], taken: tuple[str, ...] = (BASE,)) -> tuple[str, ...]:
    """Return names without points and colons that differ from each other and from those taken."""
    names: list[str] = []
    for name in stated:
        plain = name.replace(".", "_").replace(":", "_")
        tries = (f"{plain}{suffix}" for suffix in ("", *(f"_{i}" for i in range(2, 1000))))
        names.append(next(name for name in tries if name not in (*taken, *names)))
    return tuple(names)


def _choose_coordinates(
    graph: JointGraph, q: FloatArray, platform: str, T_body_frame: FloatArray
) -> list[str]:
    """Return the coordinates in which a frame of the platform is commanded."""
    home = graph.locate(q, platform) @ T_body_frame
    motions = graph.find_twists(q, platform, T_body_frame) @ graph.find_motions(q)
    return list(choose_coordinates(home, motions))


def _describe_limbs(mechanism: Linkage, paths: ClosedStage) -> Content:
    """Return the keys of the family limbs."""
    graph, home, joints = paths.graph, paths.home, mechanism.tree.joints
    links = (choose_link(mechanism, body) for body in paths.bodies)
    inner = _make_unique(links, (BASE, PLATFORM))
    bodies = dict(zip(paths.bodies, inner, strict=True))
    homes = [
        {"name": name, "home": {"x": 0.0}, **_describe_moved("home", graph.locate(home, body))}
        for body, name in bodies.items()
    ]
    bodies |= {graph.base: BASE, paths.platform: PLATFORM}
    limbs = [describe_limb(paths, limb, bodies) for limb in paths.limbs]
    parameters = [entry for _, entries in limbs for entry in entries]
    return {
        "freedoms": list(paths.freedoms),
        "controlled": _choose_coordinates(graph, home, paths.platform, paths.frame),
        "actuators": {
            name: _describe_drive(mechanism.tree, joints[name], paths.used.leads[name])
            for name in paths.used.motors
        },
        **_describe_couplings(paths),
        **({"bodies": homes} if homes else {}),
        "limbs": [limb for limb, _ in limbs],
        **({"parameters": parameters} if parameters else {}),
        **_describe_moved("home", graph.locate(home, paths.platform) @ paths.frame),
    }


def _describe_drive(tree: LinkTree, motor: TreeJoint, lead: GraphJoint) -> Content:
    """Return one drive of the robot file; its joint may be one that follows the motor."""
    if (motor.kind, lead.kind) == ("P", "R"):
        sentence = f"joint {lead.name!r} turns with the slide {motor.name!r}, which moves nothing "
        raise tree.error(f"{sentence}else of this platform. Name the joint as motor", lead.name)
    gain = "gain" if motor.kind == lead.kind else "radius"
    law = {} if lead.is_plain else {gain: lead.ratio, "offset": lead.offset}
    reads = "angle" if motor.kind == "R" else "length"
    return {"reads": reads, **law, "unknown": ["offset"], **_describe_stroke(motor)}


def _describe_stroke(joint: TreeJoint) -> Content:
    return {} if joint.limits is None else {"stroke": list(joint.limits)}
