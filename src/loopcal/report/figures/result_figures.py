# SPDX-License-Identifier: Apache-2.0
"""Figures of plans, repeatability, uncertainty budget, accuracy, validation, comparison and
heights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply.accuracy import AccuracyMap
from loopcal.apply.check_up import CheckUp
from loopcal.apply.conformity import Conformity
from loopcal.apply.error_budget import LENGTHS, ErrorBudget
from loopcal.apply.height_errors import HeightErrors
from loopcal.apply.repeatability import DIMENSIONS, Estimate, Repeatability, VisitedPose
from loopcal.apply.run_comparison import RunComparison
from loopcal.apply.validation import Validation
from loopcal.apply.volume_accuracy import VolumeAccuracy
from loopcal.diagnose.fit_examination import ROUNDING
from loopcal.findings.wording import FINE, count_decimals, name_count
from loopcal.mechanism import platform_coordinates
from loopcal.mechanism.model import Mechanism
from loopcal.planning.path import locate_home
from loopcal.planning.plane_line_planning import SurfacePlan
from loopcal.planning.pose_planning import Plan, PlannedPoses
from loopcal.planning.problem import DIMENSIONS as TARGETS
from loopcal.planning.problem import ErrorCurve
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DASHED,
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
from loopcal.results.presenters import register
from loopcal.results.serialization import json_fields
from loopcal.results.tables import choose_unit, format_number
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension, Unit, find_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@register("figure", Repeatability)
def draw_repeatability(result: Repeatability) -> Figure:
    """Draw pose accuracy and repeatability of each visited pose, with intervals of 95 %."""
    n = len(result.poses)
    figure, panels = start_panels(9.5, 0.8 + 2.7 * n, n, 2)
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
    poses: Sequence[VisitedPose],
    name: str,
    estimates: Sequence[Sequence[Estimate]],
) -> None:
    """Draw one characteristic of the poses of one quantity: one value of each pose, or one of each
    component side by side.
    """
    unit = DISPLAY_UNITS[DIMENSIONS[quantity]]
    for place, of_pose in enumerate(estimates, 1):
        for k, estimate in enumerate(of_pose):
            x = place + 0.15 * (k - (len(of_pose) - 1) / 2)
            value, low, high = (number / unit.factor_to_si for number in estimate)
            axes.vlines(x, low, high, color=COLORS[k], lw=LINE)
            axes.plot([x], [value], MARKERS[k], color=COLORS[k], ms=DOT + 0.5)
    if all(estimate.low >= 0.0 for of_pose in estimates for estimate in of_pose):
        axes.set_ylim(bottom=0.0)
    else:
        axes.axhline(0.0, **ZERO)
    is_whole, differ = poses[0].accuracy is not None, len({pose.components for pose in poses}) > 1
    components = "their components" if differ else ", ".join(poses[0].components)
    of = "" if is_whole else f" of {components} (left to right)"
    label_axes(axes, "", f"{quantity} [{unit.symbol}]", f"{name}{of}")
    named = [(pose.pose, pose.target, pose.direction) for pose in poses]
    if differ:  # instruments that measure different components of one pose
        named = [(*names, *pose.components) for names, pose in zip(named, poses, strict=True)]
    label_poses(axes, [" ".join(filter(None, names)) for names in named])


@register("figure", ErrorBudget)
def draw_budget(budget: ErrorBudget) -> Figure:
    """Draw the sources of a budget, see `draw_budget_sources`."""
    return draw_budget_sources(json_fields(budget))


def draw_budget_sources(budget: Mapping[str, Any]) -> Figure:
    """Draw the part of each source in the expected error of poses as bars, and the error that half
    the sigma of a source would leave; budget : content of JSON.
    """
    lines = budget["sources"]
    kinds = ["position", *["orientation"] * (budget["orientation"]["rms"] > ROUNDING)]
    width, height = 4.8 * len(kinds) + 1.5, 1.9 + 0.38 * len(lines)
    figure, (panels,) = start_panels(width, height, 1, len(kinds), sharey=True)
    for axes, kind in zip(panels, kinds, strict=True):
        unit = choose_unit(DISPLAY_UNITS[LENGTHS[kind]], [budget[kind]["rms"]], FINE)
        rms_by_source = np.sqrt([line[kind] for line in lines]) / unit.factor_to_si
        total = budget[kind]["rms"] / unit.factor_to_si
        how = {"color": COLORS[5], "label": "part of the source (squares add up)"}
        axes.barh(np.arange(len(lines)), rms_by_source, height=0.6, **how)
        axes.axvline(total, color=DARK, lw=LINE, label="all sources")
        for i, line in enumerate(lines):
            if line["halved"] is not None:
                left = line["halved"][f"{kind}_rms"] / unit.factor_to_si
                how = {"color": COLORS[1], "label": "all, with half its sigma"}
                axes.plot([left], [i], "D", ms=DOT + 1.0, **how)
        axes.set_xlim(0.0, 1.08 * max(total, rms_by_source.max(initial=0.0)))
        title = f"{kind}: {format_number(total, 3)} {unit.symbol} in all"
        label_axes(axes, f"{kind} [{unit.symbol}]", "", title)
    label_rows(panels[0], [shorten(line["words"], 34) for line in lines])
    add_legend(figure)
    over = "poses of the workspace" if budget["over"] == "workspace" else "measured poses"
    return finish_figure(figure, f"Expected error (rms, k = 1) at {budget['poses']} {over}")


# Uncertainty of poses over the workspace, in slices, beside the measured poses.

SLICES = 3  # slices of the workspace
NEGLIGIBLE = 1e-9  # uncertainty [rad] below which an orientation cannot change and is not drawn


@register("figure", AccuracyMap)
def draw_accuracy_map(accuracy: AccuracyMap) -> Figure:
    """Draw the rms uncertainty of position and orientation in slices of the workspace.

    A ring marks a pose that is less certain than every measured pose (extrapolated); a cross is a
    measured pose, a grey square a pose whose uncertainty the data do not bound.
    """
    names, n = accuracy.names, len(accuracy.coordinates)
    measured = platform_coordinates.read_coordinates(accuracy.measured.T, names)
    # two positions along the axes and the third as slices, or else angles
    lengths = [i for i, name in enumerate(names) if name in platform_coordinates.POSITION]
    angles = [i for i, name in enumerate(names) if name not in platform_coordinates.POSITION]
    order = [*lengths, *angles] if len(lengths) > 1 else [*angles, *lengths]
    slices = _cut(accuracy, measured, order[2] if len(order) > 2 else None)
    quantities = [
        (name, choose_unit(DISPLAY_UNITS[LENGTHS[name]], getattr(accuracy.uncertainty, name)))
        for name in LENGTHS
        if name == "position"
        or np.nanmax(accuracy.uncertainty.orientation, initial=0.0) > NEGLIGIBLE
    ]
    width, height = 1.4 + 2.3 * len(slices), 1.2 + 2.2 * len(quantities)
    figure, grid = start_panels(width, height, len(quantities), len(slices))
    for panels, (name, unit) in zip(grid, quantities, strict=True):
        label = f"{name} uncertainty (rms) [{unit.symbol}]"
        if len(order) == 1:
            _draw_line(panels[0], accuracy, measured, name, unit, label)
        else:
            values = getattr(accuracy.uncertainty, name) / unit.factor_to_si
            points = _draw_row(panels, accuracy, measured, order[:2], slices, values)
            add_colorbar(figure, points, list(panels), label, aspect=22, pad=0.02)
    add_legend(figure)
    outside = f"{int(accuracy.extrapolated.sum())} of {name_count(n, 'pose')} extrapolated"
    return finish_figure(figure, f"{outside}\n{accuracy.uncertainty.frame}")


def _cut(
    accuracy: AccuracyMap, measured: FloatArray, i: int | None
) -> list[tuple[str, BoolArray, BoolArray]]:
    """Return title, poses and measured poses of slices along coordinate i with as many poses each;
    the measured poses are in that of their place.
    """
    n, m = len(accuracy.coordinates), len(measured)
    whole = [("", np.ones(n, dtype=bool), np.ones(m, dtype=bool))]
    if i is None or n < 2 * SLICES or not np.ptp(accuracy.coordinates[:, i]) > 0.0:
        return whole
    along, name = accuracy.coordinates[:, i], accuracy.names[i]
    edges = np.quantile(along, np.linspace(0.0, 1.0, SLICES + 1))
    number = np.clip(np.searchsorted(edges, along, "right") - 1, 0, SLICES - 1)
    of_measured = np.searchsorted(edges[1:-1], measured[:, i], "right")
    unit = _unit_of(name)
    ends = [f"{end:.4g}" for end in edges / unit.factor_to_si]
    titles = (f"{name} from {ends[k]} to {ends[k + 1]} {unit.symbol}" for k in range(SLICES))
    return [(title, number == k, of_measured == k) for k, title in enumerate(titles)]


def _draw_row(
    panels: Any,
    accuracy: AccuracyMap,
    measured: FloatArray,
    axis: Sequence[int],
    slices: Sequence[tuple[str, BoolArray, BoolArray]],
    values: FloatArray,
) -> Any:
    """Draw one quantity in all slices over two coordinates; return the points with their scale."""
    names, points = [accuracy.names[k] for k in axis], None
    finite = values[np.isfinite(values)]
    limits = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    scale = np.array([_unit_of(name).factor_to_si for name in names])
    (x, y), crosses = accuracy.coordinates[:, axis].T / scale[:, None], measured[:, axis] / scale
    labels = [f"{name} [{_unit_of(name).symbol}]" for name in names]
    colors: dict[str, Any] = {"cmap": SEQUENTIAL, "vmin": limits[0], "vmax": limits[1]}
    for axes, (title, chosen, of_measured) in zip(panels, slices, strict=True):
        bounded, unbounded = chosen & np.isfinite(values), chosen & ~np.isfinite(values)
        beyond = bounded & accuracy.extrapolated
        points = axes.scatter(x[bounded], y[bounded], c=values[bounded], s=20.0, **colors)
        ring: dict[str, Any] = {"mfc": "none", "mec": COLORS[1], "ms": 7.0, "mew": 0.6}
        square: dict[str, Any] = {"color": REFERENCE, "ms": 4.0}
        for of_mark, marker, style, label in (
            (beyond, "o", ring, "less certain than every measured pose"),
            (unbounded, "s", square, "not bounded by the data, or out of reach"),
        ):
            if of_mark.any():
                axes.plot(x[of_mark], y[of_mark], marker, label=label, **style)
        axes.plot(*crosses[of_measured].T, "x", color=DARK, ms=4.5, label="measured pose")
        if set(names) <= set(platform_coordinates.POSITION):
            axes.set_aspect("equal", adjustable="datalim")
        label_axes(axes, labels[0], labels[1] if axes is panels[0] else "", title)
    return points


def _draw_line(
    axes: Axes, accuracy: AccuracyMap, measured: FloatArray, name: str, unit: Unit, label: str
) -> None:
    """Draw the uncertainty of a machine with one coordinate against it."""
    of_axis = _unit_of(accuracy.names[0])
    for uncertainty, places, marker, color, words in (
        (accuracy.uncertainty, accuracy.coordinates, ".", COLORS[0], "pose of the workspace"),
        (accuracy.measured, measured, "x", DARK, "measured pose"),
    ):
        x, y = places[:, 0] / of_axis.factor_to_si, getattr(uncertainty, name) / unit.factor_to_si
        axes.plot(x, y, marker, color=color, label=words)
    label_axes(axes, f"{accuracy.names[0]} [{of_axis.symbol}]", label)


def _unit_of(name: str) -> Unit:
    """Return the unit in which a controlled coordinate is drawn."""
    return DISPLAY_UNITS[platform_coordinates.get_dimension(name)]


# The largest error in a volume: a solid in the colors of the bound at each of its points.

CELLS = 12  # along each axis of a solid; between compared points its colors are interpolated
UP, ASIDE = 24.0, 25.0  # angles of a view from the direction of the largest bound [deg]


@register("figure", VolumeAccuracy)
def draw_volume(accuracy: VolumeAccuracy) -> Figure:
    """Draw a volume in the colors of the bound of the error at each single point.

    A solid is seen from the side of the largest bound, which a disk marks, and from the other side,
    a plane from above. Its axes are up to three coordinates, positions before angles; of the others
    the largest bound counts. Points are a list, and what no cell contains that is in reach.
    """
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    robot = accuracy.robot
    names = [name for name in robot.controlled if name in (accuracy.spacing or accuracy.worst)]
    names = ([name for name in names if name in platform_coordinates.POSITION] or names)[:3]
    units, count = [_unit_of(name) for name in names], len(names)
    unit = choose_unit(robot.get_unit(Dimension.LENGTH), [accuracy.pointwise], FINE)
    points, values = _list_solid(accuracy, names)
    points[..., :count] /= [of_name.factor_to_si for of_name in units]
    values, flat = values / unit.factor_to_si, points.reshape(-1, 3)
    worst, extent = flat[np.nanargmax(values)], np.ptp(flat, axis=0)
    thin = (extent.max() or 1.0) * np.array([0.3, 0.3, 1e-3])  # axes that the volume does not have
    x, y, _ = worst - (flat.min(axis=0) + extent / 2.0)
    side = np.degrees(np.arctan2(y, x)) + ASIDE
    views = [(UP, side), (UP, side + 180.0)] if count > 2 else [(90.0, -90.0)]
    figure, panels = start_panels(
        1.0 + 4.3 * len(views), 3.2, 1, len(views),
        subplot_kw={"projection": "3d", "proj_type": "ortho", "computed_zorder": False},
    )  # fmt: skip
    colors: dict[str, Any] = {"cmap": SEQUENTIAL, "clim": (np.nanmin(values), np.nanmax(values))}
    words = ("from the side of the largest error (disk)", "from the opposite side")
    for axes, view, title in zip(panels[0], views, words, strict=False):
        axes.view_init(*view)
        axes.set_title(title if count > 2 else "disk: the largest error", fontsize=LABEL)
        faces, of_faces = _list_faces(points, values, *np.radians(view))
        if len(faces):
            surface = Poly3DCollection(faces, array=of_faces, lw=0.4, **colors)
            axes.add_collection3d(surface)
            surface.set_edgecolor("face")
        if not len(faces) or np.isnan(values).any():  # also what no cell contains
            known = np.isfinite(values.ravel())
            style = {"c": values.ravel()[known], "depthshade": False, "zorder": 0}
            axes.scatter(*flat[known].T, **style, **colors)
        all_axes = (axes.xaxis, axes.yaxis, axes.zaxis)
        for name, of_name, axis in zip(names, units, all_axes, strict=False):
            axis.set_label_text(f"{name} [{of_name.symbol}]", fontsize=LABEL)
        axes.set_box_aspect(np.where(extent > 0.0, extent, thin), zoom=0.95 if count > 2 else 0.85)
        axes.tick_params(labelsize=SMALL)
        axes.locator_params(nbins=4)
        for axis in all_axes[count:]:
            axis.set_ticks([])
    largest = {"c": [np.nanmax(values)], "s": AREA, "ec": "black", "lw": 2.0, "zorder": 9}
    drawn = panels[0, 0].scatter(*worst[:, None], depthshade=False, **largest, **colors)
    label = f"position error, 95 % at each point [{unit.symbol}]"
    add_colorbar(figure, drawn, [*panels[0]], label, pad=0.1)
    n = name_count(accuracy.points, "compared point")
    return finish_figure(figure, f"{robot.name}: position error in the volume, {n}")


def _list_solid(accuracy: VolumeAccuracy, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Return points (a, b, c, 3) and largest bounds (a, b, c) over the coordinates of these names;
    (n, 1, 1) of a list.
    """
    from scipy.ndimage import zoom

    robot, volume, values = accuracy.robot, accuracy.volume, accuracy.bounds
    spans, places = volume.list_spans(robot), volume.list_points(robot, 2)
    if spans:
        low, high = spans[names[0]]
        cells = round((high - low) / accuracy.spacing[names[0]])
        is_smooth = len(spans) <= len(names) and np.isfinite(values).all()
        finer = 1 + cells * (max(1, CELLS // cells) if is_smooth else 1)
        sizes = {name: len(of) for name, of in volume.list_values(robot).items()}
        values = values.reshape([*(sizes | dict.fromkeys(spans, cells + 1)).values()])
        others = tuple(i for i, name in enumerate(sizes) if name not in names)
        largest = np.fmax.reduce(values, axis=others)
        values = np.asarray(zoom(largest, finer / (cells + 1), order=1))
        places = volume.list_points(robot, finer)
        places = places.reshape([*(sizes | dict.fromkeys(spans, finer)).values(), -1])
        places = places[tuple(slice(None) if name in names else 0 for name in sizes)]
    values = values.reshape(*values.shape, *[1] * (3 - values.ndim))
    points = np.zeros((*values.shape, 3))
    columns = [robot.controlled.index(name) for name in names]
    points[..., : len(names)] = places[..., columns].reshape(*values.shape, -1)
    return points, values


def _list_faces(
    points: FloatArray, values: FloatArray, elevation: float, azimuth: float
) -> tuple[FloatArray, FloatArray]:
    """Return corners (f, 4, 3) and mean values of the faces of a solid that are turned to a view;
    of a plane both sides. A cell of the grid whose corners are not all known is not in the solid.
    """
    if values.shape[2] == 1:
        points, values = np.repeat(points, 2, axis=2), np.repeat(values, 2, axis=2)
    to_eye = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation)]
    inside, faces, of_faces = np.isfinite(values), [], []
    for axis in range(3):
        inside = np.delete(inside, 0, axis) & np.delete(inside, -1, axis)
    for axis in range(3):
        ends = np.eye(3, dtype=int)[axis]
        step = np.pad(inside.astype(int), np.stack([ends, ends], axis=1))
        change = np.diff(step, axis=axis)  # +1 where the solid begins
        u, v = np.roll(np.eye(3, dtype=int), -axis, axis=0)[1:]
        corners = np.argwhere(change)[:, None] + [0 * u, u, u + v, v]
        at = tuple(np.moveaxis(corners, 2, 0))
        outward = np.cross(points[at][:, 3] - points[at][:, 1], points[at][:, 2] - points[at][:, 0])
        outward *= change[change != 0][:, None]
        seen = outward @ [*to_eye, np.sin(elevation)] >= 0.0
        faces.append(points[at][seen])
        of_faces.append(values[at].mean(axis=1)[seen])
    return np.concatenate(faces), np.concatenate(of_faces)


