# SPDX-License-Identifier: Apache-2.0
"""The model discrepancy of a fit: slow errors of the poses that no geometry explains.

The true poses are those of a geometry plus errors phi(T) c of `SmoothErrors`, independent c of
variance 1. A fit without them moves its parameters by L c, so that a pose of the calibrated machine
errs by (D L - phi(T)) c beside what the noise does. Both terms belong together: where the
parameters follow the errors, the poses err less than by either of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.estimate.poses.smooth_errors import PREFIX, SmoothErrors
from loopcal.findings.wording import round_to_digits
from loopcal.typing import FloatArray

DISCREPANCY = "residuals.model-discrepancy"
"""Source of the part of the covariance that the discrepancy causes, and code of its finding."""

STORED = ("root", "degrees", "directions", "variance")
"""Arrays of a run folder (after `PREFIX`), beside those of the errors."""


@dataclass(frozen=True, eq=False)
class ModelDiscrepancy:
    """Slow errors of the poses of a calibrated machine.

    Attributes
    ----------
    errors : phi. root : (p, m) L [SI].
    degrees : (2,) degrees of freedom of the amplitudes of rotation and place; infinite where the
        amplitude is zero.
    directions, variance : (p, p), (p,) of the posterior without the discrepancy.
    """

    errors: SmoothErrors
    root: FloatArray
    degrees: FloatArray
    directions: FloatArray
    variance: FloatArray

    def __repr__(self) -> str:
        """Return the amplitudes."""
        rotation, place = 1e3 * self.errors.amplitude[[0, 3]]
        return (
            f"<ModelDiscrepancy: {round_to_digits(place)} mm and {round_to_digits(rotation)} mrad>"
        )

    def twists(self, T: FloatArray, by_parameters: FloatArray) -> FloatArray:
        """Return twists (n, 6, m) of the platform at poses T (n, 4, 4) by independent errors of
        variance 1: first those by the rotations, then those by the places of `errors`.

        `by_parameters` (n, 6, p) are the twists by the parameters [per SI].
        """
        return by_parameters @ self.root - self.errors.twists(T)

    def split_squares(self, twists: FloatArray) -> list[tuple[FloatArray, float]]:
        """Return the variances (n, 6) that the errors of rotation and those of place cause, from
        columns (n, 6, m) such as `twists`, and the degrees of freedom of each.
        """
        halves = np.split(twists, 2, axis=2)
        return [
            ((half**2).sum(axis=2), float(degrees))
            for half, degrees in zip(halves, self.degrees, strict=True)
        ]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of the run folder, which `discrepancy_from_arrays` reads."""
        own = {PREFIX + name: np.asarray(getattr(self, name)) for name in STORED}
        return {**own, **self.errors.arrays()}


def discrepancy_from_arrays(arrays: Mapping[str, np.ndarray]) -> ModelDiscrepancy | None:
    """Return the discrepancy in the arrays of a run folder; None where it holds none."""
    if PREFIX + STORED[0] not in arrays:
        return None
    own = (arrays[PREFIX + name] for name in STORED)
    return ModelDiscrepancy(SmoothErrors.from_arrays(arrays), *own)
