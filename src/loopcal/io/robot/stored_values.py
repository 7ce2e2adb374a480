# SPDX-License-Identifier: Apache-2.0
"""Stored values of parameters to compare a fit with: published ones, or those of a firmware.

The file is a robot file, such as an imported printer.cfg, or a file with the table `identified`
alone, which may list some of the parameters.
"""

from __future__ import annotations

from pathlib import Path

from loopcal.io.core.yaml_file import read_yaml, refuse_unknown_keys
from loopcal.io.robot.identified_table import EXAMPLE, TABLE, read_rows
from loopcal.io.robot.robot_file import build_robot, find_robot_file
from loopcal.mechanism import Mechanism

WHAT = "file of stored values"


def load_stored_values(path: str | Path, robot: Mechanism) -> dict[str, float] | Mechanism:
    """Return the stored values of a robot's parameters by name [SI], or a robot that has them.

    Parameters
    ----------
    path : a robot file, or a file with the table `identified`. robot : that is calibrated.

    Raises
    ------
    FileError : unreadable, neither of the two, or a bad row; with its line.
    """
    file = read_yaml(find_robot_file(path), WHAT)
    if "family" in file.content:
        return build_robot(file)
    if TABLE not in file.content:
        raise file.error(
            f"neither a robot file nor a list of values; write a list {TABLE!r} of {EXAMPLE}"
        )
    refuse_unknown_keys(file, list(file.content), (TABLE,))
    return read_rows(file, robot)
