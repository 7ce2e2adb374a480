# SPDX-License-Identifier: Apache-2.0
"""Summaries: intervals that hold, failed trials by code, tables, views; figures: what is along the
axis, has colors and panels, and what the title says.
"""

from __future__ import annotations

import csv
import json
import re
import tracemalloc
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import beta, binom

from loopcal.errors import DataError
from loopcal.report.pictures import render_figure
from loopcal.report.words import say
from loopcal.results.tables import render_text
from loopcal.studies.files.store import read_store
from loopcal.studies.simulation.block import OUTCOMES
from loopcal.studies.specification import Cell, MethodLevel, NoiseLevel, PosesLevel, Question, Study
from loopcal.studies.specification import Scores as ScoreSettings
from loopcal.studies.study_result import (
    MEMORY,
    CellSummary,
    Interval,
    StudyResult,
    compute_binomial_interval,
    estimate_mean,
    estimate_quantile,
    estimate_share,
    list_shown,
    say_failures,
    summarize_study,
    tabulate_medians,
    view_summary,
    write_summary,
)
from loopcal.studies.summary_drawing import choose_layout, render_figures
from tests.studies.stored_scores import Scores, make_study, store_scores

FAILED, RATE = 1, 0.1


"""Code of the failed trials of the stored study, and their rate."""


def median_error(cell: Cell) -> float:
    """Return the true median of the position errors of a cell [m]."""
    return 1e-4 * float(cell.levels["noise"]) / np.sqrt(float(cell.levels["poses"]))


def draw_scores(cell: Cell) -> Scores:
    """Return log-normal errors, coverage of ten parameters each, and outcomes."""
    stream = np.random.default_rng([7, cell.number])
    t = 400
    outcome = np.where(stream.random(t) < RATE, float(FAILED), 0.0)
    position = median_error(cell) * np.exp(0.5 * stream.standard_normal(t))
    position[outcome != 0.0] = np.nan
    covered = stream.binomial(10, 0.95, t) / 10.0
    return {"outcome": outcome, "position": position, "covered_parameters": covered}


def find(cell: CellSummary, score: str, kind: str) -> Interval:
    """Return a statistic of a cell, which must have it."""
    interval = getattr(cell.find_score(score), kind)
    assert isinstance(interval, Interval)
    return interval


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    folder = tmp_path_factory.mktemp("summary") / "study"
    return store_scores(folder, make_study(), draw_scores)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "n"), [(0.5, 9), (0.5, 101), (0.95, 40), (0.95, 400)])
def test_intervals_of_quantiles_cover_95_percent_or_more(share: float, n: int) -> None:
    draws = np.sort(np.random.default_rng(n).standard_exponential((1000, n)), axis=1)
    truth = -np.log(1.0 - share)
    intervals = [estimate_quantile(row, share) for row in draws]
    covered = sum(i.low <= truth <= i.high for i in intervals)
    # 0.1 % quantile of the number of intervals that cover, at a coverage of exactly 95 %
    assert covered >= binom.ppf(0.001, 1000, 0.95)
    # not wider than needed: the next narrower pair of order statistics would fall short
    assert covered <= binom.ppf(0.999, 1000, 0.995)


def test_intervals_of_shares_are_those_of_clopper_and_pearson_and_have_known_ends() -> None:
    interval = compute_binomial_interval(7, 20)
    assert interval.value == 0.35
    # R 4.3, binom.test(7, 20): 0.1539092 0.5921885
    assert (interval.low, interval.high) == pytest.approx((0.1539092, 0.5921885), abs=5e-8)
    assert compute_binomial_interval(0, 10).high == pytest.approx(1.0 - 0.025**0.1)
    assert compute_binomial_interval(10, 10).low == pytest.approx(0.025**0.1)
    assert compute_binomial_interval(3, 9, 0.99).low == pytest.approx(beta.ppf(0.005, 3, 7))
    assert np.isnan(compute_binomial_interval(0, 0).value)


def test_coverage_of_dependent_parameters_has_the_interval_of_independent_trials() -> None:
    # all ten parameters of a trial are covered together, so that a trial is one observation
    stream = np.random.default_rng(3)
    shares = np.repeat(stream.random((1000, 1, 200)) < 0.9, 10, axis=1).mean(axis=1)
    covered = sum((i := estimate_share(row)).low <= 0.9 <= i.high for row in shares)
    assert covered >= binom.ppf(0.001, 1000, 0.95)


