# SPDX-License-Identifier: Apache-2.0
"""From bodies and joints to limbs: paths between base and platform that share nothing else.

Where other bodies branch from the limbs, loopcal has no form for them, with one exception: if they
do no more than keep the platform from turning (the parallelograms of a delta), the platform's
freedoms say the same, and one path for each motor is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import FileError
from loopcal.io.formats.urdf_loops import Edge, Loops

FREEDOMS = ("rx", "ry", "rz", "x", "y", "z")
MOVES = 1e-9
"""Smallest part of a motion that counts [m, rad]; rounding is below 1e-12."""

FIRM = 0.3
"""Share of the best firmness found that a home pose must have."""

Path = tuple[Edge, ...]


@dataclass(frozen=True)
class Cut:
    """The mechanism as limbs.

    Attributes
    ----------
    loops : at its home pose. platform : its body. limbs : joints of each from base to platform.
    freedoms : of the platform, in base axes.
    replaced : joints that the freedoms stand for.
    """

    loops: Loops
    platform: str
    limbs: tuple[Path, ...]
    freedoms: tuple[str, ...]
    replaced: tuple[str, ...] = ()


def cut(loops: Loops, platform: str) -> Cut:
    """Limbs of a mechanism, at the home pose nearest to zero of those where joints and platform are
    held firmly.

    Raises
    ------
    FileError
        It branches, with the joints where it does.
    """
    found, refusal = [], None
    for values in loops.homes:
        try:
            found.append(_cut(replace(loops, values=values), platform))
        except FileError as error:
            refusal = refusal or error
    if refusal is not None and not found:
        raise refusal
    firm = [one.loops.firmness(platform) for one in found]
    return next(one for one, value in zip(found, firm, strict=True) if value >= FIRM * max(firm))


def _cut(loops: Loops, platform: str) -> Cut:
    """Limbs at one home pose."""
    freedoms = _freedoms(loops, platform)
    limbs = _whole(loops, platform)
    if limbs is not None:
        return Cut(loops, platform, limbs, freedoms)
    turns = any(name.startswith("r") for name in freedoms)
    mobility = loops.motions().shape[1]
    if not turns and mobility == len(freedoms) == len(loops.motors):
        limbs = _driven(loops, platform)
    if limbs is None:
        raise _branches(loops, platform)
    used = {edge.name for limb in limbs for edge in limb}
    return Cut(
        loops,
        platform,
        limbs,
        freedoms,
        tuple(edge.name for edge in loops.edges if edge.name not in used),
    )


def _freedoms(loops: Loops, platform: str) -> tuple[str, ...]:
    """Components of twist in which the platform moves, at home or near."""
    largest = np.zeros(6)
    for near in loops.nearby():
        motion = near.twists(platform, near.places[platform][:3, 3]) @ near.motions()
        largest = np.maximum(largest, np.abs(motion).max(axis=1))
    return tuple(name for name, size in zip(FREEDOMS, largest, strict=True) if size > MOVES)


def _whole(loops: Loops, platform: str) -> tuple[Path, ...] | None:
    """Limbs that hold every body and joint; None where there are none."""
    left, limbs = list(loops.edges), []
    for first in [edge for edge in loops.edges if loops.base in (edge.one, edge.other)]:
        body, path = loops.base, [first]
        while (body := other_end(path[-1], body)) != platform:
            onward = [
                edge
                for edge in loops.edges
                if edge is not path[-1] and body in (edge.one, edge.other)
            ]
            if len(onward) != 1 or body == loops.base:
                return None
            path.append(onward[0])
        left = [edge for edge in left if edge not in path]
        limbs.append(tuple(path))
    return None if left else tuple(limbs)


def _driven(loops: Loops, platform: str) -> tuple[Path, ...] | None:
    """The shortest path through each motor on the base; None where two of them meet before the
    platform.
    """
    limbs, taken = [], {loops.base}
    for first in [edge for edge in loops.tree if edge.name in loops.motors]:
        if first.one != loops.base:
            return None
        queue: list[Path] = [(first,)]
        seen, found = {loops.base, first.other}, None
        while queue and found is None:
            path = queue.pop(0)
            body = _end(path, loops.base)
            if body == platform:
                found = path
                continue
            for edge in loops.edges:
                if body in (edge.one, edge.other) and (after := other_end(edge, body)) not in seen:
                    seen.add(after)
                    queue.append((*path, edge))
        if found is None:
            return None
        bodies = [_end(found[: i + 1], loops.base) for i in range(len(found) - 1)]
        if taken & set(bodies):
            return None
        taken |= set(bodies)
        limbs.append(found)
    return tuple(limbs)


def _branches(loops: Loops, platform: str) -> FileError:
    """The refusal, with the joints of the first body at which a limb branches."""
    for body in loops.bodies:
        names = [edge.name for edge in loops.edges if body in (edge.one, edge.other)]
        if body not in (loops.base, platform) and len(names) > 2:
            return loops.urdf.error(
                f"joints {', '.join(names)} meet in {body!r}, so a limb branches from a limb, "
                "which loopcal cannot express; "
                f"choose a platform other than {platform!r} (--platform), or leave the branch out",
                names[-1],
            )
    return FileError(
        f"no limbs join base and platform {platform!r}; choose another one (--platform)",
        loops.urdf.path,
    )


def other_end(edge: Edge, body: str) -> str:
    """The body at the other end of a joint."""
    return edge.other if body == edge.one else edge.one


def oriented(path: Path, body: str) -> Path:
    """The joints of a limb with its pins seen from the body that the way leads from."""
    found = []
    for edge in path:
        found.append(edge.flipped() if edge.pin and edge.one != body else edge)
        body = other_end(edge, body)
    return tuple(found)


def _end(path: Sequence[Edge], body: str) -> str:
    """The body that a path leads to."""
    for edge in path:
        body = other_end(edge, body)
    return body
