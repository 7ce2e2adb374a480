# SPDX-License-Identifier: Apache-2.0
"""Rows that a calibration used are recognized in data for validation and recalibration, also in
other files, orders and units; repeated measurements are accepted.
"""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.apply.validation import report_reused_rows
from loopcal.errors import DataError
from loopcal.estimate.identification import exclude_poses, identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.posterior import posterior_from_arrays
from loopcal.estimate.prior import prior_from
from loopcal.estimate.recalibration import recalibrate
from loopcal.findings import Severity
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.fitted_rows import collect_fitted_rows, fitted_rows_from_arrays
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from loopcal.mechanism.workspace import sample_workspace
from tests.estimate.problems import hexapod, hexapod_data
from tests.findings.expectations import expect_refusal, list_codes

FITTED = hexapod_data(20)
STORED = collect_fitted_rows(FITTED)
OTHER = hexapod_data(20, 1)


def join_measurements(*parts: Measurements) -> Measurements:
    """Join measurements of one kind."""
    readings = np.concatenate([part.readings for part in parts])
    rows = [part.observations[0] for part in parts]
    measured = np.concatenate([one.measured for one in rows])
    covariance = np.concatenate([one.covariance for one in rows])
    one = replace(
        rows[0].take(np.zeros(len(readings), dtype=int)),
        rows=np.arange(len(readings)),
        measured=measured,
        covariance=covariance,
    )
    return Measurements(parts[0].robot_name, readings, (one,))


def test_subset_of_fitted_rows_is_refused_in_another_order_and_after_rounding() -> None:
    some = FITTED.take(np.array([7, 3, 11, 0]))
    rows = some.observations[0]
    again = replace(some, observations=(replace(rows, measured=rows.measured * (1.0 + 1e-12)),))
    for data in (some, again):
        with pytest.raises(DataError) as refused:
            report_reused_rows(STORED, data)
        assert refused.value.code == "validation.rows-reused"
        assert refused.value.args[0].data["count"] == refused.value.args[0].data["total"] == 4


def test_repeated_and_new_measurements_are_accepted() -> None:
    rows = FITTED.observations[0]
    sigma = np.sqrt(np.einsum("rii->ri", rows.covariance))
    # a tenth of what a repeat has
    noise = 0.1 * sigma * np.random.default_rng(0).standard_normal(rows.measured.shape)
    assert (
        report_reused_rows(
            STORED, replace(FITTED, observations=(replace(rows, measured=rows.measured + noise),))
        )
        is None
    )
    assert report_reused_rows(STORED, OTHER) is None
    assert report_reused_rows(None, FITTED) is None


def test_few_fitted_rows_among_new_ones_are_reported() -> None:
    result = report_reused_rows(STORED, join_measurements(FITTED.take(np.arange(3)), OTHER))
    assert result is not None
    assert result.severity is Severity.WARNING
    assert result.data == {"count": 3, "total": 23, "poses": ("1", "2", "3")}


def test_poses_excluded_from_the_fit_are_accepted() -> None:
    few = FITTED.take(np.arange(2))
    fitted = collect_fitted_rows(exclude_poses(FITTED, ("1", "2")))
    assert len(fitted) == 18
    assert report_reused_rows(fitted, few) is None
    weight = np.ones(20)
    weight[:2] = 0.0
    assert report_reused_rows(collect_fitted_rows(FITTED.with_weights(weight)), few) is None
    assert report_reused_rows(STORED, exclude_poses(FITTED, FITTED.labels)) is None


def replace_measured(data: Measurements, measured: np.ndarray) -> Measurements:
    """Return measurements with other measured values."""
    return replace(data, observations=(replace(data.observations[0], measured=measured),))


@pytest.mark.parametrize("columns", [slice(0, 3), slice(3, 6)])
def test_a_row_without_some_of_its_values_is_the_same_row(columns: slice) -> None:
    """What both rows state decides: to leave out columns does not make new measurements."""
    holes = np.array(FITTED.observations[0].measured)
    holes[:, columns] = np.nan
    assert STORED.find_in(replace_measured(FITTED, holes)).count == 20
    assert collect_fitted_rows(replace_measured(FITTED, holes)).find_in(FITTED).count == 20
    assert STORED.find_in(replace_measured(OTHER, OTHER.observations[0].measured)).count == 0


def test_rounded_copies_are_the_same_rows_and_repeats_are_not() -> None:
    """Rounding to a hundredth of sigma is no new measurement; of 4,000 repeats none is reused,
    although one value of tens of them agrees as well.
    """
    rows = FITTED.observations[0]
    sigma = np.sqrt(np.einsum("rii->ri", rows.covariance))
    step = 0.01 * sigma
    rounded = np.round(rows.measured / step) * step
    readings = np.round(FITTED.readings, 6)  # [m]
    copy = replace(replace_measured(FITTED, rounded), readings=readings)
    assert STORED.find_in(copy).count == 20
    rng = np.random.default_rng(2)
    for _ in range(200):
        noise = sigma * rng.standard_normal(sigma.shape)
        repeat = replace_measured(FITTED, rows.measured + noise)
        assert STORED.find_in(repeat).count == 0


DELTA = load_robot("linear-delta")


def probe(kind: Kind, step: float, seed: int) -> Measurements:
    """Return values of a delta at the same 40 readings, sigma 0.02 mm, rounded to a step [m]."""
    poses = sample_workspace(DELTA, 40, 3).coordinates
    size = 1 if kind.name == "component" else 3
    instrument = Instrument((Sensor(kind, Gaussian(np.full(size, 2e-5))),))
    data = simulate(DELTA, poses, instrument, seed)
    return replace_measured(data, np.round(data.observations[0].measured / step) * step)


