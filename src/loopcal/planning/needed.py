# SPDX-License-Identifier: Apache-2.0
"""How many poses: expected errors of good designs against their number, and the fewest that reach a
goal.

The relaxed design bounds what any choice of so many poses can reach, and so says below how many a
goal is out of reach. Where poses are compared, pairs are counted in their place: few poses make
many pairs, and a bound on pairs is none on poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.errors import EstimationError
from loopcal.mechanism import Mechanism
from loopcal.planning.curve import Curve, design_curve, enough
from loopcal.planning.design import allowed
from loopcal.planning.problem import Accuracy, Problem, Target
from loopcal.typing import FloatArray, IntArray
from loopcal.units import DISPLAY_UNITS, Dimension, find_unit

SIZES = 6
"""Numbers of poses on a curve."""
WIDE = 4
"""A curve goes from the fewest poses to this many times the number asked for."""
MOST = 400
"""Poses beyond which no goal is followed: more is a day's work."""
SHAKES = 4
"""Times that designs of a curve are shaken out of local optima."""
DIMENSION = {"pose": Dimension.LENGTH, "position": Dimension.LENGTH, "orientation": Dimension.ANGLE}


@dataclass(frozen=True, eq=False)
class PoseCurve:
    """Expected errors by the number of poses, or of pairs where poses are compared.

    Attributes
    ----------
    numbers : (k,) of poses or pairs, ascending. expected : of a good design of each. target : which
        error was made small.
    values, bounds : (k,) that error [m, rad], and the smallest that any choice of so many of those
        considered can have.
    goal : asked for [m, rad], or None. enough : of the numbers the fewest found that reach it.
        at_least : number below which no choice of those considered reaches it. together : poses
        that are compared; 1 where each counts alone.
    considered : poses or pairs to choose from.
    """

    numbers: IntArray
    expected: tuple[Accuracy, ...]
    target: Target
    values: FloatArray
    bounds: FloatArray
    goal: float | None = None
    enough: int | None = None
    at_least: int | None = None
    together: int = 1
    considered: int = 0

    @property
    def counted(self) -> str:
        """What the numbers count."""
        return counted(self.together)

    def sentences(self, robot: Mechanism) -> list[str]:
        """Say what the curve shows."""
        if self.goal is not None:
            goal = in_unit(robot, self.goal, DIMENSION[self.target])
            reached = f"{self.enough} {self.counted} reach an expected {self.target} error of {goal} (rms)"
            among = (
                "candidates"
                if self.together == 1
                else f"{self.considered} {self.counted} considered"
            )
            if self.enough == self.numbers[0]:
                return [f"{reached}; fewer give fewer equations than there are unknowns"]
            return [f"{reached}; no choice of fewer than {self.at_least} of the {among} can"]
        found = "; ".join(
            f"{n}: {in_words(robot, e)}"
            for n, e in zip(self.numbers.tolist(), self.expected, strict=True)
        )
        return [f"expected errors by number of {self.counted}: {found}"]

    def to_dict(self) -> dict[str, Any]:
        """Everything by name for JSON, SI."""
        return {
            "target": self.target,
            "counted": self.counted,
            "considered": self.considered,
            "numbers": self.numbers.tolist(),
            "position": [e.position for e in self.expected],
            "orientation": [e.orientation for e in self.expected],
            "values": self.values.tolist(),
            "bounds": self.bounds.tolist(),
            "goal": self.goal,
            "enough": self.enough,
            "at_least": self.at_least,
        }


