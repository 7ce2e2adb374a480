# SPDX-License-Identifier: Apache-2.0
"""The study of broken assumptions: what it simulates, how it judges, and that its results hold."""

import json

import numpy as np
import pytest
from scipy.stats import binom

from evidence.assumptions.cases import SETUPS, Case, list_cases
from evidence.assumptions.evaluation import evaluate_case, is_met
from evidence.assumptions.levels import STATED_LEVELS, name_group
from evidence.assumptions.simulation import describe_noise, simulate_case
from loopcal import load_robot
from loopcal.estimate.residual_test import FALSE_ALARMS
from loopcal.measure.instrument import Gaussian
from loopcal.studies.simulation.machines import AlteredNoise

SCRIPTS = {"linear-delta": "delta", "five-bar": "five_bar", "hexapod-42": "hexapod"}


def draw(case, n=4000, columns=3):
    """Draw noise of unit sigma."""
    noise = AlteredNoise(Gaussian(np.ones(columns)), describe_noise(case))
    return noise.draw(np.random.default_rng(0), n)


def test_broken_noise_has_the_stated_size_and_correlation():
    assert draw(Case("", noise=1.3)).std() == pytest.approx(1.3, rel=0.03)
    correlated = draw(Case("", correlation=0.6), 20_000)
    assert correlated.std() == pytest.approx(1.0, rel=0.03)
    neighbors = (correlated[1:] * correlated[:-1]).mean() / correlated.var()
    assert neighbors == pytest.approx(0.6, abs=0.02)
    heavy = draw(Case("", degrees=3.0), 40_000)
    assert heavy.std() == pytest.approx(1.0, rel=0.1)
    assert (np.abs(heavy) > 4.0).mean() > 20 * 6.3e-5  # that of normal noise


def test_outliers_are_20_sigma_off_in_5_percent_of_the_poses():
    distance = np.linalg.norm(draw(Case("", outliers=0.05), 40), axis=1)
    assert (distance > 10.0).sum() == 2


@pytest.mark.parametrize("name", SETUPS)
def test_drift_and_jump_displace_the_instrument_with_mean_zero(name):
    setup = SETUPS[name]
    clean = simulate_case(setup, Case(""), 2)
    for case, ends in ((Case("", drift=5.0), 5.0), (Case("", jump=4.0), 4.0)):
        moved = simulate_case(setup, case, 2)
        shift = moved.trials.measured[0] - clean.trials.measured[0]
        np.testing.assert_allclose(shift.mean(axis=1), 0.0, atol=1e-16)
        length = np.linalg.norm(shift[:, -1] - shift[:, 0], axis=1)
        np.testing.assert_allclose(length, ends * setup.sigma[0], rtol=1e-9)
        np.testing.assert_array_equal(moved.position, clean.position)
    (rows,) = moved.measurements[0].observations
    assert set(rows.session) == {"s1", "s2"}
    assert len(rows.context["time"]) == setup.poses


@pytest.mark.parametrize("name", SETUPS)
def test_smooth_model_error_moves_measured_and_held_out_poses_by_15_um(name):
    setup = SETUPS[name]
    clean, wrong = (simulate_case(setup, Case("", smooth=size), 60) for size in (0.0, 15e-6))
    axes = len(setup.columns) or 3
    measured = (wrong.trials.measured[0] - clean.trials.measured[0])[..., -axes:]
    held_out = (wrong.position - clean.position)[..., :axes]
    for error in (measured, held_out):
        assert np.sqrt((error**2).mean()) == pytest.approx(15e-6, rel=0.15)


@pytest.mark.parametrize("name", SETUPS)
def test_parameters_are_as_many_tolerances_off_as_the_case_states(name):
    setup = SETUPS[name]
    robot = load_robot(name)
    free = robot.parameters.free
    nominal, tolerance = robot.values[free], np.asarray(robot.parameters.tolerance)[free]
    single = simulate_case(setup, Case("", single=10.0), 6)
    deviation = np.abs(single.trials.truth[:, free] - nominal) / tolerance
    np.testing.assert_array_equal(single.moved.sum(axis=1), 1)
    np.testing.assert_allclose(deviation[single.moved], 10.0, rtol=1e-9)
    assert (deviation[~single.moved] < 5.0).all()
    group = simulate_case(setup, Case("", group=6.0), 2)
    deviation = (group.trials.truth[:, free] - nominal) / tolerance
    np.testing.assert_allclose(deviation[group.moved], 6.0, rtol=1e-9)
    assert 2 <= group.moved[0].sum() < len(nominal) / 2
    assert few_equations_left(setup) == 6


def few_equations_left(setup):
    """Return the degrees of freedom of the few poses."""
    free = int(load_robot(setup.robot).parameters.free.sum())
    return (len(setup.columns) or 6) * setup.few - free


