# SPDX-License-Identifier: Apache-2.0
"""The nine steps of the paper (docs/papers/tsvd-2016.md), for t machines or t settings of lambda
and k at once; one machine with the printed noise, and many drawn machines.

Raw numbers as in the paper: millimeters and radians, every equation and every parameter of weight
one, and the filter acts on the step (`loopcal.studies.simulation.published_steps`). As in the paper
the true machine decides which lambda and k are best: the bottom of the curve, the smallest product
of the errors in position and angle.

Dimensions, poses, true errors and output range are ours: the paper's Tables 1 to 4 are not in our
text. The noise is the paper's (Appendix 1). Poses are x, y, z, phi, theta, psi with tilt and
torsion, as in the paper.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

import loopcal as lc
from loopcal import geometry
from loopcal.diagnose.identifiable_parameters import Identifiability
from loopcal.errors import DataError
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.penalties import Method
from loopcal.measure.instrument import make_random_stream
from loopcal.measure.kinds.poses import SMALL_TILT, Component
from loopcal.measure.simulation import Trials, simulate_trials
from loopcal.mechanism.kinematics import compute_readings, forward_trials, inverse_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, inverse
from loopcal.mechanism.workspace import list_tilt_rings
from loopcal.numerics.decomposition import Decomposition, are_nonzero
from loopcal.papers.paper import StudyCase
from loopcal.papers.published import PaperFile
from loopcal.studies.simulation.machines import (
    change_tolerances,
    compute_poses,
    describe_poses,
    draw_machines,
)
from loopcal.studies.simulation.published_steps import (
    AHEAD,
    LIMIT,
    RawProblem,
    RawSteps,
    StepRule,
    list_raw_units,
    make_raw_problem,
    penalize_ridge,
    penalize_truncated,
    take_steps,
)
from loopcal.studies.specification.levels import ErrorsLevel
from loopcal.studies.specification.study import describe_cell
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

MM = 1e-3
PRINTED, SIZES = PaperFile(__file__, "published.yaml"), PaperFile(__file__, "sizes.yaml")
ROBOTS = {"RU-PUS-PRS": "ru-pus-prs", "3-PRS": "3-prs"}
"""Names in the paper, and of our robot files."""
COLUMNS = ("x", "y", "z", "phi", "theta", "psi")
MEASURES = (
    "position [mm]",
    "phi and theta [deg]",
    "direction of the normal [deg]",
    "parameters [tolerances]",
    "parameters farther from the truth than nominal [share]",
)
"""Root mean squares over the output range and over the parameters, and a share."""
ERRORS, RESAMPLING = 3, 4  # purposes of random streams

SHORT, FINE = SIZES.find("short"), 0.05
"""Iterations of the paper, and leaps of iterations that are drawn, see `StepRule.ahead`."""
LS, RANKED, TSVD = "LS", "LS with rank detection", "TSVD"
RE, EARLY = "RE, all steps", f"RE, {SHORT} steps"
PICTURED = (LS, EARLY, RE, TSVD)
WHITENED, CROSS, PRIOR = "whitened LS", "whitened ridge, GCV", "MAP"
LIBRARY: Mapping[str, Method] = {
    WHITENED: lc.LeastSquares(), CROSS: lc.Ridge(lc.GCV()), PRIOR: lc.MAP(),
}  # fmt: skip
"""Methods of the library: rows whitened, columns scaled by tolerance."""

BEFORE, TRUE = "before calibration", "true parameters known"
RAW_LS, RAW_EARLY, RAW_RE, RAW_TSVD, RAW_FIVE, EARLY_FIVE, RE_FIVE, TSVD_FIVE = (
    "raw LS", f"raw {EARLY}, at its best", f"raw {RE}, at its best", "raw TSVD at its best",
    f"raw {RANKED}, 5-DOF", f"raw {EARLY}, at its best, 5-DOF", f"raw {RE}, at its best, 5-DOF",
    "raw TSVD at its best, 5-DOF",
)  # fmt: skip
RAW = {
    RAW_LS: (0, LS), RAW_EARLY: (0, EARLY), RAW_RE: (0, RE), RAW_TSVD: (0, TSVD),
    RAW_FIVE: (1, RANKED), EARLY_FIVE: (1, EARLY), RE_FIVE: (1, RE), TSVD_FIVE: (1, TSVD),
}  # fmt: skip
"""Methods of the paper: 0 with 6-DOF and 1 with 5-DOF measurement, and the algorithm."""
HINDSIGHT = "whitened ridge, best lambda in hindsight"
NARROW, WIDE = "MAP, tolerances a third of the spread", "MAP, tolerances three times the spread"
WHITENED_FIVE, PRIOR_FIVE = "whitened LS, 5-DOF", "MAP, 5-DOF"
METHODS = (
    BEFORE, *RAW, WHITENED, CROSS, PRIOR, NARROW, WIDE, HINDSIGHT, WHITENED_FIVE, PRIOR_FIVE, TRUE,
)  # fmt: skip


def list_limits() -> FloatArray:
    """Return the limits (6,) of the noise [m, rad]: the largest printed numbers of Appendix 1,
    rounded up to one digit of a millimeter and of a degree.
    """
    largest = np.abs(PRINTED.table("appendix_1").values).max(axis=0)
    sizes = largest[:3].max(), float(np.rad2deg(largest[3:].max()))
    digits = [10.0 ** np.floor(np.log10(size)) for size in sizes]
    length, angle = (
        np.ceil(size / digit) * digit for size, digit in zip(sizes, digits, strict=True)
    )
    return np.array([length * MM] * 3 + [np.deg2rad(angle)] * 3)


def list_lambdas(key: str = "exponents") -> FloatArray:
    """Return the lambdas of RE on drawn machines, see `widen`."""
    return np.logspace(*SIZES.find(key))


@dataclass(frozen=True, eq=False)
class Design:
    """A manipulator as designed, and what is measured.

    name : in tables. poses : (n, c) measured controlled coordinates [m, rad].
    output_range : (m, c) those at which errors are computed. errors : of true machines; None for
    those of sizes.yaml.
    """

    name: str
    robot: Mechanism
    poses: FloatArray
    output_range: FloatArray
    errors: ErrorsLevel | None = None

    @property
    def printed(self) -> str:
        """Its name in the paper; empty of another robot."""
        return self.name if self.errors is None else ""

    @property
    def file(self) -> str:
        """Its name in names of files."""
        return re.sub(r"\W+", "_", self.name.lower())

    @cached_property
    def free(self) -> FreeParameters:
        """The parameters that are identified."""
        return select_free_parameters(self.robot)

    @property
    def columns(self) -> tuple[str, ...]:
        """Coordinates that are measured: all, or x, y and z of a platform that cannot rotate."""
        return COLUMNS if self.robot.can_rotate else COLUMNS[:3]

    @property
    def parts(self) -> tuple[int, ...]:
        """Which of position and angle, the first MEASURES, the platform has."""
        freedoms = set(self.robot.program.freedoms)
        return tuple(i for i, of in enumerate(({3, 4, 5}, {0, 1})) if freedoms & of)

    def draw_true_values(self, trials: int, seed: int) -> FloatArray:
        """Return values (t, p) of true machines [SI]; machine i is the same for any number."""
        if self.errors is None:
            return draw_true_values(self.robot, trials, seed)
        return draw_machines(change_tolerances(self.robot, self.errors), self.errors, trials, seed)


def load_design(name: str) -> Design:
    """Return a manipulator of the paper: the shipped robot file of step 1, with our poses."""
    robot = lc.load_robot(ROBOTS[name])
    poses = list_tilt_rings(robot, len(read_noise()))
    return Design(name, robot, poses, list_output_range(robot))


def adapt_design(case: StudyCase) -> Design:
    """Return another robot with the poses and errors of its study file; DataError where it has no
    errors to identify.
    """
    study, robot = case.load_study(), case.robot
    assert robot is not None
    content = describe_cell(study, study.cells[0])
    poses, (errors,) = compute_poses(describe_poses(content)), study.errors.values()
    measured, held_out = np.array(poses.measured), np.array(poses.held_out)
    design = Design(robot.name, robot, measured, held_out, errors)
    if len(design.free) < 2 or not design.parts:
        raise DataError(
            f"{robot.name} has {len(design.free)} free parameters; the study needs 2 or more, and "
            "a platform that moves or tilts"
        )
    return design


def list_designs(case: StudyCase | None) -> tuple[Design, ...]:
    """Return the manipulators of the paper, or the robot that replaces them."""
    if case is None or case.robot is None:
        return tuple(map(load_design, ROBOTS))
    return (adapt_design(case),)


@dataclass(frozen=True, eq=False)
class Study:
    """t machines of one structure, measured."""

    design: Design
    trials: Trials  # true machines and their measurements
    freedoms: int = len(COLUMNS)  # measured coordinates of a pose

    @property
    def name(self) -> str:
        """Name of the structure."""
        return self.design.name

    @property
    def robot(self) -> Mechanism:
        """As designed."""
        return self.design.robot

    @property
    def label(self) -> str:
        """Structure and measurement."""
        return f"{self.name}, {self.freedoms}-DOF"

    @property
    def file(self) -> str:
        """The same in names of files."""
        return f"{self.design.file}_{self.freedoms}"

    @property
    def both(self) -> tuple[Study, ...]:
        """The same machines with all coordinates and, where psi is one of them, without it."""
        return (self, self.five) if "psi" in self.design.columns else (self,)

    @property
    def kind(self) -> Component:
        """The measurement kind."""
        kind = self.trials.instrument.sensors[0].kind
        assert isinstance(kind, Component)
        return kind

    @cached_property
    def five(self) -> Study:
        """The same measurements without psi."""
        sensor, measured = self.trials.instrument.sensors[0], self.trials.measured[0][..., :5]
        kind = replace(self.kind, components=self.kind.components[:5])
        sensor = replace(sensor, kind=kind, noise=lc.Uniform(list_limits()[:5]))
        instrument = lc.Instrument((sensor,))
        trials = replace(self.trials, instrument=instrument, measured=(measured,))
        return replace(self, trials=trials, freedoms=5)

    def with_noise(self, noise: FloatArray) -> Study:
        """Return the same poses measured with a noise (36, c or more) [m, rad]."""
        T, noise = self.trials.T, noise[..., : self.freedoms]
        measured = self.kind.measure(T, np.broadcast_to(noise, (*T.shape[:2], self.freedoms)))
        return replace(self, trials=replace(self.trials, measured=(measured,)))

    @cached_property
    def raw(self) -> RawProblem:
        """The measurements as the paper weights them."""
        return make_raw_problem(self.robot, self.trials)

    @cached_property
    def grid(self) -> Solution:
        """The output range: its poses, commanded with the machine as designed."""
        return inverse(self.robot, self.design.output_range)

    @cached_property
    def true_outputs(self) -> FloatArray:
        """(t, 96, 4, 4) poses of the true machines, commanded to the output range."""
        return self._compute_outputs(self.trials.truth)

    def _compute_outputs(self, values: FloatArray) -> FloatArray:
        return forward_trials(self.robot, values, self.grid.q[None], self.grid.state).T

    def compute_output_errors(
        self, values: FloatArray, machine: IntArray | None = None
    ) -> FloatArray:
        """Return errors (a, 5) of poses over the output range, at equal readings, and of
        parameters, see MEASURES. psi counts in none: the paper considers it unnecessary.

        values : (a, p) identified [SI]; NaN rows give NaN. machine : (a,) of which machine;
        default: one row each.
        """
        is_finite = np.isfinite(values).all(axis=1, keepdims=True)
        machine = np.arange(len(values)) if machine is None else machine
        T = self._compute_outputs(np.where(is_finite, values, self.robot.values))
        free = self.design.free
        truth = self.trials.truth[machine]
        off, before = ((x - truth)[:, free.places] for x in (values, self.robot.parameters.nominal))
        parameters, worse = (off / free.tolerance) ** 2, np.abs(off) > np.abs(before)
        sizes = np.sqrt(parameters.mean(axis=1)), worse.mean(axis=1)
        errors = np.column_stack([_compare_poses(T, self.true_outputs[machine]), *sizes])
        return np.where(is_finite, errors, np.nan)

    def compute_commanded_errors(
        self, values: FloatArray, machine: IntArray | None = None
    ) -> FloatArray:
        """Return the first two errors (a, 2) of the true machines, relative to the pose of the
        machine as designed, at the readings with which the identified machine would reach it;
        parameters as for `compute_output_errors`.

        Coordinates without an actuator keep their errors, even with the true values.
        """
        is_finite = np.isfinite(values).all(axis=1, keepdims=True)
        machine = np.arange(len(values)) if machine is None else machine
        known = np.where(is_finite, values, self.robot.values)
        target = self.design.output_range[None]
        state = inverse_trials(self.robot, known, target, self.grid.state)
        q = compute_readings(self.robot, known, state)
        T = forward_trials(self.robot, self.trials.truth[machine], q, self.grid.state).T
        return np.where(is_finite, _compare_poses(T, self.grid.T[None])[:, :2], np.nan)


def _compare_poses(T: FloatArray, reference: FloatArray) -> FloatArray:
    """Return rms differences (a, 3) of poses (a, n, 4, 4): the first three MEASURES. Where the
    tilt is so small that phi means nothing, the normal counts in place of phi and theta.
    """
    position = np.sum((T[..., :3, 3] - reference[..., :3, 3]) ** 2, axis=-1) / MM**2
    first, second = (geometry.matrix_to_tilt_torsion(x[..., :3, :3]) for x in (T, reference))
    turned = np.rad2deg(geometry.wrap_angle(first - second))[..., :2]
    normal = np.rad2deg(1.0) ** 2 * np.sum((T[..., :3, 2] - reference[..., :3, 2]) ** 2, axis=-1)
    angles = np.where(second[..., 1] < SMALL_TILT, normal, np.sum(turned**2, axis=-1))
    return np.sqrt(np.stack([np.mean(x, axis=1) for x in (position, angles, normal)], axis=1))


def measure_machines(design: Design, truth: FloatArray, seed: int = 0) -> Study:
    """Measure the poses of true machines (t, p) [SI] with drawn noise: steps 3 and 4."""
    n = len(design.columns)
    kind = Component(design.columns, "tilt-torsion" if n > 3 else None)
    instrument = lc.Instrument((lc.Sensor(kind, lc.Uniform(list_limits()[:n])),))
    trials = simulate_trials(design.robot, truth, design.poses, instrument, seed)
    return Study(design, trials, n)


def measure_case(design: Design, seed: int) -> Study:
    """Measure one machine with drawn errors and the noise of Appendix 1."""
    return measure_machines(design, design.draw_true_values(1, seed)).with_noise(read_noise())


def read_noise() -> FloatArray:
    """Return the noise (36, 6) [m, rad] of Appendix 1."""
    values = PRINTED.table("appendix_1").values
    values[:, :3] *= MM
    return values


def list_output_range(robot: Mechanism) -> FloatArray:
    """Return controlled coordinates (96, c) [m, rad]: tilts of 5 to 35 degrees, more azimuths."""
    heights = SIZES.find("heights") if "z" in robot.controlled else (0.0,)
    tilts = SIZES.find("evaluated_tilts")
    count = SIZES.find("evaluated") // (len(tilts) * len(heights))
    grid = np.meshgrid(np.arange(count) * 360.0 / count, tilts, heights)
    phi, theta, z = (g.ravel() for g in grid)
    given = {"phi": geometry.wrap_angle(np.deg2rad(phi)), "theta": np.deg2rad(theta), "z": z}
    return np.column_stack([given[name] for name in robot.controlled])


def draw_true_values(robot: Mechanism, trials: int, seed: int) -> FloatArray:
    """Return nominal values (t, p) [SI] with errors of drawn size and sign.

    Machine i is the same for any number of machines.
    """
    table = robot.parameters
    lengths, angles = SIZES.find("length_errors"), SIZES.find("angle_errors")
    low, high = np.array([lengths if d is Dimension.LENGTH else angles for d in table.dimensions]).T
    values = []
    for trial in range(trials):
        drawn = make_random_stream(seed, trial, ERRORS)
        size, sign = drawn.uniform(low, high), drawn.choice([-1.0, 1.0], len(table))
        values.append(table.nominal + sign * size)
    return np.array(values)


def iterate(
    study: Study, penalty: FloatArray, machine: IntArray | None = None, limit: int = LIMIT,
    ahead: float = AHEAD,
) -> RawSteps:  # fmt: skip
    """Run steps 5 to 9 with the penalty (t | 1, p) of each setting, see `take_steps`.

    machine : (t,) which machine was measured; default: the first. limit, ahead : see `StepRule`.
    """
    machine = np.zeros(len(penalty), dtype=np.int64) if machine is None else machine
    return take_steps(study.raw.take(machine), penalty, StepRule(limit=limit, ahead=ahead))


def linearize(study: Study) -> Decomposition:
    """Return the decomposition of H of the first machine at nominal values: steps 5 and 6."""
    first = study.raw.take(np.zeros(1, dtype=np.int64))
    return first.linearize(study.robot.parameters.nominal[None])[0]


def find_rank(decomposition: Decomposition) -> int:
    """Return the rank of the first machine's H."""
    return int(are_nonzero(decomposition.singular_values[0]).sum())


