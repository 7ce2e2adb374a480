# SPDX-License-Identifier: Apache-2.0
"""LS, RE and TSVD on two parallel manipulators: steps, claims of the paper, many machines.

The small version below draws 6 machines; the tests marked `evidence` check the bounds at full size.
Page: docs/papers.md.
"""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loopcal.errors import LoopcalError
from loopcal.io.core.outputs import write_files
from loopcal.io.robot.robot_file import find_robot_file
from loopcal.measure.instrument import Uniform
from loopcal.mechanism.kinematics import forward_trials
from loopcal.papers.paper import PAPERS, make_paper_study
from loopcal.papers.published import PaperFile, Printed, decide
from loopcal.papers.tsvd_2016 import results as results_module
from loopcal.papers.tsvd_2016 import steps
from loopcal.papers.tsvd_2016.results import (
    DIVERGED,
    Results,
    collect_history,
    compute,
    judge_claims,
    make_curves,
    make_medians,
)
from loopcal.studies.files.study_file import load_study
from loopcal.studies.simulation.block import calibrate_cells, find_cells, set_size
from loopcal.studies.simulation.published_steps import (
    AHEAD,
    EPSILON,
    LIMIT,
    SINGLE,
    StepRule,
    list_raw_units,
    penalize_ridge,
    penalize_truncated,
    take_steps,
)

ROOT = Path(__file__).parents[2]
DRAWS = 6
RAW = np.array([1e3, 1e3, 1e3, 1.0, 1.0, 1.0])  # from m and rad to mm and rad
FIRST = np.zeros(1, dtype=np.int64)
EXACT = np.zeros(6)
DESIGN = steps.load_design("3-PRS")


def measure_one(name: str) -> steps.Study:
    """Measure the first machine of a manipulator with the noise of Appendix 1."""
    design = steps.load_design(name)
    return steps.measure_machines(design, design.draw_true_values(1, 0))


@pytest.fixture(scope="module")
def tripod() -> steps.Study:
    return measure_one("3-PRS")


@pytest.fixture(scope="module")
def results() -> Results:
    return compute(0, DRAWS, lambda _: None)


def test_appendix_1_is_read_as_printed() -> None:
    noise = steps.PRINTED.table("appendix_1")
    assert noise.values.shape == (36, 6)
    first, last = (" ".join(noise.rows[row]) for row in ("1", "36"))
    assert first == "0.006294 -0.003925 -0.007118 0.000092 0.000087 0.000162"
    assert last == "0.008664 -0.006628 -0.004280 -0.000036 -0.000082 0.000151"
    assert np.abs(noise.values[:, :3]).max() == 0.009989
    assert np.abs(noise.values[:, 3:]).max() == 0.000174
    assert (np.abs(steps.read_noise()) <= steps.list_limits()).all()


def test_poses_parameter_errors_and_output_range_agree_with_the_paper() -> None:
    robot = steps.load_design("3-PRS").robot
    z, phi, theta = DESIGN.poses.T
    assert len(z) == 36
    assert set(np.round(z, 9)) == {0.65, 0.7, 0.75}
    assert {int(x) for x in np.round(np.rad2deg(theta))} == {10, 20, 30}
    assert len(set(np.round(np.rad2deg(phi)))) == 12
    for name in steps.ROBOTS:
        assert len(steps.list_output_range(steps.load_design(name).robot)) == 96
    errors = np.abs(steps.draw_true_values(robot, 5, 0) - robot.parameters.nominal)
    lengths = list_raw_units(robot.parameters.dimensions) != 1.0
    for chosen, (low, high) in ((lengths, (0.05e-3, 0.1e-3)), (~lengths, (2.5e-4, 5e-4))):
        assert low < errors[:, chosen].min()
        assert errors[:, chosen].max() < high
    np.testing.assert_array_equal(
        steps.draw_true_values(robot, 5, 0)[:2], steps.draw_true_values(robot, 2, 0)
    )


@pytest.mark.parametrize("name", steps.ROBOTS)
def test_first_step_agrees_with_the_printed_formulas(name) -> None:
    """H (216, p) in mm and rad by central differences of the forward kinematics."""
    measured = measure_one(name)
    robot, kind, readings = measured.robot, measured.kind, measured.trials.readings[None]
    nominal, scale, p, lam, k = (
        robot.values[None],
        list_raw_units(robot.parameters.dimensions),
        len(robot.values),
        0.01,
        15,
    )
    state = forward_trials(robot, nominal, readings)
    around = kind.measure(state.T, np.zeros((1, 36, 6)))  # nominal: phi does not wrap

    def compute_residuals(values: np.ndarray) -> np.ndarray:
        T = forward_trials(robot, values, readings, state).T
        return (kind.evaluate(T, around).residual * RAW).reshape(len(values), -1)

    shifts = 1e-4 * np.diag(scale)
    H = (compute_residuals(nominal + shifts) - compute_residuals(nominal - shifts)).T / 2e-4
    D = -(kind.evaluate(state.T, measured.trials.measured[0]).residual * RAW).ravel()
    U, s, Vt = np.linalg.svd(H, full_matrices=False)
    for penalty, expected in (
        (penalize_ridge(np.array([lam]), p), np.linalg.solve(H.T @ H + lam * np.eye(p), H.T @ D)),
        (penalize_truncated(np.array([k]), p), Vt[:k].T @ (U[:, :k].T @ D / s[:k])),
    ):
        step = (steps.iterate(measured, penalty, limit=1).values - nominal)[0] / scale
        # [mm, rad], central differences
        np.testing.assert_allclose(step, expected, rtol=0, atol=1e-5)
    singular_values = steps.linearize(measured).singular_values[0]
    np.testing.assert_allclose(singular_values, s, rtol=1e-5, atol=1e-8)


