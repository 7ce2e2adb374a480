# SPDX-License-Identifier: Apache-2.0
"""A robot with a slider for each actuator, in a browser, by the optional package viser.

Every change of a slider solves the pose from the pose before. Readings that lead to no pose leave
the robot where it is, and the page says why.
"""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from threading import Lock
from typing import Any

import numpy as np

from loopcal.diagnose.error_frames import solve_home
from loopcal.mechanism import Mechanism, Solution
from loopcal.optional_packages import import_optional
from loopcal.plain_text import escape
from loopcal.report.scene.live_axes import Axis, list_axes, solve_axes
from loopcal.report.scene.robot_parts import LINES, Part, is_planar, list_parts
from loopcal.report.scene.scene import round_down
from loopcal.report.scene.scene_data import describe_part
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit

EXTRA = "viser"
HOST = "127.0.0.1"
"""Other computers cannot reach the page."""

PORT = 8080
"""Port of the page, where it is free."""

TUBE, THIN, BALL = 0.012, 0.004, 0.03
"""Thickness of the robot's and of the base's lines, and size of points, as shares of its size."""

STEPS, PLACES = 200, 3
"""Least number of steps of a slider, and decimals of its ends [mm or deg]."""

PALE = "#e8e8e8"
"""Color of joints without a drive."""


class LiveView:
    """A robot in a browser until `stop` is called.

    Parameters
    ----------
    robot : to show. port : of this computer; where it is taken, the next free one.

    Attributes
    ----------
    server : of viser. axes : what can be changed. sliders : one for each axis, in its unit.
    text : on the page, the place of the tool or why there is no pose. solution : the shown pose.

    Raises
    ------
    MissingPackageError : viser is not installed.
    """

    def __init__(self, robot: Mechanism, port: int = PORT) -> None:
        viser = import_optional("viser", EXTRA)
        self.robot: Mechanism = robot
        self.axes: tuple[Axis, ...] = list_axes(robot)
        self.solution: Solution = solve_home(robot)
        self._lock = Lock()
        with redirect_stdout(StringIO()):  # a table of addresses
            self.server: Any = viser.ViserServer(HOST, port, escape(robot.name), verbose=False)
        self._draw_floor()
        self.text: Any = self.server.gui.add_markdown("")
        self.sliders: list[Any] = [self._add_slider(i) for i in range(len(self.axes))]
        self.server.gui.add_button("home").on_click(lambda _: self.move_home())
        self._draw_robot()

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server.get_port()}"

    def stop(self) -> None:
        """Close the page."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    def move(self, values: FloatArray) -> bool:
        """Show the robot at values (c,) of its axes [m or rad]; return whether there is a pose."""
        with self._lock:
            solution = solve_axes(self.robot, values, self.solution)
            if not solution.converged[0]:
                self.text.content = f"No pose: {solution.explain(0)}. The robot stays where it was."
                return False
            self.solution = solution
            self._draw_robot()
            return True

    def move_home(self) -> None:
        """Show the robot at home."""
        for slider, axis in zip(self.sliders, self.axes, strict=True):
            slider.value = _round(axis.home / axis.unit.factor_to_si)
        self.move(np.array([axis.home for axis in self.axes]))

    def read_sliders(self) -> FloatArray:
        """Return the values (c,) of the sliders [m or rad]."""
        pairs = zip(self.sliders, self.axes, strict=True)
        return np.array([slider.value * axis.unit.factor_to_si for slider, axis in pairs])

    def _add_slider(self, i: int) -> Any:
        """Return a slider for axis i, which moves the robot."""
        axis = self.axes[i]
        ends = (axis.low, axis.high, axis.home)
        low, high, home = (_round(value / axis.unit.factor_to_si) for value in ends)
        step = round_down(max(high - low, 10.0**-PLACES) / STEPS)
        name = f"{escape(axis.name)} [{axis.unit.symbol}]"
        slider = self.server.gui.add_slider(name, low, max(high, low + step), step, home)
        slider.on_update(lambda _: self.move(self.read_sliders()))
        return slider

    def _draw_floor(self) -> None:
        """Draw base and floor, and look from above at planar robots, from the side at others."""
        parts = list_parts(self.robot, self.robot.home_state)
        points = np.concatenate([part.points[0] for part in parts]) / self.robot.size
        low, high = points.min(axis=0), points.max(axis=0)
        middle, reach = (low + high) / 2, float(np.linalg.norm(high - low))
        scene = self.server.scene
        scene.set_up_direction("+z")
        floor = (float(middle[0]), float(middle[1]), float(low[2] - 0.02))
        scene.add_grid(
            "/floor", 2 * reach, 2 * reach, cell_size=0.1, section_size=0.5, position=floor
        )
        self._draw_lines("base", [part for part in parts if part.role == "base"], THIN)
        camera = self.server.initial_camera
        camera.look_at = tuple(middle)
        offset = np.array([0.0, -0.01, 1.3] if is_planar(self.robot) else [0.22, -0.85, 0.4])
        camera.position = tuple(middle + reach * offset)

    def _draw_robot(self) -> None:
        """Draw the robot at its pose, and state the place of the tool."""
        parts = list_parts(self.robot, self.solution.state)
        lines = [part for part in parts if part.role in LINES and part.role != "base"]
        dots = [part for part in parts if part.role not in LINES]
        looks = [describe_part(part) for part in dots]
        colors = [_parse_color(look["color"] if look["filled"] else PALE) for look in looks]
        points = np.concatenate([part.points[0] for part in dots]) / self.robot.size
        with self.server.atomic():
            self._draw_lines("limbs", lines, TUBE)
            self.server.scene.add_point_cloud(
                "/robot/joints",
                points,
                np.array(colors, np.uint8),
                point_size=BALL,
                point_shape="circle",
                precision="float32",
            )
        self.text.content = describe_tool(self.robot, self.solution)

    def _draw_lines(self, name: str, parts: list[Part], thickness: float) -> None:
        """Draw parts as lines, in the unit of the robot's size."""
        pieces = [part.points[0] / self.robot.size for part in parts]
        begins, ends = (
            np.concatenate(c) for c in zip(*((p[:-1], p[1:]) for p in pieces), strict=True)
        )
        colors = np.array(
            [
                [_parse_color(describe_part(part)["color"])] * 2
                for part, piece in zip(parts, pieces, strict=True)
                for _ in piece[1:]
            ],
            np.uint8,
        )
        segments = np.stack([begins, ends], axis=1)
        self.server.scene.add_line_segments(f"/robot/{name}", segments, colors, thickness=thickness)


def describe_tool(robot: Mechanism, solution: Solution) -> str:
    """Return the tool point of a solution of one row, in the base frame."""
    unit = find_unit(robot.units[Dimension.LENGTH])
    place = (solution.T[0] @ robot.tool)[:3, 3] / unit.factor_to_si
    values = ", ".join(f"{n} {_round(value):.3f}" for n, value in zip("xyz", place, strict=True))
    return f"Tool in the base frame: {values} {unit.symbol}"


def _parse_color(text: str) -> list[int]:
    """Return red, green and blue of a color such as #0072b2."""
    return [int(text[i : i + 2], 16) for i in (1, 3, 5)]


def _round(value: float) -> float:
    """Return a number for the screen, without the rounding errors of home and without -0."""
    return round(float(value), PLACES) + 0.0
