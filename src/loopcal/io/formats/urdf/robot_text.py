# SPDX-License-Identifier: Apache-2.0
"""The text of a robot file, from the stages of a mechanism.

One stage is a robot of the family limbs. Several are one of the family stages, whose serial joints
have the names of the URDF; closed loops have the name of the link that carries what follows. The
platform of a stage is the frame of that link, that of the last one the platform frame.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

import numpy as np

from loopcal import geometry
from loopcal.io.core.yaml_text import quote_scalar
from loopcal.io.formats.urdf.closures import UrdfMechanism
from loopcal.io.formats.urdf.elements import UrdfJoint
from loopcal.io.formats.urdf.limb_text import format_limb, format_list, format_pose
from loopcal.io.formats.urdf.tree import Urdf
from loopcal.mechanism.assembly import BASE
from loopcal.mechanism.joint_graph import (
    ClosedStage,
    JointGraph,
    SerialStage,
    StagePaths,
    choose_coordinates,
)
from loopcal.typing import FloatArray

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
