# SPDX-License-Identifier: Apache-2.0
"""Compensation: readings, shifted commands or tables of corrections that lead a machine to targets.

    readings   q = IK(x; e_hat)
    commands   x_cmd <- x_cmd - (FK(IK(x_cmd; controller); e_hat) - x), a few fixed-point steps

A machine with fewer than six actuators also errs in directions that no actuator can correct. That
part remains, and the result states it for each target. See docs/theory/accuracy.md.

A controller with tables adds a correction c that it interpolates linearly between nodes:

    commands   x + c(x) in place of the coordinates x
    height     z + c(x, y) in place of z, at the lowest z of the workspace
    readings   q_i + c_i(q_i) in place of the reading of actuator i
    skew       U^-1 x in place of x, with a unit upper triangle U, and axes that are scaled by s

At the nodes of the first two, FK(IK(x + c; controller); identified) = x. A reading needs a
correction that depends on all coordinates, except for errors of its own drive: the table of an
actuator is the least-squares fit to IK(x; identified) - IK(x; controller) over the workspace. What
remains is the error of the identified machine at other points. Skew: positions of the machine are
R U diag(s) x + b with a rotation R, by least squares; what remains is that after the best rigid
motion, because such a controller turns no frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from loopcal import geometry
from loopcal.apply.accuracy import PoseUncertainty, pose_uncertainty
from loopcal.checks import check_choice
from loopcal.diagnose.error_frames import FITTED, fit_unfixed_frames
from loopcal.diagnose.gauge_freedoms import twist_weights
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.posterior import Posterior
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Severity, report_finding
from loopcal.findings.wording import name_count
from loopcal.geometry import align_point_sets, wrap_angle
from loopcal.mechanism import workspace
from loopcal.mechanism.assembly import AXES, TWIST_UNITS
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION, TILT, list_dimensions, read_coordinates
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import Solution, are_poses, forward, inverse
from loopcal.mechanism.states import Status
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import BoolArray, FloatArray, Progress, StepCounter, report_no_progress
from loopcal.units import Dimension

What = Literal["commands", "height", "readings", "skew"]
Mode = Literal["readings", "commands"]

MAP_STEPS = 3  # each makes the rest smaller by the slope of the map, which is far below 1
SHOWN = 5  # targets out of reach that the text lists
ROUNDING = 1e-9  # an error below this share of the robot's size (or this many radians) is rounding
# Passes over all targets (the controller's answer, the best poses, the errors before, and the
# uncertainty), and what progress calls them.
PASSES, TASK = 4, "computing compensation"
# Share of its first value below which the fixed-point iteration must bring the distance to the
# best pose. It usually falls a hundredfold in each step.
REDUCED = 0.1
SHARE = 0.1  # of the largest error, which remains where nobody states another limit
STEPS = 5  # of the fixed-point iteration: each leaves the slope of the map, far below 1
CHECKS = 2000  # points between nodes at which the rest is found
FEWEST = 3  # nodes along an axis: with the ends alone, a symmetric error looks like none
ENOUGH = 1.2  # times the least rest of any number of nodes, at which more nodes do not help
LIGHT = 1e-3  # weight of a coarser table at a node, of a pose near it


class Reach(Enum):
    """Whether the machine reaches a target."""

    REACHED = "reached"
    IN_PART = "reached in part"
    OUTSIDE = "outside the limits"
    OTHER_MODE = "in another mode"
    UNREACHABLE = "unreachable"
    NOT_CONVERGED = "not converged"


# Code of the finding of a target -> its state.
CODES = {
    "compensation.reached": Reach.REACHED,
    "compensation.reached-in-part": Reach.IN_PART,
    "compensation.outside-limits": Reach.OUTSIDE,
    "compensation.other-mode": Reach.OTHER_MODE,
    "compensation.unreachable": Reach.UNREACHABLE,
    "compensation.not-converged": Reach.NOT_CONVERGED,
}


@dataclass(frozen=True, eq=False, repr=False)
class Compensation(TableResult):
    """Readings or commands for n targets, and the poses they lead to.

    Errors are twists (n, 6), rotation first [rad, m].

    Attributes
    ----------
    mode : "readings" or "commands". labels : (n,) names of the targets.
    robot, controller : the identified geometry, and that of the controller.
    readings : (n, a) of the actuators at the targets [m, rad].
    commands : (n, c) coordinates to command [m, rad]; None where readings are set.
    wanted, reached : (n, 4, 4) platform poses; `reached` is that of the identified robot. All these
        but `wanted` are NaN in rows that no pose near the target was found for.
    before : (n, 6) error of the machine when its controller commands the target unchanged, in the
        frame of `uncertainty` where that is "fitted", else in the base frame.
    remaining : (n, 6) error after compensation; it and `before` are NaN where the machine does not
        get to a pose. not_compensable : (n, 6) the part of it that no
        reading can remove.
    residual_position, residual_orientation : (steps + 1, n) [m], [rad] distance from the best
        reachable pose before the first and after each fixed-point step; zeros (1, n) where readings
        are set.
    uncertainty : of the reached poses; None where only a robot was given.
    residual_map : what the map of the residuals that corrects the poses gains at held-out regions;
        None where it is not used. The robot is the identified geometry without this map.
    findings : (n,) one for each target: reached, or why not.
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
    findings: tuple[Finding, ...]
    residual_map: Finding | None = None

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(robot="robot.name", mode="", labels="", actuators="robot.actuators.name"),
        Field("status", lambda result: [reach.value for reach in result.reach], "pose"),
        Field(
            "command",
            "commands",
            "pose coordinate",
            units=lambda result: list_dimensions(result.robot.controlled),
        ),
        Field("reading", "readings", "pose actuator", units="robot.actuators.dimension"),
        *fields(readings="", coordinates="robot.controlled", commands=""),
        Field("before", axes="pose component", unit=TWIST_UNITS, key="before"),
        Field("remaining", axes="pose component", unit=TWIST_UNITS, key="remaining"),
        *fields("not_compensable", "residual_position", "residual_orientation"),
        *fields(uncertainty=lambda result: result.uncertainty and result.uncertainty.to_dict()),
        *fields(reach=lambda result: [reach.value for reach in result.reach]),
        *fields(residual_map=lambda result: result.residual_map and str(result.residual_map)),
        *fields(sentences=lambda result: list(map(str, result.findings)), findings=""),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(
        pose="labels",
        actuator="robot.actuators.name",
        coordinate="robot.controlled",
        component=AXES,
    )

    @property
    def reach(self) -> tuple[Reach, ...]:
        """(n,) whether each target is reached."""
        return tuple(CODES[finding.code] for finding in self.findings)

    @property
    def usable(self) -> BoolArray:
        """(n,) targets to which the machine can be sent."""
        return np.array([r in (Reach.REACHED, Reach.IN_PART) for r in self.reach])

    def drop_rounding(self, errors: FloatArray) -> FloatArray:
        """Return errors (n, 6) [rad, m] with 0 for those that are rounding."""
        rounding = ROUNDING * np.repeat([1.0, self.robot.size], 3)
        return np.where(np.abs(errors) < rounding, 0.0, errors)

    def __str__(self) -> str:
        """Return how many targets are reached, and the findings of those that are not."""
        n, missed = len(self.labels), np.flatnonzero(~self.usable).tolist()
        lines = [f"{self.robot.name}: {n - len(missed)} of {n} targets reached ({self.mode})"]
        lines += [f"target {self.labels[i]!r} {self.findings[i]}" for i in missed[:SHOWN]]
        if len(missed) > SHOWN:
            lines.append(f"and {len(missed) - SHOWN} more")
        if self.residual_map is not None:
            lines.append(str(self.residual_map))
        return "\n".join(lines)


