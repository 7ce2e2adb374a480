# SPDX-License-Identifier: Apache-2.0
"""The text of one limb of a robot file, from the joints of a mechanism between base and platform.

A limb carries a frame through its joints. A joint is placed relative to the frame that the joint
before it carries: T = inv(T_far of the joint before) T_near. A shift d of the near origin is a
shift of this place in its own axes. A shift d of a far origin (of a joint that the tree of the URDF
runs through in the other direction) shifts the next place by -R' d, with the rotation R of that
place; behind the last joint it is a shift of the attachment to the platform.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.io.core.yaml_text import quote_scalar
from loopcal.mechanism.joint_graph import GraphJoint, LimbPaths, get_value, measure_rotation
from loopcal.typing import FloatArray

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
            chain += _format_joint(paths, joint, place)
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


def _format_joint(paths: LimbPaths, joint: GraphJoint, place: FloatArray) -> list[str]:
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
