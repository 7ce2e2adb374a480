# SPDX-License-Identifier: Apache-2.0
"""Closed loops of a URDF: rigid bodies, the joints between them, mobility, and a home pose in which
the loops are closed.

A closure names two revolute joints whose child links are to coincide (`closed_loop: [[A, B]]`,
`type: ['6d']`). Both turn about the same axis then, so that the two make one pin between the bodies
that carry them: T_one R(axis, q) = T_other. This is the convention of the example-parallel-robots
collection.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from loopcal import geometry
from loopcal.errors import FileError
from loopcal.io.core.yaml_file import read_yaml
from loopcal.io.formats.urdf_tree import Urdf
from loopcal.typing import FloatArray

RANK = 1e-8
"""Relative size below which a singular value of the closures counts as zero; coordinates are
written to 1e-16.
"""

CLOSED = 1e-13
"""Largest closure residual of a home pose [m, 1]."""

STARTS, STEPS, SPREAD = 24, 40, 0.6
"""Tries to close the loops, Newton steps of each, and how far from zero joints begin [rad]."""


@dataclass(frozen=True)
class Edge:
    """A joint between two bodies: `T_one` moved by it is `T_other` (4, 4), each in its body; `pin`
    where it closes a loop.

    A pin is two joints of the URDF, `name` on the first body and `far` on the other.
    """

    name: str
    kind: str
    one: str
    other: str
    T_one: FloatArray
    T_other: FloatArray
    axis: FloatArray
    pin: bool = False
    far: str = ""

    def flipped(self) -> Edge:
        """A pin seen from its other body."""
        ends = {"one": self.other, "other": self.one, "T_one": self.T_other, "T_other": self.T_one}
        return replace(self, name=self.far, far=self.name, **ends)

    def moved(self, value: float) -> FloatArray:
        """(4, 4) T_one_body of the other body's joint frame."""
        if self.kind == "P":
            return self.T_one @ geometry.make_pose(np.eye(3), value * self.axis)
        return self.T_one @ geometry.make_pose(geometry.exp_so3(value * self.axis), np.zeros(3))


