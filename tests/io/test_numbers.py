# SPDX-License-Identifier: Apache-2.0
"""Numbers in files have at most 17 significant digits, and read back as the same doubles."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.errors import FileError, UnitError
from loopcal.io.core.csv_table import (
    format_exact,
    parse_decimals,
    parse_exact,
    parse_finite,
    read_table,
)
from loopcal.io.data.measurement_file import save_measurements
from loopcal.io.robot.robot_file import load_robot, save_robot
from loopcal.measure.simulation import sample_truth
from loopcal.units import UNITS, Dimension, format_scaled, parse_number, parse_quantity
from tests.io.test_measurement_columns import draw_measurements

FACTORS = (1.0, 1e-3, 1e-6, 1e-9, 0.0254, np.pi / 180, np.pi / 10800, np.pi / 648000)
NUMBER = re.compile(r"(?<![\w.])[-+]?(\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")


def count_digits(text: str) -> int:
    """Return the number of significant digits of a number."""
    digits = re.sub(r"[eE].*|[-+.]", "", text).lstrip("0")
    return len(digits if "." in text else digits.rstrip("0"))


def find_longest(text: str) -> str:
    """Return the number with the most digits in a text."""
    return max((match[0] for match in NUMBER.finditer(text)), key=count_digits, default="0")


@pytest.mark.parametrize("factor", FACTORS)
def test_seventeen_digits_are_enough_for_every_double(factor) -> None:
    draw = np.random.default_rng(2)
    powers = 2.0 ** np.arange(-40, 11)
    values = [
        draw.normal(size=1500) * 10.0 ** draw.integers(-12, 4, 1500),
        np.nextafter(powers, 0.0),  # just below a power of two, where doubles are densest
        np.nextafter(powers, np.inf),
        [0.0, 1.0, 1e-3, 5e-324],
    ]
    for value in np.concatenate(values).tolist():
        text = format_exact(value, factor)
        assert parse_exact(text, factor) == value
        assert count_digits(text) <= 17, text
        assert count_digits(format_scaled(value, factor)) <= 17
    assert format_exact(0.2, 1e-3) == "200"


def test_rounding_through_a_double_needs_no_further_digits() -> None:
    value, arcsec = -0.22009704380249864, np.pi / 648000
    text = format_exact(value, arcsec)  # the double nearest to the quotient reads back as another
    assert text == "-45398.274095481062"
    assert parse_exact(text, arcsec) == value


@pytest.mark.parametrize("symbol", [s for s, unit in UNITS.items() if unit.factor_to_si < 1.0])
def test_a_quantity_of_few_digits_is_written_as_it_was_read(symbol) -> None:
    """0.1 is 100000 ppm, not 100000.00000000001 ppm: `simple` is the nearest double to it."""
    factor = UNITS[symbol].factor_to_si
    for simple in (100_000.0, *(float(k) for k in range(1, 2000)), 0.07, 0.035, 1.15):
        value = parse_quantity(f"{simple!r} {symbol}", is_difference=True)
        assert float(format_scaled(value, factor)) == simple
    if symbol in ("mm", "um", "nm", "mrad", "urad", "ppm", "um/m"):
        clean = (format_scaled(float(f"{k}e-3"), factor) for k in range(1, 2000))
        assert max(map(count_digits, clean)) <= 4  # 17 of two in seven, by a product with 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_measurement_files_have_at_most_seventeen_digits(tmp_path, seed) -> None:
    robot = load_robot("hexapod-42")
    data = draw_measurements(robot, seed)
    save_measurements(data, tmp_path / "data.csv", robot)
    text = (tmp_path / "data.csv").read_text()
    assert count_digits(find_longest(text)) in (16, 17), find_longest(text)


EXPORTS = {
    "linear-delta": ("klipper", "marlin", "reprap", "json", "csv"),
    "hexapod-42": ("linuxcnc", "json", "csv"),
}


@pytest.mark.parametrize(("name", "form"), [(n, f) for n, forms in EXPORTS.items() for f in forms])
def test_robot_files_and_exports_have_at_most_seventeen_digits(
    tmp_path, monkeypatch, name, form
) -> None:
    monkeypatch.chdir(tmp_path)
    robot = load_robot(name)
    truth = robot.with_values(sample_truth(robot, 1, 3)[0])
    save_robot(truth, "truth.yaml")
    # YAML numbers are doubles, which are rounded once more in their unit
    np.testing.assert_allclose(load_robot("truth.yaml").values, truth.values, rtol=1e-15)
    assert main(["export", "truth.yaml", "--format", form, "-o", "out.txt"]) == 0
    for file in ("truth.yaml", "out.txt"):
        longest = find_longest(Path(file).read_text())
        assert count_digits(longest) <= 17, longest


HUGE = f"1e{10**18 - 1}", f"1e-{10**20}"  # beyond `Decimal`: its product, or itself


@pytest.mark.parametrize("text", ["1_0", "\uff11\uff12", "1\u0663", "\u0967.5", "1e\u0663", *HUGE])
def test_files_state_numbers_in_ascii_digits_with_an_exponent_of_a_few(tmp_path, text) -> None:
    """Python reads more texts as numbers; one definition holds for all files."""
    float(text)
    assert parse_number(text) is None
    assert parse_finite(text) is None
    assert math.isnan(parse_decimals(["1", text], 1e-3)[1])
    assert math.isnan(parse_decimals(["1", text], math.pi / 180)[1])
    with pytest.raises(UnitError):
        parse_quantity(f"{text} mm")
    for unit, dimension in (("mm", Dimension.LENGTH), ("deg", Dimension.ANGLE)):
        (tmp_path / "data.csv").write_text(f"pose,a [{unit}]\n1,1\n2,{text}\n", encoding="utf-8")
        with pytest.raises(FileError, match=r"but must be a number"):
            read_table(tmp_path / "data.csv").numbers("a", dimension)


@pytest.mark.parametrize("radius", [0.9, 0.3])
def test_a_workspace_of_less_than_a_millimeter_is_not_rounded_to_zero(tmp_path, radius) -> None:
    path = tmp_path / "printer.gcode"
    path.write_text(f"M665 L2.2 R{radius} H3 X0 Y0 Z0\nM666 X0 Y0 Z0\n")
    assert main(["import", str(path), "-o", str(tmp_path / "printer.yaml")]) == 0
    assert f"x: [-{radius / 2}, {radius / 2}]" in (tmp_path / "printer.yaml").read_text()
