# SPDX-License-Identifier: Apache-2.0
"""Two calibrations of a machine: whether it has changed, and the earlier one as prior of the next.

Both say what their data alone determine, without spreads, which both share; the difference is
compared with the noise that the residuals of both show, so that a wrong sigma moves no machine. A
change of the whole machine, of each limb and of each parameter is tested, and the probability is
that of the clearest of these tests. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, ClassVar, NamedTuple

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions, merge_options
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.posterior import INFLATION, Posterior, combine_degrees
from loopcal.estimate.prior import limb_parameters, prior_from
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.findings.catalog.phrases import MACHINE
from loopcal.measure.instrument import make_random_stream
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.numerics import decomposition, statistics
from loopcal.plain_text import represent
from loopcal.results.description import Field, fields
from loopcal.results.result import Result
from loopcal.typing import BoolArray, FloatArray, Progress, report_no_progress

CHANGE_LEVEL = 0.05
"""Probability of finding a change of a machine that has not changed."""

TOO_WELL = 1e-3
"""Probability of a chi-square as small as that of new data which contain rows of the earlier
calibration in a form that `loopcal.measure.fitted_rows.FittedRows` does not recognize.
"""


@dataclass(frozen=True, eq=False)
class Change(Result):
    """Whether parameters have changed between two calibrations.

    subject : a limb, or "the machine". names : the parameters in question.
    change : (k,) change of these parameters if no other has changed [SI]; NaN where the data of
        both calibrations do not determine it.
    chi_square, degrees : of the change, in units of the noise that both calibrations show.
    p_value : see `ParameterChanges.compute_probability`; NaN where it cannot be decided.
    moved : whether they have changed; None where it cannot be decided.
    finding : the result with its code.
    """

    subject: str
    names: tuple[str, ...]
    change: FloatArray
    chi_square: float
    degrees: float
    p_value: float
    moved: bool | None
    finding: Finding

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("subject", "names", "change", "chi_square", "degrees", "p_value", "moved"),
        sentence=lambda change: str(change.finding),
    )


def recalibrate(
    robot: Mechanism,
    data: Measurements,
    earlier: Posterior,
    free_limb: str | None = None,
    *,
    options: FitOptions | None = None,
    progress: Progress = report_no_progress,
) -> tuple[Identification, Change]:
    """Identify a robot from new measurements and an earlier calibration.

    Parameters
    ----------
    robot : its table states what is nominal and tolerated. data : the new measurements.
    earlier : `Identification.posterior`, or the one of a run folder.
    free_limb : a limb that was repaired. Its parameters get the spreads of the robot file about
        nominal again; the others keep what the earlier calibration knows of them.
    options : see `FitOptions`. The method is least squares: the prior replaces the spreads.
    progress : receives the fits that are done where the machine has changed.

    Returns
    -------
    fit, change : the identification, and whether the limb (or without one, the machine) has changed
        since the earlier calibration.

    Raises
    ------
    EstimationError : an unknown limb, other parameters, an earlier calibration without uncertainty,
        or options with another method, a loss or a prior.
    """
    options = merge_options(options)
    if options.method is not None and not isinstance(options.method, LeastSquares):
        raise EstimationError(
            f"method is {options.method!r}; recalibration uses LeastSquares(), because the earlier "
            "calibration replaces the spreads"
        )
    if options.loss is not None or options.prior is not None:
        name = "loss" if options.loss is not None else "prior"
        raise EstimationError(f"recalibration takes no {name}. Remove it from the options")
    prior, free = prior_from(earlier), select_free_parameters(robot)
    for name in (*prior.names, *free.names):
        if name not in prior.names or name not in free.names:
            place = "the earlier run" if name in prior.names else "the robot file"
            raise EstimationError.of("prior.other-parameters", name=name, place=place)
    names = prior.names if free_limb is None else limb_parameters(robot, free_limb)
    alone = replace(options, method=None, noise="given", allow_fewer_equations=True)
    later = identify(robot, data, options=alone, progress=progress)
    change = assess_change(earlier, later, names, free_limb or MACHINE)
    if free_limb is not None:  # a freed limb is at its spreads again
        places = [free.names.index(name) for name in names]
        nominal, tolerance = free.nominal[places], free.tolerance[places]
        prior = prior.without(names).toleranced(names, nominal, tolerance)
    chosen = replace(options, prior=prior)
    fit = identify(robot, data, LeastSquares(), options=chosen, progress=progress)
    return replace(fit, findings=(*fit.findings, change.finding)), change


def assess_change(
    earlier: Posterior, later: Identification, names: tuple[str, ...], subject: str
) -> Change:
    """Test whether the parameters `names` are still those of an earlier calibration, by a fit of
    new rows alone; `subject` is their common name for the finding.
    """
    unknown = np.full(len(names), np.nan)
    code, changes = "prior.change-not-observable", None
    if not later.converged:
        code = "prior.change-not-converged"
    else:
        changes = compare_information(earlier, later.posterior)
        changes = changes.select([changes.names.index(name) for name in names])
    if changes is None or not changes.degrees:
        finding = report_finding(code, subject=subject)
        return Change(subject, names, unknown, 0.0, 0.0, np.nan, None, finding)
    judged = judge_change(changes, earlier.robot)
    finding = report_finding(f"prior.{judged.code}", subject=subject, **judged.data)
    shift = changes.estimate_shifts()[0]
    chi_square, degrees, p_value = changes.chi_square, float(changes.degrees), judged.p_value
    return Change(subject, names, shift, chi_square, degrees, p_value, judged.moved, finding)


# The change of parameters between two calibrations. Each gives rows B e = b + noise without
# tolerances (`DataInformation`). Let the machine have the parameters e at the first and e + d at
# the second. With both rows divided by their noise, stacked as M e = w, and an orthonormal basis Q
# of the vectors orthogonal to all columns of M, u = Q' w = D d + noise of unit variance, D = Q' (0;
# B_2), is all that can be said of d: directions that one of the data sets leaves open are gone,
# among them motions of frames that differ between the sessions. Without a change |u|^2 is a chi-
# square; the noise of both is estimated, see `compute_averaged_tail`. Other errors enter the
# covariance of u.

# Share of the largest singular value above which a column of both data sets is independent.
INDEPENDENT = 1e-9
DRAWS = 4999  # of values of unchanged machines, with which a change is compared
OF_NOISE = 2  # parts of the errors that are the noise of the two calibrations


class ErrorPart(NamedTuple):
    """A part of the noise of values, root root' (k, k), and its degrees of freedom."""

    root: FloatArray
    degrees: float


