# SPDX-License-Identifier: Apache-2.0
"""Reported errors of calibrated machines against their true errors, for five instrument set-ups.

Each set-up is planned, machines are drawn from their spreads, measured at the planned poses and
calibrated. Reported and true errors refer to the same frame: after the best rigid fit of what the
instrument does not determine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.apply.accuracy import PoseUncertainty, pose_uncertainty
from loopcal.apply.error_budget import compute_error_budget
from loopcal.apply.validation import validate
from loopcal.diagnose.error_frames import fit_frames, fit_unfixed_frames
from loopcal.diagnose.fit_examination import estimate_calibration_gain
from loopcal.estimate.identification import (
    IdentifiedTrials,
    compute_trial_posterior,
    identify,
    identify_trials,
)
from loopcal.estimate.posterior import FrameKnowledge, Posterior, compute_posterior
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.distance import Distance
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import Trials, sample_truth, simulate_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.planning.constraints import PlanOptions
from loopcal.planning.pose_planning import Plan, plan
from loopcal.units import Dimension

Array = NDArray[np.float64]

MACHINES, SEED = 20, 23
"""Machines that are calibrated one by one, with everything that is reported of them."""

STACKED, COVERED = 200, 200
"""Machines that are calibrated at once for true errors and coverage, and poses of each.

