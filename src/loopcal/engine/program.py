# SPDX-License-Identifier: Apache-2.0
"""The input and output of the engine: the structure of a mechanism, apart from its parameters.

Nodes are bodies whose poses closure determines: the platform, and other bodies that carry three or
more joints. A limb is a chain from the base or a node to a tip (link 0, joint 0, link 1, ..., link
J) and an ending that ties the tip to an attachment frame on another node: `rigid` (6 rows: rotation
times the size, position), `ball` (3 rows: position) or `distance` (1 row: |attachment - tip| -
length). A joint moves along or about the z axis of the link frame before it: `R` turns by theta and
advances by pitch * theta, `P` advances by theta. Limbs of one structure form a group and are
evaluated together. The rod of a `distance` ending counts as joint J, whose value is added to its
length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from loopcal.typing import BoolArray, FloatArray, IntArray

PITCH, LENGTH = 6, 7
"""Values of `Slot.axis` beside the axes 0..5 of a twist."""
# Endings of a limb, with the number of their closure equations.
ENDINGS = {"rigid": 6, "ball": 3, "distance": 1}
BASE, PLATFORM = -1, 0
"""Numbers of the base and of the platform among the bodies that limbs join; the others follow."""
CONVERGED, STALLED, EXHAUSTED, NOT_FINITE = 0, 1, 2, 3
"""Values of `State.status`."""
NEAR_GOAL = 8  # the value of `State.status` of a row that comes close to a given goal

Task = Callable[[FloatArray, np.ndarray], tuple[FloatArray, FloatArray]]
"""Conditions on the pose: T (N, 3, 4), rows (N,) -> residual (N, c) [m], its slopes (N, c, 6)."""


class Sums(NamedTuple):
    """Weighted sums of driven joints, r of them, that are given in place of the joints.

    weights : (t | 1, r, n_joints). values : (t | 1, n | 1, r) [m]; the weight of an angle is a
    length.
    """

    weights: FloatArray
    values: FloatArray


class Slot(NamedTuple):
    """A displacement that parameters can move, in every limb of a group.

    element : the links 0..J, J + 1 for the attachment. axis : 0..5 for (rx, ry, rz, x, y, z) in
    that link's frame, PITCH of joint `element`, or LENGTH of the rod.
    """

    element: int
    axis: int


def _as_slice(columns: IntArray) -> IntArray | slice:
    """Return columns as a slice where each is the next one, which indexes faster."""
    first = int(columns[0])
    is_run = bool((columns == np.arange(first, first + len(columns))).all())
    return slice(first, first + len(columns)) if is_run else columns


@dataclass(frozen=True, eq=False)
class Group:
    """Limbs of one structure: k limbs with J joints each.

    limbs : (k,) positions of these limbs in the mechanism. joints : one letter a joint, R or P.
    actuator : (J + 1, k) column of q that drives the joint, -1 if passive; last row: the rod.
    locked : (J,) joints that keep their start value, because they only spin a limb about itself.
    ending : rigid, ball or distance. rows : those of its rows that count, as positions in a twist;
        (0,) for distance.
    links : (k, J + 2, 4, 4) nominal link transforms, the attachment last [m].
    pitch : (k, J) nominal advance per turn angle [m/rad]. length : (k,) nominal rod length [m].
    slots : displacements of each limb. columns : their place in e, limb by limb.
    on, to : (k,) the bodies at which the limbs begin and end: all BASE, all PLATFORM or all others.
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
    on: tuple[int, ...]
    to: tuple[int, ...]

    @cached_property
    def has_plain_link(self) -> tuple[bool, ...]:
        """Whether the nominal links 0..J + 1 do not turn in any limb."""
        return tuple(np.all(self.links[:, :, :3, :3] == np.eye(3), axis=(0, 2, 3)).tolist())

    @cached_property
    def driven_joints(self) -> list[int]:
        """The actuated joints, the rod among them."""
        return np.flatnonzero(self.actuator[:, 0] >= 0).tolist()

    def unknown_joints(self, free: bool) -> list[int]:
        """Return the joints that closure determines: passive ones, and if `free` actuated ones."""
        driven = self.actuator[:, 0] >= 0
        passive = [j for j in range(len(self.joints)) if not driven[j] and not self.locked[j]]
        return sorted(passive + [j for j in range(len(driven)) if free and driven[j]])

    def insert_driven(self, joints: FloatArray, q: FloatArray) -> FloatArray:
        """Return joint values (t, n, k, J + 1) with the actuated ones set to q (t, n, n_joints)."""
        shape = (max(len(joints), len(q)), max(joints.shape[1], q.shape[1]), *joints.shape[2:])
        out = np.array(np.broadcast_to(joints, shape))
        for j, columns in enumerate(self.actuator):
            if columns[0] >= 0:
                out[..., j] = q[:, :, columns]
        return out


