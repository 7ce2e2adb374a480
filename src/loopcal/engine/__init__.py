# SPDX-License-Identifier: Apache-2.0
"""The engine: solve closed loops, certify solutions, reach poses, linearize, differentiate, fold.

Nothing outside this package depends on how these functions work or on which engine computes:
another engine is accepted when it passes tests/engine. All functions are pure; threads may call
them at the same time.
"""

from loopcal.engine.program import BASE as BASE
from loopcal.engine.program import CONVERGED as CONVERGED
from loopcal.engine.program import ENDINGS as ENDINGS
from loopcal.engine.program import EXHAUSTED as EXHAUSTED
from loopcal.engine.program import LENGTH as LENGTH
from loopcal.engine.program import NEAR_GOAL as NEAR_GOAL
from loopcal.engine.program import NOT_FINITE as NOT_FINITE
from loopcal.engine.program import PITCH as PITCH
from loopcal.engine.program import PLATFORM as PLATFORM
from loopcal.engine.program import STALLED as STALLED
from loopcal.engine.program import Advanced as Advanced
from loopcal.engine.program import Block as Block
from loopcal.engine.program import BlockRows as BlockRows
from loopcal.engine.program import ClosureBlocks as ClosureBlocks
from loopcal.engine.program import ComparedPoses as ComparedPoses
from loopcal.engine.program import EliminatedBlocks as EliminatedBlocks
from loopcal.engine.program import Group as Group
from loopcal.engine.program import MapPattern as MapPattern
from loopcal.engine.program import ParameterMap as ParameterMap
from loopcal.engine.program import Program as Program
from loopcal.engine.program import Reached as Reached
from loopcal.engine.program import Slot as Slot
from loopcal.engine.program import State as State
from loopcal.engine.program import Steps as Steps
from loopcal.engine.program import Structure as Structure
from loopcal.engine.program import Sums as Sums
from loopcal.engine.program import Target as Target
from loopcal.engine.program import Task as Task
from loopcal.engine.program import TwistRows as TwistRows
from loopcal.engine.selection import Engine as Engine
from loopcal.engine.selection import certify as certify
from loopcal.engine.selection import collect_versions as collect_versions
from loopcal.engine.selection import compare_poses as compare_poses
from loopcal.engine.selection import differentiate as differentiate
from loopcal.engine.selection import eliminate_blocks as eliminate_blocks
from loopcal.engine.selection import fold as fold
from loopcal.engine.selection import fold_compared as fold_compared
from loopcal.engine.selection import fold_poses as fold_poses
from loopcal.engine.selection import follow as follow
from loopcal.engine.selection import get_current_engine as get_current_engine
from loopcal.engine.selection import linearize as linearize
from loopcal.engine.selection import locate_points as locate_points
from loopcal.engine.selection import reach as reach
from loopcal.engine.selection import select_engine as select_engine
from loopcal.engine.selection import solve as solve
from loopcal.engine.selection import solve_triangles as solve_triangles
