# SPDX-License-Identifier: Apache-2.0
"""What the engine is told of a mechanism: its structure, apart from every number that is estimated.

A limb is a chain from the base to a tip (link 0, joint 0, link 1, ..., link J) and one ending that
ties the tip to an attachment frame on the platform: `rigid` (6 rows: rotation times the size,
position), `ball` (3: position) or `distance` (1: |attachment - tip| - length). A joint moves along
or about the z axis of the frame it stands in: `R` turns by theta and advances by pitch * theta, `P`
advances by theta. Limbs of one structure form a group and are evaluated together. The rod of a
`distance` ending counts as joint J, whose value is added to the rod's length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopcal.typing import FloatArray, IntArray

PITCH, LENGTH, CONVERGED, STALLED, EXHAUSTED, NOT_FINITE = 6, 7, 0, 1, 2, 3


@dataclass(frozen=True)
class Slot:
    """A displacement that parameters can move, in every limb of a group: `element` counts the links
    0..J and J + 1 for the attachment; `axis` is 0..5 for (rx, ry, rz, x, y, z) in that link's
    frame, PITCH of joint `element`, LENGTH of the rod.
    """

    element: int
    axis: int


@dataclass(frozen=True)
class Group:
    """Limbs of one structure: k of them, with J joints each.

    limbs : (k,) positions of these limbs in the mechanism. joints : one letter a joint, R or P.
    actuator : (J + 1, k) column of q that drives the joint, -1 where it is passive; the last row
        belongs to the rod.
    locked : (J,) joints that keep their start value: those that only spin a limb about itself.
    ending : rigid, ball or distance. rows : which of its rows count (positions in a twist); (0,)
        for distance.
    links : (k, J + 2, 4, 4) nominal link transforms, the attachment last [m].
    pitch : (k, J) nominal advance per turn angle [m/rad]. length : (k,) nominal length of the rod
        [m].
    slots : displacements present; columns : their place in e, limb by limb.
    """

    limbs: tuple[int, ...]
    joints: str
    actuator: IntArray
    locked: tuple[bool, ...]
    ending: str
    rows: tuple[int, ...]
    links: FloatArray
    pitch: FloatArray
    length: FloatArray
    slots: tuple[Slot, ...]
    columns: slice

    def unknown_joints(self, free: bool) -> list[int]:
        """Joints that closure determines: the passive ones and, if `free`, the actuated ones too."""
        driven = self.actuator[:, 0] >= 0
        passive = [j for j in range(len(self.joints)) if not driven[j] and not self.locked[j]]
        return sorted(passive + [j for j in range(len(driven)) if free and driven[j]])


@dataclass(frozen=True)
class Program:
    """A mechanism as the engine sees it.

    groups : the limbs. freedoms : positions in a twist of the platform's m freedoms.
    size : characteristic length [m]; angles times size compare with lengths.
    n_displacements, n_joints : lengths of e and of q.
    sigma : (n_joints,) standard deviations of q that weigh redundant actuators, None where there is
        no redundancy.
    """

    groups: tuple[Group, ...]
    freedoms: tuple[int, ...]
    size: float
    n_displacements: int
    n_joints: int
    sigma: tuple[float, ...] | None = None


@dataclass(frozen=True)
class State:
    """Where the mechanism stands, for t trials and n poses.

    T : (t, n, 4, 4) platform in base [m]. joints : one (t, n, k, J + 1) array a group: all joint
        values [m, rad].
    status : (t, n) CONVERGED; STALLED: no closure near here; EXHAUSTED: out of iterations;
        NOT_FINITE or singular.
    residual : (t, n) norm of the closure residual [m]. iterations : (t, n) Newton steps taken.
    closure_sign : (t, n) sign of the determinant of the closure Jacobian; it changes only through a
        singularity.
    """

    T: FloatArray
    joints: tuple[FloatArray, ...]
    status: NDArray[np.int8]
    residual: FloatArray
    iterations: IntArray
    closure_sign: NDArray[np.int8]


@dataclass(frozen=True)
class Block:
    """Linearised closure of a group in its c' rows: U dtheta + A y + E de + Q dq, shapes (t, n, k,
    c', columns).

    theta: the eliminated joints (U is triangular); y: the platform's freedoms in base axes; e, q:
    all of a limb's own.
    """

    U: FloatArray
    A: FloatArray
    E: FloatArray
    Q: FloatArray


@dataclass(frozen=True)
class ClosureBlocks:
    """Closure linearised, by group: the rows left (U is empty), the rows that give the eliminated
    joints, and these joints.
    """

    closure: tuple[Block, ...]
    passive: tuple[Block, ...]
    joints: tuple[tuple[int, ...], ...]
