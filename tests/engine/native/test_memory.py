# SPDX-License-Identifier: Apache-2.0
"""The memory of a process does not grow with the number of calls of the native engine."""

import subprocess
import sys

import pytest

SCRIPT = """
import resource
import numpy as np
from loopcal.engine import select_engine
from tests.engine.cases import draw_map, make_case, make_pose_rows
from tests import zoo
from tests.engine.native.test_blocks import draw_rows
from loopcal.engine import Target
from loopcal.io.robot.robot_file import load_robot

engine, case = select_engine("native"), make_case(zoo.five_bar(), n=3)
arguments = case.program, case.e, case.q
R, rows = np.zeros((2, 9, 9)), np.ones((2, 12, 9))
inputs = draw_map(case.program, (1, 3), True)
rows_of_poses = make_pose_rows(engine, "five-bar", 9, 3)
zeros = np.zeros((9, *(rows_of_poses[4].pattern.parameters + 1,) * 2))

rods = make_case(load_robot("hexapod-42"), n=3)
target = Target(rods.q, (0, 1, -1, 3, 4, 5), False, rods.home.T[0, 0])
reached = engine.solve(rods.program, rods.e, rods.q, rods.home)
T, reference = np.tile(np.eye(4), (9, 3, 1, 1)), np.ones((9, 3, 12))
blocks = draw_rows(1)
unknowns = 1, len(blocks.tree.node), 5
triangle, right = np.tile(np.eye(9), (9, 1, 1)), np.ones((9, 9))

def call(times):
    for _ in range(times):
        state = engine.solve(*arguments, case.home)
        engine.linearize(*arguments, state)
        engine.differentiate(*arguments, state, inputs)
        engine.fold(R, rows)
        engine.fold_poses(zeros, *rows_of_poses)
        engine.certify(rods.program, rods.e, rods.home, reached)
        engine.compare_poses(T, reference)
        engine.solve_triangles(triangle, right)
        engine.locate_points(T, T[0, 0], None, np.ones((1, 1, 2, 3)), (-1, 6, 12))
        engine.eliminate_blocks(blocks.tree.structures, blocks.list_rows(), unknowns, 1e-10)
        engine.reach(rods.program, rods.e, target, rods.home)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

before = call(1000)
print(call(20_000) - before)
"""

ALLOWED = 512
"""[kB] growth of the peak; 100,000 calls that lose 16 bytes each would need 1600."""


@pytest.mark.evidence
def test_peak_memory_does_not_grow_in_100_000_calls(root):
    command = [sys.executable, "-c", SCRIPT]
    process = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True)
    assert int(process.stdout) <= ALLOWED
