# SPDX-License-Identifier: Apache-2.0
"""Results of several numbers with intervals: repeatability and the uncertainty budget."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply import ErrorBudget
from loopcal.apply.repeatability_result import DIMENSIONS, Estimate, Repeatability, VisitedPose
from loopcal.report.budget_view import name_source
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DOT,
    LINE,
    MARKERS,
    REFERENCE,
    THIN,
    add_legend,
    finish_figure,
    label_axes,
    label_poses,
    shorten,
    start_figure,
)
from loopcal.report.numbers import format_number
from loopcal.units import DISPLAY_UNITS, Dimension, Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_repeatability(result: Repeatability) -> Figure:
    """Draw pose accuracy and repeatability of each visited pose, with intervals of 95 %."""
    n = len(result.poses)
    figure = start_figure(9.5, 0.8 + 2.7 * n)
    panels: Any = figure.subplots(n, 2, squeeze=False)
    for row, (quantity, poses) in zip(panels, result.poses.items(), strict=True):
        names = ("AP_p", "RP_l") if poses[0].accuracy is not None else ("AP", "RP")
        accuracies = [pose.list_accuracies() for pose in poses]
        repeatabilities = [pose.list_repeatabilities() for pose in poses]
        _draw_visits(row[0], quantity, poses, f"accuracy {names[0]}", accuracies)
        _draw_visits(row[1], quantity, poses, f"repeatability {names[1]}", repeatabilities)
    visits = sorted({pose.visits for poses in result.poses.values() for pose in poses})
    counts = str(visits[0]) if len(visits) == 1 else f"{visits[0]} to {visits[-1]}"
    title = f"ISO 9283, {counts} visits of each pose, {result.frame}; bars: 95 % intervals"
    return finish_figure(figure, title)


def _draw_visits(
    axes: Axes,
    quantity: str,
    poses: tuple[VisitedPose, ...],
    name: str,
    estimates: list[tuple[Estimate, ...]],
) -> None:
    """Draw one characteristic of the poses of one quantity: one value of each pose, or one of each
    component side by side.
    """
    unit = DISPLAY_UNITS[DIMENSIONS[quantity]]
    for place, of_pose in enumerate(estimates, 1):
        for k, estimate in enumerate(of_pose):
            x = place + 0.15 * (k - (len(of_pose) - 1) / 2)
            _draw_interval(axes, x, estimate, unit, COLORS[k], MARKERS[k])
    if all(estimate.low >= 0.0 for of_pose in estimates for estimate in of_pose):
        axes.set_ylim(bottom=0.0)
    else:
        axes.axhline(0.0, color=REFERENCE, lw=THIN)
    is_whole = poses[0].accuracy is not None
    of = "" if is_whole else f" of {', '.join(poses[0].components)} (left to right)"
    label_axes(axes, "", f"{quantity} [{unit.symbol}]", f"{name}{of}")
    label_poses(axes, [_name_visited(pose) for pose in poses])


def _draw_interval(
    axes: Axes, x: float, estimate: Estimate, unit: Unit, color: str, marker: str
) -> None:
    """Draw one value with its interval."""
    value, low, high = (number / unit.factor_to_si for number in estimate)
    axes.vlines(x, low, high, color=color, lw=LINE)
    axes.plot([x], [value], marker, color=color, ms=DOT + 0.5)


def _name_visited(pose: VisitedPose) -> str:
    """Return the label of a pose, with its target and its direction where there are several."""
    return " ".join(filter(None, (pose.pose, pose.target, pose.direction)))


def draw_budget(budget: ErrorBudget) -> Figure:
    """Draw the part of each source in the expected error of poses as bars, and the error that half
    the sigma of a source would leave.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    lines = budget.lines
    kinds = [("position", DISPLAY_UNITS[Dimension.LENGTH], 0)]
    if budget.orientation.rms > 0.0:
        kinds.append(("orientation", DISPLAY_UNITS[Dimension.ANGLE], 1))
    figure = start_figure(4.8 * len(kinds) + 1.5, 1.9 + 0.38 * len(lines))
    panels: Any = figure.subplots(1, len(kinds), squeeze=False, sharey=True)[0]
    y = np.arange(len(lines))
    for axes, (kind, unit, place) in zip(panels, kinds, strict=True):
        rms_by_source = np.sqrt([getattr(line, kind) for line in lines]) / unit.factor_to_si
        total = getattr(budget, kind).rms / unit.factor_to_si
        axes.barh(y, rms_by_source, height=0.6, color=COLORS[5])
        axes.axvline(total, color=DARK, lw=LINE)
        for i, line in enumerate(lines):
            if line.halved is not None:
                left = line.halved[place] / unit.factor_to_si
                axes.plot([left], [i], "D", color=COLORS[1], ms=DOT + 1.0)
        axes.set_xlim(0.0, 1.08 * max(total, rms_by_source.max(initial=0.0)))
        title = f"{kind}: {format_number(total, 3)} {unit.symbol} in all"
        label_axes(axes, f"{kind} [{unit.symbol}]", "", title)
    names = [name_source(line.source.kind, line.source.name) for line in lines]
    panels[0].set_yticks(y, [shorten(name, 34) for name in names])
    panels[0].set_ylim(len(lines) - 0.4, -0.6)
    handles = [
        Patch(color=COLORS[5], label="part of the source (squares add up)"),
        Line2D([], [], color=DARK, lw=LINE, label="all sources"),
        Line2D(
            [], [], color=COLORS[1], marker="D", ms=DOT, ls="none", label="all, with half its sigma"
        ),
    ]
    add_legend(figure, handles)
    over = "poses of the workspace" if budget.is_workspace else "measured poses"
    return finish_figure(figure, f"Expected error (rms, k = 1) at {budget.poses} {over}")
