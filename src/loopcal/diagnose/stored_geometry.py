# SPDX-License-Identifier: Apache-2.0
"""Is the geometry that a delta printer's firmware stored the optimum of the firmware's own cost on
the probes it stored?

Klipper's fit minimises w * sum(height error^2) + sum(distance error^2) with w = number of distances
/ (number of heights / 2) where there are distances, and 1 otherwise, over radius, two tower angles
and three end stops, and over the arms where there are distances (source: the module
`delta_calibrate` of Klipper). With sigmas of 1 mm / sqrt(w) and 1 mm this is the chi-square in mm^2
of `identify`, so that the stored numbers can be held against the optimum before they are believed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from loopcal.estimate import Identification
    from loopcal.measure import Measurements
    from loopcal.mechanism import Mechanism

MM = 1e-3

GAIN = 1e-3
"""Share of the stored answer's cost below which an optimum is no better: the last decimals of a
file.
"""

SMALL = 0.01
"""Changes that are not listed [mm, deg]."""


@dataclass(frozen=True)
class StoredAnswer:
    """A stored geometry and the optimum of the firmware's cost, from the same probes.

    Attributes
    ----------
    stored, best : the cost at either [mm^2]. moved : parameter, stored and best value [mm, deg]
        where they differ.
    """

    stored: float
    best: float
    moved: tuple[tuple[str, float, float], ...]

    @property
    def is_optimum(self) -> bool:
        """Whether the optimum is no better, but for the decimals of a file."""
        return self.stored - self.best <= GAIN * self.stored

    def __str__(self) -> str:
        if self.is_optimum:
            return f"the stored geometry is the optimum of the firmware's own cost ({self.stored:.4g} mm^2)"
        moved = ", ".join(f"{name} {one:.4f} -> {other:.4f}" for name, one, other in self.moved)
        return (
            f"the stored geometry is NOT the optimum of the firmware's own cost: {self.stored:.4f} "
            f"mm^2, where {self.best:.4f}"
            f" mm^2 can be had ({moved}); it was changed since, or never fitted to these probes"
        )


def stored_answer(robot: Mechanism, measured: Measurements) -> StoredAnswer | None:
    """Hold the stored geometry against the optimum of the firmware's cost.

    Parameters
    ----------
    robot : the printer with its stored geometry. measured : its heights and distances; their sigmas
        do not matter.

    Returns
    -------
    StoredAnswer, or None where the probes do not determine an optimum.
    """
    from loopcal.errors import EstimationError
    from loopcal.estimate import LeastSquares, identify

    try:
        fit = identify(robot, _weighed(measured), LeastSquares())
    except EstimationError:
        return None  # fewer probes than numbers, or a geometry that cannot reach them
    if not fit.converged or fit.rank < len(fit.names):
        return None
    return StoredAnswer(float(fit.history.cost[0]), float(fit.history.cost[-1]), tuple(_moved(fit)))


def _weighed(measured: Measurements) -> Measurements:
    """The same rows with the firmware's weights as sigmas."""
    from loopcal.measure import Observations

    count = {o.kind.poses_per_row: len(o) for o in measured.observations}
    w = 2.0 * count[2] / count[1] if count.get(1) and count.get(2) else 1.0
    sigma = {1: MM / np.sqrt(w), 2: MM}
    weighed = [
        Observations.from_sigma(o.kind, o.rows, o.measured, sigma[o.kind.poses_per_row])
        for o in measured.observations
    ]
    return replace(measured, observations=tuple(weighed))


def _moved(fit: Identification) -> list[tuple[str, float, float]]:
    """Parameters that the optimum has elsewhere, by name."""
    unit = np.array([np.pi / 180.0 if name.endswith(".angle") else MM for name in fit.names])
    stored = fit.initial.values[fit.free_parameters.places] / unit
    best = fit.estimate / unit
    return [
        (name, float(one), float(other))
        for name, one, other in zip(fit.names, stored, best, strict=True)
        if abs(other - one) > SMALL
    ]
