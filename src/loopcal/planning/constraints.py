# SPDX-License-Identifier: Apache-2.0
"""Constraints on planned poses: machine limits, margin from singularities, tilt and line of sight.

Many poses are checked at once; a violation is a code with numbers. Margins are those of
`loopcal.mechanism.singularities`, as shares of their medians over the workspace.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from loopcal.checks import NOT_NEGATIVE, POSITIVE, Limit, Limited
from loopcal.errors import DataError
from loopcal.measure.array_checks import check_array
from loopcal.measure.measurements import Measurements
from loopcal.mechanism import singularities
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution
from loopcal.mechanism.workspace import evaluate_limits
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

ROUNDING = 1e-12  # share of a bound by which it may be exceeded: the rounding of its own number
HALF_TURN = Limit(
    lambda value: 0.0 < value <= np.pi,
    "an angle above 0, at most 180 deg",
    lambda value: f"{np.degrees(value):g} deg",
)


class PlanSettings(Limited):
    """Base of the options of a plan: a wrong one is a DataError."""

    ERROR: ClassVar[type[Exception]] = DataError


@dataclass(frozen=True, eq=False)
class LineOfSight(PlanSettings):
    """A station from which the target on the tool must be visible.

    Attributes
    ----------
    station : (3,) position of the instrument in the base frame [m].
    facing : (3,) direction in which the target faces, in the axes of the platform; any length
        above 0.
    cone : half the angle within which the target is visible [rad].
    nearest, farthest : allowed distance [m].

    Raises DataError where a vector is not finite or has no length, or a number is out of range.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {"cone": HALF_TURN}
    station: FloatArray
    facing: FloatArray
    cone: float = np.pi / 2
    nearest: float = 0.0
    farthest: float = np.inf

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("station", "facing"):
            given = check_array(getattr(self, name), f"{name} of the line of sight", (3,))
            object.__setattr__(self, name, given)
        if not np.linalg.norm(self.facing) > 0.0:
            raise DataError(
                "facing of the line of sight is 0, 0, 0. Give a direction with a length above 0"
            )
        if not 0.0 <= self.nearest < self.farthest:
            raise DataError(
                f"the line of sight allows distances from {self.nearest:g} to {self.farthest:g} m. "
                "Give a smaller and a larger distance, 0 or more"
            )

    def find_violations(self, T: FloatArray, tool: FloatArray) -> Iterator[tuple[str, BoolArray]]:
        """Yield the code of each violation and the poses T (n, 4, 4) where it occurs.

        tool : T_platform_tool.
        """
        to_station = self.station - (T @ tool)[:, :3, 3]
        distance = np.linalg.norm(to_station, axis=1)
        normal = T[:, :3, :3] @ (self.facing / np.linalg.norm(self.facing))
        across = np.linalg.norm(np.cross(normal, to_station), axis=1)
        angle = np.arctan2(across, np.einsum("ni,ni->n", normal, to_station))
        in_range = (distance >= self.nearest) & (distance <= self.farthest)
        yield "distance-out-of-range", ~in_range
        yield "target-faces-away", ~(angle <= self.cone)