def list_scales(robot: Mechanism) -> FloatArray:
    """Return the paper's units (p,) in SI: millimeters and radians."""
    return list_raw_units(robot.parameters.dimensions)


def find_bottom(errors: FloatArray) -> int:
    """Return the place of the smallest product of errors (s, ..), those of `Design.parts`."""
    product = errors.prod(axis=1)
    return int(np.argmin(np.where(np.isnan(product), np.inf, product)))


def locate_bottoms(errors: FloatArray, parts: Sequence[int]) -> IntArray:
    """Return the places (t, parts + 1) of the bottoms of curves (t, s, 5): of each part and, last,
    of their product.
    """
    curves = errors[:, :, parts]
    curves = np.concatenate([curves, curves.prod(axis=2, keepdims=True)], axis=2)
    return np.argmin(np.where(np.isnan(curves), np.inf, curves), axis=1)


def widen(
    run: Callable[[FloatArray], list[np.ndarray]], lambdas: FloatArray, parts: Sequence[int],
    curves: int,
) -> tuple[FloatArray, list[np.ndarray]]:  # fmt: skip
    """Run lambdas (s,), and more decade by decade until no curve has its bottom at an end, or up to
    the range of sizes.yaml; lambda = 0 is no end.

    run : arrays (t, s, ..) at lambdas (s,), of which the first ones, `curves`, are errors.
    """
    (low, high), found = (0.9, 1.1) * np.array(SIZES.find("range")), run(lambdas)
    while True:
        bottoms = np.concatenate([locate_bottoms(x, parts) for x in found[:curves]])
        first, last = int(lambdas[0] == 0.0), len(lambdas) - 1
        ends = {lambdas[first] / 10.0: first, lambdas[last] * 10.0: last}
        more = [lam for lam, end in ends.items() if end in bottoms and low < lam < high]
        if not more:
            return lambdas, found
        pairs = zip(found, run(np.array(more)), strict=True)
        order = np.argsort(lambdas := np.array([*lambdas, *more]))
        found, lambdas = [np.concatenate(p, axis=1)[:, order] for p in pairs], lambdas[order]


