# SPDX-License-Identifier: Apache-2.0
"""Draw the diagrams of docs/pictures: delta-geometry, frames and phone-and-board.

python -m tools.diagrams
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import loopcal as lc
from loopcal.report.figures.style import COLORS, DARK, FRAME_COLORS
from loopcal.report.scene.scene import list_parts
from tools.rendering import save_picture

PICTURES = Path(__file__).resolve().parent.parent / "docs" / "pictures"
BLUE, ORANGE, GREEN = COLORS[:3]
GREY = "#8a94a0"
TEXT = 14


def dimension(axes: Any, start: Any, end: Any, text: str, place: Any, color: str = DARK) -> None:
    """Draw an arrow with two heads and the name of the dimension beside its middle."""
    style = {"arrowstyle": "<|-|>", "color": color, "lw": 2.0, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=style)
    middle = tuple(np.add(start, end) / 2)
    axes.annotate(
        text, middle, place, textcoords="offset points", fontsize=TEXT, color=color,
        ha="center", va="center",
    )  # fmt: skip


def draw_delta() -> Figure:
    """Draw the numbers of a linear delta from the side and from above."""
    figure = Figure(figsize=(12.0, 6.6), facecolor="white")
    side = figure.add_axes((0.02, 0.02, 0.5, 0.9))
    above = figure.add_axes((0.53, 0.02, 0.46, 0.9))
    radius, rod, effector, home = 105.0, 220.0, 26.0, 150.0
    rise = np.sqrt(rod**2 - radius**2)
    tower, top = radius + effector, home + rise
    side.plot([-tower, -tower], [-20, top + 70], color=GREY, lw=9, solid_capstyle="butt")
    side.plot([-tower - 60, 90], [-8, -8], color=DARK, lw=7)
    side.text(40, -28, "bed", fontsize=TEXT, color=DARK)
    for z, alpha in ((home, 1.0), (0.0, 0.3)):
        side.plot([-tower, -effector], [z + rise, z], color=BLUE, lw=6, alpha=alpha)
        side.plot([-effector, effector], [z, z], color=DARK, lw=7, alpha=alpha)
        side.plot([0, 0], [z, z - 6], color=DARK, lw=3, marker="v", ms=14, alpha=alpha)
        side.plot(-tower, z + rise, "s", color=ORANGE, ms=22, alpha=alpha)
    side.plot([-tower - 28, -tower + 28], [top + 16] * 2, color=DARK, lw=6)
    rule = "end stop k\nMarlin: H - M666 k (never above 0)\nRepRapFirmware: H + M666 k"
    side.text(-tower + 40, top + 44, rule, fontsize=TEXT - 1, color=DARK, va="center")
    dimension(side, (45, 0), (45, home), "H", (16, 0), GREEN)
    side.text(58, home + 16, "height at home", fontsize=TEXT - 2, color=GREEN, ha="center")
    dimension(side, (-tower, -44), (-effector, -44), "R, delta radius", (0, -16), BLUE)
    for x, low in ((-tower, -20), (-effector, -8)):
        side.plot([x, x], [-50, low], color=BLUE, lw=1, ls=":")
    side.text(-tower / 2 + 4, home + rise / 2 + 16, "L, rod", fontsize=TEXT, color=BLUE)
    lower = top - 42
    side.plot([-tower - 40, -tower + 40], [lower] * 2, color=DARK, lw=2, ls="--")
    dimension(side, (-tower - 50, top + 16), (-tower - 50, lower), "", (0, 0), ORANGE)
    side.text(-tower - 60, (top + lower) / 2 + 8, "M666 k", fontsize=TEXT, color=ORANGE, ha="right")
    side.text(-tower + 46, lower, "H", fontsize=TEXT, color=GREEN, va="center")
    side.set(xlim=(-290, 110), ylim=(-90, top + 90))
    draw_towers(above, 105.0)
    for axes, title in ((side, "from the side"), (above, "from above")):
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(title, fontsize=TEXT, color=DARK)
    return figure


def draw_towers(axes: Any, radius: float) -> None:
    """Draw the places of three towers with the sense in which their angles grow."""
    angles = np.linspace(0, 2 * np.pi, 200)
    axes.plot(radius * np.cos(angles), radius * np.sin(angles), color=GREY, lw=1.5, ls="--")
    for name, text, angle in (
        ("A", "210° + X", 210), ("B", "330° + Y", 330), ("C", "90° + Z", 90)
    ):  # fmt: skip
        x, y = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        axes.plot([0, radius * x], [0, radius * y], color=BLUE, lw=4)
        axes.plot(radius * x, radius * y, "o", color=GREY, ms=34)
        middle: dict[str, Any] = {"ha": "center", "va": "center"}
        axes.text(radius * x, radius * y, name, color="white", fontsize=TEXT + 2, **middle)
        place = (1.42 * radius * x, 1.42 * radius * y)
        axes.text(*place, text, fontsize=TEXT, color=ORANGE, **middle)
        turn = np.radians(angle + np.linspace(10, 34, 20))
        path = 1.12 * radius * np.array([np.cos(turn), np.sin(turn)])
        axes.plot(*path, color=ORANGE, lw=3)
        style = {"arrowstyle": "-|>", "color": ORANGE, "lw": 3, "mutation_scale": 22}
        axes.annotate("", path[:, -1] + (path[:, -1] - path[:, -3]), path[:, -3], arrowprops=style)
    for tip, name, color in (((48, 0), "x", FRAME_COLORS[0]), ((0, 48), "y", FRAME_COLORS[1])):
        style = {"arrowstyle": "-|>", "color": color, "lw": 3, "mutation_scale": 20}
        axes.annotate("", tip, (0, 0), arrowprops=style)
        axes.text(tip[0] * 1.2 + 4, tip[1] * 1.05 + 6, name, fontsize=TEXT, color=color)
    words = "positive: counterclockwise"
    axes.text(0, -1.25 * radius, words, fontsize=TEXT, color=ORANGE, ha="center")
    axes.set(xlim=(-1.85 * radius, 1.85 * radius), ylim=(-1.5 * radius, 1.5 * radius))


def draw_robot(axes: Any, robot: Any) -> None:
    """Draw a robot at home [mm]."""
    for part in list_parts(robot, robot.home_state):
        points = 1e3 * part.points[0]
        if part.role in ("base", "platform"):
            axes.plot(*points.T, color=DARK, lw=4)
        elif part.role in ("rod", "limb"):
            axes.plot(*points.T, color=GREY, lw=6, solid_capstyle="round")


def draw_board(axes: Any, T: Any, square: float = 17.0) -> Any:
    """Draw a board of 10 x 7 squares with its middle at a pose (4, 4) [mm]; return its corners."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    for i in range(10):
        for j in range(7):
            flat = np.add(corners, (i - 5, j - 3.5)) * square
            places = T[:3, 3] + flat @ T[:3, :2].T
            color = DARK if (i + j) % 2 else "white"
            axes.add_collection3d(
                Poly3DCollection([places], facecolor=color, edgecolor=DARK, lw=0.4)
            )
    ends = np.array([(-5, -3.5), (5, -3.5), (5, 3.5), (-5, 3.5)]) * square
    return T[:3, 3] + ends @ T[:3, :2].T


