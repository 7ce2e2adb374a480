# SPDX-License-Identifier: Apache-2.0
"""Test the stated tolerances against the data.

With the prior z ~ N(0, 1) and unit noise the projections c_i = u_i'b are independent, c_i ~ N(0, 1
+ s_i^2), and the most probable deviation is z = V y, y_i = s_i c_i / (1 + s_i^2), of variance w_i =
s_i^2 / (1 + s_i^2). Three tests ask whether the data are what such a prior predicts:

    all deviations    Q = sum y_i^2 = sum w_i chi2_i, compared with the scaled chi-square of equal
                      mean and variance (Satterthwaite): (sum w)^2 / sum w^2 degrees of freedom
    worst direction   max |c_i| / sqrt(1 + s_i^2)
    worst parameter   max |z_k| / sqrt(sum_i V_ki^2 w_i), which is |z_k| / sqrt(1 - v_k) with the
                      share v_k of the prior variance that the data leave

The last two are normal; the probability of the largest of n is 1 - (1 - p)^n, and that of the most
significant of the three tests 1 - (1 - p)^3 (Sidak). Directions that the data do not determine have
no weight. The part of the data outside the range contains no information on the prior; it is used
for the noise. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.tolerance_components import ToleranceComponent, are_penalized
from loopcal.findings import Finding, report_finding
from loopcal.numerics.decomposition import Decomposition
from loopcal.numerics.statistics import compute_any_probability, compute_chi_square_tail
from loopcal.results.description import Field, fields
from loopcal.typing import BoolArray, FloatArray

LEVEL = 0.01
"""Probability that any of the tests rejects tolerances that are right."""

FAR = 2.0
"""Deviation from nominal, in tolerances, above which a parameter is named."""

NAMED = 3
"""Largest number of parameters that are named."""

MAIN_PART = 0.3
"""Part of a parameter in a direction, relative to the largest, above which it is named."""

TESTABLE = 1e-6
"""Share of the prior variance that data must explain for a parameter or direction to be tested."""


@dataclass(frozen=True)
class LargestDeviation:
    """The test of the largest of several standard normal statistics.

    Attributes
    ----------
    statistic : the largest absolute value; 0 without a test. count : number of statistics.
    p_value : probability of a larger one in any of them. names : of the parameters in question.
    """

    statistic: float
    count: int
    p_value: float
    names: tuple[str, ...]


@dataclass(frozen=True)
class PriorConflict:
    """The stated tolerances against the data.

    Attributes
    ----------
    statistic, degrees, p_value : Q, its degrees of freedom and the probability of a larger Q.
    direction, parameter : the tests of the worst direction and of the worst parameter.
    joint_p_value : probability that the most significant of the three tests is more significant.
    inflation : factor by which all tolerances were inflated for the estimate.
    components : parts of them that were inflated further.
    component_rows : kind, name, names of the parameters and factor of each.
    farthest : names of the parameters farthest from nominal, and their deviations in tolerances.
    """

    statistic: float
    degrees: float
    p_value: float
    direction: LargestDeviation
    parameter: LargestDeviation
    joint_p_value: float
    inflation: float
    farthest: tuple[tuple[str, float], ...]
    components: tuple[ToleranceComponent, ...]
    component_rows: tuple[dict[str, object], ...]

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("statistic", "degrees", "p_value"),
        worst_direction="direction",
        worst_parameter="parameter",
        joint_p_value="joint_p_value",
        inflation="inflation",
        components="component_rows",
        conflict="conflict",
        farthest="farthest",
        sentence="sentence",
    )

    @property
    def conflict(self) -> bool:
        """Whether the data contradict the tolerances."""
        return self.joint_p_value < LEVEL

    @property
    def finding(self) -> Finding:
        """Whether the tolerances agree with the data, and what the method did."""
        if self.degrees < 0.5:
            return report_finding("prior.untested")
        inflated, worst = self.inflation > 1.0 or bool(self.components), self._worst
        if not self.conflict and self.components:
            return report_finding(
                "prior.components-inflated", parts=self.component_rows, factor=self.inflation
            )
        if not self.conflict:
            return report_finding("prior.consistent", p_value=self.joint_p_value, level=LEVEL)
        return report_finding(
            "prior.tolerances-inflated" if inflated else "prior.tolerances-too-narrow",
            ratio=float(np.sqrt(self.statistic / self.degrees)),
            names=tuple(name for name, _ in self.farthest),
            deviations=tuple(deviation for _, deviation in self.farthest),
            worst=() if worst is None else worst.names,
            worst_statistic=0.0 if worst is None else worst.statistic,
            factor=self.inflation,
            parts=self.component_rows,
            p_value=self.joint_p_value,
            level=LEVEL,
        )

    def report(self) -> list[Finding]:
        """Return the finding where it says more than that the tolerances agree with the data."""
        return [self.finding] if self.conflict or self.components else []

    @property
    def _worst(self) -> LargestDeviation | None:
        """The test of a parameter or direction that is more significant than the one of all."""
        worst = min(self.parameter, self.direction, key=lambda test: test.p_value)
        return worst if worst.p_value < self.p_value else None

    @property
    def sentence(self) -> str:
        """The text of the finding."""
        return str(self.finding)


def assess_prior_conflict(
    free: FreeParameters,
    decomposition: Decomposition,
    inflation: float,
    deviation: FloatArray,
    components: tuple[ToleranceComponent, ...] = (),
) -> PriorConflict:
    """Test the prior of a fit (t = 1), from its decomposition for the stated tolerances, rows
    divided by the noise that they show, and its deviation (p,) in tolerances. `inflation` and
    `components` are what the method inflated.
    """
    statistic, degrees = (float(value[0]) for value in compute_prior_statistic(decomposition))
    p_value = float(compute_chi_square_tail(degrees, statistic))
    direction = _test_directions(free, decomposition)
    parameter = _test_parameters(free, decomposition)
    distance = np.where(free.assumed, 0.0, np.abs(deviation))
    order, names = np.argsort(-distance), free.names
    far = order[distance[order] > FAR][:NAMED]
    return PriorConflict(
        statistic=statistic,
        degrees=degrees,
        p_value=p_value,
        direction=direction,
        parameter=parameter,
        joint_p_value=compute_any_probability(
            min(p_value, direction.p_value, parameter.p_value), 3
        ),
        inflation=inflation,
        farthest=tuple((names[i], float(deviation[i])) for i in far),
        components=components,
        component_rows=tuple(component.to_row(names) for component in components),
    )


def compute_prior_statistic(decomposition: Decomposition) -> tuple[FloatArray, FloatArray]:
    """Return Q (t,), scaled to a chi-square, and its degrees of freedom (t,).

    The sums are over the directions that a prior penalizes.
    """
    square = np.where(are_penalized(decomposition), decomposition.singular_values**2, 0.0)
    share = square / (1.0 + square)
    value = (share * decomposition.projections**2 / (1.0 + square)).sum(axis=1)
    first, second = share.sum(axis=1), (share**2).sum(axis=1)
    testable = second > 0.0
    safe = np.where(testable, second, 1.0)
    return np.where(testable, value * first / safe, 0.0), np.where(testable, first**2 / safe, 0.0)


def _test_directions(free: FreeParameters, d: Decomposition) -> LargestDeviation:
    """Test the worst direction (t = 1); it is named by its largest parts, in tolerances."""
    square = np.where(are_penalized(d), d.singular_values**2, 0.0)[0]
    testable = square / (1.0 + square) > TESTABLE
    values = np.where(testable, np.abs(d.projections[0]) / np.sqrt(1.0 + square), 0.0)
    worst = int(np.argmax(values))
    part = np.where(free.assumed, 0.0, np.abs(d.scale * d.directions[0][:, worst]))
    order = np.argsort(-part)
    order = order[part[order] > MAIN_PART * part.max()]
    return _largest(values, testable, tuple(free.names[i] for i in order))


def _test_parameters(free: FreeParameters, d: Decomposition) -> LargestDeviation:
    """Test the worst parameter (t = 1)."""
    square = np.where(are_penalized(d), d.singular_values**2, 0.0)[0]
    basis = d.scale[:, None] * d.directions[0]
    deviation = basis @ (np.sqrt(square) * d.projections[0] / (1.0 + square))
    variance = basis**2 @ (square / (1.0 + square))
    testable = (variance > TESTABLE) & ~free.assumed
    spread = np.sqrt(np.where(testable, variance, 1.0))
    values = np.where(testable, np.abs(deviation) / spread, 0.0)
    return _largest(values, testable, (free.names[int(np.argmax(values))],))


def _largest(values: FloatArray, testable: BoolArray, names: tuple[str, ...]) -> LargestDeviation:
    """Return the test of the largest of standard normal values that are testable."""
    count = int(testable.sum())
    if count == 0:
        return LargestDeviation(0.0, 0, 1.0, ())
    largest = float(values.max())
    single = float(compute_chi_square_tail(1.0, largest**2))
    return LargestDeviation(largest, count, compute_any_probability(single, count), names)