# Errors on measured poses before and after calibration, beside the noise floor and the limits.

BEFORE, AFTER = COLORS[1], COLORS[0]
"""Colors of errors before and after calibration."""

# Styles of the line of a limit, and of that of the noise floor.
LIMIT: dict[str, Any] = {"color": COLORS[3], "lw": LINE, "ls": "-.", "label": "limit"}
FLOOR: dict[str, Any] = {**DASHED, "label": "noise floor (rms)"}

GOOD, OPEN, BAD = "#cfeadf", "#f3eccb", "#f6d5c3"
"""Colors of what a decision rule accepts, leaves open and rejects."""

LEAST_ROOM = 0.12  # share of a number line in which a word fits
# Kinds of measurement for which there is room, so that the bars of a single one are narrow.
FEWEST_BARS = 5

# Ratio of the largest errors before and after from which their axis is logarithmic.
LOGARITHMIC = 8.0


@register("figure", Validation)
def draw_validation(validation: Validation) -> Figure:
    """Draw the errors of each quantity by pose, those of all kinds over sigma, and the decision on
    each quantity with a limit.
    """
    quantities, decisions = validation.quantities, validation.conformity
    has_kinds = validation.has_several_kinds or not quantities
    n, lines = len(quantities) + has_kinds, len(decisions)
    heights = {"height_ratios": [2.0] * n + [0.8] * lines}
    size = (9.5, 1.4 + sum(heights["height_ratios"]))
    figure, panels = start_panels(*size, n + lines, 1, gridspec_kw=heights)
    limits = {"position": validation.limit_position, "orientation": validation.limit_angle}
    for (axes,), quantity in zip(panels, quantities, strict=False):
        _draw_quantity(axes, validation, quantity, limits.get(quantity))
    if has_kinds:
        _draw_kinds(panels[n - 1, 0], validation)
    for (axes,), (quantity, conformity) in zip(panels[n:], decisions.items(), strict=True):
        _draw_decision(axes, quantity, conformity, validation.units[quantity])
    add_legend(figure)
    poses = name_count(validation.judged, "pose")
    return finish_figure(figure, f"Errors at {poses}, {validation.frame}")


