# SPDX-License-Identifier: Apache-2.0
"""The engine: solve closed loops, linearize them, fold rows into a factor. NumPy arrays only.

Nothing outside this package depends on how these three functions work: another engine is accepted
when it passes tests/engine. All functions are pure; threads may call them at the same time.
"""

from loopcal.engine.closure import linearize as linearize
from loopcal.engine.householder import fold as fold
from loopcal.engine.newton import solve as solve
from loopcal.engine.program import CONVERGED as CONVERGED
from loopcal.engine.program import LENGTH as LENGTH
from loopcal.engine.program import NEAR_GOAL as NEAR_GOAL
from loopcal.engine.program import PITCH as PITCH
from loopcal.engine.program import Block as Block
from loopcal.engine.program import ClosureBlocks as ClosureBlocks
from loopcal.engine.program import Group as Group
from loopcal.engine.program import Program as Program
from loopcal.engine.program import Slot as Slot
from loopcal.engine.program import State as State
