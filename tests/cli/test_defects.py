# SPDX-License-Identifier: Apache-2.0
"""An exception that is no mistake of the user becomes one sentence, a report and exit code 3."""

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from loopcal.cli.commands import file_commands
from loopcal.cli.entry_point import main

DEFECTS = {
    "RecursionError": "f()",
    "LinAlgError": "np.linalg.inv(np.zeros((2, 2)))",
    "FloatingPointError": "np.divide(1.0, np.zeros(1))",
    "UnicodeEncodeError": "print('\\ud800'.encode())",
    "AssertionError": "exec('assert False')",
}
SCRIPT = """
import sys
import numpy as np
from loopcal.cli.entry_point import main
from loopcal.cli.commands import file_commands
np.seterr(divide="raise")
f = lambda: f()
file_commands.check.callback = lambda **_: {}
sys.exit(main(["check", "hexapod-42"]))
"""


def run_defect(defect: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own, with a defect in the command `check`."""
    words = [sys.executable, "-c", SCRIPT.format(defect)]
    variables = {**os.environ, "TMPDIR": str(folder), **environment}
    return subprocess.run(
        words, capture_output=True, text=True, check=False, cwd=folder, env=variables
    )


def test_defect_gives_one_sentence_a_report_and_exit_code_3(tmp_path) -> None:
    done = run_defect("1 / 0", tmp_path)
    assert (done.returncode, done.stdout) == (3, "")
    assert done.stderr.startswith("loopcal: this is a defect of loopcal, not of your input (ZeroD")
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr
    (report,) = tmp_path.iterdir()
    assert str(report) in done.stderr
    text = report.read_text()
    assert "command: loopcal check hexapod-42\n" in text
    assert f"loopcal {version('loopcal')}, numpy {np.__version__}" in text
    assert text.rstrip().endswith("ZeroDivisionError: division by zero")
    assert report.stat().st_mode & 0o077 == 0, "others may read the report"


@pytest.mark.parametrize("name", DEFECTS)
def test_every_kind_of_defect_is_reported(name, tmp_path, monkeypatch, capsys) -> None:
    def f() -> None:
        f()

    def fail(**_: object) -> None:
        with np.errstate(divide="raise"):
            eval(DEFECTS[name], {"np": np, "f": f})

    monkeypatch.setattr(file_commands.check, "callback", fail)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert main(["check", "hexapod-42"]) == 3
    out, err = capsys.readouterr()
    assert out == ""
    assert f"({name}" in err
    (report,) = tmp_path.iterdir()
    assert f"{name}: " in report.read_text() or report.read_text().rstrip().endswith(name)


def test_defect_is_placed_at_a_line_of_loopcal(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("loopcal.io.robot.robot_file.build_robot", None)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert main(["check", "hexapod-42"]) == 3
    assert "(TypeError at loopcal/io/robot/robot_file.py:" in capsys.readouterr().err


def test_report_is_saved_in_the_current_folder_where_there_is_no_temporary_one(
    tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    monkeypatch.setattr(file_commands.check, "callback", lambda **_: 1 / 0)
    assert main(["check", "hexapod-42"]) == 3
    (report,) = tmp_path.iterdir()
    assert report.name in capsys.readouterr().err


def test_defect_without_a_place_for_the_report_is_still_one_sentence(monkeypatch, capsys) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.mkstemp", refuse)
    monkeypatch.setattr(file_commands.check, "callback", lambda **_: 1 / 0)
    assert main(["check", "hexapod-42"]) == 3
    err = capsys.readouterr().err
    assert "Saving the report failed: send the developers this message, the command" in err
    assert version("loopcal") in err
