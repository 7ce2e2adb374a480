# SPDX-License-Identifier: Apache-2.0
"""Relaxed designs have known weights, and a bound that holds for all designs; certified designs are
the known ones, no worse than twenty exchange starts, and have the smallest size that reaches a
target; coordinate exchange finds known designs.
"""

import json
from dataclasses import replace
from itertools import combinations
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from evidence.plan_designs import exchange_random_starts
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.information import observe_poses
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.planning import exchange
from loopcal.planning.design_space import (
    Criterion,
    DesignProblem,
    PriorInformation,
    evaluate_criterion,
    factor_design,
    find_observable_space,
)
from loopcal.planning.exchange import (
    choose_design,
    compute_design_curve,
    coordinate_exchange,
    find_smallest_design,
    relax_design,
    search_size,
)
from tests.findings.expectations import expect_refusal
from tests.planning.design_problems import (
    CASES,
    Array,
    Places,
    draw_rows,
    make_grid,
    make_problem,
    polynomial_rows,
)

SIGMA = np.array([5e-5] * 3 + [1e-5] * 3)  # [rad, m]


def linearize_drawn_poses(robot: str, count: int, components: slice = slice(0, 6)) -> Array:
    """Return whitened rows (count, r, p) of poses drawn from a shipped robot's workspace."""
    free = select_free_parameters(load_robot(robot))
    twists = observe_poses(free, sample_workspace(free.robot, count, 0).solution.q).twists[0]
    return (twists / SIGMA[:, None])[:, components]


@pytest.mark.slow
def test_efficiency_of_20_out_of_1000_hexapod_poses_exceeds_95_percent():
    problem = make_problem(linearize_drawn_poses("hexapod-42", 1000))
    found = choose_design(problem, 20)
    assert found.relaxed.converged
    assert len(problem.space) == 42
    assert found.efficiency > 0.95  # 0.980 measured
    # the first twenty drawn: 0.4 measured
    assert found.relaxed.efficiency(problem.evaluate(np.arange(20))) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "components"), [("hexapod-42", slice(3, 6)), ("3-prs", slice(0, 6))]
)
def test_certified_design_is_no_worse_than_the_best_of_20_exchange_starts(robot, components):
    problem = make_problem(linearize_drawn_poses(robot, 120, components))
    found, best = choose_design(problem, 20), max(exchange_random_starts(problem, 20, 20))
    # to a millionth of the efficiency
    assert found.value >= best - 1e-6 * len(problem.space)
    assert 0.9 < found.relaxed.efficiency(best) <= found.efficiency + 1e-6


def test_tolerance_prior_changes_the_design_only_for_coarse_data():
    # position only: three directions that no pose shows
    rows, kept = linearize_drawn_poses("hexapod-42", 150, slice(3, 6)), []
    for precision in (1.0, 1e3):
        plain, bayes = (make_problem(precision * rows, prior=prior) for prior in (False, True))
        assert (len(plain.space), len(bayes.space)) == (39, 42)
        designs = [choose_design(problem, 20, perturbations=5) for problem in (plain, bayes)]
        value, other = (plain.evaluate(design.chosen) for design in designs)
        kept.append(plain.compare(other, value))
    # with coarse data other poses are better: what the spreads say need not be measured
    assert kept[0] < 0.9
    assert 0.98 < kept[1] < 1.02


@pytest.mark.evidence
def test_design_by_criterion_i_predicts_better_than_by_criterion_d():
    rows = draw_rows(N=60, machine=6, seed=2)
    L = np.random.default_rng(3).normal(size=(4, 6)) * np.array([9.0, 3.0, 1.0, 0.3, 0.1, 0.03])
    wanted = make_problem(rows, Criterion("I", L, 4))
    other = choose_design(make_problem(rows), 8).chosen
    assert choose_design(wanted, 8).value < wanted.evaluate(other)


