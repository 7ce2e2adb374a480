# SPDX-License-Identifier: Apache-2.0
"""Machines and instruments simulated without the kinematics of loopcal: a hexapod, a linear delta
and a five-bar.

True poses are drawn, and readings follow from the true geometry in closed form. An error of a drive
is part of the reading: the machine stands elsewhere than its reading says. An unknown instrument
stands at a drawn place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import loopcal as lc

Array = NDArray[np.float64]
DriveError = Callable[[Array, np.random.Generator], Array]
"""Errors (n, a) [m, rad] of readings (n, a), in the order of measurement."""

TARGETS = np.array([[0.06, 0.0, 0.03], [-0.03, 0.05, 0.03], [-0.03, -0.05, 0.03]])
"""Places [m] of the three reflectors on a platform."""
FRAME = "tracker"


@dataclass(frozen=True)
class Effects:
    """What a simulated machine and its instrument do that a calibration does not assume.

    Attributes
    ----------
    noise : true noise over the stated one. drives : errors of the readings.
    session, walk, shared : standard deviations, in stated sigmas, of an offset of the instrument in
        each of four sessions, of its step from pose to pose, and of an error that all targets of a
        pose have in common. is_named : whether the data name the sessions.
    sag : [m], by which the platform hangs lower at the edge of the workspace than in its center.
    """

    noise: float = 1.0
    drives: DriveError | None = None
    session: float = 0.0
    is_named: bool = False
    walk: float = 0.0
    shared: float = 0.0
    sag: float = 0.0


@dataclass(frozen=True)
class Setup:
    """A machine with its instrument.

    sigma : stated (position [m], angle [rad]). in_frame : whether the instrument stands at an
    unknown place.
    """

    name: str
    robot: str
    kind: lc.Kind
    sigma: tuple[float, float]
    poses: int = 40
    in_frame: bool = False


SETUPS = {
    setup.name: setup
    for setup in (
        Setup("hexapod, pose probe", "hexapod-42", lc.Pose(), (5e-6, 2.5e-5), 60),
        Setup(
            "hexapod, tracker", "hexapod-42",
            lc.Position(targets=("a", "b", "c"), places=TARGETS, unknown=("frame",), frame=FRAME),
            (1e-5, 0.0), 40, True,
        ),
        Setup("delta, points", "linear-delta", lc.Component(("x", "y", "z")), (5e-6, 0.0)),
        Setup("delta, heights", "linear-delta", lc.Component(("z",)), (1e-5, 0.0), 60),
        Setup(
            "five-bar, camera", "five-bar",
            lc.Component(("x", "y"), unknown=("frame",), frame=FRAME), (1e-5, 0.0), 40, True,
        ),
        Setup("five-bar, known camera", "five-bar", lc.Component(("x", "y")), (5e-6, 0.0)),
    )
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class MeasuredMachine:
    """A drawn machine. truth : (p,) [SI]. data : measured poses. readings, positions : (h, a), (h,
    3) of poses that are not measured; positions [m] in the frame of the instrument.
    """

    truth: Array
    data: lc.Measurements
    readings: Array
    positions: Array


def measure_machine(
    setup: Setup, seed: int, effects: Effects | None = None, unmeasured: int = 12
) -> MeasuredMachine:
    """Measure a drawn machine, and move it to unmeasured poses."""
    effects = effects or Effects()
    rng, robot, n = np.random.default_rng([31, seed]), lc.load_robot(setup.robot), setup.poses
    table, workspace = robot.parameters, robot.assembly.workspace
    drawn = np.where(table.free, np.asarray(table.tolerance), 0.0)
    truth = table.nominal + drawn * rng.standard_normal(len(table))
    low, high = np.array(list(workspace.values())).T
    x = rng.uniform(low, high, (n + unmeasured, len(low)))
    q = READINGS[setup.robot](robot, truth, x)
    if effects.drives is not None:
        q = q - effects.drives(q, rng)
    position = np.pad(x[:, :3], ((0, 0), (0, max(0, 3 - x.shape[1]))))
    R = Rotation.from_euler("xyz", x[:, 3:] if x.shape[1] == 6 else np.zeros((len(x), 3)))
    outward = 2.0 * (x[:, :2] - 0.5 * (low + high)[:2]) / (high - low)[:2]
    position[:, 2 if len(low) > 2 else 1] -= effects.sag * np.mean(outward**2, axis=1)
    place, turn = np.zeros(3), Rotation.identity()
    if setup.in_frame:
        planar = np.array([0.0, 0.0, 1.0]) if len(low) == 2 else np.ones(3)
        turn = Rotation.from_rotvec(planar * rng.uniform(-1.0, 1.0, 3))
        place = (1.0 - planar * (len(low) == 2)) * rng.uniform(-1.0, 1.0, 3)
    position, R = turn.inv().apply(position - place), turn.inv() * R
    measured = np.array(position[:n])
    session = 4 * np.arange(n) // n
    measured += setup.sigma[0] * (
        effects.session * rng.standard_normal((4, 3))[session]
        + effects.walk * np.cumsum(rng.standard_normal((n, 3)), axis=0)
        + effects.shared * rng.standard_normal((n, 3))
    )
    if isinstance(setup.kind, lc.Position):
        arms = np.stack([R[:n].apply(target) for target in TARGETS], axis=1)
        measured = (measured[:, None] + arms).reshape(n, -1)
    stated = np.full(len(setup.kind.noise_columns), setup.sigma[0])
    if isinstance(setup.kind, lc.Pose):
        stated[:3] = setup.sigma[1]
        turned = Rotation.from_rotvec(effects.noise * stated[:3] * rng.standard_normal((n, 3)))
        measured = np.hstack([(turned * R[:n]).as_rotvec(), measured])
        measured[:, 3:] += effects.noise * stated[3:] * rng.standard_normal((n, 3))
    else:
        if isinstance(setup.kind, lc.Component):
            measured = measured[:, ["xyz".index(axis) for axis in setup.kind.components]]
        measured += effects.noise * stated * rng.standard_normal(measured.shape)
    rows = lc.Observations.from_sigma(
        setup.kind if isinstance(setup.kind, lc.Position) else setup.kind.with_tool(robot.tool),
        np.arange(n), measured, stated,
        session=np.array([f"s{k}" for k in session]) if effects.is_named else "",
    )  # fmt: skip
    rows = replace(rows, context={"time": 60.0 * np.arange(n)})
    data = lc.Measurements(robot.name, q[:n], (rows,), labels=tuple(map(str, range(1, n + 1))))
    return MeasuredMachine(truth, data, q[n:], position[n:])


def _read_hexapod(robot: lc.Mechanism, truth: Array, x: Array) -> Array:
    """Return the extensions (n, 6) [m] of the legs at poses (n, 6): x, y, z, roll, pitch, yaw."""
    table = robot.parameters
    base, platform = (
        truth[[[table.index(f"leg{k}.{end}.{axis}") for axis in "xyz"] for k in range(1, 7)]]
        for end in ("base", "platform")
    )
    R = Rotation.from_euler("xyz", x[:, 3:]).as_matrix()
    legs = x[:, None, :3] + np.einsum("nij,kj->nki", R, platform) - base
    return (
        np.linalg.norm(legs, axis=2) - truth[[table.index(f"leg{k}.length") for k in range(1, 7)]]
    )


def _read_delta(robot: lc.Mechanism, truth: Array, x: Array) -> Array:
    """Return the drops (n, 3) [m] of the carriages from their stops at positions (n, 3)."""
    angle, arm, stop = (
        np.array([truth[robot.parameters.index(f"{name}{k}.{value}")] for k in (1, 2, 3)])
        for name, value in (("tower", "angle"), ("arm", "length"), ("tower", "stop"))
    )
    radius = truth[robot.parameters.index("radius")]
    tower = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    flat = ((tower - x[:, None, :2]) ** 2).sum(axis=2)
    return stop + np.sqrt(arm**2 - radius**2) - x[:, 2:] - np.sqrt(arm**2 - flat)


def _read_five_bar(robot: lc.Mechanism, truth: Array, x: Array) -> Array:
    """Return the angles (n, 2) [rad] of the motors, elbows outward, at positions (n, 2)."""
    value = dict(zip(robot.parameters.names, truth, strict=True))
    angles = []
    for limb, motor, side in (("west", "left", 1.0), ("east", "right", -1.0)):
        d = x - [value[f"{limb}.motor.x"], value[f"{limb}.motor.y"]]
        arm, rod, square = value[f"{limb}.tip.x"], value[f"{limb}.length"], (d**2).sum(axis=1)
        inner = np.arccos((square + arm**2 - rod**2) / (2.0 * arm * np.sqrt(square)))
        angle = np.arctan2(d[:, 1], d[:, 0]) + side * inner
        angles.append(angle - value[f"{motor}.offset"])
    return np.stack(angles, axis=1)


READINGS = {
    "hexapod-42": _read_hexapod, "linear-delta": _read_delta, "five-bar": _read_five_bar
}  # fmt: skip


def draw_repeatability(size: float) -> DriveError:
    """Return independent normal errors of this standard deviation."""
    return lambda q, rng: size * rng.standard_normal(q.shape)


def make_backlash(size: float) -> DriveError:
    """Return half a backlash in the direction of travel from the pose before."""

    def error(q: Array, rng: np.random.Generator) -> Array:
        before = np.vstack([q[0] - rng.standard_normal(q.shape[1]), q[:-1]])
        return 0.5 * size * np.sign(q - before)

    return error


def make_periodic_error(amplitude: float, period: float) -> DriveError:
    """Return the error of a gear or a screw of this amplitude and period."""
    return lambda q, rng: (
        amplitude * np.sin(2.0 * np.pi * (q / period + rng.uniform(size=q.shape[1])))
    )
