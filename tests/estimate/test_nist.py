# SPDX-License-Identifier: Apache-2.0
"""Certified nonlinear regression: the descent agrees with the values and standard errors of NIST.

Pass marks: 6 matching digits for values and 4 for standard errors, from both official starts.
Lanczos1 needs 2 for standard errors, because its residuals are the rounding of its printed data
(sum of squares 1.4e-25).
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from loopcal.estimate.methods.penalties import LeastSquares
from loopcal.estimate.minimization.descent import FunctionProblem, StepControl, descend
from loopcal.numerics.gauss_newton import DescentStatus
from tests.estimate.nist import (
    MODELS,
    Certified,
    matching_digits,
    read_data_set,
    residual_and_jacobian,
)
from tests.estimate.problems import fold_rows

# [1] the starts are so far off that genuine directions sink to the rank tolerance used for robots
NO_RANK_TOLERANCE = 1e-15


class Regression:
    """One data set as a problem for the descent; columns scaled by the start values."""

    def __init__(self, certified: Certified, start: np.ndarray) -> None:
        self.certified, self.start = certified, start
        self.parameters = len(start)
        self.equations = np.array([len(certified.y)])

    def values(self, deviation: np.ndarray) -> np.ndarray:
        return self.start + np.abs(self.start) * deviation

    def evaluate(self, deviation, trials):
        assert trials.tolist() == [0]
        residual, jacobian = residual_and_jacobian(self.certified, self.values(deviation[0]))
        rows = np.column_stack([jacobian * np.abs(self.start), residual])
        with np.errstate(over="ignore"):
            cost = np.array([residual @ residual])
        if not np.isfinite(rows).all():
            return np.zeros((1, self.parameters + 1, self.parameters + 1)), np.array([np.inf])
        return fold_rows(rows[None]), cost


def score_fit(certified: Certified, start: np.ndarray) -> tuple[float, float, int, str]:
    """Fit and return matching digits of values and of standard errors, accepted steps, status."""
    problem = Regression(certified, start)
    control = StepControl(iterations=2000, relative=1e-8)
    function = FunctionProblem(problem.parameters, problem.evaluate, problem.equations)
    fit = descend(
        function,
        np.zeros((1, problem.parameters)),
        LeastSquares(),
        control,
        tolerance=NO_RANK_TOLERANCE,
    )
    errors = fit.decomposition.standard_deviations(fit.penalty, fit.cost / certified.degrees)[
        0
    ] * np.abs(start)
    return (
        matching_digits(problem.values(fit.deviation[0]), certified.values),
        matching_digits(errors, certified.standard_errors),
        int(fit.iterations[0]),
        DescentStatus(fit.status[0]).name,
    )


@pytest.fixture(scope="module")
def scores(data_folder: Path) -> dict[tuple[str, int], tuple[float, float, int, str]]:
    """Matching digits of every set from both starts."""
    sets = [read_data_set(path) for path in sorted((data_folder / "nist").glob("*.dat"))]
    assert {c.name for c in sets} == set(MODELS)
    return {(c.name, i + 1): score_fit(c, c.starts[i]) for c in sets for i in range(2)}


@pytest.mark.parametrize("name", sorted(MODELS))
@pytest.mark.parametrize("start", [1, 2])
def test_nist_values_match_to_6_digits_and_standard_errors_to_4(scores, name, start):
    values, errors, _, status = scores[name, start]
    assert status == "CONVERGED"
    assert values >= 6.0
    assert errors >= (2.0 if name == "Lanczos1" else 4.0)


def test_matching_digits_of_every_nist_data_set_are_printed(scores, capsys):
    lines = ["", "NIST StRD: matching digits", f"{'set':<10} start  values  std. errors  steps"]
    lines += [
        f"{name:<10} {i:>5}  {v:>6.1f}  {e:>11.1f}  {n:>5}"
        for (name, i), (v, e, n, _) in scores.items()
    ]
    with capsys.disabled():
        sys.stdout.write("\n".join(lines) + "\n")
    assert len(lines) == 3 + 2 * len(MODELS)
