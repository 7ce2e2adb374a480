# SPDX-License-Identifier: Apache-2.0
"""The nine steps of the paper (docs/papers.md), for t machines or t settings of lambda
and k at once. The first of the drawn machines is measured with the printed noise.

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
from typing import Any

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
from loopcal.mechanism.kinematics import forward_trials
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
    make_raw_problem,
    penalize_ridge,
    penalize_truncated,
    take_steps,
)
from loopcal.studies.specification import ErrorsLevel, describe_cell
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

MM = 1e-3
PRINTED, SIZES = PaperFile(__file__, "published.yaml"), PaperFile(__file__, "sizes.yaml")
# Names in the paper, and of our robot files.
ROBOTS = {"RU-PUS-PRS": "ru-pus-prs", "3-PRS": "3-prs"}
COLUMNS = ("x", "y", "z", "phi", "theta", "psi")
# Root mean squares over the output range and over the parameters, and a share.
MEASURES = (
    "position [mm]",
    "phi and theta [deg]",
    "direction of the normal [deg]",
    "parameters [spreads]",
    "parameters farther from the truth than nominal [share]",
)
ERRORS = 3  # purpose of a random stream

SHORT, FINE = SIZES.find("short"), 0.05
"""Iterations of the paper, and leaps of iterations that are drawn, see `StepRule.ahead`."""
LS, RANKED, TSVD = "LS", "LS with rank detection", "TSVD"
RE, EARLY = "RE, all steps", f"RE, {SHORT} steps"
PICTURED = (LS, EARLY, RE, TSVD)
WHITENED, CROSS, PRIOR = "whitened LS", "whitened ridge, GCV", "MAP"
# Methods of the library: rows whitened, columns scaled by tolerance.
LIBRARY: Mapping[str, Method] = {
    WHITENED: lc.LeastSquares(), CROSS: lc.Ridge(lc.GCV()), PRIOR: lc.MAP(),
}  # fmt: skip

BEFORE = "before calibration"


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
    """Return the lambdas of RE: powers of ten, see `widen`; "fine" ones between them."""
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
    """Return another robot with poses and errors of its study file; DataError if it has none."""
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


@dataclass(frozen=True, eq=False)
class Study:
    """t machines of one structure, measured."""

    design: Design
    trials: Trials  # true machines and their measurements
    freedoms: int = len(COLUMNS)  # measured coordinates of a pose

    @property
    def robot(self) -> Mechanism:
        """As designed."""
        return self.design.robot

    @property
    def label(self) -> str:
        """Structure and measurement."""
        return f"{self.design.name}, {self.freedoms}-DOF"

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

    @cached_property
    def known(self) -> Identifiability:
        """What the measurements of the first machine identify."""
        return lc.identifiability(self.robot.nominal, self.trials.trial(0))

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

    @cached_property
    def before(self) -> FloatArray:
        """(t, 5) errors of the machine as designed, see `compute_output_errors`."""
        nominal = self.robot.parameters.nominal[None]
        return self.compute_output_errors(np.repeat(nominal, len(self.trials), axis=0))

    def _compute_outputs(self, values: FloatArray) -> FloatArray:
        return forward_trials(self.robot, values, self.grid.q[None], self.grid.state).T

    def compute_output_errors(
        self, values: FloatArray, machine: IntArray | None = None
    ) -> FloatArray:
        """Return errors (a, 5) of poses over the output range, at equal readings, and of
        parameters, see MEASURES. psi counts in none: the paper considers it unnecessary.

        values : (a, p) identified [SI]. NaN rows are diverged machines, which count as infinitely
        wrong, so that medians stay honest. machine : (a,) of which machine; default: one row each.
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
        return np.where(is_finite, errors, np.inf)


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
    """Measure the poses of true machines (t, p) [SI]: steps 3 and 4. The first has the noise of
    Appendix 1, the others have drawn noise.
    """
    n = len(design.columns)
    kind = Component(design.columns, "tilt-torsion" if n > 3 else None)
    instrument = lc.Instrument((lc.Sensor(kind, lc.Uniform(list_limits()[:n])),))
    trials = simulate_trials(design.robot, truth, design.poses, instrument, seed)
    study = Study(design, trials, n)
    printed = study.with_noise(read_noise()).trials.measured[0][:1]
    measured = np.concatenate([printed, trials.measured[0][1:]])
    return replace(study, trials=replace(trials, measured=(measured,)))


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


