# SPDX-License-Identifier: Apache-2.0
"""Compute the misfit of measurements to a robot that is free within its tolerances.

Interpretations that differ in measured values share poses and sensitivities: they are the trials of
one problem. Every interpretation has its own nuisance parameters (frames, targets, surfaces) and
its own excluded rows. All functions are pure; see docs/theory/residual-patterns.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.diagnose.conventions.interpretations import Interpretation
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.descent import StepControl, descend
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.identification import identify
from loopcal.estimate.linearization import Linearization, Start
from loopcal.estimate.observation_rows import ObservationRows, Residuals
from loopcal.estimate.penalties import Ridge
from loopcal.estimate.problem import Problem, make_exact_problem, make_problem, problem_of
from loopcal.estimate.resampling import CenteredProblem
from loopcal.findings import Quantity
from loopcal.measure.initial_values import guess_nuisance_values_batch
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.mechanism.kinematics import find_directly_reachable, forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.numerics.gauss_newton import Halving
from loopcal.numerics.statistics import choose_evenly, compute_known_median
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

FEWEST = 3  # smallest number of equations beyond those of unknown frames that gives a misfit
ALLOWED = 4.0  # misfit up to which tolerances and noise explain a residual
# Ratio of misfits up to which two interpretations fit equally well; the first in the list is
# reported, the others as alternatives.
EQUALLY = 1.2
# Rows this many times the median row away are excluded, up to this share of the rows; the check
# for outliers names them. The same share of the poses may be out of reach.
FAR, MOST_EXCLUDED = 5.0, 0.25
# Number of poses that Newton's method does not reach from home at once, and that are tried along
# a path before all others.
FOLLOWED = 8


class Effort(NamedTuple):
    """Effort for unknown frames. An interpretation that fits needs two or three steps of it."""

    candidates: int | None  # for their start values; None: all
    guess_steps: int  # steps of each candidate
    control: Halving  # of the iteration to the best frames


QUICK = Effort(2, 8, Halving(3, 2))  # to compare many interpretations before a few are judged
THOROUGH = Effort(None, 30, Halving(8, 6))  # to judge a few


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measurements in t interpretations of their values, compared with a robot at its values."""

    data: Measurements  # at poses that the robot reaches
    problem: Problem  # of all interpretations
    # at the robot's values; None where the rows do not locate a target
    linearization: Linearization | None
    effort: Effort  # for unknown frames
    # labels of the rows of the first interpretation that are far off the others, and that the
    # problem does not contain
    excluded: tuple[str, ...] = ()

    @cached_property
    def misfits(self) -> FloatArray:
        """(t,) to first order in the parameters; NaN with too few rows."""
        linearization = self.linearization
        if linearization is None:
            return np.full(len(self.problem), np.nan)
        return _compute_misfit(linearization)

    @property
    def misfit(self) -> float:
        """Misfit of the first interpretation."""
        return float(self.misfits[0])

    @property
    def is_finite(self) -> bool:
        """Whether the first interpretation has a misfit."""
        return self.linearization is not None and bool(np.isfinite(self.misfit))

    def residuals(self) -> tuple[Residuals, ...]:
        """Return the residuals of every interpretation at the robot's values."""
        linearization = self.linearization
        assert linearization is not None
        values = None if linearization.nuisance is None else linearization.nuisance.values
        solution = self.problem.solve(linearization.deviation, linearization.next_start, values)
        return self.problem.residuals(linearization.deviation, solution)


def is_redundant(free: FreeParameters) -> bool:
    """Return whether readings are rows, too: more actuators than freedoms."""
    return free.robot.program.sigma is not None