The error of one machine scatters by a quarter about that of all machines, and its errors at all
poses follow from some 30 parameters. The median error of 20 machines is therefore known to 7 %
only, and their coverage to 2 %; of 200 machines to 2 % and 0.7 %.
"""

SIGMA = {Dimension.LENGTH: 5e-6, Dimension.ANGLE: 25e-6}
"""Noise, one standard deviation [m], [rad]."""

BALLS = np.array([[0.07, -0.03, 0.02], [-0.06, 0.04, 0.03]])
"""Places of two balls on the platform [m]."""

TARGETS = np.array([[0.06, 0.0, 0.01], [-0.03, 0.05, 0.01], [-0.03, -0.05, 0.02]])
ANCHORS = ((0.35, 0.05, 0.1), (-0.2, 0.3, 0.05), (-0.1, -0.25, 0.45))
"""Places of three reflectors on the platform, and of the fixed ends of ball bars [m]."""


FIGURES = {
    "planned": "expected by the plan, over the workspace",
    "expected": "expected by the calibration, at the measured poses",
    "total": "first lines of the calibration, over the workspace",
    "stated": "uncertainty of poses, over the workspace",
}
"""Reported position errors, and what they are."""


@dataclass(frozen=True)
class Setup:
    """A robot, the kinds of measurement of its instrument, and the number of measured poses."""

    name: str
    robot: str
    kinds: tuple[Kind, ...]
    poses: int

    @cached_property
    def instrument(self) -> Instrument:
        """Return the instrument with its noise."""
        sigmas = [[SIGMA[column.dimension] for column in k.noise_columns] for k in self.kinds]
        pairs = zip(self.kinds, sigmas, strict=True)
        return Instrument(tuple(Sensor(kind, Gaussian(np.array(s))) for kind, s in pairs))


def list_setups() -> tuple[Setup, ...]:
    """Return the five set-ups."""
    tracked = Position(targets=("a", "b", "c"), places=TARGETS, unknown=("frame",), frame="tracker")
    unknown = Position(
        targets=("a", "b", "c"), places=TARGETS, unknown=("frame", "targets"), frame="tracker"
    )
    bars = tuple(
        Distance(
            anchor=np.array(place),
            anchor_name=f"ball{i}",
            targets=("a", "b"),
            places=BALLS,
            unknown=("anchor", "targets"),
        )
        for i, place in enumerate(ANCHORS, 1)
    )
    probe = Component(("z",))
    return (
        Setup("full pose in a known frame", "hexapod-42", (Pose(),), 40),
        Setup("tracker with an unknown frame", "hexapod-42", (tracked,), 40),
        Setup("three unknown targets, unknown tracker frame", "hexapod-42", (unknown,), 40),
        Setup("ball bars from three unknown points to two", "hexapod-42", bars, 60),
        Setup("probed heights", "hexapod-42", (probe,), 80),
    )


@dataclass(frozen=True, eq=False)
class Study:
    """A planned set-up: machines that are measured at its poses, and poses to compare.

    `noise` is the true noise over the stated one; `spread` multiplies stated standard deviations. 1
    is correct, and other numbers are for tests that the comparison can fail.
    """

    setup: Setup
    plan: Plan
    test: Array
    noise: float = 1.0
    spread: float = 1.0

    @property
    def robot(self) -> Mechanism:
        """Return the nominal robot."""
        return self.plan.robot

    @cached_property
    def readings(self) -> Array:
        """Return the readings (n, a) of the compared poses."""
        return inverse(self.robot, self.test).q

    def measure(self, machines: int, held_out: bool = False, noise: float = 1.0) -> Trials:
        """Simulate machines at the planned poses, those for the fit or those held out."""
        poses = self.plan.poses
        chosen = poses.coordinates[poses.held_out == held_out]
        truth = sample_truth(self.robot, machines, SEED)
        stated = self.setup.instrument
        seed = SEED + held_out
        trials = simulate_trials(self.robot, truth, chosen, stated, seed)
        if noise == 1.0:
            return trials
        scaled = tuple(
            replace(sensor, noise=Gaussian(noise * sensor.noise.sigma)) for sensor in stated.sensors
        )
        other = simulate_trials(self.robot, truth, chosen, Instrument(scaled), seed)
        return replace(trials, measured=other.measured)


def prepare_study(setup: Setup) -> Study:
    """Return a set-up with its plan."""
    robot = load_robot(setup.robot)
    options = PlanOptions(n_poses=setup.poses, n_candidates=300, seed=SEED)
    planned = plan(robot, setup.instrument, options=options)
    test = sample_workspace(robot, COVERED, SEED).coordinates
    return Study(setup, planned, test)


@dataclass(frozen=True, eq=False)
class TrueErrors:
    """Errors of identified machines at the same readings: (n, 6) of compared poses, after the best
    rigid fit over the measured poses, `at_measured` (m, 6), and after that over the compared poses.
    """

    errors: Array
    at_measured: Array
    over_workspace: Array


def compute_true_errors(study: Study, posterior: Posterior, truth: Array) -> TrueErrors:
    """Return the errors of an identified machine in the frame of its report."""
    robot, true = posterior.robot, study.robot.with_values(truth)
    assert posterior.frames is not None
    frames = fit_unfixed_frames(posterior)
    T, raw = _differences(robot, true, study.readings)
    _, reference = _differences(robot, true, posterior.frames.readings)
    workspace = fit_frames(robot, T, frames.motions)
    return TrueErrors(
        frames.remove(raw[None], T, reference[None])[0],
        frames.remove(reference[None], frames.poses, reference[None])[0],
        workspace.remove(raw[None], T, raw[None])[0],
    )


def _differences(robot: Mechanism, true: Mechanism, readings: Array) -> tuple[Array, Array]:
    """Return poses (n, 4, 4) of a robot and their differences (n, 6) from the true ones."""
    T, truth = (forward(machine, readings).T for machine in (robot, true))
    return T, geometry.pose_difference(T, truth)


@dataclass(frozen=True)
class Report:
    """Position errors that are reported of one machine [m], root mean square.

    planned : expected by the plan over the workspace. expected : by the calibration at the measured
    poses. total : from all sources over the workspace; NaN where residuals contradict the noise.
    stated : uncertainty of the compared poses. validated, floor, exact : errors of held-out
    values with their noise, the noise floor, and the errors without noise [sigma].
    """

    planned: float
    expected: float
    total: float
    stated: float
    validated: float
    floor: float
    exact: float

    @property
    def exact_with_noise(self) -> float:
        """Return the error of held-out values that the true error and the noise give."""
        return float(np.hypot(self.exact, self.floor))


def report_machine(
    study: Study, data: Measurements, held_out: Measurements, exact: Measurements
) -> Report:
    """Calibrate a machine and return what is reported.

    `exact` are the held-out measurements without noise.
    """
    fit = identify(study.robot, data)
    uncertainty, budget = state_uncertainty(study, fit.posterior), compute_error_budget(fit, data)
    noisy, without_noise = (validate(fit, rows).kinds[-1] for rows in (held_out, exact))
    return Report(
        planned=study.spread * study.plan.errors.after.position_rms,
        expected=study.spread * estimate_calibration_gain(fit, data).position_after,
        total=np.nan if budget is None else study.spread * budget.position.rms,
        stated=float(np.sqrt((uncertainty.position**2).mean())),
        validated=noisy.after,
        floor=study.spread * noisy.noise_floor,
        exact=without_noise.after,
    )


def state_uncertainty(study: Study, posterior: Posterior) -> PoseUncertainty:
    """Return the stated uncertainty of the compared poses."""
    result = pose_uncertainty(posterior, forward(posterior.robot, study.readings))
    return replace(result, covariance=study.spread**2 * result.covariance)


def _rms(errors: Array) -> float:
    """Return the root mean square of position errors of twists (n, 6)."""
    return float(np.sqrt((errors[:, 3:] ** 2).sum(axis=1).mean()))


def report_machines(study: Study, machines: int = MACHINES) -> list[Report]:
    """Return the reports of machines of a set-up."""
    trials = study.measure(machines, noise=study.noise)
    held_out = study.measure(machines, True, noise=study.noise)
    exact = study.measure(machines, True, noise=1e-9)
    return [
        report_machine(study, trials.trial(i), held_out.trial(i), exact.trial(i))
        for i in range(machines)
    ]


@dataclass(frozen=True)
class TrueFigures:
    """True errors of many machines, and how often the stated uncertainties cover them.

    machines : number of fits that converged.
    rms, median : over these machines, of their position errors [m], each a root mean square over
    poses: `planned` over the workspace after the best fit there, `expected` at the measured poses,
    `total` and `stated` over the workspace after the best fit at the measured poses.
    uncertainty : what is stated of the latter [m], median.
    components, positions, orientations : shares of errors below their expanded uncertainty.
    """

    machines: int
    rms: Mapping[str, float]
    median: Mapping[str, float]
    uncertainty: float
    components: float
    positions: float
    orientations: float


def measure_true_figures(study: Study, machines: int = STACKED) -> TrueFigures:
    """Return the true errors of machines, and how often their stated uncertainties cover them."""
    trials = study.measure(machines, noise=study.noise)
    fits = identify_trials(study.robot, trials)
    frames = compute_trial_posterior(fits, trials, int(np.argmax(fits.converged))).frames
    sizes, stated, covered = [], [], []
    for i in np.flatnonzero(fits.converged):
        posterior = _posterior_of(fits, int(i), frames)
        true = compute_true_errors(study, posterior, trials.truth[i])
        uncertainty = state_uncertainty(study, posterior)
        errors = (true.over_workspace, true.at_measured, true.errors, true.errors)
        sizes.append([_rms(twists) for twists in errors])
        stated.append(float(np.sqrt((uncertainty.position**2).mean())))
        covered.append(_find_covered(true.errors, uncertainty))
    rms, median = np.sqrt(np.mean(np.square(sizes), axis=0)), np.median(sizes, axis=0)
    return TrueFigures(
        len(covered),
        dict(zip(FIGURES, rms.tolist(), strict=True)),
        dict(zip(FIGURES, median.tolist(), strict=True)),
        float(np.median(stated)),
        *np.mean(covered, axis=0).tolist(),
    )


def _find_covered(errors: Array, uncertainty: PoseUncertainty) -> list[float]:
    """Return the shares of components, positions and orientations below their U."""
    position, orientation = (np.linalg.norm(e, axis=1) for e in (errors[:, 3:], errors[:, :3]))
    return [
        float((np.abs(errors) <= uncertainty.expanded).mean()),
        float((position <= uncertainty.expanded_position).mean()),
        float((orientation <= uncertainty.expanded_orientation).mean()),
    ]


def _posterior_of(fits: IdentifiedTrials, trial: int, frames: FrameKnowledge | None) -> Posterior:
    """Return the posterior of a machine; all machines have the instrument's frames in common."""
    free, chosen = fits.free_parameters, np.array([trial])
    identified = free.robot.with_values(fits.values[trial])
    return compute_posterior(
        identified,
        free.places,
        free.tolerance,
        fits.decomposition.take(chosen),
        fits.penalty[chosen],
        frames=frames,
    )