@dataclass(frozen=True, eq=False)
class ParameterChanges:
    """Rows `slope` d = `value` + noise of unit variance for the change d of p parameters."""

    names: tuple[str, ...]  # (p,) of the parameters
    unit: FloatArray  # (p,) tolerances, which make columns comparable [SI]
    slope: FloatArray  # (k, p) [1 / SI]
    value: FloatArray  # (k,) [1]
    # the independent parts of the noise; the sum of root root' is the unit matrix (k, k)
    errors: tuple[ErrorPart, ...]

    __repr__ = represent

    @property
    def degrees(self) -> int:
        """Number of directions that both data sets determine."""
        return len(self.value)

    @property
    def chi_square(self) -> float:
        """Of the change in all these directions."""
        return float(self.value @ self.value)

    @property
    def sources(self) -> tuple[tuple[float, float], ...]:
        """How much of the k degrees of freedom the noise of each calibration causes, and the
        degrees of freedom of its variance; then the same of all other errors together.
        """
        shares = [(float((part.root**2).sum()), part.degrees) for part in self.errors]
        if len(shares) <= OF_NOISE:
            return tuple(shares)
        total = sum(share for share, _ in shares[OF_NOISE:])
        squares = ((np.array(share), degrees) for share, degrees in shares[OF_NOISE:])
        return (*shares[:OF_NOISE], (total, float(combine_degrees(np.array(total), squares))))

    def compute_p_value(self, chi_square: float, degrees: int) -> float:
        """Return the tail probability of chi-square if nothing changed; NaN without a direction."""
        if degrees == 0 or not np.isfinite(chi_square):
            return float("nan")
        return statistics.compute_averaged_tail(chi_square, degrees, self.sources)

    def estimate_shifts(self) -> tuple[FloatArray, FloatArray]:
        """Return the change (p,) of each parameter and its standard deviation (p,) [SI], while all
        others may have changed as well; NaN where the data do not determine it.
        """
        gain, is_open = self._invert()
        shift = np.where(is_open, np.nan, gain @ self.value)
        sd = np.where(is_open, np.nan, np.linalg.norm(gain, axis=1))
        return self.unit * shift, self.unit * sd

    def test_shifts(self) -> FloatArray:
        """Return for each parameter (p,) the probability of a larger shift if nothing changed."""
        gain, is_open = self._invert()
        variance = (gain**2).sum(axis=1)
        squares = ((((gain @ e.root) ** 2).sum(axis=1), e.degrees) for e in self.errors)
        degrees = combine_degrees(variance, squares)
        square = (gain @ self.value) ** 2 / np.where(is_open, 1.0, variance)
        return np.where(is_open, np.nan, statistics.compute_f_tail(1.0, degrees, square))

    def _invert(self) -> tuple[FloatArray, BoolArray]:
        """Return the matrix (p, k) that gives the shifts in spreads of values, and which
        parameters (p,) it does not determine.
        """
        u, s, vt = np.linalg.svd(self.slope * self.unit, full_matrices=False)
        is_used = decomposition.are_nonzero(s, INDEPENDENT)
        basis = vt[is_used].T
        is_open = 1.0 - (basis**2).sum(axis=1) > decomposition.NULL_COMPONENT
        return (basis / s[is_used]) @ u[:, is_used].T, is_open

    def find_span(self, places: list[int]) -> FloatArray:
        """Return an orthonormal basis (k, c) of what changes of some parameters cause."""
        scaled = self.slope * self.unit
        u, s, _ = np.linalg.svd(scaled[:, places], full_matrices=False)
        largest = np.linalg.norm(scaled, 2) if scaled.size else 0.0
        return u[:, s > INDEPENDENT * largest]

    def select(self, places: list[int]) -> ParameterChanges:
        """Return what the data say if only these parameters may have changed."""
        basis = self.find_span(places).T
        return ParameterChanges(
            tuple(self.names[i] for i in places),
            self.unit[places],
            basis @ self.slope[:, places],
            basis @ self.value,
            tuple(ErrorPart(basis @ error.root, error.degrees) for error in self.errors),
        )

    def project_out(self, places: list[int]) -> tuple[float, int]:
        """Return chi-square left where some parameters may have changed, and its degrees."""
        explained = self.find_span(places).T @ self.value
        left = max(self.chi_square - float(explained @ explained), 0.0)
        return left, self.degrees - len(explained)

    def compute_probability(self) -> float:
        """Return the probability that unchanged parameters show a change as clear as this; NaN
        without a direction.

        What all parameters, each limb and each parameter explain of the values, |Q' u|^2, is an F
        statistic each, whose noise has the effective degrees of freedom of its parts. The smallest
        tail counts, each times 3 m if it is one of m tests of its kind (all, limb, parameter). Its
        distribution without a change is drawn, with the noise of each part and its estimate;
        beyond the resolution of the draws the smallest product bounds the probability (Bonferroni).
        """
        if not self.degrees:
            return float("nan")
        random = make_random_stream(0, 0)
        u = np.vstack([self.value, random.standard_normal((DRAWS, self.degrees))])
        sizes = np.ones((len(self.errors), len(u)))  # of the estimated variances, over the true
        for size, error in zip(sizes, self.errors, strict=True):
            if np.isfinite(error.degrees):
                size[1:] = random.chisquare(error.degrees, DRAWS) / error.degrees
        smallest = self._find_smallest(u, sizes)
        return float(min((smallest <= smallest[0]).mean(), smallest[0]))

    def bound_probability(self) -> float:
        """Return the smallest product of `compute_probability`, an upper bound of the probability
        that needs no draws; NaN without a direction.
        """
        sizes = np.ones((len(self.errors), 1))
        return float(self._find_smallest(self.value[None], sizes)[0]) if self.degrees else np.nan

    def _find_smallest(self, u: FloatArray, sizes: FloatArray) -> FloatArray:
        """Return the smallest product (n,) for values u (n, k), with estimated variances of the
        parts of the noise that are `sizes` (s, n) times the true ones.
        """
        every = list(range(len(self.names)))
        kinds = [[every], list(self.group_limbs().values()), [[i] for i in every]]
        causes = [(self.find_span(p), len(kinds) * len(kind)) for kind in kinds for p in kind]
        smallest = np.full(len(u), np.inf)
        for basis, weight in ((basis, weight) for basis, weight in causes if basis.size):
            rank = basis.shape[1]
            shares = np.array([((basis.T @ error.root) ** 2).sum() for error in self.errors])
            squares = zip(shares, (error.degrees for error in self.errors), strict=True)
            left = combine_degrees(np.array(float(rank)), squares)
            statistic = ((u @ basis) ** 2).sum(axis=1) / (shares @ sizes)
            smallest = np.minimum(
                smallest, weight * statistics.compute_f_tail(rank, left, statistic)
            )
        return smallest

    def group_limbs(self) -> dict[str, list[int]]:
        """Return the places of the parameters of each limb, which their names state first."""
        limbs: dict[str, list[int]] = {}
        for i, name in enumerate(self.names):
            if "." in name:
                limbs.setdefault(name.split(".")[0], []).append(i)
        return limbs


