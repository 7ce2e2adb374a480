# SPDX-License-Identifier: Apache-2.0
"""The robot of most measurement files of these tests."""

import pytest

from loopcal.io.robot.robot_file import load_robot


@pytest.fixture(scope="session")
def robot():
    return load_robot("hexapod-42")
