# SPDX-License-Identifier: Apache-2.0
"""Figures of a fit, of what measurements determine, and of regularization."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply.validation import owner_of
from loopcal.diagnose.cross_validation import RegularizationCurves
from loopcal.diagnose.identifiable_parameters import Identifiability
from loopcal.estimate.result import Identification, KindResiduals
from loopcal.findings.wording import list_names, name_count
from loopcal.measure.kinds.joints import ActuatorReadings
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.statistics import normal_quantile
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DASHED,
    DIVERGING,
    DOT,
    FEW_TICKS,
    LABEL,
    LINE,
    MARKERS,
    PALE,
    SMALL,
    THIN,
    ZERO,
    add_colorbar,
    add_legend,
    finish_figure,
    label_axes,
    label_poses,
    label_rows,
    label_sparsely,
    scale_logarithmically,
    shorten,
    start_figure,
    start_panels,
)
from loopcal.report.validation_view import WORDS
from loopcal.results.presenters import register
from loopcal.results.tables import choose_unit, format_uncertainty, format_with_uncertainty
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension, Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from loopcal.estimate.free_parameters import Combination

Styles = Mapping[str, dict[str, Any]]
"""Label of a series -> color and marker."""


@dataclass(frozen=True, eq=False)
class ResidualSeries:
    """The r residuals of one component of one kind, without rows that were not measured.

    quantities : name -> (r,), what the residuals are drawn against [SI], [s], [degC].
    """

    kind: str
    component: str
    dimension: Dimension
    poses: IntArray  # (r,) number of the pose of each row, in order of measurement
    raw: FloatArray  # (r,) [SI]
    whitened: FloatArray  # (r,) over sigma
    quantities: Mapping[str, FloatArray]

    @property
    def label(self) -> str:
        """Component and kind."""
        return self.kind if self.component in {"", self.kind} else f"{self.kind} {self.component}"


def list_series(robot: Mechanism, residuals: Sequence[KindResiduals]) -> list[ResidualSeries]:
    """Return residuals by kind and component."""
    place = {label: i for i, label in enumerate(_list_poses(residuals), 1)}
    listed = []
    for rows in residuals:
        poses = np.array([place[label] for label in rows.poses], dtype=np.intp)
        actuators = [f"reading {actuator.name}" for actuator in robot.actuators]
        quantities = {**dict(zip(actuators, rows.readings.T, strict=False)), **rows.context}
        columns = zip(rows.components, rows.dimensions, rows.raw.T, rows.whitened.T, strict=True)
        for component, dimension, raw, whitened in columns:
            # a row of weight 0 has no whitened residual
            used = np.isfinite(raw) & ((whitened != 0.0) | (raw == 0.0))
            of_used = {name: values[used] for name, values in quantities.items()}
            kept = poses[used], raw[used], whitened[used], of_used
            listed.append(ResidualSeries(rows.kind, component, dimension, *kept))
    return listed


def _list_poses(residuals: Sequence[KindResiduals]) -> tuple[str, ...]:
    """Return the labels of all poses with residuals, in order of measurement."""
    return tuple(dict.fromkeys(label for rows in residuals for label in rows.poses))


def _list_quantities(series: Sequence[ResidualSeries]) -> list[str]:
    """Return the quantities that vary: readings, then time, then temperatures."""
    varying = []
    for name in dict.fromkeys(name for s in series for name in s.quantities):
        values = np.concatenate([s.quantities[name] for s in series if name in s.quantities])
        known = values[np.isfinite(values)]
        if len(known) and np.ptp(known) > 0.0:
            varying.append(name)
    return varying


SIGMAS = "residual [sigma]"  # label of an axis of whitened residuals
# Residuals over sigma that 95 % do not exceed, if the stated noise is right.
BAND = 1.959963984540054
MANY = 2000  # points of all series from which they are embedded as a picture in SVG and PDF files

UPRIGHT, LABELED, COLUMNS = 8, 30, 3
"""Components whose numbers fit side by side, that are named by target, and panels in a row."""


@register("figure residuals", Identification)
def draw_residuals(fit: Identification) -> Figure:
    """Draw the residuals of a fit, see `draw_residual_rows`."""
    return draw_residual_rows(fit.robot, fit.residuals, fit.nuisance.names)


def draw_residual_rows(
    robot: Mechanism, residuals: Sequence[KindResiduals], setup: Sequence[str] = ()
) -> Figure:
    """Draw residuals in units by pose, then over sigma by component, as histogram and normal plot,
    and against each actuator reading, time and temperature that was recorded.

    Residuals of actuator readings are in the first two only: the estimated poses take up a part of
    them, so that they are smaller than their sigma.

    residuals : of a fit or of a run folder. setup : names of the fitted setup parameters.
    """
    series = [s for s in list_series(robot, residuals) if len(s.raw)]
    if len(series) > LABELED:
        series = [replace(s, component=s.component.rpartition(".")[2]) for s in series]
    styles, quantities = _choose_styles(series), _list_quantities(series)
    poses = _list_poses(residuals)
    groups: dict[tuple[str, Dimension], list[ResidualSeries]] = {}
    for s in series:  # those of one kind and dimension share an axis
        groups.setdefault((s.kind, s.dimension), []).append(s)
    rows = -(-len(quantities) // COLUMNS)
    heights = [*[1.6] * len(groups), 2.4, *[1.7] * rows]
    figure = start_figure(11.0, 0.8 + sum(heights))
    grid = figure.add_gridspec(len(heights), 2 * COLUMNS, height_ratios=heights)
    for i, group in enumerate(groups.values()):
        raw = np.concatenate([s.raw for s in group])
        unit = choose_unit(robot.get_unit(group[0].dimension), raw)
        _draw_by_pose(figure.add_subplot(grid[i, :]), unit, poses, group, styles)
    n = len(groups)
    _draw_components(figure.add_subplot(grid[n, :2]), series, styles)
    measured = [s for s in series if s.kind != ActuatorReadings.name]
    whitened = np.concatenate([s.whitened for s in measured]) if measured else np.zeros(0)
    _draw_histogram(figure.add_subplot(grid[n, 2:4]), whitened)
    _draw_normal_plot(figure.add_subplot(grid[n, 4:]), whitened)
    units = {f"reading {a.name}": robot.get_unit(a.dimension) for a in robot.actuators}
    for i, name in enumerate(quantities):
        row, column = divmod(i, COLUMNS)
        axes = figure.add_subplot(grid[n + 1 + row, 2 * column : 2 * column + 2])
        factor = units[name].factor_to_si if name in units else 1.0
        symbol = units[name].symbol if name in units else "s" if name == "time" else "degC"
        label_sparsely(axes.xaxis, 5, is_whole=False)
        for s in (s for s in measured if name in s.quantities):
            axes.plot(s.quantities[name] / factor, s.whitened, **styles[s.label])
        _add_band(axes)
        label_axes(axes, f"{name} [{symbol}]", SIGMAS)
    add_legend(figure)
    count = f"{sum(len(s.raw) for s in series)} residuals of {name_count(len(poses), 'pose')}"
    owners = tuple(dict.fromkeys(owner_of(name) for name in setup))
    fitted = f"after the best fit of {list_names(owners, 4)}" if owners else "in the stated frames"
    return finish_figure(figure, f"{robot.name}: {count}; predicted - measured, {fitted}")


def _choose_styles(series: Sequence[ResidualSeries]) -> Styles:
    """Return label, color and marker of each series; they differ in both up to eight series."""
    is_large = sum(len(s.raw) for s in series) > MANY
    return {
        label: {
            "label": label,
            "color": COLORS[i % len(COLORS)],
            "marker": MARKERS[i % len(MARKERS)],
            "ls": "none",
            "ms": DOT,
            "mfc": "none" if i >= len(COLORS) else COLORS[i % len(COLORS)],
            "mew": 0.7,
            "rasterized": is_large,
        }
        for i, label in enumerate(dict.fromkeys(s.label for s in series))
    }


def _draw_by_pose(
    axes: Axes, unit: Unit, poses: Sequence[str], group: Sequence[ResidualSeries], styles: Styles
) -> None:
    """Draw the residuals of one kind in units; components are side by side at their pose."""
    reach = 0.25 if len(poses) <= 60 else 0.0
    for s, step in zip(group, np.linspace(-reach, reach, len(group) + 2)[1:-1], strict=True):
        axes.plot(s.poses + step, s.raw / unit.factor_to_si, **styles[s.label])
    axes.axhline(0.0, **ZERO, zorder=1)
    label_axes(axes, "", f"{group[0].kind} residual [{unit.symbol}]", "by pose")
    label_poses(axes, poses)


def _draw_components(axes: Axes, series: Sequence[ResidualSeries], styles: Styles) -> None:
    """Draw the residuals over sigma by component, with the rms of each."""
    is_crowded = len(styles) > UPRIGHT
    for i, (label, style) in enumerate(styles.items()):
        values = np.concatenate([s.whitened for s in series if s.label == label])
        spread = np.linspace(-0.22, 0.22, len(values)) if len(values) > 1 else np.zeros(len(values))
        axes.plot(i + spread, values, **style)
        size = float(np.sqrt((values**2).mean()))
        for sign in (-1.0, 1.0):
            axes.hlines(sign * size, i - 0.38, i + 0.38, color=DARK, lw=LINE)
        axes.annotate(
            f"{size:.2f}", (i, 1.0), (0, -2), ("data", "axes fraction"), "offset points",
            ha="center", va="top", fontsize=SMALL - 1, rotation=90 if is_crowded else 0,
        )  # fmt: skip
    _add_band(axes)
    axes.margins(y=0.35 if is_crowded else 0.16)
    is_long = max(map(len, styles), default=0) * len(styles) > 32
    rotation, side = (90, "center") if is_crowded else (35, "right") if is_long else (0, "center")
    axes.set_xticks(range(len(styles)), list(styles), rotation=rotation, ha=side)
    label_axes(axes, "", SIGMAS, "by component; bars: rms")


def _draw_histogram(axes: Axes, whitened: FloatArray) -> None:
    """Draw a histogram of the residuals over sigma beside the density of the stated noise."""
    reach = max(4.0, float(np.abs(whitened).max(initial=0.0)))
    bins = int(np.clip(np.sqrt(len(whitened)) * 1.5, 8, 60))
    edges, x = np.linspace(-reach, reach, bins + 1).tolist(), np.linspace(-reach, reach, 200)
    axes.hist(whitened, edges, density=whitened.size > 0, color=COLORS[5], ec="white")
    axes.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), color=DARK, lw=LINE)
    label_axes(axes, SIGMAS, "density [1/sigma]", "histogram, line: given noise")


def _draw_normal_plot(axes: Axes, whitened: FloatArray) -> None:
    """Draw the sorted residuals over sigma against the quantiles of a normal distribution."""
    values = np.sort(whitened)
    x = normal_quantile((np.arange(len(values)) + 0.5) / max(len(values), 1))
    axes.plot(x, values, "o", color=COLORS[0], ms=DOT - 0.5, rasterized=len(x) > MANY)
    if len(values):
        axes.plot(x[[0, -1]], x[[0, -1]], color=DARK, lw=LINE)
    label_axes(axes, "normal quantile [sigma]", SIGMAS, "normal plot, line: given noise")


def _add_band(axes: Axes) -> None:
    """Draw zero, and the limits of 95 % of the residuals if the stated noise is right."""
    axes.axhline(0.0, **ZERO, zorder=1)
    for sign in (-1.0, 1.0):
        axes.axhline(sign * BAND, **DASHED, zorder=1, label="95 % limits of the stated noise")


# Length of an arrow of the rms of the residuals, as a share of the width of a picture.
ARROW = 0.02


def draw_residual_arrows(robot: str, residuals: Sequence[KindResiduals]) -> Figure:
    """Draw residuals in pixels as arrows from where points were seen, for each kind in a panel.

    residuals : of kinds whose two components are pixels.
    """
    figure, panels = start_panels(11.0, 6.0, 1, len(residuals))
    for axes, rows in zip(panels[0], residuals, strict=True):
        (u, v), (du, dv) = rows.measured.T, rows.raw.T
        rms = max(float(np.sqrt(np.nanmean(rows.raw**2))), 1e-9)
        times = ARROW * float(np.nanmax(rows.measured)) / rms
        how: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / times}
        axes.quiver(u, v, du, dv, color=COLORS[0], width=0.0015, rasterized=len(u) > MANY, **how)
        axes.set_aspect("equal")
        axes.invert_yaxis()
        title = f"{name_count(len(set(rows.poses)), 'picture')}, rms {rms:.2g} px"
        label_axes(axes, "u [px]", "v [px]", f"{title}, arrows {times:.0f} times")
    return finish_figure(figure, f"{robot}: predicted - seen")


# Parameters of a fit: shifts with their intervals, uncertainties, and correlations.

MOST_ROWS, MOST_NAMES = 50, 110
"""Parameters of one column of panels, and up to which a picture of correlations names each one."""

SHIFT, WIDTH = COLORS[0], COLORS[1]
"""Colors of shifts and of uncertainties."""


@register("figure parameters", Identification)
def draw_parameters(fit: Identification) -> Figure:
    """Draw the parameters of a fit, see `draw_parameter_rows`."""
    return draw_parameter_rows(fit.robot.name, fit.list_parameters(), fit.converged)


def draw_parameter_rows(
    robot: str, rows: Sequence[Mapping[str, Any]], converged: bool = True
) -> Figure:
    """Draw the shift of each parameter in spreads with its 95 % interval, its uncertainty in
    spreads, and both as numbers in the unit of the robot's file.

    Of a fit that did not converge only the last values are drawn, without intervals.

    robot : its name. rows : see `Identification.list_parameters`; or those of a run folder.
    """
    p, columns = len(rows), max(-(-len(rows) // MOST_ROWS), 1)
    chunks = np.array_split(np.arange(p), columns)
    height = 1.6 + 0.19 * max(map(len, chunks))
    figure, panels = start_panels(
        8.2 * columns, height, 1, 2 * columns, width_ratios=[3, 2] * columns
    )
    half = np.array([row["plus_minus"] / row["tolerance"] if converged else np.nan for row in rows])
    for i, chunk in enumerate(chunks):
        shown = [rows[k] for k in chunk]
        _draw_shifts(panels[0, 2 * i], shown, half[chunk])
        _draw_uncertainties(panels[0, 2 * i + 1], shown, half[chunk], converged)
    add_legend(figure)
    status = "" if converged else ", without convergence: last values, not estimates"
    n_assumed = sum(row["tolerance_assumed"] for row in rows)
    assumed = f", {n_assumed} prior sd assumed" if n_assumed else ""
    return finish_figure(figure, f"{robot}: {name_count(p, 'parameter')}{assumed}{status}")


def _draw_shifts(axes: Axes, rows: Sequence[Mapping[str, Any]], half: FloatArray) -> None:
    """Draw estimate minus nominal value in spreads, with the 95 % interval."""
    shift = np.array([(row["estimate"] - row["nominal"]) / row["tolerance"] for row in rows])
    known, y = np.isfinite(half), np.arange(len(rows))
    band: dict[str, Any] = {"color": PALE, "alpha": 0.35, "lw": 0.0, "zorder": 0}
    axes.axvspan(-1.0, 1.0, label="one prior sd", **band)
    axes.axvline(0.0, **ZERO, zorder=1)
    if known.any():
        style: dict[str, Any] = {"fmt": "o", "ms": DOT, "elinewidth": 1.2, "capsize": 1.5}
        style |= {"color": SHIFT, "label": "shift, 95 % interval"}
        axes.errorbar(shift[known], y[known], xerr=half[known], **style)
    if not known.all():
        style = {"color": SHIFT, "ms": DOT + 1, "label": "without an interval"}
        axes.plot(shift[~known], y[~known], "x", **style)
    label_rows(axes, [shorten(row["name"]) for row in rows])
    label_axes(axes, "estimate - nominal [prior sd]", "", "shift")


def _draw_uncertainties(
    axes: Axes, rows: Sequence[Mapping[str, Any]], half: FloatArray, converged: bool
) -> None:
    """Draw the half-width of the 95 % interval in spreads; the numbers are at the right."""
    y, drawn = np.arange(len(rows)), np.isfinite(half) & (half > 0.0)
    axes.axvline(1.0, **DASHED, zorder=1)
    if drawn.any():
        axes.plot(half[drawn], y[drawn], "s", color=WIDTH, ms=DOT, label="uncertainty (95 %)")
        axes.set_xlim(0.6 * min(half[drawn].min(), 1.0), 1.7 * max(half[drawn].max(), 1.0))
        scale_logarithmically(axes.xaxis, FEW_TICKS)
    else:
        axes.set_xticks([])
    numbers = []
    for row in rows:
        value, width = row["estimate"], row["plus_minus"]
        unit = "" if row["unit"] == "1" else f" {row['unit']}"  # a ratio has no unit
        shown = f"{format_with_uncertainty(value, width)} ± {format_uncertainty(width)}"
        numbers.append(f"{shown if converged else f'{value:.3g}'}{unit}")
    axes.yaxis.tick_right()
    label_rows(axes, numbers)
    label = "half-width [prior sd]" if drawn.any() else ""
    title = "uncertainty (95 %)" if drawn.any() else "without an interval"
    label_axes(axes, label, "", title)


@register("figure correlation", Identification)
def draw_correlation(fit: Identification) -> Figure:
    """Draw the correlations of the parameters of a fit, see `draw_correlation_matrix`."""
    return draw_correlation_matrix(fit.robot.name, fit.names, fit.covariance)


def draw_correlation_matrix(robot: str, names: Sequence[str], covariance: FloatArray) -> Figure:
    """Draw the correlations of all parameters as a matrix of colors; covariance : (p, p) [SI].

    Parameters without a finite uncertainty have a grey row.
    """
    p, correlation = len(names), compute_correlation(covariance)
    size = float(np.clip(0.155 * p, 3.4, 13.0))
    figure = start_figure(size + 2.6, size + 1.6)
    axes = figure.add_subplot()
    axes.set_facecolor(PALE)
    image = axes.imshow(correlation, cmap=DIVERGING, vmin=-1.0, vmax=1.0)
    step = -(-p // MOST_NAMES)
    places = list(range(0, p, step))
    font = float(np.clip(size * 72.0 / max(len(places), 1) * 0.72, 4.0, SMALL))
    shown = [shorten(names[i]) for i in places]
    axes.set_xticks(places, shown, rotation=90, fontsize=font)
    axes.set_yticks(places, shown, fontsize=font)
    owners = [name.split(".")[0] for name in names]
    edges = [i - 0.5 for i in range(1, p) if owners[i] != owners[i - 1]]
    if len(edges) < p - 1:
        for edge in edges:
            axes.axhline(edge, color=DARK, lw=0.5)
            axes.axvline(edge, color=DARK, lw=0.5)
    add_colorbar(figure, image, axes, "correlation [1]", shrink=0.7, aspect=25)
    words = f"correlation of {name_count(p, 'parameter')}"
    off = np.abs(np.nan_to_num(correlation - np.diag(np.diag(correlation))))
    if off.size and off.max() > 0.0:
        i, j = divmod(int(off.argmax()), p)
        pair = f"{shorten(names[j])} and {shorten(names[i])}"
        words += f"\nstrongest {correlation[i, j]:+.2f}: {pair}"
    if np.isnan(np.diag(correlation)).any():
        words += "\ngrey: without a finite uncertainty"
    if step > 1:
        words += f"\nwith every {step}. name"
    return finish_figure(figure, f"{robot}: {words}")


def compute_correlation(covariance: FloatArray) -> FloatArray:
    """Return the correlations (p, p) [1]; NaN where a parameter has no finite uncertainty."""
    sd = np.sqrt(np.diag(covariance))
    usable = np.isfinite(sd) & (sd > 0.0)
    scale = np.where(usable, sd, np.nan)
    return np.where(np.outer(usable, usable), covariance, np.nan) / np.outer(scale, scale)


SMALLEST = 1e-16  # change in spreads below which a number is rounding and drawn at this value


@register("figure convergence", Identification)
def draw_convergence(fit: Identification) -> Figure:
    """Draw the sum of squares, what noise alone would leave of it, and the distance of each
    parameter from its last value in spreads, by step of the iteration.
    """
    figure, ((of_cost, of_parameters),) = start_panels(9.0, 3.9, 1, 2)
    cost, history = np.asarray(fit.history.cost), np.asarray(fit.history.estimate)
    of_cost.plot(np.arange(len(cost)), cost, "o-", color=COLORS[0], ms=DOT + 0.5, lw=LINE)
    degrees = fit.residual_test.degrees
    if np.isfinite(degrees) and degrees > 0.0 and not fit.residual_test.weighted:
        of_cost.axhline(degrees, **DASHED, label="expected from the noise")
        of_cost.legend(frameon=False, fontsize=SMALL)
    if (cost > 0.0).all():
        scale_logarithmically(of_cost.yaxis, decades=8)
    distance = np.maximum(np.abs(history - history[-1])[:-1] / fit.tolerance, SMALLEST)
    if distance.size:
        steps = np.arange(len(distance))
        of_parameters.plot(steps, distance, color=PALE, lw=THIN)
        style = {"color": COLORS[1], "ms": DOT, "lw": LINE, "label": "largest"}
        of_parameters.plot(steps, distance.max(axis=1), "o-", **style)
        of_parameters.plot([], [], color=PALE, lw=THIN, label="each parameter")
        scale_logarithmically(of_parameters.yaxis, decades=8)
        of_parameters.legend(frameon=False, fontsize=SMALL)
    for axes, count in ((of_cost, len(cost)), (of_parameters, len(history))):
        axes.set_xlim(-0.3, max(count - 1, 1) + 0.3)
        label_sparsely(axes.xaxis)
    label_axes(of_cost, "step [1]", "sum of (residual/sigma)² [1]", "sum of squares")
    distances = "distance from the last value [prior sd]"
    label_axes(of_parameters, "step [1]", distances, "parameters")
    words = fit.status.name.lower().replace("_", " ")
    return finish_figure(figure, f"{fit.robot.name}: {words} after {fit.history.iterations} steps")


# What measurements determine: singular values with the gap, and the combinations left open.

MOST_COMBINATIONS, MOST_PARAMETERS = 14, 48
"""Combinations and parameters that the picture of combinations shows."""

FLOOR = 1e-18  # share of the largest singular value at which a smaller one is drawn


@register("figure", Identifiability)
def draw_identifiability(analysis: Identifiability) -> Figure:
    """Draw the singular values with the rank and the gap, and the null vectors and weak directions
    as weights of the parameters.
    """
    combinations = (*analysis.unidentifiable, *analysis.weak)[:MOST_COMBINATIONS]
    names = list(dict.fromkeys(name for c in combinations for name in c.names))
    height = max(4.7, 2.2 + 0.17 * len(names[:MOST_PARAMETERS]))
    widths = [5.0, 3.2 + 0.42 * len(combinations)] if combinations else [5.2]
    how = {"width_ratios": widths}
    figure, (panels,) = start_panels(sum(widths), height, 1, len(widths), **how)
    _draw_spectrum(panels[0], analysis)
    if combinations:
        _draw_combinations(figure, panels[1], analysis, combinations, names)
    add_legend(figure)
    robot = analysis.free_parameters.robot.name
    rank = f"rank {analysis.rank} of {analysis.n_parameters}"
    return finish_figure(figure, f"{robot}: {rank}, {analysis.n_equations} equations")


def _draw_spectrum(axes: Axes, analysis: Identifiability) -> None:
    """Draw the singular values: those that count, those that do not, and the limits; an arrow over
    the gap between them.
    """
    s, rank = analysis.singular_values, analysis.rank
    count, number = len(s), np.arange(1, len(s) + 1)
    floor = FLOOR * float(s[0]) if count and s[0] > 0.0 else FLOOR
    drawn = np.maximum(s, floor)
    axes.plot(number[:rank], drawn[:rank], "o", color=COLORS[0], ms=DOT + 0.5, label="determined")
    if rank < count:
        style: dict[str, Any] = {"color": COLORS[1], "mfc": "none", "ms": DOT + 1.5}
        axes.plot(number[rank:], drawn[rank:], "v", label="counts as zero", **style)
    axes.axhline(1.0, **DASHED, label="known as well as the prior sd")
    if rank < count:
        limit = max(analysis.tolerance * float(s[0]), floor)
        axes.axhline(limit, color=DARK, lw=THIN, ls=":", label="limit of the rank")
    scale_logarithmically(axes.yaxis, (), decades=10)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * 3.0)
    if 0 < rank < count:
        x, (above, below) = rank + 0.5, drawn[rank - 1 : rank + 1].tolist()
        arrow = {"arrowstyle": "<->", "color": DARK, "lw": THIN}
        axes.annotate("", (x, above), (x, below), arrowprops=arrow)
        axes.annotate(
            f"gap {analysis.gap:.2g}" if np.isfinite(analysis.gap) else "infinite gap",
            (x, float(np.sqrt(drawn[rank - 1] * drawn[rank]))), (-4, 0),
            textcoords="offset points", ha="right", va="center", fontsize=SMALL,
        )  # fmt: skip
    axes.set_xlim(0.4 - 0.02 * count, count + 0.6 + 0.02 * count)
    label_sparsely(axes.xaxis, min_n_ticks=1)
    label_axes(axes, "direction [1]", "singular value [sigma per prior sd]", "singular values")


def _draw_combinations(
    figure: Figure,
    axes: Axes,
    analysis: Identifiability,
    combinations: Sequence[Combination],
    names: Sequence[str],
) -> None:
    """Draw the weight of each parameter in each combination as a color."""
    named, count, null = names[:MOST_PARAMETERS], len(combinations), len(analysis.unidentifiable)
    place = {name: i for i, name in enumerate(named)}
    weights = np.zeros((len(named), count))
    for column, combination in enumerate(combinations):
        for name, weight in zip(combination.names, combination.weights, strict=True):
            if name in place:
                weights[place[name], column] = weight
    weights /= np.maximum(np.abs(weights).max(axis=0), 1e-300)
    image = axes.imshow(weights, cmap=DIVERGING, vmin=-1.0, vmax=1.0, aspect="auto")
    labels = [f"null {i + 1}" if i < null else f"weak {i + 1 - null}" for i in range(count)]
    axes.set_xticks(range(count), labels, rotation=90)
    axes.set_yticks(range(len(named)), [shorten(name) for name in named])
    if 0 < null < count:
        axes.axvline(null - 0.5, color=DARK, lw=THIN)
    more = f" (first {count})" if count < null + len(analysis.weak) else ""
    label_axes(axes, "", "", f"null vectors and weak directions{more}", grid=False)
    if len(names) > len(named):
        axes.set_xlabel(f"and {len(names) - len(named)} more parameters", fontsize=SMALL)
    add_colorbar(figure, image, axes, "weight in prior sd, largest = 1 [1]", aspect=25, shrink=0.8)


# Rule -> marker and color of the value of a regularization curve that it chooses.
METHOD_MARKERS = {
    "GCV": ("v", COLORS[1]),
    "marginal likelihood": ("s", COLORS[2]),
    "lowest held-out error": ("o", COLORS[3]),
    "one standard error": ("D", COLORS[4]),
}


@register("figure", RegularizationCurves)
def draw_regularization(curves: RegularizationCurves) -> Figure:
    """Draw the held-out error against lam and against k, with bands of one standard error, and mark
    what rules choose.
    """
    figure, (panels,) = start_panels(10.0, 4.6, 1, 2, sharey=True)
    both = (curves.ridge, curves.truncation)
    smallest = min(float(c.score[np.isfinite(c.score)].min(initial=np.inf)) for c in both)
    for axes, curve in zip(panels, both, strict=True):
        x, y, error = curve.values, curve.score, np.nan_to_num(curve.standard_error)
        line = "-" if curve.name == "lam" else "o-"
        axes.plot(x, y, line, color=COLORS[0], ms=3.0, label="held-out error")
        band: dict[str, Any] = {"color": COLORS[0], "alpha": 0.2, "lw": 0.0}
        low = np.maximum(y - error, 0.1 * smallest)
        axes.fill_between(x, low, y + error, label="standard error", **band)
        for chosen in curve.chosen:
            marker, color = METHOD_MARKERS[chosen.rule]
            place = [chosen.value], [curve.score_at(chosen.value)[0]]
            label = f"{chosen.rule}: {chosen.value:.3g}"
            axes.plot(*place, marker, color=color, ms=7.0, mfc="none", label=label)
        axes.axhline(1.0, color="0.5", lw=0.8, ls="--", label="noise alone")
        method, number = WORDS[curve.name]
        lam = "lam [(sigma per prior sd)²]"
        label_axes(axes, lam if curve.name == "lam" else f"directions {number} [1]", "", method)
        axes.legend(frameon=False, fontsize=SMALL)
    panels[0].set_ylabel("held-out mean square over noise [1]", fontsize=LABEL)
    scale_logarithmically(panels[0].xaxis, (), decades=8)
    scale_logarithmically(panels[0].yaxis)
    return finish_figure(figure, f"{curves.robot}: n = {curves.poses} poses")
