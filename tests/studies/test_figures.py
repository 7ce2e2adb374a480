# SPDX-License-Identifier: Apache-2.0
"""Figures of studies: what is along the axis, has colors and panels, and what the title says."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.studies.results.questions import FRAMES, view_summary
from loopcal.studies.results.study_result import StudyResult
from loopcal.studies.specification.levels import MethodLevel, NoiseLevel, PosesLevel, Question
from loopcal.studies.specification.levels import Scores as ScoreSettings
from loopcal.studies.specification.study import Cell, Study
from tests.studies.stored_scores import Scores, make_study, store_scores

CHOICES = {
    "10 random": PosesLevel(10),
    "20 random": PosesLevel(20),
    "10 planned": PosesLevel(10, "planned"),
    "20 planned": PosesLevel(20, "planned"),
}
METHODS = (
    "default",
    "tolerances as stated",
    "default with Huber",
    "least squares",
    "ridge",
    "truncated SVD",
)


def draw_scores(cell: Cell) -> Scores:
    position = np.random.default_rng(cell.number).lognormal(-11.0, 0.5, 20)
    return {"position": position, "condition": 1e9 * position}


def store(folder: Path, **changes: object) -> StudyResult:
    study: Study = replace(make_study(20), noise={"1": NoiseLevel(1.0)}, **changes)  # type: ignore[arg-type]
    return store_scores(folder / "study", study, draw_scores)


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
    assert figure.get_suptitle().splitlines() == [
        "Stated scores",
        "Held-out position error after calibration, rms",
        FRAMES["base"],
        "n = 20 converged trials of each cell; bars are 95 % intervals",
    ]
    limits = [line for line in figure.axes[0].lines if np.array_equal(line.get_xdata(), [0, 1])]
    assert_allclose([np.asarray(line.get_ydata()) for line in limits], [[0.015, 0.015]])  # mm
    other = result.draw("condition")
    assert "frame" not in other.get_suptitle()
    assert not any(np.array_equal(line.get_xdata(), [0, 1]) for line in other.axes[0].lines)


def test_scores_of_both_frames_have_the_frame_of_each_in_their_title(tmp_path: Path) -> None:
    result = store(tmp_path, scores=ScoreSettings(frame="both"))
    for score, frame in (("position", "fitted"), ("position_base", "base")):
        assert FRAMES[frame] in " ".join(result.draw(score).get_suptitle().splitlines())
    page = view_summary(result.study, result.summarize(), ("position_base",))
    assert FRAMES["both"] in str(page[1])


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
