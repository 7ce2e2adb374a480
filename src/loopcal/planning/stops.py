# SPDX-License-Identifier: Apache-2.0
"""The stops of a plan: its poses in order, and home where a straight path is blocked."""

from __future__ import annotations

from dataclasses import dataclass

from loopcal.mechanism import Mechanism, inverse
from loopcal.planning.candidates import home_coordinates
from loopcal.planning.result import Plan
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Stop:
    """One stop of the machine.

    Attributes
    ----------
    label : of the pose, or "home". is_via : only passed through. is_held_out : for validation.
    coordinates : (c,) controlled coordinates [m, rad]. readings : (a,) of these coordinates [SI].
    """

    label: str
    is_via: bool
    is_held_out: bool
    coordinates: FloatArray
    readings: FloatArray


def list_stops(plan: Plan) -> tuple[Stop, ...]:
    """Return the stops of a plan in order."""
    home = _solve_home(plan.robot) if plan.poses.via_home.any() else None
    stops = []
    for i, label in enumerate(plan.poses.labels):
        if home is not None and plan.poses.via_home[i]:
            stops.append(home)
        held_out = bool(plan.poses.held_out[i])
        stops.append(
            Stop(label, False, held_out, plan.poses.coordinates[i], plan.poses.readings[i])
        )
    return tuple(stops)


def _solve_home(robot: Mechanism) -> Stop:
    """Return the stop at home."""
    home = home_coordinates(robot)
    return Stop("home", True, False, home, inverse(robot, home[None]).q[0])
