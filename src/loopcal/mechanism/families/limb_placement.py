# SPDX-License-Identifier: Apache-2.0
"""Limbs with joints about any axis, placed one after the other, in the form of the engine.

The joints of the engine move along the z axis of their link frame, so a link takes in two
rotations, T_j = A_{j-1}^-1 P_j A_j: P_j places the joint in the carried frame, A_j rotates z onto
its axis. At joint values of zero the carried frame is the base frame displaced by the placements
alone. Derivation: docs/theory/parameters.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Address, Cone, Joint, Limb, LinearMap, Link
from loopcal.typing import FloatArray

EX, EY, EZ = np.eye(3)


@dataclass(frozen=True, eq=False)
class JointPlacement:
    """A joint of a limb, and where it is; the link before it has its name.

    Attributes
    ----------
    place : (4, 4) of the joint in the frame carried up to it [m].
    axis : (3,) in the placed frame, of any length but zero.
    """

    joint: Joint
    place: FloatArray
    axis: FloatArray


class PlacedLimb(NamedTuple):
    """A limb for the engine, with the frames in which its file is written.

    Attributes
    ----------
    rotations : name of a link -> (3, 3) R_carried_link, from the link's axes to the carried ones.
    placements : name of a link -> (4, 4) its placement in the frame carried before it [m].
    """

    limb: Limb
    rotations: Mapping[str, FloatArray]
    placements: Mapping[str, FloatArray]

    @property
    def name(self) -> str:
        """Name of the limb."""
        return self.limb.name

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the links from base to tip, then of the attachment."""
        return (*(link.name for link in self.limb.links), self.limb.attachment.name)


def place_limb(
    name: str,
    steps: tuple[JointPlacement, ...],
    tip: FloatArray,
    ending: str,
    attachment: FloatArray,
    length: float = 0.0,
    actuator: str | None = None,
    cones: tuple[Cone, ...] = (),
) -> PlacedLimb:
    """Return a limb made of its joints, its tip and its attachment.

    Parameters
    ----------
    steps : the joints from base to tip; the first placement is in the base frame.
    tip : (4, 4) of the tip in the last carried frame [m]; its link is called `tip`, or `base` if
        the limb has no joints.
    attachment : (4, 4) in the platform frame [m]; its link is called `platform`.
    length, actuator, cones : of the rod of a `distance` ending [m].
    """
    back, links, rotations, placements = np.eye(4), [], {}, {}
    for step in steps:
        link, turn = step.joint.name, frame_from_axis(step.axis, step.joint.name)
        links.append(Link(link, back @ step.place @ rotation_matrix(turn)))
        rotations[link], placements[link] = turn, step.place
        back = rotation_matrix(turn.T)
    last = "tip" if steps else "base"
    links.append(Link(last, back @ tip))
    rotations |= {last: np.eye(3), "platform": np.eye(3)}
    placements |= {last: tip, "platform": attachment}
    joints, end = tuple(step.joint for step in steps), Link("platform", attachment)
    limb = Limb(name, tuple(links), joints, ending, end, length, actuator, cones)
    return PlacedLimb(limb, rotations, placements)


def place_limb_with_ball(
    name: str,
    steps: tuple[JointPlacement, ...],
    center: FloatArray,
    attachment: FloatArray,
    axes: FloatArray | None,
) -> PlacedLimb:
    """Return a limb that ends in a ball joint on the platform.

    Parameters
    ----------
    center : (3,) of the ball in the last carried frame [m]. attachment : (4, 4) in the platform.
    axes : None for a perfect ball. A ball of three rotary joints z, y, x through its center, with
        errors of their own, has the orientation (3, 3) at which they are all at zero.
    """
    if axes is None:
        return place_limb(name, steps, translate(*center), "ball", attachment)
    ball = tuple(
        JointPlacement(Joint(f"ball{i + 1}", "R"), place, axis)
        for i, (place, axis) in enumerate(
            ((geometry.make_pose(axes, center), EZ), (np.eye(4), EY), (np.eye(4), EX))
        )
    )
    return place_limb(name, (*steps, *ball), np.eye(4), "rigid", attachment)