def test_intervals_of_means_cover_95_percent() -> None:
    draws = np.random.default_rng(5).normal(3.0, 2.0, (4000, 12))
    covered = sum((i := estimate_mean(row)).low <= 3.0 <= i.high for row in draws)
    assert binom.ppf(0.001, 1000, 0.95) <= covered <= binom.ppf(0.999, 4000, 0.95)
    assert estimate_mean(np.array([2.0])).high == np.inf


def test_every_cell_has_its_numbers_and_its_failed_trials_by_code(result: StudyResult) -> None:
    summary = result.summarize()
    assert summary.is_complete
    assert summary.trials == 12 * 400
    medians_in = shares_in = 0
    for cell, summarized in zip(result.study.cells, summary.cells, strict=True):
        assert summarized.levels == cell.levels
        scores = draw_scores(cell)
        failed = int((scores["outcome"] == FAILED).sum())
        assert summarized.failed == {OUTCOMES[FAILED]: failed}
        assert summarized.converged.value == pytest.approx(1.0 - failed / 400)
        good = scores["position"][scores["outcome"] == 0.0]
        median = find(summarized, "position", "median")
        assert median.value == np.median(good)
        assert find(summarized, "position", "high").value == np.quantile(good, 0.95)
        assert find(summarized, "position", "mean").value == pytest.approx(good.mean())
        medians_in += median.low <= median_error(cell) <= median.high
        covered = summarized.find_score("covered_parameters")
        assert covered is not None
        assert covered.median is None
        share = find(summarized, "covered_parameters", "mean")
        shares_in += share.low < 0.95 < share.high
    assert min(medians_in, shares_in) >= binom.ppf(0.001, 12, 0.95)


def test_the_page_explains_failed_trials(result: StudyResult) -> None:
    summary = result.summarize()
    page = render_text(view_summary(result.study, summary, ["position"]), 100)
    count = sum(cell.failed[OUTCOMES[FAILED]] for cell in summary.cells)
    assert f"Failed trials: {count} of 4800." in page
    failed = [say_failures(cell.failed) for cell in summary.cells]
    assert all(re.fullmatch(r"\d+ out of iterations", words) for words in failed)
    assert [row[4] for row in tabulate_medians(result.study, summary, ()).rows] == failed
    assert "poses  noise  method" in page
    assert "exclude motions of frames that the measurements leave open" in " ".join(page.split())
    assert list_shown(result.study, summary) == ("position", "orientation", "covered_parameters")
    with pytest.raises(DataError, match=r"score is 'positon' .did you mean 'position'"):
        list_shown(result.study, summary, ["positon"])


def test_errors_before_stand_beside_those_after_and_results_at_the_step_limit_count(tmp_path):
    diverged, remain = (OUTCOMES.index(f"study.{name}") for name in ("diverged", "steps-remain"))

    def draw(cell: Cell) -> Scores:
        outcome = np.repeat([0.0, diverged, remain], [200, 50, 150])
        lost = outcome == diverged
        return {
            "outcome": outcome,
            "position_before": np.where(lost, 5e-3, 1e-3),
            "position": np.where(lost, np.nan, np.where(outcome == 0.0, 1e-5, 3e-5)),
        }

    result = store_scores(tmp_path / "study", make_study(), draw)
    summary = result.summarize()
    for cell in summary.cells:
        assert (cell.failed, cell.unfinished) == ({"study.diverged": 50}, 150)
        assert cell.converged.value == 0.5
        assert find(cell, "position", "mean").value == pytest.approx((200 * 1 + 150 * 3) / 35e6)
        assert find(cell, "position_before", "mean").value == pytest.approx(1.5e-3)
    table = tabulate_medians(result.study, summary, ["position"])
    shown = [column.heading for column in table.columns[3:]]
    assert shown == ["trials", "failed", "at step limit", "position before [mm]", "position [mm]"]
    assert {row[3:7] for row in table.rows} == {("400", "50 diverged", "150", "1")}
    page = render_text(view_summary(result.study, summary, ["position"]), 100)
    assert "Failed trials: 600 of 4800." in page
    assert "Trials at their limit of steps: 1800 of 4800." in page


