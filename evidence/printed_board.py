# SPDX-License-Identifier: Apache-2.0
"""A camera and a printed board calibrate a hexapod, a delta and a five-bar whose kinematics, and
whose pictures, are written here a second time: coverage, and the stated accuracy over the true one.

Nothing of loopcal makes the data: legs and arms are closed by a solver of scipy, and corners are
projected by the formulas of OpenCV's documentation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

import loopcal as lc
from loopcal.geometry import exp_so3, make_pose
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.kinds.image import Image
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations

Array = NDArray[np.float64]
Values = dict[str, float]

MACHINES, POSES, PREDICTED, SEED = 20, 30, 15, 5
SIGMA = 0.1
"""Noise of u and v [px]."""

CORNERS = (8, 6)
NORMAL_95 = 1.959963984540054
COLUMNS = [
    "machine",
    "machines",
    "parameters in their 95 % intervals [%]",
    "lens in its 95 % intervals [%]",
    "error of the tool (rms) [um]",
    "stated over true",
    "chi-square / degrees",
]
FORMATS = ["", "d", ".1f", ".1f", ".2f", ".2f", ".3f"]
TRUE_LENS = np.array([3260.0, 3268.0, 2021.0, 1487.0, 0.09, -0.16, 0.05, 0.0008, -0.0006])


def turn(angle: float) -> Array:
    """Return the rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def close_hexapod(p: Values, q: Array, x: Array) -> Array:
    """Return the errors of six legs between a base and a platform at pose x: position, rotation."""
    R, found = exp_so3(x[3:]), []
    for i in range(6):
        a, b = (
            np.array([p[f"leg{i + 1}.{body}.{axis}"] for axis in "xyz"])
            for body in ("base", "platform")
        )
        found.append(np.linalg.norm(R @ b + x[:3] - a) - p[f"leg{i + 1}.length"] - q[i])
    return np.array(found)


def close_delta(p: Values, q: Array, x: Array) -> Array:
    """Return the errors of three rods; a motor at 0 points outwards, at 90 degrees down."""
    found = []
    for i in range(3):
        angle = q[i] + p[f"q{i + 1}.offset"]
        motor = np.array([p[f"arm{i + 1}.motor.{axis}"] for axis in "xyz"])
        elbow = motor + p[f"arm{i + 1}.tip.x"] * np.array([np.cos(angle), 0.0, -np.sin(angle)])
        rod = x + turn(2.0 * np.pi * i / 3.0) @ np.array([0.04, 0.0, 0.0])
        rod = rod - turn(2.0 * np.pi * i / 3.0) @ elbow
        found.append(np.linalg.norm(rod) - p[f"arm{i + 1}.length"])
    return np.array(found)


def close_five_bar(p: Values, q: Array, x: Array) -> Array:
    """Return the errors of two rods that meet in the tool."""
    found = []
    for i, (limb, drive) in enumerate((("west", "left"), ("east", "right"))):
        angle = q[i] + p[f"{drive}.offset"]
        elbow = np.array([p[f"{limb}.motor.x"], p[f"{limb}.motor.y"]])
        elbow = elbow + p[f"{limb}.tip.x"] * np.array([np.cos(angle), np.sin(angle)])
        found.append(np.linalg.norm(x - elbow) - p[f"{limb}.length"])
    return np.array(found)


def drive_hexapod(p: Values, x: Array) -> Array:
    """Return the readings of the nominal legs at a pose."""
    return close_hexapod(p, np.zeros(6), x)


def drive_delta(p: Values, x: Array) -> Array:
    """Return the motor angles of the nominal delta, arms outwards."""
    return least_squares(lambda q: close_delta(p, q, x), np.full(3, 0.5), xtol=1e-14).x


def drive_five_bar(p: Values, x: Array) -> Array:
    """Return the motor angles of the nominal five-bar, elbows outside."""
    return least_squares(lambda q: close_five_bar(p, q, x), [2.4, 0.7], xtol=1e-14).x