def _draw_decision(axes: Axes, quantity: str, conformity: Conformity, unit: Unit) -> None:
    """Draw the largest error with its interval on a line from accepted to rejected."""
    unit = conformity.choose_unit(unit)
    ends = ("low", "estimate", "high", "limit", "acceptance_limit", "rejection_limit")
    low, error, high, limit, accepted, rejected = (
        getattr(conformity, end) / unit.factor_to_si for end in ends
    )
    right = 1.25 * max(value for value in (high, limit, rejected) if np.isfinite(value))
    for start, end, color, word in (
        (0.0, accepted, GOOD, "conforms"),
        (accepted, rejected, OPEN, "undecided"),
        (rejected, right, BAD, "fails"),
    ):
        if (end := min(end, right)) - start > 0.0:
            axes.axvspan(start, end, color=color, lw=0.0)
        if end - start > LEAST_ROOM * right:
            place = (0.5 * (start + end), 0.86)
            axes.annotate(word, place, va="center", ha="center", fontsize=SMALL, color=DARK)
    axes.axvline(limit, **LIMIT)
    axes.errorbar(
        [error], [0.4], xerr=[[error - low], [high - error]], fmt="o", color=AFTER, ms=2 * DOT,
        lw=2 * LINE, capsize=4.0,
    )  # fmt: skip
    axes.set_xlim(0.0, right)
    axes.set_ylim(0.0, 1.1)
    axes.set_yticks([])
    least, likely, most = (f"{x:.{count_decimals(high)}f}" for x in (low, error, high))
    numbers = f"{likely} (95 %: {least} to {most}), limit {limit:.6g} {unit.symbol}"
    title = f"largest {quantity} error {numbers}: {conformity.decision.value}"
    label_axes(axes, f"largest {quantity} error [{unit.symbol}]", "", title, grid=False)


