# SPDX-License-Identifier: Apache-2.0
"""The engine of this package: shapes are checked here, before the library reads any array."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version

import numpy as np

from loopcal.engine import Engine, numpy_engine
from loopcal.typing import FloatArray
from loopcal_native.library import as_reals, list_instruction_sets, load_library, require_done


def make_engine(variant: str = "") -> Engine:
    """Return the engine for an instruction set, the fastest one of this processor for `""`.

    Raises
    ------
    OSError : the library cannot be loaded. ValueError : the processor lacks the instruction set.
    """
    sets = list_instruction_sets()
    name = variant or next(iter(sets))
    if name not in sets:
        raise ValueError(f"this processor has the instruction sets {', '.join(sets)}")
    functions = NativeFunctions(sets[name])
    return Engine(
        f"native:{name}",
        version("loopcal-native"),
        numpy_engine.solve,
        numpy_engine.linearize,
        functions.fold,
    )


@dataclass(frozen=True)
class NativeFunctions:
    """The functions of the engine by one instruction set, see `loopcal.engine`."""

    instruction_set: int

    def fold(self, factor: FloatArray, rows: FloatArray) -> FloatArray:
        """Return the triangular factor R with R'R = factor'factor + rows'rows."""
        factor, rows = as_reals(factor), as_reals(rows)
        require_shapes(
            factor.ndim == 3
            and rows.ndim == 3
            and factor.shape[1] == factor.shape[2] == rows.shape[2]
            and len(rows) in (1, len(factor)),
            f"a factor (t, p, p) and rows (t | 1, m, p), not {factor.shape} and {rows.shape}",
        )
        (t, p), m, out = factor.shape[:2], rows.shape[1], np.empty_like(factor)
        stride = m * p if len(rows) == t else 0
        addresses = (a.ctypes.data for a in (factor, rows, out))
        call = load_library().loopcal_fold
        require_done(call(self.instruction_set, *addresses, t, m, p, stride))
        return out


def require_shapes(is_right: bool, expected: str) -> None:
    """Raise ValueError where arrays do not have the shapes of the interface."""
    if not is_right:
        raise ValueError(f"expected {expected}")
