# SPDX-License-Identifier: Apache-2.0
"""Closed loops in flat arrays: solve, linearise, accumulate. Imports numpy and nothing of loopcal.

Nothing outside this package may know how these three work: another engine is accepted by passing tests/engine.
"""

from loopcal.engine.householder import accumulate as accumulate
from loopcal.engine.program import FREEDOMS as FREEDOMS
from loopcal.engine.program import LENGTH as LENGTH
from loopcal.engine.program import PITCH as PITCH
from loopcal.engine.program import Array as Array
from loopcal.engine.program import Blocks as Blocks
from loopcal.engine.program import Group as Group
from loopcal.engine.program import Passive as Passive
from loopcal.engine.program import Program as Program
from loopcal.engine.program import Slot as Slot
from loopcal.engine.program import State as State
from loopcal.engine.solve import CONVERGED as CONVERGED
from loopcal.engine.solve import EXHAUSTED as EXHAUSTED
from loopcal.engine.solve import NOT_FINITE as NOT_FINITE
from loopcal.engine.solve import STALLED as STALLED
from loopcal.engine.solve import linearise as linearise
from loopcal.engine.solve import solve as solve
