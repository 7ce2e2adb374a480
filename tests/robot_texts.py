# SPDX-License-Identifier: Apache-2.0
"""Robots of texts that a test writes."""

from pathlib import Path

from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.model import Mechanism


def load_text(folder: Path, text: str) -> Mechanism:
    """Return the robot of a file with this text."""
    path = folder / "robot.yaml"
    path.write_text(text, "utf-8")
    return load_robot(path)