def select_reached(
    free: FreeParameters, data: Measurements, *, follow: bool = False
) -> tuple[Measurements | None, int, int]:
    """Return the measurements at the poses that the robot reaches with the readings, None where it
    reaches too few; and how many it reaches of how many that were tried.

    With `follow`, paths lead to a few poses that are not reached at once, and to the others only if
    these succeed, because failures take longest.
    """
    robot, q, tried = free.robot, data.readings, len(data.readings)
    reached = find_directly_reachable(robot, robot.values[None], q[None])[0]
    if follow and reached.sum() < (1.0 - MOST_EXCLUDED) * len(q):
        hard = np.flatnonzero(~reached)
        sampled = hard[choose_evenly(len(hard), FOLLOWED)]
        reached[sampled] = forward(robot, q[sampled]).converged
        rest = np.setdiff1d(hard, sampled)
        if len(rest) and reached[sampled].mean() >= 1.0 - MOST_EXCLUDED:
            reached[rest] = forward(robot, q[rest]).converged
        else:
            tried -= len(rest)
    count = int(reached.sum())
    if count < (1.0 - MOST_EXCLUDED) * tried:
        return None, count, tried
    return data if reached.all() else data.take(reached), count, tried


def compare_with_robot(
    free: FreeParameters,
    data: Measurements,
    interpretations: Sequence[Interpretation] = (),
    effort: Effort = THOROUGH,
    start: FloatArray | None = None,
) -> Comparison:
    """Compare measurements, at poses that the robot reaches, with it, all rows included.

    interpretations : of their values; default: as written. start : (t, U) nuisance parameters to
        start from; default: guessed from the data.
    """
    nuisance, rows = data.nuisance_parameters, []
    read = [interpretation.apply(data) for interpretation in interpretations] or [data]
    count = len(read)
    for i, o in enumerate(data.observations):
        if not len(o):
            continue
        measured = np.stack([each.observations[i].measured for each in read])
        # a row that another interpretation leaves without some of its residuals is absent there
        same = (o.kind.detect_present(measured) == o.present).all(axis=-1)
        whitener = o.whitener * same[..., None, None]
        places, factor = nuisance.indices[i], nuisance.factor(i)
        rows.append(ObservationRows(o.kind, o.rows, measured, whitener, places, factor))
    chosen = NuisanceParameters(
        nuisance.table, tuple(r.nuisance for r in rows), tuple(r.factor for r in rows)
    )
    if is_redundant(free):
        recorded = np.repeat(data.readings[None], count, axis=0)
        problem = make_problem(
            free, recorded, data.reading_sigma, tuple(rows), count, chosen, lambda _: data
        )
    else:
        problem = make_exact_problem(
            free, data.readings[None], tuple(rows), count, chosen, lambda _: data
        )
    problem = replace(problem, control=effort.control)
    return Comparison(data, problem, _linearize(problem, data, effort, start), effort)


def exclude_far_rows(comparison: Comparison) -> Comparison:
    """Compare without the rows of each interpretation that are far off its others; the same
    comparison where there are none, or where a misfit is not finite.
    """
    linearization, problem, data = comparison.linearization, comparison.problem, comparison.data
    if linearization is None or not np.isfinite(comparison.misfits).all():
        return comparison
    # standard deviations (r, m) of whitened residuals by tolerances and noise; by noise alone for
    # estimated poses, whose rows depend on each other
    expected = [np.ones(rows.whitener.shape[1:3]) for rows in problem.rows]
    first, p = np.arange(1), problem.parameters
    if not problem.is_uncertain:
        for rows_of_block in problem.take(first).leverage_rows(linearization.take(first)):
            for rows in rows_of_block:
                A = rows.rows[..., -p - 1 : -1]
                chosen = rows.numbers[:, None], rows.columns
                expected[rows.kind][chosen] = np.sqrt(1.0 + (A**2).sum(axis=-1))
    ratios = []
    for r, sd in zip(comparison.residuals(), expected, strict=True):
        # root mean square (t, r) of the present residuals; NaN for absent rows
        present = (r.whitened != 0.0).sum(axis=-1)
        total = ((r.whitened / sd) ** 2).sum(axis=-1)
        ratios.append(np.sqrt(np.where(present > 0, total / np.maximum(present, 1), np.nan)))
    if problem.is_uncertain:
        ratios[-1][:] = np.nan  # readings are no rows of their own: they locate the pose
    together = np.concatenate(ratios, axis=1)
    if np.isnan(together).all():
        return comparison
    limit = FAR * compute_known_median(together, axis=1)
    if np.any(together > limit[:, None]):
        limit = np.maximum(limit, np.nanquantile(together, 1.0 - MOST_EXCLUDED, axis=1))
    if not np.any(together > limit[:, None]):
        return comparison
    kept_rows, excluded, effort = [], [], comparison.effort
    for rows, ratio in zip(problem.rows, ratios, strict=True):
        kept = ~(ratio > limit[:, None])
        far = rows.poses.reshape(len(kept[0]), -1)[~kept[0]]
        excluded += ["/".join(data.labels[i] for i in poses) for poses in far]
        whitener = rows.take_trials(problem.trials)[1] * kept[..., None, None]
        kept_rows.append(replace(rows, whitener=whitener))
    problem = problem.with_rows(kept_rows)
    start = None if linearization.nuisance is None else linearization.nuisance.values
    if len(problem) == 1 and effort == THOROUGH:
        start = None  # far rows may have spoilt the guess
    return Comparison(
        data, problem, _linearize(problem, data, effort, start), effort, tuple(excluded)
    )


