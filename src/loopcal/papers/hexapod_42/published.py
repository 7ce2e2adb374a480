# SPDX-License-Identifier: Apache-2.0
"""The printed numbers of the paper, and the machine of its Tables 2 and 3."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from loopcal.mechanism.model import Mechanism
from loopcal.papers.printed import Printed, read_content
from loopcal.typing import FloatArray

MM = 1e-3
LEGS = tuple(f"leg{i}" for i in range(1, 7))
PARAMETERS = ("base.x", "base.y", "base.z", "length", "platform.x", "platform.y", "platform.z")
"""Our names for the columns of Tables 2, 3 and 5."""

ODD_POSE = "A2"
"""The row of Table 4 that belongs to another machine. The outlier search of table_4_study.py
finds it without being told.
"""
TO_PRINTED = np.array([1.0 / MM] * 3 + [1.0] * 3)
"""From [m, rad] to the units of Tables 4 and 6."""


@dataclass(frozen=True)
class Published:
    """The printed tables and statements; see published.yaml."""

    source: str
    statements: Mapping[str, Any]
    nominal: Printed
    errors: Printed
    nominal_poses: Printed
    measured_poses: Printed
    pose_errors: Printed
    parameter_errors_before: Printed
    parameter_errors_after: Printed
    pose_errors_before: Printed
    pose_errors_after: Printed

    @property
    def threshold(self) -> float:
        """Value of max dQint [mm + rad] at which the iteration ends."""
        return float(self.statements["threshold"]["value"])

    @property
    def iterations(self) -> int:
        """Iterations after which the paper meets it."""
        return int(self.statements["iterations"]["value"])

    @property
    def noise(self) -> float:
        """Limit of the stated noise [m]."""
        return float(self.statements["noise"]["value"]) * MM

    @property
    def order(self) -> str:
        """Euler order of the printed rotation matrix, in our names."""
        return self.statements["rotation"]["order"]


@cache
def read_published() -> Published:
    """Read published.yaml."""
    content = read_content(__file__)
    tables = {
        "nominal": content["table_2"],
        "errors": content["table_3"],
        "nominal_poses": content["table_4"]["PT"],
        "measured_poses": content["table_4"]["PP"],
        "pose_errors": content["table_4"]["E1"],
        **{f"parameter_errors_{when}": block for when, block in content["table_5"].items()},
        **{f"pose_errors_{when}": block for when, block in content["table_6"].items()},
    }
    printed = {name: Printed.parse(block) for name, block in tables.items()}
    return Published(source=content["source"], statements=content, **printed)


def load_nominal_machine() -> Mechanism:
    """Return the hexapod of Table 2 (the shipped robot hexapod-42)."""
    from loopcal.io.robot.robot_file import load_robot

    return load_robot("hexapod-42")


def make_true_machine(robot: Mechanism, errors: FloatArray, leg_lengths: bool = True) -> Mechanism:
    """Return the hexapod with errors.

    Parameters
    ----------
    robot : nominal. errors : (6, 7) [m] in the layout of Table 3. leg_lengths : False leaves out
        the errors of the leg lengths.
    """
    assumed = errors.copy()
    if not leg_lengths:
        assumed[:, PARAMETERS.index("length")] = 0.0
    return robot.with_values(robot.parameters.nominal + to_values(robot, assumed))


def to_values(robot: Mechanism, table: FloatArray) -> FloatArray:
    """Return values (p,) in the robot's order of a table (6, 7) in the paper's layout."""
    values = np.zeros(len(robot.parameters))
    values[_find_places(robot)] = table
    return values


def to_table(robot: Mechanism, values: FloatArray) -> FloatArray:
    """Return a table (6, 7) in the paper's layout of values (p,) in the robot's order."""
    return values[_find_places(robot)]


def _find_places(robot: Mechanism) -> np.ndarray:
    return np.array(
        [[robot.parameters.index(f"{leg}.{name}") for name in PARAMETERS] for leg in LEGS]
    )
