# SPDX-License-Identifier: Apache-2.0
"""The ten steps of the paper's section 5 (docs/papers/hexapod-42.md), repeated with other noises,
methods and poses, and the origin of its Table 4.

Least squares is `identify_per_leg`, one step at a time, every equation of weight one and every
parameter of scale one. Poses are (x, y, z, alpha, beta, gamma) [m, rad] in the paper's order.
Derivation: docs/theory/hexapod.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations
from typing import NamedTuple

import numpy as np

import loopcal as lc
from loopcal import geometry
from loopcal.measure.instrument import make_random_stream
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, forward, inverse
from loopcal.numerics.statistics import compute_chi_square_quantile
from loopcal.papers.paper import PAPERS
from loopcal.papers.published import PaperFile, Printed, Row
from loopcal.studies.simulation.block import CalibratedCell, calibrate_cells, find_cells, set_size
from loopcal.studies.simulation.published_steps import (
    MM,
    LegForm,
    identify_per_leg,
    integrate_errors,
)
from loopcal.studies.specification.levels import PosesLevel
from loopcal.typing import BoolArray, FloatArray, IntArray

TO_SI, TO_PRINTED = np.array([MM] * 3 + [1.0] * 3), np.array([1.0 / MM] * 3 + [1.0] * 3)
"""From the units of Tables 4 and 6 to [m, rad], and from [m, rad] to them."""
PARAMETERS = ("base.x", "base.y", "base.z", "length", "platform.x", "platform.y", "platform.z")
"""Our names for the columns of Tables 2, 3 and 5."""
ODD_POSE = "A2"
"""The row of Table 4 that belongs to another machine; the outlier search finds it by itself."""
ORDER = "xyz"
"""R = Rz(gamma) Ry(beta) Rx(alpha), with which Table 4 was made. Equation (2) differs, see
`rank_euler_orders`.
"""
ANGLES = geometry.parse_orientation(f"euler-{ORDER}")
GREEK = ("alpha", "beta", "gamma")

STATED, PRESUMED = "0.001 mm and 1e-06 rad", "1e-06 mm and 1e-09 rad"
"""Instruments of study.yaml: the stated noise, and that with which Tables 5 and 6 agree, as the
sweep shows. The paper states none for angles: the same number in the unit that its Table 6 prints,
0.001 mrad.
"""
PER_LEG = ("per leg, 1 step", "per leg, 2 steps", "per leg, 3 steps")
TOGETHER, PRIOR = "least squares", "MAP"
"""Methods of study.yaml."""
PAPERS_TEN = "the paper's ten"
DRAWN_POSES = 3  # purpose of a random stream

PRINTED, SIZES = PaperFile(__file__, "published.yaml"), PaperFile(__file__, "sizes.yaml")


@dataclass(frozen=True, eq=False)
class Setup:
    """Step 1."""

    robot: Mechanism  # the machine as designed
    truth: Mechanism  # with its errors
    poses: FloatArray  # (n, 6) nominal [m, rad]

    @cached_property
    def commanded(self) -> Solution:
        """Nominal poses with the leg readings of the nominal machine."""
        R = ANGLES.to_matrix(self.poses[:, 3:])
        return inverse(self.robot, geometry.make_pose(R, self.poses[:, :3]))

    @cached_property
    def actual(self) -> FloatArray:
        """(n, 6) true poses at the readings of the nominal machine: step 2."""
        return self.compute_reached(self.truth)

    def compute_reached(self, machine: Mechanism) -> FloatArray:
        """Return the poses (n, 6) [m, rad] of a machine at the readings of the nominal one."""
        return to_coordinates(forward(machine, self.commanded.q, self.commanded).T)


def make_setup(leg_lengths: bool = True) -> Setup:
    """Return the hexapod of Tables 2 and 3 at the nominal poses of Table 4.

    The printed radians are whole degrees to their last digit. Without `leg_lengths` the errors of
    the leg lengths are zero.
    """
    robot = lc.load_robot("hexapod-42")
    errors = PRINTED.table("table_3").values * MM
    errors[:, PARAMETERS.index("length")] *= leg_lengths
    poses = PRINTED.table("table_4", "PT").values / TO_PRINTED
    poses[:, 3:] = np.deg2rad(np.round(np.rad2deg(poses[:, 3:])))
    truth = robot.parameters.nominal.copy()
    truth[find_places(robot)] += errors
    return Setup(robot, robot.with_values(truth), poses)


def find_places(robot: Mechanism) -> IntArray:
    """Return the places (6, 7) of the parameters in the paper's layout in the robot's order."""
    index = robot.parameters.index
    return np.array([[index(f"leg{leg}.{name}") for name in PARAMETERS] for leg in range(1, 7)])


def to_coordinates(T: FloatArray) -> FloatArray:
    """Return coordinates (n, 6) [m, rad] of transforms (n, 4, 4)."""
    return np.concatenate([T[:, :3, 3], ANGLES.from_matrix(T[:, :3, :3])], axis=1)


def subtract_poses(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return differences (n, 6) of coordinates, angles wrapped."""
    change = first - second
    return np.concatenate([change[:, :3], geometry.wrap_angle(change[:, 3:])], axis=1)


