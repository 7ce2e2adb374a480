# SPDX-License-Identifier: Apache-2.0
"""The names of methods, and of rules that choose a number of a method, wherever options are stated:
on the command line, in study files and in the results of runs.

A new method or rule is a frozen dataclass with its `name`, whose fields are its settings, and a
line here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from loopcal.registry import Registry

if TYPE_CHECKING:
    from loopcal.estimate.penalties import Method, Rule

METHODS: Registry[Callable[..., Method | None]] = Registry(
    "method",
    "loopcal.methods",
    {
        "auto": "loopcal.estimate.penalties:make_default_method",
        "map": "loopcal.estimate.penalties:MAP",
        "least-squares": "loopcal.estimate.penalties:LeastSquares",
        "ridge": "loopcal.estimate.penalties:Ridge",
        "truncated-svd": "loopcal.estimate.penalties:TruncatedSVD",
    },
    aliases={"ls": "least-squares", "tsvd": "truncated-svd"},
)
"""Name -> what makes a method from its settings; "auto" makes None, the default of a fit."""

RULES: Registry[Callable[..., Rule]] = Registry(
    "rule",
    "loopcal.rules",
    {
        "gcv": "loopcal.estimate.penalties:GCV",
        "marginal-likelihood": "loopcal.estimate.penalties:MarginalLikelihood",
        "truncation-gcv": "loopcal.estimate.penalties:TruncationGCV",
        "inflated-tolerances": "loopcal.estimate.tolerance_components:InflatedTolerances",
    },
)
"""Name -> rule that chooses the ridge parameter, the truncation or the inflation."""

SETTINGS = {
    "inflation": ("auto", "inflation"),
    "lam": ("ridge", "lam"),
    "keep": ("truncated-svd", "k"),
}
"""Settings that stand beside the name of a method on the command line and in study files -> that
method, and the setting of its class.
"""
