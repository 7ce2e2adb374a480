# SPDX-License-Identifier: Apache-2.0
"""The descents of one fit: with or without a loss, from the closure or the kinematics, and again
where the data ask for other tolerances than those of the prior.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import Start
from loopcal.estimate.methods.penalties import Method
from loopcal.estimate.minimization.descent import Descent, descend
from loopcal.estimate.minimization.part_start import descend_in_parts
from loopcal.estimate.minimization.robust_descent import Run, descend_robustly
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.estimate.options import FitOptions
from loopcal.estimate.prior_inflation import ROUNDS, choose_methods
from loopcal.estimate.problem import Problem
from loopcal.measure import Measurements
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.typing import FloatArray, Progress, report_no_progress


def descend_once(
    problem: Problem,
    z: FloatArray,
    start: Start | None,
    options: FitOptions,
    progress: Progress = report_no_progress,
) -> Descent:
    """Descend from deviations z (t, p); the history includes steps of the linearized closure.

    `progress` receives the steps.
    """
    method, control, tolerance = get_method(options), options.control, options.rank_tolerance
    with_prior = problem if options.prior is None else options.prior.added(problem)
    if options.begin == "kinematics":
        return descend(with_prior, z, method, control, tolerance, start, progress)
    from loopcal.estimate.minimization.closure_start import descend_from_closure

    z, first = descend_from_closure(problem, z, method, control, tolerance)
    fit = descend(with_prior, z, method, control, tolerance, start, progress)
    if first is None:
        return fit
    is_exhausted = bool((first.status == DescentStatus.OUT_OF_ITERATIONS.value).any())
    return replace(fit.after(first), is_start_exhausted=is_exhausted)


def descend_weighted(
    problem: Problem,
    data: Measurements,
    z: FloatArray,
    options: FitOptions,
    progress: Progress = report_no_progress,
) -> tuple[Descent, FloatArray, Problem]:
    """Descend with or without a loss; return also the weight (n,) of each pose and the problem with
    these weights.
    """
    run: Run = partial(descend_once, options=options, progress=progress)
    if options.loss is None:
        return run(problem, z, None), np.ones(data.n_poses), problem
    estimated, blocks = options.noise == "estimated", linked_blocks(data)
    robust = descend_robustly(problem, blocks, options.loss, z, estimated, run, options.prior)
    return robust.fit, robust.weight, robust.problem


def _descend_from_part(
    problem: Problem, z: FloatArray, options: FitOptions, progress: Progress
) -> Descent | None:
    """Descend first with a part of very many poses; None where this is of no use or not possible.

    A loss needs all poses to tell which of them are far off, and the rows of an earlier calibration
    would outweigh a part.
    """
    if options.begin != "kinematics" or options.loss is not None or options.prior is not None:
        return None
    control, tolerance = options.control, options.rank_tolerance
    return descend_in_parts(problem, z, get_method(options), control, tolerance, progress)


def descend_to_prior(
    problem: Problem,
    data: Measurements,
    z: FloatArray,
    options: FitOptions,
    free: FreeParameters,
    progress: Progress = report_no_progress,
) -> tuple[Descent, FloatArray, Problem, FitOptions]:
    """Descend, and again as long as the data ask for other components of the tolerances; return
    also the options with these.
    """
    first = _descend_from_part(problem, z, options, progress)
    if first is None:
        fit, weights, weighted = descend_weighted(problem, data, z, options, progress)
    else:
        fit, weights, weighted = first, np.ones(data.n_poses), problem
    for _ in range(ROUNDS):
        method = choose_methods(free, fit, get_method(options)).get(0)
        if method is None:
            break
        other = replace(options, method=method)
        again, new_weights, new_problem = descend_weighted(
            problem, data, fit.deviation, other, progress
        )
        if again.status[0] != DescentStatus.CONVERGED.value:
            break
        fit, weights, weighted, options = again.after(fit), new_weights, new_problem, other
    return fit, weights, weighted, options


def repeat_trials(
    problem: Problem, fit: Descent, options: FitOptions, free: FreeParameters
) -> Descent:
    """Descend again in trials whose data ask for components of the tolerances."""
    for i, method in choose_methods(free, fit, get_method(options)).items():
        alone, chosen = np.array([i]), replace(options, method=method)
        own = problem.take(alone)
        again = descend_once(own, fit.deviation[alone], None, chosen)
        for _ in range(ROUNDS - 1):
            other = choose_methods(free, again, get_method(chosen)).get(0)
            if other is None:
                break
            chosen = replace(options, method=other)
            again = descend_once(own, again.deviation, None, chosen)
        if again.status[0] == DescentStatus.CONVERGED.value:
            fit = fit.put(alone, again)
    return fit


def get_method(options: FitOptions) -> Method:
    """Return the method, which `adapt_method` has set."""
    assert options.method is not None
    return options.method
