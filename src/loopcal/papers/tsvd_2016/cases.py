# SPDX-License-Identifier: Apache-2.0
"""One machine measured with the paper's noise: LS, RE over lambda, TSVD over k, and the library's
own methods beside them.

lambda runs from the smallest singular value that is not zero to 1, the paper's range, in equal
intervals as it says and in equal ratios as well; k from the number of parameters down. Which is
best is told by the true machine, as in the paper: the bottom of the curve, the smallest product of
the errors in position and angle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from loopcal.diagnose import Identifiability, identifiability
from loopcal.estimate import GCV, MAP, LeastSquares, Ridge, identify_trials
from loopcal.numerics.decomposition import RANK_TOLERANCE
from loopcal.papers.tsvd_2016.steps import (
    Iterations,
    iterate,
    least_squares,
    linearised,
    ridge,
    truncated,
    units,
)
from loopcal.papers.tsvd_2016.study import AppendixNoise, Study, machine, study, true_values
from loopcal.typing import FloatArray, IntArray

LS, RANKED, RE, TSVD = "LS", "LS with rank detection", "RE", "TSVD"
WHITENED, CROSS, PRIOR = "whitened LS", "whitened ridge, GCV", "MAP"
CHOSEN = ", chosen"
EQUAL_INTERVALS, EQUAL_RATIOS = 11, 13
TRIED = np.array([1e-20, 1e-18, 1e-16, 1e-14, 1e-12, 1e3, 1e6])
"""Lambdas among which the ends of convergence are looked for."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What one method found. setting : lambda or k. values : (p,) [SI], NaN where diverged. errors
    : (4,), see MEASURES.
    """

    setting: str
    values: FloatArray
    errors: FloatArray
    iterations: int
    converged: bool

    @property
    def diverged(self) -> bool:
        """Whether there is no answer."""
        return not np.isfinite(self.values).all()


@dataclass(frozen=True, eq=False)
class Sweep:
    """One algorithm over its setting. settings : (s,) lambda or k. runs : of all settings. errors :
    (s, 4).
    """

    settings: FloatArray
    runs: Iterations
    errors: FloatArray

    @property
    def best(self) -> int:
        """Bottom of the curve."""
        return int(np.nanargmin(self.errors[:, 0] * self.errors[:, 1]))

    def answer(self, i: int, setting: str) -> Answer:
        """What one setting found."""
        runs = self.runs
        return Answer(
            setting, runs.values[i], self.errors[i], int(runs.count[i]), bool(runs.converged[i])
        )


@dataclass(frozen=True, eq=False)
class Case:
    """One manipulator and one number of measured coordinates.

    Attributes
    ----------
    study : one machine. singular_values : (p,) of the raw identification matrix at nominal
        parameters. rank : of them.
    known : what the library says of the same measurements. equal : (s,) which lambda stand at equal
        intervals.
    ridge, truncated, ranked : sweeps; the last has one setting. answers : by method.
    bracket : smallest and largest lambda of those tried that does not diverge. normal_equations :
    largest component [mm,
    rad] of the first step if (H'H)^-1 H'D is computed as printed.
    """

    study: Study
    singular_values: FloatArray
    rank: int
    known: Identifiability
    equal: np.ndarray
    ridge: Sweep
    truncated: Sweep
    answers: dict[str, Answer]
    bracket: tuple[float, float]
    normal_equations: float

    @property
    def name(self) -> str:
        """Manipulator and measurement."""
        return f"{self.study.name}, {self.study.freedoms}-DOF"


def measure(name: str, seed: int) -> Study:
    """One machine with drawn errors, measured with the noise of Appendix 1."""
    return study(name, true_values(machine(name), 1, seed), AppendixNoise())


def solve(measured: Study, progress: Callable[[str], None]) -> Case:
    """Run all methods on one machine's measurements."""
    progress(f"{measured.name}, {measured.freedoms}-DOF measurement")
    p = len(measured.robot.parameters)
    nominal, first = measured.robot.parameters.nominal[None], np.zeros(1, dtype=np.int64)
    found, _ = linearised(measured, nominal, first)
    s = found.singular_values[0]
    rank = int((s > RANK_TOLERANCE * s[0]).sum())
    lambdas, equal = spacing(s[rank - 1])
    ks = np.arange(p, p // 3, -1)
    by_lambda, by_k = (
        _sweep(measured, lambdas, ridge(lambdas, p)),
        _sweep(measured, ks, truncated(ks, p)),
    )
    plain, ranked = (
        _sweep(measured, np.zeros(1), least_squares(p)),
        _sweep(measured, ks[:1], truncated(np.array([rank]), p)),
    )
    a, b = by_lambda.best, by_k.best
    answers = {
        LS: plain.answer(0, "-"),
        RANKED: ranked.answer(0, f"rank {rank}"),
        RE: by_lambda.answer(a, f"lambda = {lambdas[a]:.2g}"),
        TSVD: by_k.answer(b, f"k = {ks[b]}"),
        **library(measured),
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
        bracket(measured),
        normal_equations(measured, nominal, first),
    )


def spacing(smallest: float) -> tuple[FloatArray, np.ndarray]:
    """(s,) lambdas from the smallest singular value to 1, and which of them stand at equal
    intervals.
    """
    intervals, ratios = (
        np.linspace(smallest, 1.0, EQUAL_INTERVALS),
        np.geomspace(smallest, 1.0, EQUAL_RATIOS),
    )
    lambdas = np.unique(np.concatenate([intervals, ratios[1:-1]]))
    return lambdas, np.isin(lambdas, intervals)


def bracket(measured: Study) -> tuple[float, float]:
    """Smallest and largest lambda of TRIED with which three iterations do not diverge."""
    run = iterate(measured, ridge(TRIED, len(measured.robot.parameters)), limit=3)
    safe = TRIED[~run.diverged]
    return float(safe.min()), float(safe.max())


def normal_equations(measured: Study, values: FloatArray, first: IntArray) -> float:
    """First step of LS computed literally as printed, with the inverse of H'H: the one place where
    that product is formed.

    With a null direction H'H is singular up to rounding, and so its inverse is rounding.
    """
    found, _ = linearised(measured, values, first)
    H = (found.singular_values[0][:, None] * found.directions[0].T) / found.scale
    product = H.T @ H
    try:
        step = np.linalg.inv(product) @ (H.T @ found.projections[0])
    except np.linalg.LinAlgError:
        return float("inf")
    return float(np.abs(step).max())


def library(measured: Study) -> dict[str, Answer]:
    """The methods of `loopcal.calibrate`: rows whitened by the noise, columns scaled by the
    tolerances.
    """
    answers = {}
    for name, method in {WHITENED: LeastSquares(), CROSS: Ridge(GCV()), PRIOR: MAP()}.items():
        found = identify_trials(measured.robot, measured.trials, method)
        setting = "-"
        if name == CROSS:
            setting = f"lambda = {float(found.penalty[0, 0]):.2g}{CHOSEN}"
        elif name == PRIOR:
            setting = "lambda = 1, by definition"
        errors = measured.output_errors(found.values)[0]
        answers[name] = Answer(
            setting, found.values[0], errors, int(found.iterations[0]), bool(found.converged[0])
        )
    return answers


def ridge_steps(measured: Study, counts: tuple[int, ...]) -> list[tuple[int, float, FloatArray]]:
    """After each number of iterations of RE: that number, the best lambda, and the errors (4,)
    there.
    """
    smallest = float(
        linearised(measured, measured.robot.values[None], np.zeros(1, dtype=np.int64))[
            0
        ].singular_values[0, -1]
    )
    lambdas = np.geomspace(smallest, 1.0, EQUAL_RATIOS)
    history = iterate(
        measured, ridge(lambdas, len(measured.robot.parameters)), limit=max(counts)
    ).history
    found = []
    for count in counts:
        values = history[min(count, len(history) - 1)]
        errors = measured.output_errors(values, np.zeros(len(values), dtype=np.int64))
        best = int(np.argmin(errors[:, 0] * errors[:, 1]))
        found.append((count, float(lambdas[best]), errors[best]))
    return found


def in_paper_units(measured: Study, values: FloatArray) -> FloatArray:
    """Deviations from nominal [mm, rad] of values (.., p)."""
    return (values - measured.robot.parameters.nominal) / units(measured.robot)


def _sweep(measured: Study, settings: FloatArray | IntArray, penalty: FloatArray) -> Sweep:
    runs = iterate(measured, penalty)
    return Sweep(
        np.asarray(settings, dtype=np.float64),
        runs,
        measured.output_errors(runs.values, runs.machine),
    )
