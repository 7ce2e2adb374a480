# SPDX-License-Identifier: Apache-2.0
"""A picture of a mechanism: its limbs, joints, rods, platform and tool, in space and from above;
a machine in an upright plane is shown from the side.

A limb has the same color in both views. A short line through a point is the axis of a revolute
joint, a dashed line is the guide of a sliding joint, and a filled point is driven. The parts come
from `loopcal.report.scene.scene`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.findings.wording import name_count
from loopcal.mechanism.model import Mechanism
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    ERROR,
    FRAME_COLORS,
    LABEL,
    POSE,
    SEQUENTIAL,
    SMALL,
    THIN,
    add_colorbar,
    add_legend,
    finish_figure,
    label_axes,
    make_handle,
    start_figure,
)
from loopcal.report.scene.scene import Part, Role, Scene, is_planar, list_parts
from loopcal.results.presenters import register
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


FLAT = 0.05
"""Width of an upright plane that contains a machine, as a share of its largest extent."""

MARGIN = 0.08
"""Room around the second view for names of limbs, as a share of the machine's larger extent."""

VIEWS = {(0, 1): "from above", (0, 2): "from the side", (1, 2): "from the front"}
"""Directions of the second view, by the axes that it shows."""


@register("figure", Mechanism)
def draw_robot(robot: Mechanism) -> Figure:
    """Draw a robot at home, in the length unit of its file."""
    length, limbs = find_unit(robot.units[Dimension.LENGTH]), robot.assembly.limbs
    strokes = [  # lines or points (n, 3), and the arguments of matplotlib's `plot`
        (part.points[0] / length.factor_to_si, _choose_style(part))
        for part in list_parts(robot, robot.home_state)
    ]
    everything = np.concatenate([points for points, _ in strokes])
    low, high = everything.min(axis=0), everything.max(axis=0)
    is_flat, shown = is_planar(robot), [*choose_view(robot)]
    figure = start_figure(7.0 if is_flat else 11.8, 6.4 if is_flat else 6.0)
    space: Any = None if is_flat else figure.add_subplot(1, 2, 1, projection="3d")
    above: Any = figure.add_subplot() if is_flat else figure.add_subplot(1, 2, 2)
    for points, style in strokes:
        above.plot(*points.T[shown], **style)
        if space is not None:
            space.plot(*points.T, **style)
    middle = np.mean([points[0] for points, _ in strokes[: len(limbs)]], axis=0)
    for (points, style), limb in zip(strokes, limbs, strict=False):  # first the lines of limbs
        _name_limb(above, points[:, shown], limb.name, middle[shown], style["color"])
        if space is not None:
            name, place = f"  {limb.name}", points[0]
            space.text(*place, name, fontsize=SMALL, color=style["color"], zorder=9)
    _finish(space, above, low, high, length.symbol, shown)
    add_legend(figure, _list_handles(robot))
    counts = {
        "limb": len(limbs),
        "joint": sum(len(limb.joints) for limb in limbs),
        "rod": sum(limb.ending == "distance" for limb in limbs),
        "actuator": len(robot.actuators),
    }
    words = ", ".join(name_count(n, what) for what, n in counts.items() if n)
    return finish_figure(figure, f"{robot.name} at home: {words}; lengths in {length.symbol}")


def choose_view(robot: Mechanism) -> tuple[int, int]:
    """Return the axes of the second view: x and y, or of the upright plane that holds all limbs."""
    parts = list_parts(robot, robot.home_state)
    points = np.concatenate([part.points[0] for part in parts if part.role in ("limb", "rod")])
    extent = np.ptp(points, axis=0)
    for hidden, axes in ((1, (0, 2)), (0, (1, 2))):
        if extent[hidden] < FLAT * extent.max():
            return axes
    return (0, 1)