def frame_from_axis(axis: FloatArray, name: str) -> FloatArray:
    """Return a rotation (3, 3) whose third column is along `axis`.

    The axes x, y and z give a cyclic permutation.

    Raises
    ------
    MechanismError
        The axis is zero.
    """
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise MechanismError(f"joint {name!r} has the axis [0, 0, 0]; state a direction")
    z = np.asarray(axis, dtype=float) / length
    # the cyclic successor of the largest component is never parallel to the axis
    across = np.eye(3)[(int(np.argmax(np.abs(z))) + 1) % 3]
    x = across - float(across @ z) * z
    x /= float(np.linalg.norm(x))
    return np.array([x, np.cross(z, x), z], dtype=float).T


def map_displacement(
    parameter: str, limb: PlacedLimb, element: str, axis: str, coefficient: float = 1.0
) -> tuple[LinearMap, ...]:
    """Map a parameter onto a translation along, or a rotation about, an axis of the carried frame.

    A translation along x acts along up to three axes of the link's own frame: the components of
    R_carried_link' e_x.
    """
    direction = coefficient * np.eye(3)[AXES.index(axis) % 3]
    return map_direction(parameter, limb, element, direction, turns=axis in AXES[:3])


def map_direction(
    parameter: str, limb: PlacedLimb, element: str, direction: FloatArray, *, turns: bool
) -> tuple[LinearMap, ...]:
    """Map a parameter onto a rotation about (or translation along) `direction` (3,).

    The direction is in the carried frame.
    """
    components = limb.rotations[element].T @ direction
    axes = AXES[:3] if turns else AXES[3:]
    # what is below rounding of a direction is no component
    return tuple(
        LinearMap(parameter, Address(limb.name, element, axis), float(part))
        for axis, part in zip(axes, components, strict=True)
        if abs(part) > 1e-12 * np.abs(components).max()
    )


def map_slide_tilt(
    parameter: str, limb: PlacedLimb, element: str, axis: str
) -> tuple[LinearMap, ...]:
    """Map a parameter onto the tilt of a slide's axis that does not rotate what slides on it.

    exp(w) A_j [slide] A_j^-1 P A_k exp(w') keeps the orientation P A_k if w' = -(P A_k)' w. The
    translation of what is placed off the slide is compensated to first order.

    Raises
    ------
    MechanismError
        The joint is not a slide.
    """
    names = limb.elements
    place = names.index(element)
    if place >= len(limb.limb.joints) or limb.limb.joints[place].kind != "P":
        raise MechanismError(
            f"{parameter} tilts {element!r} of {limb.name!r} alone, which only a slide allows; "
            "leave out `alone: true`"
        )
    w, after = np.eye(3)[AXES.index(axis)], names[place + 1]
    behind = limb.placements[after]
    maps = map_displacement(parameter, limb, element, axis)
    maps += map_direction(parameter, limb, after, -behind[:3, :3].T @ w, turns=True)
    shift = -behind[:3, :3].T @ np.cross(w, behind[:3, 3])
    if shift.any():
        maps += map_direction(parameter, limb, after, shift, turns=False)
    return maps


def translate(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> FloatArray:
    """Return a translation (4, 4) [m]."""
    return geometry.make_pose(np.eye(3), np.array([x, y, z], dtype=float))


def rotation_matrix(rotation: FloatArray) -> FloatArray:
    """Return a rotation (3, 3) as (4, 4)."""
    return geometry.make_pose(rotation, np.zeros(3))


def rotate_about(axis: str, angle: float) -> FloatArray:
    """Return a rotation (4, 4) about x, y or z [rad]."""
    return rotation_matrix(geometry.exp_so3(angle * np.eye(3)["xyz".index(axis)]))