def to_twists(errors: FloatArray, poses: FloatArray) -> FloatArray:
    """Return twists (n, 6), rotation first, of coordinate errors (n, 6) [m, rad] near poses."""
    omega = ANGLES.rates(poses[:, 3:]) @ errors[:, 3:, None]
    return np.concatenate([omega[..., 0], errors[:, :3]], axis=1)


def to_measurements(
    setup: Setup, measured: FloatArray, sigma: FloatArray | float = 1.0
) -> Measurements:
    """Return measured poses (n, 6) [m, rad]; sigma : one for all values, or (n, 6) [m, rad]."""
    kind = Pose(f"euler-{ORDER}").with_tool(setup.robot.tool)
    sd = sigma if isinstance(sigma, float) else np.roll(sigma, 3, axis=1)
    # a kind has its angles first
    rows = Observations.from_sigma(kind, np.arange(len(measured)), np.roll(measured, 3, axis=1), sd)
    labels = tuple(f"A{i + 1}" for i in range(len(measured)))
    return Measurements(setup.robot.name, setup.commanded.q, (rows,), labels=labels)


def list_noises() -> dict[str, tuple[float, float]]:
    """Return the limits [mm, rad] of the uniform noise of each instrument of study.yaml."""
    levels, root = PAPERS["hexapod-42"].load_study().instruments, np.sqrt(3.0)
    sigmas = {name: (of.sigma_position / MM, of.sigma_angle) for name, of in levels.items()}
    return {  # sigmas have nine digits
        name: (float(f"{root * length:.6g}"), float(f"{root * angle:.6g}"))
        for name, (length, angle) in sigmas.items()
    }


def compute_rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True, eq=False)
class Iterations:
    """Result of steps 4 to 10. Index k is the state after k iterations, 0 the nominal machine."""

    values: FloatArray  # (k + 1, p) corrected parameters [m]
    pose_errors: FloatArray  # (k + 1, n, 6) measured minus corrected [m, rad]
    integrated: FloatArray  # (k + 1,) max dQint [mm + rad]
    conditions: FloatArray  # (6,) condition number of each leg's matrix in the first iteration

    def count_needed(self, threshold: float) -> int | None:
        """Return the iterations until max dQint is at most the threshold; None if it never is."""
        met = np.flatnonzero(self.integrated[1:] <= threshold)
        return int(met[0]) + 1 if len(met) else None


def draw_measured_poses(
    setup: Setup, limits: tuple[float, float], seed: int = 0, trial: int = 0
) -> FloatArray:
    """Return the true poses (n, 6) [m, rad] with uniform noise within limits [mm, rad]: step 3. The
    drawn numbers are those of `simulate_trials` for the same seed and trial.
    """
    drawn = make_random_stream(seed, trial).uniform(-1.0, 1.0, setup.actual.shape)
    noise = np.array([limits[0] * MM] * 3 + [limits[1]] * 3)
    return setup.actual + np.roll(drawn, 3, axis=1) * noise  # a kind has its angles first


