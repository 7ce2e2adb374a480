# SPDX-License-Identifier: Apache-2.0
"""The shared library and its functions, called through ctypes."""

from __future__ import annotations

import ctypes
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.engine import Steps as StepsOfEngine

ABI = 13
"""The C interface that this package calls; dispatch.cpp states it, too."""
APART, CHAINED, ENDING = 0, 1, 2
"""Where `loopcal_solve` begins the poses of a trial; interface.h states it, too."""
NO_MEMORY, TASK_FAILED = 1, 2
"""What functions of the library return, beside 0."""
MOST_CONDITIONS = 64
"""Conditions of a task for each row; interface.h states it, too."""

LINE = 64
"""Bytes of a line of the cache, at which arrays begin."""

ADDRESS, COUNT, INT = ctypes.c_void_p, ctypes.c_int64, ctypes.c_int


class Strided(ctypes.Structure):
    """An array (t | 1, n | 1, ..): strides of its first axes in doubles, 0 for one of length 1."""

    _fields_ = (("data", ADDRESS), ("trial", COUNT), ("pose", COUNT))


class TwistRows(ctypes.Structure):
    """Rows of poses, see interface.h."""

    _fields_ = (("count", COUNT), ("pose", ADDRESS), ("by_twist", Strided), ("residual", Strided))


class ComparedPoses(ctypes.Structure):
    """Measured poses, see interface.h."""

    _fields_ = (
        ("count", COUNT),
        ("height", COUNT),
        *((name, ADDRESS) for name in ("pose", "reference", "whitener")),
    )


class SolvedPoses(ctypes.Structure):
    """Addresses of a state, see interface.h."""

    _fields_ = tuple(
        (name, ADDRESS)
        for name in ("T", "joints", "residual", "iterations", "status", "sign", "strided", "factor")
    )


MOVE = ctypes.CFUNCTYPE(INT, ADDRESS)
LIMITS = StepsOfEngine._fields[3:-1]
"""Numbers by which steps end, from `widest` on."""


class Steps(ctypes.Structure):
    """Full Gauss-Newton steps, see interface.h."""

    _fields_ = (
        *((name, COUNT) for name in ("most", "height")),
        *((name, ctypes.c_double) for name in LIMITS),
        *((name, ADDRESS) for name in ("penalty", "sign")),
        ("move", MOVE),
        *((name, ADDRESS) for name in ("deviation", "cost")),
        ("change", ctypes.c_double),
        ("taken", COUNT),
    )


class BlockStructure(ctypes.Structure):
    """Blocks of unknowns and what is solved for them, see interface.h."""

    _fields_ = (
        *((name, COUNT) for name in ("count", "own", "width", "parent")),
        *((name, ADDRESS) for name in ("path", "parent_place", "inverse", "solution")),
    )


class BlockRows(ctypes.Structure):
    """Rows of blocks, see interface.h."""

    _fields_ = (
        *((name, COUNT) for name in ("structure", "count", "height", "used")),
        *((name, ADDRESS) for name in ("place", "columns")),
        *((name, Strided) for name in ("by_unknowns", "machine")),
    )


class ReachOutput(ctypes.Structure):
    """Addresses of what `loopcal_reach` returns, in the order of interface.h."""

    _fields_ = tuple(
        (name, ADDRESS) for name in ("T", "joints", "residual", "status", "sign", "arrives")
    )


class TaskAnswer(ctypes.Structure):
    """Residuals (count, conditions) and slopes (count, conditions, 6) of a task."""

    _fields_ = (("residual", ADDRESS), ("slopes", ADDRESS), ("conditions", COUNT))


TASK = ctypes.CFUNCTYPE(INT, ADDRESS, COUNT, ADDRESS, ADDRESS, ctypes.POINTER(TaskAnswer))


