# SPDX-License-Identifier: Apache-2.0
"""Estimated poses and true readings after a fit of uncertain readings, and doubts about them.

Rows at the platform do not distinguish the ways in which a limb bends to one pose, and they do not
know end stops. A reading that was not taken is therefore reported where its estimate lies outside
the stroke or on another branch than home's, so that nobody takes it for a measured one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any, NamedTuple

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import fix_all
from loopcal.estimate.linearization import LinearizedPoses, PoseEstimates
from loopcal.estimate.observation_rows import list_rows
from loopcal.estimate.pose_rows import PoseSearch
from loopcal.estimate.problem import Problem, make_exact_problem, problem_of
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.geometry import wrap_angle
from loopcal.measure.data_checks import find_outside_strokes
from loopcal.measure.initial_values import guess_nuisance_values
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.readings import fill_in_reading_sigma
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, forward, inverse, make_solution
from loopcal.numerics.gauss_newton import Halving
from loopcal.parameters import ParameterTable
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

SAME_READING = 1e-6
"""Difference of readings, as a share of the robot's size or in radians, up to which they are the
same solution: above rounding."""

UNEVEN = 1e9
"""Ratio of standard deviations beyond which the rows of larger sigma drown in the rounding of the
others."""


@dataclass(frozen=True, eq=False)
class EstimatedPoses:
    """Poses where the machine stood, by all that was measured there and the identified machine.

    labels : (n,). poses : (n, 4, 4) T_base_platform [m], NaN where not reached or excluded.
    readings : (n, actuators) [SI], the true ones, NaN where excluded.
    sigma : (n, actuators) [SI] of the recorded ones: 0 exact, infinite not taken or not believed.
    kept : (n,) poses that were not excluded.
    is_undetermined : (n,) poses of these that the data do not determine in some direction; they
        stand where the search began.
    is_converged : whether the search for the poses converged.
    """

    labels: tuple[str, ...]
    poses: FloatArray
    readings: FloatArray
    sigma: FloatArray
    kept: BoolArray
    is_undetermined: BoolArray
    is_converged: bool

    def report(self) -> tuple[Finding, ...]:
        """Return what is not known of the poses."""
        findings = []
        if self.is_undetermined.any():
            names = [*compress(self.labels, self.is_undetermined)]
            findings.append(report_finding("poses.undetermined", poses=names, n=len(names)))
        if not self.is_converged:
            findings.append(report_finding("poses.not-converged"))
        return tuple(findings)

    def to_dict(self) -> dict[str, Any]:
        """Return numbers of readings by how they were believed, for JSON.

        Excluded poses are not counted. The arrays are in `arrays`.
        """
        sigma = self.sigma[self.kept]
        return {
            "exact": int((sigma == 0.0).sum()),
            "uncertain": int(((sigma > 0.0) & np.isfinite(sigma)).sum()),
            "not_taken": int(np.isinf(sigma).sum()),
            "open": [*compress(self.labels, self.is_undetermined)],
            "calm": self.is_converged,
        }

    def arrays(self) -> dict[str, FloatArray]:
        """Return the arrays by name [SI], for the run folder."""
        return {"pose_estimate": self.poses, "reading_estimate": self.readings}


def estimate_poses(
    estimates: PoseEstimates, data: Measurements, drop: Sequence[str] = ()
) -> EstimatedPoses:
    """Return the estimated poses of measurements (one trial), nothing of the labels `drop`."""
    kept = ~np.isin(data.labels, drop)
    known = estimates.is_reached[0] & kept
    T = np.where(known[:, None, None], estimates.states.state.T[0], np.nan)
    readings = np.where(kept[:, None], estimates.states.q[0], np.nan)
    sigma = np.zeros(data.readings.shape) if data.reading_sigma is None else data.reading_sigma
    return EstimatedPoses(
        labels=data.labels,
        poses=T,
        readings=readings,
        sigma=sigma,
        kept=kept,
        is_undetermined=estimates.is_undetermined[0] & known,
        is_converged=bool(estimates.is_converged[0]),
    )


def report_doubtful_readings(robot: Mechanism, poses: EstimatedPoses) -> tuple[Finding, ...]:
    """Return estimated readings outside their stroke, or on another branch than home's.

    `robot` is the identified one.
    """
    known = np.asarray(np.isfinite(poses.poses).all(axis=(1, 2)) & ~poses.is_undetermined)
    estimated = np.isinf(poses.sigma) & known[:, None]
    outside = estimated & (find_outside_strokes(poses.readings, robot) > 0.0)
    beside = estimated & _is_on_other_branch(robot, poses, np.asarray(estimated.any(axis=1)))
    findings = []
    for code, chosen in (("poses.outside-stroke", outside), ("poses.other-branch", beside)):
        readings = []
        for pose, column in np.argwhere(chosen):
            actuator = robot.actuators[column]
            value = robot.to_quantity(float(poses.readings[pose, column]), actuator.dimension)
            readings.append({"actuator": actuator.name, "pose": poses.labels[pose], "value": value})
        if readings:
            findings.append(report_finding(code, readings=readings))
    return tuple(findings)


def report_uneven_sigmas(problem: Problem) -> tuple[Finding, ...]:
    """Return whether the sigmas of all rows differ by more than rounding bears.

    They are compared in sizes of the robot and in radians.
    """
    robot = problem.free.robot
    least, most, name = np.inf, 0.0, ""
    for rows in problem.rows:
        weight = np.einsum("trii->tri", rows.whitener)
        for i, column in enumerate(rows.kind.noise_columns):
            present = weight[..., i][weight[..., i] > 0.0]
            if len(present) and column.dimension in (Dimension.LENGTH, Dimension.ANGLE):
                scale = robot.size if column.dimension is Dimension.LENGTH else 1.0
                most = max(most, 1.0 / (present.min() * scale))
                if 1.0 / (present.max() * scale) < least:
                    least = 1.0 / (present.max() * scale)
                    name = f"{rows.kind.name} {column.name}"
    if most <= UNEVEN * least:
        return ()
    return (report_finding("poses.uneven-sigmas", ratio=most / least, smallest=name),)


def _is_on_other_branch(robot: Mechanism, poses: EstimatedPoses, chosen: BoolArray) -> BoolArray:
    """Return readings (n, actuators) that differ from those of home's branch at the same pose."""
    other = np.zeros(poses.readings.shape, dtype=bool)
    if chosen.any():
        home = inverse(robot, poses.poses[chosen])
        gap = poses.readings[chosen] - home.q
        turning = np.array([a.dimension is Dimension.ANGLE for a in robot.actuators])
        size = np.where(turning, 1.0, robot.size)
        gap = np.abs(np.where(turning, wrap_angle(gap), gap)) / size
        other[chosen] = home.closed[:, None] & (gap > SAME_READING)
    return other


