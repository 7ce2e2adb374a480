# SPDX-License-Identifier: Apache-2.0
"""Errors of parameters against a truth, after what the data leave open is taken out.

Two fits of one machine may differ by millimetres along a direction that changes nothing that was
measured, so that the plain difference of parameters says nothing of either. With the deviations of
estimate and truth in tolerances, z, and an orthonormal basis N of the directions that the rows do
not determine, what can be compared is

    e = (1 - N N') (z_estimate - z_truth)

to first order about the estimate. See docs/theory/gauge.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import EstimationError
from loopcal.estimate.inference.null_space import Combination
from loopcal.estimate.result import Identification
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class TruthComparison:
    """Errors of the free parameters of a fit; arrays (p,) in the order of `names`.

    Attributes
    ----------
    names : of the free parameters.
    raw : estimate minus truth [SI], whatever the data say of it.
    error : the same after the directions that the data leave open are projected out [SI].
    tolerances : `error` in tolerances [1].
    dropped : the directions that were projected out, by name.
    """

    names: tuple[str, ...]
    raw: FloatArray
    error: FloatArray
    tolerances: FloatArray
    dropped: tuple[Combination, ...]

    @property
    def rms(self) -> float:
        """Root mean square of the error in tolerances, over as many directions as are compared; NaN
        where none is.
        """
        left = len(self.names) - len(self.dropped)
        return float(np.sqrt(np.sum(self.tolerances**2) / left)) if left else float("nan")

    @property
    def sentence(self) -> str:
        """What was compared."""
        if not self.dropped:
            return f"errors of {len(self.names)} parameters; the data determine all of them"
        left = len(self.names) - len(self.dropped)
        words = "; ".join(combination.parts for combination in self.dropped)
        return (
            f"errors of {len(self.names)} parameters in the {left} directions that the data "
            "determine; not compared, because"
            f" the data leave it open: {words}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name for JSON, SI."""
        return {
            "names": list(self.names),
            "raw": self.raw,
            "error": self.error,
            "tolerances": self.tolerances,
            "rms": self.rms,
            "dropped": [combination.to_dict() for combination in self.dropped],
            "sentence": self.sentence,
        }


def compare_with_truth(fit: Identification, truth: ArrayLike) -> TruthComparison:
    """Compare the parameters of a fit with true ones, after what its data leave open is projected
    out.

    Parameters
    ----------
    fit : Identification
    truth : (parameters of the robot,) or (free parameters,) [SI]
        All true values in the order of the robot's table, or those of its free parameters alone.

    Returns
    -------
    TruthComparison

    Raises
    ------
    EstimationError
        If there is another number of true values, or one is not finite.
    """
    true = np.asarray(truth, dtype=np.float64)
    p, whole = len(fit.names), len(fit.robot.parameters)
    if true.shape not in ((p,), (whole,)) or not np.isfinite(true).all():
        raise EstimationError(
            "the truth has shape "
            f"{true.shape}{'' if np.isfinite(true).all() else ' and numbers that are not finite'}; "
            "give"
            f" {whole} values for all parameters of {fit.robot.name!r}, or {p} for the free ones"
        )
    true = true[fit.free_parameters.places] if len(true) == whole else true
    raw = fit.estimate - true
    z = raw / fit.tolerance
    known = fit.posterior
    open_ = (known.unit / fit.tolerance)[:, None] * known.directions[:, ~known.determined]
    basis = np.linalg.qr(open_)[0]
    z = z - basis @ (basis.T @ z)
    return TruthComparison(fit.names, raw, z * fit.tolerance, z, fit.unidentifiable)
