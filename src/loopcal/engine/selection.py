# SPDX-License-Identifier: Apache-2.0
"""Which engine computes, and the functions that call it.

The environment variable LOOPCAL_ENGINE names the engine of a process: `numpy`, or the name of an
entry point of the group `loopcal.engines`, such as `native`, with a variant of that engine behind a
colon (`native:v2`). Without the variable, the package `loopcal-native` computes where it is
installed, and NumPy elsewhere.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from loopcal.engine.program import (
    Advanced,
    BlockRows,
    ClosureBlocks,
    ComparedPoses,
    EliminatedBlocks,
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
from loopcal.errors import MissingPackageError
from loopcal.typing import BoolArray, FloatArray
from loopcal.version import __version__

# --- Keep freed memory in the process, where the next temporary array finds it.

LARGE = 3_900_000  # length of an array of float64 of 31 MB; glibc adapts its limits up to 32 MB


def keep_freed_memory() -> None:
    """Let the C library keep up to 64 MB of freed memory.

    glibc returns memory that is freed at the end of its heap to the system if it is more than twice
    the largest array freed so far. The next arrays then cost a page fault for every 4 kB, up to
    half of the time of an engine whose temporary arrays are that large. One large array, which
    is never touched, raises the limit for the rest of the process; it takes microseconds. Other C
    libraries ignore it.
    """
    np.empty(LARGE)


VARIABLE, GROUP = "LOOPCAL_ENGINE", "loopcal.engines"
"""The environment variable that names an engine, and the entry points that provide engines."""
NUMPY, NATIVE = "numpy", "native"
NATIVE_MODULE = "loopcal_native"


@dataclass(frozen=True)
class Engine:
    """An implementation of the functions whose docstrings are below.

    name : as in LOOPCAL_ENGINE, with its variant. version : of the package that computes.
    certify : None where nothing is proven. solve_triangles and those below : None where others do
        it, of the engine, of `loopcal.numerics`, of `loopcal.geometry` or of kinds.
    """

    name: str
    version: str
    solve: Callable[..., State]
    certify: Callable[..., NDArray[np.int8]] | None
    reach: Callable[..., Reached]
    linearize: Callable[..., ClosureBlocks]
    fold: Callable[[FloatArray, FloatArray], FloatArray]
    differentiate: Callable[..., tuple[FloatArray, FloatArray]]
    fold_poses: Callable[..., tuple[FloatArray, BoolArray]]
    solve_triangles: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]] | None = None
    compare_poses: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]] | None = None
    follow: Callable[..., State] | None = None
    fold_compared: Callable[..., Advanced] | None = None
    eliminate_blocks: Callable[..., EliminatedBlocks] | None = None
    locate_points: Callable[..., tuple[FloatArray, FloatArray]] | None = None

    def __str__(self) -> str:
        return f"{self.name} {self.version}"


def select_engine(choice: str = "") -> Engine:
    """Return the engine of this name, the fastest installed one without a name.

    An entry point is a function that returns an engine for a variant; `""` is its own choice.

    MissingPackageError : there is no such engine, or it does not work here.
    """
    choice = choice.strip() or (NATIVE if _is_native_installed() else NUMPY)
    name, _, variant = choice.partition(":")
    if choice == NUMPY:
        return _make_numpy_engine()
    load = _find_loader(choice, name)
    try:
        engine = load()(variant)
        if not isinstance(engine, Engine):
            raise TypeError(f"{engine!r} is not an engine")
    except Exception as cause:  # the code of others, or a record of functions of another version
        reason = "it belongs to another version of loopcal, or fails. Install both anew"
        if isinstance(cause, ImportError | OSError | ValueError):  # their texts say what to do
            reason = str(cause)
        raise MissingPackageError.of("engine.not-usable", engine=choice, reason=reason) from cause
    return engine


@cache
def _make_numpy_engine() -> Engine:
    """Return the engine in NumPy, whose modules are imported for it alone."""
    from loopcal.engine.numpy_engine.closure import linearize
    from loopcal.engine.numpy_engine.householder import fold
    from loopcal.engine.numpy_engine.newton import solve
    from loopcal.engine.numpy_engine.sensitivity import differentiate, fold_poses
    from loopcal.engine.numpy_engine.targets import reach_by

    functions = partial(reach_by, solve, None), linearize, fold, differentiate, fold_poses
    return Engine(NUMPY, np.__version__, solve, None, *functions)


def _is_native_installed() -> bool:
    """Return whether there is a package of the native engine; an empty folder is none."""
    spec = find_spec(NATIVE_MODULE)
    return spec is not None and spec.origin is not None


def _find_loader(choice: str, name: str) -> Callable[[], Callable[[str], Engine]]:
    """Return what imports the function that makes an engine; raise MissingPackageError."""
    if name == NATIVE and _is_native_installed():
        # known without a search through all installed packages, which takes 0.04 s
        return lambda: import_module(NATIVE_MODULE).make_engine
    from importlib.metadata import entry_points

    installed = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in installed:
        known = (NUMPY, *sorted(installed))
        raise MissingPackageError.of("engine.unknown", engine=choice, known=known)
    return installed[name].load


@cache
def get_current_engine() -> Engine:
    """Return the engine that LOOPCAL_ENGINE names, chosen once in a process."""
    keep_freed_memory()
    return select_engine(os.environ.get(VARIABLE, ""))


def solve(
    program: Program,
    e: FloatArray,
    q: FloatArray,
    start: State,
    task: Task | None = None,
    free: bool = False,
    max_iterations: int = 60,
    goal: State | None = None,
    sums: Sums | None = None,
) -> State:
    """Find the pose and the joints that close every loop.

    e : (t | 1, n_displacements) [m, rad].
    q : (t | 1, n, n_joints) actuated joint values [m, rad]; with `free` only their first guess.
    start : first guess, (t | 1, n | 1) rows.
    task : conditions on the pose, as many as the freed actuators leave open.
    free : solve for the actuated joints too.
    sums : solve for the actuated joints too, of which these sums are given; they begin at the
        start, and q is not read.
    goal : solutions (t, n); a row ends as NEAR_GOAL as soon as its next step leads close to its
        goal, to which further steps would converge. Its coordinates are those before that step.

    Rows that fail are marked in `status`; nothing is raised. The closure sign is that of the limbs
    that constrain the platform: a limb whose joints only follow it may pass its own singularities.
    """
    current = get_current_engine()
    if sums is not None:
        q = program.list_drives(start.joints)
    state = current.solve(program, e, q, start, task, free, max_iterations, goal, sums)
    if not program.idle_groups:
        return state
    joints = tuple(state.joints[i] for i in program.idle_groups)
    own = replace(state, joints=joints)
    sign = current.solve(program.idle_limbs, e, q, own, None, True, 0, None).closure_sign
    return replace(state, closure_sign=state.closure_sign * sign)


def follow(
    program: Program,
    e: FloatArray,
    q: FloatArray,
    start: State,
    ends: bool = False,
    max_iterations: int = 60,
    sums: Sums | None = None,
) -> State:
    """Solve the poses of each trial one after the other, each from the solution of the one before.

    Arguments are those of `solve`, start : (t | 1, 1). With `ends`, a trial ends at its first pose
    that does not converge; the others get its status, and no meaning.
    """
    own = get_current_engine().follow
    if own is None or program.idle_groups:
        from loopcal.engine.numpy_engine.newton import follow_by

        return follow_by(solve, program, e, q, start, ends, max_iterations, sums)
    return own(program, e, q, start, ends, max_iterations, sums)


def certify(program: Program, e: FloatArray, start: State, goal: State) -> NDArray[np.int8]:
    """Return the closure sign (t, n) of goals to which `solve` from the start provably converges.

    No singularity lies between them and the start. 0 where nothing is proven: the test is
    sufficient, and made for six driven rods that begin at one pose.

    e : (t | 1, n_displacements) [m, rad]. start : (t | 1, 1). goal : solutions (t, n).
    """
    own = get_current_engine().certify
    return np.zeros(goal.T.shape[:2], np.int8) if own is None else own(program, e, start, goal)


def reach(program: Program, e: FloatArray, target: Target, start: State) -> Reached:
    """Close the loops at target poses, and find which of them the start leads to.

    e : (t | 1, n_displacements) [m, rad]. target : n poses, n > 0. start : (t | 1, n | 1).

    All actuators are free, and the platform has six freedoms or the poses keep the others. Limbs
    begin at the start's joint values. Closure with locked actuators is square.
    """
    return get_current_engine().reach(program, e, target, start)


def linearize(
    program: Program, e: FloatArray, q: FloatArray, state: State, free: bool = False
) -> ClosureBlocks:
    """Linearize closure at a state (t, n) and eliminate the passive joints.

    e : (t | 1, n_displacements) [m, rad]. q : (t | 1, n, n_joints) actuated joint values [m, rad].
    free : eliminate the actuated joints too, at their values in `state`.
    """
    return get_current_engine().linearize(program, e, q, state, free)


def fold(factor: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the triangular factor R with R'R = factor'factor + rows'rows.

    No product is formed. The signs of the rows of R are arbitrary. A row of zeros changes nothing.

    factor : (t, p, p) upper triangular. rows : (t | 1, m, p), whitened.
    """
    return get_current_engine().fold(factor, rows)


