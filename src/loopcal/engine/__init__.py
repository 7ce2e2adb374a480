# SPDX-License-Identifier: Apache-2.0
"""Closed loops in flat arrays: solve, linearize, fold. Imports numpy and nothing of loopcal.

Nothing outside this package may know how these three work: another engine is accepted by passing
tests/engine.
"""

from loopcal.engine.householder import fold
from loopcal.engine.program import (
    CONVERGED,
    LENGTH,
    PITCH,
    Block,
    ClosureBlocks,
    Group,
    Program,
    Slot,
    State,
)
from loopcal.engine.solve import insert_driven_values, linearize, solve
from loopcal.typing import FloatArray

# fmt: off
__all__ = [
    "CONVERGED",
    "LENGTH",
    "PITCH",
    "Block",
    "ClosureBlocks",
    "FloatArray",
    "Group",
    "Program",
    "Slot",
    "State",
    "fold",
    "linearize",
    "insert_driven_values",
    "solve",
]