SAME_RATIO = 1e-9
"""Relative difference of sigma ratios below which a pose's readings are weighted as the robot
states."""


def predict_from_readings(robot: Mechanism, data: Measurements) -> tuple[Solution, BoolArray]:
    """Return the poses of all readings, and which of them (n,) the readings determine that were
    taken and are believed. Raises DataError where a redundant reading is stated to be exact.
    """
    if robot.redundancy is not None:
        data = fill_in_reading_sigma(robot, data)
    sigma = data.reading_sigma
    if robot.redundancy is None or sigma is None:
        known = np.ones(data.n_poses, dtype=bool)
        if sigma is not None:
            known = np.asarray(np.isfinite(sigma).all(axis=1))
        return forward(robot, data.readings), known
    ratio = sigma[:, robot.is_commanded] / np.array(robot.redundancy)
    if np.isfinite(ratio).all() and np.ptp(ratio, axis=1).max() <= SAME_RATIO * ratio.min():
        solution = forward(robot, data.readings)
        if solution.converged.all():
            return solution, np.ones(data.n_poses, dtype=bool)
    # also readings that contradict each other by more than forward kinematics accept
    located = fit_poses(robot, data)
    return located.solution, located.is_determined


class PoseFit(NamedTuple):
    """Poses of a robot where readings and rows fit best.

    solution : of n poses. is_determined : (n,) poses that the data determine.
    absorbed : (n,) number of residuals of rows that each pose takes up, which are its unknowns less
        its recorded uncertain readings; poses that rows link are counted at the first of them.
    left : (n,) number of residuals of its linked poses that are left.
    reading_residuals : (n, actuators) true minus recorded readings in units of their sigma, zero
        where exact or not taken.
    """

    solution: Solution
    is_determined: BoolArray
    absorbed: IntArray
    left: IntArray
    reading_residuals: FloatArray


