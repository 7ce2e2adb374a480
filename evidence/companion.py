# SPDX-License-Identifier: Apache-2.0
"""The companion while measuring: how often it doubts rows, and how many poses a goal takes.

Machines are drawn from the spreads of the robot file. Each session measures the suggested poses
until the goal is reached. A tenth of its rows is wrong in one value. For the first table, this is
six standard deviations of the difference from the expected value, which the companion shows.

The second table compares sessions with plans for the same goal, with the stated or another noise.
In both, a tenth of all rows, repeats among them, is wrong by 6 to 600 sigma. All poses of a plan
are measured. Then the calibration names poses, which are measured again, while the instrument still
stands. This repeats until it names none. A row counts until another of its pose replaces it.
The true error is that of the machine with the estimate from the rows in use, in the frame of the
plan. One estimator serves both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.apply.simulated_measurements import (
    InstrumentDescription,
    build_instrument,
    fill_in_measurements,
)
from loopcal.diagnose.outliers import find_outliers
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Tukey
from loopcal.estimate.options import FitOptions
from loopcal.geometry import exp_so3, make_pose
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.planning import companion as co
from loopcal.planning.constraints import PlanOptions
from loopcal.planning.pose_planning import plan
from loopcal.typing import FloatArray

MACHINES, WRONG, SIGMAS = 100, 0.1, 6.0
"""Sessions of each case, share of suggested rows that are wrong, and by how much."""

SLIPS = (6.0, 600.0)
"""Limits of the sizes of wrong rows [standard deviations of the instrument], all powers of ten
between them alike, where sessions are compared with plans."""

VISITS = 6  # of a plan, at most

NOISES = (0.5, 1.0, 1.5)  # true ones, of the stated one

DOUBTED = ("repeat", "differ")
PLACE = make_pose(exp_so3(np.array([1.1, -0.6, 2.2])), np.array([2.5, -1.3, 0.7]))
"""Frame of an instrument at an unknown place [m]."""


@dataclass(frozen=True)
class Case:
    """A robot whose tool point is measured, and the goal [m], rms over the workspace."""

    robot: str
    frames: tuple[str, ...]  # unknown ones
    sigma: float  # [m]
    goal: float
    poses: int  # of the plan, for the fit


CASES = (
    Case("hexapod-42", ("base",), 5e-6, 7e-6, 30),
    Case("linear-delta", ("base",), 2e-5, 1.5e-5, 20),
    Case("five-bar", (), 2e-5, 1.5e-5, 16),
)


class Session:
    """Planned poses of a case, and machines at which they are measured.

    goal : whether the plan has as many poses as the goal takes, instead of those of the case.
    """

    def __init__(self, case: Case, goal: bool = False) -> None:
        self.case, self.robot = case, load_robot(case.robot)
        described = InstrumentDescription(
            ("position",), sigma_position=case.sigma, unknown_frames=case.frames
        )
        instrument = build_instrument(described)
        self.exact = build_instrument(replace(described, sigma_position=1e-12))
        options = PlanOptions(n_poses=case.poses, hold_out=5, n_candidates=300)
        asked = PlanOptions(goal=case.goal, target="position")
        if goal:
            options = replace(options, n_poses=None, goal=case.goal, target="position")
        poses = plan(self.robot, instrument, options=options).poses
        self.kind = instrument.with_tool(self.robot).sensors[0].kind
        rows = Observations.from_sigma(
            self.kind, np.arange(len(poses)), np.zeros((len(poses), 3)), case.sigma, "", ""
        )
        self.planned = Measurements(
            self.robot.name,
            poses.readings,
            (rows,),
            labels=poses.labels,
            is_held_out=poses.held_out,
        )
        self.fitted = np.flatnonzero(~poses.held_out).tolist()
        self.task = co.prepare_task(self.planned, self.robot, instrument, asked)

    def draw(self, seed: int) -> tuple[FloatArray, FloatArray]:
        """Return the exact values (n, 3) [m] of a drawn machine, and its deviations (p,)."""
        drawn = fill_in_measurements(
            self.robot, self.planned, self.exact, draw_errors=True, seed=seed
        )
        free, exact = self.task.problem.free, drawn.data.observations[0].measured
        if self.case.frames:
            exact = exact @ PLACE[:3, :3].T + PLACE[:3, 3]
        return exact, free.deviation(drawn.truth.values[None])[0]

    def to_visits(self, poses: list[int], values: list[FloatArray]) -> Measurements:
        """Return visits of poses with their measured values [m]."""
        n = len(poses)
        rows = Observations.from_sigma(
            self.kind, np.arange(n), np.array(values), self.case.sigma, "", ""
        )
        return Measurements(
            self.robot.name,
            self.planned.readings[poses],
            (rows,),
            is_held_out=self.planned.is_held_out[poses],
        )

    def compute_error(self, fit: co.VisitFit, truth: FloatArray) -> float:
        """Return the true error of an estimate, rms over the workspace [m]."""
        prediction = self.task.problem.prediction
        change = prediction.position @ (fit.x[-len(truth) :] - truth)
        return float(np.linalg.norm(change) / np.sqrt(len(prediction)))

    def slip(self, rng: np.random.Generator) -> FloatArray:
        """Return the error (3,) [m] of a row, which in `WRONG` of all rows is that of one value."""
        error = np.zeros(3)
        size = self.case.sigma * np.exp(rng.uniform(*np.log(SLIPS))) * rng.choice([-1.0, 1.0])
        error[rng.integers(3)] = size
        return error * (rng.random() < WRONG)

    def measure_plan(self, seed: int, noise: float) -> dict[str, Any]:
        """Return what happened when all poses for the fit were measured, and then again those that
        the calibration named.
        """
        exact, truth = self.draw(seed)
        rng, sigma = np.random.default_rng([43, seed]), noise * self.case.sigma
        values, errors, fit = dict[int, FloatArray](), list[float](), None
        again, visits, measured = self.fitted, 0, self.planned
        while again and visits < VISITS:
            visits += 1
            for pose in again:
                noisy = exact[pose] + sigma * rng.normal(size=exact.shape[1])
                values[pose] = noisy + self.slip(rng)
                measured = self.to_visits(list(values), list(values.values()))
                fit = co.fit_visits(self.task, measured, np.ones(len(values), dtype=bool), fit)
                errors.append(self.compute_error(fit, truth))
            found = identify(self.robot, measured)
            if not found.converged:
                found = identify(self.robot, measured, options=FitOptions(loss=Tukey()))
            suspects = find_outliers(found, measured).suspects
            again = [list(values)[int(label) - 1] for label in suspects]
        return {"rows": len(errors), "visits": visits, **self.judge(errors)}

    def judge(self, errors: list[float]) -> dict[str, float]:
        """Return the error at the end, and the number of rows after which it stays within the goal,
        infinite where it does not.
        """
        above = np.flatnonzero(np.array(errors) > self.case.goal)
        reached = int(above[-1]) + 2 if len(above) else 1
        return {"error": errors[-1], "reached": reached if reached <= len(errors) else np.inf}

    def measure(self, seed: int, noise: float, slips: bool = False) -> dict[str, Any]:
        """Return what happened in one session; wrong by `SLIPS`, or else by `SIGMAS`."""
        exact, truth = self.draw(seed)
        rng, sigma = np.random.default_rng([41, seed]), noise * self.case.sigma
        state, poses, values = co.Companion(self.task), list[int](), list[FloatArray]()
        errors = list[float]()
        counts = dict.fromkeys(("right", "false", "wrong", "found", "untestable"), 0)
        while (following := co.choose_next(state)).reason not in ("validate", "done"):
            assert following.pose is not None
            poses.append(following.pose)
            values.append(exact[following.pose] + sigma * rng.normal(size=exact.shape[1]))
            if slips:
                values[-1] = values[-1] + self.slip(rng)
            verdict = co.examine_row(state, self.to_visits(poses, values), poses[-1])
            is_wrong = not slips and following.reason == "best" and rng.random() < WRONG
            if is_wrong:
                sd = verdict.prediction.sd
                places = np.flatnonzero(np.isfinite(sd))
                is_wrong = len(places) > 0
                counts["untestable"] += not is_wrong
                if is_wrong:
                    place = rng.choice(places)
                    values[-1] = values[-1].copy()
                    values[-1][place] += SIGMAS * sd[place] * rng.choice([-1.0, 1.0])
                    verdict = co.examine_row(state, self.to_visits(poses, values), poses[-1])
            is_doubted = verdict.judgement in DOUBTED
            counts["wrong" if is_wrong else "right"] += 1
            counts["found" if is_wrong else "false"] += is_doubted
            measured = self.to_visits(poses, values)
            state = co.take_rows(self.task, measured, poses, verdict.is_used, state)
            errors.append(np.inf if state.fit is None else self.compute_error(state.fit, truth))
        return {**counts, "rows": len(poses), **self.judge(errors)}


QUICK = {"MACHINES": 4, "CASES": CASES[-1:]}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    for row in tables["rows"]["rows"]:
        assert row[5] > 0.9, row
        assert row[3] < 0.1, row
    few, expected, many = (row[3] / row[4] for row in tables["poses"]["rows"])
    assert few < 0.8 < expected < many


def collect() -> dict:
    """Compute the tables."""
    of_rows, of_poses = [], []
    for case in CASES:
        session, fixed = Session(case), Session(case, goal=True)
        of_rows.append(tabulate_rows(session))
        of_poses += [compare_with_plan(session, fixed, noise) for noise in NOISES]
    return {
        "seeds": [0, MACHINES],
        "tables": {
            "rows": {
                "columns": [
                    "robot",
                    "frame of the instrument",
                    "right rows",
                    "doubted",
                    "wrong rows",
                    "repeated at once",
                    "wrong, but not testable yet",
                ],
                "formats": ["", "", "d", ".1%", "d", ".1%", "d"],
                "rows": of_rows,
            },
            "poses": {
                "columns": [
                    "robot",
                    "goal [um]",
                    "noise over given noise",
                    "rows with the companion (mean)",
                    "rows of the plan and its repeats (mean)",
                    "rows against the plan [%]",
                    "visits of the plan (mean)",
                    "rows until the true error stays within the goal, companion (median)",
                    "plan (median)",
                    "machines within the goal, companion",
                    "plan",
                ],
                "formats": [
                    "",
                    ".0f",
                    ".1f",
                    ".1f",
                    ".1f",
                    ".0f",
                    ".1f",
                    ".0f",
                    ".0f",
                    ".0%",
                    ".0%",
                ],
                "rows": of_poses,
            },
        },
    }


def tabulate_rows(session: Session) -> list[Any]:
    """Return how often rows were doubted, with the stated noise."""
    done = [session.measure(seed, 1.0) for seed in range(MACHINES)]
    total = {key: sum(each[key] for each in done) for key in done[0]}
    shares = total["false"] / total["right"], total["found"] / max(total["wrong"], 1)
    name = (session.case.robot, "unknown" if session.case.frames else "known")
    return [*name, total["right"], shares[0], total["wrong"], shares[1], total["untestable"]]


def compare_with_plan(session: Session, fixed: Session, noise: float) -> list[Any]:
    """Return rows and errors of sessions and of plans for their goal, with the same wrong rows."""
    seeds, goal = range(MACHINES), session.case.goal
    both = (
        [session.measure(seed, noise, slips=True) for seed in seeds],
        [fixed.measure_plan(seed, noise) for seed in seeds],
    )
    rows = [float(np.mean([each["rows"] for each in done])) for done in both]
    reached = (float(np.median([each["reached"] for each in done])) for done in both)
    return [
        session.case.robot,
        1e6 * goal,
        noise,
        *rows,
        100.0 * (rows[0] / rows[1] - 1.0),
        float(np.mean([each["visits"] for each in both[1]])),
        *(count if np.isfinite(count) else None for count in reached),
        *(float(np.mean([each["error"] <= goal for each in done])) for done in both),
    ]
