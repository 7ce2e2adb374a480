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

import numpy as np

from loopcal.estimate.inference.covariance_parts import CovariancePart, combine_degrees
from loopcal.estimate.inference.data_information import DataInformation
from loopcal.estimate.inference.posterior import Posterior
from loopcal.numerics.chi_square import compute_averaged_tail, compute_f_tail
from loopcal.numerics.decomposition import NULL_COMPONENT, are_nonzero
from loopcal.typing import FloatArray

PARALLEL = 1e-2
"""Sine of the angle up to which null directions of two linearizations are the same direction."""

INDEPENDENT = 1e-9
"""Share of the largest singular value above which a column of both data sets is independent."""


@dataclass(frozen=True, eq=False)
class ParameterChanges:
    """Rows `slope` d = `value` + noise of unit variance for the change d of p parameters.

    Attributes
    ----------
    names : (p,) of the parameters. unit : (p,) tolerances, which make columns comparable [SI].
    slope : (k, p) [1 / SI]. value : (k,) [1].
    sources : how much of the k degrees of freedom each source of errors causes, and the degrees of
        freedom of its variance.
    """

    names: tuple[str, ...]
    unit: FloatArray
    slope: FloatArray
    value: FloatArray
    sources: tuple[tuple[float, float], ...]

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
    def noise_degrees(self) -> float:
        """Effective degrees of freedom of the noise (Welch-Satterthwaite)."""
        total = np.array(sum(part for part, _ in self.sources))
        return float(combine_degrees(total, ((np.array(part), nu) for part, nu in self.sources)))

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
        u, s, vt = np.linalg.svd(self.slope * self.unit, full_matrices=False)
        is_used = are_nonzero(s, INDEPENDENT)
        coordinates = (u.T @ self.value)[is_used] / s[is_used]
        basis = vt[is_used].T
        sd = np.sqrt(((basis / s[is_used]) ** 2).sum(axis=1))
        is_open = 1.0 - (basis**2).sum(axis=1) > NULL_COMPONENT
        shift = np.where(is_open, np.nan, basis @ coordinates)
        return self.unit * shift, self.unit * np.where(is_open, np.nan, sd)

    def test_shifts(self) -> FloatArray:
        """Return for each parameter (p,) the probability of a larger shift if nothing changed."""
        shift, sd = self.estimate_shifts()
        square = (shift / sd) ** 2
        return np.where(np.isnan(square), np.nan, compute_f_tail(1.0, self.noise_degrees, square))

    def project_out(self, places: FloatArray | list[int]) -> tuple[float, int]:
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

    Parameters
    ----------
    first, second : with `information`, of the same parameters.
    """
    one, two = first.information, second.information
    assert one is not None
    assert two is not None
    unit = first.unit
    rows, values = zip(*(_divide_by_noise(i) for i in (one, two)), strict=True)
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
    parts = (left[:, :count], left[:, count:])
    return _whiten(first, second, slope, value, parts, (one, two))


def _divide_by_noise(information: DataInformation) -> tuple[FloatArray, FloatArray]:
    """Return rows and values of unit noise."""
    sigma = np.sqrt(information.variance)
    return information.rows / sigma, information.deviations / sigma


def _remove_common_null(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return both sets of rows without the directions that neither determines: each has them at its
    own linearization, and the small angle between the two would count as information.
    """
    null, other = (_find_null(rows) for rows in (first, second))
    if not null.shape[1] or not other.shape[1]:
        return first, second
    outside = null - other @ (other.T @ null)
    _, sine, combine = np.linalg.svd(outside, full_matrices=True)
    sine = np.r_[sine, np.zeros(len(combine) - len(sine))]
    common = null @ combine[sine < PARALLEL].T
    return first - (first @ common) @ common.T, second - (second @ common) @ common.T


def _find_null(rows: FloatArray) -> FloatArray:
    """Return an orthonormal basis (p, k) of the directions that rows (r, p) do not determine."""
    _, s, vt = np.linalg.svd(rows, full_matrices=True)
    return vt[int(are_nonzero(s).sum()) if len(s) else 0 :].T


def _whiten(
    first: Posterior,
    second: Posterior,
    slope: FloatArray,
    value: FloatArray,
    parts: tuple[FloatArray, FloatArray],
    information: tuple[DataInformation, DataInformation],
) -> ParameterChanges:
    """Divide rows by the root of their covariance, which errors beside the noise increase."""
    extra, degrees = np.zeros((len(value), len(value))), np.inf
    squares = []
    for posterior, part, own in zip((first, second), parts, information, strict=True):
        rows = part @ own.rows / np.sqrt(own.variance)
        for added in _list_added_parts(posterior):
            effect = rows @ added.root
            extra += effect @ effect.T
            squares.append((np.array((effect**2).sum()), added.degrees))
    root = np.linalg.cholesky(np.eye(len(value)) + extra)
    by_noise = [float((np.linalg.solve(root, part) ** 2).sum()) for part in parts]
    sources = [(share, i.degrees) for share, i in zip(by_noise, information, strict=True)]
    if squares:
        degrees = float(combine_degrees(np.array(np.trace(extra)), squares))
        sources.append((max(len(value) - sum(by_noise), 0.0), degrees))
    slope, value = np.linalg.solve(root, slope), np.linalg.solve(root, value)
    return ParameterChanges(first.names, first.unit, slope, value, tuple(sources))


def _list_added_parts(posterior: Posterior) -> list[CovariancePart]:
    """Return the parts of a covariance beside noise and tolerances."""
    return [part for part in posterior.parts if part.is_added and np.isfinite(part.root).all()]
