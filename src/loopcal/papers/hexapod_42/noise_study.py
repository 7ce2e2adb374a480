# SPDX-License-Identifier: Apache-2.0
"""Studies of noise, method and poses: the results of the ten steps over many draws of noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal.estimate.published_steps import LegForm
from loopcal.measure.instrument import Instrument, Sensor, Uniform, make_random_stream
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import Trials, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.papers.hexapod_42.published import MM, TO_PRINTED, Published, to_values
from loopcal.papers.hexapod_42.steps import (
    Study,
    compute_actual_poses,
    integrate_errors,
    iterate,
    name_orientation,
    subtract_poses,
    to_coordinates,
    to_transforms,
    to_twists,
)
from loopcal.papers.paper_studies import load_paper_study
from loopcal.papers.printed import Cell
from loopcal.studies.simulation.block import CalibratedCell, calibrate_cells, find_cells, set_size
from loopcal.studies.specification.levels import PosesLevel
from loopcal.studies.specification.study import Study as PaperStudy
from loopcal.typing import BoolArray, FloatArray

STATED = (1e-3, 1e-6)
"""Limits [mm, rad] of the stated noise. The paper gives none for angles: the same number in the
unit that its Table 6 prints, 0.001 mrad.
"""
PRESUMED = (1e-6, 1e-9)
"""Limits [mm, rad] of the noise with which Tables 5 and 6 agree, as the sweep shows."""
LEVELS = (
    STATED, (1e-4, 1e-7), (1e-5, 1e-8), (1e-6, 1e-12), PRESUMED, (1e-6, 5e-9), (1e-6, 1e-6),
    (1e-7, 1e-10),
)  # fmt: skip
"""Limits [mm, rad] of the instruments of study.yaml."""
PER_LEG = ("per leg, 1 step", "per leg, 2 steps", "per leg, 3 steps")
TOGETHER, PRIOR = "least squares", "MAP"
"""Methods of study.yaml."""
NARROW, WIDE = "as in the paper", "wide"
RANGES = {
    NARROW: ((-10.0, -10.0, 200.0, -3.0, -3.0, -3.0), (10.0, 10.0, 210.0, 3.0, 3.0, 3.0)),
    WIDE: ((-40.0, -40.0, 170.0, -14.0, -14.0, -14.0), (40.0, 40.0, 230.0, 14.0, 14.0, 14.0)),
}
"""Of drawn poses: low and high x, y, z [mm], alpha, beta, gamma [deg]."""
PAPERS_TEN = "the paper's ten"
UNMEASURED = 100
"""Poses that are not measured, on which methods are compared."""
DRAWN_POSES = 3  # purpose of a random stream


@dataclass(frozen=True, eq=False)
class Level:
    """Results with one level of noise.

    Attributes
    ----------
    limits : [mm, rad]. needed : (t,) iterations, infinite for never.
    sizes : (t, 4) after calibration: pose residual rms [mm] and [rad], parameter error rms [mm],
        max dQint [mm + rad].
    """

    limits: tuple[float, float]
    sizes: FloatArray
    needed: FloatArray

    @property
    def median(self) -> FloatArray:
        """(4,) medians of the sizes."""
        return np.median(self.sizes, axis=0)

    def contains(self, sizes: FloatArray) -> BoolArray:
        """Return which sizes (4,) lie between the smallest and the largest drawn ones."""
        low, high = self.sizes.min(axis=0), self.sizes.max(axis=0)
        return (sizes >= low) & (sizes <= high)


@dataclass(frozen=True)
class MethodResult:
    """Root mean squares [mm] over draws: parameters, and positions in the narrow and wide range."""

    method: str
    parameters: float
    narrow: float
    wide: float


def to_si(limits: tuple[float, float]) -> FloatArray:
    """Return limits (6,) [m, rad] of limits [mm, rad]."""
    return np.array([limits[0] * MM] * 3 + [limits[1]] * 3)


def compute_published_sizes(printed: Published) -> FloatArray:
    """Return the four sizes of Tables 5 and 6 as printed."""
    residual = printed.pose_errors_after.values * np.array([MM] * 3 + [1.0] * 3)
    rms = [_compute_rms(part) for part in (residual[:, :3] / MM, residual[:, 3:])]
    parameters = _compute_rms(printed.parameter_errors_after.values * 1e-3)
    return np.array([*rms, parameters, integrate_errors(residual[None])[0]])


def sweep_noise(
    study: Study, iterations: int, threshold: float, seed: int, trials: int
) -> tuple[Level, ...]:
    """Repeat the ten steps at every level of noise; sizes are those after `iterations`."""
    levels, whole = [], set_size(load_paper_study(__file__), seed, trials)
    for limits in LEVELS:
        integrated, sizes = [], np.zeros((trials, 4))
        for i, cell in enumerate(calibrate_methods(whole, limits, PER_LEG)):
            residual = compute_residuals(study, cell)
            integrated.append([integrate_errors(of_trial[None])[0] for of_trial in residual])
            if i + 1 == iterations:
                by_dimension = residual[..., :3] / MM, residual[..., 3:]
                error = (study.truth.values - cell.values)[:, None] / MM
                rms = [np.sqrt(np.mean(x**2, axis=(1, 2))) for x in (*by_dimension, error)]
                sizes = np.column_stack([*rms, integrated[-1]])
        met = np.array(integrated) <= threshold
        needed = np.where(met.any(axis=0), 1.0 + met.argmax(axis=0), np.inf)
        levels.append(Level(limits, sizes, needed))
    return tuple(levels)


def calibrate_methods(
    whole: PaperStudy, limits: tuple[float, float], methods: Sequence[str]
) -> Iterator[CalibratedCell]:
    """Yield the cells of a study with one level of noise, method by method."""
    instrument = f"{limits[0]:g} mm and {limits[1]:g} rad"
    for method in methods:
        yield from calibrate_cells(whole, find_cells(whole, instrument=instrument, method=method))


def compute_residuals(study: Study, cell: CalibratedCell) -> FloatArray:
    """Return measured minus corrected poses (t, n, 6) [m, rad]; NaN where there is no estimate."""
    commanded = study.commanded
    T = forward_trials(study.robot, cell.values, commanded.q[None], commanded.state).T
    measured = np.roll(cell.measured[0], 3, axis=2)  # a kind has its angles first
    return np.stack(
        [
            subtract_poses(poses, to_coordinates(reached, study.order))
            for poses, reached in zip(measured, T, strict=True)
        ]
    )


def list_levels(levels: tuple[Level, ...], published: FloatArray) -> list[tuple[Cell, ...]]:
    """Return table rows of the sweep, with the published sizes in the first one."""
    rows: list[tuple[Cell, ...]] = [
        ("published, Tables 5 and 6", None, None, *map(float, published), None, None)
    ]
    for level in levels:
        met = f"{int(np.isfinite(level.needed).sum())} of {len(level.needed)}"
        sizes = (*level.limits, *map(float, level.median))
        rows.append(("computed, median", *sizes, met, bool(level.contains(published).all())))
    return rows


def find_level(levels: tuple[Level, ...], limits: tuple[float, float]) -> Level:
    """Return the results with one of LEVELS."""
    return levels[LEVELS.index(limits)]


def compare_methods(study: Study, seed: int, trials: int) -> tuple[MethodResult, ...]:
    """Compare the paper's method, all legs weighted together, and MAP on the same stated noise."""
    whole = set_size(load_paper_study(__file__), seed, trials)
    alone, together, prior = (
        cell.values for cell in calibrate_methods(whole, STATED, (PER_LEG[-1], TOGETHER, PRIOR))
    )
    values = {
        "not calibrated": study.robot.values[None],
        "leg by leg, unweighted (the paper)": alone,
        "all legs, weighted by the noise": together,
        "the same with tolerances as prior (MAP)": prior,
    }
    unmeasured = [
        Study(study.robot, study.truth, draw_poses(name, UNMEASURED, seed), study.order)
        for name in RANGES
    ]
    return tuple(
        MethodResult(
            name,
            _compute_rms((v - study.truth.values) / MM),
            *(_compute_position_error(study, v, other) for other in unmeasured),
        )
        for name, v in values.items()
    )


