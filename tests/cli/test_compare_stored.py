# SPDX-License-Identifier: Apache-2.0
"""`calibrate --compare`: stored answers against the estimate, in a sentence and in result.json."""

import json
import shutil
from pathlib import Path

import pytest

from tests.cli.delta_printers import read_records
from tests.io.formats.printers import format_printer_cfg

CALIBRATE = "calibrate printer.yaml heights.csv -o run --force --sigma-uncertainty 0"


@pytest.fixture
def loopcal(loopcal, root):
    """Run a command line in a copy of the delta example."""
    shutil.copytree(root / "examples" / "delta-printer", ".", dirs_exist_ok=True)
    return loopcal


def write_values(*rows: str) -> None:
    """Write stored.yaml with these rows."""
    text = "".join(f"  - {{{row}}}\n" for row in rows)
    Path("stored.yaml").write_text(f"# stored by the firmware\nidentified:\n{text}", "utf-8")


def test_true_geometry_agrees_and_the_nominal_one_does_not(loopcal) -> None:
    words = "The stored values agree with the estimate: chi-square 2.957 with 6 degrees"
    loopcal(f"{CALIBRATE} --compare truth.yaml", words)
    result = json.loads(Path("run/result.json").read_text())
    comparison = result["comparison"]
    assert (comparison["degrees"], comparison["agrees"]) == (6, True)
    assert comparison["p_value"] == pytest.approx(0.81, abs=0.01)
    assert result["made_by"]["inputs"]["compare"]["path"].endswith("truth.yaml")
    # the calibration is not worse for it
    findings = loopcal(f"{CALIBRATE} --compare printer.yaml --json").json["findings"]
    codes = [f["code"] for f in findings if f["code"].startswith("comparison.")]
    assert codes == ["comparison.differs"]


def test_file_with_some_of_the_values_is_compared_in_these(loopcal) -> None:
    stop = "name: tower1.stop, value: 299.72, unit: mm"
    write_values("name: radius, value: 105.7, unit: mm", stop)
    words = "The stored values agree with the estimate: chi-square 1.622 with 2 degrees"
    loopcal(f"{CALIBRATE} --compare stored.yaml", words)
    write_values("name: tower1.angle, value: 211.3, unit: deg")
    said = ("do not agree with the estimate", "mostly of tower1.angle")
    loopcal(f"{CALIBRATE} --compare stored.yaml", *said)


def test_towers_in_another_frame_are_named(loopcal) -> None:
    text = Path("printer.yaml").read_text("utf-8")
    Path("turned.yaml").write_text(text.replace("[210, 330, 90]", "[211, 331, 91]"), "utf-8")
    loopcal(
        f"{CALIBRATE} --compare turned.yaml",
        "stored value of tower3.angle is 91 deg, but this fit fixes it at 90 deg",
        "all towers of a delta rotated",
        code=1,
    )


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (("name: radios, value: 1, unit: mm",), "'radios' is not a parameter"),
        (("name: radius, value: 1, unit: deg",), "'deg' is a unit of angle, not"),
        (("name: radius, value: 105, unit: mm",) * 2, "duplicate parameter 'radius'"),
    ],
)
def test_wrong_rows_of_stored_values_are_refused(loopcal, rows, message) -> None:
    write_values(*rows)
    loopcal(f"{CALIBRATE} --compare stored.yaml", message, code=1)


def test_files_that_are_no_stored_values_are_refused(loopcal) -> None:
    Path("stored.yaml").write_text("radius: 105\n", "utf-8")
    said = "neither a robot file nor a list of values"
    loopcal(f"{CALIBRATE} --compare stored.yaml", said, code=1)
    loopcal(f"{CALIBRATE} --compare heights.csv", code=1)
    loopcal(f"{CALIBRATE} --compare missing.yaml", code=1)


@pytest.mark.parametrize(
    ("name", "agrees"),
    [
        ("RazorCopter/Klipper_FLSUN_Q5 printer [Post-Calibration].cfg", True),
        ("danorder/Flsun-super-racer-Full-klipper-config- V400 FIXES.txt", False),
    ],
)
def test_firmware_of_real_printers_is_compared(loopcal, data_folder, name, agrees) -> None:
    """The first was fitted to its probes, the second is a factory default that never was."""
    Path("printer.cfg").write_text(format_printer_cfg(read_records(data_folder)[name]), "utf-8")
    sigmas = "--sigma-height 0.05mm" + " --sigma-distance 0.3mm" * agrees
    loopcal(f"import printer.cfg -o firmware.yaml --data probes.csv {sigmas}")
    exact = "--method ls --sigma-uncertainty 0"
    words = f"calibrate firmware.yaml probes.csv -o run {exact} --compare firmware.yaml"
    out = loopcal(words).words
    assert ("The stored values agree" in out) is agrees
    assert ("The stored values do not agree" in out) is not agrees
