# SPDX-License-Identifier: Apache-2.0
"""Score fits on held-out poses: by folds that are fitted again, and by leaving out one block; the
error against the ridge parameter lam and against the truncation k.

Leave-one-out scores many penalties from one linearization: with the rows of block j in the
coordinates of the decomposition, B_j = A_j V, and H_jj = B_j diag(1 / (s^2 + penalty)) B_j', its
residual without it is (I - H_jj)^-1 r_j, to first order; exactly for a linear problem.

With unknown frames, targets or surfaces, curves are scored by folds on a coarse grid; these
unknowns of the held-out poses are estimated from them, which lowers all scores alike. The simplest
value within one standard error of the lowest score follows Breiman, Friedman, Olshen, Stone,
Classification and Regression Trees (1984).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar, Literal

import numpy as np

from loopcal.diagnose.outliers import TESTABLE, iterate_blocks
from loopcal.diagnose.row_errors import (
    PoseErrors,
    compare_predictions,
    compute_row_errors,
    join_errors,
)
from loopcal.errors import DataError, EstimationError
from loopcal.estimate import penalties
from loopcal.estimate.fit_descent import sum_squares
from loopcal.estimate.free_parameters import free_only, select_free_parameters
from loopcal.estimate.identification import exclude_poses, identify
from loopcal.estimate.information import collect_information
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.estimate.options import FitOptions, merge_options
from loopcal.estimate.problem import problem_of
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.measure.readings import fill_in_reading_sigma
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import are_nonzero, decompose
from loopcal.results.description import Field, each, fields, label_axes, pick
from loopcal.results.result import DrawnResult, TableResult
from loopcal.results.tables import Block, Table, build_table, word_column
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False)
class CrossValidation(TableResult):
    """Prediction errors of poses by fits that did not use them.

    Attributes
    ----------
    poses : (r,) labels of the rows. before, after : prediction error of the given robot and of the
        fits.
    fold : (f,) mean square of the whitened residuals of each fold's held-out rows (1: noise alone).
        before_fold : the same of the given robot.
    converged : whether every fit converged.
    """

    poses: tuple[str, ...]
    before: PoseErrors
    after: PoseErrors
    fold: FloatArray
    before_fold: FloatArray
    converged: bool

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("*", "score", "standard_error"),
        Field("mean_square_before", "before_fold", "fold", "sigma^2"),
        Field("mean_square", "fold", "fold", "sigma^2"),
    )

    def page(self) -> list[Block]:
        """Return the score and the folds."""
        text = f"Held-out score {self.score:.4g} (standard error {self.standard_error:.2g}) sigma^2"
        poses = f"{len(self.poses)} rows in {len(self.fold)} folds"
        return [f"{text}, {poses}; 1 is noise alone.", self.main_table()]

    @property
    def score(self) -> float:
        """Mean over folds of the held-out mean square."""
        return float(self.fold.mean())

    @property
    def standard_error(self) -> float:
        """Standard error of the score, from the scatter over folds."""
        return float(self.fold.std(ddof=1) / np.sqrt(len(self.fold)))

    def improvement(self, index: str = "position", statistic: str = "rms") -> float:
        """Return the factor by which a statistic of the held-out error became smaller."""
        after = getattr(self.after.statistics(index), statistic)
        return getattr(self.before.statistics(index), statistic) / after if after > 0.0 else np.inf


def draw_folds(data: Measurements, count: int, seed: int) -> tuple[IntArray, ...]:
    """Draw the poses held out in each of `count` folds of nearly equal size: whole blocks, because
    otherwise no fold would have a row that compares poses, such as a distance, and all repeats of a
    pose together.
    """
    names, member = np.unique(linked_blocks(data, data.undivided), return_inverse=True)
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
    method: penalties.Method | None = None,
    *,
    options: FitOptions | None = None,
    count: int = 5,
    seed: int = 1,
    must_converge: bool = False,
    progress: Progress = report_no_progress,
) -> CrossValidation:
    """Fit `count` times without one fold, and predict the held-out fold.

    Parameters
    ----------
    robot, data, method, options : as for `identify`. A robot without free parameters is only used
        to predict. Excluded poses are neither fitted nor predicted.
    count : number of folds. seed : of their choice. progress : receives the folds that are done.
    must_converge : whether the first fit that does not converge ends the comparison.

    Raises
    ------
    DataError, EstimationError : as `draw_folds` and `identify`; a fit does not converge (code
        `model.fold-not-converged`, with `must_converge`); or the options have nuisance parameters,
        which belong to all rows together.
    """
    options = merge_options(options, method)
    labels: list[str] = []
    before, after, scores, scores_before, converged = [], [], [], [], True
    folds = _fit_folds(robot, data, options, count, seed, progress)
    for done, (fitted, has_converged, held_out) in enumerate(folds):
        if must_converge and not has_converged:
            raise EstimationError.of("model.fold-not-converged", fold=done + 1, count=count)
        converged = converged and has_converged
        if held_out.n_rows:  # readings alone, of redundant actuators, have a score but no errors
            comparison = compare_predictions(robot, fitted, held_out)
            rows = comparison.data.observations
            first = len(labels)
            labels += comparison.rows
            before.append(compute_row_errors(rows, comparison.before.residuals(rows), first))
            after.append(compute_row_errors(rows, comparison.after.residuals(rows), first))
        scores.append(_mean_square(fitted, held_out))
        scores_before.append(_mean_square(robot, held_out))
    return CrossValidation(
        tuple(labels),
        join_errors(before),
        join_errors(after),
        np.array(scores),
        np.array(scores_before),
        converged,
    )


def _fit_folds(
    robot: Mechanism,
    data: Measurements,
    options: FitOptions,
    count: int,
    seed: int,
    progress: Progress = report_no_progress,
) -> Iterator[tuple[Mechanism, bool, Measurements]]:
    """Return for each fold the robot that is fitted without it, whether that fit converged, and the
    measurements of the fold.
    """
    if options.nuisance is not None:
        raise EstimationError(
            "cross_validate does not support the option nuisance. Give known frames and targets "
            "in the measurements"
        )
    data = exclude_poses(fill_in_reading_sigma(robot, data), options.excluded_poses)
    options = replace(options, excluded_poses=())
    for done, places in enumerate(draw_folds(data, count, seed)):
        progress(done, count, "cross-validating")
        fitted, has_converged = robot, True
        if robot.parameters.free.any():
            remaining = data.take(np.setdiff1d(np.arange(data.n_poses), places))
            fit = identify(robot, remaining, options=options)
            fitted, has_converged = fit.robot, fit.converged
        yield fitted, has_converged, data.take(places)


def score_leave_one_out(
    robot: Mechanism, data: Measurements, methods: tuple[penalties.Method, ...]
) -> tuple[FloatArray, FloatArray, int]:
    """Score k methods that keep the columns as they are: ridge, truncation, least squares, MAP.

    robot : linearization point; best the robot of a fit.
    Returns the mean squares (k,) of whitened leave-one-block-out residuals (1: noise alone),
    infinite where a block cannot be left out; their standard errors (k,) from the scatter over
    blocks, NaN where they are infinite; and the number of blocks with rows.
    """
    free = select_free_parameters(robot)
    problem = problem_of(free, data)
    z = free.deviation(robot.values[None])
    linearization = problem.linearize(z, problem.start(z))
    d = decompose(linearization.factor, linearization.equations, z)
    penalty = np.concatenate([method.penalty(d) for method in methods])
    # 1 / (s^2 + penalty) and the coordinates y, both (k, p); zero for unused directions
    s, total = d.singular_values[0], d.singular_values[0] ** 2 + penalty
    used = (total > 0.0) & np.isfinite(total)
    weight = np.divide(1.0, total, out=np.zeros_like(total), where=used)
    y = weight * (s * d.projections[0])
    blocks, member = np.unique(linked_blocks(data, data.undivided), return_inverse=True)
    square, equations = np.zeros((len(blocks), len(penalty))), np.zeros(len(blocks))
    count = problem.poses.count_rows(member, len(blocks))
    rows = problem.leverage_rows(linearization)
    for numbers, _, A, r in iterate_blocks(rows, member, count):
        B = A @ d.directions[0]  # (blocks, m, p)
        residual = A @ z[0] - r - np.moveaxis(B @ y.T, -1, 0)
        H = np.matmul(B * weight[:, None, None, :], B.swapaxes(-1, -2))
        remaining = np.eye(A.shape[1]) - H
        # eigenvalues lie in 0 to 1: the smallest is no smaller than the determinant, which is cheap
        singular = np.linalg.det(remaining) <= TESTABLE
        singular[singular] = np.linalg.eigvalsh(remaining[singular])[..., 0] <= TESTABLE
        remaining = np.where(singular[..., None, None], np.eye(A.shape[1]), remaining)
        deleted = np.linalg.solve(remaining, residual[..., None])[..., 0]
        square[numbers] = np.where(singular, np.inf, (deleted**2).sum(axis=2)).T
        equations[numbers] = ((A != 0.0).any(axis=2) | (r != 0.0)).sum(axis=1)
    score = square.sum(axis=0) / int(linearization.equations[0])
    # standard error of a ratio of sums over b blocks; NaN of a score that is infinite
    b = int((equations > 0).sum())
    error = np.full(len(score), np.nan)
    if b > 1:
        with np.errstate(invalid="ignore"):
            off = square - equations[:, None] * score
        off = np.where(np.isfinite(score), off, np.nan)
        error = np.sqrt(b / (b - 1) * (off**2).sum(axis=0)) / equations.sum()
    return score, error, b


def _mean_square(robot: Mechanism, data: Measurements) -> float:
    """Return the mean square of whitened residuals; infinite where a pose cannot be reached."""
    problem = problem_of(select_free_parameters(robot), data)
    z = problem.free.deviation(robot.values[None])
    start = problem.start(z)
    equations = int(problem.linearize(z, start).equations[0])
    return sum_squares(problem, z, start) / equations if equations else np.inf


# Names of parameters that shift an actuator reading.
OFFSETS = re.compile(r"(^|\.)(offset|stop|zero|home)$|^q\d+$")
LENGTHS = re.compile(r"(^|\.)(length|radius)$|^[lr]\d*$")  # names of the main dimensions
NOTHING = "nothing"  # name of the set that frees no parameter
CONTROLLER = "controller"  # name of the set that the controller of the machine stores
# Codes of the reasons why a set is not compared: the data have too few equations for it, or its
# fit without a fold does not converge.
NOT_COMPARED = ("fit.too-few-equations", "model.fold-not-converged")


@dataclass(frozen=True, eq=False)
class Candidate:
    """One set of free parameters."""

    name: str  # of the set
    parameters: tuple[str, ...]  # their names
    # cross-validation; None where without a fold too few equations remain, or the fit does not
    # converge
    validation: CrossValidation | None
    rank: int  # number of directions that all data determine at the values before calibration
    condition: float  # number of the columns in spreads; infinite without full rank

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("name"),
        Field("parameters", show=lambda names: str(len(names))),
        Field("score", unit="sigma^2", digits=4),
        Field("standard_error", unit="sigma^2", title="standard error", digits=2),
        Field("rank", unit="1"),
        Field("condition", unit="1", digits=3),
    )

    @property
    def score(self) -> float:
        """Mean square error on held-out poses [sigma^2]; infinite where it is not known."""
        return np.inf if self.validation is None else self.validation.score

    @property
    def standard_error(self) -> float:
        """Standard error of the score; NaN where it is not known."""
        return np.nan if self.validation is None else self.validation.standard_error


SHOWN = ("rank", "condition", "score", "standard_error")  # columns of tables, in this order


@dataclass(frozen=True, eq=False, repr=False)
class ModelChoice(TableResult):
    """The comparison of sets of free parameters.

    Attributes
    ----------
    candidates : the set with the fewest parameters first. chosen : the set to use.
    best : the one with the lowest score. robot : the robot with only the chosen parameters free.
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate
    best: Candidate
    robot: Mechanism

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(candidates="", chosen="chosen.name", best="best.name", finding=""),
        Field(
            "parameters", lambda choice: [len(c.parameters) for c in choice.candidates], "set", "1"
        ),
        *each("candidates", "set", Candidate.FIELDS, *SHOWN),
        Field("chosen", lambda choice: [c is choice.chosen for c in choice.candidates], "set"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(set="candidates.name")

    def compare_sets(self) -> Table:
        """Return the table of the sets, in which the chosen one is marked."""
        return build_table(
            "Parameter sets: mean square error on held-out poses [sigma^2], conditioning",
            self.candidates,
            (word_column("free"), lambda c: c.name + " (chosen)" * (c is self.chosen)),
            *pick(Candidate.FIELDS, "parameters", *SHOWN),
        )

    def page(self) -> list[Block]:
        """Return the comparison of parameter sets and the choice."""
        return [self.compare_sets(), str(self.finding)]

    @property
    def finding(self) -> Finding:
        """The choice."""
        compared = [c for c in self.candidates if c.validation is not None]
        code = "simpler-suffices" if self.chosen.parameters else "nothing-gained"
        if self.chosen is compared[-1]:
            code = "all-needed"
        return report_finding(
            f"model.{code}",
            chosen=self.chosen.name,
            parameters=len(self.chosen.parameters),
            best=self.best.name,
            best_parameters=len(self.best.parameters),
            not_compared=tuple(c.name for c in self.candidates if c.validation is None),
        )

    def __str__(self) -> str:
        return f"{self.compare_sets().to_text()}\n{self.finding}"


def nest_parameter_sets(robot: Mechanism) -> dict[str, tuple[str, ...]]:
    """Return nested sets of a robot's free parameters, those that add something: offsets, then also
    lengths, then all lengths and ratios ("ideal": joints where they are, axes as designed), then
    all ("complete"). The names of the shipped families tell offsets and lengths.
    """
    free = [p for p in robot.parameters.entries if p.free]
    offsets = {p.name for p in free if OFFSETS.search(p.name)}
    lengths = offsets | {p.name for p in free if LENGTHS.search(p.name)}
    ideal = lengths | {p.name for p in free if p.dimension is not Dimension.ANGLE}
    nested = {"offsets": offsets, "lengths": lengths, "ideal": ideal}
    nested["complete"] = {p.name for p in free}
    sets: dict[str, tuple[str, ...]] = {}
    size = 0
    for name, chosen in nested.items():
        if len(chosen) > size:
            sets[name] = tuple(p.name for p in free if p.name in chosen)
            size = len(chosen)
    return sets


def list_parameter_sets(robot: Mechanism) -> dict[str, tuple[str, ...]]:
    """Return the nested sets of a robot, and the set that its controller stores, by size. That set,
    `Assembly.stored_parameters`, takes the place of a nested one that is equal.
    """
    sets = nest_parameter_sets(robot)
    free = [p.name for p in robot.parameters.entries if p.free]
    stored = tuple(name for name in free if name in robot.assembly.stored_parameters)
    if stored:
        sets = {name: names for name, names in sets.items() if names != stored}
        sets[CONTROLLER] = stored
    return dict(sorted(sets.items(), key=lambda item: len(item[1])))


def choose_model(
    robot: Mechanism,
    data: Measurements,
    nested: Mapping[str, Sequence[str]] | None = None,
    method: penalties.Method | None = None,
    *,
    options: FitOptions | None = None,
    count: int = 5,
    seed: int = 1,
    progress: Progress = report_no_progress,
) -> ModelChoice:
    """Choose the simplest set of free parameters that predicts held-out poses as well as any.

    Parameters
    ----------
    robot, data, method, options, count, seed : as for `cross_validate`; all candidates are subsets
        of the free parameters and have the same folds.
    nested : name -> parameters, each set within the next; default `list_parameter_sets`. The set
        "nothing" is always compared as well.
    progress : receives the fits that are done.

    Raises
    ------
    EstimationError : the stated sets are not nested. Sets with too few equations, and those that do
        not converge, are listed, but not compared.
    """
    sets = list_parameter_sets(robot) if nested is None else nested
    named = [(NOTHING, ()), *((name, tuple(names)) for name, names in sets.items())]
    for (small, inner), (large, outer) in pairwise(named):
        if nested is not None and not set(inner) < set(outer):
            raise EstimationError(
                f"the set {small!r} is not within {large!r}, or equal to it. Give each set within "
                "the next"
            )
    options = merge_options(options, method)

    def validate_set(place: int, names: Sequence[str]) -> CrossValidation | None:
        def count_fits(done: int, _total: int, _what: str) -> None:
            progress(place * count + done, len(named) * count, "comparing parameter sets")

        try:
            return cross_validate(
                free_only(robot, names),
                data,
                options=options,
                count=count,
                seed=seed,
                must_converge=True,
                progress=count_fits,
            )
        except EstimationError as error:
            if error.code not in NOT_COMPARED:
                raise
            return None

    columns: FloatArray = np.zeros((0, 0))  # of all free parameters, in spreads
    free = select_free_parameters(robot)
    if len(free):
        kept = exclude_poses(fill_in_reading_sigma(robot, data), options.excluded_poses)
        columns = collect_information(free, kept)[0][0, :-1, :-1]
    candidates = []
    for i, (name, names) in enumerate(named):
        rank, condition = 0, 1.0
        if names:
            places = [free.names.index(each) for each in names]
            s = np.linalg.svd(columns[:, places], compute_uv=False)
            rank = int(are_nonzero(s, options.rank_tolerance).sum())
            condition = float(s[0] / s[-1]) if rank == len(names) else np.inf
        candidates.append(Candidate(name, names, validate_set(i, names), rank, condition))
    best = min(candidates, key=lambda c: c.score)
    limit = best.score + best.standard_error if np.isfinite(best.score) else np.inf
    chosen = next(c for c in candidates if c.score <= limit)
    return ModelChoice(tuple(candidates), chosen, best, free_only(robot, chosen.parameters))


PER_DECADE = 4  # values of lam per factor of ten where no fit is repeated
# Values of lam, and of k, that are fitted again for each fold, beside those of rules.
MOST_FITTED = 13
# Range of lam in units of the largest squared singular value; a rule may choose more.
LOWEST, HIGHEST = 1e-12, 10.0
# Decades below lam = 1 (the spreads as a prior) that the grid contains, as far as allowed.
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


@dataclass(frozen=True, eq=False, repr=False)
class RegularizationCurves(DrawnResult):
    """How the error at held-out poses depends on regularization.

    Attributes
    ----------
    robot : its name. poses : that were used. parameters : free ones. scheme : what was left out at
        a time. left_out : number of poses or folds. assumed : parameters without stated spread.
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
        ChosenValue("GCV", float(penalties.GCV()(d)[0])),
        ChosenValue("marginal likelihood", float(penalties.MarginalLikelihood()(d)[0])),
    ]
    rules_k = [ChosenValue("GCV", float(penalties.TruncationGCV()(d)[0]))]
    # from hardly any effect on the weakest determined direction to hardly any use of the data, with
    # 1 (the spreads as a prior) and about what rules choose
    square, by_rules = d.singular_values[0] ** 2, [rule.value for rule in rules_lam]
    lowest = min(1e-2 * square[d.used[0]].min(), 10.0**-FEWEST_DECADES)
    low = np.log10(min(max(lowest, LOWEST * square[0]), *by_rules))
    high = np.log10(max(HIGHEST * square[0], 10.0, *by_rules))
    steps = np.arange(np.floor(low * PER_DECADE), np.ceil(high * PER_DECADE) + 1)
    lam, k = 10.0 ** (steps / PER_DECADE), np.arange(len(free) + 1)
    if problem.nuisance is not None:
        lam, k = lam[_spread(len(lam), MOST_FITTED)], k[_spread(len(k), MOST_FITTED)]
    # what the rules choose has its own score
    lam = np.union1d(lam, by_rules)
    k = np.union1d(k, [int(rule.value) for rule in rules_k])
    methods = (*map(penalties.Ridge, lam.tolist()), *(penalties.TruncatedSVD(int(i)) for i in k))
    if problem.nuisance is None:
        scheme: Scheme = "leave-one-out"
        score, error, left_out = score_leave_one_out(fit.robot, data, methods)
    else:
        scheme, left_out = "folds", folds
        score, error = np.zeros(len(methods)), np.full(len(methods), np.nan)
        for i, method in enumerate(methods):
            progress(i, len(methods), "cross-validating")
            chosen = replace(options, method=method)
            fitted = _fit_folds(robot, data, chosen, folds, seed)
            fold = np.array([_mean_square(of_fold, held) for of_fold, _, held in fitted])
            score[i] = fold.mean()
            if np.isfinite(score[i]):
                error[i] = fold.std(ddof=1) / np.sqrt(folds)
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
