# SPDX-License-Identifier: Apache-2.0
"""Planned and random poses compared: errors at validation poses after calibration, and how many
random poses are as good as planned ones. And the share of machines that end below the error that a
plan states, from the fewest possible poses on.

Machines are drawn from their spreads and measured with noise, at planned poses and at poses
drawn evenly from the workspace. They are calibrated by the default method and validated at other
poses of the workspace. One plan, made for the nominal machine, serves all machines. Every seed
draws its own random poses; the first n of them are its set of n.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.apply.accuracy import transport
from loopcal.diagnose.error_frames import fit_frames
from loopcal.estimate.identification import identify_trials
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.simulation import sample_truth, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.planning.constraints import PlanOptions, Target
from loopcal.planning.pose_groups import find_group_motions, linearize_groups
from loopcal.planning.pose_planning import plan_poses
from loopcal.planning.problem import PlanningProblem, prepare_problem

Array = NDArray[np.float64]

SEED, SEEDS, MACHINES, VALIDATION_POSES, CANDIDATES = 31, 20, 5, 40, 1000
"""Seed; sets of random poses; machines measured at each set; validation poses; candidates."""

PLANNED = (8, 12, 16, 24, 40)
RANDOM = (*PLANNED, 70, 110)
GLANCE = 16
"""Number of planned poses of the short table."""

SIGMA_LENGTH, SIGMA_ANGLE = 5e-6, 25e-6
"""Noise, one standard deviation [m], [rad]."""

NOISE_FACTORS = (0.2, 1.0, 10.0)
"""Multiples of the noise for which the theory predicts errors."""


@dataclass(frozen=True)
class Case:
    """A robot, the measured part of its pose, and the error that the plan minimizes."""

    robot: str
    measured: str
    target: Target


CASES = (
    Case("hexapod-42", "full pose", "pose"),
    Case("hexapod-42", "position", "position"),
    Case("3-prs", "full pose", "pose"),
    Case("3-prs", "position", "position"),
    Case("linear-delta", "position", "position"),
)


SHARED = (
    Case("hexapod-42", "full pose", "position"),
    Case("hexapod-42", "three targets, unknown tracker frame", "position"),
    Case("pentapod", "full pose", "position"),
    Case("linear-delta", "position", "position"),
    Case("linear-delta", "heights", "position"),
)
MULTIPLES, DRAWN, UNMEASURED = (1, 2, 4), 200, 1000
"""Numbers of poses over the smallest possible one; machines, and poses where they are compared."""

TARGETS = np.array([[0.06, 0.0, 0.01], [-0.03, 0.05, 0.01], [-0.03, -0.05, 0.02]])
"""Places of three reflectors on the platform [m]."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Root mean square errors after measuring s sets of poses.

    Attributes
    ----------
    position [m], orientation [rad] : (s, m) of m machines each.
    expected : (s,) errors of the target that the theory predicts [m].
    """

    position: Array
    orientation: Array
    expected: Array


@dataclass(frozen=True, eq=False)
class Study:
    """A case with its machines and poses.

    Attributes
    ----------
    problem : the planning problem.
    random_problem : the same with all random poses (seeds * most) as its groups.
    coordinates : (seeds, most, c) of the random poses. truth : (seeds, m, p) true machines.
    readings : (u, a) of the validation poses.
    tool : (seeds, m, u, 4, 4) true poses of the tool there [m].
    """

    case: Case
    problem: PlanningProblem
    random_problem: PlanningProblem
    coordinates: Array
    truth: Array
    readings: Array
    tool: Array

    @property
    def robot(self) -> Mechanism:
        """The nominal machine."""
        return self.problem.robot

    def target_error(self, position: Array | float, orientation: Array | float) -> Array:
        """Return the error that the plan makes small [m]; rotations times the robot's size."""
        return np.hypot(
            position, self.robot.size * orientation if self.case.target == "pose" else 0.0
        )


def set_options(problem: PlanningProblem, **changes: Any) -> PlanningProblem:
    """Return a problem with other options that do not concern candidates and data."""
    return replace(problem, options=replace(problem.options, **changes))


