# SPDX-License-Identifier: Apache-2.0
"""A planning problem: candidates, their rows, the prior, and the prediction that a plan improves.

The prediction is the pose of the tool all over the workspace, with its errors

    d tool = (size * rotation, displacement)      [m]

in a stated frame, see `loopcal.diagnose.error_frames`: after the best rigid fit of the base and
platform frames as far as no measurement of this instrument determines them. A plan states which
error, root mean square over the workspace, a share of machines stays below. Derivations:
docs/theory/observability.md, docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from loopcal.apply.accuracy import transport
from loopcal.diagnose import error_frames
from loopcal.errors import DataError, EstimationError
from loopcal.estimate import information
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.posterior import SAME_MOTION
from loopcal.estimate.problem import problem_of
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.measure.data_checks import check_actuators, check_closure
from loopcal.measure.instrument import Instrument
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.decomposition import Decomposition, are_nonzero, intersect_spaces
from loopcal.numerics.statistics import compute_weighted_quantile
from loopcal.planning import design_space, pose_groups
from loopcal.planning.candidates import Candidates, check_listed_poses, draw_candidates
from loopcal.planning.constraints import N_POSES, Constraints, PlanOptions, Target
from loopcal.planning.exchange import Design, compute_design_curve, find_smallest_design
from loopcal.results.description import Field, fields
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress
from loopcal.units import Dimension

# Poses of the workspace whose errors are predicted. They stand for all: with 200, plans of few
# poses were better at these than elsewhere by up to 10 %.
PREDICTED = 2000
# Largest singular value, in information per spread, up to which an instrument determines
# nothing: the rest is rounding.
NO_INFORMATION = 1e-6
# Share of a pose's error up to which its position or orientation does not change at all: the rest
# is rounding.
NO_MOTION = 1e-9
DIMENSIONS: dict[Target, Dimension] = {  # of the error of each target
    "pose": Dimension.LENGTH,
    "position": Dimension.LENGTH,
    "orientation": Dimension.ANGLE,
}


@dataclass(frozen=True, eq=False)
class Prediction:
    """Derivatives of the tool's pose at k poses of the workspace."""

    rotations: FloatArray  # (k, 3, p) derivatives of its rotation [rad per spread]
    displacements: FloatArray  # (k, 3, p) derivatives of its displacement [m per spread]
    size: float  # makes rotations comparable with displacements [m]
    frame: error_frames.ErrorFrame  # in which errors are stated

    def __len__(self) -> int:
        return len(self.displacements)

    # The triangular factors have the same squares as their rows, and fewer of them.

    @cached_property
    def position(self) -> FloatArray:
        """Factor (q, p) of the rows of all positions [m]."""
        return design_space.factor_rows(self.displacements.reshape(-1, self.displacements.shape[2]))

    @cached_property
    def orientation(self) -> FloatArray:
        """Factor (q, p) of the rows of all orientations [rad]."""
        return design_space.factor_rows(self.rotations.reshape(-1, self.rotations.shape[2]))

    @cached_property
    def pose(self) -> FloatArray:
        """Factor (q, p) of the rows of all poses [m], rotations times size."""
        return design_space.factor_rows(
            np.concatenate([self.size * self.orientation, self.position])
        )


def linearize_prediction(
    free: FreeParameters, solution: Solution, unfixed: FloatArray, frame: str = error_frames.FITTED
) -> Prediction:
    """Return how the tool's pose depends on the parameters, in a frame of `PlanOptions`.

    solution : the poses to predict. unfixed : (12, k) motions of frames that the measurements will
        not determine; "fitted" is after the best rigid fit of them over the poses to predict.
    """
    poses = information.observe_poses(free, solution.q)
    T, twists = poses.T[0, poses.is_reached], poses.twists[0, poses.is_reached]
    followed = None
    if frame == error_frames.RELATIVE:
        home = information.observe_poses(free, error_frames.solve_home(free.robot).q)
        own = np.zeros((6, 0))
        followed = error_frames.follow_pose(
            free.robot, home.T[0, 0], home.twists[0, 0], own, "home"
        )
    chosen = error_frames.refer_errors(
        free.robot, frame, error_frames.ReferencePoses(T, twists, "predicted"), unfixed, followed
    )
    if chosen.undetermined and free.assumed.any():
        missing = int(free.assumed.sum())
        raise EstimationError.of(
            "plan.frame-unbounded", frames=chosen.undetermined, missing=missing
        )
    kept = transport(free.robot, T, "base", "tool") @ chosen.relate(twists, T)
    return Prediction(kept[:, :3], kept[:, 3:], free.robot.size, chosen)