def pose_curve(made: Problem, n_poses: int, target: Target = "pose", seed: int = 1) -> PoseCurve:
    """Return expected errors from the fewest poses that there are equations for to a few times
    `n_poses`.
    """
    k = made.poses_in_unit
    last = min(max(WIDE * n_poses // k, 2 * made.fewest), int(allowed(made.units.rows).sum()))
    first = min(made.fewest, last)
    numbers = np.unique(
        np.append(
            np.geomspace(first, last, SIZES).round().astype(int),
            min(max(n_poses // k, first), last),
        )
    )
    wanted = made.criterion("I", target)
    return _curve(
        made,
        design_curve(made.units.rows, numbers.tolist(), wanted, made.start, seed, SHAKES),
        target,
    )


def poses_needed(made: Problem, goal: float, target: Target, seed: int = 1) -> PoseCurve:
    """Return the fewest poses found that reach a goal, on a curve of expected errors from fewer to
    twice as many.

    Parameters
    ----------
    goal : root mean square of the target over the workspace [m, rad].

    Raises
    ------
    EstimationError
        The goal is no number above zero, or out of reach, with the best that can be had.
    """
    if not goal > 0.0 or not np.isfinite(goal):
        asked = in_unit(made.free.robot, goal, DIMENSION[target])
        raise EstimationError(
            f"the accuracy asked for is {asked}; give a number above 0 with its unit, such as 20um"
        )
    wanted, rows, k = made.criterion("I", target), made.units.rows, made.poses_in_unit
    most = min(MOST // k, int(allowed(rows).sum()))
    made.require_equations(most)
    try:
        found = enough(rows, goal**2, wanted, made.start, most, seed, SHAKES)
    except EstimationError:
        best = design_curve(rows, [most], wanted, made.start, seed, 0)
        robot, dimension = made.free.robot, DIMENSION[target]
        considered = "" if k == 1 else f" of the {int(allowed(rows).sum())} considered"
        raise EstimationError(
            f"an expected {target} error of {in_unit(robot, goal, dimension)} (rms) is out of "
            f"reach: {most} {counted(k)} leave "
            f"{in_unit(robot, float(np.sqrt(best.values[0])), dimension)}, and no choice of so "
            f"many{considered} less than "
            f"{in_unit(robot, float(np.sqrt(best.bounds[0])), dimension)}; take a better "
            "instrument, "
            "allow more candidates, or ask for less"
        ) from None
    n = max(found.n, made.fewest)
    others = (
        np.geomspace(made.fewest, min(2 * n, int(allowed(rows).sum())), SIZES - 1)
        .round()
        .astype(int)
    )
    numbers = np.unique(np.append(others, n)).tolist()
    curve = design_curve(rows, numbers, wanted, made.start, seed, SHAKES)
    if n == found.n:  # the design that was found for it, where the curve's own is less good
        place = numbers.index(n)
        designs = (*curve.designs[:place], found.certified, *curve.designs[place + 1 :])
        values = np.where(
            curve.numbers == n, np.minimum(curve.values, found.certified.design.value), curve.values
        )
        curve = replace(curve, designs=designs, values=values)
    return _curve(made, curve, target, goal, n, found.at_least)


def counted(together: int) -> str:
    """Return what a plan counts where so many poses are measured together."""
    return {1: "poses", 2: "pairs"}.get(together, f"sets of {together} poses")


def in_unit(robot: Mechanism, value: float, dimension: Dimension) -> str:
    """Return a number with the unit of the robot's file."""
    symbol = robot.units.get(dimension, DISPLAY_UNITS[dimension].symbol)
    return f"{value / find_unit(symbol).factor_to_si:.3g} {symbol}"


def in_words(robot: Mechanism, errors: Accuracy) -> str:
    """Return errors with their units, those that there are."""
    pairs = ((errors.position, Dimension.LENGTH), (errors.orientation, Dimension.ANGLE))
    return (
        ", ".join(in_unit(robot, value, dimension) for value, dimension in pairs if value > 0.0)
        or "nothing"
    )


def _curve(
    made: Problem,
    found: Curve,
    target: Target,
    goal: float | None = None,
    enough_: int | None = None,
    at_least: int | None = None,
) -> PoseCurve:
    """Return a curve in errors."""
    expected = [made.accuracy(one.design.chosen) for one in found.designs]
    assert all(e is not None for e in expected)  # no design leaves a direction open
    known = tuple(e for e in expected if e is not None)
    values, bounds = np.sqrt(found.values), np.sqrt(np.maximum(found.bounds, 0.0))
    counts = made.poses_in_unit, int(allowed(made.units.rows).sum())
    return PoseCurve(found.numbers, known, target, values, bounds, goal, enough_, at_least, *counts)
