# SPDX-License-Identifier: Apache-2.0
"""`loopcal import` and `loopcal export`: geometry and data of controller files."""

import difflib
import json
from typing import Any

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import find_command
from loopcal.io.formats import FORMATS
from loopcal.units import find_unit, to_si
from tests.cli.delta_printers import list_stored_geometry, read_records
from tests.io.formats.linkages.test_urdf_closures import FIVE_BAR
from tests.io.formats.printers import format_printer_cfg

FIRMWARE_CALIBRATED = (
    "cupsster/FLSUN-SR---Klipper-Config Configuration/printer.cfg",
    "danorder/Flsun-super-racer-Full-klipper-config- printer.cfg",
    "fzechert/FLSun-V400 printer-config/printer.cfg",
)
WITH_DISTANCES = "RazorCopter/Klipper_FLSUN_Q5 printer [Post-Calibration].cfg"
ONE_COMMAND = "import printer.cfg -o printer.yaml --data heights.csv --corrected corrected.cfg"


def list_changed_lines(before: str, after: str) -> list[str]:
    """Return the lines of `after` that differ from `before`."""
    return [
        line[2:]
        for line in difflib.ndiff(before.splitlines(), after.splitlines())
        if line.startswith("+ ")
    ]


@pytest.mark.parametrize("name", sorted((*FIRMWARE_CALIBRATED, WITH_DISTANCES)))
def test_import_reads_the_geometry_and_every_probe_of_printer_cfg(
    loopcal, folder, data_folder, name
) -> None:
    record = read_records(data_folder)[name]
    (folder / "printer.cfg").write_text(format_printer_cfg(record))
    loopcal("import printer.cfg -o printer.yaml --data data.csv")
    robot = lc.load_robot("printer.yaml")
    for parameter, value in list_stored_geometry(record).items():
        factor = np.pi / 180 if parameter.endswith("angle") else 1e-3
        assert robot.values[robot.parameters.index(parameter)] == pytest.approx(
            value * factor, abs=1e-12
        )  # [m, rad]
    data = lc.load_measurements("data.csv", robot)
    assert data.n_rows == len(record["heights"]) + len(record["distances"])
    steps = (
        np.array(record["heights"][0]["stable_steps"])
        * record["geometry_stored_in_config"]["stepdist"]
    )
    np.testing.assert_allclose(
        data.readings[data.labels.index("height0")], steps * 1e-3, rtol=0, atol=1e-12
    )  # [m]
    # the arms are to be identified only where distances can tell them
    assert int(robot.parameters.free.sum()) == (9 if record["distances"] else 6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        FIRMWARE_CALIBRATED[0],
        *(pytest.param(name, marks=pytest.mark.evidence) for name in FIRMWARE_CALIBRATED[1:]),
    ],
)
def test_import_with_corrected_output_fixes_end_stops_20_mm_off(
    loopcal, folder, data_folder, name
) -> None:
    record = read_records(data_folder)[name]
    text = format_printer_cfg(record, stop_offset=20.0)
    (folder / "printer.cfg").write_text(text)
    out = loopcal(ONE_COMMAND).out
    corrected = (folder / "corrected.cfg").read_text()
    loopcal("import corrected.cfg -o again.yaml")
    again = lc.load_robot("again.yaml")
    for parameter, value in list_stored_geometry(record).items():
        factor = np.pi / 180 if parameter.endswith("angle") else 1e-3
        assert abs(again.values[again.parameters.index(parameter)] / factor - value) < 2e-3, (
            f"{parameter} [mm, deg]"
        )
    # six numbers were identified, so at most six lines are others, all of them options of the
    # geometry
    lines = list_changed_lines(text, corrected)
    assert 3 <= len(lines) <= 6
    assert all(
        line.removeprefix("#*# ").startswith(("delta_radius", "angle", "position_endstop"))
        for line in lines
    )
    assert len(text.splitlines()) == len(corrected.splitlines())
    assert (
        f"delta_radius {record['geometry_stored_in_config']['radius']:.6f} ->" in out
        or "delta_radius" not in str(lines)
    )


