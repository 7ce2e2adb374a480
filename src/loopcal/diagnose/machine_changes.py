# SPDX-License-Identifier: Apache-2.0
"""The change of parameters between two calibrations, in the directions that both data determine.

Each calibration gives rows B e = b + noise without tolerances (`DataInformation`). Let the machine
have the parameters e at the first and e + d at the second. With both sets of rows divided by their
noise, stacked as M e = w, and an orthonormal basis Q of the vectors orthogonal to all columns of M,

    u = Q' w = D d + noise of unit variance,   D = Q' (0; B_2)

is all that can be said of d: directions that one of the data sets leaves open are gone, among them
motions of frames that differ between the sessions. Without a change |u|^2 is a chi-square with as
many degrees of freedom as u has entries. The noise of both is estimated, see
`compute_averaged_tail`. Errors beside the noise, such as those that a session shares, enter the
covariance of u.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from loopcal.estimate.posterior import Posterior, combine_degrees
from loopcal.numerics.decomposition import NULL_COMPONENT, are_nonzero
from loopcal.numerics.statistics import (
    compute_averaged_tail,
    compute_chi_square_quantile,
    compute_f_tail,
)
from loopcal.typing import BoolArray, FloatArray

# Sine of the angle up to which null directions of two linearizations are the same direction.
PARALLEL = 1e-2
# Share of the largest singular value above which a column of both data sets is independent.
INDEPENDENT = 1e-9
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

    def __repr__(self) -> str:
        """Return the numbers of directions and parameters."""
        return f"<ParameterChanges: {self.degrees} directions of {len(self.names)} parameters>"

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
        """Return the probability of a larger chi-square if nothing has changed; NaN without a
        direction.
        """
        if degrees == 0 or not np.isfinite(chi_square):
            return float("nan")
        return compute_averaged_tail(chi_square, degrees, self.sources)

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
        return np.where(is_open, np.nan, compute_f_tail(1.0, degrees, square))

    def _invert(self) -> tuple[FloatArray, BoolArray]:
        """Return the matrix (p, k) that gives the shifts in tolerances of values, and which
        parameters (p,) it does not determine.
        """
        u, s, vt = np.linalg.svd(self.slope * self.unit, full_matrices=False)
        is_used = are_nonzero(s, INDEPENDENT)
        basis = vt[is_used].T
        is_open = 1.0 - (basis**2).sum(axis=1) > NULL_COMPONENT
        return (basis / s[is_used]) @ u[:, is_used].T, is_open

    def project_out(self, places: list[int]) -> tuple[float, int]:
        """Return the chi-square that is left where some parameters may have changed, and its
        degrees of freedom.
        """
        columns = (self.slope * self.unit)[:, places]
        u, s, _ = np.linalg.svd(columns, full_matrices=False)
        largest = np.linalg.norm(self.slope * self.unit, 2) if self.slope.size else 0.0
        explained = u[:, s > INDEPENDENT * largest].T @ self.value
        left = max(self.chi_square - float(explained @ explained), 0.0)
        return left, self.degrees - len(explained)


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
    scaled = _remove_common_null(rows[0] * unit, rows[1] * unit)
    stacked = np.vstack(scaled)
    u, s, _ = np.linalg.svd(stacked, full_matrices=True)
    rank = int(are_nonzero(s, INDEPENDENT).sum()) if len(s) else 0
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
            if added.is_added and np.isfinite(added.root).all()
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


def _remove_common_null(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return both sets of rows without the directions that neither determines: each has them at its
    own linearization, and the small angle between the two would count as information.
    """
    bases = []
    for rows in (first, second):
        _, s, vt = np.linalg.svd(rows, full_matrices=True)
        bases.append(vt[int(are_nonzero(s).sum()) if len(s) else 0 :].T)
    null, other = bases
    if not null.shape[1] or not other.shape[1]:
        return first, second
    outside = null - other @ (other.T @ null)
    _, sine, combine = np.linalg.svd(outside, full_matrices=True)
    sine = np.r_[sine, np.zeros(len(combine) - len(sine))]
    common = null @ combine[sine < PARALLEL].T
    return first - (first @ common) @ common.T, second - (second @ common) @ common.T


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
    """Return the simplest cause of a change; `level` is the probability with which the true cause
    is rejected.
    """
    limbs: dict[str, list[int]] = {}  # places of its parameters, named before the first point
    for i, name in enumerate(changes.names):
        if "." in name:
            limbs.setdefault(name.split(".")[0], []).append(i)
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
        near = left + float(compute_chi_square_quantile(1.0, DISTINGUISHED))
        others = [
            causes[i][0]
            for i in sorted(tested, key=lambda i: results[i][0])
            if i != best and results[i][0] <= near
        ]
        names, places = causes[best]
        parameters = tuple(changes.names[i] for i in places)
        return ChangeCause(kind, names, parameters, tuple(others), left, degrees)
    return ChangeCause("none")


def estimate_cause(changes: ParameterChanges, cause: ChangeCause) -> tuple[np.ndarray, np.ndarray]:
    """Return the change (k,) and its standard deviation (k,) [SI] of the parameters of a cause if
    nothing else has changed; NaN where the data do not determine it.
    """
    places = [changes.names.index(name) for name in cause.parameters]
    alone = ParameterChanges(
        cause.parameters,
        changes.unit[places],
        changes.slope[:, places],
        changes.value,
        changes.errors,
    )
    return alone.estimate_shifts()
