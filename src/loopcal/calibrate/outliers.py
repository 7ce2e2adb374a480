# SPDX-License-Identifier: Apache-2.0
"""Which blocks of rows do not belong: each against what all others predict of it, at a level for the whole family.

A block is named where the probability of its distance is below 1 - (1 - level)^(1/u), u blocks tested (Sidak), so that
data without a wrong block name none in 95 % of cases. Several wrong blocks hide each other; therefore what is doubted is
set aside, the others are fitted again (linearly, which needs no kinematics), and every block is asked again, inside or
outside, until the same blocks are doubted twice. Nothing is dropped: the names are for whoever decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.calibrate.identification import Identification
from loopcal.calibrate.influence import Influence, influence
from loopcal.calibrate.left_out import without_poses
from loopcal.calibrate.robust import scale_of
from loopcal.calibrate.rows import AnyRows, rows_of
from loopcal.calibrate.sensed import linked
from loopcal.linalg import Decomposition, FloatArray, decompose
from loopcal.measure import Measurements, with_stated_sigma

ROUNDS = 20
"""Times that blocks are set aside at most."""

MOST = 0.5
"""Share of the blocks that is set aside at most; with more, nothing can be said of the rest."""


@dataclass(frozen=True)
class Outlier:
    """A block that does not belong.

    Attributes
    ----------
    poses : its labels. distance : squared Mahalanobis norm of its residual against a fit of the others.
    degrees : degrees of freedom of that. p_value : probability of a larger one, for this block alone.
    """

    poses: tuple[str, ...]
    distance: float
    degrees: int
    p_value: float

    def __str__(self) -> str:
        names = f"pose {self.poses[0]}" if len(self.poses) == 1 else f"poses {', '.join(self.poses)}"
        times = np.sqrt(self.distance / self.degrees)
        return f"{names} does not fit the others: {times:.3g} times the noise expected of its {self.degrees} residuals"


@dataclass(frozen=True, eq=False)
class OutlierCheck:
    """The outcome for all blocks.

    Attributes
    ----------
    outliers : what does not belong, farthest first. level : probability of naming any block if all are right.
    blocks : number of blocks tested. poses : labels of each of the u blocks.
    influence : of all blocks, with the doubted ones set aside. scale : factor on sigma used.
    sentence : what this means.
    """

    outliers: tuple[Outlier, ...]
    level: float
    blocks: int
    poses: tuple[tuple[str, ...], ...]
    influence: Influence
    scale: float
    sentence: str

    @property
    def names(self) -> tuple[str, ...]:
        """Labels of all poses of these blocks."""
        return tuple(label for outlier in self.outliers for label in outlier.poses)

    def to_dict(self) -> dict[str, Any]:
        """Return what was found by name for JSON."""
        return {
            "outliers": [vars(o) | {"poses": list(o.poses)} for o in self.outliers],
            "level": self.level,
            "blocks": self.blocks,
            "scale": self.scale,
            "mean_leverage": float(self.influence.leverage.sum() / max(int(self.influence.residuals.sum()), 1)),
            "sentence": self.sentence,
        }


def find_outliers(fit: Identification, data: Measurements, level: float = 0.05) -> OutlierCheck:
    """Name the blocks of rows that do not fit what all others say.

    Parameters
    ----------
    fit : the identification, with or without a loss. data : the measurements it was made from.
    level : probability of naming any block where none is wrong.
    """
    data = without_poses(with_stated_sigma(fit.robot, data), fit.dropped)
    rows = rows_of(fit.unknowns, data)
    numbers, member = np.unique(linked(data), return_inverse=True)
    labels = tuple(tuple(np.array(data.labels)[member == i].tolist()) for i in range(len(numbers)))
    z = fit.unknowns.deviation(fit.robot.values[None])
    aside = np.zeros(len(numbers), dtype=bool)
    aside[member] = fit.weight < 0.5
    rounds = 0
    while True:
        found, scale = _ask(fit, rows, member, (~aside).astype(np.float64), z)
        doubted, p_value = _doubted(found, scale, level)
        rounds += 1
        if (doubted == aside).all() or rounds == ROUNDS:
            break
        aside = doubted
    order = [i for i in np.argsort(p_value, kind="stable") if doubted[i]]
    outliers = tuple(
        Outlier(labels[i], float(found.distance[i] / scale**2), int(found.degrees[i]), float(p_value[i])) for i in order
    )
    tested = int((found.degrees > 0).sum())
    return OutlierCheck(outliers, level, tested, labels, found, scale, _sentence(outliers, tested, level, found))


def _ask(fit: Identification, rows: AnyRows, member: np.ndarray, weight: FloatArray, z: FloatArray) -> tuple[Influence, float]:
    """Fit linearly with these weights (u,) of 1 and 0 and return every block's influence, and the factor on sigma."""
    kept = rows.weighted(weight[member])
    factor, _ = kept.fold(z, np.arange(1))
    method, p = fit.method, rows.parameters
    d: Decomposition = decompose(factor, kept.rows, z, method.scale(p), fit.rank_tolerance, method.flat(p))
    penalty = np.array(method.penalty(d), dtype=np.float64)
    at = d.deviation(d.solution(penalty))
    found = influence(rows, member, d, penalty, weight, z, at)
    there = (found.degrees > 0) & (weight > 0.0)
    scale = (
        scale_of(np.sqrt(found.distance[there]), found.degrees[there].astype(np.float64)) if fit.noise == "estimated" else 1.0
    )
    return found, scale


def _doubted(found: Influence, scale: float, level: float) -> tuple[np.ndarray, FloatArray]:
    """Return which blocks (u,) are beyond the level of the family, the farthest half at most, and each one's p-value."""
    from scipy.special import chdtrc

    tested = found.degrees > 0
    p_value = np.where(tested, chdtrc(np.maximum(found.degrees, 1), found.distance / scale**2), 1.0)
    alone = -np.expm1(np.log1p(-level) / max(int(tested.sum()), 1))
    beyond = p_value < alone
    most = int(MOST * tested.sum())
    if beyond.sum() > most:
        ratio = np.where(beyond, found.distance / np.maximum(found.degrees, 1), -1.0)
        beyond = np.zeros_like(beyond)
        beyond[np.argsort(-ratio, kind="stable")[:most]] = True
    return beyond, p_value


def _sentence(outliers: tuple[Outlier, ...], tested: int, level: float, found: Influence) -> str:
    """Say how many blocks do not belong."""
    if tested == 0:
        return "no block of rows can be checked: each determines parameters that no other sees; measure more"
    if tested == 1:
        return "all rows belong to one block, which has no others to be compared with"
    if not outliers:
        return f"all {tested} blocks of rows fit each other (false alarm in {level:.0%} of data sets)"
    return (
        f"{len(outliers)} of {tested} blocks of rows do not fit the others (chance names one in {level:.0%} of right data):"
        " look at them; leave them out with drop, or fit with a loss"
    )
