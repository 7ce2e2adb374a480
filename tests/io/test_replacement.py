# SPDX-License-Identifier: Apache-2.0
"""Files and folders take a name only when they are complete; what exists stays until then."""

import os
import secrets
import stat
from pathlib import Path

import pytest

from loopcal.errors import FileError
from loopcal.io.core.outputs import replace_folder
from loopcal.io.core.text_file import replace_file, write_text
from loopcal.io.example_folders import write_example


def list_names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*"))


def test_content_is_written_beside_the_target_until_it_is_complete(tmp_path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text("old")

    def write_half() -> None:
        with replace_file(path) as new:
            new.write_text("half")
            assert (new.parent, new.suffix, path.read_text()) == (tmp_path, ".yaml", "old")
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        write_half()
    assert (path.read_text(), list_names(tmp_path)) == ("old", ["robot.yaml"])
    write_text(path, "é\n")
    assert path.read_bytes() == "é\n".encode()


def test_folder_that_is_not_completed_replaces_nothing(tmp_path) -> None:
    path = tmp_path / "run"

    def write_half() -> None:
        with replace_folder(path) as folder:
            (folder / "new").touch()
            raise ValueError("stop")

    for old in (False, True):
        with pytest.raises(ValueError, match="stop"):
            write_half()
        assert list_names(tmp_path) == ["old", "run"] * old
        path.mkdir(exist_ok=True)
        (path / "old").touch()


def test_permissions_are_those_of_the_old_file_or_of_any_new_file(tmp_path) -> None:
    plain, folder = tmp_path / "plain", tmp_path / "folder"
    plain.touch()
    folder.mkdir()
    write_text(tmp_path / "new", "text")
    assert (tmp_path / "new").stat().st_mode == plain.stat().st_mode
    plain.chmod(0o640)
    write_text(plain, "text")
    assert stat.S_IMODE(plain.stat().st_mode) == 0o640
    with replace_folder(tmp_path / "run"):
        pass
    assert (tmp_path / "run").stat().st_mode == folder.stat().st_mode


def test_temporary_names_are_unpredictable_and_created_exclusively(tmp_path, monkeypatch) -> None:
    names = []
    for _ in range(50):
        with replace_file(tmp_path / "a") as new:
            names.append(new.name)
    assert len(set(names)) == 50
    victim = tmp_path / "victim"
    victim.write_text("mine")
    monkeypatch.setattr(secrets, "token_hex", lambda _: "0" * 16)
    planted = tmp_path / f".loopcal-new-{'0' * 16}-a"
    planted.symlink_to(victim)
    with pytest.raises(FileError, match="file exists"):
        write_text(tmp_path / "a", "overwritten")
    assert (victim.read_text(), planted.is_symlink()) == ("mine", True)


def test_names_that_file_systems_allow_are_written(tmp_path) -> None:
    for name in ("n" * 250 + ".csv", "é" * 125 + ".csv", os.fsdecode(b"\xff\xfe.csv"), "a\nb"):
        write_text(tmp_path / name, "text")
        assert (tmp_path / name).read_text() == "text"
        with replace_folder(tmp_path / f"{name[1:]}"):
            pass
        assert (tmp_path / name[1:]).is_dir()


def test_an_example_removes_what_a_killed_one_left_and_no_folder_of_others(tmp_path):
    ours, other = (tmp_path / f".loopcal-new-{n * 16}-printer" for n in "ab")
    for folder, file in ((ours, "heights.csv"), (other, "notes.txt")):
        folder.mkdir()
        (folder / file).write_text("half")
    names = write_example("delta-printer", tmp_path / "printer")
    assert sorted(path.name for path in (tmp_path / "printer").iterdir()) == sorted(names)
    assert (ours.exists(), other.exists()) == (False, True)
