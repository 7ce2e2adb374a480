# SPDX-License-Identifier: Apache-2.0
"""Planned against random poses: errors at unseen poses after calibration, and how many random poses
do what planned ones do.

Machines are drawn from their tolerances, measured with noise at planned poses and at poses drawn
evenly from the workspace, calibrated by the default method, and judged at other poses of the
workspace. A plan is made for the nominal machine, so that one serves all machines; every seed draws
its own poses, and the first n of them are its set of n.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.estimate import identify_trials
from loopcal.io import load_robot
from loopcal.measure import (
    Component,
    Gaussian,
    Instrument,
    Pose,
    Sensor,
    sample_truth,
    simulate_trials,
)
from loopcal.mechanism import Mechanism, forward_trials, sample_workspace
from loopcal.planning import PlanOptions, Target
from loopcal.planning.information import linearize_groups
from loopcal.planning.pose_planning import plan_poses
from loopcal.planning.problem import PlanningProblem, prepare_problem

Array = NDArray[np.float64]

SEED, SEEDS, MACHINES, UNSEEN, CANDIDATES = 31, 20, 5, 40, 1000
"""Sets of random poses, machines measured at each set, poses that they are judged at, candidates of
a plan.
"""

PLANNED = (8, 12, 16, 24, 40)
RANDOM = (*PLANNED, 70, 110)
GLANCE = 16
"""Number of planned poses of the short table."""

SIGMA_LENGTH, SIGMA_ANGLE = 5e-6, 25e-6
"""Noise, one standard deviation [m], [rad]."""

LOUDER = (0.2, 1.0, 10.0)
"""Multiples of the noise at which the theory is asked."""


@dataclass(frozen=True)
class Case:
    """A robot, what is measured of its pose, and the error that poses are planned to make small."""

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


@dataclass(frozen=True, eq=False)
class Errors:
    """Root mean square errors of s sets of poses.

    Attributes
    ----------
    position [m], orientation [rad] : (s, m) of m machines each. expected : (s,) of the target,
    predicted by the plan's theory.
    """

    position: Array
    orientation: Array
    expected: Array


@dataclass(frozen=True, eq=False)
class Study:
    """A case made ready.

    Attributes
    ----------
    problem : the planning problem. drawn : the same with all random poses (seeds * most) as its
        groups.
    coordinates : (seeds, most, c) of these. truth : (seeds, m, p). unseen : (u, a) readings of the
        poses to judge at.
    tool : (seeds, m, u, 4, 4) true poses of the tool there [m].
    """

    case: Case
    problem: PlanningProblem
    drawn: PlanningProblem
    coordinates: Array
    truth: Array
    unseen: Array
    tool: Array

    @property
    def robot(self) -> Mechanism:
        """The nominal machine."""
        return self.problem.robot

    def wanted(self, position: Array | float, orientation: Array | float) -> Array:
        """Return the error that poses are planned for [m]: turns count times the size of the robot."""
        return np.hypot(
            position, self.robot.size * orientation if self.case.target == "pose" else 0.0
        )


def prepare(
    case: Case,
    seeds: int = SEEDS,
    machines: int = MACHINES,
    most: int = RANDOM[-1],
    candidates: int = CANDIDATES,
    louder: float = 1.0,
) -> Study:
    """Draw machines and poses, and make the planning problem ready for a multiple of the noise."""
    robot = load_robot(case.robot)
    options = PlanOptions(target=case.target, hold_out=0, n_candidates=candidates, seed=SEED)
    problem = prepare_problem(robot, instrument(case, louder), options)
    pool, judged = (
        sample_workspace(robot, seeds * most, SEED + 1),
        sample_workspace(robot, UNSEEN, SEED + 2),
    )
    members = np.arange(seeds * most)[:, None]
    groups = linearize_groups(problem.free, problem.instrument, pool.solution.q, members)
    truth, q = sample_truth(robot, seeds * machines, SEED), judged.solution.q
    tool = forward_trials(robot, truth, q[None]).T @ robot.tool
    sets = (seeds, machines)
    coordinates = pool.coordinates.reshape(seeds, most, -1)
    drawn = replace(problem, groups=groups)
    return Study(
        case,
        problem,
        drawn,
        coordinates,
        truth.reshape(*sets, -1),
        q,
        tool.reshape(*sets, UNSEEN, 4, 4),
    )


def instrument(case: Case, louder: float = 1.0) -> Instrument:
    """Full poses or positions, in a known frame."""
    if case.measured == "position":
        return Instrument(
            (Sensor(Component(("x", "y", "z")), Gaussian(louder * np.full(3, SIGMA_LENGTH))),)
        )
    return Instrument(
        (Sensor(Pose(), Gaussian(louder * np.array([SIGMA_ANGLE] * 3 + [SIGMA_LENGTH] * 3))),)
    )


def at_planned(study: Study, n: int) -> Errors:
    """Errors of all machines, measured at the same n planned poses."""
    found = plan_poses(study.problem.with_options(n_poses=n))
    seeds, machines, p = study.truth.shape
    tool = study.tool.reshape(-1, *study.tool.shape[2:])
    position, orientation = calibrated(
        study, found.poses.coordinates, study.truth.reshape(-1, p), tool, SEED
    )
    expected = np.full(
        seeds, float(study.wanted(found.errors.after.position, found.errors.after.orientation))
    )
    shape = (seeds, machines)
    return Errors(position.reshape(shape), orientation.reshape(shape), expected)


def at_random(study: Study, n: int) -> Errors:
    """Errors of the machines of each seed, measured at its own n random poses."""
    seeds = len(study.coordinates)
    sets = zip(
        study.coordinates, study.truth, study.tool, range(SEED + 1, SEED + 1 + seeds), strict=True
    )
    found = [calibrated(study, poses[:n], truth, tool, seed) for poses, truth, tool, seed in sets]
    position, orientation = np.stack(found, axis=1)
    return Errors(position, orientation, foreseen_at_random(study, n))


def foreseen_at_random(study: Study, n: int) -> Array:
    """Errors (seeds,) predicted for n random poses."""
    seeds, most = study.coordinates.shape[:2]
    return np.array(
        [
            foreseen(study, study.drawn, np.arange(first, first + n))
            for first in range(0, seeds * most, most)
        ]
    )


def among_candidates(study: Study, n: int) -> float:
    """Median error predicted for as many sets of n candidates drawn at random, of which half lie at
    the boundary.
    """
    rng, count = np.random.default_rng(SEED), len(study.problem.candidates)
    sets = [rng.choice(count, n, replace=False) for _ in study.coordinates]
    return float(np.median([foreseen(study, study.problem, chosen) for chosen in sets]))


def foreseen(study: Study, problem: PlanningProblem, chosen: NDArray[np.int64]) -> float:
    """Return the error of the target that the plan's theory predicts for some units."""
    found = problem.predict_errors(chosen)
    assert found is not None, "tolerances bound every error"
    return float(study.wanted(found.position, found.orientation))


