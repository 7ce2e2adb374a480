# SPDX-License-Identifier: Apache-2.0
"""The options that say how parameters are estimated, packed into one value."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal

import click

from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.diagnose import ModelChoice
    from loopcal.estimate import Identification
    from loopcal.estimate.methods.losses import Loss
    from loopcal.estimate.methods.penalties import Method
    from loopcal.measure import Measurements
    from loopcal.mechanism import Mechanism

METHODS = ("auto", "map", "ls", "ridge", "tsvd")
LOSSES = ("none", "huber", "tukey")


@dataclass(frozen=True)
class Fitting:
    """What `fit_options` gave."""

    method: str
    lam: float | None
    keep: int | None
    noise: Literal["given", "estimated"]
    loss: str
    drop: tuple[str, ...]
    choose_model: bool

    def estimator(self) -> Method | None:
        """Return the method that the options describe; None for the library's own choice."""
        from loopcal.estimate import GCV, MAP, LeastSquares, Ridge, TruncatedSVD, TruncationGCV

        for option, value, needs in (("--lam", self.lam, "ridge"), ("--keep", self.keep, "tsvd")):
            if value is not None and self.method != needs:
                raise DataError(
                    f"{option} belongs to --method {needs}, not to {self.method}; leave it out, or "
                    "change the method"
                )
        if self.method == "ridge":
            return Ridge(GCV() if self.lam is None else self.lam)
        if self.method == "tsvd":
            return TruncatedSVD(TruncationGCV() if self.keep is None else self.keep)
        return {"auto": None, "map": MAP(), "ls": LeastSquares()}[self.method]

    def robust(self) -> Loss | None:
        """Return the loss that the options describe."""
        from loopcal.estimate import Huber, Tukey

        return {"none": None, "huber": Huber(), "tukey": Tukey()}[self.loss]

    def split(
        self, data: Measurements, hold_out: float, seed: int, planned: Sequence[str] = ()
    ) -> tuple[Measurements, Measurements | None]:
        """Return the poses to fit and those to judge by, without those of --drop in either.

        Parameters
        ----------
        hold_out : share of the poses that is drawn by `seed`. planned : names that the data hold
            out themselves, in its place.
        """
        from loopcal.estimate.excluded_poses import exclude_poses

        kept = exclude_poses(data, self.drop)
        judge = [label in planned for label in kept.labels]
        if all(judge):
            raise DataError(
                "every pose of the data is marked held-out in the column 'use'; leave some to fit"
            )
        if any(judge):
            return kept.take([not held for held in judge]), kept.take(judge)
        return kept.split(1 - hold_out, seed) if hold_out else (kept, None)

    def fit(
        self, robot: Mechanism, data: Measurements
    ) -> tuple[Identification, ModelChoice | None]:
        """Identify, after choosing the set of parameters where asked."""
        from loopcal.diagnose import choose_model, describe_missing_equations
        from loopcal.estimate import identify
        from loopcal.estimate.outlook import equations

        method, loss = self.estimator(), self.robust()
        choice = (
            choose_model(robot, data, method=method, noise=self.noise, loss=loss)
            if self.choose_model
            else None
        )
        chosen = robot if choice is None else choice.robot
        if choice is not None and not choice.chosen.parameters:
            raise DataError(
                f"{choice.sentence}; without --choose-model it is calibrated all the same"
            )
        free, count = int(chosen.parameters.free.sum()), equations(chosen, data)
        if not data.n_rows:
            raise DataError("the data hold no measured value; fill in what the instrument showed")
        if method is None and count < free:
            raise DataError(
                f"{count} equations cannot determine {free} parameters; measure more poses, fix "
                "parameters, or let the "
                f"stated tolerances decide what is open with --method map{describe_missing_equations(chosen, data)}"
            )
        drop = tuple(label for label in self.drop if label in data.labels)
        return identify(chosen, data, method, noise=self.noise, loss=loss, drop=drop), choice


def fit_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options; the command gets them as `fitting`."""
    names = [f.name for f in fields(Fitting)]

    @functools.wraps(command)
    def packed(**given: Any) -> Any:
        fitting = Fitting(**{name: given.pop(name) for name in names})
        return command(**given, fitting=fitting)

    for option in (
        click.option("--choose-model", is_flag=True,
                     help="Free only as many parameters as unseen poses justify: offsets, with "
                          "lengths, ideal, complete."),
        click.option("--drop", multiple=True, metavar="POSE", help="Leave this pose out; may be "
                                                                   "given several times."),
        click.option("--loss", type=click.Choice(LOSSES), default=LOSSES[0], show_default=True,
                     help="Whether poses far from the fit count less."),
        click.option("--noise", type=click.Choice(("given", "estimated")), default="given", show_default=True,
                     help="Whether the stated noise is true, or only up to one common factor."),
        click.option("--keep", type=click.IntRange(min=0), metavar="K",
                     help="For tsvd: how many directions; chosen by cross-validation where not "
                          "given."),
        click.option("--lam", type=click.FloatRange(min=0), help="For ridge; chosen by "
                                                                 "cross-validation where not given."),
        click.option("--method", type=click.Choice(METHODS), default=METHODS[0], show_default=True,
                     help="How to estimate: auto is map (stated tolerances as prior) with "
                          "tolerances widened where the"
                          " data contradict them; ls is least squares."),
    ):  # fmt: skip
        packed = option(packed)
    return packed
