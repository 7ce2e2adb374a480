# SPDX-License-Identifier: Apache-2.0
"""A column of decimals is read at once, to the bits that reading cell by cell gives."""

import math
import random

import numpy as np
import pytest

from loopcal.errors import FileError
from loopcal.io.core.csv_table import format_exact, parse_decimals, parse_exact, read_table
from loopcal.units import Dimension

FACTORS = (1.0, 1e-3, 1e-6, 1e-9, 0.0254, 5 / 9, 3600.0, math.pi / 180, math.pi / 648000)


def draw_text(draw: random.Random) -> str:
    """Return a random decimal, sometimes too long, without digits or with leading zeros."""
    digits = "".join(draw.choice("0123456789") for _ in range(draw.randint(0, 20)))
    place = draw.randint(0, len(digits))
    point = "." if draw.random() < 0.8 else ""
    return draw.choice(["", "-", "+"]) + digits[:place] + point + digits[place:]


@pytest.mark.parametrize("factor", FACTORS)
def test_random_decimals_give_the_bits_of_the_exact_product(factor) -> None:
    draw = random.Random(1)
    values = np.random.default_rng(2).normal(size=500) * factor
    cells = [draw_text(draw) for _ in range(2000)]
    cells += [format_exact(value, factor) for value in values.tolist()]
    parsed = parse_decimals(cells, factor)
    is_plain = ~np.isnan(parsed)
    assert is_plain.mean() > 0.8
    for cell, value in zip(np.array(cells)[is_plain].tolist(), parsed[is_plain], strict=True):
        expected = parse_exact(cell, factor)
        assert (value, math.copysign(1.0, value)) == (expected, math.copysign(1.0, expected)), cell


def test_products_near_the_middle_of_two_doubles_are_rounded_once_to_the_even_one() -> None:
    cells = [str(2**53 + 1), f"{2**53 + 1}.0", str(2**54 + 2), str(2**54 + 1), str(2**54 + 3)]
    assert parse_decimals(cells, 1.0).tolist() == [2.0**53, 2.0**53, 2.0**54, 2.0**54, 2.0**54 + 4]


OTHERS = [*"-+./:", "", "-.", "--1", "1-", "1.2.3", "1 2", "1,5", "inf", "nan", "1_000", "0x1"]


@pytest.mark.parametrize("cell", [*OTHERS, "1" * 500])
def test_everything_else_is_left_to_the_caller(cell) -> None:
    for factor in (1e-3, 0.0254):
        parsed = parse_decimals(["1.5", cell, "-0"], factor)
        np.testing.assert_array_equal(parsed, [parse_exact("1.5", factor), np.nan, -0.0])
        assert math.copysign(1.0, parsed[2]) == -1.0
    assert len(parse_decimals([], 1.0)) == 0


def test_the_first_wrong_cell_of_a_column_is_reported_behind_any_number_of_decimals(
    tmp_path,
) -> None:
    cells = [f"{i / 7:.4f}" for i in range(500)]
    file = tmp_path / "data.csv"
    cells[123], cells[321], cells[400] = "1.5e1", "1,5", "x"
    file.write_text("q [mm]\n" + "\n".join(f'"{cell}"' for cell in cells) + "\n")
    with pytest.raises(FileError, match=r":323: column 'q' is '1,5', but must be a number"):
        read_table(file).numbers("q", Dimension.LENGTH)
    cells[321], cells[400] = "", "2.5"
    file.write_text("n,q [mm]\n" + "\n".join(f"1,{cell}" for cell in cells) + "\n")
    read = read_table(file).numbers("q", Dimension.LENGTH)
    assert np.flatnonzero(np.isnan(read)).tolist() == [321]
    expected = [parse_exact(cell, 1e-3) for cell in cells if cell]
    assert read[~np.isnan(read)].tolist() == expected