def test_repeated_ridge_steps_reduce_the_effect_of_lambda() -> None:
    robot, lam = steps.load_design("3-PRS").robot, 0.01
    # errors so small that the problem is linear
    small = robot.values + 1e-2 * (steps.draw_true_values(robot, 1, 0) - robot.values)
    measured = steps.measure_machines(DESIGN, small).with_noise(EXACT)
    d = steps.linearize(measured)
    for m in (1, 3, 10):
        values = steps.iterate(measured, penalize_ridge(np.array([lam]), 33), limit=m).values
        f = 1.0 - (lam / (d.singular_values**2 + lam)) ** m
        expected = d.deviation(f * d.projections / d.singular_values) * list_raw_units(
            robot.parameters.dimensions
        )
        # [m, rad] of 4e-6, second order
        np.testing.assert_allclose(values - robot.values, expected, rtol=0, atol=5e-10)


def test_exact_measurements_give_the_true_parameters() -> None:
    truth = steps.draw_true_values(steps.load_design("3-PRS").robot, 2, 0)
    exact = steps.measure_machines(DESIGN, truth).with_noise(EXACT)
    run = steps.iterate(exact, np.zeros((1, 33)), np.arange(2))
    assert run.is_converged.all()
    # [m, rad], rounding times 1 / 4e-4
    np.testing.assert_allclose(run.values, truth, rtol=0, atol=1e-9)


def test_tsvd_with_all_singular_values_equals_ls_in_a_batch_of_settings(tripod) -> None:
    ls, truncated = np.zeros((1, 33)), penalize_truncated(np.array([33, 22]), 33)
    both = steps.iterate(tripod, np.concatenate([ls, truncated])).values
    np.testing.assert_array_equal(both[0], both[1])
    alone = steps.iterate(tripod, truncated[1:]).values[0]
    np.testing.assert_allclose(both[2], alone, rtol=0, atol=1e-13)


def test_the_first_machine_has_the_printed_noise_and_the_others_drawn_noise() -> None:
    truth = DESIGN.draw_true_values(3, 0)
    measured = steps.measure_machines(DESIGN, truth, 0)
    noise = (measured.trials.measured[0] - measured.with_noise(EXACT).trials.measured[0]) * RAW
    printed = steps.PRINTED.table("appendix_1").values
    np.testing.assert_allclose(noise[0], printed, rtol=0, atol=1e-9)  # [mm, rad]
    assert (np.abs(noise[1:] - printed).max(axis=(1, 2)) > 1e-3).all()


def test_measurements_without_psi_keep_the_other_five_coordinates(tripod) -> None:
    five, six = (study.trials.measured[0] for study in (tripod.five, tripod))
    np.testing.assert_array_equal(five, six[..., :5])
    sigma = tripod.five.trials.instrument.sensors[0].noise.sigma
    np.testing.assert_allclose(sigma, Uniform(steps.list_limits()[:5]).sigma)


def test_first_20_ridge_steps_are_computed_one_by_one(tripod) -> None:
    penalty = penalize_ridge(np.array([1e-3, 0.1, 10.0]), 33)
    single, run = (steps.iterate(tripod, penalty, limit=60, ahead=a) for a in (0.0, AHEAD))
    np.testing.assert_array_equal(run.done[: SINGLE + 1], single.done[: SINGLE + 1])
    np.testing.assert_array_equal(run.history[: SINGLE + 1], single.history[: SINGLE + 1])
    assert len(run.history) < len(single.history)


def test_ridge_leaps_end_where_single_steps_do(tripod) -> None:
    penalty, machine = penalize_ridge(np.array([1e-2, 1.0, 100.0]), 33), np.zeros(3, np.int64)
    single, run = (steps.iterate(tripod, penalty, limit=300, ahead=a) for a in (0.0, AHEAD))
    assert (single.count == run.count).all()
    assert len(run.history) < 100
    first, second = (tripod.compute_output_errors(x.values, machine) for x in (single, run))
    np.testing.assert_allclose(second, first, rtol=1e-4)