def compensate(
    fit: Identification | Posterior | Mechanism,
    targets: ArrayLike,
    mode: Mode = "readings",
    controller: Mechanism | None = None,
    steps: int = 3,
    labels: tuple[str, ...] = (),
    progress: Progress = report_no_progress,
    frame: str = FITTED,
    residual_map: bool = False,
    conditions: Mapping[str, float] | None = None,
) -> Compensation:
    """Compute readings or shifted commands for targets.

    Parameters
    ----------
    fit : identification, posterior of a run folder (both give uncertainties), or calibrated robot.
    targets : (n, 4, 4) T_base_platform or (n, c) controlled coordinates [m, rad]. Freedoms that
        coordinates do not state have the values that the controller's geometry gives them.
    mode : "readings" to set the actuators, "commands" for a controller that cannot be changed.
    controller : that geometry; default: the nominal robot. steps : fixed-point steps of "commands".
    labels : of the targets; default "1", "2", ... progress : receives the passes that are done.
    frame : of the uncertainty, see `pose_uncertainty`; "relative": to the first target.
    residual_map : whether a smooth map of the residuals of the fit corrects the poses as well.
    conditions : today's temperatures and load, see `Mechanism.with_conditions`. The controller does
        not know them.

    Returns
    -------
    Compensation. A target that cannot be reached is not an error: see `reach` and `findings`.

    Raises
    ------
    DataError : unknown mode, no step, no target or targets of another shape, another number of
        labels.
    EstimationError : no such frame; or a map that is unknown, or lowers no held-out errors.
    """
    check_choice("mode", mode, get_args(Mode), DataError)
    if steps < 1:
        raise DataError(f"steps is {steps}, but must be 1 or more, and 3 are usually enough")
    source = fit.posterior if isinstance(fit, Identification) else fit
    robot, posterior = (source, None) if isinstance(source, Mechanism) else (source.robot, source)
    old = controller or robot.nominal
    if conditions:
        robot = robot.with_conditions(conditions)
        posterior = None if posterior is None else replace(posterior, robot=robot)
    gain = None
    if residual_map:
        gain, posterior = _use_map(posterior)
    count = StepCounter(progress, PASSES + (steps if mode == "commands" else 0))
    count.begin(TASK)
    uncorrected = inverse(old, targets)
    wanted = np.reshape(targets, (-1, 4, 4)) if are_poses(old, targets) else uncorrected.T
    names = tuple(labels) or tuple(str(i + 1) for i in range(len(wanted)))
    if not names or len(names) != len(wanted):
        raise DataError(
            f"{name_count(len(names), 'label')} for {name_count(len(wanted), 'target')}: give at "
            "least one target, and one label for each or none"
        )
    count.begin(TASK)
    best = _aim(posterior, robot, targets, wanted)
    count.begin(TASK)
    unchanged = _follow(robot, old, uncorrected)
    before = geometry.pose_difference(_predict(posterior, unchanged), wanted)
    final, commands, distances = best, None, np.zeros((1, len(wanted), 6))
    if mode == "commands":
        final, commands, distances = _shift_commands(robot, old, uncorrected, best, steps, count)
    count.begin(TASK)
    not_compensable = geometry.pose_difference(_predict(posterior, best), wanted)
    findings = _report_targets(robot, uncorrected, best, final, distances, not_compensable)
    # Elsewhere the iteration ends at some pose, but it is not the one nearest to the target.
    is_solved = uncorrected.converged & best.converged & final.converged
    status = np.where(is_solved, final.status, np.maximum(final.status, Status.UNREACHABLE))
    solved = replace(
        final,
        status=status.astype(np.int8),
        q=np.where(is_solved[:, None], final.q, np.nan),
        T=np.where(is_solved[:, None, None], final.T, np.nan),
    )
    reached = np.where(is_solved[:, None, None], _predict(posterior, final), np.nan)
    uncertainty = None
    if posterior is not None:
        before = _remove_unfixed_frames(posterior, old, wanted, before, frame)
        uncertainty = pose_uncertainty(posterior, solved, frame=frame, origin_name=names[0])
    is_answered = uncorrected.converged & unchanged.converged
    remaining = geometry.pose_difference(reached, wanted)
    return Compensation(
        mode=mode,
        labels=names,
        robot=robot,
        controller=old,
        readings=solved.q,
        commands=None if commands is None else np.where(is_solved[:, None], commands, np.nan),
        wanted=wanted,
        reached=reached,
        before=np.where(is_answered[:, None], before, np.nan),
        remaining=remaining,
        not_compensable=np.where(is_solved[:, None], not_compensable, np.nan),
        residual_position=np.linalg.norm(distances[..., 3:], axis=2),
        residual_orientation=np.linalg.norm(distances[..., :3], axis=2),
        uncertainty=uncertainty,
        findings=findings,
        residual_map=gain,
    )


