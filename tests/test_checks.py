# SPDX-License-Identifier: Apache-2.0
"""Options of plans and studies accept the words and numbers that they state, and no others."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import UnionType
from typing import Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

import pytest

from loopcal.checks import Limit, Limited, check_choice
from loopcal.errors import DataError, EstimationError
from loopcal.planning.constraints import PlanOptions
from loopcal.planning.plane_line_planning import SurfaceOptions
from loopcal.studies.files.study_file import LEVELS
from loopcal.studies.specification import Question, Scores, Study

RECORDS: list[tuple[Any, dict[str, Any]]] = [
    *((record, {}) for record in (PlanOptions, SurfaceOptions, Scores, *LEVELS.values())),
    (Question, {"factor": "poses", "score": "position", "limit": 1.0}),
]


def list_words(record: type) -> dict[str, tuple[str, ...]]:
    """Return the words of each setting with a choice, by its annotation."""
    found = {}
    for name, hint in get_type_hints(record).items():
        parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        found |= dict.fromkeys([name] * (get_origin(parts[0]) is Literal), get_args(parts[0]))
    return found


@pytest.mark.parametrize(("record", "needed"), RECORDS, ids=lambda value: str(value)[-30:])
def test_settings_with_a_choice_of_words_accept_these_only(record, needed) -> None:
    for name, words in list_words(record).items():
        for wrong in (words[0] + "s", 1, ["pose"]):
            with pytest.raises((DataError, ValueError), match=f"{name} is .*{words[-1]}"):
                record(**{**needed, name: wrong})


def test_records_under_test_have_choices() -> None:
    assert sum(len(list_words(record)) for record, _ in RECORDS) >= 9


@pytest.mark.parametrize(("record", "needed"), RECORDS, ids=lambda value: str(value)[-30:])
def test_limits_are_of_settings_and_their_defaults_are_allowed(record, needed) -> None:
    assert record.LIMITS.keys() <= {item.name for item in fields(record)}
    record(**needed)


@pytest.mark.parametrize("wrong", [{"seed": -1}, {"replicates": 0}, {"block": 0}, {"block": 2001}])
def test_numbers_of_a_study_are_refused_as_those_of_its_file(wrong) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(wrong))} is .*, but must be from"):
        Study(title="wrong", robots={}, **wrong)


def test_wrong_word_names_the_option_what_is_allowed_and_what_is_similar() -> None:
    words = r"mode is 'reading' \(did you mean 'readings'\?\), but must be one of 'readings', 'x'"
    with pytest.raises(EstimationError, match=words):
        check_choice("mode", "reading", ("readings", "x"))
    check_choice("mode", "x", ("readings", "x"))


def test_limit_refuses_with_the_error_of_its_record() -> None:
    @dataclass
    class Settings(Limited):
        LIMITS: ClassVar[Mapping[str, Limit]] = {
            "share": Limit(lambda value: value < 1.0, "below 1")
        }
        ERROR = DataError
        share: float | None = None

    Settings()
    with pytest.raises(DataError, match=r"^share is 1\.5, but must be below 1$"):
        Settings(1.5)
