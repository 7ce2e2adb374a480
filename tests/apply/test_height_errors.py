# SPDX-License-Identifier: Apache-2.0
"""Errors of heights over the bed are those of the fit and of the validation, at their places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import loopcal as lc
from loopcal.apply.height_errors import (
    PREFIX,
    HeightErrors,
    map_height_errors,
    measures_only_heights,
    restore_heights,
)
from loopcal.estimate.identification import identify
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.kinds.position import Position
from loopcal.measure.kinds.surfaces import Plane
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace
from loopcal.report.calibration_view import build_height_map, build_height_summary, view_heights
from loopcal.report.figures.result_figures import draw_height_errors
from loopcal.results.storage import store_arrays
from loopcal.results.tables import Table


@pytest.fixture(scope="module")
def printer(root) -> Mechanism:
    return lc.load_robot(root / "examples" / "delta-printer" / "printer.yaml")


@pytest.fixture(scope="module")
def report(printer, root) -> lc.CalibrationReport:
    data = lc.load_measurements(root / "examples" / "delta-printer" / "heights.csv", printer)
    return lc.calibrate(printer, data, lc.CalibrationOptions(hold_out=0.4))


@pytest.fixture(scope="module")
def heights(report) -> HeightErrors:
    assert report.height_errors is not None
    return report.height_errors


def test_errors_after_are_those_of_the_fit_and_of_the_validation(report, heights) -> None:
    assert heights.poses == (*report.split.fitted.labels, *report.split.held_out.labels)
    assert heights.is_held_out.sum() == report.split.held_out.n_poses == 5
    (rows,) = report.identification.residuals
    fitted, held_out = ~heights.is_held_out, heights.is_held_out
    assert_allclose(heights.after[fitted], rows.raw[:, 0], atol=1e-12)  # [m], rounding
    for name in ("before", "after"):
        errors = getattr(report.validation, name)["position"].components[:, 0]
        assert_allclose(getattr(heights, name)[held_out], errors, atol=1e-12)
    assert heights.statistics("after", True).rms == pytest.approx(
        report.validation.after["position"].statistics.rms
    )


def test_places_are_those_of_the_calibrated_geometry(report, heights) -> None:
    readings = np.concatenate([report.split.fitted.readings, report.split.held_out.readings])
    assert_allclose(heights.points, forward(report.robot, readings).T[:, :2, 3], atol=1e-9)


def test_heights_come_back_from_the_arrays_of_a_run(report, heights) -> None:
    again = restore_heights(store_arrays(heights, PREFIX), report.robot)
    assert again is not None
    assert str(again) == str(heights)
    assert again.to_dict().keys() == report.to_dict()["height_errors"].keys()
    assert restore_heights({}, report.robot) is None


def test_figure_has_one_scale_of_colors_and_shows_every_point(report, heights) -> None:
    figure = draw_height_errors(heights)
    (scale,) = {c.get_clim() for axes in figure.axes[:2] for c in axes.collections}
    largest = 1e3 * float(np.abs(heights.before).max())
    assert scale == pytest.approx((-largest, largest), rel=1e-15)  # the unit multiplies first
    shown = [
        sum(np.asarray(c.get_offsets()).shape[0] for c in axes.collections)
        for axes in figure.axes[:2]
    ]
    assert shown == [13, 13]
    assert "[mm]" in figure.axes[2].get_ylabel()
    assert [len(axes.texts) for axes in figure.axes[:2]] == [13, 13]
    assert heights.plot().get_suptitle() == figure.get_suptitle()


def test_tables_name_units_and_which_points_were_held_out(report, heights) -> None:
    table = build_height_map(heights)
    assert isinstance(table, Table)
    text = table.to_text()
    assert "before [mm]" in text
    assert text.count("held out") == 5
    assert text.count("in the fit") == 8
    assert view_heights(heights, verbose=False) == [build_height_map(heights)]
    assert build_height_summary(heights).rows[0][2] == "8"
    assert "held out" in report._repr_html_()
    frame = heights.to_frame()
    assert list(frame["held_out"]) == list(heights.is_held_out)


def test_many_heights_have_a_summary_in_place_of_a_table(report, heights) -> None:
    many = replace(
        heights,
        poses=heights.poses * 20,
        points=np.tile(heights.points, (20, 1)),
        before=np.tile(heights.before, 20),
        after=np.tile(heights.after, 20),
        is_held_out=np.tile(heights.is_held_out, 20),
    )
    assert view_heights(many, verbose=False) == [build_height_summary(many)]
    assert build_height_map(many) == "The errors of 260 heights are too many for a table."
    assert not draw_height_errors(many).axes[0].texts


def measure(printer: Mechanism, report, kind, columns: int) -> Measurements:
    """Return exact measurements of a kind at the poses of the example."""
    data = report.split.fitted
    values = np.zeros((data.n_poses, columns))
    rows = Observations.from_sigma(kind, range(data.n_poses), values, 2e-5)
    return replace(data, observations=(rows,))


def test_gaps_to_a_level_plane_are_heights_and_those_to_a_wall_are_not(
    printer, report, heights
) -> None:
    place = np.zeros((1, 3))
    bed = Plane(places=place, surface="bed")
    fit = report.identification
    gaps = map_height_errors(fit, measure(printer, report, bed, 1), None)
    assert gaps is not None
    fitted = ~heights.is_held_out
    measured = report.split.fitted.observations[0].measured[:, 0]
    # the bed is at z = 0, and the probed heights are counted from there
    assert_allclose(gaps.after, heights.after[fitted] + measured, atol=1e-9)
    assert not gaps.is_held_out.any()
    tilted = np.eye(4)[[2, 0, 1, 3]]  # z of the frame is x of the base
    sideways = Component(("z",), T_base_frame=tilted).with_tool(np.eye(4))
    assert map_height_errors(fit, measure(printer, report, sideways, 1), None) is None
    position = Position(places=place)
    assert map_height_errors(fit, measure(printer, report, position, 3), None) is None


def test_heights_of_a_platform_that_rotates_are_no_map(heights) -> None:
    """Their errors depend on the orientation, too, and nothing that was measured is a bed."""
    robot = lc.load_robot("3-prs")
    poses = sample_workspace(robot, 12, 1).coordinates
    for kind in (Component(("z",)), Plane(places=np.zeros((1, 3)), surface="table")):
        sensor = Sensor(kind, Gaussian(np.full(len(kind.columns), 2e-5)))
        data = simulate(robot, poses, Instrument((sensor,)), 1)
        fit = identify(robot, data)
        assert map_height_errors(fit, data, None) is None
    assert restore_heights(store_arrays(heights, PREFIX), robot) is None
    assert "bed" not in str(heights)


def test_heights_alone_do_not_test_fixed_lengths(report) -> None:
    """A fixed angle of a tower defines the x axis: it is no length and not in the finding."""
    (finding,) = (f for f in report.findings if f.code == "workflow.undetermined-scale")
    assert finding.data["names"] == ("arm1.length", "arm2.length", "arm3.length")
    data = report.split.fitted
    (rows,) = data.observations
    n = len(rows)
    places = Observations.from_sigma(
        Position().with_tool(np.eye(4)), range(n), np.zeros((n, 3)), 1e-5
    )
    assert measures_only_heights(data)
    assert not measures_only_heights(replace(data, observations=(rows, places)))
