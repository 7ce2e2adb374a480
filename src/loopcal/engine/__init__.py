# SPDX-License-Identifier: Apache-2.0
"""Closed loops in flat arrays: solve, linearise, accumulate. Imports numpy and nothing of loopcal.

Nothing outside this package may know how these three work: another engine is accepted by passing
tests/engine.
"""

from loopcal.engine.householder import accumulate
from loopcal.engine.program import (
    CONVERGED,
    LENGTH,
    PITCH,
    Block,
    Blocks,
    Group,
    Program,
    Slot,
    State,
)
from loopcal.engine.solve import linearise, merged, solve
from loopcal.typing import FloatArray

# fmt: off
__all__ = [
    "CONVERGED",
    "LENGTH",
    "PITCH",
    "Block",
    "Blocks",
    "FloatArray",
    "Group",
    "Program",
    "Slot",
    "State",
    "accumulate",
    "linearise",
    "merged",
    "solve",
]
