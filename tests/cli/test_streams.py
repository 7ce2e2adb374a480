# SPDX-License-Identifier: Apache-2.0
"""Standard output that is closed or full costs no result, and what is said is true."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from loopcal.cli.entry_point import main
from loopcal.cli.terminal import prepare_streams

pytestmark = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")

COMMAND = f"{sys.executable} -m loopcal simulate five-bar -o data.csv"
FULL = "loopcal: standard output: cannot be written (no space left on device)\n"
WRITTEN = "loopcal: written completely before the following: data.csv\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("streams", "code", "said"),
    [(">/dev/full", 1, WRITTEN + FULL), (">&-", 0, ""), (">/dev/full 2>/dev/full <&-", 1, "")],
)
def test_results_are_written_whatever_becomes_of_standard_output(
    tmp_path, monkeypatch, streams, code, said
) -> None:
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)  # nothing is left to write with it
    words = ["bash", "-c", f"{COMMAND} {streams}"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (code, "", said)
    assert (tmp_path / "data.csv").read_text().startswith("## simulated by loopcal")


@pytest.mark.slow
def test_closed_streams_do_not_give_their_number_to_an_output_file(tmp_path) -> None:
    words = ["bash", "-c", f"{COMMAND} >&- 2>&- <&-"]
    assert subprocess.run(words, cwd=tmp_path, check=False).returncode == 0
    content = (tmp_path / "data.csv").read_text()
    assert subprocess.run(["bash", "-c", f"{COMMAND} --force"], cwd=tmp_path, check=False)
    assert (tmp_path / "data.csv").read_text() == content


def test_names_that_are_not_utf_8_are_written_and_recorded(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    data, run, commands = (os.fsdecode(name) for name in (b"d\xff.csv", b"run\xfe", b"c\xfd.csv"))
    Path("targets.csv").write_text("pose,x [mm],y [mm]\na,0,200\n")
    assert main(["simulate", "five-bar", "-o", data]) == 0
    assert main(["calibrate", "five-bar", data, "-o", run]) == 0
    assert "Written to run\\udcfe" in capsys.readouterr().out
    assert f'"path": "{data}"' in (
        (Path(run) / "result.json").read_text().encode().decode("unicode-escape")
    )
    assert main(["compensate", run, "targets.csv", "-o", commands]) == 0
    assert main(["calibrate", "five-bar", data, "-o", run, "--force", "--json"]) == 0
    assert sorted(path.name for path in Path().iterdir()) == sorted(
        [commands, data, run, "targets.csv"]
    )


def test_a_closed_input_is_empty_and_other_encodings_can_be_read(monkeypatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    prepare_streams()
    assert sys.stdin.readline() == ""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"caf\xe9 1\n"), "utf-8"))
    prepare_streams()
    assert sys.stdin.readline() == "caf\\xe9 1\n"
