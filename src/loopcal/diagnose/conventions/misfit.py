# SPDX-License-Identifier: Apache-2.0
"""Compute the misfit of measurements to a robot that is free within its tolerances.

Interpretations that differ in measured values share poses and sensitivities: they are the trials of
one problem. Every interpretation has its own nuisance parameters (frames, targets, surfaces) and
its own excluded rows. All functions are pure; see docs/theory/convention-check.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from loopcal import engine, measure
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.identification import identify
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.nuisance.elimination import plan_elimination
from loopcal.estimate.observation_rows import ObservationRows, Residuals
from loopcal.estimate.problem import Problem
from loopcal.estimate.problem_construction import make_problem, problem_of
from loopcal.measure import Measurements, NuisanceParameters
from loopcal.mechanism import Mechanism, find_directly_reachable, forward, forward_trials
from loopcal.numerics.gauss_newton import Halving
from loopcal.typing import FloatArray, IntArray

if TYPE_CHECKING:
    from loopcal.diagnose.conventions.interpretations.interpretation import Interpretation

FEWEST = 3
"""Smallest number of equations beyond those of unknown frames that gives a misfit."""

ALLOWED = 4.0
"""Misfit up to which tolerances and noise explain a residual."""

EQUALLY = 1.2
"""Ratio of misfits up to which two interpretations fit equally well; the first in the list is
reported, the others as alternatives.
"""

FAR, MOST_EXCLUDED = 5.0, 0.25
"""Rows this many times the median row away are excluded, up to this share of the rows; the check
for outliers names them. The same share of the poses may be out of reach.
"""

FOLLOWED = 8
"""Number of poses that Newton's method does not reach from home at once, and that are tried along a
path before all others.
"""


class Effort(NamedTuple):
    """Effort for unknown frames: candidates for their start values (None: all), steps of each, and
    the iteration to the best frames. An interpretation that fits needs two or three steps of it.
    """

    candidates: int | None
    guess_steps: int
    control: Halving


QUICK = Effort(2, 8, Halving(3, 2))
"""To compare many interpretations before a few are judged."""

THOROUGH = Effort(None, 30, Halving(8, 6))
"""To judge a few."""


class Reach(NamedTuple):
    """Measurements at the poses that a robot reaches, and the numbers of poses reached and tried.

    All poses are kept where too few are reached.
    """

    data: Measurements
    n_reached: int
    n_tested: int

    @property
    def is_enough(self) -> bool:
        """Whether the robot reaches enough of the poses."""
        return self.n_reached >= (1.0 - MOST_EXCLUDED) * self.n_tested


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measurements in t interpretations of their values, compared with a robot at its values.

    Attributes
    ----------
    data : the measurements, at poses that the robot reaches. problem : of all interpretations.
    linearization : at the robot's values; None where the rows do not locate a target.
    effort : for unknown frames. excluded : labels of the rows of the first interpretation that are
        far off the others, and that the problem does not contain.
    """

    data: Measurements
    problem: Problem
    linearization: Linearization | None
    effort: Effort
    excluded: tuple[str, ...] = ()

    @cached_property
    def misfits(self) -> FloatArray:
        """(t,) to first order in the parameters; NaN with too few rows."""
        linearization = self.linearization
        if linearization is None:
            return np.full(len(self.problem), np.nan)
        return compute_misfit(compute_smallest_cost(linearization.factor), linearization.equations)

    @property
    def misfit(self) -> float:
        """Misfit of the first interpretation."""
        return float(self.misfits[0])

    def residuals(self) -> tuple[Residuals, ...]:
        """Return the residuals of every interpretation at the robot's values."""
        linearization = self.linearization
        assert linearization is not None
        values = None if linearization.nuisance is None else linearization.nuisance.values
        solution = self.problem.solve(linearization.deviation, linearization.next_start, values)
        return self.problem.residuals(linearization.deviation, solution)


def is_redundant(free: FreeParameters) -> bool:
    """Return whether readings contradict each other by their errors, since the robot has more
    actuators than freedoms; the readings of every pose are then rows, too.
    """
    return free.robot.program.sigma is not None


