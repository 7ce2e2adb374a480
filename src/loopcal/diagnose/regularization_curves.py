# SPDX-License-Identifier: Apache-2.0
"""Held-out error against the ridge parameter lam and against the truncation k.

With known frames, every pose is left out in turn, to first order about a fit, so that fine grids
cost one linearization (see `loopcal.diagnose.cross_validation`). The directions of a truncation are
then those of all poses. With unknown frames, targets or
surfaces, folds of poses are left out and fitted again on a coarse grid; these unknowns of the
held-out poses are estimated from them, which lowers all scores alike.

The simplest value within one standard error of the lowest score follows Breiman, Friedman, Olshen,
Stone, Classification and Regression Trees (1984).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np

from loopcal.diagnose.cross_validation import cross_validate, score_leave_one_out
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import check_types, exclude_poses, identify
from loopcal.estimate.options import FitOptions, merge_options
from loopcal.estimate.penalties import GCV, MarginalLikelihood, Ridge, TruncatedSVD, TruncationGCV
from loopcal.estimate.problem import problem_of
from loopcal.measure.measurements import Measurements
from loopcal.measure.readings import fill_in_reading_sigma
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import Decomposition, decompose
from loopcal.results.description import Field, fields
from loopcal.results.result import DrawnResult
from loopcal.typing import FloatArray, Progress, report_no_progress

PER_DECADE = 4  # values of lam per factor of ten where no fit is repeated
# Values of lam, and of k, that are fitted again for each fold, beside those of rules.
MOST_FITTED = 13
# Range of lam in units of the largest squared singular value; a rule may choose more.
LOWEST, HIGHEST = 1e-12, 10.0
# Decades below lam = 1 (the tolerances as a prior) that the grid contains, as far as allowed.
FEWEST_DECADES = 4.0

Scheme = Literal["leave-one-out", "folds"]


@dataclass(frozen=True)
class ChosenValue:
    """A value of lam or k that a rule chooses. `rule` : its name in words."""

    rule: str
    value: float


@dataclass(frozen=True, eq=False)
class RegularizationCurve:
    """Held-out scores of one family of methods."""

    name: Literal["lam", "k"]  # "lam" or "k"
    values: FloatArray  # (n,) increasing
    # (n,) mean square of whitened held-out residuals; 1 is noise alone, infinite where poses
    # cannot be left out
    score: FloatArray
    standard_error: FloatArray  # (n,) of the score
    # what rules choose, among them the lowest score and the simplest value within one standard
    # error of it
    chosen: tuple[ChosenValue, ...]

    def score_at(self, value: float) -> tuple[float, float]:
        """Return the score, and its standard error, at the value of the curve nearest to one."""
        scale = np.log(self.values) if self.name == "lam" else self.values
        place = np.log(value) if self.name == "lam" else value
        i = int(np.argmin(np.abs(scale - place)))
        return float(self.score[i]), float(self.standard_error[i])


@dataclass(frozen=True, eq=False)
class RegularizationCurves(DrawnResult):
    """How the error at held-out poses depends on regularization.

    Attributes
    ----------
    robot : its name. poses : that were used. parameters : free ones. scheme : what was left out at
        a time. left_out : number of poses or folds. assumed : parameters without stated tolerance.
    ridge, truncation : the curves. nominal : score of the given robot, with its standard error.
    """

    robot: str
    poses: int
    parameters: int
    scheme: Scheme
    left_out: int
    assumed: int
    ridge: RegularizationCurve
    truncation: RegularizationCurve
    nominal: tuple[float, float]

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("*"),
        Field("regularization", lambda curves: curves.join("name"), "point"),
        Field("value", lambda curves: curves.join("values"), "point", "1"),
        Field("score", lambda curves: curves.join("score"), "point", "sigma^2"),
        Field("standard_error", lambda curves: curves.join("standard_error"), "point", "sigma^2"),
    )

    def join(self, name: str) -> list[Any]:
        """Return an attribute of both curves, one entry for each of their points."""
        joined = []
        for curve in (self.ridge, self.truncation):
            value = getattr(curve, name)
            joined += [value] * len(curve.values) if isinstance(value, str) else list(value)
        return joined

    def __repr__(self) -> str:
        return (
            f"<RegularizationCurves of {self.robot}: {len(self.ridge.values)} values of lam, "
            f"{len(self.truncation.values)} of k, {self.scheme}>"
        )


def compute_regularization_curves(
    robot: Mechanism,
    data: Measurements,
    *,
    options: FitOptions | None = None,
    folds: int = 5,
    seed: int = 1,
    progress: Progress = report_no_progress,
) -> RegularizationCurves:
    """Return the held-out error against lam of ridge and against k of truncated SVD.

    Parameters
    ----------
    robot, data : as for `identify`. options : of the fits; its method is the one about whose fit
        the rows are linearized.
    folds, seed : of the poses that are left out together where frames, targets or surfaces are
        unknown. progress : receives the finished values.

    Raises
    ------
    EstimationError, DataError : see `identify` and `cross_validate`.
    """
    check_types(robot, data)
    options = merge_options(options)
    data = exclude_poses(fill_in_reading_sigma(robot, data), options.excluded_poses)
    poses = data.n_poses - len(set(options.excluded_poses))
    options = replace(options, excluded_poses=())
    progress(0, 1, "fitting")
    fit = identify(robot, data, options=options)
    free = select_free_parameters(fit.robot)
    problem = problem_of(free, data, options.nuisance)
    z = free.deviation(fit.robot.values[None])
    linearization = problem.linearize(z, problem.start(z))
    d = decompose(linearization.factor, linearization.equations, z)
    rules_lam = [
        ChosenValue("GCV", float(GCV()(d)[0])),
        ChosenValue("marginal likelihood", float(MarginalLikelihood()(d)[0])),
    ]
    rules_k = [ChosenValue("GCV", float(TruncationGCV()(d)[0]))]
    lam, k = list_lam(d, [rule.value for rule in rules_lam]), np.arange(len(free) + 1)
    if problem.nuisance is not None:
        lam, k = lam[_spread(len(lam), MOST_FITTED)], k[_spread(len(k), MOST_FITTED)]
    # what the rules choose has its own score
    lam = np.union1d(lam, [rule.value for rule in rules_lam])
    k = np.union1d(k, [int(rule.value) for rule in rules_k])
    methods = (*map(Ridge, lam.tolist()), *(TruncatedSVD(int(i)) for i in k))
    if problem.nuisance is None:
        scheme: Scheme = "leave-one-out"
        result = score_leave_one_out(fit.robot, data, methods)
        score, error, left_out = result.score, result.standard_error, result.blocks
    else:
        scheme, left_out = "folds", folds
        score, error = np.zeros(len(methods)), np.full(len(methods), np.nan)
        for i, method in enumerate(methods):
            progress(i, len(methods), "cross-validating")
            chosen = replace(options, method=method)
            validation = cross_validate(robot, data, options=chosen, count=folds, seed=seed)
            score[i] = validation.score
            if np.isfinite(score[i]):
                error[i] = validation.standard_error
    n = len(lam)
    ridge = _mark("lam", lam, score[:n], error[:n], rules_lam)
    truncation = _mark("k", k.astype(float), score[n:], error[n:], rules_k)
    return RegularizationCurves(
        robot.name,
        poses,
        len(free),
        scheme,
        left_out,
        int(free.assumed.sum()),
        ridge,
        truncation,
        truncation.score_at(0.0),
    )


def list_lam(d: Decomposition, chosen: Sequence[float]) -> FloatArray:
    """Return values of lam: from hardly any effect on the weakest determined direction to hardly
    any use of the data, with 1 (the tolerances as a prior) and about those chosen by rules.
    """
    square = d.singular_values[0] ** 2
    lowest = min(1e-2 * square[d.used[0]].min(), 10.0**-FEWEST_DECADES)
    low = np.log10(min(max(lowest, LOWEST * square[0]), *chosen))
    high = np.log10(max(HIGHEST * square[0], 10.0, *chosen))
    steps = np.arange(np.floor(low * PER_DECADE), np.ceil(high * PER_DECADE) + 1)
    return np.asarray(10.0 ** (steps / PER_DECADE))


def _mark(
    name: Literal["lam", "k"],
    values: FloatArray,
    score: FloatArray,
    error: FloatArray,
    rules: Sequence[ChosenValue],
) -> RegularizationCurve:
    """Return a curve with its lowest score and its simplest value added to the rules."""
    chosen = list(rules)
    if np.isfinite(score).any():
        best = int(np.argmin(score))
        chosen.append(ChosenValue("lowest held-out error", float(values[best])))
        if np.isfinite(error[best]):
            within = values[score <= score[best] + error[best]]
            simplest = within.max() if name == "lam" else within.min()
            chosen.append(ChosenValue("one standard error", float(simplest)))
    return RegularizationCurve(name, values, score, error, tuple(chosen))


def _spread(count: int, most: int) -> np.ndarray:
    """Return at most `most` of `count` places, evenly, with both ends."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
