# SPDX-License-Identifier: Apache-2.0
"""Rows of sessions and targets keep the columns of their own setup, whatever else was measured."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks.bench_growth import draw_sessions
from loopcal.diagnose.blunders import Predictor
from loopcal.diagnose.residual_patterns import collect_residual_rows, estimate_correlated_errors
from loopcal.diagnose.residual_patterns import test_correlation as compute_correlation
from loopcal.estimate import fit_linearization, pose_rows
from loopcal.estimate.fit_linearization import collect_uncertainty, linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.observation_rows import ObservationRows
from loopcal.estimate.options import FitOptions
from loopcal.estimate.prior import prior_from
from loopcal.estimate.smooth_errors import describe_smooth_errors
from loopcal.geometry import exp_so3, make_pose
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.kinds.distance import Distance, Separation
from loopcal.measure.kinds.position import Bearing, Position, TargetKind
from loopcal.measure.kinds.surfaces import Plane, Sphere
from loopcal.mechanism.solutions import forward
from loopcal.numerics.split_columns import SplitColumns

NAMES, PLACES = ("a", "b", "c"), np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02], [0.0, -0.1, 0.0]])
STATION = make_pose(exp_so3(np.array([0.1, -0.2, 0.7])), np.array([-1.2, 0.4, 0.3]))
SHARED = {"targets": NAMES, "places": PLACES, "T_base_frame": STATION}
KINDS = [
    Position(unknown=("targets", "frame"), **SHARED),
    Position(unknown=("targets", "bias", "scale"), **SHARED),
    Bearing(unknown=("frame", "targets"), **SHARED),
    Distance(unknown=("targets", "offset"), **SHARED),
    Separation(unknown=("targets",), **SHARED),
    Plane(unknown=("surface", "targets"), **SHARED),
    Sphere(unknown=("surface", "targets"), **SHARED),
]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind.name}-{'-'.join(kind.unknown)}")
def test_rows_of_one_target_are_those_of_all(kind, monkeypatch) -> None:
    rng, links = np.random.default_rng(1), kind.poses_per_row
    T = np.array([make_pose(exp_so3(w), 0.1 * w) for w in rng.normal(0.0, 0.3, (4 * links, 3))])
    c, m, u = len(kind.columns), len(kind.noise_columns), len(kind.nuisance_parameters)
    measured, values = rng.uniform(0.5, 1.0, (1, 4, c)), rng.normal(0.0, 0.01, (1, u))
    values = kind.nominal_values + values
    poses = np.arange(4 * links).reshape((4, links) if links > 1 else 4)
    used = np.tile(np.arange(u), (4, 1))
    white = rng.uniform(1.0, 2.0, (1, 4, m))[..., None] * np.eye(m)
    whole = ObservationRows(kind, poses, measured, white, used)
    parts = whole.divided()
    assert len(parts.poses) == 12
    joined = kind.evaluate(T[None, poses], measured, values[:, None])
    own = parts.kind.evaluate(T[None, parts.poses], parts.measured, values[:, parts.nuisance])
    monkeypatch.setattr(TargetKind, "divided", None)
    at = replace(kind).evaluate(T[None, poses], measured, values[:, None])
    assert own.nuisance is not None
    assert at.nuisance is not None
    for one, other in zip(joined[:3], at[:3], strict=True):
        assert_allclose(one, other, atol=1e-14)
    wide = np.zeros((1, 12, m // 3, u))
    places = np.broadcast_to(parts.nuisance[:, None], own.nuisance.shape)
    np.put_along_axis(wide, places, own.nuisance, axis=3)
    assert_allclose(wide.reshape(1, 4, m, u), at.nuisance, atol=1e-14)
    assert_allclose(own.residual.reshape(1, 4, m), at.residual, atol=1e-14)
    assert_allclose(
        np.einsum("trii->tri", parts.whitener).reshape(1, 4, m), np.einsum("trii->tri", white)
    )
    mixed = white + 0.1  # errors that targets share
    assert (shared := ObservationRows(kind, poses, measured, mixed, used)).divided() is shared


def test_derivatives_of_a_tiny_machine_are_those_of_a_large_one() -> None:
    """Derivatives by angles of a frame were zero where arms are below 1e-12 m; nothing was said."""
    x, w = np.random.default_rng(2).normal(0.0, 0.1, (2, 5, 3))
    slopes = []
    for scale in (1.0, 1e-14):
        T = np.array([make_pose(exp_so3(a), scale * b) for a, b in zip(w, x, strict=True)])
        kind = Position(places=scale * PLACES[:1], unknown=("frame", "targets"))
        evaluated = kind.evaluate(T[None], scale * x[None])
        assert evaluated.nuisance is not None
        slopes.append(evaluated.nuisance * np.where(kind._is_length, scale, 1.0) / scale)
    assert_allclose(slopes[1], slopes[0], atol=1e-15)


def test_rows_do_not_grow_with_other_sessions_and_targets() -> None:
    """Columns of all setup parameters would take 5 times the memory for 8 times the sessions."""
    robot, sizes = load_robot("hexapod-42"), {}
    for sessions, targets in ((3, 3), (24, 3), (3, 12)):
        data = draw_sessions(robot, 240, sessions, targets)
        fit = identify(robot, data)
        linear = linearize_fit(fit, data)
        blocks = linear.problem.leverage_rows(linear.linearization, linear.solution)
        rows = collect_residual_rows(linear)
        assert rows is not None
        kept, values = fit.nuisance.names, fit.nuisance.values
        predictor = Predictor(fit.robot, values, frozenset(kept), collect_uncertainty(fit), ())
        sizes[sessions, targets] = (
            sum(part.rows.nbytes for parts in blocks for part in parts),
            rows.basis.wide.nbytes + getattr(rows.basis.narrow, "nnz", 0) * 12,
            sum(group.rows.nbytes for group in predictor.make_blocks(data).groups),
        )
    few, more_sessions, more_targets = (np.array(s, float) for s in sizes.values())
    assert (more_sessions <= 1.02 * few).all()
    assert (more_targets[:2] <= 1.3 * 4 * few[:2]).all()


def test_errors_of_the_poses_are_folded_session_by_session(monkeypatch) -> None:
    """All rows by all their coefficients took 240 MB of 550 MB for 60,000 residuals."""
    robot = load_robot("hexapod-42")
    data = draw_sessions(robot, 96, 24, 8)
    first = identify(robot, draw_sessions(robot, 40, 1, 1)).posterior
    earlier = replace(prior_from(first), fitted_rows=None)
    fit = identify(robot, data, options=FitOptions(prior=earlier))
    linear, T = linearize_fit(fit, data), forward(fit.robot, data.readings).T
    errors, factors, peaks = describe_smooth_errors(T, robot.tool[:3, 3], robot.size), [], []
    for most in (10_000, 400):
        monkeypatch.setattr(fit_linearization, "PART", most)
        tracemalloc.start()
        factors.append(fit_linearization.fold_smooth_errors(linear, errors))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    whole, parts = (factor.T @ factor for factor in factors)
    length = np.sqrt(np.diag(whole))
    assert_allclose(parts / length / length[:, None], whole / length / length[:, None], atol=1e-12)
    p = len(fit.names)  # the columns of the machine are those of the fit, its prior included
    of_fit = linear.linearization.factor[0, :, :p]
    assert_allclose(whole[:p, :p], of_fit.T @ of_fit, rtol=1e-9, atol=1e-9 * length[:p].max() ** 2)
    assert peaks[1] < 0.7 * peaks[0]


def test_residuals_of_many_blocks_of_poses_keep_their_rows(monkeypatch) -> None:
    robot = load_robot("hexapod-42")
    data = draw_sessions(robot, 60, 2, 2)
    fit = identify(robot, data)
    whole = collect_residual_rows(linearize_fit(fit, data))
    monkeypatch.setattr(pose_rows, "EXACT_BLOCK", 7)
    parts = collect_residual_rows(linearize_fit(fit, data))
    assert whole is not None
    assert parts is not None
    for name in ("kind", "row", "column", "series"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))
    assert_allclose(parts.residual, whole.residual, atol=1e-9)


def test_residuals_of_sessions_are_examined_as_by_dense_columns() -> None:
    robot = load_robot("hexapod-42")
    data = draw_sessions(robot, 60, 5, 2)
    rows = collect_residual_rows(linearize_fit(identify(robot, data), data))
    assert rows is not None
    assert rows.basis.narrow.shape[1] > 0
    basis, gain = (SplitColumns.of(each.toarray()) for each in (rows.basis, rows.gain))
    dense = replace(rows, basis=basis, gain=gain)
    assert_allclose(compute_correlation(rows), compute_correlation(dense), rtol=1e-9)
    one, other = (estimate_correlated_errors(each, 8.0) for each in (rows, dense))
    size = np.abs(other.covariance).max()
    assert_allclose(one.covariance, other.covariance, atol=1e-9 * size)
    assert_allclose(
        [one.degrees, one.correlation, one.sigma],
        [other.degrees, other.correlation, other.sigma],
        rtol=1e-9,
    )
    left = np.arange(0, 360, 7)
    projectors = [each.without(left).basis.toarray() for each in (rows, dense)]
    one, other = (P @ P.T for P in projectors)
    assert_allclose(one, other, atol=1e-9)
