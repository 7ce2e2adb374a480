# SPDX-License-Identifier: Apache-2.0
"""Writing a limb as people see it: joints placed in the frame carried so far, about any axis.

The engine's joints all move along the z axis of the frame they stand in, so a link takes in two
turns, T_j = A_{j-1}^-1 P_j A_j: P_j places the joint in the carried frame, A_j turns z onto its
axis. At joint values zero the carried frame is the base frame displaced by the placements alone.
Derivation: docs/theory/parameters.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import AXES, Address, Cone, Joint, Limb, LinearMap, Link
from loopcal.typing import FloatArray

EX, EY, EZ = np.eye(3)


@dataclass(frozen=True)
class Step:
    """A joint of a limb, as people place it.

    Attributes
    ----------
    name : of the joint and of the link before it. kind : R or P.
    place : (4, 4) of the joint in the frame carried so far [m].
    axis : (3,) in the placed frame, of any length but zero.
    actuator, pitch, start, limits : as in `loopcal.mechanism.assembly.Joint`.
    """

    name: str
    kind: str
    place: FloatArray
    axis: FloatArray
    actuator: str | None = None
    pitch: float = 0.0
    start: float = 0.0
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Placed:
    """A limb for the engine, with the frames that its file speaks of.

    Attributes
    ----------
    turns : name of a link -> (3, 3) R_carried_link, the rotation that takes the link's own axes to
        the carried ones.
    places : name of a link -> (4, 4) its placement in the frame carried before it [m].
    """

    limb: Limb
    turns: Mapping[str, FloatArray]
    places: Mapping[str, FloatArray]

    @property
    def name(self) -> str:
        """Name of the limb."""
        return self.limb.name

    @property
    def elements(self) -> tuple[str, ...]:
        """Links from base to tip, then the attachment."""
        return (*(link.name for link in self.limb.links), self.limb.attachment.name)


def placed(
    name: str,
    steps: tuple[Step, ...],
    tip: FloatArray,
    ending: str,
    attachment: FloatArray,
    length: float = 0.0,
    actuator: str | None = None,
    cones: tuple[Cone, ...] = (),
) -> Placed:
    """A limb from its joints, its tip and its attachment.

    Parameters
    ----------
    steps : the joints from base to tip; the first placement is in the base frame.
    tip : (4, 4) of the tip in the frame carried last [m]; the link is called `tip`, or `base` in a
        limb without joints.
    attachment : (4, 4) in the platform frame [m]; the link is called `platform`.
    length, actuator, cones : of the rod of a `distance` ending [m].
    """
    back, links, joints = np.eye(4), [], []
    turns, places = {}, {}
    for step in steps:
        turn = axis_frame(step.axis, step.name)
        links.append(Link(step.name, back @ step.place @ _turned(turn)))
        joints.append(
            Joint(step.name, step.kind, step.actuator, step.pitch, step.start, step.limits)
        )
        turns[step.name], places[step.name] = turn, step.place
        back = _turned(turn.T)
    last = "tip" if steps else "base"
    links.append(Link(last, back @ tip))
    turns |= {last: np.eye(3), "platform": np.eye(3)}
    places |= {last: tip, "platform": attachment}
    limb = Limb(
        name,
        tuple(links),
        tuple(joints),
        ending,
        Link("platform", attachment),
        length,
        actuator,
        cones,
    )
    return Placed(limb, turns, places)


def axis_frame(axis: FloatArray, name: str) -> FloatArray:
    """A rotation (3, 3) whose third column is along `axis`; x, y and z give a cyclic change of
    axes.

    Raises
    ------
    MechanismError
        The axis is zero.
    """
    length = float(np.linalg.norm(axis))
    if not length > 0:
        raise MechanismError(f"joint {name!r} has the axis [0, 0, 0]; give it a direction")
    z = np.asarray(axis, dtype=float) / length
    # the cyclic successor of the largest component is never parallel to the axis
    across = np.eye(3)[(int(np.argmax(np.abs(z))) + 1) % 3]
    x = across - float(across @ z) * z
    x /= float(np.linalg.norm(x))
    return np.array([x, np.cross(z, x), z], dtype=float).T


def moved(
    parameter: str, limb: Placed, element: str, axis: str, coefficient: float = 1.0
) -> tuple[LinearMap, ...]:
    """Maps of a parameter that moves an element along, or turns it about, an axis of the frame
    carried there.

    A move along x is a move along up to three axes of the link's own frame: the components of
    R_carried_link' e_x.
    """
    return towards(
        parameter, limb, element, axis in AXES[:3], coefficient * np.eye(3)[AXES.index(axis) % 3]
    )


def towards(
    parameter: str, limb: Placed, element: str, turns: bool, direction: FloatArray
) -> tuple[LinearMap, ...]:
    """Maps of a parameter that turns an element about (or moves it along) `direction`, in the frame
    carried there.
    """
    own = limb.turns[element].T @ direction
    axes = AXES[:3] if turns else AXES[3:]
    # what is below rounding of a direction is no component
    return tuple(
        LinearMap(parameter, Address(limb.name, element, axis), float(part))
        for axis, part in zip(axes, own, strict=True)
        if abs(part) > 1e-12 * np.abs(own).max()
    )


def tilted(parameter: str, limb: Placed, element: str, axis: str) -> tuple[LinearMap, ...]:
    """Maps of a parameter that turns the axis of a sliding joint and leaves what slides on it
    unturned.

    exp(w) A_j [slide] A_j^-1 P A_k exp(w') keeps the orientation P A_k where w' = -(P A_k)' w; the
    shift of what is placed off the slide is undone to first order.

    Raises
    ------
    MechanismError
        The joint is not a sliding one.
    """
    names = limb.elements
    place = names.index(element)
    if place >= len(limb.limb.joints) or limb.limb.joints[place].kind != "P":
        raise MechanismError(
            f"{parameter} tilts {element!r} of {limb.name!r} alone, which only a sliding joint "
            "allows; let it turn what follows"
        )
    w, behind = np.eye(3)[AXES.index(axis)], limb.places[names[place + 1]]
    undo = towards(parameter, limb, names[place + 1], True, -behind[:3, :3].T @ w)
    shift = -behind[:3, :3].T @ np.cross(w, behind[:3, 3])
    back = towards(parameter, limb, names[place + 1], False, shift) if np.abs(shift).any() else ()
    return (*moved(parameter, limb, element, axis), *undo, *back)


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> FloatArray:
    """(4, 4) translation [m]."""
    return geometry.make_pose(np.eye(3), np.array([x, y, z]))


def turn_about(axis: str, angle: float) -> FloatArray:
    """(4, 4) rotation about x, y or z [rad]."""
    return _turned(geometry.exp_so3(angle * np.eye(3)["xyz".index(axis)]))


def _turned(R: FloatArray) -> FloatArray:
    return geometry.make_pose(R, np.zeros(3))
