# SPDX-License-Identifier: Apache-2.0
"""One key of a YAML file is added and removed in any style; names are quoted where necessary."""

import json
from io import StringIO
from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from loopcal.errors import FileError
from loopcal.io.core.yaml_file import (
    add_key,
    format_yaml,
    make_yaml,
    parse_yaml,
    quote_scalar,
    remove_key,
)

ENTRY = "identified:  # delete this table\n  - {name: 'leg #1', value: 1.5, +/-: null, unit: mm}\n"
ROW = {"name": "leg #1", "value": 1.5, "+/-": None, "unit": "mm"}

STYLES = {
    "block": "a: 1\nb: [2, 3]\n",
    "no final newline": "a: 1\nb: [2, 3]",
    "comment without newline": "a: 1\nb: [2, 3]\n# the end",
    "comment behind the last value": "a: 1\nb: 2  # the end",
    "indented": "  a: 1\n  b:\n    c: 2\n",
    "indented without newline": "    a: 1 # one\n    b: 2",
    "list at the margin": "a:\n- 1\n- 2",
    "document end": "a: 1\nb: 2\n...\n",
    "document end without newline": "a: 1\n...",
    "document end and a comment": "a: 1\n... # the end\n# more\n",
    "document begin": "%YAML 1.2\n---\na: 1\n",
    "indented with document end": "---\n  a: 1 # one\n  # two\n...\n",
    "literal": "a: 1\nb: |\n  text",
    "literal with newline": "a: 1\nb: |\n  text\n",
    "literal that keeps breaks": "a: 1\nb: |+\n  text\n\n",
    "literal that keeps breaks, without newline": "a: 1\nb: |+\n  text",
    "folded": "a: 1\nb: >-\n  text\n  more",
    "literal with a number sign": "a: 1\nb: |\n  # no comment",
    "empty literal": "a: 1\nb: |\n",
    "empty last value": "a: 1\nb:",
    "plain text in two lines": "a: 1\nb: some\n  text",
    "quoted text in two lines": 'a: 1\nb: "some\n  text"',
    "explicit key": "? a\n: 1\n? b\n: 2\n",
    "anchor and alias": "a: &x [1, 2]\nb: *x\n",
    "anchor of the mapping": "&root\na: 1\nb: 2\n",
    "merge": "a: &x {c: 1}\nb: {<<: *x, d: 2}\n",
    "flow": "{a: 1, b: [2, 3]}\n",
    "flow without newline": "{a: 1, b: 2}",
    "flow in lines": "{\n  a: 1, # one\n  b: 2 # two\n}\n",
    "flow with a last comma": "{a: 1, b: 2,\n}\n",
    "flow with a comment behind it": "{a: 1} # the end",
    "flow behind a mark": "--- {a: 1}\n...\n",
    "JSON": json.dumps({"a": 1, "b": [1e-7, "x"], "c": {"d": None}}, indent=2),
    "JSON in one line": json.dumps({"a": 1, "b": True}),
    "key with a number sign": '"a #": 1\n"{b": 2',
    "Windows": "a: 1\r\nb: |\r\n  text\r\n",
    "Windows without newline": "a: 1\r\nb: 2",
    "tab": "a: 1 # one\nb: 'x\ty'\n",
    "blanks at the end": "a: 1\n   \n\n  ",
    "a key that contains the new one": "not-identified: 1\nidentified_by: me\n",
    "the new key in a text": "a: |\n  identified:\n  - 1\nb: 'identified: 2'\n",
    "the new key further inside": "a:\n  identified: 1\nb: {identified: 2}\n",
}
KEPT = "one of these comments"


def parse(text: str):
    return parse_yaml(text, Path("robot.yaml"), "robot file", has_names=False)


@pytest.mark.parametrize("text", STYLES.values(), ids=STYLES)
def test_a_key_is_added_and_removed_in_every_style(text: str) -> None:
    before = parse(text)
    with_key = add_key(before, ENTRY)
    assert parse(with_key.text).content == before.content | {"identified": [ROW]}
    assert parse(remove_key(with_key, "identified").text).content == before.content
    for comment in ("# one", "# two", "# more", "# the end"):
        assert with_key.text.count(comment) == text.count(comment)
        assert remove_key(with_key, "identified").text.count(comment) == text.count(comment)


@pytest.mark.parametrize(
    "text",
    [
        "identified: [{a: 1}]\nb: 2\n",
        "# first\nidentified:\n# inside\n  - {a: 1} # one\n\n# second\nb: 2\n",
        "b: 2\nidentified:\n- {a: 1}\n- a: 1\n  c: |\n    text\n# second\n",
        "b: 2\nidentified: # none\n",
        "b: 2\nidentified: 'text\n  more'\n# second",
        "{identified: [1, 2], b: 2}",
        "{b: 2, identified: {a: 1}}",
        "{b: 2, identified: [1],}",
        "{\n b: 2, # second\n identified: [1] # one\n}",
        '{"b": 2,\n "identified": []}',
        "  b: 2\n  identified: [&x 1, *x]\n",
        "? identified\n: [1]\n? b\n: 2\n",
        "b: &x 2\nidentified: *x\n",
        "identified: &x 2\nb: *x\n",
        "identified:\r\n  - 1\r\nb: 2\r\n",
    ],
)
def test_a_key_is_removed_wherever_it_is(text: str) -> None:
    file = remove_key(parse(text), "identified")
    assert parse(file.text).content == {"b": 2}
    assert file.text.count("# second") == text.count("# second")


