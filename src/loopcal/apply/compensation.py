# SPDX-License-Identifier: Apache-2.0
"""Use a calibration: readings that take the real machine to its targets, or shifted commands for a
closed controller.

    readings   q = IK(x; e_hat)
    commands   x_cmd <- x_cmd - (FK(IK(x_cmd; controller); e_hat) - x), a few fixed-point steps

A machine with fewer actuators than six also errs where nothing can push it: that part stays, and
each target says how much. See docs/theory/accuracy.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from loopcal import geometry
from loopcal.apply.accuracy import PoseUncertainty, pose_uncertainty
from loopcal.diagnose import twist_weights
from loopcal.errors import DataError
from loopcal.estimate.inference.posterior import Posterior
from loopcal.estimate.result import Identification
from loopcal.mechanism import Mechanism, Solution, check_limits, forward, inverse, read_coordinates
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension, find_unit

Mode = Literal["readings", "commands"]

NOTHING = 1e-9
"""Error below this share of the robot's size (or in radians) is rounding."""

SHRUNK = 0.1
"""Share of its first value to which the fixed point must have brought the distance; it usually
falls a hundredfold a step.
"""


class Reach(Enum):
    """What becomes of a target."""

    REACHED = "reached"
    IN_PART = "reached in part"
    OUTSIDE = "outside the limits"
    UNREACHABLE = "unreachable"
    NOT_SETTLED = "not settled"


@dataclass(frozen=True, eq=False)
class Compensation:
    """What to tell the machine for n targets, and where it goes then. Errors are twists (n, 6),
    rotation first [rad, m].

    Attributes
    ----------
    mode : "readings" or "commands". labels : (n,) names of the targets.
    robot, controller : the identified geometry, and that of the controller.
    readings : (n, a) of the actuators at the targets [m, rad]. commands : (n, c) coordinates to
        command [m, rad]; None where readings are set.
    wanted, reached : (n, 4, 4) platform poses. reached is where the identified robot goes.
    before : (n, 6) error of the machine if it is commanded to the target by its controller as it
        is.
    remaining : (n, 6) error after compensation. not_compensable : (n, 6) the part of it that no
        reading can remove.
    residual_position, residual_orientation : (steps + 1, n) [m], [rad] distance from the best
        reachable pose before the first and after each fixed-point step; zeros (1, n) where readings
        are set.
    uncertainty : of the poses reached; None where only a robot was given.
    reach : (n,) Reach. sentences : (n,).
    """

    mode: Mode
    labels: tuple[str, ...]
    robot: Mechanism
    controller: Mechanism
    readings: FloatArray
    commands: FloatArray | None
    wanted: FloatArray
    reached: FloatArray
    before: FloatArray
    remaining: FloatArray
    not_compensable: FloatArray
    residual_position: FloatArray
    residual_orientation: FloatArray
    uncertainty: PoseUncertainty | None
    reach: tuple[Reach, ...]
    sentences: tuple[str, ...]

    @property
    def good(self) -> BoolArray:
        """(n,) targets that the machine can be sent to."""
        return np.array([r in (Reach.REACHED, Reach.IN_PART) for r in self.reach])

    def to_dict(self) -> dict[str, Any]:
        """Return the result by name for JSON, SI."""
        found = self.uncertainty
        return {
            "robot": self.robot.name,
            "mode": self.mode,
            "labels": list(self.labels),
            "actuators": [a.name for a in self.robot.actuators],
            "readings": self.readings,
            "coordinates": list(self.robot.controlled),
            "commands": self.commands,
            "before": self.before,
            "remaining": self.remaining,
            "not_compensable": self.not_compensable,
            "residual_position": self.residual_position,
            "residual_orientation": self.residual_orientation,
            "uncertainty": None if found is None else found.to_dict(),
            "reach": [r.value for r in self.reach],
            "sentences": list(self.sentences),
        }


def compensate(
    fit: Identification | Posterior | Mechanism,
    targets: ArrayLike,
    mode: Mode = "readings",
    controller: Mechanism | None = None,
    steps: int = 3,
    labels: tuple[str, ...] = (),
) -> Compensation:
    """Return readings or shifted commands for targets.

    Parameters
    ----------
    fit : the identification, the posterior of a run folder (both give uncertainties), or a
        calibrated robot.
    targets : (n, 4, 4) T_base_platform or (n, c) controlled coordinates [m, rad]. A target in
        coordinates asks, for what cannot be controlled, for the pose that the controller's geometry
        has there.
    mode : "readings" to set the actuators, "commands" for a controller whose geometry cannot be
        changed.
    controller : that geometry; default: the nominal robot. steps : fixed-point steps of "commands".
    labels : of the targets; default "1", "2", ...

    Returns
    -------
    Compensation; a target that cannot be reached is said in `reach` and `sentences`, not raised.

    Raises
    ------
    DataError
        Unknown mode, no step, targets of another shape.
    """
    _check(mode, steps)
    known = fit.posterior if isinstance(fit, Identification) else fit
    robot = known if isinstance(known, Mechanism) else known.robot
    old = controller or robot.nominal
    believed = inverse(old, targets)
    wanted = np.reshape(targets, (-1, 4, 4)) if np.shape(targets)[-2:] == (4, 4) else believed.T
    best = inverse(robot, targets)
    before = geometry.pose_difference(forward(robot, believed.q, _begin(robot, best)).T, wanted)
    exact = _Settled(best, None, np.zeros((1, len(wanted), 6)))
    settled = exact if mode == "readings" else _shifted(robot, old, believed, best, steps)
    final = settled.final
    fixed = geometry.pose_difference(best.T, wanted)
    position, angle = (
        np.linalg.norm(settled.gaps[..., part], axis=2) for part in (slice(3, 6), slice(3))
    )
    reach, sentences = _judged(robot, believed, best, settled, fixed)
    return Compensation(
        mode=mode,
        labels=tuple(labels) or tuple(str(i + 1) for i in range(len(wanted))),
        robot=robot,
        controller=old,
        readings=final.q,
        commands=settled.commands,
        wanted=wanted,
        reached=final.T,
        before=before,
        remaining=geometry.pose_difference(final.T, wanted),
        not_compensable=fixed,
        residual_position=position,
        residual_orientation=angle,
        uncertainty=None if isinstance(known, Mechanism) else pose_uncertainty(known, final),
        reach=reach,
        sentences=sentences,
    )


