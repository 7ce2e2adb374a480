# SPDX-License-Identifier: Apache-2.0
"""The native engine with each instruction set of this processor."""

import numpy as np
from loopcal_native import list_instruction_sets

from loopcal.engine import ClosureBlocks, Engine, Reached, State, select_engine
from loopcal.io.robot.robot_file import load_robot
from tests.engine.cases import Case, make_case


def make_engines() -> dict[str, Engine]:
    """Return the native engine by instruction set, the fastest first."""
    return {name: select_engine(f"native:{name}") for name in list_instruction_sets()}


def make_robot_case(name: str, t: int, n: int) -> Case:
    """Return a shipped robot with displacements of t trials and n poses near home."""
    return make_case(load_robot(name), t=t, n=n)


def list_arrays(
    result: State | Reached | ClosureBlocks | tuple | np.ndarray,
) -> dict[str, np.ndarray]:
    """Return the arrays of a result by name."""
    if isinstance(result, np.ndarray):
        return {"R": result}
    if isinstance(result, tuple):
        return {f"part {i}": array for i, array in enumerate(result)}
    if isinstance(result, Reached):
        return list_arrays(result.state) | {"arrives": result.arrives}
    if isinstance(result, State):
        named = {"joints": np.concatenate([a.ravel() for a in result.joints])}
        fields = ("T", "status", "residual", "iterations", "closure_sign")
        return named | {field: getattr(result, field) for field in fields}
    blocks = {"closure": result.closure, "passive": result.passive}
    return {
        f"{kind}.{field}": np.concatenate([getattr(block, field).ravel() for block in of_kind])
        for kind, of_kind in blocks.items()
        for field in ("U", "A", "E", "Q")
    }