@pytest.mark.parametrize("step", [1e-6, 1e-5, 2.54e-5])
@pytest.mark.parametrize("kind", [Component(("z",)), Position()])
def test_repeats_of_rounded_values_are_no_copies(kind: Kind, step: float) -> None:
    """A dial indicator shows the same height again in some of 40 poses; before, 2 to 20 of them
    were refused. A copy, or half of one among repeats, is still recognized.
    """
    first = probe(kind, step, 0)
    stored = collect_fitted_rows(first)
    for seed in range(1, 11):
        assert stored.find_in(probe(kind, step, seed)).count == 0
    assert stored.find_in(first).count == 40
    half = np.array(probe(kind, step, 1).observations[0].measured)
    half[:20] = first.observations[0].measured[:20]
    assert stored.find_in(replace_measured(first, half)).count >= 20


def test_rows_of_another_kind_are_the_same_rows() -> None:
    """Poses without their orientations are positions, and these are components; other measurements
    at the same readings are none of them.
    """
    robot = load_robot("hexapod-42")
    coordinates = sample_workspace(robot, 20, 3).coordinates
    poses, positions = (
        simulate(robot, coordinates, Instrument((Sensor(kind, Gaussian(np.full(size, 1e-5))),)), 0)
        for kind, size in ((Pose(), 6), (Position(), 3))
    )
    positions = replace_measured(positions, poses.observations[0].measured[:, 3:6])
    for fitted, data in ((poses, positions), (positions, poses)):
        stored = collect_fitted_rows(fitted)
        assert stored.find_in(data).count == 20
        rows = data.observations[0]
        sigma = np.sqrt(np.einsum("rii->ri", rows.covariance))
        repeat = rows.measured + sigma * np.random.default_rng(1).standard_normal(sigma.shape)
        assert stored.find_in(replace_measured(data, repeat)).count == 0


def test_readings_alone_are_rows_only_where_they_were_fitted() -> None:
    bare = replace(FITTED, observations=())
    assert STORED.find_in(bare) == ((), 0, 0)
    fitted = collect_fitted_rows(bare, are_readings_fitted=True)
    assert fitted.find_in(bare)[1:] == (20, 20)
    assert fitted.find_in(replace(OTHER, observations=())).count == 0


def test_rows_survive_a_run_folder() -> None:
    back = fitted_rows_from_arrays(STORED.joined(collect_fitted_rows(OTHER)).arrays())
    assert back is not None
    assert (back.find_in(FITTED).count, back.find_in(OTHER).count) == (20, 20)
    assert fitted_rows_from_arrays({"nominal": np.zeros(3)}) is None


FIRST = identify(hexapod(), FITTED, LeastSquares())


@pytest.mark.parametrize("free_limb", [None, "leg3"])
@pytest.mark.parametrize(
    ("data", "count"),
    [
        (FITTED, 20),
        (FITTED.take(np.arange(19, -1, -1)), 20),
        (FITTED.take(np.array([3])), 1),
        (join_measurements(OTHER, FITTED), 20),
        (join_measurements(OTHER, FITTED.take(np.array([2, 4]))), 2),
    ],
)
def test_no_row_counts_twice(data: Measurements, count: int, free_limb: str | None) -> None:
    """All of the rows, a subset or a superset of them, and some among others are refused."""
    with expect_refusal("prior.rows-reused", DataError, count=count, total=data.n_poses) as found:
        recalibrate(hexapod(), data, FIRST.posterior, free_limb)
    assert len(found["poses"]) == count
    assert found["others"] == data.n_poses - count
    with expect_refusal("prior.rows-reused", DataError):
        identify(hexapod(), data, options=FitOptions(prior=prior_from(FIRST.posterior)))
    if count == data.n_poses:
        return
    options = FitOptions(excluded_poses=found["poses"])
    fit, _ = recalibrate(hexapod(), data, FIRST.posterior, free_limb, options=options)
    assert fit.posterior.fitted_rows is not None
    assert len(fit.posterior.fitted_rows) == 20 + data.n_poses - count


def test_a_chain_of_recalibrations_knows_the_rows_of_the_first() -> None:
    """A, then B with A as prior: the result refuses rows of both, also read from a run folder."""
    second, _ = recalibrate(hexapod(), OTHER, FIRST.posterior)
    stored = posterior_from_arrays(second.robot, second.arrays())
    third = hexapod_data(12, 7)
    for earlier in (second.posterior, stored):
        for data in (FITTED.take(np.arange(5)), OTHER.take(np.arange(5)), FITTED):
            with expect_refusal("prior.rows-reused", DataError, count=data.n_poses):
                recalibrate(hexapod(), data, earlier)
        fit, _ = recalibrate(hexapod(), third, earlier)
        assert "prior.rows-unknown" not in list_codes(fit.findings)
        assert fit.posterior.fitted_rows is not None
        assert len(fit.posterior.fitted_rows) == 52


def test_an_earlier_calibration_without_its_rows_is_reported() -> None:
    fit, _ = recalibrate(hexapod(), OTHER, replace(FIRST.posterior, fitted_rows=None))
    assert "prior.rows-unknown" in list_codes(fit.findings)
    assert fit.posterior.fitted_rows is None  # its own rows are known, those before are not


@pytest.mark.parametrize("hold_out", [0.0, 0.9])
def test_calibrate_refuses_reused_rows_also_among_held_out_ones(hold_out: float) -> None:
    data = join_measurements(FITTED.take(np.array([1])), OTHER)
    options = CalibrationOptions(prior=FIRST.posterior, hold_out=hold_out)
    with expect_refusal("prior.rows-reused", DataError, count=1, total=21, poses=("1",)):
        calibrate(hexapod(), data, options)