def compute_rise(curve: FloatArray) -> float:
    """Return the lower end of a curve (s,), relative to its least inner value; 0 with no inside.

    Settings that diverged are no part of the curve.
    """
    usable = curve[np.isfinite(curve)]
    if len(usable) < 3:
        return 0.0
    return float(min(usable[0], usable[-1]) / usable[1:-1].min())


@dataclass(frozen=True, eq=False)
class Chosen:
    """One method on t machines, each with one setting."""

    settings: FloatArray  # (t,) lambda or k
    values: FloatArray  # (t, p) [SI], NaN if diverged
    iterations: IntArray  # (t,)
    is_converged: BoolArray  # (t,)
    errors: FloatArray  # (t, 5), see MEASURES, infinite if diverged
    commanded: FloatArray  # (t, 2), see `Study.compute_commanded_errors`, infinite if diverged

    @classmethod
    def judge(
        cls, study: Study, settings: FloatArray, values: FloatArray, iterations: IntArray,
        is_converged: BoolArray,
    ) -> Chosen:  # fmt: skip
        """Return identified machines with their errors."""
        errors = mark_diverged(study.compute_output_errors(values))
        commanded = mark_diverged(study.compute_commanded_errors(values))
        return cls(settings, values, iterations, is_converged, errors, commanded)


