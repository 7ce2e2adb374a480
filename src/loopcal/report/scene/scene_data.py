# SPDX-License-Identifier: Apache-2.0
"""A scene as JSON for the script of the 3-D view (tools/viewer).

Points are in the length unit of the robot file, as base64 of 32-bit floats. The entries:

    name, unit, size, planar   of the robot
    parts     role, color, count of points, whether driven, and the shape of each part
    home      (P, 3) points of all parts at home, one part behind the other
    names     texts beside a point, such as those of limbs
    poses     tools, errors (n, 3) of the measured poses; labels, rows and robots (r, P, 3) of those
              at which the robot can be shown; magnification and colors
    map       points (n, 3) and colors of the accuracy map; null without
    legend    colors and their meaning
"""

from __future__ import annotations

import base64
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.mechanism import Mechanism
from loopcal.plain_text import escape
from loopcal.report.figures.style import COLORS, ERROR, FRAME_COLORS, POSE, SEQUENTIAL
from loopcal.report.scene.robot_parts import Part, is_planar, list_parts
from loopcal.report.scene.scene import PoseErrors, Scene
from loopcal.typing import FloatArray, IntArray
from loopcal.units import DISPLAY_UNITS, Dimension, Unit, find_unit

SCRIPT = Path(__file__).parent / "viewer.min.js"

MOST_NUMBERS = 200_000
"""Coordinates of robots at measured poses in one scene: 1.1 MB of text."""

BODY, BLACK, DRIVEN, UNBOUNDED = "#404040", "#000000", "#666666", "#8c8c8c"
"""Colors of the platform, of axes and the tool, of the legend of driven parts, and of poses whose
uncertainty is not bounded.
"""


@cache
def load_script() -> str:
    """Return the script of the 3-D view."""
    return SCRIPT.read_text("utf-8")


def choose_rows(robot: Mechanism, count: int) -> IntArray:
    """Return the rows, of so many, at which the robot can be shown: all, or evenly spread ones."""
    numbers = 3 * sum(part.points.shape[1] for part in list_parts(robot, robot.home_state))
    most = max(1, MOST_NUMBERS // numbers)
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, most).astype(np.intp))


def format_scene(scene: Scene) -> str:
    """Return a scene as JSON in which no text can end a script element."""
    robot = scene.robot
    unit = find_unit(robot.units[Dimension.LENGTH])
    parts = list_parts(robot, robot.home_state)
    data = {
        "name": escape(robot.name),
        "unit": unit.symbol,
        "size": robot.size / unit.factor_to_si,
        "planar": is_planar(robot),
        "parts": [describe_part(part) for part in parts],
        "home": _encode(_join(parts) / unit.factor_to_si),
        "names": _list_names(robot, parts, unit),
        "poses": _describe_poses(scene, unit),
        "map": _describe_map(scene, unit),
        "legend": _list_legend(scene, parts),
    }
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _encode(values: FloatArray) -> str:
    """Return numbers as base64 of 32-bit floats, the lowest byte first."""
    return base64.b64encode(values.astype("<f4").tobytes()).decode()


def _join(parts: tuple[Part, ...]) -> FloatArray:
    """Return the points of parts (n, P, 3), one part behind the other."""
    return np.concatenate([part.points for part in parts], axis=1)


def describe_part(part: Part) -> dict[str, Any]:
    """Return how a part is drawn."""
    colors = {"axis": BLACK, "tool": BLACK, "platform": BODY, "arm": BODY, "base": BODY}
    color = COLORS[part.index % len(COLORS)] if part.index >= 0 else BODY
    if part.role == "frame":
        color = FRAME_COLORS[part.index]
    return {
        "role": part.role,
        "color": colors.get(part.role, color),
        "count": part.points.shape[1],
        "filled": part.is_driven or part.role == "tool",
        "shape": "box" if part.role == "slide" else "ball",
    }


def _list_names(robot: Mechanism, parts: tuple[Part, ...], unit: Unit) -> list[dict[str, Any]]:
    """Return names beside the feet of limbs, and of the axes of the base frame."""
    feet = [(limb.name, part) for limb, part in zip(robot.assembly.limbs, parts, strict=False)]
    marks = [(name, describe_part(part)["color"], part.points[0, 0]) for name, part in feet]
    axes = [part for part in parts if part.role == "frame"]
    axis_names = "xy" if is_planar(robot) else "xyz"
    marks += [(name, FRAME_COLORS[i], axes[i].points[0, 1]) for i, name in enumerate(axis_names)]
    return [
        {"text": escape(name), "color": color, "point": (place / unit.factor_to_si).tolist()}
        for name, color, place in marks
    ]


