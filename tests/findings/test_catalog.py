# SPDX-License-Identifier: Apache-2.0
"""The catalog of findings agrees with the code that reports them."""

from __future__ import annotations

import ast
import inspect
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import loopcal
from loopcal.errors import EstimationError
from loopcal.findings import Quantity, Severity, report_finding
from loopcal.findings.catalog import FILES, find_entry, load_catalog, phrases, read_document
from loopcal.results.serialization import to_json
from tools import findings_reference

SOURCE = Path(loopcal.__file__).parent
OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]+")


@cache
def parse_modules() -> dict[str, ast.Module]:
    """Return the syntax trees of the package without the catalog, by path."""
    paths = {p.relative_to(SOURCE).as_posix(): p for p in SOURCE.rglob("*.py")}
    return {
        name: ast.parse(path.read_text("utf-8"))
        for name, path in sorted(paths.items())
        if not name.startswith("findings/catalog/")
    }


def list_reported_findings() -> Iterator[tuple[str, str, set[str]]]:
    """Return place, code and names of data of every finding, reported or raised, with a
    literal code.
    """
    for name, tree in parse_modules().items():
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call) or not node.args:
                continue
            code = node.args[0]
            if not isinstance(code, ast.Constant) or not isinstance(code.value, str):
                continue  # before the name of the function is written, which takes longer
            if re.fullmatch(r"report_finding|\w+Error\.of", ast.unparse(node.func)):
                given = {keyword.arg or "" for keyword in node.keywords} - {"severity"}
                yield f"{name}:{node.lineno}", code.value, given


CATALOG = load_catalog()


@pytest.mark.slow
def test_every_reported_code_is_in_the_catalog_with_the_same_fields():
    reported = list(list_reported_findings())
    assert len(reported) > 50
    for place, code, given in reported:
        assert code in CATALOG, f"{place}: {code}"
        if "" not in given:  # with **data it is checked when it is reported
            assert given == CATALOG[code].fields, f"{place}: {code}"


def test_every_code_of_the_catalog_is_used():
    nodes = [node for tree in parse_modules().values() for node in ast.walk(tree)]
    texts = {n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    # f"subject.{which}" makes any code of this subject
    begun = {n.values[0] for n in nodes if isinstance(n, ast.JoinedStr) and n.values}
    prefixes = tuple(
        str(p.value)
        for p in begun
        if isinstance(p, ast.Constant) and re.fullmatch(r"[a-z]+\.[a-z-]*", str(p.value))
    )
    unused = [code for code in CATALOG if code not in texts and not code.startswith(prefixes)]
    assert unused == []


def test_codes_consist_of_a_subject_and_a_name():
    assert [code for code in CATALOG if not re.fullmatch(r"[a-z]+\.[a-z0-9-]+", code)] == []


def test_refusals_and_failures_state_an_action():
    for entry in CATALOG.values():
        assert all(t.endswith(".") for t in (entry.when, entry.action) if t), entry.code
        if entry.severity in {Severity.REFUSAL, Severity.FAILURE}:
            assert entry.action or re.search(r"[.:;,] \w", entry.text), entry.code


def test_each_catalog_file_contains_its_listed_subjects():
    for file, subjects in FILES.items():
        assert read_document(file).keys() == {"title", *subjects}


def test_an_entry_that_is_parsed_alone_is_that_of_its_file() -> None:
    assert {code: find_entry(code) for code in CATALOG} == CATALOG


@pytest.mark.parametrize("code", ["fit.no-such-code", "nothing.no-descent", "fit", ""])
def test_a_code_that_is_not_in_the_catalog_is_a_key_error(code) -> None:
    with pytest.raises(KeyError):
        find_entry(code)


def test_every_phrase_is_used():
    texts = " ".join(entry.text for entry in CATALOG.values())
    templates = read_document("phrases")
    functions = (name for name, value in vars(phrases).items() if inspect.isfunction(value))
    defined = [name for name in functions if getattr(phrases, name).__module__ == phrases.__name__]
    called = texts + "".join(templates.values()) + inspect.getsource(phrases)
    used = [n for n in (*defined, *templates) if f"{{{n}()}}" in called or f'"{n}"' in called]
    assert [n for n in (*defined, *templates) if not n.startswith("_") and n not in used] == []


def test_findings_page_is_up_to_date():
    page = findings_reference.PAGE.read_text("utf-8")
    assert page == findings_reference.write_page(), "run `make docs`"


@pytest.mark.slow
def test_no_message_of_the_library_names_a_command_line_option():
    named = {
        name
        for name, tree in parse_modules().items()
        if not name.startswith(("cli/", "app/"))  # app writes the words of commands
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and OPTION.search(node.value)
    }
    assert named == set()


def test_finding_has_text_and_json_data():
    finding = report_finding(
        "fit.default-tolerances", count=3, total=42, assumed=(Quantity(0.19, "mm"),)
    )
    said = "3 of 42 parameters have no expected spread (`tolerances:`). Assumed: 0.19 mm. Add "
    assert str(finding).startswith(said)
    written = to_json(finding)
    json.dumps(written, allow_nan=False)
    assert written["code"] == "fit.default-tolerances"
    assert written["severity"] == "info"
    assert written["data"]["assumed"] == [{"value": 0.19, "unit": "mm"}]
    assert written["text"] == str(finding)


def test_finding_with_missing_data_or_an_unknown_code_raises_key_error():
    with pytest.raises(KeyError, match="total"):
        report_finding("fit.default-tolerances", count=3, assumed=())
    with pytest.raises(KeyError):
        report_finding("fit.unheard-of")


def test_error_made_from_a_finding_has_its_code_and_text():
    error = EstimationError(report_finding("fit.no-measured-value"))
    assert error.code == "fit.no-measured-value"
    assert str(error).startswith("The data contain no usable measured value")
    assert EstimationError("a sentence").code is None


IMPERATIVES = (
    "Add Allow Ask Avoid Begin Build Calibrate Change Check Choose Compare Compensate Compute "
    "Continue Copy Correct Declare Delete Describe Do Draw End Enter Exclude Expand Export "
    "Fill Find Fit Fix Free Give Hold Identify Import Inspect Install Join Keep Leave Let Load "
    "Make Measure Move Name Open Plan Predict Probe Put Read Reduce Relax Remove Rename "
    "Repeat Replace Restore Run Save Select Send Set Shorten Simulate Split Start Stop Swap "
    "Take Train Turn Type Update Use Validate Wait Write "
)
# Their texts end in a list of what is allowed, or state a decision that documents repeat; or they
# are the state of one target of many.
WITHOUT_ACTION = {"conformity.fails", "files.no-example"}
WITHOUT_ACTION |= {"compensation.outside-limits", "compensation.unreachable", "pictures.none"}


def test_what_is_refused_or_fails_says_in_its_own_text_what_to_do() -> None:
    """`action` is not shown with it. A new verb belongs to IMPERATIVES."""
    verbs = "|".join(IMPERATIVES.split())
    first = rf"(?:^|[.:;(|] ?|, or |, and |\n)(?:{verbs})\b"
    begins = rf"{first}|, (?:so |and |or |)(?:{verbs.lower()})\b"
    silent = {
        code
        for code, entry in load_catalog().items()
        if entry.severity.value in ("refusal", "failure")
        and not re.search(begins, f"{entry.text} {entry.word_example()}")
    }
    assert silent == WITHOUT_ACTION
