# SPDX-License-Identifier: Apache-2.0
"""Test held-out blocks against what a fit predicts: noise plus the uncertainty of the fit.

The whitened held-out rows are r = r0 + H y + noise. y are independent standard normal variables:
the directions of the fit's uncertainty (machine and nuisance parameters together, see
`FitUncertainty`), and with a very large standard deviation the nuisance parameters that the fit
does not know. So the fit is a prior, and each block is compared with what the prior and all other
held-out blocks predict. With the blocks that are not excluded, [H; 1] y = -[r0; 0] in the
least-squares sense, with the triangular factor R of [H; 1]; then G = H R^-1 R^-T H' and the
statistics are those of `influence`, the search that of `outlier_search`. Several wrong blocks do
not hide each other.

All errors may be larger than predicted, where the model has errors of its own. A single block is a
blunder only in comparison with the others: distances are divided by the scale of the blocks where
that exceeds 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.fit_checks.influence import Influence, compute_block_influence, iterate_blocks
from loopcal.diagnose.fit_checks.outlier_search import BlockSearch, PartialFit, search_blocks
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.fit_uncertainty import FitUncertainty
from loopcal.estimate.minimization.robust_descent import estimate_scale_of
from loopcal.estimate.observation_rows import linked_blocks, list_block_labels
from loopcal.estimate.problem_construction import problem_of
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.mechanism import Mechanism
from loopcal.numerics.back_substitution import substitute_transposed
from loopcal.numerics.chi_square import compute_chi_square_tail
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

LEVEL = 1e-3
"""Probability of naming any block where none is wrong. It is small, because a named block changes
the verdict.
"""

FOLDED = 10_000
"""Rows that are factorized at once."""

ANYWHERE = 1e3
"""Standard deviation of an unknown nuisance parameter, in sizes of the robot or radians."""


class HeldOutBlocks(NamedTuple):
    """Rows of held-out blocks with what predicts them.

    Attributes
    ----------
    poses : labels of each of u blocks. member : (n,) block of each pose.
    groups : blocks of equal size: numbers (b,), H (b, m, k), residuals (b, m), present (b, m).
    """

    poses: tuple[tuple[str, ...], ...]
    member: IntArray
    groups: tuple[tuple[IntArray, FloatArray, FloatArray, BoolArray], ...]

    def fit_without(self, excluded: BoolArray) -> PartialFit:
        """Return the prediction by all blocks that are not excluded (u,)."""
        triangle, y = self.combine(excluded)
        u = len(excluded)
        values = {
            name: np.zeros(u)
            for name in ("leverage", "residuals", "distance", "degrees", "deleted")
        }
        for numbers, H, residual, present in self.groups:
            tested = compare_blocks(H, residual, present, triangle, y, ~excluded[numbers])
            for name, array in values.items():
                array[numbers] = getattr(tested, name)
        influence = Influence(**values)  # type: ignore[arg-type]
        inside, scale = (influence.degrees > 0) & ~excluded, 1.0
        if inside.any():
            distance, degrees = np.sqrt(influence.distance[inside]), influence.degrees[inside]
            # the lower middle: of two blocks, one may be wrong
            middle = np.argsort(distance / np.sqrt(degrees), kind="stable")[
                [(inside.sum() - 1) // 2]
            ]
            of_middle = estimate_scale_of(distance[middle], degrees[middle].astype(np.float64))
            scale = max(1.0, of_middle)
        return PartialFit(excluded, influence, scale, 0)

    def combine(self, excluded: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return the factor R (k, k) and solution y (k,) of the blocks that are not excluded."""
        k = self.groups[0][1].shape[2]
        count = 0
        stacked: list[FloatArray] = [np.column_stack([np.eye(k), np.zeros(k)])]
        for numbers, H, residual, _ in self.groups:
            kept = ~excluded[numbers]
            rows = np.concatenate([H[kept], residual[kept][..., None]], axis=2)
            stacked.append(rows.reshape(-1, k + 1))
            count += len(stacked[-1])
            if count > FOLDED:
                stacked, count = [np.asarray(np.linalg.qr(np.concatenate(stacked), mode="r"))], 0
        triangle = np.asarray(np.linalg.qr(np.concatenate(stacked), mode="r"))
        R = triangle[:k, :k]
        return R, -np.linalg.solve(R, triangle[:k, k])


@dataclass(frozen=True, eq=False)
class HeldOutCheck:
    """The search for held-out blocks that do not fit.

    Attributes
    ----------
    predictor : makes the rows of other measurements of the same poses. blocks : those of the data.
    search : its result; `suspects` (b,) are the numbers of the blocks that do not fit.
    """

    predictor: Predictor
    blocks: HeldOutBlocks
    search: BlockSearch
    suspects: IntArray

    @cached_property
    def prediction(self) -> tuple[FloatArray, FloatArray]:
        """Factor and solution of all blocks that do fit."""
        return self.blocks.combine(self.search.end.excluded)

    def p_values(self, data: Measurements) -> FloatArray:
        """Return the probability of a larger distance, of each block (b,) of other values of some
        of these poses: against the prediction by all blocks that do fit.
        """
        end = self.search.end
        triangle, y = self.prediction
        other = self.predictor.make_blocks(data)
        p_value = np.ones(len(other.poses))
        for numbers, H, residual, present in other.groups:
            outside = np.zeros(len(numbers), dtype=bool)
            tested = compare_blocks(H, residual, present, triangle, y, outside)
            statistic = tested.distance / end.scale**2
            p_value[numbers] = compute_chi_square_tail(tested.degrees, statistic)
            p_value[numbers[tested.degrees < 1]] = np.nan
        return p_value


