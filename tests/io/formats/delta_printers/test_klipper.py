# SPDX-License-Identifier: Apache-2.0
"""Klipper's printer.cfg: precedence of options, defaults, added options, refusals."""

import numpy as np
import pytest

from loopcal.errors import FileError
from loopcal.io.formats import klipper
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.klipper import read_config
from loopcal.io.formats.program_format import ExportSource, ImportOptions
from tests.io.formats.test_text_formats import PRINTER as SHORT


def read(folder, text: str):
    path = folder / "printer.cfg"
    path.write_text(text)
    return build_imported_robot(path, klipper.read(path, ImportOptions("printer")))


def test_unchanged_arm_is_written_if_its_default_changed(tmp_path) -> None:
    robot = read(tmp_path, SHORT)
    values = robot.values.copy()
    values[robot.parameters.index("arm1.length")] += 1e-3
    written = klipper.write(ExportSource(robot.with_values(values)), tmp_path / "printer.cfg").text
    np.testing.assert_allclose(read(tmp_path, written).values, values, rtol=0, atol=1e-9)


@pytest.mark.parametrize("ratio", ["80", "80:0", "a:b", "1:2:3", "57:11, 2:1"])
def test_step_distance_includes_the_gear_ratio(tmp_path, ratio) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(SHORT.replace("microsteps: 16", f"microsteps: 16\ngear_ratio: {ratio}"))
    if ratio == "57:11, 2:1":
        found = klipper.get_step_distance(read_config(path), "stepper_a")
        assert found == pytest.approx(40 / (200 * 16 * 57 / 11 * 2), rel=1e-15)
        return
    with pytest.raises(FileError, match=":9: gear_ratio is"):
        klipper.get_step_distance(read_config(path), "stepper_a")


RECORDS = {
    "height": ("height", {"": "0.1", "_pos": "20000,20000,{i}"}),
    "manual_height": ("manual_height", {"": "0.1", "_pos": "20000,20000,{i}"}),
    "distance": ("distance", {"": "50", "_pos1": "2000,2000,{i}", "_pos2": "1000,2000,{i}"}),
}


def list_records(kind: str, count: int = 6) -> list[str]:
    """Return the lines of some records of a kind."""
    name, parts = RECORDS[kind]
    texts = (
        (f"{name}{i}{part}", text.format(i=i)) for i in range(count) for part, text in parts.items()
    )
    return [f"{option}: {text}" for option, text in texts]


@pytest.mark.parametrize(
    ("kind", "part"), [(kind, part) for kind, (_, parts) in RECORDS.items() for part in parts]
)
@pytest.mark.parametrize("number", [0, 3, 5])
def test_record_without_a_part_is_refused_with_its_line(tmp_path, kind, part, number) -> None:
    """Klipper ignores the rest silently where it is the value that is missing."""
    lines = list_records(kind)
    kept = [line for line in lines if not line.startswith(f"{kind}{number}{part}:")]
    assert len(kept) == len(lines) - 1
    text = SHORT.replace("[stepper_b]", "[delta_calibrate]\n" + "\n".join(kept) + "\n[stepper_b]")
    with pytest.raises(FileError) as refused:
        read(tmp_path, text)
    assert refused.value.code == "files.probe-part-missing"
    assert f"without '{kind}{number}{part}'" in str(refused.value)
    assert refused.value.line is not None
    line = text.splitlines()[refused.value.line - 1]
    assert line.startswith(f"{kind}{number}")


@pytest.mark.parametrize("kind", RECORDS)
@pytest.mark.parametrize("number", [0, 3])
def test_gap_in_the_records_is_refused_with_its_line(tmp_path, kind, number) -> None:
    lines = [line for line in list_records(kind) if not line.startswith(f"{kind}{number}")]
    text = SHORT.replace("[stepper_b]", "[delta_calibrate]\n" + "\n".join(lines) + "\n[stepper_b]")
    with pytest.raises(FileError) as refused:
        read(tmp_path, text)
    assert refused.value.code == "files.probe-left-out"
    assert f"'{kind}{number}' is missing" in str(refused.value)
    assert refused.value.line is not None
    assert text.splitlines()[refused.value.line - 1].startswith(f"{kind}{number + 1}")


def test_all_records_of_a_complete_file_are_read(tmp_path) -> None:
    lines = [*list_records("height"), *list_records("distance", 2)]
    stepper = "[stepper_b]\nstep_distance: 0.0125\n"
    text = SHORT.replace("[stepper_a]", "[stepper_a]\nstep_distance: 0.0125")
    text = text.replace("[stepper_c]", "[stepper_c]\nstep_distance: 0.0125")
    text = text.replace("[stepper_b]\n", "[delta_calibrate]\n" + "\n".join(lines) + "\n" + stepper)
    (tmp_path / "full.cfg").write_text(text)
    imported = klipper.read(tmp_path / "full.cfg", ImportOptions("full"))
    assert imported.measurements is not None
    assert [len(rows) for rows in imported.measurements.observations] == [6, 2]


@pytest.mark.parametrize(
    ("height", "offset", "words"),
    [
        (1500.0, "1.5", "Are they in micrometers? Or have microsteps"),
        (-2.0, "-2", "twice Z-2 of the file: its sign is probably wrong. z_offset is positive"),
        (2.0, "2", ""),
    ],
)
def test_heights_far_from_the_bed_are_named(tmp_path, height, offset, words) -> None:
    """The carriages stand where the nozzle triggers, 1.5 or 2 mm above the bed."""
    steps = (300.0 - min(abs(height), 2.0)) * 80.0
    lines = [f"height{i}: {height}\nheight{i}_pos: {steps},{steps},{steps}" for i in range(4)]
    probe = f"[probe]\nz_offset: {offset}\n[delta_calibrate]"
    path = tmp_path / "printer.cfg"
    motors = "rotation_distance: 40\nmicrosteps: 16\n"
    text = SHORT.replace("[stepper_b]\n", f"[stepper_b]\n{motors}")
    path.write_text("\n".join([text + motors + probe, *lines]))
    findings = klipper.read(path, ImportOptions("printer")).findings
    assert words in " ".join(str(finding) for finding in findings[1:])
    assert bool(findings[1:]) == bool(words)
