# SPDX-License-Identifier: Apache-2.0
"""Errors on measured poses before and after calibration, beside the noise floor and the limits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply import Validation
from loopcal.report.figures.style import (
    COLORS,
    DOT,
    LINE,
    REFERENCE,
    SMALL,
    THIN,
    add_legend,
    finish_figure,
    label_axes,
    label_logarithmic,
    label_poses,
    start_figure,
)
from loopcal.units import Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, LIMIT = COLORS[1], COLORS[0], COLORS[3]
"""Colors of errors before and after calibration, and of a limit."""

FEWEST_BARS = 5
"""Kinds of measurement for which there is room, so that the bars of a single one are narrow."""

LOGARITHMIC = 8.0
"""Ratio of the largest errors before and after from which their axis is logarithmic."""


def draw_validation(validation: Validation, with_before: bool = True) -> Figure:
    """Draw the errors of each quantity by pose, and those of all kinds over sigma.

    Parameters
    ----------
    with_before : whether there is a geometry before calibration to compare with.
    """
    quantities = validation.quantities
    has_kinds = validation.has_several_kinds or not quantities
    n = len(quantities) + has_kinds
    figure = start_figure(9.5, 1.4 + 2.7 * n)
    panels: Any = figure.subplots(n, 1, squeeze=False)[:, 0]
    for axes, quantity in zip(panels, quantities, strict=False):
        _draw_quantity(axes, validation, quantity, with_before)
    if has_kinds:
        _draw_kinds(panels[-1], validation, with_before)
    add_legend(figure, _list_handles(validation, with_before))
    poses = f"{validation.judged} {'pose' if validation.judged == 1 else 'poses'}"
    return finish_figure(figure, f"Errors at {poses}, {validation.frame}")


def _draw_quantity(axes: Axes, validation: Validation, quantity: str, with_before: bool) -> None:
    """Draw the size of each error of one quantity at the place of its pose."""
    labels = tuple(dict.fromkeys(validation.poses))
    place = np.array([labels.index(label) + 1 for label in validation.poses], dtype=float)
    unit = validation.units[quantity]
    drawn = [(validation.after, "o", AFTER, AFTER)]
    if with_before:
        drawn.insert(0, (validation.before, "s", BEFORE, "none"))
    sizes = []
    for errors, marker, color, face in drawn:
        of_quantity = errors[quantity]
        size = of_quantity.size / unit.factor_to_si
        sizes.append(size[np.isfinite(size)])
        axes.plot(
            place[of_quantity.rows], size, marker, ls="none", color=color, mfc=face, ms=DOT + 0.5
        )
        axes.axhline(errors.statistics(quantity).rms / unit.factor_to_si, color=color, lw=LINE)
    floor = validation.noise_floor.rms[quantity] / unit.factor_to_si
    axes.axhline(floor, color=REFERENCE, lw=THIN, ls="--")
    limit = _find_limit(validation, quantity)
    if limit is not None:
        axes.axhline(limit / unit.factor_to_si, color=LIMIT, lw=LINE, ls="-.")
    _scale(axes, sizes)
    label_axes(axes, "", f"{quantity} error [{unit.symbol}]", _name_rms(validation, quantity, unit))
    label_poses(axes, labels)


def _scale(axes: Axes, sizes: list[np.ndarray]) -> None:
    """Choose a logarithmic axis where errors before and after differ by much; else begin at 0."""
    largest = [float(size.max()) for size in sizes if len(size)]
    if len(largest) == 2 and 0.0 < LOGARITHMIC * largest[1] < largest[0]:
        axes.set_yscale("log")
        label_logarithmic(axes.yaxis)
    else:
        axes.set_ylim(bottom=0.0)


def _name_rms(validation: Validation, quantity: str, unit: Unit) -> str:
    """Return the components that are measured."""
    measured = validation.after[quantity].measured
    named = f" ({', '.join(measured)})" if quantity == "position" and len(measured) < 3 else ""
    rms = validation.after.statistics(quantity).rms / unit.factor_to_si
    return f"{quantity}{named}: rms {rms:.3g} {unit.symbol} after"


def _find_limit(validation: Validation, quantity: str) -> float | None:
    """Return the limit of a quantity [SI]; None without one."""
    limits = {"position": validation.limit_position, "orientation": validation.limit_angle}
    return limits.get(quantity)


def _draw_kinds(axes: Axes, validation: Validation, with_before: bool) -> None:
    """Draw the errors of each kind over sigma as bars, with their noise floor."""
    kinds = [k for k in validation.kinds if k.kind != "all" or validation.has_several_kinds]
    x = np.arange(len(kinds))
    width = 0.38 if with_before else 0.6
    shift = 0.5 * width if with_before else 0.0
    if with_before:
        axes.bar(x - shift, [k.before for k in kinds], width, ec=BEFORE, fc="none", hatch="//")
    axes.bar(x + shift, [k.after for k in kinds], width, color=AFTER)
    for i, kind in enumerate(kinds):
        axes.hlines(kind.noise_floor, i - 0.45, i + 0.45, color=REFERENCE, lw=LINE, ls="--")
    names = ["all kinds" if k.kind == "all" else k.kind for k in kinds]
    axes.set_xticks(x, [f"{n}\n{k.count} values" for n, k in zip(names, kinds, strict=True)])
    drawn = [("before", x - shift)] if with_before else []
    for name, places in [*drawn, ("after", x + shift)]:
        for place, kind in zip(places, kinds, strict=True):
            value: float = getattr(kind, name)
            if np.isfinite(value):
                axes.annotate(
                    f"{value:.3g}",
                    (place, value),
                    xytext=(0, 2),
                    textcoords="offset points",
                    ha="center",
                    fontsize=SMALL,
                )
    axes.set_xlim(-0.5 * max(FEWEST_BARS - len(kinds), 0) - 0.6, None)
    axes.set_xlim(right=len(kinds) - 1 - axes.get_xlim()[0])
    values = [v for k in kinds for v in (k.before, k.after) if np.isfinite(v) and v > 0.0]
    if with_before and values and max(values) > LOGARITHMIC * min(values):
        axes.set_yscale("log")
        axes.set_ylim(0.5 * min(*values, 1.0), 2.0 * max(values))
        label_logarithmic(axes.yaxis)
    elif values:
        axes.set_ylim(0.0, 1.15 * max(*values, 1.0))
    label_axes(axes, "", "rms error [sigma]", "by kind of measurement, over sigma")
    axes.tick_params(axis="x", labelsize=SMALL)


def _list_handles(validation: Validation, with_before: bool) -> list[Any]:
    """Return what the legend contains."""
    from matplotlib.lines import Line2D

    before = Line2D(
        [], [], color=BEFORE, marker="s", mfc="none", ms=DOT, lw=LINE, label="before, line: rms"
    )
    label = "after, line: rms" if with_before else "error, line: rms"
    handles = [
        *([before] if with_before else []),
        Line2D([], [], color=AFTER, marker="o", ms=DOT, lw=LINE, label=label),
        Line2D([], [], color=REFERENCE, lw=THIN, ls="--", label="noise floor (rms)"),
    ]
    if any(_find_limit(validation, quantity) is not None for quantity in validation.quantities):
        handles.append(Line2D([], [], color=LIMIT, lw=LINE, ls="-.", label="limit"))
    return handles