def find_rank(study: Study) -> int:
    """Return the rank of the first machine's H."""
    return int(are_nonzero(linearize(study).singular_values[0]).sum())


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

    @classmethod
    def of(
        cls, study: Study, settings: FloatArray, values: FloatArray, iterations: IntArray,
        is_converged: BoolArray,
    ) -> Chosen:  # fmt: skip
        """Return identified machines with their errors."""
        errors = study.compute_output_errors(values)
        return cls(settings, values, iterations, is_converged, errors)


@dataclass(frozen=True, eq=False)
class Sweep:
    """The paper's methods on t machines, over their settings."""

    study: Study
    # (s,) of RE and EARLY (lambda, rising) and TSVD (k, falling); the first one is LS: lambda = 0,
    # and k the number of parameters
    settings: Mapping[str, FloatArray]
    curves: Mapping[str, FloatArray]  # (t, s, 5) errors at them, see MEASURES, infinite if diverged
    counts: Mapping[str, IntArray]  # (t, s) iterations
    # LS and RANKED, the others at the bottom of their curves, without LS, and those of LIBRARY
    chosen: Mapping[str, Chosen]
    runs: RawSteps  # of PICTURED at their settings on the first machine, with FINE leaps
    exact: FloatArray  # (t, 5) errors of LS with rank detection, measured without noise

    def __len__(self) -> int:
        return len(self.exact)

    def are_at_end(self, algorithm: str) -> BoolArray:
        """Return for which machines (t,) the bottom of a curve is no minimum: LS is as good, or the
        last setting is the best.
        """
        curves = self.curves[algorithm]
        bottoms = locate_bottoms(curves, self.study.design.parts)[:, -1]
        return (bottoms == 0) | (bottoms == curves.shape[1] - 1)

    @property
    def singular_values(self) -> FloatArray:
        """(p,) of the raw identification matrix of the first machine at nominal parameters."""
        return linearize(self.study).singular_values[0]

    def is_diverged(self, method: str) -> bool:
        """Return whether a method has no answer for the first machine."""
        return not np.isfinite(self.chosen[method].values[0]).all()

    def describe_setting(self, method: str) -> str:
        """Return lambda or k of a method for the first machine."""
        form = {
            RANKED: f"rank {find_rank(self.study)}",
            EARLY: "lambda = {:.2g}",
            RE: "lambda = {:.2g}",
            TSVD: "k = {:.0f}",
            CROSS: "lambda = {:.2g}, chosen",
            PRIOR: "lambda = 1, by definition",
        }.get(method, "-")
        text = form.format(self.chosen[method].settings[0])
        if method in self.curves and self.are_at_end(method)[0]:
            return f"{text}, at the end of the range"
        return text

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
            median = np.median(curves[1 - half :: 2], axis=0, keepdims=True)
            best = locate_bottoms(median, range(len(parts)))[0, -1]
            errors, reference = curves[half::2, best], self.chosen[LS].errors[half::2, parts]
            with np.errstate(invalid="ignore"):
                ratios[half::2] = np.where(np.isfinite(errors), errors / reference, np.inf)
        return ratios


