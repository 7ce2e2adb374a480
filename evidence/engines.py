# SPDX-License-Identifier: Apache-2.0
"""How far the native engine is from the one in NumPy, which bits its instruction sets have, and
what becomes of a million wrong inputs.

Without the native engine the committed tables are kept.
"""

import hashlib
import json
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bench_engine import use_engine
from loopcal.engine import Engine, State, select_engine
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP, LeastSquares, Ridge, TruncatedSVD
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose, compare_poses
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.platform_coordinates import EULER, POSITION, read_coordinates, state_target
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.decomposition import RANK_TOLERANCE, solve_regular
from tests.engine.cases import Case, draw_map, draw_twist_rows, make_case

TRIALS, POSES, INPUTS = 5, 40, 1_000_000
ROBOTS = tuple(name for name in list_shipped_robots() if not load_robot(name).assembly.couplings)
"""Robots whose drives are the joints of the program; couplings take the paths of sums."""
FITTED = ("hexapod-42", "ru-pus-prs", "linear-delta", "five-bar")
METHODS = {
    "least squares": LeastSquares(),
    "MAP": MAP(),
    "ridge": Ridge(1.0),
    "truncated SVD": TruncatedSVD(6),
}
OUTPUT = Path(__file__).resolve().parent.parent / "docs" / "evidence" / "engines.json"

Results = list[np.ndarray]


QUICK = {"ROBOTS": ROBOTS[::6], "FITTED": ("linear-delta",), "INPUTS": 20_000}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert all(row[4] == 0 for row in tables["agreement"]["rows"])
    assert all(row[4] == 0 for row in tables["fits"]["rows"])
    assert len(tables["bits"]["rows"]) == len(FUNCTIONS), "instruction sets have other bits"
    assert all(row[5] == 0 for row in tables["inputs"]["rows"])


def collect() -> dict[str, Any]:
    """Compare, hash and disturb."""
    if find_spec("loopcal_native") is None:
        print("evidence: engines keeps its tables; the native engine is not installed")
        kept = json.loads(OUTPUT.read_text("utf-8"))
        return {name: kept[name] for name in ("cases", "tables")}
    from evidence.engine_inputs.wrong_inputs import count_answers

    return {
        "cases": {"trials": TRIALS, "poses": POSES, "robots": len(ROBOTS)},
        "tables": {
            "agreement": compare_functions(),
            "fits": compare_fits(),
            "bits": compare_instruction_sets(),
            "inputs": count_answers(INPUTS),
        },
    }


# --- functions of the engine


def solve_forward(engine: Engine, case: Case) -> Results:
    """Return the poses in sizes of the robot, and everything countable."""
    state = engine.solve(case.program, case.e, case.q, case.home)
    T = state.T.copy()
    T[..., :3, 3] /= case.program.size
    return [T, state.status, state.iterations, state.closure_sign]


def solve_inverse(engine: Engine, case: Case) -> Results:
    """Return the joints of limbs at poses, in radians or sizes, and which of these lead there."""
    coordinates = read_coordinates(_close(case).T, (*POSITION, *EULER))
    target = state_target(coordinates, (*POSITION, *EULER), case.home.T[0, 0])
    reached = engine.reach(case.program, case.e, target, case.home)
    joints = [np.asarray(a) / max(case.program.size, 1.0) for a in reached.state.joints]
    counts = [reached.state.status, reached.state.iterations, reached.state.closure_sign]
    return [np.concatenate([a.ravel() for a in joints]), *counts, reached.arrives]


def linearize(engine: Engine, case: Case) -> Results:
    """Return all rows over the largest number in them, each up to its sign: the reflection of a
    column that begins with rounding has the sign of this rounding.
    """
    state, rng = _close(case), np.random.default_rng(0)
    rows = []
    for free in (False, True):
        blocks, parts = engine.linearize(case.program, case.e, case.q, state, free), []
        for block in (*blocks.closure, *blocks.passive):
            whole = np.concatenate([block.U, block.A, block.E, block.Q], axis=-1)
            side = whole @ rng.standard_normal(whole.shape[-1])
            parts.append(np.where(side < 0.0, -1.0, 1.0)[..., None] * whole)
        rows.append(np.concatenate([part.ravel() for part in parts]))
    return [np.concatenate([part / np.abs(part).max(initial=1e-300) for part in rows])]


