# SPDX-License-Identifier: Apache-2.0
"""Errors that days, sessions or poses share: the cluster-robust covariance against the stated one.

The reference is a dense computation in numpy: the rows by all parameters from finite differences of
the residuals, an explicit hat matrix, and matrix roots from scipy.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import sqrtm

from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty, check_heavy_tails
from loopcal.diagnose.bootstrap import Clusters, compute_robust_spread, divide_into_clusters
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.problem import problem_of
from loopcal.estimate.result import Identification
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from tests import zoo
from tests.estimate.problems import UM, URAD, hexapod, hexapod_poses, noise

THREE = np.array([[0.03, -0.02, 0.05], [-0.04, 0.02, 0.05], [0.0, 0.05, 0.06]])
KNOWN_POSE = Sensor(Pose(), noise(*[50 * URAD] * 3, *[10 * UM] * 3))
THREE_TARGETS = Sensor(
    Position(targets=("a", "b", "c"), places=THREE, unknown=("frame",)), noise(*[10 * UM] * 9)
)
RANK = 1e-7
"""Share of the largest singular value that finite differences leave in null directions, at most."""
EIGHT = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (0.5, 1.5)])
EIGHT_TARGETS = Sensor(
    Position(targets=tuple("abcdefgh"), places=0.05 * EIGHT, unknown=("frame",)),
    noise(*[10 * UM] * 24),
)


def measure(
    sensor: Sensor, poses: int, seed: int, sessions: int = 0, common: np.ndarray | float = 0.0
) -> Measurements:
    """Measure the true hexapod; `common` [m, rad] is the size of an error that the values of one
    session, or else of one pose, share.
    """
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    data = simulate(truth, hexapod_poses(poses, seed), Instrument((sensor,)), seed)
    (rows,) = data.observations
    unit = np.arange(poses) * sessions // poses if sessions else np.arange(poses)
    labels = np.array([f"s{i}" for i in unit]) if sessions else rows.session
    drawn = np.random.default_rng([seed, 1]).standard_normal((poses, 3))[unit]
    columns = rows.measured.shape[1]
    shared = np.tile(drawn, columns // 3) if sensor is not KNOWN_POSE else np.tile(drawn, 2)
    measured = rows.measured + common * shared
    return replace(data, observations=(replace(rows, measured=measured, session=labels),))


def stack_rows(fit: Identification, data: Measurements) -> tuple[np.ndarray, np.ndarray]:
    """Return dense whitened rows (m, U + p) by central differences, and residuals (m,), in the
    order of poses.
    """
    problem = problem_of(fit.free_parameters, data)
    z = fit.free_parameters.deviation(fit.robot.values[None])
    start, u = problem.start(z), fit.nuisance.estimate
    U = len(u)

    def residuals(x: np.ndarray) -> np.ndarray:
        values = x[None, :U] if U else None
        solution = problem.solve(x[None, U:], start, values)
        (kind,) = problem.residuals(x[None, U:], solution)
        return kind.whitened[0].ravel()

    at = np.r_[u, z[0]]
    step = np.r_[np.full(U, 1e-6), np.full(z.shape[1], 1e-2)]
    columns = [
        (residuals(at + h * e) - residuals(at - h * e)) / (2.0 * h)
        for h, e in zip(step, np.eye(len(at)), strict=True)
    ]
    return np.column_stack(columns), residuals(at)


class DenseReference:
    """Sandwich covariance with the correction CR2 of dense rows J by U + p unknowns."""

    def __init__(self, J: np.ndarray, r: np.ndarray, cluster: np.ndarray, prior: np.ndarray):
        length = np.linalg.norm(J, axis=0)
        X = J / length
        _, s, vt = np.linalg.svd(np.vstack([X, np.diag(np.sqrt(prior) / length)]))
        B = (vt[s > RANK * s[0]].T / s[s > RANK * s[0]] ** 2) @ vt[s > RANK * s[0]]
        H = X @ B @ X.T
        self.stated = (B / length) / length[:, None]
        meat, root, K = np.diag(prior / length**2), np.zeros((len(J), len(J))), []
        for g in np.unique(cluster):
            rows = np.flatnonzero(cluster == g)
            # a frame of one session alone leaves no residual in some directions
            remaining = np.eye(len(rows)) - H[np.ix_(rows, rows)]
            adjust = np.linalg.pinv(np.real(sqrtm(remaining)), rcond=1e-4, hermitian=True)
            score = X[rows].T @ adjust @ r[rows]
            meat = meat + np.outer(score, score)
            root[np.ix_(rows, rows)] = adjust
            K.append(rows)
        self.robust = (B @ meat @ B / length) / length[:, None]
        self.linear, self.clusters = (B @ X.T) / length[:, None], K
        self.H, self.root = H, root

    def degrees(self, effect: np.ndarray) -> float:
        """2 mean^2 / variance of the sum over clusters of |effect B u_g|^2."""
        W = np.zeros_like(self.H)
        for rows in self.clusters:
            S = effect @ self.linear[:, rows]
            W[np.ix_(rows, rows)] = S.T @ S
        # residuals have the covariance I - H, with a prior too: its parameters are random
        K = self.root @ W @ self.root @ (np.eye(len(W)) - self.H)
        return float(np.trace(K) ** 2 / np.trace(K @ K))


@pytest.mark.parametrize("sensor", [KNOWN_POSE, THREE_TARGETS], ids=["pose", "three targets"])
@pytest.mark.parametrize("sessions", [0, 6, -6], ids=["poses", "sessions", "one frame"])
@pytest.mark.parametrize(
    "method",
    [pytest.param(LeastSquares(), marks=pytest.mark.evidence), MAP()],
    ids=["least squares", "MAP"],
)
def test_covariance_and_degrees_equal_a_dense_computation(sensor, sessions, method):
    data = measure(sensor, 24, 3, abs(sessions))
    if sessions < 0:  # one frame for all sessions
        (rows,) = data.observations
        data = replace(data, observations=(replace(rows, session=np.array([""] * 24)),))
    sessions = abs(sessions)
    fit = identify(hexapod(), data, method, options=FitOptions(sigma_uncertainty=0.0))
    member = np.arange(24) * sessions // 24 if sessions else np.arange(24)
    clusters = Clusters("pose", member, int(member.max()) + 1)
    spread = compute_robust_spread(linearize_fit(fit, data), clusters)
    J, r = stack_rows(fit, data)
    U, p = len(fit.nuisance), len(fit.names)
    prior = np.r_[np.zeros(U), np.full(p, 1.0 if isinstance(method, MAP) else 0.0)]
    dense = DenseReference(J, r, np.repeat(member, len(r) // 24), prior)
    root = spread.root
    effect = np.random.default_rng(0).standard_normal((5, p))
    F, A = J[:, :U], J[:, U:]
    left = A - F @ np.linalg.lstsq(F, A)[0] if U else A
    effect = effect @ np.linalg.pinv(left, rcond=RANK) @ left  # quantities that the rows determine
    wide = np.column_stack([np.zeros((5, U)), effect])
    # the reference has finite differences of 1e-6
    stated, robust = (np.trace(wide @ C @ wide.T) for C in (dense.stated, dense.robust))
    assert np.isclose(((effect @ root) ** 2).sum(), stated, rtol=1e-4)
    ratio = spread.compare(effect)
    assert np.isclose(ratio.ratio, np.sqrt(robust / stated), rtol=1e-3)
    assert np.isclose(ratio.degrees, dense.degrees(wide), rtol=1e-2)


@pytest.mark.parametrize("draws", [12, pytest.param(25, marks=pytest.mark.evidence)])
def test_the_ratio_is_one_on_average_for_independent_errors(draws):
    """CR2 is unbiased, with 5 sessions as with 30 poses."""
    for sessions in (0, 5):
        ratios = []
        for seed in range(draws):
            data = measure(KNOWN_POSE, 30, seed, sessions)
            linear = linearize_fit(identify(hexapod(), data, LeastSquares()), data)
            blocks = divide_into_clusters(data)[0]
            assert blocks.count == (sessions or 30)
            ratios.append(
                compute_robust_spread(linear, blocks).compare(np.eye(len(linear.fit.names)))
            )
        squares = [ratio.ratio**2 for ratio in ratios]
        degrees = np.mean([ratio.degrees for ratio in ratios])
        assert abs(np.mean(squares) - 1.0) < 4.0 * np.sqrt(2.0 / degrees / len(squares))
        # 4 sd of these draws: 0.6 for 25
        assert np.allclose(np.std(squares), np.sqrt(2.0 / degrees), rtol=3.0 / np.sqrt(draws))


def test_days_and_sessions_are_found_and_the_largest_unit_with_enough_clusters_is_used():
    data = measure(KNOWN_POSE, 24, 1, sessions=12)
    (rows,) = data.observations
    hours = np.repeat([0.0, 25.0, 49.0, 72.0, 99.0, 120.0], 4) + np.tile([0.0, 1.0, 3.0, 5.0], 6)
    timed = replace(data, observations=(replace(rows, context={"time": 3600.0 * hours}),))
    divisions = [(c.unit, c.count) for c in divide_into_clusters(timed)]
    assert divisions == [("day", 6), ("session", 12), ("pose", 24)]
    assert [(c.unit, c.count) for c in divide_into_clusters(data)] == [
        ("session", 12),
        ("pose", 24),
    ]
    few = measure(KNOWN_POSE, 24, 1, sessions=4)
    assert [c.unit for c in divide_into_clusters(few)] == ["pose"]
    blocks = replace(few, block=np.arange(24) // 3)
    assert [(c.unit, c.count) for c in divide_into_clusters(blocks)] == [("block", 8)]


def test_sessions_that_measure_the_same_poses_are_not_independent():
    data = measure(KNOWN_POSE, 24, 1)
    (rows,) = data.observations
    left = replace(rows, session=np.array([f"left{i // 4}" for i in range(24)]))
    right = replace(rows, session=np.array([f"right{i // 8}" for i in range(24)]))
    both = replace(data, observations=(left, right))
    assert [(c.unit, c.count) for c in divide_into_clusters(both)] == [("pose", 24)]


def test_checks_with_a_given_linearization_equal_those_without_it():
    data = measure(THREE_TARGETS, 24, 5, 6)
    fit = identify(hexapod(), data)
    linear = linearize_fit(fit, data)
    adjusted = adjust_uncertainty(fit, data)
    shared = adjust_uncertainty(fit, data, linear)
    np.testing.assert_array_equal(shared.covariance, adjusted.covariance)
    assert check_heavy_tails(adjusted, data, (), linear) == check_heavy_tails(adjusted, data)
