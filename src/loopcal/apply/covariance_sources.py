# SPDX-License-Identifier: Apache-2.0
"""Split the covariance of a fit by the sources of its errors, and compute it for other sigmas.

The estimate is a linear function of independent errors: the noise of every row, the deviations from
nominal that the tolerances allow, and what was added to the covariance. With the projected rows A_k
of source k, the penalty P, b = (sum A_k'A_k + P)^-1, and the rows N_k by the errors of the setup
parameters at a known machine,

    error of the machine            e = b A_k' noise_k + ... + b P^(1/2) deviation
    error of the setup parameters   s = S e + T (N_k' noise_k + ...)

Part of e belongs to s: e = G s + the rest, uncorrelated. G s is what not knowing the setup adds.
The rest is the error with a known setup, and its squares add up over the sources, whatever their
order; only the setup comes first. A source never has a negative part.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal.estimate.fit_linearization import FitLinearization, linearize_rows_of
from loopcal.estimate.inference.covariance_parts import NOISE, TOLERANCES, CovariancePart
from loopcal.estimate.inference.model_discrepancy import DISCREPANCY
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.poses.source_rows import fold_sources
from loopcal.estimate.problem import Problem
from loopcal.estimate.result import Identification
from loopcal.measure import Measurements, Observations
from loopcal.numerics.back_substitution import substitute_backward
from loopcal.numerics.decomposition import are_nonzero
from loopcal.typing import BoolArray, FloatArray, IntArray

INSTRUMENT, READINGS, SETUP = "instrument", "readings", "setup"
EARLIER, REPEATABILITY = "earlier calibration", "repeatability"
"""Kinds of sources; others are the codes of the findings with which a covariance was added."""


class Source(NamedTuple):
    """A source of errors.

    Attributes
    ----------
    kind : one of the kinds above, "residuals.model-discrepancy", or the code of another finding.
    name : of the measurement with its session; "position" or "orientation" of a discrepancy; of
        other sources empty.
    evaluation : "A" by statistics, "B" by other means (JCGM 100, 3.3), "A and B" where a stated
        value was corrected by statistics.
    degrees : degrees of freedom; infinite where the size counts as known.
    """

    kind: str
    name: str
    evaluation: str
    degrees: float


class CovarianceSplit(NamedTuple):
    """The covariance of the parameters of a fit, by source.

    Attributes
    ----------
    sources : of errors. roots : (p, k) [SI] for each, whose squares add up to the covariance.
    undetermined : (p,) parameters of infinite variance, of which the roots contain what the
        tolerances allow.
    """

    sources: tuple[Source, ...]
    roots: tuple[FloatArray, ...]
    undetermined: BoolArray


class _Penalty(NamedTuple):
    """What a fit assumes of its p coordinates y: to_z (p, p) takes them to deviations in
    tolerances, `penalty` (p,) their weights and `spread` (p,) the standard deviations of the
    whitened deviations. `is_estimated` (p,) : those that follow the rows. `noise` : standard
    deviation of the whitened rows.
    """

    to_z: FloatArray
    is_estimated: BoolArray
    penalty: FloatArray
    spread: FloatArray
    noise: float


def split_covariance(
    fit: Identification, data: Measurements, linear: FitLinearization
) -> CovarianceSplit:
    """Return the covariance of a fit by source.

    Parameters
    ----------
    fit : with intervals. data : its measurements, with the sigma of their readings, without
        excluded poses. linear : of both, see `linearize_fit`.
    """
    assumed, evaluated = _read_penalty(fit, linear), _evaluate_noise(fit)
    names, members = _number_sources(data, linear.problem)
    sources = [Source(kind, name, *evaluated) for kind, name in names]
    factors = list(fold_sources(linear.problem, linear.linearization, members, len(names)))
    U = factors[0].shape[1] - len(fit.names)
    for kind, rows in _further_rows(fit, linear, U):
        sources.append(Source(kind, "", "B", np.inf))
        factors.append(rows)
    own, moved = _propagate(assumed, factors, U)
    sources.append(Source(TOLERANCES, "", *_evaluate_tolerances(fit)))
    rest, of_setup = _separate_setup(own, moved, linear.linearization)
    if len(fit.nuisance):  # rows of stated setup parameters act by these alone
        sources.append(Source(SETUP, "", *evaluated))
        rest.append(of_setup)
    merged: dict[Source, list[FloatArray]] = {}
    setup = next((source for source in sources if source.kind == SETUP), None)
    for source, root in zip(sources, rest, strict=True):
        key = setup if source.kind == SETUP and setup is not None else source
        merged.setdefault(key, []).append(root)
    for part in (part for part in fit.posterior.parts if part.is_added):
        name = _name_discrepancy(fit, part) if part.source == DISCREPANCY else ""
        key = Source(part.source, name, "A", part.degrees)
        merged.setdefault(key, []).append(part.root / fit.tolerance[:, None])
    roots = tuple(
        fit.tolerance[:, None] * np.concatenate(roots, axis=1) for roots in merged.values()
    )
    return CovarianceSplit(tuple(merged), roots, np.isinf(np.diag(fit.covariance)))


def halve_sigma(
    fit: Identification, data: Measurements, linear: FitLinearization, source: Source
) -> tuple[FloatArray, Linearization, Problem] | None:
    """Return a root (p, k) [SI] of the covariance without added parts if the sigma of a source of
    rows or of the tolerances were half as large, with its linearization; None for other sources.

    Every weight is that of the smaller sigma. Estimates stay, and so does a scale of the noise that
    the residuals gave. The other arguments are as of `split_covariance`.
    """
    assumed = _read_penalty(fit, linear)
    changed, other = data, fit
    if source.kind == TOLERANCES:
        assumed = assumed._replace(penalty=4.0 * assumed.penalty)
    elif source.kind == READINGS and data.reading_sigma is not None:
        changed = replace(data, reading_sigma=0.5 * data.reading_sigma)
    elif source.kind == INSTRUMENT:
        of_poses, of_base = (
            tuple(_halve(rows, source.name, data) for rows in observations)
            for observations in (data.observations, data.base_observations)
        )
        changed = replace(data, observations=of_poses, base_observations=of_base)
    elif source.kind == SETUP and _has_stated_setup(fit):
        other = _with_half_setup(fit, data)
    else:
        return None
    problem, linearization = linearize_rows_of(other, changed)
    p = len(fit.names)
    own, _ = _propagate(assumed, [linearization.factor[0, :p, :p]], 0)
    return fit.tolerance[:, None] * np.concatenate(own, axis=1), linearization, problem


def _read_penalty(fit: Identification, linear: FitLinearization) -> _Penalty:
    """Return the assumptions of a fit; a direction that is not estimated has its tolerance."""
    d, used = linear.decomposition, linear.is_estimated
    to_z = d.deviation(np.eye(len(used))).T
    penalty, spread = np.where(used, linear.penalty[0], 1.0), np.where(used, linear.spread, 1.0)
    return _Penalty(to_z, used, penalty, spread, float(np.sqrt(linear.sources.noise)))


def _evaluate_noise(fit: Identification) -> tuple[str, float]:
    """Return how the noise of the rows was evaluated, and its degrees of freedom."""
    degrees = _find_degrees(fit, NOISE)
    test = fit.residual_test
    if test.noise == "estimated" or test.failed:
        return "A", degrees
    return ("A and B" if np.isfinite(degrees) else "B"), degrees


def _evaluate_tolerances(fit: Identification) -> tuple[str, float]:
    """Return how the size of the deviations was evaluated, and its degrees of freedom."""
    degrees = _find_degrees(fit, TOLERANCES)
    if np.isfinite(degrees):
        return "A and B", degrees
    return ("B (assumed)" if fit.free_parameters.assumed.any() else "B"), degrees


def _find_degrees(fit: Identification, source: str) -> float:
    """Return the degrees of freedom of what a source contributes; infinite where it is known."""
    return next((part.degrees for part in fit.posterior.parts if part.source == source), np.inf)


def _name_discrepancy(fit: Identification, part: CovariancePart) -> str:
    """Return whether a part comes from slow errors of the position or of the orientation."""
    own = fit.posterior.discrepancy
    assert own is not None
    half = own.root.shape[1] // 2
    return "position" if np.array_equal(part.root, own.root[:, half:]) else "orientation"


def _name(rows: Observations, session: str, data: Measurements) -> str:
    """Return the name of a kind of measurement with its session, and its frame where several
    instruments measure the same.
    """
    name = rows.kind.name
    alike = [o for o in data.observations if len(o) and o.kind.name == name and o is not rows]
    frame = getattr(rows.kind, "frame", None)
    if any(getattr(o.kind, "frame", None) != frame for o in alike):
        name = f"{name} in {frame}"
    name = f"{name} of the base" if rows.kind.is_of_base else name
    return f"{name}, {session}" if session else name


def _number_sources(
    data: Measurements, problem: Problem
) -> tuple[list[tuple[str, str]], list[IntArray]]:
    """Return kind and name of the sources of rows, and the number of the source of each row of
    every kind of a problem.
    """
    numbers: dict[tuple[str, str], int] = {}
    members = []
    for rows in (o for o in data.all_observations if len(o)):
        labels = [(INSTRUMENT, _name(rows, session, data)) for session in rows.session.tolist()]
        members.append(np.array([numbers.setdefault(label, len(numbers)) for label in labels]))
    if problem.is_uncertain:
        label = (READINGS, "")
        count = len(problem.rows[-1].poses)
        members.append(np.full(count, numbers.setdefault(label, len(numbers))))
    return list(numbers), members


def _further_rows(
    fit: Identification, linear: FitLinearization, U: int
) -> list[tuple[str, FloatArray]]:
    """Return kind and rows (m, U + p) of the stated setup parameters, and of an earlier
    calibration.
    """
    rows = []
    problem, estimate = linear.problem, linear.linearization.nuisance
    if problem.nuisance is not None and estimate is not None and problem.nuisance.has_prior.any():
        stated = problem.nuisance.has_prior
        sd = problem.nuisance.local.table.tolerance[stated]
        done = estimate.elimination
        both = np.concatenate([done.joint_root()[0], done.slope[0]], axis=1)[stated]
        rows.append((SETUP, both / sd[:, None]))
    if fit.options.prior is not None:
        measured = problem.linearize(
            linear.linearization.deviation, linear.linearization.next_start
        )
        slope = fit.options.prior.added(problem).list_slopes(measured)[0]
        rows.append((EARLIER, np.concatenate([np.zeros((len(slope), U)), slope], axis=1)))
    return rows


def _propagate(
    assumed: _Penalty, factors: list[FloatArray], U: int
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return for each source of rows, and for the tolerances at the end, the error of the machine
    (p, k) [tolerances] and that of the setup parameters at a known machine (U, k).

    With [A; P^(1/2)] = Q R, b A_k' is R^-1 Q_k'. A'A is never formed.
    """
    own = [factor[:, U:] @ assumed.to_z * assumed.is_estimated for factor in factors]
    penalty = np.diag(np.sqrt(assumed.penalty))
    Q, R = np.linalg.qr(np.concatenate([*own, penalty]))
    Q_blocks = np.split(Q, np.cumsum([len(rows) for rows in own]))
    size = [assumed.noise] * len(own)
    errors = [
        assumed.to_z @ substitute_backward(R, s * q.T)
        for s, q in zip(size, Q_blocks[:-1], strict=True)
    ]
    errors.append(assumed.to_z @ substitute_backward(R, (Q_blocks[-1] * assumed.spread[:, None]).T))
    moved = [assumed.noise * factor[:, :U].T for factor in factors]
    return errors, [*moved, np.zeros((U, len(penalty)))]


