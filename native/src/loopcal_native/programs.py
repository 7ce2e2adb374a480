# SPDX-License-Identifier: Apache-2.0
"""Programs as two flat arrays, which the library reads: `Program` in program.h."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from loopcal.engine import BASE, LENGTH, PITCH, PLATFORM, Group, MapPattern, Program
from loopcal.typing import FloatArray, IntArray

ENDINGS = {"rigid": 0, "ball": 1, "distance": 2}
ROWS = {"rigid": 6, "ball": 3, "distance": 1}
DRIVEN = 6
"""The first freedom of a limb that is a driven joint whose sums are given; program.h states it."""


class FlatProgram(NamedTuple):
    """A program as integers and reals; `unknown` joints of each group."""

    structure: IntArray
    numbers: FloatArray
    unknown: tuple[tuple[int, ...], ...]


def flatten_program(program: Program, free: bool, sums: int | None = None) -> FlatProgram:
    """Return a program as flat arrays; they are kept with it, as its groups keep derived values.

    sums : how many sums of driven joints are given in place of these; None without any.

    Raises
    ------
    ValueError : an entry points beyond the arrays of the program.
    """
    key = f"_native_{free}_{sums}"
    kept = vars(program).get(key)
    if kept is None:
        kept = vars(program)[key] = _flatten(program, free, sums)
    return kept


def _flatten(program: Program, free: bool, sums: int | None) -> FlatProgram:
    """Return a program as flat arrays, with the order of program.h."""
    freedoms = list(program.freedoms)
    require(len(freedoms) <= 6 and set(freedoms) <= set(range(6)), "freedoms of a twist")
    whole = [len(program.groups), len(program.nodes)]
    whole += [len(freedoms), program.n_displacements, program.n_joints]
    whole += [program.sigma is not None, free, sums is not None, sums or 0]
    whole += [*freedoms, *[0] * (6 - len(freedoms))]
    reals: list[FloatArray] = [np.array([program.size], float)]
    if program.sigma is not None:
        require(len(program.sigma) == program.n_joints, "one sigma for each actuator")
        reals.append(np.array(program.sigma, float))
    unknown = []
    for group in program.groups:
        unknown.append(tuple(group.unknown_joints(free)))
        _require_inside(program, group)
        whole += _list_structure(program, group, unknown[-1], sums is not None)
        reals += [group.links[:, :, :3, :3].reshape(len(group.limbs), -1, 9)]
        origins = group.links[:, :, :3, 3]
        reals[-1] = np.concatenate([reals[-1], origins], axis=2)
        reals += [group.pitch, group.length]
    places = [6 * node + f for node, f in program.unknown_twists]
    if sums is not None:  # driven joints are the last part of a step
        counts = (len(g.limbs) * len(own) for g, own in zip(program.groups, unknown, strict=True))
        first = 6 * len(program.nodes) + sum(counts)
        places += range(first, first + program.n_joints)
    whole += [program.may_stay_open, len(places), *places]
    whole += _list_eliminations(program, unknown, sums)
    numbers = np.concatenate([np.asarray(a, np.float64).ravel() for a in reals])
    return FlatProgram(np.array(whole, np.int64), numbers, tuple(unknown))


def flatten_pattern(program: Program, pattern: MapPattern, functions: int) -> IntArray:
    """Return the entries of a map limb by limb, as `InputMap` of sensitivity.h; kept with it.

    Raises
    ------
    ValueError : an entry points beyond the arrays of the program.
    """
    kept = vars(pattern).get("_native")
    if kept is None or kept[0] is not program or kept[1] != functions:
        entries = _list_entries(program, pattern, functions)
        kept = vars(pattern)["_native"] = program, functions, entries
    return kept[2]


def _list_entries(program: Program, pattern: MapPattern, functions: int) -> IntArray:
    """Return the entries of a map with a number for each lane's coefficient and basis."""
    p = pattern.parameters
    places, triples = (np.asarray(a, np.int64) for a in (pattern.displacements, pattern.joints))
    require(places.ndim == 2 and places.shape[1] == 2, "displacements (z, 2)")
    require(triples.ndim == 2 and triples.shape[1] == 3, "joints (y, 3)")
    require(0 <= p < 2**31, "a number of parameters")
    for indices, ends in (
        (places, (program.n_displacements, p)),
        (triples, (program.n_joints, functions, p)),
    ):
        inside = (indices >= 0).all() and (indices < np.array(ends)).all()
        require(bool(inside), "entries of its displacements, joints, functions and parameters")
    of_limbs = [np.array([p, functions], np.int64)]
    for group in program.groups:
        slots, first = len(group.slots), group.columns.start or 0
        for k in range(len(group.limbs)):
            begin = first + k * slots
            own = np.flatnonzero((places[:, 0] >= begin) & (places[:, 0] < begin + slots))
            none = np.full(len(own), -1)
            parts = [np.column_stack([places[own, 0] - begin, places[own, 1], own, none])]
            for j in np.flatnonzero(group.actuator[:, k] >= 0):
                own = np.flatnonzero(triples[:, 0] == group.actuator[j, k])
                joint, function, parameter = triples[own].T
                column = np.full(len(own), slots + j)
                basis = joint * functions + function
                parts.append(np.column_stack([column, parameter, own, basis]))
            entries = np.concatenate(parts)
            entries = entries[np.argsort(entries[:, 0], kind="stable")]
            of_limbs += [np.array([len(entries)]), entries.ravel()]
    return np.concatenate(of_limbs).astype(np.int64)