class Predictor(NamedTuple):
    """What predicts held-out rows: a robot, the values of its nuisance parameters, and what is
    known of both.

    Attributes
    ----------
    robot : the calibrated one. values : name -> nuisance parameter [SI].
    kept : names of those that the fit knows; the others are unknown.
    uncertainty : of the fit; None where robot and nuisance parameters are taken as exact.
    """

    robot: Mechanism
    values: Mapping[str, float]
    kept: tuple[str, ...]
    uncertainty: FitUncertainty | None
    unknown: tuple[str, ...]

    def make_blocks(self, data: Measurements) -> HeldOutBlocks:
        """Return the rows of measurements with what predicts them."""
        data = fill_in_reading_sigma(self.robot, data)
        free = _make_free(self.robot, self.uncertainty)
        problem = problem_of(free, data)
        table = data.nuisance_parameters.table
        z = free.deviation(self.robot.values[None])
        values = np.array([[self.values[name] for name in table.names]]).reshape(1, -1)
        member = np.unique(linked_blocks(data), return_inverse=True)[1]
        poses = list_block_labels(data.labels, member)
        total = problem.count_leverage_rows(member, len(poses))
        by_y = self._predict(table.names, table.dimensions)
        noise = 1.0 if self.uncertainty is None else self.uncertainty.noise_scale
        groups = []
        for blocks, columns, r in iterate_blocks(problem.rows_at(z, values), member, total):
            present = np.any(columns != 0.0, axis=2) | (r != 0.0)
            groups.append((blocks, columns @ by_y / noise, r / noise, present))
        return HeldOutBlocks(poses, member, tuple(groups))

    def _predict(self, names: tuple[str, ...], dimensions: tuple[Dimension, ...]) -> FloatArray:
        """Return the derivative (U + p + m, k) of nuisance parameters, free parameters and the
        errors of a model discrepancy by y.
        """
        fit, U = self.uncertainty, len(names)
        p, w = (0, 0) if fit is None else (len(fit.posterior.unit), len(fit.names))
        own = None if fit is None else fit.posterior.discrepancy
        m = 0 if own is None else own.errors.count
        by_y = np.zeros((U + p + m, p + w + len(self.unknown) + m))
        if fit is not None:
            spread = fit.spread
            by_y[U : U + p, :p] = spread / fit.posterior.unit[:, None]
            if own is not None:  # parameters follow the errors, which predictions lack
                by_y[U : U + p, -m:] = own.root / fit.posterior.unit[:, None]
                by_y[U + p :, -m:] = -np.eye(m)
            follow, places = fit.slope @ spread, {name: i for i, name in enumerate(fit.names)}
            for i, name in enumerate(names):
                if name in self.kept and name in places:
                    by_y[i, :p] = follow[places[name]]
                    by_y[i, p : p + w] = fit.root[places[name]]
        for i, name in enumerate(names):
            if name in self.unknown:
                unit = self.robot.size if dimensions[i] is Dimension.LENGTH else 1.0
                by_y[i, p + w + self.unknown.index(name)] = ANYWHERE * unit
        return by_y


def check_held_out_rows(
    robot: Mechanism,
    data: Measurements,
    values: Mapping[str, float],
    kept: tuple[str, ...],
    uncertainty: FitUncertainty | None = None,
) -> HeldOutCheck | None:
    """Search the held-out blocks that neither the fit nor the other blocks explain.

    Parameters
    ----------
    robot : the calibrated one. data : held-out rows whose poses are reached.
    values : name -> nuisance parameter [SI] with which they are compared. kept : names of those
        that the fit determined; the others were fitted to these rows.
    uncertainty : of the fit; None where it is not known.

    Returns
    -------
    The result; None without any block that can be tested.
    """
    table = data.nuisance_parameters.table
    unknown = tuple(p.name for p in table.entries if p.free and p.name not in kept)
    predictor = Predictor(robot, values, kept, uncertainty, unknown)
    blocks = predictor.make_blocks(data)
    if not blocks.groups:
        return None
    nothing = np.zeros(len(blocks.poses), dtype=bool)
    search = search_blocks(blocks.fit_without, nothing, LEVEL)
    if search.whole.tested == 1:  # only the fit predicts it
        tested = search.whole.influence.degrees > 0
        alone = blocks.fit_without(tested)
        is_wrong = bool((alone.p_value() < LEVEL).any())
        search = replace(search, fits=(alone if is_wrong else search.whole,))
    always = np.all([fit.excluded for fit in search.fits], axis=0)
    order = np.argsort(-search.end.ratio, kind="stable")
    suspects = order[always[order]]
    return HeldOutCheck(predictor, blocks, search, suspects)


def compare_blocks(
    H: FloatArray,
    residual: FloatArray,
    present: BoolArray,
    triangle: FloatArray,
    y: FloatArray,
    inside: BoolArray,
) -> Influence:
    """Return the influence of blocks H (b, m, k) for the factor and solution of `inside` (b,) and
    other blocks.
    """
    b, m, k = H.shape
    half = H
    if H.size:  # one system for all blocks
        half = substitute_transposed(triangle, H.reshape(b * m, k).T).T.reshape(H.shape)
    return compute_block_influence(half, residual + H @ y, present, inside.astype(np.float64))


def _make_free(robot: Mechanism, uncertainty: FitUncertainty | None) -> FreeParameters:
    """Return the free parameters of a fit at its estimate; none where it is not known."""
    if uncertainty is not None:
        return uncertainty.free
    nothing = np.zeros(0)
    return FreeParameters(robot, nothing.astype(np.int64), nothing, nothing, nothing.astype(bool))