def _draw_quantity(axes: Axes, validation: Validation, quantity: str, limit: float | None) -> None:
    """Draw the size of each error of one quantity at the place of its pose; the axis is logarithmic
    where errors before and after differ by much.
    """
    labels = tuple(dict.fromkeys(validation.poses))
    place = np.array([labels.index(label) + 1 for label in validation.poses], dtype=float)
    after = validation.after
    size_after = [after.statistics(quantity).rms, validation.noise_floor.rms[quantity]]
    unit, largest = choose_unit(validation.units[quantity], size_after), []
    for name, errors, marker, color, face in (
        ("before", validation.before, "s", BEFORE, "none"),
        ("after", after, "o", AFTER, AFTER),
    ):
        size, x = errors[quantity].size / unit.factor_to_si, place[errors[quantity].rows]
        largest += [float(size[np.isfinite(size)].max())] if np.isfinite(size).any() else []
        axes.plot(x, size, marker, color=color, mfc=face, ms=DOT + 0.5, label=name)
        rms = errors.statistics(quantity).rms / unit.factor_to_si
        axes.axhline(rms, color=color, lw=LINE, label=f"{name} (rms)")
    axes.axhline(validation.noise_floor.rms[quantity] / unit.factor_to_si, **FLOOR)
    if limit is not None:
        axes.axhline(limit / unit.factor_to_si, **LIMIT)
    if len(largest) == 2 and 0.0 < LOGARITHMIC * largest[1] < largest[0]:
        scale_logarithmically(axes.yaxis)
    else:
        axes.set_ylim(bottom=0.0)
    measured = after[quantity].measured
    named = f" ({', '.join(measured)})" if quantity == "position" and len(measured) < 3 else ""
    title = f"{quantity}{named}: rms {rms:.3g} {unit.symbol} after"
    label_axes(axes, "", f"{quantity} error [{unit.symbol}]", title)
    label_poses(axes, labels)


