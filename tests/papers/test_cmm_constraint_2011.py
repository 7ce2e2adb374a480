# SPDX-License-Identifier: Apache-2.0
"""Calibration from planes and perpendicular lines: equations, claims of the paper, many machines.

The small version below draws 6 machines, uses fewer sweeps of the exchange, and has wide bounds.
The tests marked `evidence` use 200 machines.
Page: docs/papers.md.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import beta

from evidence.cmm_constraint import remove_gauge
from loopcal import geometry
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.penalties import LeastSquares
from loopcal.measure.instrument import make_random_stream
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.solutions import forward
from loopcal.papers import published
from loopcal.papers.cmm_constraint_2011 import results as steps
from loopcal.papers.cmm_constraint_2011.results import (
    ABSOLUTE,
    ALIGNED,
    AT_NOMINAL,
    BEFORE,
    CASE,
    DETERMINED,
    LS,
    MM,
    PARAMETERS,
    PRIOR,
    Results,
    compute,
    judge_claims,
    list_methods,
    make_tables,
    name_measure,
    word_change,
)
from loopcal.papers.paper import PAPERS
from loopcal.papers.published import write_page
from loopcal.studies.simulation.published_steps import (
    Layout,
    PaperRows,
    identify_from_rows,
    linearize_products,
    map_displacements,
)
from tests.papers.random_results import collect_answers
from tests.papers.small_reproduction import MADE_BY

ROOT = Path(__file__).parents[2]
DRAWS = 6
POSITION, ABSOLUTE_POSITION, POSITION_AT_NOMINAL = (
    name_measure("position", frame) for frame in (ALIGNED, ABSOLUTE, AT_NOMINAL)
)


def plan_few(seed: int = 0, trials: int = DRAWS, robot: str | None = None) -> steps.Study:
    """Return the points of the study, after one sweep of the exchange."""
    grid = steps.load_grid(PAPERS[CASE.paper.name].make_case(robot), seed, trials)
    (level,) = grid.poses.values()
    return steps.plan_points(grid, replace(level, sweeps=1))


def calibrate_one(study: steps.Study, errors: float, noise: float) -> steps.Cell:
    (cell,) = steps.calibrate(
        study, steps.change_sizes(study.grid, {"": errors}, {"": noise})
    ).values()
    return cell


@pytest.fixture(scope="module")
def study() -> steps.Study:
    return plan_few()


@pytest.fixture(scope="module")
def results() -> Results:
    return compute(0, DRAWS, lambda _: None, draws=2, sweeps=1)


def list_gauge_directions(robot) -> np.ndarray:
    """Return the motions of base and platform of a hexapod as changes (9, p) of its parameters, k =
    x, y, z: shifts of the base db_i = k, its rotations k x b_i, rotations of the platform k x p_i.
    """
    changes = np.zeros((9, len(robot.parameters)))
    for leg in robot.assembly.limbs:
        base, platform = (
            [robot.parameters.index(f"{leg.name}.{end}.{axis}") for axis in "xyz"]
            for end in ("base", "platform")
        )
        changes[0:3, base] = np.eye(3)
        changes[3:6, base] = np.cross(np.eye(3), robot.values[base])
        changes[6:9, platform] = np.cross(np.eye(3), robot.values[platform])
    return changes


def list_quotients(before: tuple[str, ...], after: tuple[str, ...]) -> tuple[float, float, float]:
    """Return the quotient of roots of sums of squares of printed numbers, and the least and the
    largest one of numbers that round to them.
    """
    (least, most), (last, first) = (
        [np.hypot.reduce([float(x) + sign * 0.5 * published.last_digit(x) for x in of])
         for sign in (-1, 1)]
        for of in (before, after)
    )  # fmt: skip
    exact = (np.hypot.reduce([float(x) for x in of]) for of in (before, after))
    return float(next(exact) / next(exact)), float(least / first), float(most / last)


@pytest.mark.parametrize(
    ("name", "follows"),
    [
        ("position, mean", True),  # 2.75
        ("position, standard deviation", None),  # 5, but 0.45 / 0.15 is 3
        ("orientation, mean", False),  # 1.45 / 0.35 is 4.14
        ("orientation, standard deviation", True),
    ],
)
def test_factors_of_table_4_follow_from_its_numbers_from_rounded_ones_or_not(name, follows) -> None:
    given = steps.PRINTED.find("table_4", name)
    stated, unit = float(given["stated"]), published.last_digit(given["stated"])
    factor, low, high = list_quotients((given["before"],), (given["after"],))
    off = max(low - stated, stated - high)
    assert published.decide(abs(factor - stated) <= unit, off > 0.5 * unit) is follows


def test_factors_of_the_conclusion_are_those_of_means_and_not_of_root_mean_squares() -> None:
    table, stated = steps.PRINTED.find("table_4"), steps.PRINTED.find("conclusion")
    for part, possible in (("position", (2.61, 2.95)), ("orientation", (4.15, 6.14))):
        mean, sd = (table[f"{part}, {what}"] for what in ("mean", "standard deviation"))
        assert stated[part] == mean["stated"]
        _, *ends = list_quotients((mean["before"], sd["before"]), (mean["after"], sd["after"]))
        np.testing.assert_allclose(ends, possible, atol=0.01)
    assert float(stated["orientation"]) < 4.0


def test_printed_reductions_follow_from_the_printed_errors() -> None:
    for name, given in steps.PRINTED.find("figure_5").items():
        if name != PARAMETERS:
            left = float(given["after"]) / float(given["before"])
            assert abs(100.0 * (1.0 - left) - float(given["stated"])) <= 0.5


def test_what_plane_and_line_do_not_determine_are_motions_of_base_and_platform(study) -> None:
    robot, at = study.robot, study.held_out
    step, x = 1e-6, at.T[:, :3, 3]
    for i, direction in enumerate(list_gauge_directions(robot)):
        T = forward(robot.with_values(robot.values + step * direction), at.q, at).T
        k = np.eye(3)[i % 3]
        expected = (np.tile(k, (len(x), 1)), np.cross(k, x), np.zeros_like(x))[i // 3]
        moved = (T[:, :3, 3] - x) / step
        np.testing.assert_allclose(moved, expected, atol=1e-5)  # second order of a step of 1e-6
    assert len(study.observable) == 33
    left = study.remove_unobservable(list_gauge_directions(robot))
    np.testing.assert_allclose(left, 0.0, atol=1e-12)  # [m per m]
    errors = sample_truth(robot, 4, 0) - robot.values
    kept = study.remove_unobservable(errors)
    np.testing.assert_allclose(kept @ list_gauge_directions(robot).T, 0.0, atol=1e-15)  # [m2]
    np.testing.assert_allclose(study.remove_unobservable(kept), kept, atol=1e-15)
    words = steps.list_undetermined(study)
    motions = ("shifting the base frame along", "rotating the base frame about",
               "rotating the platform frame about")  # fmt: skip
    expected = [f"Equivalent to {of} {axis} (gauge freedom)" for of in motions for axis in "xyz"]
    assert [direction for direction, _ in words] == expected
    assert all(effect < 1e-13 for _, effect in words)


def test_undetermined_directions_are_different_and_contain_no_motion_that_points_determine() -> (
    None
):
    """A palletizer: the points determine the height of its base, and some lengths are open."""
    study = plan_few(trials=2, robot="palletizer")
    words = [direction for direction, _ in steps.list_undetermined(study)]
    assert len(set(words)) == len(words) == len(study.planned.free) - len(study.observable)
    of_base = [direction for direction in words if "the base frame" in direction]
    assert len(of_base) == 5
    assert not [direction for direction in of_base if "along z" in direction]
    assert len([direction for direction in words if direction.startswith("Changes of")]) == 4


def test_equation_17_and_the_noise_map_are_derivatives_of_equation_14(study) -> None:
    layout, nominal = study.layout, study.robot.parameters.nominal[None]
    q = layout.hold_points(nominal)[1]
    at, J, _ = layout.linearize_points(nominal, q)
    a, c = linearize_products(at, J)
    np.testing.assert_allclose(c, 0.0, atol=1e-12)  # [m2], the points are exact
    step = 1e-6
    for place in (0, 5, 6, 40):
        moved = np.repeat(nominal, 2, axis=0)
        moved[:, place] += step, -step
        T = forward_trials(study.robot, moved, q, layout.state).T
        x = T[:, :, :3, 3].reshape(2, *at.shape[1:])
        first, second = -linearize_products(x, np.repeat(J, 2, axis=0))[1]
        slope = (first - second) / (2 * step)
        np.testing.assert_allclose(slope, a[0, ..., place], atol=1e-8)  # [m2 per m]
    shift = 1e-7 * np.random.default_rng(0).normal(size=at.shape)
    by_map = (map_displacements(*layout.levers) @ shift[0].reshape(layout.groups, -1, 1))[..., 0]
    changed = -linearize_products(at + shift, J)[1][0]
    np.testing.assert_allclose(changed, by_map, atol=1e-12)  # [m2], second order of 1e-7


def hold_with_noise(layout: Layout, truth: np.ndarray, sigma: float) -> np.ndarray:
    """Return readings at which true machines hold the points but for noise of `sigma` [m]."""
    streams = (make_random_stream(7, trial) for trial in range(len(truth)))
    noise = np.stack([stream.standard_normal((layout.points, 3)) for stream in streams])
    return layout.hold_points(truth, sigma * noise)[1]


def test_true_machines_reach_the_planned_poses_within_the_noise(study) -> None:
    truth, layout = sample_truth(study.robot, 2, 0), study.layout
    q = hold_with_noise(layout, truth, 1e-4)
    off = forward_trials(study.robot, truth, q, layout.state).T - layout.state.T
    noise = off[:, :, :3, 3] / 1e-4
    assert abs(noise.std() - 1.0) < 5.0 / np.sqrt(2 * noise.size)  # 5 sd of a sd
    np.testing.assert_allclose(off[:, :, :3, :3], 0.0, atol=1e-9)  # orientations as commanded


def test_alignment_removes_base_motions_and_platform_rotations_only(study) -> None:
    def pose(w: list[float], x: list[float]) -> np.ndarray:
        return geometry.make_pose(geometry.exp_so3(np.array(w)), np.array(x))

    true = study.held_out.T[None]
    base, turn = pose([0.1, -0.2, 0.3], [0.3, 0.1, -0.2]), pose([0.2, 0.1, -0.1], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(steps.fit_motions(base @ true @ turn, true), true, atol=1e-12)
    shifted = steps.fit_motions(true @ pose([0.0, 0.0, 0.0], [1e-3, 0.0, 0.0]), true)
    # [m] a shift of the platform is no motion of the base
    assert np.abs(shifted[..., :3, 3] - true[..., :3, 3]).max() > 1e-5


def test_gauge_changes_absolute_errors_but_not_nominal_or_aligned_ones(study) -> None:
    robot = study.robot
    truth, values = robot.values + 0.1 * (sample_truth(robot, 1, 0) - robot.values), robot.values

    def list_errors(change: np.ndarray) -> tuple[float, ...]:
        errors = study.compute_errors((values + change)[None], truth)
        return tuple(
            float(errors[m][0]) for m in (ABSOLUTE_POSITION, POSITION_AT_NOMINAL, POSITION)
        )

    absolute, at_nominal, aligned = list_errors(0.0 * values)
    assert at_nominal == pytest.approx(absolute, rel=1e-9)  # as designed
    directions = list_gauge_directions(robot)
    for direction in directions:
        _, *moved = list_errors(1e-5 * direction / np.linalg.norm(direction))
        # second order: some 1e-5 of the step, which is 0.01 mm
        assert moved == pytest.approx([at_nominal, aligned], abs=1e-6)
    shifted, _, still = list_errors(1e-2 * directions[0])
    assert shifted == pytest.approx(10.0, abs=absolute)  # [mm] along x
    assert still == pytest.approx(aligned, abs=1e-6)


def test_large_absolute_errors_of_least_squares_come_from_the_gauge(study) -> None:
    """Move the same estimates along the gauge directions to the poses nearest to nominal."""
    loud = calibrate_one(study, 0.01, 0.1)
    absolute, nominal, aligned = (
        loud.compute_median(LS, m) for m in (ABSOLUTE_POSITION, POSITION_AT_NOMINAL, POSITION)
    )
    assert absolute > 10.0 * nominal
    # what is left is the data's noise, in position after alignment, and the base's true error
    assert nominal < 1.5 * np.hypot(aligned, loud.compute_median(BEFORE, ABSOLUTE_POSITION))


def test_noise_free_data_give_the_true_machine_up_to_the_gauge(study) -> None:
    robot = study.robot
    truth = robot.values + 0.1 * (sample_truth(robot, 2, 0) - robot.values)
    problem = PaperRows(study.layout, study.layout.hold_points(truth)[1], MM, 1e-9)
    run = identify_from_rows(problem, LeastSquares(), 1e-6)
    assert (run.decomposition.rank == 33).all()
    errors = study.compute_errors(problem.values(run.deviation), truth)
    assert errors[POSITION].max() < 1e-7  # [mm], what the last step leaves of 0.1 mm
    assert errors[ABSOLUTE_POSITION].min() > 1e-3  # the base is not determined


def test_machines_without_gauge_errors_have_the_same_estimates_to_first_order(study) -> None:
    """Errors of machines whose gauge part is taken away afterwards, and of machines drawn so."""
    cell, layout = calibrate_one(study, 1.0, 0.01), study.layout
    judged = remove_gauge(study, cell)
    q = hold_with_noise(layout, judged.truth, 1e-5)
    problem = PaperRows(layout, q, MM, 1e-5)
    values = problem.values(identify_from_rows(problem, LeastSquares(), 1e-6).deviation)
    drawn = study.compute_errors(values, judged.truth)
    for measure in (POSITION, ABSOLUTE_POSITION):
        of = np.median(drawn[measure] / judged.errors[BEFORE][measure])
        # parts of the error that are left: 0.02 to 0.1, of other noise
        assert of == pytest.approx(np.median(judged.compute_left(LS, measure)), abs=0.04)


def test_points_of_a_plane_and_its_line_give_two_equations_fewer(study) -> None:
    assert steps.compute_pair_rank(study) == (10, 8)


@pytest.mark.slow
def test_rank_is_33_for_1_to_30_planes(results) -> None:
    assert {row["rank"] for row in results.ranks} == {33}
    assert {row["groups"] for row in results.ranks} >= {1, 10, 30}
    assert all(row["used"] > 1e8 * row["last"] for row in results.ranks)


@pytest.mark.slow
def test_map_has_smaller_errors_than_least_squares_at_high_noise(results) -> None:
    for c in results.cells.values():
        assert all(converged.all() for converged in c.converged.values())
        before, ls, prior = (c.compute_median(m, POSITION) for m in (BEFORE, LS, PRIOR))
        assert 1.4 < ls / c.noise < 3.5  # 2.1 over 200 draws; medians of 6 wander by 30 %
        if c.noise >= c.size:
            assert prior < 0.6 * ls
            assert ls > before
    quiet = results.cells["1", "0.0001"]  # the gauge floor
    assert quiet.compute_median(LS, ABSOLUTE_POSITION) > 100.0 * quiet.compute_median(LS, POSITION)


VERDICTS = {
    "independent": True, "counted": None, "least_squares": False, "three_quarters": None,
    "better": True, "correlation": True, "figure_5": None, "full_poses": None,
}  # fmt: skip


@pytest.mark.slow
def test_claims_have_the_expected_verdicts(results) -> None:
    reproduction = PAPERS["cmm-constraint-2011"].present(results, 0, DRAWS)
    content = reproduction.content
    assert len(content.verdicts) == 12
    judged = {v.name: v.agrees for v in content.verdicts}
    assert {name: judged[name] for name in VERDICTS} == VERDICTS
    elsewhere = {v.name for v in content.verdicts if v.is_elsewhere}
    assert "three_quarters" in elsewhere
    for table in content.tables:
        numbers = [x for row in table.rows for x in row if isinstance(x, float)]
        assert np.isfinite(numbers).all(), table.name
    text = write_page(reproduction, MADE_BY)
    lines = text.replace(r"\|", "").splitlines()
    of_tables = [line.count("|") for line in lines if line.startswith("|")]
    heads = [line.count("|") for line in lines if line.startswith("| ---") or "---: |" in line]
    assert set(of_tables) == set(heads)
    assert "Equivalent to rotating the platform frame" in text
    assert "**Undecided:** n measured points" in text
    assert text.index("## Statements of the paper") < text.index("## Our own checks")
    figures = {f.name: f for f in content.figures}
    assert {"figure_4", "figure_5"} <= set(figures)
    assert {len(s.x) for s in figures["figure_4"].series} == {12}
    assert not figures["figure_4"].joined
    lines = [s for f in figures.values() for s in f.series]
    assert all(np.isfinite(s.y).all() and len(s.x) == len(s.y) > 1 for s in lines)


Change = Callable[[steps.Draw, np.ndarray], steps.Draw]
ALL, NONE, HALF = np.ones(DRAWS), np.zeros(DRAWS), np.arange(DRAWS) % 2.0


def set_left(cell: steps.Cell, left: Mapping[str, np.ndarray]) -> steps.Cell:
    """Return a cell in which these parts of all errors are left after each method."""
    before = np.linspace(1.0, 2.0, DRAWS)
    errors = {m: dict.fromkeys(of, before * left.get(m, ALL)) for m, of in cell.errors.items()}
    return replace(cell, errors=errors)


def change_draws(results: Results, change: Change, good: np.ndarray, count: int = 2) -> Results:
    """Return results in which a statement holds for `good` machines of so many draws."""
    return replace(results, draws=tuple(change(results.draws[0], good) for _ in range(count)))


def leave_errors(draw: steps.Draw, good: np.ndarray) -> steps.Draw:
    """Both methods take 99 % of the errors of good machines away, and double the others."""
    left: dict[str, np.ndarray] = dict.fromkeys((LS, PRIOR), np.where(good > 0.0, 0.01, 2.0))
    cells, fifties = (
        {key: set_left(cell, left) for key, cell in of.items()} for of in (draw.cells, draw.fifties)
    )
    return replace(draw, cells=cells, fifties=fifties)


def order_errors(draw: steps.Draw, good: np.ndarray) -> steps.Draw:
    """Position errors of good machines fall in the order of parameter errors, others against it."""
    cells = {}
    for i, (key, cell) in enumerate(draw.cells.items()):
        changed = set_left(cell, {})
        left = {m: dict(of) for m, of in changed.errors.items()}
        along, against = (i + 1) / 12, 1 - i / 12
        left[LS][PARAMETERS] = left[BEFORE][PARAMETERS] * along
        of_position = left[BEFORE][ABSOLUTE_POSITION] * np.where(good > 0.0, along, against)
        left[LS][ABSOLUTE_POSITION] = of_position
        cells[key] = replace(changed, errors=left)
    return replace(draw, cells=cells)


def need_iterations(draw: steps.Draw, good: np.ndarray) -> steps.Draw:
    taken = np.where(good > 0.0, 5, 6)
    return replace(draw, fifties={g: replace(c, iterations=taken) for g, c in draw.fifties.items()})


def compare_priors(draw: steps.Draw, good: np.ndarray) -> steps.Draw:
    left = {LS: 0.5 * ALL, PRIOR: np.where(good > 0.0, 0.5, 0.9)}
    return replace(draw, cells={key: set_left(cell, left) for key, cell in draw.cells.items()})


def change_numbers(name: str, values: tuple[Any, Any, Any]) -> Callable[[Results, np.ndarray], Any]:
    """Return what sets a number of the results for all, no and half of the machines."""

    def change(results: Results, good: np.ndarray) -> Results:
        return replace(results, **{name: values[(1.0, 0.0, 0.5).index(good.mean())]})

    return change


def change_gains(results: Results, good: np.ndarray) -> Results:
    draws = tuple(replace(results.draws[0], gain=2.0 + 2.0 * g) for g in good)
    return replace(results, draws=draws)


def on_draws(change: Change) -> Callable[[Results, np.ndarray], Results]:
    return lambda results, good: change_draws(results, change, good)


CHANGES: Mapping[str, Callable[[Results, np.ndarray], Results]] = {
    "independent": change_numbers("frame_effect", (1e-15, 1e-2, 1e-7)),
    "counted": change_numbers("pair", ((10, 9), (10, 5), (10, 8))),
    "least_squares": change_numbers("ranks", (
        [{"groups": 1, "rank": 42, "last": 1e-3}], [{"groups": 1, "rank": 42, "last": 1e-17}],
        [{"groups": 1, "rank": 42, "last": 1e-10}])),
    "three_quarters": on_draws(leave_errors), "better": on_draws(leave_errors),
    "figure_5": on_draws(leave_errors), "full_poses": on_draws(leave_errors),
    "correlation": on_draws(order_errors), "prior": on_draws(compare_priors),
    "iterations": lambda results, good: change_draws(
        change_draws(results, leave_errors, ALL), lambda draw, of: need_iterations(
            leave_errors(draw, ALL), of), good),
    "seconds": on_draws(lambda draw, good: replace(draw, seconds=tuple(60.0 - 59.0 * good))),
    "exchange": change_gains,
}  # fmt: skip


@pytest.fixture
def has_printed_dimensions(monkeypatch) -> None:
    """The robot has the dimensions of the paper, so that its machines refute statements."""
    content = published._read_file(steps.SIZES.module, "sizes.yaml")
    monkeypatch.setitem(content, "dimensions", "of the paper")


@pytest.mark.slow
@pytest.mark.usefixtures("has_printed_dimensions")
@pytest.mark.parametrize("name", CHANGES)
def test_every_claim_agrees_disagrees_and_is_undecided(results, name) -> None:
    """Results in which a statement holds for all, for no and for half of the machines."""
    change, answers = CHANGES[name], []
    for good in (ALL, NONE, HALF):
        changed = change(results, good)
        answers.append(next(v for v in judge_claims(changed) if v.name == name).agrees)
    assert answers == [True, False, None]


OF_PAPER = ("three_quarters", "figure_5", "iterations", "full_poses", "correlation", "better")
"""Claims about the machines of the paper."""


@pytest.mark.slow
@pytest.mark.parametrize("name", OF_PAPER)
def test_machines_of_other_dimensions_refute_no_claim_about_those_of_the_paper(
    results, name, has_printed_dimensions, monkeypatch
) -> None:
    def judge(changed: Results) -> tuple[bool | None, bool]:
        verdict = next(v for v in judge_claims(changed) if v.name == name)
        return verdict.agrees, verdict.is_elsewhere

    refuted = CHANGES[name](results, NONE)
    assert judge(refuted) == (False, False)
    another = PAPERS[CASE.paper.name].make_case("hexapod-octahedral")
    assert judge(replace(refuted, case=another)) == (None, True)
    monkeypatch.setitem(published._read_file(steps.SIZES.module, "sizes.yaml"),
                        "dimensions", "ours")  # fmt: skip
    assert judge(refuted) == (None, True)
    assert judge(CHANGES[name](results, ALL)) == (True, False)


@pytest.mark.slow
@pytest.mark.parametrize("good", [ALL, NONE], ids=["all", "none"])
def test_claims_and_tables_show_the_same_medians(results, good) -> None:
    """The first draw is as computed, and another one is better or worse."""
    other = leave_errors(results.draws[0], good)
    changed = replace(results, draws=(results.draws[0], other, other))
    reasons = {v.name: v.why for v in judge_claims(changed)}
    measures = {PARAMETERS: PARAMETERS, "position": ABSOLUTE_POSITION}
    left = {name: results.figure_5.compute_left(LS, m) for name, m in measures.items()}
    changes = {name: word_change(100.0 * float(np.median(1.0 - x))) for name, x in left.items()}
    assert f"the error is {changes[PARAMETERS]} (median of the {DRAWS}" in reasons["three_quarters"]
    assert (
        f"the parameters is {changes[PARAMETERS]}, of positions {changes['position']}"
        in (reasons["correlation"])
    )
    assert f"frame: position {changes['position']} and orientation" in reasons["figure_5"]
    assert "at most 55 % in half of the draws, and 75 % in 1.5 % of" in (reasons["three_quarters"])


@pytest.mark.slow
def test_changes_of_errors_are_worded_by_their_sign(results) -> None:
    assert [word_change(x) for x in (51.2, 0.2, -0.2, -1.6)] == [
        "51 % smaller", "0 % smaller", "0 % smaller", "2 % larger",
    ]  # fmt: skip
    cells = {k: set_left(c, {LS: 3.0 * ALL}) for k, c in results.cells.items()}
    changed = replace(results, draws=(replace(results.draws[0], cells=cells),))
    reasons = {v.name: v.why for v in judge_claims(changed)}
    assert "the error is 200 % larger" in reasons["three_quarters"]
    assert not [name for name, why in reasons.items() if re.search(r" -\d", why)]


@pytest.mark.slow
def test_every_claim_has_such_results_and_is_judged_on_any_numbers(results) -> None:
    answers = collect_answers(judge_claims, results, 16, keep=(steps.Study,))
    assert {claim.split()[1] for claim in answers} == set(CHANGES)


@pytest.mark.slow
def test_a_word_does_not_depend_on_the_number_of_machines(results) -> None:
    """Half of the machines leave a claim undecided, few of them or many."""
    for draws in (1, 2, 40):
        changed = change_draws(results, leave_errors, HALF, draws)
        words = {v.name: v.word for v in judge_claims(changed)}
        assert words["three_quarters"] == words["better"] == "Undecided"


def test_printed_numbers_decide_what_is_computed(monkeypatch) -> None:
    content = published._read_file(steps.PRINTED.module, "published.yaml")
    monkeypatch.setitem(content, "sets", "0.02 3")
    monkeypatch.setitem(content, "noises", "0.5")
    monkeypatch.setitem(content, "points", {"simulated": "80", "measured": "45", "compared": "7"})
    monkeypatch.setitem(content, "accuracy", {"accuracy": "0.2"})
    monkeypatch.setitem(content, "figure_5_cell", {"set": "2", "noise": "0.5"})
    grid = steps.load_grid(CASE, 0, 2)
    assert [e.tolerance_factor for e in grid.errors.values()] == [0.02, 3.0]
    assert [i.sigma_position for i in grid.instruments.values()] == [pytest.approx(0.5 * MM)]
    (level,) = grid.poses.values()
    assert (level.count, grid.scores.held_out) == (80, 7)
    fifty = steps.place_fifty(grid, 5)
    (measured,), (held,) = fifty.poses.values(), fifty.instruments.values()
    assert (measured.count, held.sigma_position) == (45, pytest.approx(0.2 * MM))
    assert steps.find_figure_5() == ("3", "0.5")


@pytest.mark.slow
@pytest.mark.usefixtures("has_printed_dimensions")
def test_printed_numbers_decide_verdicts(results, monkeypatch) -> None:
    content = published._read_file(steps.PRINTED.module, "published.yaml")
    # 99 % less, 5 iterations at most; 16 times
    changed = change_draws(results, leave_errors, ALL, 8)

    def judge(name: str) -> bool | None:
        return next(v for v in judge_claims(changed) if v.name == name).agrees

    assert judge("three_quarters") is judge("figure_5") is judge("seconds") is True
    figure = {name: {**given, "stated": "100"} for name, given in content["figure_5"].items()}
    monkeypatch.setitem(content, "figure_5", figure)
    monkeypatch.setitem(content, "experiment", {"iterations": "0", "seconds": "0"})
    assert judge("three_quarters") is judge("figure_5") is judge("iterations") is False
    assert not judge("seconds")


def test_fits_that_did_not_converge_have_a_row_of_their_own() -> None:
    errors = {POSITION: np.array([1.0, 2.0, 100.0])}
    converged = {
        BEFORE: np.ones(3, dtype=bool),
        LS: np.array([True, True, False]),
        PRIOR: np.zeros(3, dtype=bool),
    }
    of_methods: dict[str, dict[str, np.ndarray]] = dict.fromkeys((BEFORE, LS, PRIOR), errors)
    cell = steps.Cell(1.0, 0.01, of_methods, np.zeros(3, dtype=int), converged, np.zeros(3), {})
    assert list(list_methods(cell, [POSITION])) == [
        (BEFORE, 3, 2.0), (LS, 2, 1.5), (f"{LS}, not converged", 1, 100.0),
        (PRIOR, 0, None), (f"{PRIOR}, not converged", 3, 2.0),
    ]  # fmt: skip
    assert np.isnan(cell.compute_left(LS, POSITION)[2])
    assert cell.are_reduced(LS, [POSITION]) == [False, False, None]


@pytest.mark.slow
def test_another_robot_is_judged_in_its_spreads_and_without_what_it_lacks() -> None:
    """A delta: its platform does not turn, and its parameters are lengths and angles."""
    case = PAPERS["cmm-constraint-2011"].make_case("linear-delta")
    of_delta = compute(0, 2, lambda _: None, case, draws=1, sweeps=0)
    tables = {table.name: table for table in make_tables(of_delta)}
    titles = [title for table in tables.values() for title in table.columns]
    assert not [title for title in titles if "orientation" in title]
    assert f"{DETERMINED} [spreads]" in tables["table_3"].columns
    sets = [row[0] for row in tables["table_3"].rows]
    assert list(dict.fromkeys(sets)) == ["0.01 spreads", "0.1 spreads", "1 spread"]
    presented = PAPERS["cmm-constraint-2011"].present(of_delta, 0, 2, case)
    assert {v.name for v in presented.content.verdicts} == set(CHANGES)
    assert not presented.content.comparisons
    # one direction of 9: Beta(1/2, 4) has the median 0.0587, and is below 1/16 in 51.4 %
    why = {v.name: v.why for v in presented.content.verdicts}["three_quarters"]
    assert "at most 76 % in half of the draws, and 75 % in 51.4 % of the draws" in why
    assert "does not turn" in presented.replaced[-1]
    assert "errors of 1 spread on linear-delta" in presented.replaced[-2]


def test_a_hexapod_of_other_tolerances_has_sets_by_their_true_size() -> None:
    study = plan_few(trials=2, robot="hexapod-octahedral")
    assert [study.describe_errors(given) for given in study.grid.errors] == [
        "0.0005 mm", "0.005 mm", "0.05 mm",
    ]  # fmt: skip
    assert study.label(PARAMETERS) == "parameters [mm]"
    assert len(study.observable) == 33


def test_a_robot_without_tolerances_is_refused(tmp_path) -> None:
    text = (ROOT / "src/loopcal/robots/hexapod-nategh-agheli.yaml").read_text("utf-8")
    (tmp_path / "mine.yaml").write_text(text.partition("tolerances:\n  base")[0], "utf-8")
    with pytest.raises(DataError, match="has an expected spread, so the true machine"):
        CASE.paper.make_case(tmp_path / "mine.yaml")


def test_one_plane_that_determines_less_than_several_is_planned_with_tolerances() -> None:
    """A direction of a palletizer changes one plane by 2e-8 of the largest effect."""
    grid = steps.load_grid(CASE.paper.make_case("palletizer"), 0, 2)
    (level,) = grid.poses.values()
    one = steps.plan_points(grid, replace(level, groups=1, sweeps=0))
    assert np.isfinite(one.spreads).all()


def test_a_robot_that_cannot_follow_planes_and_lines_is_refused() -> None:
    with pytest.raises(EstimationError, match="3-prs does not control x and y"):
        compute(0, 2, lambda _: None, PAPERS["cmm-constraint-2011"].make_case("3-prs"))


def test_gauge_share_of_random_errors_follows_a_beta_distribution() -> None:
    """The share of nine of 42 directions in a squared norm is Beta(9/2, 33/2)."""
    drawn = np.random.default_rng(0).normal(size=(200_000, 42)) ** 2
    share = np.mean(drawn[:, :9].sum(axis=1) <= 0.25**2 * drawn.sum(axis=1))
    chance = float(beta.cdf(0.25**2, 4.5, 16.5))
    assert 0.010 < chance < 0.020
    assert abs(share - chance) < 5.0 * np.sqrt(chance / 200_000)  # 5 sd, binomial


def test_same_seed_gives_the_same_numbers() -> None:
    first, again, more = (calibrate_one(plan_few(3, trials), 1.0, 0.01) for trials in (2, 2, 3))
    for method in (BEFORE, LS, PRIOR):
        for measure, errors in first.errors[method].items():
            np.testing.assert_array_equal(errors, again.errors[method][measure])
            np.testing.assert_allclose(more.errors[method][measure][:2], errors, rtol=1e-6)


@pytest.fixture(scope="module")
def evidence() -> dict:
    return json.loads((ROOT / "docs" / "evidence" / "cmm_constraint.json").read_text("utf-8"))


@pytest.mark.evidence
def test_evidence_coordinate_exchange_gains_threefold_from_five_starts(evidence) -> None:
    rows = evidence["tables"]["exchange"]["rows"]
    assert len(rows) == 5
    assert all(gain >= 3.0 for _, _, _, gain, _, _ in rows)
    costs = [cost for *_, cost in rows if cost is not None]
    assert costs
    assert max(costs) <= 40.0


@pytest.mark.evidence
def test_evidence_map_errors_do_not_exceed_those_of_least_squares(evidence) -> None:
    assert evidence["draws"] >= 200
    for given, noise, before, ls, prior, *_, failed in evidence["tables"]["table_3"]["rows"]:
        assert failed == 0
        assert ls == pytest.approx(1.98 * float(noise), rel=0.05)
        assert prior < 1.1 * ls
        assert prior < 1.05 * before, (given, noise)
    layouts = {row[0]: row for row in evidence["tables"]["layouts"]["rows"]}
    ten, one = layouts["10 planes, a line each"], layouts["one plane, one line"]
    assert one[2] > 3.0 * ten[2]
    assert one[3] > 2.0 * ten[3]


@pytest.mark.evidence
def test_evidence_row_covariance_reduces_errors_by_a_sixth(evidence) -> None:
    rows = {words: numbers for words, *numbers in evidence["tables"]["weights"]["rows"]}
    share = {words: numbers[4] for words, numbers in rows.items()}
    full, single = "with their covariance", "divided by the sd of each, taken as independent"
    # two draws of 200 machines gave 0.84 and 0.80, and 0.93 and 0.86
    assert share[full] == pytest.approx(0.82, abs=0.06)
    assert share["divided by the distance d_1"] == pytest.approx(0.90, abs=0.07)
    assert share[single] > 0.9
    assert rows[single][0] == pytest.approx(0.025, rel=0.2)  # [mm] an earlier study
    assert rows[full][3] == min(numbers[3] for numbers in rows.values())  # parameters by MAP


@pytest.mark.evidence
def test_evidence_gauge_changes_absolute_errors_and_not_aligned_ones(evidence) -> None:
    tables = evidence["tables"]
    columns, rows = tables["table_3"]["columns"], tables["table_3"]["rows"]
    loud, quiet = (
        dict(zip(columns, next(row for row in rows if row[:2] == key), strict=True))
        for key in (["0.01", "0.1"], ["1", "0.0001"])
    )
    absolute, nominal = "position, absolute [mm], LS", "position, gauge at nominal [mm], LS"
    assert loud[absolute] > 15.0 * loud[nominal]
    assert quiet[absolute] < 0.5 * quiet[nominal]
    fifty = {(planes, frame): numbers for planes, frame, *numbers in tables["fifty"]["rows"]}
    for planes in (1, 5):
        before, ls, _, _ = fifty[planes, "absolute"]
        assert ls > 4.0 * before
        before, ls, _, _ = fifty[planes, "gauge at nominal"]
        assert ls == pytest.approx(before, rel=0.1)
        before, _, prior, _ = fifty[planes, "aligned"]
        assert prior < 0.2 * before
    # by the points that are drawn least squares makes one plane worse or better, five better
    assert fifty[5, "aligned"][1] < 0.8 * fifty[5, "aligned"][0]
    # one plane: all of 40 machines within 5 iterations; five: 40 to 72 % of them, by the points
    assert fifty[1, "aligned"][3] >= 90.0
    assert fifty[5, "aligned"][3] < 85.0
    # 17 of 50 converged while rotations of the residuals counted as information
    assert [row[1] for row in tables["surfaces"]["rows"]] == ["50 of 50", "50 of 50"]


@pytest.mark.evidence
def test_evidence_figure_5_is_reproduced_only_without_the_gauge(evidence) -> None:
    rows = evidence["tables"]["readings"]["rows"]
    printed, results = rows[0][3:], {tuple(row[:3]): row[3:] for row in rows[1:]}
    for reading in (
        ("gauge-free", "absolute"),
        ("all parameters", "aligned"),
        ("gauge-free", "aligned"),
    ):
        assert np.abs(np.subtract(results["standard deviation", *reading], printed)).max() < 20.0
    assert results["standard deviation", "all parameters", "absolute"][0] < 54.0 < printed[0]
    assert all(of[0] < 0.0 for (reading, *_), of in results.items() if reading == "variance")
    ranks = evidence["tables"]["correlation"]["rows"]
    assert all(cells == 12 and ratios == 6 and rank > 0.7 for _, rank, cells, ratios in ranks)