def _separate_setup(
    errors: list[FloatArray], moved: list[FloatArray], linearization: Linearization
) -> tuple[list[FloatArray], FloatArray]:
    """Return the errors of the machine that are uncorrelated with those of the setup parameters, by
    source, and a root (p, k) of the others.
    """
    estimate = linearization.nuisance
    if estimate is None:
        return list(errors), np.zeros((len(errors[0]), 0))
    done = estimate.elimination
    e = np.concatenate(errors, axis=1)
    setup = done.slope[0] @ e + done.joint_root()[0] @ np.concatenate(moved, axis=1)
    length = np.linalg.norm(setup, axis=1, keepdims=True)
    _, s, vt = np.linalg.svd(setup / np.where(length > 0.0, length, 1.0), full_matrices=False)
    basis = vt[are_nonzero(s)].T if s.size and s[0] > 0.0 else np.zeros((e.shape[1], 0))
    of_setup = e @ basis
    rest = e - of_setup @ basis.T
    ends = np.cumsum([each.shape[1] for each in errors])[:-1]
    return list(np.split(rest, ends, axis=1)), of_setup


def _halve(rows: Observations, name: str, data: Measurements) -> Observations:
    """Return rows, those of a source with half their sigma."""
    if not len(rows):
        return rows
    chosen = np.array([_name(rows, session, data) == name for session in rows.session.tolist()])
    factor = np.where(chosen, 0.25, 1.0)[:, None, None]
    return replace(rows, covariance=rows.covariance * factor)


def _has_stated_setup(fit: Identification) -> bool:
    """Return whether the standard deviation of some free setup parameter is stated."""
    return any(p.free and p.tolerance is not None for p in fit.nuisance.table.entries)


def _with_half_setup(fit: Identification, data: Measurements) -> Identification:
    """Return a fit whose stated setup parameters have half their standard deviations."""
    setup = data.nuisance_parameters if fit.options.nuisance is None else fit.options.nuisance
    for entry in setup.table.entries:
        if entry.free and entry.tolerance is not None:
            setup = setup.with_prior(entry.name, 0.5 * entry.tolerance)
    return replace(fit, options=replace(fit.options, nuisance=setup))
