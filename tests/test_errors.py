# SPDX-License-Identifier: Apache-2.0
"""Error classes: one base class, messages with file and line, similar names."""

import inspect
import itertools

import pytest

from loopcal import errors
from loopcal.errors import MOST_NAMES, FileError, LoopcalError, suggest_names


def test_every_error_class_is_a_loopcal_error() -> None:
    classes = [
        c for _, c in inspect.getmembers(errors, inspect.isclass) if issubclass(c, Exception)
    ]
    assert len(classes) == 8
    assert all(issubclass(c, LoopcalError) for c in classes)


@pytest.mark.parametrize(
    ("line", "text"), [(7, "robot.yaml:7: bad key"), (None, "robot.yaml: bad key")]
)
def test_file_error_names_path_and_line(line: int | None, text: str) -> None:
    error = FileError("bad key", "robot.yaml", line)
    assert str(error) == text
    assert (str(error.path), error.line) == ("robot.yaml", line)


def test_only_similar_names_are_suggested() -> None:
    assert suggest_names("lenght", ["length", "angle"]) == " (did you mean 'length'?)"
    assert suggest_names("zzz", ["length", "angle"]) == ""


def test_no_name_is_suggested_where_there_are_too_many_to_compare() -> None:
    assert "'p7'" in suggest_names("p7 ", (f"p{i}" for i in range(MOST_NAMES)))
    assert suggest_names("p7 ", (f"p{i}" for i in itertools.count())) == ""
