# SPDX-License-Identifier: Apache-2.0
"""Files: robots, measurements, run folders."""

from loopcal.io.data.measurement_file import load_measurements as load_measurements
from loopcal.io.data.measurement_writer import save_measurements as save_measurements
from loopcal.io.robot.robot_file import load_robot as load_robot
from loopcal.io.robot.robot_file import save_robot as save_robot
