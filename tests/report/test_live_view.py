# SPDX-License-Identifier: Apache-2.0
"""The live view by viser: a real server on this computer, moved without a browser."""

from urllib.request import urlopen

import numpy as np
import pytest
from numpy.testing import assert_allclose

import loopcal as lc
from loopcal.errors import MissingPackageError
from loopcal.report.scene import live_view
from loopcal.report.scene.live_axes import list_axes, solve_axes
from loopcal.report.scene.live_view import LiveView

pytestmark = pytest.mark.slow


def test_sliders_move_the_robot_and_readings_without_pose_leave_it(capsys) -> None:
    pytest.importorskip("viser")
    robot = lc.load_robot("five-bar")
    view = LiveView(robot, 18080)
    try:
        with urlopen(view.address, timeout=10) as answer:
            assert b"<html" in answer.read()
        assert [axis.name for axis in view.axes] == ["left", "right"]
        home = view.read_sliders()
        readings = home + np.deg2rad([4.0, -3.0])
        assert view.move(readings)
        assert_allclose(view.solution.T, lc.forward(robot, readings).T, atol=1e-9)  # [m]
        x = 1e3 * view.solution.T[0, 0, 3]
        assert f"x {x:.3f}, y " in view.text.content
        assert view.text.content.endswith(" mm")
        assert not view.move(np.deg2rad([45.0, 135.0]))
        assert "No pose: " in view.text.content
        assert_allclose(view.solution.q[0], readings)
        view.move_home()
        assert_allclose(view.solution.q[0], home, atol=1e-5)  # [rad], the sliders' decimals
        second = LiveView(robot, 18080)  # the port is taken
        assert second.address != view.address
        second.stop()
    finally:
        view.stop()
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("name", ["cable-4", "3-prs", "linear-delta"])
def test_axes_contain_home_and_can_be_changed_one_at_a_time(name: str) -> None:
    """The four cables of a robot cannot: its axes are the coordinates of the platform."""
    robot = lc.load_robot(name)
    axes = list_axes(robot)
    home = np.array([axis.home for axis in axes])
    start = solve_axes(robot, home, lc.forward(robot, robot_home(robot)))
    assert start.converged.all()
    assert len(axes) == (3 if name == "cable-4" else len(robot.actuators))
    for i, axis in enumerate(axes):
        assert axis.low <= axis.home <= axis.high
        assert axis.low < axis.high
        values = home.copy()
        values[i] += 0.01 * (axis.high - axis.low) * (1 if axis.home < axis.high else -1)
        assert solve_axes(robot, values, start).converged.all()


def robot_home(robot: lc.Mechanism) -> np.ndarray:
    """Return the readings (1, a) at home."""
    return lc.inverse(robot, robot.home_state.T[0]).q


def test_missing_package_is_named_with_its_extra(monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'loopcal\[viser\]'"):
        live_view.LiveView(lc.load_robot("five-bar"))
