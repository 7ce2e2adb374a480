# SPDX-License-Identifier: Apache-2.0
"""Plan which poses to measure, so that the tool is predicted best all over the workspace.

Candidates satisfy every constraint. The convex relaxation gives the bound, exchange the poses. The
validation poses are drawn evenly, and a short path visits all of them. Theory:
docs/theory/planning.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from loopcal.apply.validation import FEW_ROWS
from loopcal.diagnose.gauge_freedoms import interpret_combinations, report_undetermined
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import describe_null_space
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.findings.wording import round_to_digits
from loopcal.measure.instrument import Instrument
from loopcal.measure.kinds.setup_parameters import POSITION_AXES, ROTATION_AXES
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import list_dimensions
from loopcal.mechanism.solutions import inverse
from loopcal.plain_text import represent
from loopcal.planning.candidates import list_steps
from loopcal.planning.constraints import N_POSES, PlanOptions
from loopcal.planning.design_space import Criterion, is_allowed
from loopcal.planning.exchange import EXCHANGES, choose_design
from loopcal.planning.path import locate_home, order_poses
from loopcal.planning.problem import (
    ErrorCurve,
    ExpectedErrors,
    PlanningProblem,
    compute_error_curve,
    find_sample_size,
    name_groups,
    prepare_problem,
)
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import DrawnResult
from loopcal.results.serialization import to_json
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

WEAK = 0.5  # efficiency below which the certificate guarantees little


def round_shortfall(efficiency: float) -> float:
    """Return how far a guaranteed efficiency can be from 1, in per cent, rounded up to 0.1."""
    return float(np.round(100.0 - np.floor(1e3 * efficiency) / 10.0, 1))


@dataclass(frozen=True, eq=False)
class PlannedPoses:
    """Poses in the order of visiting."""

    labels: tuple[str, ...]  # (m,) names
    coordinates: FloatArray  # (m, c) controlled coordinates [m, rad]
    readings: FloatArray  # (m, a) actuator readings to command [m, rad]
    held_out: BoolArray  # (m,) True for validation poses
    via_home: BoolArray  # (m,) True where the path goes via home before the pose
    groups: IntArray  # (u, k) indices of the poses that are measured together
    # from home through all poses [m], rotations times the robot's size
    path_length: float | None = None
    cameras: tuple[str, ...] = ()  # (m,) whose stations they are seen from; () for one

    def __len__(self) -> int:
        return len(self.labels)

    __repr__ = represent

    @property
    def uses(self) -> tuple[str, ...]:
        """(m,) "fit" or "held-out"."""
        return tuple("held-out" if is_held_out else "fit" for is_held_out in self.held_out)

    def to_dicts(self, robot: Mechanism) -> list[dict[str, Any]]:
        """Return for each pose its name, use, command and readings, SI."""
        actuators = [actuator.name for actuator in robot.actuators]
        return [
            {
                "name": label,
                "use": self.uses[i],
                "via_home": bool(self.via_home[i]),
                "commanded": dict(zip(robot.controlled, self.coordinates[i].tolist(), strict=True)),
                "readings": dict(zip(actuators, self.readings[i].tolist(), strict=True)),
            }
            for i, label in enumerate(self.labels)
        ]


@dataclass(frozen=True, eq=False)
class Stop:
    """One stop of the machine: a pose of the plan, or home between two poses."""

    label: str  # of the pose, or "home"
    is_via: bool  # only passed through
    is_held_out: bool  # for validation
    coordinates: FloatArray  # (c,) controlled coordinates [m, rad]
    readings: FloatArray  # (a,) of these coordinates [SI]


@dataclass(frozen=True)
class DesignQuality:
    """Quality of the poses for the fit."""

    figures: Mapping[str, float]  # D, I, A and E, in spreads
    # lower bound on the efficiency relative to the best possible choice: (ratio of
    # determinants)^(1/p) for D, ratio of variances for I
    efficiency: float
    n_candidates: int  # number of candidate groups; the efficiency holds among them


@dataclass(frozen=True)
class ErrorForecast:
    """Expected errors of the tool over the workspace."""

    before: ExpectedErrors | None  # with the prior information only; None where nothing bounds them
    # with as many poses drawn evenly, median of several draws; None where there are too few
    # candidates
    random: ExpectedErrors | None
    after: ExpectedErrors  # with the planned poses
    frame: Finding  # point, axes and frame of these errors

    FIELDS: ClassVar[tuple[Field, ...]] = fields(before="", evenly_drawn="random", after="")


POSE_FIELDS = (
    Field("use", "poses.uses", "pose"),
    Field(
        "commanded",
        "poses.coordinates",
        "pose coordinate",
        units=lambda plan: list_dimensions(plan.robot.controlled),
    ),
    Field("reading", "poses.readings", "pose actuator", units="robot.actuators.dimension"),
)


@dataclass(frozen=True, eq=False)
class Plan(DrawnResult):
    """Poses to measure.

    Attributes
    ----------
    robot : at the values for which the plan was made. instrument : what will measure.
    options : of the plan. poses : in the order of visiting, with `labels`, `coordinates` (m, c) and
        `readings` (m, a) [m, rad], and `held_out` (m,); `simulate` takes `poses.coordinates`.
    quality : of the choice. errors : expected over the workspace.
    notes : findings on assumptions and exclusions.
    curve : expected errors by the number of poses, where requested.
    """

    robot: Mechanism
    instrument: Instrument
    options: PlanOptions
    poses: PlannedPoses
    quality: DesignQuality
    errors: ErrorForecast
    notes: tuple[Finding, ...] = ()
    curve: ErrorCurve | None = None

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(robot="robot.name", kinds="instrument.sensors.kind.name", n_poses=""),
        *fields(criterion="options.criterion", target="options.target", figures="quality.figures"),
        *fields(efficiency="quality.efficiency", n_candidates="quality.n_candidates"),
        *fields(frame=lambda plan: str(plan.errors.frame)),
        *fields(expected=lambda plan: to_json(plan.errors)),
        *fields(path_length="poses.path_length", seed="options.seed"),
        *fields(asked=lambda plan: to_json(plan.options.asked)),
        *fields(poses=lambda plan: plan.poses.to_dicts(plan.robot)),
        *fields(compared=lambda plan: plan.list_compared(), curve=""),
        *fields(notes=lambda plan: list(map(str, plan.notes)), findings=""),
        *POSE_FIELDS,
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(
        pose="poses.labels", coordinate="robot.controlled", actuator="robot.actuators.name"
    )

    @property
    def n_poses(self) -> int:
        """Number of poses for the fit."""
        return int((~self.poses.held_out).sum())

    @property
    def n_groups(self) -> int:
        """Number of groups for the fit."""
        return int((~self.poses.held_out[self.poses.groups].any(axis=1)).sum())

    def list_compared(self) -> list[list[str]]:
        """Return the labels of the poses that are measured together; none for single poses."""
        groups, labels = self.poses.groups, self.poses.labels
        return [[labels[i] for i in group] for group in groups] if groups.shape[1] > 1 else []

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Everything that the plan reports: content, certificate, errors, curve and notes."""
        poses, counted = self.poses, name_groups(self.poses.groups.shape[1])
        curve = () if self.curve is None else (self.curve.report(self.robot),)
        assert poses.path_length is not None, "a plan has a path"
        efficiency = self.quality.efficiency
        what: dict[str, Any] = {"robot": self.robot.name, "poses": len(poses)}
        kinds = (
            f"{kind.name} of targets on the base" if kind.is_of_base else kind.name
            for kind in (sensor.kind for sensor in self.instrument.sensors)
        )
        what["kinds"] = tuple(dict.fromkeys(kinds))
        path = report_finding(
            "plan.path", length=Quantity(poses.path_length, "m"), via_home=int(poses.via_home.sum())
        )
        if self.options.allow_fewer_equations:
            return (report_finding("plan.check", **what), path)
        held_out = len(poses.groups) - self.n_groups
        counts: dict[str, Any] = {"counted": counted, "fitted": self.n_groups, "held_out": held_out}
        return (
            report_finding("plan.poses", **what, **counts),
            path,
            report_finding(
                "plan.weak-certificate" if efficiency < WEAK else "plan.certificate",
                shortfall=round_shortfall(efficiency),
                chosen=self.n_groups,
                counted=counted,
                candidates=self.quality.n_candidates,
                criterion=self.options.criterion,
            ),
            self._report_errors(counted),
            *curve,
            *self.notes,
        )

    def __repr__(self) -> str:
        return (
            f"Plan({self.robot.name}: {self.n_poses} poses for the fit, "
            f"{int(self.poses.held_out.sum())} held out, criterion {self.options.criterion}, "
            f"efficiency at least {round_to_digits(self.quality.efficiency)})"
        )

    def _report_errors(self, counted: str) -> Finding:
        """Return the expected errors: before, with random poses, and after."""
        given, target = self.errors, self.options.target
        shown = {
            name: None if errors is None else errors.to_quantities(self.robot)
            for name, errors in (
                ("before", given.before),
                ("random", given.random),
                ("after", given.after),
            )
        }
        reduction = None
        if given.random is not None:
            reduction = 1.0 - given.after.select(target) / given.random.select(target)
        return report_finding(
            "plan.expected-errors",
            **shown,
            counted=counted,
            target=target,
            reduction=reduction,
            share=given.after.share,
            **given.frame.data,
        )


