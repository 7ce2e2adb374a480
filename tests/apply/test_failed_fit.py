# SPDX-License-Identifier: Apache-2.0
"""A fit that did not converge: nothing that is printed or written pretends to be its result."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.apply.calibration_report import CalibrationReport, Verdict
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Huber
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.result import Identification
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.report.calibration_view import view_calibration, view_fit
from loopcal.results.tables import render_text
from tests.estimate.problems import hexapod, hexapod_data


def wrong_data(instrument: Instrument | None = None) -> Measurements:
    """Return measurements whose readings belong to other poses."""
    data = hexapod_data(20, instrument=instrument)
    return replace(data, readings=data.readings[np.random.default_rng(0).permutation(20)])


@cache
def failed() -> CalibrationReport:
    """Return a calibration whose fit did not converge."""
    options = CalibrationOptions(hold_out=0.25, check_conventions=False)
    return calibrate(hexapod(), wrong_data(), options)


def list_texts(report: CalibrationReport) -> dict[str, str]:
    """Return everything that people read about a calibration."""
    fit = report.identification
    return {
        "report": str(report),
        "fit": str(fit),
        "repr": repr(fit),
        "summary": render_text(view_calibration(report), 100),
        "page": render_text(view_calibration(report, verbose=True), 100),
        "view": render_text(view_fit(fit), 100),
    }


@pytest.mark.parametrize("name", ["report", "fit", "repr", "summary", "page", "view"])
def test_no_statistics_and_no_precise_values_are_printed(name):
    assert not failed().identification.converged
    text = list_texts(failed())[name]
    assert not re.search(r"chi-square|degrees of freedom|[Rr]ank \d|nan|\+/-", text)
    assert "after calibration" not in text
    assert "smaller" not in text
    values = [line for line in text.splitlines() if line.startswith("leg")]
    for line in values:  # name, nominal value, last value, unit
        digits = re.sub(r"e[+-]\d+|[^0-9]", "", line.split()[2]).strip("0")
        assert len(digits) <= 3, line


def test_json_has_no_statistics_of_a_failed_fit():
    document = failed().to_dict()
    fit = document["fit"]
    for key in ("chi_square", "degrees", "p_value", "dof", "rank", "condition", "sigma_scale"):
        assert fit[key] is None, key
    assert all(row["plus_minus"] is None for row in fit["parameters"])
    assert document["validation"] is None
    assert failed().verdict is Verdict.NOT_CALIBRATED
    codes = {finding.code for finding in failed().findings}
    assert not {code for code in codes if code.startswith(("gates.errors", "validation."))}


def test_run_of_a_failed_fit_with_an_unknown_frame_is_read_back(tmp_path):
    """The frame has no bounded uncertainty; its run folder could not be written."""
    options = CalibrationOptions(hold_out=0.25, check_conventions=False)
    tracker = Instrument((Sensor(Position(unknown=("frame",)), Gaussian(np.full(3, 5e-6))),))
    report = calibrate(lc.load_robot("hexapod-42"), wrong_data(tracker), options)
    assert not report.identification.converged
    lc.save_run(report, tmp_path / "run")
    arrays = lc.load_run(tmp_path / "run").arrays
    assert arrays["frames_T"].shape == (0, 4, 4)


def test_sum_of_squares_is_printed_only_where_the_iteration_lowered_it():
    fit = failed().identification
    first, last = fit.history.cost[0], fit.history.cost[-1]
    assert fit.describe_statistics().endswith(f"fell from {first:.3g} to {last:.3g}.")
    stuck = replace(fit, history=replace(fit.history, cost=fit.history.cost[:1]))
    assert stuck.describe_statistics() == ""


@pytest.mark.parametrize("method", [LeastSquares(), MAP()], ids=["least squares", "MAP"])
def test_chi_square_is_that_of_the_residuals(method):
    fit = identify(hexapod(), hexapod_data(20), method)
    assert fit.converged
    # also of MAP: no penalty enters the test of the noise
    expected = identify(hexapod(), hexapod_data(20), LeastSquares())
    squares = sum((r.whitened**2).sum() for r in expected.residuals)
    assert fit.chi_square == pytest.approx(squares, rel=1e-4)
    assert fit.residual_test.degrees == 120 - 42


def test_chi_square_of_a_loss_is_that_of_the_weighted_residuals():
    data = hexapod_data(20)
    rows = data.observations[0]
    measured = np.array(rows.measured)
    measured[3, 3:] += 1e-4
    data = replace(data, observations=(replace(rows, measured=measured),))
    fit: Identification = identify(
        hexapod(), data, options=FitOptions(method=LeastSquares(), loss=Huber())
    )
    squares = (fit.residuals[0].whitened ** 2).sum(axis=1)
    assert fit.chi_square == pytest.approx((fit.pose_weights * squares).sum(), rel=1e-4)
    assert fit.chi_square < 0.9 * squares.sum()
    assert "weighted residuals" in fit.describe_statistics()


def test_fit_that_leads_away_from_a_geometry_without_poses_is_not_called_a_failure(tmp_path):
    """The nominal anchors close no pose, the calibrated ones all: the readings before calibration
    contradict each other, and lead to the nearest poses. The calibrated geometry is good, and a
    second calibration can begin with it."""
    shipped = lc.load_robot("cable-4")
    truth = shipped.with_values(lc.sample_truth(shipped, 1, 1)[0])
    noise = lc.Gaussian(np.array([5e-5] * 3 + [1e-5] * 3))
    instrument = lc.Instrument((lc.Sensor(lc.Pose(), noise),))
    data = lc.simulate(truth, lc.sample_workspace(shipped, 12, 1).coordinates, instrument, 1)
    text = (Path(lc.__file__).parent / "robots" / "cable-4.yaml").read_text("utf-8")
    for old, new in (("[0, -1500, -120]", "[0, -900, -120]"), ("[1300, 750,", "[900, 1100,")):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "far.yaml").write_text(text)
    options = CalibrationOptions(check_conventions=False)
    first = calibrate(lc.load_robot(tmp_path / "far.yaml"), data, options)
    assert first.verdict is Verdict.UNDECIDED
    assert "fit.poses-open-at-start" in [f.code for f in first.findings]
    assert first.fitted_errors is not None
    assert len(first.fitted_errors.poses) == 12
    (all_kinds,) = first.fitted_errors.changes().values()
    assert all_kinds.before > 1e4 > 1e3 * all_kinds.after  # [sigma]
    lc.save_robot(first.identification.robot, tmp_path / "corrected.yaml")
    second = calibrate(lc.load_robot(tmp_path / "corrected.yaml"), data, options)
    assert second.fitted_errors is not None
    assert len(second.fitted_errors.poses) == 12


def test_outliers_of_a_failed_fit_are_refused():
    with pytest.raises(lc.EstimationError, match="did not converge"):
        lc.find_outliers(failed().identification, wrong_data())