def _follow(robot: Mechanism, controller: Mechanism, commanded: Solution) -> Solution:
    """Return where a robot is at the readings of its controller, at today's conditions."""
    return forward(robot, commanded.q[:, controller.is_commanded])


def _use_map(posterior: Posterior | None) -> tuple[Finding, Posterior]:
    """Return what the map of the residuals gains, and the posterior of the poses that it corrects.

    EstimationError: there is no map, or it is no proven gain.
    """
    if posterior is None:
        raise EstimationError.of("compensation.map-needs-run")
    own = posterior.discrepancy
    if own is None:
        raise EstimationError.of("compensation.map-not-tested", is_smooth=False)
    before, after, lowest, regions = own.test.tolist()
    values: dict[str, Any] = {"before": before, "after": after, "regions": int(regions)}
    values["lowest"] = 100.0 * lowest
    if np.isnan(lowest):
        raise EstimationError.of("compensation.map-not-tested", is_smooth=True)
    if not len(own.mean):
        raise EstimationError.of("compensation.map-no-gain", **values)
    corrected = replace(posterior, discrepancy=replace(own, is_corrected=True))
    return report_finding("compensation.map-gain", **values), corrected


def _correct(posterior: Posterior | None, solution: Solution) -> FloatArray | None:
    """Return the twists (n, 6) by which the map corrects solved poses; None without a map."""
    if posterior is None or (own := posterior.discrepancy) is None or not own.is_corrected:
        return None
    robot = posterior.robot
    S = differentiate_pose(robot, robot.values[None], solution.q[None], solution.state)
    return own.correct(solution.T, S.parameters[0][..., posterior.places])


