# SPDX-License-Identifier: Apache-2.0
"""Options of a plan: number of poses or accuracy goal, criterion, constraints, candidates, seed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from loopcal.errors import DataError
from loopcal.measure import Measurements
from loopcal.planning.constraints import Constraints
from loopcal.typing import FloatArray

Target = Literal["pose", "position", "orientation"]
"""Error that a plan makes small; that of a pose counts rotations times the robot's size."""

N_POSES = 40
"""Number of poses where neither a number nor a goal is given."""


@dataclass(frozen=True, eq=False)
class PlanOptions:
    """Options of `plan`.

    Parameters
    ----------
    n_poses : number of poses for the fit; default 40, or as many as the goal needs.
    criterion : "I", the mean predicted variance of `target` over the workspace, or "D", the volume
        of uncertainty of the parameters.
    target : error to make small: "pose" (rotations times the robot's size), "position" or
        "orientation".
    goal : expected error of `target` to reach [m, rad], root mean square over the workspace; the
        plan then has the smallest number of poses that reaches it.
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
    seed : of all random choices.

    Raises
    ------
    DataError
        Both `n_poses` and `goal` are given, or `n_candidates` is not positive.
    """

    n_poses: int | None = None
    criterion: str = "I"
    target: Target = "pose"
    goal: float | None = None
    hold_out: int | None = None
    frame: str = "fitted"
    constraints: Constraints = field(default_factory=Constraints)
    allowed_poses: FloatArray | None = field(default=None, repr=False)
    n_candidates: int = 1000
    measured: Measurements | None = field(default=None, repr=False)
    used_names: tuple[str, ...] = field(default=(), repr=False)
    curve: bool = False
    seed: int = 1

    def __post_init__(self) -> None:
        if self.n_poses is not None and self.goal is not None:
            raise DataError(
                f"both a number of poses ({self.n_poses}) and an accuracy goal are given; give one "
                "of them"
            )
        if self.n_candidates < 1:
            raise DataError(f"{self.n_candidates} candidate poses; give 1 or more")
        if self.allowed_poses is not None:
            poses = np.atleast_2d(np.array(self.allowed_poses, dtype=float))
            poses.setflags(write=False)
            object.__setattr__(self, "allowed_poses", poses)
