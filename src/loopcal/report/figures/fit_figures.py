# SPDX-License-Identifier: Apache-2.0
"""Residuals of a fit: by pose, by component, as a distribution, and against recorded quantities."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from loopcal.apply.validation import owner_of
from loopcal.diagnose.cross_validation import RegularizationCurves
from loopcal.diagnose.identifiable_parameters import Identifiability
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.result import Identification, KindResiduals
from loopcal.findings.wording import list_names
from loopcal.measure.kinds.joints import ActuatorReadings
from loopcal.mechanism.model import Mechanism
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DIVERGING,
    DOT,
    FEW_TICKS,
    LABEL,
    LINE,
    MARKERS,
    PALE,
    REFERENCE,
    SMALL,
    THIN,
    VERY_WIDE,
    add_legend,
    finish_figure,
    label_axes,
    label_logarithmic,
    label_poses,
    shorten,
    show_names,
    start_figure,
)
from loopcal.report.validation_view import WORDS
from loopcal.results.presenters import register
from loopcal.results.tables import format_uncertainty, format_with_uncertainty
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension, Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from loopcal.estimate.null_space import Combination


# --- Residuals of a fit, sorted for drawing: one series for each kind and component.

READING_PREFIX, TIME = "reading ", "time"
"""Start of the name of an actuator reading, and name of the time."""


@dataclass(frozen=True, eq=False)
class ResidualSeries:
    """The residuals of one component of one kind, without rows that were not measured.

    Attributes
    ----------
    kind, component : names. dimension : of the residuals.
    poses : (r,) number of the pose of each row, in order of measurement.
    raw : (r,) [SI]. whitened : (r,) over sigma.
    quantities : name -> (r,), what the residuals are drawn against [SI], [s], [degC].
    """

    kind: str
    component: str
    dimension: Dimension
    poses: IntArray
    raw: FloatArray
    whitened: FloatArray
    quantities: dict[str, FloatArray]

    @property
    def is_reading(self) -> bool:
        """Whether these are actuator readings, of which estimated poses take up a part."""
        return self.kind == ActuatorReadings.name

    @property
    def label(self) -> str:
        """Component and kind."""
        return self.kind if self.component in {"", self.kind} else f"{self.kind} {self.component}"


def list_poses(residuals: Sequence[KindResiduals]) -> tuple[str, ...]:
    """Return the labels of all poses with residuals, in order of measurement."""
    return tuple(dict.fromkeys(label for rows in residuals for label in rows.poses))


def list_series(robot: Mechanism, residuals: Sequence[KindResiduals]) -> list[ResidualSeries]:
    """Return residuals by kind and component."""
    place = {label: i for i, label in enumerate(list_poses(residuals), 1)}
    return [series for rows in residuals for series in _split(robot, rows, place)]


def _split(
    robot: Mechanism, rows: KindResiduals, place: dict[str, int]
) -> Iterator[ResidualSeries]:
    """Yield the components of one kind."""
    poses = np.array([place[label] for label in rows.poses], dtype=np.intp)
    actuators = [f"{READING_PREFIX}{actuator.name}" for actuator in robot.actuators]
    quantities = {**dict(zip(actuators, rows.readings.T, strict=False)), **rows.context}
    for j, component in enumerate(rows.components):
        used = _are_used(rows.raw[:, j], rows.whitened[:, j])
        yield ResidualSeries(
            rows.kind,
            component,
            rows.dimensions[j],
            poses[used],
            rows.raw[used, j],
            rows.whitened[used, j],
            {name: values[used] for name, values in quantities.items()},
        )


def _are_used(raw: FloatArray, whitened: FloatArray) -> BoolArray:
    """Return which residuals were measured and count: a row of weight 0 has no whitened one."""
    return np.isfinite(raw) & ((whitened != 0.0) | (raw == 0.0))


def list_quantities(series: list[ResidualSeries]) -> list[str]:
    """Return the quantities that vary: readings, then time, then temperatures."""
    names = dict.fromkeys(name for s in series for name in s.quantities)
    varying = []
    for name in names:
        values = np.concatenate([s.quantities[name] for s in series if name in s.quantities])
        known = values[np.isfinite(values)]
        if len(known) and np.ptp(known) > 0.0:
            varying.append(name)
    return varying


def find_quantity_unit(robot: Mechanism, name: str) -> tuple[float, str]:
    """Return the factor to SI and the symbol of a quantity that residuals are drawn against."""
    if name.startswith(READING_PREFIX):
        wanted = name.removeprefix(READING_PREFIX)
        (actuator,) = (a for a in robot.actuators if a.name == wanted)
        unit: Unit = robot.get_unit(actuator.dimension)
        return unit.factor_to_si, unit.symbol
    return 1.0, "s" if name == TIME else "degC"


def describe_residual_frame(setup: Sequence[str]) -> str:
    """Return in words what residuals are differences of, and after the fit of which frames.

    Parameters
    ----------
    setup : names of the fitted setup parameters, such as `tracker.x`.
    """
    owners = tuple(dict.fromkeys(owner_of(name) for name in setup))
    fitted = f"after the best fit of {list_names(owners, 4)}" if owners else "in the stated frames"
    return f"predicted - measured, {fitted}"


SIGMAS = "residual [sigma]"
"""Label of an axis of whitened residuals."""

BAND = 1.959963984540054
"""Residuals over sigma that 95 % do not exceed, if the stated noise is right."""

MANY = 2000
"""Points of a series from which they are embedded as a picture in SVG and PDF files."""

UPRIGHT = 8
"""Components up to which their numbers fit side by side."""

COLUMNS = 3
"""Panels of quantities beside each other."""


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

    Parameters
    ----------
    residuals : of a fit or of a run folder. setup : names of the fitted setup parameters.
    """
    series = [s for s in list_series(robot, residuals) if len(s.raw)]
    quantities = list_quantities(series)
    groups = _group_by_unit(series)
    rows = -(-len(quantities) // COLUMNS)
    figure = start_figure(11.0, 0.8 + 2.2 * len(groups) + 2.6 + 2.3 * rows)
    heights = [*[2.2] * len(groups), 2.6, *[2.3] * rows]
    grid = figure.add_gridspec(len(heights), 2 * COLUMNS, height_ratios=heights)
    styles = _choose_styles(series)
    for i, group in enumerate(groups):
        _draw_by_pose(figure.add_subplot(grid[i, :]), robot, list_poses(residuals), group, styles)
    n = len(groups)
    _draw_components(figure.add_subplot(grid[n, :2]), series, styles)
    measured = [s for s in series if not s.is_reading]
    whitened = np.concatenate([s.whitened for s in measured]) if measured else np.zeros(0)
    _draw_histogram(figure.add_subplot(grid[n, 2:4]), whitened)
    _draw_normal_plot(figure.add_subplot(grid[n, 4:]), whitened)
    for i, name in enumerate(quantities):
        row, column = divmod(i, COLUMNS)
        place = grid[n + 1 + row, 2 * column : 2 * column + 2]
        _draw_against(figure.add_subplot(place), robot, measured, styles, name)
    add_legend(figure, _list_handles(series, styles))
    n = len(list_poses(residuals))
    count = f"{sum(len(s.raw) for s in series)} residuals of {n} {'pose' if n == 1 else 'poses'}"
    return finish_figure(figure, f"{robot.name}: {count}; {describe_residual_frame(setup)}")


def _group_by_unit(series: list[ResidualSeries]) -> list[list[ResidualSeries]]:
    """Return the series of each kind and dimension, which share an axis."""
    groups: dict[tuple[str, Dimension], list[ResidualSeries]] = {}
    for s in series:
        groups.setdefault((s.kind, s.dimension), []).append(s)
    return list(groups.values())


def _choose_styles(series: list[ResidualSeries]) -> dict[str, dict[str, Any]]:
    """Return color and marker of each series; they differ in both up to eight series."""
    labels = dict.fromkeys(s.label for s in series)
    return {
        label: {
            "color": COLORS[i % len(COLORS)],
            "marker": MARKERS[i % len(MARKERS)],
            "ls": "none",
            "ms": DOT,
            "mfc": "none" if i >= len(COLORS) else COLORS[i % len(COLORS)],
            "mew": 0.7,
        }
        for i, label in enumerate(labels)
    }


def _draw_by_pose(
    axes: Axes,
    robot: Mechanism,
    poses: Sequence[str],
    group: list[ResidualSeries],
    styles: dict[str, dict[str, Any]],
) -> None:
    """Draw the residuals of one kind in units; components are side by side at their pose."""
    unit = robot.get_unit(group[0].dimension)
    steps = np.linspace(-0.25, 0.25, len(group) + 2)[1:-1] if len(poses) <= 60 else [0.0] * 99
    for s, step in zip(group, steps, strict=False):
        axes.plot(
            s.poses + step,
            s.raw / unit.factor_to_si,
            rasterized=len(s.raw) > MANY,
            **styles[s.label],
        )
    axes.axhline(0.0, color=REFERENCE, lw=THIN, zorder=1)
    label_axes(axes, "", f"{group[0].kind} residual [{unit.symbol}]", "by pose")
    label_poses(axes, poses)


def _draw_components(
    axes: Axes, series: list[ResidualSeries], styles: dict[str, dict[str, Any]]
) -> None:
    """Draw the residuals over sigma by component, with the rms of each."""
    labels = list(styles)
    for i, label in enumerate(labels):
        values = np.concatenate([s.whitened for s in series if s.label == label])
        spread = np.linspace(-0.22, 0.22, len(values)) if len(values) > 1 else np.zeros(len(values))
        axes.plot(i + spread, values, rasterized=len(values) > MANY, **styles[label])
        size = float(np.sqrt((values**2).mean()))
        for sign in (-1.0, 1.0):
            axes.hlines(sign * size, i - 0.38, i + 0.38, color=DARK, lw=LINE)
        axes.annotate(
            f"{size:.2f}",
            (i, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, -2),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=SMALL - 1,
            rotation=90 if len(labels) > UPRIGHT else 0,
        )
    _add_band(axes)
    axes.margins(y=0.16 if len(labels) <= UPRIGHT else 0.35)
    is_long = max((len(label) for label in labels), default=0) * len(labels) > 32
    rotation, side = (0, "center") if not is_long else (35, "right")
    if len(labels) > UPRIGHT:
        rotation, side = 90, "center"
    axes.set_xticks(range(len(labels)), labels, rotation=rotation, ha=side)
    label_axes(axes, "", SIGMAS, "by component; bars: rms")


def _draw_histogram(axes: Axes, whitened: np.ndarray) -> None:
    """Draw a histogram of the residuals over sigma beside the density of the stated noise."""
    reach = max(4.0, float(np.abs(whitened).max(initial=0.0)))
    bins = int(np.clip(np.sqrt(len(whitened)) * 1.5, 8, 60))
    x = np.linspace(-reach, reach, 200)
    axes.hist(
        whitened,
        np.linspace(-reach, reach, bins + 1).tolist(),
        density=True,
        color=COLORS[5],
        ec="white",
    )
    axes.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), color=DARK, lw=LINE)
    label_axes(axes, SIGMAS, "density [1/sigma]", "histogram; line: stated noise")


