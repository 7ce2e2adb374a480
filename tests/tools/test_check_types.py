# SPDX-License-Identifier: Apache-2.0
"""The check of public types reports what pyright finds incomplete, and nothing else."""

import pytest

from tools.check_types import list_incomplete_types


def build_symbol(name, known=True, ambiguous=False, message=None):
    problems = [] if message is None else [{"message": message}]
    return {
        "name": name,
        "isTypeKnown": known,
        "isTypeAmbiguous": ambiguous,
        "diagnostics": problems,
    }


def build_report(*symbols):
    return {"typeCompleteness": {"symbols": list(symbols)}}


def test_complete_types_are_not_reported():
    assert list_incomplete_types(build_report(build_symbol("loopcal.identify"))) == []


def test_unknown_and_ambiguous_types_are_reported_with_the_text_of_pyright():
    lines = list_incomplete_types(
        build_report(
            build_symbol("loopcal.identify", known=False, message='Type of "fit" is\nunknown'),
            build_symbol("loopcal.Plan.quality", ambiguous=True),
        )
    )
    assert lines == [
        'loopcal.identify: Type of "fit" is unknown',
        "loopcal.Plan.quality: its type is incomplete",
    ]


def test_types_of_the_command_line_are_not_checked():
    assert (
        list_incomplete_types(
            build_report(build_symbol("loopcal.cli.options.Quantity", known=False))
        )
        == []
    )


def test_report_without_symbols_is_refused():
    with pytest.raises(ValueError, match="no symbol of loopcal"):
        list_incomplete_types(build_report())