@cache
def load_library() -> ctypes.CDLL:
    """Load the library beside this file.

    Raises
    ------
    OSError : it is missing, belongs to another platform, or to another version of this package.
    """
    file = next(Path(__file__).parent.glob("libloopcal.*"), None)
    if file is None:
        raise OSError("its library was not built; install loopcal-native with a C++ compiler")
    library = ctypes.CDLL(str(file))
    library.loopcal_abi.restype = INT
    if library.loopcal_abi() != ABI:
        raise OSError("its library belongs to another version of it; install loopcal-native anew")
    library.loopcal_instruction_set.argtypes = (INT, ctypes.POINTER(INT))
    library.loopcal_instruction_set.restype = ctypes.c_char_p
    library.loopcal_fold.argtypes = (INT, *(ADDRESS,) * 3, *(COUNT,) * 4)
    library.loopcal_certify.argtypes = (INT, *(ADDRESS,) * 3, *(COUNT,) * 2, ADDRESS)
    library.loopcal_reach.argtypes = (INT, *(ADDRESS,) * 5, *(COUNT,) * 2)
    library.loopcal_reach.argtypes += (ctypes.POINTER(ReachOutput),)
    library.loopcal_linearize.argtypes = (INT, *(ADDRESS,) * 5, *(COUNT,) * 2)
    library.loopcal_differentiate.argtypes = (INT, *(ADDRESS,) * 7, *(COUNT,) * 2)
    library.loopcal_fold_poses.argtypes = (INT, *(ADDRESS,) * 5, ctypes.POINTER(TwistRows))
    library.loopcal_fold_poses.argtypes += (*(ADDRESS,) * 3, *(COUNT,) * 2)
    library.loopcal_fold_compared.argtypes = (INT, *(ADDRESS,) * 5)
    library.loopcal_fold_compared.argtypes += (ctypes.POINTER(ComparedPoses),)
    library.loopcal_fold_compared.argtypes += (ctypes.POINTER(SolvedPoses),)
    library.loopcal_fold_compared.argtypes += (*(ADDRESS,) * 2, *(COUNT,) * 2)
    library.loopcal_fold_compared.argtypes += (ctypes.POINTER(Steps),)
    library.loopcal_compare_poses.argtypes = (INT, *(ADDRESS,) * 3, *(COUNT,) * 2)
    library.loopcal_solve_triangles.argtypes = (INT, *(ADDRESS,) * 4, *(COUNT,) * 2)
    library.loopcal_locate_points.argtypes = (INT, *(ADDRESS,) * 5, *(COUNT,) * 3)
    library.loopcal_eliminate_blocks.argtypes = (INT, ADDRESS, COUNT, ADDRESS, *(COUNT,) * 4)
    library.loopcal_eliminate_blocks.argtypes += (ctypes.c_double, *(ADDRESS,) * 5)
    library.loopcal_solve.argtypes = (INT, *(ADDRESS,) * 4, *(COUNT,) * 3)
    library.loopcal_solve.argtypes += (INT, TASK, *(ADDRESS,) * 7)
    return library


@cache
def list_instruction_sets() -> dict[str, int]:
    """Return the instruction sets that this processor has, the fastest first, by name."""
    library, sets, works = load_library(), {}, INT(0)
    number = 0
    while (name := library.loopcal_instruction_set(number, ctypes.byref(works))) is not None:
        if works.value:
            sets[name.decode()] = number
        number += 1
    return sets


def require_done(outcome: int) -> None:
    """Raise the error that a function of the library returned."""
    if outcome == NO_MEMORY:
        raise MemoryError("the native engine has not enough memory")
    if outcome:
        raise RuntimeError(f"the native engine returned {outcome}")


def as_reals(array: np.ndarray) -> np.ndarray:
    """Return an array of doubles in one piece of memory; most arrays stay as they are."""
    return np.ascontiguousarray(array, dtype=np.float64)


def allocate(*parts: tuple[tuple[int, ...], type]) -> list[np.ndarray]:
    """Return arrays of these shapes and types, with any content, in one piece of memory.

    The C library keeps the memory of a freed array for the next one of its size. Several arrays
    would exceed what it keeps: new pages from the system cost as much as the kinematics.
    """
    at, offsets = 0, []
    for shape, kind in parts:
        offsets.append(at)
        at += -(-math.prod(shape) * np.dtype(kind).itemsize // LINE) * LINE
    memory = np.empty(at // 8)
    return [np.ndarray(*part, memory, at) for part, at in zip(parts, offsets, strict=True)]


def locate(array: np.ndarray) -> int:
    """Return the address of an array, which must be kept; a third of the time of `ctypes.data`."""
    if array.size and array.flags.writeable:
        memory: Any = array  # a buffer, which the type does not say
        return ctypes.addressof(ctypes.c_char.from_buffer(memory))
    return array.ctypes.data


def describe(array: np.ndarray) -> Strided:
    """Return the address and the strides of an array of `as_reals`, which must be kept."""
    address = locate(array)
    if array.ndim == 2:  # (t | 1, numbers)
        return Strided(address, array.shape[1] if len(array) > 1 else 0, 0)
    trials, poses = array.shape[:2]
    size = math.prod(array.shape[2:])
    return Strided(address, size * poses if trials > 1 else 0, size if poses > 1 else 0)