def _choose_style(part: Part) -> dict[str, Any]:
    """Return how a part is drawn."""
    color = COLORS[part.index % len(COLORS)]
    face = color if part.is_driven else "white"
    styles: dict[Role, dict[str, Any]] = {
        "limb": {"color": color, "lw": 2.5, "solid_capstyle": "round"},
        "axis": {"color": "black", "lw": 1.2},
        "guide": {"color": color, "lw": 1.0, "ls": (0, (4, 3))},
        "joint": _dot("o", color, face, 8.0 if part.is_driven else 5.0),
        "slide": _dot("s", color, face, 8.0 if part.is_driven else 5.0),
        "rod": {"color": color, "lw": 1.6},
        "cable": {"color": color, "lw": 1.0},
        "rod drive": _dot("D", color, face),
        "end": _dot("o", color, "white"),
        "base": {"color": "0.6", "lw": 1.0, "ls": ":", "zorder": 0.5},
        "platform": {"color": DARK, "lw": 2.0},
        "arm": {"color": DARK, "lw": 1.0},
        "frame": {"color": FRAME_COLORS[part.index % 3], "lw": 1.4},
        "tool": _dot("*", "black", "black", 8.0),
    }
    return styles[part.role]


def _dot(marker: str, edge: str, face: str, size: float = 5.0) -> dict[str, Any]:
    return {"marker": marker, "ls": "none", "ms": size, "mec": edge, "mfc": face, "mew": 1.2}


def _name_limb(axes: Any, points: FloatArray, name: str, middle: FloatArray, color: str) -> None:
    """Write the name of a limb beside its foot: away from the middle (2,), or diagonally where the
    limb points (n, 2) away from the middle, too.
    """
    away = points[0] - middle
    if (points[-1] - points[0]) @ away > 0.0:
        away = np.array([away[0] - away[1], away[0] + away[1]])
    distance = float(np.linalg.norm(away))
    place = tuple(np.array([20.0, 13.0]) * (away / distance if distance > 0 else [1.0, 1.0]))
    axes.annotate(
        name, tuple(points[0]), place, textcoords="offset points", ha="center", va="center",
        fontsize=8, color=color,
        bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.7},
    )  # fmt: skip


def _finish(
    space: Any, above: Any, low: FloatArray, high: FloatArray, symbol: str, shown: list[int]
) -> None:
    """Set equal scales, and units on all axes."""
    room = MARGIN * (high - low)[shown].max()  # for names beside the outermost feet
    above.update_datalim([(low - room)[shown], (high + room)[shown]])
    above.set_aspect("equal", adjustable="datalim")
    above.autoscale_view()
    across, up = (f"{'xyz'[axis]} [{symbol}]" for axis in shown)
    if space is None:
        label_axes(above, across, up)
        return
    label_axes(above, across, up, VIEWS[shown[0], shown[1]])
    middle, reach = (low + high) / 2, np.maximum(high - low, 0.15 * (high - low).max()) * 0.55
    for axis, m, r in zip("xyz", middle, reach, strict=True):
        getattr(space, f"set_{axis}lim")(m - r, m + r)
        getattr(space, f"set_{axis}label")(f"{axis} [{symbol}]", fontsize=LABEL)
    space.set_box_aspect(reach, zoom=0.9)
    space.view_init(elev=22, azim=-58)
    space.tick_params(labelsize=7)
    space.locator_params(nbins=5)
    space.set_title("perspective", fontsize=LABEL)


