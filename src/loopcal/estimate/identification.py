# SPDX-License-Identifier: Apache-2.0
"""Identify the free parameters of a robot from measurements, with all diagnostics, and those of
many simulated machines at once.

Trials are fitted in parts of limited size, so that what a part computes with fits the cache and
memory holds little more than the results, however many trials there are. Parts are independent of
each other: threads compute them in any order, with the same numbers to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Integral
from typing import Any, ClassVar, NoReturn

import numpy as np

from loopcal.errors import DataError, EstimationError, suggest_names
from loopcal.estimate import information
from loopcal.estimate.descent import Descent, LinearModel, descend
from loopcal.estimate.determinable_setup import fix_undetermined_setup
from loopcal.estimate.fit_analysis import ASSUMED, FitAnalysis
from loopcal.estimate.fit_descent import fit_rows, fit_with_tolerances, get_method, repeat_trials
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.linearization import PoseSolution, Start, linearize_rows
from loopcal.estimate.losses import Loss
from loopcal.estimate.options import FitOptions, merge_options
from loopcal.estimate.penalties import MAP, LeastSquares, Method, adapt_method, fix_penalty
from loopcal.estimate.pose_estimate import find_unclosed_poses, refuse_unreached
from loopcal.estimate.posterior import Posterior, VarianceSources, compute_posterior
from loopcal.estimate.prior import refuse_reused_rows
from loopcal.estimate.problem import Problem, problem_of, problem_of_trials
from loopcal.estimate.residual_test import FEWEST_DEGREES
from loopcal.estimate.result import Identification
from loopcal.measure.array_checks import check_type
from loopcal.measure.data_checks import check_actuators
from loopcal.measure.measurements import Measurements
from loopcal.measure.readings import fill_in_reading_sigma, weight_reading_sigma
from loopcal.measure.simulation import Trials
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import Decomposition, solve_regular
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.results.description import Field, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

HUGE = 1e150  # residuals, in units of sigma, whose squares cannot be summed


def prepare_fitted_data(fit: Identification, data: Measurements) -> Measurements:
    """Return the measurements of a fit as it used them: with the sigma of their readings, without
    excluded poses. Raises DataError unless they have as many poses as the fit was made from.
    """
    if data.n_poses != len(fit.pose_weights):
        raise DataError(
            f"the data have {data.n_poses} poses, but the fit has "
            f"{len(fit.pose_weights)}. Give the measurements of the fit, without held-out "
            "poses"
        )
    return exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)


def exclude_poses(data: Measurements, excluded: Sequence[str]) -> Measurements:
    """Return the measurements with weight 0 for every row and reading of poses of these labels;
    they keep their places. Raises DataError for an unknown label.
    """
    if not excluded:
        return data
    known, unwanted = set(data.labels), set(excluded)
    for label in excluded:
        if label not in known:
            raise DataError(
                f"no pose {label!r} to exclude{suggest_names(label, data.labels)}. Give labels of "
                "poses in the data"
            )
    kept = np.array([label not in unwanted for label in data.labels])
    observations = tuple(
        o.with_weights(o.weight * kept[o.rows].reshape(len(o), o.kind.poses_per_row).all(axis=1))
        for o in data.observations
    )
    return replace(
        data,
        observations=observations,
        reading_sigma=weight_reading_sigma(data.reading_sigma, kept.astype(np.float64)),
    )


def check_rows(problem: Problem, data: Measurements, robot: Mechanism) -> None:
    """Refuse readings of another robot, held-out poses, no free parameters, and no rows."""
    check_actuators(data, robot)
    if count := int(data.is_held_out.sum()):
        raise DataError.of("data.held-out-fitted", count=count)
    if problem.parameters == 0:
        raise EstimationError.of(
            "fit.no-free-parameter", robot=robot.name, total=len(robot.parameters)
        )
    if problem.residual_count[0] == 0:
        raise EstimationError.of("fit.no-measured-value")


def check_count(problem: Problem, data: Measurements, options: FitOptions, z: FloatArray) -> None:
    """Refuse equations of which each is needed and that leave parameters without a prior open: more
    of them would determine more. With equations to spare the rank decides what is determined.
    """
    method = get_method(options)
    nuisance = 0 if problem.nuisance is None else problem.nuisance.unpenalized_count
    required = method.required_equations(problem.parameters)
    m, p = int(problem.equations[0]), required + nuisance
    if m >= p or options.allow_fewer_equations or options.prior is not None:
        return
    if m == 0:
        raise EstimationError.of("fit.no-equation-left", poses=data.n_poses, unknowns=p)
    if information.has_equations_to_spare(problem, z, method, options.rank_tolerance):
        return
    raise EstimationError.of(
        "fit.too-few-equations",
        equations=m,
        poses=data.n_poses,
        unknowns=p,
        nuisance=nuisance,
        has_prior=required != problem.parameters,
        poses_needed=int(np.ceil(p * data.n_poses / m)),
    )


def refuse_start(problem: Problem, data: Measurements, deviation: FloatArray) -> NoReturn:
    """Refuse a start at which some residuals are not finite, with the poses."""
    start = problem.start(deviation)
    refuse_unreached(data, problem.poses.find_unreached(deviation, start))
    with np.errstate(all="ignore"):
        residuals = problem.residuals(deviation, problem.solve(deviation, start))
    bad = {
        int(i)
        for s, r in zip(problem.rows, residuals, strict=True)
        for i in s.poses_by_link[~(np.abs(r.whitened[0]) < HUGE).all(axis=1)].ravel()
    }
    raise EstimationError.of(
        "fit.residuals-not-finite", poses=tuple(data.labels[i] for i in sorted(bad))
    )


def identify(
    robot: Mechanism,
    data: Measurements,
    method: Method | None = None,
    *,
    loss: Loss | None = None,
    options: FitOptions | None = None,
    progress: Progress = report_no_progress,
) -> Identification:
    """Identify the free parameters of a robot; see `loopcal.estimate.penalties`.

    Parameters
    ----------
    robot : its values are the start; its table states what is nominal, free and tolerated.
    data : the measurements. Where a reading has a sigma, given or stated by the robot, its pose is
        estimated as well (docs/theory/identification.md).
    method, loss : in place of those of `options`.
    options : see `FitOptions`. By default stated spreads are a prior, which is inflated where
        the data contradict it.
    progress : receives the steps of the iteration, with the sum of squares.

    Returns
    -------
    Identification; an iteration that did not converge is no error: see `status` and `findings`.

    Raises
    ------
    EstimationError : nothing to identify, fewer equations than parameters, poses out of reach at
        the start, or redundant readings that contradict each other so widely that the fit does not
        converge.
    """
    options = merge_options(options, method, loss)
    free = select_free_parameters(robot)
    default = LeastSquares() if options.prior is not None else None
    data = exclude_poses(fill_in_reading_sigma(robot, data), options.excluded_poses)
    data = data if options.nuisance is not None else fix_undetermined_setup(robot, data)
    problem = problem_of(free, data, options.nuisance)
    check_rows(problem, data, robot)
    refuse_reused_rows(options.prior, data)
    unknowns = len(free) + (0 if problem.nuisance is None else problem.nuisance.unpenalized_count)
    is_free = options.noise == "given" and options.prior is None and data.noise_source == ASSUMED
    if is_free and int(problem.equations[0]) - unknowns >= FEWEST_DEGREES:
        options = replace(options, noise="estimated")
    method = adapt_method(
        options.method or default, free.names, free.assumed, options.noise, free.correlation
    )
    options = replace(options, method=method)
    values = robot.values if options.start is None else np.asarray(options.start)
    z = free.deviation(robot.with_values(values).values[None])
    check_count(problem, data, options, z)
    fit, weights, weighted, options = fit_with_tolerances(problem, data, z, options, free, progress)
    if fit.status[0] == DescentStatus.BAD_START.value:
        refuse_start(problem, data, z)
    else:  # the rank of a symmetric machine may be larger there than at its nominal values
        check_count(problem, data, options, fit.deviation)
    unclosed = find_unclosed_poses(robot.with_values(values), data)
    if fit.status[0] != DescentStatus.CONVERGED.value and unclosed.are_most:
        raise EstimationError(unclosed.report("fit.poses-open"))
    analysis = FitAnalysis(robot, free, options, data, problem, weights, weighted, fit, unclosed)
    return analysis.identification()


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiedTrials(TableResult):
    """t machines identified at once; arrays are (t, ...), SI.

    Attributes
    ----------
    values : (t, p of the robot). status : (t,) DescentStatus. iterations : (t,).
    cost : (t,) whitened sum of squares. free_parameters : names, nominal values and spreads.
    linear_models : of the last rows of consecutive trials. method : with what `adapt_method`
        entered.
    """

    values: FloatArray
    status: IntArray
    iterations: IntArray
    cost: FloatArray
    free_parameters: FreeParameters
    linear_models: tuple[LinearModel, ...]
    method: Method

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("converged", axes="trial"),
        Field("iterations", axes="trial", unit="1"),
        Field("sum_of_squares", "cost", "trial", "1"),
        Field(
            "estimate",
            lambda trials: trials.values[:, trials.free_parameters.places],
            "trial parameter",
            units="free_parameters.dimensions",
        ),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="free_parameters.names")

    @cached_property
    def decomposition(self) -> Decomposition:
        """The decompositions of the rows: variances and leverages are read from them."""
        decompositions = [model.decomposition for model in self.linear_models]
        if any(part.dual is not None for part in decompositions):
            decompositions = [part.with_dual() for part in decompositions]
        return Decomposition.join(decompositions)

    @cached_property
    def penalty(self) -> FloatArray:
        """(t, p free) of the directions of the decompositions."""
        return np.concatenate([model.penalty for model in self.linear_models])

    @cached_property
    def prior_variance(self) -> FloatArray | None:
        """(t, p free) see `Method.prior_variance`."""
        return self.method.prior_variance(self.decomposition, self.penalty, self.free_parameters)

    @property
    def converged(self) -> BoolArray:
        """(t,) which trials converged."""
        return self.status == DescentStatus.CONVERGED

    def standard_deviations(self, noise_variance: FloatArray | float = 1.0) -> FloatArray:
        """Return standard deviations (t, p free) [SI]; infinite where the data do not determine a
        parameter. They do not contain the uncertainty of factors on the spreads.
        """
        scaled = self.decomposition.standard_deviations(
            self.penalty, noise_variance, self.prior_variance
        )
        return scaled * self.free_parameters.tolerance


# A trial that began with a chord has converged where all further steps together would change the
# whitened residuals by less than this: no estimate then moves by more than this share of its
# standard deviation.
ACCEPTED_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class SharedFactor:
    """The factor of the rows of one trial at the start of all.

    solution : of this trial at the start. start : there, for the linearizations nearby.
    triangle : (p, p) R. by_residuals : (p, m) R^-1 Q' of the rows. by_deviation : (p, p) R^-1 Q' P.
    """

    solution: PoseSolution
    start: Start
    triangle: FloatArray
    by_residuals: FloatArray
    by_deviation: FloatArray


def share_factor(
    problem: Problem, deviation: FloatArray, method: Method, tolerance: float
) -> SharedFactor | None:
    """Return the factor of the first trial at deviation (1, p).

    None where chords cannot be used: poses or nuisance parameters are eliminated from the rows, the
    penalty depends on them, or a direction might not count.
    """
    poses, p = problem.poses, problem.parameters
    if isinstance(method, MAP) and callable(method.inflation):
        method = replace(method, inflation=1.0)  # which only chooses where the exact descent begins
    fixed = fix_penalty(method, p)
    is_plain = problem.nuisance is None and problem.consistent is None
    if fixed is None or not (is_plain and poses.coordinates.are_shared and poses.is_kept):
        return None
    first = problem.take(np.array([0]))
    begin = first.start(deviation)
    solution = first.poses.solve(deviation, first.trials, begin, first.control)
    assert solution.linearized is not None
    if solution.linearized.is_lost(poses.blocks[0].is_needed).any():
        return None
    kinds = [
        linearize_rows(rows, solution.linearized, first.trials, None)
        for rows in poses.blocks[0].rows
    ]
    A = np.concatenate([kind.by_parameters.reshape(-1, p) for kind in kinds])
    q, r = np.linalg.qr(np.concatenate([A, fixed]))
    if len(r) < p:  # fewer rows than parameters
        return None
    _, is_regular = solve_regular(r[None], np.zeros((1, p)), tolerance)
    if not is_regular[0]:
        return None
    inverse = np.linalg.solve(r, q.T)
    states, is_near = poses.next_start(solution, begin)
    start = replace(begin, deviation=deviation, poses=states, is_near=is_near)
    by_residuals = np.ascontiguousarray(inverse[:, : len(A)])
    return SharedFactor(solution, start, np.array(r), by_residuals, inverse[:, len(A) :] @ fixed)


def identify_trials(
    robot: Mechanism,
    trials: Trials,
    method: Method | None = None,
    *,
    options: FitOptions | None = None,
    threads: int = 1,
    chord_start: bool = False,
) -> IdentifiedTrials:
    """Identify t simulated machines at once.

    Each trial equals its own `identify`, and no trial stops another.

    Parameters
    ----------
    robot : as for `identify`. trials : their measurements.
    method : in place of that of `options`.
    options : see `FitOptions`; `start` may be (t, p of the robot). A loss, a prior, excluded poses
        and nuisance parameters are not supported.
    threads : that compute, 1 or more; results do not depend on it. Let linear algebra have one
        thread for each of them (OPENBLAS_NUM_THREADS=1).
    chord_start : whether the first step of all trials uses one factor, and a trial has converged
        where further steps would move no estimate by more than 1e-3 standard deviations. For
        studies: it takes about half of the time. Trials equal their own `identify` within 1e-3
        standard deviations. It has no effect where poses or setup parameters are estimated, where
        trials begin at different values, or with `begin="closure"`.

    Raises
    ------
    EstimationError : an option that is not supported, or no thread.
    """
    check_threads(threads)
    if not len(trials):
        raise EstimationError("the set of trials is empty. Simulate at least one machine")
    options = merge_options(options, method)
    for name in ("loss", "prior", "nuisance", "excluded_poses"):
        value = getattr(options, name)
        if value is not None and value != ():
            raise EstimationError(
                f"identify_trials does not support the option {name}. Remove it, or call identify "
                "for every trial"
            )
    free = select_free_parameters(robot)
    setup = fix_undetermined_setup(robot, trials.trial(0)).nuisance_parameters
    problem = problem_of_trials(free, trials, setup)
    values = np.atleast_2d(robot.values if options.start is None else np.asarray(options.start))
    z = np.broadcast_to(free.deviation(values), (len(trials), len(free)))
    method = adapt_method(options.method, free.names, free.assumed, options.noise, free.correlation)
    options = replace(options, method=method)
    shared = None
    if chord_start and options.begin == "kinematics" and len(values) == 1:
        shared = share_factor(problem, z[:1], method, options.rank_tolerance)
    fits = _fit_parts(problem, z, options, free, threads, shared)
    *arrays, models = zip(*fits, strict=True)
    deviation, status, iterations, cost = map(np.concatenate, arrays)
    return IdentifiedTrials(
        free.values(deviation), status, iterations, cost, free, tuple(models), method
    )


def check_threads(threads: int) -> None:
    """Raise EstimationError unless `threads` is a whole number of at least 1."""
    check_type(threads, Integral, "threads", "a whole number, 1 or more")
    if threads < 1:
        raise EstimationError(f"threads is {threads}. Give 1 or more")


def _fit_parts(
    problem: Problem,
    z: FloatArray,
    options: FitOptions,
    free: FreeParameters,
    threads: int,
    shared: SharedFactor | None,
) -> list[tuple[FloatArray, IntArray, IntArray, FloatArray, LinearModel]]:
    """Return deviation, status, iterations, cost and linear model (see `Descent`) of all parts of
    the trials, which begin at deviations z (t, p), with chords where a factor is shared.
    """
    # all trials begin with the nuisance parameters of the first one that reaches its poses
    start = None if problem.nuisance is None else problem.start(z)

    def fit(part: IntArray) -> tuple[FloatArray, IntArray, IntArray, FloatArray, LinearModel]:
        begin = None if start is None else start.take(part)
        own, of_parts = problem.take(part), np.arange(len(part))
        if problem.folds_plain_rows:  # measured columns are prepared once for all steps of a fit
            numbers, data = problem.trials[part], problem.data
            cut = problem.with_rows(r.cut_trials(numbers) for r in problem.rows)
            own = replace(cut, trials=of_parts, data=lambda i: data(int(numbers[i])))
        if shared is None:
            first = fit_rows(own, z[part], begin, options)
        else:
            first = _descend_from_chords(own, z[part], options, shared)
        fit = repeat_trials(own, first, options, free)
        return (fit.deviation, fit.status, fit.iterations, fit.cost, fit.linear_model)

    batches = divide_trials(problem, threads)
    if threads == 1 or len(batches) == 1:
        return [fit(batch) for batch in batches]
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(min(threads, len(batches))) as pool:
        return list(pool.map(fit, batches))


def _descend_from_chords(
    problem: Problem, z: FloatArray, options: FitOptions, shared: SharedFactor
) -> Descent:
    """Return the descents that begin with chords from deviations z (t, p), which are equal in all
    trials; without them in trials that do not converge.
    """
    t = len(z)
    kinds = problem.residuals(z, shared.solution)
    residual = np.concatenate([kind.whitened.reshape(t, -1) for kind in kinds], axis=1)
    # one product for each trial: a product of all of them would round by their number
    with np.errstate(over="ignore", invalid="ignore"):  # of residuals that are huge or infinite
        step = np.matmul(shared.by_residuals, residual[:, :, None])
        step = -(step + np.matmul(shared.by_deviation, z[:, :, None]))[:, :, 0]
        # by how much a chord changes the whitened residuals, to first order
        length = np.linalg.norm(np.matmul(shared.triangle, step[:, :, None])[:, :, 0], axis=1)
    good = np.isfinite(length)
    fit = descend(
        problem,
        np.where(good[:, None], z + step, z),
        get_method(options),
        options.control,
        options.rank_tolerance,
        shared.start.take(np.zeros(t, dtype=np.int64)),
        arrival=np.where(good, length, np.inf),
        sufficient=ACCEPTED_STEP,
    )
    fit = replace(fit, iterations=fit.iterations + good)
    again = np.flatnonzero(fit.status != DescentStatus.CONVERGED)
    if not again.size:
        return fit
    usual = fit_rows(problem.take(again), z[again], None, options)
    return usual if len(again) == len(z) else fit.put(again, usual)


def divide_trials(problem: Problem, threads: int) -> list[IntArray]:
    """Return the numbers of the trials of each part: equal parts, and equally many for each thread
    unless they were too small.
    """
    least = -(-len(problem) // problem.part_size)
    count = -(-least // threads) * threads
    if 2 * count > 3 * least:  # a part takes milliseconds of Python, which runs in one thread
        count = least
    return np.array_split(np.arange(len(problem)), count)


def compute_trial_posterior(fits: IdentifiedTrials, trials: Trials, trial: int) -> Posterior:
    """Return the posterior of a trial, as its own `identify` gives it for stated noise.

    fits : of `identify_trials`. trials : their measurements. trial : number of the machine.
    """
    free, chosen = fits.free_parameters, np.array([trial])
    data = trials.trial(trial)
    problem = problem_of(free, data)
    z = free.deviation(fits.values[chosen])
    start = problem.start(z)
    linearization = problem.linearize(z, start)
    found = information.find_unfixed_motions(problem, z, linearization.next_start)
    frames = information.describe_frames(problem, data, found, linearization=linearization)
    prior = fits.prior_variance
    return compute_posterior(
        free.robot.with_values(fits.values[trial]),
        free.places,
        free.tolerance,
        fits.decomposition.take(chosen),
        fits.penalty[chosen],
        VarianceSources(1.0, None if prior is None else prior[chosen]),
        frames,
    )