ROUNDING = 1e-9
"""Share of the pose error up to which an error in position or orientation is none."""


@dataclass(frozen=True, eq=False)
class ExpectedErrors:
    """Errors of the tool, root mean square over the workspace: what a share of machines ends below,
    and the root mean square of all machines.
    """

    share: float  # of machines whose own error is at most
    position: float  # [m]
    orientation: float  # [rad]
    pose: float  # [m], rotations times the robot's size
    position_rms: float = field(repr=False)  # of all machines together [m]
    orientation_rms: float = field(repr=False)  # [rad]
    pose_rms: float = field(repr=False)  # [m]

    def select(self, target: Target) -> float:
        """Return the error of a target that the share of machines stays below [m, rad]."""
        return float(getattr(self, target))

    def to_quantities(self, robot: Mechanism) -> tuple[Quantity, ...]:
        """Return the errors of the share above rounding in the units of the robot's file."""
        pairs = ((self.position, Dimension.LENGTH), (self.orientation, Dimension.ANGLE))
        return tuple(
            robot.to_quantity(value, dimension)
            for (value, dimension), arm in zip(pairs, (1.0, robot.size), strict=True)
            if arm * value > ROUNDING * self.pose
        )


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """Everything that a choice of poses depends on."""

    free: FreeParameters  # the robot's free parameters
    instrument: Instrument  # mounted on its tool
    options: PlanOptions  # of the plan
    candidates: Candidates  # poses that may be measured
    groups: pose_groups.GroupRows  # their rows
    prior: design_space.PriorInformation  # information before the first new pose
    observable: Decomposition  # decomposition of all candidates together, without spreads
    prediction: Prediction  # of the tool's pose over the workspace
    n_earlier_equations: int = 0  # of measurements made already, less their own nuisance parameters
    used_names: tuple[str, ...] = ()  # names of poses that were measured already

    @property
    def robot(self) -> Mechanism:
        """The robot at its present values."""
        return self.free.robot

    @cached_property
    def space(self) -> design_space.ObservableSpace:
        """The directions in which designs are compared."""
        return design_space.find_observable_space(self.groups.rows, self.prior)

    @property
    def poses_per_group(self) -> int:
        """Number of poses that are measured together."""
        return self.groups.members.shape[1]

    @property
    def counted(self) -> str:
        """Plural noun for the groups: poses, pairs or sets of k poses."""
        return name_groups(self.poses_per_group)

    @property
    def n_candidates(self) -> int:
        """Number of groups that may be chosen."""
        return int(design_space.is_allowed(self.groups.rows).sum())

    @cached_property
    def n_unknowns(self) -> int:
        """Number of equations needed: one for each direction that candidates and earlier
        measurements determine and for each setup parameter without a prior, and one to spare where
        these are not all parameters, which shows that more poses would not determine more.
        """
        known = self.groups.nuisance_prior
        length = np.linalg.norm(known, axis=0)
        s = np.linalg.svd(known / np.where(length > 0.0, length, 1.0), compute_uv=False)
        stated = int(are_nonzero(s).sum()) if s.size else 0
        nuisance = max(self.space.nuisance.shape[1] - stated, 0)
        rank = int(self.observable.rank[0])
        return rank + nuisance + int(rank < len(self.free))

    @property
    def min_groups(self) -> int:
        """Smallest number of groups that give as many equations as there are unknowns."""
        missing = self.n_unknowns - self.n_earlier_equations
        return max(-(-missing // self.groups.rows.shape[1]), 1)

    def build_criterion(self, name: str | None = None) -> design_space.Criterion:
        """Return criterion D, or I for the target; by default the criterion of the options."""
        name, target = name or self.options.criterion, self.options.target
        if name == "D":
            return design_space.Criterion("D")
        rows, scale = getattr(self.prediction, target), 1.0
        if target == "orientation":
            scale = self.prediction.size
        largest = float(np.abs(self.prediction.pose).max(initial=0.0))
        if target != "pose" and not scale * np.abs(rows).max(initial=0.0) > NO_MOTION * largest:
            raise EstimationError.of(
                "plan.target-unobservable", robot=self.robot.name, target=target
            )
        return design_space.Criterion("I", rows, len(self.prediction))

    def pose_design(
        self, rows: FloatArray | None = None, name: str | None = None
    ) -> design_space.DesignProblem:
        """Return the choice of groups by a criterion of this name; by default from all rows."""
        rows = self.groups.rows if rows is None else rows
        return design_space.DesignProblem(
            rows, self.build_criterion(name), self.prior, counted=self.counted
        )

    def predict_errors(self, chosen: IntArray, noise: float = 1.0) -> ExpectedErrors | None:
        """Return the errors expected after measuring groups (n,) with so many times the stated
        noise; None if unbounded.
        """
        if len(chosen):
            factor = design_space.factor_design(
                self.groups.rows[chosen] / noise, self.prior, self.space
            )
        else:
            # no row of the prior has both nuisance and machine columns, see `combine_prior`
            rows = self.prior.rows[:, self.prior.n_nuisance :] @ self.space.machine
            factor = design_space.factor_square(rows)
        s = np.linalg.svd(factor, compute_uv=False)
        if not design_space.is_full_rank(s):
            return None
        share, errors = self.options.share, dict[str, float]()
        for target in DIMENSIONS:
            L = getattr(self.prediction, target) @ self.space.machine
            s = np.linalg.svd(design_space.divide_by_factor(L, factor), compute_uv=False)
            squares = s**2 / len(self.prediction)  # the error is their sum for unit variances
            errors[target] = float(np.sqrt(compute_weighted_quantile(squares, share)))
            errors[f"{target}_rms"] = float(np.sqrt(squares.sum()))
        return ExpectedErrors(share, **errors)

    def require_equations(self, n: int) -> None:
        """Refuse n groups that give fewer equations than there are unknowns."""
        k = self.poses_per_group
        if n < self.min_groups and not self.options.allow_fewer_equations:
            raise EstimationError.of(
                "plan.too-few-equations",
                robot=self.robot.name,
                poses=n * k,
                equations=n * self.groups.rows.shape[1],
                earlier=self.n_earlier_equations,
                unknowns=self.n_unknowns,
                needed=self.min_groups * k,
            )


def prepare_problem(
    robot: Mechanism,
    instrument: Instrument,
    options: PlanOptions | None = None,
    candidates: Candidates | None = None,
) -> PlanningProblem:
    """Return the planning problem of a robot, at its present values, and an instrument.

    candidates : poses to choose from; by default those of the options, drawn or listed.

    Errors are predicted for PREDICTED poses drawn evenly from the workspace within the machine's
    own limits, wherever the constraints allow measuring. With allowed poses in the options, they
    are predicted for as many of these, drawn at random.
    """
    options = options or PlanOptions()
    free = select_free_parameters(robot)
    if not len(free):
        raise EstimationError.of("plan.no-free-parameter", robot=robot.name)
    _require_plain_sensors(instrument)
    check_closure(robot, [sensor.kind for sensor in instrument.sensors], None, 1)
    rng = np.random.default_rng(options.seed)
    if candidates is None and options.allowed_poses is not None:
        candidates = check_listed_poses(robot, options.allowed_poses, options.constraints)
    elif candidates is None:
        candidates = draw_candidates(robot, options.constraints, options.n_candidates, rng)
    mounted, measured = instrument.with_tool(robot), options.measured
    groups = pose_groups.linearize_candidate_groups(free, mounted, candidates.solution.q, rng)
    observable = pose_groups.decompose_information(groups)
    if not observable.singular_values.max(initial=0.0) > NO_INFORMATION:
        raise EstimationError.of(
            "plan.nothing-observable",
            robot=robot.name,
            kinds=tuple(sensor.kind.name for sensor in mounted.sensors),
            parameters=len(free),
            poses=len(candidates),
        )
    earlier, n_equations, labels = None, 0, ()
    to_predict = _select_predicted(candidates, options)
    unfixed = pose_groups.find_group_motions(free, mounted, candidates.solution.q, groups.members)
    if measured is not None:
        earlier, n_equations = _fold_measured(free, measured)
        observable, labels = pose_groups.decompose_information(groups, earlier), measured.labels
        problem, z = problem_of(free, measured), free.deviation(robot.values[None])
        found = information.find_unfixed_motions(problem, z, problem.start(z))
        still_open = unfixed[:, :0] if found is None else found.motions
        unfixed = intersect_spaces(unfixed, still_open, SAME_MOTION)
    return PlanningProblem(
        free,
        mounted,
        options,
        candidates,
        groups,
        pose_groups.combine_prior(free, groups, earlier),
        observable,
        linearize_prediction(free, to_predict, unfixed, options.frame),
        n_equations,
        tuple(dict.fromkeys([*labels, *options.used_names])),
    )


def name_groups(poses_per_group: int) -> str:
    """Return the plural noun for groups of so many poses."""
    return {1: "poses", 2: "pairs"}.get(poses_per_group, f"sets of {poses_per_group} poses")


def _require_plain_sensors(instrument: Instrument) -> None:
    """Refuse sensors that measure some poses only, or in sessions or groups, and an instrument that
    measures nothing but the base.
    """
    if all(sensor.kind.is_of_base for sensor in instrument.sensors):
        raise DataError(
            "the instrument only measures targets on the base, which no choice of poses changes. "
            "Add what it measures of the platform"
        )
    if any(sensor.rows is not None for sensor in instrument.sensors):
        raise DataError(
            "an instrument for planning measures every pose. Leave out the rows of its sensors"
        )
    if any(
        set(np.unique(label)) != {""} for s in instrument.sensors for label in (s.session, s.group)
    ):
        raise DataError(
            "an instrument for planning has one set-up. Leave out sessions and groups of its "
            "sensors"
        )


def _fold_measured(free: FreeParameters, measured: Measurements) -> tuple[FloatArray, int]:
    """Return the factor (p, p) of earlier measurements, and how many equations the robot gets."""
    robot = free.robot
    check_actuators(measured, robot)
    if not any(rows.is_measured.any() for rows in measured.observations):
        raise DataError.of("plan.measured-empty")
    factor, reached = information.collect_information(free, measured)
    if not reached.all():
        label = measured.labels[int(np.flatnonzero(~reached)[0])]
        raise DataError.of("plan.measured-pose-unreachable", robot=robot.name, pose=label)
    table = measured.nuisance_parameters.table
    nuisance = int((table.free & np.isnan(table.tolerance)).sum())
    n_equations = max(information.count_equations(robot, measured) - nuisance, 0)
    return factor[0, :-1, :-1], n_equations


def _select_predicted(candidates: Candidates, options: PlanOptions) -> Solution:
    """Return the poses to predict; they do not depend on constraints and candidates."""
    robot = candidates.checker.robot
    rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(2,)))
    if options.allowed_poses is None:
        return sample_workspace(robot, PREDICTED, rng).solution
    solution = inverse(robot, np.unique(options.allowed_poses, axis=0))
    machine = replace(candidates.checker, constraints=Constraints(min_margin=0.0))
    reached = np.flatnonzero(machine.check_poses(solution).allowed)
    return solution.take(np.sort(rng.permutation(reached)[:PREDICTED]))


