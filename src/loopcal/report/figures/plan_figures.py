# SPDX-License-Identifier: Apache-2.0
"""Pictures of a plan: the poses with the way through them, and expected errors by the number of
poses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.mechanism import POSITION, Mechanism
from loopcal.planning.path import locate_home
from loopcal.planning.prediction import DIMENSIONS
from loopcal.planning.result import Plan
from loopcal.planning.sample_size import ErrorCurve
from loopcal.report.figures.style import COLORS, label_logarithmic, show_names, start_figure
from loopcal.units import Dimension, Unit, find_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CALIBRATION, VALIDATION, BOUND = COLORS[0], COLORS[1], COLORS[2]
"""Colors of calibration poses, of validation poses, and of the bound."""


def draw_plan(plan: Plan) -> Figure:
    """Draw the poses of a plan in pairs of controlled coordinates, with the path between them."""
    from matplotlib.ticker import MaxNLocator

    names = plan.robot.controlled
    columns = [
        plan.poses.coordinates[:, i] / _unit(plan.robot, name).factor_to_si
        for i, name in enumerate(names)
    ]
    pairs = [(i, i + 1) for i in range(0, len(names) - 1, 2)] + (
        [(len(names) - 1, None)] if len(names) % 2 else []
    )
    figure = start_figure(4.2 * len(pairs), 4.4)
    home = locate_home(plan.robot)
    start = [home[i] / _unit(plan.robot, name).factor_to_si for i, name in enumerate(names)]
    step = np.arange(1, len(plan.poses.labels) + 1)
    for place, (i, j) in enumerate(pairs, 1):
        axes: Any = figure.add_subplot(1, len(pairs), place)
        x, y = (columns[i], columns[j]) if j is not None else (step, columns[i])
        first = (start[i], start[j]) if j is not None else (0.0, start[i])
        axes.plot([first[0], *x], [first[1], *y], color="0.7", lw=0.8, zorder=1, label="path")
        axes.plot(*first, "k+", ms=8.0, label="home", zorder=3)
        for chosen, color, label in (
            (~plan.poses.held_out, CALIBRATION, "calibration"),
            (plan.poses.held_out, VALIDATION, "validation"),
        ):
            axes.plot(x[chosen], y[chosen], "o", color=color, ms=4.5, label=label, zorder=2)
        axes.set_xlabel(_label(plan.robot, names[i]) if j is not None else "step [1], home is 0")
        if j is None:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_ylabel(_label(plan.robot, names[i if j is None else j]))
        axes.grid(visible=True, lw=0.3)
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=4,
        frameon=False,
        fontsize=8,
    )
    n_held_out = int(plan.poses.held_out.sum())
    figure.suptitle(
        f"{plan.robot.name}: n = {plan.n_poses} poses for calibration, {n_held_out} for validation",
        fontsize=10,
    )
    return show_names(figure)


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
    axes.set_xlabel(f"{curve.counted} for calibration [1]")
    words = f"expected {curve.target} error (rms)"
    words += ", rotations times robot size" if curve.target == "pose" else ""
    axes.set_ylabel(f"{words} [{unit.symbol}]", fontsize=9)
    axes.grid(visible=True, lw=0.3)
    axes.legend(frameon=False, fontsize=8)
    axes.set_title(
        f"{robot.name}: n = {curve.numbers[0]} to {curve.numbers[-1]} {curve.counted}", fontsize=10
    )
    return show_names(figure)


def _unit(robot: Mechanism, name: str) -> Unit:
    return find_unit(robot.units[Dimension.LENGTH if name in POSITION else Dimension.ANGLE])


def _label(robot: Mechanism, name: str) -> str:
    return f"{name} [{_unit(robot, name).symbol}]"
