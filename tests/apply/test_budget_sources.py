# SPDX-License-Identifier: Apache-2.0
"""The budget of parameters and poses: parts add up, equal a dense computation, and brute force."""

from dataclasses import replace
from functools import cache
from typing import Any, cast

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply import error_budget
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.apply.error_budget import (
    ErrorBudget,
    SourceBudget,
    compute_error_budget,
    split_covariance,
)
from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares, Ridge, TruncatedSVD
from loopcal.estimate.result import Identification
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.distance import Distance
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import StatedValue
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.workspace import sample_workspace
from tests.estimate.problems import UM, URAD, noise

PLACES = np.array([[0.03, -0.02, 0.05], [-0.04, 0.02, 0.05], [0.0, 0.05, 0.06]])
XYZ = Sensor(Component(("x", "y", "z")), noise(*[10 * UM] * 3))
ROUNDING = 1e-6
"""Relative difference of variances of directions that 30 poses determine a thousandfold better."""


@cache
def delta() -> Mechanism:
    """Return a robot with spreads whose fit is fast."""
    return lc.load_robot("linear-delta")


@cache
def tripod() -> Mechanism:
    """Return a robot with orientation."""
    return lc.load_robot("3-prs")


def find(budget: ErrorBudget, kind: str, name: str = "") -> SourceBudget:
    """Return the only source of this kind and name."""
    (line,) = [
        line for line in budget.lines if line.source.kind == kind and name in line.source.name
    ]
    return line


def budget_of(fit: Identification, data: Measurements, frame: str = "fitted") -> ErrorBudget:
    """Return the budget of a fit that has one."""
    budget = compute_error_budget(fit, data, frame)
    assert budget is not None
    return budget


def measured(robot: Mechanism, *sensors: Sensor, poses: int = 25, seed: int = 1) -> Measurements:
    """Return simulated measurements of a machine drawn from the spreads."""
    machine = robot.with_values(sample_truth(robot, 1, seed)[0])
    return simulate(
        machine, sample_workspace(robot, poses, 7).coordinates, Instrument(sensors), seed
    )


def three_targets(*unknown: str, sigma: float = 10 * UM) -> Sensor:
    """Return a tracker that measures three targets."""
    kind = Position(targets=("a", "b", "c"), places=PLACES, unknown=unknown)
    return Sensor(kind, noise(*[sigma] * 9))


def with_stated_targets(data: Measurements, sd: float) -> Measurements:
    """Return measurements that state the places of the targets with a standard deviation."""
    names = [n for n in data.nuisance_parameters.table.names if not n.startswith("frame")]
    return replace(data, stated_values=tuple(StatedValue(n, sd) for n in names))


def with_common_errors(data: Measurements, *items: str, sd: float = 25e-6) -> Measurements:
    """Return measurements whose instruments have a scale, or a bias, of this standard deviation."""
    rows = tuple(
        replace(rows, kind=replace(cast(Any, rows.kind), unknown=(*rows.kind.unknown, *items)))
        for rows in data.observations
    )
    data = replace(data, observations=rows)
    common = {
        rows.kind.nuisance_parameters[i].name for rows in rows for i in rows.kind.common_errors
    }
    return replace(data, stated_values=tuple(StatedValue(name, sd) for name in sorted(common)))


