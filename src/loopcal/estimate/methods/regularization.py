# SPDX-License-Identifier: Apache-2.0
"""The regularization that a fit used: its parameter, how it was chosen, and how much it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.estimate.methods.penalties import Method, Ridge, TruncatedSVD
from loopcal.findings import Finding, report_finding
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import FloatArray

FIXED = "fixed"
"""Rule of a parameter that was given."""


@dataclass(frozen=True)
class Regularization:
    """Ridge parameter or truncation of a fit.

    Attributes
    ----------
    parameter : "lam", the ridge parameter in squared standard deviations of the noise per squared
        tolerance, or "k", the number of directions of a truncated SVD.
    value : of the parameter; the largest one where each parameter has its own `lam`.
    rule : name of the rule that chose it, such as "GCV"; "fixed" where it was given.
    score : what the rule minimizes, at `value`; None where it was given or the rule has no score.
    effective : sum of the filter factors, the number of directions that the data determine after
        regularization. parameters, rank : p, and the number of directions without regularization.
    is_at_limit : whether a rule chose an end of its range, so that its minimum may lie beyond.
    """

    parameter: str
    value: float
    rule: str
    score: float | None
    effective: float
    parameters: int
    rank: int
    is_at_limit: bool

    @property
    def finding(self) -> Finding:
        """The parameter with rule and score."""
        code = "fit.regularization-at-limit" if self.is_at_limit else "fit.regularization"
        return report_finding(code, **vars(self))

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name for JSON."""
        return dict(vars(self))


def describe_regularization(
    method: Method, decomposition: Decomposition, penalty: FloatArray
) -> Regularization | None:
    """Return the regularization of trial 0; None for methods without a parameter to choose.

    Parameters
    ----------
    decomposition, penalty : of the fit.
    """
    if isinstance(method, Ridge):
        name, stated = "lam", method.lam
    elif isinstance(method, TruncatedSVD):
        name, stated = "k", method.k
    else:
        return None
    score, is_at_limit, rule = None, False, FIXED
    if callable(stated):
        value = float(np.atleast_1d(np.asarray(stated(decomposition)))[0])
        rule = getattr(stated, "__name__", type(stated).__name__)
        if callable(measure := getattr(stated, "score", None)):
            score = float(np.asarray(measure(decomposition, np.full(1, value)))[0])
        if callable(is_limit := getattr(stated, "is_limit", None)):
            is_at_limit = bool(np.asarray(is_limit(decomposition, np.full(1, value)))[0])
    else:
        value = float(np.max(stated))
    return Regularization(
        parameter=name,
        value=value,
        rule=rule,
        score=score,
        effective=float(decomposition.filter_factors(penalty)[0].sum()),
        parameters=penalty.shape[1],
        rank=int(decomposition.rank[0]),
        is_at_limit=is_at_limit,
    )
