# SPDX-License-Identifier: Apache-2.0
"""The wording of all findings: the only test that pins sentences."""

from __future__ import annotations

from loopcal.findings.catalog import load_catalog
from loopcal.findings.wording import depends_on_data
from tools import findings_reference


def test_texts_of_the_catalog_equal_the_pinned_wording():
    pinned = findings_reference.WORDING.read_text("utf-8").splitlines()
    worded = findings_reference.write_wording().splitlines()
    advice = "run `python -m tools.findings_reference --wording` and read its changes"
    assert set(worded) - set(pinned) == set(), advice
    assert worded == pinned, advice


def test_every_text_that_depends_on_its_data_has_an_example():
    entries = load_catalog().values()
    assert [e.code for e in entries if depends_on_data(e.text) and not e.example] == []


def test_texts_are_one_paragraph_without_command_line_options():
    for line in findings_reference.write_wording().splitlines():
        code, _, text = line.partition("]: ")
        assert text == " ".join(text.split()), code
        assert "--" not in text, code