def compare_poses(study: Study, threshold: float, seed: int, trials: int) -> list[tuple[Cell, ...]]:
    """Return table rows for other numbers and ranges of poses."""
    sets = [("first of the paper", study.poses[:n]) for n in (7, 8, 9)]
    sets.append((PAPERS_TEN, study.poses))
    for name, counts in ((NARROW, (20, 40)), (WIDE, (10, 20, 40))):
        sets += [(f"drawn, {name}", draw_poses(name, n, seed)) for n in counts]
    rows: list[tuple[Cell, ...]] = []
    whole, methods = set_size(load_paper_study(__file__), seed, trials), (PER_LEG[-1], TOGETHER)
    for name, poses in sets:
        other = Study(study.robot, study.truth, poses, study.order)
        exact = iterate(other, compute_actual_poses(other))
        level = PosesLevel(len(poses), coordinates=tuple(map(tuple, poses.tolist())))
        cells = calibrate_methods(replace(whole, poses={name: level}), STATED, methods)
        errors = [_compute_rms((cell.values - study.truth.values) / MM) for cell in cells]
        needed, condition = exact.count_needed(threshold), float(exact.conditions.max())
        left = _compute_rms(exact.compute_parameter_errors(study.truth)[-1] / MM)
        rows.append((name, len(poses), needed, left, condition, *errors))
    return rows