def iterate(
    setup: Setup, measured: FloatArray, limit: int = 4, is_renewed: bool = True
) -> Iterations:
    """Run steps 4 to 10 on measured poses (n, 6) [m, rad], `limit` times, beyond the paper's rule.

    is_renewed : whether the matrix is computed anew at every corrected machine. The paper does not
    say. False keeps the matrix of the nominal machine throughout.
    """
    robot, data = setup.robot, to_measurements(setup, measured)
    nominal = LegForm.at(robot, setup.commanded)
    values = list(identify_per_leg(robot, data, limit if is_renewed else 1).estimate_history)
    errors = [subtract_poses(measured, setup.poses)]
    for k in range(1, limit + 1):
        if k == len(values):
            values.append(values[-1] + nominal.fit(to_twists(errors[-1], measured)))
        reached = setup.compute_reached(robot.with_values(values[k]))
        errors.append(subtract_poses(measured, reached))
    stacked = np.stack(errors)
    return Iterations(np.stack(values), stacked, integrate_errors(stacked), nominal.conditions)


@dataclass(frozen=True, eq=False)
class Level:
    """Results with one level of noise."""

    limits: tuple[float, float]  # [mm, rad]
    # (t, 4): rms of pose residuals [mm], [rad] and of parameter errors [mm], max dQint [mm + rad]
    sizes: FloatArray
    needed: FloatArray  # (t,) iterations, infinite for never

    @property
    def median(self) -> FloatArray:
        """(4,) medians of the sizes."""
        return np.median(self.sizes, axis=0)

    def contains(self, sizes: FloatArray) -> BoolArray:
        """Return which sizes (4,) lie between the smallest and the largest drawn ones."""
        return (sizes >= self.sizes.min(axis=0)) & (sizes <= self.sizes.max(axis=0))


def calibrate_methods(
    seed: int, trials: int, instrument: str, methods: Sequence[str], **poses: PosesLevel
) -> Iterator[CalibratedCell]:
    """Yield cells of study.yaml with so many draws, method by method; poses : in place of its."""
    study = set_size(PAPERS["hexapod-42"].load_study(), seed, trials)
    study = replace(study, poses=poses or study.poses)
    for method in methods:
        yield from calibrate_cells(study, find_cells(study, instrument=instrument, method=method))


def sweep_noise(
    setup: Setup, iterations: int, threshold: float, seed: int, trials: int
) -> dict[str, Level]:
    """Repeat the ten steps at every level of noise; sizes are those after `iterations`."""
    levels, commanded = {}, setup.commanded
    for instrument, limits in list_noises().items():
        integrated, sizes = [], np.zeros((trials, 4))
        for i, cell in enumerate(calibrate_methods(seed, trials, instrument, PER_LEG)):
            T = forward_trials(setup.robot, cell.values, commanded.q[None], commanded.state).T
            measured = np.roll(cell.measured[0], 3, axis=2)  # a kind has its angles first
            residual = np.stack(
                [
                    subtract_poses(poses, to_coordinates(reached))
                    for poses, reached in zip(measured, T, strict=True)
                ]
            )
            integrated.append(integrate_errors(residual))
            if i + 1 == iterations:
                by_dimension = residual[..., :3] / MM, residual[..., 3:]
                error = (setup.truth.values - cell.values)[:, None] / MM
                rms = [np.sqrt(np.mean(x**2, axis=(1, 2))) for x in (*by_dimension, error)]
                sizes = np.column_stack([*rms, integrated[-1]])
        met = np.array(integrated) <= threshold
        needed = np.where(met.any(axis=0), 1.0 + met.argmax(axis=0), np.inf)
        levels[instrument] = Level(limits, sizes, needed)
    return levels