def list_stops(plan: Plan) -> tuple[Stop, ...]:
    """Return the poses of a plan in order, with home where a straight path is blocked."""
    home, poses = locate_home(plan.robot), plan.poses
    via = Stop("home", True, False, home, inverse(plan.robot, home[None]).q[0])
    stops = []
    for i, label in enumerate(poses.labels):
        if poses.via_home[i]:
            stops.append(via)
        held_out = bool(poses.held_out[i])
        stops.append(Stop(label, False, held_out, poses.coordinates[i], poses.readings[i]))
    return tuple(stops)


# Number of perturbations of a design: more of them gain some tenths of a per cent.
PERTURBATIONS = 10
GAP = 5e-3  # gap of the efficiency up to which the bound is computed
DRAWS = 20  # sets of evenly drawn poses that a plan is compared with
# Decimal places to which readings are stated, see `list_steps`.
DIGITS = 8
# Largest number of times that poses are added where a goal is missed because some are held out.
EXTENSIONS = 12
# Poses of the fit for each validation pose, by default. At least FEW_ROWS poses are held out:
# fewer leave the verdict of a calibration undecided.
FITTED_PER_HELD_OUT = 4


def plan(
    robot: Mechanism,
    instrument: Instrument,
    n_poses: int | None = None,
    criterion: str | None = None,
    options: PlanOptions | None = None,
    progress: Progress = report_no_progress,
) -> Plan:
    """Plan the poses to measure.

    Parameters
    ----------
    robot : at its present values. instrument : what will measure, with its noise.
    n_poses, criterion : short for these options.
    options : constraints, candidates, goal, earlier measurements, seed; see `PlanOptions`.
    progress : receives the steps that are done.

    Raises
    ------
    EstimationError
        Fewer equations than unknowns, an unknown criterion, a goal out of reach, or a number of
        poses that is not possible.
    MechanismError
        The constraints exclude the whole workspace.
    """
    options = options or PlanOptions()
    if n_poses is not None:
        options = replace(options, n_poses=n_poses)
    if criterion is not None:
        options = replace(options, criterion=criterion)
    return plan_poses(prepare_problem(robot, instrument, options), progress)