def _draw_normal_plot(axes: Axes, whitened: np.ndarray) -> None:
    """Draw the sorted residuals over sigma against the quantiles of a normal distribution."""
    from scipy.special import ndtri

    values = np.sort(whitened)
    x = ndtri((np.arange(len(values)) + 0.5) / max(len(values), 1))
    axes.plot(x, values, "o", color=COLORS[0], ms=DOT - 0.5, rasterized=len(values) > MANY)
    if len(values):
        ends = np.array([x[0], x[-1]])
        axes.plot(ends, ends, color=DARK, lw=LINE)
    label_axes(axes, "normal quantile [sigma]", SIGMAS, "normal plot; line: stated noise")


def _draw_against(
    axes: Axes,
    robot: Mechanism,
    series: list[ResidualSeries],
    styles: dict[str, dict[str, Any]],
    name: str,
) -> None:
    """Draw the residuals over sigma against a recorded quantity."""
    from matplotlib.ticker import MaxNLocator

    factor, symbol = find_quantity_unit(robot, name)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    for s in series:
        if name in s.quantities:
            axes.plot(
                s.quantities[name] / factor,
                s.whitened,
                rasterized=len(s.raw) > MANY,
                **styles[s.label],
            )
    _add_band(axes)
    label_axes(axes, f"{name} [{symbol}]", SIGMAS)


