# SPDX-License-Identifier: Apache-2.0
"""Templates of messages: formats, conditions and lists."""

from __future__ import annotations

import pytest

from loopcal.findings import Quantity, report_finding
from loopcal.findings.wording import depends_on_data, fill_template, list_fields

LEGS = ({"leg": "a", "error": 0.12345}, {"leg": "b", "error": 2.0})


@pytest.mark.parametrize(
    ("template", "data", "sentence"),
    [
        (
            "{x} {length} {k}",
            {"x": 1 / 3, "length": Quantity(0.12345, "mm"), "k": 7},
            "0.333 0.123 mm 7",
        ),
        ("{names:list}", {"names": "abc"}, "a, b and c"),
        ("{n:count pose}, {m:count axis/axes}", {"n": 1, "m": 2}, "1 pose, 2 axes"),
        ("{share:percent}", {"share": 0.05}, "5 %"),
        ("{small:factor} {large:factor}", {"small": 1.234, "large": 1234.5}, "1.2 1234"),
        ("{clause:sentence}", {"clause": "it moves."}, "It moves."),
        ("{name!r}", {"name": "leg"}, "'leg'"),
        ("a{n:if|, {n} more|, no more}", {"n": 3}, "a, 3 more"),
        ("a{n:if|, {n} more|, no more}", {"n": 0}, "a, no more"),
        ("a{n:if|, {n} more}", {"n": None}, "a"),
        ("{n:plural|it|them}, {names:plural|it|them}", {"n": 1, "names": "ab"}, "it, them"),
        ("{key:choose|a=first|b=second|{key}}", {"key": "b"}, "second"),
        ("{key:choose|a=first|b=second|{key}}", {"key": "c"}, "c"),
        ("{legs:each|{leg} {error}}", {"legs": LEGS}, "a 0.123 and b 2"),
        ("{legs:each 1|{leg}}", {"legs": LEGS}, "a and 1 more"),
        ("{rows:each; |{item}{sign}}", {"rows": "ab", "sign": "+"}, "a+; b+"),
        ("{n+u:each, |{n} in {u}}", {"n": (1, 2), "u": ("mm", "deg")}, "1 in mm, 2 in deg"),
        ("{a:if|{b:if|both|one}|none}", {"a": 1, "b": 1}, "both"),
    ],
)
def test_template_is_filled_with_formatted_data(template, data, sentence):
    assert fill_template(template, **data) == sentence


def test_list_fields_includes_conditional_fields_but_not_keys_of_rows():
    assert list_fields("{a.x}{b:if|{c[0]:list}|{d!r}} {legs:each|{leg}} {motion()}") == {
        *"abcd",
        "legs",
    }


def test_only_templates_with_conditions_or_phrases_depend_on_data():
    assert depends_on_data("{n:if|some}")
    assert depends_on_data("{motion()}")
    assert not depends_on_data("{n:count pose} of {robot!r}")


@pytest.mark.parametrize(
    ("value", "text"),
    [(1484.5, "1484 mm"), (999.7, "1000 mm"), (-23456.0, "-23456 mm"), (0.0123456, "0.0123 mm")],
)
def test_quantities_of_thousands_have_no_power_of_ten(value, text) -> None:
    assert str(Quantity(value, "mm")) == text


@pytest.mark.parametrize(
    ("factor", "words"), [(1.2, "1.2 times as wide"), (1.002, "less than 0.5 % wider")]
)
def test_a_factor_near_one_is_not_called_1_times(factor: float, words: str) -> None:
    sentence = str(report_finding("prior.inflation", factor=factor, parts=()))
    assert f"expected spreads {words}" in sentence
    assert " 1 times" not in sentence