def _list_handles(robot: Mechanism) -> list[Any]:
    """Return a handle for everything that the picture of a robot contains."""
    limbs = robot.assembly.limbs
    kinds = {joint.kind for limb in limbs for joint in limb.joints}
    driven = {joint.kind for limb in limbs for joint in limb.joints if joint.actuator}
    marker = "s" if "P" in driven else "o" if driven else "D"
    has_rods = any(limb.ending == "distance" for limb in limbs)
    has_rods = has_rods or any(actuator.is_triangle for actuator in robot.actuators)
    has_axes = "R" in kinds and not is_planar(robot)
    guide = {"color": "0.4", "lw": 1.0, "ls": (0, (4, 3))}
    axes = zip("xy" if is_planar(robot) else "xyz", FRAME_COLORS, strict=False)
    rows: list[tuple[str, bool, dict[str, Any]]] = [
        ("axis of a revolute joint", has_axes, {"color": "black", "lw": 1.2}),
        ("guide of a sliding joint", "P" in kinds, guide),
        ("rod", has_rods, {"color": "0.4", "lw": 1.6}),
        ("driven, filled", True, _dot(marker, "0.4", "0.4")),
        ("platform", True, {"color": "0.25", "lw": 2.0}),
        ("tool", True, _dot("*", "black", "black", 8.0)),
        *((f"{axis} of base and tool", True, {"color": color, "lw": 1.4}) for axis, color in axes),
    ]
    return [make_handle(label, **style) for label, is_drawn, style in rows if is_drawn]


def draw_scene(scene: Scene) -> Figure:
    """Draw a robot at home; with measured poses the tool points and errors there; with an accuracy
    map the uncertainty of positions over the workspace as pale points.
    """
    robot, poses, figure = scene.robot, scene.poses, draw_robot(scene.robot)
    factor, flat = find_unit(robot.units[Dimension.LENGTH]).factor_to_si, [*choose_view(robot)]
    panels = [(axes, [0, 1, 2] if axes.name == "3d" else flat) for axes in figure.axes]
    if scene.accuracy is not None:
        _draw_map(figure, panels, scene, factor)
    if poses is None:
        return figure
    tips = poses.tool + poses.magnification * poses.error
    gaps = np.full(poses.tool.shape, np.nan)  # between the lines from tools to tips
    lines = np.stack([poses.tool, tips, gaps], axis=1).reshape(-1, 3) / factor
    for axes, kept in panels:
        axes.plot(*lines[:, kept].T, color=ERROR, lw=1.0, zorder=8)
        axes.plot(*poses.tool[:, kept].T / factor, "o", color=POSE, ms=2.5, zorder=8)
        if axes.name == "3d" and len(lines):
            _include(axes, lines)
    count = name_count(len(poses.tool), "measured pose")
    title = f"{robot.name} at home, {count}; errors before calibration"
    return finish_figure(figure, f"{title}, x {poses.magnification:g}")


def _draw_map(
    figure: Figure, panels: list[tuple[Any, list[int]]], scene: Scene, factor: float
) -> None:
    """Draw the uncertainty of positions where it is known, with its scale of colors."""
    values, unit = scene.map_values
    known = np.isfinite(values) & np.isfinite(scene.map_points).all(axis=1)
    if not known.any():
        return
    points, drawn = scene.map_points[known] / factor, None
    style: dict[str, Any] = {"cmap": SEQUENTIAL, "s": 9.0, "marker": "s", "lw": 0.0, "alpha": 0.45}
    for axes, kept in panels:
        drawn = axes.scatter(*points[:, kept].T, c=values[known], zorder=0.4, **style)
        if axes.name == "3d":
            _include(axes, points)
    label = f"position uncertainty (rms) [{unit.symbol}]"
    bar = add_colorbar(figure, drawn, panels[-1][0], label, aspect=30, pad=0.02, shrink=0.8)
    bar.ax.tick_params(width=THIN)
    bar.solids.set_alpha(1.0)


def _include(axes: Any, points: FloatArray) -> None:
    """Widen the limits of axes in space so that they contain points; scales stay equal."""
    spans = []
    for axis, values in zip("xyz", points.T, strict=True):
        low, high = getattr(axes, f"get_{axis}lim")()
        low, high = min(low, float(np.nanmin(values))), max(high, float(np.nanmax(values)))
        getattr(axes, f"set_{axis}lim")(low, high)
        spans.append(high - low)
    axes.set_box_aspect(spans, zoom=0.9)
