# SPDX-License-Identifier: Apache-2.0
"""The robot of most measurement files of these tests, and a function that writes files."""

import pytest

from loopcal.io.robot.robot_file import load_robot


@pytest.fixture(scope="session")
def robot():
    return load_robot("hexapod-42")


@pytest.fixture
def write_files(tmp_path):
    """Return a function that writes CSV files by name and returns their paths."""

    def write(**texts: str):
        paths = [tmp_path / f"{name}.csv" for name in texts]
        for path, text in zip(paths, texts.values(), strict=True):
            path.write_text(text, encoding="utf-8")
        return paths

    return write
