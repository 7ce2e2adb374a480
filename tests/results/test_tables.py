# SPDX-License-Identifier: Apache-2.0
"""Tables as text, CSV and HTML within a width, and the digits of numbers."""

import pytest

from loopcal.report.calibration_view import build_parameter_table
from loopcal.results.tables import (
    Column,
    Table,
    build_table,
    format_exact_beside,
    format_number,
    format_uncertainty,
    format_with_uncertainty,
    render_text,
    word_column,
    wrap_line,
)

TABLE = Table(
    "Errors",
    (word_column("of", wraps=True), Column("rms", "mm"), Column("largest", "mm")),
    (("position of the platform", "0.05", "1.25"), ("x & y", "12.5", "-")),
)


def test_text_aligns_words_left_and_numbers_right():
    assert TABLE.to_text().split("\n") == [
        "Errors",
        "of                        rms [mm]  largest [mm]",
        "─" * 48,
        "position of the platform      0.05          1.25",
        "x & y                         12.5             -",
    ]


def test_build_table_makes_one_row_per_object():
    table = build_table(
        "Roots",
        (1.0, 4.0),
        (word_column("of"), lambda x: f"{x:g}"),
        (Column("root"), lambda x: f"{x**0.5:.1f}"),
    )
    assert [column.title for column in table.columns] == ["of", "root"]
    assert table.rows == (("1", "1.0"), ("4", "2.0"))


@pytest.mark.parametrize("width", [40, 30])
def test_narrow_table_breaks_headings_and_words_but_no_number(width):
    lines = TABLE.to_text(width).split("\n")
    assert max(map(len, lines)) <= width
    text = " ".join(" ".join(lines).split())
    assert all(cell in text for cell in ("0.05", "1.25", "12.5", "[mm]"))


def test_heading_of_numbers_and_caption_are_broken_between_words():
    columns = (word_column("method"), Column("drop of chi-square"), Column("degrees of freedom"))
    table = Table("Left out, one by one", columns, (("leg by leg", "1.373e+04", "12"),))
    assert table.to_text(34).split("\n") == [
        "Left out, one by one",
        "method         drop of  degrees of",
        "            chi-square     freedom",
        "─" * 34,
        "leg by leg   1.373e+04          12",
    ]
    assert table.to_text(12).startswith("Left out,\none by one\n")


def test_csv_and_html_contain_the_same_cells():
    assert TABLE.to_csv().splitlines()[0] == "of,rms [mm],largest [mm]"
    assert TABLE.to_csv().splitlines()[2] == "x & y,12.5,-"
    page = TABLE.to_html()
    assert "<caption>Errors</caption>" in page
    assert '<th scope="row" class="words wraps">x &amp; y</th><td class="numbers">12.5</td>' in page
    assert page.count("<tr>") == 3


def test_wrapped_paragraphs_are_indented_and_commands_stay_on_one_line():
    wrapped = wrap_line("  warning  one two three four five six seven", 28)
    assert wrapped[1].startswith(" " * 11 + "four")
    command = "Next: loopcal calibrate a-long-name.yaml another-long-name.csv -o run"
    assert wrap_line(command, 30) == [command]  # to be copied
    assert render_text(["a", TABLE, "", "b"], 80).split("\n")[:2] == ["a", ""]
    assert "\n\n\n" not in render_text(["a", TABLE, "", "b", "", TABLE, "c"], 80)


@pytest.mark.parametrize(
    ("value", "uncertainty", "shown"),
    [
        (120.02291, 0.00512, "120.0229"),
        (-139.9606, 0.0165, "-139.961"),
        (4.923e-15, 0.02, "0.000"),
        (1e-4, 0.02, "0.000"),
        (-4e-4, 0.02, "0.000"),  # not -0.000
        (12345.678, 250.0, "12346"),
        (5.0, float("inf"), "5"),
        (1.0, 0.009996, "1.000"),
    ],
)
def test_uncertainty_decides_the_digits_of_the_value(value, uncertainty, shown):
    assert format_with_uncertainty(value, uncertainty) == shown


def test_formats_of_uncertainties_and_numbers_cover_nan_infinity_and_zero():
    assert format_uncertainty(0.0051234) == "0.0051"
    assert format_uncertainty(float("inf")) == "unknown"
    assert format_uncertainty(float("nan")) == "not given"
    assert format_uncertainty(0.0) == "0"
    assert format_number(float("nan")) == "-"
    assert format_number(4.9e-15) == "0"


def test_complete_table_of_parameters_has_the_terms_of_the_gum():
    row = {"name": "a", "nominal": 1.0, "estimate": 1.5, "sd": 0.1, "plus_minus": 0.2, "unit": "mm"}
    rows = [
        {**row, "tolerance": 0.25, "degrees": degrees}
        for degrees in (4.567, 163.6, 484063690.0, float("inf"))
    ]
    table = build_parameter_table("Parameters", rows, is_complete=True)
    headings = [column.heading for column in table.columns]
    assert headings[3:] == [
        "shift [expected spreads]",
        "u",
        "degrees of freedom",
        "k",
        "U (95 %)",
        "unit",
    ]
    assert table.rows[0][3:] == ("+2.00", "0.10", "4.57", "2.00", "0.20", "mm")
    assert [cells[5] for cells in table.rows] == ["4.57", "164", "over 10000", "infinite"]
    unknown = {**rows[0], "sd": float("inf"), "plus_minus": float("inf")}
    (cells,) = build_parameter_table("Parameters", [unknown], is_complete=True).rows
    assert cells[4:8] == ("unknown", "4.57", "-", "unknown")


def test_exact_value_is_never_hidden_by_the_uncertainty_beside_it():
    assert format_exact_beside(105.0, 0.381) == "105.00"
    assert format_exact_beside(105.0, 1.6e8) == "105"
    assert format_exact_beside(0.3, 500.0) == "0.3"
    assert format_exact_beside(0.0, 0.1) == "0.00"
    assert format_exact_beside(1e-17, 0.1) == "0.00"
    assert format_exact_beside(105.0, float("inf")) == "105"
    row = {"name": "radius", "nominal": 105.0, "estimate": 105.8, "plus_minus": 2e4, "unit": "mm"}
    assert build_parameter_table("Parameters", [row]).rows[0][1:3] == ("105", "0")