def draw_phone(axes: Any, place: Any, corners: Any) -> None:
    """Draw a phone at a place that sees the corners of a board [mm]."""
    target = np.mean(corners, axis=0)
    ahead = np.subtract(target, place) / np.linalg.norm(np.subtract(target, place))
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    body = [place + 34 * x * right + 68 * y * up for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    axes.plot(*np.transpose([*body, body[0]]), color=BLUE, lw=4)
    for corner in corners:
        axes.plot(*np.transpose([place, corner]), color=ORANGE, lw=1.6, ls="--")
    axes.text(*(place + 92 * up + 46 * right), "phone", fontsize=TEXT, color=BLUE)


def draw_phone_and_board() -> Figure:
    """Draw where phone and board are, on a hexapod, a delta and a five-bar."""
    figure = Figure(figsize=(13.0, 4.9), facecolor="white")
    for k, (name, title, away) in enumerate(
        (
            ("hexapod-42", "hexapod: at an angle", (300.0, -230.0, 210.0)),
            ("rotary-delta", "delta: tilted, from below", (170.0, -120.0, -560.0)),
            ("five-bar", "five-bar: tilted, from above", (150.0, -260.0, 430.0)),
        )
    ):
        robot = lc.load_robot(name)
        axes: Any = figure.add_axes((0.005 + 0.332 * k, -0.06, 0.326, 1.02), projection="3d")
        draw_robot(axes, robot)
        T = np.array(robot.home)
        T[:3, 3] *= 1e3
        T[2, 3] += -14.0 if name == "rotary-delta" else 14.0
        draw_phone(axes, T[:3, 3] + np.array(away), draw_board(axes, T))
        figure.text(0.168 + 0.332 * k, 0.93, title, fontsize=TEXT, color=DARK, ha="center")
        axes.set_box_aspect(None, zoom=1.75)
        axes.set_aspect("equal")
        axes.view_init(elev=18 if name != "rotary-delta" else -14, azim=-62)
        axes.set_axis_off()
    return figure


def draw_frames() -> Figure:
    """Draw the frames of base, platform, tool and tracker at a hexapod, and what joins them."""
    robot = lc.load_robot("hexapod-42")
    figure = Figure(figsize=(10.0, 6.2), facecolor="white")
    axes: Any = figure.add_axes((-0.16, -0.22, 1.3, 1.42), projection="3d")
    draw_robot(axes, robot)
    platform = robot.home[:3, 3] * 1e3
    nest, tracker = platform + np.array([70.0, -60.0, 45.0]), np.array([560.0, -60.0, 120.0])
    turn = np.radians(35.0)
    turned = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    for name, origin, rotation, place in (
        ("base", np.zeros(3), np.eye(3), (-30, 0, -52)),
        ("platform", platform, np.eye(3), (-95, 0, 62)),
        ("tracker", tracker, turned, (-10, 0, 92)),
    ):
        for k in range(3):
            end = origin + 75.0 * rotation[:, k]
            axes.quiver(*origin, *(end - origin), color=FRAME_COLORS[k], lw=4)
        axes.text(*(origin + place), name, fontsize=TEXT + 3, weight="bold", color=DARK, zorder=20)
    axes.plot(*tracker, "o", color=DARK, ms=14)
    axes.plot(*np.transpose([platform, nest]), color=DARK, lw=2, ls=":")
    axes.plot(*nest, "o", color=ORANGE, ms=13)
    axes.text(*(nest + np.array([-20, 0, 24])), "SMR1, a target", fontsize=TEXT, color=ORANGE)
    axes.plot(*np.transpose([tracker, nest]), color=ORANGE, lw=2.5)
    axes.text(
        *((tracker + nest) / 2 + np.array([10, 0, 28])), "measured", fontsize=TEXT, color=ORANGE
    )
    axes.plot(*np.transpose([np.zeros(3), tracker]), color=BLUE, lw=2.5, ls="--")
    axes.text(270, -40, 8, "unknown: [frame]", fontsize=TEXT, color=BLUE)
    axes.set_box_aspect((2.3, 1.0, 0.9), zoom=1.35)
    axes.set(xlim=(-200, 620), ylim=(-180, 180), zlim=(-30, 290))
    axes.view_init(elev=20, azim=-62)
    axes.set_axis_off()
    return figure


def main() -> int:
    """Draw the diagrams."""
    drawn = {"delta-geometry": draw_delta, "frames": draw_frames}
    drawn["phone-and-board"] = draw_phone_and_board
    for name, draw in drawn.items():
        save_picture(PICTURES / f"{name}.png", draw(), 110)
    return 0


if __name__ == "__main__":
    sys.exit(main())
