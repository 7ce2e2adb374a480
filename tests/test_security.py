# SPDX-License-Identifier: Apache-2.0
"""Promises of SECURITY.md that hold for all of the code."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from loopcal.engine.selection import VARIABLE
from loopcal.environment import PINNED, REMOVED

FORBIDDEN_MODULES = {
    "asyncio", "code", "dbm", "ftplib", "http", "imaplib", "marshal", "multiprocessing", "pickle",
    "poplib", "pty", "runpy", "shelve", "smtplib", "socket", "socketserver", "ssl", "subprocess",
    "telnetlib", "urllib", "webbrowser", "xmlrpc",
}  # fmt: skip
ALLOWED = {
    "documents.py": {"subprocess", "webbrowser"},
    "app/work.py": {"asyncio"},
    "app/server.py": {"asyncio"},
    "cli/commands/session_commands.py": {"asyncio"},
}  # fmt: skip
"""The workers of a study are processes of this program; a report is printed by an installed
browser, where --pdf asks for it; a view is opened in the user's browser; `loopcal app` is a server.
"""
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__", "system", "popen", "spawnl", "execv"}

WATCH = """
import os, sys, tempfile
from pathlib import Path
import matplotlib.font_manager  # its cache of fonts is made once for a user
from loopcal.cli.entry_point import main
inside, events = Path.cwd().resolve(), []
FORBIDDEN = ("socket.", "subprocess.", "os.system", "os.exec", "os.posix_spawn", "os.fork", "pty.",
             "urllib.", "http.", "ftplib.", "smtplib.", "webbrowser.", "pickle.")
WRITES = ("os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.chmod",
          "os.truncate", "shutil.rmtree", "shutil.move", "shutil.copyfile")
def is_outside(path):
    if isinstance(path, int):
        return False
    path = os.path.realpath(os.fsdecode(path))
    return not Path(path).is_relative_to(inside) and path != os.devnull
def watch(event, arguments):
    if event.startswith(FORBIDDEN):
        events.append((event, repr(arguments)[:200]))
    elif event in WRITES and any(is_outside(a) for a in arguments if isinstance(a, (str, bytes))):
        events.append((event, repr(arguments)[:200]))
    elif event == "open" and arguments[0] is not None:
        path, mode, flags = arguments
        is_written = flags & (os.O_WRONLY | os.O_RDWR) if mode is None else set(mode) & set("wax+")
        if is_written and is_outside(path):
            events.append((event, repr(arguments)[:200]))
sys.dont_write_bytecode = True
sys.addaudithook(watch)
codes = [main(command.split()) for command in sys.argv[1].splitlines()]
found = list(events)
assert codes == [0] * len(codes), codes
assert not found, found
"""
COMMANDS = """\
check five-bar --plot robot.svg
simulate five-bar -o data.csv --kind position --draw 12 --draw-errors --truth truth.yaml
calibrate five-bar data.csv -o run --method map --hold-out 0.25
calibrate five-bar data.csv -o run --method map --force
export run -o run.csv"""


@pytest.mark.slow
def test_no_module_can_start_a_program_open_an_address_or_run_text(root: Path) -> None:
    found = []
    wrong = FORBIDDEN_MODULES | FORBIDDEN_CALLS
    written = re.compile(
        rf"\b(import|from)\b.*\b({'|'.join(FORBIDDEN_MODULES)})\b"
        rf"|(?<!re\.)\b({'|'.join(FORBIDDEN_CALLS)})\("
    )
    for path in sorted((root / "src").rglob("*.py")):
        text = path.read_text("utf-8")
        if not written.search(text):
            continue  # parsing takes ten times as long
        for node in ast.walk(ast.parse(text)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if isinstance(node, ast.Call):
                function = node.func
                is_pattern = isinstance(function, ast.Attribute) and function.attr == "compile"
                name = getattr(function, "attr", getattr(function, "id", ""))
                names += [name] if name in FORBIDDEN_CALLS and not is_pattern else []
            allowed = ALLOWED.get(path.relative_to(root / "src" / "loopcal").as_posix(), set())
            names = [name for name in names if name not in allowed]
            found += [f"{path.name}: {name}" for name in names if name.split(".")[0] in wrong]
    assert found == []


def test_arrays_are_never_pickled(root: Path) -> None:
    text = "".join(path.read_text("utf-8") for path in (root / "src").rglob("*.py"))
    calls = re.findall(r"np\.(?:load|save|savez)\(.*", text)
    assert calls
    assert [call for call in calls if "allow_pickle=False" not in call] == []


@pytest.mark.slow
def test_commands_start_no_program_open_no_address_and_write_only_named_files(tmp_path) -> None:
    words = [sys.executable, "-c", WATCH, COMMANDS]
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    assert {path.name for path in tmp_path.iterdir()} == {
        "robot.svg", "data.csv", "truth.yaml", "run", "run.csv",
    }  # fmt: skip


STUDY = """\
format: 1
title: A study
robots: [five-bar]
replicates: 4
block: 2
instruments: {tracker: {kinds: [position]}}
poses: {few: 8}
"""


@pytest.mark.slow
def test_modules_in_the_current_folder_are_not_imported_by_workers(tmp_path) -> None:
    (tmp_path / "study.yaml").write_text(STUDY)
    for name in ("loky", "multiprocessing", "numpy", "pickle", "sitecustomize", "click", "signal"):
        (tmp_path / f"{name}.py").write_text(f"open('{name}.ran', 'w').close()\n")
    command = (
        "import sys; from loopcal.__main__ import run; sys.argv[1:] = sys.argv[1].split(); run()"
    )
    words = [sys.executable, "-P", "-c", command, "study run study.yaml -o out --workers 2"]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"}
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, check=False)
    assert b"2 of 2 blocks are stored" in done.stdout, done.stderr.decode()
    assert [path.name for path in tmp_path.glob("*.ran")] == []


def test_page_lists_every_variable_that_the_code_reads_or_pins(root: Path) -> None:
    text = "".join(path.read_text("utf-8") for path in (root / "src").rglob("*.py"))
    read = re.findall(r"environ(?:\.\w+\(|\[)\"(\w+)\"", text)
    read += re.findall(r"environ\.get\(name\) for name in \(([^)]*)\)", text)
    names = {name.strip('" ') for each in read for name in each.split(",")}
    page = (root / "SECURITY.md").read_text("utf-8")
    assert {"DISPLAY", "RAY_ADDRESS", "MATPLOTLIBRC"} <= names
    names |= {*PINNED, *REMOVED, VARIABLE}
    assert [name for name in sorted(names) if f"`{name}`" not in page] == []


def test_page_names_existing_tests(root: Path) -> None:
    named = re.findall(r"`(tests/[\w/.]+)`", (root / "SECURITY.md").read_text("utf-8"))
    assert len(named) > 8
    assert [name for name in named if not (root / name).exists()] == []
