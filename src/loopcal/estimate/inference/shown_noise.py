# SPDX-License-Identifier: Apache-2.0
"""The noise that residuals alone show, without the stated sigma.

A covariance contains the stated noise, or a compromise between it and the residuals. A test whose
false-alarm rate must not depend on a wrong sigma needs the noise that the residuals show.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.estimate.inference.residual_test import FEWEST_DEGREES, ResidualTest
from loopcal.numerics.decomposition import Decomposition

NAME = "posterior_shown_noise"
"""Name of the stored array."""


@dataclass(frozen=True)
class ShownNoise:
    """The variance of whitened rows, in units of the stated one.

    Attributes
    ----------
    variance : that of the residuals that no parameter explains. degrees : its degrees of freedom.
    used : the variance that the covariance of the fit contains.
    """

    variance: float
    degrees: float
    used: float

    @property
    def is_known(self) -> bool:
        """Whether at least five degrees of freedom determine it."""
        return self.degrees >= FEWEST_DEGREES and self.variance > 0.0

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the numbers by name, to be stored."""
        return {NAME: np.array([self.variance, self.degrees, self.used])}


def find_shown_noise(decomposition: Decomposition, test: ResidualTest) -> ShownNoise | None:
    """Return the noise that the residuals of a fit show (t = 1); None without intervals, or where
    a loss chose the weights by the residuals.
    """
    if not test.intervals or test.weighted:
        return None
    degrees = float((decomposition.rows - decomposition.rank)[0])
    variance = float(decomposition.unexplained[0]) / degrees if degrees > 0.0 else np.nan
    return ShownNoise(variance, degrees, test.sigma_scale**2)


def shown_noise_from_arrays(arrays: Mapping[str, np.ndarray]) -> ShownNoise | None:
    """Return the noise in the arrays of a run folder; None where it is not known."""
    return ShownNoise(*arrays[NAME].tolist()) if NAME in arrays else None
