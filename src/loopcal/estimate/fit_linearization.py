# SPDX-License-Identifier: Apache-2.0
"""The rows of a fit, linearized once more at its estimate: what its statistics are read from.

Rows by the source of their noise (`fold_sources`): eliminating the coordinates u of a pose mixes
the rows that see it. There every row keeps its place: with the best coordinates u = -X z of all
rows [Y | A], the projected rows of a source are

    A_k - Y_k X

which, stacked over all sources, are A projected onto the complement of the range of Y.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.estimate.elimination import EliminatedNuisance, NodeRows, divide_among_nodes
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.identification import prepare_fitted_data
from loopcal.estimate.linearization import KindRows, Linearization, PoseSolution
from loopcal.estimate.penalties import decompose_for
from loopcal.estimate.pose_rows import PoseBlock, PoseRows, stack_rows
from loopcal.estimate.posterior import (
    Posterior,
    VarianceSources,
    find_variance_sources,
    posterior_from_arrays,
)
from loopcal.estimate.problem import Problem, problem_of, spread_rows
from loopcal.estimate.residual_test import NoiseKnowledge
from loopcal.estimate.result import Identification
from loopcal.estimate.smooth_errors import SmoothErrors
from loopcal.measure.array_checks import drop_repeats, take_rows
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import Decomposition, empty_factor
from loopcal.numerics.elimination import UnknownRoot, eliminate_columns, spread_columns
from loopcal.numerics.statistics import find_distinct
from loopcal.typing import BoolArray, FloatArray, IntArray

MOST_KEPT = 50_000_000  # derivatives of poses that are kept for the rows of a fit, at most
PART = 20_000  # residuals, about, whose rows by errors of the poses are made together


class FitLinearization(NamedTuple):
    """The problem of a fit at its estimate, weighted as in the fit (t = 1).

    fit : it. data : its measurements, with the sigma of their readings, without excluded poses.
    problem : without the rows of an earlier calibration. linearization : with them.
    solution : poses and nuisance parameters at which both are linearized.
    decomposition, penalty : of the fit. sources : of its variances.
    """

    fit: Identification
    data: Measurements
    problem: Problem
    solution: PoseSolution
    linearization: Linearization
    decomposition: Decomposition
    penalty: FloatArray
    sources: VarianceSources

    @property
    def information(self) -> FloatArray:
        """(p,) s^2 + penalty of each direction; infinite where it is not used."""
        return self.decomposition.singular_values[0] ** 2 + self.penalty[0]

    @property
    def variance(self) -> FloatArray:
        """(p,) variance of each direction; infinite where it is not estimated."""
        return self.decomposition.variances(self.penalty, *self.sources)[0]

    @property
    def spread(self) -> FloatArray:
        """(p,) standard deviation of the true coordinates times the root of the penalty: 1 where
        the penalty is a prior of the rows' unit noise.
        """
        penalty, prior = self.penalty[0], self.sources.prior
        if prior is None:
            return np.ones(len(penalty))
        finite = np.where(np.isfinite(penalty), penalty, 0.0)
        return np.asarray(np.sqrt(finite * prior[0]))

    @property
    def prior_weight(self) -> FloatArray:
        """(p,) 1 / variance of the true coordinates about nominal: the penalty, but where it
        contains an estimated noise; 0 without a prior, infinite where a direction is not used.
        """
        penalty = self.penalty[0]
        spread = np.where(np.isfinite(penalty) & (penalty > 0.0), self.spread, 1.0)
        return np.asarray(penalty / spread**2)

    @property
    def is_estimated(self) -> BoolArray:
        """(p,) directions that the rows determine and the fit estimates."""
        return np.isfinite(self.variance) & self.decomposition.used[0]


def linearize_fit(
    fit: Identification, data: Measurements, linear: FitLinearization | None = None
) -> FitLinearization:
    """Linearize the rows of a fit that converged at its estimate.

    data : the measurements it was made from.
    linear : the result for the same fit before findings widened its covariance, which is used
        again; anew where another test of the residuals scales the noise since.

    DataError : the measurements have another number of poses than the fit.
    """
    if linear is not None and fit.residual_test is linear.fit.residual_test:
        return linear._replace(fit=fit)
    data = prepare_fitted_data(fit, data)
    setup = data.nuisance_parameters if fit.options.nuisance is None else fit.options.nuisance
    problem = problem_of(fit.free_parameters, data, setup).weighted(fit.pose_weights)
    z = problem.free.deviation(fit.robot.values[None])
    start = problem.start(z, seek=False).with_nuisance(fit.nuisance.estimate[None])
    kept = 6 * data.n_poses * len(problem.free) <= MOST_KEPT  # or computed when needed
    solution = problem.solve(z, start, derivatives=kept)
    rows = problem.linearize_at(z, start, solution)
    if fit.options.prior is not None:
        rows = fit.options.prior.added(problem).append(rows)
    method, tolerance = fit.method, fit.spectrum.tolerance
    d = decompose_for(method, rows.factor, rows.equations, z, tolerance)
    penalty = np.array(method.penalty(d), dtype=np.float64)
    sources = find_variance_sources(d, penalty, fit.residual_test, method, fit.free_parameters)
    return FitLinearization(fit, data, problem, solution, rows, d, penalty, sources)


def fold_smooth_errors(linear: FitLinearization, errors: SmoothErrors) -> FloatArray:
    """Return the factor (p + m + 1, p + m + 1) of the rows of a fit by its parameters and the m
    coefficients of errors of the poses; poses and nuisance parameters stay those of `linear`.
    """
    at = linear.linearization
    whole, solution = linear.problem.with_errors(errors, linear.solution)
    z = np.pad(at.deviation, ((0, 0), (0, errors.count)))
    start = replace(at.next_start, deviation=z, poses=None, is_near=False)
    factor = empty_factor(1, z.shape[1])
    for problem in whole.divide(PART):  # all rows together would take most of the memory
        known = solution
        if problem is not whole:
            known = problem.solve(z, start, solution.nuisance, derivatives=True)
        factor = engine.fold(factor, problem.linearize_at(z, start, known).factor)
    if (prior := linear.fit.options.prior) is not None:
        factor = prior.added(whole).append(replace(at, deviation=z, factor=factor)).factor
    return factor[0]


# What a fit knows of machine and nuisance parameters together, to predict other measurements.

UNKNOWN = 1e6
"""Standard deviation in `unit` that stands for a direction of which nothing is known."""

SLOPE, ROOT, COLUMNS = "local_slope", "local_root", "local_columns"
"""Arrays of a run folder."""


class FitUncertainty(NamedTuple):
    """Free parameters and nuisance parameters of a fit with their joint uncertainty.

    posterior : of the machine. names : (U,) nuisance parameters.
    slope : (U, p) S [SI / SI]. root : T [SI], see `NuisanceEstimate`.
    noise_scale : factor on the stated sigmas of the rows. noise : what the fit says of other rows.
    """

    posterior: Posterior
    names: tuple[str, ...]
    slope: FloatArray
    root: UnknownRoot
    noise_scale: float
    noise: NoiseKnowledge

    def __repr__(self) -> str:
        p, u = len(self.posterior.unit), len(self.names)
        return f"<FitUncertainty: {p} parameters, {u} nuisance parameters>"

    @property
    def spread(self) -> FloatArray:
        """(p, p) E [SI] without a model discrepancy; zero where the fit states no intervals."""
        posterior = self.posterior.without_discrepancy
        variance = posterior.variance
        sd = np.where(np.isinf(variance), UNKNOWN, np.sqrt(np.nan_to_num(variance, posinf=0.0)))
        return posterior.unit[:, None] * posterior.directions * sd

    @property
    def free(self) -> FreeParameters:
        """The free parameters at the estimate, in units of the posterior, and the errors of a model
        discrepancy.
        """
        posterior = self.posterior
        stated = np.zeros(len(posterior.unit), dtype=bool)
        own = posterior.discrepancy
        return FreeParameters(
            posterior.robot,
            posterior.places,
            posterior.estimate,
            posterior.unit,
            stated,
            errors=None if own is None else own.errors,
        )


def collect_uncertainty(fit: Identification) -> FitUncertainty:
    """Return the joint uncertainty of a fit."""
    nuisance = fit.nuisance
    slope = nuisance.slope / fit.tolerance
    scale = np.nan_to_num(fit.residual_test.sigma_scale, nan=1.0)
    noise = NoiseKnowledge.of(fit.residual_test)
    return FitUncertainty(fit.posterior, nuisance.names, slope, nuisance.root, float(scale), noise)


def uncertainty_from_arrays(
    robot: Mechanism,
    names: tuple[str, ...],
    arrays: Mapping[str, np.ndarray],
    noise_scale: float,
    noise: NoiseKnowledge,
) -> FitUncertainty:
    """Return the joint uncertainty of a corrected robot and its nuisance parameters `names` in the
    arrays of a run folder. Raises as `posterior_from_arrays`.
    """
    posterior = posterior_from_arrays(robot, arrays)
    root = UnknownRoot.of(arrays[COLUMNS], arrays[ROOT])
    return FitUncertainty(posterior, names, arrays[SLOPE], root, noise_scale, noise)


# The sources of the noise of a kind: the number (r,) of the source of each row, and the root
# (r, m, m) that multiplies whitened rows; None where the source is that of the whole row.
RowSources = Sequence[tuple[IntArray, FloatArray | None]]


def find_share(parts: RowSources, source: int, rows: IntArray | slice = slice(None)) -> FloatArray:
    """Return the roots (k | 1, m, m) of a source in rows of a kind; (k | 1, 1, 1) of whole rows."""
    share = np.zeros((1, 1, 1))
    for numbers, root in parts:
        chosen = (numbers[rows] == source)[:, None, None]
        chosen = chosen[:1] if (chosen == chosen[:1]).all() else chosen
        own = root if root is None or isinstance(rows, slice) else take_rows(root, rows)
        share = share + (chosen if own is None else chosen * drop_repeats(own))
    return np.asarray(share)


class SourceFactor(NamedTuple):
    """A triangular factor of rows of one source that move the setup parameters of one cluster.

    source : its number. unknowns : (u,) the setup parameters. setup : (m, u) rows by these, in
        units of their standard deviations. machine : (m, p) by the machine.
    """

    source: int
    unknowns: IntArray
    setup: FloatArray
    machine: FloatArray


def fold_sources(
    problem: Problem, linearization: Linearization, sources: Sequence[RowSources], count: int
) -> list[SourceFactor]:
    """Return triangular factors of the rows of each of `count` sources (one machine), one for each
    cluster of setup parameters that they move, so that time and memory grow with the sessions, not
    with their cube. `sources` are those of every kind.
    """
    z, p = linearization.deviation, problem.parameters
    estimate, poses = linearization.nuisance, problem.poses
    fixed = None if estimate is None else estimate.values
    at_nodes = None if estimate is None else estimate.elimination.at_nodes
    solution = poses.solve(z, problem.trials, linearization.next_start, problem.control, fixed)
    folded: dict[tuple[int, int], SourceFactor] = {}
    for block, linearized in poses.iterate_poses(solution, z):
        kinds = poses.linearize_kinds(block, linearized, problem.trials, fixed)
        parts = divide_among_nodes(kinds, block.members)
        for source in range(count):
            own = [
                _take_share(find_share(of, source, numbers), len(numbers), len(rows.poses))
                for of, numbers, rows in zip(sources, block.row_numbers, block.rows, strict=True)
            ]
            if not any(rows.any() for rows in own):
                continue
            node_rows = _select_rows(poses, block, kinds, parts, own)
            for part in spread_rows(poses, block, node_rows, at_nodes):
                rows = part.rows[..., :-1]
                for factor in divide_by_cluster(source, part.unknowns, rows, p, estimate):
                    key = source, int(factor.unknowns[0]) if len(factor.unknowns) else -1
                    folded[key] = _fold_together(folded.get(key), factor)
    return [folded[key] for key in sorted(folded)]


def divide_by_cluster(
    source: int, moved: IntArray, rows: FloatArray, p: int, estimate: EliminatedNuisance | None
) -> list[SourceFactor]:
    """Return rows (k, m, w + p) of a source, which move setup parameters (k, w), by the clusters of
    these.
    """
    k, m, w = *rows.shape[:2], moved.shape[1]
    if estimate is None or not w:
        rows = rows.reshape(k * m, w + p)
        return [SourceFactor(source, np.zeros(0, dtype=np.int64), rows[:, :0], rows)]
    cluster, factors = estimate.elimination.tree.cluster, []
    for c in find_distinct(cluster[moved[:, 0]]):
        chosen, unknowns = cluster[moved[:, 0]] == c, np.flatnonzero(cluster == c)
        own, machine = np.split(rows[chosen], [w], axis=2)
        setup = spread_columns(own, np.searchsorted(unknowns, moved[chosen]), len(unknowns))
        flat = (each.reshape(len(own) * m, -1) for each in (setup, machine))
        factors.append(SourceFactor(source, unknowns, *flat))
    return factors


def _fold_together(first: SourceFactor | None, other: SourceFactor) -> SourceFactor:
    """Return the factor of rows of one source and cluster with further ones."""
    u, parts = len(other.unknowns), [each for each in (first, other) if each is not None]
    rows = np.concatenate([np.hstack([each.setup, each.machine]) for each in parts])
    triangle = engine.fold(np.zeros((1, rows.shape[1], rows.shape[1])), rows[None])[0]
    triangle = triangle[triangle.any(axis=1)]
    return other._replace(setup=triangle[:, :u], machine=triangle[:, u:])


def _select_rows(
    poses: PoseRows,
    block: PoseBlock,
    kinds: Sequence[KindRows | None],
    parts: Sequence[NodeRows],
    own: Sequence[FloatArray],
) -> list[NodeRows]:
    """Return the rows of one source, with roots `own` (r, ..) of every kind, of nodes in `parts`,
    or projected along all rows of poses that have coordinates.
    """
    tree, chosen = None if poses.nuisance is None else poses.nuisance.tree, []
    for part in parts:
        root = own[part.kind][part.numbers]
        kept = np.any(root, axis=(1, 2))
        if kept.any():
            taken = part._replace(
                nodes=part.nodes[kept],
                numbers=part.numbers[kept],
                by_unknowns=_weigh(part.by_unknowns[:, kept], root[kept]),
                columns=part.columns[kept],
                machine=_weigh(part.machine[:, kept], root[kept]),
            )
            chosen.append(taken)
    k = poses.coordinates.count
    masked = [
        kind
        and KindRows(
            _weigh(kind.machine, root),
            None if kind.by_nuisance is None else _weigh(kind.by_nuisance, root),
            None if kind.by_coordinates is None else _weigh(kind.by_coordinates, root),
        )
        for kind, root in zip(kinds, own if block.groups else (), strict=False)
    ]
    for group in block.groups:
        all_rows, own_rows = (stack_rows(block, group, rows, k, tree) for rows in (kinds, masked))
        width = group.poses.shape[1] * k
        solved = eliminate_columns(all_rows, width).solution
        left = own_rows[..., width:] - own_rows[..., :width] @ solved
        of_group = tree, group.structure, group.nodes, group.components
        chosen.append(NodeRows.divide(*of_group, left))
    return chosen


def _take_share(share: FloatArray, count: int, divided: int) -> FloatArray:
    """Return the roots of `divided` rows of targets from those (r | 1, m, m) of `count` rows."""
    k, m = max(divided // max(count, 1), 1), share.shape[1]
    if m > 1:
        share = np.einsum("rkikj->rkij", share.reshape(len(share), k, m // k, k, m // k))
    share = share.reshape(len(share), -1, *share.shape[-2:])
    return np.broadcast_to(share, (count, k, *share.shape[2:])).reshape(divided, *share.shape[2:])


def _weigh(rows: FloatArray, root: FloatArray) -> FloatArray:
    """Return rows (a, r, .., m, c) times roots (r, m, m) or numbers (r, 1, 1)."""
    of_rows = root.reshape(len(root), *[1] * (rows.ndim - 4), *root.shape[1:])
    return rows * of_rows if root.shape[1] == 1 else of_rows @ rows
