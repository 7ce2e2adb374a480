# SPDX-License-Identifier: Apache-2.0
"""A million wrong inputs for the native engine: each one is answered or refused, none ends the
process.

A sort of input is a function that draws arguments of `solve` for some rows. What it returns goes
through the C interface, and the results through `linearize` and `fold`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.engine import CONVERGED, Engine, Program, State, select_engine
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from tests.engine.cases import Case, make_case

ROWS, INPUTS = 1000, 1_000_000
REFUSALS = (ValueError, IndexError, MemoryError)
HUGE = 10**13
"""Rows of an array without memory of its own: more than any machine can hold."""

SPECIAL = np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1.7e308, 1.0, np.pi])


@dataclass(frozen=True)
class Call:
    """Arguments of `solve` for one call."""

    program: Program
    e: np.ndarray
    q: np.ndarray
    start: State


def draw_any(rng: np.random.Generator, array: np.ndarray, share: float) -> np.ndarray:
    """Replace a share of the entries by numbers of every magnitude, infinities and NaN."""
    value = rng.normal(size=array.shape) * 10.0 ** rng.uniform(-320, 308, array.shape)
    value = np.where(rng.uniform(size=array.shape) < 0.3, rng.choice(SPECIAL, array.shape), value)
    return np.where(rng.uniform(size=array.shape) < share, value, array)


def draw_numbers(rng: np.random.Generator, case: Case) -> Call:
    """Numbers of every magnitude, infinities and NaN among displacements, readings and starts."""
    share = rng.choice([0.001, 0.02, 0.3, 1.0])
    start = repeat_start(case)
    start = replace(
        start,
        T=draw_any(rng, start.T, share / 10),
        joints=tuple(draw_any(rng, a, share / 10) for a in start.joints),
    )
    return Call(case.program, draw_any(rng, case.e, share), draw_any(rng, case.q, share), start)


def draw_geometry(rng: np.random.Generator, case: Case) -> Call:
    """Links, rods and pitches of length zero, coincident joints, and frames that do not turn."""
    groups = []
    for group in case.program.groups:
        links, none = group.links.copy(), rng.uniform(size=group.links.shape[:2]) < 0.5
        links[none, :3, 3] = 0.0
        if rng.uniform() < 0.3:
            links[:, :, :3, :3] = np.eye(3)
        length = np.where(rng.uniform(size=group.length.shape) < 0.5, 0.0, group.length)
        pitch = np.where(rng.uniform(size=group.pitch.shape) < 0.5, 0.0, group.pitch)
        groups.append(replace(group, links=links, length=length, pitch=pitch))
    program = replace(case.program, groups=tuple(groups))
    return Call(program, case.e, case.q * rng.choice([0.0, 1.0, 100.0]), repeat_start(case))


def draw_poses(rng: np.random.Generator, case: Case) -> Call:
    """Starts far away, at the origin, without a rotation, or where limbs have no length."""
    start = repeat_start(case)
    T, scale = start.T.copy(), rng.choice([0.0, 1.0, 1e3, 1e150], len(start.T))
    T[..., :3, 3] *= scale[:, None, None]
    T[..., :3, :3] *= rng.choice([1.0, 0.0, -1.0], len(T))[:, None, None, None]
    factors = rng.choice([0.0, 1.0, np.pi, 1e16], len(T))[:, None, None, None]
    joints = tuple(a * factors for a in start.joints)
    return Call(case.program, case.e, case.q, replace(start, T=T, joints=joints))


def draw_shapes(rng: np.random.Generator, case: Case) -> Call:
    """One array with an axis too many or too few, other lengths, or more rows than memory."""
    start = case.home
    arrays = {"e": case.e[:3], "q": case.q[:3], "T": start.T, "joints": start.joints[0]}
    name = str(rng.choice(list(arrays)))
    wrong = _deform(rng, arrays[name])
    arrays[name] = wrong
    joints = (arrays["joints"], *start.joints[1:])
    start = replace(start, T=arrays["T"], joints=joints)
    return Call(case.program, arrays["e"], arrays["q"], start)


def _deform(rng: np.random.Generator, array: np.ndarray) -> np.ndarray:
    """Return an array of another shape."""
    axis = int(rng.integers(array.ndim))
    ways: tuple[Callable[[], np.ndarray], ...] = (
        lambda: array[None],
        lambda: array.sum(axis=axis),
        lambda: np.concatenate([array, array.take([0] * int(rng.integers(1, 9)), axis)], axis),
        lambda: array.take(range(array.shape[axis] - 1), axis),
        lambda: np.broadcast_to(array[:1], (HUGE, *array.shape[1:])),
        lambda: array.astype(np.int32).reshape(-1),
    )
    return ways[int(rng.integers(len(ways)))]()


def repeat_start(case: Case) -> State:
    """Return the start of a case with a row of its own for each trial."""
    rows = len(case.q)
    joints = tuple(np.repeat(a, rows, axis=0) for a in case.home.joints)
    return replace(case.home, T=np.repeat(case.home.T, rows, axis=0), joints=joints)


SORTS: dict[str, tuple[Callable[[np.random.Generator, Case], Call], float, int]] = {
    "numbers of every size, infinities, NaN": (draw_numbers, 0.5, ROWS),
    "degenerate geometry: lengths of zero, coincident joints": (draw_geometry, 0.2, ROWS),
    "starts that are singular, huge or no rotations": (draw_poses, 0.2, ROWS),
    "wrong shapes and huge counts": (draw_shapes, 0.1, 1),
}
"""Sort: function, share of all inputs, rows of a call."""


def count_answers(inputs: int = INPUTS) -> dict[str, Any]:
    """Return how many inputs of each sort were answered, converged, and refused."""
    native, rows = select_engine("native"), []
    cases = [make_case(load_robot(name), t=ROWS, n=1) for name in list_shipped_robots()]
    with np.errstate(all="ignore"):
        for sort, (draw, share, of_call) in SORTS.items():
            rng, counts = np.random.default_rng(len(sort)), np.zeros(4, dtype=np.int64)
            for i in range(round(share * inputs / of_call)):
                counts += _answer(native, draw(rng, cases[i % len(cases)]), of_call)
            rows.append([sort, int(counts[:2].sum()), *(int(count) for count in counts)])
    return {
        "columns": [
            "inputs",
            "number",
            "answered",
            "refused",
            "converged",
            "converged, not finite",
        ],
        "formats": ["", "d", "d", "d", "d", "d"],
        "rows": rows,
    }


def _answer(native: Engine, call: Call, count: int) -> np.ndarray:
    """Return how many inputs of a call were answered, refused, converged, and not finite then."""
    try:
        state = native.solve(call.program, call.e, call.q, call.start, max_iterations=30)
        blocks = native.linearize(call.program, call.e, call.q, state)
    except REFUSALS:
        return np.array([0, count, 0, 0])
    rows = blocks.closure[0].E
    rows = rows.reshape(len(rows), math.prod(rows.shape[1:-1]), rows.shape[-1])  # there may be none
    native.fold(np.zeros((len(rows), rows.shape[2], rows.shape[2])), rows)
    closed = state.status == CONVERGED
    wrong = closed & ~np.isfinite(state.T).all(axis=(2, 3))
    return np.array([count, 0, min(int(closed.sum()), count), int(wrong.sum())])
