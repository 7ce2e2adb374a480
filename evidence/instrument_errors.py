# SPDX-License-Identifier: Apache-2.0
"""A scale error of the instrument: how often the stated uncertainty contains the error of poses.

The lengths of simulated measurements are multiplied by 1 + s, s drawn anew for each machine from a
normal distribution, and the machine from its spreads. The instrument has noise of 3 um (30 urad)
and a known frame; each fit takes 30 poses, and 30 others test it. Four sessions of the gantry have
one scale, or each its own, and either is stated.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from loopcal.apply.accuracy import pose_uncertainty
from loopcal.estimate.identification import identify
from loopcal.estimate.result import Identification
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.distance import Distance, Separation
from loopcal.measure.kinds.kind import Kind, name_shared_error
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import StatedValue
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.solutions import Solution, forward
from loopcal.mechanism.workspace import sample_workspace
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

Scope = Literal["session", "all"]
SCOPES: tuple[Scope, ...] = get_args(Scope)
FITS, POSES = 200, 30
SIGMA = {Dimension.LENGTH: 3e-6, Dimension.ANGLE: 30e-6}
SCALES = (25e-6, 50e-6)  # standard deviations; 2 and 4 K on steel
ANCHORS = np.array([[0.6, 0.0, 0.9], [-0.3, 0.5, 0.9], [-0.3, -0.5, 0.9]])


@dataclass(frozen=True)
class Setup:
    """What is measured: its name, the robot, and the kinds, which share one scale."""

    name: str
    robot: str
    kinds: tuple[Kind, ...]


SETUPS = (
    Setup("positions (tracker)", "linear-delta", (Position(),)),
    Setup("positions of a gantry with unknown gains", "core-xy", (Position(),)),
    Setup("poses", "hexapod-42", (Pose(),)),
    Setup(
        "three wires",
        "linear-delta",
        tuple(
            Distance(anchor=a, anchor_name=f"wire{i}", frame="rig") for i, a in enumerate(ANCHORS)
        ),
    ),
    Setup("ball bar", "linear-delta", (Separation(),)),
    Setup("heights", "linear-delta", (Component(("z",)),)),
    Setup("one axis", "linear-delta", (Component(("x",)),)),
)


def state_scale(data: Measurements, sd: float, scope: Scope = "session") -> Measurements:
    """Return measurements of instruments with a scale of this standard deviation."""
    names = {name_shared_error(rows.kind, "scale", "") for rows in data.observations}
    observations: Any = tuple(
        replace(rows, kind=replace(rows.kind, unknown=("scale",))) for rows in data.observations
    )
    stated = tuple(StatedValue(name, sd, scope=scope) for name in names)
    return replace(data, observations=observations, stated_values=stated)


def scale_lengths(data: Measurements, scale: float | FloatArray) -> Measurements:
    """Return measurements with all lengths multiplied by 1 + scale, which may be (r, 1)."""
    observations = []
    for rows in data.observations:
        is_length = np.array([c.dimension is Dimension.LENGTH for c in rows.kind.columns])
        observations.append(replace(rows, measured=rows.measured * (1.0 + scale * is_length)))
    return replace(data, observations=tuple(observations))


def check_poses(fit: Identification, true: Solution) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return which errors of poses (n,) are in U(95 %), their standard uncertainties and the errors
    [m].
    """
    predicted = forward(fit.robot, true.q)
    U = pose_uncertainty(fit, predicted, frame="base")
    error = np.linalg.norm((predicted.T - true.T)[:, :3, 3], axis=1)
    return error <= U.expanded_position, U.position, error


def summarize(results: list[tuple[BoolArray, FloatArray, FloatArray]]) -> list[float]:
    """Return coverage [%], and root mean squares of stated and true errors [um]."""
    inside, stated, error = (np.array(values) for values in zip(*results, strict=True))
    rms = (1e6 * float(np.sqrt(np.mean(values**2))) for values in (stated, error))
    return [100.0 * float(inside.mean()), *rms]