@pytest.mark.parametrize("criterion", [Criterion("D"), Criterion("A")], ids=["D", "A"])
def test_efficiency_is_at_most_one_and_repeats_do_not_worsen_the_design(criterion):
    once, often = (
        choose_design(make_problem(draw_rows(N=30), criterion, repeats=repeats), 7)
        for repeats in (False, True)
    )
    assert 0.8 < once.efficiency <= 1.0 + 1e-9
    assert 0.8 < often.efficiency <= 1.0 + 1e-9
    problem = often.relaxed.candidates.problem
    assert problem.compare(once.value, often.value) <= 1.0 + 1e-9


def test_same_seed_gives_the_same_design():
    problem = make_problem(draw_rows(N=80, machine=6))
    first, second = (choose_design(problem, 9, seed=4) for _ in range(2))
    assert_array_equal(first.chosen, second.chosen)


def test_design_of_all_candidates_has_efficiency_one():
    found = choose_design(make_problem(draw_rows()), 12)
    assert_array_equal(found.chosen, np.arange(12))
    assert found.efficiency == pytest.approx(1.0, abs=1e-9)


def test_incomplete_first_design_is_completed():
    first = [np.array([3, 5]), np.array([], dtype=np.int64)]
    assert len(choose_design(make_problem(draw_rows(N=30)), 7, first=first).chosen) == 7


def test_candidates_without_information_leave_the_prior_unchanged():
    found = choose_design(make_problem(np.zeros((6, 2, 3)), prior=True), 2)
    assert found.efficiency == 1.0
    assert found.value == pytest.approx(0.0, abs=1e-12)  # log det of the unit matrix


@pytest.mark.evidence
def test_evidence_certified_designs_are_no_worse_than_exchange(root):
    path = root / "docs" / "evidence" / "plan_designs.json"
    if not path.is_file():
        pytest.skip("docs/evidence/plan_designs.json is made by `make evidence`")
    table = json.loads(path.read_text("utf-8"))["tables"]["designs"]
    best, certified = (
        table["columns"].index(name) for name in ("exchange, best start", "certified design")
    )
    assert table["rows"]
    for row in table["rows"]:
        assert row[certified] >= row[best] - 1e-6, row  # to a millionth of the efficiency
        assert row[:3] != ["hexapod-42", "full pose", "D"] or row[certified] >= 0.95


@pytest.mark.parametrize("criterion", [Criterion("D"), Criterion("A")], ids=["D", "A"])
def test_larger_designs_are_better_and_stay_within_their_bounds(criterion):
    problem = make_problem(draw_rows(N=30), criterion)
    found = compute_design_curve(problem, (12, 4, 6, 5, 9, 9), perturbations=2)
    assert [len(made.chosen) for made in found] == [4, 5, 6, 9, 12]
    sign = 1.0 if criterion.is_d else -1.0
    values, bounds = (
        sign * np.array(numbers)
        for numbers in zip(*((m.value, m.relaxed.bound) for m in found), strict=True)
    )
    assert (np.diff(values) > 0.0).all()
    assert (values <= bounds + 1e-12).all()


@pytest.mark.parametrize(
    ("criterion", "target", "size"),
    [
        # With weights 1/4, 1/2, 1/4 of n points the sum of the variances is 8 / n.
        (Criterion("A"), 0.4 + 1e-9, 20),
        (
            Criterion("D"),
            np.log(4 / 27 * 30**3) - 1e-9,
            30,
        ),  # ten points at each end and in the middle
    ],
    ids=["A", "D"],
)
def test_smallest_design_has_the_known_size(criterion, target, size):
    rows = polynomial_rows(np.linspace(-1, 1, 21), 2)
    problem = make_problem(rows, criterion, repeats=True)
    found, at_least = find_smallest_design(problem, target, most=200, perturbations=2)
    assert len(found.chosen) == size
    assert size - 1 <= at_least <= size  # the bound is computed to three parts in a thousand
    assert found.value == pytest.approx(target, rel=1e-8)


def test_earlier_measurements_reduce_the_design_size():
    rows, none = draw_rows(N=60), PriorInformation.none(4)
    alone, helped = (
        find_smallest_design(DesignProblem(rows, Criterion("A"), start), 0.1, perturbations=2)
        for start in (none, none.with_rows(rows[:10]))
    )
    assert alone[1] <= len(alone[0].chosen)
    assert len(helped[0].chosen) < len(alone[0].chosen)


