# SPDX-License-Identifier: Apache-2.0
"""A plan: poses to measure in their order, quality of the choice, and expected errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from loopcal.findings import Finding, Quantity, report_finding
from loopcal.findings.wording import round_to_digits
from loopcal.measure.instrument import Instrument
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import list_dimensions
from loopcal.mechanism.solutions import inverse
from loopcal.planning.constraints import PlanOptions
from loopcal.planning.path import locate_home
from loopcal.planning.problem import ErrorCurve, ExpectedErrors, name_groups
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import DrawnResult
from loopcal.results.serialization import to_json
from loopcal.typing import BoolArray, FloatArray, IntArray

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

    def __len__(self) -> int:
        return len(self.labels)

    def __repr__(self) -> str:
        return f"PlannedPoses({len(self)} poses, {int(self.held_out.sum())} held out)"

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

    figures: Mapping[str, float]  # D, I, A and E, in tolerances
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
        return (
            report_finding(
                "plan.poses",
                robot=self.robot.name,
                poses=len(poses),
                counted=counted,
                fitted=self.n_groups,
                held_out=len(poses.groups) - self.n_groups,
                kinds=tuple(
                    f"{kind.name} of targets on the base" if kind.is_of_base else kind.name
                    for kind in (sensor.kind for sensor in self.instrument.sensors)
                ),
            ),
            report_finding(
                "plan.path",
                length=Quantity(poses.path_length, "m"),
                via_home=int(poses.via_home.sum()),
            ),
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

    def __str__(self) -> str:
        return "\n".join(str(finding) for finding in self.findings)

    def _report_errors(self, counted: str) -> Finding:
        """Return the expected errors: before, with random poses, and after."""
        given, target, size = self.errors, self.options.target, self.robot.size
        shown = {
            name: None if errors is None else errors.to_quantities(self.robot)
            for name, errors in (
                ("before", given.before),
                ("random", given.random),
                ("after", given.after),
            )
        }
        share = None
        if given.random is not None:
            share = 1.0 - given.after.select(target, size) / given.random.select(target, size)
        return report_finding(
            "plan.expected-errors",
            **shown,
            counted=counted,
            target=target,
            reduction=share,
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