def _predict(posterior: Posterior | None, solution: Solution) -> FloatArray:
    """Return where the machine is at solved poses (n, 4, 4)."""
    twists = _correct(posterior, solution)
    return solution.T if twists is None else geometry.apply_twist(solution.T, twists)


def _aim(
    posterior: Posterior | None, robot: Mechanism, targets: ArrayLike, wanted: FloatArray
) -> Solution:
    """Return the poses of the identified robot that the map of the residuals takes to targets."""
    best, is_pose = inverse(robot, targets), are_poses(robot, targets)
    for _ in range(MAP_STEPS):
        if (twists := _correct(posterior, best)) is None:
            break
        aimed = geometry.apply_twist(wanted, -twists)
        best = inverse(robot, aimed if is_pose else read_coordinates(aimed, robot.controlled))
    return best


def _remove_unfixed_frames(
    posterior: Posterior, controller: Mechanism, T: FloatArray, errors: FloatArray, frame: str
) -> FloatArray:
    """Return errors (n, 6) at poses T (n, 4, 4), in the frame "fitted" after the best rigid fit of
    frames that the measurements do not determine, over the measured poses.
    """
    frames = fit_unfixed_frames(posterior)
    if frame != FITTED or not frames.motions.shape[1]:
        return errors
    commanded = inverse(controller, frames.poses)
    reached = _follow(posterior.robot, controller, commanded)
    if not (commanded.converged & reached.converged).all():
        return errors
    reference = geometry.pose_difference(reached.T, frames.poses)
    return frames.remove(errors[None], T, reference[None])[0]


def _shift_commands(
    robot: Mechanism,
    controller: Mechanism,
    uncorrected: Solution,
    best: Solution,
    steps: int,
    count: StepCounter,
) -> tuple[Solution, FloatArray, FloatArray]:
    """Shift commands until the machine goes to the best poses: where it goes, the commands (n, c)
    [m, rad], and twists (steps + 1, n, 6) from the best poses, before and after each step.

    The shift is a twist, so no choice of angles is singular.
    """
    solution = uncorrected
    commands = read_coordinates(solution.T, controller.controlled)
    final = _follow(robot, controller, solution)
    distances = [geometry.pose_difference(final.T, best.T)]
    for _ in range(steps):
        count.begin(TASK)
        moved = geometry.apply_twist(solution.T, -distances[-1])
        commands = read_coordinates(moved, controller.controlled)
        solution = inverse(controller, commands, solution if solution.converged.all() else None)
        final = _follow(robot, controller, solution)
        distances.append(geometry.pose_difference(final.T, best.T))
    return final, commands, np.stack(distances)