def cases() -> dict[str, tuple[Mechanism, Measurements, FitOptions]]:
    """Return fits of every kind of source and method."""
    robot, poses = tripod(), Sensor(Pose(), noise(*[50 * URAD] * 3, *[10 * UM] * 3))
    tracked = measured(robot, three_targets("frame", "targets"))
    plain = measured(robot, poses)
    lines = measured(delta(), XYZ)
    both = measured(robot, poses, three_targets("frame"))
    return {
        "MAP": (robot, plain, FitOptions(method=MAP())),
        "default": (robot, plain, FitOptions()),
        "unknown setup": (robot, tracked, FitOptions(method=MAP())),
        "stated setup": (robot, with_stated_targets(tracked, 20 * UM), FitOptions(method=MAP())),
        "least squares": (robot, plain, FitOptions(method=LeastSquares())),
        "least squares, unknown": (robot, tracked, FitOptions(method=LeastSquares())),
        "ridge": (robot, plain, FitOptions(method=Ridge(3.0))),
        "truncated": (robot, plain, FitOptions(method=TruncatedSVD(8))),
        "estimated noise": (robot, plain, FitOptions(noise="estimated")),
        "estimated, least squares": (
            robot,
            tracked,
            FitOptions(noise="estimated", method=LeastSquares()),
        ),
        "two instruments": (robot, both, FitOptions(method=MAP())),
        "uncertain readings": (
            robot,
            replace(both, reading_sigma=np.full(both.readings.shape, 4 * UM)),
            FitOptions(method=MAP()),
        ),
        "readings and setup": (
            robot,
            replace(tracked, reading_sigma=np.full(tracked.readings.shape, 4 * UM)),
            FitOptions(),
        ),
        "scale": (robot, with_common_errors(plain, "scale"), FitOptions(method=MAP())),
        "scale and bias of a tracker": (
            robot,
            with_common_errors(tracked, "scale", "bias"),
            FitOptions(method=MAP()),
        ),
        "delta": (delta(), lines, FitOptions()),
        "excluded": (delta(), lines, FitOptions(excluded_poses=("2", "5"))),
    }


CASES = cases()


@pytest.mark.parametrize("name", CASES)
def test_parts_of_parameters_and_poses_add_up_and_none_is_negative(name):
    robot, data, options = CASES[name]
    fit = identify(robot, data, options=options)
    budget = budget_of(fit, data)
    determined = np.isfinite(fit.standard_deviations)
    parts = np.array([line.parameters[determined] for line in budget.lines])
    assert (parts >= 0.0).all()
    total = np.diag(fit.covariance)[determined]
    assert np.allclose(parts.sum(axis=0), total, rtol=ROUNDING, atol=0.0)
    assert np.array_equal(np.isinf(budget.sd), ~determined)
    for length, sources in (("position", budget.position), ("orientation", budget.orientation)):
        variances = [getattr(line, length) for line in budget.lines]
        assert min(variances) >= 0.0
        assert sum(variances) == pytest.approx(sum(sources), rel=1e-12)
    if np.isfinite(fit.posterior.variance).all():
        solution = sample_workspace(fit.robot, 200, 0).solution
        u = pose_uncertainty(fit, solution)
        assert budget.position.rms == pytest.approx(np.sqrt((u.position**2).mean()), rel=ROUNDING)


def test_parts_equal_a_dense_propagation_of_the_noise_of_each_instrument():
    """Independent: rows of every instrument by NumPy, with known setup and exact readings."""
    robot = tripod()
    data = measured(robot, Sensor(Pose(), noise(*[50 * URAD] * 3, *[10 * UM] * 3)), three_targets())
    fit = identify(robot, data, MAP())
    free = fit.free_parameters
    solution = lc.forward(fit.robot, data.readings)
    D = (
        differentiate_pose(
            fit.robot, fit.robot.values[None], data.readings[None], solution.state
        ).parameters[0][:, :, free.places]
        * free.tolerance
    )
    rows = []
    for o in data.observations:
        G = o.kind.evaluate(solution.T[None, o.rows], o.measured[None], None, None).jacobian[0]
        rows.append((o.whitener @ G @ D[o.rows]).reshape(-1, len(free)))
    A = np.concatenate(rows)
    gain = np.linalg.inv(A.T @ A + np.eye(len(free)))
    budget = budget_of(fit, data)
    for kind, own in zip(("pose", "position"), rows, strict=True):
        expected = np.diag(gain @ own.T @ own @ gain) * free.tolerance**2
        assert np.allclose(find(budget, "instrument", kind).parameters, expected, rtol=1e-7)
    expected = np.diag(gain @ gain) * free.tolerance**2
    assert np.allclose(find(budget, "tolerances").parameters, expected, rtol=1e-7)
    # half the sigma of one instrument: four times its weight
    weighted = np.concatenate([2.0 * rows[0], rows[1]])
    halved = np.diag(np.linalg.inv(weighted.T @ weighted + np.eye(len(free)))) * free.tolerance**2
    line = find(budget, "instrument", "pose")
    assert line.halved is not None
    assert np.allclose(line.halved.parameters**2, halved, rtol=1e-7)
    prior = np.diag(np.linalg.inv(A.T @ A + 4.0 * np.eye(len(free)))) * free.tolerance**2
    tolerances = find(budget, "tolerances").halved
    assert tolerances is not None
    assert np.allclose(tolerances.parameters**2, prior, rtol=1e-7)


