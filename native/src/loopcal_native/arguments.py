# SPDX-License-Identifier: Apache-2.0
"""Arguments of the library: their shapes are checked, and their addresses listed."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from loopcal.engine import ParameterMap, Program, State, Sums
from loopcal.typing import FloatArray, IntArray
from loopcal_native.library import Strided, as_reals, describe, locate
from loopcal_native.programs import flatten_pattern, require


def require_start(program: Program, e: FloatArray, T: FloatArray, t: int) -> None:
    """Raise ValueError unless e and T are those of t trials that begin at one pose each."""
    require(len(e) in (1, t) and e.shape[1:] == (program.n_displacements,), f"e ({t} | 1, ..)")
    require(T.shape == (len(T), 1, 4, 4), "a start (t | 1, 1, 4, 4)")
    require(len(T) in (1, len(e)), "a start for each trial, or one")


def require_arrays(
    program: Program,
    arrays: Sequence[FloatArray],
    joints: Sequence[FloatArray],
    shape: tuple[int, int],
) -> None:
    """Raise ValueError unless e, q, T and joints are arrays of t trials and n poses."""
    t, e, q, T = shape[0], *arrays
    expected = f"e ({t} | 1, {program.n_displacements}), not {e.shape}"
    require(e.ndim == 2 and e.shape[1] == program.n_displacements, expected)
    require(len(e) in (1, t), expected)
    named = [("q", q, (program.n_joints,)), ("T", T, (4, 4))]
    for name, array, end in named:
        require_rows(name, array, end, shape)
    require_joints(program, joints, shape)


def list_joints(state: State) -> list[FloatArray]:
    """Return the joints of all groups, then the poses of the nodes but the platform."""
    return [as_reals(a) for a in (*state.joints, *state.others)]


def require_joints(program: Program, joints: Sequence[FloatArray], shape: tuple[int, int]) -> None:
    """Raise ValueError unless joints are those of all groups for t trials and n poses, and the
    poses of nodes but the platform.
    """
    count = len(program.groups) + len(program.others)
    require(len(joints) == count, f"joints of {len(program.groups)} groups, and poses of nodes")
    for group, values in zip(program.groups, joints, strict=False):
        require_rows("joints", values, (len(group.limbs), len(group.joints) + 1), shape)
    for T in joints[len(program.groups) :]:
        require_rows("T", T, (4, 4), shape)


def require_rows(
    name: str, array: FloatArray, end: tuple[int, ...], shape: tuple[int, int]
) -> None:
    """Raise ValueError unless an array is (t | 1, n | 1, ..) with this end."""
    t, n = shape
    is_right = array.ndim == 2 + len(end) and array.shape[2:] == end
    is_right = is_right and array.shape[0] in (1, t) and array.shape[1] in (1, n)
    require(is_right, f"{name} ({t} | 1, {n} | 1, {end}), not {array.shape}")


def flatten_sums(program: Program, sums: Sums, shape: tuple[int, int]) -> list[FloatArray]:
    """Return the weights and the values of sums of driven joints."""
    weights, values, (t, _) = as_reals(sums.weights), as_reals(sums.values), shape
    require(values.ndim == 3, "sums (t | 1, n | 1, r)")
    require_rows("sums", values, values.shape[2:], shape)
    expected = values.shape[2], program.n_joints
    is_right = weights.shape == (len(weights), *expected) and len(weights) in (1, t)
    require(is_right, f"weights of sums ({t} | 1, {expected}), not {weights.shape}")
    return [weights.reshape(len(weights), -1), values]


def flatten_inputs(
    program: Program,
    e: FloatArray,
    q: FloatArray,
    state: State,
    inputs: ParameterMap,
    shape: tuple[int, int],
) -> tuple[IntArray, list[FloatArray], list[FloatArray]]:
    """Return the entries of a map, e, q, T and the numbers of the map, and `list_joints`.

    They must be kept while their addresses are in use.
    """
    arrays, joints = [as_reals(a) for a in (e, q, state.T)], list_joints(state)
    require_arrays(program, arrays, joints, shape)
    entries, numbers = flatten_map(program, inputs, shape)
    return entries, [*arrays, *numbers], joints


def flatten_map(
    program: Program, inputs: ParameterMap, shape: tuple[int, int]
) -> tuple[IntArray, list[FloatArray]]:
    """Return the entries of a map and its four arrays of numbers."""
    (t, n), a = shape, program.n_joints
    pattern, basis = inputs.pattern, as_reals(inputs.basis)
    require(basis.ndim == 4, "a basis (t | 1, n | 1, joints, functions)")
    entries = flatten_pattern(program, pattern, basis.shape[3])
    coefficients = [as_reals(inputs.displacements), as_reals(inputs.joints)]
    for array, pairs in zip(coefficients, (pattern.displacements, pattern.joints), strict=True):
        is_right = array.ndim == 2 and array.shape[1] == len(pairs) and len(array) in (1, t)
        require(is_right, f"coefficients ({t} | 1, {len(pairs)}), not {array.shape}")
    readings = as_reals(inputs.readings)
    for array, end in ((basis, (a, basis.shape[3])), (readings, (a,))):
        is_right = array.shape[2:] == end and array.shape[0] in (1, t) and array.shape[1] in (1, n)
        require(is_right, f"derivatives ({t} | 1, {n} | 1, {end}), not {array.shape}")
    return entries, [*coefficients, basis, readings]


def describe_all(arrays: Sequence[FloatArray | None]) -> ctypes.Array[Strided]:
    """Return the addresses and strides of arrays; null for None."""
    described = (Strided(None, 0, 0) if a is None else describe(a) for a in arrays)
    return (Strided * len(arrays))(*described)


def list_addresses(arrays: Sequence[FloatArray]) -> ctypes.Array[ctypes.c_void_p]:
    """Return the addresses of arrays."""
    return (ctypes.c_void_p * len(arrays))(*(locate(a) for a in arrays))