def differentiate(engine: Engine, case: Case) -> Results:
    """Return derivatives of the platform over the largest of a robot."""
    shape = case.q.shape[:2]
    inputs = draw_map(case.program, shape, True)
    both = engine.differentiate(case.program, case.e, case.q, _close(case), inputs)
    return [np.concatenate([part.ravel() / np.abs(part).max() for part in both])]


def fold(engine: Engine, case: Case) -> Results:
    """Return R'R over the largest number in it, of rows with parts of zeros and of all sizes."""
    return [_scale_gram(_fold_rows(engine, case))]


def fold_poses(engine: Engine, case: Case) -> Results:
    """Return R'R over the lengths of its columns, of measured twists of poses, and which count."""
    inputs = draw_map(case.program, case.q.shape[:2], True)
    width = inputs.pattern.parameters + 1
    factor, is_finite = engine.fold_poses(
        np.zeros((TRIALS, width, width)),
        case.program,
        case.e,
        case.q,
        _close(case),
        inputs,
        draw_twist_rows(TRIALS, POSES),
    )
    return [_scale_gram(factor), is_finite]


def solve_triangles(engine: Engine, case: Case) -> Results:
    """Return solutions of triangular systems in lengths of their columns over the largest number,
    and which matrices are regular: all but the first two, whose last columns are another one and
    almost another one.
    """
    R = _fold_rows(_choose_baseline(), case)
    R[:2, :, -1] = R[:2, :, 0]
    R[1, -1, -1] = 1e-14 * R[1, 0, 0]
    right = np.random.default_rng(len(case.name)).normal(size=R.shape[:2])
    with use_engine(engine.name):
        x, is_regular = solve_regular(R, right, RANK_TOLERANCE)
    scaled = x * np.linalg.norm(R, axis=1)
    return [scaled / np.abs(scaled).max(), is_regular]


def compare_measured_poses(engine: Engine, case: Case) -> Results:
    """Return the differences of each pose and the next one, and their derivatives by twists."""
    T = _close(case).T
    other = np.roll(T, 1, axis=1)
    reference = np.concatenate([other[..., :3, :3].reshape(*T.shape[:2], 9), other[..., :3, 3]], -1)
    with use_engine(engine.name):
        both = compare_poses(T, reference)
    return [np.concatenate([part.ravel() for part in both])]