def prepare_study(
    case: Case,
    seeds: int = SEEDS,
    machines: int = MACHINES,
    most: int = RANDOM[-1],
    candidates: int = CANDIDATES,
    noise_factor: float = 1.0,
) -> Study:
    """Draw machines and poses, and prepare the planning problem for a multiple of the noise."""
    robot = load_robot(case.robot)
    options = PlanOptions(target=case.target, hold_out=0, n_candidates=candidates, seed=SEED)
    problem = prepare_problem(robot, instrument(case, noise_factor), options)
    pool, validation = (
        sample_workspace(robot, seeds * most, SEED + 1),
        sample_workspace(robot, VALIDATION_POSES, SEED + 2),
    )
    members = np.arange(seeds * most)[:, None]
    groups = linearize_groups(problem.free, problem.instrument, pool.solution.q, members)
    truth, q = sample_truth(robot, seeds * machines, SEED), validation.solution.q
    tool = forward_trials(robot, truth, q[None]).T @ robot.tool
    sets = (seeds, machines)
    coordinates = pool.coordinates.reshape(seeds, most, -1)
    random_problem = replace(problem, groups=groups)
    return Study(
        case,
        problem,
        random_problem,
        coordinates,
        truth.reshape(*sets, -1),
        q,
        tool.reshape(*sets, VALIDATION_POSES, 4, 4),
    )


def instrument(case: Case, noise_factor: float = 1.0) -> Instrument:
    """Return an instrument for what is measured, in a known frame unless that is said."""
    kinds: dict[str, Kind] = {
        "full pose": Pose(),
        "position": Component(("x", "y", "z")),
        "heights": Component(("z",)),
        "three targets, unknown tracker frame": Position(
            targets=("a", "b", "c"), places=TARGETS, unknown=("frame",), frame="tracker"
        ),
    }
    kind, sigmas = kinds[case.measured], {"length": SIGMA_LENGTH, "angle": SIGMA_ANGLE}
    sigma = np.array([sigmas[column.dimension.value] for column in kind.noise_columns])
    return Instrument((Sensor(kind, Gaussian(noise_factor * sigma)),))


def measure_planned(study: Study, n: int) -> Errors:
    """Return the errors of all machines, measured at the same n planned poses."""
    plan = plan_poses(set_options(study.problem, n_poses=n))
    seeds, machines, p = study.truth.shape
    tool = study.tool.reshape(-1, *study.tool.shape[2:])
    position, orientation = calibrate_machines(
        study, plan.poses.coordinates, study.truth.reshape(-1, p), tool, SEED
    )
    expected = np.full(
        seeds,
        float(
            study.target_error(plan.errors.after.position_rms, plan.errors.after.orientation_rms)
        ),
    )
    shape = (seeds, machines)
    return Errors(position.reshape(shape), orientation.reshape(shape), expected)


def measure_random(study: Study, n: int) -> Errors:
    """Return the errors of the machines of each seed, measured at its own n random poses."""
    seeds = len(study.coordinates)
    sets = zip(
        study.coordinates, study.truth, study.tool, range(SEED + 1, SEED + 1 + seeds), strict=True
    )
    errors = [
        calibrate_machines(study, poses[:n], truth, tool, seed) for poses, truth, tool, seed in sets
    ]
    position, orientation = np.stack(errors, axis=1)
    return Errors(position, orientation, predict_random(study, n))


def predict_random(study: Study, n: int) -> Array:
    """Return the predicted errors (seeds,) for n random poses."""
    seeds, most = study.coordinates.shape[:2]
    return np.array(
        [
            predict_error(study, study.random_problem, np.arange(first, first + n))
            for first in range(0, seeds * most, most)
        ]
    )


def predict_among_candidates(study: Study, n: int) -> float:
    """Return the median predicted error of as many sets of n candidates drawn at random.

    Half of the candidates lie at the boundary of the workspace.
    """
    rng, count = np.random.default_rng(SEED), len(study.problem.candidates)
    sets = [rng.choice(count, n, replace=False) for _ in study.coordinates]
    return float(np.median([predict_error(study, study.problem, chosen) for chosen in sets]))


def predict_error(study: Study, problem: PlanningProblem, chosen: NDArray[np.int64]) -> float:
    """Return the error of the target that the theory predicts for some groups."""
    errors = problem.predict_errors(chosen)
    assert errors is not None, "tolerances bound every error"
    return float(study.target_error(errors.position_rms, errors.orientation_rms))


def calibrate_machines(
    study: Study, poses: Array, truth: Array, tool: Array, seed: int
) -> tuple[Array, Array]:
    """Measure machines (t, p) at poses (n, c) and calibrate them.

    Returns
    -------
    position, orientation : (t,) errors [m], [rad] of the tool at its true poses (t, u, 4, 4).
    """
    robot = study.robot
    fit = identify_trials(
        robot, simulate_trials(robot, truth, poses, study.problem.instrument, seed)
    )
    assert fit.converged.all(), "machines within their tolerances always converge"
    gap = geometry.pose_difference(
        forward_trials(robot, fit.values, study.readings[None]).T @ robot.tool, tool
    )
    squares = (gap**2).reshape(*gap.shape[:2], 2, 3).sum(axis=3).mean(axis=1)
    return np.sqrt(squares[:, 1]), np.sqrt(squares[:, 0])