def evaluate(setup: Setup, sd: float, fits: int) -> list[list[Any]]:
    """Return name, scale, whether it is stated, number of fits, coverage [%], and the root mean
    squares of stated and true errors of position [um].
    """
    robot = load_robot(setup.robot)
    truths = sample_truth(robot, fits, 1)
    sensors = [
        Sensor(k, Gaussian(np.array([SIGMA[c.dimension] for c in k.noise_columns])))
        for k in setup.kinds
    ]
    covered: dict[bool, list[Any]] = {False: [], True: []}
    for i, truth in enumerate(truths):
        poses = sample_workspace(robot, 2 * POSES, i).coordinates
        machine = robot.with_values(truth)
        scale = sd * np.random.default_rng([i, 7]).standard_normal()
        data = scale_lengths(simulate(machine, poses[:POSES], Instrument(tuple(sensors)), i), scale)
        true = forward(
            machine, simulate(machine, poses[POSES:], Instrument(tuple(sensors)), i).readings
        )
        for is_stated, results in covered.items():
            fit = identify(robot, state_scale(data, sd) if is_stated else data)
            results.append(check_poses(fit, true))
    rows = []
    for is_stated, results in covered.items():
        words = "yes" if is_stated else "no"
        rows.append([setup.name, 1e6 * sd, words, fits, *summarize(results)])
    return rows


def evaluate_sessions(fits: int) -> list[list[Any]]:
    """Return true and stated scope, number of fits, coverage [%], and the root mean squares of
    stated and true errors of position [um], for a scale of 25 ppm in four sessions of a gantry.
    """
    robot = load_robot("core-xy")
    session = np.repeat(["a", "b", "c", "d"], POSES // 3)
    noise = Gaussian(np.full(3, SIGMA[Dimension.LENGTH]))
    found: dict[tuple[str, Scope], list[Any]] = {}
    for i, truth in enumerate(sample_truth(robot, fits, 1)):
        machine, drawn = robot.with_values(truth), np.random.default_rng([i, 7])
        poses = sample_workspace(robot, len(session) + POSES, i).coordinates
        tracker = Instrument((Sensor(Position(), noise, session=session),))
        data = simulate(machine, poses[: len(session)], tracker, i)
        others = simulate(
            machine, poses[len(session) :], Instrument((Sensor(Position(), noise),)), i
        )
        true = forward(machine, others.readings)
        for words, count in (("one scale", 1), ("four scales", 4)):
            scales = SCALES[0] * drawn.standard_normal(count)
            scaled = scale_lengths(data, np.repeat(scales, len(session) // count)[:, None])
            for scope in SCOPES:
                fit = identify(robot, state_scale(scaled, SCALES[0], scope))
                found.setdefault((words, scope), []).append(check_poses(fit, true))
    rows = []
    for (words, scope), results in found.items():
        rows.append([words, scope, fits, *summarize(results)])
    return rows


QUICK = {"FITS": 4}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size: a stated scale covers no less than an unstated one."""
    rows = tables["coverage"]["rows"]
    for plain, stated in zip(rows[::2], rows[1::2], strict=True):
        assert (plain[2], stated[2]) == ("no", "yes")
        assert stated[4] >= plain[4] - 5.0, (plain, stated)
    coverage = {tuple(row[:2]): row[3] for row in tables["sessions"]["rows"]}
    assert coverage["one scale", "all"] >= coverage["one scale", "session"]


def collect() -> dict[str, Any]:
    """Collect the coverage of each set-up."""
    rows = [row for setup in SETUPS for sd in SCALES for row in evaluate(setup, sd, FITS)]
    table: dict[str, Any] = {
        "columns": [
            "measured",
            "scale, sd [ppm]",
            "stated",
            "fits",
            "pose errors in U(95 %) [%]",
            "reported position error, rms [um]",
            "true [um]",
        ],
        "formats": ["", ".0f", "", "d", ".1f", ".1f", ".1f"],
        "rows": rows,
    }
    sessions = {
        "columns": ["true", "declared `scope`", *table["columns"][3:]],
        "formats": ["", "", *table["formats"][3:]],
        "rows": evaluate_sessions(FITS),
    }
    return {"seeds": [0, FITS], "tables": {"coverage": table, "sessions": sessions}}
