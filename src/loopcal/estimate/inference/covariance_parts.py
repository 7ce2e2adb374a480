# SPDX-License-Identifier: Apache-2.0
"""Parts of a covariance whose size was estimated from data, each with its degrees of freedom."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from loopcal.typing import FloatArray

PREFIX = "posterior_"
"""Beginning of the names of the arrays of a run folder."""

NOISE = "noise"
"""Source of the part of the covariance that the noise of the rows causes."""

TOLERANCES = "tolerances"
"""Source of the part that the deviations from nominal cause, where their size was estimated."""

PARTS = ("source", "degrees", "root", "part")
"""Arrays of a run folder (after `PREFIX`) with the parts of the covariance: the source and the
degrees of freedom of each, the roots beside each other, and the number of the part of each column.
"""


class CovariancePart(NamedTuple):
    """A part of the covariance of the parameters whose size was estimated from data.

    Attributes
    ----------
    source : what causes it: "noise", "tolerances", or the code of the finding with which it was
        added.
    root : (p, k) [SI], the part is root root'.
    degrees : degrees of freedom of its estimated size; infinite where it is known.
    """

    source: str
    root: FloatArray
    degrees: float

    @property
    def is_added(self) -> bool:
        """Whether it is beside what noise and tolerances cause."""
        return self.source not in (NOISE, TOLERANCES)


def combine_degrees(total: FloatArray, squares: Iterable[tuple[FloatArray, float]]) -> FloatArray:
    """Return the effective degrees of freedom (..,) of variances.

    With parts u_i^2 of nu_i degrees of freedom (Welch-Satterthwaite, JCGM 100, G.4):

        degrees = u^4 / sum(u_i^4 / nu_i)

    Parameters
    ----------
    total : (..,) variance u^2 of all parts, also those that are known. squares : variance (..,) and
        degrees of freedom of each part that was estimated.

    Returns
    -------
    At least the smallest nu_i; infinite where nothing was estimated, or the variance is infinite.
    """
    spread = sum((square**2 / nu for square, nu in squares), np.zeros_like(total))
    is_estimated = np.isfinite(total) & (spread > 0.0)
    square = np.where(is_estimated, total, 1.0) ** 2
    return np.divide(square, spread, out=np.full_like(total, np.inf), where=is_estimated)


def store_parts(parts: Sequence[CovariancePart], parameters: int) -> dict[str, np.ndarray]:
    """Return the arrays of a run folder, which `parts_from_arrays` reads, for p parameters."""
    roots = [part.root for part in parts]
    content = (
        np.array([part.source for part in parts], dtype=np.str_),
        np.array([part.degrees for part in parts]),
        np.concatenate([np.zeros((parameters, 0)), *roots], axis=1),
        np.repeat(np.arange(len(parts)), [root.shape[1] for root in roots]),
    )
    return {PREFIX + name: array for name, array in zip(PARTS, content, strict=True)}


def parts_from_arrays(arrays: Mapping[str, np.ndarray]) -> tuple[CovariancePart, ...]:
    """Return the parts of a covariance in a run folder; none in those of earlier versions."""
    if any(PREFIX + name not in arrays for name in PARTS):
        return ()
    sources, degrees, roots, number = (arrays[PREFIX + name] for name in PARTS)
    return tuple(
        CovariancePart(str(source), roots[:, number == i], float(degrees[i]))
        for i, source in enumerate(sources.tolist())
    )