@pytest.mark.slow
def test_exported_printer_cfg_imports_with_the_calibrated_values(
    loopcal, folder, data_folder
) -> None:
    record = read_records(data_folder)[FIRMWARE_CALIBRATED[0]]
    (folder / "printer.cfg").write_bytes(
        b"\xef\xbb\xbf" + format_printer_cfg(record, stop_offset=5.0).replace("\n", "\r\n").encode()
    )
    loopcal("import printer.cfg -o printer.yaml --data data.csv --sigma-height 50um")
    loopcal("calibrate printer.yaml data.csv -o run --noise estimated")
    loopcal("export run --format klipper --into printer.cfg -o corrected.cfg")
    before, after = (folder / "printer.cfg").read_bytes(), (folder / "corrected.cfg").read_bytes()
    assert before != after
    assert after.startswith(b"\xef\xbb\xbf")
    assert before.count(b"\r\n") == after.count(b"\r\n") == after.count(b"\n")
    loopcal("import corrected.cfg -o again.yaml")
    found, again = lc.load_robot("run/robot.yaml"), lc.load_robot("again.yaml")
    # six decimals are written [mm, deg]
    np.testing.assert_allclose(again.values, found.values, rtol=0, atol=1e-8)
    loopcal("export again.yaml --format klipper --into corrected.cfg -o twice.cfg")
    assert (folder / "twice.cfg").read_bytes() == after


def test_exported_json_and_csv_contain_every_parameter_with_its_interval(
    loopcal, folder, data_folder
) -> None:
    (folder / "printer.cfg").write_text(
        format_printer_cfg(read_records(data_folder)[FIRMWARE_CALIBRATED[0]])
    )
    loopcal("import printer.cfg -o printer.yaml --data data.csv")
    loopcal("calibrate printer.yaml data.csv -o run")
    loopcal("export run -o found.json")
    loopcal("export run -o found.csv --json")
    document = json.loads((folder / "found.json").read_text())
    result = json.loads((folder / "run" / "result.json").read_text())
    half = {row["name"]: row["plus_minus"] for row in result["fit"]["parameters"]}
    robot = lc.load_robot("run/robot.yaml")
    assert [row["name"] for row in document["parameters"]] == list(robot.parameters.names)
    csv_rows = (folder / "found.csv").read_text().splitlines()
    assert csv_rows[0] == "name,nominal,value,plus_minus,unit,free"
    for row, line, value in zip(document["parameters"], csv_rows[1:], robot.values, strict=True):
        unit = find_unit(row["unit"])
        assert to_si(row["value"], unit) == to_si(float(line.split(",")[2]), unit) == value
        assert row["plus_minus"] == half.get(row["name"])
        assert row["free"] == (row["name"] in half)


def test_existing_file_is_replaced_only_with_force(loopcal, folder, data_folder) -> None:
    (folder / "printer.cfg").write_text(
        format_printer_cfg(read_records(data_folder)[WITH_DISTANCES])
    )
    (folder / "printer.yaml").write_text("mine")
    loopcal("import printer.cfg -o printer.yaml", "this file exists", code=1)
    assert (folder / "printer.yaml").read_text() == "mine"
    loopcal("import printer.cfg -o printer.yaml --force")
    loopcal("export printer.yaml --format klipper --into printer.cfg -o printer.cfg", code=1)
    loopcal("export printer.yaml --format klipper --into printer.cfg -o printer.cfg --force")


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("import no.cfg -o x.yaml", "no.cfg: this printer.cfg does not exist"),
        ("import a.txt -o x.yaml", "the ending of this file belongs to no known format"),
        ("import a.csv -o x.yaml", "loopcal writes the format csv, but cannot read it"),
        ("import a.csv -o x.yaml", "an instrument's export with a profile (--profile"),
        (
            "import a.cfg -o x.yaml --corrected y.cfg",
            "Name a file for them, such as --data data.csv",
        ),
        ("import a.cfg -o x.yaml --unit mm", "--unit does not belong to the format klipper"),
        (
            "import a.hal -o x.yaml --sigma-height 1mm",
            "--sigma-height does not belong to the format linuxcnc",
        ),
        (
            "export hexapod-42 --format klipper -o x.cfg",
            "holds a robot of the family linear-delta, not",
        ),
        (
            "export core-xy --format linuxcnc -o x.hal",
            "holds a hexapod (family gough) or a delta (family linear-delta), not",
        ),
        ("export linear-delta -o x.csv --into y.csv", "the format csv makes a new file"),
        (
            "export linear-delta --format klipper --into no.cfg -o x.cfg",
            "no.cfg: this printer.cfg does not exist",
        ),
    ],
)
def test_invalid_import_or_export_is_refused_in_one_sentence(
    loopcal, folder, command, sentence
) -> None:
    loopcal(command, sentence, code=1)
    assert list(folder.iterdir()) == []


