# SPDX-License-Identifier: Apache-2.0
"""Findings of a validation: limits, setup parameters that moved, and poses that were left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.diagnose import (
    PoseErrors,
    PosePredictions,
    PredictionComparison,
    find_moved_setups,
    predict_poses,
)
from loopcal.errors import DataError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.findings.wording import list_names
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism
from loopcal.numerics.chi_square import compute_chi_square_quantile
from loopcal.numerics.sorted_values import find_distinct
from loopcal.units import Unit

FEW_ROWS = 5
"""Number of rows below which an error cannot be judged.

At 4 rows the rms of noise alone varies by a third.
"""


GREW = 1.1
"""Factor by which an error must grow to be called larger."""

NOISE_LEVEL = 1e-3
"""Probability that noise alone exceeds what is called the noise."""


@dataclass(frozen=True)
class ErrorChange:
    """The rms error of one quantity before and after calibration.

    Attributes
    ----------
    before, after, noise_floor : [m], [rad] or [sigma]. values : number of measured components.
    """

    before: float
    after: float
    noise_floor: float
    values: int

    @property
    def times(self) -> float:
        """How many times smaller the error became; infinite where it vanished, NaN if unknown."""
        if not (np.isfinite(self.before) and np.isfinite(self.after)):
            return np.nan
        if self.after > 0.0:
            return self.before / self.after
        return np.inf if self.before > 0.0 else 1.0

    @property
    def largest_noise(self) -> float:
        """The rms that noise alone exceeds with the probability `NOISE_LEVEL`."""
        square = compute_chi_square_quantile(max(self.values, 1), NOISE_LEVEL) / max(self.values, 1)
        return self.noise_floor * float(np.sqrt(square))

    @property
    def is_noise(self) -> bool:
        """Whether noise alone explains the error before and after."""
        return max(self.before, self.after) <= self.largest_noise

    @property
    def has_grown(self) -> bool:
        """Whether the error became larger by more than a tenth, and noise does not explain it."""
        return self.after > GREW * self.before and self.after > self.largest_noise


def owner_of(name: str) -> str:
    """Return the frame, target or surface of a setup parameter: `tracker` of `tracker.x`."""
    return name.rsplit(".", 1)[0]


def group_setup(prediction: PosePredictions) -> dict[str, tuple[str, ...]]:
    """Return the frames, targets and surfaces that are kept, and those fitted to the rows."""
    kept = dict.fromkeys(owner_of(n) for n in prediction.setup.table.names if n in prediction.kept)
    fitted = dict.fromkeys(
        owner_of(n) for n in prediction.setup.table.names if n not in prediction.kept
    )
    return {"kept": tuple(kept), "fitted": tuple(fitted)}


def describe_frame(errors: PoseErrors, setup: Sequence[str]) -> str:
    """Return the frame of errors in words.

    Parameters
    ----------
    setup : frames, targets and surfaces that were estimated. Without any, positions and
        orientations are those in the stated frame of the instrument.
    """
    if setup:
        return f"after the best fit of {list_names(setup, 6)}"
    if {"position", "orientation"} & errors.quantities.keys():
        return "in the stated frame"
    return "without any frame"


def report_setup(first: PosePredictions, last: PosePredictions) -> list[Finding]:
    """Report where the setup parameters come from."""
    before, after = group_setup(first), group_setup(last)
    only_after = tuple(name for name in after["kept"] if name in before["fitted"])
    codes = {
        "validation.setup-kept": after["kept"],
        "validation.setup-fitted-before": only_after,
        "validation.setup-fitted": after["fitted"],
    }
    return [report_finding(code, names=names) for code, names in codes.items() if names]


def report_few_rows(after: PoseErrors) -> list[Finding]:
    """Report quantities that too few rows measure."""
    counts = {name: len(find_distinct(errors.rows)) for name, errors in after.quantities.items()}
    return [
        report_finding("validation.few-rows", quantity=quantity, count=count)
        for quantity, count in counts.items()
        if 0 < count < FEW_ROWS
    ]


def report_left_out(data: Measurements, compared: PredictionComparison) -> list[Finding]:
    """Report poses with rows that no statistic contains, and poses that were estimated."""
    has_rows = np.zeros(data.n_poses, dtype=bool)
    for o in data.observations:
        has_rows[o.rows[o.weight > 0.0]] = True
    estimated = compared.estimated & compared.usable
    cases = {
        "validation.unreachable-poses": ~compared.usable & compared.predictable,
        "validation.missing-readings": has_rows & ~compared.predictable,
        "validation.poses-estimated": estimated,
    }
    named = {code: [data.labels[i] for i in np.flatnonzero(out)] for code, out in cases.items()}
    extra: dict[str, dict[str, Any]] = {
        "validation.poses-estimated": {"absorbed": int(compared.absorbed.sum())}
    }
    return [
        report_finding(code, names=tuple(f"pose {name}" for name in names), **extra.get(code, {}))
        for code, names in named.items()
        if names
    ]


def report_moved_setup(
    robot: Mechanism, compared: PredictionComparison, kept: Mapping[str, float]
) -> list[Finding]:
    """Report kept frames, targets and surfaces that were apparently moved after the fit."""
    data = compared.data
    table, rows = data.nuisance_parameters.table, data.observations
    owner = {p.name: owner_of(p.name) for p in table.entries}

    def measure_errors(refit: tuple[str, ...]) -> tuple[float, int]:
        """Return the whitened rms error with these fitted again, and the equations left over."""
        values = {name: v for name, v in kept.items() if owner.get(name) not in refit}
        try:
            prediction = predict_poses(robot, data, compared.solution, compared.usable, values)
        except DataError:  # too few rows to fit it
            return float("nan"), 0
        total = 0.0
        for o, residual in zip(rows, prediction.residuals(rows), strict=True):
            present = np.where(o.present, residual, 0.0)
            total += float(((o.whitener @ present[..., None]) ** 2).sum())
        fitted = sum(p.free and owner[p.name] in refit for p in table.entries)
        left = sum(o.n_residuals for o in rows) - fitted
        return float(np.sqrt(total / max(left, 1))), left

    names = dict.fromkeys(owner[p.name] for p in table.entries if p.free and p.name in kept)
    moved = find_moved_setups(tuple(names), measure_errors)
    if moved is None:
        return []
    return [report_finding("validation.setup-moved", names=moved.names, times=moved.times)]


def check_limit(name: str, limit: float | None) -> None:
    """Refuse a limit below 0, or NaN: no error could keep it, or exceed it."""
    if limit is None:
        return
    if not limit >= 0.0:
        raise DataError(f"{name} is {limit}; give a number of metres or radians, 0 or more")


def check_limits(
    after: PoseErrors,
    poses: tuple[str, ...],
    limits: Mapping[str, float | None],
    units: Mapping[str, Unit],
) -> list[Finding]:
    """Report limits that the largest error exceeds, and limits on what no row measures."""
    findings = []
    for quantity, limit in limits.items():
        if limit is None:
            continue
        errors = after[quantity]
        if not len(errors.rows):
            findings.append(report_finding("gates.limit-not-measured", quantity=quantity))
            continue
        worst, unit = int(np.argmax(errors.size)), units[quantity]
        if errors.size[worst] > limit:
            findings.append(
                report_finding(
                    "gates.limit-exceeded",
                    quantity=quantity,
                    pose=poses[errors.rows[worst]],
                    target=errors.targets[worst],
                    error=Quantity(float(errors.size[worst]) / unit.factor_to_si, unit.symbol),
                    limit=Quantity(limit / unit.factor_to_si, unit.symbol),
                )
            )
    return findings