def run_settings(study: Study, progress: Callable[[str], None] = lambda _: None) -> Sweep:
    """Run the paper's methods on all machines: RE with as many lambdas as `widen` needs, after all
    steps and after the first ones, and TSVD with every k; and the methods of the library.
    """
    p, t, judged = len(study.design.free), len(study.trials), study.design.parts
    null, machines = p - find_rank(study), np.arange(t)
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
            arrays = (*errors, steps.values, early, steps.count,
                      np.minimum(steps.count, SHORT), steps.is_converged,
                      steps.is_converged & (steps.count <= SHORT))  # fmt: skip
            parts.append([x.reshape(len(of), -1, *x.shape[1:]) for x in arrays])
        return [np.concatenate(part) for part in zip(*parts, strict=True)]

    truncated = run(penalize_truncated(ks, p))
    lambdas, ridge = widen(
        lambda more: run(penalize_ridge(more, p)), np.array([0.0, *list_lambdas()]), judged, 2
    )
    settings = {EARLY: lambdas, RE: lambdas, TSVD: ks.astype(np.float64)}
    found = {EARLY: ridge[1::2], RE: ridge[::2], TSVD: truncated[::2]}
    places = {a: 1 + locate_bottoms(of[0][:, 1:], judged)[:, -1] for a, of in found.items()}

    def choose(algorithm: str, place: IntArray) -> Chosen:
        values, count, is_converged = (x[machines, place] for x in found[algorithm][1:])
        return Chosen.of(study, settings[algorithm][place], values, count, is_converged)

    progress(f"{study.label}, methods of loopcal")
    fits = {name: lc.identify_trials(study.robot, study.trials, how)
            for name, how in LIBRARY.items()}  # fmt: skip
    chosen = {
        LS: choose(TSVD, np.zeros(t, np.int64)),
        RANKED: choose(TSVD, np.full(t, null)),
        **{algorithm: choose(algorithm, place) for algorithm, place in places.items()},
        **{name: Chosen.of(study, fit.penalty[:, 0], fit.values, fit.iterations, fit.converged)
           for name, fit in fits.items()},
    }  # fmt: skip
    pictured = [penalize_truncated(np.array([p]), p),
                *(penalize_ridge(chosen[a].settings[:1], p) for a in (EARLY, RE)),
                penalize_truncated(chosen[TSVD].settings[:1].astype(np.int64), p)]  # fmt: skip
    exact = study.with_noise(np.zeros(study.freedoms))
    free = iterate(exact, penalize_truncated(np.array([p - null]), p), machines)
    return Sweep(
        study=study,
        settings=settings,
        curves={a: of[0] for a, of in found.items()},
        counts={a: of[2] for a, of in found.items()},
        chosen=chosen,
        runs=iterate(study, np.concatenate(pictured), ahead=FINE),
        exact=exact.compute_output_errors(free.values),
    )


def follow_ridge(sweep: Sweep) -> list[tuple[int | str, float, bool, FloatArray]]:
    """Return the best lambda for the first machine, whether it is at an end of the range, and its
    errors (5,) after each number of RE iterations, and after all.
    """
    study, counts, lambdas = sweep.study, SIZES.find("ridge_steps"), list_lambdas("fine")
    penalty = penalize_ridge(lambdas, len(study.design.free))
    history = iterate(study, penalty, limit=max(counts), ahead=0.0).history
    machine, found = np.zeros(len(lambdas), dtype=np.int64), list[tuple[int | str, Any, Any]]()
    for count in counts:
        values = history[min(count, len(history) - 1)]
        found.append((count, lambdas, study.compute_output_errors(values, machine)))
    rows = []
    for count, settings, errors in (*found, ("all", sweep.settings[RE], sweep.curves[RE][0])):
        best = int(locate_bottoms(errors[None], study.design.parts)[0, -1])
        is_at_end = best in (0, len(settings) - 1)
        rows.append((count, float(settings[best]), is_at_end, errors[best]))
    return rows


def simulate_machines(
    design: Design, seed: int, trials: int, progress: Callable[[str], None] = lambda _: None
) -> tuple[Sweep, ...]:
    """Draw machines, measure and identify them by all methods: with all coordinates and, where psi
    is one of them, without it.

    The paper's methods take the setting that is best for the true machine. The library's methods
    choose theirs from the data; MAP is given the true spread of the errors as its spreads.
    """
    whole = measure_machines(design, design.draw_true_values(trials, seed), seed)
    return tuple(run_settings(study, progress) for study in whole.both)
