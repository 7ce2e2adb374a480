# SPDX-License-Identifier: Apache-2.0
"""The 42-parameter hexapod study: which published numbers and claims are confirmed.

Statistics are over 10 drawings (seed 0). Their bounds are written beside them and hold for seeds 0
to 6 too. A root mean square over 10 drawings of few independent directions has an uncertainty of
some 15 %.
Page: docs/papers.md.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.errors import DataError, LoopcalError
from loopcal.papers.hexapod_42 import results as steps
from loopcal.papers.hexapod_42.results import (
    Results,
    compute,
    count_printed,
    judge_claims,
    make_tables,
)
from loopcal.papers.paper import PAPERS
from loopcal.papers.published import PaperFile, write_page
from loopcal.studies.simulation.published_steps import LegForm
from tests.papers.random_results import collect_answers
from tests.papers.small_reproduction import MADE_BY

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
TRIALS = 10
STATED = (1e-3, 1e-6)  # [mm, rad]


@pytest.fixture(scope="module")
def results() -> Results:
    return compute(0, TRIALS, lambda _: None)


@pytest.fixture(scope="module")
def setup(results) -> steps.Setup:
    return results.setup


def find_limits(instrument: str) -> np.ndarray:
    length, angle = steps.list_noises()[instrument]
    return np.array([length * steps.MM] * 3 + [angle] * 3)


def simulate_stated_noise(setup: steps.Setup, seed: int, trials: int) -> lc.Trials:
    noise = lc.Uniform(np.roll(find_limits(steps.STATED), 3))
    instrument = lc.Instrument((lc.Sensor(lc.Pose("euler-xyz"), noise),))
    truth = np.repeat(setup.truth.values[None], trials, axis=0)
    return lc.simulate_trials(setup.robot, truth, setup.commanded.T, instrument, seed)


def test_table_4_follows_from_tables_2_and_3_to_one_unit_of_the_last_digit(results) -> None:
    fourth = results.comparisons["table_4"]
    labels = fourth.published.labels
    actual = np.array([x.endswith((" PP", " E1")) and not x.startswith("A2 ") for x in labels])
    assert actual.sum() == 18
    assert fourth.within[actual].sum() == 108  # all of them
    assert not fourth.within[labels.index("A2 PP")].all()


def test_noise_free_steps_agree_with_the_paper(results, setup) -> None:
    threshold, iterations = setup.epsilon, count_printed()
    assert (threshold, iterations) == (1e-6, 2)
    # [mm] with a new matrix in each iteration, and with one throughout
    for run, second in ((results.runs["exact"], 2e-8), (results.runs["frozen"], 3e-6)):
        errors = np.abs(setup.truth.values - run.values).max(axis=1) / steps.MM
        assert run.integrated[0] == pytest.approx(0.058938, abs=5e-7)  # [mm + rad], last digit
        assert errors[1] == pytest.approx(1.6e-3, rel=0.1)
        assert errors[2] < second
        assert run.count_needed(threshold) == iterations
        assert run.count_needed(0.0) is None
    exact = results.runs["exact"]
    assert np.abs(setup.truth.values - exact.values[3]).max() / steps.MM < 1e-8
    conditions = np.round(exact.conditions)
    np.testing.assert_array_equal(conditions, [5822, 3501, 4924, 4570, 3385, 4683])


def test_stated_noise_prevents_the_stopping_rule_and_worsens_parameters(results) -> None:
    stated = results.levels[steps.STATED]
    assert not np.isfinite(stated.needed).any()
    assert 6e-4 < stated.median[3] < 1.2e-3  # [mm + rad]; 7.6e-4 to 9.5e-4 over seeds 0 to 6
    before, alone, together, prior = (draws.rms for draws in results.methods.values())
    assert before["parameters"] == pytest.approx(0.0336, abs=1e-4)  # [mm] Table 3 itself
    assert 0.14 < alone["parameters"] < 0.26  # [mm]; 0.168 to 0.200 over seeds 0 to 6
    assert 1.5 < alone["parameters"] / together["parameters"] < 3.1  # 1.8 to 2.6 over seeds 0 to 6
    assert prior["parameters"] < before["parameters"]
    assert 0.6e-3 < alone["as in the paper"] < 2e-3  # [mm]
    assert 0.008 < alone["wide"] < 0.03  # [mm]


def test_per_leg_fit_has_2_4_times_the_standard_deviation_of_the_joint_fit(setup) -> None:
    sd, legs = find_limits(steps.STATED) / np.sqrt(3.0), LegForm.at(setup.robot, setup.commanded)
    unit = np.eye(60).reshape(60, 10, 6) * sd  # exact to first order: each of 60 noises on its own
    squares = [legs.fit(setup.to_twists(noise, setup.actual)) ** 2 for noise in unit]
    trials = simulate_stated_noise(setup, 0, 2)
    fits = lc.identify_trials(setup.robot, trials, lc.LeastSquares())
    together = fits.standard_deviations()[0]
    rms = [np.sqrt(np.mean(x)) / steps.MM for x in (np.sum(squares, axis=0), together**2)]
    np.testing.assert_allclose(rms, [0.199, 0.084], rtol=0.03)  # [mm]
    assert rms[0] / rms[1] == pytest.approx(2.4, abs=0.1)


def test_noise_follows_from_the_seed_and_is_that_of_simulated_trials(setup) -> None:
    made = simulate_stated_noise(setup, 3, 2)
    for trial in range(2):
        drawn = steps.draw_measured_poses(setup, STATED, 3, trial)
        ours = steps.to_measurements(setup, drawn).observations[0].measured
        np.testing.assert_allclose(made.measured[0][trial], ours, rtol=0, atol=1e-13)  # rounding
    first, again, other = (steps.draw_measured_poses(setup, STATED, seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


def test_40_wide_poses_reduce_the_error_tenfold_at_the_stated_noise(results) -> None:
    rows = {(row["poses"], row["number"]): row for row in results.poses}
    assert all(row["iterations"] == 2 for row in rows.values())
    assert max(row["left"] for row in rows.values()) < 1e-9  # [mm], without noise
    wide, ten = rows["drawn, wide", 40][steps.PER_LEG], rows[steps.MEASURED, 10][steps.PER_LEG]
    assert 0.004 < wide < 0.012  # [mm]; 0.0058 to 0.0074 over seeds 0 to 6
    assert wide < ten / 10.0


def test_claims_have_the_expected_verdicts(results) -> None:
    judged = {v.name: v.agrees for v in judge_claims(results)}
    assert len(judged) == 10
    assert None not in judged.values()
    assert {name for name, agrees in judged.items() if agrees} == {
        "exact", "table_4", "threshold", "poses_improve", "positions_improve", "fewest_poses",
    }  # fmt: skip
    answers = collect_answers(judge_claims, results, 16, keep=(steps.Setup,))  # any numbers
    assert len(answers) == 10


def with_units(results: Results, units: float) -> Results:
    """Return results that differ from Table 4 by units of the last digit."""
    old = results.comparisons["table_4"]
    is_odd = np.array([label.startswith("A2 ") for label in old.published.labels])
    off = np.where(is_odd[:, None], old.computed, old.published.values + units * old.step)
    return replace(results, comparisons={"table_4": replace(old, computed=off)})


def with_draws(results: Results, **changes: Any) -> Results:
    alone = replace(results.methods["alone"], **changes)
    return replace(results, methods={**results.methods, "alone": alone})


def with_stated(results: Results, **changes: Any) -> Results:
    stated = replace(results.levels["stated"], **changes)
    return replace(results, levels={**results.levels, "stated": stated})


def with_run(results: Results, name: str, **changes: Any) -> Results:
    run = replace(results.runs[name], **changes)
    return replace(results, runs={**results.runs, name: run})


def make_exact(results: Results, left: float) -> Results:
    """Return results in which this share of the errors is left in the end."""
    truth, nominal = results.setup.truth.values, results.setup.robot.values
    shares = np.array([1.0, *[left] * (len(results.runs["exact"].values) - 1)])
    return with_run(results, "exact", values=truth + shares[:, None] * (nominal - truth))


def make_never(results: Results, *names: str) -> Results:
    for name in names:
        results = with_run(results, name, integrated=np.ones(6))
    return results


def make_places(results: Results, near: np.ndarray, wide: np.ndarray) -> Results:
    """Return results whose position errors are factors of those before."""
    before, factors = results.methods["before"].places, {"as in the paper": near, "wide": wide}
    places = {name: before[name] * factor for name, factor in factors.items()}
    return with_draws(results, places=places)


def make_fewest(results: Results, left: float | None) -> Results:
    first, *others = results.poses
    return replace(results, poses=[{**first, "left": left}, *others])


def draw(value: float, other: float | None = None) -> np.ndarray:
    """Return draws of one value, or half of them of another one."""
    return np.where(np.arange(TRIALS) % 2, value if other is None else other, value)


# claim -> results for which it agrees, does not agree, and is undecided
OUTCOMES: dict[str, tuple[Callable[[Results], Results], ...]] = {
    "table_4": tuple(partial(with_units, units=u) for u in (0.5, 3.0, 1.5)),
    "exact": tuple(partial(make_exact, left=x) for x in (0.01, 1.5, 0.5)),
    "converges": tuple(
        (lambda r, x=x: with_draws(r, largest=x))
        for x in (draw(0.01), draw(0.62), draw(0.62, 0.01))
    ),
    "threshold": (
        lambda r: r, lambda r: make_never(r, "exact", "frozen"), lambda r: make_never(r, "frozen"),
    ),
    "threshold_noise": tuple(
        (lambda r, x=x: with_stated(r, needed=x)) for x in (draw(2.0), draw(3.0), draw(2.0, np.inf))
    ),
    "parameters_improve": tuple(
        (lambda r, h=h: with_draws(r, smaller=draw(0.9), halved=h))
        for h in (draw(0.8), draw(0.2), draw(0.2, 0.8))
    ),
    "poses_improve": tuple(
        (lambda r, x=x: with_stated(r, sizes=x[:, None] * [1.0, 1e-3, 9.0, 1.0]))
        for x in (draw(1e-4, 1.1e-4), draw(0.025, 0.026), draw(1e-4, 0.025))
    ),
    "positions_improve": tuple(
        partial(make_places, near=draw(0.1), wide=w) for w in (draw(0.9), draw(2.0), draw(0.9, 2.0))
    ),
    "leg_by_leg": tuple(
        (lambda r, x=x: with_draws(r, parameters=r.methods["together"].parameters * x))
        for x in (draw(1.0), draw(3.0), draw(1.0, 3.0))
    ),
    "fewest_poses": tuple(partial(make_fewest, left=x) for x in (1e-9, None, 1e-3)),
}  # fmt: skip


@pytest.mark.parametrize("claim", OUTCOMES)
def test_every_claim_can_agree_disagree_and_stay_undecided_and_every_draw_decides(
    results, claim
) -> None:
    found = []
    for make in OUTCOMES[claim]:
        (verdict,) = (v for v in judge_claims(make(results)) if v.name == claim)
        assert None not in verdict.draws
        found.append(verdict.agrees)
    assert found == [True, False, None]


def test_every_claim_has_results_for_all_outcomes(results) -> None:
    assert {verdict.name for verdict in judge_claims(results)} == set(OUTCOMES)


def test_lost_draws_are_dashes_and_count_against_an_improvement(results) -> None:
    lost = np.where(np.arange(TRIALS) < 9, np.nan, 0.01)
    places = dict.fromkeys(results.methods["alone"].places, lost)
    changed = with_draws(results, parameters=lost, places=places)
    methods = next(table for table in make_tables(changed) if table.name == "methods")
    assert methods.text()[1][1:] == ("-", "-", "-")
    judged = {verdict.name: verdict.agrees for verdict in judge_claims(changed)}
    assert judged["positions_improve"] is judged["leg_by_leg"] is False


@pytest.fixture
def change_print(tmp_path, monkeypatch) -> Callable[[str, str], None]:
    """Change a text of published.yaml."""

    def change(old: str, new: str) -> None:
        text = PAPERS["hexapod-42"].read_file("published.yaml")
        assert old in text
        folder = tmp_path / str(len(list(tmp_path.iterdir())))  # files are read once
        folder.mkdir()
        (folder / "published.yaml").write_text(text.replace(old, new, 1))
        changed = PaperFile(str(folder / "steps.py"), "published.yaml")
        monkeypatch.setattr(steps, "PRINTED", changed)

    return change


def test_changed_noise_rule_errors_and_poses_of_the_print_change_what_is_computed(
    change_print, setup
) -> None:
    change_print('value: "0.001", unit: mm', 'value: "0.003", unit: mm')
    assert steps.list_noises()["stated"] == (3e-3, 3e-6)
    assert steps.list_noises()["presumed"] == (3e-6, 3e-9)
    made = steps.make_setup()
    assert made.study.instruments["stated"].sigma_position == pytest.approx(3e-6 / np.sqrt(3.0))
    change_print('threshold: {value: "1E-06"', 'threshold: {value: "1E-03"')
    made = steps.make_setup()
    assert made.epsilon == made.study.methods[steps.PER_LEG].epsilon == 1e-3
    change_print('leg1: "0.02 0.03 -0.05', 'leg1: "0.07 0.03 -0.05')
    made = steps.make_setup()
    change = made.truth.values - setup.truth.values
    assert change[made.robot.parameters.index("leg1.base.x")] == pytest.approx(5e-5)
    (errors,) = made.study.errors.values()
    assert errors.deviations["leg1.base.x"] == f"{float(made.truth.values[0]) - 0.12!r} m"
    change_print('A1: "10 0 200', 'A1: "12 0 200')
    made = steps.make_setup()
    (poses,) = made.study.poses.values()
    assert poses.coordinates[0][0] == made.coordinates[0, 0] == pytest.approx(0.012)
    change_print('least: "7"', 'least: "8"')
    assert steps.make_setup().fewest == 8
    change_print('iterations: {value: "2"', 'iterations: {value: "3"')
    assert count_printed() == 3


def test_the_robot_file_has_the_printed_nominal_parameters(setup) -> None:
    printed, places = steps.PRINTED.table("table_2"), steps.find_places(setup.robot)
    nominal = setup.robot.parameters.nominal[places] / steps.MM
    assert (abs(nominal - printed.values) <= 0.5 * printed.unit + 1e-9).all()
    assert setup.robot.parameters.free.all()


# noise +- [mm], [rad] -> rms of pose residuals [mm], [rad] and of parameter errors [mm], max dQint.
# Independent numbers of an audit, for one draw or two; drawn rms scatter by some 20 %.
FOUR_LEVELS = {
    (1e-3, 1e-6): (3.2e-4, 1.3e-6, 0.205, 8.4e-4),
    (1e-6, 1e-12): (3.0e-7, 1.2e-9, 1.7e-4, 8.5e-7),
    (1e-6, 5e-9): (3.5e-7, 1.9e-9, 2.2e-4, 9e-7),
    (1e-6, 1e-6): (2.6e-5, 2.3e-7, 0.025, 6.5e-5),
}


def test_sizes_at_four_levels_of_noise_are_those_of_an_audit(results) -> None:
    levels = {level.limits: level.median for level in results.levels.values()}
    for limits, sizes in FOUR_LEVELS.items():
        np.testing.assert_allclose(levels[limits], sizes, rtol=0.25)


def write_robot(path: Path, *changes: tuple[str, str]) -> Path:
    """Write a hexapod of other dimensions, with an offset tool and two fixed parameters."""
    text = (ROOT / "src/loopcal/robots/hexapod-octahedral.yaml").read_text()
    for old, new in (("name: hexapod-octahedral", "name: mine"), *changes):
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def test_study_of_another_hexapod_has_its_tables_figures_and_claims(tmp_path) -> None:
    tool = ("home: {z: 300}", "home: {z: 300}\ntool: {x: 30, z: 50, pitch: 20}")
    fixed = ("tolerances:", "fixed: [leg1.platform.z, leg4.length]\ntolerances:")
    robot = write_robot(tmp_path / "mine.yaml", ("[250, -20, 0]", "[262, -24, 3]"), tool, fixed)
    case = PAPERS["hexapod-42"].make_case(robot)
    made = compute(3, 3, lambda _: None, case)
    setup = made.setup
    assert not np.array_equal(setup.robot.tool, np.eye(4))
    assert len(setup.coordinates) == 10
    assert np.abs(setup.truth.values - setup.robot.values).max() > 1e-5
    for name in ("exact", "frozen"):  # the tool is where the kind and the twists put it
        errors = np.abs(setup.truth.values - made.runs[name].values).max(axis=1)
        assert errors[4] < 1e-6 * errors[0]
    for cell in (setup.calibrate(3, 3, "stated", name) for name in setup.study.methods):
        np.testing.assert_array_equal(cell.truth, np.tile(setup.truth.values, (3, 1)))
    shown = PAPERS["hexapod-42"].present(made, 3, 3, case)
    assert shown.replaced[0] == "The robot is mine in place of hexapod-42."
    assert "in place of two ranges" in shown.replaced[-1]
    assert shown.content.comparisons == ()
    tables = {table.name: table for table in shown.content.tables}
    assert set(tables) == {
        "figure_4", "conditions", "parameters", "pose_errors", "noise", "methods", "poses"
    }  # fmt: skip
    assert len(tables["parameters"].rows) == 40
    assert len(tables["pose_errors"].rows) == 40
    assert [figure.name for figure in shown.content.figures] == ["figure_4", "noise"]
    assert {verdict.name for verdict in shown.content.verdicts} == {
        "exact", "converges", "threshold", "threshold_noise", "parameters_improve",
        "poses_improve", "positions_improve", "leg_by_leg", "fewest_poses",
    }  # fmt: skip
    text = write_page(shown, MADE_BY)
    assert "Published and computed" not in text
    assert all(verdict.reason in text for verdict in shown.content.verdicts)


def test_a_hexapod_with_more_parameters_is_said_to_have_the_poses_that_are_measured() -> None:
    case = PAPERS["hexapod-42"].make_case("6-rus")
    assert len(steps.make_setup(case).poses) == 14
    assert "14 poses come from the workspace of 6-rus" in " ".join(case.list_replaced())


def test_another_epsilon_ends_the_steps_and_is_stated() -> None:
    paper = PAPERS["hexapod-42"]
    case = paper.make_case(epsilon=0.01)
    made = compute(0, 2, lambda _: None, case)
    assert (made.levels["stated"].needed == 1.0).all()
    assert made.levels["stated"].median[3] < 0.01
    shown = paper.present(made, 0, 2, case)
    assert shown.replaced == (
        "The steps end when max dQint is at most 0.01 mm + rad, in place of 1e-06.",
    )
    assert shown.settings["epsilon"] == 0.01
    names = {verdict.name for verdict in shown.content.verdicts}
    assert names.isdisjoint({"converges", "threshold_noise"})
    needed = shown.content.tables[0].rows[-1]
    assert needed == ("iterations needed", 1, 1, 1, 1)
    with pytest.raises(DataError, match="epsilon is 1 for tsvd-2016"):
        PAPERS["tsvd-2016"].make_case(epsilon=1.0)
    for wrong in (np.inf, np.nan, 0.0):
        with pytest.raises(DataError, match="Give a finite number above 0, for hexapod-42 only"):
            paper.make_case(epsilon=wrong)


@pytest.mark.parametrize("wrong", ["inf", "1e999", "nan", "0", "-1"])
@pytest.mark.parametrize("command", ["reproduce hexapod-42 --trials 2", "per-leg hexapod-42 DATA"])
def test_an_epsilon_that_ends_no_steps_is_refused(capsys, tmp_path, command, wrong) -> None:
    data = tmp_path / "data.csv"
    assert main(["simulate", "hexapod-42", "--draw", "8", "-o", str(data)]) == 0
    words = command.replace("DATA", str(data)).split()
    assert main([*words, "--epsilon", wrong]) == 1
    assert "epsilon" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("robot", "code"),
    [
        ("3-prs", "fit.no-six-legs"),
        ("tricept", "fit.legs-coupled"),
        ("tolerances", "data.no-errors"),
    ],
)
def test_robots_that_do_not_fit_are_refused_with_what_to_use(tmp_path, capsys, robot, code) -> None:
    if robot == "tolerances":
        path = tmp_path / "plain.yaml"
        text = write_robot(path).read_text()
        path.write_text(text[: text.index("tolerances:")])
        robot = str(path)
    with pytest.raises(LoopcalError) as refused:
        PAPERS["hexapod-42"].run(0, 2, robot=robot)
    assert str(refused.value.code).startswith(code)
    assert main(["reproduce", "hexapod-42", "--trials", "2", "--robot", robot]) == 1
    said = capsys.readouterr().err
    assert ("loopcal reproduce tsvd-2016 --robot" in said) == code.startswith("fit.")


def test_iteration_ends_after_its_limit(setup) -> None:
    assert len(steps.iterate(setup, setup.actual, 2).integrated) == 3


def test_page_shows_all_tables_figures_and_statements(results) -> None:
    reproduction = PAPERS["hexapod-42"].present(results, 0, TRIALS)
    text, content = write_page(reproduction, MADE_BY), reproduction.content
    titles = [item.title for item in (*content.comparisons, *content.tables, *content.figures)]
    assert [title for title in titles if f"## {title}\n" not in text] == []
    columns = {table.name: " ".join(table.columns) for table in content.tables}
    assert columns["methods"].count("rms over draws") == 3
    assert columns["poses"].count("rms over draws") == 1  # "the same" is beside it
    assert columns["noise"].count("of one draw") == 1
    assert all(verdict.reason in text for verdict in content.verdicts)