def mark_diverged(errors: FloatArray) -> FloatArray:
    """Count diverged machines as infinitely wrong, so that medians stay honest."""
    return np.where(np.isnan(errors), np.inf, errors)


@dataclass(frozen=True, eq=False)
class Sweep:
    """The paper's methods on t machines, over their settings."""

    study: Study
    # (s,) of RE and EARLY (lambda, rising) and TSVD (k, falling); the first one is LS: lambda = 0,
    # and k the number of parameters
    settings: Mapping[str, FloatArray]
    curves: Mapping[str, FloatArray]  # (t, s, 5) errors at them, see MEASURES, infinite if diverged
    counts: Mapping[str, IntArray]  # (t, s) iterations
    # of LS and RANKED, and of the others at the bottom of their curves, without LS
    chosen: Mapping[str, Chosen]
    exact: FloatArray  # (t, 5) errors of LS with rank detection, measured without noise

    def __len__(self) -> int:
        return len(self.exact)

    @property
    def short(self) -> FloatArray:
        """(t, s - 1, 5) errors of EARLY, without LS."""
        return self.curves[EARLY][:, 1:]

    def are_at_end(self, algorithm: str) -> BoolArray:
        """Return for which machines (t,) the bottom of a curve is no minimum: LS is as good, or the
        last setting is the best.
        """
        curves = self.curves[algorithm]
        bottoms = locate_bottoms(curves, self.study.design.parts)[:, -1]
        return (bottoms == 0) | (bottoms == curves.shape[1] - 1)

    def compute_median(self, algorithm: str) -> FloatArray:
        """Return the median curve (s, 5)."""
        return np.median(self.curves[algorithm], axis=0)

    def compute_rises(self, algorithm: str, measure: int) -> FloatArray:
        """Return `compute_rise` of each machine's curve (t,)."""
        return np.array([compute_rise(curve) for curve in self.curves[algorithm][:, :, measure]])

    def compare_unseen(self, algorithm: str) -> FloatArray:
        """Return errors (t, parts) relative to LS with a setting that was best on other machines.

        Each half of the machines takes the setting at the bottom of the median curve of the other
        half. Infinite if the algorithm diverged, 0 if only LS did.
        """
        parts = self.study.design.parts
        curves, ratios = self.curves[algorithm][:, 1:, parts], np.empty((len(self), len(parts)))
        for half in (0, 1):
            best = find_bottom(np.median(curves[1 - half :: 2], axis=0))
            errors, reference = curves[half::2, best], self.chosen[LS].errors[half::2, parts]
            with np.errstate(invalid="ignore"):
                ratios[half::2] = np.where(np.isfinite(errors), errors / reference, np.inf)
        return ratios