def compute_misfits(
    free: FreeParameters,
    data: Measurements,
    interpretations: Sequence[Interpretation],
    effort: Effort,
) -> FloatArray:
    """Return the misfits (t,) of interpretations of the values without far rows."""
    if not interpretations:
        return np.zeros(0)
    together = compare_with_robot(free, data, interpretations, effort)
    if together.linearization is None and len(interpretations) > 1:  # one cannot be evaluated
        middle = len(interpretations) // 2
        halves = (interpretations[:middle], interpretations[middle:])
        return np.concatenate([compute_misfits(free, data, half, effort) for half in halves])
    return exclude_far_rows(together).misfits


def compute_quick_misfit(free: FreeParameters, data: Measurements) -> float:
    """Return an upper bound of the misfit of measurements as written, in one step of a fit from the
    nominal values of unknown frames; infinite where a pose is out of reach, NaN with too few rows.
    """
    if not find_directly_reachable(free.robot, free.robot.values[None], data.readings[None]).all():
        return np.inf
    problem = problem_of(free, data)
    z = free.deviation(free.robot.values[None])
    with np.errstate(all="ignore"):
        linearization = problem.linearize(z, problem.start(z, seek=False))
        if not np.isfinite(linearization.cost[0]):
            return np.inf
        return float(_compute_misfit(linearization)[0])


def compute_fitted_misfit(robot: Mechanism, data: Measurements) -> float:
    """Return the misfit that a fit of redundant readings leaves, with tolerances as prior; infinite
    where it does not converge, and for other robots. Such readings of a machine far from its file
    lead to no pose to compare.
    """
    if robot.program.sigma is None:
        return np.inf
    try:
        fit = identify(robot, data.fitted)
    except (DataError, EstimationError):
        return np.inf
    if not fit.converged or fit.residual_test.dof <= 0:
        return np.inf
    return float(np.sqrt(fit.residual_test.chi_square / fit.residual_test.dof))


def _linearize(
    problem: Problem, data: Measurements, effort: Effort, start: FloatArray | None
) -> Linearization | None:
    """Linearize at the robot's values, from nuisance parameters `start` (t, U) or from guesses;
    None where the rows do not locate a target, which the fit reports.
    """
    z = np.repeat(problem.free.deviation(problem.free.robot.values[None]), len(problem), axis=0)
    begin = problem.start(z, seek=False)
    try:
        if start is None and problem.nuisance is not None:
            robot, t, observations = problem.free.robot, len(problem), list(data.observations)
            measured = [np.broadcast_to(o.measured, (t, *o.measured.shape)) for o in observations]
            used = [i for i, o in enumerate(observations) if len(o)]
            for i, rows in zip(used, problem.rows, strict=False):  # readings may follow
                measured[i] = np.broadcast_to(rows.measured, measured[i].shape)
                if t == 1:  # absent rows do not count
                    present = np.any(rows.whitener[0] != 0.0, axis=(1, 2))
                    weighted = observations[i].with_weights(present * observations[i].weight)
                    observations[i] = weighted
            start = guess_nuisance_values_batch(
                replace(data, observations=tuple(observations)),
                measured,
                forward_trials(robot, robot.values[None], data.readings[None]).T,
                data.nuisance_parameters,
                most=effort.candidates,
                steps=effort.guess_steps,
            )
        return problem.linearize(z, begin if start is None else begin.with_nuisance(start))
    except DataError:
        return None


