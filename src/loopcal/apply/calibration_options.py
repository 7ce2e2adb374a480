# SPDX-License-Identifier: Apache-2.0
"""The options of a calibration, as one value."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from loopcal.apply.volume_accuracy import VolumeLike, as_volume
from loopcal.diagnose.error_frames import FITTED
from loopcal.errors import DataError, suggest_names
from loopcal.estimate.options import OBJECT, FitOptions, check_labels
from loopcal.estimate.posterior import Posterior
from loopcal.measure.array_checks import check_seed, check_type
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.typing import IntArray


def describe_wrong_share(share: float) -> str:
    """Return what is wrong with a share of held-out poses; empty where nothing is."""
    if 0.0 <= share < 1.0:
        return ""
    fault = f"{share:g}, which is not a share of the poses, from 0 to below 1"
    if not 1.0 <= share < 100.0:  # others were probably meant in percent, or as a number of poses
        return f"{fault}. Write 0.25 for a quarter"
    return (
        f"{fault}. Write {share / 100:g} for {share:g} %, or the number of poses to hold out "
        "divided by the number of all poses"
    )


def check_limit(name: str, limit: float | None) -> None:
    """Refuse a limit below 0, or NaN: no error could keep it, or exceed it."""
    if limit is not None and not limit >= 0.0:
        raise DataError(f"{name} is {limit}. Give a number of metres or radians, 0 or more")


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of `calibrate`. Every field has a default.

    Parameters
    ----------
    fit : how parameters are estimated, and which poses are excluded.
    hold_out : share of the poses to keep out of the fit for validation, from 0 to below 1. The
        sets are those of `data.split(hold_out=hold_out, seed=seed)`; of a
        dense map whose residuals vary slowly, they are whole regions.
    held_out : labels of the poses to keep out, instead of a share. Neither is allowed where the
        data state their held-out poses (`Measurements.is_held_out`).
    seed : of the random choice of held-out poses.
    limit_position, limit_angle : largest allowed errors [m], [rad] on held-out poses; that of the
        position also in the volume.
    volume : in which the largest position error is stated: a `loopcal.Volume`, ranges of controlled
        coordinates, or points, see `loopcal.bound_errors`.
    choose_model : free only as many parameters as held-out predictions justify.
    prior : the posterior of an earlier calibration of this machine; its knowledge is kept.
    compare_with : stored values, such as those of a firmware or published ones: by name [SI], or a
        robot that has them. They are tested jointly, see `loopcal.compare_with_values`.
    free_limb : with `prior`: a limb that was repaired, which starts again from its spreads.
    frame : in which expected errors are stated: "fitted", "base", "relative", or the name of the
        frame of an instrument, see `loopcal.pose_uncertainty`.
    check_conventions : refuse data that fit far better in another unit, order, sign or column; see
        `loopcal.check_conventions`. allow_still : accept targets that no pose moves.
    allow_duplicates : accept rows that copy others, perhaps with fewer digits.

    Raises
    ------
    DataError : a value that is not allowed, or options that contradict each other.
    """

    fit: FitOptions = field(default_factory=FitOptions)
    hold_out: float = 0.0
    held_out: Sequence[str] = ()
    seed: int = 1
    limit_position: float | None = None
    limit_angle: float | None = None
    volume: VolumeLike | None = None
    choose_model: bool = False
    prior: Posterior | None = None
    free_limb: str | None = None
    frame: str = FITTED
    compare_with: Mapping[str, float] | Mechanism | None = None
    check_conventions: bool = True
    allow_still: bool = False
    allow_duplicates: bool = False

    def __post_init__(self) -> None:
        check_type(self.fit, FitOptions, "fit", "such as FitOptions(method=MAP())")
        check_seed(self.seed)
        if fault := describe_wrong_share(self.hold_out):
            raise DataError(f"hold_out is {fault}")
        object.__setattr__(self, "held_out", check_labels("held_out", self.held_out))
        if self.hold_out and self.held_out:
            raise DataError(
                f"hold_out is {self.hold_out} and held_out names {len(self.held_out)} poses. Give "
                "one of the two"
            )
        if self.volume is not None:
            object.__setattr__(self, "volume", as_volume(self.volume))
        check_limit("limit_position", self.limit_position)
        check_limit("limit_angle", self.limit_angle)
        if self.free_limb is not None and self.prior is None:
            raise DataError.of("workflow.free-limb-needs-prior", limb=self.free_limb)
        chosen = {
            "method": self.fit.method is not None,
            "loss": self.fit.loss is not None,
            "choose_model": self.choose_model,
        }
        excluded = [option for option, is_chosen in chosen.items() if is_chosen]
        if self.prior is not None and excluded:
            raise DataError.of("workflow.option-excludes-prior", option=excluded[0])

    def to_dict(self) -> dict[str, Any]:
        """Return the options as plain data; an object is `{object: text}`, see `FitOptions`."""
        plain = {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in vars(self).items()
        }
        for key in ("prior", "compare_with"):
            if value := plain[key]:
                plain[key] = dict(value) if isinstance(value, Mapping) else {OBJECT: repr(value)}
        return {**plain, "fit": self.fit.to_dict()}


