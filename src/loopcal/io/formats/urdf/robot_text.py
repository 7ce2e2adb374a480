# SPDX-License-Identifier: Apache-2.0
"""The text of a robot file, from the stages of a mechanism.

One stage is a robot of the family limbs. Several are one of the family stages, whose serial joints
have the names of the URDF; closed loops have the name of the link that carries what follows. The
platform of a stage is the frame of that link, that of the last one the platform frame.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.io.core.yaml_file import quote_scalar
from loopcal.io.formats.urdf.closures import UrdfMechanism
from loopcal.io.formats.urdf.tree import Urdf, UrdfJoint
from loopcal.mechanism.assembly import BASE
from loopcal.mechanism.joint_graph.graph import GraphJoint, choose_coordinates
from loopcal.mechanism.joint_graph.loops import JointGraph, get_value, measure_rotation
from loopcal.mechanism.joint_graph.paths import ClosedStage, LimbPaths, SerialStage, StagePaths
from loopcal.typing import FloatArray

# The text of one limb of a robot file, from the joints of a mechanism between base and
# platform.

ZERO = 1e-15
"""Numbers below this are rounding and written as 0 [m, rad]."""

POSE = ("x", "y", "z", "roll", "pitch", "yaw")

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


@dataclass(frozen=True)
class LimbText:
    """One limb of a robot file, and the entries of `parameters:` that it needs."""

    text: str
    parameters: str


def format_limb(
    paths: LimbPaths, limb: tuple[GraphJoint, ...], T_body_frame: FloatArray
) -> LimbText:
    """Return one limb of the robot file.

    It ends in a point where its last joint is a ball joint, and on a platform that does not turn.
    """
    turns = any(name.startswith("r") for name in paths.freedoms)
    name, last = limb[0].name, limb[-1]
    chain, errors, parameters = [], [], []
    pending: FloatArray = np.eye(4)
    before: GraphJoint | None = None
    ends_in_point = last.kind == "S" or not turns
    tip: FloatArray = np.eye(4)
    for joint in limb:
        place = pending @ joint.T_a
        is_tip = joint is last and ends_in_point
        element = "tip" if is_tip else joint.name
        if before is not None and before.origin_b:
            parameters += _format_far_shifts(name, before, element, place)
        if joint.origin_a:
            errors.append(_format_shifts(element, joint.origin_a, joint.shifts))
        if is_tip:
            tip = place
        else:
            chain += _format_limb_joint(paths, joint, place)
        pending, before = geometry.invert_pose(joint.T_b), joint
    attach: FloatArray = geometry.invert_pose(pending @ T_body_frame)
    if last.origin_b:
        errors.append(_format_shifts("platform", last.origin_b, last.shifts))
    if not ends_in_point and not last.origin_b:
        tip, attach = pending @ T_body_frame, np.eye(4)
    text = LIMB.format(
        name=quote_scalar(name),
        chain="\n".join(chain),
        ending="ball" if ends_in_point else "rigid",
        tip=format_pose(tip),
        attach=format_pose(attach),
        errors="\n".join(errors) or "      []",
    )
    return LimbText(text, "".join(parameters))


def format_pose(T: FloatArray) -> str:
    """Return a pose as a flow mapping without zeros."""
    values = [*T[:3, 3], *geometry.matrix_to_euler(T[:3, :3], "xyz")]
    pairs = zip(POSE, values, strict=True)
    shown = [f"{name}: {float(value)!r}" for name, value in pairs if abs(value) > ZERO]
    return f"{{{', '.join(shown)}}}" if shown else "[0, 0, 0]"


def _format_shifts(element: str, origin: str, axes: str) -> str:
    """Return one entry of `errors:`."""
    of = quote_scalar(element)
    name = "" if element == origin else f", name: {quote_scalar(origin)}"
    return f"      - {{of: {of}{name}, shift: [{', '.join(axes)}]}}"


def _format_far_shifts(limb: str, joint: GraphJoint, element: str, place: FloatArray) -> list[str]:
    """Return entries of `parameters:`, the shifts of a far origin as shifts of the next place."""
    entries = []
    for axis in joint.shifts:
        coefficients = -place["xyz".index(axis), :3]
        maps = ", ".join(
            f"{{limb: {quote_scalar(limb)}, element: {quote_scalar(element)}, axis: {letter}, "
            f"coefficient: {float(coefficient)!r}}}"
            for letter, coefficient in zip("xyz", coefficients, strict=True)
            if abs(coefficient) > ZERO
        )
        name = quote_scalar(f"{limb}.{joint.origin_b}.{axis}")
        entries.append(f"  - {{name: {name}, length: 0, maps: [{maps}]}}\n")
    return entries


def _format_limb_joint(paths: LimbPaths, joint: GraphJoint, place: FloatArray) -> list[str]:
    """Return a joint of a limb."""
    name, where = quote_scalar(joint.name), f"at: {format_pose(place)}"
    if joint.kind == "S":
        R = measure_rotation(paths.graph, paths.home, joint)
        roll, pitch, yaw = geometry.matrix_to_euler(R, "xyz")
        start = format_list((yaw, pitch, roll))
        return [f"      - {{joint: S, name: {name}, {where}, start: {start}}}"]
    motor = f", actuated: {name}" if joint.name in paths.graph.motors else ""
    value = get_value(paths.graph, paths.home, joint)
    axis = f"axis: {format_list(joint.axis)}, start: {value!r}"
    return [f"      - {{joint: {joint.kind}, name: {name}, {where}, {axis}{motor}}}"]


def format_list(vector: Any) -> str:
    """Return numbers as a flow list."""
    return f"[{', '.join(repr(float(v)) if abs(v) > ZERO else '0' for v in vector)}]"


LIMBS = """\
freedoms: [{freedoms}]
controlled: [{controlled}]
actuators:
{actuators}
limbs:
{limbs}
{parameters}home: {home}
"""
STAGES = """\
controlled: [{controlled}]
stages:
{stages}"""
JOINT = """\
  - name: {name}
    joint: {{{entries}}}
