# SPDX-License-Identifier: Apache-2.0
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# pyright: reportOptionalMemberAccess=false
# matplotlib's types do not say that lines and images contain arrays.
"""Figures contain all data, have units on their axes, and have the same bytes each time."""

import warnings
from dataclasses import replace
from pathlib import Path

import matplotlib.figure
import numpy as np
import pytest
from matplotlib.text import Text
from numpy.testing import assert_allclose

import loopcal as lc
from loopcal.report.figures.fit_figures import (
    compute_correlation,
    draw_convergence,
    draw_correlation,
    draw_identifiability,
    draw_parameters,
    draw_residuals,
    list_series,
)
from loopcal.report.figures.result_figures import draw_accuracy_map, draw_plan, draw_validation
from loopcal.report.figures.style import label_poses, shorten, start_figure
from loopcal.report.pictures import render_figure
from loopcal.report.scene.scene import draw_robot
from loopcal.units import find_unit

OF_FITS = [draw_residuals, draw_parameters, draw_correlation, draw_convergence]
WITHOUT_UNIT = {"", "pose"}
"""Labels of axes that have names in place of numbers."""


def list_points(axes, marker=None) -> int:
    return sum(len(x.get_xdata()) for x in axes.lines if marker in {None, x.get_marker()})


def check(figure: matplotlib.figure.Figure) -> None:
    """Draw a figure without warnings, and check that axes with numbers have units."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.canvas.draw()
    assert figure.get_suptitle()
    for axes in figure.axes:
        for label in (axes.get_xlabel(), axes.get_ylabel()):
            assert label in WITHOUT_UNIT or "[" in label or "more parameters" in label, label


@pytest.mark.slow
@pytest.mark.parametrize("draw", OF_FITS, ids=lambda draw: draw.__name__)
@pytest.mark.parametrize("name", ["linear_delta", "hexapod"])
def test_figure_of_a_fit_has_units_and_no_warnings(draw, name, request) -> None:
    check(draw(request.getfixturevalue(name).fit))


@pytest.mark.slow
@pytest.mark.parametrize(
    "draw",
    [OF_FITS[0], *(pytest.param(draw, marks=pytest.mark.evidence) for draw in OF_FITS[1:])],
    ids=lambda draw: draw.__name__,
)
def test_figure_has_the_same_bytes_each_time(draw, five_bar) -> None:
    figure = draw(five_bar.fit)
    content = render_figure(figure, ".svg")
    assert content == render_figure(draw(five_bar.fit), ".svg")
    assert figure.get_layout_engine() is not None


def test_residuals_by_pose_are_those_of_the_fit_in_the_unit_of_the_file(five_bar) -> None:
    figure = draw_residuals(five_bar.fit)
    by_pose = figure.axes[0]
    rows = five_bar.fit.residuals[0]
    assert by_pose.get_ylabel() == "position residual [mm]"
    components = [line for line in by_pose.lines if len(line.get_xdata()) == len(rows.raw)]
    assert len(components) == 3
    for line, values in zip(components, rows.raw.T, strict=True):
        assert_allclose(line.get_ydata(), 1e3 * values)
    labels = [text.get_text() for text in by_pose.get_xticklabels()]
    assert labels == list(rows.poses)
    readings = [axes for axes in figure.axes if axes.get_xlabel().startswith("reading ")]
    assert [axes.get_xlabel() for axes in readings] == ["reading left [deg]", "reading right [deg]"]
    drawn = readings[0].lines[0]
    assert_allclose(np.deg2rad(drawn.get_xdata()), five_bar.fitted.readings[:, 0])
    assert_allclose(drawn.get_ydata(), rows.whitened[:, 0])
    assert "in the stated frames" in figure.get_suptitle()


def test_residual_figure_names_the_fitted_frame(linear_delta) -> None:
    title = draw_residuals(linear_delta.fit).get_suptitle()
    assert title.endswith("predicted - measured, after the best fit of tracker")


def test_components_show_their_rms_over_sigma(five_bar) -> None:
    figure = draw_residuals(five_bar.fit)
    (panel,) = (axes for axes in figure.axes if axes.get_title().startswith("by component"))
    rms = np.sqrt((five_bar.fit.residuals[0].whitened ** 2).mean(axis=0))
    assert [text.get_text() for text in panel.texts] == [f"{value:.2f}" for value in rms]


def test_residuals_of_estimated_readings_are_no_part_of_the_histogram(hexapod) -> None:
    fit = hexapod.fit
    assert fit.residuals[-1].kind == "readings"
    figure = draw_residuals(fit)
    (normal,) = (axes for axes in figure.axes if axes.get_title().startswith("normal plot"))
    assert list_points(normal, "o") == fit.residuals[0].raw.size


def test_missing_components_and_rows_of_weight_zero_are_not_drawn(five_bar) -> None:
    rows = five_bar.fit.residuals[0]
    raw, whitened = rows.raw.copy(), rows.whitened.copy()
    raw[0, 0], whitened[0, 0] = np.nan, 0.0
    whitened[1] = 0.0
    changed = replace(five_bar.fit, residuals=(replace(rows, raw=raw, whitened=whitened),))
    n = len(raw)
    assert [len(series.raw) for series in list_series(changed.robot, changed.residuals)] == [
        n - 2,
        n - 1,
        n - 1,
    ]
    check(draw_residuals(changed))


def test_components_of_many_targets_share_labels_and_all_are_drawn(five_bar) -> None:
    rows, *_ = five_bar.fit.residuals
    raw = np.tile(rows.raw[:, :1], (1, 120))
    whole = replace(
        rows,
        components=tuple(f"t{i // 3}.{'xyz'[i % 3]}" for i in range(120)),
        dimensions=rows.dimensions[:1] * 120,
        **dict.fromkeys(("raw", "whitened", "measured"), raw),
    )
    figure = draw_residuals(replace(five_bar.fit, residuals=(whole,)))
    by_pose, by_component, *_ = figure.axes
    labels = [label.get_text() for label in by_component.get_xticklabels()]
    assert labels == [f"{rows.kind} {axis}" for axis in "xyz"]
    drawn = [line for line in by_pose.lines if len(np.atleast_1d(line.get_xdata())) == len(raw)]
    assert len(drawn) == 120
    assert all(line.get_rasterized() == (raw.size > 2000) for line in drawn)


def test_residuals_against_time_and_temperature_that_were_recorded(five_bar) -> None:
    rows = five_bar.fit.residuals[0]
    n = len(rows.raw)
    context = {"time": np.arange(n) * 60.0, "temperature.base": np.linspace(20.0, 22.0, n)}
    rows = replace(rows, context={**context, "temperature": np.full(n, 20.0)})
    figure = draw_residuals(replace(five_bar.fit, residuals=(rows,)))
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert "time [s]" in labels
    assert "temperature.base [degC]" in labels
    assert "temperature [degC]" not in labels  # it did not change
    check(figure)


def test_many_residuals_are_a_picture_within_the_svg(five_bar) -> None:
    rows = five_bar.fit.residuals[0]
    times = 400
    many = replace(
        rows,
        poses=tuple(f"{label}-{i}" for i in range(times) for label in rows.poses),
        raw=np.tile(rows.raw, (times, 1)),
        whitened=np.tile(rows.whitened, (times, 1)),
        readings=np.tile(rows.readings, (times, 1)),
    )
    figure = draw_residuals(replace(five_bar.fit, residuals=(many,)))
    assert len(render_figure(figure, ".svg")) < 2_000_000


def test_parameters_are_drawn_in_tolerances_with_their_intervals(five_bar) -> None:
    fit = five_bar.fit
    shifts, widths = draw_parameters(fit).axes
    (bars,) = shifts.containers
    assert_allclose(bars[0].get_xdata(), (fit.estimate - fit.nominal) / fit.tolerance)
    segments = np.array([path[:, 0] for path in bars[2][0].get_segments()])
    assert_allclose(np.ptp(segments, axis=1) / 2.0, fit.interval() / fit.tolerance)
    assert [text.get_text() for text in shifts.get_yticklabels()] == list(fit.names)
    numbers = [text.get_text() for text in widths.get_yticklabels()]
    assert len(numbers) == len(fit.names)
    assert all(" ± " in number and number.endswith((" mm", " deg")) for number in numbers)


def test_parameters_that_are_not_determined_have_no_interval(five_bar) -> None:
    covariance = five_bar.fit.covariance.copy()
    covariance[0, 0] = np.inf
    fit = replace(five_bar.fit, covariance=covariance)
    figure = draw_parameters(fit)
    crosses = [line for line in figure.axes[0].lines if line.get_marker() == "x"]
    assert [len(line.get_xdata()) for line in crosses] == [1]
    assert figure.axes[1].get_yticklabels()[0].get_text().endswith("± unknown mm")
    assert "without a finite uncertainty" in draw_correlation(fit).get_suptitle()
    check(figure)
    check(draw_correlation(fit))


def test_fit_that_did_not_converge_has_last_values_only(five_bar) -> None:
    history = replace(five_bar.fit.history, status=lc.DescentStatus.OUT_OF_ITERATIONS)
    fit = replace(five_bar.fit, history=history)
    figure = draw_parameters(fit)
    assert "not estimates" in figure.get_suptitle()
    assert not any("±" in text.get_text() for text in figure.axes[1].get_yticklabels())
    check(figure)
    assert "out of iterations after" in draw_convergence(fit).get_suptitle()


def test_correlation_is_one_on_the_diagonal_and_names_every_parameter(hexapod) -> None:
    fit = hexapod.fit
    correlation = compute_correlation(fit.covariance)
    known = np.isfinite(fit.standard_deviations)
    assert_allclose(np.diag(correlation)[known], 1.0)
    axes = draw_correlation(fit).axes[0]
    assert_allclose(axes.images[0].get_array().filled(np.nan), correlation)
    assert [text.get_text() for text in axes.get_yticklabels()] == list(fit.names)


def test_convergence_shows_every_step(five_bar) -> None:
    cost, parameters = draw_convergence(five_bar.fit).axes
    assert_allclose(cost.lines[0].get_ydata(), five_bar.fit.history.cost)
    assert len(parameters.lines[0].get_xdata()) == five_bar.fit.history.iterations


@pytest.mark.parametrize("name", ["five_bar", "linear_delta"])
def test_validation_shows_errors_before_and_after_with_floor_and_limit(name, request) -> None:
    example = request.getfixturevalue(name)
    validation = lc.validate(example.fit, example.held_out, limit_position=1e-4)
    figure = draw_validation(validation)
    axes = figure.axes[0]
    (after,) = (line for line in axes.lines if line.get_marker() == "o")
    assert_allclose(after.get_ydata(), 1e3 * validation.after["position"].size)
    assert axes.get_ylabel() == "position error [mm]"
    legend = [text.get_text() for text in figure.legends[0].texts]
    shown = ["before", "before (rms)", "after", "after (rms)", "noise floor (rms)", "limit"]
    assert legend == shown
    assert figure.get_suptitle().endswith(validation.frame)
    check(figure)


@pytest.mark.parametrize("name", ["five_bar", "linear_delta", "hexapod"])
def test_accuracy_map_shows_every_pose_once_in_slices(name, request) -> None:
    example = request.getfixturevalue(name)
    accuracy = lc.accuracy_map(example.fit, example.fitted.readings, poses=60)
    figure = draw_accuracy_map(accuracy)
    panels = [axes for axes in figure.axes if axes.get_xlabel()]
    bounded = np.isfinite(accuracy.uncertainty.position)
    slices = 1 if name == "five_bar" else 3
    first = [axes.collections[0] for axes in panels[:slices]]
    assert sum(len(points.get_offsets()) for points in first) == bounded.sum()
    values = np.concatenate([points.get_array() for points in first])
    assert_allclose(np.sort(values), np.sort(1e3 * accuracy.uncertainty.position[bounded]))
    assert accuracy.uncertainty.frame in " ".join(figure.get_suptitle().split())
    check(figure)


SOLIDS = {  # volume -> whether it has a surface, whether the robot reaches all of it
    "cylinder": (lc.Volume({"z": (0.06, 0.12)}, radius=0.05), True, True),
    "beyond reach": (
        lc.Volume({"x": (-0.05, 0.3), "y": (-0.05, 0.05), "z": (0.06, 0.12)}),
        True,
        False,
    ),
    "one point in reach": (lc.Volume({"x": (-0.5, 0.5), "y": (-0.5, 0.5)}), False, False),
    "one point": (lc.Volume(points=[[0.0, 0.0, 0.1]]), False, True),
    "plane": (lc.Volume(radius=0.05), True, True),
    "line": (lc.Volume({"x": (-0.05, 0.05)}), False, True),
    "list": (
        lc.Volume(points=[[0.0, 0.0, 0.1], [0.01, 0.0, 0.1], [0.01, 0.03, 0.11]]),
        False,
        True,
    ),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_volume_shows_its_errors_and_the_place_of_the_largest(name, linear_delta) -> None:
    volume, has_surface, is_whole = SOLIDS[name]
    accuracy = lc.bound_errors(linear_delta.fit, volume)
    figure = accuracy.plot()
    drawn, *_, disk = figure.axes[0].collections
    place = np.array([*accuracy.worst.values()])[: len(accuracy.spacing) or 3]
    assert_allclose(np.ravel(disk._offsets3d)[: len(place)], 1e3 * place, atol=1e-9)
    unit = find_unit(figure.axes[-1].get_ylabel().partition("[")[2][:-1])
    assert_allclose(np.asarray(disk.get_array()) * unit.factor_to_si, accuracy.pointwise)
    shown = drawn.get_array()
    assert drawn.get_clim() == disk.get_clim() or accuracy.points == 1
    assert disk.get_array() >= shown.max() >= shown.min() >= drawn.get_clim()[0]
    if has_surface:
        corners = np.concatenate(drawn._faces)
        assert np.ptp(corners, axis=0).max() == pytest.approx(100.0) or not is_whole  # [mm]
        assert np.ptp(corners[:, 0]) < 300.0  # without what is beyond reach
    assert (accuracy.reachable == 1.0) == is_whole
    check(figure)


def test_identifiability_shows_rank_gap_and_null_vectors(hexapod) -> None:
    analysis = lc.identifiability(hexapod.robot, hexapod.fitted)
    figure = draw_identifiability(analysis)
    spectrum, vectors = figure.axes[:2]
    counted, cut = spectrum.lines[:2]
    assert len(counted.get_xdata()) == analysis.rank
    assert len(cut.get_xdata()) == analysis.n_parameters - analysis.rank
    assert any(text.get_text().startswith("gap ") for text in spectrum.texts)
    shown = [text.get_text() for text in vectors.get_xticklabels()]
    assert shown.count("null 1") == 1
    assert len(shown) == len(analysis.unidentifiable) + len(analysis.weak)
    check(figure)


def test_identifiability_of_what_is_determined_has_no_second_panel(five_bar) -> None:
    robot = five_bar.robot
    some = lc.identifiability(robot, five_bar.fitted)
    figure = draw_identifiability(replace(some, weak=()))
    assert len(figure.axes) == 1
    check(figure)


def test_plan_numbers_every_pose(plan) -> None:
    figure = draw_plan(plan)
    for axes in figure.axes:
        numbers = ", ".join(text.get_text().replace("\n", ", ") for text in axes.texts)
        drawn = sorted(int(number) for number in numbers.split(", ") if number)
        assert drawn == list(range(1, len(plan.poses) + 1))
    check(figure)


def test_plan_that_goes_via_home_says_so(plan) -> None:
    via = np.arange(len(plan.poses)) == 2
    figure = draw_plan(replace(plan, poses=replace(plan.poses, via_home=via)))
    assert "path via home" in [text.get_text() for text in figure.legends[0].texts]
    assert sum(line.get_linestyle() == "--" for line in figure.axes[0].lines) == 2


def test_plan_of_surfaces_shows_the_line_and_the_plane_of_each_group() -> None:
    options = lc.SurfaceOptions(groups=4, points=5)
    plan = lc.plan_surfaces(lc.load_robot("linear-delta"), options)
    figure = plan.plot()
    check(figure)
    assert len(figure.axes) == 3
    for axes, view in zip(figure.axes, ([0, 1], [0, 2], [1, 2]), strict=True):
        drawn = (line for line in axes.lines if len(line.get_xdata()))
        lines = [line.get_xydata() for line in drawn if line.get_linewidth() == 2.2]
        assert_allclose(np.stack(lines), 1e3 * plan.positions[:, :2][:, :, view])
        numbers = ", ".join(text.get_text() for text in axes.texts)
        assert sorted(map(int, numbers.split(", "))) == [1, 2, 3, 4]
    assert "4 planes with a perpendicular line, n = 5 points" in figure.get_suptitle()
    labels = [text.get_text() for text in figure.legends[0].texts]
    assert "group 4, line along " in labels[-1]


def test_one_parameter_and_one_pose_are_singular(five_bar, tmp_path) -> None:
    robot, data = five_bar.robot, five_bar.fitted
    source = (Path(lc.__file__).parent / "robots" / "five-bar.yaml").read_text()
    fixed = [name for name in robot.parameters.names if name != "left.offset"]
    (tmp_path / "five-bar.yaml").write_text(f"{source}fixed: [{', '.join(fixed)}]\n")
    single = lc.load_robot(tmp_path / "five-bar.yaml")
    fit = lc.identify(single, data)
    assert "five-bar: 1 parameter" in fit.plot.parameters().get_suptitle()
    assert fit.plot.correlation().get_suptitle().endswith("correlation of 1 parameter")
    spectrum = lc.identifiability(single, data).plot().axes[0]
    assert all(tick == round(tick) for tick in spectrum.get_xticks())
    one = lc.identify(robot, data.take([0]))
    assert "residuals of 1 pose;" in one.plot.residuals().get_suptitle()
    for figure in (fit.plot.parameters(), one.plot.parameters(), one.plot.residuals()):
        check(figure)


@pytest.mark.parametrize(("name", "panels"), [("five-bar", 1), ("3-rrr", 1), ("linear-delta", 2)])
def test_planar_robot_has_one_flat_view(name, panels) -> None:
    figure = draw_robot(lc.load_robot(name))
    assert len(figure.axes) == panels
    assert figure.axes[-1].name == "rectilinear"


def test_hostile_names_are_text(five_bar) -> None:
    name = "<script>$\\frac{"
    robot = replace(five_bar.robot, assembly=replace(five_bar.robot.assembly, name=name))
    fit = replace(five_bar.fit, robot=robot)
    drawn = [draw(fit) for draw in OF_FITS]
    for figure in drawn:
        texts = [t for t in figure.findobj(Text) if isinstance(t, Text) and name in t.get_text()]
        assert texts
    assert b"<script" not in render_figure(drawn[-1], ".svg")


def test_labels_of_many_poses_are_numbers_and_long_ones_are_shortened() -> None:
    axes = start_figure(5.0, 3.0).add_subplot()
    label_poses(axes, [f"{i}" for i in range(400)])
    assert "in order of measurement" in axes.get_xlabel()
    assert shorten("a" * 60) == "a" * 11 + "…" + "a" * 11


def test_figure_is_shown_in_a_notebook_without_pyplot(five_bar) -> None:
    content, size = draw_convergence(five_bar.fit)._repr_png_()
    assert content.startswith(b"\x89PNG")
    assert size == {"width": 864, "height": 374}


@pytest.mark.parametrize(
    ("subject", "limit", "word"),
    [
        ("fit", 1e-4, "conforms"),
        ("fit", 1e-5, "neither conforms nor fails"),
        ("robot", 1e-5, "does not conform"),
    ],
)
def test_decision_is_a_number_line_with_error_interval_and_limit(
    subject, limit, word, hexapod
) -> None:
    validation = lc.validate(getattr(hexapod, subject), hexapod.held_out, limit_position=limit)
    axes = draw_validation(validation).axes[-1]
    decision = validation.conformity["position"]
    assert axes.get_title().endswith(f"m: {word}")
    factor = {"um": 1e6, "mm": 1e3}[axes.get_xlabel().split("[")[1].rstrip("]")]
    (error,) = (np.asarray(line.get_xdata())[0] for line in axes.lines if line.get_marker() == "o")
    assert error == pytest.approx(factor * decision.estimate)
    assert pytest.approx(factor * limit) in [np.asarray(line.get_xdata())[0] for line in axes.lines]
    words = [text.get_text() for text in axes.texts]
    assert words == sorted(words, key=["conforms", "undecided", "fails"].index)
    assert axes.get_xlim()[1] > factor * max(decision.high, limit)