def _draw_kinds(axes: Axes, validation: Validation) -> None:
    """Draw the errors of each kind over sigma as bars, with their noise floor."""
    kinds = [k for k in validation.kinds if k.kind != "all" or validation.has_several_kinds]
    x = np.arange(len(kinds))
    hatched: dict[str, Any] = {"ec": BEFORE, "fc": "none", "hatch": "//"}
    above: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "fontsize": SMALL}
    filled: dict[str, Any] = {"color": AFTER}
    for name, by, style in (("before", -0.19, hatched), ("after", 0.19, filled)):
        axes.bar(x + by, [getattr(k, name) for k in kinds], 0.38, label=f"{name} (rms)", **style)
        for place, kind in zip(x + by, kinds, strict=True):
            if np.isfinite(value := getattr(kind, name)):
                axes.annotate(f"{value:.3g}", (place, value), (0, 2), **above)
    for i, kind in enumerate(kinds):
        axes.plot([i - 0.45, i + 0.45], [kind.noise_floor] * 2, **FLOOR)
    names = ["all kinds" if k.kind == "all" else k.kind for k in kinds]
    axes.set_xticks(x, [f"{n}\n{k.count} values" for n, k in zip(names, kinds, strict=True)])
    axes.set_xlim(-0.5 * max(FEWEST_BARS - len(kinds), 0) - 0.6, None)
    axes.set_xlim(right=len(kinds) - 1 - axes.get_xlim()[0])
    values = [v for k in kinds for v in (k.before, k.after) if np.isfinite(v) and v > 0.0]
    if values and max(values) > LOGARITHMIC * min(values):
        axes.set_ylim(0.5 * min(*values, 1.0), 2.0 * max(values))
        scale_logarithmically(axes.yaxis)
    elif values:
        axes.set_ylim(0.0, 1.15 * max(*values, 1.0))
    label_axes(axes, "", "rms error [sigma]", "by kind of measurement, over sigma")
    axes.tick_params(axis="x", labelsize=SMALL)


