# SPDX-License-Identifier: Apache-2.0
"""Poses that could be measured: spread through the workspace and along its boundary, each judged by
every constraint.

Informative poses lie at the boundary of what can be reached: half of the candidates are therefore
drawn inside, and half are drawn on faces, edges and corners of the stated ranges and, where these
cannot be reached, drawn back along a straight line towards the middle until they can. Kept are
those with an allowed straight way from home, so that home is a way round everything that may not be
crossed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism import (
    MIN_DRAWS,
    MIN_REACHABLE_SHARE,
    POSITION,
    Mechanism,
    Solution,
    draw_coordinates,
    inverse,
    read_coordinates,
    workspace_ranges,
)
from loopcal.planning.constraints import Constraints, Rules, Verdicts, refusals, rules
from loopcal.planning.paths import between, distance, follow
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit

HALVINGS = 12
"""Bisections of the line to the middle: the boundary is met to 1/4096 of it."""
DIGITS = 5
"""Decimal places of the robot's size, in its unit, to which coordinates are commanded; the same of
a radian.
"""
ROUNDING = 1e-6
"""Part of a step that is the rounding of a bound's own number."""
ON_BOUNDARY = 0.7
"""Share of the coordinates of a boundary pose that are put to an end of their range."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses that may be measured.

    Attributes
    ----------
    coordinates : (n, c) controlled coordinates [m, rad]. solution : their readings and poses.
    even : (n,) True for those drawn evenly from the workspace, which stand for it.
    refused : reason -> number of poses that it ruled out. tried : number of poses in all. rules :
        judged by.
    """

    coordinates: FloatArray
    solution: Solution
    even: np.ndarray
    refused: Mapping[str, int]
    tried: int
    rules: Rules

    def __len__(self) -> int:
        return len(self.coordinates)

    def sentence(self) -> str:
        """Say how many poses are left, and what ruled out the others."""
        out = self.tried - len(self)
        ruled = f"; ruled out: {refusals(dict(self.refused), len(self.refused))}" if out else ""
        return f"{len(self)} of {self.tried} poses may be measured{ruled}"


