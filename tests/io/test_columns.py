# SPDX-License-Identifier: Apache-2.0
"""Every registered column reads the values that it writes."""

import numpy as np
import pytest

from loopcal.io.core.csv_table import format_row, read_table
from loopcal.io.data.columns import TextColumn, find_open_column, is_context, list_columns
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.kinds.poses import Component, Pose

ROBOT = load_robot("hexapod-42")
COLUMNS = list_columns(ROBOT, [Component(("z",)), Pose("quaternion")])
OPEN_ENDED = ("temperature.bed", "note of the day")


@pytest.mark.parametrize("name", [*COLUMNS, *OPEN_ENDED])
def test_column_reads_the_values_that_it_writes(tmp_path, name) -> None:
    column = COLUMNS.get(name) or find_open_column(name)
    assert column is not None
    is_text = isinstance(column, TextColumn)
    values = (column.choices or ("a", 'b,"c"')) if is_text else (0.1, 1 / 3)
    rows = [format_row([f"p{i}", column.format(value)]) for i, value in enumerate(values)]
    lines = [format_row(["first", column.header]), *rows]
    (tmp_path / "data.csv").write_text("\n".join(lines) + "\n")
    read = column.parse(read_table(tmp_path / "data.csv"))
    if is_text:
        assert read == values
    else:
        np.testing.assert_allclose(np.asarray(read), np.asarray(values, float), rtol=3e-16)


def test_open_ended_columns_are_recognized_by_their_names() -> None:
    assert is_context("temperature.bed")
    assert not is_context("temperature.")
    assert find_open_column("temperatures") is None