def fit_poses(
    robot: Mechanism, data: Measurements, nuisance: NuisanceParameters | None = None
) -> PoseFit:
    """Return the poses where uncertain readings and all rows fit best at this geometry.

    Of `nuisance` those without fixed values are fitted as well. None leaves the rows out: readings
    alone locate the poses. Raises DataError where a redundant reading is stated to be exact.
    """
    data = fill_in_reading_sigma(robot, data)
    if nuisance is None:
        data = replace(data, observations=())
        nuisance = NuisanceParameters(ParameterTable(()), ())
    problem, z = problem_of(fix_all(robot), data, nuisance), np.zeros((1, 0))
    fitted = problem.solve(z, problem.start(z))
    estimates = fitted.estimates
    assert estimates is not None
    states, member = estimates.states, problem.poses.member
    assert data.reading_sigma is not None
    uncertain = (np.isfinite(data.reading_sigma) & (data.reading_sigma > 0.0)).sum(axis=1)
    first = np.unique(member, return_index=True)[1]
    absorbed = np.zeros(data.n_poses, dtype=np.int64)
    absorbed[first] = np.maximum(estimates.rank[0] - np.bincount(member, uncertain), 0)
    return PoseFit(
        make_solution(robot, states.state, states.q[0]),
        ~estimates.is_undetermined[0],
        absorbed,
        (problem.poses.component_count[0] - estimates.rank[0])[member],
        problem.residuals(z, fitted)[-1].whitened[0],
    )


NUISANCE_CONTROL = Halving(absolute=1e-6)


def fit_nuisance_values(
    robot: Mechanism,
    data: Measurements,
    T: FloatArray,
    nuisance: NuisanceParameters | None = None,
    joints: Mapping[str, FloatArray] | None = None,
) -> FloatArray:
    """Return values (U,) of the nuisance parameters that fit the measurements at given poses.

    T : (n, 4, 4) T_base_platform of each pose, usually of the nominal robot at the readings.
    nuisance : with priors and fixed values; default: `data.nuisance_parameters`.
    joints : name -> (1, n) of joints that kinds sense.
    DataError : the poses are too few or too similar to determine a parameter.
    """
    own = data.nuisance_parameters if nuisance is None else nuisance
    if not own.table.free.any():
        return own.values()
    measured = [o.measured[None] for o in data.all_observations]
    begin = guess_nuisance_values(data, measured, T[None], own)
    readings, rows, z = data.readings[None], list_rows(data, own), np.zeros((1, 0))
    poses = make_exact_problem(fix_all(robot), readings, rows, 1, own, lambda _: data).poses
    located = [
        LinearizedPoses(
            T[None, of],
            np.ones((1, len(of)), dtype=bool),
            np.zeros((1, len(of), 6, 0)),
            {name: value[:, of] for name, value in (joints or {}).items()},
        )
        for of in (block.poses for block in poses.blocks)
    ]
    search = PoseSearch(poses, z, np.zeros(1, dtype=np.int64), True, located)
    found = search.minimize(None, begin, NUISANCE_CONTROL)[0].nuisance
    assert found is not None
    return found[0]


def refuse_unreached(data: Measurements, lost: IntArray) -> None:
    """Refuse measurements with poses (k,) that a robot does not reach, if there are any."""
    if len(lost):
        names, total = tuple(data.labels[i] for i in lost), data.n_poses
        found = {"count": len(names), "total": total, "poses": names}
        raise EstimationError.of("fit.poses-out-of-reach", **found)


MOST = 0.5
"""Share of open poses above which a geometry is not one to begin with."""


class UnclosedPoses(NamedTuple):
    """Poses at which the loops do not close with their readings.

    poses : their labels, the widest open first. gaps : what is left open in the loops.
    total : number of poses with all readings.
    """

    poses: tuple[str, ...]
    gaps: tuple[Quantity, ...]
    total: int

    @property
    def are_most(self) -> bool:
        """Whether more than a share `MOST` of the poses is open."""
        return len(self.poses) > MOST * self.total

    def report(self, code: str) -> Finding:
        """Return the finding or error of this code, with poses and gaps."""
        return report_finding(
            code, count=len(self.poses), total=self.total, poses=self.poses, gaps=self.gaps
        )


def find_unclosed_poses(robot: Mechanism, data: Measurements) -> UnclosedPoses:
    """Return the poses of measurements whose redundant readings do not close the loops of a robot.

    Poses with a missing reading are not tested, and robots with as many actuators as freedoms have
    none: a pose that they do not reach is refused by `refuse_start`.
    """
    if robot.redundancy is None:
        return UnclosedPoses((), (), data.n_poses)
    used = np.flatnonzero(np.isfinite(data.readings).all(axis=1))
    if not len(used):
        return UnclosedPoses((), (), 0)
    solution = forward(robot, data.readings[used])
    is_open = np.flatnonzero(~solution.converged)
    gaps = solution.residual[is_open]
    order = np.argsort(-np.where(np.isfinite(gaps), gaps, np.inf), kind="stable")
    labels = tuple(data.labels[i] for i in used[is_open[order]])
    return UnclosedPoses(labels, tuple(map(robot.describe_gap, gaps[order].tolist())), len(used))
