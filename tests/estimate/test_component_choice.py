# SPDX-License-Identifier: Apache-2.0
"""Parts of the spreads that are wider than stated: evidence, choice, and what the default fit
gains by them.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal, norm

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.losses import Huber
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.prior_inflation import (
    LEVEL,
    PRIOR_ODDS,
    VARIANCES,
    ComponentSearch,
    compute_evidence,
    find_information,
    predict,
)
from loopcal.estimate.result import Identification
from loopcal.estimate.tolerance_components import (
    InflatedTolerances,
    ToleranceComponent,
    list_components,
)
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.simulation import sample_truth, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.decomposition import decompose
from loopcal.numerics.statistics import compute_any_probability
from loopcal.report.calibration_view import view_fit
from tests.estimate.problems import fold_rows
from tests.findings.expectations import get_finding

LASER = Instrument((Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, 50e-6))),))
DELTA = load_robot("linear-delta")
NAMES = DELTA.parameters.names
SHIFT = ToleranceComponent("shift", "length", (1, 2, 4))
GROUP = ToleranceComponent("group", "limb", (0, 3))
SINGLE = ToleranceComponent("single", "x", (5,))


def make_rows(seed: int = 0):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((12, 6)) * [30.0, 1.0, 0.5, 3.0, 1.0, 2.0]
    b = A @ rng.standard_normal(6) * 2.0 + rng.standard_normal(12)
    return A, b, decompose(fold_rows(np.column_stack([A, b])[None]), np.array([12]))


def components_of(fit: Identification) -> tuple[ToleranceComponent, ...]:
    """Return the parts of the spreads that a fit inflated."""
    assert isinstance(fit.method, MAP)
    return fit.method.components


def simulate_deltas(t: int, moved: dict[str, float], seed: int = 9):
    """Return simulated deltas some parameters of which are moved [tolerances]; 20 positions."""
    truth = sample_truth(DELTA, t, seed)
    for name, size in moved.items():
        i = NAMES.index(name)
        truth[:, i] = DELTA.parameters.nominal[i] + size * DELTA.parameters.tolerance[i]
    poses = sample_workspace(DELTA, 20, seed).coordinates
    return truth, simulate_trials(DELTA, truth, poses, LASER, seed)


ARMS = [f"arm{i}.length" for i in (1, 2, 3)]


@pytest.mark.parametrize("component", [SHIFT, GROUP, SINGLE])
@pytest.mark.parametrize("factor", [1.0, 1.7])
def test_evidence_equals_that_of_dense_normal_densities(component, factor):
    A, b, d = make_rows()
    E = component.columns(6)

    def log_density(variance):
        K = np.eye(12) + A @ (factor**2 * np.eye(6) + variance * E @ E.T) @ A.T
        return multivariate_normal(np.zeros(12), K).logpdf(b)

    gain = np.array([log_density(v) for v in VARIANCES]) - log_density(0.0)
    expected = np.log(np.mean(np.exp(gain)))
    alone = compute_evidence(predict(d, np.array([factor])), [component])[0, 0]
    odds = np.log(PRIOR_ODDS[component.kind])
    if np.isfinite(alone):
        assert alone == pytest.approx(expected + odds, abs=1e-9)
    else:
        assert expected + odds <= 0.0


def test_evidence_of_some_components_is_positive_and_of_others_not():
    found = [
        compute_evidence(predict(make_rows(seed)[2], np.ones(1)), [SHIFT, GROUP, SINGLE])[0]
        for seed in range(20)
    ]
    positive = np.array(found) > 0.0
    assert positive.any(axis=0).all()
    assert not positive.all(axis=0).any()


def test_search_finds_the_component_with_which_data_were_made():
    rng = np.random.default_rng(3)
    A = rng.standard_normal((40, 6)) * 20.0
    z = rng.standard_normal(6)
    z[[1, 2, 4]] += 9.0
    b = A @ z + rng.standard_normal(40)
    d = decompose(fold_rows(np.column_stack([A, b])[None]), np.array([40]))
    singles = [ToleranceComponent("single", str(i), (i,)) for i in range(6)]
    search = ComponentSearch(d, None, None, (SHIFT, GROUP, *singles))
    (chosen,) = search.choose()
    assert (chosen.kind, chosen.places) == ("shift", (1, 2, 4))
    assert 5.0 < chosen.factor < 16.0
    only_singles = ComponentSearch(d, None, None, tuple(singles)).choose()
    assert {c.places for c in only_singles} <= {(1,), (2,), (4,)}


def test_candidates_are_limbs_types_and_parameters_with_a_tolerance():
    free = select_free_parameters(load_robot("3-prs"))
    found = list_components(free, "auto")
    members = {(c.kind, c.name): [free.names[i] for i in c.places] for c in found}
    assert members["shift", "thBx"] == ["thB1x", "thB2x", "thB3x"]
    assert members["group", "chain2"][:3] == ["a2x", "a2y", "a2z"]
    assert sum(c.kind == "single" for c in found) == 33
    assert {c.kind for c in list_components(free, "groups")} == {"shift", "group"}
    assert {c.kind for c in list_components(free, "heavy-tailed")} == {"single"}
    assert list_components(free, "global") == ()
    nothing = replace(free, assumed=np.ones(33, dtype=bool))
    assert list_components(nothing, "auto") == ()


def position_errors(values, truth):
    q = sample_workspace(DELTA, 40, 10).solution.q
    found, true = forward_trials(DELTA, values, q[None]), forward_trials(DELTA, truth, q[None])
    return np.sqrt(((found.T - true.T)[..., :3, 3] ** 2).sum(axis=-1).mean(axis=1))


@pytest.mark.evidence
@pytest.mark.parametrize(
    "moved", [dict.fromkeys(ARMS, 4.0), {"arm2.length": -10.0}, {"tower1.stop": 20.0}]
)
def test_default_is_at_most_ten_percent_worse_than_least_squares(moved):
    truth, trials = simulate_deltas(24, moved)
    fits = [identify_trials(DELTA, trials, method) for method in (None, LeastSquares())]
    default, ls = (np.median(position_errors(fit.values, truth)) for fit in fits)
    assert default <= 1.1 * ls


def test_parameter_far_from_nominal_is_covered():
    truth, trials = simulate_deltas(16, {"arm2.length": 10.0})
    i = NAMES.index("arm2.length")
    for method, low, high in ((MAP(), 0, 2), (None, 13, 16)):
        fits = [identify(DELTA, trials.trial(k), method) for k in range(16)]
        place = fits[0].names.index("arm2.length")
        near = [
            abs(f.estimate - truth[k, f.free_parameters.places])[place] for k, f in enumerate(fits)
        ]
        covered = sum(e < f.interval()[place] for e, f in zip(near, fits, strict=True))
        assert low <= covered <= high
        assert truth[0, i] == truth[1, i]


def test_default_names_what_deviates_together():
    _, trials = simulate_deltas(1, dict.fromkeys(ARMS, 8.0))
    fit = identify(DELTA, trials.trial(0))
    finding = get_finding(fit.findings, "prior.tolerances-inflated")
    (part,) = finding.data["parts"]
    assert (part["kind"], part["names"]) == ("shift", ARMS)
    assert "a common deviation of arm1.length, arm2.length and arm3.length" in str(finding)
    assert components_of(fit)[0].kind == "shift"
    row = fit.to_dict()["prior_conflict"]
    assert row.components[0].name == "length"


@pytest.mark.parametrize(
    ("by", "together", "alone"),
    [
        ("global", set(), set()),
        ("groups", {"shift"}, None),
        ("heavy-tailed", None, {"single"}),
        ("auto", {"shift"}, {"single"}),
    ],
)
def test_user_selects_what_may_be_inflated(by, together, alone):
    for moved, kinds in ((dict.fromkeys(ARMS, 12.0), together), ({ARMS[1]: 20.0}, alone)):
        _, trials = simulate_deltas(1, moved)
        fit = identify(DELTA, trials.trial(0), MAP(InflatedTolerances(by)))
        assert kinds is None or {c.kind for c in components_of(fit)} == kinds


def test_unknown_choices_are_refused():
    with pytest.raises(EstimationError, match="'global', 'groups', 'heavy-tailed' or 'auto'"):
        InflatedTolerances("single")  # type: ignore[arg-type]


def test_trials_equal_their_own_fits():
    _, trials = simulate_deltas(6, {"arm2.length": 7.0})
    together = identify_trials(DELTA, trials)
    fits = [identify(DELTA, trials.trial(i)) for i in range(6)]
    assert {len(components_of(fit)) for fit in fits} > {0}  # some with components, some without
    for i, fit in enumerate(fits):
        free = fit.free_parameters
        error = np.abs(together.values[i, free.places] - fit.estimate) / free.tolerance
        assert error.max() < 1e-4


def test_choice_with_the_method_of_a_fit_is_the_same():
    _, trials = simulate_deltas(1, dict.fromkeys(ARMS, 8.0))
    first = identify(DELTA, trials.trial(0))
    second = identify(DELTA, trials.trial(0), first.method)
    assert [c.places for c in components_of(second)] == [c.places for c in components_of(first)]
    np.testing.assert_allclose((second.estimate - first.estimate) / first.tolerance, 0.0, atol=0.02)


@pytest.mark.evidence
def test_right_tolerances_rarely_get_a_component():
    _, trials = simulate_deltas(60, {}, seed=4)
    fits = [identify(DELTA, trials.trial(i)) for i in range(60)]
    conflicts = [f.prior_conflict for f in fits]
    # 4 % are expected; more than 10 have probability 2e-5
    assert sum(bool(c.components) for c in conflicts if c) <= 10


def test_undetectable_deviations_are_reported_where_the_prior_hides_them():
    _, trials = simulate_deltas(1, {})
    coarse = get_finding(identify(DELTA, trials.trial(0)).findings, "prior.undetectable")
    assert set(coarse.data["together"]) == set(ARMS)
    assert "test the expected spreads" in str(coarse)
    poses = sample_workspace(DELTA, 20, 9).coordinates
    sharp = Instrument((Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, 2e-6))),))
    fine = simulate_trials(DELTA, sample_truth(DELTA, 1, 9), poses, sharp, 9).trial(0)
    codes = {finding.code for finding in identify(DELTA, fine).findings}
    assert "prior.undetectable" not in codes


def test_deviation_that_counts_as_detectable_is_detected_in_four_of_five_machines():
    free = select_free_parameters(DELTA)
    least = find_information(5.0, len(free))
    # t = N(x sqrt(q), 1) for a deviation x with the information q, in one of the 9 statistics, at
    # quantiles of equal probability
    drawn = norm.ppf((np.arange(1000) + 0.5) / 1000)
    statistic = np.abs(5.0 * np.sqrt(least) + drawn)
    p = [
        compute_any_probability(compute_any_probability(float(chi2.sf(t**2, 1)), 9), 3)
        for t in statistic
    ]
    assert np.mean(np.array(p) < LEVEL) == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize(
    ("method", "source"),
    [(None, "the expected spreads"), (MAP(), "the expected spreads"), (LeastSquares(), "")],
)
def test_tables_of_intervals_state_what_they_average_over(method, source):
    _, trials = simulate_deltas(1, {})
    fit = identify(DELTA, trials.trial(0), method)
    note = f"The intervals rely on {source}. If"
    shown = "\n".join(str(block) for block in view_fit(fit))
    for text in (str(fit), shown, str(fit.to_dict()["interval_note"])):
        assert (note in " ".join(text.split())) == bool(source)


@pytest.mark.parametrize("case", ["as stated", "huber", "noise", "some assumed", "four poses"])
def test_covariance_and_posterior_agree_where_a_component_was_chosen(case):
    truth, trials = simulate_deltas(1, {"arm2.length": 25.0})
    data, robot = trials.trial(0), DELTA
    if case == "some assumed":
        entries = [
            replace(p, tolerance=None if p.name == "radius" else p.tolerance)
            for p in DELTA.parameters.entries
        ]
        robot = replace(DELTA, parameters=replace(DELTA.parameters, entries=tuple(entries)))
    if case == "four poses":
        data = data.take(np.arange(4))
    options = FitOptions(
        loss=Huber() if case == "huber" else None, noise="estimated" if case == "noise" else "given"
    )
    fit = identify(robot, data, options=options)
    assert fit.converged
    assert components_of(fit)
    root = fit.posterior.root
    np.testing.assert_allclose(root @ root.T, fit.covariance, rtol=1e-9, atol=1e-16)
    error = np.abs(fit.estimate - truth[0, fit.free_parameters.places])
    assert (error < 4.0 * fit.standard_deviations).all()