def test_known_setup_is_what_remains_without_the_part_of_the_setup():
    robot = tripod()
    unknown = measured(robot, three_targets("frame", "targets"))
    (rows,) = unknown.observations
    known = replace(unknown, observations=(replace(rows, kind=replace(rows.kind, unknown=())),))
    fit = identify(robot, unknown, MAP())
    at_estimate = identify(robot, known, MAP(), options=FitOptions(start=fit.robot.values))
    rest = split_covariance(linearize_fit(fit, unknown))
    without = sum(
        (root**2).sum(axis=1)
        for source, root in zip(rest.sources, rest.roots, strict=True)
        if source.kind != "setup"
    )
    assert np.allclose(np.sqrt(without), at_estimate.standard_deviations, rtol=2e-3)


def test_order_of_the_instruments_does_not_matter():
    robot, data, options = CASES["two instruments"]
    turned = replace(data, observations=data.observations[::-1])
    first, second = (budget_of(identify(robot, d, options=options), d) for d in (data, turned))
    for kind in ("pose", "position"):
        a, b = (find(budget, "instrument", kind) for budget in (first, second))
        assert a.position == pytest.approx(b.position, rel=1e-6)
        assert np.allclose(a.parameters, b.parameters, rtol=1e-6)


def test_sessions_are_sources_of_their_own():
    data = measured(delta(), XYZ)
    (rows,) = data.observations
    session = np.where(np.arange(len(rows)) < 10, "monday", "tuesday")
    data = replace(data, observations=(replace(rows, session=session),))
    budget = budget_of(identify(delta(), data), data)
    parts = [find(budget, "instrument", day).position for day in ("monday", "tuesday")]
    assert min(parts) > 0.0
    whole = budget_of(identify(delta(), measured(delta(), XYZ)), measured(delta(), XYZ))
    assert sum(parts) == pytest.approx(find(whole, "instrument").position, rel=1e-9)


def test_common_errors_have_lines_of_their_own_and_move_no_error_into_the_setup():
    robot, data, options = CASES["scale and bias of a tracker"]
    budget = budget_of(identify(robot, data, options=options), data)
    named = [line for line in budget.lines if line.source.kind == "common"]
    assert [line.source.name for line in named] == ["position.bias", "position.scale"]
    assert [line.source.words for line in named][1] == "common error: position.scale"
    assert all(line.source.evaluation == "B" for line in named)
    assert budget.position.common == pytest.approx(sum(line.position for line in named))
    wider = with_common_errors(data, sd=50e-6)
    other = budget_of(identify(robot, wider, options=options), wider)
    assert find(other, "common", "scale").position > 2.0 * find(budget, "common", "scale").position
    assert find(other, "setup").position == pytest.approx(find(budget, "setup").position, rel=0.05)
    plain, known, fit_options = CASES["MAP"]
    none = budget_of(identify(plain, known, options=fit_options), known)
    assert none.position.common == 0.0
    alone = budget_of(identify(*CASES["scale"][:2], options=CASES["scale"][2]), CASES["scale"][1])
    assert {line.source.kind for line in alone.lines} >= {"common", "instrument", "tolerances"}
    assert "setup" not in {line.source.kind for line in alone.lines}


