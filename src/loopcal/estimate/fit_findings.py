# SPDX-License-Identifier: Apache-2.0
"""Findings of a fit: how the iteration ended, poses with low weight, estimates beyond tolerance."""

from __future__ import annotations

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.methods.losses import Loss, describe_loss
from loopcal.estimate.methods.penalties import MAP, Method, Ridge
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.typing import FloatArray

FAR = 10.0
"""Deviation from nominal, in stated tolerances (standard deviations), that contradicts the
tolerance; noise alone does not cause it.
"""

LOW_WEIGHT = 0.5
"""Weight of a pose below which it is named."""

STATUS_CODES = {
    DescentStatus.CONVERGED: "fit.converged",
    DescentStatus.OUT_OF_ITERATIONS: "fit.out-of-iterations",
    DescentStatus.NO_DESCENT: "fit.no-descent",
    DescentStatus.BAD_START: "fit.bad-start",
    DescentStatus.NO_PROGRESS: "fit.no-progress",
}


def report_status(status: DescentStatus, iterations: int) -> Finding:
    """Return how the iteration ended."""
    code = STATUS_CODES[status]
    if status is DescentStatus.BAD_START:
        return report_finding("fit.bad-start")
    return report_finding(code, iterations=iterations)


def report_divergence(
    free: FreeParameters, deviation: FloatArray, method: Method, converged: bool
) -> list[Finding]:
    """Return findings on estimates far beyond their stated tolerances.

    Nothing is reported where the tolerances are a prior: then `PriorConflict` tests them.

    Parameters
    ----------
    free : the parameters. deviation : (p,) estimate - nominal, in tolerances.
    method : of the fit. converged : whether the iteration did.
    """
    if isinstance(method, MAP):
        return []
    far = np.flatnonzero((np.abs(deviation) > FAR) & ~free.assumed)
    if len(far) == 0:
        stated = not free.assumed.all()
        return [report_finding("fit.no-prior")] if stated and not converged else []
    order = far[np.argsort(-np.abs(deviation[far]), kind="stable")]
    return [
        report_finding(
            "fit.beyond-tolerance",
            names=tuple(free.names[i] for i in order),
            factor=abs(float(deviation[order[0]])),
        )
    ]


def report_weights(data: Measurements, weights: FloatArray, loss: Loss | None) -> list[Finding]:
    """Return which poses a loss gave less than half of their weight.

    Parameters
    ----------
    weights : (n,) of the poses. loss : None reports nothing.
    """
    if loss is None:
        return []
    low = tuple(data.labels[i] for i in np.flatnonzero(weights < LOW_WEIGHT))
    name, total = describe_loss(loss), data.n_poses
    if not low:
        return [report_finding("fit.full-weights", loss=name, total=total)]
    return [report_finding("fit.low-weights", loss=name, count=len(low), total=total, poses=low)]


def report_used_poses(
    data: Measurements, weights: FloatArray, loss: Loss | None, excluded: tuple[str, ...]
) -> list[Finding]:
    """Return which poses the loss gives little weight, and which ones the options exclude."""
    findings = report_weights(data, weights, loss)
    return (
        [*findings, report_finding("fit.excluded-poses", poses=excluded)] if excluded else findings
    )


def report_equations(equations: int, parameters: int, method: Method) -> list[Finding]:
    """Return how many directions are known from tolerances alone."""
    if equations >= parameters or not isinstance(method, MAP):
        return []
    return [
        report_finding(
            "fit.few-equations",
            equations=equations,
            parameters=parameters,
            directions=parameters - equations,
        )
    ]


def report_unknown_bias(
    free: FreeParameters, method: Method, prior: FloatArray | None
) -> list[Finding]:
    """Return why a ridge has no intervals, where its bias is not known.

    Parameters
    ----------
    prior : (1, p) variance of the true coordinates, see `Method.prior_variance`.
    """
    if not isinstance(method, Ridge) or prior is None or not np.isnan(prior).any():
        return []
    lacking = method.lacks_tolerances(free)
    return [
        report_finding(
            "fit.ridge-without-intervals",
            names=tuple(n for n, lacks in zip(free.names, lacking, strict=True) if lacks),
            is_correlated=free.correlation is not None,
        )
    ]
