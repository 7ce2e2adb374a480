# SPDX-License-Identifier: Apache-2.0
"""Conformity with a limit: the stated probability is that of the truth, and the rule follows it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, multivariate_normal, norm

from loopcal.apply.conformity import (
    LARGE,
    LEVEL,
    SMALL,
    Decision,
    Spread,
    _find_distribution,
    _find_equal_errors,
    _mix,
    _rotate,
    judge_estimate,
    judge_largest_error,
    judge_limits,
    report_conformity,
)
from loopcal.apply.validation import validate
from loopcal.errors import EstimationError
from loopcal.estimate.identification import identify
from loopcal.findings import Severity
from loopcal.io.core.text_file import to_json
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism
from loopcal.report.validation_view import view_validation
from loopcal.units import find_unit
from tests.estimate.problems import UM, noise


def isotropic(sigma: float, count: int, components: int = 3) -> np.ndarray:
    """Return covariances (e, c, c) of equal noise."""
    return np.tile(sigma**2 * np.eye(components), (count, 1, 1))


def test_estimate_of_12_um_against_15_um_conforms_with_98_percent() -> None:
    judged = judge_estimate(12 * UM, 1.5 * UM, 15 * UM)
    assert judged.probability == pytest.approx(norm.cdf(2.0))
    assert judged.expanded == pytest.approx(1.96 * 1.5 * UM, rel=1e-3)
    assert judged.guard_band == pytest.approx(1.6449 * 1.5 * UM, rel=1e-3)  # JCGM 106, 8.3.2
    assert judged.decision is Decision.CONFORMS


def test_rule_accepts_up_to_the_acceptance_limit() -> None:
    edge = judge_estimate(12 * UM, 1.5 * UM, 15 * UM).acceptance_limit
    assert judge_estimate(0.999 * edge, 1.5 * UM, 15 * UM).decision is Decision.CONFORMS
    assert judge_estimate(1.001 * edge, 1.5 * UM, 15 * UM).decision is Decision.UNDECIDED
    assert judge_estimate(19 * UM, 1.5 * UM, 15 * UM).decision is Decision.FAILS
    assert judge_estimate(12 * UM, 1.5 * UM, 15 * UM, level=0.99).decision is Decision.UNDECIDED


def test_few_degrees_of_freedom_lower_the_probability() -> None:
    known, estimated = (judge_estimate(12.0, 1.5, 15.0, degrees=n) for n in (np.inf, 3.0))
    assert estimated.probability < known.probability
    assert estimated.guard_band > known.guard_band


def test_exact_values_conform_or_fail_with_certainty() -> None:
    assert judge_estimate(15.0, 0.0, 15.0).probability == 1.0
    errors = np.array([[3.0, 4.0, 0.0], [1.0, np.nan, np.nan]])
    for limit, probability in ((5.001, 1.0), (4.999, 0.0)):
        judged = judge_largest_error(errors, np.zeros((2, 3, 3)), limit)
        assert judged.probability == probability
        assert judged.estimate == pytest.approx(5.0, rel=1e-5)


@pytest.mark.parametrize("value", [0.5, 1.0, float("nan")])
def test_senseless_levels_are_refused(value) -> None:
    with pytest.raises(EstimationError, match=r"above 0\.5 and below 1"):
        judge_estimate(1.0, 1.0, 1.0, level=value)


def test_senseless_estimates_are_refused() -> None:
    with pytest.raises(EstimationError, match="finite numbers"):
        judge_estimate(float("nan"), 1.0, 1.0)
    with pytest.raises(EstimationError, match="the data contain no error"):
        judge_largest_error(np.full((1, 3), np.nan), np.zeros((1, 3, 3)), 1.0)


@pytest.mark.parametrize("spread", [SMALL, LARGE], ids=["small", "large"])
def test_distribution_is_that_of_drawn_errors(spread: Spread) -> None:
    """Correlated noise of unequal components, against drawing tau, the tails and the errors."""
    rng = np.random.default_rng(0)
    errors, count = 2.0 * rng.normal(size=(6, 3)), 20_000
    noise = np.array([[1.0, 0.5, 0.0], [0.5, 2.0, 0.0], [0.0, 0.0, 0.1]])
    scales = np.exp(np.linspace(np.log(0.03), np.log(40.0), 300))
    variances = scales[:, None] ** 2 / spread.tails  # (s, k)
    each = np.array(
        [
            [w * multivariate_normal.pdf(errors, cov=noise + v * np.eye(3)) for v, w in pairs]
            for pairs in (list(zip(of_scale, spread.shares, strict=True)) for of_scale in variances)
        ]
    )  # (s, k, e)
    log_weight = np.log(each.sum(axis=1)).sum(axis=1) + spread.slope * np.log(scales)
    weight = np.exp(log_weight - np.max(log_weight))
    drawn = rng.choice(len(scales), count, p=weight / weight.sum())
    sizes = np.zeros((count, 6))
    for s in np.unique(drawn):
        chosen = np.flatnonzero(drawn == s)
        for e in range(6):
            tails = rng.choice(
                len(spread.tails), len(chosen), p=each[s, :, e] / each[s, :, e].sum()
            )
            for k in np.unique(tails):
                V = np.linalg.inv(np.linalg.inv(noise) + np.eye(3) / variances[s, k])
                mean, which = errors[e] @ np.linalg.inv(noise) @ V, chosen[tails == k]
                t = mean + rng.multivariate_normal(np.zeros(3), V, len(which))
                sizes[which, e] = np.linalg.norm(t, axis=1)
    largest = sizes.max(axis=1)
    rotated = _rotate(errors, np.tile(noise, (6, 1, 1)))
    below = _find_distribution(*rotated, 1.0, np.inf, spread).below
    for limit in (6.0, *np.quantile(largest, [0.025, 0.05, 0.95, 0.975])):
        assert below(limit) == pytest.approx((largest <= limit).mean(), abs=0.015)


def draw_statements(sets: int, seed: int) -> np.ndarray:
    """Return (2, 2) the number of statements "conforms" and "does not conform", right and wrong,
    where limits are within a quarter of the largest true error, and this of the size of the noise.

    Errors are normal, with the tails of Student's t, of equal sizes, with one large, or of heights.
    """
    rng, counts = np.random.default_rng(seed), np.zeros((2, 2), dtype=int)
    for i in range(sets):
        n, kind, true = (6, 15, 25)[i % 3], i // 3 % 5, 10 ** rng.uniform(-0.3, 0.8)
        t = rng.standard_normal((n, 1 if kind == 4 else 3))
        if kind == 1:
            t *= np.sqrt(4.0 / rng.chisquare(4, (n, 1)))
        if kind == 2:
            t *= 1.6 / np.linalg.norm(t, axis=1, keepdims=True)
        t[0] *= 4.0 if kind == 3 else 1.0
        t *= true
        # sigma known to 25 % in every second set
        scale, degrees = (np.exp(0.25 * rng.standard_normal()), 8.0) if i % 2 else (1.0, np.inf)
        errors = _rotate(t + scale * rng.standard_normal(t.shape), isotropic(1.0, n, t.shape[1]))
        large = _find_distribution(*errors, 1.0, degrees, LARGE).below
        small = _find_distribution(*errors, 1.0, degrees, SMALL)
        small = _mix(small, _find_equal_errors(*errors, 1.0, degrees))
        for share in (0.77, 0.85, 0.93, 0.98, 1.02, 1.07, 1.15, 1.23):
            limit = share * float(np.linalg.norm(t, axis=1).max())
            low, high = sorted((large(limit), small(limit)))
            counts[0, int(share < 1.0)] += low >= LEVEL
            counts[1, int(share > 1.0)] += high <= 1.0 - LEVEL
    return counts


@pytest.mark.parametrize("sets", [60, pytest.param(1200, marks=pytest.mark.evidence)])
def test_at_most_one_statement_in_20_is_wrong_where_limits_are_near_the_true_error(sets) -> None:
    for right, wrong in draw_statements(sets, seed=4):
        count = right + wrong
        assert count >= 0.5 * sets
        # at most 5 % of statements, up to a chance of 1 %
        assert wrong <= binom.ppf(0.99, count, 1.0 - LEVEL), (wrong, count)


@pytest.mark.parametrize("limit", [1e-3, 1e-2, 0.05])
def test_noise_alone_fails_no_limit_far_below_it(limit) -> None:
    for seed in range(3):
        errors = np.random.default_rng(seed).standard_normal((12, 3))
        judged = judge_largest_error(errors, isotropic(1.0, 12), limit)
        assert judged.decision is Decision.UNDECIDED


def test_groups_of_many_similar_errors_change_little(monkeypatch) -> None:
    errors = 1.5 * np.random.default_rng(1).normal(size=(1000, 3))
    grouped = judge_largest_error(errors, isotropic(1.0, 1000), 5.0)
    monkeypatch.setattr("loopcal.apply.conformity.MOST", 1000)
    single = judge_largest_error(errors, isotropic(1.0, 1000), 5.0)
    assert grouped.probability == pytest.approx(single.probability, abs=2e-3)
    assert grouped.bound == pytest.approx(single.bound, rel=1e-3)


def test_components_that_are_not_measured_do_not_count() -> None:
    errors = np.array([[1.0, np.nan, np.nan], [-2.0, np.nan, np.nan], [0.5, np.nan, np.nan]])
    full = judge_largest_error(errors, isotropic(0.3, 3), 2.2)
    one = judge_largest_error(errors[:, :1], isotropic(0.3, 3)[:, :1, :1], 2.2)
    assert full.probability == pytest.approx(one.probability, rel=1e-9)


def measure_positions(machine: Mechanism, points: np.ndarray, sigma: float, seed: int):
    """Measure x, y and z of commanded points with this noise [m]."""
    instrument = Instrument((Sensor(Component(("x", "y", "z")), noise(sigma, sigma, sigma)),))
    return simulate(machine, points, instrument, seed, controller=machine.nominal)


def collect_statements(count: int) -> np.ndarray:
    """Stated probabilities, and whether the truth conforms, for limits near the measured error and
    the true one.

    Each machine has errors within its spreads, and is calibrated and validated by measurements
    with noise; half of the calibrations leave errors of the arms in the machine. The true error is
    the one of the same poses without the noise of the validation.
    """
    nominal, rows = load_robot("linear-delta"), []
    names = [n for n in nominal.parameters.names if not n.endswith((".length", "1.stop"))]
    rigid = replace(nominal, parameters=nominal.parameters.with_free(names))
    machines = sample_truth(nominal, count, seed=5)
    for i, values in enumerate(machines):
        rng = np.random.default_rng(i)
        truth = nominal.with_values(nominal.values + 0.1 * (values - nominal.values))
        points = rng.uniform([-0.06, -0.06, 0.0], [0.06, 0.06, 0.05], (24, 3))
        sigma = 10 ** rng.uniform(-0.7, 1.5) * UM
        fit = identify(
            (nominal, rigid)[i % 2], measure_positions(truth, points[:16], sigma, seed=i)
        )
        measured = measure_positions(truth, points[16:], sigma, seed=1000 + i)
        exact = measure_positions(truth, points[16:], 1e-6 * sigma, seed=i)
        result, true = validate(fit, measured), validate(fit, exact).after.position.max()
        known = (result.noise.scale, result.noise.degrees)
        largest = result.after.position.max()
        for limit in (*np.array([0.2, 0.4, 0.7, 1.0, 1.5, 2.5]) * largest, 0.9 * true, 1.1 * true):
            judged = judge_limits(measured.observations, result.after, {"position": limit}, *known)
            stated = judged["position"]
            rows.append((stated.probability, stated.most_probable, true <= limit))
    return np.array(rows)


@pytest.mark.evidence
def test_stated_probabilities_contain_the_shares_that_conform() -> None:
    lowest, highest, conforms = collect_statements(28).T
    assert conforms[lowest >= 0.9].mean() >= 0.93
    doubtful = (highest > 0.05) & (lowest < 0.9)
    share = conforms[doubtful].mean()
    assert lowest[doubtful].mean() - 0.1 < share < highest[doubtful].mean() + 0.1


def test_conform_and_does_not_conform_are_wrong_in_at_most_their_stated_probability() -> None:
    """Truths of simulated machines; also limits that are a tenth off the true error."""
    lowest, highest, conforms = collect_statements(8).T
    for stated, is_right in ((lowest >= LEVEL, conforms), (highest <= 1.0 - LEVEL, 1.0 - conforms)):
        wrong, count = int((1.0 - is_right)[stated].sum()), int(stated.sum())
        assert count >= 8
        # at most 5 % of statements: more wrong ones than that by chance have a probability of 1 %
        assert wrong <= binom.ppf(0.99, count, 1.0 - LEVEL), (wrong, count)


@pytest.fixture(scope="module")
def held_out():
    """Return a fit of the linear delta and held-out rows with noise of 20 um."""
    robot = load_robot("linear-delta")
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (28, 3)) * [1.0, 1.0, 0.5]
    data = measure_positions(robot, points, 20 * UM, seed=0)
    return identify(robot, data.take(np.arange(28) < 18)), data.take(np.arange(28) >= 18)


def test_validation_states_conformity_on_the_page_and_in_the_result(held_out) -> None:
    result = validate(*held_out, limit_position=0.2e-3)
    text = str(view_validation(result, True, False))
    assert "Largest of 10 position errors, without the noise of the measurement: " in text
    (finding,) = [f for f in result.findings if f.code == "conformity.conforms"]
    assert " um " in str(finding)
    assert " mm" not in str(finding)
    assert (
        " against the limit 200 um: conforms. The probability of being within the limit is more "
        in text
    )
    stored = json.loads(to_json(result.to_dict()))["conformity"]["position"]
    assert stored["decision"] == "conforms"
    assert stored["acceptance_limit"] < stored["limit"] == 0.2e-3
    assert "orientation" not in result.conformity


def test_interval_that_is_not_centered_is_stated_by_its_bounds(held_out) -> None:
    """Estimate -/+ half the interval would state errors below zero, and too low an upper bound."""
    fit, data = held_out
    quiet, limit = np.zeros((8, 3)), 3e-5
    quiet[:, 0] = 1e-5
    skewed = judge_largest_error(quiet, isotropic(1e-5, 8), limit)
    assert skewed.estimate < skewed.expanded
    assert skewed.high > 1.1 * (skewed.estimate + skewed.expanded)

    def state(judged) -> str:
        limits = {"position": limit}
        errors = validate(fit, data).after
        units, poses = {"position": find_unit("mm")}, data.labels
        return str(report_conformity({"position": judged}, limits, errors, units, poses)[0])

    low, high = (f"{1e6 * bound:.1f} um" for bound in (skewed.low, skewed.high))
    assert f"(95 % interval {low} to {high})" in state(skewed)
    assert "+/-" not in state(skewed)
    centered = judge_estimate(12 * UM, 1.5 * UM, limit)
    assert "12.0 um +/- 2.9 um (95 %)" in state(centered)


def test_limit_that_noise_leaves_open_is_a_warning(held_out) -> None:
    largest = validate(*held_out, limit_position=1.0).conformity["position"]
    limit = 0.5 * (largest.estimate + largest.bound)
    result = validate(*held_out, limit_position=limit)
    (found,) = (f for f in result.findings if f.code.startswith("conformity."))
    assert (found.code, found.severity) == ("conformity.undecided", Severity.WARNING)
    assert ": undecided. The probability" in str(found)


def test_noise_that_nobody_stated_gives_no_probability(held_out) -> None:
    fit, data = held_out
    assumed = tuple(replace(o, is_noise_assumed=True) for o in data.observations)
    result = validate(fit, replace(data, observations=assumed), limit_position=1e-3)
    assert not result.conformity
    assert any(f.code == "gates.limit-kept" for f in result.findings)
    exceeded = validate(fit, replace(data, observations=assumed), limit_position=1e-9)
    assert [f.code for f in exceeded.failures] == ["gates.limit-exceeded"]


def test_setup_fitted_to_the_same_rows_leaves_less_noise_to_subtract(held_out) -> None:
    _, data = held_out
    errors = validate(*held_out).after
    full, part = (
        judge_limits(data.observations, errors, {"position": 1e-3}, scale)["position"]
        for scale in (1.0, 0.7)
    )
    assert part.estimate > full.estimate
