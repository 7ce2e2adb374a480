# SPDX-License-Identifier: Apache-2.0
"""The sampled posterior against an independent Markov chain, and against linear intervals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import genpareto, t

import loopcal as lc
from loopcal.diagnose import intervals
from loopcal.diagnose.intervals import (
    effective_size,
    fit_tail_shape,
    normalize_weights,
    weighted_quantiles,
)
from loopcal.errors import EstimationError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.prior import prior_from
from loopcal.measure.readings import fill_in_reading_sigma
from loopcal.mechanism.model import Mechanism
from loopcal.parameters import ParameterTable
from tests.diagnose.test_cluster_covariance import THREE_TARGETS, measure
from tests.estimate.problems import MM, UM, hexapod, hexapod_data
from tests.estimate.uncertain_reading_problems import simulate_hexapod

EXACT = FitOptions(method=lc.MAP(), sigma_uncertainty=0.0)
"""Options with spreads as the prior and sigmas that are exact, as in the reference."""


def delta(
    times: float, sigma: float, poses: int = 4, seed: int = 0
) -> tuple[Mechanism, lc.Measurements]:
    """Return a delta with tolerances `times` wider than shipped, and measured positions."""
    shipped = lc.load_robot("linear-delta")
    entries = tuple(
        replace(entry, tolerance=entry.tolerance * times)
        if entry.free and entry.tolerance is not None
        else entry
        for entry in shipped.parameters.entries
    )
    robot = replace(shipped, parameters=ParameterTable(entries))
    truth = robot.with_values(lc.sample_truth(robot, 1, seed)[0])
    sensor = lc.Sensor(lc.Component(("x", "y", "z")), lc.Gaussian(np.full(3, sigma)))
    commanded = lc.sample_workspace(shipped, poses, seed).coordinates
    return robot, lc.simulate(truth, commanded, lc.Instrument((sensor,)), seed)


def find_nozzle(values: np.ndarray, readings: np.ndarray) -> np.ndarray:
    """Closed form of the delta: the lower point (m, n, 3) at the distance of each arm from the ends
    of three rods, for values (m, 10) and readings (n, 3) counted down; NaN where there is none.
    """
    radius, towers = values[:, :1], values[:, 1:].reshape(-1, 3, 3)
    angle, arm, stop = (towers[:, None, :, i] for i in range(3))
    with np.errstate(invalid="ignore"):
        height = stop + np.sqrt(arm**2 - radius[:, None] ** 2) - readings
    x, y = (np.broadcast_to(radius[:, None] * g(angle), height.shape) for g in (np.cos, np.sin))
    P = np.stack([x, y, height], axis=-1)  # (m, n, 3 towers, 3)
    first, ex = P[..., 0, :], P[..., 1, :] - P[..., 0, :]
    d = np.linalg.norm(ex, axis=-1, keepdims=True)
    ex = ex / d
    to = P[..., 2, :] - first
    i = (ex * to).sum(axis=-1, keepdims=True)
    ey = to - i * ex
    j = np.linalg.norm(ey, axis=-1, keepdims=True)
    ey = ey / j
    square = np.broadcast_to(arm**2, height.shape)
    u = (square[..., :1] - square[..., 1:2] + d**2) / (2.0 * d)
    v = (square[..., :1] - square[..., 2:] + i**2 + j**2 - 2.0 * i * u) / (2.0 * j)
    down = np.cross(ex, ey)
    down = np.where(down[..., 2:] > 0.0, -down, down)
    with np.errstate(invalid="ignore"):
        w = np.sqrt(square[..., :1] - u**2 - v**2)
    return first + u * ex + v * ey + w * down


def sample_by_walkers(
    robot: Mechanism, data: lc.Measurements, sigma: float, start: np.ndarray, steps: int
) -> np.ndarray:
    """Draw deviations (m, p) in spreads from the posterior by the stretch move of Goodman and
    Weare (2010), with closed kinematics; `start` (walkers, p).
    """
    places = np.flatnonzero(robot.parameters.free)
    nominal, tolerance = robot.parameters.nominal[places], robot.parameters.tolerance[places]
    (rows,) = data.observations

    def density(z: np.ndarray) -> np.ndarray:
        values = np.tile(robot.values, (len(z), 1))
        values[:, places] = nominal + tolerance * z
        off = (find_nozzle(values, data.readings) - rows.measured) / sigma
        square = (off**2).sum(axis=(1, 2)) + (z**2).sum(axis=1)
        return np.where(np.isfinite(square), -0.5 * square, -np.inf)

    rng, half, p = np.random.default_rng(3), len(start) // 2, start.shape[1]
    walkers, kept = start.copy(), []
    log_p = density(walkers)
    for step in range(steps):
        for mine, others in (
            (slice(0, half), slice(half, None)),
            (slice(half, None), slice(0, half)),
        ):
            partner = walkers[others][rng.integers(0, half, half)]
            stretch = (1.0 + rng.uniform(size=half)) ** 2 / 2.0
            moved = partner + stretch[:, None] * (walkers[mine] - partner)
            tried = density(moved)
            accept = (
                np.log(rng.uniform(size=half)) < (p - 1) * np.log(stretch) + tried - log_p[mine]
            )
            walkers[mine] = np.where(accept[:, None], moved, walkers[mine])
            log_p[mine] = np.where(accept, tried, log_p[mine])
        if step >= steps // 3:
            kept.append(walkers.copy())
    return np.concatenate(kept)


@pytest.mark.slow
def test_a_curved_posterior_equals_that_of_a_markov_chain_and_is_reported() -> None:
    robot, data = delta(60.0, 20 * MM, poses=3)
    fit = identify(robot, data, options=EXACT)
    known = find_nozzle(fit.robot.values[None], data.readings)[0]
    assert known == pytest.approx(lc.forward(fit.robot, data.readings).T[:, :3, 3], abs=1e-9)
    sample = lc.sample_posterior(fit, data, 5000)
    assert sample.effective_size > 800
    intervals = sample.intervals()
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(sample.draws), 100, p=sample.weight, replace=False)
    begin = (sample.draws[chosen] - fit.nominal) / fit.tolerance
    chain = fit.nominal + fit.tolerance * sample_by_walkers(robot, data, 20 * MM, begin, 1200)
    sd = chain.std(axis=0)
    assert (np.abs(intervals.center - chain.mean(axis=0)) < 0.15 * sd).all()
    assert intervals.sd / sd == pytest.approx(1.0, abs=0.15)
    low, high = np.quantile(chain, [0.025, 0.975], axis=0)
    assert (np.abs(intervals.lower - low) < 0.35 * sd).all()
    assert (np.abs(intervals.upper - high) < 0.35 * sd).all()
    # what the linear posterior misses is more than that: the radius moves by an sd
    (finding,) = sample.findings
    assert finding.code == "sampling.posterior-differs"
    assert finding.data["names"][0] == "radius"
    radius = fit.names.index("radius")
    assert intervals.is_off[radius]
    worse = (
        np.abs(intervals.linear_lower - low)[radius],
        np.abs(intervals.linear_upper - high)[radius],
    )
    assert max(worse) > 0.35 * sd[radius]


def test_linear_intervals_of_linear_problems_are_confirmed_to_a_percent() -> None:
    for seed in range(8):
        robot, data = delta(1.0, 10 * UM, 6, seed)
        sample = lc.sample_posterior(identify(robot, data, options=EXACT), data, 1000, seed=seed)
        assert [finding.code for finding in sample.findings] == ["sampling.posterior-agrees"]
        assert np.abs(sample.intervals().shift).max() < 0.03


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", ["targets", "sessions", "uncertain readings", "earlier", "estimated"]
)
def test_exact_and_linear_posterior_agree_where_rows_are_nearly_linear(case) -> None:
    options, method = FitOptions(sigma_uncertainty=0.0), lc.MAP()
    data = hexapod_data(12, seed=5)
    if case == "targets":
        data = measure(THREE_TARGETS, 20, 3)
    elif case == "sessions":
        data = measure(THREE_TARGETS, 20, 3, sessions=5)
    elif case == "uncertain readings":
        data = simulate_hexapod(12, 2 * UM)
    elif case == "earlier":
        earlier = identify(hexapod(), hexapod_data(20), lc.MAP())
        options = FitOptions(sigma_uncertainty=0.0, prior=prior_from(earlier.posterior))
        method = lc.LeastSquares()
    else:
        options, method = FitOptions(noise="estimated"), lc.LeastSquares()
    fit = identify(hexapod(), data, method, options=options)
    sample = lc.sample_posterior(fit, data, 800)
    assert sample.effective_size > 400
    assert sample.weight == pytest.approx(sample.linear_weight, rel=0.1, abs=2e-5)
    assert sample.linear_sd == pytest.approx(fit.standard_deviations, rel=1e-6)
    assert np.abs(sample.linear_mean - fit.estimate).max() < 1e-3 * fit.standard_deviations.min()
    if case == "estimated":  # Student's t: wider than normal
        half = 0.5 * np.diff([sample.intervals().lower, sample.intervals().upper], axis=0)[0]
        factor = t.ppf(0.975, fit.residual_test.noise_degrees)
        assert half == pytest.approx(factor * fit.standard_deviations, rel=0.02)


def test_few_effective_draws_are_reported_before_any_interval() -> None:
    robot, data = delta(60.0, 20 * MM, poses=3)
    sample = lc.sample_posterior(identify(robot, data, lc.MAP()), data, 300)
    assert [finding.code for finding in sample.findings] == ["sampling.few-effective-draws"]


def test_proposals_that_run_out_are_reported(monkeypatch) -> None:
    """Tests above assert that nothing is said where the first proposals are good."""
    robot, data = delta(1.0, 60 * UM, 8)
    fit = identify(robot, data, lc.MAP())
    monkeypatch.setattr(intervals, "ROUNDS", 1)
    monkeypatch.setattr(intervals, "GOOD_SHARE", 1.01)
    findings = lc.sample_posterior(fit, data, 1000).findings
    assert findings[-1].code == "sampling.proposals-exhausted"
    assert "ended after 1 rounds" in str(findings[-1])


def test_wider_stated_intervals_are_reported() -> None:
    robot, data = delta(1.0, 60 * UM, 8)
    (rows,) = data.observations
    understated = replace(rows, covariance=rows.covariance / 9.0)
    contradicted = replace(data, observations=(understated,))
    fit = identify(robot, contradicted, lc.MAP())
    assert fit.residual_test.sigma_scale > 2.0
    sample = lc.sample_posterior(fit, contradicted, 1000)
    codes = [finding.code for finding in sample.findings]
    assert codes == ["sampling.posterior-agrees", "sampling.stated-wider"]


def test_a_parameter_that_the_data_do_not_determine_has_no_interval() -> None:
    data = measure(THREE_TARGETS, 20, 3)  # an unknown frame and least squares
    fit = identify(hexapod(), data, lc.LeastSquares())
    intervals = lc.sample_posterior(fit, data, 300).intervals()
    unknown = np.isinf(fit.standard_deviations)
    assert 0 < unknown.sum() < len(unknown)
    assert (np.isnan(intervals.lower) == unknown).all()


def test_fits_without_a_posterior_are_refused() -> None:
    robot, data = delta(1.0, 10 * UM, 6)
    with pytest.raises(EstimationError, match="Ridge is a penalty without a probability"):
        lc.sample_posterior(identify(robot, data, lc.Ridge(1.0)), data)
    with pytest.raises(EstimationError, match="at least 100"):
        lc.sample_posterior(identify(robot, data), data, 10)
    stopped = identify(robot, data, options=FitOptions(control=lc.StepControl(iterations=0)))
    with pytest.raises(EstimationError, match="did not converge"):
        lc.sample_posterior(stopped, data)


def test_weighted_quantiles_and_sizes_are_those_of_repeated_draws() -> None:
    rng = np.random.default_rng(0)
    draws, count = rng.standard_normal((400, 2)), rng.integers(1, 4, 400)
    weight = count / count.sum()
    repeated = np.repeat(draws, count, axis=0)
    levels = np.array([0.05, 0.5, 0.9])
    expected = np.quantile(repeated, levels, axis=0)
    assert weighted_quantiles(draws, weight, levels) == pytest.approx(expected, abs=0.03)
    assert effective_size(np.full(50, 0.02)) == pytest.approx(50.0)
    assert normalize_weights(np.array([-1e5, -np.inf, -1e5])) == pytest.approx([0.5, 0.0, 0.5])
    assert effective_size(normalize_weights(np.full(3, -np.inf))) == 0.0


@pytest.mark.parametrize("shape", [0.2, 0.5, 0.9])
def test_the_shape_of_a_pareto_tail_is_recovered(shape) -> None:
    weight = np.asarray(genpareto.rvs(shape, size=20_000, random_state=1))
    found = fit_tail_shape(weight / weight.sum())
    assert found == pytest.approx(shape, abs=0.15)


def test_readings_with_a_sigma_are_taken_from_the_robot_or_the_data() -> None:
    data = simulate_hexapod(12, 2 * UM)
    assert fill_in_reading_sigma(hexapod(), data).reading_sigma is not None
    fit = identify(hexapod(), data, lc.MAP())
    assert lc.sample_posterior(fit, data, 100).draws.shape == (100, len(fit.names))