def compare_information(first: Posterior, second: Posterior) -> ParameterChanges:
    """Return what two calibrations of independent data say of a change of the machine.

    first, second : with `information`, of the same parameters.
    """
    before, after = first.information, second.information
    assert before is not None
    assert after is not None
    unit = first.unit
    sigmas = [np.sqrt(information.variance) for information in (before, after)]
    rows = (before.rows / sigmas[0], after.rows / sigmas[1])
    values = (before.deviations / sigmas[0], after.deviations / sigmas[1])
    # both deviations from the nominal values of the first
    offset = second.robot.nominal.values[second.places] - first.robot.nominal.values[first.places]
    values = (values[0], values[1] + rows[1] @ offset)
    scaled = [own * unit for own in rows]
    # neither determines these directions, each at its own linearization: the small angle between
    # the two would count as information
    common = decomposition.intersect_spaces(
        decomposition.find_null_space(scaled[0]), decomposition.find_null_space(scaled[1])
    )
    scaled = [own - (own @ common) @ common.T for own in scaled]
    stacked = np.vstack(scaled)
    u, s, _ = np.linalg.svd(stacked, full_matrices=True)
    rank = int(decomposition.are_nonzero(s, INDEPENDENT).sum()) if len(s) else 0
    left = u[:, rank:].T
    count = len(scaled[0])
    slope, value = left[:, count:] @ scaled[1] / unit, left @ np.concatenate(values)
    # rows are divided by the root of their covariance, which errors beside the noise increase
    errors = [ErrorPart(left[:, :count], before.degrees), ErrorPart(left[:, count:], after.degrees)]
    for posterior, combined, own in zip((first, second), errors[:2], (before, after), strict=True):
        changed = combined.root @ own.rows / np.sqrt(own.variance)
        errors += [
            ErrorPart(changed @ added.root, added.degrees)
            for added in posterior.parts
            # how far tolerances pull the estimate is no error of what the data say
            if added.is_added and added.source != INFLATION and np.isfinite(added.root).all()
        ]
    root = np.linalg.cholesky(np.sum([error.root @ error.root.T for error in errors], axis=0))

    def divide(values: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.solve(root, values), dtype=np.float64)

    return ParameterChanges(
        first.names,
        first.unit,
        divide(slope),
        divide(value[:, None])[:, 0],
        tuple(ErrorPart(divide(error.root), error.degrees) for error in errors),
    )