def _compute_misfit(linearization: Linearization, cost: FloatArray | None = None) -> FloatArray:
    """Return the root mean square (t,) of a cost over the equations; NaN with too few.

    The default is the smallest |R z + r|^2 + |z|^2 of the factor.
    """
    if cost is None:
        factor = linearization.factor
        t, p = len(factor), factor.shape[-1] - 1
        prior = np.broadcast_to(np.eye(p, p + 1), (t, p, p + 1))
        cost = (engine.fold(factor, prior) if p else factor)[:, -1, -1] ** 2
    rows = linearization.equations
    return np.where(rows >= FEWEST, np.sqrt(cost / np.maximum(rows, 1)), np.nan)


# Factor by which another interpretation must fit better before data are refused: true data of a
# robot far beyond its tolerances fit twice as well in none of them.
BETTER = 5.0


def judge_data(
    free: FreeParameters, data: Measurements, start: FloatArray | None = None
) -> Comparison | None:
    """Compare measurements with the robot without far rows, quickly from a given start; None where
    it reaches too few poses.
    """
    reached = select_reached(free, data)[0]
    if reached is None:
        return None
    effort = THOROUGH if start is None else QUICK
    return exclude_far_rows(compare_with_robot(free, reached, (), effort, start))


def compute_rms_residuals(comparison: Comparison) -> dict[Dimension, float]:
    """Return root mean squares [m or rad] of the first interpretation's residuals by dimension."""
    square: dict[Dimension, list[FloatArray]] = {}
    for s, r in zip(comparison.problem.rows, comparison.residuals(), strict=True):
        present = np.einsum("rmm->rm", s.whitener[0]) != 0.0
        for j, column in enumerate(s.kind.noise_columns):
            square.setdefault(column.dimension, []).append(r.raw[0, present[:, j], j] ** 2)
    joined = {dimension: np.concatenate(squares) for dimension, squares in square.items()}
    return {d: float(np.sqrt(values.mean())) for d, values in joined.items() if len(values)}


def list_rms_residuals(comparison: Comparison) -> tuple[Quantity, ...]:
    """Return these root mean squares in units of the robot's file."""
    to_quantity = comparison.problem.free.robot.to_quantity
    return tuple(to_quantity(size, d) for d, size in compute_rms_residuals(comparison).items())


