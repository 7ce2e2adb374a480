# SPDX-License-Identifier: Apache-2.0
"""Results of several numbers with intervals: repeatability and the uncertainty budget."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from loopcal.apply.accuracy import AccuracyMap
from loopcal.apply.error_budget import ErrorBudget
from loopcal.apply.height_errors import HeightErrors
from loopcal.apply.repeatability import DIMENSIONS, Estimate, Repeatability, VisitedPose
from loopcal.apply.run_comparison import RunComparison
from loopcal.apply.validation import Validation
from loopcal.findings.wording import count_decimals
from loopcal.mechanism.platform_coordinates import POSITION, read_coordinates
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DIVERGING,
    DOT,
    LABEL,
    LINE,
    MARKERS,
    PALE,
    REFERENCE,
    SEQUENTIAL,
    SMALL,
    THIN,
    add_legend,
    finish_figure,
    label_axes,
    label_logarithmic,
    label_poses,
    shorten,
    start_figure,
)
from loopcal.results.presenters import register
from loopcal.results.tables import format_number
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension, Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@register("figure", Repeatability)
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


@register("figure", ErrorBudget)
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
    names = [line.source.words for line in lines]
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


# --- Uncertainty of poses over the workspace, in slices, beside the measured poses.

SLICES = 3
"""Slices of the workspace."""

NEGLIGIBLE = 1e-9
"""Uncertainty [rad] below which an orientation cannot change and is not drawn."""


class Layout(NamedTuple):
    """Coordinates along both axes and that of the slices, as columns; None without."""

    x: int
    y: int | None
    sliced: int | None


class Slice(NamedTuple):
    """Poses of the map and measured poses in one slice."""

    title: str
    chosen: BoolArray
    measured: BoolArray


@register("figure", AccuracyMap)
def draw_accuracy_map(accuracy: AccuracyMap) -> Figure:
    """Draw the rms uncertainty of position and orientation in slices of the workspace.

    A ring marks a pose that is less certain than every measured pose (extrapolated); a cross is a
    measured pose, a grey square a pose whose uncertainty the data do not bound.
    """
    measured = read_coordinates(accuracy.measured.T, accuracy.names)
    layout = _choose_layout(accuracy.names)
    slices = _cut(accuracy, measured, layout)
    quantities = [("position", DISPLAY_UNITS[Dimension.LENGTH])]
    if np.nanmax(accuracy.uncertainty.orientation, initial=0.0) > NEGLIGIBLE:
        quantities.append(("orientation", DISPLAY_UNITS[Dimension.ANGLE]))
    figure = start_figure(1.8 + 3.5 * len(slices), 1.5 + 3.1 * len(quantities))
    axes_grid: Any = figure.subplots(len(quantities), len(slices), squeeze=False)
    for panels, (name, unit) in zip(axes_grid, quantities, strict=True):
        values = getattr(accuracy.uncertainty, name) / unit.factor_to_si
        if layout.y is None:
            _draw_line(panels[0], accuracy, measured, layout.x, name, unit)
            continue
        _draw_row(figure, panels, accuracy, measured, layout, slices, values)
        figure.axes[-1].set_ylabel(f"{name} uncertainty (rms) [{unit.symbol}]", fontsize=LABEL)
    add_legend(figure, _list_handles(accuracy))
    n = len(accuracy.coordinates)
    outside = (
        f"{int(accuracy.extrapolated.sum())} of {n} {'pose' if n == 1 else 'poses'} extrapolated"
    )
    return finish_figure(figure, f"{outside}\n{accuracy.uncertainty.frame}")


def _choose_layout(names: tuple[str, ...]) -> Layout:
    """Return two positions along the axes and the third as slices, or else angles."""
    lengths = [i for i, name in enumerate(names) if name in POSITION]
    angles = [i for i, name in enumerate(names) if name not in POSITION]
    if len(names) == 1:
        return Layout(0, None, None)
    order = [*lengths, *angles] if len(lengths) > 1 else [*angles, *lengths]
    return Layout(order[0], order[1], order[2] if len(order) > 2 else None)


def _cut(accuracy: AccuracyMap, measured: FloatArray, layout: Layout) -> list[Slice]:
    """Return slices with as many poses each; the measured poses are in that of their place."""
    n, m = len(accuracy.coordinates), len(measured)
    if layout.sliced is None or n < 2 * SLICES:
        return [Slice("", np.ones(n, dtype=bool), np.ones(m, dtype=bool))]
    along = accuracy.coordinates[:, layout.sliced]
    edges = np.quantile(along, np.linspace(0.0, 1.0, SLICES + 1))
    name, unit = accuracy.names[layout.sliced], _unit_of(accuracy.names[layout.sliced])
    number = np.clip(np.searchsorted(edges, along, "right") - 1, 0, SLICES - 1)
    of_measured = np.searchsorted(edges[1:-1], measured[:, layout.sliced], "right")
    if not np.ptp(along) > 0.0:
        return [Slice("", np.ones(n, dtype=bool), np.ones(m, dtype=bool))]
    ends = edges / unit.factor_to_si
    return [
        Slice(
            f"{name} from {ends[i]:.4g} to {ends[i + 1]:.4g} {unit.symbol}",
            number == i,
            of_measured == i,
        )
        for i in range(SLICES)
    ]


def _draw_row(
    figure: Figure,
    panels: Any,
    accuracy: AccuracyMap,
    measured: FloatArray,
    layout: Layout,
    slices: list[Slice],
    values: FloatArray,
) -> None:
    """Draw one quantity in all slices, with one scale of colors."""
    assert layout.y is not None
    finite = values[np.isfinite(values)]
    limits = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    names, i, j = accuracy.names, layout.x, layout.y
    scale = [_unit_of(names[k]).factor_to_si for k in (i, j)]
    x, y = (accuracy.coordinates[:, k] / f for k, f in zip((i, j), scale, strict=True))
    points = None
    for axes, part in zip(panels, slices, strict=True):
        bounded = part.chosen & np.isfinite(values)
        unbounded = part.chosen & ~np.isfinite(values)
        beyond = bounded & accuracy.extrapolated
        points = axes.scatter(
            x[bounded], y[bounded], c=values[bounded], cmap=SEQUENTIAL, s=20.0,
            vmin=limits[0], vmax=limits[1],
        )  # fmt: skip
        axes.scatter(x[beyond], y[beyond], s=52.0, fc="none", ec=COLORS[1], lw=0.6)
        axes.plot(x[unbounded], y[unbounded], "s", color=REFERENCE, ms=4.0)
        place = measured[part.measured]
        axes.plot(place[:, i] / scale[0], place[:, j] / scale[1], "x", color=DARK, ms=4.5)
        if names[i] in POSITION and names[j] in POSITION:
            axes.set_aspect("equal", adjustable="datalim")
        symbols = [f"{names[k]} [{_unit_of(names[k]).symbol}]" for k in (i, j)]
        label_axes(axes, symbols[0], symbols[1] if axes is panels[0] else "", part.title)
    assert points is not None
    bar = figure.colorbar(points, ax=list(panels), aspect=22, pad=0.02)
    bar.ax.tick_params(labelsize=SMALL)


def _draw_line(
    axes: Axes, accuracy: AccuracyMap, measured: FloatArray, i: int, name: str, unit: Unit
) -> None:
    """Draw the uncertainty of a machine with one coordinate against it."""
    of_axis = _unit_of(accuracy.names[i])
    for uncertainty, places, marker, color in (
        (accuracy.uncertainty, accuracy.coordinates, ".", COLORS[0]),
        (accuracy.measured, measured, "x", DARK),
    ):
        values = getattr(uncertainty, name) / unit.factor_to_si
        axes.plot(places[:, i] / of_axis.factor_to_si, values, marker, color=color, lw=THIN)
    label_axes(
        axes, f"{accuracy.names[i]} [{of_axis.symbol}]", f"{name} uncertainty (rms) [{unit.symbol}]"
    )


def _unit_of(name: str) -> Unit:
    """Return the unit in which a controlled coordinate is drawn."""
    return DISPLAY_UNITS[Dimension.LENGTH if name in POSITION else Dimension.ANGLE]


def _list_handles(accuracy: AccuracyMap) -> list[Any]:
    """Return what the legend contains."""
    from matplotlib.lines import Line2D

    style: dict[str, Any] = {"ls": "none"}
    handles = [Line2D([], [], marker="x", color=DARK, ms=4.5, label="measured pose", **style)]
    if accuracy.extrapolated.any():
        label = "less certain than every measured pose"
        handles.append(Line2D([], [], marker="o", mfc="none", mec=COLORS[1], label=label, **style))
    values = accuracy.uncertainty
    if not (np.isfinite(values.position) & np.isfinite(values.orientation)).all():
        label = "not bounded by the data, or out of reach"
        handles.append(Line2D([], [], marker="s", color=REFERENCE, ms=4.0, label=label, **style))
    return handles


# --- Errors on measured poses before and after calibration, beside the noise floor and the limits.

BEFORE, AFTER, LIMIT = COLORS[1], COLORS[0], COLORS[3]
"""Colors of errors before and after calibration, and of a limit."""

FEWEST_BARS = 5
"""Kinds of measurement for which there is room, so that the bars of a single one are narrow."""

LOGARITHMIC = 8.0
"""Ratio of the largest errors before and after from which their axis is logarithmic."""


@register("figure", Validation)
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
    add_legend(figure, _list_validation_handles(validation, with_before))
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


def _list_validation_handles(validation: Validation, with_before: bool) -> list[Any]:
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


# --- Several calibrations side by side: parameters with their intervals, shifts, held-out errors.

MOST_ROWS = 60
"""Parameters that a figure shows."""


def draw_run_parameters(comparison: RunComparison) -> Figure:
    """Draw the estimate of each run with its 95 % interval, as difference from the first run that
    identified the parameter, in half-widths of that run's interval.
    """
    from matplotlib.lines import Line2D

    names = [name for name in comparison.parameters if _find_reference(comparison, name)]
    shown = names[:MOST_ROWS]
    figure = start_figure(7.2, 1.8 + 0.22 * max(len(shown), 1))
    axes: Any = figure.add_subplot()
    handles, count = [], len(comparison.runs)
    for k, run in enumerate(comparison.runs):
        color, marker = COLORS[k % len(COLORS)], MARKERS[k % len(MARKERS)]
        offset = 0.6 * (k + 0.5) / count - 0.3
        for row, name in enumerate(shown):
            value, half = run.estimates.get(name), run.plus_minus.get(name)
            if value is None or half is None:
                continue
            center, unit = _find_reference(comparison, name) or (0.0, 1.0)
            axes.errorbar(
                (value - center) / unit, row + offset, xerr=half / unit, color=color,
                marker=marker, ms=DOT + 0.5, lw=LINE, capsize=2.0,
            )  # fmt: skip
        handles.append(Line2D([], [], color=color, marker=marker, lw=LINE, label=shorten(run.name)))
    axes.axvline(0.0, color=REFERENCE, lw=THIN)
    axes.set_yticks(range(len(shown)), [shorten(name) for name in shown])
    axes.set_ylim(len(shown) - 0.4, -0.6)
    first = shorten(comparison.runs[0].name)
    label_axes(axes, f"difference from {first} [half-widths of its 95 % interval]", "")
    add_legend(figure, handles)
    more = len(names) - len(shown)
    part = f" (the first {len(shown)} of {len(names)} parameters)" if more > 0 else ""
    return finish_figure(figure, f"Estimates with their 95 % intervals{part}")


def _find_reference(comparison: RunComparison, name: str) -> tuple[float, float] | None:
    """Return estimate and half-width of the first run with an interval above 0; None without."""
    for run in comparison.runs:
        value, half = run.estimates.get(name), run.plus_minus.get(name)
        if value is not None and half is not None and half > 0.0:
            return value, half
    return None


def draw_run_errors(comparison: RunComparison, show_unit: Callable[[str], Unit]) -> Figure:
    """Draw rms (bar) and largest (dot) error of each run after calibration, by quantity.

    Parameters
    ----------
    show_unit : quantity ("position", ...) -> the unit of its errors.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    has_common = comparison.common_poses > 0
    errors = [run.common if has_common else run.own for run in comparison.errors]
    quantities = tuple(dict.fromkeys(name for of_run in errors for name in of_run))
    figure = start_figure(7.2, 1.4 + 2.6 * max(len(quantities), 1))
    panels: Any = figure.subplots(max(len(quantities), 1), 1, squeeze=False)[:, 0]
    x = np.arange(len(errors))
    for axes, quantity in zip(panels, quantities, strict=False):
        unit = show_unit(quantity)
        for k, of_run in enumerate(errors):
            error = of_run.get(quantity)
            if error is not None:
                axes.bar(k, error.rms / unit.factor_to_si, 0.5, color=COLORS[k % len(COLORS)])
                axes.plot(k, error.max / unit.factor_to_si, "o", color="0.2", ms=DOT + 1.0)
        labels = [shorten(run.run) for run in comparison.errors]
        axes.set_xticks(x, labels, fontsize=SMALL)
        axes.set_xlim(-0.6, len(errors) - 0.4)
        axes.set_ylim(bottom=0.0)
        label_axes(axes, "", f"{quantity} error [{unit.symbol}]")
    add_legend(
        figure,
        [
            Patch(color=REFERENCE, label="root mean square"),
            Line2D([], [], ls="none", marker="o", color="0.2", label="largest"),
        ],
    )
    poses = (
        f"{comparison.common_poses} common poses" if has_common else "held-out poses of each run"
    )
    return finish_figure(figure, f"Errors after calibration at the {poses}")