CAUSE_LEVEL = 0.01  # probability of rejecting the true cause of a change
COVERED = 1.96  # standard deviations of the half-width of a 95 % interval of a change
DISTINGUISHED = 0.05  # probability of distinguishing the true cause from a better one by chance


@dataclass(frozen=True)
class ChangeCause:
    """What explains a change."""

    kind: str  # "parameter", "limb", "limbs" (two of them) or "none" where no such cause suffices
    names: tuple[str, ...] = ()  # the best cause: a parameter, a limb or two limbs
    parameters: tuple[str, ...] = ()  # those that may change
    # other causes of this kind that the data cannot distinguish from it
    alternatives: tuple[tuple[str, ...], ...] = ()
    left: float = float("nan")  # chi-square that it leaves
    degrees: int = 0  # of freedom of this chi-square


def explain_change(changes: ParameterChanges, level: float) -> ChangeCause:
    """Return the simplest cause of a change; `level`: probability that a true one is rejected."""
    limbs = changes.group_limbs()
    kinds: dict[str, list[tuple[tuple[str, ...], list[int]]]] = {
        "parameter": [((name,), [i]) for i, name in enumerate(changes.names)],
        "limb": [((limb,), places) for limb, places in limbs.items()],
        "limbs": [
            ((first, second), [*limbs[first], *limbs[second]])
            for first, second in combinations(limbs, 2)
        ],
    }
    for kind, causes in kinds.items():
        results = [changes.project_out(places) for _, places in causes]
        p_values = [
            changes.compute_p_value(left, degrees) if degrees else 1.0 for left, degrees in results
        ]
        # a cause that leaves nothing to test explains any change
        tested = [i for i, (_, degrees) in enumerate(results) if degrees < changes.degrees]
        best = max(tested, key=lambda i: (p_values[i], -results[i][0]), default=-1)
        if best < 0 or p_values[best] < level or results[best][1] == 0:
            continue
        left, degrees = results[best]
        near = left + float(statistics.compute_chi_square_quantile(1.0, DISTINGUISHED))
        others = [
            causes[i][0]
            for i in sorted(tested, key=lambda i: results[i][0])
            if i != best and results[i][0] <= near
        ]
        names, places = causes[best]
        parameters = tuple(changes.names[i] for i in places)
        return ChangeCause(kind, names, parameters, tuple(others), left, degrees)
    return ChangeCause("none")