def guess_frames(
    free: FreeParameters, data: Measurements, readings: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Guess nuisance parameters for sets of readings (h, n, a), the robot as it is: the sets (k,)
    with which the robot reaches enough poses, their nuisance parameters (k, U), and the median (k,)
    of the sizes of whitened residuals. Poses out of reach are taken at home.
    """
    robot, a = free.robot, readings.shape[-1]
    reached = find_directly_reachable(robot, robot.values[None], readings.reshape(1, -1, a))
    reached = reached.reshape(readings.shape[:2])
    near = np.flatnonzero(reached.mean(axis=1) >= 1.0 - MOST_EXCLUDED)
    readings, reached = readings[near], reached[near]
    nuisance, h = data.nuisance_parameters, len(near)
    T = np.broadcast_to(robot.home_state.T.reshape(-1, 4, 4)[0], (*reached.shape, 4, 4)).copy()
    T[reached] = forward_trials(robot, robot.values[None], readings[reached][None]).T[0]
    measured = [np.broadcast_to(o.measured, (h, *o.measured.shape)) for o in data.observations]
    most, steps = QUICK.candidates, QUICK.guess_steps
    start = guess_nuisance_values_batch(data, measured, T, nuisance, most=most, steps=steps)
    sizes = [np.zeros((h, 0))]
    for o, places in zip(data.observations, nuisance.indices, strict=True):
        if len(o) and not o.kind.sensed_joints:
            residual = o.evaluate(T, start[:, places]).residual
            whitened = np.matmul(o.whitener, residual[..., None])[..., 0]
            sizes.append(np.linalg.norm(whitened, axis=-1))
    size = np.concatenate(sizes, axis=1)
    return near, start, np.median(size, axis=1) if size.shape[1] else np.zeros(h)


def is_informative(
    free: FreeParameters, data: Measurements, interpretation: Interpretation, misfit: float
) -> bool:
    """Return whether values that shrink fit far better than controls without information: random
    numbers of any size fit as well at any pose, and zeros in every unit.
    """
    parts = interpretation.parts or (interpretation,)
    if not any(part.details.get("factor", 1.0) < 1.0 for part in parts):
        return True
    changed, rng = interpretation.apply(data), np.random.default_rng(0)
    shuffled = [o.measured[rng.permutation(len(o))] for o in changed.observations]
    pairs = zip(data.observations, changed.observations, strict=True)
    constant = [_make_constant(old.measured, new.measured) for old, new in pairs]
    readings = _make_constant(data.readings, changed.readings)
    for measured, q in ((shuffled, changed.readings), (constant, readings)):
        pairs = zip(changed.observations, measured, strict=True)
        observations = tuple(replace(o, measured=values) for o, values in pairs)
        control = judge_data(free, replace(changed, readings=q, observations=observations))
        if control is not None and control.misfit < BETTER * misfit:
            return False
    return True


def _make_constant(old: FloatArray, new: FloatArray) -> FloatArray:
    """Return a table with the median of its column in place of the values that changed."""
    is_changed = ~np.isclose(old, new, rtol=1e-12, atol=0.0, equal_nan=True)
    return np.where(is_changed, np.nanmedian(new, axis=0), new) if is_changed.any() else new


# Steps by which the stated convention and the best other one are compared finally.
REFINEMENT = 3
LARGEST_STEP = 30.0  # tolerances that a parameter may leave its value in these steps
# Factor by which the deviations of a robot far from nominal may exceed its tolerances, and the
# steps of its fit.
FAR_AWAY, FIT = 30.0, 12


def refine_misfit(comparison: Comparison) -> tuple[float, FloatArray]:
    """Return the misfit of the first interpretation after steps of a fit within the tolerances, or
    to first order where that is smaller, and its nuisance parameters (U,) there.
    """
    if not comparison.is_finite:
        return comparison.misfit, comparison.data.nuisance_parameters.values()
    misfit, end = _fit(comparison, 1.0, REFINEMENT)
    return min(comparison.misfit, misfit), end.nuisance[0]


def explains_after_fit(comparison: Comparison) -> bool:
    """Return whether a robot far from nominal explains the first interpretation: after a fit with
    tolerances `FAR_AWAY` times as large.
    """
    return comparison.is_finite and _fit(comparison, FAR_AWAY, FIT)[0] <= ALLOWED


def _fit(comparison: Comparison, scale: float, steps: int) -> tuple[float, Start]:
    """Return the misfit of the first interpretation after steps of a fit with tolerances `scale`
    times as large, infinite where a parameter leaves them by far, and where the fit ended.
    """
    assert comparison.linearization is not None
    first = np.arange(1)
    problem, at = comparison.problem.take(first), comparison.linearization.take(first)
    centered = CenteredProblem(problem, at.deviation, at.equations)
    control, start = StepControl(steps), at.next_start
    end = descend(centered, np.zeros_like(at.deviation), Ridge(scale**-2), control, start=start)
    if np.abs(end.deviation).max(initial=0.0) > LARGEST_STEP * scale:
        return np.inf, start
    cost = end.cost + ((end.deviation / scale) ** 2).sum(axis=1)
    return float(_compute_misfit(at, cost)[0]), end.start