def report_medians(reports: list[Report]) -> dict[str, float]:
    """Return every reported figure, median over the machines that report it."""
    medians = {}
    for name in (*FIGURES, "validated", "exact_with_noise"):
        values = np.array([getattr(report, name) for report in reports])
        known = values[np.isfinite(values)]
        medians[name] = float(np.median(known)) if len(known) else float("nan")
    return medians


QUICK = {"MACHINES": 2, "STACKED": 20}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    for setup, _, *shares in tables["coverage"]["rows"]:
        assert min(shares) > 80.0, setup


def collect() -> dict:
    """Collect every set-up at full size."""
    figures, held_out, coverage = [], [], []
    for setup in list_setups():
        study = prepare_study(setup)
        true, reported = (
            measure_true_figures(study, STACKED),
            report_medians(report_machines(study, MACHINES)),
        )
        for name, words in FIGURES.items():
            numbers = (reported[name], true.rms[name], true.median[name])
            figures.append([setup.name, words, *(1e6 * x for x in numbers)])
        held_out.append([setup.name, reported["validated"], reported["exact_with_noise"]])
        shares = (true.components, true.positions, true.orientations)
        coverage.append([setup.name, true.machines, *(100.0 * x for x in shares)])
    return {
        "seed": SEED,
        "noise": {"length [um]": 5.0, "angle [urad]": 25.0},
        "machines": {"reported": MACHINES, "true": STACKED},
        "tables": {
            "figures": {
                "columns": [
                    "set-up",
                    "position error",
                    "reported [um]",
                    "true, rms of machines [um]",
                    "true, median of machines [um]",
                ],
                "formats": ["", "", ".2f", ".2f", ".2f"],
                "rows": figures,
            },
            "held_out": {
                "columns": [
                    "set-up",
                    "error of held-out values [sigma]",
                    "true error and noise floor [sigma]",
                ],
                "formats": ["", ".3f", ".3f"],
                "rows": held_out,
            },
            "coverage": {
                "columns": [
                    "set-up",
                    "machines",
                    "components within U [%]",
                    "positions within U [%]",
                    "orientations within U [%]",
                ],
                "formats": ["", "d", ".1f", ".1f", ".1f"],
                "rows": coverage,
            },
        },
    }