def _report_targets(
    robot: Mechanism,
    uncorrected: Solution,
    best: Solution,
    final: Solution,
    distances: FloatArray,
    not_compensable: FloatArray,
) -> tuple[Finding, ...]:
    """Return one finding for each target."""
    distances = distances * twist_weights(robot.size) / robot.size
    allowed, why = workspace.check_limits(robot, robot.values[None], final.q[None], final.state)
    first, last = np.linalg.norm(distances[[0, -1]], axis=2)
    is_loose = last > np.maximum(REDUCED * first, ROUNDING)
    position = np.linalg.norm(not_compensable[:, 3:], axis=1)
    angle = np.linalg.norm(not_compensable[:, :3], axis=1)
    solutions = [(solution, solution.converged) for solution in (best, uncorrected, final)]
    closed, findings = best.closed, []
    for i in range(len(not_compensable)):
        failed = next((solution for solution, converged in solutions if not converged[i]), None)
        values: dict[str, Any] = {}
        if failed is best and closed[i]:
            code = "other-mode"
        elif failed is not None:
            whose = "the controller's geometry: " if failed is uncorrected else ""
            code, values = "unreachable", {"reason": whose + str(failed.explain(i))}
        elif not allowed[0, i]:
            code, values = "outside-limits", {"limit": str(why[0, i])}
        elif is_loose[i]:
            code = "not-converged"
        elif position[i] > ROUNDING * robot.size or angle[i] > ROUNDING:
            code, values = "reached-in-part", {"names": tuple(robot.controlled)}
            values["position"] = robot.to_quantity(float(position[i]), Dimension.LENGTH)
            values["orientation"] = robot.to_quantity(float(angle[i]), Dimension.ANGLE)
        else:
            code = "reached"
        findings.append(report_finding(f"compensation.{code}", **values))
    return tuple(findings)


class TableSize(NamedTuple):
    """What a controller corrects, and the most nodes of a table: in all, and along an axis."""

    what: What
    most: int
    most_along: int


@dataclass(frozen=True, eq=False)
class CorrectionTable:
    """Corrections at the nodes of a grid.

    axes : coordinate, or actuator -> its nodes [m, rad]. values : what is corrected -> corrections
    at all nodes, one axis of the array for each of `axes` [m, rad].
    """

    axes: Mapping[str, FloatArray]
    values: Mapping[str, FloatArray]


class _Machine(NamedTuple):
    """The identified robot, the geometry of its controller, and the coordinates to correct."""

    robot: Mechanism
    controller: Mechanism
    corrected: list[int]

    def lead(self, targets: FloatArray, commands: FloatArray) -> FloatArray:
        """Return how far (n, c) from targets the robot stops at commands (n, c), or NaN."""
        led = inverse(self.controller, commands)
        readings = np.where(led.converged[:, None], led.q, np.nan)
        return self.stop(targets, readings[:, self.controller.is_commanded])

    def stop(self, targets: FloatArray, readings: FloatArray) -> FloatArray:
        """Return how far (n, c) the robot stops from targets at readings (n, a)."""
        reached = forward(self.robot, np.nan_to_num(readings))
        found = read_coordinates(reached.T, self.robot.controlled) - targets
        found = np.where(np.isin(self.robot.controlled, POSITION), found, wrap_angle(found))
        usable = reached.converged & np.isfinite(readings).all(axis=1)
        return np.where(usable[:, None], found, np.nan)

    def measure(self, misses: FloatArray, columns: Sequence[int]) -> tuple[float, float]:
        """Return the largest error in position and in orientation [m, rad] of some columns."""
        of = np.isin(np.arange(misses.shape[1]), columns)
        is_length = np.isin(self.robot.controlled, POSITION)
        parts = (misses[:, of & is_length], misses[:, of & ~is_length])
        position, angle = (float(np.linalg.norm(p, axis=1).max(initial=0.0)) for p in parts)
        return position, angle

    def weigh(self, misses: FloatArray) -> float:
        """Return the larger of both [m], an angle by its arc at the robot's size."""
        position, angle = self.measure(misses, self.corrected)
        return max(position, self.robot.size * angle)