def recover_noise(study: Study, printed: Published) -> FloatArray:
    """Return the noise (n, 6) [m, rad] that Tables 5 and 6 together imply.

    residual = noise + D (true - corrected parameters), with D the change of the coordinates.
    """
    actual = compute_actual_poses(study)
    D = LegForm.at(study.truth, study.solve_truth()).D
    rates = name_orientation(study.order).rates_inverse(actual[:, 3:])
    by_coordinates = np.concatenate([D[:, 3:], rates @ D[:, :3]], axis=1)
    errors = to_values(study.robot, printed.parameter_errors_after.values * 1e-3 * MM)
    return printed.pose_errors_after.values / TO_PRINTED - by_coordinates @ errors


def compute_explained_share(study: Study, printed: Published) -> FloatArray:
    """Return the share (6,) of each leg's residuals of Table 6 that parameters could explain."""
    residuals = printed.pose_errors_after.values / TO_PRINTED
    legs = LegForm.at(study.truth, study.solve_truth())
    return legs.explain(to_twists(residuals, compute_actual_poses(study), study.order))


def compute_initial_error(study: Study) -> float:
    """Return the rms parameter error [mm] of the machine as designed."""
    return _compute_rms((study.robot.values - study.truth.values) / MM)


def simulate_stated_noise(study: Study, seed: int, trials: int) -> Trials:
    """Return measurements with the stated noise; the draws are those of `draw_measured_poses`."""
    noise = Uniform(np.roll(to_si(STATED), 3))
    instrument = Instrument((Sensor(Pose(f"euler-{study.order}"), noise),))
    truth = np.repeat(study.truth.values[None], trials, axis=0)
    poses = to_transforms(study.poses, study.order)
    return simulate_trials(study.robot, truth, poses, instrument, seed)


def draw_poses(name: str, n: int, seed: int) -> FloatArray:
    """Return poses (n, 6) [m, rad] drawn uniformly in one of RANGES."""
    low, high = (np.array(end) * np.array([MM] * 3 + [np.pi / 180.0] * 3) for end in RANGES[name])
    return make_random_stream(seed, n, DRAWN_POSES).uniform(low, high, (n, 6))


def _compute_position_error(study: Study, values: FloatArray, other: Study) -> float:
    """Return the rms distance [mm] of true and predicted positions at equal readings."""
    commanded = other.commanded
    predicted, true = (
        forward_trials(study.robot, v, commanded.q[None], commanded.state).T[..., :3, 3]
        for v in (values, study.truth.values[None])
    )
    return float(np.sqrt(np.mean(np.sum(((predicted - true) / MM) ** 2, axis=-1))))


def _compute_rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
