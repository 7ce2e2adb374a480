# SPDX-License-Identifier: Apache-2.0
"""Which parameters and readings stand in the equations of which limb: worked out once for a
mechanism.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.engine import Group, Program
from loopcal.mechanism.transmission import TERMS
from loopcal.typing import BoolArray, FloatArray, IntArray

Columns = slice | IntArray


@dataclass(frozen=True)
class LimbMap:
    """A limb's part of the maps.

    Attributes
    ----------
    own : its displacements in e. parameters : the parameters that its equations hold.
    plain : whether each of these parameters is exactly one of its displacements, in the same order
        and counted alike.
    drives : for each driven joint: the joint, its actuator, and the transmission terms that
        parameters move.
    readings : the actuators, as columns.
    """

    own: slice
    parameters: Columns
    plain: bool
    drives: tuple[tuple[int, int, tuple[int, ...]], ...]
    readings: Columns


def build_limb_maps(
    program: Program, matrix: FloatArray, touches: BoolArray
) -> tuple[tuple[LimbMap, ...], ...]:
    """The limb maps of each group, from the linear map (s, p) and which parameters may move which
    slots (s, p).
    """
    return tuple(
        tuple(_limb_map(program, g, k, matrix, touches) for k in range(len(g.limbs)))
        for g in program.groups
    )


def _limb_map(
    program: Program, group: Group, k: int, matrix: FloatArray, touches: BoolArray
) -> LimbMap:
    width = len(group.slots)
    own = slice(group.columns.start + k * width, group.columns.start + (k + 1) * width)
    touched, drives = touches[own].any(axis=0), []
    for j, columns in enumerate(group.actuator):
        if columns[k] >= 0:
            first = program.n_displacements + len(TERMS) * int(columns[k])
            terms = touches[first : first + len(TERMS)]
            touched = touched | terms.any(axis=0)
            drives.append(
                (j, int(columns[k]), tuple(int(i) for i in np.flatnonzero(terms.any(axis=1))))
            )
    places = np.flatnonzero(touched)
    linear = np.array_equal(touches[own][:, places], np.eye(width, len(places), dtype=bool))
    plain = (
        linear and width == len(places) and np.array_equal(matrix[own][:, places], np.eye(width))
    )
    return LimbMap(
        own,
        as_columns(places),
        plain,
        tuple(drives),
        as_columns(np.array([a for _, a, _ in drives], dtype=np.int64)),
    )


def as_columns(places: IntArray) -> Columns:
    """Places as a slice where they are consecutive: a view in the place of a copy."""
    if len(places) and (np.diff(places) == 1).all():
        return slice(int(places[0]), int(places[-1]) + 1)
    return places
