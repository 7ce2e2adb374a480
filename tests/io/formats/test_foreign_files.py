# SPDX-License-Identifier: Apache-2.0
"""Numbers are not written into files of another kind, and these are not read."""

import pytest

import loopcal as lc
from loopcal.errors import FileError
from loopcal.io.formats import FORMATS
from loopcal.io.formats.program_format import ExportSource, ImportOptions
from loopcal.mechanism.model import Mechanism
from tools.fuzz.sources import SOURCES

OWN = {
    "klipper": ("printer.cfg",),
    "marlin": ("marlin.g",),
    "reprap": ("robot.g",),
    "linuxcnc": ("hexapod.hal",),
    "linuxcnc-ini": ("machine.ini",),
    "urdf": ("robot.urdf", "constrained.urdf"),
    "sdf": ("robot.sdf",),
    "mjcf": ("robot.xml",),
    "maslow": (),
}
"""Names in SOURCES of the files of each format that corrects a file."""

OTHERS = {
    "notes.txt": "Bought in May.\nRods were changed on 2026-05-04: [see photo]\n",
    "table.csv": "pose,x [mm]\n1,0\n",
    "settings.ini": "[project]\nname = x\n[tool.ruff]\nline-length = 100\n",
    "printer.yaml": "format: 1\nfamily: linear-delta\nradius: 100\n",
    "page.html": "<html><body>robot</body></html>\n",
    "cartesian.cfg": "[printer]\nkinematics: corexy\n[stepper_x]\nposition_endstop: 0\n",
    "fans.cfg": "[fan]\npin: PA1\n",
}


@pytest.fixture(scope="module")
def robots() -> dict[str, Mechanism]:
    """Return a robot for each format that corrects a file."""
    return {name: lc.load_robot("linear-delta") for name in ("klipper", "marlin", "reprap")} | {
        "linuxcnc": lc.load_robot("hexapod-42"),
        "linuxcnc-ini": lc.load_robot("hexapod-42"),
        "maslow": lc.load_robot("belt-4"),
        **{name: lc.load_robot("five-bar") for name in ("urdf", "sdf", "mjcf")},
    }


@pytest.mark.parametrize(
    ("name", "file"),
    [(n, f) for n in OWN for f in (*OTHERS, *SOURCES, "robot.json") if f not in OWN[n]],
)
def test_a_file_of_another_kind_is_not_corrected(tmp_path, robots, name: str, file: str) -> None:
    path = tmp_path / file
    path.write_text({**OTHERS, **SOURCES, "robot.json": '{"a": [1]}\n'}[file])
    write, read = FORMATS[name].write, FORMATS[name].read
    assert write is not None
    with pytest.raises(FileError) as caught:
        write(ExportSource(robots[name]), path)
    assert str(caught.value).startswith(str(path))
    if read is not None and (name, file) != ("klipper", "rotary.cfg"):  # of another robot
        with pytest.raises(FileError):
            read(path, ImportOptions("r", length_unit="mm", home_height=0.2))


def test_the_formats_that_correct_a_file_are_all_tested() -> None:
    assert set(OWN) == {name for name, known in FORMATS.items() if known.write and known.takes_file}


def test_a_configuration_of_several_files_is_corrected(tmp_path, robots) -> None:
    """The main file may only include others; what is saved belongs into it."""
    write = FORMATS["klipper"].write
    assert write is not None
    for text in ("[include delta.cfg]\n", "[stepper_a]\narm_length: 250\n"):
        (tmp_path / "printer.cfg").write_text(text)
        written = write(ExportSource(robots["klipper"]), tmp_path / "printer.cfg")
        assert written.text.startswith(text.splitlines()[0])
        assert "position_endstop" in written.text


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.g", "M669 K10\n", "shipped robot 'rotary-delta'"),
        ("a.cfg", "[printer]\nkinematics: polar\n", "in a robot file, as a chain"),
        ("a.cfg", "[printer]\nkinematics: corexy\n", "shipped robot 'core-xy'"),
        ("a.g", "M669 K0\n", "'cartesian'"),
        (
            "a.g",
            "M669 K6 N4 A0:1 B1:1:1 C1:1:1 D0:0:2\n",
            "A of M669 has 2 numbers, but must have 3",
        ),
        ("a.g", "M669 K6 N3 A0:1:1 B1:1:1 C1:1:1\nM666 R7:7:7\n", "M666 needs positive R, U"),
        ("a.g", "M669 K6 N9\n", "Write a number of 3 to 8 lines"),
    ],
)
def test_a_printer_without_towers_is_told_whether_loopcal_calibrates_it(
    tmp_path, name: str, text: str, words: str
) -> None:
    (tmp_path / name).write_text(text)
    read = FORMATS["klipper" if name == "a.cfg" else "reprap"].read
    assert read is not None
    with pytest.raises(FileError, match=words):
        read(tmp_path / name, ImportOptions("r"))


def test_anchors_of_a_hanging_printer_are_read_and_written(tmp_path) -> None:
    """M669 as RepRapFirmware saves it; spools of 75 mm, a gear of 255:20, lines in tackles."""
    anchors = "A0:-1610:-132 B1314:1268:-121 C-1415:744:-121 D0:0:2299"
    spools = "R75:75:75:75 U2:2:2:4 O1:1:1:1 L20:20:20:20 H255:255:255:255"
    (tmp_path / "config.g").write_text(f"M669 K6 N4 P500 {anchors}\nM666 A1 Q0.007 {spools}\n")
    read, write = FORMATS["reprap"].read, FORMATS["hangprinter"].write
    assert read is not None
    assert write is not None
    (tmp_path / "r.yaml").write_text(read(tmp_path / "config.g", ImportOptions("r")).robot_text)
    robot = lc.load_robot(tmp_path / "r.yaml")
    assert robot.actuators[3].name == "d"
    # one turn of the motor pays out 2 pi 75 mm * 20 / 255 / 4 of the line D
    start = lc.inverse(robot, [[0.0, 0.0, 0.0], [0.0, 0.0, -0.00924]]).q[:, 3]
    assert start[1] - start[0] == pytest.approx(2 * 3.14159, rel=1e-3)
    exported = write(ExportSource(robot), None)
    assert exported.text == f"M669 K6 N4 {anchors}\n"
    with pytest.raises(lc.DataError, match="has no anchors"):
        write(ExportSource(lc.load_robot("linear-delta")), None)