def run_settings(
    study: Study, lambdas: FloatArray, progress: Callable[[str], None] = lambda _: None
) -> Sweep:
    """Run the paper's methods on all machines: RE with these lambdas and as many more as `widen`
    needs, after all steps and after the first ones, and TSVD with every k.
    """
    p, t, judged = len(study.design.free), len(study.trials), study.design.parts
    null, machines = p - find_rank(linearize(study)), np.arange(t)
    ks, together = np.arange(p, 0, -1), SIZES.find("together")

    def run(penalty: FloatArray) -> list[np.ndarray]:
        """Return arrays (t, s, ..): errors after all steps and after SHORT, and for both the
        values, the iterations, and whether they converged.
        """
        parts = []
        for first in range(0, t, together):  # histories are large
            progress(f"{study.label}, machine {first + 1} of {t}")
            of = np.arange(first, min(first + together, t))
            machine = np.repeat(of, len(penalty))
            steps = iterate(study, np.tile(penalty, (len(of), 1)), machine)
            place = np.searchsorted(steps.done.max(axis=1), SHORT)
            early = steps.history[min(int(place), len(steps.done) - 1)]
            errors = [study.compute_output_errors(v, machine) for v in (steps.values, early)]
            arrays = (*map(mark_diverged, errors), steps.values, early, steps.count,
                      np.minimum(steps.count, SHORT), steps.is_converged,
                      steps.is_converged & (steps.count <= SHORT))  # fmt: skip
            parts.append([x.reshape(len(of), -1, *x.shape[1:]) for x in arrays])
        return [np.concatenate(part) for part in zip(*parts, strict=True)]

    truncated = run(penalize_truncated(ks, p))
    lambdas, ridge = widen(
        lambda more: run(penalize_ridge(more, p)), np.array([0.0, *lambdas]), judged, 2
    )
    settings = {EARLY: lambdas, RE: lambdas, TSVD: ks.astype(np.float64)}
    found = {EARLY: ridge[1::2], RE: ridge[::2], TSVD: truncated[::2]}
    places = {a: 1 + locate_bottoms(of[0][:, 1:], judged)[:, -1] for a, of in found.items()}

    def choose(algorithm: str, place: IntArray) -> Chosen:
        values, count, is_converged = (x[machines, place] for x in found[algorithm][1:])
        return Chosen.judge(study, settings[algorithm][place], values, count, is_converged)

    exact = study.with_noise(np.zeros(study.freedoms))
    free = iterate(exact, penalize_truncated(np.array([p - null]), p), machines)
    return Sweep(
        study=study,
        settings=settings,
        curves={a: of[0] for a, of in found.items()},
        counts={a: of[2] for a, of in found.items()},
        chosen={
            LS: choose(TSVD, np.zeros(t, np.int64)),
            RANKED: choose(TSVD, np.full(t, null)),
            **{algorithm: choose(algorithm, place) for algorithm, place in places.items()},
        },
        exact=mark_diverged(exact.compute_output_errors(free.values)),
    )