def make_tables(
    robot: Mechanism, controller: Mechanism, size: TableSize, limit: float | None = None
) -> tuple[tuple[CorrectionTable, ...], Finding]:
    """Return the tables with which a controller leads the identified robot to its commands: one,
    or one for each actuator; and what remains between the nodes.

    controller : the geometry that it computes with. limit : error that may remain [m], of an
    orientation by its arc at the robot's size; a tenth of the largest error by default.

    DataError : the controller errs nowhere, has other coordinates, or reaches no node.
    """
    names, reason = robot.controlled, ""
    if set(names) & set(TILT):
        reason = "tilt"
    elif size.what in ("height", "skew") and names[:3] != ("x", "y", "z"):
        reason = "height"
    elif controller.controlled != names or len(controller.actuators) != len(robot.actuators):
        reason = "other"
    elif np.array_equal(controller.values, robot.values):
        reason = "equal"
    if reason:
        raise DataError(_refuse(robot, reason))
    ranges = workspace.workspace_ranges(robot)
    moved = {"height": ["z"], "skew": ["x", "y", "z"]}.get(size.what, list(names))
    machine = _Machine(robot, controller, [names.index(name) for name in moved])
    axes, home = list(names), read_coordinates(robot.home, names)
    if size.what == "height":
        axes, home[names.index("z")] = ["x", "y"], ranges["z"][0]
    places = [names.index(name) for name in axes]

    def place(points: FloatArray) -> FloatArray:
        targets = np.tile(home, (len(points), 1))
        targets[:, places] = points
        return targets

    if size.what == "readings":
        targets = workspace.sample_workspace(robot, 4 * CHECKS).coordinates
    else:
        targets = place(
            workspace.draw_coordinates(np.random.default_rng(0), tuple(axes), ranges, CHECKS)
        )
    before = machine.lead(targets, targets)
    targets, before = (rows[np.isfinite(before).all(axis=1)] for rows in (targets, before))
    if not len(targets):
        raise DataError(_refuse(robot, "nowhere"))
    tables, after = list[CorrectionTable](), before
    if size.what == "skew":
        tables, before, after = _fit_skew(machine, targets, before)
    limit = SHARE * machine.weigh(before) if limit is None else limit
    if size.what == "readings":
        tables, after = _fit_readings(machine, targets, limit, size.most_along)
    elif size.what != "skew":
        spans = [ranges[name] for name in axes]
        nodes, grid, after = _choose_grid(machine, place, targets[:, places], spans, limit, size)
        values = dict(zip(moved, np.moveaxis(grid, -1, 0), strict=True))
        tables = [CorrectionTable(dict(zip(axes, nodes, strict=True)), values)]
    return tuple(tables), _report(machine, size, tables, (before, after), limit)


def _refuse(robot: Mechanism, reason: str) -> Finding:
    """Return why there is no table of a robot."""
    return report_finding("files.no-table", robot=robot.name, reason=reason)


def _extend(points: FloatArray, values: FloatArray, is_known: BoolArray) -> None:
    """Fill in the values (n, c) at points (n, d) out of reach, such as corners of a round bed: by
    the plane through the nearest known ones.
    """
    from scipy.spatial import KDTree

    known, lost = points[is_known], points[~is_known]
    count = min(4 * points.shape[1], len(known))
    near = KDTree(known).query(lost, count)[1].reshape(-1, count)
    steps = known[near] - lost[:, None]
    planes = np.concatenate([np.ones((*near.shape, 1)), steps], axis=2)
    values[~is_known] = (np.linalg.pinv(planes) @ values[is_known][near])[:, 0]