@pytest.mark.parametrize(("target", "most"), [(0.001, 12), (0.2, 5)])
def test_unreachable_target_is_refused_with_the_largest_possible_size(target, most):
    with expect_refusal("plan.target-impossible", size=most, available=12, target=target):
        find_smallest_design(make_problem(draw_rows(), Criterion("A")), target, most)


@pytest.mark.parametrize("right", [3, 4, 57, 999, 1000, 1001])
@pytest.mark.parametrize(
    ("excess", "most"),
    [
        (lambda n, right: right / n, 14),  # information grows with the size
        (lambda n, right: (right / n) ** 2, 24),
        (lambda n, right: (right / n) ** 0.25, 24),  # and hardly grows, beside earlier knowledge
        # the doublings, and twice the halvings of a thousand
        (lambda n, right: 1.0 + 1e-9 if n < right else 1.0, 30),
        (lambda n, right: 0.01 if n >= right else 1e9, 30),
    ],
)
def test_search_finds_the_smallest_size_in_few_evaluations(right, excess, most):
    asked: list[int] = []

    def measure(n: int) -> float:
        asked.append(n)
        return excess(n, right)

    assert search_size(measure, 3, 1000) == right
    assert len(asked) == len(set(asked)) <= most
    assert search_size(measure, 1000, 1000) == max(right, 1000)


def test_size_without_any_regular_design_does_not_meet_the_target():
    rows = np.zeros((12, 2, 4))  # groups of two equal rows, each of one unknown
    rows[np.arange(12), :, np.arange(12) % 4] = 1.0
    problem = make_problem(rows, Criterion("A"))
    assert problem.n_needed == 2
    with expect_refusal("plan.design-singular", chosen=2):
        choose_design(problem, 2)
    found, at_least = find_smallest_design(problem, 2.0, perturbations=2)
    assert (at_least, len(found.chosen)) == (4, 4)
    found, at_least = find_smallest_design(problem, 4.0, perturbations=2)
    assert (at_least, len(found.chosen)) == (2, 4)
    with expect_refusal("plan.design-singular", chosen=3):
        find_smallest_design(problem, 4.0, 3, perturbations=2)


POINT = 1 / np.sqrt(5)

PARABOLA = polynomial_rows(make_grid(), 2)

ENDS = PriorInformation.none(3).with_rows(
    np.repeat(polynomial_rows(np.array([-1.0, 1.0]), 2), 3, axis=0)
)


"""Earlier measurements: the ends, three times each."""


@pytest.mark.parametrize(
    ("x", "problem", "points"),
    [
        (make_grid(), make_problem(PARABOLA, repeats=True), [-1, -1, 0, 0, 1, 1]),
        (make_grid(), DesignProblem(PARABOLA, Criterion("D"), ENDS, repeats=True), [0, 0, 0]),
        (
            make_grid(POINT),
            make_problem(polynomial_rows(make_grid(POINT), 3)),
            [-1, -POINT, POINT, 1],
        ),
    ],
    ids=["parabola", "parabola with measured ends", "cubic"],
)
def test_designs_of_polynomials_are_the_known_ones(x, problem, points):
    found = choose_design(problem, len(points))
    assert_allclose(x[found.chosen], points, atol=1e-12)
    if len(points) == 6:  # det of weights 1/3 each, times 6^3
        assert found.value == pytest.approx(np.log(4 / 27 * 6**3), abs=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("criterion", "nuisance", "prior"), CASES.values(), ids=CASES)
def test_exchange_finds_the_best_of_all_subsets(criterion, nuisance, prior):
    problem = make_problem(draw_rows(N=8, nuisance=nuisance), criterion, nuisance, prior)
    found = choose_design(problem, 5)

    def value(chosen: tuple[int, ...]) -> float:
        return problem.evaluate(np.array(chosen))

    best = (max if criterion.is_d else min)(combinations(range(8), 5), key=value)
    assert tuple(found.chosen) == best
    assert found.value == pytest.approx(value(best), rel=1e-10)  # relative: rounding


