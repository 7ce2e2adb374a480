# SPDX-License-Identifier: Apache-2.0
"""A scale error of the instrument: how often the stated uncertainty contains the error of poses.

The lengths of simulated measurements are multiplied by 1 + s, s drawn anew for each machine from a
normal distribution, and the machine from its tolerances. The instrument has noise of 3 um (30 urad)
and a known frame; each fit takes 30 poses, and 30 others test it.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.apply.accuracy import pose_uncertainty
from loopcal.estimate.identification import identify
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.distance import Distance, Separation
from loopcal.measure.kinds.kind import Kind, name_shared_error
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import StatedValue
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace
from loopcal.units import Dimension

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


def state_scale(data: Measurements, sd: float) -> Measurements:
    """Return measurements of instruments with a scale of this standard deviation."""
    names = {name_shared_error(rows.kind, "scale", "") for rows in data.observations}
    observations: Any = tuple(
        replace(rows, kind=replace(rows.kind, unknown=("scale",))) for rows in data.observations
    )
    stated = tuple(StatedValue(name, sd) for name in names)
    return replace(data, observations=observations, stated_values=stated)


def scale_lengths(data: Measurements, scale: float) -> Measurements:
    """Return measurements with all lengths multiplied by 1 + scale."""
    observations = []
    for rows in data.observations:
        is_length = np.array([c.dimension is Dimension.LENGTH for c in rows.kind.columns])
        observations.append(replace(rows, measured=rows.measured * (1.0 + scale * is_length)))
    return replace(data, observations=tuple(observations))


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
            predicted = forward(fit.robot, true.q)
            U = pose_uncertainty(fit, predicted, frame="base")
            error = np.linalg.norm((predicted.T - true.T)[:, :3, 3], axis=1)
            results.append((error <= U.expanded_position, U.position, error))
    rows = []
    for is_stated, results in covered.items():
        inside, stated, error = (np.array(values) for values in zip(*results, strict=True))
        rms = [1e6 * float(np.sqrt(np.mean(values**2))) for values in (stated, error)]
        words = "yes" if is_stated else "no"
        rows.append([setup.name, 1e6 * sd, words, fits, 100.0 * float(inside.mean()), *rms])
    return rows


QUICK = {"FITS": 4}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size: a stated scale covers no less than an unstated one."""
    rows = tables["coverage"]["rows"]
    for plain, stated in zip(rows[::2], rows[1::2], strict=True):
        assert (plain[2], stated[2]) == ("no", "yes")
        assert stated[4] >= plain[4] - 5.0, (plain, stated)


def collect() -> dict[str, Any]:
    """Collect the coverage of each set-up."""
    rows = [row for setup in SETUPS for sd in SCALES for row in evaluate(setup, sd, FITS)]
    table = {
        "columns": [
            "measured",
            "scale, sd [ppm]",
            "stated",
            "fits",
            "pose errors in U(95 %) [%]",
            "stated position error, rms [um]",
            "true [um]",
        ],
        "formats": ["", ".0f", "", "d", ".1f", ".1f", ".1f"],
        "rows": rows,
    }
    return {"seeds": [0, FITS], "tables": {"coverage": table}}
