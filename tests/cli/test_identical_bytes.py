# SPDX-License-Identifier: Apache-2.0
"""The same commands write identical bytes, whatever the environment and the current folder are."""

import locale
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.studies.files.store import StoreHeader, make_store, open_store

TARGETS = "pose,x [mm],y [mm]\na,0,330\nb,10,320\n"
SHORT = """\
check five-bar --plot robot.svg --json
simulate five-bar -o data.csv --kind position --draw 12 --draw-errors --truth truth.yaml
calibrate five-bar data.csv -o run --method map --hold-out 0.25 -v
per-leg hexapod-42 {root}/examples/hexapod-42/measurements.csv -o per-leg.yaml"""
LONG = f"""\
{SHORT}
check five-bar --plot robot.png
check five-bar --plot robot.pdf
new linear-delta -o new.yaml --measurements new.csv --kind component --components z
simulate five-bar -o more.csv --kind position --draw 6 --seed 5
identifiability five-bar data.csv --json
calibrate five-bar data.csv -o run-2 --method map --loss huber --json
calibrate linear-delta {{root}}/examples/delta-printer/heights.csv -o delta --choose-model
validate run more.csv --json
budget run --json
compensate run targets.csv -o commands.csv
bootstrap run --count 20 --json
sample run --json
sample run --region -p west.motor.* --json
plan five-bar -o plan --kind position --candidates 40 --accuracy 0.3mm
plan linear-delta -o surfaces --measure plane-line --groups 4 --points 4
import {{root}}/examples/cable-robot/samples.json --format hangprinter -o cable.yaml
import {{root}}/examples/exports/tracker-points.txt -o tracker.csv \
--profile {{root}}/examples/exports/tracker-points.yaml
export delta -o printer.cfg
export run -o run.csv
export run -o run.json
reproduce hexapod-42 -o study --trials 2"""
"""Every command; `reproduce` takes 3 s for two trials, too long for SHORT."""

WORK = """
import contextlib, io, sys
from pathlib import Path
from loopcal.cli.entry_point import main
for n, command in enumerate(sys.argv[1].splitlines()):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(command.split())
    text = f"{command}\\n{code}\\n{out.getvalue()}{err.getvalue()}"
    Path(f"printed-{n}.txt").write_bytes(text.encode())
"""

USUAL = {"PYTHONHASHSEED": "0", "TZ": "UTC", "LC_ALL": "C.UTF-8"}
"""Environment of the first run."""

OTHER = {
    "PYTHONHASHSEED": "12345",
    "TZ": "Asia/Tokyo",
    "LC_ALL": "C",
    "LANG": "de_DE.UTF-8",
    "OMP_NUM_THREADS": "4",
    "OPENBLAS_NUM_THREADS": "4",
    "SOURCE_DATE_EPOCH": "no number",
    "NUMPY_MADVISE_HUGEPAGE": "no number",
    "COLUMNS": "80",
    "MPLBACKEND": "no backend",
    "MPLCONFIGDIR": "/dev/null",
    "MATPLOTLIBRC": "no file",
}
SETTINGS = b"text.usetex: True\nfont.family: serif\nsavefig.dpi: 30\naxes.facecolor: red\n\xff\n"
"""Settings of matplotlib in the current folder, which no decoder of text can read to the end."""

