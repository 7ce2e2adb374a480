# SPDX-License-Identifier: Apache-2.0
"""Changes of a machine between two calibrations: the false-alarm rate, and what is named."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.penalties import MAP, LeastSquares, Ridge
from loopcal.estimate.posterior import (
    CovariancePart,
    Posterior,
    compute_posterior,
    fold_information,
    posterior_from_arrays,
)
from loopcal.estimate.recalibration import (
    CHANGE_LEVEL,
    Change,
    ErrorPart,
    ParameterChanges,
    compare_information,
    explain_change,
    recalibrate,
)
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.statistics import compute_averaged_tail
from tests.estimate.problems import UM, noise

ROBOTS = {name: load_robot(name) for name in ("linear-delta", "five-bar")}
SIGMA = 10 * UM


def measure(
    robot: Mechanism, machine: Mechanism, seed: int, poses: int = 12, unknown=(), ratio: float = 1.0
) -> Measurements:
    """Return positions whose noise is `ratio` times the stated sigma."""
    coordinates = sample_workspace(robot, poses, seed).coordinates
    sensor = Sensor(Position(unknown=unknown), noise(*[ratio * SIGMA] * 3))
    data = simulate(machine, coordinates, Instrument((sensor,)), seed)
    rows = data.observations[0]
    return replace(data, observations=(replace(rows, covariance=rows.covariance / ratio**2),))


def compare(
    robot: Mechanism, machines, seeds, method=None, poses=12, unknown=(), ratio=1.0
) -> ParameterChanges:
    """Calibrate two machines, and compare what their data say."""
    posteriors = [
        identify(robot, measure(robot, machine, seed, poses, unknown, ratio), method).posterior
        for machine, seed in zip(machines, seeds, strict=True)
    ]
    return compare_information(*posteriors)


def draw_machine(robot: Mechanism, seed: int) -> Mechanism:
    return robot.with_values(sample_truth(robot, 1, seed)[0])


def identify_batch(robot: Mechanism, truths: np.ndarray, seed: int, poses: int) -> list[Posterior]:
    """Return the posteriors of many machines, with the noise that their residuals show."""
    coordinates = sample_workspace(robot, poses, seed).coordinates
    instrument = Instrument((Sensor(Position(), noise(*[SIGMA] * 3)),))
    trials = simulate_trials(robot, truths, coordinates, instrument, seed)
    fits = identify_trials(robot, trials, MAP())
    assert fits.converged.all()
    free, posteriors = fits.free_parameters, []
    for i in range(len(truths)):
        d = fits.decomposition.take(np.array([i]))
        machine = robot.with_values(fits.values[i])
        one = compute_posterior(machine, free.places, free.tolerance, d, fits.penalty[[i]])
        degrees = float((d.rows - d.rank)[0])
        information = fold_information(free, d, float(d.unexplained[0]) / degrees, degrees)
        posteriors.append(replace(one, information=information))
    return posteriors


def judge_batch(robot: Mechanism, count: int, poses: int) -> np.ndarray:
    """Return the p-values of pairs of calibrations of random machines that have not changed."""
    truths = sample_truth(robot, count, 1)
    pairs = zip(*(identify_batch(robot, truths, seed, poses) for seed in (2, 3)), strict=True)
    compared = [compare_information(*pair) for pair in pairs]
    return np.array([c.compute_probability() for c in compared])


def judge_unmoved(name: str, count: int, **options) -> np.ndarray:
    """Return the same p-values where each machine is calibrated at poses of its own."""
    robot = ROBOTS[name]
    p_values = []
    for seed in range(count):
        truth = draw_machine(robot, seed)
        changes = compare(robot, (truth, truth), (1000 + seed, 5000 + seed), **options)
        p_values.append(changes.compute_probability())
    return np.array(p_values)


def assert_uniform(p_values: np.ndarray) -> None:
    """5 % false alarms, and p-values that are as frequent everywhere."""
    count = len(p_values)
    assert (p_values < 0.05).sum() <= stats.binom.ppf(0.999, count, 0.05)
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(("name", "count"), [("linear-delta", 60), ("five-bar", 40)])
def test_unmoved_machines_are_declared_changed_at_the_stated_rate(name, count) -> None:
    """100 pairs, whose tolerances pull both estimates to the same nominal values."""
    assert_uniform(judge_batch(ROBOTS[name], count, 10))


def test_a_frame_that_differs_between_sessions_is_no_change() -> None:
    p_values = judge_unmoved("five-bar", 8, unknown=("frame",))
    assert_uniform(p_values)


def test_a_wrong_sigma_does_not_change_the_rate() -> None:
    """A sigma that is three times too small would move every machine."""
    assert_uniform(judge_unmoved("linear-delta", 8, ratio=3.0))


@pytest.mark.evidence
@pytest.mark.parametrize("name", sorted(ROBOTS))
@pytest.mark.parametrize("unknown", [(), ("frame",)])
def test_false_alarm_rate_of_many_machines(name, unknown) -> None:
    p_values = judge_unmoved(name, 400, unknown=unknown, poses=15)
    rate = (p_values < 0.05).mean()
    assert abs(rate - 0.05) < 3.3 * np.sqrt(0.05 * 0.95 / 400)
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3


def move(machine: Mechanism, **changes: float) -> Mechanism:
    """Return a machine whose parameters have changed [SI]; `__` stands for a point."""
    values = machine.values.copy()
    for name, change in changes.items():
        values[machine.parameters.index(name.replace("__", "."))] += change
    return machine.with_values(values)


def test_the_moved_parameter_is_named_with_its_change() -> None:
    robot = ROBOTS["linear-delta"]
    named = []
    for seed in range(8):
        truth = draw_machine(robot, seed)
        moved = move(truth, tower2__stop=40 * UM)
        changes = compare(robot, (truth, moved), (seed, 100 + seed))
        assert changes.compute_probability() < 1e-3
        cause = explain_change(changes, 0.01)
        named.append((cause.kind, cause.names))
        if named[-1] == ("parameter", ("tower2.stop",)):
            places = [changes.names.index(name) for name in cause.parameters]
            shift, sd = changes.select(places).estimate_shifts()
            assert abs(shift[0] - 40 * UM) < 4.0 * sd[0]
    assert named.count(("parameter", ("tower2.stop",))) >= 7


def test_a_moved_limb_and_two_moved_limbs_are_named() -> None:
    """Several parameters of limb 2; then also one of limb 3."""
    robot = ROBOTS["five-bar"]
    truth = draw_machine(robot, 3)
    free = [p.name for p in robot.parameters.entries if p.free]
    limbs = sorted({name.split(".")[0] for name in free if "." in name})
    of_first = [name for name in free if name.startswith(f"{limbs[0]}.")][:3]
    sizes = (300 * UM, -200 * UM, 250 * UM)
    changed = {n.replace(".", "__"): c for n, c in zip(of_first, sizes, strict=False)}
    changes = compare(robot, (truth, move(truth, **changed)), (3, 103), poses=30)
    cause = explain_change(changes, 0.01)
    assert cause.kind in ("limb", "parameter")
    every = {cause.names, *cause.alternatives}
    assert any(name.split(".")[0] == limbs[0] for names in every for name in names)


def test_the_shift_of_each_parameter_has_the_stated_spread() -> None:
    robot = ROBOTS["linear-delta"]
    truths = sample_truth(robot, 40, 5)
    pairs = zip(*(identify_batch(robot, truths, seed, 10) for seed in (6, 7)), strict=True)
    compared = [compare_information(*pair) for pair in pairs]
    ratios = np.array([np.divide(*c.estimate_shifts()) for c in compared])
    assert np.sqrt(np.mean(ratios**2)) == pytest.approx(1.0, abs=0.12)
    p_values = np.concatenate([c.test_shifts() for c in compared])
    assert (p_values < 0.05).mean() == pytest.approx(0.05, abs=0.035)


def test_a_method_does_not_change_what_data_say() -> None:
    """Ridge with a strong penalty pulls estimates to nominal; the comparison is the same."""
    robot = ROBOTS["linear-delta"]
    truth = draw_machine(robot, 5)
    plain = compare(robot, (truth, truth), (5, 105), LeastSquares())
    ridge = compare(robot, (truth, truth), (5, 105), Ridge(30.0))
    assert ridge.degrees == plain.degrees == 9
    assert ridge.chi_square == pytest.approx(plain.chi_square, rel=0.05)


def test_information_survives_a_run_folder() -> None:
    robot = ROBOTS["linear-delta"]
    truth = draw_machine(robot, 6)
    fits = [identify(robot, measure(robot, truth, seed)) for seed in (6, 106)]
    stored = [posterior_from_arrays(fit.robot, fit.arrays()) for fit in fits]
    direct = compare_information(*(fit.posterior for fit in fits))
    read = compare_information(*stored)
    assert read.chi_square == pytest.approx(direct.chi_square, rel=1e-12)
    assert direct.sources == read.sources


def test_added_errors_widen_the_comparison() -> None:
    """A covariance that another diagnosis adds enters both the spread and the probability."""
    robot = ROBOTS["linear-delta"]
    truth = draw_machine(robot, 7)
    fits = [identify(robot, measure(robot, truth, seed)) for seed in (7, 107)]
    plain = compare_information(*(fit.posterior for fit in fits))
    root = np.zeros((len(fits[0].names), 1))
    root[fits[0].names.index("tower2.stop")] = 100 * UM
    part = CovariancePart("residuals.drift", root, 5.0)
    wide = replace(fits[0].posterior, parts=(*fits[0].posterior.parts, part))
    changes = compare_information(wide, fits[1].posterior)
    place = fits[0].names.index("tower2.stop")
    sd = changes.estimate_shifts()[1][place]
    expected = np.hypot(plain.estimate_shifts()[1][place], 100 * UM)
    assert sd == pytest.approx(expected, rel=1e-6)
    alone = changes.test_shifts()[place]
    shift = changes.estimate_shifts()[0][place]
    assert alone == pytest.approx(2.0 * stats.t.sf(abs(shift) / sd, 5.0), rel=0.1)
    assert len(changes.sources) == 3
    assert sum(share for share, _ in changes.sources) == pytest.approx(changes.degrees)


def make_changes(value: np.ndarray, degrees=(np.inf, np.inf), share=0.5) -> ParameterChanges:
    """Changes of parameters of which each is one direction; the first part has this share."""
    count = len(value)
    roots = [np.sqrt(part) * np.eye(count) for part in (share, 1.0 - share)]
    names = tuple(f"leg{i // 6}.p{i % 6}" for i in range(count))
    errors = tuple(map(ErrorPart, roots, degrees))
    return ParameterChanges(names, np.ones(count), np.eye(count), value, errors)


def test_a_change_of_one_parameter_is_not_lost_among_30_directions() -> None:
    value = np.tile([0.9, -0.9], 15)
    value[7] = 4.2
    changes = make_changes(value)
    assert changes.compute_p_value(changes.chi_square, 30) > 0.05
    assert changes.compute_probability() < 0.01
    assert make_changes(10.0 * value).compute_probability() < 1e-12  # beyond the draws


@pytest.mark.parametrize("degrees", [(np.inf, np.inf), (6.0, 12.0)])
def test_probability_of_a_change_is_uniform_with_known_and_estimated_noise(degrees) -> None:
    rng = np.random.default_rng(1)
    p_values = []
    for _ in range(40):
        sizes = [1.0 if np.isinf(nu) else rng.chisquare(nu) / nu for nu in degrees]
        value = rng.standard_normal(6) / np.sqrt(np.mean(sizes))
        changes = make_changes(value, degrees, sizes[0] / sum(sizes))
        p_values.append(changes.compute_probability())
    assert_uniform(np.array(p_values))


def test_the_pull_of_tolerances_is_no_error_of_what_data_say() -> None:
    """The comparison contains no spread, so an inflated one must not widen it."""
    robot = ROBOTS["linear-delta"]
    truth = draw_machine(robot, 7)
    fits = [identify(robot, measure(robot, truth, seed), LeastSquares()) for seed in (7, 107)]
    plain = compare_information(*(fit.posterior for fit in fits))
    root = 100 * UM * np.ones((len(fits[0].names), 1))
    part = CovariancePart("prior.inflation", root, np.inf)
    pulled = replace(fits[0].posterior, parts=(*fits[0].posterior.parts, part))
    changes = compare_information(pulled, fits[1].posterior)
    assert changes.chi_square == pytest.approx(plain.chi_square, rel=1e-12)


# With an earlier calibration as the prior.

STATED = 20 * UM


def measure_delta(
    machine: Mechanism, seed: int, ratio: float, poses: int = 20, unknown: tuple[str, ...] = ()
) -> Measurements:
    """Return positions whose noise is `ratio` times the stated sigma; other numbers are equal."""
    coordinates = sample_workspace(ROBOTS["linear-delta"], poses, seed).coordinates
    stated, exact = (
        Instrument((Sensor(Position(unknown=unknown), noise(*[sd] * 3)),)) for sd in (STATED, 1e-12)
    )
    data = simulate(machine, coordinates, stated, seed)
    rows = simulate(machine, coordinates, exact, seed).observations[0]
    error = ratio * STATED * np.random.default_rng(seed + 10**6).standard_normal((poses, 3))
    rows = replace(data.observations[0], measured=rows.measured + error)
    return replace(data, observations=(rows,))


def recalibrate_delta(
    seed: int, before: float, after: float, limb=None, poses=20, unknown=()
) -> Change:
    """Calibrate an unmoved machine twice, with noise of these ratios to the stated sigma."""
    truth = ROBOTS["linear-delta"].with_values(sample_truth(ROBOTS["linear-delta"], 1, seed)[0])
    first = identify(
        ROBOTS["linear-delta"], measure_delta(truth, seed, before, unknown=unknown), LeastSquares()
    )
    data = measure_delta(truth, seed + 5000, after, poses, unknown)
    return recalibrate(ROBOTS["linear-delta"], data, first.posterior, limb)[1]


@pytest.mark.parametrize("limb", [None, "tower1"])
def test_a_wrong_sigma_does_not_change_the_test_of_a_prior(limb) -> None:
    """Sigmas that are three times too small and twice too large, in one calibration or in both."""
    for seed in (0,):
        right = recalibrate_delta(seed, 1.0, 1.0, limb)
        assert right.moved == (right.p_value < CHANGE_LEVEL)
        for before, after in [(3.0, 3.0), (0.5, 0.5), (2.0, 1.0), (1.0, 3.0)]:
            wrong = recalibrate_delta(seed, before, after, limb)
            assert wrong.degrees == right.degrees
            if before == after:
                assert wrong.p_value == pytest.approx(right.p_value, rel=0.1)
            assert wrong.chi_square / wrong.degrees < 4.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ratio", "poses", "unknown"),
    [(2.0, 20, ()), pytest.param(0.5, 8, ("frame",), marks=pytest.mark.evidence)],
)
def test_unmoved_machines_are_declared_moved_at_the_stated_rate(ratio, poses, unknown) -> None:
    """5 % of 10; p-values are uniform. Before, a sigma twice too small moved nearly every one."""
    changes = [recalibrate_delta(s, ratio, ratio, poses=poses, unknown=unknown) for s in range(10)]
    p_values = [change.p_value for change in changes]
    moved = [change.moved for change in changes if change.moved is not None]
    assert len(moved) == 10
    assert sum(moved) <= stats.binom.ppf(0.999, 10, CHANGE_LEVEL)
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3
    assert all(change.finding.data["level"] == CHANGE_LEVEL for change in changes)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 3.0])
def test_moved_machines_are_found(ratio) -> None:
    """One parameter by 5 standard deviations of its difference, and a limb."""
    truth = ROBOTS["linear-delta"].with_values(sample_truth(ROBOTS["linear-delta"], 1, 4)[0])
    first = identify(ROBOTS["linear-delta"], measure_delta(truth, 4, ratio), LeastSquares())
    place = first.names.index("tower2.stop")
    stated = [
        identify(ROBOTS["linear-delta"], measure_delta(truth, seed, 1.0), LeastSquares())
        for seed in (4, 14)
    ]
    sd = ratio * np.hypot(*(fit.standard_deviations[place] for fit in stated))
    values = truth.values.copy()
    values[first.posterior.places[place]] += 5.0 * sd
    data = measure_delta(truth.with_values(values), 14, ratio)
    for limb in (None, "tower2"):
        change = recalibrate(ROBOTS["linear-delta"], data, first.posterior, limb)[1]
        assert change.moved
        assert change.p_value < 1e-2
    assert change.finding.data["names"] == ("tower2.stop",)


def test_probability_with_estimated_noise_is_the_f_distribution_for_one_source() -> None:
    for ratio in (0.5, 1.0, 2.0, 3.0):
        for nu in (6.0, 30.0):
            p_value = compute_averaged_tail(7.0 * ratio, 7.0, [(7.0, nu)])
            assert p_value == pytest.approx(stats.f.sf(ratio, 7.0, nu), rel=0.02, abs=1e-4)
        known = compute_averaged_tail(7.0 * ratio, 7.0, [(3.0, np.inf), (4.0, np.inf)])
        assert known == pytest.approx(stats.chi2.sf(7.0 * ratio, 7.0), rel=1e-12)
    two = compute_averaged_tail(14.0, 7.0, [(3.0, 8.0), (4.0, np.inf)])
    assert stats.chi2.sf(14.0, 7.0) < two < stats.f.sf(2.0, 7.0, 8.0)


@pytest.mark.parametrize("method", [LeastSquares(), None])
def test_copies_in_an_unknown_form_agree_too_well(method) -> None:
    """Rows rounded to 0.2 sigma are not recognized, but the change is too small; new rows and those
    of a moved machine do not agree too well.
    """
    truth = ROBOTS["linear-delta"].with_values(sample_truth(ROBOTS["linear-delta"], 1, 4)[0])
    data = measure_delta(truth, 4, 1.0)
    first = identify(ROBOTS["linear-delta"], data, method)
    rows = data.observations[0]
    step = 0.2 * STATED
    copy = replace(rows, measured=np.round(rows.measured / step) * step)
    change = recalibrate(
        ROBOTS["linear-delta"], replace(data, observations=(copy,)), first.posterior
    )[1]
    assert change.finding.code == "prior.agree-too-well"
    assert change.moved is False
    assert change.finding.data["probability"] < 1e-3
    for seed in range(5, 15):
        other = recalibrate(
            ROBOTS["linear-delta"], measure_delta(truth, seed, 1.0), first.posterior
        )[1]
        assert other.finding.code in ("prior.machine-unchanged", "prior.machine-changed")
