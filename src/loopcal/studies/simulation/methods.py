# SPDX-License-Identifier: Apache-2.0
"""The estimation method of a cell."""

from __future__ import annotations

from loopcal.estimate import (
    GCV,
    MAP,
    FitOptions,
    Huber,
    InflatedTolerances,
    LeastSquares,
    Ridge,
    TruncatedSVD,
    TruncationGCV,
    Tukey,
)
from loopcal.estimate.methods.losses import Loss
from loopcal.estimate.methods.penalties import Method
from loopcal.studies.specification.levels import MethodLevel


def make_method(level: MethodLevel) -> Method:
    """Return the method of a level; the default is that of `identify`."""
    if level.has_steps:  # fitted in published_fits.py
        return LeastSquares()
    if level.method == "map":
        return MAP()
    if level.method == "least-squares":
        return LeastSquares()
    if level.method == "ridge":
        return Ridge(GCV() if level.lam is None else level.lam)
    if level.method == "truncated-svd":
        return TruncatedSVD(TruncationGCV() if level.keep is None else level.keep)
    return MAP(InflatedTolerances())


def make_loss(level: MethodLevel) -> Loss | None:
    """Return the loss of a level."""
    return {"none": None, "huber": Huber(), "tukey": Tukey()}[level.loss]


def make_fit_options(level: MethodLevel) -> FitOptions:
    """Return the options of a fit."""
    return FitOptions(method=make_method(level), loss=make_loss(level), noise=level.noise)