@dataclass(frozen=True)
class Machine:
    """A robot of loopcal, and its kinematics written here."""

    robot: str
    close: Callable[[Values, Array, Array], Array]
    drive: Callable[[Values, Array], Array]
    low: tuple[float, ...]  # ranges of the coordinates of a pose
    high: tuple[float, ...]
    square: float  # [m]
    camera: tuple[float, float, float]  # place from the middle of the workspace [m]
    degrees: tuple[int, int]  # coordinates of position, and of rotation
    times: int = 1  # more machines where few directions decide the error


MACHINES_BY_NAME = {
    "hexapod": Machine(
        "hexapod-42",
        close_hexapod,
        drive_hexapod,
        (-0.035, -0.035, 0.175, -0.2, -0.2, -0.2),
        (0.035, 0.035, 0.225, 0.2, 0.2, 0.2),
        0.012,
        (0.09, -0.12, 0.26),
        (3, 3),
    ),
    "delta": Machine(
        "rotary-delta",
        close_delta,
        drive_delta,
        (-0.11, -0.11, -0.55),
        (0.11, 0.11, -0.42),
        0.018,
        (0.25, -0.3, 0.55),
        (3, 0),
        30,
    ),
    "five-bar": Machine(
        "five-bar",
        close_five_bar,
        drive_five_bar,
        (-0.11, 0.275),
        (0.11, 0.385),
        0.018,
        (0.18, -0.28, 0.4),
        (2, 0),
        20,
    ),
}


def locate(machine: Machine, p: Values, q: Array, start: Array) -> Array:
    """Return the coordinates of the pose at which the loops close, by Newton's method with
    differences.
    """
    x: Array = np.array(start, dtype=np.float64)
    step = 1e-6
    for _ in range(30):
        errors = machine.close(p, q, x)
        if np.abs(errors).max() < 1e-14:  # [m]
            break
        pairs = [
            (machine.close(p, q, x + step * d), machine.close(p, q, x - step * d))
            for d in np.eye(len(x))
        ]
        slope = np.column_stack([(a - b) / (2.0 * step) for a, b in pairs])
        x = x - np.linalg.solve(slope, errors)
    assert np.abs(machine.close(p, q, x)).max() < 1e-12  # [m], of loops that close
    return x


def place(machine: Machine, x: Array) -> Array:
    """Return T_base_platform (4, 4) of coordinates."""
    n, rotations = machine.degrees
    position = np.zeros(3)
    position[:n] = x[:n]
    return make_pose(exp_so3(x[n:]) if rotations else np.eye(3), position)


