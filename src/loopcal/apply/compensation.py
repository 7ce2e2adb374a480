# SPDX-License-Identifier: Apache-2.0
"""Compensation: actuator readings, or shifted commands, that take the machine to its targets.

    readings   q = IK(x; e_hat)
    commands   x_cmd <- x_cmd - (FK(IK(x_cmd; controller); e_hat) - x), a few fixed-point steps

A machine with fewer than six actuators also errs in directions that no actuator can correct. That
part remains, and the result states it for each target. See docs/theory/accuracy.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, ClassVar, Literal, get_args

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
from loopcal.findings import Finding, report_finding
from loopcal.findings.wording import name_count
from loopcal.mechanism.assembly import AXES, TWIST_UNITS
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import list_dimensions, read_coordinates
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import Solution, are_poses, forward, inverse, list_commanded
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import check_limits
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import BoolArray, FloatArray, Progress, StepCounter, report_no_progress
from loopcal.units import Dimension

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


@dataclass(frozen=True, eq=False)
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

    __repr__ = __str__


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
    EstimationError : no such frame; or a map that is not known, or lowers no errors at held-out
        regions.
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
    return forward(robot, commanded.q[:, list_commanded(controller)])


def _use_map(posterior: Posterior | None) -> tuple[Finding, Posterior]:
    """Return what the map of the residuals gains, and the posterior of the poses that it corrects.

    EstimationError: there is no map, or it is no proven gain.
    """
    if posterior is None:
        raise EstimationError(report_finding("compensation.map-needs-run"))
    own = posterior.discrepancy
    if own is None:
        raise EstimationError(report_finding("compensation.map-no-errors"))
    before, after, lowest, regions = own.test.tolist()
    values: dict[str, Any] = {"before": before, "after": after, "regions": int(regions)}
    values["lowest"] = 100.0 * lowest
    if np.isnan(lowest):
        raise EstimationError(report_finding("compensation.map-not-tested"))
    if not len(own.mean):
        raise EstimationError(report_finding("compensation.map-no-gain", **values))
    corrected = replace(posterior, discrepancy=replace(own, is_corrected=True))
    return report_finding("compensation.map-gain", **values), corrected


def _correct(posterior: Posterior | None, solution: Solution) -> FloatArray | None:
    """Return the twists (n, 6) by which the map of the residuals corrects solved poses; None
    without a map.
    """
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
    allowed, why = check_limits(robot, robot.values[None], final.q[None], final.state)
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
