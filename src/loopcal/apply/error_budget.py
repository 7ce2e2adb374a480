# SPDX-License-Identifier: Apache-2.0
"""The uncertainty budget of a calibration: parameters and poses by the sources of their errors.

The roots by source of `split_covariance` are taken to every parameter and, by the error model D, to
poses over the workspace, in the frame of `loopcal.diagnose.error_frames`. Poses have three more
errors: those of the frame itself (setup), those of the readings in use, where the actuators have a
sigma (repeatability), and what a model discrepancy leaves beyond the parameters. The squares of all
sources add up to the variance. What half a sigma would gain is computed from a covariance with all
weights changed, not from the part of the source. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from loopcal.diagnose import error_frames
from loopcal.diagnose.fit_examination import ROUNDING
from loopcal.errors import MechanismError
from loopcal.estimate.fit_linearization import (
    FitLinearization,
    RowSources,
    SourceFactor,
    divide_by_cluster,
    find_share,
    fold_sources,
    linearize_fit,
)
from loopcal.estimate.information import describe_frames, find_unfixed_motions
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.posterior import DISCREPANCY, INFLATION, NOISE, TOLERANCES, combine_degrees
from loopcal.estimate.problem import Problem
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.findings.wording import choose_symbol
from loopcal.measure.array_checks import drop_repeats
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations, StatedSize, find_size
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.decomposition import are_nonzero, find_null_space, substitute_backward
from loopcal.numerics.elimination import TreeElimination
from loopcal.numerics.statistics import find_distinct
from loopcal.results.description import OTHER, Field, fields, label_axes
from loopcal.results.result import DrawnResult
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

# Kinds of sources; others are the codes of the findings with which a covariance was added.
INSTRUMENT, READINGS, SETUP, COMMON = "instrument", "readings", "setup", "common"
EARLIER, REPEATABILITY = "earlier calibration", "repeatability"
# Kinds of sources whose errors the fit weighs against each other.
OF_ROWS = (INSTRUMENT, READINGS, SETUP, COMMON, TOLERANCES, EARLIER)
PRIOR = "prior."  # begins codes of findings on the spreads, whose errors count as theirs
POSES, SEED = 200, 0  # number and seed of the poses that are drawn from the workspace
NEGLIGIBLE = 0.01  # share of an expected error below which the sentence leaves out a source
LENGTHS = {"position": Dimension.LENGTH, "orientation": Dimension.ANGLE}
AS_STATED = "noise.setup-as-stated"  # code of a finding
SOURCE_WORDS = {
    INSTRUMENT: "instrument: {name}",
    READINGS: "actuator readings",
    SETUP: "setup parameters",
    COMMON: "common error: {name}",
    TOLERANCES: "expected spreads",
    EARLIER: "earlier calibration",
    REPEATABILITY: "repeatability in use",
    DISCREPANCY: "model discrepancy: {name}",
    "residuals.correlated": "correlated errors",
    "residuals.drift": "drift",
    "residuals.trend": "trend",
    "residuals.sessions-differ": "differences of sessions",
    "residuals.shared-errors": "shared errors",
    "residuals.depend-on-temperature": "temperature",
    "residuals.depend-on-reading": "dependence on a reading",
    INFLATION: "factor on the expected spreads",
    AS_STATED: "setup parameters and common errors",
}


# Split the covariance of a fit by the sources of its errors, and compute it for other sigmas.


class Source(NamedTuple):
    """A source of errors."""

    # one of the kinds above, "residuals.model-discrepancy", or the code of another finding
    kind: str
    # of the measurement with its session; of a common error of an instrument, such as
    # `tracker.scale`; "position" or "orientation" of a discrepancy; of other sources empty
    name: str
    # "A" by statistics, "B" by other means (JCGM 100, 3.3), "A and B" where a stated value was
    # corrected by statistics
    evaluation: str
    degrees: float  # degrees of freedom; infinite where the size counts as known
    size: StatedSize | None = None  # as stated, where one number states it
    # standard uncertainty in its unit, with the factor on all stated sigmas that the residuals gave
    u: float | None = None

    @property
    def words(self) -> str:
        """What people read."""
        words = SOURCE_WORDS.get(self.kind)
        return self.kind if words is None else words.format(name=self.name)


class NumberedSources(NamedTuple):
    """The sources of the noise of rows."""

    sizes: dict[tuple[str, str], StatedSize | None]  # by kind and name, in the order of numbers
    rows: list[RowSources]  # by number, of every kind


class CovarianceSplit(NamedTuple):
    """The covariance of the parameters of a fit, by source."""

    sources: tuple[Source, ...]  # of errors
    roots: tuple[FloatArray, ...]  # (p, k) [SI] for each, whose squares add up to the covariance
    # (p,) parameters of infinite variance, of which the roots contain what the spreads allow
    undetermined: BoolArray
    numbered: NumberedSources
    factors: tuple[SourceFactor, ...]  # of the numbered sources


def split_covariance(linear: FitLinearization) -> CovarianceSplit:
    """Return the covariance of a fit with intervals by source."""
    fit = linear.fit
    degrees = {part.source: part.degrees for part in reversed(fit.posterior.parts)}
    of_noise, of_size = (degrees.get(source, np.inf) for source in (NOISE, TOLERANCES))
    test = fit.residual_test
    evaluation = "A and B" if np.isfinite(of_noise) else "B"
    if test.noise == "estimated" or test.failed:
        evaluation = "A"
    numbered = _number_sources(linear)
    names, members = numbered
    noise = float(np.sqrt(linear.sources.noise))

    def state(kind: str, name: str, size: StatedSize | None, of: str, nu: float) -> Source:
        u = None if size is None else noise * size.value / size.divisor
        return Source(kind, name, of, nu, size, u)

    sources = [state(*key, size, evaluation, of_noise) for key, size in names.items()]
    factors = fold_sources(linear.problem, linear.linearization, members, len(names))
    of_rows = tuple(factors)
    common, estimate = list_common_errors(linear.problem), linear.linearization.nuisance
    for (kind, name), rows in _list_further_rows(linear, common):
        size = _find_common_size(linear, common, name) if kind == COMMON else None
        for each in rows:
            factors += divide_by_cluster(len(sources), *each, len(fit.names), estimate)
        sources.append(state(kind, name, size, "B", np.inf))
    own = _propagate(linear, factors)
    evaluation_of_size = "B (assumed)" if fit.free_parameters.assumed.any() else "B"
    evaluation_of_size = "A and B" if np.isfinite(of_size) else evaluation_of_size
    sources.append(Source(TOLERANCES, "", evaluation_of_size, of_size))
    noise_of = [sources[factor.source] for factor in factors]
    kept = np.array([source.kind != COMMON for source in noise_of])
    is_setup = np.array([not name for name in common], dtype=bool)
    rest, of_setup = own, own[0][:, :0]
    if estimate is not None:
        given = own, factors, kept, is_setup
        rest, of_setup = _separate_setup(*given, estimate.elimination, noise)
    by_source = [*zip([*noise_of, sources[-1]], rest, strict=True)]
    by_source += [(source, own[0][:, :0]) for source in sources]  # also those without rows
    if is_setup.any():  # rows of stated setup parameters act by these alone
        by_source.append((Source(SETUP, "", evaluation, of_noise), of_setup))
    merged: dict[Source, list[FloatArray]] = {}
    setup = next((source for source, _ in by_source if source.kind == SETUP), None)
    for source, root in by_source:
        key = setup if source.kind == SETUP and setup is not None else source
        merged.setdefault(key, []).append(root)
    for part in (part for part in fit.posterior.parts if part.is_added):
        name, slow = "", fit.posterior.discrepancy
        if part.source == DISCREPANCY and slow is not None:
            is_place, _, root = slow.parts[-1]
            is_place = is_place and np.array_equal(part.root, root)
            name = "position" if is_place else "orientation"
        key = Source(part.source, name, "B" if part.source == AS_STATED else "A", part.degrees)
        merged.setdefault(key, []).append(part.root / fit.tolerance[:, None])
    joined = (np.concatenate(each, axis=1) for each in merged.values())
    # what many rows do is as well a root of as many columns as parameters
    short = (
        np.asarray(np.linalg.qr(x.T, mode="r")).T if x.shape[1] > len(x) else x for x in joined
    )
    roots = tuple(fit.tolerance[:, None] * root for root in short)
    undetermined = np.isinf(np.diag(fit.covariance))
    return CovarianceSplit(tuple(merged), roots, undetermined, numbered, of_rows)


def _halve_sigma(
    linear: FitLinearization, split: CovarianceSplit, source: Source, *, moves_frames: bool
) -> tuple[FloatArray, Linearization, Problem] | None:
    """Return a root (p, k) [SI] of the covariance without added parts if the sigma of a source of
    rows or of the spreads were half as large, with its linearization; None for other sources.

    Every weight is that of the smaller sigma. Estimates stay, and so does a scale of the noise that
    the residuals gave. Where all rows of a source are alone in their clusters of setup parameters,
    these follow them as before, and only the factor of the machine changes; whether frames of
    instruments are asked for, too, is `moves_frames`.
    """
    fit, problem, weight = linear.fit, linear.problem, 1.0
    nuisance, (of_rows, members) = problem.nuisance, split.numbered
    p, at = len(fit.names), linear.linearization
    if not moves_frames and (rows := _find_rows_alone(problem, split, source)) is not None:
        triangle = np.concatenate([at.factor[0, :p, :p], np.sqrt(3.0) * rows])
        triangle = np.asarray(np.linalg.qr(triangle, mode="r"))
        own = _propagate(linear, _make_factors(triangle))
        return fit.tolerance[:, None] * np.concatenate(own, axis=1), at, problem
    if source.kind == TOLERANCES:
        weight = 4.0
    elif (named := (source.kind, source.name)) in of_rows:
        number, rows = list(of_rows).index(named), []
        for of_kind, own in zip(problem.rows, members, strict=True):
            root = find_share(own, number)
            left, axes = np.linalg.eigh(
                np.eye(root.shape[1]) - 0.75 * np.swapaxes(root, 1, 2) @ root
            )
            factor = axes / np.sqrt(left)[:, None, :] @ np.swapaxes(axes, 1, 2)
            whitener = drop_repeats(of_kind.whitener)  # rows of one covariance share one matrix
            whitener = factor * whitener if root.shape[1] == 1 else factor @ whitener
            whitener = np.broadcast_to(whitener, of_kind.whitener.shape)
            rows.append(replace(of_kind, whitener=whitener))
        problem = problem.with_rows(rows)
    elif source.kind in (SETUP, COMMON) and nuisance is not None and nuisance.has_prior.any():
        local = nuisance.local
        for entry, name in zip(local.table.entries, list_common_errors(problem), strict=True):
            if name == source.name and entry.free and entry.tolerance is not None:
                local = local.with_prior(entry.name, 0.5 * entry.tolerance)
        poses = replace(problem.poses, nuisance=replace(nuisance, local=local))
        problem = replace(problem, poses=poses)
    else:
        return None
    linearization = problem.linearize(at.deviation, at.next_start)
    if fit.options.prior is not None:
        linearization = fit.options.prior.added(problem).append(linearization)
    factor = linearization.factor[0, :p, :p]
    own = _propagate(linear, _make_factors(factor), weight)
    return fit.tolerance[:, None] * np.concatenate(own, axis=1), linearization, problem


def _make_factors(rows: FloatArray) -> list[SourceFactor]:
    """Return rows (m, p) of one source that move the machine alone."""
    return [SourceFactor(0, np.zeros(0, dtype=np.int64), rows[:, :0], rows)]


def _find_rows_alone(problem: Problem, split: CovarianceSplit, source: Source) -> FloatArray | None:
    """Return the rows (m, p) of a source, setup parameters eliminated, if their setup parameters
    have no prior and no rows of another source; None for others.
    """
    of_rows, members = split.numbered
    named = source.kind, source.name
    if named not in of_rows or problem.is_uncertain:
        return None
    number = list(of_rows).index(named)
    shares = [root for parts in members for numbers, root in parts if (numbers == number).any()]
    own = [factor for factor in split.factors if factor.source == number]
    moved = {int(i) for factor in own for i in factor.unknowns}
    others = (f.unknowns[:1].tolist() for f in split.factors if f.source != number)
    is_shared = any(first and first[0] in moved for first in others)
    has_prior = problem.nuisance is not None and problem.nuisance.has_prior[list(moved)].any()
    if is_shared or has_prior or not own or any(root is not None for root in shares):
        return None
    return np.concatenate([factor.machine for factor in own])


def _name(rows: Observations, session: str, data: Measurements) -> str:
    """Return a kind with its session, and its frame where several instruments measure the same."""
    name = rows.kind.name
    alike = [o for o in data.observations if len(o) and o.kind.name == name and o is not rows]
    frame = getattr(rows.kind, "frame", None)
    if any(getattr(o.kind, "frame", None) != frame for o in alike):
        name = f"{name} in {frame}"
    name = f"{name} of the base" if rows.kind.is_of_base else name
    return f"{name}, {session}" if session else name


def _number_sources(linear: FitLinearization) -> NumberedSources:
    """Return the sources of the noise of rows."""
    data, problem = linear.data, linear.problem
    numbers: dict[tuple[str, str], int] = {}
    sizes: dict[tuple[str, str], StatedSize | None] = {}
    members: list[RowSources] = []
    for rows in (o for o in data.all_observations if len(o)):
        parts = []
        for name, size, root in rows.split_noise():
            labels = [(_name(rows, session, data), name) for session in rows.session.tolist()]
            keys = [(INSTRUMENT, ", ".join(filter(None, label))) for label in labels]
            sizes |= {k: size if sizes.get(k, size) == size else None for k in keys}
            parts.append((np.array([numbers.setdefault(k, len(numbers)) for k in keys]), root))
        members.append(parts)
    if problem.is_uncertain:
        number = numbers.setdefault((READINGS, ""), len(numbers))
        members.append([(np.full(len(problem.rows[-1].poses), number), None)])
        sizes[READINGS, ""] = _find_drive_size(linear.fit.robot, data.reading_sigma)
    return NumberedSources(sizes, members)


def _find_drive_size(robot: Mechanism, sd: FloatArray | None) -> StatedSize | None:
    """Return the size that the robot file states for the errors of all readings; None where the
    `sd` in use is another, such as one that residuals gave.
    """
    known = robot.stated_sigma
    is_stated = sd is not None and np.array_equal(sd, np.broadcast_to(known, np.shape(sd)))
    return find_size(known, {a.dimension for a in robot.actuators}) if is_stated else None


def _find_common_size(linear: FitLinearization, common: list[str], name: str) -> StatedSize | None:
    """Return the size of a common error of an instrument; None where its components differ."""
    stated = (v for v in linear.data.stated_values if v.size is not None)
    of_name = {v.size for v in stated if v.name == name or v.name.endswith(f".{name}")}
    if of_name or linear.problem.nuisance is None:
        return of_name.pop() if len(of_name) == 1 else None
    table, chosen = linear.problem.nuisance.local.table, [owner == name for owner in common]
    return find_size(table.tolerance[chosen], itertools.compress(table.dimensions, chosen))


def list_common_errors(problem: Problem) -> list[str]:
    """Return for each of U setup parameters the common error of an instrument that it is, such as
    `tracker.bias` for a component in a session; empty for frames and others, or without a prior.
    """
    nuisance = problem.nuisance
    if nuisance is None:
        return []
    names = [""] * len(nuisance)
    for rows in problem.rows:
        for i, name in rows.kind.common_errors.items():
            for k in find_distinct(rows.nuisance[:, i]):
                names[k] = name if nuisance.has_prior[k] else ""
    return names


def _list_further_rows(
    linear: FitLinearization, common: list[str]
) -> list[tuple[tuple[str, str], list[tuple[IntArray, FloatArray]]]]:
    """Return kind, name and rows of stated setup parameters, of common errors, and of an earlier
    calibration, as arguments of `divide_by_cluster`.
    """
    rows, prior = [], linear.fit.options.prior
    problem, estimate = linear.problem, linear.linearization.nuisance
    if problem.nuisance is not None and estimate is not None and problem.nuisance.has_prior.any():
        stated = problem.nuisance.has_prior
        names, sd = np.array(common), problem.nuisance.local.table.tolerance
        done = estimate.elimination
        for name in find_distinct(names[stated]).tolist():
            parts = []
            for s, root in zip(done.tree.structures, done.roots, strict=True):
                place, column = np.nonzero((stated & (names == name))[s.unknowns])
                own = s.unknowns[place, column]
                both = np.concatenate([root[0, place, column], done.slope[0, own]], axis=1)
                parts.append((s.path[place], (both / sd[own, None])[:, None]))
            rows.append(((COMMON if name else SETUP, name), parts))
    if prior is not None:
        measured = problem.linearize(
            linear.linearization.deviation, linear.linearization.next_start
        )
        slope = prior.added(problem).list_slopes(measured)[0]
        rows.append(((EARLIER, ""), [(np.zeros((len(slope), 0), np.int64), slope[:, None])]))
    return rows


def _propagate(
    linear: FitLinearization, factors: Sequence[SourceFactor], weight: float = 1.0
) -> list[FloatArray]:
    """Return for each factor of rows, and for the spreads at the end, the error of the machine
    (p, k) [tolerances].

    With [A; P^(1/2)] = Q R, b A_k' is R^-1 Q_k'. A'A is never formed. A direction that is not
    estimated has its spread. The penalty P is that of the fit times a weight.
    """
    used, noise = linear.is_estimated, float(np.sqrt(linear.sources.noise))
    to_z = linear.decomposition.directions[0]
    penalty = np.diag(np.sqrt(weight * np.where(used, linear.penalty[0], 1.0)))
    spread = np.where(used, linear.spread, 1.0)
    own = [factor.machine @ to_z * used for factor in factors]
    Q, R = np.linalg.qr(np.concatenate([*own, penalty]))
    *of_rows, of_penalty = np.split(Q, np.cumsum([len(rows) for rows in own]))
    whitened = [*(noise * q.T for q in of_rows), (of_penalty * spread[:, None]).T]
    return [to_z @ substitute_backward(R, each) for each in whitened]


def _separate_setup(
    errors: list[FloatArray],
    factors: Sequence[SourceFactor],
    kept: BoolArray,
    is_setup: BoolArray,
    done: TreeElimination,
    noise: float,
) -> tuple[list[FloatArray], FloatArray]:
    """Return the errors e (p, k) of the machine that are uncorrelated with those of the setup
    parameters, for each factor and for the spreads, and a root (p, r + p) of the others.

    Factors that are not `kept`, common errors of an instrument, stay whole: they also move frames,
    and would seem to be errors of these. is_setup : (U,) parameters that are no such errors.
    noise : factor on the stated sigmas of rows.

    The setup parameters move by W = D + S e, with D in blocks, one for each cluster, along what
    rows determine of them: start values decide the rest, and errors cannot depend on these. With
    D = V s Q', the rows of W are spanned by Q' + (V'S / s) e = Q' + H e, and by N e where s is
    zero. With y = e Q and e - y Q' = F Z, a vector Q a + Z' b is without part in these rows if

        a = -H t,  (1 + y H) t = F b,  N t = 0,

    a null space of p unknowns t and b, however many clusters there are.
    """
    p, slope, root, null = len(errors[0]), done.slope[0], done.list_root(), done.null_directions()
    members: dict[int, list[int]] = {}
    for i in np.flatnonzero(kept).tolist():
        cluster = done.tree.cluster[factors[i].unknowns[:1]]
        members.setdefault(int(cluster[0]) if len(cluster) else -1, []).append(i)
    members.setdefault(-1, []).append(len(factors))
    order = [i for group in members.values() for i in group]
    left, Q, H, N, y = {i: errors[i] for i in order}, {}, [], [np.zeros((0, p))], []
    for c, group in members.items():
        unknowns = np.flatnonzero((done.tree.cluster == c) & is_setup)
        if c < 0 or not len(unknowns):
            continue
        whole = factors[group[0]].unknowns
        motion = noise * np.concatenate([factors[i].setup for i in group]).T
        D = root.fill(whole)[is_setup[whole]] @ motion
        e = np.concatenate([errors[i] for i in group], axis=1)
        length, own = done.length[0][unknowns, None], null[unknowns]
        own = length * own[:, own.any(axis=0)]  # no row decides along these
        axes = np.linalg.qr(own, mode="complete")[0][:, own.shape[1] :].T
        V, s, Qt = np.linalg.svd(axes @ (length * D))
        rank = int(are_nonzero(s).sum()) if s.any() else 0
        turned = V.T @ (axes @ (length * slope[unknowns]))
        H.append(turned[:rank] / s[:rank, None])
        N.append(turned[rank:])
        y.append(e @ Qt[:rank].T)
        ends = np.cumsum([errors[i].shape[1] for i in group])[:-1]
        for i, inside in zip(group, np.split(Qt[:rank], ends, axis=1), strict=True):
            Q[i] = len(H) - 1, inside
            left[i] = errors[i] - y[-1] @ inside
    if not H:
        return list(errors), np.zeros((p, 0))
    Z, F = np.linalg.qr(np.concatenate([left[i] for i in order], axis=1).T)
    rows, inner = np.concatenate(H), np.concatenate([*y, F.T], axis=1)
    conditions = np.block([[np.eye(p) + inner[:, : len(rows)] @ rows, -F.T]])
    absent = np.concatenate(N)
    absent = np.concatenate([absent, np.zeros((len(absent), F.shape[0]))], axis=1)
    null = find_null_space(np.concatenate([conditions, absent]))
    free = np.linalg.qr(np.concatenate([-rows @ null[:p], null[p:]]))[0]
    along = inner @ free
    separated, first = list(errors), np.cumsum([0, *(len(each) for each in H)])
    ends = np.cumsum([errors[i].shape[1] for i in order])[:-1]
    for i, outside in zip(order, np.split(Z, ends), strict=True):
        separated[i] = along @ (free[first[-1] :].T @ outside.T)
        if i in Q:
            block, inside = Q[i]
            separated[i] += along @ (free[first[block] : first[block + 1]].T @ inside)
    return separated, inner - along @ free.T


class ErrorSources(NamedTuple):
    """Variances [m^2 or rad^2] of the length of an error, mean over poses, by kind of source.

    `common` are those that all values of an instrument share, such as its scale; `other` the
    covariances that findings added, such as for correlated errors.
    """

    instrument: float
    setup: float
    tolerances: float
    repeatability: float
    readings: float = 0.0
    earlier: float = 0.0
    discrepancy: float = 0.0
    other: float = 0.0
    common: float = 0.0

    @property
    def rms(self) -> float:
        """Root mean square of the error from all sources [m or rad]."""
        return float(np.sqrt(sum(self)))


class HalvedErrors(NamedTuple):
    """Root mean squares of position [m] and orientation [rad] from all sources with one sigma
    halved, and the standard deviations (p,) of the parameters [SI].
    """

    position: float
    orientation: float
    parameters: FloatArray


@dataclass(frozen=True, eq=False)
class SourceBudget:
    """What one source does, and what half its sigma would leave."""

    source: Source  # kind, name, type of evaluation and degrees of freedom
    # position, orientation: variances [m^2, rad^2] of the length of the error of a pose
    position: float
    orientation: float
    parameters: FloatArray  # (p,) variances [SI]; NaN for undetermined parameters
    # root mean squares with half the sigma of this source; None where it has no sigma
    halved: HalvedErrors | None


@dataclass(frozen=True, eq=False, repr=False)
class ErrorBudget(DrawnResult):
    """The uncertainty of the parameters and of poses over the workspace, by source.

    position, orientation : variances of the tool's place and of the rotation, by kind of source.
    lines : every source. sd : (p,) standard deviations of the parameters `names` [SI]; infinite for
        undetermined ones. worst : name of the determined parameter with the largest standard
        deviation in spreads; empty where none is determined.
    poses : number of poses. is_workspace : whether they are drawn from the workspace of the robot;
        otherwise they are those that were measured.
    finding : the errors of poses with their frame, in one sentence.
    """

    position: ErrorSources
    orientation: ErrorSources
    lines: tuple[SourceBudget, ...]
    names: tuple[str, ...]
    sd: FloatArray
    worst: str
    poses: int
    is_workspace: bool
    finding: Finding

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(
            position=lambda b: b._describe("position"),
            orientation=lambda b: b._describe("orientation"),
            parameters=lambda b: dict(zip(b.names, b.sd.tolist(), strict=True)),
            worst_parameter="worst",
            sources=lambda b: [b._list_line(line) for line in b.lines],
            poses="poses",
            over=lambda b: "workspace" if b.is_workspace else "measured poses",
            frame="finding.data.frame",
            finding="finding",
        ),
        Field("type", "lines.source.evaluation", "source"),
        Field("degrees", "lines.source.degrees", "source", "1"),
        Field("position", lambda b: np.sqrt([x.position for x in b.lines]), "source", "m"),
        Field("orientation", lambda b: np.sqrt([x.orientation for x in b.lines]), "source", "rad"),
        Field("position_if_halved", "lines.halved.position", "source", "m"),
        Field("orientation_if_halved", "lines.halved.orientation", "source", "rad"),
        Field(
            "parameter_variance",
            lambda b: np.reshape([line.parameters for line in b.lines], (-1, len(b.names))),
            f"source {OTHER}",
            "square of the SI unit",
        ),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(source="lines.source.words", other="names")

    @property
    def summary(self) -> Finding:
        """The errors of poses without their sources, in one sentence."""
        data = self.finding.data
        errors = tuple(data[name][0] for name in LENGTHS if data[name])
        return report_finding("accuracy.typical", **{**data, "errors": errors})

    def _describe(self, kind: str) -> dict[str, Any]:
        """Return the errors of a kind for JSON, with their effective degrees of freedom.

        Sources that the residuals scale together are one part, as their size is estimated once.
        """
        parts: dict[str, tuple[float, float]] = {}
        for line in self.lines:
            source, square = line.source, getattr(line, kind)
            shared = NOISE if source.kind in (INSTRUMENT, READINGS, SETUP) else source.words
            before, nu = parts.get(shared, (0.0, source.degrees))
            parts[shared] = (before + square, min(nu, source.degrees))
        errors = getattr(self, kind)
        squares = [(np.array(square), nu) for square, nu in parts.values()]
        degrees = float(combine_degrees(np.array(errors.rms**2), squares))
        finite = degrees if np.isfinite(degrees) else None
        return {"rms": errors.rms, "degrees": finite, "variances": errors._asdict()}

    def _list_line(self, line: SourceBudget) -> dict[str, Any]:
        """Return a source by name for JSON."""
        halved = None
        if line.halved is not None:
            sd = dict(zip(self.names, line.halved.parameters.tolist(), strict=True))
            halved = {
                "position_rms": line.halved.position,
                "orientation_rms": line.halved.orientation,
                "worst_parameter_sd": sd.get(self.worst),
            }
        degrees = line.source.degrees if np.isfinite(line.source.degrees) else None
        size = line.source.size
        stated = None if size is None else {**asdict(size), "u": line.source.u}
        identity = line.source._asdict()
        return {
            **{key: identity[key] for key in ("kind", "name", "evaluation")},
            "words": line.source.words,
            "stated": stated,
            "degrees": degrees,
            "position": line.position,
            "orientation": line.orientation,
            "parameters": dict(zip(self.names, line.parameters.tolist(), strict=True)),
            "halved": halved,
        }


def compute_error_budget(
    fit: Identification,
    data: Measurements,
    frame: str = error_frames.FITTED,
    linear: FitLinearization | None = None,
) -> ErrorBudget | None:
    """Return the uncertainty budget of a calibrated machine; None where the fit has no intervals,
    or where no pose is reached.

    frame : in which the errors of poses are stated, see `choose_error_frame`; "relative" means
        relative to the home pose. linear : the linearized fit, see `linearize_fit`.
    """
    if not (fit.converged and fit.residual_test.intervals):
        return None
    linear = linearize_fit(fit, data, linear)
    is_workspace = True
    try:
        drawn = sample_workspace(fit.robot, POSES, SEED).solution
        solution = drawn.take(np.flatnonzero(drawn.converged))
    except MechanismError:  # the robot states no workspace
        solution, is_workspace = error_frames.locate_measured_poses(fit, linear.data, POSES), False
    if not len(solution.q):
        return None
    effects = error_frames.linearize_tool_errors(fit.posterior, solution, frame)
    split = split_covariance(linear)
    lines = _list_sources(fit, split, effects, is_relative=frame == error_frames.RELATIVE)
    sd = np.sqrt(sum(line.parameters for line in lines))
    sd = np.where(split.undetermined, np.inf, sd)
    given = lines, solution, frame, effects
    halved = [_halve(linear, split, each, *given) for each in lines]
    lines = [replace(line, halved=of_line) for line, of_line in zip(lines, halved, strict=True)]
    position, orientation = _add_kinds(lines)
    n = len(solution.q)
    finding = _word(fit, (position, orientation), n, is_workspace, effects.reference)
    shares = np.where(np.isfinite(sd), sd / fit.tolerance, -1.0)
    worst = fit.names[int(np.argmax(shares))] if shares.max(initial=-1.0) > 0.0 else ""
    return ErrorBudget(
        position, orientation, tuple(lines), fit.names, sd, worst, n, is_workspace, finding
    )


def _list_sources(
    fit: Identification,
    split: CovarianceSplit,
    effects: error_frames.ToolErrors,
    *,
    is_relative: bool,
) -> list[SourceBudget]:
    """Return every source with its variances.

    Errors of the frame itself are those of the set-up; those of the reference pose of relative
    errors are repeatability.
    """
    D = effects.by_parameters / fit.posterior.unit
    lines = []
    for source, root in zip(split.sources, split.roots, strict=True):
        twists = D @ root
        if source.kind == DISCREPANCY and (slow := fit.posterior.discrepancy) is not None:
            # columns of the directions, then of what each pose has of its own
            is_own = next(own for of, own, _ in slow.parts if of == (source.name == "position"))
            centers = len(slow.errors.centers)
            chosen = np.concatenate([np.repeat(is_own, centers), is_own])
            twists = effects.by_discrepancy[..., chosen]
        if source.kind == SETUP and not is_relative:
            twists = np.concatenate([twists, effects.by_frame], axis=2)
        variances = np.where(split.undetermined, np.nan, (root**2).sum(axis=1))
        angle, position = error_frames.compute_mean_squares(twists)
        lines.append(SourceBudget(source, position, angle, variances, None))
    repeated = effects.by_readings
    if is_relative:
        repeated = np.concatenate([repeated, effects.by_frame], axis=2)
    if repeated.any():
        angle, position = error_frames.compute_mean_squares(repeated)
        nothing = np.where(split.undetermined, np.nan, 0.0)
        size = _find_drive_size(fit.robot, fit.posterior.repeatability)
        source = Source(REPEATABILITY, "", "B", np.inf, size, size and size.value)
        lines.append(SourceBudget(source, position, angle, nothing, None))
    return lines


def _halve(
    linear: FitLinearization,
    split: CovarianceSplit,
    line: SourceBudget,
    lines: list[SourceBudget],
    solution: Solution,
    frame: str,
    effects: error_frames.ToolErrors,
) -> HalvedErrors | None:
    """Return the errors from all sources with half the sigma of one."""
    fit = linear.fit
    position, orientation = (sum(getattr(each, name) for each in lines) for name in LENGTHS)
    parameters = sum(each.parameters for each in lines)
    if line.source.kind in OF_ROWS:
        moves_frames = frame not in (error_frames.FITTED, error_frames.BASE, error_frames.RELATIVE)
        halved = _halve_sigma(linear, split, line.source, moves_frames=moves_frames)
        if halved is None:
            return None
        root, linearization, problem = halved
        if moves_frames:
            at = linearization.deviation, linearization.next_start
            found, prior = find_unfixed_motions(problem, *at), fit.options.prior
            noise = fit.residual_test.sigma_scale**2
            frames = describe_frames(problem, linear.data, found, prior, linearization, noise)
            posterior = replace(fit.posterior, discrepancy=None, frames=frames)
            effects = error_frames.linearize_tool_errors(posterior, solution, frame)
        D, own = effects.by_parameters / fit.posterior.unit, effects.by_frame
        own = own[..., :0] if frame == error_frames.RELATIVE else own
        angle, place = error_frames.compute_mean_squares(np.concatenate([D @ root, own], axis=2))
        kept = [each for each in lines if each.source.kind not in OF_ROWS]
        place += sum(each.position for each in kept)
        angle += sum(each.orientation for each in kept)
        rest = sum((each.parameters for each in kept), np.zeros(len(root)))
        variances = rest + np.where(np.isnan(parameters), np.nan, (root**2).sum(axis=1))
    else:
        place, angle = position - 0.75 * line.position, orientation - 0.75 * line.orientation
        variances = parameters - 0.75 * line.parameters
    return HalvedErrors(float(np.sqrt(place)), float(np.sqrt(angle)), np.sqrt(variances))


def _add_kinds(lines: list[SourceBudget]) -> tuple[ErrorSources, ErrorSources]:
    """Return the variances of position and orientation by kind of source."""
    sums = {name: dict.fromkeys(ErrorSources._fields, 0.0) for name in LENGTHS}
    names = {DISCREPANCY: "discrepancy", EARLIER: "earlier"}
    names[AS_STATED] = "other" if any(line.source.kind == COMMON for line in lines) else SETUP
    for line in lines:
        kind = names.get(line.source.kind, line.source.kind)
        kind = TOLERANCES if kind.startswith(PRIOR) else kind
        for name, total in sums.items():
            total[kind if kind in total else "other"] += getattr(line, name)
    return ErrorSources(**sums["position"]), ErrorSources(**sums["orientation"])


def _word(
    fit: Identification,
    errors: tuple[ErrorSources, ErrorSources],
    poses: int,
    is_workspace: bool,
    reference: Finding,
) -> Finding:
    """Return the errors in one sentence."""
    stated: dict[str, Any] = {}
    for (name, dimension), sources in zip(LENGTHS.items(), errors, strict=True):
        size = fit.robot.size if dimension is Dimension.LENGTH else 1.0
        stated[name] = None
        if sources.rms > ROUNDING * size:
            sizes = {
                key: rms
                for key, value in sources._asdict().items()
                if (rms := float(np.sqrt(value))) > NEGLIGIBLE * sources.rms
            }
            least = fit.robot.to_quantity(min(sizes.values(), default=sources.rms), dimension)
            symbol, factor = choose_symbol(least.value, least.unit)  # one unit for all
            total, *parts = (
                Quantity(factor * fit.robot.to_quantity(rms, dimension).value, symbol)
                for rms in (sources.rms, *sizes.values())
            )
            stated[name] = (total, dict(zip(sizes, parts, strict=True)))
    return report_finding(
        "accuracy.budget",
        **stated,
        poses=poses,
        is_workspace=is_workspace,
        tolerances_assumed=bool(fit.free_parameters.assumed.any()),
        repeatability_stated=bool(fit.posterior.repeatability.any()),
        **reference.data,
    )