def _add_band(axes: Axes) -> None:
    """Draw zero, and the limits of 95 % of the residuals if the stated noise is right."""
    axes.axhline(0.0, color=REFERENCE, lw=THIN, zorder=1)
    for sign in (-1.0, 1.0):
        axes.axhline(sign * BAND, color=REFERENCE, lw=THIN, ls="--", zorder=1)


def _list_handles(series: list[ResidualSeries], styles: dict[str, dict[str, Any]]) -> list[Any]:
    """Return what the legend contains."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], label=label, **style) for label, style in styles.items()]
    if series:
        limits = "95 % limits of the stated noise"
        handles.append(Line2D([], [], color=REFERENCE, lw=THIN, ls="--", label=limits))
    return handles


# --- Parameters of a fit: shifts with their intervals, uncertainties, and correlations.

MOST_ROWS = 50
"""Parameters of one column of panels."""

MOST_NAMES = 110
"""Parameters up to which a picture of correlations names each one."""

RATIO = "1"
"""Symbol of a ratio, which stands at no number."""

SHIFT, WIDTH = COLORS[0], COLORS[1]
"""Colors of shifts and of uncertainties."""


class FittedParameters(Protocol):
    """What these figures use of a fit, an `Identification` or a stored one."""

    @property
    def robot(self) -> Mechanism:
        """Its robot, with the estimates."""
        ...

    @property
    def free_parameters(self) -> FreeParameters:
        """The free parameters with nominal values and tolerances."""
        ...

    @property
    def estimate(self) -> FloatArray:
        """(p,) estimates."""
        ...

    @property
    def covariance(self) -> FloatArray:
        """(p, p) covariance of the estimates."""
        ...

    @property
    def standard_deviations(self) -> FloatArray:
        """(p,) standard deviations."""
        ...

    @property
    def converged(self) -> bool:
        """Whether the iteration converged."""
        ...

    def interval(self) -> FloatArray:
        """Return half-widths (p,) of the 95 % intervals."""
        ...


@register("figure parameters", Identification)
def draw_parameters(fit: FittedParameters) -> Figure:
    """Draw the shift of each parameter in tolerances with its 95 % interval, its uncertainty in
    tolerances, and both as numbers in the unit of the robot's file.

    Of a fit that did not converge only the last values are drawn, without intervals.
    """
    from matplotlib.lines import Line2D

    p = len(fit.free_parameters.names)
    columns = max(-(-p // MOST_ROWS), 1)
    chunks = np.array_split(np.arange(p), columns)
    figure = start_figure(8.2 * columns, 1.6 + 0.19 * max(len(chunk) for chunk in chunks))
    axes_grid: Any = figure.subplots(1, 2 * columns, squeeze=False, width_ratios=[3, 2] * columns)
    for i, chunk in enumerate(chunks):
        _draw_shifts(axes_grid[0, 2 * i], fit, chunk)
        _draw_uncertainties(axes_grid[0, 2 * i + 1], fit, chunk)
    handles = [
        Line2D([], [], color=SHIFT, marker="o", ms=DOT, lw=1.2, label="shift, 95 % interval"),
        Line2D([], [], color=WIDTH, marker="s", ms=DOT, ls="none", label="uncertainty (95 %)"),
        Line2D([], [], color=SHIFT, marker="x", ms=DOT + 1, ls="none", label="without an interval"),
        Line2D([], [], color=PALE, lw=6, alpha=0.5, label="one tolerance"),
    ]
    add_legend(figure, handles)
    status = "" if fit.converged else "; not converged: last values, no estimates"
    n_assumed = int(fit.free_parameters.assumed.sum())
    assumed = f"; {n_assumed} tolerances are assumed" if n_assumed else ""
    return finish_figure(figure, f"{fit.robot.name}: {_count(p)}{assumed}{status}")


def _count(parameters: int) -> str:
    """Return a number of parameters in words."""
    return "1 parameter" if parameters == 1 else f"{parameters} parameters"


def _half_widths(fit: FittedParameters) -> FloatArray:
    """Return half-widths (p,) of the 95 % intervals in tolerances; NaN or infinite without."""
    if not fit.converged:
        return np.full(len(fit.free_parameters.names), np.nan)
    return fit.interval() / fit.free_parameters.tolerance


def _draw_shifts(axes: Axes, fit: FittedParameters, chunk: IntArray) -> None:
    """Draw estimate minus nominal value in tolerances, with the 95 % interval."""
    shift = ((fit.estimate - fit.free_parameters.nominal) / fit.free_parameters.tolerance)[chunk]
    half, y = _half_widths(fit)[chunk], np.arange(len(chunk))
    known = np.isfinite(half)
    axes.axvspan(-1.0, 1.0, color=PALE, alpha=0.35, lw=0.0, zorder=0)
    axes.axvline(0.0, color=REFERENCE, lw=THIN, zorder=1)
    axes.errorbar(
        shift[known],
        y[known],
        xerr=half[known],
        fmt="o",
        color=SHIFT,
        ms=DOT,
        elinewidth=1.2,
        capsize=1.5,
    )
    axes.plot(shift[~known], y[~known], "x", color=SHIFT, ms=DOT + 1)
    _set_rows(axes, [shorten(fit.free_parameters.names[i]) for i in chunk])
    label_axes(axes, "estimate - nominal [tolerance]", "", "shift")


def _draw_uncertainties(axes: Axes, fit: FittedParameters, chunk: IntArray) -> None:
    """Draw the half-width of the 95 % interval in tolerances; the numbers are at the right."""
    half, y = _half_widths(fit)[chunk], np.arange(len(chunk))
    drawn = np.isfinite(half) & (half > 0.0)
    axes.axvline(1.0, color=REFERENCE, lw=THIN, ls="--", zorder=1)
    axes.plot(half[drawn], y[drawn], "s", color=WIDTH, ms=DOT)
    if drawn.any():
        axes.set_xlim(0.6 * min(half[drawn].min(), 1.0), 1.7 * max(half[drawn].max(), 1.0))
        axes.set_xscale("log")
        label_logarithmic(axes.xaxis, FEW_TICKS)
    else:
        axes.set_xticks([])
    factor, symbols = fit.free_parameters.display()
    symbols = ["" if symbol == RATIO else f" {symbol}" for symbol in symbols]
    widths = half * fit.free_parameters.tolerance[chunk] / factor[chunk]
    estimate = (fit.estimate / factor).tolist()
    numbers = [
        f"{format_with_uncertainty(estimate[i], width)} ± {format_uncertainty(width)}{symbols[i]}"
        for i, width in zip(chunk, widths.tolist(), strict=True)
    ]
    if not fit.converged:
        numbers = [f"{estimate[i]:.3g}{symbols[i]}" for i in chunk]
    axes.yaxis.tick_right()
    _set_rows(axes, numbers)
    label = "half-width [tolerance]" if drawn.any() else ""
    title = "uncertainty (95 %)" if drawn.any() else "without an interval"
    label_axes(axes, label, "", title)


def _set_rows(axes: Axes, labels: list[str]) -> None:
    """Write one label for each row, the first on top."""
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.4, -0.6)


@register("figure correlation", Identification)
def draw_correlation(fit: FittedParameters) -> Figure:
    """Draw the correlations of all parameters as a matrix of colors.

    Parameters without a finite uncertainty have a grey row.
    """
    p = len(fit.free_parameters.names)
    size = float(np.clip(0.155 * p, 3.4, 13.0))
    figure = start_figure(size + 2.6, size + 1.6)
    axes = figure.add_subplot()
    axes.set_facecolor(PALE)
    image = axes.imshow(compute_correlation(fit), cmap=DIVERGING, vmin=-1.0, vmax=1.0)
    step = -(-p // MOST_NAMES)
    places = list(range(0, p, step))
    font = float(np.clip(size * 72.0 / max(len(places), 1) * 0.72, 4.0, SMALL))
    names = [shorten(fit.free_parameters.names[i]) for i in places]
    axes.set_xticks(places, names, rotation=90, fontsize=font)
    axes.set_yticks(places, names, fontsize=font)
    owners = [name.split(".")[0] for name in fit.free_parameters.names]
    edges = [i - 0.5 for i in range(1, p) if owners[i] != owners[i - 1]]
    if len(edges) < p - 1:
        for edge in edges:
            axes.axhline(edge, color=DARK, lw=0.5)
            axes.axvline(edge, color=DARK, lw=0.5)
    bar = figure.colorbar(image, ax=axes, shrink=0.7, aspect=25)
    bar.set_label("correlation [1]", fontsize=LABEL)
    bar.ax.tick_params(labelsize=SMALL)
    return finish_figure(figure, f"{fit.robot.name}: {_describe_correlation(fit, step)}")


def compute_correlation(fit: FittedParameters) -> FloatArray:
    """Return the correlations (p, p) [1]; NaN where a parameter has no finite uncertainty."""
    sd = fit.standard_deviations
    usable = np.isfinite(sd) & (sd > 0.0)
    scale = np.where(usable, sd, np.nan)
    return np.where(np.outer(usable, usable), fit.covariance, np.nan) / np.outer(scale, scale)


def _describe_correlation(fit: FittedParameters, step: int) -> str:
    """Return the strongest correlation in words, and what grey means where there is any."""
    correlation = compute_correlation(fit)
    off = np.abs(np.nan_to_num(correlation - np.diag(np.diag(correlation))))
    words = f"correlation of {_count(len(fit.free_parameters.names))}"
    if off.size and off.max() > 0.0:
        i, j = np.unravel_index(int(off.argmax()), off.shape)
        value = f"{correlation[i, j]:+.2f}"
        names = fit.free_parameters.names
        words += f"\nstrongest {value}: {shorten(names[j])} and {shorten(names[i])}"
    if np.isnan(np.diag(correlation)).any():
        words += "\ngrey: without a finite uncertainty"
    if step > 1:
        words += f"\nevery {step}. name is written"
    return words


# --- The iteration of a fit: sum of squares and changes of the parameters.

SMALLEST = 1e-16
"""Change in tolerances below which a number is rounding and drawn at this value."""


@register("figure convergence", Identification)
def draw_convergence(fit: Identification) -> Figure:
    """Draw the sum of squares and the distance of each parameter from its last value by step."""
    figure = start_figure(9.0, 3.9)
    panels: Any = figure.subplots(1, 2)
    _draw_cost(panels[0], fit)
    _draw_distances(panels[1], fit)
    words = fit.status.name.lower().replace("_", " ")
    return finish_figure(figure, f"{fit.robot.name}: {words} after {fit.history.iterations} steps")


def _draw_cost(axes: Axes, fit: Identification) -> None:
    """Draw the sum of squares of the residuals over sigma, and what noise alone would leave."""
    cost = np.asarray(fit.history.cost)
    axes.plot(np.arange(len(cost)), cost, "o-", color=COLORS[0], ms=DOT + 0.5, lw=LINE)
    degrees = fit.residual_test.degrees
    if np.isfinite(degrees) and degrees > 0.0 and not fit.residual_test.weighted:
        axes.axhline(degrees, color=REFERENCE, lw=THIN, ls="--", label="expected from the noise")
        axes.legend(frameon=False, fontsize=SMALL)
    if (cost > 0.0).all():
        axes.set_yscale("log")
        _thin_decades(axes)
    _set_steps(axes, len(cost))
    label_axes(axes, "step [1]", "sum of (residual/sigma)² [1]", "sum of squares")


def _draw_distances(axes: Axes, fit: Identification) -> None:
    """Draw how far each parameter is from its last value, in tolerances."""
    history = np.asarray(fit.history.estimate)
    distance = np.abs(history - history[-1])[:-1] / fit.tolerance
    steps = np.arange(len(distance))
    if distance.size:
        floored = np.maximum(distance, SMALLEST)
        axes.plot(steps, floored, color=PALE, lw=THIN)
        axes.plot(
            steps, floored.max(axis=1), "o-", color=COLORS[1], ms=DOT, lw=LINE, label="largest"
        )
        axes.plot([], [], color=PALE, lw=THIN, label="each parameter")
        axes.set_yscale("log")
        _thin_decades(axes)
        axes.legend(frameon=False, fontsize=SMALL)
    _set_steps(axes, len(history))
    label_axes(axes, "step [1]", "distance from the last value [tolerance]", "parameters")


def _set_steps(axes: Axes, count: int) -> None:
    """Number the steps from 0."""
    from matplotlib.ticker import MaxNLocator

    axes.set_xlim(-0.3, max(count - 1, 1) + 0.3)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _thin_decades(axes: Axes) -> None:
    """Write a few powers of ten as numbers; more numbers on a short axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = axes.yaxis.get_view_interval()
    if high < VERY_WIDE * low:
        label_logarithmic(axes.yaxis)
        return
    axes.yaxis.set_major_locator(LogLocator(numticks=8))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())


