# SPDX-License-Identifier: Apache-2.0
"""Compare what may cause residuals that noise alone does not explain, wrong rows among it.

Each cause h is a component of the variance of the whitened rows, K_h = Z Z' for independent errors
with columns Z of unit variance. What nothing estimated explains of the residuals has the covariance
sigma^2 (1 + tau^2 K_h); its likelihood over that of noise alone, averaged over log tau, is
the evidence of h, and with equal probabilities before the data it gives those after them. A noise
that is larger than stated is K = 1: without it, any other cause would explain too large residuals
of any kind. Few wrong poses are errors of any size in the rows of k of n poses, for each choice of
k of them. The most probable cause is taken into the covariance, and the others are compared again,
until noise alone explains the rest, or rows are wrong, which pull the fit. See
docs/theory/residual-patterns.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.drive_errors import list_drive_effects
from loopcal.diagnose.residual_patterns import (
    Effect,
    ResidualRows,
    list_effects,
    list_shared_errors,
)
from loopcal.estimate.fit_linearization import FitLinearization
from loopcal.estimate.residual_test import FEWEST_DEGREES, count_sigma_degrees
from loopcal.findings import Finding, report_finding
from loopcal.numerics.statistics import (
    UNSEEN,
    Remainder,
    VarianceComponent,
    compute_any_probability,
    compute_f_tail,
    estimate_variance_component,
)
from loopcal.typing import IntArray

NOISE, LARGER, OUTLIERS = "noise", "larger-noise", "outliers"
CAUSE = "residuals.cause"  # code of the finding
EXCLUDED = 0.05  # probability of noise alone below which a cause is named
OUTLYING = 0.1  # largest share of the poses that may be wrong
MOST_CAUSES, MOST_WRONG = 3, 30  # causes that are named, and wrong poses that are compared


class Cause(NamedTuple):
    """What probably causes the residuals."""

    source: str  # such as "pose", "session", "drives" or "outliers"
    name: str  # of the actuator or temperature, else empty
    probability: float
    second: str  # the next probable source
    second_probability: float
    effect: Effect | None  # None for outliers and a larger noise
    size: VarianceComponent | None  # of the effect, in columns of unit variance
    p_value: float  # (Sidak) of such an effect by noise alone, in any of those that are compared

    @property
    def finding(self) -> Finding:
        """The comparison as a finding."""
        names = ("name", "probability", "second", "second_probability")
        data = {name: getattr(self, name) for name in names}
        return report_finding(CAUSE, cause=self.source, **data)


def find_causes(linear: FitLinearization, rows: ResidualRows) -> tuple[Cause, ...]:
    """Return the causes of the residuals of a fit, the most probable first; none where noise alone
    may explain them.
    """
    fit, data = linear.fit, linear.data
    known = count_sigma_degrees(fit.residual_test.noise, fit.options.sigma_uncertainty)

    def list_all(rows: ResidualRows) -> list[Effect]:
        """Return the effects of rows that these can show."""
        effects = [*list_effects(rows, data, fit.robot), *list_shared_errors(rows, data, fit.robot)]
        return [effect for effect in effects if effect.columns.any()]

    few = rows.take_poses(data)
    effects = list_all(few) + list_drive_effects(linear, few)[:2]
    causes = compare_causes(few.remainder, effects, few.locate_poses(data), known)
    if few is rows or not causes:
        return causes
    whole = {(effect.source, effect.name): effect for effect in list_all(rows)}
    return tuple(c._replace(effect=whole.get((c.source, c.name), c.effect)) for c in causes)


def compare_causes(
    remainder: Remainder, effects: Sequence[Effect], pose: IntArray, known: float
) -> tuple[Cause, ...]:
    """Return the causes among effects and wrong poses; `pose` (R,) of each row. `known` degrees of
    freedom say that the noise has unit variance.
    """
    causes: list[Cause] = []
    listed = list(effects)
    alike = Counter(effect.source for effect in effects)
    while len(causes) < MOST_CAUSES and remainder.degrees >= FEWEST_DEGREES:
        spectra = [remainder.find_spectrum(effect.scaled) for effect in listed]
        seen = [i for i, spectrum in enumerate(spectra) if len(spectrum.y)]
        listed, spectra = [listed[i] for i in seen], [spectra[i] for i in seen]
        sizes = [spectrum.estimate(known) for spectrum in spectra]
        logs = [
            size.evidence - np.log(alike[e.source]) for size, e in zip(sizes, listed, strict=True)
        ]
        wrong = measure_wrong_poses(remainder, pose, known)
        larger = _estimate_larger_noise(remainder, known) if known else -np.inf
        share = np.array([0.0, wrong, larger, *logs])
        share = np.exp(share - share.max())
        share /= share.sum()
        if share[0] > EXCLUDED:
            break
        sources = [NOISE, OUTLIERS, LARGER, *(effect.source for effect in listed)]
        total = {name: float(share[[s == name for s in sources]].sum()) for name in sources}
        first, second, *_ = sorted(total, key=lambda name: -total[name])
        stated = (total[first], second, total[second])
        best = int(np.argmax(np.where([s == first for s in sources], share, -1.0)))
        if first in (OUTLIERS, LARGER):
            causes.append(Cause(first, "", *stated, None, None, np.nan))
            if first == OUTLIERS:  # they have pulled the fit, so that the rest says nothing
                break
            known = 0.0
            continue
        effect = listed.pop(best - 3)
        spectrum, size = spectra[best - 3], sizes[best - 3]
        p_value = compute_any_probability(spectrum.compute_tail(known), len(effects))
        causes.append(Cause(first, effect.name, *stated, effect, size, p_value))
        remainder = remainder.add(spectrum, size.ratio)
    return tuple(causes)


def _estimate_larger_noise(remainder: Remainder, known: float) -> float:
    """Return the evidence of a noise of unknown size beside the stated one."""
    square = float(remainder.residual @ remainder.weigh(remainder.residual))
    count = max(round(remainder.degrees), 1)
    y = np.full(count, np.sqrt(square / count))
    return estimate_variance_component(np.ones(count), y, known).evidence


def measure_wrong_poses(remainder: Remainder, pose: IntArray, known: float) -> float:
    """Return the evidence of few wrong poses. The pose that fits the others least is excluded, and
    so on.
    """
    order = np.argsort(pose, kind="stable")
    names, count = np.unique(pose, return_counts=True)
    member = np.full((len(names), int(count.max())), -1)  # rows of each pose
    member[np.arange(member.shape[1]) < count[:, None]] = order
    is_row = member >= 0
    total, evidence = 0.0, [-np.inf]
    for k in range(1, min(max(int(OUTLYING * len(names)), 1), MOST_WRONG) + 1):
        square = float(remainder.residual @ remainder.weigh(remainder.residual))
        P = remainder.taken[member] * is_row[..., None]
        own = remainder.weigh(remainder.residual)[member] * is_row
        w, vectors = np.linalg.eigh(
            is_row[:, None] * np.eye(member.shape[1]) - P @ P.swapaxes(1, 2)
        )
        y = (own[:, None] @ vectors)[:, 0]
        is_open = w > UNSEEN
        distance = (np.where(is_open, y, 0.0) ** 2 / np.where(is_open, w, 1.0)).sum(axis=1)
        degrees = is_open.sum(axis=1)
        left = remainder.degrees + known - degrees
        spread = np.ones(len(left)) if np.isinf(known) else (square + known - distance) / left
        p_value = compute_f_tail(degrees, left, distance / np.maximum(degrees, 1) / spread)
        worst = int(np.nanargmin(np.where(degrees > 0, p_value, 2.0)))
        columns = np.zeros((len(pose), int(count[worst])))
        columns[member[worst, : count[worst]], np.arange(count[worst])] = 1.0
        spectrum = remainder.find_spectrum(columns)
        if not len(spectrum.y) or remainder.degrees <= len(spectrum.y):
            break
        total += spectrum.estimate(known).evidence - np.log((len(names) - k + 1) / k)
        remainder = remainder.add(spectrum, np.inf)
        evidence.append(total - k * np.log(2.0))  # more wrong poses are less probable
    return float(np.logaddexp.reduce(evidence))