MORE = {
    "no variables": {},
    "two threads": {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2", "PYTHONHASHSEED": "1"},
    "four threads": {"OPENBLAS_NUM_THREADS": "4", "OMP_NUM_THREADS": "4", "PYTHONHASHSEED": "2"},
    "another time zone": {"TZ": "America/St_Johns", "PYTHONHASHSEED": "random"},
    "C": {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
    "a decimal comma": {"LC_ALL": "de_DE.UTF-8", "PYTHONHASHSEED": "3"},
    "a dotless i": {"LC_ALL": "tr_TR.UTF-8", "LANGUAGE": "tr"},
    "no UTF-8": {"LC_ALL": "de_DE.ISO-8859-1", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
}


def run_commands(
    folder: Path, commands: str, variables: dict[str, str], more: dict[str, bytes] | None = None
) -> dict[str, bytes]:
    """Run commands in a process and a folder of their own, which has `more` files; return the
    content of all other files.
    """
    more = more or {}
    folder.mkdir()
    (folder / "targets.csv").write_text(TARGETS)
    for name, content in more.items():
        (folder / name).write_bytes(content)
    kept = {"PATH", "PYTHONPATH", "HOME", "MPLCONFIGDIR"}
    environment = {k: v for k, v in os.environ.items() if k in kept} | variables
    words = [sys.executable, "-c", WORK, commands]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in more)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def make_locale(folder: Path, name: str, encoding: str = "UTF-8") -> None:
    """Make a locale of the operating system, which may lack it; without tools it stays C."""
    folder.mkdir(exist_ok=True)
    if shutil.which("localedef"):
        words = ["localedef", "-i", name, "-f", encoding, str(folder / f"{name}.{encoding}")]
        subprocess.run(words, check=False, capture_output=True)


def list_differences(first: dict[str, bytes], second: dict[str, bytes]) -> list[str]:
    return sorted(n for n in first.keys() | second.keys() if first.get(n) != second.get(n))


@pytest.mark.slow
def test_files_and_pages_are_identical_in_another_environment(tmp_path, root) -> None:
    commands = SHORT.format(root=root)
    first = run_commands(tmp_path / "first", commands, USUAL)
    second = run_commands(tmp_path / "second folder", commands, OTHER, {"matplotlibrc": SETTINGS})
    names = {"robot.svg", "data.csv", "run/result.json", "run/arrays.npz", "per-leg.yaml"}
    assert names <= set(first)
    assert list_differences(first, second) == []


LOCALES = {
    "tr_TR.UTF-8": ("tr_TR", "UTF-8"),  # a dotted and a dotless i
    "de_DE.UTF-8": ("de_DE", "UTF-8"),  # a decimal comma
    "de_DE.ISO-8859-1": ("de_DE", "ISO-8859-1"),  # no UTF-8
}
"""Name -> source and encoding, for the tool `localedef` of the operating system."""


@pytest.fixture(scope="session")
def locales(tmp_path_factory) -> Path:
    """Return a folder for the locales that the operating system lacks: to make one takes 3 s."""
    return tmp_path_factory.mktemp("locales")


@pytest.fixture(params=LOCALES)
def locale_of_program(request, locales, monkeypatch) -> Iterator[str]:
    """Set every category of a locale, which is more than Python does when it starts."""
    usual = locale.setlocale(locale.LC_ALL)
    try:
        locale.setlocale(locale.LC_ALL, request.param)
    except locale.Error:
        if not (locales / request.param).exists():
            make_locale(locales, *LOCALES[request.param])
        monkeypatch.setenv("LOCPATH", str(locales))
        try:
            locale.setlocale(locale.LC_ALL, request.param)
        except locale.Error:
            pytest.skip(f"no locale {request.param}: install the package locales")
    yield request.param
    locale.setlocale(locale.LC_ALL, usual)


def write_files(folder: Path, monkeypatch, capsys) -> dict[str, bytes]:
    """Run the commands of SHORT but the last in this process; return files and output."""
    folder.mkdir()
    monkeypatch.chdir(folder)
    codes = [main(command.split()) for command in SHORT.splitlines()[:3]]
    assert codes == [0, 0, 0]
    written = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    return written | {"printed": "".join(capsys.readouterr()).encode()}


@pytest.mark.slow
def test_files_and_pages_are_identical_in_every_locale(
    locale_of_program, tmp_path, monkeypatch, capsys
) -> None:
    there = write_files(tmp_path / "there", monkeypatch, capsys)
    locale.setlocale(locale.LC_ALL, "C")
    here = write_files(tmp_path / "here", monkeypatch, capsys)
    assert {"robot.svg", "data.csv", "run/result.json"} <= set(here)
    assert list_differences(there, here) == []


@pytest.mark.evidence
def test_files_and_pages_of_all_commands_are_identical_in_any_environment(tmp_path, root) -> None:
    commands = LONG.format(root=root)
    for place, of in LOCALES.values():
        make_locale(tmp_path / "locales", place, of)
    first = run_commands(tmp_path / "first", commands, USUAL)
    codes = {n: text.split(b"\n")[:2] for n, text in first.items() if n.startswith("printed")}
    assert [c for c in codes.values() if c[1] not in (b"0", b"2")] == []
    for i, (name, variables) in enumerate(MORE.items()):
        again = run_commands(
            tmp_path / str(i), commands, {**variables, "LOCPATH": str(tmp_path / "locales")}
        )
        assert list_differences(first, again) == [], name


def test_a_study_counts_its_blocks_in_every_locale(locale_of_program, tmp_path) -> None:
    make_store(tmp_path, StoreHeader("{}", ("error",), {}))
    with open_store(tmp_path) as store:
        assert store.add_block("key", {"noise": "1"}, 0, np.zeros((2, 1)), 0.1)
        assert not store.add_block("key", {"noise": "1"}, 0, np.zeros((2, 1)), 0.1)
        assert store.count_cell({"noise": "1"}).blocks == 1
