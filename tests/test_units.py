# SPDX-License-Identifier: Apache-2.0
"""Units: factors to SI, and refusals with the allowed units."""

import math

import pytest

from loopcal.errors import UnitError
from loopcal.units import Dimension, find_unit, list_symbols, parse_quantity


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.02mm", 2e-5),
        ("5 urad", 5e-6),
        ("1e-3 m", 1e-3),
        ("-2in", -0.0508),
        ("180deg", math.pi),
        ("60 arcmin", math.pi / 180),
        ("3600arcsec", math.pi / 180),
        ("7 1", 7.0),
        ("10nm", 1e-8),
        ("+.5E-2 mm", 5e-6),
        ("2.mm", 2e-3),
    ],
)
def test_quantity_is_its_number_times_the_factor_of_its_unit(text: str, value: float) -> None:
    assert parse_quantity(text) == pytest.approx(value, rel=4e-16)  # one rounding of the product


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("5", "has no unit. Add one of m, mm"),
        ("mm", "not a number with a unit"),
        ("5 deg", "unit of angle, not of a length"),
        ("5 mmm", "unknown unit 'mmm' .did you mean 'mm'"),
        ("nan mm", "not finite"),
        ("", "not a number with a unit"),
        ("1_0mm", "unknown unit"),
        ("5e", "unknown unit 'e'"),
        ("-Infinity m", "not finite"),
        ("- 5 mm", "not a number with a unit"),
        ("0x" * 10**6, "unknown unit"),
        ("m" * 10**6, "not a number with a unit"),
    ],
)
def test_invalid_quantity_is_refused_with_the_allowed_units(text: str, message: str) -> None:
    with pytest.raises(UnitError, match=message):
        parse_quantity(text, Dimension.LENGTH)


def test_every_unit_is_found_by_its_symbol() -> None:
    for dimension in Dimension:
        for symbol in list_symbols(dimension):
            assert find_unit(symbol, dimension).dimension is dimension
            assert str(find_unit(symbol)) == symbol


@pytest.mark.parametrize(
    ("text", "value", "difference"),
    [("23 degC", 23.0, 23.0), ("296.15 K", 23.0, 296.15), ("73.4 degF", 23.0, 73.4 * 5 / 9)],
)
def test_a_temperature_has_an_offset_and_a_difference_has_none(text, value, difference) -> None:
    assert parse_quantity(text, Dimension.TEMPERATURE) == pytest.approx(value, rel=1e-14)
    found = parse_quantity(text, Dimension.TEMPERATURE, is_difference=True)
    assert found == pytest.approx(difference, rel=1e-14)


def test_a_temperature_below_absolute_zero_is_refused() -> None:
    with pytest.raises(UnitError, match="-1 K is below absolute zero"):
        parse_quantity("-1 K", Dimension.TEMPERATURE)