def test_ridge_leaps_agree_with_100000_single_steps(tripod) -> None:
    """Errors computed once by a loop of single steps (15 minutes); lambda = 100 ends before."""
    penalty = penalize_ridge(np.array([0.01, 0.1, 1.0, 100.0]), 33)
    run = steps.iterate(tripod, penalty, limit=100_000)
    errors = tripod.compute_output_errors(run.values, np.zeros(4, np.int64))[:, :2]
    expected = [
        [6.8725196e-3, 3.7259392e-2],  # [mm], [deg]
        [6.0248488e-3, 3.7245793e-2],
        [5.4766020e-3, 3.8343422e-2],
        [4.9843617e-3, 2.8652481e-2],
    ]
    np.testing.assert_allclose(errors, expected, rtol=1e-3)
    assert run.is_converged.tolist() == [False, False, False, True]
    assert run.count[3] == pytest.approx(87048, rel=1e-3)


def test_stated_number_of_steps_is_taken_by_every_method(tripod) -> None:
    """Least squares, too, which ends after 40 steps where none is stated."""
    penalty = np.concatenate([np.zeros((1, 33)), penalize_ridge(np.array([1.0]), 33)])
    run = take_steps(tripod.raw.take(np.zeros(2, np.int64)), penalty, StepRule(0.0, 45))
    assert run.count.tolist() == [45, 45]


def test_ridge_runs_until_its_steps_are_small(tripod) -> None:
    penalty = penalize_ridge(np.array([1e-5, 1e-4, 1e-3]), 33)
    run = steps.iterate(tripod, penalty)
    assert run.is_converged.all()
    assert (run.count > [50, 500, 2000]).all()
    assert (run.count < LIMIT).all()
    again, _ = tripod.raw.take(np.repeat(FIRST, 3)).linearize(run.values)
    step = again.deviation(again.solution(penalty))
    assert (np.abs(step).max(axis=1) < 1.01 * EPSILON).all()


def test_diverged_iteration_has_no_values_after_its_last_step(tripod) -> None:
    run = steps.iterate(tripod.five, np.zeros((1, 33)))
    assert run.is_diverged.all()
    assert np.isfinite(run.history[0]).all()
    for lost in (run.values, run.history[-1], run.steps[-1]):
        assert np.isnan(lost).all()


def test_interior_minimum_is_lower_than_both_ends() -> None:
    for curve, is_inside in (
        ([2.0, 1.0, 2.0], True),
        ([1.0, 1.0, 2.0], False),
        ([1.04, 1.0, 2.0], False),
        ([np.inf, 2.0, 1.0, 2.0], True),  # diverged: no part of it
        ([np.inf, 1.0, 2.0], False),
    ):
        assert (steps.compute_rise(np.array(curve)) > 1.05) == is_inside


@pytest.mark.parametrize(
    ("best", "ends", "is_inside"),
    [
        (1e6, (1e-6, 1e7), True),  # beyond the first range
        (1e-7, (1e-8, 1e4), True),
        (1e20, (1e-6, 1e12), False),  # beyond every range
        (0.0, (1e-6, 1e4), False),  # LS is best
        (1e2, (1e-6, 1e4), True),
    ],
)
def test_range_of_lambda_gets_decades_until_the_minimum_is_inside(best, ends, is_inside) -> None:
    asked: list[float] = []

    def run(lambdas: np.ndarray) -> list[np.ndarray]:
        asked.extend(lambdas)
        away = lambdas if best == 0.0 else abs(np.log(np.maximum(lambdas, 1e-30) / best))
        return [np.repeat(away[None, :, None], 5, axis=2)]

    lambdas, (curve,) = steps.widen(run, np.array([0.0, *np.logspace(-6, 4, 11)]), (0, 1), 1)
    assert (lambdas[1], lambdas[-1]) == pytest.approx(ends)
    assert sorted(asked) == list(lambdas)
    bottom = int(np.argmin(curve[0, :, 0]))
    assert (0 < bottom < len(lambdas) - 1) == is_inside


@pytest.mark.slow
def test_best_lambda_and_k_of_the_3_prs_are_those_of_independent_code(results) -> None:
    """Numbers of an audit with other code: [mm], [deg]; `all steps` end after 87,048 steps."""
    sweep = results.draws["3-PRS"][0]
    for method, setting, errors in (
        (steps.RE, 100.0, (0.0050, 0.0287)),
        (steps.TSVD, 23.0, (0.0044, 0.026)),
    ):
        assert sweep.chosen[method].settings[0] == setting
        np.testing.assert_allclose(sweep.chosen[method].errors[0, :2], errors, rtol=0.01)
    assert sweep.chosen[steps.RE].is_converged[0]
    early = [lam for count, lam, *_ in results.ridge_steps if count != "all"]
    # 0.0063 to 0.156 on a grid of 100 per decade, here 12; the audit stated 0.0055 to 0.14
    np.testing.assert_allclose((min(early), max(early)), (0.0063, 0.156), rtol=0.1)
    assert not any(is_at_end for _, _, is_at_end, _ in results.ridge_steps)