def _fold_rows(engine: Engine, case: Case) -> np.ndarray:
    """Return the factors of rows with parts of zeros and of all sizes."""
    rng = np.random.default_rng(len(case.name))
    columns = int(rng.integers(2, 60))
    rows = rng.normal(size=(TRIALS, 5 * columns, columns)) * 10.0 ** rng.uniform(-3, 3, columns)
    rows[:, : len(rows[0]) // 2, : columns // 2] = 0.0
    return engine.fold(np.zeros((TRIALS, columns, columns)), rows)


def _scale_gram(R: np.ndarray) -> np.ndarray:
    """Return R'R (t, p, p) of factors, their columns scaled to length 1; columns of zeros stay."""
    length = np.linalg.norm(R, axis=1, keepdims=True)
    scaled = R / np.where(length > 0.0, length, 1.0)
    return scaled.swapaxes(1, 2) @ scaled


def _close(case: Case) -> State:
    """Return the state at which all engines begin: one with the same bits on every machine."""
    return _choose_baseline().solve(case.program, case.e, case.q, case.home)


def _choose_baseline() -> Engine:
    """Return the engine that has the same bits on every machine, with what every processor has."""
    return select_engine("native:baseline")


FUNCTIONS: dict[str, tuple[Callable[[Engine, Case], Results], str]] = {
    "forward kinematics": (solve_forward, "size of the robot"),
    "inverse kinematics": (solve_inverse, "size of the robot, rad"),
    "linearized closure": (linearize, "largest entry"),
    "sensitivities": (differentiate, "largest entry"),
    "factor": (fold, "lengths of its columns"),
    "factor of poses": (fold_poses, "lengths of its columns"),
    "triangular systems": (solve_triangles, "largest number"),
    "differences of poses": (compare_measured_poses, "rad, m"),
}


def make_cases() -> list[Case]:
    """Return every shipped robot, displaced and near home."""
    return [make_case(load_robot(name), t=TRIALS, n=POSES) for name in ROBOTS]


def compare_functions() -> dict[str, Any]:
    """Return the largest deviation of each function, and in how many cases counts differ."""
    native, plain, rows = select_engine("native"), select_engine("numpy"), []
    for name, (function, unit) in FUNCTIONS.items():
        worst, different = 0.0, 0
        for case in make_cases():
            mine, theirs = function(native, case), function(plain, case)
            worst = max(worst, float(np.abs(mine[0] - theirs[0]).max()))
            counts = zip(mine[1:], theirs[1:], strict=True)
            different += sum(int((a != b).sum()) for a, b in counts)
        rows.append([name, len(ROBOTS), worst, unit, different])
    return {
        "columns": [
            "function",
            "robots",
            "largest deviation",
            "in units of",
            "other status or steps",
        ],
        "formats": ["", "d", ".1e", "", "d"],
        "rows": rows,
    }


# --- fits


def compare_fits() -> dict[str, Any]:
    """Return the largest deviations of estimates and of their standard deviations.

    Estimates differ in standard deviations, and in spreads where these are infinite.
    """
    rows = []
    for method, value in METHODS.items():
        of_estimate, of_sd, ranks = 0.0, 0.0, 0
        for name in FITTED:
            fits = []
            for engine in ("numpy", "native"):
                with use_engine(engine):
                    robot = load_robot(name)
                    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
                    at = sample_workspace(truth, 40, seed=1).coordinates
                    noise = Gaussian(np.array([5e-6] * 3 + [1e-6] * 3))  # [rad] and [m]
                    data = simulate(truth, at, Instrument((Sensor(Pose(), noise),)), seed=2)
                    fits.append(identify(robot, data, value))
            one, two = fits
            sd, other = one.standard_deviations, two.standard_deviations
            finite = np.isfinite(sd) & (sd > 0.0)
            unit = np.where(finite, sd, one.tolerance)
            away = np.abs(one.estimate - two.estimate) / unit
            of_estimate = max(of_estimate, float(away.max()))
            of_sd = max(of_sd, float(np.abs(sd[finite] / other[finite] - 1.0).max(initial=0.0)))
            ranks += int(one.rank != two.rank)
        rows.append([method, len(FITTED), of_estimate, of_sd, ranks])
    return {
        "columns": [
            "method",
            "robots",
            "estimate [standard deviations]",
            "standard deviation",
            "other rank",
        ],
        "formats": ["", "d", ".1e", ".1e", "d"],
        "rows": rows,
    }


# --- instruction sets


def compare_instruction_sets() -> dict[str, Any]:
    """Return the digest of each function's results, and the instruction sets that have it."""
    from loopcal_native import list_instruction_sets

    sets, rows = list(list_instruction_sets()), []
    for name, (function, _) in FUNCTIONS.items():
        digests: dict[str, list[str]] = {}
        for chosen in sets:
            digest = hashlib.sha256()
            engine = select_engine(f"native:{chosen}")
            for case in make_cases():
                for array in function(engine, case):
                    digest.update(np.ascontiguousarray(array).tobytes())
            digests.setdefault(digest.hexdigest()[:16], []).append(chosen)
        rows += [[name, digest, ", ".join(chosen)] for digest, chosen in digests.items()]
    return {
        "columns": ["function", "SHA-256 of all results", "instruction sets"],
        "formats": ["", "", ""],
        "rows": rows,
    }
