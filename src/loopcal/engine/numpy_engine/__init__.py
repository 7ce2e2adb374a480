# SPDX-License-Identifier: Apache-2.0
"""The engine in NumPy: always present, and the specification of every other engine."""

from loopcal.engine.numpy_engine.certificate import certify as certify
from loopcal.engine.numpy_engine.closure import linearize as linearize
from loopcal.engine.numpy_engine.householder import fold as fold
from loopcal.engine.numpy_engine.newton import solve as solve
from loopcal.engine.numpy_engine.pose_rows import fold_poses as fold_poses
from loopcal.engine.numpy_engine.sensitivity import differentiate as differentiate
from loopcal.engine.numpy_engine.targets import reach as reach
