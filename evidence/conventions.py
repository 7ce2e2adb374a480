# SPDX-License-Identifier: Apache-2.0
"""Convention check: false alarms on correct data, and detection of wrong conventions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.diagnose.conventions.convention_check import (
    IMPLAUSIBLE,
    ConventionCheck,
    compare_conventions,
)
from loopcal.errors import LoopcalError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.units import Dimension

SEED, POSES = 3, 20
SIGMA = {Dimension.LENGTH: 1e-5, Dimension.ANGLE: 5e-5}  # [m], [rad]
RATIO = 1e-4  # [1], of columns without a unit
ERROR_FACTORS = (1.0, 3.0, 10.0, 30.0)
ROBOTS_WITH_EVERY_KIND = ("hexapod-42", "3-prs", "linear-delta")
"""Robots with every kind; the others are measured as full poses and as positions in an unknown
frame, and up to 3 times off.
"""
ROBOTS_WITH_SLIPS = (*ROBOTS_WITH_EVERY_KIND, "ru-pus-prs", "rotary-delta")

IN_UNKNOWN_FRAME = Position(unknown=("frame",))

Change = Callable[[np.ndarray], np.ndarray]


def simulate_data(robot: Mechanism, kind: Kind, times: float, seed: int) -> Measurements | None:
    """Simulate a machine with errors of `times` its spreads.

    None if the kind does not apply or a pose is out of reach.
    """
    noise = Gaussian(np.array([SIGMA.get(c.dimension, RATIO) for c in kind.noise_columns]))
    free = select_free_parameters(robot)
    truth = robot.values.copy()
    truth[free.places] += (
        times * free.tolerance * np.random.default_rng((SEED, seed)).standard_normal(len(free))
    )
    try:
        at = sample_workspace(robot, POSES, SEED + seed).coordinates
        return simulate(
            robot.with_values(truth), at, Instrument((Sensor(kind, noise),)), seed, controller=robot
        )
    except LoopcalError:
        return None


def list_cases(times: float) -> Iterator[tuple[Mechanism, Kind]]:
    """Yield robots with a workspace and kinds: the first and last example of each kind, or only the
    first for large errors.
    """
    for name in ROBOTS_WITH_EVERY_KIND if times > 3.0 else list_shipped_robots():
        robot = load_robot(name)
        every = [
            kind
            for cls in KINDS.values()
            for kind in (cls.examples()[:1] + cls.examples()[1:][-1:])
            if kind.columns
        ]
        first = [cls.examples()[0] for cls in KINDS.values() if cls.examples()[0].columns]
        if robot.assembly.workspace:
            yield from (
                (robot, k)
                for k in (
                    (first if times > 3.0 else every)
                    if name in ROBOTS_WITH_EVERY_KIND
                    else (Pose(), IN_UNKNOWN_FRAME)
                )
            )


def count_false_alarms(times: float) -> list:
    """Return one row: data sets, without a misfit, median misfit, doubtful, refused."""
    misfits, refused = [], 0
    for seed, (robot, kind) in enumerate(list_cases(times)):
        data = simulate_data(robot, kind, times, seed)
        if data is not None:
            result = compare_conventions(robot, data)
            misfits.append(result.misfit)
            refused += result.is_refused
    finite = np.array(misfits)[~np.isnan(misfits)]
    doubted = int((finite > IMPLAUSIBLE).sum())
    return [
        times,
        len(misfits),
        len(misfits) - len(finite),
        float(np.median(finite)),
        doubted,
        refused,
    ]


def scale_columns(chosen: list[int], factor: float) -> Change:
    """Return a change that multiplies some columns by a factor."""

    def change(values: np.ndarray) -> np.ndarray:
        changed = values.copy()
        changed[:, chosen] *= factor
        return changed

    return change


def reorder_columns(order: list[int]) -> Change:
    """Return a change of the order of columns."""
    return lambda values: values[:, order]


def rewrite_rotations(change: Change) -> Change:
    """Return a change of the first three columns, the rotations."""
    return lambda values: np.concatenate([change(values[:, :3]), values[:, 3:]], axis=1)


Details = dict[str, Any]
"""The slip of an interpretation, and its details."""


def unit_slip(quantity: str, factor: float) -> Details:
    """Return the details of a wrong unit: correct values are `factor` times larger."""
    return {"slip": "unit", "quantity": quantity, "factor": factor}


def is_named(check: ConventionCheck, details: Details) -> bool:
    """Return whether the slip is the best interpretation or fits as well as the best."""
    if check.interpretation is None:
        return False
    every = (check.interpretation, *check.alternatives)
    return any(details.items() <= {"slip": one.slip, **one.details}.items() for one in every)


XYZ = Pose("euler-xyz")
VALUE_SLIPS: tuple[tuple[str, Kind, Change, Details], ...] = (
    ("mm written as m", Pose(), scale_columns([3, 4, 5], 1e3), unit_slip("lengths", 1e-3)),
    (
        "deg written as rad",
        Pose(),
        scale_columns([0, 1, 2], 180.0 / np.pi),
        unit_slip("angles", 1.0 / (180.0 / np.pi)),
    ),
    (
        "x and y swapped",
        Pose(),
        reorder_columns([0, 1, 2, 4, 3, 5]),
        {"slip": "swapped-columns", "columns": ("x", "y")},
    ),
    ("rotations inverted", Pose(), scale_columns([0, 1, 2], -1.0), {"slip": "inverted-rotations"}),
    (
        "euler-zyx for euler-xyz",
        XYZ,
        rewrite_rotations(
            lambda a: geometry.matrix_to_euler(geometry.euler_to_matrix(a, "xyz"), "zyx")
        ),
        {"slip": "orientation-form", "form": "euler-zyx"},
    ),
    (
        "moving for fixed axes",
        XYZ,
        rewrite_rotations(
            lambda a: geometry.matrix_to_euler(geometry.euler_to_matrix(a, "xyz"), "XYZ")
        ),
        {"slip": "orientation-form", "form": "euler-XYZ"},
    ),
    (
        "inches written as mm, frame unknown",
        IN_UNKNOWN_FRAME,
        scale_columns([0, 1, 2], 1.0 / 25.4),
        unit_slip("lengths", 25.4),
    ),
    (
        "cm written as mm, frame unknown",
        IN_UNKNOWN_FRAME,
        scale_columns([0, 1, 2], 0.1),
        unit_slip("lengths", 10.0),
    ),
    ("drop for rise", Component(("z",)), scale_columns([0], -1.0), {"slip": "sign", "column": "z"}),
    (
        "heights in inches written as mm",
        Component(("z",)),
        scale_columns([0], 1.0 / 25.4),
        {"slip": "unit", "factor": 25.4},
    ),
    (
        "inches written as mm, and x and y swapped",
        Pose(),
        lambda values: scale_columns([3, 4, 5], 1.0 / 25.4)(values)[:, [0, 1, 2, 4, 3, 5]],
        {"slip": "combination"},
    ),
)
READING_SLIPS: tuple[tuple[str, Change, Details], ...] = (
    (
        "two actuators swapped",
        lambda q: q[:, [1, 0, *range(2, q.shape[1])]],
        {"slip": "swapped-readings"},
    ),
    (
        "actuators counted from the second one",
        lambda q: np.roll(q, 1, axis=1),
        {"slip": "permuted-readings"},
    ),
    ("half the gear factor", lambda q: 2.0 * q, {"slip": "gear-factor", "factor": 0.5}),
    ("readings of the other sign", lambda q: -q, {"slip": "reading-sign"}),
    (
        "rows moved by one",
        lambda q: np.roll(q, 1, axis=0),
        {"slip": "shifted-readings", "neighbor": "below"},
    ),
)


def simulate_slip(
    robot: Mechanism, kind: Kind, change: Change | None, change_readings: Change | None
) -> Measurements | None:
    """Simulate data with changed values or readings; None if they are impossible for the kind or
    robot.
    """
    data = simulate_data(robot, kind, 1.0, SEED)
    if data is None:
        return None
    rows = data.observations[0]
    try:
        if change is not None:
            return replace(data, observations=(replace(rows, measured=change(rows.measured)),))
    except LoopcalError:
        return None
    return (
        data if change_readings is None else replace(data, readings=change_readings(data.readings))
    )


def count_detections() -> list[list]:
    """Return for each slip: data sets, those doubtful, refused, named (alone or among equals)."""
    tried = [(name, kind, change, None, slip) for name, kind, change, slip in VALUE_SLIPS]
    tried += [(name, Pose(), None, change, slip) for name, change, slip in READING_SLIPS]
    machines = [load_robot(name) for name in ROBOTS_WITH_SLIPS]
    rows = []
    for name, kind, change, change_readings, details in tried:
        every = [(robot, simulate_slip(robot, kind, change, change_readings)) for robot in machines]
        result = [compare_conventions(robot, data) for robot, data in every if data is not None]
        named = sum(is_named(check, details) for check in result)
        doubtful = sum(check.is_doubtful for check in result)
        refused = sum(check.is_refused for check in result)
        rows.append([name, len(result), doubtful, refused, named])
    return rows


def count_verdicts_on_random_data() -> list[list]:
    """Return for each kind of random numbers: data sets, those doubtful, refused."""
    rng = np.random.default_rng(SEED)

    def draw(values: np.ndarray) -> np.ndarray:
        return rng.uniform(values.min(axis=0), values.max(axis=0), values.shape)

    rows = []
    for name, of_values, of_readings in (
        ("measured values", draw, np.array),
        ("measured values, 1000 times too large", lambda values: 1e3 * draw(values), np.array),
        ("measured values of other rows", rng.permutation, np.array),
        ("readings", np.array, draw),
    ):
        result = []
        for robot in map(load_robot, ROBOTS_WITH_EVERY_KIND):
            for kind in (Pose(), IN_UNKNOWN_FRAME):
                data = simulate_data(robot, kind, 1.0, SEED)
                if data is not None:
                    observations = data.observations[0]
                    drawn = replace(observations, measured=of_values(observations.measured))
                    random = replace(
                        data, readings=of_readings(data.readings), observations=(drawn,)
                    )
                    result.append(compare_conventions(robot, random))
        rows.append(
            [
                name,
                len(result),
                sum(check.is_doubtful for check in result),
                sum(check.is_refused for check in result),
            ]
        )
    return rows


QUICK = {
    "ERROR_FACTORS": (1.0,),
    "ROBOTS_WITH_EVERY_KIND": ("3-prs",),
    "ROBOTS_WITH_SLIPS": ("3-prs",),
}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert all(row[5] == 0 for row in tables["false_alarms"]["rows"])
    assert all(row[2] == row[1] for row in tables["random"]["rows"])


def collect() -> dict:
    """Collect false alarms, detections and verdicts on random numbers."""
    alarms = {
        "columns": [
            "errors [spreads]",
            "correct data sets",
            "too few rows",
            "median misfit",
            "misfit above 10",
            "refused",
        ],
        "formats": [".0f", "d", "d", ".2g", "d", "d"],
        "rows": [count_false_alarms(times) for times in ERROR_FACTORS],
    }
    detection = {
        "columns": ["slip", "data sets", "misfit above 10", "refused", "named"],
        "formats": ["", "d", "d", "d", "d"],
        "rows": count_detections(),
    }
    random = {
        "columns": ["random numbers", "data sets", "misfit above 10", "refused"],
        "formats": ["", "d", "d", "d"],
        "rows": count_verdicts_on_random_data(),
    }
    return {
        "seed": SEED,
        "poses": POSES,
        "tables": {"false_alarms": alarms, "detection": detection, "random": random},
    }