def candidates(
    robot: Mechanism,
    constraints: Constraints | None = None,
    count: int = 1000,
    seed: int | np.random.Generator = 0,
) -> Candidates:
    """Draw about `count` allowed poses from the workspace of a robot, half of them at its boundary.

    Raises
    ------
    MechanismError
        The robot states no workspace, nothing of it is left by the constraints, or home itself
        breaks one.
    """
    rng = np.random.default_rng(seed)
    judged_by, wanted = _at_home(robot, constraints), workspace_ranges(robot)
    refused: Counter[str] = Counter()
    inside, tried = _inside(judged_by, rng, wanted, count - count // 2, refused)
    edge = _boundary(judged_by, rng, wanted, count // 2, inside)
    poses = np.concatenate([inside, edge])
    even = np.arange(len(poses)) < len(inside)
    return _reached(judged_by, poses, even, refused, tried + len(edge))


def listed_candidates(
    robot: Mechanism, poses: FloatArray, constraints: Constraints | None = None
) -> Candidates:
    """Return those of the given poses (n, c) [m, rad] that are allowed; they stand for the
    workspace themselves.

    Raises
    ------
    MechanismError
        None of them is allowed, or home itself breaks a constraint.
    """
    judged_by = _at_home(robot, constraints)
    poses = np.unique(poses, axis=0)
    verdict = judged_by.judge(inverse(robot, poses))
    refused: Counter[str] = Counter(verdict.counts())
    good = poses[verdict.allowed]
    if not len(good):
        raise MechanismError(
            f"none of the {len(poses)} poses given for {robot.name} is allowed: "
            f"{refusals(dict(refused))}; correct the poses, "
            "or relax a constraint"
        )
    return _reached(judged_by, good, np.ones(len(good), dtype=bool), refused, len(poses))


def rounded(
    robot: Mechanism, coordinates: FloatArray, towards: FloatArray | None = None
) -> FloatArray:
    """Round coordinates (n, c) to a step that a person types: DIGITS of the robot's size and of a
    radian, in its units.

    Parameters
    ----------
    towards : (c,) place to which everything is rounded; default: to the nearest.
    """
    steps = []
    for name in robot.controlled:
        dimension = Dimension.LENGTH if name in POSITION else Dimension.ANGLE
        shown = find_unit(robot.units[dimension])
        whole = (robot.size if name in POSITION else 1.0) / shown.factor_to_si
        steps.append(10.0 ** (np.floor(np.log10(whole)) - DIGITS) * shown.factor_to_si)
    counts = coordinates / np.array(steps)
    if towards is None:
        return np.round(counts) * steps
    slack = np.where(coordinates > towards, ROUNDING, -ROUNDING)
    return (
        np.where(coordinates > towards, np.floor(counts + slack), np.ceil(counts + slack)) * steps
    )


def home_coordinates(robot: Mechanism) -> FloatArray:
    """Controlled coordinates (c,) of home [m, rad]."""
    return read_coordinates(robot.home, robot.controlled)


def _at_home(robot: Mechanism, constraints: Constraints | None) -> Rules:
    """Return the rules, after a look at home, from which every way starts."""
    found = rules(robot, constraints or Constraints())
    verdict = found.judge(inverse(robot, home_coordinates(robot)[None]), at_pose=False)
    if not verdict.allowed[0]:
        raise MechanismError(
            f"every way starts at the home of {robot.name}, and there {verdict.why[0]}; choose "
            "another home in the robot file, "
            "or relax the constraint"
        )
    return found


def _inside(
    judged_by: Rules,
    rng: np.random.Generator,
    wanted: Mapping[str, tuple[float, float]],
    count: int,
    refused: Counter[str],
) -> tuple[FloatArray, int]:
    """Draw poses evenly (count, c) and count the refused; also how many were tried."""
    robot, parts, kept, tried = judged_by.robot, [], 0, 0
    while kept < count:
        poses = rounded(
            robot,
            draw_coordinates(
                rng,
                robot.controlled,
                wanted,
                count if not kept else max(count - kept, count // 10, 1),
            ),
        )
        verdict = judged_by.judge(inverse(robot, poses))
        refused.update(verdict.counts())
        parts.append(poses[verdict.allowed])
        kept, tried = kept + len(parts[-1]), tried + len(poses)
        if tried >= MIN_DRAWS and kept < MIN_REACHABLE_SHARE * tried:
            raise MechanismError(
                f"the constraints leave nothing of the workspace of {robot.name}: {kept} of "
                f"{tried} poses drawn from it are "
                f"allowed; refused were {refusals(dict(refused.most_common()))}; relax one of these"
            )
    return np.concatenate(parts), tried


def _boundary(
    judged_by: Rules,
    rng: np.random.Generator,
    wanted: Mapping[str, tuple[float, float]],
    count: int,
    inside: FloatArray,
) -> FloatArray:
    """Poses (count, c) at the ends of ranges, drawn back to the boundary of what is allowed."""
    robot, names = judged_by.robot, judged_by.robot.controlled
    low, high = np.array([wanted[name] for name in names]).T
    full = np.isclose(high - low, 2.0 * np.pi)
    poses = draw_coordinates(rng, names, wanted, count)
    end = rng.random((count, len(names))) < 0.5
    put = (rng.random((count, len(names))) < ON_BOUNDARY) & ~full
    # one coordinate at least is at an end, unless none has one
    put[
        np.arange(count), rng.choice(np.flatnonzero(~full), count) if not full.all() else 0
    ] |= not full.all()
    poses = np.where(put, np.where(end, high, low), poses)
    middle = inside[np.argmin(distance(robot, inside, np.median(inside, axis=0)[None]))]
    anchor = np.broadcast_to(middle, poses.shape)
    good = np.zeros(count)
    good[judged_by.judge(inverse(robot, poses)).allowed] = 1.0
    bad = np.ones(count)
    for _ in range(HALVINGS):
        open_ = np.flatnonzero(good < 1.0)
        if not len(open_):
            break
        share = (good[open_] + bad[open_]) / 2.0
        allowed = judged_by.judge(
            inverse(robot, between(robot, anchor[open_], poses[open_], share))
        ).allowed
        good[open_], bad[open_] = (
            np.where(allowed, share, good[open_]),
            np.where(allowed, bad[open_], share),
        )
    found = np.where(good[:, None] == 1.0, poses, between(robot, anchor, poses, good))[good > 0.0]
    # towards the middle, so that what is rounded stays inside
    found = rounded(robot, found, middle)
    found = np.unique(found, axis=0)
    return found[judged_by.judge(inverse(robot, found)).allowed]


def _reached(
    judged_by: Rules, poses: FloatArray, even: np.ndarray, refused: Counter[str], tried: int
) -> Candidates:
    """Keep the poses to which a straight way leads from home."""
    robot = judged_by.robot
    home = np.broadcast_to(home_coordinates(robot), poses.shape)
    way: Verdicts = follow(judged_by, home, poses)
    refused.update(
        {f"no straight way from home: {reason}": n for reason, n in way.counts().items()}
    )
    if not way.allowed.any():
        raise MechanismError(
            f"no pose of {robot.name} can be reached from home on an allowed straight way: "
            f"{refusals(way.counts())}; relax a "
            "constraint, or choose another home in the robot file"
        )
    kept = poses[way.allowed]
    return Candidates(
        kept, inverse(robot, kept), even[way.allowed], dict(refused.most_common()), tried, judged_by
    )
