# SPDX-License-Identifier: Apache-2.0
"""Programs as two flat arrays, which the library reads: `Program` in program.h."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal.engine import LENGTH, PITCH, Group, MapPattern, Program
from loopcal.typing import FloatArray, IntArray

ENDINGS = {"rigid": 0, "ball": 1, "distance": 2}
ROWS = {"rigid": 6, "ball": 3, "distance": 1}


class FlatProgram(NamedTuple):
    """A program as integers and reals; `unknown` joints of each group."""

    structure: IntArray
    numbers: FloatArray
    unknown: tuple[tuple[int, ...], ...]


def flatten_program(program: Program, free: bool) -> FlatProgram:
    """Return a program as flat arrays; they are kept with it, as its groups keep derived values.

    Raises
    ------
    ValueError : an entry points beyond the arrays of the program.
    """
    key = f"_native_{free}"
    kept = vars(program).get(key)
    if kept is None:
        kept = vars(program)[key] = _flatten(program, free)
    return kept


def _flatten(program: Program, free: bool) -> FlatProgram:
    """Return a program as flat arrays, with the order of program.h."""
    freedoms = list(program.freedoms)
    require(len(freedoms) <= 6 and set(freedoms) <= set(range(6)), "freedoms of a twist")
    whole = [len(program.groups), len(freedoms), program.n_displacements, program.n_joints]
    whole += [program.sigma is not None, free, *freedoms, *[0] * (6 - len(freedoms))]
    reals: list[FloatArray] = [np.array([program.size], float)]
    if program.sigma is not None:
        require(len(program.sigma) == program.n_joints, "one sigma for each actuator")
        reals.append(np.array(program.sigma, float))
    unknown = []
    for group in program.groups:
        unknown.append(tuple(group.unknown_joints(free)))
        _require_inside(program, group)
        whole += _list_structure(group, unknown[-1])
        reals += [group.links[:, :, :3, :3].reshape(len(group.limbs), -1, 9)]
        origins = group.links[:, :, :3, 3]
        reals[-1] = np.concatenate([reals[-1], origins], axis=2)
        reals += [group.pitch, group.length]
    whole.append(program.may_stay_open)
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


def _list_structure(group: Group, unknown: tuple[int, ...]) -> list[int]:
    """Return the integers of a group."""
    joints, links = len(group.joints), len(group.joints) + 2
    turned = {slot.element for slot in group.slots if slot.axis < 3}
    advancing = {slot.element for slot in group.slots if slot.axis == PITCH}
    first = group.columns.start or 0
    out = [len(group.limbs), joints, ENDINGS[group.ending], len(group.rows), len(group.slots)]
    out += [len(unknown), first, *group.rows]
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