@dataclass(frozen=True, eq=False)
class Program:
    """A mechanism in the form that the engine computes with.

    groups : the limbs. freedoms : positions in a twist of the platform's m freedoms.
    others : the freedoms of each node but the platform.
    size : characteristic length [m]; an angle times the size compares with a length.
    n_displacements, n_joints : lengths of e and of q.
    sigma : (n_joints,) standard deviations of q that weigh redundant actuators; None without
        redundancy.
    may_stay_open : whether the least-squares solution of more closure equations than unknowns
        counts as closed, whatever gap it leaves. It is so with redundant actuators, too.
    """

    groups: tuple[Group, ...]
    freedoms: tuple[int, ...]
    size: float
    n_displacements: int
    n_joints: int
    sigma: tuple[float, ...] | None = None
    may_stay_open: bool = False
    others: tuple[tuple[int, ...], ...] = ()

    @property
    def nodes(self) -> tuple[tuple[int, ...], ...]:
        """Freedoms of all nodes, those of the platform first."""
        return (self.freedoms, *self.others)

    @cached_property
    def widths(self) -> tuple[int, ...]:
        """Numbers of unknowns of all nodes; behind them of driven joints whose sums are given."""
        return (*map(len, self.nodes), self.n_joints)

    @cached_property
    def unknown_twists(self) -> list[tuple[int, int]]:
        """The node and the freedom of each column of A, node by node."""
        return [(node, f) for node, freedoms in enumerate(self.nodes) for f in freedoms]

    @cached_property
    def elimination_order(self) -> tuple[int, ...]:
        """The nodes in the order in which a factorization eliminates them, the platform last.

        Each is the one with the fewest neighbors among the rest, which become neighbors of each
        other: a tree is eliminated from its leaves, where no row gets longer.
        """
        near: dict[int, set[int]] = {node: set() for node in range(len(self.nodes))}
        for group in self.groups:
            for ends in zip(group.on, group.to, strict=True):
                if min(ends) >= PLATFORM:
                    near[ends[0]].add(ends[1])
                    near[ends[1]].add(ends[0])
        order: list[int] = []
        while len(near) > 1:
            node = min((i for i in near if i != PLATFORM), key=lambda i: (len(near[i]), i))
            order.append(node)
            joined = near.pop(node)
            for other in joined:
                near[other] = (near[other] | joined) - {node, other}
        return (*order, PLATFORM)

    def list_drives(self, joints: tuple[FloatArray, ...]) -> FloatArray:
        """Return values (t, n, a) of the actuated joints, of those of groups (t, n, k, J + 1)."""
        out = np.zeros((*joints[0].shape[:2], self.n_joints))
        for group, j, columns in self._drives:
            out[..., columns] = joints[group][..., j]
        return out

    @cached_property
    def _drives(self) -> list[tuple[int, int, IntArray | slice]]:
        """Return the group, the joint and the columns of q of all driven joints."""
        return [
            (g, j, _as_slice(columns))
            for g, group in enumerate(self.groups)
            for j, columns in enumerate(group.actuator)
            if columns[0] >= 0
        ]

    @cached_property
    def shared_drive_count(self) -> int:
        """Number of driven joints beyond one for each actuator."""
        driven = sum(int((columns >= 0).sum()) for g in self.groups for columns in g.actuator)
        return driven - self.n_joints

    @cached_property
    def has_square_limbs(self) -> bool:
        """Whether the limbs have as many unknown joints as equations, drives among them, where the
        platform rests: each limb for itself, or with the other nodes.
        """
        if self.others:
            return self.count_equations(free=True) == sum(map(len, self.others))
        return all(len(g.rows) == len(g.unknown_joints(free=True)) for g in self.groups)

    @cached_property
    def with_fixed_platform(self) -> Program:
        """The same limbs with a platform that stays where the start has it."""
        return replace(self, freedoms=())

    @cached_property
    def idle_groups(self) -> tuple[int, ...]:
        """Groups of limbs without a drive that constrain nothing: their joints follow the platform.

        Each has as many unknown joints as equations, such as a limb that only carries sensors.
        """
        return tuple(
            i
            for i, g in enumerate(self.groups)
            if g.actuator.max() < 0 and len(g.rows) == len(g.unknown_joints(free=False))
        )

    @cached_property
    def idle_limbs(self) -> Program:
        """The limbs of the idle groups alone, with nodes that stay where the start has them."""
        groups = tuple(self.groups[i] for i in self.idle_groups)
        return replace(self, groups=groups, freedoms=(), others=((),) * len(self.others))

    @cached_property
    def is_square(self) -> bool:
        """Whether closure with locked actuators has as many equations as the nodes freedoms."""
        return self.count_equations(free=False) == len(self.unknown_twists)

    @cached_property
    def drive_map(self) -> ParameterMap:
        """The map of no parameters, and of readings that are the values of driven joints."""
        pattern = MapPattern(0, np.zeros((0, 2), np.int64), np.zeros((0, 3), np.int64))
        none, a = np.zeros((1, 0)), self.n_joints
        return ParameterMap(pattern, none, none, np.zeros((1, 1, a, 0)), np.ones((1, 1, a)))

    def count_equations(self, *, free: bool) -> int:
        """Return the number of closure equations without passive joints, and with `free` drives."""
        return sum(len(g.limbs) * (len(g.rows) - len(g.unknown_joints(free))) for g in self.groups)