def _report(
    machine: _Machine,
    size: TableSize,
    tables: Sequence[CorrectionTable],
    misses: Sequence[FloatArray],
    limit: float,
) -> Finding:
    """Return how large errors were, what remains, and what no table of this sort corrects."""
    robot, others = machine.robot, tuple(set(range(misses[0].shape[1])) - {*machine.corrected})
    is_met = machine.weigh(misses[1]) <= limit
    measured = (machine.measure(rows, machine.corrected) for rows in misses)
    sizes = [(p * (p > ROUNDING * robot.size), a * (a > ROUNDING)) for p, a in measured]
    sizes.append((limit, limit / robot.size if sizes[0][1] else 0.0))
    data: dict[str, Any] = {"what": size.what, "points": len(misses[1]), "is_met": is_met}
    data["nodes"] = [" x ".join(str(len(n)) for n in t.axes.values()) for t in tables if t.axes]
    for key, (position, angle) in zip(("before", "after", "limit"), sizes, strict=True):
        data[key] = robot.to_quantity(position, Dimension.LENGTH)
        data[f"angle_{key}"] = robot.to_quantity(angle, Dimension.ANGLE) if angle else 0
    data["others"] = tuple(robot.controlled[i] for i in others)
    rests = zip(
        machine.measure(misses[1], others), (Dimension.LENGTH, Dimension.ANGLE), strict=True
    )
    data["rests"] = [str(robot.to_quantity(rest, dimension)) for rest, dimension in rests if rest]
    level = Severity.INFO if is_met and not others else Severity.WARNING
    return report_finding("files.table-remains", level, **data)


