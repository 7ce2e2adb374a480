# SPDX-License-Identifier: Apache-2.0
"""What the engine is told of a mechanism: its structure, apart from every number that is estimated.

A limb is a chain from the base to a tip: link 0, joint 0, link 1, ..., link J, and then one ending that ties the tip
to an attachment frame on the platform. Every joint moves along or about the z axis of the frame it stands in:
`R` turns by theta and advances by pitch * theta, `P` advances by theta. Limbs of one structure form a group and are
evaluated together. The rod of a `distance` ending counts as joint J, whose value is the rod's length.

    endings      rows of closure                                  joint J
    rigid        6: rotation (times the size), position           none
    ball         3: position                                      none
    distance     1: |attachment - tip| - length                   the length
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FREEDOMS = ("rx", "ry", "rz", "x", "y", "z")
"""The platform's freedoms in the order of a twist: rotation about the base axes, then translation along them."""


@dataclass(frozen=True)
class Slot:
    """One displacement that a parameter can move, the same in every limb of a group.

    `element` counts the links 0..J and J + 1 for the platform's attachment; `axis` is an index into (rx, ry, rz, x, y, z)
    of that link's own frame, 6 for a pitch of joint `element`, 7 for the length of the rod.
    """

    element: int
    axis: int


PITCH, LENGTH = 6, 7


@dataclass(frozen=True)
class Group:
    """Limbs of one structure: k of them, with J joints each.

    Attributes
    ----------
    limbs : (k,) positions of these limbs in the mechanism.
    joints : one letter a joint, R or P.
    actuator : (J + 1, k) column of the joint values q that drives the joint; -1 where the joint is passive. The last
        row belongs to the rod.
    held : (J + 1,) joints that keep their start value: those that only spin a limb about itself.
    ending : rigid, ball or distance.
    rows : which of the ending's rows count: positions in a twist (rigid, ball); (0,) for distance.
    links : (k, J + 2, 4, 4) nominal link transforms, the attachment last [m].
    pitch : (k, J) nominal advance per turn angle [m/rad].
    length : (k,) nominal length of the rod at q = 0 [m].
    slots : displacements present, and `columns`, their place in e: limb by limb, slot by slot.
    """

    limbs: tuple[int, ...]
    joints: str
    actuator: NDArray[np.int64]
    held: tuple[bool, ...]
    ending: str
    rows: tuple[int, ...]
    links: Array
    pitch: Array
    length: Array
    slots: tuple[Slot, ...]
    columns: slice

    @property
    def size(self) -> int:
        """Number of limbs k."""
        return len(self.limbs)

    def unknown(self, free: bool) -> list[int]:
        """Joints that closure determines: the passive ones and, if `free`, the actuated ones too."""
        last = 1 if self.ending == "distance" else 0
        return [
            j
            for j in range(len(self.joints) + last)
            if not self.held[j] and ((self.actuator[j, 0] < 0 and j < len(self.joints)) or (free and self.actuator[j, 0] >= 0))
        ]


@dataclass(frozen=True)
class Program:
    """A mechanism as the engine sees it.

    Attributes
    ----------
    groups : the limbs, grouped by structure.
    freedoms : positions in a twist of the platform's m freedoms.
    size : characteristic length [m]; angles times size compare with lengths.
    n_displacements : length of e.
    n_joints : number of actuated joint values, the length of q.
    """

    groups: tuple[Group, ...]
    freedoms: tuple[int, ...]
    size: float
    n_displacements: int
    n_joints: int


@dataclass(frozen=True)
class State:
    """Where the mechanism stands, for t trials and n poses.

    Attributes
    ----------
    T : (t, n, 4, 4) platform in base [m].
    joints : one (t, n, k, J + 1) array a group: all joint values [m, rad].
    status : (t, n) 0 converged, 1 stalled (no closure near here), 2 out of iterations, 3 not finite.
    residual : (t, n) norm of the closure residual [m].
    iterations : (t, n) Newton steps taken.
    orientation : (t, n) sign of the determinant of the closure Jacobian; it changes only through a singularity.
    """

    T: Array
    joints: tuple[Array, ...]
    status: NDArray[np.int8]
    residual: Array
    iterations: NDArray[np.int64]
    orientation: NDArray[np.int8]


@dataclass(frozen=True)
class Blocks:
    """Closure linearised at a state, passive joints eliminated: A y + sum_k (E_k de_k) + Q dq = 0.

    Attributes
    ----------
    A : (t, n, c, m) columns of the platform's freedoms; rotation and translation in base axes.
    E : one (t, n, k, r, s) array a group: the r rows of limb k against its s displacements.
    Q : one (t, n, k, r, J + 1) array a group: the same rows against its joint values (zero columns where passive).
    rows : one (k, r) integer array a group: the place of those rows in A.
    passive : one `Passive` a group: what the eliminated joints do.
    """

    A: Array
    E: tuple[Array, ...]
    Q: tuple[Array, ...]
    rows: tuple[NDArray[np.int64], ...]
    passive: tuple[Passive, ...]


@dataclass(frozen=True)
class Passive:
    """The eliminated joints of a group: U dtheta + A y + E de + Q dq = 0 with U upper triangular, u x u.

    Attributes
    ----------
    joints : the u eliminated joints. U : (t, n, k, u, u). A : (t, n, k, u, m). E : (t, n, k, u, s). Q : (t, n, k, u, J + 1).
    """

    joints: tuple[int, ...]
    U: Array
    A: Array
    E: Array
    Q: Array