@pytest.mark.slow
def test_a_minimum_is_inside_the_range_or_the_row_says_that_it_is_not(results) -> None:
    for sweep in results.sweeps.values():
        for algorithm, curves in sweep.curves.items():
            product = curves[0, :, 0] * curves[0, :, 1]
            is_inside = 0 < np.argmin(product) < len(product) - 1
            assert ("end of the range" in sweep.describe_setting(algorithm)) == (not is_inside)
    for six, five in results.draws.values():
        ends = {row[:2]: row[-1] for row in make_medians((six, five)).rows}
        assert ends["6-DOF", steps.LS] is None
        for algorithm, curves in six.curves.items():
            bottoms = np.argmin(curves[:, :, 0] * curves[:, :, 1], axis=1)
            last = curves.shape[1] - 1
            assert ends["6-DOF", algorithm] == ((bottoms == 0) | (bottoms == last)).sum()
            assert (bottoms < last).all()  # decades were added


@pytest.mark.slow
def test_drawn_iterations_are_computed_steps_that_do_not_rise_after_leaps(results) -> None:
    figures = {f.name: f for f in PAPERS["tsvd-2016"].present(results, 0, DRAWS).content.figures}
    lines = {s.label: s for s in figures["convergence"].series}
    for name in ("3-PRS", "RU-PUS-PRS"):
        early, whole = (lines[f"{a}, {name}"] for a in (steps.EARLY, steps.RE))
        assert early.x == tuple(range(1, 21))
        assert whole.x[:20] == early.x
        y = np.array(whole.y[4:])
        assert (y[1:] < 1.02 * np.minimum.accumulate(y)[:-1]).all()


@pytest.mark.evidence
def test_same_seed_gives_the_same_numbers(results) -> None:
    for first, again in zip(
        results.draws["3-PRS"], steps.simulate_machines(DESIGN, 0, 2), strict=True
    ):
        for method, answer in again.chosen.items():  # a machine is the same however many there are
            errors = first.chosen[method].errors[:2]
            np.testing.assert_allclose(answer.errors, errors, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "p", "parameters"),
    [("3-PRS", 33, {"a1y", "a2y", "a3y"}), ("RU-PUS-PRS", 25, {"a1y", "a2x", "thU2z"})],
)
def test_5_dof_measurement_leaves_one_combination_unidentifiable(
    results, name, p, parameters
) -> None:
    six, five = results.draws[name]
    ranks = (*(steps.find_rank(sweep.study) for sweep in (six, five)), five.study.known.rank)
    assert ranks == (p, p - 1, p - 1)
    assert five.singular_values[-1] < 1e-11
    assert five.singular_values[-2] > 1e-6
    (null,) = five.study.known.unidentifiable
    assert set(null.names) == parameters
    assert five.is_diverged(steps.LS)
    # rank detection alone: as good as with 6-DOF
    ranked, ls = five.chosen[steps.RANKED].errors[0, :2], six.chosen[steps.LS].errors[0, :2]
    np.testing.assert_allclose(ranked, ls, rtol=0.02)
    assert (five.chosen[steps.PRIOR].errors < 1.2 * six.chosen[steps.PRIOR].errors)[0, :2].all()


@pytest.mark.slow
def test_tsvd_needs_fewest_iterations_and_ridge_most(results) -> None:
    for sweep in results.sweeps.values():
        chosen = {name: (c.iterations[0], c.is_converged[0]) for name, c in sweep.chosen.items()}
        ls, _ = chosen[steps.LS if sweep.study.freedoms == 6 else steps.RANKED]
        count, is_converged = chosen[steps.TSVD]
        assert is_converged
        assert count < ls
        assert chosen[steps.RE][0] > 100 * ls
    lambdas = [lam for _, lam, *_ in results.ridge_steps]  # rise with the iterations
    assert lambdas == sorted(lambdas)
    assert lambdas[-1] > 5.0 * lambdas[0]


@pytest.mark.slow
def test_map_has_smaller_errors_than_raw_methods_on_drawn_machines(results) -> None:
    def compare(sweep: steps.Sweep, method: str, other: str) -> np.ndarray:
        first, second = (np.median(sweep.chosen[m].errors, axis=0) for m in (method, other))
        return first / second

    for six, _ in results.draws.values():
        for method in (steps.LS, steps.RE, steps.TSVD):
            assert (compare(six, steps.PRIOR, method)[:2] < 1.1).all()
            assert compare(six, steps.PRIOR, method)[1] < 0.7  # in angle by far
    six, five = results.draws["3-PRS"]
    assert (compare(six, steps.PRIOR, steps.CROSS)[:2] < 1.15).all()
    ranked = np.median(five.chosen[steps.RANKED].errors, axis=0)
    ls = np.median(six.chosen[steps.LS].errors, axis=0)
    np.testing.assert_allclose(ranked[:2], ls[:2], rtol=0.02)
    # parameters of least squares deviate although poses do not
    ls, prior = (six.chosen[m].errors[0] for m in (steps.WHITENED, steps.PRIOR))
    assert ls[0] < 0.01  # [mm]
    assert ls[3] > 10.0  # [tolerances]
    assert prior[3] < 1.0


