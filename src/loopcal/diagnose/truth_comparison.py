# SPDX-License-Identifier: Apache-2.0
"""Compare the parameters of a fit with true ones, in the directions that the data determine.

Fits of one machine may differ by millimeters along unobservable directions without any effect on
the measurements, so the plain difference between parameters and their true values means little.
With the deviations z in tolerances and an orthonormal basis N of the unobservable directions, the
comparable part of the error is, to first order,

    e = (1 - N N') (z_estimate - z_truth)

See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import EstimationError
from loopcal.estimate.inference.null_space import Combination
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class TruthComparison:
    """Errors of the free parameters of a fit; arrays (p,) in the order of `names`.

    Attributes
    ----------
    names : of the free parameters.
    raw : estimate minus truth [SI].
    error : the same without the unobservable directions [SI].
    tolerances : `error` in tolerances [1].
    dropped : the unobservable directions, as combinations of parameters.
    """

    names: tuple[str, ...]
    raw: FloatArray
    error: FloatArray
    tolerances: FloatArray
    dropped: tuple[Combination, ...]

    @property
    def rms(self) -> float:
        """Root mean square of the error in tolerances over the compared directions; NaN without
        any.
        """
        count = len(self.names) - len(self.dropped)
        return float(np.sqrt(np.sum(self.tolerances**2) / count)) if count else float("nan")

    @property
    def finding(self) -> Finding:
        """The compared directions, and those that the data do not determine."""
        return report_finding(
            "identifiability.compared-with-truth",
            parameters=len(self.names),
            compared=len(self.names) - len(self.dropped),
            excluded=tuple(dict(combination.finding.data) for combination in self.dropped),
        )

    def __repr__(self) -> str:
        p, d = len(self.names), len(self.dropped)
        return (
            f"<TruthComparison: {p} parameters, {p - d} directions, rms {self.rms:.3g} tolerances>"
        )

    def to_dict(self) -> dict[str, object]:
        """Return the attributes, the root mean square and the finding, SI."""
        return {**vars(self), "rms": self.rms, "finding": self.finding}


def compare_with_truth(fit: Identification, truth: ArrayLike) -> TruthComparison:
    """Compare the parameters of a fit with true ones in the directions that its data determine.

    Parameters
    ----------
    fit : Identification
    truth : (parameters of the robot,) or (free parameters,) [SI]
        True values of the robot's table, or of its free parameters only, in that order.

    Raises
    ------
    EstimationError
        The number of true values is different, or one of them is not finite.
    """
    true = np.asarray(truth, dtype=np.float64)
    p, total = len(fit.names), len(fit.robot.parameters)
    if true.shape not in ((p,), (total,)) or not np.isfinite(true).all():
        problem = "" if np.isfinite(true).all() else " and numbers that are not finite"
        raise EstimationError(
            f"the truth has shape {true.shape}{problem}; give {total} values for all parameters of "
            f"{fit.robot.name!r}, or {p} for the free ones"
        )
    true = true[fit.free_parameters.places] if len(true) == total else true
    raw = fit.estimate - true
    z = raw / fit.tolerance
    posterior = fit.posterior
    unobservable = posterior.directions[:, ~posterior.determined]
    basis = np.linalg.qr((posterior.unit / fit.tolerance)[:, None] * unobservable)[0]
    z = z - basis @ (basis.T @ z)
    return TruthComparison(fit.names, raw, z * fit.tolerance, z, fit.unidentifiable)