"""
LOOP = """\
  - name: {name}
{mount}    family: limbs
{robot}"""


def choose_family(paths: StagePaths) -> str:
    """Return the family of the robot file: stages, unless the only stage stands in the base."""
    first, *others = paths.stages
    is_closed = isinstance(first, ClosedStage) and np.array_equal(first.mount, np.eye(4))
    return "limbs" if is_closed and not others else "stages"


def format_robot(mechanism: UrdfMechanism, paths: StagePaths, frame: str) -> str:
    """Return a robot file without its head; `frame` is the link that is the platform frame."""
    urdf, T_body_frame = mechanism.urdf, mechanism.locate(frame)[1]
    tool = geometry.invert_pose(paths.stages[-1].frame) @ T_body_frame
    is_turned = not np.array_equal(paths.stages[-1].frame, T_body_frame)
    ending = f"tool: {format_pose(tool)}\n" if is_turned else ""
    if choose_family(paths) == "limbs":
        assert isinstance(paths.stages[0], ClosedStage)
        return _format_limbs(urdf, paths.stages[0]) + ending
    carriers = [np.eye(4), *(geometry.invert_pose(stage.frame) for stage in paths.stages[:-1])]
    named = zip(list_stage_names(mechanism, paths), paths.stages, strict=True)
    stages = [
        _format_joint(urdf, name, stage, before)
        if isinstance(stage, SerialStage)
        else _format_loop(urdf, name, stage, before)
        for (name, stage), before in zip(named, carriers, strict=True)
    ]
    controlled = _choose_coordinates(
        paths.graph, paths.home, paths.platform, paths.stages[-1].frame
    )
    return STAGES.format(controlled=controlled, stages="".join(stages)) + ending


def choose_link(mechanism: UrdfMechanism, body: str) -> str:
    """Return the link of a rigid body that has most movable joints: closures cut links in parts."""
    movable = [joint for joint in mechanism.urdf.joints.values() if joint.kind]
    ends = [link for joint in movable for link in (joint.parent, joint.child)]
    return max(mechanism.list_links(body), key=ends.count)


def list_stage_names(mechanism: UrdfMechanism, paths: StagePaths) -> tuple[str, ...]:
    """Return names of the stages: of a joint its own, of a loop that of the link it carries."""
    names: list[str] = []
    for stage in paths.stages:
        is_serial = isinstance(stage, SerialStage)
        stated = stage.joint.name if is_serial else choose_link(mechanism, stage.platform)
        plain = stated.replace(".", "_").replace(":", "_")
        tries = (f"{plain}{suffix}" for suffix in ("", *(f"_{i}" for i in range(2, 1000))))
        names.append(next(name for name in tries if name not in (BASE, *names)))
    return tuple(names)


def _choose_coordinates(
    graph: JointGraph, q: FloatArray, platform: str, T_body_frame: FloatArray
) -> str:
    """Return the coordinates in which a frame of the platform is commanded, as a list."""
    home = graph.get_place(graph.place(q[None]), platform)[0] @ T_body_frame
    motions = graph.find_twists(q, platform, T_body_frame) @ graph.find_motions(q)
    return ", ".join(choose_coordinates(home, motions))


def _format_limbs(urdf: Urdf, stage: ClosedStage) -> str:
    """Return the keys of the family limbs."""
    paths, T_body_frame = stage.paths, stage.frame
    graph = paths.graph
    home = graph.get_place(graph.place(paths.home[None]), paths.platform)[0] @ T_body_frame
    limbs = [format_limb(paths, limb, T_body_frame) for limb in paths.limbs]
    parameters = "".join(limb.parameters for limb in limbs)
    drives = (f"  {quote_scalar(n)}: {_format_drive(urdf.joints[n])}" for n in graph.motors)
    return LIMBS.format(
        freedoms=", ".join(paths.freedoms),
        controlled=_choose_coordinates(graph, paths.home, paths.platform, T_body_frame),
        actuators="\n".join(drives),
        limbs="".join(limb.text for limb in limbs),
        parameters=f"parameters:\n{parameters}\n" if parameters else "",
        home=format_pose(home),
    )


def _format_loop(urdf: Urdf, name: str, stage: ClosedStage, T_frame_body: FloatArray) -> str:
    """Return a stage with closed loops.

    T_frame_body (4, 4) is the body that carries it in the platform of the stage before.
    """
    mount = T_frame_body @ stage.mount
    is_moved = not np.array_equal(mount, np.eye(4))
    line = f"    mount: {format_pose(mount)}\n" if is_moved else ""
    robot = textwrap.indent(_format_limbs(urdf, stage), "    ")
    return LOOP.format(name=quote_scalar(name), mount=line, robot=robot)


def _format_joint(urdf: Urdf, name: str, stage: SerialStage, T_frame_body: FloatArray) -> str:
    """Return a stage of one driven joint; arguments as those of `_format_loop`."""
    joint, place = stage.joint, T_frame_body @ stage.joint.T_a
    tip = geometry.invert_pose(joint.T_b) @ stage.frame

    def list_entries() -> Iterator[str]:
        yield f"kind: {joint.kind}"
        yield f"at: {format_pose(place)}"
        yield f"axis: {format_list(joint.axis)}"
        if not np.array_equal(tip, np.eye(4)):
            yield f"tip: {format_pose(tip)}"
        yield f"drive: {quote_scalar(joint.name)}"
        yield f"start: {stage.start!r}"
        limits = urdf.joints[joint.name].limits
        if limits is not None:
            yield f"stroke: [{limits[0]!r}, {limits[1]!r}]"
        yield f"errors: [{', '.join([*joint.shifts, 'offset'])}]"

    return JOINT.format(name=quote_scalar(name), entries=", ".join(list_entries()))


def _format_drive(joint: UrdfJoint) -> str:
    """Return one drive of the robot file."""
    stroke = "" if joint.limits is None else f", stroke: [{joint.limits[0]!r}, {joint.limits[1]!r}]"
    return f"{{reads: {'angle' if joint.kind == 'R' else 'length'}, unknown: [offset]{stroke}}}"
