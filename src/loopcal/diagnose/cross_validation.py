# SPDX-License-Identifier: Apache-2.0
"""k-fold cross-validation over whole blocks: every pose is predicted once by a fit that has not
seen it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from loopcal.diagnose.prediction_errors import (
    PoseErrors,
    compare_predictions,
    compute_row_errors,
    join_errors,
)
from loopcal.errors import DataError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.methods.losses import Loss
from loopcal.estimate.methods.penalties import Method
from loopcal.estimate.options import FitOptions
from loopcal.estimate.problem import problem_of
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Prediction errors of poses by fits that have not seen them.

    Attributes
    ----------
    poses : (r,) labels of the rows. before, after : prediction error of the given robot and of the
        fits.
    fold : (f,) mean square of the whitened residuals of each fold's held-out rows (1: noise alone).
        before_fold : the same of the given robot.
    converged : whether every fit did.
    """

    poses: tuple[str, ...]
    before: PoseErrors
    after: PoseErrors
    fold: FloatArray
    before_fold: FloatArray
    converged: bool

    @property
    def score(self) -> float:
        """Mean over folds of the held-out mean square."""
        return float(self.fold.mean())

    @property
    def standard_error(self) -> float:
        """Standard error of the score, from the spread over folds."""
        return float(self.fold.std(ddof=1) / np.sqrt(len(self.fold)))

    def improvement(self, index: str = "position", statistic: str = "rms") -> float:
        """Return how many times smaller a statistic of the prediction error became on unseen poses."""
        after = getattr(self.after.statistics(index), statistic)
        return getattr(self.before.statistics(index), statistic) / after if after > 0.0 else np.inf

    def to_dict(self) -> dict[str, Any]:
        """Return the result by name for JSON, SI."""
        return {
            "poses": list(self.poses),
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
            "fold": self.fold,
            "before_fold": self.before_fold,
            "score": self.score,
            "standard_error": self.standard_error,
            "converged": self.converged,
        }


def draw_folds(data: Measurements, count: int, seed: int) -> tuple[IntArray, ...]:
    """Return the poses held out in each of `count` folds: whole blocks drawn at random, folds of
    nearly equal size.

    Raises
    ------
    DataError
        Fewer than two folds, or fewer blocks than folds.
    """
    names, member = np.unique(data.block, return_inverse=True)
    if count < 2 or len(names) < count:
        raise DataError(
            f"{count} folds of {len(names)} blocks of poses: give at least 2 folds and no more "
            "than there are blocks"
        )
    order = np.random.default_rng(np.random.SeedSequence(seed)).permutation(len(names))
    return tuple(np.flatnonzero(np.isin(member, order[i::count])) for i in range(count))


def cross_validate(
    robot: Mechanism,
    data: Measurements,
    method: Method | None = None,
    *,
    count: int = 5,
    seed: int = 1,
    noise: Literal["given", "estimated"] = "given",
    loss: Loss | None = None,
) -> CrossValidation:
    """Fit `count` times without one fold and predict it.

    Parameters
    ----------
    robot, data, method, noise, loss : as for `identify`. A robot without free parameters is only
        predicted with.
    count : number of folds. seed : of their choice.

    Raises
    ------
    DataError, EstimationError
        As `folds` and `identify`.
    """
    labels: list[str] = []
    before, after, scores, plain, converged = [], [], [], [], True
    for held in draw_folds(data, count, seed):
        unseen = data.take(held)
        fitted = robot
        if robot.parameters.free.any():
            fit = identify(
                robot,
                data.take(np.setdiff1d(np.arange(data.n_poses), held)),
                method,
                loss=loss,
                options=FitOptions(noise=noise),
            )
            fitted, converged = fit.robot, converged and fit.converged
        if (
            unseen.n_rows
        ):  # else readings alone, of redundant actuators: there is a score, but no measured error
            compared = compare_predictions(robot, fitted, unseen)
            rows = compared.data.observations
            labels += compared.rows
            before.append(compute_row_errors(rows, compared.before.residuals(rows)))
            after.append(compute_row_errors(rows, compared.after.residuals(rows)))
        scores.append(_mean_square(fitted, unseen))
        plain.append(_mean_square(robot, unseen))
    return CrossValidation(
        tuple(labels),
        join_errors(before),
        join_errors(after),
        np.array(scores),
        np.array(plain),
        converged,
    )


def _mean_square(robot: Mechanism, data: Measurements) -> float:
    """Mean square of the whitened residuals of a robot; infinite where it cannot reach a pose."""
    problem = problem_of(select_free_parameters(robot), data)
    z = problem.free.deviation(robot.values[None])
    at = problem.linearize(z, problem.start(z))
    equations, total = int(at.equations[0]), 0.0
    solution = problem.solve(z, at.next_start)
    for rows, residuals in zip(problem.rows, problem.residuals(z, solution), strict=True):
        total += float(np.where(rows.is_present[0], residuals.whitened[0] ** 2, 0.0).sum())
    return total / equations if np.isfinite(total) and equations else np.inf