def test_files_have_every_factor_as_a_column_and_are_read_back(result: StudyResult) -> None:
    summary = result.summarize()
    write_summary(result.folder, result.study, summary, (), {})
    with (result.folder / "summary.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 12
    for row, cell in zip(rows, summary.cells, strict=True):
        assert {name: row[name] for name in cell.levels} == cell.levels
        median = find(cell, "position", "median")
        assert float(row["position median [m]"]) == median.value
        assert float(row["position median low [m]"]) == median.low
        assert float(row["position mean high [m]"]) == find(cell, "position", "mean").high
        assert (row["failed"], row["unfinished"]) == (row["out of iterations"], "0")
        assert int(row["out of iterations"]) == cell.failed[OUTCOMES[FAILED]] > 0
    document = json.loads((result.folder / "summary.json").read_text("utf-8"))
    assert [cell["levels"] for cell in document["cells"]] == [c.levels for c in summary.cells]
    assert (document["format"], document["questions"]) == (1, [])


def test_figures_show_medians_against_poses_with_their_intervals(result: StudyResult) -> None:
    layout = choose_layout(result.study)
    assert (layout.axis, layout.color, layout.panels) == ("poses", "noise", ("method",))
    figure = result.draw("position")
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title() for axes in panels] == ["method map", "method least-squares"]
    summary = result.summarize()
    first = [c for c in summary.cells if c.levels["method"] == "map" and c.levels["noise"] == "1"]
    first.sort(key=lambda cell: float(cell.levels["poses"]))
    line, _, (bars,) = panels[0].containers[0]
    assert list(line.get_xdata()) == [10.0, 20.0, 40.0]
    medians = [find(cell, "position", "median") for cell in first]
    np.testing.assert_allclose(line.get_ydata(), [1e3 * m.value for m in medians])  # in mm
    ends = [segment[:, 1] for segment in bars.get_segments()]
    np.testing.assert_allclose(ends, [[1e3 * m.low, 1e3 * m.high] for m in medians])
    assert panels[0].get_ylabel() == "position [mm]"
    assert panels[0].get_xlabel() == "poses"


def test_figures_are_written_by_level_and_refused_where_there_are_too_many_panels(
    result: StudyResult,
) -> None:
    summary = result.summarize()
    figures = render_figures(result.study, summary, ["covered_parameters"], "method")
    assert list(figures) == ["covered_parameters.png"]
    assert figures["covered_parameters.png"].startswith(b"\x89PNG")
    labels = [text.get_text() for text in result.draw(factor="method").axes[0].get_xticklabels()]
    assert labels == ["map", "least-squares"]
    with pytest.raises(DataError, match=r"factor is 'pose' .did you mean 'poses'"):
        result.draw("position", "pose")


def test_a_cell_without_trials_and_one_with_few_have_no_false_bounds(tmp_path: Path) -> None:
    few = store_scores(tmp_path / "few", make_study(replicates=3), draw_scores)
    summary = few.summarize()
    assert {cell.trials for cell in summary.cells} == {3}
    # three trials bound no 95 % quantile
    assert find(summary.cells[0], "position", "high").high == np.inf
    assert len(render_figure(few.draw("position"), ".svg")) > 1000


def test_views_contain_every_trial_with_its_factors(result: StudyResult) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    table, data = result.to_frame(), result.to_dataset()
    assert len(table) == 4800
    cell = result.study.cells[5]
    expected = draw_scores(cell)["position"]
    chosen = table[(table[list(cell.levels)] == list(cell.levels.values())).all(axis=1)]
    np.testing.assert_array_equal(chosen["position"], expected)
    np.testing.assert_array_equal(data.position.sel(cell.levels), expected)
    assert data.position.attrs["units"] == "m"
    medians = table[table["outcome"] == 0].groupby("poses", observed=True)["position"].median()
    assert medians["10"] > medians["20"] > medians["40"]


def test_memory_does_not_grow_with_the_number_of_cells(result: StudyResult, tmp_path: Path) -> None:
    study = result.study
    with read_store(result.folder) as store:
        summarize_study(store)  # imports
        tracemalloc.start()
        try:
            summarize_study(store)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    one_cell = 8 * 400 * len(study.columns)
    assert peak < 10 * one_cell  # the trials of all cells are 12 times those of one


