# SPDX-License-Identifier: Apache-2.0
"""Compare the geometry that a delta printer's firmware stored with the optimum of its own cost.

Klipper's fit minimizes w * sum(height error^2) + sum(distance error^2) with w = number of distances
/ (number of heights / 2) where there are distances, and 1 otherwise, over radius, two tower angles
and three end stops, and over the arms where there are distances (source: the module
`delta_calibrate` of Klipper). With sigmas of 1 mm / sqrt(w) and 1 mm this is the chi-square in mm^2
of `identify`, so the stored values can be checked against the optimum before they are used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate import Identification, LeastSquares, identify
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, Observations
from loopcal.mechanism import Mechanism

MM = 1e-3

GAIN = 1e-3
"""Share of the stored geometry's cost below which an optimum is no better: the last decimals of a
file.
"""

SMALL = 0.01
"""Changes below this are not listed [mm, deg]."""


@dataclass(frozen=True)
class StoredAnswer:
    """A stored geometry and the optimum of the firmware's cost, from the same probes.

    Attributes
    ----------
    stored, best : the cost of each [mm^2]. moved : parameter, stored value, best value and unit, of
        those that differ.
    """

    stored: float
    best: float
    moved: tuple[tuple[str, float, float, str], ...]

    @property
    def is_optimum(self) -> bool:
        """Whether the optimum is no better, except for the decimals of a file."""
        return self.stored - self.best <= GAIN * self.stored

    @property
    def finding(self) -> Finding:
        """The comparison as a finding."""
        if self.is_optimum:
            return report_finding("residuals.stored-is-optimum", stored=self.stored, best=self.best)
        return report_finding("residuals.stored-not-optimum", **vars(self))

    def __str__(self) -> str:
        return str(self.finding)


def compare_stored_geometry(robot: Mechanism, measured: Measurements) -> StoredAnswer | None:
    """Compare the stored geometry with the optimum of the firmware's cost.

    Return None where the probes do not determine an optimum.

    Parameters
    ----------
    robot : the printer with its stored geometry. measured : its heights and distances; their sigmas
        do not matter.
    """
    try:
        fit = identify(robot, _with_firmware_weights(measured), LeastSquares())
    except EstimationError:
        return None  # fewer probes than parameters, or a geometry that cannot reach them
    if not fit.converged or fit.rank < len(fit.names):
        return None
    return StoredAnswer(float(fit.history.cost[0]), float(fit.history.cost[-1]), tuple(_moved(fit)))


def _with_firmware_weights(measured: Measurements) -> Measurements:
    """The same rows with the firmware's weights as sigmas."""
    count = {o.kind.poses_per_row: len(o) for o in measured.observations}
    w = 2.0 * count[2] / count[1] if count.get(1) and count.get(2) else 1.0
    sigma = {1: MM / np.sqrt(w), 2: MM}
    weighted = [
        Observations.from_sigma(o.kind, o.rows, o.measured, sigma[o.kind.poses_per_row])
        for o in measured.observations
    ]
    return replace(measured, observations=tuple(weighted))


def _moved(fit: Identification) -> list[tuple[str, float, float, str]]:
    """Parameters that differ at the optimum, by name."""
    is_angle = np.array([name.endswith(".angle") for name in fit.names])
    unit = np.where(is_angle, np.pi / 180.0, MM)
    stored = fit.initial.values[fit.free_parameters.places] / unit
    best = fit.estimate / unit
    symbols = ["deg" if angle else "mm" for angle in is_angle]
    return [
        (name, float(first), float(last), symbol)
        for name, first, last, symbol in zip(fit.names, stored, best, symbols, strict=True)
        if abs(last - first) > SMALL
    ]