@dataclass(frozen=True, eq=False)
class Case:
    """One machine with the printed noise and one number of measured coordinates."""

    sweep: Sweep
    singular_values: FloatArray  # (p,) of the raw identification matrix at nominal parameters
    rank: int  # of them
    known: Identifiability  # identifiability of the same measurements
    spacing: tuple[str, ...]  # of each lambda
    runs: RawSteps  # of PICTURED at their settings, with FINE leaps
    answers: Mapping[str, Chosen]  # by method of the paper and of LIBRARY
    bracket: tuple[float, float]  # smallest and largest lambda of those tried that does not diverge
    # largest component [mm, rad] of the first step if (H'H)^-1 H'D is computed as printed
    normal_equations: float

    @property
    def study(self) -> Study:
        """The measurements."""
        return self.sweep.study

    def is_diverged(self, method: str) -> bool:
        """Return whether a method has no answer."""
        return not np.isfinite(self.answers[method].values).all()

    def describe_setting(self, method: str) -> str:
        """Return lambda or k of a method."""
        form = {
            RANKED: f"rank {self.rank}",
            EARLY: "lambda = {:.2g}",
            RE: "lambda = {:.2g}",
            TSVD: "k = {:.0f}",
            CROSS: "lambda = {:.2g}, chosen",
            PRIOR: "lambda = 1, by definition",
        }.get(method, "-")
        text = form.format(self.answers[method].settings[0])
        if method in self.sweep.curves and self.sweep.are_at_end(method)[0]:
            return f"{text}, at the end of the range"
        return text


