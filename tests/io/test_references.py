# SPDX-License-Identifier: Apache-2.0
"""Files that a measurement file names stay in its folder, unless their path is absolute."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.errors import FileError
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.robot.robot_file import find_robot_file, load_robot
from loopcal.measure.measurements import Measurements
from tests.findings.expectations import expect_refusal

HEAD = "# kind: component\n# components: [x]\n# noise: {x: 1 um}\n"
READINGS = "pose,left [deg],right [deg]\na,100,30\nb,101,31\n"
MEASURED = HEAD + "# poses: NAME\npose,x [mm]\na,1\nb,2\n"
COMMANDED = HEAD + "# controller: NAME\npose,commanded.x [mm],commanded.y [mm],x [mm]\na,0,330,1\n"


@pytest.fixture
def folders(tmp_path, monkeypatch) -> Path:
    """Return a folder `data` with links, beside files that its files must not name."""
    inside = tmp_path / "data"
    (inside / "deeper").mkdir(parents=True)
    for folder in (tmp_path, inside, inside / "deeper"):
        (folder / "poses.csv").write_text(READINGS)
        shutil.copy(find_robot_file("five-bar"), folder / "robot.yaml")
    (inside / "out").symlink_to(tmp_path)
    (inside / "out.csv").symlink_to(tmp_path / "poses.csv")
    (inside / "out.yaml").symlink_to(tmp_path / "robot.yaml")
    (inside / "in.csv").symlink_to(inside / "deeper" / "poses.csv")
    (inside / "loop.csv").symlink_to(inside / "loop.csv")
    monkeypatch.chdir(tmp_path)
    return inside


def load(folder: Path, text: str, name: str) -> Measurements:
    (folder / "data.csv").write_text(text.replace("NAME", name))
    return load_measurements(folder / "data.csv", load_robot("five-bar"))


@pytest.mark.parametrize(
    "name", ["poses.csv", "deeper/poses.csv", "in.csv", "./deeper/../poses.csv"]
)
def test_path_inside_the_folder_is_read(folders, name) -> None:
    assert np.isfinite(load(folders, MEASURED, name).readings).all()


OUTSIDE = [
    *((MEASURED, name) for name in ("../poses.csv", "deeper/../../poses.csv", "out/poses.csv")),
    *((COMMANDED, name) for name in ("../robot.yaml", "out/robot.yaml", "out.yaml")),
    (MEASURED, "out.csv"),
]


@pytest.mark.parametrize(("text", "name"), OUTSIDE)
def test_path_that_leaves_the_folder_is_refused_at_its_line(folders, text, name) -> None:
    with pytest.raises(FileError) as caught:
        load(folders, text, name)
    assert (caught.value.code, caught.value.line) == ("files.reference-outside", 4)


@pytest.mark.parametrize("name", ["absent.csv", "loop.csv", "deeper", "data", "five-bar"])
def test_file_that_does_not_exist_is_refused_and_not_searched_for_elsewhere(folders, name) -> None:
    with pytest.raises(FileError) as caught:
        load(folders, MEASURED, name)
    assert caught.value.code in ("files.reference-missing", "files.reference-outside")


def test_controller_is_beside_the_file_or_shipped_and_not_in_the_current_folder(folders) -> None:
    (folders / "robot.yaml").unlink()  # one of this name is in the current folder
    with expect_refusal("files.reference-missing", FileError):
        load(folders, COMMANDED, "robot.yaml")
    load(folders, COMMANDED, "five-bar")


def test_absolute_path_is_read_and_reported(folders, capsys) -> None:
    load(folders, MEASURED, str(folders.parent / "poses.csv"))
    assert main(["identifiability", "five-bar", str(folders / "data.csv")]) == 0
    note = capsys.readouterr().err
    assert f"names {folders.parent / 'poses.csv'} as 'poses' by its absolute path" in note
    load(folders, COMMANDED, str(folders.parent / "robot.yaml"))
    main(["identifiability", "five-bar", str(folders / "data.csv")])
    assert "as 'controller' by its absolute path" in capsys.readouterr().err