VERDICTS = {
    "ls_fails": (True,), "no_solution": (True,), "faster": (True, None), "deviate": (True,),
    "k_near_j": (None,), "lambda_range": (None,), "noise": (True,),
    "tsvd_best": (False, None),
}  # fmt: skip
"""Answers that six draws may give; None where they are too few, or of other machines."""


@pytest.mark.slow
def test_statements_and_own_checks_have_the_expected_verdicts(results) -> None:
    verdicts = judge_claims(results)
    assert [v.name for v in verdicts if not v.draws] == ["noise"]  # of Appendix 1 alone
    answers = {v.name: v.agrees for v in verdicts if v.name != "u_shape"}
    assert len(verdicts) == len(answers) + 4  # curves with 6- and 5-DOF measurement
    assert all(answers[name] in allowed for name, allowed in VERDICTS.items())
    own = {"noise", "five_usable", "map_better"}
    assert {v.name for v in verdicts if v.is_own_check} == own
    assert all("MAP" not in v.claim for v in verdicts if not v.is_own_check)


@pytest.mark.slow
def test_verdicts_on_curves_equal_comparisons_written_out_machine_by_machine(results) -> None:
    verdicts = judge_claims(results)
    situations = results.sweeps.values()
    best, lost = np.ones(DRAWS, dtype=bool), np.zeros(DRAWS, dtype=bool)
    for situation, u_shape in zip(situations, verdicts, strict=False):
        held: list[bool | None] = []
        for i in range(DRAWS):
            ridge, truncated = (situation.curves[a][i, :, :2] for a in (steps.RE, steps.TSVD))
            tsvd, re = (x[np.argmin(x[:, 0] * x[:, 1])] for x in (truncated[1:], ridge[1:]))
            others = (re, truncated[0])
            best[i] &= all((tsvd <= other).all() for other in others)
            lost[i] |= any((other < tsvd).all() for other in others)
            usable = [curve[np.isfinite(curve)] for curve in (*ridge.T, *truncated.T)]
            rises = [min(c[0], c[-1]) / c[1:-1].min() for c in usable]
            held.append(True if min(rises) > 1.05 else False if min(rises) <= 1.0 else None)
        assert (u_shape.name, list(u_shape.draws)) == ("u_shape", held)
    decided = tuple(map(decide, best, lost))
    assert next(v for v in verdicts if v.name == "tsvd_best").draws == decided


def flatten_sweep(sweep: steps.Sweep, t: int) -> steps.Sweep:
    """Return the settings of a sweep with t machines on which all errors are 1, and 2 before."""
    lost = np.full((t, len(sweep.study.robot.parameters)), np.nan)

    def flat(*shape: int) -> np.ndarray:
        return np.ones((t, *shape, len(steps.MEASURES)))

    chosen = {
        a: steps.Chosen(np.ones(t), lost, np.full(t, 9), np.ones(t, bool), flat())
        for a in sweep.chosen
    }
    curves = {a: flat(len(settings)) for a, settings in sweep.settings.items()}
    study = replace(sweep.study)
    vars(study)["before"] = 2.0 * flat()
    return replace(sweep, study=study, chosen=chosen, curves=curves, exact=flat())


def flatten(results: Results, t: int) -> Results:
    """Return results of t machines on which all errors are 1, in arrays that may be changed."""
    draws = {
        name: tuple(flatten_sweep(sweep, t) for sweep in sweeps)
        for name, sweeps in results.draws.items()
    }
    return replace(results, draws=draws)


