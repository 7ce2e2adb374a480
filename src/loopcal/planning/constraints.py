# SPDX-License-Identifier: Apache-2.0
"""What a planned pose must keep to: the machine's own limits, a margin from singularities, tilt,
and being seen.

Everything is judged for many poses at once, with the reason in words. Margins are those of
`loopcal.mechanism.singularities`, as shares of their medians over the workspace.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopcal.errors import DataError
from loopcal.mechanism import (
    NEAR_SHARE,
    Mechanism,
    Solution,
    analyze_singularity,
    compute_closure_sign,
    compute_median_margins,
    evaluate_limits,
)
from loopcal.typing import BoolArray, FloatArray

ROUNDING = 1e-12
"""Share of a bound by which it may be exceeded: the rounding of its own number."""


@dataclass(frozen=True, eq=False)
class Sight:
    """A place from which the target on the tool must be seen.

    Attributes
    ----------
    station : (3,) place of the instrument in the base frame [m].
    facing : (3,) where the target faces, in the axes of the platform; any length above zero.
    cone : half the angle within which the target can be seen [rad]. nearest, farthest : allowed
        distance [m].

    Raises
    ------
    DataError
        A number that cannot be.
    """

    station: FloatArray
    facing: FloatArray
    cone: float = np.pi / 2
    nearest: float = 0.0
    farthest: float = np.inf

    def __post_init__(self) -> None:
        for name in ("station", "facing"):
            given = np.array(getattr(self, name), dtype=float)
            if given.shape != (3,) or not np.isfinite(given).all():
                raise DataError(
                    f"the {name} of a line of sight needs three finite numbers, but "
                    f"{given.tolist()} was given"
                )
            given.setflags(write=False)
            object.__setattr__(self, name, given)
        if not np.linalg.norm(self.facing) > 0.0:
            raise DataError(
                "the direction in which the target faces is 0, 0, 0; give one that points somewhere"
            )
        if not 0.0 < self.cone <= np.pi:
            raise DataError(
                f"the target is seen within {np.degrees(self.cone):g} deg; give an angle above 0, "
                "at most 180 deg"
            )
        if not 0.0 <= self.nearest < self.farthest:
            raise DataError(
                f"the distance of the target is to be {self.nearest:g} to {self.farthest:g} m; "
                "give a smaller and a larger one"
            )

    def broken(self, T: FloatArray, tool: FloatArray) -> Iterator[tuple[str, BoolArray]]:
        """Yield what is not met in words and at which of the poses T (n, 4, 4); tool is
        T_platform_tool (4, 4).
        """
        to_station = self.station - (T @ tool)[:, :3, 3]
        distance = np.linalg.norm(to_station, axis=1)
        faces = T[:, :3, :3] @ (self.facing / np.linalg.norm(self.facing))
        across = np.linalg.norm(np.cross(faces, to_station), axis=1)
        off = np.arctan2(across, np.einsum("ni,ni->n", faces, to_station))
        yield (
            "the instrument is too near or too far",
            ~((distance >= self.nearest) & (distance <= self.farthest)),
        )
        yield "the target faces away from the instrument", ~(off <= self.cone)


@dataclass(frozen=True)
class Constraints:
    """What is asked of planned poses beside the machine's own strokes, joint limits and cones.

    Attributes
    ----------
    min_margin : smallest distance from a singularity, as a share of its median over the workspace,
        0 to 1; on the way too.
    max_tilt : largest angle between the z axis of the platform and that of the base [rad]; on the
        way too.
    sight : a place from which the target must be seen at each pose.

    Raises
    ------
    DataError
        A number that cannot be.
    """

    min_margin: float = NEAR_SHARE
    max_tilt: float | None = None
    sight: Sight | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.min_margin < 1.0:
            raise DataError(
                f"the margin from singularities is {self.min_margin:g}; give a share of the "
                "median, 0 or more and below 1"
            )
        if self.max_tilt is not None and not 0.0 < self.max_tilt <= np.pi:
            raise DataError(
                f"the largest tilt is {np.degrees(self.max_tilt):g} deg; give an angle above 0, at "
                "most 180 deg"
            )


@dataclass(frozen=True, eq=False)
class Rules:
    """Constraints of one robot, with what they are compared with.

    Attributes
    ----------
    medians : of margin and drive margin over the workspace. side : sign of the determinant at home.
    """

    robot: Mechanism
    constraints: Constraints
    medians: tuple[float, float]
    side: int

    def judge(self, found: Solution, at_pose: bool = True) -> Verdicts:
        """Judge poses; `at_pose` False leaves out what holds only where something is measured: the
        line of sight.
        """
        allowed = np.array(found.converged)
        why = np.full(len(allowed), "", dtype=object)
        why[~allowed] = "the loops cannot be closed"
        for words, broken in self._broken(found, at_pose):
            first = broken & allowed
            why[first] = words
            allowed &= ~broken
        return Verdicts(allowed, why)

    def _broken(self, found: Solution, at_pose: bool) -> Iterator[tuple[str, BoolArray]]:
        """Yield each constraint in words, and where it is not met (n,)."""
        robot, asked = self.robot, self.constraints
        for limit in evaluate_limits(robot, robot.values[None], found.q[None], found.state):
            yield (
                f"{limit.name} is exceeded",
                ~(limit.margin[0] >= -ROUNDING * max(abs(limit.low), abs(limit.high))),
            )
        near = analyze_singularity(robot, found, self.medians)
        yield "a singularity lies between it and home", near.closure_sign != self.side
        yield (
            f"a singularity is near (margin below {asked.min_margin:g} of the median)",
            ~((near.ratio >= asked.min_margin) & (near.drive_ratio >= asked.min_margin)),
        )
        if asked.max_tilt is not None:
            upright = found.T[:, 2, 2]
            tilt = np.arctan2(np.hypot(found.T[:, 0, 2], found.T[:, 1, 2]), upright)
            yield (
                f"the tilt exceeds {np.degrees(asked.max_tilt):.6g} deg",
                ~(tilt <= asked.max_tilt * (1.0 + ROUNDING)),
            )
        if at_pose and asked.sight is not None:
            yield from asked.sight.broken(found.T, robot.tool)


@dataclass(frozen=True, eq=False)
class Verdicts:
    """Which of n poses or ways are allowed (n,), and the first reason against each of the others,
    '' where there is none.
    """

    allowed: BoolArray
    why: NDArray[np.object_]

    def counts(self) -> dict[str, int]:
        """Reason -> how often it was the first, most frequent first."""
        return dict(Counter(self.why[~self.allowed].tolist()).most_common())


def rules(robot: Mechanism, constraints: Constraints) -> Rules:
    """Return what poses of a robot are judged by."""
    side = int(compute_closure_sign(robot, robot.values[None], robot.home_state)[0, 0])
    return Rules(robot, constraints, compute_median_margins(robot), side)


def refusals(counts: dict[str, int], most: int = 3) -> str:
    """Return counts of refusals in words, the most frequent first."""
    shown = [f"{reason} ({count})" for reason, count in list(counts.items())[:most]]
    return "; ".join([*shown, *(["..."] if len(counts) > most else [])])
