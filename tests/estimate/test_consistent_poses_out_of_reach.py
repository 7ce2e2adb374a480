# SPDX-License-Identifier: Apache-2.0
"""Gaps that no pose can have do not keep the search for consistent poses busy."""

import warnings

from loopcal import engine
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.robot.robot_file import load_robot
from loopcal.numerics.gauss_newton import DescentStatus

ROWS = """\
# kind: line
# noise: {gap_a: "10 um", gap_b: "10 um"}
pose,left [deg],right [deg],gap_a [mm],gap_b [mm]
1,135.66,43.15,2.8,1e5
2,119.84,6.85,108.1,1e5
3,157.29,59.91,-85.4,1e5
4,109.98,26.77,107.7,1e5
5,156.93,45.07,-45.2,1e5
6,145.38,42.90,-18.4,1e5
7,128.11,12.07,78.7,1e5
8,153.38,37.63,-21.8,1e5
"""


def test_gaps_of_a_hundred_meters_end_early_and_without_a_warning(tmp_path, monkeypatch) -> None:
    (tmp_path / "line.csv").write_text(ROWS, "utf-8")
    robot = load_robot("five-bar")
    data = load_measurements(tmp_path / "line.csv", robot)
    calls, solve = [], engine.solve

    def counted(*args, **options):
        calls.append(1)
        return solve(*args, **options)

    monkeypatch.setattr(engine, "solve", counted)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = identify(robot, data, MAP())
    assert fit.history.status != DescentStatus.CONVERGED
    assert len(calls) < 600  # more than a thousand where each step is halved to its end
