# SPDX-License-Identifier: Apache-2.0
"""The noise varied, the method varied, the poses varied: what the ten steps yield on average over
drawings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate import MAP, LeastSquares, identify_trials
from loopcal.measure import (
    Instrument,
    Pose,
    Sensor,
    Trials,
    Uniform,
    make_random_stream,
    simulate_trials,
)
from loopcal.mechanism import forward_trials
from loopcal.papers.hexapod_42.published import MM, Published
from loopcal.papers.hexapod_42.steps import (
    Study,
    actual_poses,
    form_name,
    integrated,
    iterate,
    measured_poses,
    transforms,
)
from loopcal.papers.per_leg import identify_per_leg
from loopcal.papers.printed import Cell, Table
from loopcal.typing import FloatArray

STATED = (1e-3, 1e-6)
"""Limits [mm, rad] of the stated noise. The paper gives none for angles: the same number in the
unit that its Table 6 prints,
0.001 mrad."""
PRESUMED = (1e-6, 1e-9)
"""Limits [mm, rad] of the noise with which Tables 5 and 6 agree, as the sweep shows."""
LEVELS = (
    STATED,
    (1e-4, 1e-7),
    (1e-5, 1e-8),
    (1e-6, 0.0),
    PRESUMED,
    (1e-6, 5e-9),
    (1e-6, 1e-6),
    (1e-7, 1e-10),
)
SIZES = (
    "pose residual rms [mm]",
    "pose residual rms [rad]",
    "parameter error rms [mm]",
    "max dQint [mm + rad]",
)
NARROW, WIDE = "as in the paper", "wide"
RANGES = {
    NARROW: ((-10.0, -10.0, 200.0, -3.0, -3.0, -3.0), (10.0, 10.0, 210.0, 3.0, 3.0, 3.0)),
    WIDE: ((-40.0, -40.0, 170.0, -14.0, -14.0, -14.0), (40.0, 40.0, 230.0, 14.0, 14.0, 14.0)),
}
"""Of drawn poses: low and high x, y, z [mm], alpha, beta, gamma [deg]."""
UNSEEN = 100
DRAWN_POSES = 3  # purpose of a random stream


@dataclass(frozen=True, eq=False)
class Level:
    """What came of one level of noise. limits : [mm, rad]. sizes : (t, 4), see SIZES. needed : (t,)
    iterations, inf: never.
    """

    limits: tuple[float, float]
    sizes: FloatArray
    needed: FloatArray

    @property
    def median(self) -> FloatArray:
        """(4,) medians of the sizes."""
        return np.median(self.sizes, axis=0)

    def holds(self, published: FloatArray) -> bool:
        """Whether published sizes (4,) lie between the smallest and the largest drawn ones."""
        return bool(
            np.all((published >= self.sizes.min(axis=0)) & (published <= self.sizes.max(axis=0)))
        )


def limits_si(limits: tuple[float, float]) -> FloatArray:
    """(6,) [m, rad] of [mm, rad]."""
    return np.array([limits[0] * MM] * 3 + [limits[1]] * 3)


def published_sizes(printed: Published) -> FloatArray:
    """(4,) sizes of Tables 5 and 6 as printed."""
    residual = printed.pose_errors_after.values * np.array([MM] * 3 + [1.0] * 3)
    rms = [np.sqrt(np.mean(part**2)) for part in (residual[:, :3] / MM, residual[:, 3:])]
    parameters = np.sqrt(np.mean((printed.parameter_errors_after.values * 1e-3) ** 2))
    return np.array([*rms, parameters, integrated(residual[None])[0]])


def noise_sweep(
    study: Study, iterations: int, threshold: float, seed: int, trials: int
) -> tuple[Level, ...]:
    """Repeat the ten steps at every level of noise; sizes are those after `iterations`."""
    found = []
    for limits in LEVELS:
        sizes, needed = [], []
        for trial in range(trials):
            run = iterate(
                study, measured_poses(study, limits_si(limits), seed, trial), limit=iterations + 1
            )
            left, error = run.pose_errors[iterations], run.parameter_errors(study.truth)[iterations]
            rms = (
                np.sqrt(np.mean(part**2)) for part in (left[:, :3] / MM, left[:, 3:], error / MM)
            )
            sizes.append([*rms, run.integrated[iterations]])
            needed.append(run.needed(threshold) or np.inf)
        found.append(Level(limits, np.array(sizes), np.array(needed)))
    return tuple(found)


def noise_table(levels: tuple[Level, ...], published: FloatArray, iterations: int) -> Table:
    """The sweep, with the published sizes in its first line."""
    rows: list[tuple[Cell, ...]] = [
        ("published, Tables 5 and 6", None, None, *map(float, published), None, None)
    ]
    for level in levels:
        met = int(np.isfinite(level.needed).sum())
        medians = map(float, level.median)
        rows.append(
            (
                "computed, median",
                *level.limits,
                *medians,
                f"{met} of {len(level.needed)}",
                level.holds(published),
            )
        )
    columns = (
        "",
        "noise +- [mm]",
        "noise +- [rad]",
        *SIZES,
        "max dQint below the threshold",
        "published within the drawn range",
    )
    note = f"After {iterations} iterations, leg by leg, as in the paper."
    return Table(
        "noise",
        "Noise varied",
        columns,
        tuple(rows),
        ("", ".0e", ".0e", ".2g", ".2g", ".2g", ".2g", "", ""),
        note,
    )


@dataclass(frozen=True)
class MethodResult:
    """Root mean squares [mm] over drawings: of the parameters, of positions on unseen poses in both
    ranges.
    """

    method: str
    parameters: float
    narrow: float
    wide: float


def methods(study: Study, seed: int, trials: int) -> tuple[MethodResult, ...]:
    """Leg by leg as in the paper, all legs weighted together, and with tolerances as priors, on the
    same stated noise.
    """
    made = simulated(study, seed, trials)
    values = {
        "not calibrated": study.robot.values[None],
        "leg by leg, unweighted (the paper)": _per_leg(study, made),
        "all legs, weighted by the noise": identify_trials(
            study.robot, made, LeastSquares()
        ).values,
        "the same with tolerances as prior (MAP)": identify_trials(study.robot, made, MAP()).values,
    }
    unseen = [_unseen(study, name, seed) for name in RANGES]
    return tuple(
        MethodResult(
            name,
            _rms((v - study.truth.values) / MM),
            *(_position_error(study, v, q) for q in unseen),
        )
        for name, v in values.items()
    )


def methods_table(found: tuple[MethodResult, ...], trials: int) -> Table:
    """The methods side by side."""
    rows = tuple((m.method, m.parameters, m.narrow, m.wide) for m in found)
    columns = (
        "method",
        "parameter error rms [mm]",
        f"position error rms, poses {NARROW} [mm]",
        f"the same, {WIDE} range [mm]",
    )
    note = (
        f"Stated noise, +-{STATED[0]:g} mm and +-{STATED[1]:g} rad, ten poses of the paper, "
        f"{trials} drawings of noise;"
        f" position errors on {UNSEEN} poses that were not measured, at equal readings."
    )
    return Table(
        "methods", "What the stated noise does", columns, rows, ("", ".2g", ".2g", ".2g"), note
    )


def poses_table(study: Study, threshold: float, seed: int, trials: int) -> Table:
    """Number and range of the poses varied."""
    sets = [("first of the paper", study.poses[:n]) for n in (7, 8, 9)] + [
        ("the paper's ten", study.poses)
    ]
    sets += [
        (f"drawn, {name}", drawn(name, n, seed))
        for name, counts in ((NARROW, (20, 40)), (WIDE, (10, 20, 40)))
        for n in counts
    ]
    rows = []
    for name, poses in sets:
        own = Study(study.robot, study.truth, poses, study.order)
        exact = iterate(own, actual_poses(own))
        made = simulated(own, seed, trials)
        together = identify_trials(study.robot, made, LeastSquares()).values
        errors = [
            _rms((values - study.truth.values) / MM) for values in (_per_leg(own, made), together)
        ]
        rows.append(
            (name, len(poses), exact.needed(threshold), float(exact.conditions.max()), *errors)
        )
    columns = ("poses", "number", "iterations without noise", "largest condition of a leg",
               "parameter error rms, leg by leg [mm]", "the same, all legs weighted [mm]")  # fmt: skip
    low, high = RANGES[WIDE]
    note = (
        f"Errors with the stated noise, {trials} drawings; before calibration "
        f"{_rms(_errors(study)):.2g} mm. Drawn poses,"
        f" range {NARROW}: +-10 mm, 3 deg; {WIDE}: +-{high[0]:g} mm, z {low[2]:g} to {high[2]:g} "
        f"mm, +-{high[3]:g} deg. A"
        " dash: a corrected machine could not reach the poses in some drawing."
    )
    return Table(
        "poses",
        "Number of poses varied",
        columns,
        tuple(rows),
        ("", "d", "d", ".0f", ".2g", ".2g"),
        note,
    )


def simulated(study: Study, seed: int, trials: int) -> Trials:
    """Measurements with the stated noise, a trial each; the same drawings as those of
    `measured_poses`.
    """
    limits = limits_si(STATED)
    sensor = Sensor(Pose(form_name(study.order)), Uniform(np.roll(limits, 3)))
    truth = np.repeat(study.truth.values[None], trials, axis=0)
    return simulate_trials(
        study.robot, truth, transforms(study.poses, study.order), Instrument((sensor,)), seed
    )


def drawn(name: str, n: int, seed: int) -> FloatArray:
    """(n, 6) poses [m, rad] drawn uniformly in one of RANGES."""
    low, high = (np.array(end) * np.array([MM] * 3 + [np.pi / 180.0] * 3) for end in RANGES[name])
    return make_random_stream(seed, n, DRAWN_POSES).uniform(low, high, (n, 6))


def _per_leg(study: Study, made: Trials) -> FloatArray:
    """(t, p) values found leg by leg; NaN where a corrected machine cannot reach the poses."""
    values = []
    for trial in range(len(made)):
        try:
            values.append(identify_per_leg(study.robot, made.trial(trial)).robot.values)
        except EstimationError:
            values.append(np.full(len(study.robot.parameters), np.nan))
    return np.array(values)


def _unseen(study: Study, name: str, seed: int) -> Study:
    """The study at poses that were not measured."""
    return Study(study.robot, study.truth, drawn(name, UNSEEN, seed), study.order)


def _position_error(study: Study, values: FloatArray, unseen: Study) -> float:
    """Root mean square [mm] of the distance between true and predicted positions at equal readings."""
    at = unseen.commanded
    poses = [
        forward_trials(study.robot, v, at.q[None], at.state).T[..., :3, 3]
        for v in (values, study.truth.values[None])
    ]
    return float(np.sqrt(np.mean(np.sum(((poses[0] - poses[1]) / MM) ** 2, axis=-1))))


def _errors(study: Study) -> FloatArray:
    """(p,) errors of the machine as designed [mm]."""
    return (study.robot.values - study.truth.values) / MM


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