@dataclass(frozen=True, eq=False)
class DataSplit:
    """The two sets of a calibration."""

    fitted: Measurements  # measurements to fit
    held_out: Measurements | None  # measurements for validation; None where there are none
    share: float  # the share that was asked for; 0 where poses were named, or none were held out
    seed: int  # of the random choice
    repeats: tuple[str, ...] = ()  # labels of held-out poses that repeat a fitted one

    def change(self, function: Callable[[Measurements], Measurements]) -> DataSplit:
        """Return the sets as a function changes them."""
        held_out = self.held_out and function(self.held_out)
        return replace(self, fitted=function(self.fitted), held_out=held_out)

    def list_observations(self) -> tuple[Observations, ...]:
        """Return the observations of both sets, those of targets on the base once."""
        held_out = () if self.held_out is None else self.held_out.observations
        return (*self.fitted.all_observations, *held_out)

    def to_dict(self) -> dict[str, object] | None:
        """Return share, seed and labels of the held-out poses for JSON; None without any."""
        if self.held_out is None:
            return None
        return {"hold_out": self.share, "seed": self.seed, "held_out": list(self.held_out.labels)}


def split_data(
    data: Measurements,
    hold_out: float = 0.0,
    seed: int = 1,
    held_out: Sequence[str] = (),
    regions: IntArray | None = None,
) -> DataSplit:
    """Divide measurements into a set to fit and a set for validation.

    Measurements that state their held-out poses are divided so, and no other choice is allowed.

    hold_out : share of the poses to hold out, drawn by whole blocks, and with all repeats of a
        pose, as `data.split` does. 0 holds nothing out.
    held_out : labels of the poses to hold out, instead of a share. regions : see `data.split`.
    """
    stated = tuple(label for label, out in zip(data.labels, data.is_held_out, strict=True) if out)
    if stated and (hold_out or (held_out and set(held_out) != set(stated))):
        raise DataError.of("data.held-out-twice", count=len(stated))
    held_out = stated or held_out
    if held_out:
        for label in held_out:
            if label not in data.labels:
                raise DataError(
                    f"held_out names the pose {label!r}, which the data do not have"
                    f"{suggest_names(label, data.labels)}"
                )
        names = set(held_out)
        is_held_out = np.array([label in names for label in data.labels])
        if is_held_out.all():
            raise DataError("the validation takes all poses of the data. Leave some to fit")
        is_repeat = is_held_out & np.isin(data.repeats, data.repeats[~is_held_out])
        repeats = tuple(data.labels[i] for i in np.flatnonzero(is_repeat))
        return DataSplit(data.take(~is_held_out), data.take(is_held_out), 0.0, seed, repeats)
    if not hold_out:
        return DataSplit(data, None, 0.0, seed)
    return DataSplit(*data.split(hold_out=hold_out, seed=seed, regions=regions), hold_out, seed)