def make_true(claim: str, draws: list[tuple[steps.Sweep, ...]], is_true: np.ndarray) -> None:
    """Change flat results so that a claim is true in these draws (t,) and false in the others."""
    low, high = np.where(is_true, 0.5, 2.0), np.where(is_true, 2.0, 0.5)
    for number, (six, five) in enumerate(draws):
        for sweep in (six, five):
            chosen, curve = sweep.chosen, sweep.curves[steps.TSVD]
            match claim:
                case "u_shape":
                    for curves in sweep.curves.values():
                        curves[is_true, 0] = curves[is_true, -1] = 2.0
                case "ls_not_best":
                    chosen[steps.LS].errors[:] = high[:, None]
                case "tsvd_best":
                    chosen[steps.TSVD].errors[:] = low[:, None]
                case "deviate":
                    for algorithm in (steps.RANKED, steps.RE, steps.TSVD):
                        chosen[algorithm].errors[:, :2] = 0.1
                        chosen[algorithm].errors[:, 4] = np.where(is_true, 0.3, 0.0)
                case "faster":
                    chosen[steps.TSVD].iterations[:] = np.where(is_true, 5, 20)
                case "lambda_range":
                    best = np.where(is_true, 1e-4 if number else 1e-1, 10.0)
                    for algorithm in (steps.RE, steps.EARLY):
                        chosen[algorithm].settings[:] = best
                case "k_near_j":
                    curve[np.arange(len(low)), np.where(is_true, 1, -1)] = 0.5
                case "no_rule":
                    chosen[steps.CROSS].errors[:] = high[:, None]
                case "map_better":
                    chosen[steps.PRIOR].errors[:] = low[:, None]
                case _:
                    pass
        match claim:
            case "ls_stable":
                six.chosen[steps.LS].is_converged[:] = is_true
            case "ls_fails":
                five.chosen[steps.LS].errors[is_true] = np.inf
            case "no_solution":
                six.exact[:], five.exact[:, 3] = 0.0, np.where(is_true, 1.0, 0.0)
            case "six_better":
                for algorithm in (steps.RE, steps.TSVD):
                    five.chosen[algorithm].errors[:, 3] = high
            case "five_usable":
                five.chosen[steps.RANKED].errors[:] = low[:, None]
            case _:
                pass


CLAIMS = [name for name in results_module.TEXT.find("claims") if name != "noise"]


@pytest.mark.slow
@pytest.mark.parametrize("claim", CLAIMS)
def test_every_claim_agrees_disagrees_or_stays_undecided(results, claim) -> None:
    """True in all draws, in none, and in every second one; and in none of the paper's machines."""
    t, answers = 12, []
    for is_true in (np.ones(t, bool), np.zeros(t, bool), np.arange(t) % 2 == 0):
        made = flatten(results, t)
        make_true(claim, [*made.draws.values()], is_true)
        chosen = [v for v in judge_claims(made) if v.name == claim]
        for verdict in chosen:
            assert verdict.draws == tuple(is_true)
            assert "nan" not in verdict.why
        answers.append({(v.agrees, v.is_elsewhere) for v in chosen})
    is_elsewhere = claim in ("k_near_j", "lambda_range")
    no = (None, True) if is_elsewhere else (False, False)
    assert answers == [{(True, False)}, {no}, {(None, False)}]


@pytest.mark.slow
def test_noise_is_judged_by_its_root_mean_square(results) -> None:
    """Uniform noise, two and a half standard deviations less, and half of it."""
    drawn = np.linspace(-1.0, 1.0, 217)[:216].reshape(36, 6) * steps.list_limits() * RAW
    for factor, answer in ((1.0, True), (1.0 - 2.5 / np.sqrt(5.0 * 216), None), (0.5, False)):
        rows = {str(i): tuple(map(str, row)) for i, row in enumerate(factor * drawn)}
        (verdict,) = (
            v for v in judge_claims(replace(results, noise=Printed(rows))) if v.name == "noise"
        )
        assert verdict.agrees is answer


def test_printed_noise_decides_limits_and_number_of_poses(tmp_path, monkeypatch) -> None:
    folder = Path(steps.__file__).parent
    text = (folder / "published.yaml").read_text("utf-8").replace(" 0.009651", " 0.029651")
    text = re.sub(r'^  "3[4-6]": "[-0-9. ]*"\n', "", text, flags=re.MULTILINE)
    (tmp_path / "published.yaml").write_text(text.replace('"0.009651', '"0.029651'), "utf-8")
    monkeypatch.setattr(steps, "PRINTED", PaperFile(str(tmp_path / "steps.py"), "published.yaml"))
    np.testing.assert_allclose(steps.list_limits()[:3], 0.03e-3)
    assert len(steps.load_design("3-PRS").poses) == 33


@pytest.mark.slow
def test_tables_and_figures_show_diverged_fits_as_diverged(results) -> None:
    content = PAPERS["tsvd-2016"].present(results, 0, DRAWS).content
    tables = {table.name: table for table in content.tables}
    for table in tables.values():
        cells = [cell for row in table.rows for cell in row if isinstance(cell, float)]
        assert np.isfinite(cells).all(), table.name
        assert table.text()
    for name, number in (("3_prs", 8), ("ru_pus_prs", 7)):
        end = [row for row in tables[f"history_{name}_5"].rows if row[0] == steps.LS][-1]
        assert set(end[2:]) == {DIVERGED}
        (row,) = (row for row in tables[f"table_{number}"].rows if row[:2] == ("5-DOF", steps.LS))
        assert row[3:7] == (DIVERGED,) * 4
    assert np.isnan(collect_history(results.draws["3-PRS"][1], steps.LS)[1][-1]).all()
    figures = {figure.name: figure for figure in content.figures}
    assert {f"figure_{n}{part}" for n in (6, 8, 10, 11) for part in "ab"} <= set(figures)
    for figure in figures.values():
        assert all(np.isfinite(s.y).all() and len(s.x) == len(s.y) for s in figure.series)
    for name, k in (("figure_8b", 25.0), ("figure_11b", 33.0)):  # k = number of parameters
        (marked,) = (s for s in figures[name].series if s.label == DIVERGED)
        assert marked.x == (k,)
    assert content.comparisons[0].within.all()