def differentiate(
    program: Program,
    e: FloatArray,
    q: FloatArray,
    state: State,
    inputs: ParameterMap,
    nodes: int = 1,
) -> tuple[FloatArray, FloatArray]:
    """Differentiate the first nodes at a state (t, n), D = -A^-1 [E de/dp + Q dq/dp].

    e : (t | 1, n_displacements) [m, rad]. q : (t | 1, n, n_joints) actuated joint values [m, rad].
    inputs : how parameters and readings move e and q. nodes : 1 for the platform alone.

    Redundant actuators are weighted by the standard deviations of the program. Singular rows have
    infinities or NaN.

    Returns
    -------
    by_parameter, by_reading : (t, n, 6 nodes, p) and (t, n, 6 nodes, n_joints) twists per unit of
        each, node by node, zero outside their freedoms.
    """
    return get_current_engine().differentiate(program, e, q, state, inputs, nodes)


def fold_poses(
    factor: FloatArray,
    program: Program,
    e: FloatArray,
    q: FloatArray,
    state: State,
    inputs: ParameterMap,
    observed: Sequence[TwistRows],
) -> tuple[FloatArray, BoolArray]:
    """Fold the rows [G D | r] of observed poses, with D of `differentiate` and G = `by_twist`.

    factor : (t, p + 1, p + 1) upper triangular. e, q, state, inputs : as for `differentiate`, of t
        trials, or of a single one that stands for all.

    Returns
    -------
    factor : (t, p + 1, p + 1), see `fold`. is_finite : (t, n) where all derivatives of a pose that
        was observed are finite. Its rows are zero elsewhere.
    """
    arguments = program, e, q, state, inputs, observed
    return get_current_engine().fold_poses(factor, *arguments)


