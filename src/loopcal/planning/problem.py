# SPDX-License-Identifier: Apache-2.0
"""A planning problem made ready: candidates, the rows an instrument would give there, what is
known, what is wanted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from loopcal.errors import DataError, EstimationError
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.outlook import equations, information
from loopcal.measure import Instrument, Measurements, check_actuators
from loopcal.mechanism import Mechanism, Solution, inverse, sample_workspace
from loopcal.numerics.decomposition import Decomposition
from loopcal.planning.candidates import Candidates, candidates, listed_candidates
from loopcal.planning.constraints import Constraints
from loopcal.planning.criteria import Criterion, D, I
from loopcal.planning.design import Directions, Start, design_factor, directions, triangle
from loopcal.planning.information import (
    Predicted,
    UnitRows,
    considered,
    knowable,
    predicted,
    start_of,
)
from loopcal.typing import FloatArray

PREDICTED = 200
"""Poses of the workspace whose errors are predicted."""
NOTHING = 1e-6
"""Largest singular value, in information per tolerance, up to which an instrument tells nothing:
what is left is rounding.
"""
STILL = 1e-9
"""Share of a pose's error up to which its position or orientation does not change at all: what is
left is rounding.
"""

Target = Literal["pose", "position", "orientation"]


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Predicted errors of the tool, root mean square over the workspace.

    Attributes
    ----------
    position [m], orientation [rad].
    """

    position: float
    orientation: float

    def of(self, target: Target, size: float) -> float:
        """Return the error of a target [m, rad]; of a pose with turns times the robot's size [m]."""
        if target == "pose":
            return float(np.hypot(self.position, size * self.orientation))
        return self.position if target == "position" else self.orientation


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything that a choice of poses is made from.

    Attributes
    ----------
    free : the robot's unknowns. instrument : mounted on its tool. candidates : poses that may be
        measured.
    units : their rows. start : what is known before. seen : what all candidates together could
        tell, without tolerances.
    wanted : what is to be predicted. equations : that measurements made already give of the robot,
        those taken off that
        their own unknowns need. taken : names of poses that were measured already.
    """

    free: FreeParameters
    instrument: Instrument
    candidates: Candidates
    units: UnitRows
    start: Start
    seen: Decomposition
    wanted: Predicted
    equations: int
    taken: tuple[str, ...] = ()

    @cached_property
    def space(self) -> Directions:
        """The directions in which designs are compared."""
        return directions(self.units.rows, self.start)

    @property
    def poses_in_unit(self) -> int:
        """Number of poses that are measured together."""
        return self.units.members.shape[1]

    def criterion(self, name: str, target: Target = "pose") -> Criterion:
        """Return D, or I for what is to be predicted; raises EstimationError for another name."""
        if name == "D":
            return D()
        if name != "I":
            raise EstimationError(
                f"the criterion is {name!r}; allowed are I (mean predicted variance of poses) and "
                "D (volume of uncertainty)"
            )
        if target != "pose" and not self._shown(target) > STILL * self._shown("pose"):
            moves, other = (
                ("turn", "a length") if target == "orientation" else ("move its tool", "an angle")
            )
            raise EstimationError(
                f"no {target} is to be predicted: {self.free.robot.name} does not {moves}, or this "
                "instrument cannot tell by "
                f"how much; give {other}, or choose another kind"
            )
        # the triangular factor of the rows gives the same trace from fewer rows
        return I(triangle(getattr(self.wanted, target)), len(self.wanted.shifts))

    def _shown(self, target: Target) -> float:
        """Return how much errors of the parameters show in a target, turns times the size [m]."""
        rows = getattr(self.wanted, target)
        return float(np.abs(rows).max(initial=0.0)) * (
            self.wanted.size if target == "orientation" else 1.0
        )

    def accuracy(self, chosen: np.ndarray) -> Accuracy | None:
        """Return the predicted errors after measuring units (n,), none at all allowed; None where
        nothing bounds them.
        """
        if len(chosen):
            factor = design_factor(self.units.rows[chosen], self.start, self.space)
        # no row of the start speaks of own unknowns and of the machine at once, see `start_of`
        else:
            told = self.start.rows[:, self.start.own :] @ self.space.machine
            factor = triangle(np.concatenate([told, np.zeros((told.shape[1], told.shape[1]))]))
        s = np.linalg.svd(factor, compute_uv=False)
        if not s[-1] > np.finfo(float).eps * len(s) * s[0]:
            return None
        k = len(self.wanted.shifts)
        found = [
            float(np.sqrt((np.linalg.solve(factor.T, (L @ self.space.machine).T) ** 2).sum() / k))
            for L in (self.wanted.position, self.wanted.orientation)
        ]
        return Accuracy(*found)

    @cached_property
    def unknown(self) -> int:
        """How many equations it takes: parameters, or those that can be told with the instrument's
        own unknowns.
        """
        own = self.space.own.shape[1] - int(np.any(self.units.prior != 0.0, axis=1).sum())
        return max(len(self.free), int(self.seen.rank[0]) + max(own, 0))

    @property
    def fewest(self) -> int:
        """Units that give as many equations as there are unknowns."""
        return max(-(-(self.unknown - self.equations) // self.units.rows.shape[1]), 1)

    def require_equations(self, n: int) -> None:
        """Refuse n units that give fewer equations than there are unknowns.

        Raises
        ------
        EstimationError
            With the number of poses that it takes.
        """
        r, k, p = self.units.rows.shape[1], self.poses_in_unit, len(self.free)
        if n < self.fewest:
            least, needed = self.fewest * k, self.unknown
            also = f" and {self.equations} were measured already" if self.equations else ""
            raise EstimationError(
                f"{n * k} poses give {n * r} equations{also}, but there are {needed} unknowns ({p} "
                "parameters of "
                f"{self.free.robot.name}, the others of the instrument); plan at least {least} "
                "poses, or fix parameters in the "
                "robot file"
            )


def problem(
    robot: Mechanism,
    instrument: Instrument,
    constraints: Constraints | None = None,
    poses: FloatArray | None = None,
    measured: Measurements | None = None,
    count: int = 1000,
    seed: int = 1,
    taken: Sequence[str] = (),
) -> Problem:
    """Make a planning problem ready.

    Parameters
    ----------
    robot : at the values that are believed now; its free parameters and tolerances.
    instrument : what will measure, with its noise. constraints : what poses must keep to.
    poses : (n, c) controlled coordinates that are allowed [m, rad]; default: about `count` drawn
        from the workspace.
    measured : measurements that were made already; the instrument is taken to be set up anew after
        them.
    taken : names that new poses may not get, beside those of `measured`, such as of poses held out
        there.

    Errors are predicted for PREDICTED poses drawn evenly from the workspace within the machine's
    own limits, wherever `constraints` allow to measure; of given poses, for as many of them drawn
    at random.

    Raises
    ------
    EstimationError
        The robot has no free parameter, or this instrument tells nothing of those there are.
    MechanismError, DataError
        See `candidates`, `considered`.
    """
    free = select_free_parameters(robot)
    if not len(free):
        raise EstimationError(
            f"there is nothing to plan for: {robot.name} has no free parameter; free one in its "
            "file"
        )
    if any(sensor.rows is not None for sensor in instrument.sensors):
        raise DataError(
            "an instrument for planning looks at every pose; leave out the rows of its sensors"
        )
    if any(
        set(np.unique(label)) != {""} for s in instrument.sensors for label in (s.session, s.group)
    ):
        raise DataError(
            "an instrument for planning is set up once; leave out sessions and groups of its "
            "sensors"
        )
    rng = np.random.default_rng(seed)
    found = (
        candidates(robot, constraints, count, rng)
        if poses is None
        else listed_candidates(robot, poses, constraints)
    )
    mounted = instrument.with_tool(robot)
    units = considered(free, mounted, found.solution.q, rng)
    told = knowable(free, units)
    if not told.singular_values.max(initial=0.0) > NOTHING:
        kinds = ", ".join(sensor.kind.name for sensor in mounted.sensors)
        raise EstimationError(
            f"an instrument of kind {kinds} tells nothing of the {len(free)} free parameters of "
            f"{robot.name} at any of "
            f"{len(found)} poses; choose another kind"
        )
    known, given = (None, 0) if measured is None else _known(free, measured)
    seen = told if known is None else knowable(free, units, known)
    wanted = predicted(free, _to_predict(found, poses, seed), seen)
    names = tuple(dict.fromkeys([*(() if measured is None else measured.labels), *taken]))
    return Problem(
        free, mounted, found, units, start_of(free, units, known), seen, wanted, given, names
    )


def _known(free: FreeParameters, measured: Measurements) -> tuple[FloatArray, int]:
    """Return the factor (p, p) of measurements made already, and how many equations they leave for
    the robot.
    """
    robot = free.robot
    check_actuators(measured, robot)
    if not measured.n_rows:
        raise DataError(
            "what is said to be measured already holds no measured value; fill it in, or leave it "
            "out"
        )
    factor, reached = information(free, measured)
    if not reached.all():
        lost = measured.labels[int(np.flatnonzero(~reached)[0])]
        raise DataError(
            f"{robot.name} does not reach the measured pose {lost!r} with the readings given "
            "there; correct the readings, "
            "or plan with the calibrated robot file"
        )
    table = measured.nuisance_parameters.table
    own = int((table.free & np.isnan(table.tolerance)).sum())
    return factor[0, :-1, :-1], max(equations(robot, measured) - own, 0)


def _to_predict(found: Candidates, poses: FloatArray | None, seed: int) -> Solution:
    """Return the poses whose errors are predicted; they depend neither on constraints nor on the
    candidates drawn.
    """
    robot = found.rules.robot
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    if poses is None:
        return sample_workspace(robot, PREDICTED, rng).solution
    listed = np.unique(poses, axis=0)
    solution = inverse(robot, listed)
    bare = replace(found.rules, constraints=Constraints(min_margin=0.0))
    reached = np.flatnonzero(bare.judge(solution).allowed)
    return solution.take(np.sort(rng.permutation(reached)[:PREDICTED]))