@dataclass(frozen=True, eq=False)
class State:
    """Positions of a mechanism for t trials and n poses.

    T : (t, n, 4, 4) platform in base [m]. joints : for each group all joint values
        (t, n, k, J + 1) [m, rad]. others : the other nodes in base, each (t, n, 4, 4) [m].
    status : (t, n) CONVERGED; STALLED: no closure near here; EXHAUSTED: out of iterations;
        NOT_FINITE: not finite, or singular.
    residual : (t, n) norm of the closure residual [m]. iterations : (t, n) Newton steps.
    closure_sign : (t, n) sign of the determinant of the closure Jacobian; along a continuous
        motion it changes only at a singularity.
    """

    T: FloatArray
    joints: tuple[FloatArray, ...]
    status: NDArray[np.int8]
    residual: FloatArray
    iterations: IntArray
    closure_sign: NDArray[np.int8]
    others: tuple[FloatArray, ...] = ()

    def map(self, function: Callable[..., np.ndarray], *others: State) -> Self:
        """Return the state each array of which is a function of the same array of all states."""

        def apply(*arrays: Any) -> Any:
            if isinstance(arrays[0], tuple):
                return tuple(map(apply, *arrays))
            return function(*arrays)

        made = {f.name: [getattr(s, f.name) for s in (self, *others)] for f in fields(self)}
        return replace(self, **{name: apply(*arrays) for name, arrays in made.items()})

    def select(self, shape: tuple[int, int], trial: np.ndarray, pose: np.ndarray) -> Self:
        """Return rows (trial, pose) of a state that broadcasts to a shape (t, n), as (rows, 1)."""
        return self.map(lambda a: np.broadcast_to(a, (*shape, *a.shape[2:]))[trial, pose][:, None])


