# SPDX-License-Identifier: Apache-2.0
"""Options that say how parameters are estimated, packed into one value."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal

import click

from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.estimate import FitOptions

METHODS = ("auto", "map", "ls", "ridge", "tsvd")
LOSSES = ("none", "huber", "tukey")


@dataclass(frozen=True)
class FitArguments:
    """The options of `fit_options` as the user gave them."""

    method: str
    lam: float | None
    keep: int | None
    noise: Literal["given", "estimated"]
    loss: str
    drop: tuple[str, ...]

    def to_options(self) -> FitOptions:
        """Return the options of the library.

        Raises
        ------
        DataError
            A number that belongs to another method.
        """
        from loopcal.estimate import (
            GCV,
            MAP,
            FitOptions,
            Huber,
            LeastSquares,
            Ridge,
            TruncatedSVD,
            TruncationGCV,
            Tukey,
        )

        for option, value, needs in (("--lam", self.lam, "ridge"), ("--keep", self.keep, "tsvd")):
            if value is not None and self.method != needs:
                raise DataError(
                    f"{option} belongs to --method {needs}, not to {self.method}; leave it out, or "
                    "change the method"
                )
        method = {
            "auto": lambda: None,
            "map": MAP,
            "ls": LeastSquares,
            "ridge": lambda: Ridge(GCV() if self.lam is None else self.lam),
            "tsvd": lambda: TruncatedSVD(TruncationGCV() if self.keep is None else self.keep),
        }[self.method]()
        loss = {"none": lambda: None, "huber": Huber, "tukey": Tukey}[self.loss]()
        return FitOptions(method=method, loss=loss, noise=self.noise, excluded_poses=self.drop)


def fit_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options; the command gets them as `fit_arguments`."""
    names = [f.name for f in fields(FitArguments)]

    @functools.wraps(command)
    def packed(**given: Any) -> Any:
        arguments = FitArguments(**{name: given.pop(name) for name in names})
        return command(**given, fit_arguments=arguments)

    options = (
        click.option(
            "--drop",
            multiple=True,
            metavar="POSE",
            help="Exclude this pose from fit and validation. May be given several times.",
        ),
        click.option(
            "--loss",
            type=click.Choice(LOSSES),
            default=LOSSES[0],
            show_default=True,
            help="Reduce the weight of poses that are far from the fit.",
        ),
        click.option(
            "--noise",
            type=click.Choice(("given", "estimated")),
            default="given",
            show_default=True,
            help="Take the stated sigmas as true, or as true up to one common factor that is "
            "estimated.",
        ),
        click.option(
            "--keep",
            type=click.IntRange(min=0),
            metavar="K",
            help="For tsvd: number of directions; by default chosen by cross-validation.",
        ),
        click.option(
            "--lam",
            type=click.FloatRange(min=0),
            help="For ridge: weight of the penalty; by default chosen by cross-validation.",
        ),
        click.option(
            "--method",
            type=click.Choice(METHODS),
            default=METHODS[0],
            show_default=True,
            help="map: the tolerances are a prior. auto: map, with tolerances inflated where the "
            "data contradict them. ls: least squares. ridge, tsvd: regularized least squares.",
        ),
    )
    for option in options:
        packed = option(packed)
    return packed