@pytest.mark.slow
def test_medians_stand_between_the_quarters_of_the_machines_and_diverged_ones_are_counted(
    results,
) -> None:
    for draws in results.draws.values():
        table = make_medians(draws)
        rows: dict[Any, Any] = {row[:2]: row for row in table.rows}
        assert rows["", steps.BEFORE][2] > 10.0 * rows["6-DOF", steps.PRIOR][2] > 0.0
        low, high = map(float, rows["6-DOF", steps.PRIOR][3].split(" to "))
        assert 0.99 * low <= rows["6-DOF", steps.PRIOR][2] <= 1.01 * high  # of two digits
        assert rows["5-DOF", steps.LS][2] == DIVERGED
        assert rows["5-DOF", steps.LS][-2] == DRAWS
        assert "true spread" in table.note
    ends = {row[0]: row for row in make_curves(results.draws["3-PRS"][1]).rows if row[1] == 33.0}
    assert ends[steps.TSVD][2] == ends[steps.TSVD][6] == DIVERGED


@pytest.fixture(scope="module")
def tripod_file(tmp_path_factory) -> Path:
    """Return the file of a 3-PRS of other dimensions."""
    changed = {"name: 3-prs": "name: my tripod", "base_radius: 350": "base_radius: 260",
               "platform_radius: 200": "platform_radius: 120", "rod: 500": "rod: 400",
               "{z: 700}": "{z: 520}", "[650, 750]": "[480, 560]", "[0, 35]": "[0, 28]",
               "sd: 0.076": "sd: 0.05"}  # fmt: skip
    text = find_robot_file("3-prs").read_text("utf-8")
    for old, new in changed.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path_factory.mktemp("robot") / "tripod.yaml"
    path.write_text(text, "utf-8")
    return path


OF_FIVE = {"ls_fails", "no_solution", "six_better", "five_usable"}
OF_PAPER = {"lambda_range", "noise"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "measures", "left_out"),
    [
        ("five-bar", ("position [mm]",), OF_PAPER | OF_FIVE),
        ("agile-eye", ("phi and theta [deg]",), OF_PAPER),
        ("linear-delta", ("position [mm]",), OF_PAPER | OF_FIVE),
    ],
)
def test_another_robot_has_the_tables_figures_and_claims_of_its_freedoms(
    robot, measures, left_out
) -> None:
    made = PAPERS["tsvd-2016"].run(0, 2, robot=robot)
    content, text = made.content, " ".join(made.replaced)
    assert not content.comparisons
    names = {v.name for v in content.verdicts}
    assert {*CLAIMS, "noise"} - names == left_out
    tables = {table.name.rsplit("_", 1)[0]: table for table in content.tables}
    outputs = next(table for name, table in tables.items() if name.startswith("outputs"))
    before: dict[str, Any] = dict(zip(outputs.columns, outputs.rows[0], strict=True))
    assert {name for name in steps.MEASURES[:2] if before[name] is not None} == set(measures)
    assert all(isinstance(before[name], float) and before[name] > 0.0 for name in measures)
    kinds = {figure.name.split("_")[0] for figure in content.figures}
    assert kinds == {"medians", "curve", "history", "convergence"}
    curves = [figure for figure in content.figures if figure.name.startswith("curve_")]
    labels = {series.label.split(", ")[0] for figure in curves for series in figure.series}
    assert set(measures) <= labels <= {*measures, DIVERGED}
    shown = next(t for t in content.tables if t.name.startswith("curves") and t.shown)
    places, column = shown.shown or (), shown.columns.index(measures[0])
    for algorithm in (steps.RE, steps.TSVD):
        rows = [(row[column], i) for i, row in enumerate(shown.rows) if row[0] == algorithm]
        inside = rows if algorithm == steps.RE else rows[1:]  # k of all parameters is LS
        finite = [pair for pair in inside if isinstance(pair[0], float)]
        assert min(finite)[1] in places
    medians = [figure for figure in content.figures if figure.name.startswith("medians")]
    assert all(s.joined != ("bottom of each" in s.label) for s in medians[0].series)
    assert sum(not s.joined for s in medians[0].series) == len(measures)
    compared = {"ls_not_best", "tsvd_best", "ls_fails", "six_better", "faster", "no_rule"}
    for verdict in content.verdicts:
        assert ("RE, 20 steps" in verdict.why) >= (verdict.name in compared), verdict.name
        assert not re.search(r"\binf\b", verdict.why)
    words = " ".join([*made.about, *(figure.caption for figure in content.figures)])
    assert "ours" not in words
    assert "our dimensions" not in words
    assert "0 settings" not in words
    assert "36 poses of" in text
    assert "free parameters" in text
    assert ("the angles are left out" in text) == (robot != "agile-eye")


