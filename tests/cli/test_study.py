# SPDX-License-Identifier: Apache-2.0
"""loopcal study: from a new file to results, and what happens to folders."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from evidence.study_interruption import read_contents
from loopcal.cli.entry_point import main
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.studies.files.store import NAME, open_store
from tests.studies.small_study import CELLS, write_study

ROOT = str(Path(__file__).parents[2])
ONE = "--workers 1"


@pytest.fixture
def loopcal(loopcal):
    """Run a command of studies."""
    return lambda words, *said, **code: loopcal(f"study {words}", *said, **code)


def shrink(file: Path) -> None:
    """Leave few trials and levels in a study file."""
    text = file.read_text().replace("replicates: 1000", "replicates: 6\nblock: 3")
    file.write_text(text.replace("poses: [10, 20, 40]", "poses: [10]"))


def test_new_file_leads_to_results_by_the_commands_that_each_step_names(loopcal, tmp_path) -> None:
    out = loopcal("new study.yaml").out
    assert out.splitlines()[-1] == "Next: loopcal study check study.yaml"
    shrink(tmp_path / "study.yaml")
    out = loopcal("check study.yaml", "4 cells, 24 trials").out
    assert out.splitlines()[-1] == "Next: loopcal study run study.yaml -o FOLDER"
    out = loopcal(f"run study.yaml -o results {ONE}").out
    assert out.splitlines()[-1] == "Next: loopcal study summary results"
    assert "8 of 8 blocks are stored in results: 8 new, 24 trials" in out
    out = loopcal("summary results").out
    for word in ("instrument", "effects", "tracker", "noisier", "position", "[mm]"):
        assert word in out
    rows = list(csv.DictReader((tmp_path / "results" / "summary.csv").open()))
    assert len(rows) == 4
    factors = {"robot", "instrument", "noise", "poses", "errors", "method", "effects"}
    assert factors <= set(rows[0])
    row = rows[0]
    low, median, high = (row[f"position median{part} [m]"] for part in (" low", "", " high"))
    assert float(low) <= float(median) <= float(high)


def test_named_command_has_quotes_where_a_shell_needs_them(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["study", "new", "my study.yaml"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "Next: loopcal study check 'my study.yaml'"


@pytest.mark.parametrize("robot", ["five-bar", "hexapod-42"])
def test_template_is_valid_for_other_robots(loopcal, tmp_path, robot) -> None:
    loopcal(f"new study.yaml --robot {robot}")
    shrink(tmp_path / "study.yaml")
    printed = loopcal("check study.yaml --json")
    assert (printed.err, printed.json["cells"]) == ("", 4)


def test_every_command_prints_json(loopcal, tmp_path) -> None:
    file = write_study(tmp_path, 4, 2).name
    documents = {}
    for words in (
        f"check {file}",
        f"run {file} -o f {ONE}",
        "status f",
        f"extend f --replicates 6 {ONE}",
        "summary f",
        "export f -o trials.csv",
        "replay f 1/5 -o trial",
        "merge f -o g",
    ):
        documents[words.split()[0]] = loopcal(f"{words} --json", code=(0, 2)).json
    assert documents["check"]["trials"] == CELLS * 4
    assert documents["run"]["computed"] == CELLS * 2
    assert documents["status"]["total"] == CELLS * 2
    assert documents["extend"]["computed"] == CELLS
    assert documents["summary"]["cells"][0]["trials"] == 6
    assert documents["export"]["trials"] == CELLS * 6
    assert "verdict" in documents["replay"]
    assert documents["merge"]["new_blocks"] == CELLS * 3
    assert read_contents(tmp_path / "g") == read_contents(tmp_path / "f")


def test_exports_contain_every_trial_with_its_factors(loopcal, tmp_path) -> None:
    from pyarrow import parquet

    file = write_study(tmp_path, 3, 2).name
    loopcal(f"run {file} -o f {ONE}")
    for name in ("trials.csv", "trials.parquet"):
        loopcal(f"export f -o {name}")
    rows = list(csv.DictReader((tmp_path / "trials.csv").open()))
    table = parquet.read_table(tmp_path / "trials.parquet")
    assert len(rows) == table.num_rows == CELLS * 3
    assert [row["trial"] for row in rows[:4]] == ["0", "1", "2", "0"]
    assert [row["method"] for row in rows] == table["method"].to_pylist()
    assert [float(row["position [m]"]) for row in rows] == table["position"].to_pylist()
    assert table.schema.field("position").metadata == {b"unit": b"m"}
    loopcal("export f -o trials.txt", "must end in .csv or .parquet", code=1)


def test_replayed_trial_is_a_normal_run_with_the_numbers_of_the_study(loopcal, tmp_path) -> None:
    file = write_study(tmp_path, 4, 2).name
    loopcal(f"run {file} -o f {ONE}")
    words = "Written to trial, and its inputs to trial-input"
    code = loopcal("replay f 2/3 -o trial", words).code
    data = "trial-input/robot.yaml trial-input/measurements.csv"
    again = main(f"calibrate {data} -o again --method map".split())
    robots = [lc.load_robot(tmp_path / name / "robot.yaml") for name in ("trial", "again")]
    assert again == code
    assert robots[0].values == pytest.approx(robots[1].values, rel=1e-9)
    truth = lc.load_robot(tmp_path / "trial-input" / "truth.yaml")
    error = (robots[0].values - truth.values)[select_free_parameters(truth).places]
    scaled = error / select_free_parameters(truth).tolerance
    stored = lc.StudyResult(tmp_path / "f").read_scores(2, ["parameters"])[3, 0]
    assert np.sqrt(np.mean(scaled**2)) == pytest.approx(stored, rel=1e-6)
    for words in ("9/0", "0/4", "x"):
        err = loopcal(f"replay f {words} -o other", code=1).err
        assert "this study has no" in err or "such as 3/17" in err


def test_folder_in_use_changed_study_other_version_and_two_drivers_are_refused(
    loopcal, tmp_path
) -> None:
    file = write_study(tmp_path, 4, 2)
    start = f"run {file.name} -o f {ONE}"
    loopcal(start)
    loopcal(start, "already contains a study", "Hint: use --resume to continue it", code=1)
    loopcal(f"{start} --resume")
    file.write_text(file.read_text().replace("seed: 3", "seed: 4"))
    loopcal(f"{start} --resume", "seed: 3 -> 4", code=1)
    with open_store(tmp_path / "f") as store:
        loopcal("extend f --replicates 8", "another process computes this study now", code=1)
        loopcal("status f", "computation continues")
        store.connection.execute("PRAGMA user_version = 9")
    for words in ("status f", "summary f", "extend f --replicates 8"):
        loopcal(words, "has format 9", code=1)


@pytest.mark.slow
def test_ctrl_c_leaves_a_folder_that_is_continued(tmp_path) -> None:
    file = write_study(tmp_path, 4000, 5)
    words = [sys.executable, "-m", "loopcal", "study", "run", file.name, "-o", "f"]
    environment = os.environ | {"PYTHONPATH": f"{ROOT}/src:{ROOT}"}
    with subprocess.Popen(
        [*words, "--workers", "2"], cwd=tmp_path, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    ) as driver:  # fmt: skip
        end = time.monotonic() + 60.0
        while not (tmp_path / "f" / NAME).exists() or len(read_contents(tmp_path / "f")) < 2:
            assert time.monotonic() < end
            time.sleep(0.1)
        os.killpg(driver.pid, signal.SIGINT)  # as a terminal does, to the workers, too
        out, err = driver.communicate(timeout=30.0)
    assert (driver.returncode, out) == (1, "")
    stored = len(read_contents(tmp_path / "f"))
    assert f"loopcal: Stopped. f contains {stored} of 3200 blocks" in err
    assert "use --resume to continue" in err
    assert "Traceback" not in err


FULL = """
import os
from loopcal.cli.entry_point import main
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.io.robot.robot_file import load_robot
code = main("study run small.yaml -o disk/f --workers 1".split())
print(code, flush=True)
os.unlink("disk/filler")
print(main("study run small.yaml -o disk/f --workers 1 --resume".split()))
"""


@pytest.mark.slow
def test_study_on_a_full_disk_is_continued_when_there_is_space(tmp_path) -> None:
    write_study(tmp_path, 300, 50)
    (tmp_path / "disk").mkdir()
    mount = "mount -t tmpfs -o size=1m none disk && dd if=/dev/zero of=disk/filler bs=1k count=850"
    probe = subprocess.run(
        ["unshare", "-m", "sh", "-c", mount], cwd=tmp_path, check=False, capture_output=True
    )
    if probe.returncode != 0:
        pytest.skip("no small disk can be mounted here")
    command = f'{mount} 2>/dev/null && exec "$0" -c "$1"'
    words = ["unshare", "-m", "sh", "-c", command, sys.executable, FULL]
    environment = os.environ | {"PYTHONPATH": f"{ROOT}/src:{ROOT}"}
    done = subprocess.run(
        words, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment
    )
    assert done.stdout.splitlines()[0] == "1", done.stdout + done.stderr
    assert "the disk is full" in done.stderr
    assert "Hint: use --resume to continue" in done.stderr
    assert done.stdout.splitlines()[-1] == "0"
    assert "24 of 24 blocks" in done.stdout


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("run small.yaml -o f --cells 11/10", "'11/10' is not a share"),
        ("run small.yaml -o f --workers 0", "--workers"),
        ("run small.yaml -o f --ray --workers 2", "--workers has no effect with --ray"),
        ("run small.yaml -o f --dask tcp://h:1 --ray", "--ray has no effect with --dask"),
        ("run missing.yaml -o f", "this study file does not exist"),
        ("status small.yaml", "this is not the folder of a study"),
        ("summary nowhere", "this is not the folder of a study"),
        ("sumary f", "did you mean 'summary'"),
    ],
)
def test_wrong_use_gets_a_sentence(loopcal, tmp_path, words, sentence) -> None:
    write_study(tmp_path)
    loopcal(words, sentence, code=1)
    assert not (tmp_path / "f").exists()


def test_share_of_a_job_and_scores_of_the_summary_are_chosen(loopcal, tmp_path) -> None:
    file = write_study(tmp_path, 4, 2).name
    for part in (1, 2):
        loopcal(f"run {file} -o part-{part} --cells {part}/2 {ONE}")
    loopcal("status part-1", "4 of 8 blocks")
    loopcal("merge part-1 part-2 -o whole")
    out = loopcal("summary whole --score condition --score rank", "condition").out
    assert "position" not in out
    loopcal("summary whole --score positon", "did you mean 'position'", code=1)


PER_LEG = """\
format: 1
title: Leg by leg
replicates: {replicates}
block: {block}
robots: [{robot}]
methods: [per-leg]
scores: {{held_out: 3}}
"""


def test_failed_trials_lead_to_the_reason_in_check_summary_and_replay(loopcal, tmp_path) -> None:
    file = write_study(
        tmp_path, 4, 2, f"poses: [5]\n{PER_LEG}".replace("{robot}", "hexapod-42")
    ).name
    out = loopcal(f"check {file}", "1 cell, 4 trials").out
    advice = "Replay one of these trials to find the reason."
    assert "Failed trials: 2 of 2. loopcal refused the trial" in " ".join(out.split())
    assert advice in " ".join(out.split())
    loopcal(f"run {file} -o f {ONE}")
    loopcal("summary f", advice)
    loopcal("replay f 0/1 -o trial", "5 poses are too few for the 7 parameters of a leg", code=1)
    assert not (tmp_path / "trial").exists()


def test_replay_says_where_the_method_of_the_trial_is_not_that_of_the_calibration(
    loopcal, tmp_path
) -> None:
    file = write_study(tmp_path, 2, 2, PER_LEG.replace("{robot}", "hexapod-42")).name
    loopcal(f"run {file} -o f {ONE}")
    _, out, err = loopcal("replay f 0/1 -o trial", code=(0, 2))
    assert "used per-leg, a published method" in " ".join((out + err).split())


def test_joined_folders_of_two_studies_are_both_named(loopcal, tmp_path) -> None:
    for name, replicates in (("small", 4), ("large", 6)):
        text = (tmp_path / write_study(tmp_path, replicates, 2).name).read_text()
        seed = "seed: 3" if name == "small" else "seed: 4"
        (tmp_path / "s.yaml").write_text(text.replace("seed: 3", seed))
        loopcal(f"run s.yaml -o {name} {ONE} --cells 1/4")
    loopcal(
        "merge small large -o both", "small: the study of this folder differs from large", code=1
    )


def test_durations_have_two_digits_in_the_unit_that_is_printed() -> None:
    from loopcal.cli.commands.study_commands import round_duration

    words = [round_duration(seconds) for seconds in (0.0123, 19.4, 340.0, 7000.0, 500000.0)]
    assert words == ["0.012 s", "19 s", "5.7 min", "1.9 h", "140 h"]
