# SPDX-License-Identifier: Apache-2.0
"""Files and folders take a name only when they are complete; what exists stays until then."""

import os
import secrets
import stat
from pathlib import Path

import pytest

from loopcal.errors import FileError
from loopcal.io.core.outputs import replace_folder
from loopcal.io.core.text_file import write_text


def refuse(path: Path) -> None:
    raise ValueError(f"{path}: line 3 is not a number")


def list_names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*"))


def test_file_that_cannot_be_read_replaces_nothing(tmp_path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text("old")
    with pytest.raises(FileError, match="This is a defect of loopcal") as caught:
        write_text(path, "new", refuse)
    assert caught.value.code == "files.written-unreadable"
    assert f"({path}: line 3 is not a number)" in str(caught.value)
    assert (path.read_text(), list_names(tmp_path)) == ("old", ["robot.yaml"])


def test_folder_that_cannot_be_read_replaces_nothing(tmp_path) -> None:
    path = tmp_path / "run"
    for old in (False, True):
        with pytest.raises(FileError) as caught, replace_folder(path, refuse) as folder:
            (folder / "new").touch()
        assert caught.value.code == "files.written-unreadable"
        assert list_names(tmp_path) == ["old", "run"] * old
        path.mkdir(exist_ok=True)
        (path / "old").touch()


def test_read_back_sees_the_complete_content_beside_the_target(tmp_path) -> None:
    path, seen = tmp_path / "data.csv", []
    write_text(path, "é\n", lambda new: seen.append((new.read_bytes(), new.parent, new.suffix)))
    assert seen == [("é\n".encode(), tmp_path, ".csv")]
    assert path.read_bytes() == "é\n".encode()


def test_permissions_are_those_of_the_old_file_or_of_any_new_file(tmp_path) -> None:
    plain, folder = tmp_path / "plain", tmp_path / "folder"
    plain.touch()
    folder.mkdir()
    write_text(tmp_path / "new", "text", Path.read_text)
    assert (tmp_path / "new").stat().st_mode == plain.stat().st_mode
    plain.chmod(0o640)
    write_text(plain, "text", Path.read_text)
    assert stat.S_IMODE(plain.stat().st_mode) == 0o640
    with replace_folder(tmp_path / "run", os.listdir):
        pass
    assert (tmp_path / "run").stat().st_mode == folder.stat().st_mode


def test_temporary_names_are_unpredictable_and_created_exclusively(tmp_path, monkeypatch) -> None:
    names = []
    for _ in range(50):
        write_text(tmp_path / "a", "text", lambda new: names.append(new.name))
    assert len(set(names)) == 50
    victim = tmp_path / "victim"
    victim.write_text("mine")
    monkeypatch.setattr(secrets, "token_hex", lambda _: "0" * 16)
    planted = tmp_path / f".loopcal-new-{'0' * 16}-a"
    planted.symlink_to(victim)
    with pytest.raises(FileError, match="file exists"):
        write_text(tmp_path / "a", "overwritten", Path.read_text)
    assert (victim.read_text(), planted.is_symlink()) == ("mine", True)


def test_names_that_file_systems_allow_are_written(tmp_path) -> None:
    for name in ("n" * 250 + ".csv", "é" * 125 + ".csv", os.fsdecode(b"\xff\xfe.csv"), "a\nb"):
        write_text(tmp_path / name, "text", Path.read_text)
        assert (tmp_path / name).read_text() == "text"
        with replace_folder(tmp_path / f"{name[1:]}", os.listdir):
            pass
        assert (tmp_path / name[1:]).is_dir()
