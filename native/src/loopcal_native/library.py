# SPDX-License-Identifier: Apache-2.0
"""The shared library and its functions, called through ctypes."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

import numpy as np

ABI = 1
"""The C interface that this package calls; dispatch.cpp states it, too."""
NO_MEMORY, TASK_FAILED = 1, 2
"""What functions of the library return, beside 0."""

REAL = ctypes.c_void_p
COUNT = ctypes.c_int64


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
    library.loopcal_abi.restype = ctypes.c_int
    if library.loopcal_abi() != ABI:
        raise OSError("its library belongs to another version of loopcal-native")
    library.loopcal_instruction_set.argtypes = (ctypes.c_int, ctypes.POINTER(ctypes.c_int))
    library.loopcal_instruction_set.restype = ctypes.c_char_p
    library.loopcal_fold.argtypes = (ctypes.c_int, REAL, REAL, REAL, *(COUNT,) * 4)
    return library


@cache
def list_instruction_sets() -> dict[str, int]:
    """Return the instruction sets that this processor has, the fastest first, by name."""
    library, sets, works = load_library(), {}, ctypes.c_int(0)
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