def plan_poses(problem: PlanningProblem, progress: Progress = report_no_progress) -> Plan:
    """Plan the poses of a prepared problem; see `plan`."""
    options, k = problem.options, problem.poses_per_group
    if options.goal is None:
        number = N_POSES if options.n_poses is None else options.n_poses
        result = _plan_number(problem, number, progress)
        if not options.curve:
            return result
        return replace(result, curve=compute_error_curve(problem, progress))
    curve = find_sample_size(problem, progress)
    assert curve.enough is not None, "a goal exists"
    n = curve.enough
    # Validation poses are taken from the candidates, and D is not what the goal counts: both can
    # cost some more poses.
    for _ in range(EXTENSIONS):
        result = _plan_number(problem, n * k, progress)
        if result.errors.after.select(options.target) <= options.goal:
            return replace(result, curve=replace(curve, enough=n))
        n += max(n // 20, 1)
    raise EstimationError.of(
        "plan.goal-missed",
        number=n,
        counted=problem.counted,
        criterion=options.criterion,
        expected=curve.enough,
    )


def _plan_number(problem: PlanningProblem, n_poses: int, progress: Progress) -> Plan:
    """Plan a number of poses."""
    k, robot, options, groups = (
        problem.poses_per_group,
        problem.robot,
        problem.options,
        problem.groups,
    )
    default = max(n_poses // FITTED_PER_HELD_OUT // k, -(-FEW_ROWS // k)) * k
    n_held_out = default if options.hold_out is None else options.hold_out
    for use, number, least in (("for the fit", n_poses, 1), ("to hold out", n_held_out, 0)):
        if number < least or number % k:
            multiples = (
                f", in multiples of {k} because the instrument compares {k} poses" if k > 1 else ""
            )
            raise EstimationError(f"{number} poses {use}. Give {least} or more{multiples}")
    n = n_poses // k
    problem.require_equations(n)
    rng = np.random.default_rng(np.random.SeedSequence(options.seed, spawn_key=(1,)))
    # groups whose poses were drawn evenly
    is_uniform = problem.candidates.is_uniform[groups.members].all(axis=1)
    uniform = np.flatnonzero(is_uniform & is_allowed(groups.rows))
    held_out = _draw_held_out(problem, n_held_out // k, rng.permutation(uniform))
    rows = np.array(groups.rows)
    rows[np.isin(groups.members, groups.members[held_out]).any(axis=1)] = np.nan
    design = problem.pose_design(rows)
    best = choose_design(design, n, options.seed, PERTURBATIONS, gap=GAP, progress=progress)
    chosen = best.chosen
    after = problem.predict_errors(chosen)
    assert after is not None, "the exchange determines every direction"
    whole, random = problem.pose_design(name="I"), None
    if len(uniform) >= n:  # the median, by I, of some sets of evenly drawn groups
        sets = [rng.choice(uniform, n, replace=False) for _ in range(DRAWS)]
        values = [whole.evaluate(drawn) for drawn in sets]
        random = problem.predict_errors(sets[int(np.argsort(values)[DRAWS // 2])])
    forecast = ErrorForecast(
        before=problem.predict_errors(np.zeros(0, dtype=np.int64)),
        random=random,
        after=after,
        frame=problem.prediction.frame.describe(axes=""),
    )
    criteria = (Criterion("D"), whole.criterion, Criterion("A"), Criterion("E"))
    quality = DesignQuality(
        {c.name: whole.evaluate(chosen, c) for c in criteria},
        min(best.efficiency, 1.0),
        len(design.allowed),
    )
    poses, is_order_short = _arrange_poses(problem, chosen, held_out)
    notes = _collect_notes(problem)
    if not best.is_converged:
        counts = {"counted": problem.counted, "exchanges": EXCHANGES * n}
        notes.append(report_finding("plan.exchanges-exhausted", **counts))
    if not is_order_short:
        notes.append(report_finding("plan.order-exhausted"))
    return Plan(robot, problem.instrument, options, poses, quality, forecast, tuple(notes))


def _draw_held_out(problem: PlanningProblem, count: int, drawn: IntArray) -> IntArray:
    """Return the first `count` of the drawn groups that have no pose in common."""
    chosen: list[int] = []
    used: set[int] = set()
    for group in drawn.tolist():
        if len(chosen) == count:
            break
        poses = problem.groups.members[group].tolist()
        if not used & set(poses):
            chosen.append(group)
            used.update(poses)
    if len(chosen) < count:
        raise EstimationError.of(
            "plan.too-few-held-out",
            requested=count,
            counted=problem.counted,
            candidates=len(problem.candidates),
            available=len(chosen),
        )
    return np.array(chosen, dtype=np.int64)


def _arrange_poses(
    problem: PlanningProblem, chosen: IntArray, held_out: IntArray
) -> tuple[PlannedPoses, bool]:
    """Return the poses of groups for the fit and for validation in the order of visiting, and
    whether the search for a short order came to its end.
    """
    robot, members, candidates = problem.robot, problem.groups.members, problem.candidates
    groups, count = np.concatenate([chosen, held_out]), problem.groups.n_stations
    selected, station_of = members[groups], groups // (len(problem.groups.rows) // count)
    place = np.empty((count, len(candidates)), dtype=np.int64)
    ordered, stations, visits = place[0, :0], place[0, :0], []
    for station in np.unique(station_of):  # one after the other
        poses = np.unique(selected[station_of == station])
        visits.append(order_poses(candidates.checker, candidates.coordinates[poses]))
        place[station, poses[visits[-1].order]] = len(ordered) + np.arange(len(poses))
        ordered = np.append(ordered, poses[visits[-1].order])
        stations = np.append(stations, np.full(len(poses), station))
    via_home = np.concatenate([visit.via_home for visit in visits])
    via_home[1:] |= np.diff(stations) != 0  # a further station begins at home
    readings = candidates.solution.q[ordered]
    # no instrument resolves the difference
    steps = list_steps(robot, [a.dimension for a in robot.actuators], DIGITS)
    names = [getattr(sensor.kind, "camera", "") for sensor in problem.instrument.sensors]
    numbers = [int(name) for name in problem.used_names if name.isdecimal()]
    planned = PlannedPoses(
        tuple(str(max(numbers, default=0) + i) for i in range(1, len(ordered) + 1)),
        candidates.coordinates[ordered],
        np.round(readings / steps) * steps + 0.0,  # + 0: no reading is -0
        np.isin(ordered, members[held_out]),
        via_home,
        place[station_of[:, None], selected],
        sum(visit.length for visit in visits),
        tuple(names[i] for i in stations) if count > 1 else (),
    )
    return planned, all(visit.is_converged for visit in visits)


def _collect_notes(problem: PlanningProblem) -> list[Finding]:
    """Return findings on what was assumed and excluded."""
    p, assumed = len(problem.free), problem.free.assumed
    notes = [problem.candidates.report()]
    if assumed.any():
        notes.append(
            report_finding("plan.tolerances-missing", missing=int(assumed.sum()), parameters=p)
        )
    frame = problem.prediction.frame
    if frame.fitted or frame.undetermined:
        frames = frame.fitted or frame.undetermined
        notes.append(report_finding("plan.frames-undetermined", frames=frames))
    else:
        axes = (*ROTATION_AXES, *POSITION_AXES)
        stated = [v for v in problem.instrument.stated_values if 0.0 < v.sd < np.inf]
        parts = [v.name.rpartition(".") for v in stated]
        if known := tuple(dict.fromkeys(name for name, _, axis in parts if axis in axes)):
            notes.append(report_finding("plan.frames-included", names=known))
    combinations = describe_null_space(problem.free, problem.observable.null_space())
    if combinations:
        interpreted = interpret_combinations(problem.free, combinations)
        notes += report_undetermined(problem.free, interpreted)[0]
    return notes