def test_scores_that_are_read_a_few_at_a_time_have_the_same_summary(
    result: StudyResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = result.summarize()
    monkeypatch.setattr(
        "loopcal.studies.study_result.MEMORY", 8 * 400 * 3
    )  # three scores of a cell
    assert result.summarize() == whole


@pytest.mark.evidence
def test_a_million_trials_are_summarized_with_bounded_memory(tmp_path: Path) -> None:
    def draw(cell: Cell) -> Scores:
        position = np.random.default_rng(cell.number).lognormal(-11.0, 0.5, 84_000)
        return {"position": position}

    result = store_scores(tmp_path / "study", make_study(84_000), draw)
    tracemalloc.start()
    try:
        summary = result.summarize()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert summary.trials == 1_008_000
    assert peak < 2 * MEMORY


CHOICES = {
    "10 random": PosesLevel(10),
    "20 random": PosesLevel(20),
    "10 planned": PosesLevel(10, "planned"),
    "20 planned": PosesLevel(20, "planned"),
}

METHODS = (
    "default",
    "spreads as given",
    "default with Huber",
    "least squares",
    "ridge",
    "truncated SVD",
)


def draw_shown_scores(cell: Cell) -> Scores:
    position = np.random.default_rng(cell.number).lognormal(-11.0, 0.5, 20)
    return {"position": position, "condition": 1e9 * position}


def store(folder: Path, **changes: object) -> StudyResult:
    study: Study = replace(make_study(20), noise={"1": NoiseLevel(1.0)}, **changes)  # type: ignore[arg-type]
    return store_scores(folder / "study", study, draw_shown_scores)


def test_levels_that_differ_in_words_are_lines_over_one_axis_of_numbers(tmp_path: Path) -> None:
    figure = store(tmp_path, poses=CHOICES).draw("position")
    panel = figure.axes[0]
    assert [axes.get_title() for axes in figure.axes] == ["method map", "method least-squares"]
    assert [t.get_text() for t in panel.get_xticklabels()] == ["10", "20"]
    lines = [container[0] for container in panel.containers]
    assert len(lines) == 4  # median and 95 %, of random and of planned poses
    for line in lines:
        assert_allclose(line.get_xdata(), [10.0, 20.0])
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words == ["choice random", "choice planned", "median", "95 % of machines"]


def test_the_title_states_score_and_frame_and_a_line_the_limit_of_the_question(
    tmp_path: Path,
) -> None:
    asked = {"q": Question("poses", "position", "15 um")}
    result = store(tmp_path, scores=ScoreSettings(frame="base"), questions=asked)
    figure = result.draw("position")
    lines = [
        "Stated scores",
        "Held-out position error after calibration, rms",
        say("study.frame-base"),
        "n = 20 trials of each cell that did not fail; bars are 95 % intervals",
    ]
    assert figure.get_suptitle().split() == " ".join(lines).split()
    limits = [line for line in figure.axes[0].lines if np.array_equal(line.get_xdata(), [0, 1])]
    assert_allclose([np.asarray(line.get_ydata()) for line in limits], [[0.015, 0.015]])  # mm
    other = result.draw("condition")
    assert "frame" not in other.get_suptitle()
    assert not any(np.array_equal(line.get_xdata(), [0, 1]) for line in other.axes[0].lines)


def test_scores_of_both_frames_have_the_frame_of_each_in_their_title(tmp_path: Path) -> None:
    result = store(tmp_path, scores=ScoreSettings(frame="both"))
    for score, frame in (("position", "fitted"), ("position_base", "base")):
        assert say(f"study.frame-{frame}") in " ".join(
            result.draw(score).get_suptitle().splitlines()
        )
    page = view_summary(result.study, result.summarize(), ("position_base",))
    assert say("study.frame-both") in str(page[1])


@pytest.mark.parametrize(
    "names", [METHODS, METHODS[:2], tuple(f"level{'x' * 14}{i}" for i in "12345")]
)
def test_long_names_of_levels_do_not_overlap(names: tuple[str, ...], tmp_path: Path) -> None:
    methods = {
        name: MethodLevel("map", loss="huber" if i else "none") for i, name in enumerate(names)
    }
    figure = store(tmp_path, methods=methods).draw("position", "method")
    figure.draw_without_rendering()
    for axes in figure.axes:
        labels = axes.get_xticklabels()
        assert [text.get_text().replace("\n", " ") for text in labels] == list(names)
        if labels[0].get_rotation() == 0.0:
            boxes = [text.get_window_extent() for text in labels]
            assert all(one.x1 < other.x0 for one, other in pairwise(boxes))
        else:
            assert all(text.get_horizontalalignment() == "right" for text in labels)
            ends = [text.get_window_extent().x1 for text in labels]
            assert min(np.diff(ends)) > 3.0 * float(labels[0].get_fontsize()) * figure.dpi / 72.0