def solve_case(study: Study, progress: Callable[[str], None]) -> Case:
    """Run all methods on one machine's measurements."""
    progress(f"{study.label} measurement")
    p, known = len(study.design.free), linearize(study)
    s, rank, tried = known.singular_values[0], find_rank(known), np.array(SIZES.find("tried"))
    lambdas, is_equal = space_lambdas(s[rank - 1])
    wide = list_lambdas()
    sweep = run_settings(study, np.array([*lambdas, *wide[wide > lambdas[-1]]]))
    words = dict(zip(lambdas, np.where(is_equal, "equal intervals", "equal ratios"), strict=True))
    k = {LS: p, TSVD: sweep.chosen[TSVD].settings[0]}
    pictured = [
        penalize_truncated(np.array([k[a]]), p) if a in k
        else penalize_ridge(sweep.chosen[a].settings, p)
        for a in PICTURED
    ]  # fmt: skip
    safe = tried[~iterate(study, penalize_ridge(tried, p), limit=3).is_diverged]
    return Case(
        sweep=sweep,
        singular_values=s,
        rank=rank,
        known=lc.identifiability(study.robot.nominal, study.trials.trial(0)),
        spacing=tuple(str(words.get(lam, "more decades")) for lam in sweep.settings[RE][1:]),
        runs=iterate(study, np.concatenate(pictured), ahead=FINE),
        answers={**sweep.chosen, **run_library(study)},
        bracket=(float(safe.min()), float(safe.max())),
        normal_equations=solve_normal_equations(study),
    )


def space_lambdas(smallest: float) -> tuple[FloatArray, BoolArray]:
    """Return lambdas (s,) from the smallest singular value to 1, and which are equidistant."""
    intervals = np.linspace(smallest, 1.0, SIZES.find("equal_intervals"))
    ratios = np.geomspace(smallest, 1.0, SIZES.find("equal_ratios"))
    lambdas = np.unique(np.concatenate([intervals, ratios[1:-1]]))
    return lambdas, np.isin(lambdas, intervals)


def solve_normal_equations(study: Study) -> float:
    """Return the first step of LS as printed, with the inverse of H'H: only here it is formed.

    With a null direction H'H is singular up to rounding, and so its inverse is rounding.
    """
    d = linearize(study)
    H = d.singular_values[0][:, None] * d.directions[0].T
    try:
        step = np.linalg.inv(H.T @ H) @ (H.T @ d.projections[0])
    except np.linalg.LinAlgError:
        return float("inf")
    return float(np.abs(step).max())


def run_library(study: Study, methods: Mapping[str, Method] = LIBRARY) -> dict[str, Chosen]:
    """Return the results of methods of the library."""
    answers = {}
    for name, method in methods.items():
        fit = lc.identify_trials(study.robot, study.trials, method)
        answers[name] = Chosen.judge(
            study, fit.penalty[:, 0], fit.values, fit.iterations, fit.converged
        )
    return answers


def follow_ridge(case: Case) -> list[tuple[int | str, float, bool, FloatArray]]:
    """Return the best lambda, whether it is at an end of the range, and its errors (5,) after each
    number of RE iterations, and after all.
    """
    study, sweep, counts = case.study, case.sweep, SIZES.find("ridge_steps")
    lambdas = sweep.settings[RE]
    penalty = penalize_ridge(lambdas, len(study.design.free))
    history = iterate(study, penalty, limit=max(counts), ahead=0.0).history
    machine, rows = np.zeros(len(lambdas), dtype=np.int64), []
    for count in (*counts, "all"):
        errors = sweep.curves[RE][0]
        if count != "all":
            values = history[min(count, len(history) - 1)]
            errors = mark_diverged(study.compute_output_errors(values, machine))
        best = int(locate_bottoms(errors[None], study.design.parts)[0, -1])
        rows.append((count, float(lambdas[best]), best in (0, len(lambdas) - 1), errors[best]))
    return rows


