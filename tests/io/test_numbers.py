# SPDX-License-Identifier: Apache-2.0
"""Numbers in files have at most 17 significant digits, and read back as the same doubles."""

import re
from pathlib import Path

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.io.core.csv_table import format_exact, format_scaled, parse_exact
from loopcal.io.data.measurement_writer import save_measurements
from loopcal.io.robot.robot_file import load_robot, save_robot
from loopcal.measure.simulation import sample_truth
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