# Several calibrations side by side: parameters with their intervals, shifts, held-out errors.

MOST_ROWS = 60  # parameters that a figure shows


def _choose_style(k: int, name: str) -> dict[str, Any]:
    """Return color, marker and label of run k, whose points no line joins."""
    color, marker = COLORS[k % len(COLORS)], MARKERS[k % len(MARKERS)]
    return {"color": color, "marker": marker, "ls": "none", "label": shorten(name)}


def draw_run_parameters(comparison: RunComparison) -> Figure:
    """Draw the estimate of each run with its 95 % interval, as difference from the first run that
    identified the parameter, in half-widths of that run's interval.
    """
    intervals = [
        [(run.estimates.get(name), run.plus_minus.get(name)) for run in comparison.runs]
        for name in comparison.parameters
    ]
    references = [
        next(((x, u) for x, u in of_runs if x is not None and u is not None and u > 0.0), None)
        for of_runs in intervals
    ]
    rows = [row for row in zip(comparison.parameters, intervals, references, strict=True) if row[2]]
    shown, count = rows[:MOST_ROWS], len(comparison.runs)
    figure = start_figure(7.2, 1.8 + 0.22 * max(len(shown), 1))
    axes = figure.add_subplot()
    for k, run in enumerate(comparison.runs):
        style, offset = _choose_style(k, run.name), 0.6 * (k + 0.5) / count - 0.3
        for row, (_, of_runs, reference) in enumerate(shown):
            value, half = of_runs[k]
            if value is not None and half is not None:
                center, unit = reference or (0.0, 1.0)
                x, bar = (value - center) / unit, half / unit
                axes.errorbar(x, row + offset, xerr=bar, ms=DOT + 0.5, capsize=2.0, **style)
    axes.axvline(0.0, **ZERO)
    label_rows(axes, [shorten(name) for name, *_ in shown])
    first = shorten(comparison.runs[0].name)
    label_axes(axes, f"difference from {first} [half-widths of its 95 % interval]", "")
    add_legend(figure)
    part = f" (the first {len(shown)} of {len(rows)} parameters)" if len(rows) > len(shown) else ""
    return finish_figure(figure, f"Estimates with their 95 % intervals{part}")


def draw_run_errors(comparison: RunComparison) -> Figure:
    """Draw rms (bar) and largest (dot) error of each run after calibration, by quantity."""
    has_common = comparison.common_poses > 0
    errors = [run.common if has_common else run.own for run in comparison.errors]
    quantities = tuple(dict.fromkeys(name for of_run in errors for name in of_run))
    n = max(len(quantities), 1)
    figure, panels = start_panels(7.2, 1.4 + 2.6 * n, n, 1)
    for (axes,), quantity in zip(panels, quantities, strict=False):
        unit = comparison.error_units[quantity]
        for k, of_run in enumerate(errors):
            if (error := of_run.get(quantity)) is not None:
                axes.bar(k, error.rms / unit.factor_to_si, 0.5, color=COLORS[k % len(COLORS)])
                axes.plot(k, error.max / unit.factor_to_si, "o", color="0.2", ms=DOT + 1.0)
        labels = [shorten(run.run) for run in comparison.errors]
        axes.set_xticks(range(len(errors)), labels, fontsize=SMALL)
        axes.set_xlim(-0.6, len(errors) - 0.4)
        axes.set_ylim(bottom=0.0)
        label_axes(axes, "", f"{quantity} error [{unit.symbol}]")
    common = f"{comparison.common_poses} common poses"
    poses = common if has_common else "held-out poses of each run"
    words = f"Errors after calibration at the {poses}; bars: root mean square, dots: largest"
    return finish_figure(figure, words)


