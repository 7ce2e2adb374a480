# SPDX-License-Identifier: Apache-2.0
"""A study file to begin with."""

from __future__ import annotations

import json
import os
from importlib.resources import files
from pathlib import Path

from loopcal.io.core.text_file import write_text
from loopcal.io.robot.robot_file import find_robot_file, list_shipped_robots, load_robot

PLACE = "ROBOT"
"""Stands for the robot in the template."""


def write_template(path: Path, robot: str) -> None:
    """Write a study file with a comment for each setting.

    Parameters
    ----------
    robot : name of a shipped robot, or a robot file, which is named relative to the study file.

    Raises
    ------
    FileError : there is no such robot, it cannot be read, or the file cannot be written.
    """
    load_robot(robot)
    text = (files("loopcal.studies.files") / "template.yaml").read_text("utf-8")
    write_text(path, text.replace(f"[{PLACE}]", f"[{quote_robot(path, robot)}]"))


def quote_robot(path: Path, robot: str) -> str:
    """Return how a study file names a robot: a shipped one by its name, another one by its file,
    relative to the study file.

    Raises
    ------
    FileError : there is no such robot.
    """
    file, name = find_robot_file(robot), robot
    if robot not in list_shipped_robots():
        name = Path(os.path.relpath(file, path.parent)).as_posix()
    return name if name.replace("-", "").isalnum() else json.dumps(name, ensure_ascii=False)