@dataclass(frozen=True, eq=False)
class Target:
    """Poses of the platform, stated by coordinates: a position and R = Rz(a) Ry(b) Rx(c).

    With `torsion`, R = Rz(a) Ry(b) Rz(c - a). What is not stated are the position of `base`, angles
    of zero, and without any angle the rotation of `base`.

    values : (.., c) coordinates [m, rad], of an engine (t | 1, n, c). columns : those of x, y, z,
        a, b, c; -1 for none. base : (4, 4) [m].
    """

    values: FloatArray
    columns: tuple[int, ...]
    torsion: bool
    base: FloatArray

    @property
    def poses(self) -> FloatArray:
        """The poses (.., 4, 4) [m]."""
        T = np.array(np.broadcast_to(self.base, (*self.values.shape[:-1], 4, 4)))
        none = np.zeros(T.shape[:-2])
        at = [self.values[..., i] if i >= 0 else none for i in self.columns]
        for axis, column in enumerate(self.columns[:3]):
            if column >= 0:
                T[..., axis, 3] = at[axis]
        if max(self.columns[3:]) < 0:
            return T
        a, b, c = at[3], at[4], at[5] - at[3] if self.torsion else at[5]
        (sa, sb, sc), (ca, cb, cc) = ((f(a), f(b), f(c)) for f in (np.sin, np.cos))
        # the columns of Rz(a) Ry(b), of which the last turn combines two
        x, y, z = (ca * cb, sa * cb, -sb), (-sa, ca, none), (ca * sb, sa * sb, cb)
        for row, (i, j, k) in enumerate(zip(x, y, z, strict=True)):
            turned = (cc * i + sc * j, cc * j - sc * i, k)
            if not self.torsion:
                turned = (i, cc * j + sc * k, cc * k - sc * j)
            T[..., row, 0], T[..., row, 1], T[..., row, 2] = turned
        return T


@dataclass(frozen=True, eq=False)
class Reached:
    """Closed loops at target poses.

    state : (t, n); `closure_sign` is that with locked actuators.
    arrives : (t, n) whether its actuated joints lead from the start to the pose: `solve` converges
        to it, on the start's side of every singularity. Where it is False, nothing is known.
    """

    state: State
    arrives: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Block:
    """Linearized closure of a group, c' rows of each limb: U dtheta + A y + E de + Q dq.

    Shapes (t, n, k, c', columns). theta : the eliminated joints, with U triangular. y : the
    freedoms of all nodes in base axes, see `Program.unknown_twists`. e, q : all displacements and
    joints of the limb itself.
    """

    U: FloatArray
    A: FloatArray
    E: FloatArray
    Q: FloatArray


@dataclass(frozen=True, eq=False)
class ClosureBlocks:
    """Linearized closure of all groups, the joints of each limb eliminated.

    closure : the rows without joints (U is empty). passive : the rows that determine the
    eliminated joints. joints : these joints, group by group.
    """

    closure: tuple[Block, ...]
    passive: tuple[Block, ...]
    joints: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, eq=False)
class MapPattern:
    """Which of p parameters move which displacements and actuated joints.

    parameters : p. displacements : (z, 2) pairs of a place in e and a parameter.
    joints : (y, 3) a column of q, the number of a basis function, and a parameter.
    """

    parameters: int
    displacements: IntArray
    joints: IntArray


@dataclass(frozen=True, eq=False)
class ParameterMap:
    """Derivatives of displacements e and actuated joints q by parameters and by readings.

    de = sum of displacements * dp over the pairs of the pattern;
    dq = sum of basis * joints * dp over its triples, + readings * d reading.

    displacements : (t | 1, z). joints : (t | 1, y).
    basis : (t | 1, n | 1, n_joints, functions). readings : (t | 1, n | 1, n_joints).
    """

    pattern: MapPattern
    displacements: FloatArray
    joints: FloatArray
    basis: FloatArray
    readings: FloatArray


@dataclass(frozen=True, eq=False)
class ComparedPoses:
    """Measured poses of one trial, whose rows are W r of the differences r of `compare_poses`.

    poses : (r,) number of the pose of each measurement, ascending. reference : (r, 12) rotations
    row by row, then positions. whitener : (r, m, 6) W.
    """

    poses: IntArray
    reference: FloatArray
    whitener: FloatArray


