# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements of planes and perpendicular lines, whose readings are measured."""

from dataclasses import replace
from functools import cache

import numpy as np

import loopcal as lc
from loopcal.measure.instrument import Instrument
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import sample_truth, simulate_contacts
from loopcal.mechanism.model import Mechanism
from loopcal.planning.plane_line_planning import SurfacePlan

ROBOT = "hexapod-nategh-agheli"


@cache
def plan_groups(groups: int = 12, points: int = 6, robot: str = ROBOT) -> SurfacePlan:
    """Return a plan of planes and lines."""
    return lc.plan_surfaces(lc.load_robot(robot), lc.SurfaceOptions(groups, points))


def simulate_plan(
    plan: SurfacePlan, sigma: float, seed: int, errors: float = 1.0
) -> tuple[Mechanism, Measurements]:
    """Return a true machine and its measurements with this noise [m]; errors in spreads."""
    robot = plan.robot
    drawn = sample_truth(robot, 1, seed)[0] - robot.values
    truth = robot.with_values(robot.values + errors * drawn)
    sensors = [
        replace(s, noise=lc.Gaussian(np.full(len(s.noise.sigma), sigma)))
        for s in plan.instrument.sensors
    ]
    rows = tuple(
        Observations.from_sigma(
            s.kind,
            s.assigned_rows,
            np.zeros((len(s.assigned_rows), len(s.kind.columns))),
            s.noise.sigma,
            s.session,
            s.group,
        )
        for s in sensors
    )
    sheet = Measurements(robot.name, plan.poses.readings, rows, labels=plan.poses.labels)
    return truth, simulate_contacts(truth, sheet, Instrument(tuple(sensors)), seed)
