# SPDX-License-Identifier: Apache-2.0
"""A folder is replaced only if loopcal made it, and nobody changed it or added to it."""

import os
import shutil
from pathlib import Path

import pytest

from loopcal.errors import FileError
from loopcal.io.core import text_file
from loopcal.io.core.outputs import (
    FolderKind,
    describe_leftover,
    refuse_folder,
    write_result_folder,
)
from loopcal.io.core.text_file import NEW, OLD, list_leftovers

RUN = FolderKind("run", "result.json", ("made_by", "fit"), ("arrays.npz", "robot.yaml"))
STUDY = FolderKind("study", "result.json", ("made_by", "paper"), ("page.md", "tables/*.csv"))
DOCUMENTS = {"run": {"made_by": {}, "fit": {}}, "study": {"made_by": {}, "paper": "p"}}
FILES = {
    "run": {"arrays.npz": b"arrays", "robot.yaml": b"name: h\n"},
    "study": {"page.md": b"# Page\n", "tables/a.csv": b"a\n1\n"},
}


def write(path: Path, kind: FolderKind = RUN, force: bool = False, text: str = "") -> None:
    document = DOCUMENTS[kind.content] | {"text": text}
    write_result_folder(path, kind, document, FILES[kind.content], force)


def read_all(path: Path) -> dict[str, bytes]:
    return {p.relative_to(path).as_posix(): p.read_bytes() for p in path.rglob("*") if p.is_file()}


def refuse(path: Path, kind: FolderKind = RUN) -> str:
    """Return why a folder is not replaced even with force, and that it stays as it is."""
    before = read_all(path)
    with pytest.raises(FileError) as caught:
        write(path, kind, force=True)
    assert read_all(path) == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    return str(caught.value)


@pytest.mark.parametrize("kind", [RUN, STUDY])
def test_unchanged_folder_is_replaced_with_force_only(tmp_path, kind) -> None:
    write(tmp_path / "a", kind)
    with pytest.raises(FileError, match="not empty"):
        write(tmp_path / "a", kind, text="new")
    write(tmp_path / "a", kind, force=True, text="new")
    assert b'"text": "new"' in read_all(tmp_path / "a")["result.json"]
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_folder_of_another_kind_is_not_replaced(tmp_path) -> None:
    for kind, other in ((RUN, STUDY), (STUDY, RUN)):
        folder = tmp_path / kind.content / "a"
        write(folder, kind)
        assert f"something other than a {other.content}" in refuse(folder, other)


@pytest.mark.parametrize(
    ("name", "kind"), [("notes.txt", RUN), ("sub/notes.txt", RUN), ("tables/mine.csv", STUDY)]
)
def test_foreign_file_is_never_removed(tmp_path, name, kind) -> None:
    write(tmp_path / "a", kind)
    (tmp_path / "a" / name).parent.mkdir(exist_ok=True)
    (tmp_path / "a" / name).write_text("mine")
    assert f"also contains {name}, which is foreign to a {kind.content}" in refuse(
        tmp_path / "a", kind
    )


def test_foreign_folder_link_and_pipe_are_never_removed(tmp_path) -> None:
    for make in (Path.mkdir, lambda path: path.symlink_to("robot.yaml"), os.mkfifo):
        folder = tmp_path / "place" / "a"
        write(folder)
        make(folder / "mine")
        assert "also contains mine" in refuse(folder)
        shutil.rmtree(folder)


@pytest.mark.parametrize("name", ["robot.yaml", "arrays.npz", "result.json"])
def test_changed_file_is_never_removed(tmp_path, name) -> None:
    write(tmp_path / "a")
    content = (tmp_path / "a" / name).read_bytes()
    (tmp_path / "a" / name).write_bytes(content.replace(b"a", b"b", 1))
    found = refuse(tmp_path / "a")
    if name == "result.json":  # the first letter a is that of the key made_by
        assert "something other than a run" in found
        (tmp_path / "a" / name).write_bytes(content.replace(b'"text": ""', b'"text": "mine"'))
        found = refuse(tmp_path / "a")
    assert f"{name} in this folder has changed" in found


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "null", '{"fit": 1}', "[" * 100_000),
        *(f'{{"made_by": {{}}, "fit": {{}}{rest}}}' for rest in ("", ', "files": {}')),
    ],
)
def test_folder_with_another_document_is_not_replaced(tmp_path, text) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "result.json").write_text(text)
    assert "something other than a run" in refuse(tmp_path / "a")