def test_the_study_of_another_robot_is_the_one_that_is_written(tripod_file, tmp_path) -> None:
    design = steps.adapt_design(PAPERS["tsvd-2016"].make_case(tripod_file))
    theta = np.rad2deg(design.poses[:, design.robot.controlled.index("theta")])
    np.testing.assert_allclose(np.unique(np.round(theta, 9)), [8.0, 16.0, 24.0])
    path = tmp_path / "study.yaml"
    write_files(make_paper_study(PAPERS["tsvd-2016"], path, str(tripod_file)))
    study = load_study(path)
    keeps = [level.keep for level in study.methods.values() if level.keep is not None]
    assert keeps == list(range(len(design.free) - 1, 0, -1))
    (cell,) = calibrate_cells(
        set_size(study, 0, 2), find_cells(study, instrument="6-DOF", method="LS")
    )
    measured = steps.measure_machines(design, cell.truth)
    np.testing.assert_allclose(measured.trials.readings, cell.readings, rtol=0, atol=1e-12)
    drawn = np.abs(design.draw_true_values(5, 0) - design.robot.parameters.nominal)
    limit = np.sqrt(12.0 / 7.0) * design.robot.parameters.tolerance  # half to whole of it
    assert ((drawn >= 0.5 * limit - 1e-12) & (drawn <= limit + 1e-12)).all()


@pytest.mark.parametrize(("old", "new", "message"), [
    ("tolerances:", "", "no free parameter of .* has an expected spread"),
    ("z: [480, 560]", "z: [4800, 5600]", "almost nothing of its workspace"),
])  # fmt: skip
def test_a_robot_without_errors_or_workspace_is_refused(
    tripod_file, tmp_path, old, new, message
) -> None:
    text, path = tripod_file.read_text("utf-8"), tmp_path / "robot.yaml"
    path.write_text(text.replace(old, new) if new else text.split(old)[0], "utf-8")
    with pytest.raises(LoopcalError, match=message):
        PAPERS["tsvd-2016"].run(0, 2, robot=path)


def load_evidence(name: str) -> dict:
    return json.loads((ROOT / "docs" / "evidence" / f"{name}.json").read_text("utf-8"))


def read_column(document: dict, table: str, number: int) -> dict[tuple[str, str], float]:
    return {tuple(row[:2]): row[number] for row in document["tables"][table]["rows"]}


@pytest.mark.evidence
def test_evidence_map_is_better_than_raw_methods_and_near_gcv() -> None:
    document = load_evidence("three_prs_draws")
    assert document["draws"] >= 100
    for number in (2, 4):  # position, angle
        medians = read_column(document, "medians", number)
        prior = medians["6-DOF", steps.PRIOR]
        for method in (steps.LS, steps.RE, steps.TSVD):
            assert prior < medians["6-DOF", method]
        assert prior < 1.05 * medians["6-DOF", steps.CROSS]


@pytest.mark.evidence
def test_evidence_curves_of_the_3_prs_are_u_shaped_and_5_dof_is_as_accurate() -> None:
    document = load_evidence("three_prs_draws")
    for freedoms in ("6", "5"):
        for algorithm in document["minimum_inside"][freedoms].values():
            assert all(inside["median"] for inside in algorithm.values())
            assert min(inside["machines"] for inside in algorithm.values()) > 70
    for number in (2, 4):  # position, angle
        medians = read_column(document, "medians", number)
        for five, six, within in ((steps.RANKED, steps.LS, 0.02), (steps.WHITENED, steps.WHITENED,
                                  0.05), (steps.PRIOR, steps.PRIOR, 0.1)):  # fmt: skip
            assert medians["5-DOF", five] == pytest.approx(medians["6-DOF", six], rel=within)


@pytest.mark.evidence
def test_evidence_curves_of_the_ru_pus_prs_are_u_shaped_where_the_range_is_wide_enough() -> None:
    document = load_evidence("ru_pus_prs_draws")
    for freedoms in ("6", "5"):
        for algorithm in document["minimum_inside"][freedoms].values():
            for name, share in (("position [mm]", 0.7), ("phi and theta [deg]", 0.9)):
                assert algorithm[name]["median"]
                assert algorithm[name]["machines"] > share * document["draws"]
    medians = read_column(document, "medians", 4)  # angle
    for method in (steps.LS, steps.RE, steps.TSVD):
        assert medians["6-DOF", steps.PRIOR] < medians["6-DOF", method]