def select_reached(free: FreeParameters, data: Measurements, *, follow: bool = False) -> Reach:
    """Select the poses that the robot reaches with the readings.

    With `follow`, a few poses that are not reached at once are followed along a path before all
    others are, because failures take longest.
    """
    robot, q, n_tested = free.robot, data.readings, len(data.readings)
    reached = find_directly_reachable(robot, robot.values[None], q[None])[0]
    if follow and reached.sum() < (1.0 - MOST_EXCLUDED) * len(q):
        hard = np.flatnonzero(~reached)
        sampled = hard[np.unique(np.linspace(0, len(hard) - 1, FOLLOWED).astype(np.intp))]
        reached[sampled] = forward(robot, q[sampled]).converged
        rest = np.setdiff1d(hard, sampled)
        if len(rest) and reached[sampled].mean() >= 1.0 - MOST_EXCLUDED:
            reached[rest] = forward(robot, q[rest]).converged
        else:
            n_tested -= len(rest)
    reach = Reach(data, int(reached.sum()), n_tested)
    if reached.all() or not reach.is_enough:
        return reach
    return reach._replace(data=data.take(reached))


def compare_with_robot(
    free: FreeParameters,
    data: Measurements,
    interpretations: Sequence[Interpretation] = (),
    effort: Effort = THOROUGH,
    start: FloatArray | None = None,
) -> Comparison:
    """Compare measurements with a robot, all rows included.

    Parameters
    ----------
    data : at poses that the robot reaches. interpretations : of their values; default: as written.
    start : (t, U), optional. Nuisance parameters to start from; default: guessed from the data.
    """
    nuisance, rows, count = data.nuisance_parameters, [], max(len(interpretations), 1)
    for i, o in enumerate(data.observations):
        if not len(o):
            continue
        changes = [
            interpretation.change if interpretation.observation == i else np.array
            for interpretation in interpretations
        ]
        measured = np.stack([change(o.measured) for change in changes or [np.array]])
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
        problem = replace(problem, control=effort.control)
    else:
        problem = Problem(
            free,
            data.readings[None],
            tuple(rows),
            np.arange(count),
            plan_elimination(chosen, rows),
            lambda _: data,
            control=effort.control,
        )
    return Comparison(data, problem, _linearize(problem, data, effort, start), effort)


def exclude_far_rows(comparison: Comparison) -> Comparison:
    """Compare without the rows of each interpretation that are far off its others.

    Return the same comparison where there are none, or where a misfit is not finite.
    """
    linearization, problem, data = comparison.linearization, comparison.problem, comparison.data
    if linearization is None or not np.isfinite(comparison.misfits).all():
        return comparison
    pairs = zip(comparison.residuals(), _expected_sd(problem, linearization), strict=True)
    ratios = [_row_rms(residuals.whitened, sd) for residuals, sd in pairs]
    if problem.is_uncertain:
        ratios[-1][:] = np.nan  # readings are no rows of their own: they locate the pose
    together = np.concatenate(ratios, axis=1)
    if np.isnan(together).all():
        return comparison
    median = np.nanmedian(together, axis=1)
    limit = np.maximum(FAR * median, np.nanquantile(together, 1.0 - MOST_EXCLUDED, axis=1))
    if not np.any(together > limit[:, None]):
        return comparison
    kept_rows, excluded, effort = [], [], comparison.effort
    for rows, ratio in zip(problem.rows, ratios, strict=True):
        kept = ~(ratio > limit[:, None])
        far = rows.poses.reshape(len(kept[0]), -1)[~kept[0]]
        excluded += ["/".join(data.labels[i] for i in poses) for poses in far]
        whitener = rows.take_trials(problem.trials)[1] * kept[..., None, None]
        kept_rows.append(replace(rows, whitener=whitener))
    problem = replace(problem, rows=tuple(kept_rows))
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
    """Return the misfits (t,) of interpretations of the values without far rows, all at once; each
    half by itself where one cannot be evaluated.
    """
    if not interpretations:
        return np.zeros(0)
    together = compare_with_robot(free, data, interpretations, effort)
    if together.linearization is None and len(interpretations) > 1:
        middle = len(interpretations) // 2
        halves = (interpretations[:middle], interpretations[middle:])
        return np.concatenate([compute_misfits(free, data, half, effort) for half in halves])
    return exclude_far_rows(together).misfits