# --- What measurements determine: singular values with the gap, and the combinations left open.

MOST_COMBINATIONS, MOST_PARAMETERS = 14, 48
"""Combinations and parameters that the picture of combinations shows."""

FLOOR = 1e-18
"""Share of the largest singular value at which a smaller one is drawn."""

COUNTED, CUT = COLORS[0], COLORS[1]
"""Colors of singular values that count and of those that count as zero."""


@register("figure", Identifiability)
def draw_identifiability(analysis: Identifiability) -> Figure:
    """Draw the singular values with the rank and the gap, and the null vectors and weak directions
    as weights of the parameters.
    """
    combinations = (*analysis.unidentifiable, *analysis.weak)[:MOST_COMBINATIONS]
    names = _list_names(combinations)
    width = 5.2 + (2.2 + 0.42 * len(combinations) + 0.8 if combinations else 0.0)
    figure = start_figure(width, max(4.7, 2.2 + 0.17 * len(names)))
    if not combinations:
        _draw_spectrum(figure.add_subplot(), analysis)
    else:
        panels: Any = figure.subplots(1, 2, width_ratios=[5.0, width - 5.0])
        _draw_spectrum(panels[0], analysis)
        _draw_combinations(figure, panels[1], analysis, combinations, names)
    add_legend(figure, figure.axes[0].get_legend_handles_labels()[0])
    robot = analysis.free_parameters.robot.name
    rank = f"rank {analysis.rank} of {analysis.n_parameters}"
    return finish_figure(figure, f"{robot}: {rank}, {analysis.n_equations} equations")