def test_forbidden_and_repeated_candidates_are_never_chosen():
    rows = draw_rows(N=20)
    rows[::2, 1, 2] = np.nan
    chosen = choose_design(make_problem(rows), 8).chosen
    assert (chosen % 2 == 1).all()
    assert len(set(chosen.tolist())) == 8


def test_singular_start_finds_the_few_candidates_that_are_needed():
    rows = draw_rows(N=60)
    rows[:57, :, 3] = 0.0  # only the last three show the fourth parameter
    found = choose_design(make_problem(rows), 3)
    assert (found.chosen >= 57).any()
    assert np.isfinite(found.value)


def test_exchange_that_stays_singular_is_refused():
    rows = draw_rows(N=6)
    # three units show two unknowns only, the others the other two, by one row of use each
    rows[:3, :, 2:] = 0.0
    rows[3:, :, :2] = 0.0
    rows[3:, 1] = rows[3:, 0]
    rows[4:, :, 2:] = rows[3, :, 2:]
    rows[5, :, 3] += 1.0
    with expect_refusal("plan.design-singular", chosen=2, available=6):
        choose_design(make_problem(rows), 2)


def test_criterion_e_is_refused():
    with pytest.raises(EstimationError, match="Choose D, I or A"):
        choose_design(make_problem(draw_rows(), Criterion("E")), 5)


GAP = 1e-7

MOMENTS = np.linalg.cholesky(
    np.array([[1, 0, 1 / 3], [0, 1 / 3, 0], [1 / 3, 0, 1 / 5]])
).T  # of [-1, 1], for 1, x, x^2


@pytest.mark.parametrize(
    ("criterion", "nuisance", "shares", "value"),
    [
        (Criterion("D"), 0, (1 / 3, 1 / 3, 1 / 3), np.log(4 / 27)),
        (Criterion("A"), 0, (1 / 4, 1 / 2, 1 / 4), 8.0),
        (Criterion("I", MOMENTS), 0, (1 / 4, 1 / 2, 1 / 4), 32 / 15),
        # 1 and x are not of interest: the Chebyshev points
        (Criterion("D"), 2, (1 / 4, 1 / 2, 1 / 4), np.log(1 / 4)),
    ],
    ids=["D", "A", "I", "D of the highest coefficient"],
)
def test_weights_and_values_for_a_parabola_are_the_known_ones(criterion, nuisance, shares, value):
    x, n, q = make_grid(), 12, 3 - nuisance
    problem = make_problem(polynomial_rows(x, 2), criterion, nuisance, repeats=True)
    found = relax_design(problem, n, GAP)
    known = value + q * np.log(n) if criterion.is_d else value / n
    assert found.converged
    assert found.value == pytest.approx(known, rel=1e-6)  # relative: the gap asked for
    assert found.efficiency(known) == pytest.approx(1.0, abs=2 * GAP)
    # the optimum is flat about 0
    masses = [found.weights[abs(x - at) < 0.15].sum() / n for at in (-1.0, 0.0, 1.0)]
    assert_allclose(masses, shares, atol=2e-3)
    if criterion.is_d and not nuisance:
        # variance of the prediction at most p, the equivalence theorem of Kiefer and Wolfowitz
        assert (n * found.slopes).max() == pytest.approx(3.0, rel=1e-5)
        assert_allclose(n * found.slopes[found.weights > 0.1], 3.0, rtol=1e-3)


def test_points_for_a_cubic_are_the_known_ones():
    x = make_grid(extra=1 / np.sqrt(5))
    found = relax_design(make_problem(polynomial_rows(x, 3), repeats=True), 4, GAP)
    for at in (-1.0, -1 / np.sqrt(5), 1 / np.sqrt(5), 1.0):
        assert found.weights[abs(x - at) < 0.05].sum() == pytest.approx(1.0, abs=2e-3)


def find_best_value(problem: DesignProblem, n: int) -> float:
    """Return the best criterion value of all subsets."""
    subsets = combinations(range(len(problem.rows)), n)
    values = [problem.evaluate(np.array(chosen)) for chosen in subsets]
    return max(values) if problem.criterion.is_d else min(values)


