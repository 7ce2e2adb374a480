# SPDX-License-Identifier: Apache-2.0
"""Characters that are shown as escapes, in text and in JSON."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from loopcal.errors import FileError
from loopcal.plain_text import SHOWN, escape, escape_json, find_not_plain, name_character, quote

CHARACTERS = {
    "\x1b": "\\x1b",
    "\x07": "\\x07",
    "\x9b": "\\x9b",
    "\x7f": "\\x7f",
    "\n": "\\n",
    "\u202e": "\\u202e",
    "\u2066": "\\u2066",
    "\u2028": "\\u2028",
    "\u200b": "\\u200b",
    "\ufeff": "\\ufeff",
    "\udcff": "\\udcff",
    "\U000e0041": "\\U000e0041",
}
PLAIN = [
    "leg 1",
    "Größe",
    "αβγ",
    "数控",
    "\u0645\u06cc\u200c\u062e\u0648\u0627\u0647\u0645",
    "12 µm",
    "°C",
    "😀",
    "C:\\temp",
    "a\u00a0b",
]


@pytest.mark.parametrize("character", CHARACTERS)
def test_character_that_is_not_plain_is_shown_as_its_escape(character) -> None:
    assert escape(f"a{character}b") == f"a{CHARACTERS[character]}b"
    assert find_not_plain(f"a{character}b") == character
    assert find_not_plain(f"a{character}b", allowed=character) is None
    assert escape(f"a{character}b", allowed=character) == f"a{character}b"


@pytest.mark.parametrize("text", PLAIN)
def test_text_of_any_language_is_plain(text) -> None:
    assert escape(text) == text
    assert find_not_plain(text) is None


@settings(max_examples=50)
@given(st.text(st.sampled_from([*CHARACTERS, "a", "\\", '"', "é"])))
def test_json_keeps_its_content_and_contains_no_character_that_is_not_plain(text) -> None:
    document = json.dumps({text: [text]}, indent=2, ensure_ascii=False)
    escaped = escape_json(document)
    assert json.loads(escaped) == {text: [text]}
    assert find_not_plain(escaped, "\n") is None
    escaped.encode("utf-8")


def test_long_text_is_quoted_in_part() -> None:
    assert quote("a") == "'a'"
    assert quote("x" * 99) == repr("x" * SHOWN + "…")
    assert quote("\u202e" * 3) == "'\\u202e\\u202e\\u202e'"
    assert quote(3) == "3"
    assert len(quote(list(range(999)))) == SHOWN + 1


def test_characters_have_names() -> None:
    assert name_character("\u202e") == "U+202E (right-to-left override)"
    assert name_character("\x1b") == "U+001B (a control character)"
    assert name_character("\udcff") == "U+DCFF (half of a character)"


def test_path_of_an_error_is_plain() -> None:
    assert str(FileError("bad", "a\x1b[31m\n\udcff.csv", 3)) == "a\\x1b[31m\\n\\udcff.csv:3: bad"
