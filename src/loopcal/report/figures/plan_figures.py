# SPDX-License-Identifier: Apache-2.0
"""Pictures of a plan: the poses with the way through them, and expected errors by the number of
poses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION
from loopcal.planning.path import locate_home
from loopcal.planning.plane_line_planning import SurfacePlan
from loopcal.planning.problem import DIMENSIONS, ErrorCurve
from loopcal.planning.result import Plan, PlannedPoses
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
    label_logarithmic,
    start_figure,
)
from loopcal.results.presenters import register
from loopcal.results.tables import units_of
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension, Unit, find_unit

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
    names, poses = plan.robot.controlled, plan.poses
    scale = np.array([_unit(plan.robot, name).factor_to_si for name in names])
    stops = np.concatenate([locate_home(plan.robot)[None], poses.coordinates]) / scale
    pairs = [(i, i + 1) for i in range(0, len(names) - 1, 2)] + (
        [(len(names) - 1, None)] if len(names) % 2 else []
    )
    figure = start_figure(max(4.9 * len(pairs), 6.0), 5.4)
    for place, (i, j) in enumerate(pairs, 1):
        axes = figure.add_subplot(1, len(pairs), place)
        step = np.arange(len(stops), dtype=float)
        x, y = (stops[:, i], stops[:, j]) if j is not None else (step, stops[:, i])
        _draw_path(axes, x, y, poses.via_home)
        _draw_poses(axes, x, y, poses.held_out)
        if j is None:
            from matplotlib.ticker import MaxNLocator

            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        label_axes(
            axes,
            _label(plan.robot, names[i]) if j is not None else "step [1], home is 0",
            _label(plan.robot, names[i if j is None else j]),
        )
    add_legend(figure, _list_handles(poses))
    n_held_out = int(poses.held_out.sum())
    return finish_figure(
        figure,
        f"{plan.robot.name}: n = {len(poses) - n_held_out} poses for calibration, {n_held_out} for "
        "validation, numbered in their order",
    )


def _draw_path(axes: Axes, x: FloatArray, y: FloatArray, via_home: BoolArray) -> None:
    """Draw the path from home through all poses, with an arrow in the middle of each part."""
    for k in range(1, len(x)):
        segments = [(k - 1, 0, "--"), (0, k, "--")] if via_home[k - 1] else [(k - 1, k, "-")]
        for start, end, line in segments:
            ends = x[[start, end]], y[[start, end]]
            axes.plot(*ends, color=PALE, lw=THIN, ls=line, zorder=1)
            middle = ends[0].mean(), ends[1].mean()
            before = 0.52 * ends[0][0] + 0.48 * ends[0][1], 0.52 * ends[1][0] + 0.48 * ends[1][1]
            if np.ptp(ends[0]) > 0.0 or np.ptp(ends[1]) > 0.0:
                arrow = {"arrowstyle": "-|>", "color": REFERENCE, "lw": 0.0, "mutation_scale": 7.0}
                axes.annotate("", middle, before, arrowprops=arrow, zorder=1)


def _draw_poses(axes: Axes, x: FloatArray, y: FloatArray, held_out: BoolArray) -> None:
    """Draw home, and the poses as disks that contain their numbers where these can be read."""
    axes.plot(x[0], y[0], "k+", ms=9.0, mew=1.4, zorder=3)
    is_numbered = len(held_out) <= MOST_NUMBERS
    size = DISK if is_numbered else DOT
    for chosen, color, marker in ((~held_out, CALIBRATION, "o"), (held_out, VALIDATION, "s")):
        axes.plot(x[1:][chosen], y[1:][chosen], marker, color=color, ms=size, zorder=2)
    if is_numbered:
        for members in _find_clusters(x[1:], y[1:]):
            _write_numbers(axes, x[1:], y[1:], members)


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
    k = members[0]
    if len(members) == 1:
        style: dict[str, Any] = {"ha": "center", "va": "center", "color": "white", "weight": "bold"}
        axes.annotate(str(k + 1), (x[k], y[k]), fontsize=6, zorder=4, **style)
        return
    side = -1 if x[k] > x.mean() else 1
    height = -1 if y[k] > y.mean() else 1
    lines = [
        ", ".join(str(number + 1) for number in members[first : first + IN_LINE])
        for first in range(0, len(members), IN_LINE)
    ]
    axes.annotate(
        "\n".join(lines),
        (x[k], y[k]),
        xytext=(7 * side, 7 * height),
        textcoords="offset points",
        ha="left" if side > 0 else "right",
        va="bottom" if height > 0 else "top",
        fontsize=6.5,
        zorder=5,
        bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8},
    )


def _list_handles(poses: PlannedPoses) -> list[Any]:
    """Return what the legend contains."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=CALIBRATION, marker="o", ls="none", label="calibration"),
        Line2D([], [], color="black", marker="+", ls="none", label="home"),
        Line2D([], [], color=PALE, lw=THIN, label="path"),
    ]
    if poses.held_out.any():
        validation = Line2D([], [], color=VALIDATION, marker="s", ls="none", label="validation")
        handles.insert(1, validation)
    if poses.via_home.any():
        handles.append(Line2D([], [], color=PALE, lw=THIN, ls="--", label="path via home"))
    return handles


