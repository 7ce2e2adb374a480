# SPDX-License-Identifier: Apache-2.0
"""Options that choose the method, the loss and the noise of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import click

from loopcal.cli.options.shared_options import add_options
from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.estimate import FitOptions
    from loopcal.estimate.methods.inflated_tolerances import By

METHODS = ("auto", "map", "ls", "ridge", "tsvd")
INFLATIONS = ("auto", "global", "groups", "heavy-tailed", "none")
LOSSES = ("none", "huber", "tukey")

rank_tolerance_option = click.option(
    "--rank-tolerance",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    metavar="SHARE",
    help="Share of the largest singular value below which one counts as zero.  [default: 1e-11]",
)
"""Decorator of a command that decides a rank."""

fit_options = add_options(
    click.option(
        "--method",
        type=click.Choice(METHODS),
        default=METHODS[0],
        help="map: the tolerances are a prior. auto: map, with tolerances inflated where the "
        "data contradict them. ls: least squares. ridge, tsvd: regularized least squares.",
    ),
    click.option(
        "--inflation",
        type=click.Choice(INFLATIONS),
        default=INFLATIONS[0],
        help="For auto: which tolerances may be inflated. global: all by one factor. groups: also "
        "limbs and types of parameters, and what these have in common. heavy-tailed: also single "
        "parameters. auto: all of these. none: as stated.",
    ),
    click.option(
        "--lam",
        type=click.FloatRange(min=0),
        metavar="WEIGHT",
        help="For ridge: weight of the penalty; by default chosen by cross-validation.",
    ),
    click.option(
        "--keep",
        type=click.IntRange(min=0),
        metavar="K",
        help="For tsvd: number of directions; by default chosen by cross-validation.",
    ),
    click.option(
        "--noise",
        type=click.Choice(("given", "estimated")),
        default="given",
        help="Take the stated sigmas as true, or as true up to one common factor that is "
        "estimated.",
    ),
    click.option(
        "--sigma-uncertainty",
        type=click.FloatRange(0, 1),
        metavar="SHARE",
        help="Relative standard uncertainty of given sigmas, which the intervals account for; 0 "
        "takes them as exact.  [default: 0.25]",
    ),
    click.option(
        "--loss",
        type=click.Choice(LOSSES),
        default=LOSSES[0],
        help="Reduce the weight of poses that are far from the fit.",
    ),
    rank_tolerance_option,
    click.option(
        "--drop",
        multiple=True,
        metavar="POSE",
        help="Exclude this pose from fit and validation. May be given several times.",
    ),
)
"""Decorator of a command that fits; `make_fit_options` takes their values."""


def _make_default(inflation: By | Literal["none"]) -> Any:
    """Return the default method, None, or MAP with another choice of what is inflated."""
    from loopcal.estimate import MAP, InflatedTolerances

    if inflation == "auto":
        return None
    return MAP() if inflation == "none" else MAP(InflatedTolerances(inflation))


def make_fit_options(options: Mapping[str, Any]) -> FitOptions:
    """Return the options of the library from those of `fit_options`.

    Raises
    ------
    DataError
        A number that belongs to another method.
    """
    from loopcal import estimate
    from loopcal.estimate.inference.residual_test import SIGMA_UNCERTAINTY
    from loopcal.numerics.decomposition import RANK_TOLERANCE

    stated = options["sigma_uncertainty"]
    name, lam, keep = options["method"], options["lam"], options["keep"]
    for option, value, needed in (("--lam", lam, "ridge"), ("--keep", keep, "tsvd")):
        if value is not None and name != needed:
            raise DataError(
                f"{option} belongs to --method {needed}, not to {name}; leave it out, or change "
                "the method"
            )
    inflation = options["inflation"]
    if inflation != INFLATIONS[0] and name != "auto":
        raise DataError(
            f"--inflation belongs to --method auto, not to {name}; leave it out, or change the "
            "method"
        )
    if name == "auto":
        method = _make_default(inflation)
    elif name == "ridge":
        method = estimate.Ridge(estimate.GCV() if lam is None else lam)
    elif name == "tsvd":
        method = estimate.TruncatedSVD(estimate.TruncationGCV() if keep is None else keep)
    else:
        method = estimate.MAP() if name == "map" else estimate.LeastSquares()
    loss = None
    if options["loss"] != "none":
        loss = estimate.Huber() if options["loss"] == "huber" else estimate.Tukey()
    return estimate.FitOptions(
        method=method,
        loss=loss,
        noise=options["noise"],
        sigma_uncertainty=SIGMA_UNCERTAINTY if stated is None else stated,
        excluded_poses=options["drop"],
        rank_tolerance=options["rank_tolerance"] or RANK_TOLERANCE,
    )
