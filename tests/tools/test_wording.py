# SPDX-License-Identifier: Apache-2.0
"""Patterns of wording are found in the texts that people read, and in no code."""

from tools.wording import PATTERNS, find_patterns


def test_a_page_is_searched_outside_of_code_with_its_lines(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# Poses\n\n```text\nThe file is read; it is no file.\n```\n\nNobody moves. The rod,\n"
        "where it is short, is not longer `a; b`.\n\n| pose; | The rod is moved. |\n"
    )
    found = [(line, name) for line, name, _ in find_patterns(page)]
    assert found == [
        (7, '"hardly", "nobody", "beside", "beyond"'),
        (7, '"where" for "if"'),
        (10, "passive voice"),
    ]


def test_each_branch_of_a_template_is_searched_once(tmp_path):
    folder = tmp_path / "catalog"
    folder.mkdir()
    (folder / "fit.toml").write_text(
        '[fit.a]\ninfo = "{n:if|The {n:count rod} is moved|Nobody moves}. It is no rod."\n'
    )
    found = sorted(name for _, name, _ in find_patterns(folder / "fit.toml"))
    assert found == ['"hardly", "nobody", "beside", "beyond"', '"is no"', "passive voice"]


def test_help_texts_are_searched_and_docstrings_are_not(tmp_path):
    module = tmp_path / "commands.py"
    module.write_text(
        '"""It is no text."""\n@command()\ndef plan(out=option(f"Poses; {x} is no pose.")):\n'
        '    """Plan poses, so that they fit."""\n\ndef help():\n    """It is no text."""\n'
    )
    assert sorted((line, name) for line, name, _ in find_patterns(module)) == [
        (3, '"is no"'),
        (3, "semicolon"),
        (4, '", so that"'),
    ]


def test_a_long_sentence_has_more_than_25_words(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("word " * 25 + "\n\n" + "word " * 26 + "\n")
    assert [line for line, name, _ in find_patterns(page)] == [3]
    assert "more than 25 words" in PATTERNS