class Steps(NamedTuple):
    """Full Gauss-Newton steps of one trial, and when they end.

    deviation : (p,) z of e, q and their map. penalty : (k, p) P of the penalty |P z|^2.
    most : steps. widest : residual of closure up to which a pose counts as closed [m].
    relative, absolute : a step is the last that changes the whitened residuals by this share of
        their norm, and all further ones by `further` of it, as the ratio of the last two lets
        expect, `slowest` at least from 1; or that is so long relative to 1 + |z|.
    accepted : share of the predicted decrease that a step must bring, with `rounding` of the sum.
    singular : share of |R| above which all singular values of R must certainly be.
    move : from z (p,) to e, q and their map; None without steps.
    """

    deviation: FloatArray
    penalty: FloatArray
    most: int = 0
    widest: float = np.inf
    relative: float = 0.0
    absolute: float = 0.0
    further: float = 0.0
    slowest: float = 0.0
    accepted: float = 0.0
    rounding: float = 0.0
    singular: float = 0.0
    move: Callable[[FloatArray], tuple[FloatArray, FloatArray, ParameterMap]] | None = None


class Advanced(NamedTuple):
    """Where full steps end: what `fold_poses` returns with the state (1, n), and the way there.

    deviations : (s + 1, p) of the s steps that were accepted, none where poses are not solved or
        lie beyond a singularity. costs : (s + 1,) sums of squares. change : of the whitened
        residuals by the last step; infinite without any.
    """

    state: State
    factor: FloatArray
    is_finite: NDArray[np.bool_]
    deviations: FloatArray
    costs: FloatArray
    change: float


@dataclass(frozen=True, eq=False)
class TwistRows:
    """Whitened rows of poses, m of each of r measurements, as the platform's twist changes them.

    poses : (r,) number of the pose of each measurement. by_twist : (t | 1, r, m, 6) derivatives.
    residual : (t, r, m).
    """

    poses: IntArray
    by_twist: FloatArray
    residual: FloatArray


@dataclass(frozen=True, eq=False)
class Structure:
    """n nodes, blocks of unknowns, with as many of them, and as many columns in their paths, each.

    unknowns : (n, u) the unknowns of each node.
    path : (n, w) the unknowns of each node, followed by those of its ancestors, innermost first.
    parent : number of the structure of the parents, -1 without any.
    parent_place : (n,) place of each node's parent in that structure.
    """

    unknowns: IntArray
    path: IntArray
    parent: int
    parent_place: IntArray

    def __len__(self) -> int:
        return len(self.unknowns)

    @property
    def width(self) -> int:
        """Number w of columns of a path."""
        return self.path.shape[1]


class BlockRows(NamedTuple):
    """Whitened rows of nodes of one structure: k sets, m rows each, of t trials.

    structure : its number. places : (k,) node of each set in it. columns : (k, c) columns of the
        node's path, w where a row has none.
    by_unknowns : (t, k, m, c). machine : (t, k, m, p + 1), residuals last.
    """

    structure: int
    places: IntArray
    columns: IntArray
    by_unknowns: FloatArray
    machine: FloatArray


class EliminatedBlocks(NamedTuple):
    """What the elimination of all unknowns leaves, where it is regular.

    factor : (t, p + 1, p + 1) upper triangular, of the rows left. values : (t, U, p + 1) best ones
        by the machine's deviations, and here. length : (t, U) of the columns over all rows, 1 for
        one of zeros. explained : (t,) decrease of the sum of squares by the best values.
    is_regular : (t,) where the rows certainly determine all unknowns.
    solutions : inverse and solution of the nodes of every structure, see `NodeSolution` of
        `loopcal.numerics.elimination`.
    """

    factor: FloatArray
    values: FloatArray
    length: FloatArray
    explained: FloatArray
    is_regular: BoolArray
    solutions: list[tuple[FloatArray, FloatArray]]
