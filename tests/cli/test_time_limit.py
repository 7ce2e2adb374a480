# SPDX-License-Identifier: Apache-2.0
"""The option --time-limit stops every command with exit code 4, and without a result."""

import signal
import threading
import time

import pytest
from click.testing import CliRunner

from loopcal.cli import main
from loopcal.cli.commands.study_commands import study
from loopcal.cli.entry_point import SECTIONS, command_line
from loopcal.cli.terminal import ProgressBar
from loopcal.cli.time_limit import TimeLimitError, limit_time

NAMES = [(name,) for members in SECTIONS.values() for name in members if name != "study"]
EVERY = [*NAMES, *(("study", name) for name in study.commands)]


def work_forever() -> None:
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        pass
    pytest.fail("the work was not stopped")


def test_work_is_stopped_by_a_signal_which_is_then_released() -> None:
    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(TimeLimitError) as stop, limit_time(0.05):
        work_forever()
    assert str(stop.value) == "the time limit of 0.05 s was reached"
    assert signal.getsignal(signal.SIGALRM) == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_work_in_another_thread_is_stopped_without_signals() -> None:
    stops = []

    def work() -> None:
        try:
            with limit_time(0.05):
                work_forever()
        except TimeLimitError as error:
            stops.append(str(error))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(30.0)
    assert stops == ["the time limit of 0.05 s was reached"]


def test_work_within_the_limit_is_not_stopped() -> None:
    with limit_time(3600.0):
        assert signal.getitimer(signal.ITIMER_REAL)[0] > 3500.0


def test_stop_names_the_step_that_progress_reported() -> None:
    def work() -> None:
        with ProgressBar() as progress:
            progress(2, 5, "fit 3 of 5")
            raise TimeLimitError(120.0)

    with pytest.raises(TimeLimitError, match="of 2 min was reached during this step: fit 3 of 5"):
        work()


def test_long_calibration_ends_with_exit_code_4_and_leaves_nothing(tmp_path, capsys) -> None:
    data, run = tmp_path / "data.csv", tmp_path / "run"
    assert main(["simulate", "hexapod-42", "--draw", "400", "-o", str(data)]) == 0
    names = sorted(tmp_path.iterdir())
    capsys.readouterr()
    words = ["calibrate", "hexapod-42", str(data), "-o", str(run), "--time-limit", "0.1s"]
    assert main(words) == 4
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("loopcal: the time limit of 0.1 s was reached")
    assert err.rstrip().endswith("; no result was written.")
    assert sorted(tmp_path.iterdir()) == names


@pytest.mark.parametrize("words", EVERY)
def test_every_command_has_the_option(words: tuple[str, ...]) -> None:
    result = CliRunner().invoke(command_line, [*words, "--help"])
    assert "--time-limit DURATION" in result.output


@pytest.mark.parametrize("text", ["0s", "5", "-1s", "1e3s", "nan s", "30 sec", "721h", "s", "5m"])
def test_what_is_no_duration_is_refused(text: str, capsys) -> None:
    assert main(["check", "five-bar", "--time-limit", text]) == 1
    assert repr(text) in capsys.readouterr().err


@pytest.mark.parametrize("text", ["30s", "0.5h", "10min", "2 h"])
def test_durations_are_accepted(text: str, capsys) -> None:
    assert main(["check", "five-bar", "--time-limit", text]) == 0
    assert "five-bar" in capsys.readouterr().out
