# SPDX-License-Identifier: Apache-2.0
"""Starts of unknown frames, targets and surfaces, sought without a guess, from a machine that is a
millimetre off.

Frames are drawn from the whole group of rotations and up to metres away; a start is found when it
explains the rows at least as well as the truth does at the poses that the nominal machine would
stand in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure import (
    Autocollimation,
    Bearing,
    Component,
    Direction,
    Distance,
    Inclination,
    Kind,
    Line,
    Measurements,
    NuisanceParameters,
    Observations,
    Plane,
    Pose,
    Position,
    Separation,
    Sphere,
    collect_nuisance_parameters,
    evaluate_measurements,
    guess_nuisance_values,
    whiten_rows,
)

Array = NDArray[np.float64]

DRAWS, POSES = 1000, 12
"""Frames drawn of each kind, and poses in which it is seen."""

OFF = 1e-3
"""By how much the believed poses are off, one standard deviation [m], [rad]."""

SIGMA = 1e-5
"""Noise that is stated, one standard deviation [m], [rad]; none comes."""

AS_GOOD = 1.05
"""Residual of a start that is found, as a share of that at the truth: a start is sought to a few
digits only.
"""

TURNED = 0.05
"""Error of orientation of a frame that is found, at most [rad]: a millimetre over a tenth of a
metre is 0.01.
"""

POINT = np.array([[0.03, -0.02, 0.05]])
NOWHERE, NOWHERE_3 = np.zeros((1, 3)), np.zeros((3, 3))
ONE = np.eye(4)
FIVE = ("x", "y", "z", "phi", "theta")
KINDS: dict[str, Kind] = {
    "targets in a frame": Position(
        targets=("a", "b", "c"), places=NOWHERE_3, unknown=("frame", "targets")
    ),
    "a frame": Position(places=POINT, unknown=("frame",)),
    "targets": Position(targets=("a", "b", "c"), places=NOWHERE_3, unknown=("targets",)),
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
    "both ends of a wire": Distance(places=NOWHERE, unknown=("anchor", "targets")),
    "theodolite": Bearing(places=POINT, unknown=("frame",)),
    "theodolite and its target": Bearing(places=NOWHERE, unknown=("frame", "targets")),
    "camera": Bearing(places=POINT, unknown=("frame",), form="camera"),
    "frame and axis": Direction(unknown=("frame", "axis")),
    "gravity and mounting": Inclination(unknown=("gravity", "mounting")),
    "mirror": Autocollimation(unknown=("mirror",)),
    "plane": Plane(places=POINT, unknown=("surface",)),
    "line": Line(places=POINT, unknown=("surface",)),
    "sphere": Sphere(places=POINT, unknown=("surface",)),
    "point and zero of a ball-bar": Separation(places=NOWHERE, unknown=("targets", "offset")),
}
FAR = ("frame", "anchor", "sphere")
AT_FULL_SIZE = (
    "targets in a frame",
    "frame and tool of poses",
    "point and zero of a ball-bar",
    "targets",
)


def draw_poses(rng: np.random.Generator, n: int) -> Array:
    """Poses (n, 4, 4) within a decimetre and a quarter of a radian of one 0.8 m above the base."""
    x = rng.uniform(-1, 1, (n, 6)) * [0.1, 0.1, 0.1, 0.25, 0.25, 0.25] + [0, 0, 0.8, 0, 0, 0]
    return geometry.make_pose(geometry.euler_to_matrix(x[:, 3:], "xyz"), x[:, :3])


def truth_of(local: NuisanceParameters, rng: np.random.Generator) -> Array:
    """Values anywhere: rotations over the whole group, frames up to metres off, targets and
    surfaces by centimetres.
    """
    values = local.values()
    for i, name in enumerate(local.table.names):
        owner, axis = name.rsplit(".", 1)
        if axis in ("u", "v"):
            values[i] = rng.uniform(-0.6, 0.6)
        elif axis == "radius":
            values[i] += rng.uniform(0.0, 0.02)
        elif axis not in ("rx", "ry", "rz"):
            reach = 2.0 if owner in FAR else 0.1
            values[i] += rng.uniform(-reach, reach)
    for owner in {name[:-3] for name in local.table.names if name.endswith(".rx")}:
        quaternion = rng.normal(size=4)
        turn = geometry.log_so3(
            geometry.quaternion_to_matrix(quaternion / np.linalg.norm(quaternion))
        )
        for axis, value in zip(("rx", "ry", "rz"), turn, strict=True):
            values[local.table.index(f"{owner}.{axis}")] = value
    return values


def measured_at(
    kind: Kind, T: Array, rng: np.random.Generator
) -> tuple[Measurements, NuisanceParameters, Array]:
    """Noise-free rows at random true values, and these values."""
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
    truth = truth_of(local, rng)
    seen = kind.measure(T[None, poses_seen], np.zeros((1, n, m)), local.select(0, truth[None]))
    return replace(data, observations=(replace(empty, measured=seen[0]),)), local, truth


def residuals(data: Measurements, T: Array, local: NuisanceParameters, values: Array) -> Array:
    """Whitened residuals of all rows at poses T (n, 4, 4)."""
    return whiten_rows(
        evaluate_measurements(data, T[None], values[None], local), np.zeros((1, len(T), 6, 0))
    )[0, :, -1]


@dataclass(frozen=True)
class Start:
    """What a search without a guess gave.

    residual : root mean square at the start, as a share of that at the truth. turned : error of
    orientation of the frame
    [rad]; None where none is unknown.
    """

    residual: float
    turned: float | None

    @property
    def found(self) -> bool:
        """Whether the start explains the rows as well as the truth does, its frame turned as it
        should be.
        """
        return self.residual < AS_GOOD and (self.turned is None or self.turned < TURNED)


def start(name: str, seed: int) -> Start | None:
    """Seek the unknowns of one draw of a kind; None where the truth drawn cannot be measured, such
    as a length below zero.
    """
    rng = np.random.default_rng(seed)
    T = draw_poses(rng, POSES)
    try:
        data, local, truth = measured_at(KINDS[name], T, rng)
    except DataError:
        return None
    believed = geometry.apply_twist(T, rng.normal(size=(POSES, 6)) * OFF)
    found = guess_nuisance_values(data, believed, local)
    left, best = (
        float(np.linalg.norm(residuals(data, believed, local, values))) for values in (found, truth)
    )
    turned = None
    if "frame.rx" in local.table.names:
        first = local.table.index("frame.rx")
        turn, right = (geometry.exp_so3(values[first : first + 3]) for values in (found, truth))
        turned = float(np.linalg.norm(geometry.log_so3(turn @ right.T)))
    return Start(left / best, turned)


def collect() -> dict:
    """Draw frames, targets and zeros of the kinds at full size."""
    rows = []
    for name in AT_FULL_SIZE:
        drawn = [one for seed in range(DRAWS) if (one := start(name, seed)) is not None]
        turns = [1e3 * one.turned for one in drawn if one.turned is not None]
        share = max(one.residual for one in drawn)
        rows.append(
            [
                name,
                len(drawn),
                sum(one.found for one in drawn),
                share,
                max(turns) if turns else None,
            ]
        )
    return {
        "seeds": [0, DRAWS],
        "poses": POSES,
        "off": {"length [mm]": 1e3 * OFF, "angle [mrad]": 1e3 * OFF},
        "tables": {
            "found": {
                "columns": [
                    "unknown", "draws", "found", "largest residual / that of the truth",
                    "largest error of orientation [mrad]",
                ],
                "formats": ["", "d", "d", ".2f", ".1f"],
                "rows": rows,
            }
        },
    }  # fmt: skip
