# SPDX-License-Identifier: Apache-2.0
"""Slow errors of the poses that no geometry explains: found, stated, and contained in U."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

import loopcal as lc
from loopcal import geometry
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
from loopcal.diagnose.blunders import Predictor
from loopcal.diagnose.error_frames import locate_measured_poses
from loopcal.diagnose.model_discrepancy import (
    KERNELS,
    LEVEL,
    SlowErrorRows,
    add_slow_errors,
    detect_slow_errors,
    find_slow_errors,
)
from loopcal.estimate.fit_linearization import collect_uncertainty, linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.posterior import DISCREPANCY
from loopcal.estimate.residual_test import FALSE_ALARMS
from loopcal.estimate.result import Identification
from loopcal.estimate.smooth_errors import describe_smooth_errors
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.statistics import compute_component_tail
from tests.estimate.problems import UM, URAD

SIGMA = 10 * UM


@cache
def delta() -> Mechanism:
    """Return a robot whose fit is fast, with stated spreads and workspace."""
    return lc.load_robot("linear-delta")


def measure(robot: Mechanism, poses: int = 30, seed: int = 1, scale: float = 1.0) -> Measurements:
    """Return measurements of a machine whose noise is `scale` times the stated one."""
    machine = robot.with_values(sample_truth(robot, 1, seed)[0])
    kind = Component(("x", "y", "z")) if robot.name == "linear-delta" else Pose()
    sigma = np.full(3, SIGMA)
    if isinstance(kind, Pose):
        sigma = np.r_[np.full(3, 50 * URAD), sigma]
    coordinates = sample_workspace(robot, poses, 7).coordinates
    stated, true = (
        simulate(machine, coordinates, Instrument((Sensor(kind, Gaussian(s * sigma)),)), seed)
        for s in (1.0, scale)
    )
    (rows,), (noisy,) = stated.observations, true.observations
    return replace(stated, observations=(replace(rows, measured=noisy.measured),))


def bend(points: np.ndarray, reference: np.ndarray, amplitude: float, seed: int) -> np.ndarray:
    """Return slow displacements (n, 3): one wave over the diameter of the reference points."""
    rng = np.random.default_rng(seed)
    center = reference.mean(axis=0)
    radius = np.sqrt(((reference - center) ** 2).sum(axis=1).max())
    directions = rng.normal(size=(3, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    return amplitude * np.sin(np.pi * (points - center) @ directions.T / radius + phase)


def displaced(data: Measurements, by: np.ndarray) -> Measurements:
    """Return measurements whose measured places x, y, z are displaced by (n, 3)."""
    (rows,) = data.observations
    columns = [c.name for c in rows.kind.columns]
    measured = rows.measured.copy()
    measured[:, [columns.index(name) for name in "xyz"]] += by
    return replace(data, observations=(replace(rows, measured=measured),))


def find(fit: Identification) -> list:
    """Return the findings of a discrepancy."""
    return [f for f in fit.findings if f.code == DISCREPANCY]


def places(robot: Mechanism, readings: np.ndarray) -> np.ndarray:
    """Return places of the tool (n, 3)."""
    return (forward(robot, readings).T @ robot.tool)[:, :3, 3]


def study(amplitude: float, machines: int) -> tuple[float, float, float]:
    """Return the coverage of U at held-out poses before and after, and the share of machines with a
    discrepancy.
    """
    robot, before, after, count = delta(), [], [], 0
    held_out = sample_workspace(robot, 30, 8).solution.q
    for seed in range(machines):
        machine = robot.with_values(sample_truth(robot, 1, seed)[0])
        data = measure(robot, 30, seed)
        at, elsewhere = places(machine, data.readings), places(machine, held_out)
        data = displaced(data, bend(at, at, amplitude, seed))
        fit = identify(robot, data)
        adjusted = adjust_uncertainty(fit, data)
        count += bool(find(adjusted))
        true = elsewhere + bend(elsewhere, at, amplitude, seed)
        error = np.abs(places(fit.robot, held_out) - true)
        for each, inside in ((fit, before), (adjusted, after)):
            u = pose_uncertainty(each, forward(fit.robot, held_out), frame="base")
            inside.append((error <= u.expanded[:, 3:]).mean())
    return float(np.mean(before)), float(np.mean(after)), count / machines


def test_slow_errors_are_found_and_the_uncertainty_of_poses_contains_them():
    before, after, share = study(15 * UM, 8)
    assert before < 0.80
    assert after > 0.93
    assert share > 0.8


def test_clean_data_have_no_discrepancy_at_the_stated_level():
    _, coverage, share = study(0.0, 10)
    assert share <= LEVEL + 3.0 * np.sqrt(LEVEL * (1.0 - LEVEL) / 10)
    assert coverage > 0.93


def touch_bed(seed: int, points: int = 13, sigma: float = 20 * UM) -> Measurements:
    """Return readings where the nozzle touches the bed at z = 0, up to the noise."""
    rng = np.random.default_rng(seed)
    machine = delta().with_values(sample_truth(delta(), 1, seed)[0])
    turn = 2.4 * np.arange(points)  # golden angle
    radius = 0.07 * np.sqrt(np.arange(points) / points)
    z = sigma * rng.standard_normal(points)
    q = inverse(machine, np.c_[radius * np.cos(turn), radius * np.sin(turn), z]).q
    instrument = Instrument((Sensor(Component(("z",)), Gaussian(np.array([sigma]))),))
    data = simulate(machine, np.zeros((points, 3)), instrument, seed)
    (rows,) = data.observations
    touched = replace(rows, measured=np.zeros_like(rows.measured))
    return replace(data, readings=q, observations=(touched,))


def touch_uneven_bed(seed: int, points: int = 140) -> Measurements:
    """Return a dense map of heights of a bed whose bumps of 40 um are 20 mm wide, noise 10 um."""
    data = touch_bed(seed, points, 10 * UM)
    at = places(delta(), data.readings)
    rng = np.random.default_rng(seed)
    square = ((at[:, None, :2] - at[:, :2]) ** 2).sum(axis=2)
    covariance = (40 * UM) ** 2 * np.exp(-0.5 * square / 20e-3**2)
    bumps = rng.multivariate_normal(np.zeros(points), covariance)
    (rows,) = data.observations
    return replace(data, observations=(replace(rows, measured=bumps[:, None]),))


def misstate_proportion(seed: int) -> Measurements:
    """Return positions 1.6 times as noisy as stated, and orientations as stated."""
    data, noisy = (measure(lc.load_robot("3-prs"), 18, seed, scale) for scale in (1.0, 1.6))
    (rows,), (other,) = data.observations, noisy.observations
    measured = np.concatenate([rows.measured[:, :3], other.measured[:, 3:]], axis=1)
    return replace(data, observations=(replace(rows, measured=measured),))


def repeat_poses(seed: int, size: float = 0.0) -> Measurements:
    """Return twelve poses, three times each, whose own errors of a size [m] repeat."""
    robot = delta()
    coordinates = np.repeat(sample_workspace(robot, 12, 7).coordinates, 3, axis=0)
    sensor = Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, SIGMA)))
    machine = robot.with_values(sample_truth(robot, 1, seed)[0])
    data = simulate(machine, coordinates, Instrument((sensor,)), seed)
    own = np.random.default_rng(seed).standard_normal((12, 3))
    return displaced(data, np.repeat(size * own, 3, axis=0))


CLEAN = {
    "a wrong sigma": (lambda seed: measure(delta(), 30, seed, 2.0), 16, 16),
    # the z of the fitted poses is their residual; a function of it would explain all of them
    "heights of a bed": (touch_bed, 16, 16),
    "a wrong proportion of the sigmas": (misstate_proportion, 6, 12),
    "repeats of a model that fits": (repeat_poses, 8, 16),
}


@pytest.mark.parametrize("case", CLEAN)
@pytest.mark.parametrize("size", ["few", pytest.param("all", marks=pytest.mark.evidence)])
def test_data_without_slow_errors_have_no_discrepancy(case, size):
    make, *machines = CLEAN[case]
    count = machines[size == "all"]
    found = 0
    for seed in range(count):
        data = make(seed)
        fit = identify(lc.load_robot(data.robot_name), data)
        found += bool(find(adjust_uncertainty(fit, data)))
    assert found <= binom.isf(1e-3, count, LEVEL)


def test_clean_heights_are_hardly_ever_widened():
    """All tests together: readings that contain the noise of the probe look like no effect."""
    sets, widened = 40, 0
    for seed in range(sets):
        data = touch_bed(200 + seed, 30)
        fit = identify(delta(), data)
        ratio = adjust_uncertainty(fit, data).standard_deviations / fit.standard_deviations
        widened += bool(ratio.max() > 1.03)
    assert widened <= binom.isf(1e-3, sets, sum(FALSE_ALARMS.values()))


def test_errors_seen_in_heights_alone_are_not_given_to_x_and_y():
    data = touch_uneven_bed(3)
    fit = identify(delta(), data)
    adjusted = adjust_uncertainty(fit, data)
    (finding,) = find(adjusted)
    assert finding.data["axes"] == ("z",)
    own = adjusted.posterior.discrepancy
    assert own is not None
    assert np.flatnonzero(own.errors.amplitude.any(axis=1)).tolist() == [5]


def test_the_amplitude_of_a_dense_map_is_stable_when_a_quarter_of_the_points_is_left_out():
    data = touch_uneven_bed(4)
    rng = np.random.default_rng(5)
    subsets = [data.take(np.sort(rng.permutation(140)[:105])) for _ in range(4)]
    amplitudes = []
    for each in (data, *subsets):
        (finding,) = find(adjust_uncertainty(identify(delta(), each), each))
        amplitudes.append(1e-3 * finding.data["amplitude"].value)
    assert max(amplitudes) < 1.5 * min(amplitudes)
    assert 25 * UM < amplitudes[0] < 60 * UM  # 40 um; the parameters and 140 points leave 20 %


def test_an_error_in_one_direction_widens_the_others_less():
    robot, ratios = delta(), []
    for seed in range(6):
        data = measure(robot, 30, seed)
        at = places(robot, data.readings)
        data = displaced(data, bend(at, at, 40 * UM, seed) * [1.0, 0.0, 0.0])
        fit = identify(robot, data)
        poses = forward(fit.robot, data.readings)
        adjusted = adjust_uncertainty(fit, data)
        before, after = (pose_uncertainty(f, poses, frame="base").sd for f in (fit, adjusted))
        ratios.append((after[:, 3:] / before[:, 3:]).mean(axis=0))
        if findings := find(adjusted):
            assert findings[0].data["axes"][0] == "x"
    x, y, z = np.mean(ratios, axis=0)
    assert x > 1.5 * max(y, z)


def test_probabilities_agree_with_all_eigenvectors_of_the_variances():
    rng = np.random.default_rng(3)
    T = np.tile(np.eye(4), (6, 1, 1))
    T[:, :3, 3] = rng.standard_normal((6, 3))
    errors = describe_smooth_errors(T, np.zeros(3), 1.0)
    half = errors.count // 2
    rows = np.triu(rng.standard_normal((2 * half, 2 * half)))
    y = 5.0 * rng.standard_normal(2 * half)
    groups = list(np.split(np.eye(6), 2, axis=1))
    found = detect_slow_errors(
        SlowErrorRows(errors, rows, rows, y, np.ones(6)), groups, known=0.0, level=1.0
    )
    variance = np.eye(2 * half)
    for error in found:
        part = int(error.directions[3:].any())
        own = rows[:, part * half : (part + 1) * half]
        root = np.linalg.inv(np.linalg.cholesky(variance))
        weights, axes = np.linalg.eigh(root @ own @ own.T @ root.T)
        kept = weights > 1e-12 * weights[-1]
        by_all = compute_component_tail(weights[kept], axes[:, kept].T @ root @ y)
        assert error.p_value == pytest.approx(by_all, rel=1e-9)
        variance += error.size.ratio * own @ own.T
    assert len(found) == 2


def test_linearized_poses_are_those_of_the_forward_kinematics():
    data = measure(delta())
    fit = identify(delta(), data)
    linearized = linearize_fit(fit, data).solution.linearized
    assert linearized is not None
    assert linearized.is_reached.all()
    located = locate_measured_poses(fit, data).T
    # [m] and entries of rotations, double rounding
    np.testing.assert_allclose(linearized.T[0], located, rtol=0.0, atol=1e-13)


def add_model_discrepancy(fit: Identification, data: Measurements) -> Identification:
    """Return a fit whose uncertainty includes the slow errors that its residuals show."""
    measured = locate_measured_poses(fit, data)
    slow = find_slow_errors(linearize_fit(fit, data), measured.T)
    return fit if slow is None else add_slow_errors(fit, slow)


@cache
def bent_fit(name: str = "3-prs") -> tuple[Identification, Identification, Measurements]:
    """Return a fit of a machine with slow errors before and after, and its data."""
    robot = lc.load_robot(name)
    data = measure(robot)
    at = places(robot, data.readings)
    data = displaced(data, bend(at, at, 40 * UM, 3))
    fit = identify(robot, data, MAP())
    return fit, add_model_discrepancy(fit, data), data


def test_covariance_of_poses_is_that_of_a_dense_gaussian_process():
    """Independent computation: kernels between all poses, without any decomposition."""
    fit, adjusted, data = bent_fit()
    assert adjusted.posterior.discrepancy is not None
    amplitude = adjusted.posterior.discrepancy.errors.amplitude
    robot, free = fit.robot, fit.free_parameters
    other = sample_workspace(robot, 12, 5).solution
    T = np.concatenate([forward(robot, data.readings).T, other.T])
    q = np.concatenate([data.readings, other.q])
    n = len(data.readings)
    state = forward(robot, q).state
    D = differentiate_pose(robot, robot.values[None], q[None], state).parameters[0]
    D = D[:, :, free.places] * free.tolerance
    mean = np.linalg.svd(T[:n, :3, :3].mean(axis=0))
    rotation = geometry.log_so3(T[:, :3, :3] @ (mean[0] @ mean[2]).T)
    place = (T @ robot.tool)[:, :3, 3]
    x = np.column_stack([rotation, place])
    half = 0.5 * (x[:n].max(axis=0) - x[:n].min(axis=0))
    length = adjusted.posterior.discrepancy.errors.length
    multiple = length[np.isfinite(length)] / half[np.isfinite(length)]
    assert any(np.allclose(multiple, length) for length, _ in KERNELS)
    x = x / length
    kernel = np.exp(-0.5 * ((x[:, None] - x) ** 2).sum(axis=2))
    arm = T[:, :3, :3] @ robot.tool[:3, 3]
    back = geometry.transport_matrix(-arm)
    # covariance (6 N, 6 N) of the slow twists of the platform's origin
    by_axes = amplitude @ amplitude.T
    slow = np.einsum("nac,nm,cd,mbd->namb", back, kernel, by_axes, back).reshape(6 * len(T), -1)
    (rows,) = data.observations
    W = rows.whitener
    G = rows.kind.evaluate(T[None, :n], rows.measured[None], None, None).jacobian[0]
    A = (W @ G @ D[:n]).reshape(-1, len(free))
    WG = np.zeros((len(A), 6 * n))
    for i in range(n):
        m = W.shape[1]
        WG[m * i : m * (i + 1), 6 * i : 6 * i + 6] = W[i] @ G[i]
    gain = np.linalg.solve(A.T @ A + np.eye(len(free)), A.T)
    move = D[n:].reshape(-1, len(free)) @ gain @ WG
    own, cross = slow[6 * n :, 6 * n :], slow[6 * n :, : 6 * n]
    added = own - move @ cross.T - cross @ move.T + move @ slow[: 6 * n, : 6 * n] @ move.T
    H = geometry.transport_matrix(arm[n:])
    before, after = (pose_uncertainty(f, other, frame="base").covariance for f in (fit, adjusted))
    blocks = np.stack([added[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(12)])
    expected = H @ blocks @ H.swapaxes(1, 2)
    scale = np.sqrt(np.einsum("nii,njj->nij", after, after))
    assert np.abs((after - before - expected) / scale).max() < 1e-5
    # the parameters: gain times the slow errors of the measured poses
    root = gain @ WG
    by_errors = root @ slow[: 6 * n, : 6 * n] @ root.T * np.outer(free.tolerance, free.tolerance)
    size = np.sqrt(np.diag(adjusted.covariance))
    widened = (adjusted.covariance - fit.covariance - by_errors) / np.outer(size, size)
    assert np.abs(widened).max() < 1e-5


def test_the_estimate_stays_and_no_variance_becomes_smaller():
    fit, adjusted, _ = bent_fit()
    assert np.array_equal(fit.estimate, adjusted.estimate)
    assert (adjusted.standard_deviations >= fit.standard_deviations * (1.0 - 1e-12)).all()
    poses = sample_workspace(fit.robot, 50, 4).solution
    before, after = (pose_uncertainty(f, poses, frame="base").sd for f in (fit, adjusted))
    assert (after >= before * (1.0 - 1e-9)).all()


def test_the_finding_states_size_degrees_of_freedom_and_level():
    _, adjusted, _ = bent_fit()
    (finding,) = find(adjusted)
    assert finding.data["quantity"] == "position"
    assert 10 < 1e3 * finding.data["amplitude"].value < 80  # [um], wave of 40 um
    assert 3.0 < finding.data["degrees"] < 100.0
    assert finding.data["p_value"] < LEVEL
    part = adjusted.posterior.parts[-1]
    assert (part.source, part.degrees) == (DISCREPANCY, finding.data["degrees"])


def test_the_order_of_the_poses_does_not_matter():
    _, adjusted, data = bent_fit()
    turned = data.take(np.random.default_rng(0).permutation(data.n_poses))
    again = add_model_discrepancy(identify(adjusted.initial, turned, MAP()), turned)
    poses = sample_workspace(adjusted.robot, 20, 4).solution
    first, second = (pose_uncertainty(f, poses, frame="base").sd for f in (adjusted, again))
    assert np.allclose(first, second, rtol=1e-5)


def test_slow_rotations_are_stated_as_orientation():
    robot = lc.load_robot("3-prs")
    data = measure(robot)
    at = places(robot, data.readings)
    (rows,) = data.observations
    measured = rows.measured.copy()
    measured[:, :3] += bend(at, at, 300 * URAD, 3)  # rotation vectors of small rotations
    data = replace(data, observations=(replace(rows, measured=measured),))
    found = find(adjust_uncertainty(identify(robot, data), data))
    assert "orientation" in [f.data["quantity"] for f in found]


def test_a_run_folder_keeps_the_discrepancy(tmp_path):
    from loopcal.estimate.posterior import posterior_from_arrays

    _, adjusted, _ = bent_fit()
    arrays: dict[str, Any] = {**adjusted.arrays()}
    np.savez(tmp_path / "arrays.npz", **arrays)
    with np.load(tmp_path / "arrays.npz") as stored:
        read = posterior_from_arrays(adjusted.robot, dict(stored))
    poses = sample_workspace(adjusted.robot, 20, 4).solution
    for frame in ("fitted", "relative"):
        first, second = (pose_uncertainty(f, poses, frame=frame) for f in (adjusted, read))
        assert np.array_equal(first.covariance, second.covariance)


@pytest.mark.parametrize("frame", ["fitted", "base", "relative", "frame"])
def test_errors_that_a_frame_takes_up_do_not_count_in_it(frame):
    """The unknown frame of the instrument takes the mean of slow errors, and the best fit, too."""
    robot = lc.load_robot("3-prs")
    target = np.array([[0.03, 0.0, 0.05], [-0.03, 0.02, 0.05], [0.0, -0.03, 0.06]])
    kind = Position(targets=("a", "b", "c"), places=target, unknown=("frame",))
    sensor = Sensor(kind, Gaussian(np.full(9, SIGMA)))
    data = simulate(robot, sample_workspace(robot, 30, 7).coordinates, Instrument((sensor,)), 1)
    (rows,) = data.observations
    at = places(robot, data.readings)
    moved = rows.measured + np.tile(bend(at, at, 60 * UM, 3), 3)
    data = replace(data, observations=(replace(rows, measured=moved),))
    fit = identify(robot, data)
    adjusted = adjust_uncertainty(fit, data)
    assert find(adjusted)
    poses = sample_workspace(fit.robot, 20, 4).solution
    before, after = (pose_uncertainty(f, poses, frame=frame).position for f in (fit, adjusted))
    assert np.isfinite(after).all()
    assert after.mean() > before.mean()


def test_uncertain_readings_least_squares_and_few_poses_are_no_obstacle():
    robot = delta()
    data = measure(robot)
    at = places(robot, data.readings)
    bent = displaced(data, bend(at, at, 60 * UM, 3))
    assert find(adjust_uncertainty(identify(robot, bent, LeastSquares()), bent))
    estimated = identify(robot, bent, options=FitOptions(noise="estimated"))
    assert find(adjust_uncertainty(estimated, bent))
    uncertain = replace(bent, reading_sigma=np.full(bent.readings.shape, 2 * UM))
    assert find(adjust_uncertainty(identify(robot, uncertain), uncertain))
    few = bent.take(np.arange(4))
    fit = identify(robot, few)
    assert adjust_uncertainty(fit, few) is fit


def test_a_calibration_states_the_discrepancy_and_keeps_it_with_the_fit():
    fit, _, data = bent_fit()
    report = lc.calibrate(fit.initial, data)
    assert report.identification.posterior.discrepancy is not None
    assert DISCREPANCY in [f.code for f in report.findings]
    assert "discrepancy_root" in report.arrays()


def test_held_out_rows_are_predicted_with_the_discrepancy():
    """Rows x, y, z at the tool have the covariance of the poses, divided by their noise."""
    robot = delta()
    data = measure(robot)
    at = places(robot, data.readings)
    data = displaced(data, bend(at, at, 60 * UM, 3))
    fit = add_model_discrepancy(identify(robot, data, MAP()), data)
    assert find(fit)
    other = measure(fit.robot, 40).take(np.arange(30, 40))
    blocks = Predictor(fit.robot, {}, frozenset(), collect_uncertainty(fit), ()).make_blocks(other)
    u = pose_uncertainty(fit, forward(fit.robot, other.readings), frame="base")
    noise = fit.residual_test.sigma_scale * SIGMA
    for group in blocks.groups:
        variance = noise**2 * (group.rows[..., :-1] ** 2).sum(axis=(1, 2))
        assert np.allclose(np.sqrt(variance), u.position[group.blocks], rtol=0.02)


@pytest.mark.parametrize("machines", [6, pytest.param(12, marks=pytest.mark.evidence)])
def test_errors_that_each_pose_has_of_its_own_show_in_repeats(machines):
    """The errors of 60 um repeat, the noise of 10 um does not."""
    robot, inside, before, found = delta(), [], [], 0
    held_out = sample_workspace(robot, 30, 8).solution.q
    for seed in range(machines):
        machine = robot.with_values(sample_truth(robot, 1, seed)[0])
        data = repeat_poses(seed, 60 * UM)
        fit = identify(robot, data)
        adjusted = adjust_uncertainty(fit, data)
        found += bool(find(adjusted))
        rng = np.random.default_rng(seed + 100)
        true = places(machine, held_out) + 60 * UM * rng.standard_normal((30, 3))
        error = np.abs(places(fit.robot, held_out) - true)
        for each, shares in ((fit, before), (adjusted, inside)):
            u = pose_uncertainty(each, forward(fit.robot, held_out), frame="base")
            shares.append((error <= u.expanded[:, 3:]).mean())
    assert found == machines
    assert np.mean(before) < 0.8
    assert np.mean(inside) > 0.93
