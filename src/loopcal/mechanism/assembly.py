# SPDX-License-Identifier: Apache-2.0
"""The generic description of a mechanism that every family expands into: limbs, actuators,
parameters and their maps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension

AXES = ("rx", "ry", "rz", "x", "y", "z")
"""Axes of a displacement in a link's own frame; `pitch` and `length` are the other two things that
can move.
"""


@dataclass(frozen=True)
class Link:
    """A link transform: takes coordinates behind the link to those before it.

    Attributes
    ----------
    name : unique in its limb.
    transform : (4, 4) nominal [m]; the joint behind it moves along or about its z axis.
    """

    name: str
    transform: FloatArray


@dataclass(frozen=True)
class Joint:
    """A joint about (R) or along (P) the z axis of the link before it.

    Attributes
    ----------
    name : unique in its limb. kind : R or P. actuator : name of what drives it, None if passive.
    pitch : advance per turn angle of a screw [m/rad], R only.
    start : value to begin from when the home position is computed [m or rad]; it picks the working
        mode.
    limits : allowed values (low, high) [m or rad].
    """

    name: str
    kind: str
    actuator: str | None = None
    pitch: float = 0.0
    start: float = 0.0
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Cone:
    """How far a rod may lean at one of its ends: within `angle` [rad] of `axis` (3,).

    `end` is `tip` (axis in the frame of the chain's tip, rod pointing to the platform) or
    `attachment` (axis in the attachment's frame, rod pointing to the tip).
    """

    end: str
    axis: tuple[float, float, float]
    angle: float


@dataclass(frozen=True)
class Limb:
    """A serial chain from the base to the platform: link, joint, link, ..., link, ending,
    attachment.

    Attributes
    ----------
    links : one more than joints. ending : rigid, ball or distance. attachment : on the platform, in
        its frame.
    length : nominal length of the rod of a `distance` ending at joint value zero [m].
    actuator : what drives that length, None for a rod of fixed length. cones : how far the rod may
        lean.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    ending: str
    attachment: Link
    length: float = 0.0
    actuator: str | None = None
    cones: tuple[Cone, ...] = ()


@dataclass(frozen=True)
class Address:
    """A number that parameters can move: a limb's link axis, pitch or rod length, or a term of an
    actuator's transmission.

    `owner` is a limb or an actuator; `element` a link or joint of the limb, `rod`, or
    `transmission`; `axis` one of AXES, `pitch`, `length`, or a term (see
    `loopcal.mechanism.transmission`).
    """

    owner: str
    element: str
    axis: str

    def __str__(self) -> str:
        return f"{self.owner}/{self.element}/{self.axis}"


@dataclass(frozen=True)
class LinearMap:
    """Map of one parameter onto one address: displacement += coefficient * (value - nominal)."""

    parameter: str
    address: Address
    coefficient: float = 1.0


class SharedMap(Protocol):
    """Map of several parameters onto several addresses by a smooth function (delta radius, tower
    angle).
    """

    @property
    def inputs(self) -> tuple[str, ...]:
        """Parameter names, i of them."""
        ...

    @property
    def outputs(self) -> tuple[Address, ...]:
        """Addresses, o of them."""
        ...

    def value(self, inputs: FloatArray) -> FloatArray:
        """(t, i) -> (t, o); what counts is the change from the value at nominal."""
        ...

    def jacobian(self, inputs: FloatArray) -> FloatArray:
        """(t, i) -> (t, o, i)."""
        ...


@dataclass(frozen=True)
class Actuator:
    """A drive with a reading.

    Attributes
    ----------
    name : column of the readings. dimension : of the reading. stroke : allowed readings (low, high)
        [m or rad].
    terms : nominal transmission, reading to joint value, by name of the term (default: joint value
        = reading).
    period : reading per turn of whatever makes the harmonics [m or rad], 0 where there are none.
    sigma : standard deviation of the reading, used to weigh redundant readings against each other
        [m or rad].
    """

    name: str
    dimension: Dimension
    stroke: tuple[float, float] | None = None
    terms: Mapping[str, float] = field(default_factory=dict)
    period: float = 0.0
    sigma: float | None = None


@dataclass(frozen=True)
class Assembly:
    """A whole mechanism, as a family's `expand` returns it.

    Attributes
    ----------
    name, source : for people. limbs, actuators : in the order of readings and tables.
    freedoms : the platform's freedoms, of AXES in base axes. controlled : coordinates the machine
        is commanded in.
    home : (4, 4) T_base_platform of the home pose; only its controlled coordinates must be exact.
    tool : (4, 4) T_platform_tool. workspace : coordinate -> (low, high) [m, rad].
    parameters, maps, shared : the unknowns and how they enter.
    """

    name: str
    limbs: tuple[Limb, ...]
    actuators: tuple[Actuator, ...]
    freedoms: tuple[str, ...]
    controlled: tuple[str, ...]
    home: FloatArray
    parameters: tuple[Parameter, ...]
    maps: tuple[LinearMap, ...]
    shared: tuple[SharedMap, ...] = ()
    tool: FloatArray = field(default_factory=lambda: np.eye(4))
    workspace: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    source: str = ""