def _list_eliminations(
    program: Program, unknown: Sequence[tuple[int, ...]], sums: int | None
) -> list[int]:
    """Return rows and columns of the elimination of each node, as `Elimination` of program.h; the
    rows have the order of the NumPy engine, so that determinants have equal signs.
    """
    drives = len(program.nodes)  # the number of the node of driven joints
    columns: dict[int, list[int]] = {node: [] for node in range(drives + 1)}
    for i, (node, _) in enumerate(program.unknown_twists):
        columns[node].append(i)
    twists, order = len(program.unknown_twists), program.elimination_order
    if sums is not None:
        columns[drives] = list(range(twists, twists + program.n_joints))
        order = (*order[:-1], drives, order[-1])
    fronts: list[tuple[tuple[int, ...], list[int]]] = []
    first = 0
    for group, joints in zip(program.groups, unknown, strict=True):
        count, ends = (
            max(len(group.rows) - len(joints), 0),
            list(zip(group.on, group.to, strict=True)),
        )
        for pair in dict.fromkeys(ends):
            own = [k for k, other in enumerate(ends) if other == pair]
            rows = [first + count * k + i for k in own for i in range(count)]
            nodes = tuple(node for node in pair if node != BASE)
            fronts.append((nodes if sums is None else (*nodes, drives), rows))
        first += count * len(ends)
    if sums is not None:
        fronts.append(((drives,), list(range(first, first + sums))))
        first += sums
    begin, alone, out = first, fronts.copy(), []
    for node in order:
        own = [front for front in fronts if node in front[0]]
        near = sorted({other for nodes, _ in own for other in nodes} - {node})
        rows = [row for _, of_front in own for row in of_front]
        while len(rows) < len(columns[node]):
            rows.append(first)
            first += 1
        used = [column for other in (node, *near) for column in columns[other]]
        out += [len(columns[node]), len(rows), len(used), *rows, *used]
        fronts = [front for front in fronts if node not in front[0]]
        fronts.append((tuple(near), rows[len(columns[node]) :]))
    task = sum(len(rows) for nodes, rows in alone if nodes == (PLATFORM,))
    if len(order) == 1:
        return [0, 0]
    return [first - begin, task, *out]


def _list_structure(
    program: Program, group: Group, unknown: tuple[int, ...], frees_drives: bool
) -> list[int]:
    """Return the integers of a group."""
    joints, links = len(group.joints), len(group.joints) + 2
    turned = {slot.element for slot in group.slots if slot.axis < 3}
    advancing = {slot.element for slot in group.slots if slot.axis == PITCH}
    first = group.columns.start or 0
    out = [len(group.limbs), joints, ENDINGS[group.ending], len(group.rows), len(group.slots)]
    ends = (group.on[0], group.to[0])
    begun, ended = ([] if node == BASE else list(program.nodes[node]) for node in ends)
    place = {twist: i for i, twist in enumerate(program.unknown_twists)}
    driven = group.driven_joints if frees_drives else []
    out += [len(unknown), first, len(begun), len(begun + ended + driven), *begun, *ended]
    out += [DRIVEN + j for j in driven]
    out += [end for pair in zip(group.on, group.to, strict=True) for end in pair]
    for k, (on, to) in enumerate(zip(group.on, group.to, strict=True)):
        out += [place[on, f] for f in begun] + [place[to, f] for f in ended]
        out += [len(place) + int(group.actuator[j, k]) for j in driven]
    out += group.rows
    out += [letter == "R" for letter in group.joints]
    out += [*unknown, *group.actuator.ravel().tolist()]
    out += [value for slot in group.slots for value in (slot.element, slot.axis)]
    out += [j in turned or not group.has_plain_link[j] for j in range(links)]
    out += [j in turned for j in range(links)]
    out += [j in advancing or bool(group.pitch[:, j].any()) for j in range(joints)]
    return out


def _require_inside(program: Program, group: Group) -> None:
    """Raise ValueError where an index of a group is not one of its arrays."""
    limbs, joints = len(group.limbs), len(group.joints)
    require(group.ending in ENDINGS, "an ending: rigid, ball or distance")
    require(set(group.joints) <= {"R", "P"}, "joints R and P")
    require(group.links.shape == (limbs, joints + 2, 4, 4), "links (k, J + 2, 4, 4)")
    require(group.pitch.shape == (limbs, joints), "pitch (k, J)")
    require(group.length.shape == (limbs,), "length (k,)")
    require(group.actuator.shape == (joints + 1, limbs), "actuator (J + 1, k)")
    require(bool((group.actuator < program.n_joints).all()), "actuators that are columns of q")
    nodes = len(program.nodes)
    for ends in (group.on, group.to):
        require(
            len(ends) == limbs and all(-1 <= end < nodes for end in ends), "bodies of its nodes"
        )
        freedoms = {() if end == BASE else (end > 0, program.nodes[end]) for end in ends}
        require(len(freedoms) == 1, "bodies of one kind at which the limbs of a group begin or end")
    require(all(set(f) <= set(range(6)) for f in program.nodes), "freedoms of a twist")
    rows = len(group.rows)
    inside = all(0 <= row < ROWS[group.ending] for row in group.rows)
    require(0 < rows <= ROWS[group.ending] and inside, "rows of the ending")
    for slot in group.slots:
        last = {PITCH: joints - 1, LENGTH: joints}.get(slot.axis, joints + 1)
        require(0 <= slot.element <= last and 0 <= slot.axis <= LENGTH, "slots of its links")
    first, last, step = group.columns.indices(program.n_displacements)
    require(step == 1 and last - first == limbs * len(group.slots), "columns of its displacements")


def require(is_right: bool, expected: str) -> None:
    """Raise ValueError where arrays do not have the shapes of the interface."""
    if not is_right:
        raise ValueError(f"the native engine expects {expected}")
