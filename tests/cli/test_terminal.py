# SPDX-License-Identifier: Apache-2.0
"""Hints, order of findings, progress bar and width of the terminal."""

import os
import pty
import subprocess
import sys
from typing import Any

import pytest

from loopcal.cli import terminal
from loopcal.cli.commands.calibration_commands import calibrate, validate
from loopcal.cli.commands.study_commands import study
from loopcal.cli.hints import find_hint, hint_for, load_hints
from loopcal.findings import IMPORTANCE, report_finding, sort_by_importance
from loopcal.findings.catalog import load_catalog
from loopcal.findings.catalog.phrases import MACHINE
from loopcal.findings.wording import add_advice
from tools.fuzz.commands import list_commands

WORK = """
import sys, time
from loopcal.cli import terminal
terminal.DELAY = float(sys.argv[2])
with terminal.TerminalProgress() as progress:
    for i in range(int(sys.argv[1])):
        progress(i, 10, "fitting")
        time.sleep(0.1)
print("end")
"""


def test_hints_and_importance_use_codes_of_the_catalog():
    codes = (*load_hints(), *IMPORTANCE.split())
    assert [code for code in codes if code not in load_catalog()] == []


def test_hint_names_the_poses_of_its_finding():
    step = report_finding("workflow.next-check-outliers", poses=("pose 6", "pose 9"))
    assert hint_for(step) == "use --drop 6 --drop 9, or --loss huber"
    step = report_finding("workflow.next-check-outliers", poses=("pose P1, left", "pose $(reboot)"))
    assert hint_for(step) == "use --drop 'P1, left' --drop '$(reboot)', or --loss huber"
    assert hint_for(report_finding("workflow.next-use-result")) is None


def test_hint_is_shown_only_for_commands_with_its_options():
    code = "outliers.some"
    assert find_hint(code, calibrate) == "use --drop POSE, or --loss huber"
    assert find_hint(code, validate) is None
    assert find_hint("workflow.next-check-data", validate) is not None


def test_change_of_a_freed_limb_has_no_hint_to_free_it():
    data: dict[str, Any] = {"chi_square": 99.0, "degrees": 7.0, "p_value": 1e-9, "level": 0.05}
    data |= {"kind": "none", "names": (), "change": "", "alternatives": ()}
    machine, limb = (
        report_finding("prior.machine-changed", subject=subject, **data)
        for subject in (MACHINE, "leg3")
    )
    assert hint_for(machine) == "use --free-limb LIMB"
    assert hint_for(limb) is None


def test_hint_follows_its_finding():
    finding = report_finding("workflow.no-held-out-poses")
    assert add_advice(finding, hint_for(finding)).endswith(" (Hint: use --hold-out 0.25)")
    assert add_advice(finding, None) == str(finding)


def test_findings_are_sorted_from_failure_to_info():
    info = report_finding("workflow.frame-freedoms", count=6, frames=("base",), still=0, bodies=())
    warning = report_finding("workflow.no-held-out-poses")
    failure = report_finding("gates.limit-not-measured", quantity="position")
    assert sort_by_importance((info, warning, failure)) == (failure, warning, info)


def _run_on_terminal(steps: int, delay: float) -> str:
    """Return what a program writes to a terminal that shows progress after a delay [s].

    A step takes 0.1 s, or more on a busy machine: delays are far from the time of all steps.
    """
    parent, child = pty.openpty()
    words = [sys.executable, "-c", WORK, str(steps), str(delay)]
    with subprocess.Popen(words, stdout=child, stderr=child) as process:
        os.close(child)
        text = b""
        while True:
            try:
                block = os.read(parent, 4096)
            except OSError:  # the program closed the terminal
                break
            if not block:
                break
            text += block
        assert process.wait() == 0
    os.close(parent)
    return text.decode("utf-8", "replace")


def test_long_work_shows_percentage_and_remaining_time_on_a_terminal():
    shown = _run_on_terminal(8, 0.05)
    assert "fitting" in shown
    assert "%" in shown
    assert "0:00" in shown


def test_bar_begins_at_the_steps_that_are_done_and_keeps_its_time():
    bar = terminal.TerminalProgress()
    bar._bar = terminal._make_bar()
    bar(2, 5, "fitting")
    first = bar._task
    assert (bar._bar.tasks[0].completed, bar._bar.tasks[0].total) == (2, 5)
    bar(3, 5, "searching for outliers")
    assert bar._task == first
    assert (bar._bar.tasks[0].completed, bar._bar.tasks[0].description) == (
        3,
        "searching for outliers",
    )
    bar(1, 9, "comparing")
    assert [(task.completed, task.total) for task in bar._bar.tasks] == [(1, 9)]


@pytest.mark.slow
def test_progress_is_hidden_for_short_work_and_without_a_terminal():
    assert _run_on_terminal(1, 60.0).split() == ["end"]
    words = [sys.executable, "-c", WORK, "8", "0.05"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("end\n", "")


def test_width_without_a_terminal_is_80(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.setattr(sys, "__stdout__", None)
    assert terminal.width() == 80


def test_copies_of_all_rows_have_no_hint_to_exclude_them():
    data = {"count": 3, "total": 3, "poses": ("1", "2", "3")}
    nothing_left, some_left = (
        report_finding("prior.rows-reused", **data, others=others) for others in (0, 20)
    )
    assert hint_for(nothing_left) is None
    assert hint_for(some_left) == "exclude poses with --drop POSE"


def test_every_hint_is_shown_by_some_command() -> None:
    commands = [*list_commands().values(), *study.commands.values()]
    never = [code for code in load_hints() if not any(find_hint(code, c) for c in commands)]
    assert never == []
