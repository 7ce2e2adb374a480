# SPDX-License-Identifier: Apache-2.0
"""A plan: the poses to measure in the order of visiting, what they are worth, and what to expect of
them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.measure import Instrument
from loopcal.mechanism import Mechanism
from loopcal.planning.needed import PoseCurve, counted, in_words
from loopcal.planning.problem import Accuracy, Target
from loopcal.typing import BoolArray, FloatArray, IntArray

WEAK = 0.5
"""Efficiency below which it is said that little is guaranteed."""


def at_least(share: float) -> str:
    """Return a share of which no less is guaranteed in per cent, rounded down."""
    return f"{np.floor(1e3 * share) / 10.0:.1f}%"


@dataclass(frozen=True, eq=False)
class Plan:
    """Poses to measure, in the order of visiting.

    Attributes
    ----------
    robot : for whose present values it was made. instrument : that will measure.
    coordinates : (m, c) controlled coordinates [m, rad]. readings : (m, a) that these poses are
        commanded with [m, rad].
    held_out : (m,) True for the poses to judge by. via_home : (m,) True where home must be visited
        before.
    labels : (m,) names of the poses. units : (u, k) rows of the poses that are measured together.
    criterion : I or D. figures : D, I, A, E of the fitted poses, in tolerances.
    efficiency : at least this share of the best possible (det ratio^(1/p) for D, variance ratio for
        I).
    expected : errors after calibration with the fitted poses; before : without; even : median of as
        many evenly drawn.
    length : of the way [m]. seed : of all random choices. notes : sentences on what was assumed or
        left out.
    curve : expected errors by the number of poses, where it was asked for.
    target : what I is the mean variance of: pose, turns times the robot's size [m^2], position
        [m^2] or orientation [rad^2]. considered : units that were chosen from; `efficiency` holds
        among them.
    """

    robot: Mechanism
    instrument: Instrument
    coordinates: FloatArray
    readings: FloatArray
    held_out: BoolArray
    via_home: BoolArray
    labels: tuple[str, ...]
    units: IntArray
    criterion: str
    figures: dict[str, float]
    efficiency: float
    expected: Accuracy
    before: Accuracy | None
    even: Accuracy | None
    length: float
    seed: int
    notes: tuple[str, ...]
    curve: PoseCurve | None = None
    target: Target = "pose"
    considered: int = 0

    @property
    def n_poses(self) -> int:
        """Number of poses that are fitted."""
        return int((~self.held_out).sum())

    def __str__(self) -> str:
        return "\n".join([*self.sentences(), *(f"note: {note}" for note in self.notes)])

    def sentences(self) -> list[str]:
        """What was planned and what to expect of it."""
        via = int(self.via_home.sum())
        ways = f", {via} of the ways via home" if via else ""
        seen = ", ".join(sensor.kind.name for sensor in self.instrument.sensors)
        held, best = int(self.held_out.sum()), at_least(self.efficiency)
        what = f"{self.n_poses} pose{'s'[: self.n_poses != 1]} of {self.robot.name} to measure ({seen}) and {held} to judge by"
        among, drawn = "candidates", "poses"
        if (k := self.units.shape[1]) > 1:
            judged = int(self.held_out[self.units].any(axis=1).sum())
            fitted, drawn = len(self.units) - judged, counted(k)
            among = f"{self.considered} {drawn} considered"
            what = f"{fitted} {drawn} to measure ({seen}) and {judged} to judge by, of {len(self.labels)} poses of "
            what += self.robot.name
        lines = [
            what,
            f"way from home through all of them: {self.length:.3g} m{ways}",
            (
                f"criterion {self.criterion}: at least {best} of the best that as many of the "
                f"{among} "
                "allow"
            ),
        ]
        if self.efficiency < WEAK:
            lines[-1] += (
                " (little is guaranteed: a plan that tells twice as much may exist; try another "
                "seed, or more poses)"
            )
        shown = [
            ("before", self.before),
            (f"as many evenly drawn {drawn}", self.even),
            ("after this plan", self.expected),
        ]
        found = [
            f"{words} {in_words(self.robot, errors)}"
            for words, errors in shown
            if errors is not None
        ]
        lines.append(f"expected errors over the workspace (rms): {'; '.join(found)}")
        return lines if self.curve is None else [*lines, *self.curve.sentences(self.robot)]

    def to_dict(self) -> dict[str, Any]:
        """Everything by name for JSON, SI."""
        errors = {"before": self.before, "evenly_drawn": self.even, "after": self.expected}
        rows = zip(
            self.labels, self.held_out, self.via_home, self.coordinates, self.readings, strict=True
        )
        actuators = [actuator.name for actuator in self.robot.actuators]
        return {
            "robot": self.robot.name,
            "kinds": [sensor.kind.name for sensor in self.instrument.sensors],
            "n_poses": self.n_poses,
            "criterion": self.criterion,
            "target": self.target,
            "figures": self.figures,
            "efficiency": self.efficiency,
            "considered": self.considered,
            "expected": {name: None if e is None else dict(vars(e)) for name, e in errors.items()},
            "path_length": self.length,
            "seed": self.seed,
            "poses": [
                {
                    "name": label,
                    "use": "held-out" if held else "fit",
                    "via_home": bool(via),
                    "commanded": dict(zip(self.robot.controlled, x.tolist(), strict=True)),
                    "readings": dict(zip(actuators, q.tolist(), strict=True)),
                }
                for label, held, via, x, q in rows
            ],
            "compared": [[self.labels[i] for i in unit_] for unit_ in self.units]
            if self.units.shape[1] > 1
            else [],
            "curve": None if self.curve is None else self.curve.to_dict(),
            "notes": list(self.notes),
        }