@dataclass(frozen=True, eq=False)
class Draws:
    """Results of t drawn machines of a structure.

    The paper's methods take the setting that is best for the true machine. The library's methods
    choose theirs from the data; MAP is given the true spread of the errors as its tolerances.
    """

    sweeps: tuple[Sweep, ...]  # the paper's methods with 6- and 5-DOF measurement
    errors: Mapping[str, FloatArray]  # method -> (t, 5), see MEASURES, infinite if diverged
    # method -> (t, 2), see `Chosen`; without HINDSIGHT, which takes another lambda for each measure
    commanded: Mapping[str, FloatArray]
    # method with a setting -> (t,) whether its curve has no minimum, see `Sweep.are_at_end`
    at_end: Mapping[str, BoolArray]

    def __len__(self) -> int:
        return len(self.sweeps[0])

    @property
    def design(self) -> Design:
        """The structure."""
        return self.sweeps[0].study.design

    @property
    def name(self) -> str:
        """Its name."""
        return self.design.name

    def compute_median(self, method: str) -> FloatArray:
        """Return medians (5,) over the machines."""
        return np.median(self.errors[method], axis=0)

    def compute_interval(self, method: str) -> FloatArray:
        """Return the bootstrap interval (2, 5) of the medians, 95 %."""
        return _find_interval(_resample_medians(self.errors[method]))

    def compute_ratio(self, method: str, other: str) -> FloatArray:
        """Return the ratio (5,) of medians, method over other."""
        with np.errstate(divide="ignore", invalid="ignore"):  # of diverged fits
            return self.compute_median(method) / self.compute_median(other)

    def compute_ratio_interval(self, method: str, other: str) -> FloatArray:
        """Return the bootstrap interval (2, parts) of the ratio of medians, the machines drawn in
        pairs, 95 %.
        """
        parts = self.design.parts
        first, second = (_resample_medians(self.errors[m][:, parts]) for m in (method, other))
        return _find_interval(first / second)


def _resample_medians(values: FloatArray) -> FloatArray:
    """Return medians (r, ..) of machines drawn with replacement, always the same ones."""
    t, count = len(values), SIZES.find("resamples")
    drawn = make_random_stream(0, 0, RESAMPLING).integers(0, t, (count, t))
    return np.median(values[drawn], axis=1)


def _find_interval(medians: FloatArray) -> FloatArray:
    return np.quantile(medians, [0.025, 0.975], axis=0, method="nearest")  # some may be infinite


def simulate_machines(
    design: Design, seed: int, trials: int, progress: Callable[[str], None] = lambda _: None
) -> Draws:
    """Draw machines, measure and identify them by all methods."""
    truth = design.draw_true_values(trials, seed)
    whole = measure_machines(design, truth, seed)
    sweeps = tuple(run_settings(study, list_lambdas(), progress) for study in whole.both)
    progress(f"{design.name}, methods of loopcal")
    factor = SIZES.find("factor")
    scaled = {NARROW: lc.Ridge(factor**2), WIDE: lc.Ridge(factor**-2)}
    without = {WHITENED_FIVE: lc.LeastSquares(), PRIOR_FIVE: lc.MAP()}
    values = {BEFORE: np.repeat(whole.robot.parameters.nominal[None], trials, axis=0), TRUE: truth}
    for study, methods in zip(whole.both, ({**LIBRARY, **scaled}, without), strict=False):
        for method, how in methods.items():
            values[method] = lc.identify_trials(study.robot, study.trials, how).values
    errors = {m: whole.compute_output_errors(v) for m, v in values.items()}
    commanded = {m: whole.compute_commanded_errors(v) for m, v in values.items()}

    def run(lambdas: FloatArray) -> list[np.ndarray]:
        start, tried = None, []
        for lam in lambdas:
            options = lc.FitOptions(start=start)
            fit = lc.identify_trials(whole.robot, whole.trials, lc.Ridge(lam), options=options)
            start = fit.values
            tried.append(mark_diverged(whole.compute_output_errors(fit.values)))
        return [np.stack(tried, axis=1)]

    parts, lambdas = design.parts, list_lambdas("hindsight_exponents")
    lambdas, (tried,) = widen(run, lambdas, parts, 1)  # each machine and measure has its best one
    bottoms, errors[HINDSIGHT] = locate_bottoms(tried, parts), tried.min(axis=1)
    at_end = {HINDSIGHT: ((bottoms == 0) | (bottoms == len(lambdas) - 1)).any(axis=1)}
    for method, (place, algorithm) in RAW.items():
        if place == len(sweeps):  # without psi, which is not measured
            continue
        chosen = sweeps[place].chosen[algorithm]
        errors[method], commanded[method] = chosen.errors, chosen.commanded
        if algorithm in sweeps[place].curves:
            at_end[method] = sweeps[place].are_at_end(algorithm)
    errors, commanded = (
        {m: mark_diverged(of[m]) for m in METHODS if m in of} for of in (errors, commanded)
    )
    return Draws(sweeps, errors, commanded, at_end)
