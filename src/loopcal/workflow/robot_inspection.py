# SPDX-License-Identifier: Apache-2.0
"""Inspect a robot: its readings at home, and the limits that home exceeds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from loopcal.findings import Finding, report_finding
from loopcal.mechanism import Mechanism, evaluate_limits, inverse, propose_added_joints
from loopcal.typing import FloatArray

ROUNDING = 1e-9
"""How far home may exceed a limit by rounding [m or rad]."""


@dataclass(frozen=True, eq=False)
class RobotInspection:
    """A robot and what it does at home.

    Attributes
    ----------
    robot : the robot. home_readings : (a,) readings of the actuators at home [SI].
    findings : notes of the robot file, and limits that home exceeds.
    """

    robot: Mechanism
    home_readings: FloatArray
    findings: tuple[Finding, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the robot by name for JSON, SI."""
        robot, table = self.robot, self.robot.parameters
        return {
            "name": robot.name,
            "path": robot.record.path,
            "freedoms": robot.freedoms,
            "controlled": robot.controlled,
            "size": robot.size,
            "home": robot.home,
            "tool": robot.tool,
            "actuators": [
                {"name": a.name, "dimension": a.dimension, "stroke": a.stroke}
                for a in robot.actuators
            ],
            "parameters": [
                {
                    "name": p.name,
                    "dimension": p.dimension,
                    "nominal": p.nominal,
                    "value": robot.values[i],
                    "tolerance": p.tolerance,
                    "free": p.free,
                }
                for i, p in enumerate(table.entries)
            ],
            "common_errors": [
                {"name": c.name, "parameters": c.parameters, "tolerance": c.tolerance}
                for c in table.common
            ],
            "notes": [str(finding) for finding in robot.findings],
            "findings": self.findings,
        }


def inspect_robot(robot: Mechanism) -> RobotInspection:
    """Return the readings at home, and findings."""
    solution = inverse(robot, robot.home[None])
    limits = evaluate_limits(robot, robot.values[None], solution.q[None], solution.state)
    exceeded = tuple(limit.name for limit in limits if limit.margin[0, 0] < -ROUNDING)
    findings = list(robot.findings)
    proposal = propose_added_joints(robot)
    if proposal is not None:
        findings.append(proposal)
    if exceeded:
        findings.append(report_finding("workflow.home-exceeds-limits", names=exceeded))
    if not len(robot.parameters):
        findings.append(report_finding("workflow.no-unknowns"))
    return RobotInspection(robot, solution.q[0], tuple(findings))