def compare_methods(setup: Setup, seed: int, trials: int) -> list[Row]:
    """Compare the paper's method, all legs weighted together, and MAP on the same stated noise."""
    cells = calibrate_methods(seed, trials, STATED, (PER_LEG[-1], TOGETHER, PRIOR))
    names = ("leg by leg, unweighted (the paper)", "all legs, weighted by the noise",
             "the same with tolerances as prior (MAP)")  # fmt: skip
    values = {"not calibrated": setup.robot.values[None]}
    values |= {name: cell.values for name, cell in zip(names, cells, strict=True)}
    unmeasured = {
        name: replace(setup, poses=draw_poses(name, SIZES.find("unmeasured"), seed))
        for name in SIZES.find("ranges")
    }
    rows = []
    for name, v in values.items():
        row: Row = {"method": name, "parameters": compute_rms((v - setup.truth.values) / MM)}
        for place, other in unmeasured.items():  # at equal readings
            poses = other.commanded
            predicted, true = (
                forward_trials(setup.robot, machine, poses.q[None], poses.state).T[..., :3, 3]
                for machine in (v, setup.truth.values[None])
            )
            squares = np.sum(((predicted - true) / MM) ** 2, axis=-1)
            row[place] = float(np.sqrt(np.mean(squares)))
        rows.append(row)
    return rows


def compare_poses(setup: Setup, threshold: float, seed: int, trials: int) -> list[Row]:
    """Calibrate from other numbers and ranges of poses."""
    sets = [("first of the paper", setup.poses[:n]) for n in SIZES.find("first")]
    sets.append((PAPERS_TEN, setup.poses))
    for name, counts in SIZES.find("drawn").items():
        sets += [(f"drawn, {name}", draw_poses(name, n, seed)) for n in counts]
    rows, methods = [], (PER_LEG[-1], TOGETHER)
    for name, poses in sets:
        other = replace(setup, poses=poses)
        exact = iterate(other, other.actual)
        level = PosesLevel(len(poses), coordinates=tuple(map(tuple, poses.tolist())))
        left = compute_rms((setup.truth.values - exact.values[-1]) / MM)
        row: Row = {
            "poses": name, "number": len(poses), "iterations": exact.count_needed(threshold),
            "left": left, "condition": float(exact.conditions.max()),
        }  # fmt: skip
        for cell in calibrate_methods(seed, trials, STATED, methods, poses=level):
            row[cell.levels["method"]] = compute_rms((cell.values - setup.truth.values) / MM)
        rows.append(row)
    return rows


def draw_poses(name: str, n: int, seed: int) -> FloatArray:
    """Return poses (n, 6) [m, rad] drawn uniformly in one of the ranges."""
    low, high = np.array(SIZES.find("ranges", name)) * np.array([MM] * 3 + [np.pi / 180.0] * 3)
    return make_random_stream(seed, n, DRAWN_POSES).uniform(low, high, (n, 6))


def recover_noise(setup: Setup) -> FloatArray:
    """Return the noise (n, 6) [m, rad] that Tables 5 and 6 together imply.

    residual = noise + D (true - corrected parameters), with D the change of the coordinates.
    """
    D = linearize_truth(setup).D
    rates = ANGLES.rates_inverse(setup.actual[:, 3:])
    by_coordinates = np.concatenate([D[:, 3:], rates @ D[:, :3]], axis=1)
    errors = np.zeros(len(setup.robot.parameters))
    errors[find_places(setup.robot)] = PRINTED.table("table_5", "after").values * 1e-3 * MM
    return PRINTED.table("table_6", "after").values / TO_PRINTED - by_coordinates @ errors


def linearize_truth(setup: Setup) -> LegForm:
    """Return the matrices at the machine with errors."""
    return LegForm.at(setup.truth, forward(setup.truth, setup.commanded.q, setup.commanded))


def write_rotation(order: str, angles: tuple[int, ...] = (0, 1, 2)) -> str:
    """Return the product R of an Euler order whose angles are those of GREEK at these places.

    Examples
    --------
    >>> write_rotation("ZYX")
    'Rz(alpha) Ry(beta) Rx(gamma)'
    >>> write_rotation("xyz")
    'Rz(gamma) Ry(beta) Rx(alpha)'
    """
    turns = [f"R{axis.lower()}({GREEK[place]})" for axis, place in zip(order, angles, strict=True)]
    return " ".join(reversed(turns) if order.islower() else turns)