def calibrated(
    study: Study, poses: Array, truth: Array, tool: Array, seed: int
) -> tuple[Array, Array]:
    """Measure machines (t, p) at poses (n, c), calibrate, and return errors (t,) [m], [rad] of tool
    poses (t, u, 4, 4).
    """
    robot = study.robot
    fit = identify_trials(
        robot, simulate_trials(robot, truth, poses, study.problem.instrument, seed)
    )
    assert fit.converged.all(), "machines within their tolerances are always found"
    gap = geometry.pose_difference(
        forward_trials(robot, fit.values, study.unseen[None]).T @ robot.tool, tool
    )
    squares = (gap**2).reshape(*gap.shape[:2], 2, 3).sum(axis=3).mean(axis=1)
    return np.sqrt(squares[:, 1]), np.sqrt(squares[:, 0])


def matching(numbers: tuple[int, ...], errors: list[float], wanted: float) -> float | None:
    """Return the number of poses with this error, on straight lines between logarithms; None
    outside of the numbers.

    Parameters
    ----------
    errors : of each number of poses; a number that happens to be no better than a smaller one is
        left out.
    """
    best = np.minimum.accumulate(errors)
    falling = np.append(True, best[1:] < best[:-1])
    if not best[-1] <= wanted <= best[0]:
        return None
    return float(
        np.exp(np.interp(-np.log(wanted), -np.log(best[falling]), np.log(numbers)[falling]))
    )


