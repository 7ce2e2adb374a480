# SPDX-License-Identifier: Apache-2.0
"""Analyze what measurements determine, and which further measurements determine the rest."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from loopcal.apply.calibration_report import is_readings_alone
from loopcal.diagnose.gauge_freedoms import report_undetermined
from loopcal.diagnose.identifiable_parameters import (
    Identifiability,
    IdentifiableSubset,
    MeasurementSuggestion,
    UsefulAccuracy,
    choose_identifiable_subset,
    identifiability,
    judge_useful_accuracy,
    suggest_measurements,
)
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.families.joint_release import propose_added_joints
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.singularities import NEAR_SHARE, analyze_singularity
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.workspace import ReachableShare, evaluate_limits, measure_reachable_share
from loopcal.numerics.decomposition import RANK_TOLERANCE
from loopcal.results.description import Field, fields, within
from loopcal.typing import FloatArray
from loopcal.units import Dimension

FEW = 3  # combinations that change poses and that a summary lists one by one


@dataclass(frozen=True, eq=False)
class IdentifiabilityReport:
    """What measurements determine."""

    analysis: Identifiability  # rank, singular values and a statement on each parameter
    suggestions: tuple[MeasurementSuggestion, ...]  # further measurements for open combinations
    # a smallest set of parameters; None where it was not asked for
    subset: IdentifiableSubset | None
    # what is determined to a useful accuracy; None where none was stated
    useful: UsefulAccuracy | None = None
    is_readings_alone: bool = False  # whether nothing but redundant readings was measured

    @cached_property
    def summary(self) -> tuple[Finding, ...]:
        """Rank, what is undetermined in words, what is known poorly, and what to measure."""
        analysis = self.analysis
        by_code = {finding.code: finding for finding in analysis.findings}
        cut = by_code.get("identifiability.arbitrary-cut")
        findings = [by_code["identifiability.rank"], *([] if cut is None else [cut])]
        findings += () if self.useful is None else self.useful.findings
        if open_ones := analysis.unidentifiable:  # how many are harmless, and how many change poses
            given = (analysis.free_parameters, open_ones)
            counts, changing = report_undetermined(*given, is_readings_alone=self.is_readings_alone)
            findings += [*counts, *(c.finding for c in changing if len(changing) <= FEW)]
        findings.append(by_code["identifiability.improved"])
        # the measurement that determines most combinations that move the platform or a frame, the
        # simplest of them; or that none does
        suggestions = [s for s in self.suggestions if not s.combination.is_harmless]
        solved = Counter(m.words for s in suggestions for m in s.measurements)
        if not solved:
            return (*findings, *(s.finding for s in suggestions))
        (words, count), total = solved.most_common(1)[0], len(suggestions)
        stated: dict[str, Any] = {"words": words, "count": count}
        stated |= {"total": total, "left": total - count}
        return (*findings, report_finding("identifiability.measure-for-all", **stated))

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *within("analysis", [field for field in Identifiability.FIELDS if field.name != "scaling"]),
        *fields("summary", remedies="suggestions"),
        Field("useful", is_optional=True),
        Field("reduction", "subset", is_optional=True),
    )


def analyze_identifiability(
    robot: Mechanism,
    data: Measurements,
    choose_subset: bool = False,
    rank_tolerance: float = RANK_TOLERANCE,
    useful: tuple[float, float | None] | None = None,
) -> IdentifiabilityReport:
    """Return what measurements determine of a robot's free parameters.

    data : measurements, or simulated ones without noise for an instrument that is considered.
    choose_subset : also choose a smallest set of parameters that says the same.
    rank_tolerance : share of the largest singular value below which one counts as zero.
    useful : accuracy of lengths [m] and angles [rad] to which combinations are to be determined;
        see `loopcal.diagnose.identifiable_parameters.judge_useful_accuracy`.
    """
    analysis = identifiability(robot, data, rank_tolerance)
    subset = choose_identifiable_subset(analysis) if choose_subset else None
    accuracy = None if useful is None else judge_useful_accuracy(analysis, *useful)
    suggestions = suggest_measurements(analysis)
    return IdentifiabilityReport(analysis, suggestions, subset, accuracy, is_readings_alone(data))


POSITIONS, ENOUGH = 400, 0.95
"""Random positions of the workspace, and share of them that a machine reaches without a warning."""
FEW_REACHED = 0.05  # share of the workspace up to which nothing is compared with its median
SMALL, LARGE = 0.005, 100.0  # characteristic lengths of machines [m]; others are doubted
FLAT = 0.02  # margin [m/m] below which home is close to a singularity
ROUNDING = 1e-9  # how far home may exceed a limit by rounding [m or rad]


@dataclass(frozen=True, eq=False)
class RobotInspection:
    """A robot and what it does at home."""

    robot: Mechanism  # the robot
    home_readings: FloatArray  # (a,) readings of the actuators at home [SI]
    findings: tuple[Finding, ...]  # notes of the robot file, and limits that home exceeds
    reachable: ReachableShare | None = None  # share of the stated workspace; None where none is

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(name="robot.name", path="robot.record.path", freedoms="robot.freedoms"),
        *fields(controlled="robot.controlled", size="robot.size", home="robot.home"),
        *fields(tool="robot.tool"),
        *fields(
            actuators=lambda inspection: [
                {"name": a.name, "dimension": a.dimension, "stroke": a.stroke}
                for a in inspection.robot.actuators
            ]
        ),
        *fields(parameters=lambda inspection: inspection.list_parameters()),
        *fields(common_errors="robot.parameters.common"),
        *fields(reachable=lambda found: found.reachable and found.reachable._asdict()),
        *fields(notes=lambda inspection: list(map(str, inspection.robot.findings)), findings=""),
    )

    def list_parameters(self) -> list[dict[str, Any]]:
        """Return what the robot states of each parameter [SI]."""
        entries = zip(self.robot.parameters.entries, self.robot.values, strict=True)
        return [
            {"name": p.name, "dimension": p.dimension, "nominal": p.nominal, "value": value}
            | {"tolerance": p.tolerance, "free": p.free}
            for p, value in entries
        ]


def inspect_robot(robot: Mechanism) -> RobotInspection:
    """Return the readings at home, the reachable share of the workspace, and findings.

    Home is near a singularity if it is so in units of the workspace's median, or if a motion of
    the platform and one of an actuator differ by a factor of 1 / FLAT.
    """
    solution = inverse(robot, robot.home[None])
    limits = evaluate_limits(robot, robot.values[None], solution.q[None], solution.state)
    exceeded = tuple(limit.name for limit in limits if limit.margin[0, 0] < -ROUNDING)
    proposal = propose_added_joints(robot)
    findings = [*robot.findings, *(() if proposal is None else (proposal,))]
    if exceeded:
        findings.append(report_finding("workflow.home-exceeds-limits", names=exceeded))
    if not len(robot.parameters):
        findings.append(report_finding("workflow.no-unknowns"))
    if not SMALL <= robot.size <= LARGE:
        size = robot.to_quantity(robot.size, Dimension.LENGTH)
        findings.append(report_finding("workflow.unusual-size", size=size))
    reachable = measure_reachable_share(robot, POSITIONS)
    has_medians = reachable is None or reachable.share > FEW_REACHED
    home = analyze_singularity(robot, solution, None if has_medians else (FLAT, FLAT))
    clearance = min(home.ratio[0] / NEAR_SHARE, home.margin[0] / FLAT)
    of_drives = min(home.drive_ratio[0] / NEAR_SHARE, home.drive_margin[0] / FLAT)
    if min(clearance, of_drives) < 1.0:
        is_weak = of_drives < clearance
        findings.append(
            report_finding(
                "workflow.home-near-singularity",
                actuator=home.actuators[home.drive[0]] if is_weak else None,
                motion=home.motion(0),
                margin=float((home.drive_margin if is_weak else home.margin)[0]),
            )
        )
    if reachable is not None and reachable.high < ENOUGH:
        reasons = reachable.reasons
        findings.append(
            report_finding(
                "workflow.unreachable-workspace",
                name=robot.name,
                share=reachable.share,
                low=reachable.low,
                high=reachable.high,
                count=reachable.positions,
                reasons=tuple(reasons),
                shares=tuple(number / reachable.positions for number in reasons.values()),
            )
        )
    return RobotInspection(robot, solution.q[0], tuple(findings), reachable)
