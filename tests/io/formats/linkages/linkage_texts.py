# SPDX-License-Identifier: Apache-2.0
"""SDF and MJCF files of the machines of `urdf_machines`, drawn at home."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from tests.io.formats.linkages.urdf_machines import BASE, PLATFORM, TOOL, MachineJoint, make_pose

SDF_TYPES = {"R": "revolute", "P": "prismatic", "U": "universal", "S": "ball"}


def _place_bodies(joints: Sequence[MachineJoint]) -> dict[str, np.ndarray]:
    """Return the frames of the bodies: each at its first joint, the base unmoved."""
    frames = {BASE: np.eye(4)}
    for joint in joints:
        for body in (joint.a, joint.b):
            frames.setdefault(body, joint.T)
    return frames


def _format(values: Iterable[float]) -> str:
    return " ".join(repr(float(v)) for v in values)


def _format_pose(T: np.ndarray) -> str:
    return _format([*T[:3, 3], *_find_angles(T, "xyz")])


def _find_angles(T: np.ndarray, order: str) -> np.ndarray:
    """Return angles [rad]; at a gimbal lock the third one is zero."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return Rotation.from_matrix(T[:3, :3]).as_euler(order)


def write_sdf(joints: Sequence[MachineJoint]) -> tuple[str, str]:
    """Return an SDF in which closing joints give a link two parents, and a file of its motors."""
    frames, text = _place_bodies(joints), []
    for body, T in frames.items():
        text.append(f'<link name="{body}"><!-- {body} --><pose>{_format_pose(T)}</pose></link>\n')
    text.append(f'<link name="tool"><pose relative_to="{PLATFORM}">{_format(TOOL)} 0 0 0</pose>')
    text.append('</link>\n<joint name="flange_tool" type="fixed">')
    text.append(f"<parent>{PLATFORM}</parent><child>tool</child></joint>\n")
    for joint in joints:
        pose = _format_pose(np.linalg.inv(frames[joint.b]) @ joint.T)
        axes = [np.eye(3)[i] for i in ((0, 1) if joint.kind == "U" else (2,))]
        text += [
            f'<joint name="{joint.name}" type="{SDF_TYPES[joint.kind]}">\n  <pose>{pose}</pose>\n',
            f"  <parent>{joint.a}</parent><child>{joint.b}</child>\n",
            *(
                f"  <axis{n}><xyz>{_format(axis)}</xyz></axis{n}>\n"
                for n, axis in zip(("", "2"), axes, strict=False)
            ),
            "</joint>\n",
        ]
    motors = [joint.name for joint in joints if joint.is_motor]
    sdf = f'<sdf version="1.8"><model name="m">\n{"".join(text)}</model></sdf>\n'
    return sdf, f"name_mot: {motors}\n"


def write_mjcf(joints: Sequence[MachineJoint]) -> str:
    """Return an MJCF, in which `connect` closes the loops, twice for a hinge; angles in degrees,
    and each body turned by another way to write it.
    """
    frames = {BASE: np.eye(4)}
    inside: dict[str, list[tuple[MachineJoint, str]]] = {}
    waiting = sorted(joints, key=lambda joint: not joint.is_motor)
    while ready := [j for j in waiting if (j.a in frames) != (j.b in frames)]:
        joint = ready[0]
        parent, child = (joint.a, joint.b) if joint.a in frames else (joint.b, joint.a)
        frames[child] = joint.T @ make_pose(np.eye(3), [0.01, 0.02, -0.01])
        inside.setdefault(parent, []).append((joint, child))
        waiting.remove(joint)

    def write_body(joint: MachineJoint, parent: str, child: str) -> str:
        T = np.linalg.inv(frames[parent]) @ frames[child]
        turn = Rotation.from_matrix(T[:3, :3])
        x, y, z, w = turn.as_quat()
        turns = {
            "quat": [w, x, y, z],
            "euler": np.rad2deg(_find_angles(T, "XYZ")),
            "xyaxes": [*T[:3, 0], *T[:3, 1]],
        }
        key = [*turns][len(child) % 3]
        place = np.linalg.inv(frames[child]) @ joint.T
        back = 1.0 if parent == joint.a else -1.0  # the child moves the other way
        axes = {"R": [2], "P": [2], "U": [0, 1]}.get(joint.kind, [])
        names = [joint.name] if len(axes) < 2 else [f"{joint.name}_{i}" for i in axes]
        axes, names = (axes, names) if back > 0 else (axes[::-1], names[::-1])
        sort = {"P": "slide", "S": "ball"}.get(joint.kind, "hinge")
        written = [
            f'<joint name="{name}" type="{sort}" pos="{_format(place[:3, 3])}" '
            f'axis="{_format(back * place[:3, axis])}"/>\n'
            for name, axis in zip(names, axes, strict=True)
        ]
        if joint.kind == "S":
            written = [f'<joint name="{joint.name}" type="ball" pos="{_format(place[:3, 3])}"/>\n']
        T_tool = np.linalg.inv(frames[child]) @ joint.T @ make_pose(np.eye(3), TOOL)
        tool = f'<body name="tool" pos="{_format(T_tool[:3, 3])}"/>' if child == PLATFORM else ""
        inner = "".join(write_body(other, child, end) for other, end in inside.get(child, []))
        start = f'<body name="{child}" pos="{_format(T[:3, 3])}" {key}="{_format(turns[key])}">\n'
        return f"{start}<!-- {child} -->{''.join(written)}{tool}{inner}</body>\n"

    equal = []
    for joint in waiting:
        for k in range({"S": 1, "R": 2}[joint.kind]):
            point = joint.T @ [0.0, 0.0, 0.05 * k, 1.0]
            anchor = _format((np.linalg.inv(frames[joint.a]) @ point)[:3])
            bodies = f'body1="{joint.a}" body2="{joint.b}"'.replace(BASE, "world")
            equal.append(f'<connect name="{joint.name}_{k}" {bodies} anchor="{anchor}"/>\n')
    motors = "".join(f'<motor joint="{joint.name}"/>\n' for joint in joints if joint.is_motor)
    bodies = "".join(write_body(joint, BASE, child) for joint, child in inside[BASE])
    return (
        f"<mujoco><worldbody>\n{bodies}</worldbody>\n<equality>\n{''.join(equal)}</equality>\n"
        f"<actuator>\n{motors}</actuator></mujoco>\n"
    )
