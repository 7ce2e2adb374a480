# SPDX-License-Identifier: Apache-2.0
"""Errors that sessions or poses share: the cluster-robust uncertainty over the stated one.

The 42-parameter hexapod, drawn from its tolerances, with 30 poses. Either full poses in a known
frame (10 um, 50 urad), or three or eight targets in an unknown frame (10 um). Independent noise
tests the false alarms. A common error, of the size of three standard deviations, is one
displacement of all targets of a pose or of all poses of a session.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.diagnose.cluster_covariance import check_clusters
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate

CLEAN, COMMON, POSES = 400, 100, 30
SIGMA, ANGLE = 10e-6, 50e-6
PLACES = 0.05 * np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (0.5, 1.5)])
POSE = Sensor(Pose(), Gaussian(np.array([ANGLE] * 3 + [SIGMA] * 3)))


def make_targets(chosen: tuple[int, ...]) -> Sensor:
    """Return a tracker in an unknown frame that measures some of the targets."""
    names = tuple(f"target{i}" for i in chosen)
    kind = Position(targets=names, places=PLACES[list(chosen)], unknown=("frame",))
    return Sensor(kind, Gaussian(np.full(3 * len(chosen), SIGMA)))


THREE, EIGHT = make_targets((0, 3, 5)), make_targets(tuple(range(8)))
ROBOT = load_robot("hexapod-42")


@dataclass(frozen=True)
class Case:
    """One set-up: its name, the sensor, sessions (0: none), and the common error in sigma."""

    name: str
    sensor: Sensor
    sessions: int = 0
    common: float = 0.0


CASES = (
    Case("full poses", POSE),
    Case("full poses, 8 sessions", POSE, 8),
    Case("full poses, 5 sessions", POSE, 5),
    Case("three targets", THREE),
    Case("three targets, 5 sessions with a frame each", THREE, 5),
    Case("three targets that share an error", THREE, 0, 3.0),
    Case("eight targets that share an error", EIGHT, 0, 3.0),
    Case("full poses, 8 sessions that share an error", POSE, 8, 3.0),
)


def measure(case: Case, seed: int) -> Measurements:
    """Return the measurements of a drawn machine."""
    truth = sample_truth(ROBOT, 1, seed)[0]
    ranges = np.array([ROBOT.assembly.workspace[name] for name in ROBOT.controlled])
    rng = np.random.default_rng(seed)
    poses = rng.uniform(ranges[:, 0], ranges[:, 1], (POSES, len(ranges)))
    data = simulate(ROBOT.with_values(truth), poses, Instrument((case.sensor,)), seed)
    (rows,) = data.observations
    session = np.arange(POSES) * case.sessions // POSES
    unit = session if case.sessions else np.arange(POSES)
    shift = case.common * SIGMA * rng.standard_normal((POSES, 3))[unit]
    measured = np.array(rows.measured)
    first = 3 if case.sensor is POSE else 0
    measured[:, first:] += np.tile(shift, (measured.shape[1] - first) // 3)
    labels = np.array([f"s{i}" for i in session]) if case.sessions else rows.session
    return replace(data, observations=(replace(rows, measured=measured, session=labels),))


QUICK = {"CLEAN": 3, "COMMON": 3}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    reported = [row[-1] for row in tables["ratios"]["rows"]]
    assert max(reported[:5]) == 0.0
    assert reported[6] == 100.0, "eight targets that share an error"


def collect() -> dict:
    """Return the table."""
    rows = []
    for case in CASES:
        fits = COMMON if case.common else CLEAN
        checks = []
        for seed in range(fits):
            data = measure(case, seed)
            checks.append(check_clusters(identify(ROBOT, data, LeastSquares()), data))
        ratios = np.array([check.position.ratio for check in checks])
        low, middle, high = np.quantile(ratios, [0.05, 0.5, 0.95])
        named = np.mean([check.finding.code == "residuals.common-errors" for check in checks])
        above = np.mean(ratios > 1.5)
        rows.append(
            [
                case.name,
                fits,
                f"{checks[0].clusters} {checks[0].unit}s",
                f"{middle:.2f} ({low:.2f} to {high:.2f})",
                100.0 * float(above),
                100.0 * float(named),
            ]
        )
    table = {
        "columns": [
            "measured",
            "fits",
            "independent units",
            "ratio for positions: median (90 % of fits)",
            "ratio above 1.5 [%]",
            "reported [%]",
        ],
        "formats": ["", "d", "", "", ".1f", ".1f"],
        "rows": rows,
    }
    return {"seeds": [0, CLEAN], "tables": {"ratios": table}}
