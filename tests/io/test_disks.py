# SPDX-License-Identifier: Apache-2.0
"""A full disk, a read-only folder and several writers at once cost no result."""

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from loopcal.errors import FileError
from loopcal.io.core.text_file import write_text
from tests.io.folder_writing import RUN, run_in_copy, write

pytestmark = pytest.mark.forks

NOBODY = 65534


def read_value(path: Path) -> int:
    """Return the value of a complete folder."""
    document = json.loads((path / RUN.document).read_text())
    text = f"value: {document['value']}\n"
    assert (path / "robot.yaml").read_text() == text
    content = (path / "arrays.npz").read_text()
    assert content == text * (len(content) // len(text)) != ""
    return document["value"]


def limit_file_size(size: int, function):
    """Return a function for a process in which no file can become larger."""

    def run():
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        return function()

    return run


@pytest.mark.parametrize("size", [0, 1, 20, 500, 5000])
def test_disk_that_becomes_full_keeps_the_old_folder_and_file(tmp_path, size) -> None:
    run, file = tmp_path / "run", tmp_path / "data.csv"
    write(run, 1)
    file.write_text("old")

    def write_file() -> str:
        try:
            write_text(file, "new" * 3000)
        except FileError as error:
            return str(error)
        return ""

    refused = run_in_copy(limit_file_size(size, lambda: write(run, 2, force=True, size=1000)))
    assert refused == (0, f"{run}: cannot write here (file too large). Choose another place")
    refused = run_in_copy(limit_file_size(size, write_file))
    assert refused == (0, f"{file}: cannot write here (file too large). Choose another place")
    assert (read_value(run), file.read_text()) == (1, "old")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data.csv", "run"]


FULL = """
import sys
from pathlib import Path
from tests.io.folder_writing import write
print(repr(write(Path("disk/run"), 1)))
for size in (40_000, 10_000, 4_000):
    print(repr(write(Path("disk/run"), 2, True, size)))
print(sorted(path.name for path in Path("disk").iterdir()))
print(Path("disk/run/robot.yaml").read_text())
"""


@pytest.mark.slow
def test_full_disk_keeps_the_old_folder(tmp_path) -> None:
    (tmp_path / "disk").mkdir()
    place = Path(__file__).parents[2]
    mount = "mount -t tmpfs -o size=96k none disk"
    probe = subprocess.run(["unshare", "-m", "sh", "-c", mount], cwd=tmp_path, check=False)
    if probe.returncode != 0:
        pytest.skip("no small disk can be mounted here")
    words = ["unshare", "-m", "sh", "-c", f'{mount} && exec "$0" -c "$1"', sys.executable, FULL]
    environment = os.environ | {"PYTHONPATH": f"{place / 'src'}:{place}"}
    done = subprocess.run(
        words, cwd=tmp_path, capture_output=True, text=True, check=True, env=environment
    )
    refused = "'disk/run: cannot write here (no space left on device). Choose another place'"
    assert done.stdout.split("\n")[:6] == ["''", *[refused] * 2, "''", "['run']", "value: 2"]


@pytest.mark.skipif(os.geteuid() != 0, reason="needs permissions to drop")
def test_read_only_folder_is_refused_before_work_begins() -> None:
    place = Path(tempfile.mkdtemp())
    try:
        place.chmod(0o755)
        for path in (place / "run", place / "deep" / "run"):

            def refuse(path: Path = path) -> str:
                os.setuid(NOBODY)
                return write(path, 1)

            said = f"{path}: cannot write here (permission denied). Choose another folder"
            assert run_in_copy(refuse) == (0, said)
        assert list(place.iterdir()) == []
    finally:
        shutil.rmtree(place)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs permissions to drop")
def test_folder_that_cannot_be_removed_is_not_replaced() -> None:
    place = Path(tempfile.mkdtemp())
    path = place / "run"
    try:
        os.chown(place, NOBODY, NOBODY)

        def replace_protected() -> list[str]:
            said = [write(path, 1, force=True), write(path, 1, force=True)]
            for entry in (path, *path.iterdir()):
                os.chown(entry, NOBODY, NOBODY)
            os.setuid(NOBODY)
            path.chmod(0o555)
            said.append(write(path, 2, force=True))
            path.chmod(0o755)
            return [*said, write(path, 3, force=True)]

        code, said = run_in_copy(replace_protected)
        assert code == 0
        assert (said[0], said[1], said[3]) == ("", "", "")
        assert said[2].startswith(f"{path}: this folder permits no changes")
        assert (read_value(path), [p.name for p in place.iterdir()]) == (3, ["run"])
    finally:
        shutil.rmtree(place)


@pytest.mark.slow
@pytest.mark.parametrize("exists", [False, True])
def test_of_four_writers_at_once_exactly_one_wins_without_force(tmp_path, exists) -> None:
    for n in range(8):
        path = tmp_path / str(n) / "run"
        path.parent.mkdir()
        if exists:
            path.mkdir()
        said = write_at_once(path, force=False)
        assert sorted(said.values())[0] == ""
        winner = next(value for value, sentence in said.items() if not sentence)
        assert sum("this folder is not empty" in sentence for sentence in said.values()) == 3
        assert read_value(path) == winner
        assert [p.name for p in path.parent.iterdir()] == ["run"]


def test_four_writers_at_once_with_force_leave_one_complete_folder(tmp_path) -> None:
    for n in range(8):
        path = tmp_path / str(n) / "run"
        write(path, 9)
        assert set(write_at_once(path, force=True).values()) == {""}
        assert read_value(path) in range(4)
        assert [p.name for p in path.parent.iterdir()] == ["run"]


def write_at_once(path: Path, force: bool) -> dict[int, str]:
    """Write a folder by four processes that begin together; return value -> what was said."""
    gate, opened = os.pipe()
    results = {}
    for value in range(4):
        reader, writer = os.pipe()
        if os.fork() == 0:
            try:
                os.close(opened)
                os.read(gate, 1)  # returns when the last process has closed the other end
                os.write(writer, write(path, value, force).encode())
            finally:
                os._exit(0)
        os.close(writer)
        results[value] = reader
    os.close(gate)
    os.close(opened)
    said = {}
    for value, reader in results.items():
        with os.fdopen(reader, "rb") as stream:
            said[value] = stream.read().decode()
    for _ in results:
        os.wait()
    return said