def count_below(case: Case) -> list[list]:
    """Return for each number of poses what a plan states of position errors, and how many machines
    end below it.

    Machines are drawn from their spreads, measured at the planned poses and calibrated. Their
    errors are those at other poses of the workspace, in the frame of the plan.
    """
    robot = load_robot(case.robot)
    options = PlanOptions(target=case.target, hold_out=0, n_candidates=CANDIDATES, seed=SEED)
    problem = prepare_problem(robot, instrument(case), options)
    members, q = problem.groups.members, problem.candidates.solution.q
    unfixed = find_group_motions(problem.free, problem.instrument, q, members)
    elsewhere = sample_workspace(robot, UNMEASURED, SEED + 2).solution
    frames = fit_frames(robot, elsewhere.T, unfixed)
    to_tool = transport(robot, elsewhere.T, "base", "tool")
    truth = sample_truth(robot, DRAWN, SEED)
    true, rows = forward_trials(robot, truth, elsewhere.q[None]).T, []
    for n in (multiple * problem.min_groups for multiple in MULTIPLES):
        plan = plan_poses(set_options(problem, n_poses=n))
        data = simulate_trials(robot, truth, plan.poses.coordinates, problem.instrument, SEED)
        values = identify_trials(robot, data).values
        gap = geometry.pose_difference(forward_trials(robot, values, elsewhere.q[None]).T, true)
        twists = (to_tool @ frames.remove(gap, elsewhere.T, gap)[..., None])[..., 0]
        error = np.sqrt((twists[..., 3:] ** 2).sum(axis=2).mean(axis=1))
        stated = plan.errors.after
        share = float((error <= stated.position).mean())
        reached = float(np.quantile(error, stated.share)) / stated.position
        above = float((error > stated.position_rms).mean())
        known = [1e6 * stated.position, 100.0 * share, reached, 1e6 * stated.position_rms]
        of_rms = [100.0 * above, float(_rms(error)) / stated.position_rms]
        rows.append([case.robot, case.measured, n, *known, *of_rms])
    return rows


def find_equal_number(numbers: tuple[int, ...], errors: list[float], error: float) -> float | None:
    """Return the number of poses with an error, on straight lines between logarithms.

    None outside the range of the numbers.

    Parameters
    ----------
    errors : of each number of poses. A number that happens to be no better than a smaller one is
        left out.
    """
    best = np.minimum.accumulate(errors)
    falling = np.append(True, best[1:] < best[:-1])
    if not best[-1] <= error <= best[0]:
        return None
    return float(
        np.exp(np.interp(-np.log(error), -np.log(best[falling]), np.log(numbers)[falling]))
    )


def compare_case(
    study: Study, sizes: tuple[int, ...] = PLANNED, drawn: tuple[int, ...] = RANDOM
) -> tuple[list, list]:
    """Return rows of the tables of accuracy and of saving, one for each number of planned poses
    that gives enough equations.
    """
    random = {n: measure_random(study, n) for n in drawn}
    case, accuracy, saving = study.case, [], []
    error = {n: study.target_error(e.position, e.orientation) for n, e in random.items()}
    medians = [float(np.median(error[n])) for n in drawn]
    expected = [float(np.median(random[n].expected)) for n in drawn]
    mixed = [predict_among_candidates(study, n) for n in drawn]
    for n in (n for n in sizes if n >= study.problem.min_groups):
        plan = measure_planned(study, n)
        own, other = study.target_error(plan.position, plan.orientation), error[n]
        better = int((_rms(own) < _rms(other)).sum())
        turned = case.target == "pose"
        pairs = [1e6 * float(np.median(e)) for e in (plan.position, random[n].position)]
        turns = [
            1e6 * float(np.median(e)) if turned else None
            for e in (plan.orientation, random[n].orientation)
        ]
        accuracy.append([case.robot, case.measured, n, *pairs, *turns, better])
        equal = find_equal_number(drawn, medians, float(np.median(own)))
        theory = [
            find_equal_number(drawn, curve, float(plan.expected[0])) for curve in (expected, mixed)
        ]
        saved = None if equal is None else 100.0 * (1.0 - n / equal)
        true = [
            float(_rms(own.ravel()) / _rms(plan.expected)),
            float(_rms(other.ravel()) / _rms(random[n].expected)),
        ]
        saving.append([case.robot, case.measured, n, equal, saved, *theory, *true])
    return accuracy, saving


