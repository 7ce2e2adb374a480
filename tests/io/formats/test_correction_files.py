# SPDX-License-Identifier: Apache-2.0
"""Files with tables of corrections, read by others: Klipper itself, and readers of our own."""

import csv
import io
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.compensation import TableSize, make_tables
from loopcal.cli.entry_point import main
from loopcal.documents import list_controllers
from loopcal.findings import report_finding
from loopcal.findings.catalog import load_catalog
from loopcal.geometry import align_point_sets
from loopcal.io.formats import FORMATS
from loopcal.io.formats.program_format import Exported, ExportSource
from tests.apply.test_correction_tables import disturb
from tests.io.formats.delta_printers.real_klipper import Printer, install

MM, LIMIT = 1e-3, 5e-6
Pair = tuple[lc.Mechanism, lc.Mechanism]
WRITTEN = 0.1e-6
"""Rounding of heights in the files [m]."""


def export(truth: lc.Mechanism, controller: lc.Mechanism, name: str) -> Exported:
    """Return the file of a format, for a limit of 5 um."""
    known = FORMATS[name]
    assert known.table is not None
    assert known.write is not None
    tables, _ = make_tables(truth, controller, TableSize(*known.table), LIMIT)
    return known.write(ExportSource(truth, tables=tables, stem="table"), None)


def move(truth: lc.Mechanism, controller: lc.Mechanism, commands: np.ndarray) -> np.ndarray:
    """Return where a machine stops (n, 3) [mm] at commands (n, 3) [mm] of its controller."""
    return lc.forward(truth, lc.inverse(controller, commands * MM).q).T[:, :3, 3] / MM


@pytest.fixture(scope="module")
def machine() -> Pair:
    """A delta printer, and what its controller believes."""
    controller = lc.load_robot("linear-delta")
    return disturb(controller), controller


@pytest.fixture
def points() -> np.ndarray:
    """Places on the bed (n, 3) [mm]."""
    return np.random.default_rng(3).uniform([-60, -60, 0], [60, 60, 0], (300, 3))


@pytest.mark.slow
def test_klipper_with_the_mesh_prints_flat(tmp_path, machine: Pair, points) -> None:
    install()
    (tmp_path / "mesh.cfg").write_text(export(*machine, "grid-klipper").text)
    config = tmp_path / "printer.cfg"
    config.write_text("[include mesh.cfg]\n[printer]\nkinematics: delta\n[bed_mesh]\n")
    from klippy.extras import bed_mesh  # type: ignore[import-not-found]

    section = Printer(config).config.getsection("bed_mesh")
    profile = bed_mesh.ProfileManager(section, None).get_profiles()["loopcal"]
    mesh = bed_mesh.ZMesh(profile["mesh_params"])
    mesh.build_mesh(profile["points"])
    heights = np.array([mesh.calc_z(x, y) for x, y, _ in points.tolist()])
    assert np.abs(heights).max() > 0.1
    commands = points + heights[:, None] * [0, 0, 1]
    assert np.abs(move(*machine, commands)[:, 2]).max() * MM < LIMIT + WRITTEN
    assert np.abs(move(*machine, points)[:, 2]).max() > 0.1


@pytest.mark.slow
def test_klipper_with_the_skew_of_a_corexy_prints_true(tmp_path) -> None:
    """Tilted slides and a wrong rotation distance of both belts and of the lift."""
    install()
    controller = lc.load_robot("core-xy")
    errors = {"gantry.x.rz": 4e-3, "gantry.z.rx": -3e-3, "gantry.z.ry": 2e-3, "z.gain": 2e-3}
    errors |= {f"{belt}.radius": 1e-5 for belt in "ab"}
    names = controller.parameters.names
    truth = controller.with_values(controller.values + [errors.get(name, 0.0) for name in names])
    exported = export(truth, controller, "klipper-skew").text
    config = tmp_path / "printer.cfg"
    config.write_text("[printer]\nkinematics: corexy\n[skew_correction]\n" + exported)
    from klippy.extras.skew_correction import PrinterSkew  # type: ignore[import-not-found]

    skew = PrinterSkew(Printer(config).config.getsection("skew_correction"))
    skew.cmd_SKEW_PROFILE(SimpleNamespace(get={"LOAD": "loopcal"}.get))
    scales = [float(line.split()[-1].rstrip(".")) for line in exported.splitlines()[1:4]]
    points = np.random.default_rng(4).uniform([-100, -100, 10], [100, 100, 200], (50, 3))
    moved = np.array([skew.calc_skew([*point, 0.0])[:3] for point in points.tolist()])
    # a motor turns less by the factor of its rotation distance
    errors_left = []
    for commands in (points, moved / scales):
        reached = move(truth, controller, commands)
        M = align_point_sets(reached, points)
        errors_left.append(np.abs(reached @ M[:3, :3].T + M[:3, 3] - points).max())
    assert errors_left[0] > 0.2  # [mm]
    # [mm] x and y share a scale, and (4 mrad)^2 / 4 of 100 mm remain in each
    assert errors_left[1] < 5e-4