def test_folder_that_changes_during_the_exchange_is_kept(tmp_path, monkeypatch) -> None:
    write(tmp_path / "a")
    exchange = text_file._exchange

    def add_a_file_first(first: Path, second: Path) -> bool:
        if first.name.startswith(".loopcal-new") and not (first / "mine").exists():
            (second / "mine").touch()
        return exchange(first, second)

    monkeypatch.setattr(text_file, "_exchange", add_a_file_first)
    with pytest.raises(FileError, match="a: this folder also contains mine"):
        write(tmp_path / "a", force=True, text="new")
    assert sorted(read_all(tmp_path / "a")) == ["arrays.npz", "mine", "result.json", "robot.yaml"]
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_symbolic_link_stays_a_link(tmp_path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    (tmp_path / "later").symlink_to("unmade")
    for text in ("one", "two"):
        for name in ("link", "later"):
            write(tmp_path / name, force=True, text=text)
            assert (tmp_path / name).is_symlink()
            assert text.encode() in read_all(tmp_path / name)["result.json"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["later", "link", "real", "unmade"]
    (tmp_path / "circle").symlink_to("circle")
    with pytest.raises(FileError, match="has no target"):
        refuse_folder(tmp_path / "circle", RUN, force=True)


def test_folder_whose_name_is_taken_between_two_renames_is_written(tmp_path, monkeypatch) -> None:
    """Another command takes the name while the old folder is set aside."""
    take, other = text_file._take_free_name, tmp_path / "b"
    write(other, text="other")

    def take_later(temporary: Path, target: Path) -> bool:
        if other.exists() and not target.exists() and list_leftovers(target, OLD):
            other.rename(target)
        return take(temporary, target)

    monkeypatch.setattr(text_file, "_take_free_name", take_later)
    write(tmp_path / "a")
    for text in ("new", "newer"):  # the second one removes the folder that was set aside
        write(tmp_path / "a", force=True, text=text)
        assert f'"{text}"'.encode() in read_all(tmp_path / "a")["result.json"]
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def leave(path: Path, state: str, kind: FolderKind = RUN) -> Path:
    """Make what a command leaves that was killed: a complete folder with a temporary name."""
    place = path.with_name("elsewhere")
    write(place, kind)
    return place.rename(text_file._name_beside(path, state))


def test_folder_set_aside_is_named_by_readers_and_returned_by_writers(tmp_path) -> None:
    path = tmp_path / "a"
    leftover = leave(path, OLD)
    before = read_all(leftover)
    assert f"left it as {leftover}. Rename" in describe_leftover(path, "result.json")
    with pytest.raises(FileError, match="not empty"):
        refuse_folder(path, RUN, force=False)
    assert (read_all(path), [p.name for p in tmp_path.iterdir()]) == (before, ["a"])
    assert describe_leftover(path, "result.json") == ""


def test_leftovers_of_loopcal_are_removed_and_others_stay(tmp_path) -> None:
    path = tmp_path / "a"
    write(path)
    own = [leave(path, NEW), leave(path, OLD), leave(path, NEW)]
    (own[2] / "result.json").unlink()  # killed before it was complete
    foreign = [leave(path, NEW), leave(path, NEW), leave(path, NEW, STUDY), leave(path, NEW)]
    (foreign[0] / "mine").touch()
    (foreign[1] / "robot.yaml").write_text("changed")
    others = tmp_path / ".loopcal-mine"
    others.mkdir()
    link = text_file._name_beside(path, NEW)
    link.symlink_to(others)
    beside = leave(tmp_path / "b", NEW)
    refuse_folder(path, RUN, force=True)
    assert not any(folder.exists() for folder in own)
    assert all(folder.is_dir() for folder in (*foreign[:3], others, link, beside)), foreign
    assert not foreign[3].exists()


def test_folder_that_is_being_written_is_no_leftover(tmp_path) -> None:
    path = tmp_path / "a"
    with text_file.create_temporary(path, is_folder=True) as temporary:
        refuse_folder(path, RUN, force=True)
        assert list_leftovers(path) == [temporary]
    assert list_leftovers(path) == []