class JudgedChange(NamedTuple):
    """Whether a machine has changed, and what explains it.

    code, data : of its finding, without its family.
    p_value : see `ParameterChanges.compute_probability`. moved : whether it has changed.
    cause : of the change. shift, sd : (k,) change of its parameters [SI].
    """

    code: str
    data: dict[str, Any]
    p_value: float
    moved: bool
    cause: ChangeCause
    shift: FloatArray
    sd: FloatArray


def judge_change(
    changes: ParameterChanges, robot: Mechanism, tests: int = 1, level: float = CHANGE_LEVEL
) -> JudgedChange:
    """Test whether a machine has changed, one of a number of tests at `level` together."""
    p_value = changes.compute_probability()
    moved = bool(p_value < statistics.compute_single_level(level, tests))
    data: dict[str, Any] = {"chi_square": changes.chi_square, "degrees": float(changes.degrees)}
    too_small = 1.0 - changes.compute_p_value(changes.chi_square, changes.degrees)
    cause, shift, sd = ChangeCause("none"), np.zeros(0), np.zeros(0)
    if not moved and too_small < TOO_WELL:
        data["probability"] = too_small
        return JudgedChange("agree-too-well", data, p_value, moved, cause, shift, sd)
    data |= {"p_value": p_value, "level": level}
    if not moved:
        return JudgedChange("machine-unchanged", data, p_value, moved, cause, shift, sd)
    cause, size = explain_change(changes, CAUSE_LEVEL), ""
    if cause.parameters:
        shift, sd = changes.select([*map(changes.names.index, cause.parameters)]).estimate_shifts()
    if cause.kind == "parameter":
        unit = robot.get_unit(robot.parameters.dimensions[robot.parameters.index(cause.names[0])])
        value, half = (float(x[0]) / unit.factor_to_si for x in (shift, COVERED * sd))
        size = f"{value:+.3g} {unit.symbol} +/- {half:.2g} {unit.symbol}"
    alternatives = tuple(" and ".join(names) for names in cause.alternatives)
    data |= {"kind": cause.kind, "names": cause.names, "change": size}
    data["alternatives"] = alternatives
    return JudgedChange("machine-changed", data, p_value, moved, cause, shift, sd)
