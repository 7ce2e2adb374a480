# SPDX-License-Identifier: Apache-2.0
"""Start values of unknown frames, targets and surfaces, computed without a guess, for a machine
that is a millimeter off.

Frames are drawn from all rotations and up to meters away. A start is successful if it explains the
rows at least as well as the truth does at the poses of the nominal machine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.estimate.pose_estimate import fit_nuisance_values
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.initial_values import evaluate_measurements, whiten_rows
from loopcal.measure.kinds.directions import Autocollimation, Direction, Inclination
from loopcal.measure.kinds.distance import Distance, Separation
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Bearing, Position
from loopcal.measure.kinds.surfaces import Line, Plane, Sphere
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters, collect_nuisance_parameters
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism

Array = NDArray[np.float64]

DRAWS, POSES = 1000, 12
"""Draws of each kind, and measured poses."""

POSE_ERROR = 1e-3
"""Error of the nominal poses, one standard deviation [m], [rad]."""

SIGMA = 1e-5
"""Stated noise, one standard deviation [m], [rad]; the draws are zero."""

RESIDUAL_LIMIT = 1.05
"""Largest residual of a successful start over that at the truth: a few digits are enough."""

ROTATION_LIMIT = 0.05
"""Largest rotation error of a successful frame [rad]: 1 mm over 0.1 m is 0.01."""

POINT = np.array([[0.03, -0.02, 0.05]])
NO_PLACE, NO_PLACES = np.zeros((1, 3)), np.zeros((3, 3))
ONE = np.eye(4)
FIVE = ("x", "y", "z", "phi", "theta")
KINDS: dict[str, Kind] = {
    "targets in a frame": Position(
        targets=("a", "b", "c"), places=NO_PLACES, unknown=("frame", "targets")
    ),
    "a frame": Position(places=POINT, unknown=("frame",)),
    "targets": Position(targets=("a", "b", "c"), places=NO_PLACES, unknown=("targets",)),
    "frame and tool of poses": Pose(unknown=("frame", "tool"), T_platform_tool=ONE),
    "frame of poses": Pose(unknown=("frame",), T_platform_tool=ONE),
    "frame of five coordinates": Component(
        FIVE, "tilt-torsion", unknown=("frame",), T_platform_tool=ONE
    ),
    "frame of a height and two tilts": Component(
        ("z", "a", "b"), "euler-xyz", unknown=("frame",), T_platform_tool=ONE
    ),
    "point of distances": Distance(places=POINT, unknown=("anchor",)),
    "point and zero of a wire": Distance(places=POINT, unknown=("anchor", "offset")),
    "both ends of a wire": Distance(places=NO_PLACE, unknown=("anchor", "targets")),
    "theodolite": Bearing(places=POINT, unknown=("frame",)),
    "theodolite and its target": Bearing(places=NO_PLACE, unknown=("frame", "targets")),
    "camera": Bearing(places=POINT, unknown=("frame",), form="camera"),
    "frame and axis": Direction(unknown=("frame", "axis")),
    "gravity and mounting": Inclination(unknown=("gravity", "mounting")),
    "mirror": Autocollimation(unknown=("mirror",)),
    "plane": Plane(places=POINT, unknown=("surface",)),
    "line": Line(places=POINT, unknown=("surface",)),
    "sphere": Sphere(places=POINT, unknown=("surface",)),
    "point and zero of a ball-bar": Separation(places=NO_PLACE, unknown=("targets", "offset")),
}
DISTANT_SETUPS = ("frame", "anchor", "sphere")
FULL_SIZE_KINDS = (
    "targets in a frame",
    "frame and tool of poses",
    "point and zero of a ball-bar",
    "targets",
)


def draw_poses(rng: np.random.Generator, n: int) -> Array:
    """Draw poses (n, 4, 4) within 0.1 m and 0.25 rad of one 0.8 m above the base."""
    x = rng.uniform(-1, 1, (n, 6)) * [0.1, 0.1, 0.1, 0.25, 0.25, 0.25] + [0, 0, 0.8, 0, 0, 0]
    return geometry.make_pose(geometry.euler_to_matrix(x[:, 3:], "xyz"), x[:, :3])


def draw_truth(local: NuisanceParameters, rng: np.random.Generator) -> Array:
    """Draw true values: any rotation, frames up to 2 m off, targets and surfaces up to 0.1 m."""
    values = local.values()
    for i, name in enumerate(local.table.names):
        owner, axis = name.rsplit(".", 1)
        if axis in ("u", "v"):
            values[i] = rng.uniform(-0.6, 0.6)
        elif axis == "radius":
            values[i] += rng.uniform(0.0, 0.02)
        elif axis not in ("rx", "ry", "rz"):
            reach = 2.0 if owner in DISTANT_SETUPS else 0.1
            values[i] += rng.uniform(-reach, reach)
    for owner in {name[:-3] for name in local.table.names if name.endswith(".rx")}:
        quaternion = rng.normal(size=4)
        turn = geometry.log_so3(
            geometry.quaternion_to_matrix(quaternion / np.linalg.norm(quaternion))
        )
        for axis, value in zip(("rx", "ry", "rz"), turn, strict=True):
            values[local.table.index(f"{owner}.{axis}")] = value
    return values


def simulate_rows(
    kind: Kind, T: Array, rng: np.random.Generator
) -> tuple[Measurements, NuisanceParameters, Array]:
    """Simulate noise-free rows at random true values; return both."""
    n, m = len(T), len(kind.noise_columns)
    poses_seen = (
        np.arange(n)
        if kind.poses_per_row == 1
        else np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    )
    empty = Observations.from_sigma(
        kind, poses_seen, np.full((n, len(kind.columns)), np.nan), SIGMA
    )
    data = Measurements("toy", np.zeros((n, 1)), (empty,))
    local = collect_nuisance_parameters(data.observations, data.labels)
    truth = draw_truth(local, rng)
    seen = kind.measure(T[None, poses_seen], np.zeros((1, n, m)), local.select(0, truth[None]))
    return replace(data, observations=(replace(empty, measured=seen[0]),)), local, truth


def whitened_residuals(
    data: Measurements, T: Array, local: NuisanceParameters, values: Array
) -> Array:
    """Return the whitened residuals of all rows at poses T (n, 4, 4)."""
    return whiten_rows(
        evaluate_measurements(data, T[None], values[None], local), np.zeros((1, len(T), 6, 0))
    )[0, :, -1]


@dataclass(frozen=True)
class StartResult:
    """Result of a search without a guess.

    residual : root mean square at the start over that at the truth.
    rotation_error : of the frame [rad]; None if no frame is unknown.
    """

    residual: float
    rotation_error: float | None

    @property
    def is_successful(self) -> bool:
        """Return whether residual and rotation are within their limits."""
        return self.residual < RESIDUAL_LIMIT and (
            self.rotation_error is None or self.rotation_error < ROTATION_LIMIT
        )


@cache
def load_any_robot() -> Mechanism:
    """Return a robot, on which start values at given poses do not depend."""
    return load_robot("hexapod-42")


def compute_start(name: str, seed: int) -> StartResult | None:
    """Compute start values for one draw of a kind; None if the drawn truth cannot be measured, such
    as a length below zero.
    """
    rng = np.random.default_rng(seed)
    T = draw_poses(rng, POSES)
    try:
        data, local, truth = simulate_rows(KINDS[name], T, rng)
    except DataError:
        return None
    believed = geometry.apply_twist(T, rng.normal(size=(POSES, 6)) * POSE_ERROR)
    result = fit_nuisance_values(load_any_robot(), data, believed, local)
    left, best = (
        float(np.linalg.norm(whitened_residuals(data, believed, local, values)))
        for values in (result, truth)
    )
    rotation_error = None
    if "frame.rx" in local.table.names:
        first = local.table.index("frame.rx")
        turn, right = (geometry.exp_so3(values[first : first + 3]) for values in (result, truth))
        rotation_error = float(np.linalg.norm(geometry.log_so3(turn @ right.T)))
    return StartResult(left / best, rotation_error)


QUICK = {"DRAWS": 15}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert all(row[2] == row[1] > 0 for row in tables["found"]["rows"])


def collect() -> dict:
    """Collect the starts of the full-size kinds."""
    rows = []
    for name in FULL_SIZE_KINDS:
        drawn = [one for seed in range(DRAWS) if (one := compute_start(name, seed)) is not None]
        turns = [1e3 * one.rotation_error for one in drawn if one.rotation_error is not None]
        share = max(one.residual for one in drawn)
        rows.append(
            [
                name,
                len(drawn),
                sum(one.is_successful for one in drawn),
                share,
                max(turns) if turns else None,
            ]
        )
    return {
        "seeds": [0, DRAWS],
        "poses": POSES,
        "off": {"length [mm]": 1e3 * POSE_ERROR, "angle [mrad]": 1e3 * POSE_ERROR},
        "tables": {
            "found": {
                "columns": [
                    "unknown setup", "draws", "successful",
                    "largest residual / residual at the truth",
                    "largest error of orientation [mrad]",
                ],
                "formats": ["", "d", "d", ".2f", ".1f"],
                "rows": rows,
            }
        },
    }  # fmt: skip