def test_reprapfirmware_with_the_height_map_prints_flat(machine: Pair, points) -> None:
    """The reader is that of RepRapFirmware 3.3 by its rules: two lines of labels, of which one is
    compared, numbers by commas, no row longer than 8 characters a height, and linear interpolation.
    """
    text = export(*machine, "grid-reprap").text
    head, labels, grid, *rows = text.splitlines()
    assert head.startswith("RepRapFirmware height map file v2")
    assert labels == "axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1"
    assert grid.split(",")[:2] == ["X", "Y"]
    low_x, _, low_y, _, radius, dx, dy, columns, count = map(float, grid.split(",")[2:])
    assert radius < 0
    heights = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    assert heights.shape == (count, columns)
    assert heights.size <= 441
    assert columns <= 41
    assert max(map(len, rows)) <= 8 * columns
    assert not any(cell == "0" for row in rows for cell in row.split(","))  # would be no height
    x, y = (points[:, 0] - low_x) / dx, (points[:, 1] - low_y) / dy
    i = np.minimum(x.astype(int), int(columns) - 2)
    k = np.minimum(y.astype(int), int(count) - 2)
    fx, fy = x - i, y - k
    found = heights[k, i] * (1 - fx) * (1 - fy) + heights[k, i + 1] * fx * (1 - fy)
    found += heights[k + 1, i] * (1 - fx) * fy + heights[k + 1, i + 1] * fx * fy
    commands = points + found[:, None] * [0, 0, 1]
    assert np.abs(move(*machine, commands)[:, 2]).max() * MM < LIMIT + WRITTEN


def test_rows_of_the_grid_lead_to_their_nodes(machine: Pair) -> None:
    rows = list(csv.DictReader(io.StringIO(export(*machine, "grid").text)))
    table = np.array([[float(cell) for cell in row.values()] for row in rows])
    assert list(rows[0])[::3] == ["x [mm]", "add x [mm]"]
    reached = move(*machine, table[:, :3] + table[:, 3:])
    np.testing.assert_allclose(reached, table[:, :3], rtol=0, atol=1e-6)  # [mm], nine digits


def test_every_joint_of_linuxcnc_has_a_file(machine: Pair) -> None:
    exported = export(*machine, "grid-linuxcnc")
    for joint in range(3):
        assert f"[JOINT_{joint}]" in exported.text
        assert f"COMP_FILE = table-joint{joint}.comp" in exported.text
        rows = np.loadtxt(io.StringIO(exported.beside[f"table-joint{joint}.comp"]))
        assert rows.shape[1] == 3
        assert len(rows) <= 256
        assert (np.diff(rows[:, 0]) > 0).all()


def test_the_command_writes_tables_and_keeps_files(tmp_path: Path, capsys) -> None:
    lc.save_robot(disturb(lc.load_robot("linear-delta")), tmp_path / "true.yaml")
    command = ["export", str(tmp_path / "true.yaml"), "--controller", "linear-delta", "--format"]
    output = ["-o", str(tmp_path / "joints.ini")]
    assert main([*command, "grid-linuxcnc", *output]) == 0
    assert (tmp_path / "joints-joint2.comp").exists()
    (tmp_path / "joints.ini").unlink()
    assert main([*command, "grid-linuxcnc", *output]) == 1  # the files of joints are there
    assert not (tmp_path / "joints.ini").exists()
    assert main([*command, "grid-linuxcnc", *output, "--force"]) == 0
    capsys.readouterr()
    assert main([*command, "grid", "--table-error", "2um"]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("x [mm],y [mm],z [mm],add x [mm]")
    assert main([*command, "csv", "--table-error", "2um"]) == 1
    assert main([*command, "grid-reprap", "--into", str(tmp_path / "joints.ini"), "-o", "x"]) == 1


def test_only_tables_of_all_coordinates_move_programs(tmp_path: Path, capsys, monkeypatch) -> None:
    lc.save_robot(disturb(lc.load_robot("linear-delta")), tmp_path / "true.yaml")
    moves = report_finding("files.base-moves", **load_catalog()["files.base-moves"].example)
    chosen = "loopcal.apply.base_motion.choose_base"
    monkeypatch.setattr(chosen, lambda result, old, robot, **settings: (robot, (moves,)))
    command = ["export", str(tmp_path / "true.yaml"), "--controller", "linear-delta", "--format"]
    for name, is_said in (("grid", True), ("grid-klipper", False), ("klipper-skew", False)):
        assert main([*command, name]) == 0
        assert ("of a program" in " ".join(capsys.readouterr().err.split())) == is_said


def test_reports_list_no_tables(machine: Pair) -> None:
    listed = [entry.format for entry in list_controllers(ExportSource(machine[0]))]
    assert "klipper" in listed
    assert not any(name.startswith("grid") for name in listed)