def _check(mode: str, steps: int) -> None:
    """Refuse what `compensate` cannot do; raises DataError."""
    if mode not in get_args(Mode):
        raise DataError(f"mode is {mode!r}; it must be 'readings' or 'commands'")
    if steps < 1:
        raise DataError(
            f"{steps} steps of compensation were asked for; give 1 or more, 3 are usually enough"
        )


@dataclass(frozen=True, eq=False)
class _Settled:
    """Where the machine goes: its solution, what is commanded (n, c), and the gaps (steps + 1, n,
    6) on the way.
    """

    final: Solution
    commands: FloatArray | None
    gaps: FloatArray


def _begin(robot: Mechanism, best: Solution) -> Solution | None:
    """Start of forward solutions: the best poses where all are closed, else home."""
    return best if best.converged.all() and robot.program.sigma is None else None


def _shifted(
    robot: Mechanism, controller: Mechanism, believed: Solution, best: Solution, steps: int
) -> _Settled:
    """Shift commands until the machine goes to the best poses; the shift is a twist, so no angle is
    singular.
    """
    start = _begin(robot, best)
    commands = read_coordinates(believed.T, controller.controlled)
    final = forward(robot, believed.q, start)
    gaps = [geometry.pose_difference(final.T, best.T)]
    for _ in range(steps):
        moved = geometry.apply_twist(believed.T, -gaps[-1])
        commands = read_coordinates(moved, controller.controlled)
        believed = inverse(controller, commands, believed if believed.converged.all() else None)
        final = forward(robot, believed.q, start)
        gaps.append(geometry.pose_difference(final.T, best.T))
    return _Settled(final, commands, np.stack(gaps))


def _judged(
    robot: Mechanism, believed: Solution, best: Solution, settled: _Settled, fixed: FloatArray
) -> tuple[tuple[Reach, ...], tuple[str, ...]]:
    """Say what becomes of each target; `fixed` (n, 6) is what no reading can remove."""
    final, gap = settled.final, settled.gaps * twist_weights(robot) / robot.size
    allowed, why = check_limits(robot, robot.values[None], final.q[None], final.state)
    first, last = np.linalg.norm(gap[0], axis=1), np.linalg.norm(gap[-1], axis=1)
    loose = last > np.maximum(SHRUNK * first, NOTHING)
    position, angle = np.linalg.norm(fixed[:, 3:], axis=1), np.linalg.norm(fixed[:, :3], axis=1)
    names = ", ".join(robot.controlled)
    found = []
    for i in range(len(fixed)):
        lost = next((s for s in (best, believed, final) if not s.converged[i]), None)
        if lost is not None:
            whose = "the controller's geometry: " if lost is believed else ""
            found.append(
                (
                    Reach.UNREACHABLE,
                    f"cannot be reached: {whose}{lost.explain(i).split(': ', 1)[1]}",
                )
            )
        elif not allowed[0, i]:
            found.append((Reach.OUTSIDE, f"outside the machine's limits: {why[0, i]}"))
        elif loose[i]:
            found.append(
                (
                    Reach.NOT_SETTLED,
                    "the shifted commands have not settled; allow more steps, or set readings",
                )
            )
        elif position[i] > NOTHING * robot.size or angle[i] > NOTHING:
            left = _shown(robot, position[i], angle[i])
            found.append((Reach.IN_PART, f"{names} reached; no actuator removes {left}"))
        else:
            found.append((Reach.REACHED, "reached in full"))
    return tuple(reach for reach, _ in found), tuple(sentence for _, sentence in found)


def _shown(robot: Mechanism, position: float, angle: float) -> str:
    """Length and angle in the units of the robot's file."""
    parts = []
    for value, dimension in ((position, Dimension.LENGTH), (angle, Dimension.ANGLE)):
        shown = find_unit(robot.units.get(dimension, DISPLAY_UNITS[dimension].symbol))
        parts.append(f"{value / shown.factor_to_si:.3g} {shown}")
    return " and ".join(parts)