def rank_euler_orders(setup: Setup, nominal: FloatArray, measured: FloatArray) -> list[Row]:
    """Return the rms differences [mm, rad] of all products, the best first: 12 sequences of axes,
    angles in any order.

    setup : machines of Tables 2 and 3. nominal, measured : (n, 6) poses of Table 4 [m, rad].
    """
    orders = []
    for order in (name for name in geometry.EULER_ORDERS if name.islower()):
        for angles in permutations(range(3)):
            wanted, printed = (
                geometry.make_pose(
                    geometry.euler_to_matrix(poses[:, 3:][:, angles], order), poses[:, :3]
                )
                for poses in (nominal, measured)
            )
            commanded = inverse(setup.robot, wanted)
            reached = forward(setup.truth, commanded.q, commanded).T
            change = geometry.pose_difference(reached, printed)
            orders.append(
                {"formula": write_rotation(order, angles),
                 "position": compute_rms(change[:, 3:] / MM),
                 "rotation": compute_rms(change[:, :3])}
            )  # fmt: skip
    return sorted(orders, key=lambda order: order["position"])


class Outliers(NamedTuple):
    """Labels of outliers in the order of their removal, and the fits without each pose before the
    first removal and after the last.
    """

    labels: list[str]
    first: list[Row]
    last: list[Row]


def find_rounding(printed: Printed) -> FloatArray:
    """Return the standard deviations (n, 6) [m, rad] of the rounding of printed poses."""
    return printed.unit * TO_SI / np.sqrt(12.0)


def search_outliers(setup: Setup, printed: Printed) -> Outliers:
    """Name measured poses of Table 4 that the others contradict, without the errors of Table 3.

    Removing a pose lowers the chi-square of a least-squares fit (all legs, weighted by the rounding
    of each printed number) by a chi-square of its 6 equations if it belongs to the same machine.
    The pose with the largest drop is removed while that drop is too large.
    """
    data = to_measurements(setup, printed.values / TO_PRINTED, find_rounding(printed))
    method, keep = lc.LeastSquares(), np.arange(len(printed.rows))
    labels, rounds = [], []
    while True:
        whole = lc.identify(setup.robot, data.take(keep), method).chi_square
        fits = []
        for pose in keep:
            test = lc.identify(setup.robot, data.take(keep[keep != pose]), method).residual_test
            fits.append(
                {"label": data.labels[pose], "chi_square": test.chi_square, "degrees": test.degrees,
                 "p_value": test.p_value, "drop": whole - test.chi_square}
            )  # fmt: skip
        rounds.append(fits)
        worst = max(range(len(keep)), key=lambda i: fits[i]["drop"])
        level = SIZES.find("outlier_level") / len(keep)
        largest = float(compute_chi_square_quantile(6, level))
        if fits[worst]["drop"] <= largest or fits[worst]["degrees"] < 6:
            return Outliers(labels, rounds[0], rounds[-1])
        labels.append(fits[worst]["label"])
        keep = np.delete(keep, worst)


def calibrate_from_print(setup: Setup, printed: Printed) -> list[Row]:
    """Return number of poses and rms parameter error [mm] of calibrations from Table 4 itself: as
    printed, with row A2 corrected, without it, unrounded, and with all legs weighted.
    """
    actual, odd = setup.actual, printed.labels.index(ODD_POSE)
    measured, unit = printed.values / TO_PRINTED, printed.unit[odd - 1] * TO_SI
    repaired = measured.copy()
    repaired[odd] = np.round(actual[odd] / unit) * unit
    keep = np.arange(len(measured)) != odd
    nine = replace(setup, poses=setup.poses[keep])
    made: list[tuple[str, int | None, FloatArray]] = [("not calibrated", None, setup.robot.values)]
    for name, other, poses in (
        ("Table 4 as printed", setup, measured),
        ("row A2 computed, rounded as row A1", setup, repaired),
        ("without row A2", nine, measured[keep]),
        ("computed poses in full", setup, actual),
    ):
        made.append((name, len(poses), iterate(other, poses).values[-1]))
    data = to_measurements(nine, measured[keep], find_rounding(printed)[keep])
    for name, method in (
        ("least squares", lc.LeastSquares()),
        ("tolerances as prior (MAP)", lc.MAP()),
    ):
        title = f"without row A2, all legs weighted by the rounding, {name}"
        made.append((title, len(nine.poses), lc.identify(setup.robot, data, method).robot.values))
    return [
        {"name": name, "number": n, "error": compute_rms(v - setup.truth.values) / MM}
        for name, n, v in made
    ]
