# SPDX-License-Identifier: Apache-2.0
"""Points that an instrument holds on planes and perpendicular lines: the true machine moves until
its tool is there, so that all gaps are zero and the readings differ from machine to machine.
"""

from __future__ import annotations

import numpy as np

from loopcal.errors import DataError
from loopcal.estimate.published_methods.plane_line_products import Layout
from loopcal.measure import (
    Instrument,
    Seed,
    Trials,
    collect_nuisance_parameters,
    make_random_stream,
)
from loopcal.mechanism import Mechanism, Status
from loopcal.studies.specification.levels import EffectsLevel
from loopcal.typing import FloatArray


def make_layout(robot: Mechanism, coordinates: FloatArray, groups: int) -> Layout:
    """Return the groups of points with controlled coordinates (n, c)."""
    return Layout(robot, coordinates.reshape(groups, -1, coordinates.shape[1]))


def measure_held_points(
    layout: Layout, truth: FloatArray, instrument: Instrument, seed: Seed, is_exact: bool = False
) -> Trials:
    """Return the measurements of true machines (t, p) [SI] that are held.

    Parameters
    ----------
    instrument : kinds plane and line at the points. The noise of the plane is that of each held
        coordinate. is_exact : whether the points are held without noise.
    """
    n = layout.points
    assigned = Instrument(tuple(sensor.assign_rows(n) for sensor in instrument.sensors))
    (noise,) = {id(s.noise): s.noise for s in assigned.sensors if s.kind.name == "plane"}.values()
    drawn = np.zeros((len(truth), n, 3))
    if not is_exact:
        streams = (make_random_stream(seed, trial) for trial in range(len(truth)))
        drawn = np.stack([noise.draw(stream, 3 * n).reshape(n, 3) for stream in streams])
    state, readings = layout.hold_points(truth, drawn)
    gaps = [(len(truth), len(s.assigned_rows), len(s.noise.sigma)) for s in assigned.sensors]
    labels = tuple(str(i + 1) for i in range(n))
    return Trials(
        assigned,
        layout.robot.name,
        layout.commanded_readings,
        tuple(np.zeros(shape) for shape in gaps),
        truth,
        state.T,
        state.status == Status.CONVERGED,
        collect_nuisance_parameters(assigned.sensors, labels),
        readings,
    )


def check_effects(effects: EffectsLevel) -> None:
    """Raise DataError for effects that held points do not have."""
    plain = EffectsLevel()
    for name in ("drift", "jump", "thermal", "backlash"):
        if getattr(effects, name) != getattr(plain, name):
            raise DataError(
                f"points that are held on planes and lines are simulated without {name}; remove it"
            )