def compare(
    study: Study, sizes: tuple[int, ...] = PLANNED, drawn: tuple[int, ...] = RANDOM
) -> tuple[list, list]:
    """Return rows of accuracy and rows of saving, one for each number of planned poses that gives
    enough equations.
    """
    random = {n: at_random(study, n) for n in drawn}
    case, accuracy, saving = study.case, [], []
    error = {n: study.wanted(e.position, e.orientation) for n, e in random.items()}
    medians = [float(np.median(error[n])) for n in drawn]
    expected = [float(np.median(random[n].expected)) for n in drawn]
    mixed = [among_candidates(study, n) for n in drawn]
    for n in (n for n in sizes if n >= study.problem.min_groups):
        plan = at_planned(study, n)
        own, other = study.wanted(plan.position, plan.orientation), error[n]
        better = int((_rms(own) < _rms(other)).sum())
        turned = case.target == "pose"
        pairs = [1e6 * float(np.median(e)) for e in (plan.position, random[n].position)]
        turns = [
            1e6 * float(np.median(e)) if turned else None
            for e in (plan.orientation, random[n].orientation)
        ]
        accuracy.append([case.robot, case.measured, n, *pairs, *turns, better])
        equal = matching(drawn, medians, float(np.median(own)))
        theory = [matching(drawn, curve, float(plan.expected[0])) for curve in (expected, mixed)]
        saved = None if equal is None else 100.0 * (1.0 - n / equal)
        true = [
            float(_rms(own.ravel()) / _rms(plan.expected)),
            float(_rms(other.ravel()) / _rms(random[n].expected)),
        ]
        saving.append([case.robot, case.measured, n, equal, saved, *theory, *true])
    return accuracy, saving


def by_noise(case: Case) -> list:
    """Return how many random poses should be as good as GLANCE planned ones, at each multiple of
    the noise.
    """
    found: list[object] = [case.robot, case.measured, GLANCE]
    for louder in LOUDER:
        study = prepare(case, machines=1, louder=louder)
        plan = plan_poses(study.problem.with_options(n_poses=GLANCE)).errors.after
        curve = [float(np.median(foreseen_at_random(study, n))) for n in RANDOM]
        found.append(matching(RANDOM, curve, float(study.wanted(plan.position, plan.orientation))))
    return found


def at_a_glance(accuracy: list, saving: list) -> list:
    """Return one row for each case at GLANCE poses: position errors, random poses as good, and the
    share saved.
    """
    return [[*a[:5], *s[3:5]] for a, s in zip(accuracy, saving, strict=True) if a[2] == GLANCE]


def _rms(errors: Array) -> Array:
    """Root mean square over the last axis."""
    return np.sqrt((errors**2).mean(axis=-1))


def collect() -> dict:
    """Every case at full size."""
    tables = [compare(prepare(case)) for case in CASES]
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
        "predicted, half of them at the boundary",
    ]
    ratios = [f"error / predicted error: {which}" for which in ("planned", "random")]
    noise = [f"noise {1e6 * f * SIGMA_LENGTH:g} um, {1e6 * f * SIGMA_ANGLE:g} urad" for f in LOUDER]
    return {
        "seed": SEED,
        "seeds": SEEDS,
        "machines per seed": MACHINES,
        "unseen poses": UNSEEN,
        "candidates": CANDIDATES,
        "noise": {"length [um]": 1e6 * SIGMA_LENGTH, "angle [urad]": 1e6 * SIGMA_ANGLE},
        "tables": {
            "glance": {
                "columns": ["robot", "measured", "poses", *errors[:2], *numbers[:2]],
                "formats": ["", "", "d", ".1f", ".1f", ".0f", ".0f"],
                "rows": at_a_glance(accuracy, saving),
            },
            "noise": {
                "columns": ["robot", "measured", "planned poses", *noise],
                "formats": ["", "", "d", *[".0f"] * len(LOUDER)],
                "rows": [
                    by_noise(case)
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
            "saving": {
                "columns": ["robot", "measured", "planned poses", *numbers, *ratios],
                "formats": ["", "", "d", ".0f", ".0f", ".0f", ".0f", ".2f", ".2f"],
                "rows": saving,
            },
        },
    }