def _draw_spectrum(axes: Axes, analysis: Identifiability) -> None:
    """Draw the singular values: those that count, those that do not, and the limits."""
    s, rank = analysis.singular_values, analysis.rank
    number = np.arange(1, len(s) + 1)
    floor = FLOOR * float(s[0]) if len(s) and s[0] > 0.0 else FLOOR
    drawn = np.maximum(s, floor)
    axes.plot(number[:rank], drawn[:rank], "o", color=COUNTED, ms=DOT + 0.5, label="determined")
    if rank < len(s):
        axes.plot(
            number[rank:],
            drawn[rank:],
            "v",
            color=CUT,
            mfc="none",
            ms=DOT + 1.5,
            label="counts as zero",
        )
    axes.axhline(1.0, color=REFERENCE, lw=THIN, ls="--", label="known as well as the tolerance")
    if rank < len(s):
        limit = max(analysis.tolerance * float(s[0]), floor)
        axes.axhline(limit, color=DARK, lw=THIN, ls=":", label="limit of the rank")
    axes.set_yscale("log")
    _set_powers(axes)
    if 0 < rank < len(s):
        _mark_gap(axes, analysis, drawn)
    from matplotlib.ticker import MaxNLocator

    axes.set_xlim(0.4 - 0.02 * len(s), len(s) + 0.6 + 0.02 * len(s))
    axes.xaxis.set_major_locator(MaxNLocator(10, integer=True, min_n_ticks=1))
    label_axes(axes, "direction [1]", "singular value [sigma per tolerance]", "singular values")