@dataclass(frozen=True)
class Constraints(PlanSettings):
    """Requirements on planned poses beside the machine's own strokes, joint limits and cones.

    Attributes
    ----------
    min_margin : smallest distance from a singularity, as a share of its median over the workspace,
        0 to 1; also required on paths.
    max_tilt : largest angle between the z axis of the platform and that of the base [rad]; also
        required on paths.
    sight : line of sight to the target, required at each pose.
    stroke_margin, stroke_margin_angle : smallest distance of each reading from both ends of its
        stroke, of actuators that move a length [m] and of those that turn [rad]; also required on
        paths.

    Raises DataError where a margin or the tilt is out of range.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "min_margin": Limit(
            lambda value: 0.0 <= value < 1.0, "a share of the median, 0 or more and below 1"
        ),
        "max_tilt": HALF_TURN,
        "stroke_margin": Limit(lambda value: 0.0 <= value < np.inf, "finite, 0 m or more"),
        "stroke_margin_angle": Limit(lambda value: 0.0 <= value < np.inf, "finite, 0 rad or more"),
    }
    min_margin: float = singularities.NEAR_SHARE
    max_tilt: float | None = None
    sight: LineOfSight | None = None
    stroke_margin: float = 0.0
    stroke_margin_angle: float = 0.0

    def stroke_margin_of(self, dimension: Dimension) -> float:
        """Return the margin from the ends of a stroke of this dimension [m or rad]."""
        return self.stroke_margin_angle if dimension is Dimension.ANGLE else self.stroke_margin


@dataclass(frozen=True)
class Violation:
    """The first constraint that a pose or a path violates."""

    code: str  # of the reason; worded by `violation` of `phrases.toml`
    data: tuple[tuple[str, Any], ...] = ()  # names and numbers of the reason
    on_path: bool = False  # whether it occurs on the straight path from home, not at the pose


@dataclass(frozen=True, eq=False)
class ConstraintCheck:
    """Result of checking n poses or paths."""

    allowed: BoolArray  # (n,)
    violations: NDArray[np.object_]  # (n,) the first `Violation` of each; None where allowed

    def count_violations(self) -> Counter[Violation]:
        """Return how often each violation was the first, most frequent first."""
        return Counter(dict(Counter(self.violations[~self.allowed].tolist()).most_common()))


@dataclass(frozen=True, eq=False)
class ConstraintChecker:
    """The constraints of one robot with their reference values."""

    robot: Mechanism
    constraints: Constraints
    medians: tuple[float, float]  # of margin and drive margin over the workspace

    def check_poses(
        self, solution: Solution, at_pose: bool = True, steps: int = 1
    ) -> ConstraintCheck:
        """Check poses; `at_pose` False omits the line of sight, which only measuring needs.

        steps : of paths, whose poses the solution has one after the other; of each path the check
            is exact up to its first violation.
        """
        robot, required, allowed = self.robot, self.constraints, np.array(solution.closed)
        violations = np.full(len(allowed), None, dtype=object)

        def refuse(violated: BoolArray, code: str, *data: tuple[str, Any]) -> None:
            """Enter a violation at poses (n,) that have none yet."""
            violations[violated & allowed] = Violation(code, data)
            allowed[violated] = False

        violations[~allowed] = Violation("loops-open")
        for limit in evaluate_limits(robot, robot.values[None], solution.q[None], solution.state):
            slack = ROUNDING * max(abs(limit.low), abs(limit.high))
            name = ("limit", limit.name)
            refuse(~(limit.margin[0] >= -slack), "limit-exceeded", name)
            needed = required.stroke_margin_of(limit.dimension) if limit.is_stroke else 0.0
            if needed > 0.0:
                shown = ("needed", str(robot.to_quantity(needed, limit.dimension)))
                refuse(~(limit.margin[0] >= needed - slack), "near-stroke-end", name, shown)
        refuse(~solution.converged, "other-mode")
        share = required.min_margin
        least = share * self.medians[0], share * self.medians[1]
        is_near = singularities.find_near_singularity(robot, solution.state, least, allowed, steps)
        refuse(is_near, "near-singularity", ("min_margin", share))
        if required.max_tilt is not None:
            T = solution.T
            tilt = np.arctan2(np.hypot(T[:, 0, 2], T[:, 1, 2]), T[:, 2, 2])
            largest = ("max_tilt_deg", float(np.degrees(required.max_tilt)))
            refuse(~(tilt <= required.max_tilt * (1.0 + ROUNDING)), "tilt-exceeded", largest)
        if at_pose and required.sight is not None:
            for code, violated in required.sight.find_violations(solution.T, robot.tool):
                refuse(violated, code)
        return ConstraintCheck(allowed, violations)


def build_checker(robot: Mechanism, constraints: Constraints | None) -> ConstraintChecker:
    """Return the checker of a robot's poses; None stands for the default constraints.

    Raises DataError for a margin from the ends of strokes where there is no stroke, or as large as
    half of one.
    """
    required = constraints or Constraints()
    for dimension in (Dimension.LENGTH, Dimension.ANGLE):
        margin = required.stroke_margin_of(dimension)
        if not margin > 0.0:
            continue
        strokes = {
            a.name: a.stroke[1] - a.stroke[0]
            for a in robot.actuators
            if a.dimension is dimension and a.stroke is not None
        }
        if not strokes:
            raise DataError.of("plan.no-stroke", robot=robot.name, dimension=dimension.value)
        name = min(strokes, key=strokes.__getitem__)
        if not 2.0 * margin < strokes[name]:
            raise DataError.of(
                "plan.margin-exceeds-stroke",
                actuator=name,
                margin=robot.to_quantity(margin, dimension),
                stroke=robot.to_quantity(strokes[name], dimension),
            )
    return ConstraintChecker(robot, required, singularities.compute_median_margins(robot))


def list_reasons(counts: Counter[Violation]) -> tuple[dict[str, Any], ...]:
    """Return counted violations as data of a finding, most frequent first."""
    return tuple(
        {"code": why.code, "on_path": why.on_path, **dict(why.data), "count": count}
        for why, count in counts.most_common()
    )


# Error that a plan makes small; that of a pose counts rotations times the robot's size.
Target = Literal["pose", "position", "orientation"]
N_POSES = 40  # number of poses where neither a number nor a goal is given


@dataclass(frozen=True, eq=False)
class PlanOptions(PlanSettings):
    """Options of `plan`.

    Parameters
    ----------
    n_poses : number of poses for the fit; default 40, or as many as the goal needs.
    criterion : "I", the mean predicted variance of `target` over the workspace, or "D", the volume
        of uncertainty of the parameters.
    target : error to make small: "pose" (rotations times the robot's size), "position" or
        "orientation".
    goal : error of `target` [m, rad], root mean square over the workspace, that the `share` of
        machines is to stay below; the plan then has the smallest number of poses that reaches it.
    share : of machines with errors by the spreads, whose error after the calibration a plan
        states: at least 0.7, so that the error is above the root mean square of all machines.
    hold_out : number of further poses for validation, drawn evenly; default one for four poses of
        the fit, and at least 5, which a verdict needs.
    frame : in which errors are stated: "fitted", after the best rigid fit of the base and platform
        frames as far as no measurement determines them; "base", the base frame of the robot file;
        "relative", relative to the home pose.
    constraints : margin from singularities, tilt, line of sight. Strokes, joint limits and cones
        are always respected.
    allowed_poses : (n, c) controlled coordinates to choose from [m, rad]; default: about
        `n_candidates` drawn from the workspace.
    n_candidates : number of candidate poses that are drawn.
    measured : measurements made already; they count as prior information.
    used_names : names that new poses must not get, beside those of `measured`, such as the poses
        held out there.
    curve : whether to compute the expected errors by the number of poses, too. With a goal the
        curve is always computed.
    allow_fewer_equations : plan also poses that alone do not determine all parameters, such as
        those of a check, where the expected spreads tell which changes to look for.
    seed : of all random choices.

    Raises DataError for a value that is not allowed, and where `n_poses` and `goal` are given.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "criterion": Limit(
            lambda value: value in ("I", "D"),
            "I (mean predicted variance of poses) or D (volume of uncertainty of the parameters)",
        ),
        # Of all sums of weighted squares, a single square is most often below its mean: in 68 %.
        "share": Limit(lambda value: 0.7 <= value < 1.0, "a share of 0.7 or more and below 1"),
        "n_candidates": POSITIVE,
        "seed": NOT_NEGATIVE,
    }
    n_poses: int | None = None
    criterion: str = "I"
    target: Target = "pose"
    goal: float | None = None
    share: float = 0.9
    hold_out: int | None = None
    frame: Literal["fitted", "base", "relative"] = "fitted"
    constraints: Constraints = field(default_factory=Constraints)
    allowed_poses: FloatArray | None = field(default=None, repr=False)
    n_candidates: int = 1000
    measured: Measurements | None = field(default=None, repr=False)
    used_names: tuple[str, ...] = field(default=(), repr=False)
    curve: bool = False
    allow_fewer_equations: bool = False
    seed: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_poses is not None and self.goal is not None:
            raise DataError(
                f"a number of poses ({self.n_poses}) and an accuracy goal exclude each other. Give "
                "one of them"
            )
        if self.allowed_poses is not None:
            poses = np.atleast_2d(np.array(self.allowed_poses, dtype=float))
            poses.setflags(write=False)
            object.__setattr__(self, "allowed_poses", poses)

    @property
    def asked(self) -> dict[str, Any]:
        """What the poses of the plan are for; see `restore_options`."""
        return {name: getattr(self, name) for name in ASKED}


# Options that a session of measuring the plan needs.
ASKED = ("target", "goal", "share", "frame", "constraints")


def restore_options(asked: Mapping[str, Any]) -> PlanOptions:
    """Return the options of a plan from the JSON of what was asked for."""
    of_plan = {name: value for name, value in asked.items() if name in ASKED}
    stated = {name: v for name, v in of_plan.get("constraints", {}).items() if v is not None}
    if "sight" in stated:  # null stands for an infinite distance
        stated["sight"] = LineOfSight(**{k: v for k, v in stated["sight"].items() if v is not None})
    return PlanOptions(**{**of_plan, "constraints": Constraints(**stated)})