@pytest.mark.parametrize("source", ["instrument", "readings", "setup"])
def test_half_a_sigma_is_a_new_fit_with_half_the_sigma(source):
    """The same noise, half as large where it is that of the instrument, with the sigma stated."""
    robot = tripod()
    data = with_stated_targets(measured(robot, three_targets("targets")), 20 * UM)
    data = replace(data, reading_sigma=np.full(data.readings.shape, 4 * UM))
    exact = FitOptions(method=MAP(), sigma_uncertainty=0.0)  # one scale of the noise for both fits
    fit = identify(robot, data, options=exact)
    halved = find(budget_of(fit, data), source).halved
    assert halved is not None
    other = data
    if source == "instrument":
        finer = with_stated_targets(
            measured(robot, three_targets("targets", sigma=5 * UM)), 20 * UM
        )
        other = replace(finer, reading_sigma=data.reading_sigma)
    elif source == "readings":
        assert data.reading_sigma is not None
        other = replace(data, reading_sigma=0.5 * data.reading_sigma)
    else:
        other = with_stated_targets(data, 10 * UM)
    again = budget_of(identify(robot, other, options=exact), other)
    assert halved.position == pytest.approx(again.position.rms, rel=5e-3)
    assert halved.orientation == pytest.approx(again.orientation.rms, rel=5e-3)
    assert np.allclose(halved.parameters, again.sd, rtol=5e-3)


def test_half_the_sigma_of_a_common_error_is_a_new_fit_with_half_of_it():
    robot, data, _ = CASES["scale"]
    exact = FitOptions(method=MAP(), sigma_uncertainty=0.0)
    halved = find(budget_of(identify(robot, data, options=exact), data), "common").halved
    assert halved is not None
    finer = with_common_errors(data, sd=12.5e-6)
    again = budget_of(identify(robot, finer, options=exact), finer)
    assert halved.position == pytest.approx(again.position.rms, rel=5e-3)
    assert np.allclose(halved.parameters, again.sd, rtol=5e-3)


def test_fits_with_one_source_switched_off_lack_its_part():
    """Brute force: 300 machines of a linear model of the machine, measured by two instruments, one
    of which measures without noise, fitted as if both had theirs.
    """
    robot = delta()
    coordinates = sample_workspace(robot, 15, 7).coordinates
    first = Sensor(Component(("x", "y", "z")), noise(*[10 * UM] * 3))
    second = Sensor(Distance(), noise(6 * UM))
    silent = Sensor(Component(("x", "y", "z")), noise(*[1e-9] * 3))
    truth = sample_truth(robot, 300, 5)
    from loopcal.estimate.identification import identify_trials
    from loopcal.measure.simulation import simulate_trials

    trials = simulate_trials(robot, truth, coordinates, Instrument((first, second)), 5)
    quiet = simulate_trials(robot, truth, coordinates, Instrument((silent, second)), 5)
    exact = FitOptions(method=MAP(), sigma_uncertainty=0.0)
    budget = budget_of(identify(robot, trials.trial(0), options=exact), trials.trial(0))
    part = find(budget, "instrument", "component").parameters
    variances = []
    for t in (trials, replace(trials, measured=quiet.measured)):
        fits = identify_trials(robot, t, MAP())
        assert fits.converged.all()
        variances.append(((fits.values - truth)[:, robot.parameters.free] ** 2).mean(axis=0))
    drop = variances[0] - variances[1]
    # scatter of a mean square of 300 machines, for the parameters that the noise decides
    scatter = np.sqrt(2.0 / 300.0) * np.sqrt(variances[0] ** 2 + variances[1] ** 2)
    assert (np.abs(drop - part) < 4.0 * scatter).all()
    assert np.sum(drop / variances[0]) == pytest.approx(np.sum(part / variances[0]), rel=0.15)