def draw_curve(robot: Mechanism, curve: ErrorCurve) -> Figure:
    """Draw expected errors by the number of poses, with the bound that no choice of so many
    candidates can beat.
    """
    dimension = DIMENSIONS[curve.target]
    unit = find_unit(robot.units[dimension])
    figure = start_figure(6.4, 4.4)
    axes: Any = figure.add_subplot(1, 1, 1)
    for errors, line, color, label in (
        (curve.values, "o-", CALIBRATION, f"planned {curve.counted}"),
        (curve.bounds, "--", BOUND, f"no choice of {curve.counted} is better"),
    ):
        axes.plot(curve.numbers, errors / unit.factor_to_si, line, color=color, label=label)
    if curve.goal is not None:
        axes.axhline(
            curve.goal / unit.factor_to_si,
            color=VALIDATION,
            lw=1.0,
            label=f"goal: {curve.goal / unit.factor_to_si:.3g} {unit.symbol}",
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    label_logarithmic(axes.xaxis)
    label_logarithmic(axes.yaxis)
    words = f"expected {curve.target} error (rms)"
    words += ", rotations times robot size" if curve.target == "pose" else ""
    label_axes(axes, f"{curve.counted} for calibration [1]", f"{words} [{unit.symbol}]")
    axes.legend(frameon=False, fontsize=SMALL)
    n = f"n = {curve.numbers[0]} to {curve.numbers[-1]} {curve.counted}"
    return finish_figure(figure, f"{robot.name}: {n}")


def _unit(robot: Mechanism, name: str) -> Unit:
    return find_unit(robot.units[Dimension.LENGTH if name in POSITION else Dimension.ANGLE])


def _label(robot: Mechanism, name: str) -> str:
    return f"{name} [{_unit(robot, name).symbol}]"


# --- A plan of planes with perpendicular lines: the points of each group in three views.

VIEWS = ((0, 1), (0, 2), (1, 2))
"""Pairs of coordinates: from above, from the front, from the side."""

MOST_GROUPS = 8
"""Groups with a label of their own in the legend."""


@register("figure", SurfacePlan)
def draw_surface_plan(plan: SurfacePlan) -> Figure:
    """Draw where the tool is at the points of each group: the first two are on the line, and the
    first and all others in the plane. A number is that of a group at its first point.
    """
    from matplotlib.lines import Line2D

    unit = units_of(plan.robot)[Dimension.LENGTH]
    places = plan.positions / unit.factor_to_si
    figure = start_figure(12.6, 5.0)
    panels: Any = figure.subplots(1, len(VIEWS))
    for axes, view in zip(panels, VIEWS, strict=True):
        for group, points in enumerate(places):
            _draw_group(axes, points[:, view], group)
        _number_surfaces(axes, places[:, 0, view])
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.12)
        x, y = (POSITION[i] for i in view)
        label_axes(axes, f"{x} [{unit.symbol}]", f"{y} [{unit.symbol}]")
    handles = [
        Line2D([], [], color=DARK, lw=2.2, marker="o", ms=DOT, label="line: points 1 and 2"),
        Line2D([], [], color=DARK, lw=THIN, marker="o", ms=DOT, label="plane: point 1 and others"),
    ]
    if len(places) <= MOST_GROUPS:
        handles += [
            Line2D([], [], color=_color(i), marker=_marker(i), ms=DOT + 1, ls="none",
                   label=f"group {i + 1}, line along {POSITION[plan.axis[i]]}")
            for i in range(len(places))
        ]  # fmt: skip
    add_legend(figure, handles)
    groups, points = plan.poses.groups.shape
    planes = "1 plane" if groups == 1 else f"{groups} planes"
    words = f"{planes} with a perpendicular line, n = {points} points in each"
    return finish_figure(figure, f"{plan.robot.name}: {words}")


def _draw_group(axes: Axes, points: FloatArray, group: int) -> None:
    """Draw the points (k, 2) of a group: a thick line, and a fan of thin ones in the plane."""
    color, marker = _color(group), _marker(group)
    axes.plot(*points[:2].T, "-", color=color, lw=2.2, zorder=2)
    for point in points[2:]:
        axes.plot(*np.stack([points[0], point]).T, "-", color=color, lw=THIN, alpha=0.6, zorder=1)
    axes.plot(*points.T, marker, color=color, ms=DOT + LINE, ls="none", zorder=3)


def _number_surfaces(axes: Axes, first: FloatArray) -> None:
    """Write the numbers of groups at their first points (u, 2); those of one place together."""
    groups: dict[tuple[float, ...], list[int]] = {}
    for group, point in enumerate(first):
        groups.setdefault(tuple(np.round(point, 6).tolist()), []).append(group)
    for (x, y), members in groups.items():
        axes.annotate(
            ", ".join(str(group + 1) for group in members),
            (x, y),
            xytext=(5, 4),
            textcoords="offset points",
            fontsize=SMALL,
            zorder=4,
            bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.7},
        )


def _color(group: int) -> str:
    return COLORS[group % len(COLORS)]


def _marker(group: int) -> str:
    return MARKERS[group // len(COLORS) % len(MARKERS)]
