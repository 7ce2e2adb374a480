# SPDX-License-Identifier: Apache-2.0
"""`loopcal measure`: rows typed, piped and followed; sessions resumed, killed, and used twice."""

import csv
import io
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from loopcal.cli.entry_point import main
from loopcal.io.runs.session_folder import split_values

POSES = 16
COMMAND = [sys.executable, "-m", "loopcal", "measure", "plan", "-o", "session"]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with a plan, and its sheet filled in by a simulation."""
    folder = tmp_path_factory.mktemp("measure")
    plan, filled = str(folder / "plan"), str(folder / "filled.csv")
    words = ["--kind", "position", "--frames", "base", "--sigma-position", "5um"]
    size = ["--poses", str(POSES), "--hold-out", "1", "--candidates", "40"]
    assert main(["plan", "hexapod-42", "-o", plan, *words, *size]) == 0
    simulate = ["simulate", "hexapod-42", "--fill", f"{plan}/measurements.csv", "-o", filled]
    assert main([*simulate, "--draw-errors"]) == 0
    return folder


def read_csv(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(line for line in path.read_text().splitlines() if line[0] != "#"))


@pytest.fixture
def rows(made, folder) -> list[list[str]]:
    """Pose, x, y and z [mm] of all rows, in a folder with the plan."""
    shutil.copytree(made / "plan", folder / "plan")
    return [
        [row[name] for name in ("pose", "x [mm]", "y [mm]", "z [mm]")]
        for row in read_csv(made / "filled.csv")
    ]


@pytest.fixture
def measure(loopcal, monkeypatch):
    """Run the command with lines as standard input."""

    def run(lines, *said, words="measure plan -o session", code=0):
        monkeypatch.setattr(sys, "stdin", io.StringIO("".join(f"{line}\n" for line in lines)))
        return loopcal(words, *said, code=code)

    return run


def join(row) -> str:
    return " ".join(row)


def read_used() -> list[str]:
    return [row["pose"] for row in read_csv(Path("session/measurements.csv"))]


def wrong(row, by=1.0) -> str:
    return join([row[0], str(float(row[1]) + by), *row[2:]])


@pytest.mark.slow
def test_a_session_becomes_the_input_of_a_calibration(measure, rows, loopcal) -> None:
    printed = measure(
        map(join, rows), "accuracy so far: 90 % of machines", "Next: loopcal calibrate hexapod-42 "
    )
    assert "8 rows" not in printed.words
    assert read_used() == [row[0] for row in rows]
    assert all(len(line) <= 80 for line in printed.out.splitlines() if "Next:" not in line)
    assert "\x1b" not in printed.out
    loopcal("calibrate hexapod-42 session/measurements.csv -o run --method map", "Written to run")


def test_the_suggested_pose_needs_no_name(measure, rows) -> None:
    values = {row[0]: row[1:] for row in rows}
    first = measure([]).words.partition("Command pose ")[2].partition(":")[0]
    measure([join(values[first])], "session: 1 row, 1 used")
    assert read_used() == [first]


def test_a_chosen_pose_is_the_one_that_comes_next(measure, rows) -> None:
    said = measure([f"pose {rows[4][0]}"]).words
    assert f"next: pose {rows[4][0]}, as you chose Command pose {rows[4][0]}:" in said


def test_a_wrong_row_is_left_out_and_its_repeat_used(measure, rows) -> None:
    given = [*map(join, rows[:6]), wrong(rows[6]), join(rows[6])]
    measure(given, f"pose {rows[6][0]} does not fit: x differs", "Its earlier row was wrong")
    assert read_used() == [row[0] for row in rows[:7]]
    journal = Path("session/rows.csv").read_text()
    assert wrong(rows[6]).split()[1] in journal  # what was measured is not lost


def test_a_wrong_row_that_is_pasted_twice_confirms_nothing(measure, rows) -> None:
    given = [*map(join, rows[:6]), wrong(rows[6]), wrong(rows[6]), join(rows[6])]
    measure(given, "repeats the doubted row", "Its earlier row was wrong")
    assert Path("session/rows.csv").read_text().count(wrong(rows[6]).split()[1]) == 1


@pytest.mark.slow
def test_a_row_is_taken_back_used_and_left_out(measure, rows) -> None:
    measure([*map(join, rows[:3]), "back"], f"loopcal removes the row of pose {rows[2][0]}")
    assert read_used() == [row[0] for row in rows[:2]]
    measure(["out"], "resumed with 2 rows, 2 of them in use")
    assert read_used() == [rows[0][0]]
    measure(["keep"], f"loopcal uses the row of pose {rows[1][0]}")
    assert read_used() == [row[0] for row in rows[:2]]
    measure(["back", "back", "back"], "the session has no row")
    assert not Path("session/measurements.csv").exists()


@pytest.mark.parametrize(
    "line", ["12 x 3", "1 2", "nan 1 2", "1 2 3 4 5", "\x1b[A", "=1+1", "1e999 1 1"]
)
def test_rubbish_is_not_understood_and_changes_nothing(measure, rows, line) -> None:
    printed = measure([join(rows[0]), line], "does not understand")
    assert read_used() == [rows[0][0]]
    assert "\x1b" not in printed.out


def test_an_unknown_pose_and_an_empty_row_are_left_out(measure, rows) -> None:
    given = ["99 1 2 3", "- - -", "pose 99", join(rows[0])]
    measure(given, "the sheet has no pose '99'", "no measured value")
    assert read_used() == [rows[0][0]]


@pytest.mark.parametrize(
    ("line", "name", "values"),
    [
        ("1 2 3", "", ["1", "2", "3"]),
        ("1,5 2,5 3", "", ["1.5", "2.5", "3"]),
        ("1.5, 2.5, 3", "", ["1.5", "2.5", "3"]),
        ("1.5,2.5,3", "", ["1.5", "2.5", "3"]),
        ("1,5;2,5;3", "", ["1.5", "2.5", "3"]),
        ("7\t1e-3\t2\t-3", "7", ["1e-3", "2", "-3"]),
        ("1 - 3", "", ["1", "", "3"]),
        ("1 two 3", "", None),
    ],
)
def test_numbers_are_separated_as_people_write_them(line, name, values) -> None:
    assert split_values(line, 3) == (name, values)


@pytest.mark.slow
def test_a_resumed_session_says_what_an_uninterrupted_one_says(measure, rows) -> None:
    whole = measure(map(join, rows[:6])).out.splitlines()[-8:-2]
    shutil.rmtree("session")
    measure(map(join, rows[:3]))
    assert measure(map(join, rows[3:6])).out.splitlines()[-8:-2] == whole


def test_a_row_that_was_cut_off_is_dropped_and_one_without_judgement_is_judged(
    measure, rows
) -> None:
    measure(map(join, rows[:6]))
    journal = Path("session/rows.csv")
    values = wrong(rows[6]).split()
    with journal.open("a") as stream:  # killed before the row was judged, then in the next row
        stream.write(
            f"measured,7,{values[0]},2026-01-01T00:00:00+00:00,{','.join(values[1:])}\nmeas"
        )
    measure([], f"pose {rows[6][0]} does not fit")
    assert journal.read_text().endswith("left out,7,,,,,\n")
    assert read_used() == [row[0] for row in rows[:6]]


def test_a_session_of_another_sheet_and_other_folders_are_refused(measure, rows) -> None:
    measure([join(rows[0])])
    with Path("plan/measurements.csv").open("a") as sheet:
        sheet.write("## changed\n")
    measure([], "another sheet", code=1)
    Path("other").mkdir()
    Path("other/letter.txt").write_text("dear")
    measure([], "other content", words="measure plan -o other", code=1)
    Path("mine").mkdir()
    Path("mine/rows.csv").write_text("a,b\n1,2")  # without an end of its line
    measure([], "other content", words="measure plan -o mine", code=1)
    assert Path("mine/rows.csv").read_text() == "a,b\n1,2"
    Path("file").write_text("x")
    measure([], "other content", words="measure plan -o file", code=1)
    measure([], "--profile belong together", words="measure plan -o s --follow x.txt", code=1)
    document = Path("plan/plan.json").read_text()
    Path("plan/plan.json").write_text(document.replace('"sha256": "', '"sha256": "0'))
    measure([], "has changed since the plan", words="measure plan -o again")
    shutil.copy("plan/measurements.csv", "sheet.csv")
    measure([], "does not name its robot", words="measure sheet.csv -o s", code=1)
    measure([], "no-plan: this measurement file does not", words="measure no-plan -o s", code=1)


def test_a_damaged_line_is_named(measure, rows) -> None:
    measure([join(rows[0])])
    journal = Path("session/rows.csv")
    journal.write_text(journal.read_text().replace("measured,1", "measured,one"))
    measure([], "session/rows.csv:5: this line is not a row of a session", code=1)


def test_a_folder_that_cannot_be_written_is_named(measure, rows) -> None:
    Path("letter").write_text("dear")
    measure([], "cannot write here (not a directory)", words="measure plan -o letter/s", code=1)


def test_a_full_disk_loses_no_row_and_is_named(measure, rows, monkeypatch, capsys) -> None:
    measure(map(join, rows[:2]))
    before, whole = Path("session/rows.csv").read_text(), os.write

    def write_part(descriptor: int, content: bytes) -> int:
        return (
            whole(descriptor, content[:10])
            if content.startswith(b"measured")
            else whole(descriptor, content)
        )

    monkeypatch.setattr(os, "write", write_part)
    monkeypatch.setattr(sys, "stdin", io.StringIO(join(rows[2])))
    assert main(["measure", "plan", "-o", "session"]) == 1
    assert (
        "session/rows.csv: cannot write here (no space left on device)" in capsys.readouterr().err
    )
    monkeypatch.setattr(os, "write", whole)
    assert Path("session/rows.csv").read_text() == before


def test_a_json_document_has_no_dialog_beside_it(measure, rows) -> None:
    document = measure(map(join, rows[:3]), words="measure plan -o session --json").json
    assert (document["rows"], document["used"]) == (3, 3)
    assert document["findings"][0]["code"] == "companion.accuracy"


def test_times_and_gcode_are_shown_where_asked_for(measure, rows) -> None:
    words = "measure plan -o session --minutes 2 --speed 500 --gcode --accuracy 20um"
    printed = measure([], "G53 G1 X", "to the goal of 0.02 mm", " min", words=words)
    assert printed.words.count("G53") == 1


FOLLOW = "measure plan -o session --follow points.txt --profile leica"


def export(rows, newline="\n", decimal=".") -> bytes:
    lines = (" ".join([row[0], *(cell.replace(".", decimal) for cell in row[1:])]) for row in rows)
    return "".join(f"{line}{newline}" for line in lines).encode()


@pytest.mark.parametrize(
    ("newline", "decimal", "more"), [("\n", ".", ""), ("\r\n", ",", " --decimal comma")]
)
def test_rows_of_an_export_are_taken(measure, rows, newline, decimal, more) -> None:
    Path("points.txt").write_bytes(export([["99", "1", "2", "3"], *rows], newline, decimal))
    measure(["quit"], "the sheet has no pose '99'", words=FOLLOW + more)
    assert read_used() == [row[0] for row in rows]


@pytest.mark.slow
def test_an_export_grows_begins_again_and_repeats_rows(rows, monkeypatch, capsys) -> None:
    steps = iter(  # content of the export, and how many rows loopcal then has
        [
            (b"// points\n", 0),
            (export(rows[:2]) + export(rows[2:3])[:9], 2),  # a part of a row
            (export(rows[:3]), 3),
            (export([*rows[:3], rows[2], rows[3]]), 4),  # a row twice
            (export(rows[4:5]), 5),  # a new file
            (b"", 5),  # cut off
            (b"no point at all\n" + export(rows[5:6]), 6),
            (b"", 6),
        ]
    )

    class Instrument:
        """Writes when the dialog reads a line, and gives it time to read the export."""

        def readline(self) -> str:
            step = next(steps, None)
            if step is None:
                return ""
            Path("points.txt").write_bytes(step[0])
            for _ in range(200):
                time.sleep(0.05)
                journal = Path("session/rows.csv")
                if journal.exists() and journal.read_text().count("measured,") == step[1]:
                    time.sleep(0.1)
                    return "quit\n" if step == (b"", 6) else "help\n"
            raise AssertionError(f"not {step[1]} rows")

    monkeypatch.setattr("loopcal.cli.measuring_dialog.POLL", 0.02)
    monkeypatch.setattr(sys, "stdin", Instrument())
    assert main(FOLLOW.split()) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert read_used() == [row[0] for row in rows[:6]]
    assert "exists already, digit for digit" in printed
    assert "points.txt began again" in printed
    assert "does not match the profile" in printed


def test_rows_without_names_belong_to_the_suggested_poses(measure, rows) -> None:
    values = {row[0]: row[1:] for row in rows}
    first = measure([]).words.partition("Command pose ")[2].partition(":")[0]
    Path("points.txt").write_bytes(export([["any", *values[first]]]))
    for _ in range(2):  # once in all, although the export is read again
        measure(["quit"], words=f"{FOLLOW} --by-order")
        assert read_used() == [first]
    assert len(read_csv(Path("session/rows.csv"))) == 2  # measured, used


def test_links_stand_for_the_folder_of_a_session(measure, rows) -> None:
    Path("session").symlink_to("there")
    measure([join(rows[0])])
    assert Path("session").is_symlink()
    assert len(read_csv(Path("there/measurements.csv"))) == 1
    Path("circle").symlink_to("circle")
    measure([], "this symbolic link has no target", words="measure plan -o circle", code=1)


@pytest.mark.slow
def test_two_commands_do_not_measure_into_one_folder(rows) -> None:
    with subprocess.Popen(COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdin is not None
        assert first.stdout is not None
        first.stdout.readline()  # it asks
        second = subprocess.run(COMMAND, input=b"", capture_output=True, check=False)
        assert second.returncode == 1
        assert b"another command measures into this folder" in second.stderr
        first.communicate(b"quit\n")
    assert first.returncode == 0


@pytest.mark.slow
def test_a_killed_command_loses_no_row(measure, rows) -> None:
    with subprocess.Popen(COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        for row in rows[:4]:
            process.stdin.write((join(row) + "\n").encode())
        process.stdin.flush()
        asked = 0
        for line in process.stdout:  # it asks for the fifth row when four are on the disk
            asked += line.startswith(b"Command pose")
            if asked == 5:
                break
        os.kill(process.pid, signal.SIGKILL)
    measure([], "resumed with 4 rows, 4 of them in use")
    assert read_used() == [row[0] for row in rows[:4]]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("tmux") is None, reason="needs tmux")
def test_a_session_in_a_terminal_of_80_columns(rows) -> None:
    name = f"measure-{os.getpid()}"
    tmux = ["tmux", "-L", name]
    words = " ".join([f"cd {Path.cwd()};", "TERM=vt100", "NO_COLOR=1", "LC_ALL=C", *COMMAND])
    subprocess.run([*tmux, "new-session", "-d", "-x", "80", "-y", "24", words], check=True)

    def wait_for(text: str) -> str:
        screen = ""
        for _ in range(100):
            screen = subprocess.run(
                [*tmux, "capture-pane", "-p"], capture_output=True, text=True, check=True
            ).stdout
            if text in " ".join(screen.split()):
                return screen
            time.sleep(0.1)
        raise AssertionError(f"{text!r} is not on the screen:\n{screen}")

    try:
        wait_for("or help:")
        subprocess.run([*tmux, "send-keys", join(rows[0]), "Enter"], check=True)
        screen = wait_for("cannot judge pose")
        while not screen.rstrip().endswith("or help:"):  # it asks for the next row
            screen = wait_for("or help:")
        assert len(screen.rstrip().splitlines()) == 23  # the last answer and question are visible
        subprocess.run([*tmux, "send-keys", "help", "Enter"], check=True)
        wait_for("take the last row back")
    finally:
        subprocess.run([*tmux, "kill-server"], check=False)
    assert "measured,1" in Path("session/rows.csv").read_text()
