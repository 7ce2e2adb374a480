# SPDX-License-Identifier: Apache-2.0
"""Identify the free parameters of many simulated machines at once.

Trials are fitted in parts of limited size, so that what a part computes with fits the cache and
memory holds little more than the results, however many trials there are. Parts are independent of
each other: threads compute them in any order, with the same numbers to the last bit.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from numbers import Integral
from typing import NamedTuple

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.fit_descent import descend_once, get_method, repeat_trials
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.identified_trials import IdentifiedTrials
from loopcal.estimate.methods.penalties import Method, adapt_method
from loopcal.estimate.minimization.chord_start import (
    ACCEPTED_STEP,
    SharedFactor,
    share_factor,
    take_chords,
)
from loopcal.estimate.minimization.descent import Descent, descend
from loopcal.estimate.minimization.linear_model import LinearModel
from loopcal.estimate.options import FitOptions, merge_options
from loopcal.estimate.problem import Problem
from loopcal.estimate.problem_construction import problem_of_trials
from loopcal.measure import Trials
from loopcal.measure.array_checks import check_type
from loopcal.mechanism import Mechanism
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.typing import FloatArray, IntArray


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
    check_type(robot, Mechanism, "robot", "as from load_robot('hexapod-42')")
    check_type(trials, Trials, "trials", "as from simulate_trials(...)")
    check_threads(threads)
    if not len(trials):
        raise EstimationError("there are no trials; simulate at least one machine")
    options = merge_options(options, method)
    for name in ("loss", "prior", "nuisance", "excluded_poses"):
        value = getattr(options, name)
        if value is not None and value != ():
            raise EstimationError(
                f"identify_trials does not support the option {name}; remove it, or call identify "
                "for every trial"
            )
    free = select_free_parameters(robot)
    problem = problem_of_trials(free, trials)
    values = np.atleast_2d(robot.values if options.start is None else np.asarray(options.start))
    z = np.broadcast_to(free.deviation(values), (len(trials), len(free)))
    method = adapt_method(options.method, free.assumed, options.noise, free.correlation)
    options = replace(options, method=method)
    shared = None
    if chord_start and options.begin == "kinematics" and len(values) == 1:
        shared = share_factor(problem, z[:1], method, options.rank_tolerance)
    fits = _fit_parts(problem, z, options, free, threads, shared)
    return IdentifiedTrials(
        free.values(np.concatenate([fit.deviation for fit in fits])),
        np.concatenate([fit.status for fit in fits]),
        np.concatenate([fit.iterations for fit in fits]),
        np.concatenate([fit.cost for fit in fits]),
        free,
        tuple(fit.linear_model for fit in fits),
        method,
    )


def check_threads(threads: int) -> None:
    """Raise EstimationError unless `threads` is a whole number of at least 1."""
    check_type(threads, Integral, "threads", "a whole number, 1 or more")
    if threads < 1:
        raise EstimationError(f"threads is {threads}; give 1 or more")


class _Part(NamedTuple):
    """What is kept of the fits of a part, see `Descent`."""

    deviation: FloatArray
    status: IntArray
    iterations: IntArray
    cost: FloatArray
    linear_model: LinearModel


def _fit_parts(
    problem: Problem,
    z: FloatArray,
    options: FitOptions,
    free: FreeParameters,
    threads: int,
    shared: SharedFactor | None,
) -> list[_Part]:
    """Return the fits of all parts of the trials, which begin at deviations z (t, p), with chords
    where a factor is shared.
    """
    # all trials begin with the nuisance parameters of the first one that reaches its poses
    start = None if problem.nuisance is None else problem.start(z)

    def fit(part: IntArray) -> _Part:
        own, begin = _cut_problem(problem, part), None if start is None else start.take(part)
        if shared is None:
            first = descend_once(own, z[part], begin, options)
        else:
            first = _descend_from_chords(own, z[part], options, shared)
        fit = repeat_trials(own, first, options, free)
        return _Part(fit.deviation, fit.status, fit.iterations, fit.cost, fit.linear_model)

    batches = divide_trials(problem, threads)
    if threads == 1 or len(batches) == 1:
        return [fit(batch) for batch in batches]
    with ThreadPoolExecutor(min(threads, len(batches))) as pool:
        return list(pool.map(fit, batches))


def _descend_from_chords(
    problem: Problem, z: FloatArray, options: FitOptions, shared: SharedFactor
) -> Descent:
    """Return the descents that begin with chords; without them in trials that do not converge."""
    begin, method = take_chords(problem, shared, z), get_method(options)
    fit = descend(
        problem,
        begin.deviation,
        method,
        options.control,
        options.rank_tolerance,
        begin.start,
        arrival=begin.length,
        sufficient=ACCEPTED_STEP,
    )
    fit = replace(fit, iterations=fit.iterations + np.isfinite(begin.length))
    again = np.flatnonzero(fit.status != DescentStatus.CONVERGED)
    if not again.size:
        return fit
    usual = descend_once(problem.take(again), z[again], None, options)
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


def _cut_problem(problem: Problem, trials: IntArray) -> Problem:
    """Return the problem of some trials, where rows are plain with arrays of their own.

    The measured columns are then prepared once for all steps of a fit.
    """
    if not problem.folds_plain_rows:
        return problem.take(trials)
    numbers, data, own = problem.trials[trials], problem.data, np.arange(len(trials))
    rows = tuple(r.cut_trials(numbers) for r in problem.rows)
    return replace(problem, rows=rows, trials=own, data=lambda i: data(int(numbers[i])))
