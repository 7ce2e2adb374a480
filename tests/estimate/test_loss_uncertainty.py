# SPDX-License-Identifier: Apache-2.0
"""Intervals of fits with a loss: the variance of an M-estimate, also where sigma is too small."""

import numpy as np
import pytest

from loopcal.estimate.fit_descent import compute_loss_variance
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Huber, Tukey
from loopcal.estimate.penalties import LeastSquares
from tests.estimate.test_machine_change import DELTA, measure
from tests.findings.expectations import list_codes


def fit_lines(loss, A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return estimates (t, p) by reweighting single rows b (t, n), and the weights (t, n)."""
    weight, z = np.ones(b.shape), np.zeros((len(b), A.shape[1]))
    for _ in range(20):
        M = np.einsum("np,tn,nq->tpq", A, weight, A, optimize=True)
        z = np.linalg.solve(M, np.einsum("np,tn->tp", A, weight * b)[..., None])[..., 0]
        distance = np.abs(z @ A.T - b)
        weight = loss.weight(distance.ravel(), np.ones(b.size)).reshape(b.shape)
    return z, weight


@pytest.mark.parametrize("loss", [Huber(), Tukey()])
@pytest.mark.parametrize(("ratio", "tails"), [(1.0, "normal"), (1.3, "normal"), (1.0, "t3")])
def test_variance_is_that_of_the_true_errors(loss, ratio, tails) -> None:
    """200 independent fits of 60 rows: stated variance over the variance of the estimates."""
    rng, t, n = np.random.default_rng(5), 200, 60
    A = rng.normal(size=(n, 4))
    noise = rng.standard_normal((t, n)) if tails == "normal" else rng.standard_t(3, (t, n))
    z, weight = fit_lines(loss, A, ratio * noise)
    stated = []
    for trial in range(t):
        distance = np.abs(A @ z[trial] - ratio * noise[trial])
        variance, left = compute_loss_variance(loss, distance, np.ones(n), 4)
        assert left == n - 4
        covariance = np.linalg.inv(A.T @ (weight[trial][:, None] * A))
        stated.append(variance * np.diag(covariance))
    assert np.mean(stated) / np.mean(z**2) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("loss", [Huber(), Tukey()])
def test_intervals_allow_for_a_sigma_that_is_too_small(loss) -> None:
    wrong, right = (identify(DELTA, measure(DELTA, 3, ratio), LeastSquares(), loss=loss)
                    for ratio in (2.5, 1.0))  # fmt: skip
    assert "noise.loss-contradicted" in list_codes(wrong.findings)
    assert "noise.loss-contradicted" not in list_codes(right.findings)
    times = np.median(wrong.standard_deviations / right.standard_deviations)
    assert times == pytest.approx(2.5, rel=0.4)  # 20 poses, of which Tukey's loss drops some
    np.testing.assert_allclose(
        wrong.standard_deviations**2, (wrong.posterior.root**2).sum(axis=1), rtol=1e-9
    )
