# SPDX-License-Identifier: Apache-2.0
"""Whether a machine has moved is judged by the noise that both calibrations show."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.recalibration import CHANGE_LEVEL, Change, recalibrate
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.statistics import compute_averaged_tail
from tests.estimate.problems import UM, noise

DELTA = load_robot("linear-delta")
SIGMA = 20 * UM


def measure(
    machine: Mechanism, seed: int, ratio: float, poses: int = 20, unknown: tuple[str, ...] = ()
) -> Measurements:
    """Return positions whose noise is `ratio` times the stated sigma; other numbers are equal."""
    coordinates = sample_workspace(DELTA, poses, seed).coordinates
    stated, exact = (
        Instrument((Sensor(Position(unknown=unknown), noise(*[sd] * 3)),)) for sd in (SIGMA, 1e-12)
    )
    data = simulate(machine, coordinates, stated, seed)
    rows = simulate(machine, coordinates, exact, seed).observations[0]
    error = ratio * SIGMA * np.random.default_rng(seed + 10**6).standard_normal((poses, 3))
    rows = replace(data.observations[0], measured=rows.measured + error)
    return replace(data, observations=(rows,))


def compare(seed: int, before: float, after: float, limb=None, poses=20, unknown=()) -> Change:
    """Calibrate an unmoved machine twice, with noise of these ratios to the stated sigma."""
    truth = DELTA.with_values(sample_truth(DELTA, 1, seed)[0])
    first = identify(DELTA, measure(truth, seed, before, unknown=unknown), LeastSquares())
    data = measure(truth, seed + 5000, after, poses, unknown)
    return recalibrate(DELTA, data, first.posterior, limb)[1]


@pytest.mark.parametrize("limb", [None, "tower1"])
def test_a_wrong_sigma_does_not_change_the_test(limb) -> None:
    """Sigmas that are three times too small and twice too large, in one calibration or in both."""
    for seed in (0,):
        right = compare(seed, 1.0, 1.0, limb)
        assert right.moved == (right.p_value < CHANGE_LEVEL)
        for before, after in [(3.0, 3.0), (0.5, 0.5), (2.0, 1.0), (1.0, 3.0)]:
            wrong = compare(seed, before, after, limb)
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
    changes = [compare(s, ratio, ratio, poses=poses, unknown=unknown) for s in range(10)]
    p_values = [change.p_value for change in changes]
    moved = [change.moved for change in changes if change.moved is not None]
    assert len(moved) == 10
    assert sum(moved) <= stats.binom.ppf(0.999, 10, CHANGE_LEVEL)
    assert stats.kstest(p_values, "uniform").pvalue > 1e-3
    assert all(change.finding.data["level"] == CHANGE_LEVEL for change in changes)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 3.0])
def test_moved_machines_are_found(ratio) -> None:
    """One parameter by 5 standard deviations of its difference, and a limb."""
    truth = DELTA.with_values(sample_truth(DELTA, 1, 4)[0])
    first = identify(DELTA, measure(truth, 4, ratio), LeastSquares())
    place = first.names.index("tower2.stop")
    stated = [identify(DELTA, measure(truth, seed, 1.0), LeastSquares()) for seed in (4, 14)]
    sd = ratio * np.hypot(*(fit.standard_deviations[place] for fit in stated))
    values = truth.values.copy()
    values[first.posterior.places[place]] += 5.0 * sd
    data = measure(truth.with_values(values), 14, ratio)
    for limb in (None, "tower2"):
        change = recalibrate(DELTA, data, first.posterior, limb)[1]
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
    truth = DELTA.with_values(sample_truth(DELTA, 1, 4)[0])
    data = measure(truth, 4, 1.0)
    first = identify(DELTA, data, method)
    rows = data.observations[0]
    step = 0.2 * SIGMA
    copy = replace(rows, measured=np.round(rows.measured / step) * step)
    change = recalibrate(DELTA, replace(data, observations=(copy,)), first.posterior)[1]
    assert change.finding.code == "prior.agree-too-well"
    assert change.moved is False
    assert change.finding.data["probability"] < 1e-3
    for seed in range(5, 15):
        other = recalibrate(DELTA, measure(truth, seed, 1.0), first.posterior)[1]
        assert other.finding.code in ("prior.machine-unchanged", "prior.machine-changed")
