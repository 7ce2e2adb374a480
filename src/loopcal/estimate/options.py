# SPDX-License-Identifier: Apache-2.0
"""The options of a fit, as one value that `identify`, `identify_trials` and `recalibrate` share."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from loopcal.errors import DataError, EstimationError
from loopcal.estimate.descent import StepControl
from loopcal.estimate.losses import Loss
from loopcal.estimate.penalties import Method
from loopcal.estimate.prior import Prior
from loopcal.estimate.residual_test import SIGMA_UNCERTAINTY
from loopcal.measure.array_checks import check_type
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.numerics.decomposition import RANK_TOLERANCE
from loopcal.typing import FloatArray

Noise = Literal["given", "estimated"]
"""Whether the stated sigmas are true, or true up to one common factor."""

Begin = Literal["kinematics", "closure"]
"""What is linearized first: the predicted poses, or the loop closure at the measured poses."""

METHOD_PARTS = ("required_equations", "unpenalized", "scale", "penalty")
"""Attributes that make an object a method, see `loopcal.estimate.penalties.Method`."""


@dataclass(frozen=True, eq=False)
class FitOptions:
    """Options of a fit. Every field has a default; `FitOptions()` is what `identify` uses.

    Parameters
    ----------
    method : how directions that the data hardly determine are treated. None is the default:
        `MAP(InflatedTolerances())`, or least squares where there is a `prior`.
    loss : `Huber()` or `Tukey()` reduce the weight of observation blocks far from the fit; None
        gives all rows their full weight.
    noise : "given" takes the sigmas of the data as true, "estimated" up to one common factor.
    sigma_uncertainty : relative standard uncertainty of given sigmas. The residuals correct them
        within it, and intervals account for it; 0 takes them as exact.
    prior : an earlier calibration, see `loopcal.estimate.prior.prior_from`.
    start : (p of the robot,) or (t, p of the robot) [SI] values to begin with; None begins with the
        values of the robot.
    begin : "closure" first linearizes the loop closure at the measured poses, for starts far off.
        It needs poses that are measured in full.
    control : settings of the iteration.
    rank_tolerance : singular values below this share of the largest one count as zero.
    allow_fewer_equations : lets least squares return the smallest deviation from nominal that
        explains fewer equations than there are parameters.
    excluded_poses : labels of poses that get weight 0.
    nuisance : unknown frames, targets, surfaces and offsets of the measurements, with priors or
        fixed values; None frees all of them.

    Raises
    ------
    EstimationError : a value that is not allowed, with the allowed ones.

    Examples
    --------
    >>> FitOptions(noise="estimated", excluded_poses=("6",))
    FitOptions(noise='estimated', excluded_poses=('6',))
    """

    method: Method | None = None
    loss: Loss | None = None
    noise: Noise = "given"
    sigma_uncertainty: float = SIGMA_UNCERTAINTY
    prior: Prior | None = None
    start: Sequence[float] | FloatArray | None = None
    begin: Begin = "kinematics"
    control: StepControl = field(default_factory=StepControl)
    rank_tolerance: float = RANK_TOLERANCE
    allow_fewer_equations: bool = False
    excluded_poses: Sequence[str] = ()
    nuisance: NuisanceParameters | None = None

    def __post_init__(self) -> None:
        _check_choice("noise", self.noise, get_args(Noise))
        _check_choice("begin", self.begin, get_args(Begin))
        if not 0.0 <= self.sigma_uncertainty <= 1.0:
            raise EstimationError(
                f"sigma_uncertainty is {self.sigma_uncertainty}; it must be from 0 (the stated "
                "sigmas are exact) to 1"
            )
        if self.method is not None and not _is_instance_with(self.method, METHOD_PARTS):
            raise EstimationError(
                f"method is {self.method!r}; it must be an instance such as MAP(), "
                "LeastSquares(), Ridge(1.0) or TruncatedSVD(10)"
            )
        if self.loss is not None and not _is_instance_with(self.loss, ("weight",)):
            raise EstimationError(
                f"loss is {self.loss!r}; it must be an instance such as Huber() or Tukey()"
            )
        if self.prior is not None:
            check_type(self.prior, Prior, "prior", "as from prior_from(fit.posterior)")
        check_type(self.control, StepControl, "control", "such as StepControl(iterations=100)")
        if self.nuisance is not None:
            wanted = "such as measurements.nuisance_parameters"
            check_type(self.nuisance, NuisanceParameters, "nuisance", wanted)
        if not 0.0 < self.rank_tolerance < 1.0:
            raise EstimationError(
                f"rank_tolerance is {self.rank_tolerance}; it must be above 0 and below 1"
            )
        object.__setattr__(
            self, "excluded_poses", check_labels("excluded_poses", self.excluded_poses)
        )
        if self.start is not None:
            start = np.array(self.start, dtype=np.float64)
            start.setflags(write=False)
            object.__setattr__(self, "start", start)

    def __repr__(self) -> str:
        """Return the options that differ from their defaults."""
        shown = []
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if not _is_default(value, entry):
                text = f"<{value.shape} array>" if isinstance(value, np.ndarray) else repr(value)
                shown.append(f"{entry.name}={text}")
        return f"FitOptions({', '.join(shown)})"


def merge_options(
    options: FitOptions | None, method: Method | None = None, loss: Loss | None = None
) -> FitOptions:
    """Return options in which a method and a loss that are not None replace those of `options`.

    Raises
    ------
    DataError : `options` is no `FitOptions`.
    EstimationError : the merged options are not allowed.
    """
    if options is None:
        return FitOptions(method=method, loss=loss)
    check_type(options, FitOptions, "options", "such as FitOptions(noise='estimated')")
    shortcuts = {"method": method, "loss": loss}
    stated = {name: value for name, value in shortcuts.items() if value is not None}
    return dataclasses.replace(options, **stated) if stated else options


def check_labels(option: str, labels: Sequence[str]) -> tuple[str, ...]:
    """Return labels of poses as a tuple; raise DataError for a single text."""
    if isinstance(labels, str):
        raise DataError(
            f"{option} is the text {labels!r}; give a sequence of labels, such as [{labels!r}]"
        )
    given = tuple(labels)
    for label in given:
        check_type(label, str, option, f"the label of a pose, such as '{label}'")
    return given


def _check_choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Refuse a word that is not allowed."""
    if value not in allowed:
        words = " or ".join(repr(word) for word in allowed)
        raise EstimationError(f"{name} is {value!r}; it must be {words}")


def _is_instance_with(value: object, attributes: Sequence[str]) -> bool:
    """Return whether a value is no class and has these attributes."""
    return not isinstance(value, type) and all(hasattr(value, name) for name in attributes)


def _is_default(value: Any, entry: dataclasses.Field[Any]) -> bool:
    """Return whether a field has its default value."""
    if entry.default_factory is not dataclasses.MISSING:
        return value == entry.default_factory()
    return value is entry.default or (
        isinstance(value, str | float | tuple) and value == entry.default
    )