def _choose_grid(
    machine: _Machine,
    place: Callable[[FloatArray], FloatArray],
    checks: FloatArray,
    spans: Sequence[tuple[float, float]],
    limit: float,
    size: TableSize,
) -> tuple[list[FloatArray], FloatArray, FloatArray]:
    """Return the nodes along each axis, corrections (.., c) at all of them, and what remains (n, c)
    at the checks (n, d) and between neighbors.

    Linear interpolation errs by the square of the spacing: n nodes become so many that all axes
    contribute alike.
    """
    from scipy.interpolate import RegularGridInterpolator

    columns, dims = machine.corrected, len(spans)
    counts = np.full(dims, FEWEST)
    while True:
        nodes = [np.linspace(*span, n) for span, n in zip(spans, counts.tolist(), strict=True)]
        points = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, dims)
        targets = place(points)
        commands = targets.copy()
        for _ in range(STEPS):
            commands[:, columns] -= machine.lead(targets, commands)[:, columns]
        is_known: BoolArray = np.asarray(np.isfinite(commands).all(axis=1))
        if not is_known.any():
            raise DataError(_refuse(machine.robot, "nowhere"))
        grid = (commands - targets)[:, columns]
        _extend(points / [node[1] - node[0] for node in nodes], grid, is_known)
        grid = grid.reshape(*counts, len(columns))
        correct = RegularGridInterpolator(nodes, grid)

        def remain(points: FloatArray) -> FloatArray:
            targets = place(points)
            commands = targets.copy()
            commands[:, columns] += correct(points)  # noqa: B023  # used in this round only
            found = machine.lead(targets, commands)
            return found[np.isfinite(found).all(axis=1)]

        rest, along = [remain(checks)], []
        for i, own in enumerate(nodes):
            middle = points[points[:, i] < own[-1]]
            middle = middle[:: max(1, len(middle) // CHECKS)]
            rest.append(remain(middle + 0.5 * (own[1] - own[0]) * np.eye(dims)[i]))
            along.append(machine.weigh(rest[-1]))
        after = np.concatenate(rest)
        if machine.weigh(after) <= limit:
            return nodes, grid, after
        shares = np.array(along) / limit * max(1, sum(e > 0.01 * limit for e in along))
        growth = np.clip(np.sqrt(shares), 1.0, 8.0)
        if growth.max() < 1.05:
            growth *= 1.2
        wanted = np.ceil((counts - 1) * growth).astype(int) + 1
        wanted = np.minimum(wanted, size.most_along)
        while wanted.prod() > size.most:
            k = int(np.argmax(wanted / counts))
            if wanted[k] <= counts[k]:
                break
            wanted[k] -= 1
        if (wanted == counts).all():
            return nodes, grid, after
        counts = wanted


def _fit_skew(
    machine: _Machine, targets: FloatArray, before: FloatArray
) -> tuple[list[CorrectionTable], FloatArray, FloatArray]:
    """Return skews and scales, errors at targets (n, c), and what remains of them."""
    places, led = targets[:, :3], (targets + before)[:, :3]
    A = np.linalg.lstsq(*(x - x.mean(axis=0) for x in (places, led)), rcond=None)[0].T
    T = np.linalg.qr(A)[1]
    T *= np.sign(np.diag(T))[:, None]
    scale, U = np.diag(T).copy(), T / np.diag(T)
    if any(actuator.weights for actuator in machine.controller.actuators):
        scale[:2] = scale[:2].mean()  # both belts drive x and y
    commands = np.column_stack([np.linalg.solve(U, places.T).T / scale, targets[:, 3:]])
    after = machine.lead(targets, commands)
    usable = np.isfinite(after).all(axis=1)
    aligned = []
    for misses in (before[usable], after[usable]):
        led = places[usable] + misses[:, :3]
        M = align_point_sets(led, places[usable])
        left = led @ M[:3, :3].T + M[:3, 3] - places[usable]
        aligned.append(np.column_stack([left, misses[:, 3:]]))
    values = {"xy": U[0, 1], "xz": U[0, 2], "yz": U[1, 2], **dict(zip("xyz", scale, strict=True))}
    return [CorrectionTable({}, values)], *aligned


def _fit_readings(
    machine: _Machine, targets: FloatArray, limit: float, most: int
) -> tuple[list[CorrectionTable], FloatArray]:
    """Return a table for each commanded actuator, fitted to all but `CHECKS` of the poses (n, c),
    and what remains at these.
    """
    led, own = (inverse(robot, targets) for robot in (machine.controller, machine.robot))
    usable, commanded = led.converged & own.converged, machine.robot.is_commanded
    q, change = led.q[usable][:, commanded], (own.q - led.q)[usable][:, commanded]
    targets, checked = targets[usable][:CHECKS], q[:CHECKS]
    names = [a.name for a in machine.robot.actuators if a.reference is None]
    tables = [(row[[row.argmin(), row.argmax()]], np.zeros(2)) for row in q.T]
    tried, count = list[tuple[float, list[tuple[FloatArray, FloatArray]], FloatArray]](), FEWEST
    while True:
        fitted = zip(q[CHECKS:].T, change[CHECKS:].T, tables, strict=True)
        tables = [_fit_table(x, y, table, count) for x, y, table in fitted]
        shifts = [np.interp(x, *table) for x, table in zip(checked.T, tables, strict=True)]
        after = machine.stop(targets, checked + np.column_stack(shifts))
        tried.append((machine.weigh(after), tables, after))
        if tried[-1][0] <= limit or count == most:
            break
        count = min(2 * count - 1, most)
    enough = max(limit, ENOUGH * min(rest for rest, *_ in tried))
    _, tables, after = next(trial for trial in tried if trial[0] <= enough)
    pairs = zip(names, tables, strict=True)
    return [CorrectionTable({name: x}, {name: y}) for name, (x, y) in pairs], after


def _fit_table(
    x: FloatArray, y: FloatArray, coarse: tuple[FloatArray, FloatArray], count: int
) -> tuple[FloatArray, FloatArray]:
    """Return nodes, and the values of the straight lines between them that fit y(x) best; where no
    pose is near a node, a coarser table counts.
    """
    from scipy.interpolate import make_lsq_spline

    nodes = np.linspace(coarse[0][0], coarse[0][-1], count)
    inner = (x > nodes[0]) & (x < nodes[-1])
    places = np.concatenate([x[inner], nodes])
    known = np.concatenate([y[inner], np.interp(nodes, *coarse)])
    weights = np.repeat([1.0, LIGHT], [inner.sum(), count])
    order = np.argsort(places)
    knots = nodes[[0, *range(count), -1]]
    return nodes, make_lsq_spline(places[order], known[order], knots, 1, weights[order])(nodes)