def _set_powers(axes: Axes) -> None:
    """Write some powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = axes.get_ylim()
    axes.set_ylim(low, high * 3.0)
    axes.yaxis.set_major_locator(LogLocator(numticks=10))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())


def _mark_gap(axes: Axes, analysis: Identifiability, drawn: np.ndarray) -> None:
    """Draw an arrow over the gap between the values that count and those that do not."""
    rank = analysis.rank
    x = rank + 0.5
    ends = (x, float(drawn[rank - 1])), (x, float(drawn[rank]))
    axes.annotate("", *ends, arrowprops={"arrowstyle": "<->", "color": DARK, "lw": THIN})
    axes.annotate(
        f"gap {analysis.gap:.2g}" if np.isfinite(analysis.gap) else "infinite gap",
        (x, float(np.sqrt(drawn[rank - 1] * drawn[rank]))),
        xytext=(-4, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=SMALL,
    )


def _list_names(combinations: tuple[Combination, ...]) -> list[str]:
    """Return the parameters of the combinations, at most so many."""
    names = dict.fromkeys(name for c in combinations for name in c.names)
    return list(names)[:MOST_PARAMETERS]


def _draw_combinations(
    figure: Figure,
    axes: Axes,
    analysis: Identifiability,
    combinations: tuple[Combination, ...],
    names: list[str],
) -> None:
    """Draw the weight of each parameter in each combination as a color."""
    weights = np.zeros((len(names), len(combinations)))
    for column, combination in enumerate(combinations):
        for name, weight in zip(combination.names, combination.weights, strict=True):
            if name in names:
                weights[names.index(name), column] = weight
    weights /= np.maximum(np.abs(weights).max(axis=0), 1e-300)
    image = axes.imshow(weights, cmap=DIVERGING, vmin=-1.0, vmax=1.0, aspect="auto")
    null = len(analysis.unidentifiable)
    labels = [
        f"null {i + 1}" if i < null else f"weak {i + 1 - null}" for i in range(len(combinations))
    ]
    axes.set_xticks(range(len(combinations)), labels, rotation=90)
    axes.set_yticks(range(len(names)), [shorten(name) for name in names])
    if 0 < null < len(combinations):
        axes.axvline(null - 0.5, color=DARK, lw=THIN)
    shown = len(combinations) < null + len(analysis.weak)
    more = f" (first {len(combinations)})" if shown else ""
    label_axes(axes, "", "", f"null vectors and weak directions{more}", grid=False)
    total = len(dict.fromkeys(n for c in combinations for n in c.names))
    if total > len(names):
        axes.set_xlabel(f"and {total - len(names)} more parameters", fontsize=SMALL)
    bar = figure.colorbar(image, ax=axes, aspect=25, shrink=0.8)
    bar.set_label("weight in tolerances, largest = 1 [1]", fontsize=LABEL)
    bar.ax.tick_params(labelsize=SMALL)


# --- Regularization curves as a picture.

METHOD_MARKERS = {
    "GCV": ("v", COLORS[1]),
    "marginal likelihood": ("s", COLORS[2]),
    "lowest held-out error": ("o", COLORS[3]),
    "one standard error": ("D", COLORS[4]),
}
"""Rule -> marker and color of the value that it chooses."""


@register("figure", RegularizationCurves)
def draw_regularization(curves: RegularizationCurves) -> Figure:
    """Draw the held-out error against lam and against k, with bands of one standard error, and mark
    what rules choose.
    """
    figure = start_figure(10.0, 4.6)
    panels: Any = figure.subplots(1, 2, sharey=True)
    finite = [c.score[np.isfinite(c.score)] for c in (curves.ridge, curves.truncation)]
    positive = np.concatenate(finite)
    for axes, curve in zip(panels, (curves.ridge, curves.truncation), strict=True):
        x, y, error = curve.values, curve.score, np.nan_to_num(curve.standard_error)
        line = "-" if curve.name == "lam" else "o-"
        axes.plot(x, y, line, color=COLORS[0], ms=3.0, label="held-out error")
        low = np.maximum(y - error, 0.1 * positive.min())
        axes.fill_between(
            x, low, y + error, color=COLORS[0], alpha=0.2, lw=0.0, label="standard error"
        )
        for chosen in curve.chosen:
            marker, color = METHOD_MARKERS[chosen.rule]
            axes.plot(
                [chosen.value],
                [curve.score_at(chosen.value)[0]],
                marker,
                color=color,
                ms=7.0,
                mfc="none",
                label=f"{chosen.rule}: {chosen.value:.3g}",
            )
        axes.axhline(1.0, color="0.5", lw=0.8, ls="--", label="noise alone")
        method, number = WORDS[curve.name]
        axes.set_title(method, fontsize=10)
        axes.set_xlabel(
            "lam [(sigma per tolerance)²]" if curve.name == "lam" else f"directions {number} [1]"
        )
        axes.grid(visible=True, lw=0.3)
        axes.legend(frameon=False, fontsize=8)
    panels[0].set_xscale("log")
    panels[0].set_yscale("log")
    ticks = np.unique(np.round(np.log10(curves.ridge.values[[0, -1]])))
    step = max(int(np.ceil((ticks[-1] - ticks[0]) / 7.0)), 1)
    powers = np.arange(np.ceil(ticks[0]), ticks[-1] + 1, step)
    panels[0].set_xticks(10.0**powers, [f"1e{int(power)}" for power in powers])
    panels[0].minorticks_off()
    panels[0].set_ylabel("held-out mean square over that of noise [1]")
    label_logarithmic(panels[0].yaxis)
    figure.suptitle(f"{curves.robot}: n = {curves.poses} poses", fontsize=10)
    return show_names(figure)
