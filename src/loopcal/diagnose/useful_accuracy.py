# SPDX-License-Identifier: Apache-2.0
"""Separate the combinations of parameters that data determine to a useful accuracy from the others.

Where singular values form a continuum, a rank that depends on a tolerance near rounding says
little. An accuracy that is useful says more: with the deviations y = x / w, where w is this
accuracy for each parameter (a length, an angle, or a share of the robot's size for ratios), and
with A the whitened rows by y, A = U S V', the combination v_i'y has the standard deviation 1 / s_i
by the data alone. All combinations c'y of length one

    in the span of the v_i with s_i >= 1    have a standard deviation of at most 1: useful
    in the span of the other v_i            have one of at least 1, or an infinite one: not useful

No tolerance of parameters and no rank tolerance enters. See docs/theory/gauge.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.diagnose.identifiable_parameters import Identifiability
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.null_space import sparsify_basis
from loopcal.findings import Finding, report_finding
from loopcal.numerics.decomposition import NULL_COMPONENT
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

NEIGHBORS = (0.1, 10.0)
"""Multiples of the accuracy for which the number of combinations is stated, too."""

NEGLIGIBLE = 1e-6
"""Part of a combination of length one that is rounding and left out."""


@dataclass(frozen=True, eq=False)
class AccurateCombination:
    """A combination c'y of length one of the parameters, in units of the useful accuracy.

    Attributes
    ----------
    names : (k,) strongest first. coefficients : (k,) c of y = deviation / useful accuracy.
    sd : standard deviation by the data alone, in units of the useful accuracy; infinite where the
        data do not determine it.
    """

    names: tuple[str, ...]
    coefficients: FloatArray
    sd: float

    def to_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {**vars(self), "sd": self.sd if np.isfinite(self.sd) else None}


@dataclass(frozen=True, eq=False)
class UsefulAccuracy:
    """What data determine to a useful accuracy.

    Attributes
    ----------
    free_parameters : the free parameters.
    length, angle : the accuracy [m, rad].
    sd : (p,) [SI] standard deviation of each parameter by the data alone; infinite where they do
        not determine it.
    is_useful : (p,) parameters whose own standard deviation is at most the accuracy.
    determined, undetermined : combinations of length one that span what is known to the accuracy,
        and what is not.
    nearby : number of determined combinations at `NEIGHBORS` times the accuracy.
    """

    free_parameters: FreeParameters
    length: float
    angle: float
    sd: FloatArray
    is_useful: BoolArray
    determined: tuple[AccurateCombination, ...]
    undetermined: tuple[AccurateCombination, ...]
    nearby: tuple[int, ...]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """How many combinations are known to the accuracy, and which parameters on their own."""
        robot = self.free_parameters.robot
        names = np.array(self.free_parameters.names)[: len(self.is_useful)]
        return (
            report_finding(
                "identifiability.useful",
                count=len(self.determined),
                parameters=len(self.sd),
                length=robot.to_quantity(self.length, Dimension.LENGTH),
                angle=robot.to_quantity(self.angle, Dimension.ANGLE),
                finer=self.nearby[0],
                coarser=self.nearby[1],
            ),
            report_finding(
                "identifiability.useful-parameters",
                names=tuple(names[self.is_useful].tolist()),
                others=tuple(names[~self.is_useful].tolist()),
            ),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {
            "length": self.length,
            "angle": self.angle,
            "determined": self.determined,
            "undetermined": self.undetermined,
            "nearby": dict(zip(map(str, NEIGHBORS), self.nearby, strict=True)),
            "parameters": [
                {"name": name, "sd": float(sd) if np.isfinite(sd) else None, "useful": bool(ok)}
                for name, sd, ok in zip(
                    self.free_parameters.names, self.sd, self.is_useful, strict=True
                )
            ],
            "findings": self.findings,
        }


def judge_useful_accuracy(
    analysis: Identifiability, length: float, angle: float | None = None
) -> UsefulAccuracy:
    """Separate the combinations that the data of an analysis determine to an accuracy.

    Parameters
    ----------
    length : accuracy of lengths [m], a standard deviation.
    angle : accuracy of angles [rad]; default: the length over the robot's size, by which an angle
        moves a point at that distance as far as the length.

    Raises
    ------
    EstimationError : an accuracy is not above 0 and finite.
    """
    free = analysis.free_parameters
    angle = length / free.robot.size if angle is None else angle
    for name, value in (("length", length), ("angle", angle)):
        if not 0.0 < value < np.inf:
            raise EstimationError(f"useful {name} is {value}; give a finite number above 0")
    unit = _accuracy_units(free, length, angle)
    _, s, vt = np.linalg.svd(analysis.factor * (unit / free.tolerance))
    s = np.where(s > np.finfo(np.float64).eps * len(s) * s[0], s, 0.0)
    count = int((s >= 1.0).sum())
    components = _without_rounding(vt)
    sd = np.sqrt((_divide(components, s[:, None]) ** 2).sum(axis=0))
    return UsefulAccuracy(
        free_parameters=free,
        length=length,
        angle=angle,
        sd=sd * unit,
        is_useful=sd <= 1.0,
        determined=_name_combinations(free, vt[:count], s[:count]),
        undetermined=_name_combinations(free, vt[count:], s[count:]),
        nearby=tuple(int((s * factor >= 1.0).sum()) for factor in NEIGHBORS),
    )


def _accuracy_units(free: FreeParameters, length: float, angle: float) -> FloatArray:
    """Return the accuracy (p,) [SI] of each parameter; of ratios it is the length over the size."""
    units = {Dimension.LENGTH: length, Dimension.ANGLE: angle}
    ratio = length / free.robot.size
    return np.array([units.get(parameter.dimension, ratio) for parameter in free.parameters])


def _name_combinations(
    free: FreeParameters, vt: FloatArray, s: FloatArray
) -> tuple[AccurateCombination, ...]:
    """Return a sparse basis of the span of directions vt (k, p), by names, best known first."""
    combinations = []
    for row in sparsify_basis(vt.T):
        c = row / np.linalg.norm(row)
        sd = float(np.linalg.norm(_divide(_without_rounding(vt @ c), s)))
        chosen = np.flatnonzero(np.abs(c) > NEGLIGIBLE)
        order = chosen[np.argsort(-np.round(np.abs(c[chosen]), 9), kind="stable")]
        names = tuple(free.names[i] for i in order)
        combinations.append(AccurateCombination(names, c[order] * np.sign(c[order[0]]), sd))
    return tuple(sorted(combinations, key=lambda combination: combination.sd))


def _without_rounding(components: FloatArray) -> FloatArray:
    """Return components of directions, with zero for those that are rounding."""
    return np.where(np.abs(components) > NULL_COMPONENT, components, 0.0)


def _divide(components: FloatArray, s: FloatArray) -> FloatArray:
    """Return components / s; infinite where only s is zero, zero where the component is."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(components == 0.0, 0.0, components / s)