@pytest.mark.parametrize(("criterion", "nuisance", "prior"), CASES.values(), ids=CASES)
def test_bound_holds_for_every_subset_and_is_tighter_without_repeats(criterion, nuisance, prior):
    problem = make_problem(draw_rows(nuisance=nuisance), criterion, nuisance, prior)
    capped = relax_design(problem, 5, 1e-6)
    free = relax_design(replace(problem, repeats=True), 5, 1e-6)
    best = find_best_value(problem, 5)
    assert capped.converged
    assert free.converged
    assert capped.weights.max() <= 1.0
    assert capped.weights.sum() == pytest.approx(5.0, abs=1e-9)
    assert 0.5 < capped.efficiency(best) <= 1.0 + 1e-9
    assert free.efficiency(best) < capped.efficiency(best)


def test_no_single_swap_improves_an_exchanged_design():
    candidates = make_problem(np.random.default_rng(1).normal(size=(60, 3, 8))).scale_candidates(9)
    for seed in range(20):
        stream = np.random.default_rng(seed)
        begin = exchange.draw_groups(candidates, stream, 9, None)
        chosen, _ = exchange.exchange_from_start(candidates, begin, stream)
        R = candidates.factor(chosen)
        terms = exchange.compute_swap_terms(candidates.scoring, R, candidates.rows)
        gains = np.array([exchange.score_swaps(terms, j) for j in chosen])
        gains[:, chosen] = -np.inf
        assert gains.max() <= exchange.GAIN * candidates.scoring.height


def test_weights_of_120_poses_need_at_most_20_second_derivatives(monkeypatch):
    made = Mock(side_effect=exchange.differentiate_score)
    monkeypatch.setattr(exchange, "differentiate_score", made)
    rows = np.random.default_rng(1).normal(size=(120, 3, 12))
    assert relax_design(make_problem(rows), 20, 1e-4).converged
    assert made.call_count <= 20  # 33 by a barrier that is sharpened after each of its maxima


def test_bound_holds_for_an_early_stop():
    problem = make_problem(draw_rows())
    rough = relax_design(problem, 5, gap=0.9)
    assert rough.bound >= find_best_value(problem, 5)
    assert rough.value <= rough.bound


def test_relaxed_design_of_all_candidates_has_unit_weights():
    found = relax_design(make_problem(draw_rows(), Criterion("A")), 12)
    assert found.value == found.bound
    assert_array_equal(found.weights, 1.0)


def test_forbidden_candidates_have_zero_weight():
    rows = draw_rows(N=30)
    rows[:10, 0, 0] = np.nan
    found = relax_design(make_problem(rows), 6)
    assert found.weights[:10].max() == 0.0
    assert found.converged


def test_unobservable_prediction_is_refused():
    rows = draw_rows()
    rows[:, :, 3] = 0.0
    with expect_refusal("plan.prediction-unobservable"):
        relax_design(make_problem(rows, Criterion("I", np.array([[0.0, 0.0, 0.0, 1.0]]))), 5)


NONE = PriorInformation.none(3)

LEVELS = [np.linspace(-1.0, 1.0, 5)]


def parabola(_: Places, x: Array) -> Array:
    """Return rows of 1, x, x^2."""
    return polynomial_rows(x[:, 0], 2)


@pytest.mark.parametrize(
    ("criterion", "best"),
    [
        (Criterion("D"), [-1, -1, -1, -1, 0, 0, 0, 0, 1, 1, 1, 1]),
        (Criterion("A"), [-1] * 3 + [0] * 6 + [1] * 3),
    ],
)
@pytest.mark.parametrize("seed", range(4))
def test_every_start_converges_to_the_known_design_of_a_parabola(criterion, best, seed):
    begin = np.random.default_rng(seed).uniform(-1, 1, (12, 1))
    found = coordinate_exchange(parabola, begin, LEVELS, criterion, NONE)
    assert_allclose(np.sort(found.design[:, 0]), best, atol=1e-12)
    assert_array_equal(found.rows, parabola(np.arange(12), found.design))


