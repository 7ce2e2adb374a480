# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of poses: covariance propagation, unobservable directions, frames, maps over the
workspace, and Monte Carlo.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, t

from loopcal import geometry, load_robot
from loopcal.apply.accuracy import accuracy_map, pose_uncertainty, simulate_accuracy
from loopcal.diagnose.gauge_freedoms import find_gauge_freedoms
from loopcal.errors import EstimationError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from tests.estimate.problems import five_dof, hexapod, hexapod_data, hexapod_poses, tracker

TEST_POSES = hexapod_poses(5, seed=11)


@pytest.fixture(scope="module")
def fit():
    return identify(hexapod(), hexapod_data(), LeastSquares())


@pytest.fixture(scope="module")
def fit_5():
    return identify(hexapod(), hexapod_data(instrument=five_dof()), LeastSquares())


def difference_poses(function, at, steps):
    """Central differences of poses, as twists (n, 6, p) in base axes at the platform's origin."""
    columns = []
    for i, h in enumerate(steps):
        d = np.zeros(len(at))
        d[i] = h
        columns.append(geometry.pose_difference(function(at + d), function(at - d)) / (2 * h))
    return np.stack(columns, axis=-1)


def test_posterior_has_the_covariance_of_its_fit(fit):
    known = fit.posterior
    spread = known.unit[:, None] * known.directions * np.sqrt(known.variance)
    # the rest is rounding
    np.testing.assert_allclose(
        spread @ spread.T, fit.covariance, rtol=0, atol=1e-12 * fit.covariance.max()
    )


def test_pose_covariance_agrees_with_finite_differences(fit):
    q = inverse(fit.robot, TEST_POSES).q
    D = difference_poses(
        lambda e: forward(fit.robot.with_values(e), q).T, fit.estimate, np.full(42, 1e-6)
    )
    expected = D @ fit.covariance @ D.swapaxes(1, 2)
    result = pose_uncertainty(fit, TEST_POSES, point="platform").covariance
    # differences of 1 um steps
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_reading_noise_adds_to_the_pose_covariance(fit):
    sigma = np.array([1, 2, 3, 4, 5, 6]) * 1e-7
    robot = fit.robot
    actuators = tuple(replace(a, sigma=s) for a, s in zip(robot.actuators, sigma, strict=True))
    noisy = replace(
        fit.posterior, robot=replace(robot, assembly=replace(robot.assembly, actuators=actuators))
    )
    more = (
        pose_uncertainty(noisy, TEST_POSES, point="platform").covariance
        - pose_uncertainty(fit, TEST_POSES, point="platform").covariance
    )
    q = inverse(robot, TEST_POSES[:1]).q
    J = difference_poses(lambda x: forward(robot, x).T, q[0], np.full(6, 1e-6))[0]
    np.testing.assert_allclose(
        more[0], (J * sigma**2) @ J.T, rtol=0, atol=1e-6 * np.abs(more[0]).max()
    )


def test_tool_uncertainty_includes_platform_rotation_times_the_lever_arm(fit):
    known, T_platform_tool = fit.posterior, np.eye(4)
    T_platform_tool[:3, 3] = [0.0, 0.0, 0.3]
    robot = replace(known.robot, assembly=replace(known.robot.assembly, tool=T_platform_tool))
    at_platform, at_tool = (
        pose_uncertainty(replace(known, robot=robot), TEST_POSES, point=point)
        for point in ("platform", "tool")
    )
    arm = TEST_POSES[:, :3, 2] * 0.3
    move = np.concatenate([-geometry.hat(arm), np.broadcast_to(np.eye(3), (5, 3, 3))], axis=2)
    expected = move @ at_platform.covariance @ move.swapaxes(1, 2)
    np.testing.assert_allclose(
        at_tool.covariance[:, 3:, 3:], expected, rtol=0, atol=1e-10 * expected.max()
    )
    assert "tool point" in at_tool.frame
    assert "platform origin" in at_platform.frame


def test_size_of_pose_uncertainty_does_not_depend_on_the_axes(fit):
    base, platform = (pose_uncertainty(fit, TEST_POSES, frame) for frame in ("base", "platform"))
    np.testing.assert_allclose(base.position, platform.position, rtol=1e-9)
    np.testing.assert_allclose(base.orientation, platform.orientation, rtol=1e-9)
    assert "platform axes" in platform.frame
    assert np.array_equal(base.expanded, base.coverage_factor * base.sd)
    student = t(base.degrees.components)  # one coverage for all: 95 %
    np.testing.assert_allclose(student.cdf(base.coverage_factor), 0.975, rtol=1e-12)
    np.testing.assert_allclose(base.degrees.position, platform.degrees.position, rtol=1e-9)


def test_uncertainty_without_torsion_is_infinite_about_the_normal_only(fit_5):
    result = pose_uncertainty(fit_5, TEST_POSES, "platform", frame="base", point="platform")
    assert np.array_equal(
        np.isinf(result.sd), np.tile([False, False, True, False, False, False], (5, 1))
    )
    in_base = pose_uncertainty(fit_5, TEST_POSES, "base", frame="base", point="platform")
    # tilted poses: the normal has a part along each axis of the base
    assert np.isinf(in_base.sd[:, :3]).all()
    np.testing.assert_allclose(in_base.position, result.position, rtol=1e-9)


def test_rotation_of_the_platform_frame_is_left_out_and_reported(fit_5):
    result = pose_uncertainty(fit_5, TEST_POSES)
    assert np.isfinite(result.sd).all()
    assert result.reference.code == "accuracy.frame"
    assert result.reference.data["fitted"] == ("platform",)
    assert "best rigid fit of the platform frame over the measured poses, because" in result.frame