def _describe_poses(scene: Scene, unit: Unit) -> dict[str, Any]:
    """Return measured poses with errors; those of a scene without are empty."""
    robot, poses = scene.robot, scene.poses
    rows = np.arange(0) if poses is None else choose_rows(robot, len(poses.tool))
    nothing = np.zeros((0, 3))
    tools, errors = (nothing, nothing) if poses is None else (poses.tool, poses.error)
    robots = nothing
    if poses is not None and len(rows):
        robots = _join(list_parts(robot, poses.solution.take(rows).state))
    return {
        "labels": [] if poses is None else [escape(poses.labels[i]) for i in rows],
        "rows": rows.tolist(),
        "robots": _encode(robots / unit.factor_to_si),
        "tools": _encode(tools / unit.factor_to_si),
        "errors": _encode(errors / unit.factor_to_si),
        "magnification": 1.0 if poses is None else poses.magnification,
        "colors": {"pose": POSE, "error": ERROR},
    }


def _describe_map(scene: Scene, unit: Unit) -> dict[str, Any] | None:
    """Return the reached poses of the accuracy map with their colors."""
    from matplotlib import colormaps
    from matplotlib.colors import Normalize, to_hex

    if scene.accuracy is None:
        return None
    points, values = scene.map_points, scene.accuracy.uncertainty.position
    reached = np.isfinite(points).all(axis=1)
    known = np.isfinite(values)
    if not (reached & known).any():
        return None
    scale = Normalize(values[known].min(), values[known].max())
    shades = [
        to_hex(colormaps[SEQUENTIAL](scale(value))) if np.isfinite(value) else UNBOUNDED
        for value in values[reached]
    ]
    return {"points": _encode(points[reached] / unit.factor_to_si), "colors": shades}


def _list_legend(scene: Scene, parts: tuple[Part, ...]) -> list[dict[str, str]]:
    """Return the colors of the scene and their meaning."""
    roles = {part.role for part in parts}
    rows = [
        (BODY, "platform", any(p.role == "platform" and _is_wide(p, scene.robot) for p in parts)),
        (BLACK, "tool", True),
        (BLACK, "axis of a revolute joint", "axis" in roles and not is_planar(scene.robot)),
        (DRIVEN, "driven: larger, in the color of its limb", True),
        *(_describe_errors(scene.poses) if scene.poses is not None else ()),
        *_describe_scale(scene),
    ]
    return [{"color": color, "text": text} for color, text, is_drawn in rows if is_drawn]


def _is_wide(part: Part, robot: Mechanism) -> bool:
    """Return whether the points of a part differ."""
    return bool(np.ptp(part.points[0], axis=0).max() > 1e-6 * robot.size)


def _describe_errors(poses: PoseErrors) -> tuple[tuple[str, str, bool], ...]:
    """Return the legend of poses and errors."""
    text = f"position error before calibration, {poses.magnification:g} times magnified"
    is_any = bool(len(poses.tool))
    return ((POSE, "tool at a measured pose", is_any), (ERROR, text, is_any))


def _describe_scale(scene: Scene) -> tuple[tuple[str, str, bool], ...]:
    """Return the legend of the accuracy map."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    if scene.accuracy is None:
        return ()
    unit, values = DISPLAY_UNITS[Dimension.LENGTH], scene.accuracy.uncertainty.position
    known = values[np.isfinite(values)] / unit.factor_to_si
    if not len(known):
        return ()
    stops = [to_hex(colormaps[SEQUENTIAL](share)) for share in np.linspace(0.0, 1.0, 5)]
    ends = " to ".join(f"{value:.3g}" for value in (known.min(), known.max()))
    text = f"position uncertainty (rms) over the workspace, {ends} {unit.symbol}"
    unbounded = bool(len(known) < len(values))
    return (
        (f"linear-gradient(to right, {', '.join(stops)})", text, True),
        (UNBOUNDED, "uncertainty not bounded by the data", unbounded),
    )
