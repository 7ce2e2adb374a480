# SPDX-License-Identifier: Apache-2.0
"""The engine of this package: shapes are checked here, before the library reads any array."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopcal.engine import (
    Advanced,
    Block,
    BlockRows,
    ClosureBlocks,
    ComparedPoses,
    EliminatedBlocks,
    Engine,
    ParameterMap,
    Program,
    Reached,
    State,
    Steps,
    Structure,
    Sums,
    Target,
    Task,
    TwistRows,
)
from loopcal.engine.numpy_engine.sensitivity import differentiate as differentiate_nodes
from loopcal.engine.numpy_engine.targets import reach_by
from loopcal.typing import BoolArray, FloatArray
from loopcal_native.arguments import (
    describe_all,
    flatten_inputs,
    flatten_sums,
    list_addresses,
    list_joints,
    require_arrays,
    require_joints,
    require_rows,
    require_start,
)
from loopcal_native.library import (
    APART,
    CHAINED,
    ENDING,
    TASK_FAILED,
    ReachOutput,
    SolvedPoses,
    allocate,
    as_reals,
    list_instruction_sets,
    load_library,
    locate,
    require_done,
)
from loopcal_native.library import ComparedPoses as ComparedPosesOfLibrary
from loopcal_native.library import Steps as StepsOfLibrary
from loopcal_native.pose_rows import describe_blocks, flatten_rows
from loopcal_native.programs import flatten_program, require
from loopcal_native.tasks import NO_TASK, MoveCalls, TaskCalls
from loopcal_native.version import VERSION

MOST_STEPS = 60
"""Newton steps, as of `loopcal.engine.solve`."""


def make_engine(variant: str = "") -> Engine:
    """Return the engine for an instruction set, the fastest one of this processor for `""`.

    Raises
    ------
    OSError : the library cannot be loaded. ValueError : the processor lacks the instruction set.
    """
    sets = list_instruction_sets()
    name = variant or next(iter(sets))
    if name not in sets:
        raise ValueError(f"this processor has the instruction sets {', '.join(sets)}")
    own = NativeFunctions(sets[name])
    functions = own.solve, own.certify, own.reach, own.linearize, own.fold
    functions += own.differentiate, own.fold_poses, own.solve_triangles, own.compare_poses
    functions += own.follow, own.fold_compared, own.eliminate_blocks, own.locate_points
    return Engine(f"native:{name}", VERSION, *functions)


@dataclass(frozen=True)
class NativeFunctions:
    """The functions of the engine by one instruction set, see `loopcal.engine`."""

    instruction_set: int

    def solve(
        self,
        program: Program,
        e: FloatArray,
        q: FloatArray,
        start: State,
        task: Task | None = None,
        free: bool = False,
        max_iterations: int = 60,
        goal: State | None = None,
        sums: Sums | None = None,
        order: int = APART,
    ) -> State:
        """Find the pose and the joints that close every loop."""
        t, n = max(len(e), len(q), len(start.T)), max(q.shape[1], start.T.shape[1])
        given = list[FloatArray]()
        if sums is not None:
            t, n = max(t, *map(len, sums)), max(n, sums.values.shape[1])
            given = flatten_sums(program, sums, (t, n))
        shape = t, n
        flat = flatten_program(program, free, None if sums is None else sums.values.shape[2])
        arrays = [as_reals(e), as_reals(q), as_reals(start.T)]
        joints = list_joints(start)
        require_arrays(program, arrays, joints, shape)
        goals = None if goal is None else as_reals(goal.T)
        require(goal is None or goal.T.shape == (t, n, 4, 4), f"a goal ({t}, {n}, 4, 4)")
        T, residual, iterations, status, sign, *out = allocate(
            ((t, n, 4, 4), float),
            (shape, float),
            (shape, np.int64),
            (shape, np.int8),
            (shape, np.int8),
            *(((t, n, *a.shape[2:]), float) for a in joints),
        )
        if t * n:
            calls = TaskCalls(task) if task is not None else None
            outcome = load_library().loopcal_solve(
                self.instruction_set,
                locate(flat.structure),
                locate(flat.numbers),
                describe_all([*arrays, goals, *(given or (None, None))]),
                describe_all(joints),
                t,
                n,
                max(max_iterations, 0),
                order,
                calls.function if calls else NO_TASK,
                None,
                locate(T),
                list_addresses(out),
                *(locate(a) for a in (residual, iterations, status, sign)),
            )
            if calls is not None and outcome == TASK_FAILED:
                raise calls.error
            require_done(outcome)
        groups = len(program.groups)
        parts = tuple(out[:groups]), status, residual, iterations, sign, tuple(out[groups:])
        return State(T, *parts)

    def follow(
        self,
        program: Program,
        e: FloatArray,
        q: FloatArray,
        start: State,
        ends: bool = False,
        max_iterations: int = 60,
        sums: Sums | None = None,
    ) -> State:
        """Solve the poses of each trial one after the other."""
        order = ENDING if ends else CHAINED
        q = q if sums is None else program.list_drives(start.joints)
        return self.solve(
            program, e, q, start, max_iterations=max_iterations, sums=sums, order=order
        )

    def certify(
        self, program: Program, e: FloatArray, start: State, goal: State
    ) -> NDArray[np.int8]:
        """Return the closure signs of goals to which `solve` provably converges, else 0."""
        t, n = goal.T.shape[:2]
        sign = np.zeros((t, n), np.int8)
        if not (has_driven_rods(program) and start.T.shape[1] == 1 and t * n):
            return sign
        flat, arrays = flatten_program(program, False), [as_reals(a) for a in (e, start.T, goal.T)]
        require(goal.T.shape == (t, n, 4, 4), f"a goal ({t}, {n}, 4, 4)")
        require_start(program, arrays[0], arrays[1], t)
        outcome = load_library().loopcal_certify(
            self.instruction_set,
            locate(flat.structure),
            locate(flat.numbers),
            describe_all(arrays),
            t,
            n,
            locate(sign),
        )
        require_done(outcome)
        return sign

    def reach(self, program: Program, e: FloatArray, target: Target, start: State) -> Reached:
        """Close the loops at target poses, and find which of them the start leads to."""
        values = as_reals(target.values)
        require(values.ndim == 3, "values (t | 1, n, c)")
        if not (is_closed_at_once(program) and start.T.shape[1] == 1 and values.shape[1]):
            return reach_by(self.solve, self.certify, program, e, target, start)
        t, n = shape = max(len(e), len(values), len(start.T)), values.shape[1]
        flat = flatten_program(program, False)
        sign = np.broadcast_to(start.closure_sign, (len(start.T), 1)).astype(np.float64)
        arrays = [as_reals(e), as_reals(start.T), values, sign[..., None]]
        require_start(program, arrays[0], arrays[1], t)
        require(len(values) in (1, t), f"values ({t} | 1, {n}, c)")
        require_joints(program, start.joints, (t, 1))
        columns = np.array([*target.columns, target.torsion], np.int64)
        base = as_reals(target.base)
        require(len(columns) == 7 and max(target.columns) < values.shape[2], "columns of values")
        require(base.shape == (4, 4), "a base (4, 4)")
        T, residual, iterations, status, closure_sign, arrives, *out = allocate(
            ((t, n, 4, 4), float),
            (shape, float),
            (shape, np.int64),
            (shape, np.int8),
            (shape, np.int8),
            (shape, np.bool_),
            *(((t, n, *a.shape[2:]), float) for a in start.joints),
        )
        iterations[:] = 0
        listed = list_addresses(out)
        addresses = [locate(a) for a in (residual, status, closure_sign, arrives)]
        outcome = load_library().loopcal_reach(
            self.instruction_set,
            locate(flat.structure),
            locate(flat.numbers),
            describe_all(arrays),
            locate(columns),
            locate(base),
            t,
            n,
            ReachOutput(locate(T), ctypes.addressof(listed), *addresses),
        )
        require_done(outcome)
        state = State(T, tuple(out), status, residual, iterations, closure_sign)
        return Reached(state, arrives)

    def linearize(
        self, program: Program, e: FloatArray, q: FloatArray, state: State, free: bool = False
    ) -> ClosureBlocks:
        """Linearize closure at a state (t, n) and eliminate the passive joints."""
        t, n = shape = state.T.shape[:2]
        flat = flatten_program(program, free)
        arrays, joints = [as_reals(e), as_reals(q), as_reals(state.T)], list_joints(state)
        require_arrays(program, arrays, joints, shape)
        m, out = len(program.unknown_twists), []
        for group, unknown in zip(program.groups, flat.unknown, strict=True):
            width = len(unknown) + m + len(group.slots) + len(group.joints) + 1
            out.append(np.empty((t, n, len(group.limbs), len(group.rows), width)))
        if t * n:
            call = load_library().loopcal_linearize
            require_done(
                call(
                    self.instruction_set,
                    locate(flat.structure),
                    locate(flat.numbers),
                    describe_all([arrays[0], None if free else arrays[1], arrays[2]]),
                    describe_all(joints),
                    list_addresses(out),
                    t,
                    n,
                )
            )
        closure, passive = [], []
        for group, unknown, rows in zip(program.groups, flat.unknown, out, strict=True):
            u = len(unknown)
            cuts = [0, u, u + m, u + m + len(group.slots), rows.shape[-1]]
            for blocks, part in ((passive, rows[..., :u, :]), (closure, rows[..., u:, :])):
                blocks.append(Block(*(part[..., cuts[i] : cuts[i + 1]] for i in range(4))))
        return ClosureBlocks(tuple(closure), tuple(passive), flat.unknown)

    def differentiate(
        self,
        program: Program,
        e: FloatArray,
        q: FloatArray,
        state: State,
        inputs: ParameterMap,
        nodes: int = 1,
    ) -> tuple[FloatArray, FloatArray]:
        """Differentiate the platform in parameters and readings; NumPy does it for other nodes."""
        if nodes > 1:
            return differentiate_nodes(program, e, q, state, inputs, nodes)
        t, n = shape = state.T.shape[:2]
        flat = flatten_program(program, False)
        entries, arrays, joints = flatten_inputs(program, e, q, state, inputs, shape)
        p, a = inputs.pattern.parameters, program.n_joints
        by_parameter, by_reading = np.empty((t, n, 6, p)), np.empty((t, n, 6, a))
        if t * n:
            call = load_library().loopcal_differentiate
            require_done(
                call(
                    self.instruction_set,
                    locate(flat.structure),
                    locate(flat.numbers),
                    locate(entries),
                    describe_all(arrays),
                    describe_all(joints),
                    locate(by_parameter),
                    locate(by_reading),
                    t,
                    n,
                )
            )
        return by_parameter, by_reading

    def fold(self, factor: FloatArray, rows: FloatArray) -> FloatArray:
        """Return the triangular factor R with R'R = factor'factor + rows'rows."""
        factor, rows = as_reals(factor), as_reals(rows)
        require(
            factor.ndim == 3
            and rows.ndim == 3
            and factor.shape[1] == factor.shape[2] == rows.shape[2]
            and len(rows) in (1, len(factor)),
            f"a factor (t, p, p) and rows (t | 1, m, p), not {factor.shape} and {rows.shape}",
        )
        (t, p), m, out = factor.shape[:2], rows.shape[1], np.empty_like(factor)
        stride = m * p if len(rows) == t else 0
        addresses = (locate(a) for a in (factor, rows, out))
        call = load_library().loopcal_fold
        require_done(call(self.instruction_set, *addresses, t, m, p, stride))
        return out

    def fold_poses(
        self,
        factor: FloatArray,
        program: Program,
        e: FloatArray,
        q: FloatArray,
        state: State,
        inputs: ParameterMap,
        observed: Sequence[TwistRows],
    ) -> tuple[FloatArray, BoolArray]:
        """Fold the rows of observed poses."""
        t, n = len(factor), state.T.shape[1]
        flat = flatten_program(program, False)
        entries, arrays, joints = flatten_inputs(program, e, q, state, inputs, (t, n))
        width = inputs.pattern.parameters + 1
        factor, rows = as_reals(factor), flatten_rows(observed, t, n)
        require(factor.shape == (t, width, width), f"a factor (t, {width}, {width})")
        out, is_finite = np.empty_like(factor), np.ones((t, n), dtype=bool)
        if t * n:
            call = load_library().loopcal_fold_poses
            require_done(
                call(
                    self.instruction_set,
                    locate(flat.structure),
                    locate(flat.numbers),
                    locate(entries),
                    describe_all(arrays),
                    describe_all(joints),
                    ctypes.byref(rows.describe()),
                    locate(factor),
                    locate(out),
                    locate(is_finite),
                    t,
                    n,
                )
            )
        return (out if t * n else factor), is_finite

    def fold_compared(
        self,
        factor: FloatArray,
        program: Program,
        e: FloatArray,
        q: FloatArray,
        start: State,
        inputs: ParameterMap,
        measured: ComparedPoses,
        steps: Steps,
    ) -> Advanced:
        """Close the loops of one trial, fold the rows of its poses, and take full steps."""
        n, flat = start.T.shape[1], flatten_program(program, False)
        entries, arrays, begin = flatten_inputs(program, e, q, start, inputs, (1, n))
        p, (count, height) = inputs.pattern.parameters, measured.whitener.shape[:2]
        factor, pose = as_reals(factor), np.ascontiguousarray(measured.poses, np.int64)
        reference, whitener = as_reals(measured.reference), as_reals(measured.whitener)
        require(factor.shape == (1, p + 1, p + 1), f"a factor (1, {p + 1}, {p + 1})")
        require(start.T.shape == (1, n, 4, 4), "a start (1, n)")
        is_right = reference.shape == (count, 12) and whitener.shape == (count, height, 6)
        require(is_right and pose.shape == (count,), "measured poses (r,), (r, 12), (r, m, 6)")
        require(not count or (pose.min() >= 0 and pose.max() < n), f"poses of {n}")
        require(bool((pose[1:] >= pose[:-1]).all()), "poses in ascending order")
        sign = np.array(np.broadcast_to(start.closure_sign, (1, n)), np.int8)
        penalty = as_reals(steps.penalty)
        is_right = penalty.shape == (len(penalty), p) or not penalty.size
        require(
            is_right and steps.deviation.shape == (p,), f"a penalty (k, {p}) and a deviation ({p},)"
        )
        if steps.most:  # these move, and T, the third one, does not
            arrays = [a if i == 2 else a.copy() for i, a in enumerate(arrays)]
        parts: list[tuple[tuple[int, ...], type]] = [
            *(((1, n, 4, 4), float), ((1, n), float), ((1, n), np.int64)),
            *(((1, n), np.int8), ((1, n), np.int8), (factor.shape, float)),
            *(((1, n, *a.shape[2:]), float) for a in begin),
        ]
        finite = ((1, n), np.bool_), ((steps.most + 1, p), float), ((steps.most + 1,), float)
        is_finite, deviations, costs, *memory = allocate(*finite, *parts, *parts)
        deviations[0] = steps.deviation
        solved, kept = (SolvedPoses * 2)(), []
        for i, own in enumerate((memory[: len(parts)], memory[len(parts) :])):
            kept += [list_addresses(own[6:]), describe_all(own[6:])]
            T, *others, out = (locate(a) for a in own[:6])
            lists = (ctypes.addressof(a) for a in kept[-2:])
            solved[i] = SolvedPoses(T, next(lists), *others, next(lists), out)
        calls = MoveCalls(steps, [arrays[i] for i in (0, 1, 3, 4, 5)])
        taken = StepsOfLibrary(
            *(steps.most, len(penalty), *steps[3:-1]),
            *(locate(a) for a in (penalty, sign)),
            calls.function,
            *(locate(deviations), locate(costs), np.inf, -1),
        )
        numbers = (locate(a) for a in (pose, reference, whitener))
        outcome = load_library().loopcal_fold_compared(
            self.instruction_set,
            locate(flat.structure),
            locate(flat.numbers),
            locate(entries),
            describe_all(arrays),
            describe_all(begin),
            ComparedPosesOfLibrary(count, height, *numbers),
            solved,
            locate(factor),
            locate(is_finite),
            n,
            MOST_STEPS,
            taken,
        )
        if outcome == TASK_FAILED:
            raise calls.error
        require_done(outcome)
        last = len(parts) if taken.taken % 2 and taken.taken > 0 else 0
        T, residual, iterations, status, sign, out, *joints = memory[last : last + len(parts)]
        groups = len(program.groups)
        others = status, residual, iterations, sign, tuple(joints[groups:])
        state, end = State(T, tuple(joints[:groups]), *others), taken.taken + 1
        return Advanced(state, out, is_finite, deviations[:end], costs[:end], taken.change)

    def locate_points(
        self,
        T: FloatArray,
        stated: FloatArray,
        frame: FloatArray | None,
        points: FloatArray,
        columns: tuple[int, int, int],
    ) -> tuple[FloatArray, FloatArray]:
        """Return points of the platform in a frame, and their derivatives."""
        k, arrays = points.shape[2], [as_reals(T), None if frame is None else as_reals(frame)]
        arrays.append(as_reals(points).reshape(*points.shape[:2], 3 * k))
        shapes = [a.shape[:2] for a in arrays if a is not None]
        t, n = (0 if 0 in sizes else max(sizes) for sizes in zip(*shapes, strict=True))
        shape = t, n
        ends = ("poses", (4, 4)), ("frames", (6,)), ("points", (3 * k,))
        for (name, end), array in zip(ends, arrays, strict=True):
            if array is not None:
                require_rows(name, array, end, shape)
        of_frame, of_points, width = columns
        is_right = of_frame < 0 or (6 <= of_frame <= width - 6 and frame is not None)
        is_right = is_right and width >= 6 and (of_points < 0 or 6 <= of_points <= width - 3 * k)
        require(is_right and stated.shape == (4, 4), f"a frame (4, 4), and columns of {width}")
        stated, listed = as_reals(stated), np.array(columns, np.int64)
        x, slopes = np.empty((t, n, k, 3)), np.empty((t, n, k, 3, width))
        addresses = locate(stated), locate(listed), locate(x), locate(slopes)
        if t * n:
            call = load_library().loopcal_locate_points
            require_done(call(self.instruction_set, describe_all(arrays), *addresses, t, n, k))
        return x, slopes

    def eliminate_blocks(
        self,
        structures: Sequence[Structure],
        rows: Sequence[BlockRows],
        shape: tuple[int, int, int],
        limit: float,
    ) -> EliminatedBlocks:
        """Eliminate all unknowns from whitened rows, the innermost blocks first."""
        t, U, q = shape[0], shape[1], shape[2] + 1
        blocks = describe_blocks(structures, rows, (t, U, q))
        factor, values, length, explained, is_regular = allocate(
            *(((t, q, q), float), ((t, U, q), float), ((t, U), float), ((t,), float)),
            ((t,), np.bool_),
        )
        values[:] = 0.0  # of unknowns without a block
        results = factor, values, length, explained, is_regular
        outcome = load_library().loopcal_eliminate_blocks(
            self.instruction_set,
            blocks.structures,
            len(structures),
            blocks.rows,
            len(rows),
            *(t, U, q, limit),
            *(locate(a) for a in results),
        )
        require_done(outcome)
        return EliminatedBlocks(*results, blocks.solutions)

    def solve_triangles(
        self, triangle: FloatArray, right: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Solve upper triangular systems, and bound the inverse of their matrices."""
        triangle, right = as_reals(triangle), as_reals(right)
        require(right.ndim == 2, f"a right side (t, p), not {right.shape}")
        t, p = right.shape
        require(triangle.shape == (t, p, p), f"triangles ({t}, {p}, {p}), not {triangle.shape}")
        x, growth = np.empty_like(right), np.zeros(t)
        addresses = (locate(a) for a in (triangle, right, x, growth))
        call = load_library().loopcal_solve_triangles
        require_done(call(self.instruction_set, *addresses, t, p))
        return x, growth

    def compare_poses(self, T: FloatArray, reference: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the differences of poses, and their derivatives by twists."""
        arrays = [as_reals(T), as_reals(reference)]
        (t, n), (t_other, n_other) = (a.shape[:2] if a.ndim > 2 else (-1, -1) for a in arrays)
        shape = t, n = t_other if t == 1 else t, n_other if n == 1 else n
        require_rows("T", arrays[0], (4, 4), shape)
        require_rows("references", arrays[1], (12,), shape)
        residual, by_twist = np.empty((t, n, 6)), np.empty((t, n, 6, 6))
        addresses = locate(residual), locate(by_twist)
        if t * n:
            call = load_library().loopcal_compare_poses
            require_done(call(self.instruction_set, describe_all(arrays), *addresses, t, n))
        return residual, by_twist


def has_driven_rods(program: Program) -> bool:
    """Return whether the mechanism has six freedoms and six limbs, each a driven rod alone."""
    return (
        len(program.freedoms) == 6
        and not program.others
        and sum(len(group.limbs) for group in program.groups) == 6
        and all(
            g.ending == "distance" and not g.joints and g.actuator[0, 0] >= 0
            for g in program.groups
        )
    )


def is_closed_at_once(program: Program) -> bool:
    """Return whether `reach` of the library takes it: driven rods alone, an actuator for each."""
    kept = vars(program).get("_native_rods")
    if kept is None:
        driven = [column for group in program.groups for column in group.actuator.ravel().tolist()]
        kept = has_driven_rods(program) and sorted(driven) == list(range(program.n_joints))
        vars(program)["_native_rods"] = kept
    return kept