@dataclass(frozen=True)
class Loops:
    """A mechanism of bodies: the tree's joints, then the pins; `motors` are driven; `values` close
    the loops.

    `homes` are the values that do, found from many starts, the ones nearest to zero first.
    """

    urdf: Urdf
    tree: tuple[Edge, ...]
    pins: tuple[Edge, ...]
    motors: tuple[str, ...]
    values: Mapping[str, float]
    homes: tuple[Mapping[str, float], ...] = ()

    @property
    def base(self) -> str:
        """The root body."""
        return self.urdf.root

    @property
    def bodies(self) -> tuple[str, ...]:
        """All rigid bodies, the base first."""
        return (self.base, *(edge.other for edge in self.tree))

    @property
    def edges(self) -> tuple[Edge, ...]:
        """All joints."""
        return self.tree + self.pins

    @cached_property
    def places(self) -> dict[str, FloatArray]:
        """Body -> (4, 4) T_base_body."""
        T = {self.base: np.eye(4)}
        for edge in self.tree:
            T[edge.other] = T[edge.one] @ edge.moved(self.values[edge.name])
        return T

    def twists(self, body: str, point: FloatArray) -> FloatArray:
        """(6, j) twist (omega, v of a point [m] of the body) for each joint of the tree."""
        T, columns = self.places, np.zeros((6, len(self.tree)))
        above = {edge.other: i for i, edge in enumerate(self.tree)}
        while body in above:
            i = above[body]
            edge = self.tree[i]
            frame = T[edge.one] @ edge.T_one
            axis = frame[:3, :3] @ edge.axis
            arm = np.cross(axis, point - frame[:3, 3])
            columns[:, i] = np.concatenate([axis, arm] if edge.kind == "R" else [np.zeros(3), axis])
            body = edge.one
        return columns

    def closure(self) -> tuple[FloatArray, FloatArray]:
        """Residuals (6 c,) [m, 1] of the pins, and their derivative (6 c, j) by the joints of the
        tree.
        """
        T, residual, rows = self.places, [], []
        for pin in self.pins:
            one, other = T[pin.one] @ pin.T_one, T[pin.other] @ pin.T_other
            a, b = one[:3, :3] @ pin.axis, other[:3, :3] @ pin.axis
            first, second = self.twists(pin.one, one[:3, 3]), self.twists(pin.other, other[:3, 3])
            residual += [one[:3, 3] - other[:3, 3], a - b]
            rows += [
                first[3:] - second[3:],
                -geometry.hat(a) @ first[:3] + geometry.hat(b) @ second[:3],
            ]
        j = len(self.tree)
        return (
            (np.concatenate(residual), np.concatenate(rows))
            if rows
            else (np.zeros(0), np.zeros((0, j)))
        )

    def motions(self) -> FloatArray:
        """(j, m) joint rates that keep the loops closed; m is the mobility."""
        _, rows = self.closure()
        if not len(rows):
            return np.eye(len(self.tree))
        _, s, V = np.linalg.svd(rows)
        return V[int((s > RANK * s[0]).sum()) :].T

    def firmness(self, platform: str) -> float:
        """How well the motors hold the other joints and move the platform: the product of two
        smallest singular values.

        The first is that of the closures by the other joints, the second that of the platform's
        position and attitude by the joint rates that keep the loops closed.
        """
        _, rows = self.closure()
        driven = np.array([edge.name in self.motors for edge in self.tree])
        passive, motions = rows[:, ~driven], self.motions()
        hold = (
            float(np.linalg.svd(passive, compute_uv=False)[passive.shape[1] - 1])
            if passive.size
            else 1.0
        )
        twists = self.twists(platform, self.places[platform][:3, 3]) @ motions
        return hold * float(np.linalg.svd(twists, compute_uv=False)[-1])

    def closed(self, begin: Mapping[str, float], held: tuple[str, ...] = ()) -> Loops | None:
        """The same with its loops closed, from joint values near; None where they do not close."""
        free = np.array([edge.name not in held for edge in self.tree])
        loops = replace(self, values=dict(begin))
        for _ in range(STEPS):
            residual, rows = loops.closure()
            if np.abs(residual).max(initial=0.0) < CLOSED:
                return loops
            step = np.zeros(len(free))
            step[free] = np.linalg.lstsq(rows[:, free], -residual, rcond=RANK)[0]
            step *= min(1.0, SPREAD / max(float(np.abs(step).max()), 1e-300))
            loops = replace(
                loops,
                values={e.name: loops.values[e.name] + step[i] for i, e in enumerate(self.tree)},
            )
        return None

    def nearby(self) -> Iterator[Loops]:
        """The pose itself and others, with the motors moved a little."""
        yield self
        for seed in range(4):
            rng = np.random.default_rng(seed)
            begin = {
                name: value + (rng.uniform(-0.15, 0.15) if name in self.motors else 0.0)
                for name, value in self.values.items()
            }
            found = self.closed(begin, self.motors)
            if found is not None:
                yield found

    def pin_value(self, pin: Edge) -> float:
        """The angle of a pin at home [rad]."""
        T = self.places
        between = geometry.invert_pose(T[pin.one] @ pin.T_one) @ T[pin.other] @ pin.T_other
        return float(geometry.log_so3(between[:3, :3]) @ pin.axis)


