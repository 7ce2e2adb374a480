# SPDX-License-Identifier: Apache-2.0
"""The most probable cause of residuals, compared with wrong rows and with noise alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.diagnose.adjusted_uncertainty import SHARED, adjust_uncertainty
from loopcal.diagnose.error_causes import (
    NOISE,
    compare_causes,
    explain_residuals,
    measure_wrong_poses,
)
from loopcal.diagnose.residual_patterns import CAUSE, Effect
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.numerics.split_columns import SplitColumns
from loopcal.numerics.statistics import Remainder
from loopcal.units import Dimension
from tests.diagnose.correlated_data import LENGTH, ROBOTS, draw_errors, measure
from tests.diagnose.test_model_discrepancy import repeat_poses

RNG = np.random.default_rng


def name_causes(robot, kind, errors, seed, **context):
    """Return the sources of the causes of the residuals of a fit, the most probable first."""
    _, data = measure(robot, kind, errors, seed, **context)
    linear = linearize_fit(identify(ROBOTS[robot], data), data)
    return [cause.source for cause in explain_residuals(linear).causes]


def share(seed, n, size=2.0):
    """Return errors (n, 9) that the three targets of a pose share, beside their noise."""
    shared = np.tile(RNG([seed, 3]).normal(0.0, size, (n, 3)), (1, 3))
    return draw_errors(n, 9, seed) + shared


def test_an_error_that_targets_of_a_pose_share_is_named_and_no_pose_is_called_wrong():
    for seed in (1, 2):
        _, data = measure("hexapod-42", "tracker", share(seed, 27), seed)
        report = lc.calibrate(ROBOTS["hexapod-42"], data)
        codes = {f.code for f in report.findings}
        (cause,) = (f for f in report.findings if f.code == CAUSE)
        (found,) = (f for f in report.findings if f.code == SHARED)
        assert cause.data["cause"] == found.data["cause"] == "pose"
        assert cause.data["probability"] > cause.data["second_probability"]
        # 27 poses, of which the machine takes up about half: 30 % are two standard deviations
        assert found.data["sizes"][0].value == pytest.approx(2e3 * LENGTH, rel=0.6)
        assert not codes & {"outliers.some", "outliers.pose", "noise.residuals-too-large"}
        assert "Correct or exclude" not in str(report)


@pytest.mark.parametrize(
    ("expected", "robot", "kind"),
    [
        ("walk", "linear-delta", "component"),
        ("walk", "hexapod-42", "tracker"),
        ("target", "hexapod-42", "tracker"),
        ("session", "3-prs", "pose"),
        ("outliers", "linear-delta", "component"),
    ],
)
def test_other_causes_are_named(expected, robot, kind):
    n, m, rng, session = 27, {"component": 3, "pose": 6, "tracker": 9}[kind], RNG(4), None
    errors = draw_errors(n, m, 5)
    if expected == "walk":
        errors += np.tile(np.cumsum(rng.normal(0.0, 1.0, (n, 3)), axis=0), (1, m // 3))
    if expected == "target":
        errors += rng.normal(0.0, 3.0, m)
    if expected == "session":
        session = np.array([f"s{i}" for i in np.arange(n) // 7])
        errors += rng.normal(0.0, 3.0, (4, m))[np.arange(n) // 7]
    if expected == "outliers":
        errors[[4, 20]] += 20.0
    assert name_causes(robot, kind, errors, 5, session=session)[0] == expected


def test_nothing_is_said_of_what_wrong_poses_leave():
    """They pull the fit, so that the others seem to have errors of the drives or of the model."""
    errors = share(3, 27)
    errors[[5, 11]] += RNG(5).normal(0.0, 30.0, (2, 9))
    assert name_causes("hexapod-42", "tracker", errors, 3) == ["outliers"]


def test_a_noise_larger_than_stated_is_no_error_of_the_drives():
    """Three drives and three coordinates: errors of the drives explain noise of any size."""
    for seed in range(4):
        names = name_causes("linear-delta", "component", 4.0 * draw_errors(40, 3, seed), seed)
        assert names == ["larger-noise"]


def test_noise_of_another_size_has_no_other_cause():
    for seed in range(6):
        assert name_causes("3-prs", "pose", 2.0 * draw_errors(14, 6, seed), seed) in (
            [],
            ["larger-noise"],
        )


def draw_remainder(rng, rows=40, estimated=10):
    """Return residuals of normal errors, and the basis of what nothing estimated explains."""
    Q = np.linalg.qr(rng.standard_normal((rows, rows)))[0]
    residual = Q[:, estimated:] @ rng.standard_normal(rows - estimated)
    return Remainder(SplitColumns.of(Q[:, :estimated]), residual, rows - estimated), Q[
        :, estimated:
    ]


def test_a_component_is_taken_into_the_inverse_of_the_covariance():
    rng = RNG(6)
    remainder, left = draw_remainder(rng)
    Z, other = rng.standard_normal((40, 8)), rng.standard_normal((40, 3))
    taken = remainder.add(remainder.find_spectrum(Z), 0.7)
    V = np.linalg.inv(np.eye(30) + 0.7 * left.T @ Z @ Z.T @ left)
    assert other.T @ taken.weigh(other) == pytest.approx(other.T @ left @ V @ left.T @ other)
    gone = remainder.add(remainder.find_spectrum(Z), np.inf)
    without = left @ np.linalg.svd(left.T @ Z)[0][:, 8:]  # nothing of Z
    assert gone.degrees == 22
    assert other.T @ gone.weigh(other) == pytest.approx(other.T @ without @ without.T @ other)


@pytest.mark.parametrize(("rows", "estimated", "per_pose"), [(12, 6, 6), (12, 7, 6), (18, 12, 6)])
def test_wrong_poses_need_degrees_of_freedom_beside_their_own(rows, estimated, per_pose):
    """An estimated noise has none left where the rows of one pose are all that remain."""
    remainder, _ = draw_remainder(np.random.default_rng(0), rows, estimated)
    pose = np.arange(rows) // per_pose
    assert measure_wrong_poses(remainder, pose, 0.0) == -np.inf


def test_noise_alone_is_hardly_ever_excluded():
    rng, found, draws = RNG(7), 0, 400
    pose = np.repeat(np.arange(10), 4)
    label = (("x", Dimension.LENGTH),)
    groups = [np.arange(40) // k for k in (4, 8, 20)]
    columns = [(g[:, None] == np.unique(g)).astype(float) for g in groups]
    effects = [Effect("pose", str(i), Z, label * Z.shape[1], Z) for i, Z in enumerate(columns)]
    for _ in range(draws):
        remainder, _ = draw_remainder(rng)
        found += bool(compare_causes(remainder, effects, pose, np.inf))
    # the mean of the evidence is one, and noise alone is excluded where it exceeds 19
    # (Markov: 5 %); 0.05 + 3 standard deviations of 400 draws
    assert found / draws <= 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / draws)


def test_clean_data_name_no_cause():
    for seed in range(8):
        _, data = measure("linear-delta", "component", draw_errors(20, 3, seed), seed)
        fit = adjust_uncertainty(identify(ROBOTS["linear-delta"], data), data)
        assert CAUSE not in {f.code for f in fit.findings}


def test_few_rows_and_one_row_of_each_pose_name_no_cause_and_no_error():
    _, data = measure("linear-delta", "component", draw_errors(8, 3, 1), 1)
    (rows,) = data.observations
    heights = np.where([False, False, True], rows.measured, np.nan)
    data = replace(data, observations=(replace(rows, measured=heights),))
    linear = linearize_fit(identify(ROBOTS["linear-delta"], data), data)
    assert NOISE not in {
        cause.source for cause in explain_residuals(linear, is_doubted=True).causes
    }


def test_blocks_that_cross_all_regions_are_held_out_alone():
    _, data = measure("linear-delta", "component", draw_errors(12, 3, 1), 1)
    blocks, regions = np.arange(12) // 3, np.arange(12) % 3
    fitted, held_out = replace(data, block=blocks).split(hold_out=0.25, seed=0, regions=regions)
    assert (fitted.n_poses, held_out.n_poses) == (9, 3)


def test_many_poses_are_compared_by_an_even_choice_and_widen_the_uncertainty_as_all():
    _, data = measure("hexapod-42", "tracker", share(2, 130, 3.0), 2)
    fit = adjust_uncertainty(identify(ROBOTS["hexapod-42"], data), data)
    causes = [f.data["cause"] for f in fit.findings if f.code == CAUSE]
    (found,) = (f for f in fit.findings if f.code == SHARED)
    assert causes[0] == found.data["cause"] == "pose"
    # chi-square has multiplied the variance by 1 + 9, and 9 for each of three targets are added;
    # 130 poses know the size to 5 %, of which the frame and the drives take some
    assert found.data["ratio"] == pytest.approx(np.sqrt(1.0 + 27.0 / 10.0), rel=0.15)


def test_an_error_that_repeats_share_is_no_walk_and_no_slow_error():
    for seed in (1, 2, 3):
        data = repeat_poses(seed, 60e-6)  # twelve poses, three times each, one after the other
        linear = linearize_fit(identify(ROBOTS["linear-delta"], data), data)
        assert [cause.source for cause in explain_residuals(linear).causes] == ["rough"]