def test_types_and_degrees_of_freedom_follow_the_guide():
    robot, data, _ = CASES["MAP"]
    stated = budget_of(identify(robot, data, MAP()), data)
    assert find(stated, "tolerances").source.evaluation == "B"
    assert find(stated, "instrument").source.evaluation in ("B", "A and B")
    fit = identify(robot, data, LeastSquares(), options=FitOptions(noise="estimated"))
    source = find(budget_of(fit, data), "instrument").source
    assert source.evaluation == "A"
    assert source.degrees == pytest.approx(fit.residual_test.dof)
    robot, data, options = CASES["stated setup"]
    rows = tuple(replace(o, covariance=4.0 * o.covariance) for o in data.observations)
    rough = replace(data, observations=rows)
    budget = budget_of(identify(robot, rough, options=options), rough)
    assert find(budget, "noise.setup-as-stated").source.evaluation == "B"
    assert "other errors" not in str(budget.finding)  # residuals show nothing of what was stated


def test_a_discrepancy_is_a_source_of_type_a():
    robot = tripod()
    data = measured(robot, Sensor(Pose(), noise(*[50 * URAD] * 3, *[5 * UM] * 3)), poses=30)
    (rows,) = data.observations
    place = sample_workspace(robot, 30, 7).solution.T[:, :3, 3]
    place = place / np.abs(place - place.mean(axis=0)).max()
    wave = 60 * UM * np.sin(np.pi * (place - place.mean(axis=0)) @ np.array([0.6, 0.6, 0.5]))
    moved = rows.measured.copy()
    moved[:, 3:] += wave[:, None]
    data = replace(data, observations=(replace(rows, measured=moved),))
    fit = adjust_uncertainty(identify(robot, data), data)
    assert fit.posterior.discrepancy is not None
    budget = budget_of(fit, data)
    line = find(budget, "residuals.model-discrepancy", "position")
    assert line.source.evaluation == "A"
    assert 1.0 < line.source.degrees < 100.0
    parts = [each.position for each in budget.lines if each.source.kind == line.source.kind]
    assert budget.position.discrepancy == pytest.approx(sum(parts))
    assert min(parts) > 0.0
    assert line.halved is not None
    expected = np.sqrt(budget.position.rms**2 - 0.75 * line.position)
    assert line.halved.position == pytest.approx(expected, rel=1e-12)
    solution = sample_workspace(fit.robot, 200, 0).solution
    u = pose_uncertainty(fit, solution)
    assert budget.position.rms == pytest.approx(np.sqrt((u.position**2).mean()), rel=1e-6)
    parts = np.array([each.parameters for each in budget.lines]).sum(axis=0)
    assert np.allclose(np.sqrt(parts), fit.standard_deviations, rtol=1e-6)
    assert "model discrepancy" in str(budget)


@pytest.mark.parametrize("frame", ["base", "relative", "frame"])
def test_other_frames_have_the_same_gain_as_a_new_fit(frame):
    robot = tripod()
    data = measured(robot, three_targets("frame"))
    exact = FitOptions(method=MAP(), sigma_uncertainty=0.0)
    fit = identify(robot, data, options=exact)
    halved = find(budget_of(fit, data, frame), "instrument").halved
    assert halved is not None
    other = measured(robot, three_targets("frame", sigma=5 * UM))
    again = budget_of(identify(robot, other, options=exact), other, frame)
    assert halved.position == pytest.approx(again.position.rms, rel=5e-3)
    assert halved.orientation == pytest.approx(again.orientation.rms, rel=5e-3)


def test_an_earlier_calibration_is_a_source():
    robot = delta()
    first, second = measured(robot, XYZ), measured(robot, XYZ, poses=12, seed=2)
    fit, _ = lc.recalibrate(robot, second, identify(robot, first).posterior)
    budget = budget_of(fit, second)
    assert find(budget, "earlier calibration").position > 0.0
    parts = np.array([line.parameters for line in budget.lines]).sum(axis=0)
    finite = np.isfinite(fit.standard_deviations)
    assert np.allclose(np.sqrt(parts)[finite], fit.standard_deviations[finite], rtol=1e-6)


