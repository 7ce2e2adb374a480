# SPDX-License-Identifier: Apache-2.0
"""The command line as a whole: help texts, imports, error messages and exit codes."""

import gc
import subprocess
import sys
from pathlib import Path

import click
import pytest

import loopcal as lc
from loopcal.cli.commands import file_commands
from loopcal.cli.commands.study_commands import study
from loopcal.cli.entry_point import command_line, main

NAMES = sorted(command_line.list_commands(click.Context(command_line)))


def test_help_lists_every_command(capsys) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_help_of_every_command_has_an_example_and_the_option_json(name, capsys) -> None:
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"    loopcal {name} " in text
    assert "--json" in text or name == "study"  # its commands have it
    assert "None" not in text


@pytest.mark.parametrize("name", sorted(study.commands))
def test_help_of_every_command_of_studies_has_an_example_and_the_option_json(name, capsys) -> None:
    assert main(["study", name, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"    loopcal study {name} " in text
    assert "--json" in text


def test_python_m_loopcal_runs_the_command_line() -> None:
    words = [sys.executable, "-m", "loopcal"]
    done = subprocess.run(
        [*words, "check", "no-such-robot"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("loopcal: ")
    assert "no-such-robot" in done.stderr


def test_large_packages_are_not_imported_before_a_command_runs() -> None:
    large = {"numpy", "scipy", "msgspec", "ruamel", "rich", "importlib.metadata"}
    code = (
        "import sys; from loopcal.cli.entry_point import main; main(['--help']); "
        f"print(sorted({large} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


UNUSED = {
    *("matplotlib", "jinja2", "rich", "pandas", "xarray", "msgspec", "loky"),
    *("scipy.stats", "scipy.optimize", "scipy.spatial", "scipy.sparse", "scipy.linalg"),
    *("loopcal.planning", "loopcal.studies", "loopcal.documents", "loopcal.report.figures"),
    *("loopcal.apply.compensation", "loopcal.apply.run_comparison"),
    *("loopcal.diagnose.cross_validation", "loopcal.diagnose.bootstrap"),
}
"""Packages that an ordinary calibration does not need, each of which takes time to import."""


DATA = str(Path("examples/hexapod-42/measurements.csv").resolve())
COMMANDS = [
    ["--version"],
    ["check", "hexapod-42"],
    ["identifiability", "hexapod-42"],
    ["simulate", "hexapod-42", "-o", "simulated.csv"],
    ["calibrate", "hexapod-42", DATA, "-o", "run", "--hold-out", "0.25"],
    ["validate", "run", "simulated.csv"],
    ["budget", "run"],
]


@pytest.mark.slow
def test_commands_import_only_what_they_need(tmp_path) -> None:
    """In one process, which keeps what any of them imports."""
    code = (
        f"import sys; from loopcal.cli.entry_point import main\nfor words in {COMMANDS}:\n"
        f"    print('\\nSEEN', words[0], main(words), *({UNUSED} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    seen = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("SEEN")]
    assert [name for name, *_ in seen] == [words[0] for words in COMMANDS]
    assert all(codes in (["0"], ["2"]) for _, *codes in seen), seen


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (lc.MechanismError("two\n  lines"), "loopcal: hexapod-42: two lines\n"),
        (KeyboardInterrupt(), "loopcal: stopped before the end, and loopcal wrote no result.\n"),
        (
            PermissionError(13, "Permission denied", "run"),
            "loopcal: run: the operating system refused (permission denied)",
        ),
        (
            OSError(28, "No space left on device"),
            "loopcal: the operating system refused (no space left on device)",
        ),
        (MemoryError(), "loopcal: there is not enough memory"),
        (click.UsageError("bad"), "loopcal: bad\n"),
    ],
)
def test_user_error_prints_one_sentence_and_gives_exit_code_1(
    monkeypatch, capsys, error, sentence
) -> None:
    def fail(*_args, **_kwargs):
        raise error

    monkeypatch.setattr(file_commands.check, "callback", fail)
    assert main(["check", "hexapod-42"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.lstrip("\n").startswith(sentence)  # click ends the line of ^C first
    assert err.strip().count("\n") == 0


def test_closed_output_pipe_causes_no_traceback() -> None:
    code = (
        "import sys; from loopcal.cli.entry_point import main; "
        "sys.exit(main(['check', 'hexapod-42']))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 1


def test_command_line_called_from_python_leaves_the_garbage_collection_as_it_was() -> None:
    before = gc.get_threshold()
    assert main(["check", "hexapod-42"]) == 0
    assert gc.get_threshold() == before
