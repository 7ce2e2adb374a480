# SPDX-License-Identifier: Apache-2.0
"""One machine measured with the paper's noise: LS, RE over lambda, TSVD over k, and the library's
own methods beside them.

lambda runs from the smallest singular value that is not zero to 1, the paper's range, in equal
intervals as it says and in equal ratios as well; k from the number of parameters down. As in the
paper the true machine decides which is best: the minimum of the curve, the smallest product of the
errors in position and angle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from loopcal.diagnose.identifiable_parameters import Identifiability, identifiability
from loopcal.estimate.penalties import GCV, MAP, LeastSquares, Ridge
from loopcal.estimate.published_steps import penalize_none, penalize_ridge, penalize_truncated
from loopcal.estimate.trial_identification import identify_trials
from loopcal.numerics.decomposition import are_nonzero
from loopcal.papers.tsvd_2016.machines import (
    AppendixNoise,
    Study,
    draw_true_values,
    load_machine,
    measure_machines,
)
from loopcal.papers.tsvd_2016.situations import LS, RANKED, RE, TSVD, find_bottom
from loopcal.papers.tsvd_2016.steps import Iterations, iterate, linearize, list_scales
from loopcal.typing import BoolArray, FloatArray, IntArray

WHITENED, CROSS, PRIOR = "whitened LS", "whitened ridge, GCV", "MAP"
CHOSEN = ", chosen"
EQUAL_INTERVALS, EQUAL_RATIOS = 11, 13
TRIED = np.array([1e-20, 1e-18, 1e-16, 1e-14, 1e-12, 1e3, 1e6])
"""Lambdas among which the ends of convergence are looked for."""


@dataclass(frozen=True, eq=False)
class Answer:
    """Result of one method.

    Attributes
    ----------
    setting : lambda or k. values : (p,) [SI], NaN if diverged. errors : (5,), see MEASURES.
    commanded : (2,), see COMMANDED.
    """

    setting: str
    values: FloatArray
    errors: FloatArray
    commanded: FloatArray
    iterations: int
    is_converged: bool

    @property
    def is_diverged(self) -> bool:
        """Whether there is no answer."""
        return not np.isfinite(self.values).all()

    @property
    def needed(self) -> str:
        """Iterations until convergence, in words."""
        if self.is_diverged:
            return "diverged"
        return f"{self.iterations:,}" if self.is_converged else f"more than {self.iterations:,}"


@dataclass(frozen=True, eq=False)
class Sweep:
    """One algorithm over its setting.

    Attributes
    ----------
    settings : (s,) lambda or k. study : what was measured. runs : of all settings.
    errors : (s, 5), see MEASURES. first : place of the first setting that may be the best: 1 where
        the setting before it is LS.
    """

    settings: FloatArray
    study: Study
    runs: Iterations
    errors: FloatArray
    first: int = 0

    @property
    def best(self) -> int:
        """Place of the bottom of the curve."""
        return self.first + find_bottom(self.errors[self.first :])

    def answer(self, i: int, setting: str) -> Answer:
        """Return the result of one setting."""
        runs = self.runs
        commanded = self.study.compute_commanded_errors(runs.values[[i]], runs.machine[[i]])[0]
        count, is_converged = int(runs.count[i]), bool(runs.is_converged[i])
        return Answer(setting, runs.values[i], self.errors[i], commanded, count, is_converged)


@dataclass(frozen=True, eq=False)
class Case:
    """One manipulator and one number of measured coordinates.

    Attributes
    ----------
    study : one machine. singular_values : (p,) of the raw identification matrix at nominal
        parameters. rank : of them.
    known : identifiability of the same measurements by the library. is_equal : (s,)
        which lambdas are at equal intervals.
    ridge, truncated, ranked : sweeps; the last has one setting. answers : by method.
    bracket : smallest and largest lambda of those tried that does not diverge. normal_equations :
    largest component [mm,
    rad] of the first step if (H'H)^-1 H'D is computed as printed.
    """

    study: Study
    singular_values: FloatArray
    rank: int
    known: Identifiability
    is_equal: BoolArray
    ridge: Sweep
    truncated: Sweep
    answers: dict[str, Answer]
    bracket: tuple[float, float]
    normal_equations: float

    @property
    def name(self) -> str:
        """Manipulator and measurement."""
        return f"{self.study.name}, {self.study.freedoms}-DOF"

    @property
    def unknowns(self) -> int:
        """Number of parameters."""
        return len(self.singular_values)


def measure_case(name: str, seed: int) -> Study:
    """Measure one machine with drawn errors and the noise of Appendix 1."""
    return measure_machines(name, draw_true_values(load_machine(name), 1, seed), AppendixNoise())


def solve_case(measured: Study, progress: Callable[[str], None]) -> Case:
    """Run all methods on one machine's measurements."""
    progress(f"{measured.name}, {measured.freedoms}-DOF measurement")
    p = len(measured.robot.parameters)
    nominal, first = measured.robot.parameters.nominal[None], np.zeros(1, dtype=np.int64)
    decomposition, _ = linearize(measured, nominal, first)
    s = decomposition.singular_values[0]
    rank = int(are_nonzero(s).sum())
    lambdas, equal = space_lambdas(s[rank - 1])
    ks = np.arange(p, p // 3, -1)
    by_lambda, by_k = (
        _sweep(measured, lambdas, penalize_ridge(lambdas, p)),
        _sweep(measured, ks, penalize_truncated(ks, p), first=1),
    )
    plain, ranked = (
        _sweep(measured, np.zeros(1), penalize_none(p)),
        _sweep(measured, ks[:1], penalize_truncated(np.array([rank]), p)),
    )
    a, b = by_lambda.best, by_k.best
    answers = {
        LS: plain.answer(0, "-"),
        RANKED: ranked.answer(0, f"rank {rank}"),
        RE: by_lambda.answer(a, f"lambda = {lambdas[a]:.2g}"),
        TSVD: by_k.answer(b, f"k = {ks[b]}"),
        **run_library(measured),
    }
    known = identifiability(measured.robot.nominal, measured.trials.trial(0))
    return Case(
        measured,
        s,
        rank,
        known,
        equal,
        by_lambda,
        by_k,
        answers,
        find_bracket(measured),
        solve_normal_equations(measured, nominal, first),
    )


def space_lambdas(smallest: float) -> tuple[FloatArray, BoolArray]:
    """Return lambdas (s,) from the smallest singular value to 1, and which are equidistant."""
    intervals, ratios = (
        np.linspace(smallest, 1.0, EQUAL_INTERVALS),
        np.geomspace(smallest, 1.0, EQUAL_RATIOS),
    )
    lambdas = np.unique(np.concatenate([intervals, ratios[1:-1]]))
    return lambdas, np.isin(lambdas, intervals)


def find_bracket(measured: Study) -> tuple[float, float]:
    """Return the smallest and largest lambda of TRIED that does not diverge in three iterations."""
    run = iterate(measured, penalize_ridge(TRIED, len(measured.robot.parameters)), limit=3)
    safe = TRIED[~run.is_diverged]
    return float(safe.min()), float(safe.max())


def solve_normal_equations(measured: Study, values: FloatArray, first: IntArray) -> float:
    """Return the first step of LS as printed, with the inverse of H'H: only here it is formed.

    With a null direction H'H is singular up to rounding, and so its inverse is rounding.
    """
    d, _ = linearize(measured, values, first)
    H = (d.singular_values[0][:, None] * d.directions[0].T) / d.scale
    product = H.T @ H
    try:
        step = np.linalg.inv(product) @ (H.T @ d.projections[0])
    except np.linalg.LinAlgError:
        return float("inf")
    return float(np.abs(step).max())


def run_library(measured: Study) -> dict[str, Answer]:
    """Return the results of `loopcal.identify`: rows whitened, columns scaled by tolerance."""
    answers = {}
    for name, method in {WHITENED: LeastSquares(), CROSS: Ridge(GCV()), PRIOR: MAP()}.items():
        fit = identify_trials(measured.robot, measured.trials, method)
        setting = "-"
        if name == CROSS:
            setting = f"lambda = {float(fit.penalty[0, 0]):.2g}{CHOSEN}"
        elif name == PRIOR:
            setting = "lambda = 1, by definition"
        errors = measured.compute_output_errors(fit.values)[0]
        commanded = measured.compute_commanded_errors(fit.values)[0]
        count, is_converged = int(fit.iterations[0]), bool(fit.converged[0])
        answers[name] = Answer(setting, fit.values[0], errors, commanded, count, is_converged)
    return answers


def follow_ridge(
    measured: Study, counts: tuple[int, ...]
) -> list[tuple[int | str, float, FloatArray]]:
    """Return the best lambda and its errors (5,) after each number of RE iterations, and at the end
    of the iteration.
    """
    first = np.zeros(1, dtype=np.int64)
    decomposition, _ = linearize(measured, measured.robot.values[None], first)
    lambdas = np.geomspace(float(decomposition.singular_values[0, -1]), 1.0, EQUAL_RATIOS)
    penalty = penalize_ridge(lambdas, len(measured.robot.parameters))
    history = iterate(measured, penalty, limit=max(counts), ahead=0.0).history
    ends: list[tuple[int | str, FloatArray]] = [
        (count, history[min(count, len(history) - 1)]) for count in counts
    ]
    ends.append(("at convergence", iterate(measured, penalty).values))
    rows = []
    for count, values in ends:
        errors = measured.compute_output_errors(values, np.zeros(len(values), dtype=np.int64))
        best = find_bottom(errors)
        rows.append((count, float(lambdas[best]), errors[best]))
    return rows


def to_paper_units(measured: Study, values: FloatArray) -> FloatArray:
    """Return deviations from nominal [mm, rad] of values (.., p)."""
    return (values - measured.robot.parameters.nominal) / list_scales(measured.robot)


def _sweep(
    measured: Study, settings: FloatArray | IntArray, penalty: FloatArray, first: int = 0
) -> Sweep:
    runs = iterate(measured, penalty)
    errors = measured.compute_output_errors(runs.values, runs.machine)
    return Sweep(np.asarray(settings, dtype=np.float64), measured, runs, errors, first)