@register("figure", CheckUp)
def draw_check_up(result: CheckUp) -> Figure:
    """Draw the probability of each check with the level of the alarm, and its prediction errors."""
    x, n = np.arange(len(result.checks)), len(result.units)
    figure, panels = start_panels(7.2, 3.4 + 2.2 * n, n + 1, 1, sharex=True)
    alarm = np.array([check.alarm for check in result.checks])
    p_values = np.maximum([check.p_value for check in result.checks], SMALLEST_SHOWN)
    for chosen, color, label in ((~alarm, COLORS[0], "check"), (alarm, COLORS[1], "alarm")):
        style = {"color": color, "ms": DOT + 1.0, "label": label}
        panels[0, 0].plot(x[chosen], p_values[chosen], "o", **style)
    panels[0, 0].axhline(result.level, **DASHED, label="level of the alarm")
    panels[0, 0].set_yscale("log")
    scale_logarithmically(panels[0, 0].yaxis)
    label_axes(panels[0, 0], "", "probability if unchanged [1]")
    for (axes,), (quantity, unit) in zip(panels[1:], result.units.items(), strict=True):
        sizes = np.array([check.errors.get(quantity, np.nan) for check in result.checks])
        shown = choose_unit(unit, sizes[np.isfinite(sizes)])
        axes.plot(x, sizes / shown.factor_to_si, "o-", color=COLORS[0], ms=DOT, lw=THIN)
        axes.set_ylim(bottom=0.0)
        label_axes(axes, "", f"{quantity} error (rms) [{shown.symbol}]")
    every = slice(None, None, -(-len(x) // MOST_LABELS))
    names = [shorten(check.name) for check in result.checks]
    panels[-1, 0].set_xticks(x[every], names[every], rotation=45, ha="right")
    add_legend(figure)
    share = f"{100.0 * result.false_alarms:.3g} %"
    return finish_figure(figure, f"Checks since the calibration; false alarms: {share} a year")


SMALLEST_SHOWN, MOST_LABELS = 1e-12, 30
"""Probability below which a check is drawn at this one; most names of checks."""


@register("figure", RunComparison)
def draw_run_shifts(comparison: RunComparison) -> Figure:
    """Draw the shift of each parameter from the first run, in standard deviations, while all others
    may have changed, too; a significant shift is filled. What is not determined or not tested has
    no marker.
    """
    names, total = comparison.parameters[:MOST_ROWS], len(comparison.parameters)
    figure = start_figure(7.2, 1.8 + 0.2 * len(names))
    axes, y, lines = figure.add_subplot(), np.arange(len(names)), []
    words = {True: "has changed", False: "no change", None: "not tested"}
    for k, pair in enumerate(comparison.pairs, 1):  # the first run has color and marker 0
        shifts = [pair.find_shift(name) for name in names]
        style = _choose_style(k, pair.second)
        size = np.array([shift / sd if sd > 0.0 else np.nan for shift, sd, _ in shifts])
        significant = np.array([flag for _, _, flag in shifts])
        offset = 0.5 * k / (len(comparison.pairs) + 1) - 0.25
        for chosen, face in ((significant, style["color"]), (~significant, "white")):
            axes.plot(size[chosen], (y + offset)[chosen], mfc=face, ms=DOT + 2, **style)
        explained = pair.moved and pair.cause.names
        cause = f"; a change of {' and '.join(pair.cause.names)} alone explains it"
        lines.append(f"{style['label']}: {words[pair.moved]}{cause if explained else ''}")
    band: dict[str, Any] = {"color": PALE, "alpha": 0.35, "lw": 0.0, "zorder": 0}
    axes.axvspan(-1.96, 1.96, label="95 % of a single shift", **band)
    axes.plot([], [], "o", color=DARK, label="filled: significant")
    axes.axvline(0.0, **ZERO)
    label_rows(axes, [shorten(name) for name in names])
    first = shorten(comparison.runs[0].name)
    label_axes(axes, f"shift from {first} [standard deviations]", "")
    add_legend(figure)
    lines += [f"the first {MOST_ROWS} of {total} parameters"] if total > MOST_ROWS else []
    return finish_figure(figure, "\n".join(lines))


# Errors of measured heights over x and y, before and after calibration.

MOST_NUMBERS = 40  # points up to which each has its error as a number
# Of points that the fit used, and of those that it did not, with their words.
HEIGHT_MARKERS = {"fitted": ("o", "used in the fit"), "held-out": ("s", "held out")}

AREA, MARGIN = 110.0, 0.16
"""Area of a marker [pt^2], and margin around the points as a share of their range."""


@register("figure", HeightErrors)
def draw_height_errors(heights: HeightErrors) -> Figure:
    """Draw the errors of heights over x and y, before and after, with one scale of colors.

    Circles are points of the fit, squares are held out.
    """
    factor, symbol = heights.unit.factor_to_si, heights.unit.symbol
    limit = float(np.abs(np.concatenate([heights.before, heights.after])).max()) / factor or 1.0
    figure, (panels,) = start_panels(10.0, 5.2, 1, 2)
    points = None
    for axes, name in zip(panels, ("before", "after"), strict=True):
        points = _draw_heights(axes, heights, name, limit)
    label = f"height error, predicted - measured [{symbol}]"
    add_colorbar(figure, points, list(panels), label, aspect=24, pad=0.02)
    add_legend(figure)
    return finish_figure(figure, f"Height errors at {len(heights.poses)} points")


def _draw_heights(axes: Axes, heights: HeightErrors, name: str, limit: float) -> Any:
    """Draw the errors before or after; return the points with their scale of colors."""
    factor, symbol = heights.unit.factor_to_si, heights.unit.symbol
    x, y = heights.points.T / factor
    errors = getattr(heights, name) / factor
    style: dict[str, Any] = {"cmap": DIVERGING, "vmin": -limit, "vmax": limit, "s": AREA}
    drawn, rms = None, []
    for of_set, is_held_out in heights.list_sets():
        chosen, (marker, words) = heights.is_held_out == is_held_out, HEIGHT_MARKERS[of_set]
        axes.plot([], [], marker, mfc="none", mec=DARK, label=words)
        places = x[chosen], y[chosen]
        drawn = axes.scatter(*places, c=errors[chosen], marker=marker, ec=DARK, lw=0.7, **style)
        rms.append(f"{of_set} {heights.statistics(name, is_held_out).rms / factor:.3g}")
    if len(errors) <= MOST_NUMBERS:
        decimals = count_decimals(limit, 3)
        above: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "fontsize": SMALL}
        for *place, value in zip(x, y, errors.tolist(), strict=True):
            number = f"{round(value, decimals) + 0.0:+.{decimals}f}"
            axes.annotate(number, tuple(place), (0, 8), **above)
    title = f"{name} calibration: rms {', '.join(rms)} {symbol}"
    label_axes(axes, f"x [{symbol}]", f"y [{symbol}]" if name == "before" else "", title)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(MARGIN)
    return drawn


# A plan: the poses with the way through them, and expected errors by the number of poses.

CALIBRATION, VALIDATION, BOUND = COLORS[0], COLORS[1], COLORS[2]
"""Colors of calibration poses, of validation poses, and of the bound."""

MOST_NUMBERED, IN_LINE = 80, 6
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
    of_name = [units[d] for d in platform_coordinates.list_dimensions(names)]
    labels = [f"{name} [{unit.symbol}]" for name, unit in zip(names, of_name, strict=True)]
    scale = np.array([unit.factor_to_si for unit in of_name])
    stops = np.concatenate([locate_home(plan.robot)[None], poses.coordinates]) / scale
    pairs = [(i, i + 1) for i in range(0, len(names) - 1, 2)]
    single = len(names) - 1 if len(names) % 2 else None
    count = len(pairs) + (single is not None)
    figure = start_figure(max(4.9 * count, 6.0), 5.4)
    for place, (i, j) in enumerate(pairs, 1):
        axes = figure.add_subplot(1, count, place)
        _draw_route(axes, stops[:, i], stops[:, j], poses)
        label_axes(axes, labels[i], labels[j])
    if single is not None:
        axes = figure.add_subplot(1, count, count)
        _draw_route(axes, np.arange(len(stops), dtype=float), stops[:, single], poses)
        label_sparsely(axes.xaxis)
        label_axes(axes, "step [1], home is 0", labels[single])
    add_legend(figure)
    held_out = int(poses.held_out.sum())
    fitted = f"n = {len(poses) - held_out} poses for calibration"
    words = f"{fitted}, {held_out} for validation, numbered in their order"
    return finish_figure(figure, f"{plan.robot.name}: {words}")


def _draw_route(axes: Axes, x: FloatArray, y: FloatArray, poses: PlannedPoses) -> None:
    """Draw the path from home through all poses, with an arrow in the middle of each part, and the
    poses as disks that contain their numbers where these can be read.
    """
    for k in range(1, len(x)):
        segments = [(k - 1, 0, "--"), (0, k, "--")] if poses.via_home[k - 1] else [(k - 1, k, "-")]
        for start, end, line in segments:
            ends = x[[start, end]], y[[start, end]]
            label = "path" if line == "-" else "path via home"
            axes.plot(*ends, color=PALE, lw=THIN, ls=line, zorder=1, label=label)
            middle = ends[0].mean(), ends[1].mean()
            before = 0.52 * ends[0][0] + 0.48 * ends[0][1], 0.52 * ends[1][0] + 0.48 * ends[1][1]
            if np.ptp(ends[0]) > 0.0 or np.ptp(ends[1]) > 0.0:
                arrow = {"arrowstyle": "-|>", "color": REFERENCE, "lw": 0.0, "mutation_scale": 7.0}
                axes.annotate("", middle, before, arrowprops=arrow, zorder=1)
    axes.plot(x[0], y[0], "k+", ms=9.0, mew=1.4, zorder=3, label="home")
    x, y, held_out = x[1:], y[1:], poses.held_out
    is_numbered = len(held_out) <= MOST_NUMBERED
    size = DISK if is_numbered else DOT
    for chosen, color, marker, label in (
        (~held_out, CALIBRATION, "o", "calibration"),
        (held_out, VALIDATION, "s", "validation"),
    ):
        if chosen.any():
            style: dict[str, Any] = {"color": color, "ms": size, "label": label, "zorder": 2}
            axes.plot(x[chosen], y[chosen], marker, **style)
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
    unit = find_unit(robot.units[TARGETS[curve.target]])
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

VIEWS = ((0, 1), (0, 2), (1, 2))  # pairs of coordinates: from above, from the front, from the side
MOST_GROUPS = 8  # groups with a label of their own in the legend


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
    labels = [
        f"group {i}, line along {platform_coordinates.POSITION[axis]}"
        for i, axis in enumerate(plan.axis, 1)
    ]
    labels = labels if len(labels) <= MOST_GROUPS else [""] * len(labels)
    figure, (panels,) = start_panels(12.6, 5.0, 1, len(VIEWS))
    for words, width in (("line: points 1 and 2", 2.2), ("plane: point 1 and others", THIN)):
        panels[0].plot([], [], "o-", color=DARK, lw=width, ms=DOT, label=words)
    for axes, view in zip(panels, VIEWS, strict=True):
        for points, label, (color, marker) in zip(places[:, :, view], labels, styles, strict=True):
            axes.plot(*points[:2].T, "-", color=color, lw=2.2, zorder=2)
            for point in points[2:]:  # a fan of thin lines in the plane
                ends = np.stack([points[0], point])
                axes.plot(*ends.T, "-", color=color, lw=THIN, alpha=0.6, zorder=1)
            style: dict[str, Any] = {"color": color, "ms": DOT + LINE, "zorder": 3}
            axes.plot(*points.T, marker, label=label, **style)
        _number_surfaces(axes, places[:, 0, view])
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.12)
        x, y = (platform_coordinates.POSITION[i] for i in view)
        label_axes(axes, f"{x} [{unit.symbol}]", f"{y} [{unit.symbol}]")
    add_legend(figure)
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