@register("figure", RunComparison)
def draw_run_shifts(comparison: RunComparison) -> Figure:
    """Draw the shift of each parameter from the first run, in standard deviations, while all others
    may have changed, too; a significant shift is filled. What is not determined or not tested has
    no marker.
    """
    from matplotlib.lines import Line2D

    names = comparison.parameters[:MOST_ROWS]
    figure = start_figure(7.2, 1.8 + 0.2 * len(names))
    axes: Any = figure.add_subplot()
    handles, y = [], np.arange(len(names))
    for k, pair in enumerate(comparison.pairs, 1):  # the first run has color and marker 0
        color, marker = COLORS[k % len(COLORS)], MARKERS[k % len(MARKERS)]
        shifts = [pair.find_shift(name) for name in names]
        size = np.array([shift / sd if sd > 0.0 else np.nan for shift, sd, _ in shifts])
        significant = np.array([flag for _, _, flag in shifts])
        offset = 0.5 * k / (len(comparison.pairs) + 1) - 0.25
        for chosen, face in ((significant, color), (~significant, "white")):
            axes.plot(size[chosen], (y + offset)[chosen], marker, color=color, mfc=face, ms=DOT + 2)
        handles.append(
            Line2D([], [], color=color, marker=marker, ls="none", label=shorten(pair.second))
        )
    axes.axvspan(-1.96, 1.96, color=PALE, alpha=0.35, lw=0.0, zorder=0)
    axes.axvline(0.0, color=REFERENCE, lw=THIN)
    axes.set_yticks(y, [shorten(name) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    first = comparison.runs[0].name
    label_axes(axes, f"shift from {shorten(first)} [standard deviations]", "")
    handles.append(Line2D([], [], color=PALE, lw=6, alpha=0.5, label="95 % of a single shift"))
    handles.append(
        Line2D([], [], color=DARK, marker="o", ls="none", label="filled: significant at 5 % of all")
    )
    add_legend(figure, handles)
    return finish_figure(figure, _describe_changes(comparison))


def _describe_changes(comparison: RunComparison) -> str:
    """Return the outcome of each pair in a few words, and what explains a change."""
    words = {True: "has changed", False: "no change", None: "not tested"}
    lines = []
    for pair in comparison.pairs:
        line = f"{shorten(pair.second)}: {words[pair.moved]}"
        if pair.moved and pair.cause.names:
            line += f"; a change of {' and '.join(pair.cause.names)} alone explains it"
        lines.append(line)
    more = len(comparison.parameters) - MOST_ROWS
    if more > 0:
        lines.append(f"the first {MOST_ROWS} of {len(comparison.parameters)} parameters")
    return "\n".join(lines)


# --- Errors of measured heights over x and y, before and after calibration.

MOST_NUMBERS = 40
"""Points up to which each has its error as a number."""

HEIGHT_MARKERS = {"fitted": "o", "held-out": "s"}
"""Of points that the fit used, and of those that it did not."""

AREA, MARGIN = 110.0, 0.16
"""Area of a marker [pt^2], and margin around the points as a share of their range."""


@register("figure", HeightErrors)
def draw_height_errors(heights: HeightErrors) -> Figure:
    """Draw the errors of heights over x and y, before and after, with one scale of colors.

    Circles are points of the fit, squares are held out.
    """
    factor = heights.unit.factor_to_si
    limit = float(np.abs(np.concatenate([heights.before, heights.after])).max()) / factor or 1.0
    figure = start_figure(10.0, 5.2)
    panels: Any = figure.subplots(1, 2)
    points = None
    for axes, name in zip(panels, ("before", "after"), strict=True):
        points = _draw_panel(axes, heights, name, limit)
    assert points is not None
    bar = figure.colorbar(points, ax=list(panels), aspect=24, pad=0.02)
    bar.ax.tick_params(labelsize=SMALL)
    symbol = heights.unit.symbol
    bar.ax.set_ylabel(f"height error, predicted - measured [{symbol}]", fontsize=LABEL)
    add_legend(figure, _list_height_handles(heights))
    count = len(heights.poses)
    return finish_figure(figure, f"Height errors at {count} points")


def _draw_panel(axes: Axes, heights: HeightErrors, name: str, limit: float) -> Any:
    """Draw the errors before or after; return the points with their scale of colors."""
    factor, symbol = heights.unit.factor_to_si, heights.unit.symbol
    x, y = heights.points.T / factor
    errors = getattr(heights, name) / factor
    drawn = None
    for of_set, is_held_out in heights.list_sets():
        chosen = heights.is_held_out == is_held_out
        drawn = axes.scatter(
            x[chosen], y[chosen], c=errors[chosen], cmap=DIVERGING, vmin=-limit, vmax=limit,
            s=AREA, marker=HEIGHT_MARKERS[of_set], ec=DARK, lw=0.7,
        )  # fmt: skip
    if len(errors) <= MOST_NUMBERS:
        decimals = count_decimals(limit)
        for place, value in zip(zip(x, y, strict=True), errors, strict=True):
            axes.annotate(
                f"{round(float(value), decimals) + 0.0:+.{decimals}f}", place, (0, 8),
                textcoords="offset points", ha="center", fontsize=SMALL,
            )  # fmt: skip
    rms = [
        f"{of_set} {heights.statistics(name, is_held_out).rms / factor:.3g}"
        for of_set, is_held_out in heights.list_sets()
    ]
    title = f"{name} calibration: rms {', '.join(rms)} {symbol}"
    label_axes(axes, f"x [{symbol}]", f"y [{symbol}]" if name == "before" else "", title)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(MARGIN)
    return drawn


def _list_height_handles(heights: HeightErrors) -> list[Any]:
    """Return what the legend contains."""
    from matplotlib.lines import Line2D

    words = {"fitted": "used in the fit", "held-out": "held out"}
    return [
        Line2D([], [], ls="none", marker=HEIGHT_MARKERS[n], mfc="none", mec=DARK, label=words[n])
        for n, _ in heights.list_sets()
    ]