# Number of poses: expected errors by number, and the smallest number that reaches a goal.

SIZES = 6  # numbers of poses on a curve
RANGE = 4  # a curve goes from the smallest number to this many times the requested one
MOST = 400  # largest number of poses for a goal: more is over a day's work
PERTURBATIONS = 4  # number of perturbations of each design of a curve


@dataclass(frozen=True, eq=False)
class ErrorCurve:
    """Expected errors by the number of poses, or of pairs where poses are compared."""

    numbers: IntArray  # (k,) of poses or pairs, ascending
    expected: tuple[ExpectedErrors, ...]  # errors after measuring a good design of each number
    target: Target  # the error that the designs make small
    # values, rms, bounds: (k,) that error of the share of machines [m, rad], that of all machines,
    # and the smallest of the latter that any choice of so many candidates can have
    values: FloatArray
    rms: FloatArray
    bounds: FloatArray
    goal: float | None = None  # error [m, rad] that the share is to stay below, or None
    enough: int | None = None  # smallest of the numbers that reaches the goal
    at_least: int | None = None  # no smaller number of candidates has so small an rms as `enough`
    counted: str = "poses"  # plural noun for what the numbers count
    n_candidates: int = 0  # number of candidate poses or pairs

    def report(self, robot: Mechanism) -> Finding:
        """Return the result of the curve: the number that reaches the goal, or all errors."""
        if self.goal is None:
            points = tuple(
                {"number": n, "errors": errors.to_quantities(robot)}
                for n, errors in zip(self.numbers.tolist(), self.expected, strict=True)
            )
            return report_finding(
                "plan.error-curve", share=self.share, counted=self.counted, points=points
            )
        return report_finding(
            "plan.goal-reached",
            share=self.share,
            number=self.enough,
            counted=self.counted,
            target=self.target,
            goal=robot.to_quantity(self.goal, DIMENSIONS[self.target]),
            at_least=self.at_least,
            candidates=self.n_candidates,
            decided_by_equations=bool(self.enough == self.numbers[0]),
        )

    @property
    def share(self) -> float:
        """The share of machines that stay below `values`."""
        return self.expected[0].share

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("target", "share", "counted", "n_candidates", "numbers"),
        position="expected.position",
        orientation="expected.orientation",
        **dict.fromkeys(("values", "rms", "bounds", "goal", "enough", "at_least"), ""),
    )