def look_at(eye: Array, target: Array) -> Array:
    """Return the pose of a camera that looks at a target, x level."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    return make_pose(np.column_stack([x, np.cross(z, x), z]), eye)


def photograph(points: Array, lens: Array) -> Array:
    """Return the pixels (k, 2) of points (k, 3) in the frame of the camera."""
    fx, fy, cx, cy, k1, k2, k3, p1, p2 = lens
    a, b = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = a**2 + b**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a**2)
    v = b * radial + p1 * (r2 + 2 * b**2) + 2 * p2 * a * b
    return np.column_stack([fx * u + cx, fy * v + cy])


@dataclass(frozen=True, eq=False)
class Scene:
    """One machine with a camera and a board: what is true, and where a person would put them."""

    truth: Values
    q: Array  # (n, a) readings
    x: Array  # (n, c) true coordinates there
    stated: tuple[Array, Array]  # camera in the base, board on the platform
    true: tuple[Array, Array]
    lens: Array

    def locate_board(self, machine: Machine, x: Array) -> Array:
        """Return T_camera_board (4, 4) at the coordinates of a pose."""
        return np.linalg.inv(self.true[0]) @ place(machine, x) @ self.true[1]


def build_scene(machine: Machine, rng: np.random.Generator, poses: int) -> Scene:
    """Return a machine whose errors are drawn from its spreads, at drawn poses."""
    table = load_robot(machine.robot).parameters
    nominal = dict(zip(table.names, table.nominal.tolist(), strict=True))
    truth = {
        e.name: e.nominal + (e.tolerance or 0.0) * rng.standard_normal() * e.free
        for e in table.entries
    }
    commanded = rng.uniform(machine.low, machine.high, (poses, len(machine.low)))
    q = np.array([machine.drive(nominal, x) for x in commanded])
    x = np.array([locate(machine, truth, *each) for each in zip(q, commanded, strict=True)])
    middle = place(machine, 0.5 * (np.array(machine.low) + machine.high))[:3, 3]
    square, (columns, rows) = machine.square, CORNERS
    board = make_pose(
        np.diag([1.0, -1.0, -1.0]), square * np.array([-0.5 * (columns - 1), 0.5 * (rows - 1), 0.0])
    )
    camera = look_at(middle + machine.camera, middle)
    # the board is mounted, and the camera set up, by hand
    twist = rng.standard_normal((2, 6)) * np.repeat([0.03, 0.004], 3)
    true_camera, true_board = (
        make_pose(exp_so3(t[:3]) @ T[:3, :3], T[:3, 3] + t[3:])
        for t, T in zip(twist, (camera, board), strict=True)
    )
    lens = TRUE_LENS * (1.0 + 0.01 * rng.standard_normal(9))
    lens[1] = lens[0] * TRUE_LENS[1] / TRUE_LENS[0]  # pixels of phones are nearly square
    return Scene(truth, q, x, (camera, board), (true_camera, true_board), lens)


@dataclass(frozen=True, eq=False)
class Sample:
    """One machine: its measurements and what is true."""

    data: Measurements
    truth: Values
    q: Array  # (k, a) readings at which poses are predicted
    x: Array  # (k, c) true coordinates there
    setup: Values


def simulate_machine(machine: Machine, seed: int, poses: int = POSES) -> Sample:
    """Return the pictures of a machine whose errors are drawn from its spreads."""
    rng, robot = np.random.default_rng([SEED, seed]), load_robot(machine.robot)
    scene = build_scene(machine, rng, poses + PREDICTED)
    square, (columns, rows) = machine.square, CORNERS
    flat = [
        [square * (i % columns), square * (i // columns), 0.0, 1.0] for i in range(columns * rows)
    ]
    pixels = []
    for each in scene.x[:poses]:
        body = scene.locate_board(machine, each)
        pixels.append(photograph((np.array(flat) @ body.T)[:, :3], scene.lens))
    seen = np.array(pixels) + SIGMA * rng.standard_normal((poses, len(flat), 2))
    inside = ((seen > 0) & (seen < [4000, 3000])).all(axis=-1)
    kind = Image(
        T_camera=scene.stated[0],
        T_board=scene.stated[1],
        focal=(3150.0, 3150.0),
        corners=CORNERS,
        square=square,
        unknown=("camera", "board", "focal", "center", "radial", "tangential"),
    )
    corner = np.tile(np.arange(len(flat)), (poses, 1))
    columns_seen = np.column_stack([corner[inside], seen[inside]])
    rows_of = np.repeat(np.arange(poses), inside.sum(axis=1))
    observed = Observations.from_sigma(kind, rows_of, columns_seen, SIGMA)
    data = Measurements(robot.name, scene.q[:poses], (observed,))
    return Sample(data, scene.truth, scene.q[poses:], scene.x[poses:], name_lens(scene.lens))


def name_lens(lens: Array) -> Values:
    """Return the parameters of a lens (9,) by their names in loopcal."""
    fx, fy, *others = lens
    names = ("fx", "aspect", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
    return {f"camera.{n}": v for n, v in zip(names, (fx, fy / fx - 1.0, *others), strict=True)}


def predict_errors(machine: Machine, sample: Sample, values: Values) -> Array:
    """Return the errors (3 k,) of the position of the tool at the predicted readings."""
    found = [locate(machine, values, *each) for each in zip(sample.q, sample.x, strict=True)]
    positions = [place(machine, x)[:3, 3] for x in found]
    return np.array(positions).ravel()


def fit_motions(machine: Machine, sample: Sample) -> Array:
    """Return an orthonormal basis (3 k, m) of what motions of base and platform frame do to the
    positions: these the pictures do not determine.
    """
    T = np.array([place(machine, x) for x in sample.x])
    columns = []
    for axis in np.eye(3):
        columns.append(np.tile(axis, len(T)))
        columns.append(np.cross(axis, T[:, :3, 3]).ravel())
        columns.append((T[:, :3, :3] @ axis).ravel())
    U, s, _ = np.linalg.svd(np.column_stack(columns), full_matrices=False)
    return U[:, s > 1e-9 * s[0]]


@dataclass(frozen=True)
class Outcome:
    """What one machine shows."""

    inside: int  # parameters in their 95 % intervals
    count: int
    lens_inside: int
    lens_count: int
    stated: float  # mean square of the position, stated [m^2]
    true: float
    chi_square: float  # over its degrees of freedom


def examine_machine(name: str, seed: int) -> Outcome:
    """Return whether the truth is in the intervals, and the accuracy of the position."""
    machine = MACHINES_BY_NAME[name]
    return judge(machine, simulate_machine(machine, seed))


def judge(machine: Machine, sample: Sample) -> Outcome:
    """Return what the calibration of a machine states, and what is true."""
    robot = load_robot(machine.robot)
    fit = lc.identify(robot, sample.data)
    assert fit.converged
    free = fit.free_parameters
    names, sd = list(free.names), np.sqrt(np.diag(fit.covariance))
    estimate = dict(zip(robot.parameters.names, fit.robot.values.tolist(), strict=True))
    truth = np.array([sample.truth[n] for n in names])
    error = np.array([estimate[n] for n in names]) - truth
    nuisance = dict(
        zip(
            fit.nuisance.names,
            zip(fit.nuisance.estimate, fit.nuisance.sd, strict=True),
            strict=True,
        )
    )
    lens = [abs(nuisance[n][0] - v) < NORMAL_95 * nuisance[n][1] for n, v in sample.setup.items()]
    step = 1e-7
    base = predict_errors(machine, sample, estimate)
    slopes = np.column_stack(
        [
            (predict_errors(machine, sample, estimate | {n: estimate[n] + step}) - base) / step
            for n in names
        ]
    )
    true = base - np.array([place(machine, x)[:3, 3] for x in sample.x]).ravel()
    U = fit_motions(machine, sample)
    out, slopes = true - U @ (U.T @ true), slopes - U @ (U.T @ slopes)
    k = len(sample.x)
    stated = float(np.einsum("ij,jk,ik->", slopes, fit.covariance, slopes)) / k
    return Outcome(
        int((np.abs(error) < NORMAL_95 * sd).sum()),
        len(names),
        sum(lens),
        len(lens),
        stated,
        float(out @ out) / k,
        float(fit.residual_test.chi_square / fit.residual_test.degrees),
    )


def summarize(name: str, outcomes: list[Outcome]) -> list[Any]:
    """Return the row of a machine."""
    total = {key: sum(getattr(o, key) for o in outcomes) for key in Outcome.__dataclass_fields__}
    return [
        name,
        len(outcomes),
        100.0 * total["inside"] / total["count"],
        100.0 * total["lens_inside"] / total["lens_count"],
        1e6 * np.sqrt(total["true"] / len(outcomes)),
        float(np.sqrt(total["stated"] / total["true"])),
        total["chi_square"] / len(outcomes),
    ]


def collect() -> dict[str, Any]:
    """Return the table of all machines."""
    rows = [
        summarize(name, [examine_machine(name, seed) for seed in range(machine.times * MACHINES)])
        for name, machine in MACHINES_BY_NAME.items()
    ]
    return {
        "seeds": [SEED, SEED],
        "tables": {"coverage": {"columns": COLUMNS, "formats": FORMATS, "rows": rows}},
    }


QUICK = {"MACHINES": 2, "PREDICTED": 20}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds for two machines each."""
    for _, _, inside, _, _, ratio, chi_square in tables["coverage"]["rows"]:
        assert inside > 85.0
        assert 0.4 < ratio < 2.5
        assert 0.8 < chi_square < 1.2
