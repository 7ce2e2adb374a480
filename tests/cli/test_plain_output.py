# SPDX-License-Identifier: Apache-2.0
"""What commands print is plain text, and nothing of a file that is not one of loopcal."""

import os
import shlex
import shutil
import subprocess
import sys

import pytest

from loopcal.cli import terminal
from loopcal.io.robot.robot_file import find_robot_file
from loopcal.plain_text import find_not_plain

EVIL = "a\x1b[2J\n\u202eb"


def refuse_escapes(text: str) -> None:
    assert find_not_plain(text, "\n") is None, repr(text)
    assert "\nb" not in text


LINES = {
    "a file that is absent": ["check", f"{EVIL}.yaml"],
    "a file of data": ["identifiability", "five-bar", f"{EVIL}.csv"],
    "an output": ["simulate", "five-bar", "-o", f"{EVIL}/a.csv"],
    "a command": [EVIL],
    "an option": ["check", f"--{EVIL}"],
    "a value of an option": ["simulate", "five-bar", "-o", "a.csv", "--sigma-position", EVIL],
    "a choice": ["simulate", "five-bar", "-o", "a.csv", "--distribution", EVIL],
    "an ending": ["import", f"x.{EVIL}", "-o", "a.yaml"],
    "a folder": ["budget", EVIL],
    "a format of a picture": ["check", "five-bar", "--plot", f"a.{EVIL}"],
    "bytes that are not UTF-8": ["check", "\udcff\udc9b.yaml"],
}


@pytest.mark.parametrize("case", LINES)
def test_words_of_the_command_line_are_printed_as_plain_text(loopcal, folder, case) -> None:
    printed = loopcal(LINES[case], code=1)
    refuse_escapes(printed.out + printed.err)
    assert printed.err.count("\n") <= 2  # the message and a hint


@pytest.mark.parametrize("name", [EVIL, "\udcff\udc9b"])
def test_results_name_files_as_plain_text(loopcal, folder, name) -> None:
    robot, printed = f"{name}.yaml", []
    (folder / robot).write_bytes(find_robot_file("five-bar").read_bytes())
    for words in (["check", robot], ["simulate", robot, "-o", f"{name}.csv", "--draw", "3"]):
        printed += loopcal(words)[1:]
        printed += loopcal([*words, "--json", *(["--force"] if "-o" in words else [])])[1:]
    printed += loopcal(["new", "five-bar", "-o", f"{name}-2.yaml"])[1:]
    printed += loopcal(["check", f"{name}-2.yaml"])[1:]
    refuse_escapes("".join(printed))
    assert "\\x1b" in "".join(printed) or "\\udcff" in "".join(printed)


def test_json_keeps_names_of_files_that_are_not_utf_8(loopcal, folder) -> None:
    name = os.fsdecode(b"a\xff.csv")
    assert (
        name in loopcal(["simulate", "five-bar", "-o", name, "--draw", "3", "--json"]).json.values()
    )


def test_terminal_that_lacks_a_character_shows_a_sign_or_its_escape(folder) -> None:
    shutil.copy(find_robot_file("five-bar"), "\u540d.yaml")
    words = [sys.executable, "-m", "loopcal", "check", "\u540d.yaml"]
    latin = {**os.environ, "PYTHONIOENCODING": "latin-1"}
    done = subprocess.run(words, capture_output=True, check=False, env=latin)
    assert done.returncode == 0, done.stderr
    assert b"file: \\u540d.yaml" in done.stdout
    assert b"\n----------" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80


def test_command_to_copy_is_read_by_a_shell_as_it_is(loopcal, folder) -> None:
    lines = loopcal(
        ["new", "five-bar", "-o", "$(reboot) a.yaml", "--measurements", "b;c.csv"]
    ).out.splitlines()
    following = ["Next:", "loopcal", "calibrate", "$(reboot) a.yaml", "b;c.csv", "-o", "run"]
    assert shlex.split(lines[-1]) == following


def test_endless_message_is_cut(capsys) -> None:
    terminal.print_message("x" * 10**6)
    assert len(capsys.readouterr().err) < terminal.LONGEST_MESSAGE + 10


SECRET = "hunter2"
SECRETS = {
    "shadow": f"root:$6${SECRET}$abc:19000:0:99999:7:::\ndaemon:{SECRET}:19000:0:99999:7:::\n",
    "table": f"user,{SECRET},x\nroot,{SECRET}]a,y\n",
    "keys": f"password: {SECRET}\n{SECRET}: [{SECRET}, 1\n",
    "twice": f"{SECRET}: 1\n{SECRET}: 2\n",
    "alias": f"a: *{SECRET}\n",
    "tag": f"a: !{SECRET} 1\n{SECRET}: .inf\n",
    "date": f"? [{SECRET}]\n: 2026-99-99\n",
    "variables": f"TOKEN={SECRET}\nPASS='{SECRET}'\n",
    "config": f"[default]\nsecret = {SECRET}\n",
    "json": f'{{"token": "{SECRET}", }}',
    "xml": f"<secrets><s name='{SECRET}'>{SECRET}</s></secrets>",
    "comments": f"# of {SECRET}: b: {SECRET}\nUUID={SECRET} / ext4 0 1\n",
}
PROFILE = "columns: {x: {from: 1, unit: mm}, y: {from: 2, unit: mm}, z: {from: 3, unit: mm}}\n"
READERS = [
    "check FILE",
    "calibrate five-bar FILE -o run",
    "calibrate five-bar FILE -o run --prior FILE",
    "validate FILE FILE",
    "compensate five-bar FILE -o out.csv",
    "identifiability five-bar --poses FILE",
    "plan five-bar -o plan --like FILE",
    "plan five-bar -o plan --allowed FILE",
    "simulate five-bar --poses FILE -o out.csv",
    *(
        f"import FILE -o out.yaml --format {name}"
        for name in ("klipper", "marlin", "reprap", "urdf", "hangprinter", "linuxcnc --unit mm")
    ),
    "import FILE -o out.csv --profile profile.yaml",
    "import FILE -o out.csv --profile FILE",
    "export linear-delta -o out.gcode --into FILE",
    "budget FILE",
]


@pytest.mark.slow
@pytest.mark.parametrize("content", SECRETS)
def test_nothing_is_shown_of_a_file_that_is_not_one_of_loopcal(loopcal, folder, content) -> None:
    (folder / "file").write_text(SECRETS[content])
    kind = "settings: {kind: position, noise: {x: 1 um, y: 1 um, z: 1 um}}\n"
    (folder / "profile.yaml").write_text("delimiter: spaces\n" + PROFILE + kind)
    for command in READERS:
        printed = loopcal(command.replace("FILE", "file"), code=1)
        assert SECRET not in printed.out + printed.err, command