def fold_compared(
    factor: FloatArray,
    program: Program,
    e: FloatArray,
    q: FloatArray,
    start: State,
    inputs: ParameterMap,
    measured: ComparedPoses,
    steps: Steps,
) -> Advanced | None:
    """Close the loops of one trial and fold the rows of its measured poses: `solve` from a start
    (1, n), `compare_poses`, and `fold_poses` of the whitened differences. Then take full steps,
    each to the least sum of squares with penalty of the linear model, as long as they are accepted
    and not negligible. Rows of poses that are not solved are not defined.

    None where the engine leaves this to these functions, and steps to `loopcal.estimate.descent`.
    """
    current = get_current_engine()
    if current.fold_compared is None or program.idle_groups:
        return None
    return current.fold_compared(factor, program, e, q, start, inputs, measured, steps)


def eliminate_blocks(
    structures: Sequence[Structure],
    rows: Sequence[BlockRows],
    shape: tuple[int, int, int],
    limit: float,
) -> EliminatedBlocks | None:
    """Eliminate all unknowns from whitened rows by orthogonal projection, innermost nodes first.

    structures : of the nodes, parents before their children. rows : of all trials.
    shape : t trials, U unknowns, those without a node among them, and p parameters.
    limit : the singular values of the triangle of each node, in columns of length one over all
        rows, must be above this share of the largest, 1 at least, to be regular.

    None where the engine leaves this to `loopcal.numerics.elimination`.
    """
    own = get_current_engine().eliminate_blocks
    return None if own is None else own(structures, rows, shape, limit)


def solve_triangles(
    triangle: FloatArray, right: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Solve R x = b for upper triangular matrices R (t, p, p) and b (t, p).

    The entries of R^-1 are at most those of M^-1 in size, where M has |r_ii| on its diagonal and
    -|r_ij| beside it.

    Returns
    -------
    x : (t, p). growth : (t,) largest entry of M^-1 (1 .. 1)', so that |R^-1|_2 <= sqrt(p) growth.
        A zero on the diagonal gives infinities or NaN. None where the engine leaves this to
        `loopcal.numerics.decomposition`.
    """
    solve = get_current_engine().solve_triangles
    return None if solve is None else solve(triangle, right)


def compare_poses(T: FloatArray, reference: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the differences of poses, and their derivatives by the twists of T.

    T : (t | 1, n, 4, 4) [m]. reference : (t | 1, n, 12) rotations R_0 row by row, then positions.

    Returns
    -------
    residual : (t, n, 6) log(R R_0') [rad] and the difference of positions [m]. by_twist : (t, n, 6,
        6). None where the engine leaves this to the functions of `loopcal.geometry`.
    """
    compare = get_current_engine().compare_poses
    return None if compare is None else compare(T, reference)


def locate_points(
    T: FloatArray,
    stated: FloatArray,
    frame: FloatArray | None,
    points: FloatArray,
    columns: tuple[int, int, int],
) -> tuple[FloatArray, FloatArray] | None:
    """Return points of the platform in a frame, and their derivatives.

    T : (t | 1, n | 1, 4, 4) [m]. points : (t | 1, n | 1, k, 3) on the platform.
    stated : (4, 4) frame. frame : (t | 1, n | 1, 6) its rotation vector from there, and its place;
        None as stated. columns : first ones of the frame's numbers and of the points, -1 for none,
        and the number of columns.

    Returns
    -------
    x : (t, n, k, 3). slopes : (t, n, k, 3, columns), by the twist of T, then by these numbers;
        other columns are zero. None where the engine leaves this to `loopcal.measure.kinds`.
    """
    own = get_current_engine().locate_points
    return None if own is None else own(T, stated, frame, points, columns)


# --- Versions of what determines the last digits of a result.


def collect_versions() -> dict[str, str]:
    """Return the versions of loopcal, numpy, scipy and Python, and the engine of this process."""
    import platform

    import scipy

    return {
        "loopcal": __version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
        "engine": str(get_current_engine()),
    }