def compute_quick_misfit(free: FreeParameters, data: Measurements) -> float:
    """Return an upper bound of the misfit of measurements as written, in one step of a fit.

    Unknown frames start only from their nominal values. The result is infinite where a pose is out
    of reach, and NaN with too few rows.
    """
    if not find_directly_reachable(free.robot, free.robot.values[None], data.readings[None]).all():
        return np.inf
    problem = problem_of(free, data)
    z = free.deviation(free.robot.values[None])
    with np.errstate(all="ignore"):
        linearization = problem.linearize(z, problem.start(z, seek=False))
        if not np.isfinite(linearization.cost[0]):
            return np.inf
        return float(
            compute_misfit(compute_smallest_cost(linearization.factor), linearization.equations)[0]
        )


def compute_fitted_misfit(robot: Mechanism, data: Measurements) -> float:
    """Return the misfit that a fit of redundant readings leaves, with tolerances as prior.

    Redundant readings of a machine far from its file lead to no pose, so that nothing can be
    compared there. The result is infinite where the fit does not converge, and for other robots.
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
    return None where the rows do not locate a target, which the fit words.
    """
    z = np.repeat(problem.free.deviation(problem.free.robot.values[None]), len(problem), axis=0)
    begin = problem.start(z, seek=False)
    try:
        if start is None and problem.nuisance is not None:
            start = _guess_start(problem, data, effort)
        return problem.linearize(z, begin if start is None else begin.with_nuisance(start))
    except DataError:
        return None


def _guess_start(problem: Problem, data: Measurements, effort: Effort) -> FloatArray:
    """Guess nuisance parameters (t, U) for every interpretation; absent rows do not count where
    there is one interpretation.
    """
    robot, t, observations = problem.free.robot, len(problem), list(data.observations)
    measured = [np.broadcast_to(o.measured, (t, *o.measured.shape)) for o in observations]
    used = [i for i, o in enumerate(observations) if len(o)]
    for i, rows in zip(used, problem.rows, strict=False):  # readings may follow
        measured[i] = np.broadcast_to(rows.measured, measured[i].shape)
        if t == 1:
            present = np.any(rows.whitener[0] != 0.0, axis=(1, 2))
            observations[i] = observations[i].with_weights(present * observations[i].weight)
    return measure.guess_nuisance_values_batch(
        replace(data, observations=tuple(observations)),
        measured,
        forward_trials(robot, robot.values[None], data.readings[None]).T,
        data.nuisance_parameters,
        most=effort.candidates,
        steps=effort.guess_steps,
    )


def _expected_sd(problem: Problem, linearization: Linearization) -> list[FloatArray]:
    """Return the standard deviations (r, m) [1] of whitened residuals by tolerances and noise; by
    noise alone for estimated poses, whose rows depend on each other.
    """
    result = [np.ones(rows.whitener.shape[1:3]) for rows in problem.rows]
    if problem.is_uncertain:
        return result
    first, p = np.arange(1), problem.parameters
    blocks = problem.take(first).leverage_rows(linearization.take(first))
    for block, rows_of_block in zip(problem.poses.blocks, blocks, strict=True):
        for rows in rows_of_block:
            A = rows.rows[..., -p - 1 : -1]
            chosen = block.row_numbers[rows.kind][rows.numbers]
            result[rows.kind][chosen] = np.sqrt(1.0 + (A**2).sum(axis=-1))
    return result


def compute_smallest_cost(factor: FloatArray) -> FloatArray:
    """Return the smallest |R z + r|^2 + |z|^2 (t,) of factors (t, p + 1, p + 1)."""
    t, p = len(factor), factor.shape[-1] - 1
    prior = np.broadcast_to(np.eye(p, p + 1), (t, p, p + 1))
    return engine.fold(factor, prior)[:, -1, -1] ** 2 if p else factor[:, -1, -1] ** 2


def compute_misfit(cost: FloatArray, rows: IntArray) -> FloatArray:
    """Return the root mean square (t,) over the equations; NaN with too few."""
    return np.where(rows >= FEWEST, np.sqrt(cost / np.maximum(rows, 1)), np.nan)


def _row_rms(whitened: FloatArray, sd: FloatArray) -> FloatArray:
    """Return the root mean square (t, r) of the present residuals (t, r, m) over their sd (r, m);
    NaN for absent rows.
    """
    count = (whitened != 0.0).sum(axis=-1)
    total = ((whitened / sd) ** 2).sum(axis=-1)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))