def compute_error_curve(
    problem: PlanningProblem, progress: Progress = report_no_progress
) -> ErrorCurve:
    """Return expected errors from the smallest number of poses to RANGE times the requested one."""
    k, count, options = problem.poses_per_group, problem.n_candidates, problem.options
    requested = options.n_poses or N_POSES
    last = min(max(RANGE * requested // k, 2 * problem.min_groups), count)
    first = min(problem.min_groups, last)
    sizes = np.geomspace(first, last, SIZES).round().astype(int)
    sizes = np.append(sizes, min(max(requested // k, first), last)).tolist()
    design = problem.pose_design(name="I")
    designs = compute_design_curve(design, sizes, options.seed, PERTURBATIONS, progress)
    return _convert_curve(problem, designs)


def find_sample_size(
    problem: PlanningProblem, progress: Progress = report_no_progress
) -> ErrorCurve:
    """Return the smallest number of poses that reaches the goal of the options, with the expected
    errors from the smallest number to twice that one.

    Designs have the smallest mean square over machines, whose root the error of the share exceeds.
    """
    options, robot = problem.options, problem.robot
    target, goal, dimension = options.target, options.goal, DIMENSIONS[options.target]
    assert goal is not None, "the caller has a goal"
    if not goal > 0.0 or not np.isfinite(goal):
        raise EstimationError(
            f"the accuracy goal is {robot.to_quantity(goal, dimension)}. Give a number above 0 "
            "with its unit, such as 20um"
        )
    design, count = problem.pose_design(name="I"), problem.n_candidates
    most = min(MOST // problem.poses_per_group, count)
    problem.require_equations(most)

    def evaluate(chosen: IntArray) -> float:
        errors = problem.predict_errors(chosen)
        return np.inf if errors is None else errors.select(target) ** 2

    try:
        best, at_least = find_smallest_design(
            design, goal**2, most, options.seed, PERTURBATIONS, evaluate
        )
    except EstimationError as error:
        if error.code not in ("plan.target-impossible", "plan.target-not-reached"):
            raise
        (last,) = compute_design_curve(design, [most], options.seed, 0)
        reached, bound = (np.sqrt(v) for v in (evaluate(last.chosen), last.relaxed.bound))
        raise EstimationError.of(
            "plan.goal-unreachable",
            share=options.share,
            target=target,
            goal=robot.to_quantity(goal, dimension),
            number=most,
            counted=problem.counted,
            candidates=count,
            best=robot.to_quantity(float(reached), dimension),
            bound=robot.to_quantity(float(bound), dimension),
        ) from None
    n = max(len(best.chosen), problem.min_groups)
    others = np.geomspace(problem.min_groups, min(2 * n, count), SIZES - 1).round().astype(int)
    sizes = np.append(others, n).tolist()
    curve = compute_design_curve(design, sizes, options.seed, PERTURBATIONS, progress)
    # the design of the search, where that of the curve is less good
    size = len(best.chosen)
    designs = [
        best if len(made.chosen) == size and best.value <= made.value else made for made in curve
    ]
    return replace(_convert_curve(problem, designs), goal=goal, enough=n, at_least=at_least)


def _convert_curve(problem: PlanningProblem, designs: list[Design]) -> ErrorCurve:
    """Return designs by their mean variance as a curve of errors."""
    target, expected = problem.options.target, []
    for made in designs:
        errors = problem.predict_errors(made.chosen)
        assert errors is not None, "every design determines its errors"
        expected.append(errors)
    bounds = np.array([made.relaxed.bound for made in designs])
    return ErrorCurve(
        np.array([len(made.chosen) for made in designs], dtype=np.int64),
        tuple(expected),
        target,
        np.array([errors.select(target) for errors in expected]),
        np.sqrt([made.value for made in designs]),
        np.sqrt(np.maximum(bounds, 0.0)),
        counted=problem.counted,
        n_candidates=problem.n_candidates,
    )
