# SPDX-License-Identifier: Apache-2.0
"""Files: robots, measurements, run folders, and files of other programs.

This package parses and writes. It uses the types of lower layers, and leaves computations to them.
"""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.io.data.measurement_file import load_measurements as load_measurements
    from loopcal.io.data.measurement_writer import save_measurements as save_measurements
    from loopcal.io.robot.robot_file import load_robot as load_robot
    from loopcal.io.robot.robot_file import save_robot as save_robot
    from loopcal.io.robot.stored_values import load_stored_values as load_stored_values
    from loopcal.io.runs.run import Run as Run
    from loopcal.io.runs.run_folder import load_run as load_run
    from loopcal.io.runs.run_folder import save_run as save_run
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.io.data.measurement_file": "load_measurements",
            "loopcal.io.data.measurement_writer": "save_measurements",
            "loopcal.io.robot.robot_file": "load_robot save_robot",
            "loopcal.io.robot.stored_values": "load_stored_values",
            "loopcal.io.runs.run": "Run",
            "loopcal.io.runs.run_folder": "load_run save_run",
        },
    )
