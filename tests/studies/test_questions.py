# SPDX-License-Identifier: Apache-2.0
"""Questions to a study: certain answers are right, and others are open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy.stats import binom

from loopcal.errors import DataError
from loopcal.results.tables import render_text
from loopcal.studies.files.store import StudySource, open_study
from loopcal.studies.specification import (
    Cell,
    EffectsLevel,
    InstrumentLevel,
    Outliers,
    PosesLevel,
    Question,
    list_chains,
)
from loopcal.studies.study_result import (
    AnsweredQuestion,
    StudyResult,
    decide,
    say_answer,
    view_answers,
)
from tests.studies.stored_scores import Scores, make_study, store_scores

SHARES = {"10": 0.5, "20": 0.93, "40": 0.999}
"""Number of poses -> share of machines within 10 um, at noise 1; at noise 2 half of it."""

HOW_MANY = Question("poses", "position", "10 um", 0.9)


def draw_scores(cell: Cell) -> Scores:
    """Return errors that are below 10 um with the stated share; each tenth machine fails when the
    method is least squares.
    """
    share = SHARES[cell.levels["poses"]] / float(cell.levels["noise"])
    t = 2000
    is_within = np.arange(t) < share * t
    outcome = np.zeros(t)
    if cell.levels["method"] == "least-squares":
        outcome[::10] = 1.0
    return {"position": np.where(is_within, 9e-6, 11e-6), "outcome": outcome}


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> StudyResult:
    study = make_study(2000, {"how many": HOW_MANY})
    return store_scores(tmp_path_factory.mktemp("questions") / "study", study, draw_scores)


def by_levels(answered: AnsweredQuestion) -> dict[tuple[str, ...], str]:
    """Return other levels -> answer in words."""
    wanted = answered.question.wanted
    return {tuple(a.levels.values()): say_answer(a, wanted) for a in answered.answers}


def test_the_smallest_number_of_poses_is_found_for_every_other_combination(
    result: StudyResult,
) -> None:
    (answered,) = result.answer_questions()
    assert by_levels(answered) == {
        ("1", "map"): "20",
        ("1", "least-squares"): "not certain: 40, or no level",  # 0.999 of 0.9: on the limit
        ("2", "map"): "no level",
        ("2", "least-squares"): "no level",
    }
    question, *lines = str(answered).splitlines()
    assert "smallest level of poses" in question
    rows = [line.split() for line in lines if line.startswith(("1 ", "2 "))]
    assert len(rows) == 4
    assert rows[0][:5] == ["1", "map", "20", "10:", "50"]
    first = answered.answers[0]
    assert (first.quantity, first.unit, first.best) == ("count", "1", "20")
    assert [(s.level, s.value, s.reached, s.state) for s in first.shares] == [
        ("10", 10, 1000, "no"),
        ("20", 20, 1860, "yes"),
        ("40", 40, 1998, "yes"),
    ]


def test_the_largest_noise_that_still_does_is_found(result: StudyResult) -> None:
    answered = result.find_largest("noise", "position", "10 um", 0.9)
    answers = by_levels(answered)
    assert answers[("20", "map")] == "1"
    assert answers[("10", "map")] == "no level"
    generous = result.find_largest("noise", "position", "12 um", 0.8)
    assert by_levels(generous)[("10", "map")] == "2, the largest of the study"


def test_a_limit_has_the_unit_of_its_score(result: StudyResult) -> None:
    assert result.find_smallest("poses", "position", "0.01 mm").limit == pytest.approx(1e-5)
    assert result.find_smallest("poses", "parameters", "1.5").limit == 1.5
    with pytest.raises(DataError, match="limit"):
        result.find_smallest("poses", "position", "10 urad")
    with pytest.raises(DataError, match="limit is 'ten', but parameters has no unit"):
        result.find_smallest("poses", "parameters", "ten")


@pytest.mark.parametrize(
    ("factor", "score", "message"),
    [
        ("method", "position", r"levels \(map, least-squares\) have no order"),
        ("pose", "position", "factor is 'pose' .did you mean 'poses'"),
        ("poses", "positions", "score is 'positions'"),
        ("poses", "covered_parameters", "score is 'covered_parameters'"),
    ],
)
def test_questions_without_an_answer_are_refused(
    result: StudyResult, factor: str, score: str, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        result.find_smallest(factor, score, "10 um")


def test_a_study_without_trials_has_no_answer(tmp_path: Path) -> None:
    with open_study(tmp_path / "study", StudySource(make_study(1, {"how many": HOW_MANY}))):
        pass
    (answered,) = StudyResult(tmp_path / "study").answer_questions()
    assert {a.certainty for a in answered.answers} == {"unknown"}
    assert "no trials with this score" in render_text(view_answers([answered]), 200)


def test_the_page_states_level_share_interval_and_what_is_not_known(result: StudyResult) -> None:
    page = render_text(view_answers(result.answer_questions()), 110)
    assert "smallest level of poses with position up to 10 um on 90 % of machines" in page
    assert "10: 50 % (47.3 to 52.7); 20: 93 % (91.5 to 94.3)" in page
    assert "The study contains no levels between these." in page.replace("\n", " ")


def choose(true: dict[str, float], share: float, wanted: str) -> str | None:
    """Return the true answer."""
    order = list(true) if wanted == "smallest" else list(reversed(list(true)))
    return next((level for level in order if true[level] >= share), None)


@pytest.mark.parametrize("wanted", ["smallest", "largest"])
@pytest.mark.parametrize("n", [50, 400])
@pytest.mark.parametrize(
    "shares",
    [
        (0.2, 0.949, 0.951, 0.999),  # both sides of the demanded share
        (0.9499,) * 6,  # no level reaches it, each nearly
        (0.9501,) * 6,  # each reaches it, hardly
        (0.94, 0.96, 0.94, 0.96),  # not monotone
        (0.5, 0.8, 0.9, 0.97, 0.99),
    ],
)
def test_certain_answers_are_wrong_in_at_most_5_percent_of_studies(
    shares: tuple[float, ...], n: int, wanted: Literal["smallest", "largest"]
) -> None:
    true = {str(i): share for i, share in enumerate(shares)}
    truth, studies, wrong, missed = choose(true, 0.95, wanted), 600, 0, 0
    draws = np.random.default_rng([n, len(shares)]).binomial(n, shares, (studies, len(shares)))
    for row in draws.tolist():
        counts = {level: (reached, n) for level, reached in zip(true, row, strict=True)}
        certainty, candidates, may_be_none, _ = decide(counts, 0.95, wanted)
        if certainty == "certain":
            wrong += candidates[-1] != truth
        if certainty == "none":
            wrong += truth is not None
        # what is called open contains the truth, with the same probability
        missed += truth not in candidates if truth is not None else not may_be_none
    limit = binom.ppf(0.999, studies, 0.05)
    assert wrong <= limit
    assert missed <= limit


def test_intervals_that_ignore_the_number_of_levels_are_wrong_too_often() -> None:
    """The test above can fail: with 20 levels, separate intervals promise too much."""
    n, levels, studies, wrong = 400, 20, 400, 0
    draws = np.random.default_rng(1).binomial(n, 0.9499, (studies, levels))
    for row in draws.tolist():
        counts = {str(i): (reached, n) for i, reached in enumerate(row)}
        separate = 1.0 - 0.05 * levels * 0.99  # what decide() divides by the number of levels
        states = decide(counts, 0.95, confidence=separate)[3]
        wrong += any(state == "yes" for _, state in states.values())
    assert wrong > binom.ppf(0.999, studies, 0.05)


def test_enough_trials_give_certain_answers() -> None:
    true, n = {"10": 0.5, "20": 0.9, "40": 0.99}, 1000
    draws = np.random.default_rng(2).binomial(n, list(true.values()), (200, 3))
    answers = [decide(dict(zip(true, ((k, n) for k in row), strict=True)), 0.95) for row in draws]
    assert sum(a[0] == "certain" and a[1] == ("40",) for a in answers) >= 199


def test_levels_are_ordered_by_the_numbers_in_which_they_differ() -> None:
    study = make_study()
    (chain,) = list_chains(study, "poses")
    assert (chain.quantity, chain.levels) == ("count", ("10", "20", "40"))
    assert chain.values == (10, 20, 40)
    coarse = InstrumentLevel(("position",), sigma_position=6e-5, sigma_angle=9e-5)
    fine = replace(coarse, sigma_position=2e-5)
    study = replace(study, instruments={"coarse": coarse, "fine": fine})
    (chain,) = list_chains(study, "instrument")
    assert (chain.quantity, chain.unit, chain.levels) == ("sigma position", "m", ("fine", "coarse"))
    study = replace(study, instruments={"coarse": coarse, "other": replace(fine, sigma_angle=1.0)})
    assert [chain.levels for chain in list_chains(study, "instrument")] == [("coarse",), ("other",)]


def test_levels_with_other_words_are_compared_among_themselves(tmp_path: Path) -> None:
    poses = {"10": PosesLevel(10), "20": PosesLevel(20), "20 planned": PosesLevel(20, "planned")}
    study = replace(make_study(), poses=poses)
    chains = list_chains(study, "poses")
    assert [(chain.label, chain.levels) for chain in chains] == [
        ("choice random", ("10", "20")),
        ("choice planned", ("20 planned",)),
    ]
    result = store_scores(tmp_path / "study", study, lambda _: {"position": np.full(400, 1e-6)})
    answered = result.find_smallest("poses", "position", "10 um")
    assert [(a.chain, a.best) for a in answered.answers][:2] == [
        ("choice random", "10"),
        ("choice planned", "20 planned"),
    ]
    assert "choice planned" in render_text(view_answers([answered]), 110)


def test_effects_are_ordered_by_an_inner_number() -> None:
    effects = {
        "many": EffectsLevel(outliers=Outliers(0.1)),
        "few": EffectsLevel(outliers=Outliers(0.01)),
    }
    (chain,) = list_chains(replace(make_study(), effects=effects), "effects")
    assert (chain.quantity, chain.levels) == ("outliers share", ("few", "many"))


def test_score_that_the_robot_does_not_have_is_unknown_and_not_missed(tmp_path: Path) -> None:
    def compute(cell: Cell) -> Scores:
        outcome = np.where(np.arange(400) < 7, 1.0, 0.0)
        is_defined = cell.levels["noise"] == "2" and cell.levels["method"] == "map"
        return {"orientation": np.full(400, 1e-4 if is_defined else np.nan), "outcome": outcome}

    result = store_scores(tmp_path / "study", make_study(), compute)
    answered = result.find_smallest("poses", "orientation", "1 mrad")
    certainties = {tuple(a.levels.values()): a.certainty for a in answered.answers}
    assert certainties.pop(("2", "map")) == "certain"
    assert set(certainties.values()) == {"unknown"}
    unknown = next(a for a in answered.answers if a.certainty == "unknown")
    assert {(share.reached, share.trials) for share in unknown.shares} == {(0, 0)}
    assert "10: no trials" in render_text(view_answers([answered]), 200)


def test_only_answers_that_are_not_certain_lead_to_more_machines(tmp_path: Path) -> None:
    question = Question("poses", "position", "10 um", 0.99)
    for trials, is_open in ((100, True), (2000, False)):
        study = make_study(trials, {"all": question})
        folder = tmp_path / str(trials)
        kept = store_scores(folder, study, lambda _: {"position": np.full(2000, 9e-6)})
        page = render_text(view_answers(kept.answer_questions()), 100)
        assert ("not certain: " in page, "loopcal study extend" in page) == (is_open, is_open)