def test_requirement_can_fail_by_coverage_and_be_met_by_an_explanation():
    good = {"parameters": 0.95, "moved": 0.95, "position": 0.94, "orientation": None}
    assert is_met(good | {"explained": None}, is_clean=True)
    assert not is_met(good | {"position": 0.97, "explained": None}, is_clean=True)
    assert is_met(good | {"explained": 0.0}, is_clean=False)
    assert not is_met(good | {"position": 0.9, "explained": 0.9}, is_clean=False)
    assert is_met(good | {"position": 0.9, "explained": 0.96}, is_clean=False)
    assert not is_met(good | {"moved": 0.5, "explained": None}, is_clean=False)


def test_study_sees_an_alarm_where_it_is_due_and_none_where_it_is_not():
    setup = SETUPS["five-bar"]
    cases = {case.name: case for case in list_cases()}
    loud = evaluate_case(setup, cases["noise 2.0 times sigma"], 2)
    assert loud["explained"] == 1.0
    assert loud["codes"]["noise.doubtful"] == 1.0
    assert loud["groups"]["noise.doubtful"] == 1.0
    # a code that is common in clean data explains nothing
    common = frozenset({"noise.doubtful"})
    assert evaluate_case(setup, cases["noise 2.0 times sigma"], 2, common)["explained"] == 0.0
    assert "noise.doubtful" not in evaluate_case(setup, cases["clean"], 2)["alarms"]


def test_codes_of_one_level_form_one_group():
    assert name_group("outliers.pose") == name_group("outliers.some") == "outliers"
    assert name_group("residuals.depend-on-reading") == "residuals.causes"
    assert name_group("residuals.correlated") in STATED_LEVELS
    assert name_group("fit.beyond-tolerance") == "fit.beyond-tolerance"


def test_false_alarms_of_all_tests_stay_below_5_percent():
    assert 0.0 < sum(FALSE_ALARMS.values()) < 0.05
    assert set(STATED_LEVELS.values()) <= set(FALSE_ALARMS.values()) | {0.5 * FALSE_ALARMS["noise"]}


@pytest.fixture(params=SCRIPTS.values())
def document(request, root):
    """Return the committed results of one robot."""
    path = root / "docs" / "evidence" / f"broken_assumptions_{request.param}.json"
    if not path.exists():
        pytest.skip(f"{path.name} is made by `make evidence`")
    return json.loads(path.read_text("utf-8"))


MISSED = {
    "linear-delta": {
        "clean, least squares",  # 96.5 % of parameters, a little too many: 95 +/- 1.5 % is demanded
        "one parameter 5.0 spreads off",
        "a batch 4.0 spreads off",
    },
    "five-bar": {
        "one parameter 5.0 spreads off",
        "one parameter 10.0 spreads off",
        "a batch 4.0 spreads off",
        "a batch 6.0 spreads off",
        "smooth model error of 15 um",
    },
    "hexapod-42": {
        "clean, coarse instrument",  # 96.5 % of positions
        "one parameter 5.0 spreads off",
        "one parameter 10.0 spreads off",
        "smooth model error of 15 um",
    },
}
"""Cases whose requirement is not reached; the page on evidence has their figures. Errors of
parameters that these measurements hardly determine are covered by too few intervals, and rarely
found. Since all tests of a calibration together warn of 5 % of clean data sets (before: 5 % each),
they find 3 to 6 % fewer errors of one parameter or of the model, and a quarter fewer batches.
"""


@pytest.mark.evidence
def test_intervals_hold_or_a_finding_explains_why_not(document):
    statistics = document["statistics"]
    assert set(statistics) == {case.name for case in list_cases()}
    assert {s["fits"] for s in statistics.values()} == {400}
    missed = {
        case.name for case in list_cases() if not is_met(statistics[case.name], case.is_clean)
    }
    assert missed <= MISSED[document["robot"]]


@pytest.mark.evidence
def test_no_alarm_exceeds_its_stated_level_in_clean_data(document):
    for case in (case for case in list_cases() if case.is_clean):
        statistics = document["statistics"][case.name]
        for group, rate in statistics["groups"].items():
            if group in FACTS:
                continue
            # the 99.9 % point of the binomial distribution of the stated level
            limit = binom.ppf(0.999, statistics["fits"], STATED_LEVELS[group])
            assert rate * statistics["fits"] <= limit, (case.name, group)


FACTS = ("fit.beyond-tolerance",)
"""Alarms that state what the estimates are, and test nothing."""


@pytest.mark.evidence
def test_default_is_at_most_10_percent_worse_than_least_squares(document):
    for name, statistics in document["statistics"].items():
        assert statistics["median"] <= 1.1, name
        if name not in MISSED[document["robot"]]:
            assert statistics["rms"] <= 1.1, name