def test_page_and_commands_list_every_format(root) -> None:
    page = (root / "docs" / "controllers.md").read_text()
    assert all(f"`{name}`" in page for name in FORMATS)
    for command, ability in (("import", "read"), ("export", "write")):
        found: Any = find_command(command)
        (option,) = [o for o in found.params if o.name == "format_name"]
        assert set(option.type.choices) == {n for n, f in FORMATS.items() if getattr(f, ability)}


def test_uncalibrated_five_bar_exports_to_the_same_urdf_file(loopcal, folder, data_folder) -> None:
    source = data_folder / "urdf_closures" / "5bar_linkage" / "robot.urdf"
    loopcal(
        f"import {source} -o five-bar.yaml",
        "5 rigid bodies with the base (of 8 links), 5 joints (1 closes a loop), 2 motors",
    )
    loopcal(f"export five-bar.yaml --format urdf --into {source} -o same.urdf")
    assert (folder / "same.urdf").read_bytes() == source.read_bytes()


@pytest.mark.slow
def test_heights_and_distances_give_the_optimum_of_the_firmware_cost(
    loopcal, folder, data_folder
) -> None:
    """The weights are those of the firmware. Two of its arms are not optimal (cost 0.6477)."""
    record = read_records(data_folder)[WITH_DISTANCES]
    (folder / "printer.cfg").write_text(format_printer_cfg(record))
    sigma = 0.01 / np.sqrt(2 * len(record["distances"]) / len(record["heights"]))
    words = f"{ONE_COMMAND} --sigma-height {sigma}mm --sigma-distance 0.01mm --json"
    loopcal(words, code=2)
    assert not (folder / "corrected.cfg").exists()
    document = loopcal(f"{words} --force", code=2).json
    assert document["fit"]["rank"] == 9
    assert document["fit"]["chi_square"] * 0.01**2 == pytest.approx(0.6160, abs=1e-4)  # [mm^2]
    found = {row["name"]: row["estimate"] for row in document["fit"]["parameters"]}
    best = {
        "arm1.length": 217.4260,
        "arm2.length": record["geometry_stored_in_config"]["arms"][1],
        "arm3.length": 215.6702,
    }
    for name, value in {**list_stored_geometry(record), **best}.items():
        if name in found:
            assert abs(found[name] - value) < 1e-3, f"{name} [mm, deg]"
    assert (
        len(
            list_changed_lines(
                (folder / "printer.cfg").read_text(), (folder / "corrected.cfg").read_text()
            )
        )
        <= 9
    )
    loopcal("import corrected.cfg -o again.yaml")
    again = lc.load_robot("again.yaml")
    for name, value in found.items():
        factor = np.pi / 180 if name.endswith("angle") else 1e-3
        assert again.values[again.parameters.index(name)] / factor == pytest.approx(
            value, abs=1e-6
        )  # six decimals


def test_output_beside_a_urdf_that_does_not_exist_is_no_input(loopcal, folder) -> None:
    (folder / "r.urdf").write_text(FIVE_BAR)
    loopcal("import r.urdf -o r.yaml", "5 rigid bodies")
    loopcal("import r.urdf -o r.yaml --force", "5 rigid bodies")