def test_the_rest_of_a_file_stays_as_it_is() -> None:
    for text in ("# x\na:   1\nb : [2,3]  # y\n", "{a:   1, # x\n b : 2}"):
        with_key = add_key(parse(text), ENTRY)
        assert remove_key(with_key, "identified").text.split() == text.split()
        assert with_key.text.startswith(text[:-1])


def test_what_no_edit_can_express_is_written_anew() -> None:
    """An anchor in the removed value is used elsewhere, so the text without it is not YAML."""
    file = remove_key(
        parse("identified: &x 1e-05\nb: [*x, -0.0, 'a\\n', \"\\x7f\\u2028\"]\n"), "identified"
    )
    assert file.content == {"b": [1e-05, -0.0, "a\\n", "\x7f\u2028"]}
    assert file.text.isprintable() or file.text.strip("\n").isprintable()


WORDS = """
yes y N null ~ 1e3 =a *w %w "q" ' a: .inf NaN 0x1 1_0 2026-01-01 << !x &x | > @ ` { } [ ] , ---
... é \U0001f916"""
PHRASES = (
    "5 um",
    "-1.5e-05 rad",
    "0.5 1",
    " a",
    "a ",
    "leg #1",
    "a, b",
    "x: y",
    "- a",
    "? b",
    "\u2028",
    "\ufeff",
    "\x85",
    "# a",
)
NAMES = st.sampled_from((*WORDS.split(), *PHRASES)) | st.text(
    st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=12
)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.lists(NAMES, min_size=1, max_size=6, unique=True))
def test_any_name_is_quoted_so_that_yaml_reads_it_back(names: list[str]) -> None:
    quoted = [quote_scalar(name) for name in names]
    assert parse(f"a: [{', '.join(quoted)}]\n").content == {"a": names}
    assert parse("".join(f"{text}: 1\n" for text in quoted)).content == dict.fromkeys(names, 1)
    assert "\n" not in "".join(quoted)


@pytest.mark.parametrize("word", ["yes", "Off", "True", "null"])
def test_words_that_older_yaml_reads_as_something_else_are_quoted(word: str) -> None:
    assert quote_scalar(word) == f'"{word}"'


SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(10**15), 10**15)
    | st.floats(allow_nan=False, allow_infinity=False)
    | NAMES
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3)
)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(
    st.dictionaries(
        NAMES.filter(lambda name: name != "identified"), VALUES, min_size=1, max_size=4
    ),
    st.data(),
)
def test_any_mapping_takes_the_key_and_loses_it(content: dict, data) -> None:
    yaml, stream = make_yaml(), StringIO()
    yaml.default_flow_style = data.draw(st.booleans())
    yaml.explicit_end = data.draw(st.booleans())
    yaml.dump(content, stream)
    text = stream.getvalue().rstrip("\n" if data.draw(st.booleans()) else "")
    try:
        before = parse(text)
    except FileError:
        assume(False)  # ruamel.yaml does not quote all that it should
    with_key = add_key(before, ENTRY)
    assert with_key.content == before.content | {"identified": [ROW]}
    assert remove_key(with_key, "identified").content == before.content


@given(st.dictionaries(NAMES, VALUES, min_size=1, max_size=5))
@settings(max_examples=60, deadline=None)
def test_written_content_reads_the_same(content) -> None:
    comments = dict.fromkeys(content, "a comment: {of a key}")
    read = parse_yaml(format_yaml(content, comments), "f.yaml", "file", has_names=False)
    assert read.content == content


def test_what_fits_into_a_line_is_in_one_line() -> None:
    row = {"name": "y", "place": [0.1, -0.0]}
    text = (
        "a: {name: y, place: [0.1, 0.0]}     # one\nb:\n" + 7 * "  - {name: y, place: [0.1, 0.0]}\n"
    )
    assert format_yaml({"a": row, "b": [row] * 7}, {"a": "one"}) == text


@pytest.mark.parametrize("merged", ["5", "text", "[1, {c: 1}]", "[[{c: 1}]]", "~", "2026-01-01"])
def test_a_merge_of_what_is_no_mapping_is_refused_at_its_line(merged: str) -> None:
    with pytest.raises(FileError, match=r"robot\.yaml:2: <<"):
        parse(f"a: 1\nb: {{<<: {merged}, d: 2}}\n")
