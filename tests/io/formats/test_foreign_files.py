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
    if read is not None:
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
