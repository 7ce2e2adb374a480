# SPDX-License-Identifier: Apache-2.0
"""Measurements divided into those to fit and those held out for validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.errors import DataError, suggest_names
from loopcal.findings import report_finding
from loopcal.measure import Measurements

UNKNOWN = np.array(np.inf)
"""Sigma of readings that may be missing."""


@dataclass(frozen=True, eq=False)
class DataSplit:
    """The two sets of a calibration.

    Attributes
    ----------
    fitted : measurements to fit. held_out : measurements for validation; None where there are none.
    share : the share that was asked for; 0 where poses were named, or none were held out.
    seed : of the random choice.
    """

    fitted: Measurements
    held_out: Measurements | None
    share: float
    seed: int

    def list_repeats(self) -> tuple[str, ...]:
        """Return the labels of held-out poses that repeat a fitted one."""
        if self.held_out is None:
            return ()
        n = self.fitted.n_poses
        readings = np.concatenate([self.fitted.readings, self.held_out.readings])
        repeats = Measurements(self.fitted.robot_name, readings, (), reading_sigma=UNKNOWN).repeats
        is_repeat = np.isin(repeats[n:], repeats[:n])
        pairs = zip(self.held_out.labels, is_repeat, strict=True)
        return tuple(label for label, repeated in pairs if repeated)

    def to_dict(self) -> dict[str, object] | None:
        """Return share, seed and labels of the held-out poses for JSON; None without any."""
        if self.held_out is None:
            return None
        labels = list(self.held_out.labels)
        return {"hold_out": self.share, "seed": self.seed, "held_out": labels}


def split_data(
    data: Measurements, hold_out: float = 0.0, seed: int = 1, held_out: Sequence[str] = ()
) -> DataSplit:
    """Divide measurements into a set to fit and a set for validation.

    Measurements that state their held-out poses are divided so, and no other choice is allowed.

    Parameters
    ----------
    hold_out : share of the poses to hold out, drawn by whole blocks, and with all repeats of a
        pose, as `data.split` does. 0 holds nothing out.
    held_out : labels of the poses to hold out, instead of a share.

    Raises
    ------
    DataError : a label that the data do not have, two choices of poses, or no pose is left to fit.
    """
    stated = tuple(label for label, out in zip(data.labels, data.is_held_out, strict=True) if out)
    if stated and (hold_out or (held_out and set(held_out) != set(stated))):
        raise DataError(report_finding("data.held-out-twice", count=len(stated)))
    held_out = stated or held_out
    if held_out:
        for label in held_out:
            if label not in data.labels:
                raise DataError(
                    f"held_out names the pose {label!r}, which the data do not have"
                    f"{suggest_names(label, data.labels)}"
                )
        names = set(held_out)
        is_held_out = [label in names for label in data.labels]
        if all(is_held_out):
            raise DataError("all poses of the data are held out; leave some to fit")
        fitted = data.take([not chosen for chosen in is_held_out])
        return DataSplit(fitted, data.take(is_held_out), 0.0, seed)
    if not hold_out:
        return DataSplit(data, None, 0.0, seed)
    fitted, validation = data.split(hold_out=hold_out, seed=seed)
    return DataSplit(fitted, validation, hold_out, seed)