def make_base_unobservable(fit, extra=None):
    """Return the fit's posterior with an unobservable base frame (and parameter `extra`)."""
    base = fit.estimate.reshape(6, 7)[:, :3]
    known = np.zeros((42, 6))
    for leg, b in enumerate(base):
        known[7 * leg : 7 * leg + 3] = np.concatenate([-geometry.hat(b), np.eye(3)], axis=1)
    if extra is not None:
        known = np.column_stack([known, np.eye(42)[:, extra]])
    q, _ = np.linalg.qr(known / fit.tolerance[:, None], mode="complete")
    k = known.shape[1]
    variance = np.r_[np.full(k, np.inf), np.full(42 - k, 1e-4)]
    return replace(
        fit.posterior,
        unit=fit.tolerance,
        directions=q,
        variance=variance,
        determined=np.arange(42) >= k,
    )


def test_unknown_base_gives_six_rigid_motions_of_the_base_frame(fit):
    if fit.names[:3] != ("leg1.base.x", "leg1.base.y", "leg1.base.z"):
        pytest.fail("this test counts on the order of the hexapod's parameters")
    known = make_base_unobservable(fit)
    motions = find_gauge_freedoms(known.robot, known.places, known.unit, known.undetermined)
    assert (motions.count, motions.frames) == (6, ("base",))
    assert (motions.still, motions.changing) == (0, 0)
    assert np.isfinite(pose_uncertainty(known, TEST_POSES).sd).all()
    assert np.isinf(pose_uncertainty(known, TEST_POSES, frame="base").sd).all()


def test_unobservable_leg_length_keeps_infinite_uncertainty(fit):
    known = make_base_unobservable(fit, extra=fit.names.index("leg2.length"))
    assert find_gauge_freedoms(known.robot, known.places, known.unit, known.undetermined).count == 6
    assert np.isinf(pose_uncertainty(known, TEST_POSES).sd).all()


def test_frame_known_from_its_prior_alone_is_left_out(fit):
    known = make_base_unobservable(fit)
    with_prior = replace(known, variance=np.where(known.determined, known.variance, 1.0))
    left_out, kept = (pose_uncertainty(with_prior, TEST_POSES, frame=f) for f in ("fitted", "base"))
    np.testing.assert_allclose(left_out.sd, pose_uncertainty(known, TEST_POSES).sd, rtol=1e-9)
    assert (kept.position > 5 * left_out.position).all()


def test_unreachable_poses_have_nan_uncertainty(fit):
    far = TEST_POSES[:2].copy()
    far[1, 2, 3] = np.nan
    result = pose_uncertainty(fit, far)
    assert np.isfinite(result.sd[0]).all()
    assert np.isnan(result.sd[1]).all()
    assert np.isnan(result.T[1]).all()


def test_unknown_frame_option_is_refused(fit):
    with pytest.raises(
        EstimationError, match="axes is 'world', but must be one of 'base', 'platform'"
    ):
        pose_uncertainty(fit, TEST_POSES, "world")  # pyright: ignore[reportArgumentType]
    names = "but must be one of 'fitted', 'base', 'relative', 'frame'"
    with pytest.raises(EstimationError, match=f"frame is 'world', {names}"):
        pose_uncertainty(fit, TEST_POSES, frame="world")


def test_accuracy_map_marks_extrapolated_poses():
    robot = load_robot("hexapod-42")
    truth = robot.with_values(sample_truth(robot, 1, 5)[0])
    everywhere = sample_workspace(robot, 30, 1).coordinates
    middle = everywhere.mean(axis=0)
    maps = []
    for share in (1.0, 0.2):  # measured poses in the whole workspace, and in its middle fifth
        data = simulate(truth, middle + share * (everywhere - middle), tracker(), 1)
        maps.append(
            accuracy_map(identify(robot, data, LeastSquares()), data.readings, poses=200, seed=2)
        )
    wide, narrow = maps
    assert np.median(narrow.position_ratio) > 3
    assert narrow.extrapolated.mean() > 0.9
    assert np.median(wide.position_ratio) < 1
    assert f"{int(wide.extrapolated.sum())} of 200 poses" in str(wide)
    assert narrow.to_dict()["extrapolated"] == int(narrow.extrapolated.sum())


def chi_interval(trials, numbers):
    """Return the interval of sample sd / sd for `numbers` samples at level 1e-3 (Bonferroni)."""
    tail = 1e-3 / (2 * numbers)
    return np.sqrt(chi2.ppf([tail, 1 - tail], trials) / trials)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("hexapod-42", LeastSquares()),
        ("3-prs", LeastSquares()),
        ("3-prs", MAP()),
        ("linear-delta", MAP()),
    ],
)
def test_predicted_pose_errors_agree_with_simulated_calibrations(name, method):
    robot, trials = load_robot(name), 300
    measured, judged = (
        sample_workspace(robot, n, seed).coordinates for n, seed in ((40, 1), (6, 9))
    )
    reports = []
    result = simulate_accuracy(
        robot,
        measured,
        tracker(),
        judged,
        method,
        trials,
        3,
        lambda *report: reports.append(report),
    )
    assert [(done, total) for done, total, _ in reports] == [(0, trials), (250, trials)]
    ratio = result.ratio[np.isfinite(result.ratio)]
    low, high = chi_interval(result.trials, len(ratio))
    assert (result.trials, result.failed) == (trials, 0)
    assert len(ratio) == (18 if name == "linear-delta" else 36)
    # one trial's decomposition stands for all: 3 % for truths that differ by their spreads
    assert ratio.min() > 0.97 * low
    assert ratio.max() < 1.03 * high
    assert (ratio / 1.5).min() < 0.97 * low  # a prediction 50 % too large would fail