def test_points_that_start_at_one_place_are_separated():
    found = coordinate_exchange(parabola, np.zeros((6, 1)), LEVELS, Criterion("D"), NONE)
    assert found.history[0] == -np.inf
    assert_allclose(np.sort(found.design[:, 0]), [-1, -1, 0, 0, 1, 1], atol=1e-12)


def test_forbidden_levels_are_never_chosen():
    def forbid_left_end(which: Places, x: Array) -> Array:
        rows = parabola(which, x)
        rows[(x[:, 0] < -0.9) & (which % 2 == 0)] = np.nan
        return rows

    found = coordinate_exchange(
        forbid_left_end, np.full((6, 1), 0.25), LEVELS, Criterion("D"), NONE
    )
    assert (found.design[::2, 0] > -0.9).all()
    assert (found.design[1::2, 0] < -0.9).any()


def test_rows_of_all_levels_of_a_coordinate_are_evaluated_in_one_call():
    asked = []

    def count_rows(which: Places, x: Array) -> Array:
        asked.append(len(which))
        return parabola(which, x)

    found = coordinate_exchange(
        count_rows, np.linspace(-1, 1, 7)[:, None], LEVELS, Criterion("D"), NONE
    )
    sweeps = len(found.history) - 1
    assert asked[0] == 7
    assert asked[2:] == [7 * 5] * sweeps


def test_coordinate_without_levels_is_not_changed():
    begin = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    found = coordinate_exchange(parabola, begin, [*LEVELS, np.zeros(0)], Criterion("D"), NONE)
    assert_array_equal(found.design[:, 1], begin[:, 1])


def test_forbidden_first_design_and_too_few_points_are_refused():
    with pytest.raises(EstimationError, match="group 1 of the first design is forbidden"):
        coordinate_exchange(
            parabola, np.array([[0.0], [np.nan], [1.0]]), LEVELS, Criterion("D"), NONE
        )
    with expect_refusal("plan.design-too-small", needed=3):
        coordinate_exchange(parabola, np.zeros((2, 1)), LEVELS, Criterion("D"), NONE)


def test_design_that_stays_singular_is_refused():
    def fix_all_but_the_first(which: Places, x: Array) -> Array:
        rows = parabola(which, x)
        rows[(which > 0) & (x[:, 0] != 0.0)] = np.nan
        return rows

    with expect_refusal("plan.design-singular", unknowns=3):
        coordinate_exchange(fix_all_but_the_first, np.zeros((4, 1)), LEVELS, Criterion("D"), NONE)


def test_exchange_of_hexapod_poses_halves_the_parameter_uncertainty():
    free = select_free_parameters(load_robot("hexapod-42"))
    drawn = sample_workspace(free.robot, 200, 0).coordinates
    middle, half = drawn.mean(axis=0), 0.5 * np.ptp(drawn, axis=0)

    def linearize(_: Places, x: Array) -> Array:
        at = inverse(free.robot, x)
        rows = (
            observe_poses(free, np.where(at.converged[:, None], at.q, 0.0)).twists[0]
            / SIGMA[:, None]
        )
        return np.where(at.converged[:, None, None], rows, np.nan)

    levels = [
        m + h * np.array([-1.0, -0.5, 0.0, 0.5, 1.0]) for m, h in zip(middle, half, strict=True)
    ]
    found = coordinate_exchange(
        linearize, drawn[:20], levels, Criterion("D"), PriorInformation.none(len(free))
    )
    none = PriorInformation.none(len(free))
    space = find_observable_space(found.rows, none)
    before, after = (
        evaluate_criterion(Criterion("A"), factor_design(rows, none, space), space.machine)
        for rows in (linearize(np.arange(20), drawn[:20]), found.rows)
    )
    assert (np.diff(found.history) >= 0.0).all()
    # rms standard deviation of the parameters; 2.8 to 3.0 with 100 poses
    assert np.sqrt(before / after) > 2.0
    assert inverse(free.robot, found.design).converged.all()