def compare_noise(case: Case) -> list:
    """Return how many random poses the theory predicts to be as good as GLANCE planned ones, for
    each multiple of the noise.
    """
    row: list[object] = [case.robot, case.measured, GLANCE]
    for noise_factor in NOISE_FACTORS:
        study = prepare_study(case, SEEDS, 1, RANDOM[-1], CANDIDATES, noise_factor)
        plan = plan_poses(set_options(study.problem, n_poses=GLANCE)).errors.after
        curve = [float(np.median(predict_random(study, n))) for n in RANDOM]
        row.append(
            find_equal_number(
                RANDOM, curve, float(study.target_error(plan.position_rms, plan.orientation_rms))
            )
        )
    return row


def select_glance(accuracy: list, saving: list) -> list:
    """Return the position errors, random poses as good, and share saved at GLANCE poses."""
    return [[*a[:5], *s[3:5]] for a, s in zip(accuracy, saving, strict=True) if a[2] == GLANCE]


def _rms(errors: Array) -> Array:
    """Return the root mean square over the last axis."""
    return np.sqrt((errors**2).mean(axis=-1))


QUICK = {
    "SEEDS": 4,
    "MACHINES": 2,
    "CANDIDATES": 200,
    "CASES": CASES[-1:],
    "PLANNED": (16,),
    "RANDOM": (16, 40, 110),
    "NOISE_FACTORS": (1.0,),
    "SHARED": SHARED[2:4],
    "MULTIPLES": (1,),
}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    for *_, position, other, _, _, better in tables["accuracy"]["rows"]:
        assert position < other
        assert better >= SEEDS / 2
    for row in tables["shares"]["rows"]:
        # of DRAWN machines, each with the probability 0.9
        assert abs(row[4] - 90.0) < 100.0 * 4.0 * np.sqrt(0.9 * 0.1 / DRAWN), row


def collect() -> dict:
    """Compute every case at full size."""
    studies = (prepare_study(c, SEEDS, MACHINES, RANDOM[-1], CANDIDATES) for c in CASES)
    tables = [compare_case(study, PLANNED, RANDOM) for study in studies]
    accuracy, saving = ([row for table in tables for row in table[i]] for i in (0, 1))
    errors = [
        f"{what}: {how}"
        for what in ("position [um]", "orientation [urad]")
        for how in ("planned", "random")
    ]
    numbers = [
        "random poses as good",
        "poses saved [%]",
        "predicted",
        "predicted, half of the candidates at the boundary",
    ]
    ratios = [f"error / predicted error: {which}" for which in ("planned", "random")]
    noise = [
        f"noise {1e6 * f * SIGMA_LENGTH:g} um, {1e6 * f * SIGMA_ANGLE:g} urad"
        for f in NOISE_FACTORS
    ]
    return {
        "seed": SEED,
        "seeds": SEEDS,
        "machines per seed": MACHINES,
        "unseen poses": VALIDATION_POSES,
        "candidates": CANDIDATES,
        "noise": {"length [um]": 1e6 * SIGMA_LENGTH, "angle [urad]": 1e6 * SIGMA_ANGLE},
        "tables": {
            "glance": {
                "columns": ["robot", "measured", "poses", *errors[:2], *numbers[:2]],
                "formats": ["", "", "d", ".1f", ".1f", ".0f", ".0f"],
                "rows": select_glance(accuracy, saving),
            },
            "noise": {
                "columns": ["robot", "measured", "planned poses", *noise],
                "formats": ["", "", "d", *[".0f"] * len(NOISE_FACTORS)],
                "rows": [
                    compare_noise(case)
                    for case in CASES
                    if case.measured == "full pose" or case.robot == "linear-delta"
                ],
            },
            "accuracy": {
                "columns": [
                    "robot",
                    "measured",
                    "poses",
                    *errors,
                    f"planned better, of {SEEDS} seeds",
                ],
                "formats": ["", "", "d", ".2f", ".2f", ".1f", ".1f", "d"],
                "rows": accuracy,
            },
            "shares": {
                "columns": [
                    *(
                        "robot",
                        "measured",
                        "poses",
                        "stated for 9 of 10 [um]",
                        "machines below [%]",
                    ),
                    *("9 of 10 machines / stated", "stated rms [um]", "machines above the rms [%]"),
                    "rms of machines / stated",
                ],
                "formats": ["", "", "d", ".2f", ".1f", ".2f", ".2f", ".1f", ".2f"],
                "rows": [row for case in SHARED for row in count_below(case)],
            },
            "saving": {
                "columns": ["robot", "measured", "planned poses", *numbers, *ratios],
                "formats": ["", "", "d", ".0f", ".0f", ".0f", ".0f", ".2f", ".2f"],
                "rows": saving,
            },
        },
    }
