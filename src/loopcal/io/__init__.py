# SPDX-License-Identifier: Apache-2.0
"""Files: robots, measurements, run folders."""

from loopcal.io.robot_file import load_robot as load_robot
from loopcal.io.robot_file import save_robot as save_robot
