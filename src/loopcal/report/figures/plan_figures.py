# SPDX-License-Identifier: Apache-2.0
"""Pictures of a plan: the poses with the way through them, and expected errors by the number of
poses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.findings.wording import name_count
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION, list_dimensions
from loopcal.planning.path import locate_home
from loopcal.planning.plane_line_planning import SurfacePlan
from loopcal.planning.pose_planning import Plan, PlannedPoses
from loopcal.planning.problem import DIMENSIONS, ErrorCurve
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DOT,
    LINE,
    MARKERS,
    PALE,
    REFERENCE,
    SMALL,
    THIN,
    add_legend,
    finish_figure,
    label_axes,
    label_sparsely,
    make_handle,
    scale_logarithmically,
    start_figure,
    start_panels,
)
from loopcal.results.presenters import register
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CALIBRATION, VALIDATION, BOUND = COLORS[0], COLORS[1], COLORS[2]
"""Colors of calibration poses, of validation poses, and of the bound."""

MOST_NUMBERS, IN_LINE = 80, 6
"""Poses up to which each one has its number, and numbers in one line beside poses that overlap."""

DISK, CLOSE = 9.5, 0.02
"""Size of the disk of a pose [pt], and distance of two overlapping ones as a share of an axis."""


@register("figure", Plan)
def draw_plan(plan: Plan) -> Figure:
    """Draw the poses of a plan in pairs of controlled coordinates, numbered in the order of
    visiting, with the path between them.

    The path is straight in the coordinates and begins at home; where it goes via home before a
    pose, it is dashed.
    """
    names, poses, units = plan.robot.controlled, plan.poses, plan.robot.shown_units
    of_name = [units[d] for d in list_dimensions(names)]
    labels = [f"{name} [{unit.symbol}]" for name, unit in zip(names, of_name, strict=True)]
    scale = np.array([unit.factor_to_si for unit in of_name])
    stops = np.concatenate([locate_home(plan.robot)[None], poses.coordinates]) / scale
    pairs = [(i, i + 1) for i in range(0, len(names) - 1, 2)]
    single = len(names) - 1 if len(names) % 2 else None
    count = len(pairs) + (single is not None)
    figure = start_figure(max(4.9 * count, 6.0), 5.4)
    for place, (i, j) in enumerate(pairs, 1):
        axes = figure.add_subplot(1, count, place)
        _draw_visits(axes, stops[:, i], stops[:, j], poses)
        label_axes(axes, labels[i], labels[j])
    if single is not None:
        axes = figure.add_subplot(1, count, count)
        _draw_visits(axes, np.arange(len(stops), dtype=float), stops[:, single], poses)
        label_sparsely(axes.xaxis)
        label_axes(axes, "step [1], home is 0", labels[single])
    handles = [
        make_handle("calibration", color=CALIBRATION, marker="o", ls="none"),
        make_handle("home", color="black", marker="+", ls="none"),
        make_handle("path", color=PALE, lw=THIN),
    ]
    if poses.held_out.any():
        handles.insert(1, make_handle("validation", color=VALIDATION, marker="s", ls="none"))
    if poses.via_home.any():
        handles.append(make_handle("path via home", color=PALE, lw=THIN, ls="--"))
    add_legend(figure, handles)
    held_out = int(poses.held_out.sum())
    fitted = f"n = {len(poses) - held_out} poses for calibration"
    words = f"{fitted}, {held_out} for validation, numbered in their order"
    return finish_figure(figure, f"{plan.robot.name}: {words}")


def _draw_visits(axes: Axes, x: FloatArray, y: FloatArray, poses: PlannedPoses) -> None:
    """Draw the path from home through all poses, with an arrow in the middle of each part, and the
    poses as disks that contain their numbers where these can be read.
    """
    for k in range(1, len(x)):
        segments = [(k - 1, 0, "--"), (0, k, "--")] if poses.via_home[k - 1] else [(k - 1, k, "-")]
        for start, end, line in segments:
            ends = x[[start, end]], y[[start, end]]
            axes.plot(*ends, color=PALE, lw=THIN, ls=line, zorder=1)
            middle = ends[0].mean(), ends[1].mean()
            before = 0.52 * ends[0][0] + 0.48 * ends[0][1], 0.52 * ends[1][0] + 0.48 * ends[1][1]
            if np.ptp(ends[0]) > 0.0 or np.ptp(ends[1]) > 0.0:
                arrow = {"arrowstyle": "-|>", "color": REFERENCE, "lw": 0.0, "mutation_scale": 7.0}
                axes.annotate("", middle, before, arrowprops=arrow, zorder=1)
    axes.plot(x[0], y[0], "k+", ms=9.0, mew=1.4, zorder=3)
    x, y, held_out = x[1:], y[1:], poses.held_out
    is_numbered = len(held_out) <= MOST_NUMBERS
    size = DISK if is_numbered else DOT
    for chosen, color, marker in ((~held_out, CALIBRATION, "o"), (held_out, VALIDATION, "s")):
        axes.plot(x[chosen], y[chosen], marker, color=color, ms=size, zorder=2)
    if is_numbered:
        for members in _find_clusters(x, y):
            _write_numbers(axes, x, y, members)


def _find_clusters(x: FloatArray, y: FloatArray) -> list[list[int]]:
    """Return the poses in groups that are so close in this view that their disks overlap."""
    scaled = np.stack([x, y], axis=1)
    scaled = scaled / np.maximum(np.ptp(scaled, axis=0), 1e-300)
    clusters: list[list[int]] = []
    for k, point in enumerate(scaled):
        for members in clusters:
            if np.linalg.norm(scaled[members[0]] - point) < CLOSE:
                members.append(k)
                break
        else:
            clusters.append([k])
    return clusters


def _write_numbers(axes: Axes, x: FloatArray, y: FloatArray, members: list[int]) -> None:
    """Write the number of a pose in its disk; those of poses that overlap beside them."""
    k, numbers = members[0], [str(number + 1) for number in members]
    if len(members) == 1:
        style: dict[str, Any] = {"ha": "center", "va": "center", "color": "white", "weight": "bold"}
        axes.annotate(numbers[0], (x[k], y[k]), fontsize=6, zorder=4, **style)
        return
    side, height = (-1 if values[k] > values.mean() else 1 for values in (x, y))
    lines = (numbers[i : i + IN_LINE] for i in range(0, len(numbers), IN_LINE))
    axes.annotate(
        "\n".join(map(", ".join, lines)), (x[k], y[k]), (7 * side, 7 * height),
        textcoords="offset points", ha="left" if side > 0 else "right",
        va="bottom" if height > 0 else "top", fontsize=6.5, zorder=5, bbox=_make_box(0.8),
    )  # fmt: skip


def _make_box(alpha: float) -> dict[str, Any]:
    """Return the background of numbers beside points."""
    return {"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": alpha}


def draw_curve(robot: Mechanism, curve: ErrorCurve) -> Figure:
    """Draw errors by the number of poses: what the share of machines ends below, the root mean
    square of all machines, and the bound of that which no choice of so many candidates can beat.
    """
    unit = find_unit(robot.units[DIMENSIONS[curve.target]])
    figure = start_figure(6.4, 4.4)
    axes: Any = figure.add_subplot(1, 1, 1)
    for errors, line, color, label in (
        (curve.values, "o-", CALIBRATION, f"{100.0 * curve.share:g} % of machines end below"),
        (curve.rms, ".-", REFERENCE, "rms of all machines"),
        (curve.bounds, "--", BOUND, f"no choice of {curve.counted} has a smaller rms"),
    ):
        axes.plot(curve.numbers, errors / unit.factor_to_si, line, color=color, label=label)
    if curve.goal is not None:
        goal = curve.goal / unit.factor_to_si
        axes.axhline(goal, color=VALIDATION, lw=1.0, label=f"goal: {goal:.3g} {unit.symbol}")
    scale_logarithmically(axes.xaxis)
    scale_logarithmically(axes.yaxis)
    words = f"{curve.target} error over the workspace (rms)"
    words += ", rotations times robot size" if curve.target == "pose" else ""
    label_axes(axes, f"{curve.counted} for calibration [1]", f"{words} [{unit.symbol}]")
    axes.legend(frameon=False, fontsize=SMALL)
    n = f"n = {curve.numbers[0]} to {curve.numbers[-1]} {curve.counted}"
    return finish_figure(figure, f"{robot.name}: {n}")


# A plan of planes with perpendicular lines: the points of each group in three views.

VIEWS = ((0, 1), (0, 2), (1, 2))
"""Pairs of coordinates: from above, from the front, from the side."""

MOST_GROUPS = 8
"""Groups with a label of their own in the legend."""


@register("figure", SurfacePlan)
def draw_surface_plan(plan: SurfacePlan) -> Figure:
    """Draw where the tool is at the points of each group: the first two are on the line, and the
    first and all others in the plane. A number is that of a group at its first point.
    """
    unit = plan.robot.shown_units[Dimension.LENGTH]
    places = plan.positions / unit.factor_to_si
    styles = [
        (COLORS[i % len(COLORS)], MARKERS[i // len(COLORS) % len(MARKERS)])
        for i in range(len(places))
    ]
    figure, (panels,) = start_panels(12.6, 5.0, 1, len(VIEWS))
    for axes, view in zip(panels, VIEWS, strict=True):
        for points, (color, marker) in zip(places[:, :, view], styles, strict=True):
            axes.plot(*points[:2].T, "-", color=color, lw=2.2, zorder=2)
            for point in points[2:]:  # a fan of thin lines in the plane
                ends = np.stack([points[0], point])
                axes.plot(*ends.T, "-", color=color, lw=THIN, alpha=0.6, zorder=1)
            axes.plot(*points.T, marker, color=color, ms=DOT + LINE, ls="none", zorder=3)
        _number_surfaces(axes, places[:, 0, view])
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.12)
        x, y = (POSITION[i] for i in view)
        label_axes(axes, f"{x} [{unit.symbol}]", f"{y} [{unit.symbol}]")
    handles = [
        make_handle("line: points 1 and 2", color=DARK, lw=2.2, marker="o", ms=DOT),
        make_handle("plane: point 1 and others", color=DARK, lw=THIN, marker="o", ms=DOT),
    ]
    if len(places) <= MOST_GROUPS:
        for i, (color, marker) in enumerate(styles):
            label = f"group {i + 1}, line along {POSITION[plan.axis[i]]}"
            handles.append(make_handle(label, color=color, marker=marker, ms=DOT + 1, ls="none"))
    add_legend(figure, handles)
    groups, points = plan.poses.groups.shape
    planes = f"{name_count(groups, 'plane')} with a perpendicular line"
    return finish_figure(figure, f"{plan.robot.name}: {planes}, n = {points} points in each")


def _number_surfaces(axes: Axes, first: FloatArray) -> None:
    """Write the numbers of groups at their first points (u, 2); those of one place together."""
    groups: dict[tuple[float, ...], list[str]] = {}
    for group, point in enumerate(first, 1):
        groups.setdefault(tuple(np.round(point, 6).tolist()), []).append(str(group))
    beside: dict[str, Any] = {"textcoords": "offset points", "fontsize": SMALL, "zorder": 4}
    for (x, y), members in groups.items():
        axes.annotate(", ".join(members), (x, y), (5, 4), bbox=_make_box(0.7), **beside)