def test_json_lists_sources_with_the_variance_of_every_parameter():
    robot, data, options = CASES["readings and setup"]
    report = lc.calibrate(robot, data, lc.CalibrationOptions(options))
    content = report.to_dict()["expected_error"]
    kinds = [line["kind"] for line in content["sources"]]
    assert {"instrument", "readings", "setup", "tolerances"} <= set(kinds)
    total = sum(line["parameters"][content["worst_parameter"]] for line in content["sources"])
    assert np.sqrt(total) == pytest.approx(content["parameters"][content["worst_parameter"]])
    assert content["frame"] == "fitted"
    halved = [line["halved"] for line in content["sources"] if line["kind"] == "instrument"]
    assert halved[0]["position_rms"] < content["position"]["rms"]


def test_sources_of_all_sessions_add_up_and_no_decomposition_grows_with_the_sessions(monkeypatch):
    """Frames and targets of every session: the largest decomposition is one of a session."""
    sizes: list[int] = []

    def record(decompose):
        return lambda a, *rest, **how: (
            sizes.append(min(a.shape[-2:])),
            decompose(a, *rest, **how),
        )[1]

    robot, n = lc.load_robot("hexapod-42"), 48
    kind = Position(targets=("a", "b", "c"), places=PLACES, unknown=("frame", "targets"))
    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
    poses = sample_workspace(robot, n, 1).coordinates
    for sessions in (4, 8):
        day = np.array([f"day {i * sessions // n}" for i in range(n)])
        sensor = Sensor(kind, noise(*[10 * UM] * 9), session=day)
        data = simulate(truth, poses, Instrument((sensor,)), 1)
        linear = linearize_fit(identify(robot, data), data)
        with monkeypatch.context() as patch:
            patch.setattr(np.linalg, "svd", record(np.linalg.svd))
            patch.setattr(np.linalg, "qr", record(np.linalg.qr))
            split = split_covariance(linear)
        of_rows = ("instrument", "setup", "tolerances")
        roots = [r for s, r in zip(split.sources, split.roots, strict=True) if s.kind in of_rows]
        along = linear.decomposition.directions[0][:, linear.is_estimated].T
        parts = [along @ (root / linear.fit.tolerance[:, None]) for root in roots]
        variance = np.diag(linear.variance[linear.is_estimated])
        assert np.allclose(sum(x @ x.T for x in parts), variance, rtol=0.0, atol=1e-9)
    assert max(sizes) == len(robot.parameters.names)


def test_half_the_sigma_of_a_session_alone_is_that_of_all_rows_with_this_sigma(monkeypatch):
    """The factor with the rows of the session added equals that of a problem with other weights."""
    robot, n = lc.load_robot("hexapod-42"), 24
    kind = Position(targets=("a", "b", "c"), places=PLACES, unknown=("frame", "targets"))
    truth = robot.with_values(sample_truth(robot, 1, 0)[0])
    day = np.array([f"day {i // 8}" for i in range(n)])
    sensor = Sensor(kind, noise(*[10 * UM] * 9), session=day)
    poses = sample_workspace(robot, n, 1).coordinates
    data = simulate(truth, poses, Instrument((sensor,)), 1)
    fit = identify(robot, data)
    short = budget_of(fit, data)
    monkeypatch.setattr(error_budget, "_find_rows_alone", lambda *_: None)
    whole = budget_of(fit, data)
    for a, b in zip(short.lines, whole.lines, strict=True):
        if a.halved is not None and b.halved is not None:
            assert a.halved.position == pytest.approx(b.halved.position, rel=1e-9)
            assert a.halved.orientation == pytest.approx(b.halved.orientation, rel=1e-9)
            assert np.allclose(a.halved.parameters, b.halved.parameters, rtol=1e-9)
