# SPDX-License-Identifier: Apache-2.0
"""The companion while measuring: how often it doubts rows, and how many poses a goal takes.

Machines are drawn from the spreads of the robot file. Each session measures the suggested poses
until the goal is reached. A tenth of its rows is wrong in one value, by six standard deviations of
the difference from the expected value, which the companion shows. The true error is that of the
machine with the estimate at the end of the session, in the frame of the plan.

The noise is the stated one, or another. A plan made for the goal has a fixed number of poses, and
is measured without any wrong row.
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

    def measure_all(self, seed: int, noise: float) -> float:
        """Return the true error [m] after all poses for the fit."""
        exact, truth = self.draw(seed)
        rng, poses = np.random.default_rng([41, seed]), self.fitted
        values = exact[poses]
        values = values + noise * self.case.sigma * rng.normal(size=values.shape)
        measured = self.to_visits(poses, list(values))
        fit = co.fit_visits(self.task, measured, np.ones(len(poses), dtype=bool))
        return self.compute_error(fit, truth)

    def measure(self, seed: int, noise: float) -> dict[str, Any]:
        """Return what happened in one session."""
        exact, truth = self.draw(seed)
        rng, sigma = np.random.default_rng([41, seed]), noise * self.case.sigma
        state, poses, values = co.Companion(self.task), list[int](), list[FloatArray]()
        counts = dict.fromkeys(("right", "false", "wrong", "found", "untestable"), 0)
        while (following := co.choose_next(state)).reason not in ("validate", "done"):
            assert following.pose is not None
            poses.append(following.pose)
            values.append(exact[following.pose] + sigma * rng.normal(size=exact.shape[1]))
            verdict = co.examine_row(state, self.to_visits(poses, values), poses[-1])
            is_wrong = following.reason == "best" and rng.random() < WRONG
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
        assert state.fit is not None
        error = self.compute_error(state.fit, truth)
        return {**counts, "rows": len(poses), "error": error}


QUICK = {"MACHINES": 4, "CASES": CASES[-1:]}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    for row in tables["rows"]["rows"]:
        assert row[5] > 0.9, row
        assert row[3] < 0.1, row
    few, expected, many = (row[4] / row[5] for row in tables["poses"]["rows"])
    assert few < 0.8 < expected < many


def collect() -> dict:
    """Compute the tables."""
    of_rows, of_poses = [], []
    for case in CASES:
        session, fixed = Session(case), Session(case, goal=True)
        name = (case.robot, "unknown" if case.frames else "known")
        for noise in NOISES:
            done = [session.measure(seed, noise) for seed in range(MACHINES)]
            total = {key: sum(each[key] for each in done) for key in done[0]}
            if noise == 1.0:
                shares = total["false"] / total["right"], total["found"] / max(total["wrong"], 1)
                rows = (total["right"], shares[0], total["wrong"], shares[1], total["untestable"])
                of_rows.append([*name, *rows])
            errors = np.array([each["error"] for each in done])
            planned = np.array([fixed.measure_all(seed, noise) for seed in range(MACHINES)])
            of_poses.append(
                [
                    *name,
                    1e6 * case.goal,
                    noise,
                    float(np.mean([each["rows"] for each in done])),
                    len(fixed.fitted),
                    1e6 * float(np.median(errors)),
                    1e6 * float(np.median(planned)),
                    float(np.mean(errors <= case.goal)),
                    float(np.mean(planned <= case.goal)),
                ]
            )
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
                    "frame of the instrument",
                    "goal [um]",
                    "true noise, of the stated one",
                    "rows with the companion (mean)",
                    "poses of a plan for this goal",
                    "true error with the companion [um] (median)",
                    "with the plan [um]",
                    "machines within the goal with the companion",
                    "with the plan",
                ],
                "formats": ["", "", ".0f", ".1f", ".1f", "d", ".2g", ".2g", ".0%", ".0%"],
                "rows": of_poses,
            },
        },
    }