def read(urdf: Urdf, closures: Path) -> Loops:
    """Read the closures of a URDF and close them; FileError for what is not there, not a pin, or
    does not close.
    """
    file = read_yaml(closures, "file of loop closures")
    pairs, types, motors = (
        file.content.get(key, []) for key in ("closed_loop", "type", "name_mot")
    )
    whole = isinstance(pairs, list) and all(
        isinstance(pair, list) and len(pair) == 2 for pair in pairs
    )
    if (
        not whole
        or not isinstance(types, list)
        or not isinstance(motors, list)
        or len(types) != len(pairs)
    ):
        raise file.error(
            "write 'closed_loop:' as a list of pairs, 'type:' with one entry each, and 'name_mot:' "
            "as a list"
        )
    for i, (pair, kind) in enumerate(zip(pairs, types, strict=True)):
        for name in pair:
            if name not in urdf.joints:
                raise file.error(
                    f"the closure {name!r} is no joint of {urdf.path.name}; correct it",
                    ("closed_loop", i),
                )
        if str(kind).lower() != "6d":
            raise file.error(
                f"closure {pair[0]!r} is of type {kind!r}; loopcal reads '6d' between two revolute "
                "joints",
                ("type", i),
            )
    ends = {name for pair in pairs for name in pair}
    for name in motors:
        if name not in urdf.joints or not urdf.joints[name].kind or name in ends:
            raise file.error(
                f"the motor {name!r} is no movable joint of {urdf.path.name}; correct it",
                ("name_mot",),
            )
    if not motors:
        raise file.error("no motor is named; name the driven joints in 'name_mot:'")
    tree = _tree_edges(urdf, ends)
    pins = tuple(_pin(urdf, one, other) for one, other in pairs)
    loops = Loops(
        urdf, tree, pins, tuple(str(name) for name in motors), {edge.name: 0.0 for edge in tree}
    )
    return _home(loops, closures)


def _tree_edges(urdf: Urdf, ends: set[str]) -> tuple[Edge, ...]:
    """Movable joints of the tree, each after the one that carries it."""
    edges, bodies, waiting = (
        [],
        {urdf.root},
        [j for j in urdf.joints.values() if j.kind and j.name not in ends],
    )
    while waiting:
        ready = [joint for joint in waiting if urdf.body(joint.parent) in bodies]
        if not ready:
            raise urdf.error(
                f"joint {waiting[0].name!r} hangs on a link that a closure holds; close the loop "
                "elsewhere",
                waiting[0].name,
            )
        for joint in ready:
            place = urdf.in_body(joint.parent) @ joint.origin
            edges.append(
                Edge(
                    joint.name,
                    joint.kind,
                    urdf.body(joint.parent),
                    joint.child,
                    place,
                    np.eye(4),
                    joint.axis,
                )
            )
            bodies.add(joint.child)
        waiting = [joint for joint in waiting if joint not in ready]
    return tuple(edges)


def _pin(urdf: Urdf, first: str, second: str) -> Edge:
    """The pin that two revolute joints make whose child links coincide."""
    one, other = urdf.joints[first], urdf.joints[second]
    for joint in (one, other):
        if joint.kind != "R":
            raise urdf.error(
                f"closure joint {joint.name!r} does not turn; loopcal closes loops by revolute "
                "joints",
                joint.name,
            )
    if np.abs(one.axis - other.axis).max() > 1e-9:
        raise urdf.error(
            f"closure joints {first!r} and {second!r} turn about different axes; give them the same",
            second,
        )
    ends = [(urdf.body(j.parent), urdf.in_body(j.parent) @ j.origin) for j in (one, other)]
    return Edge(
        first, "R", ends[0][0], ends[1][0], ends[0][1], ends[1][1], one.axis, pin=True, far=second
    )


def _home(loops: Loops, closures: Path) -> Loops:
    """Close the loops as near to zero joint values as can be found, away from poses where a link
    could go either way.
    """
    found = []
    for seed in range(STARTS):
        rng = np.random.default_rng(seed)
        spread = 0.0 if seed == 0 else SPREAD
        closed = loops.closed({name: rng.uniform(-spread, spread) for name in loops.values})
        if closed is not None:
            found.append(closed)
    if not found:
        raise FileError(
            f"the loops of {loops.urdf.path.name} do not close within the joints' reach; check the "
            "closures",
            closures,
        )
    mobility = min(closed.motions().shape[1] for closed in found)
    regular = [closed for closed in found if closed.motions().shape[1] == mobility]
    nearest = sorted(regular, key=lambda closed: sum(value**2 for value in closed.values.values()))
    return replace(nearest[0], homes=tuple(closed.values for closed in nearest))
