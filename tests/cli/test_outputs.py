# SPDX-License-Identifier: Apache-2.0
"""Commands overwrite no file unasked, and write all of their files or none."""

import json
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.io.core.text_file import write_text
from loopcal.io.robot.robot_file import find_robot_file

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42"
TARGETS = "pose,x [mm],y [mm],z [mm],roll [deg],pitch [deg],yaw [deg]\nhome,0,0,200,0,0,0\n"


@pytest.fixture
def loopcal(loopcal):
    """Run a command line in a folder with a robot and data."""
    shutil.copy(find_robot_file("hexapod-42"), "robot.yaml")
    shutil.copy(EXAMPLE / "measurements.csv", "data.csv")
    Path("pp.csv").write_text(TARGETS)
    Path("old.csv").write_text("mine\n")
    Path("old.png").write_text("mine\n")

    return loopcal


def read_all_files() -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in Path().rglob("*") if path.is_file()}


IS_INPUT, IS_NAMED_TWICE, EXISTS, NO_FOLDER = (
    "is also an input of this command",
    "two outputs",
    "this file exists",
    "folder nodir does not exist",
)
REFUSED = {
    "simulate robot.yaml -o robot.yaml": IS_INPUT,
    "simulate robot.yaml -o robot.yaml --force": IS_INPUT,
    "simulate robot.yaml --poses pp.csv -o ./pp.csv --force": IS_INPUT,
    "simulate robot.yaml -o new.csv --truth robot.yaml --force": IS_INPUT,
    "simulate robot.yaml -o new.csv --truth ./new.csv": IS_NAMED_TWICE,
    "simulate robot.yaml -o old.csv": EXISTS,
    "simulate robot.yaml -o new.csv --truth old.csv": EXISTS,
    "simulate robot.yaml -o new.csv --truth nodir/t.yaml": NO_FOLDER,
    "compensate robot.yaml pp.csv -o pp.csv --force": IS_INPUT,
    "compensate robot.yaml pp.csv -o robot.yaml --force": IS_INPUT,
    "compensate robot.yaml pp.csv -o old.csv": EXISTS,
    "check robot.yaml --plot old.png": EXISTS,
    "identifiability robot.yaml data.csv --fix-unidentifiable -o robot.yaml --force": IS_INPUT,
    "export robot.yaml --format csv -o robot.yaml --force": IS_INPUT,
    "new gough -o a.yaml --measurements nodir/x.csv": NO_FOLDER,
    "new 3-prs -o old.csv": EXISTS,
    "new gough -o a.yaml --measurements a.yaml": IS_NAMED_TWICE,
}


@pytest.mark.parametrize("words", REFUSED)
def test_output_that_would_overwrite_a_file_is_refused_before_writing(loopcal, words) -> None:
    before = read_all_files()
    loopcal(words, REFUSED[words], code=1)
    assert read_all_files() == before


AT_ONCE = {
    "simulate robot.yaml -o new.csv --truth truth.yaml": {"new.csv", "truth.yaml"},
    "new 3-prs -o new.yaml": {"new.yaml", "robot.schema.json"},
    "check robot.yaml --plot new.png": {"new.png"},
    "example hexapod-42 -o folder": {"folder"},
    "board -o board.yaml": {"board.pdf", "board.svg", "board.yaml"},
}


@pytest.mark.forks
@pytest.mark.parametrize(
    "words",
    # the last one needs the extra `camera`, which the clean environment of .ci/native lacks
    [*list(AT_ONCE)[:-1], pytest.param([*AT_ONCE][-1], marks=pytest.mark.slow)],
)
def test_of_two_commands_that_write_the_same_at_once_one_is_told(loopcal, words) -> None:
    before = {*Path().iterdir()}
    assert sorted(run_at_once(words.split(), 2)) == [0, 1]
    assert {str(path) for path in {*Path().iterdir()} - before} == AT_ONCE[words]


def run_at_once(words: list[str], count: int) -> list[int]:
    """Run a command line in processes that begin together; return their exit codes."""
    gate, opened = os.pipe()
    processes = []
    for _ in range(count):
        processes.append(os.fork())
        if processes[-1] == 0:
            code = 70
            try:
                os.close(opened)
                os.read(gate, 1)  # returns when the last process has closed the other end
                code = main(words)
            finally:
                os._exit(code)
    os.close(gate)
    os.close(opened)
    return [os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) for process in processes]


def test_force_replaces_a_file_that_is_not_an_input(loopcal) -> None:
    loopcal("simulate robot.yaml -o old.csv --force")
    assert Path("old.csv").read_text() != "mine\n"
    loopcal("compensate robot.yaml pp.csv -o old.csv --force")
    assert "note status" in Path("old.csv").read_text()
    loopcal("new 3-prs -o old.csv --force")
    assert "family: 3-prs" in Path("old.csv").read_text()


@pytest.mark.slow
def test_run_folder_used_as_input_is_not_replaced(loopcal) -> None:
    loopcal("calibrate robot.yaml data.csv -o run")
    before = read_all_files()
    for words in (
        "run/robot.yaml data.csv -o run --force",
        "robot.yaml pp.csv -o run --force --prior run",
    ):
        loopcal(f"calibrate {words}", "would remove the input", code=1)
    loopcal("compensate run pp.csv -o run/robot.yaml --force", IS_INPUT, code=1)
    assert read_all_files() == before


def test_pipe_is_not_replaced_even_with_force(loopcal) -> None:
    os.mkfifo("pipe")
    Path("link").symlink_to("pipe")
    for name in ("pipe", "link"):
        for words in (
            f"simulate robot.yaml -o {name} --force",
            f"new gough -o new.yaml --measurements {name} --force",
        ):
            loopcal(words, "this is a device or a pipe", code=1)
        with pytest.raises(lc.FileError, match="this is a device or a pipe"):
            write_text(name, "text")
    assert stat.S_ISFIFO(os.lstat("pipe").st_mode)
    assert Path("link").is_symlink()
    assert not Path("new.yaml").exists()


def test_force_on_a_symbolic_link_writes_its_target(loopcal) -> None:
    Path("folder").mkdir()
    Path("folder/real.csv").write_text("mine\n")
    Path("link.csv").symlink_to("folder/real.csv")
    Path("new.csv").symlink_to("folder/later.csv")
    loopcal("simulate robot.yaml -o link.csv", EXISTS, code=1)
    for link, real in (("link.csv", "folder/real.csv"), ("new.csv", "folder/later.csv")):
        loopcal(f"simulate robot.yaml -o {link} --force")
        assert Path(link).is_symlink()
        assert "pose,q1" in Path(real).read_text()
        assert not Path(real).is_symlink()
    assert sorted(path.name for path in Path("folder").iterdir()) == ["later.csv", "real.csv"]


def test_circular_and_broken_links_are_refused(loopcal) -> None:
    Path("circle").symlink_to("circle")
    Path("lost").symlink_to("nodir/file")
    for name, sentence in (
        ("circle", "this symbolic link has no target"),
        ("lost", "does not exist"),
    ):
        loopcal(f"simulate robot.yaml -o {name} --force", sentence, code=1)
    loopcal("compensate robot.yaml circle -o new.csv", code=1)
    loopcal(f"plan robot.yaml -o {300 * 'n'}", "name too long", code=1)


PRINTER = """[printer]
kinematics: delta
delta_radius: 130.25
[stepper_a]
step_distance: 0.0125
position_endstop: 250
arm_length: 269
[stepper_b]
step_distance: 0.0125
[stepper_c]
step_distance: 0.0125
[delta_calibrate]
radius: 50
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# [delta_calibrate]
#*# height0 = 0.1
#*# height0_pos = 20000.000,20000.000,20000.000
#*# height1 = 0.2
#*# height1_pos = 20010.000,20000.000,20000.000
"""


def test_import_with_a_failed_calibration_changes_no_file(loopcal) -> None:
    """Two heights are too few for the six parameters."""
    Path("printer.cfg").write_text(PRINTER)
    before = read_all_files()
    for words in ("-o printer.yaml --data heights.csv", "-o old.csv --data heights.csv --force"):
        command = f"import printer.cfg {words} --corrected corrected.cfg"
        loopcal(command, "2 equations", code=1)
        assert read_all_files() == before


def test_template_of_a_kind_that_compares_poses_explains_their_names(loopcal) -> None:
    loopcal("new gough -o a.yaml --measurements m.csv --kind separation")
    assert "name them in the column pose as a;b and leave its" in Path("m.csv").read_text()
    loopcal("new gough -o b.yaml --measurements n.csv --kind position")
    assert "compares two poses" not in Path("n.csv").read_text()


@pytest.mark.skipif(os.name == "nt", reason="a working folder cannot be removed there")
def test_removed_working_folder_is_named_as_the_cause(loopcal, tmp_path, monkeypatch) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    robot = find_robot_file("five-bar")
    for words in ("plan {} -o plan", "simulate {} -o data.csv", "check {}"):
        said = loopcal(words.format(robot), code=1).err
        assert said.startswith("loopcal: the working folder has disappeared. Change to a folder")


REMOVE = """
import os, sys
def remove(event, given):
    if event == "open" and str(given[0]).endswith("five-bar.yaml") and os.path.isdir(sys.argv[1]):
        os.rmdir(sys.argv[1])
sys.addaudithook(remove)
from loopcal.cli.entry_point import main
sys.exit(main("plan five-bar -o plan".split()))
"""


@pytest.mark.skipif(os.name == "nt", reason="a working folder cannot be removed there")
def test_working_folder_that_is_removed_while_a_command_runs_is_the_cause(tmp_path) -> None:
    """It was called a symbolic link without a target."""
    (gone := tmp_path / "gone").mkdir()
    words = [sys.executable, "-c", REMOVE, str(gone)]
    done = subprocess.run(words, cwd=gone, capture_output=True, text=True, check=False)
    sentence = "loopcal: the working folder has disappeared. Change to a folder that exists.\n"
    assert (done.returncode, done.stderr) == (1, sentence)


def test_folder_that_refuses_new_entries_is_not_called_missing(loopcal) -> None:
    if not Path("/proc/self").is_dir():
        pytest.skip("needs a file system in which nothing can be made")
    said = loopcal("simulate five-bar -o /proc/data.csv", code=1).err
    assert "does not exist" not in said


PLAN = "plan hexapod-nategh-agheli -o out"


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("calibrate hexapod-42 data.csv -o out --hold-out 0.25", "result.json"),
        (f"{PLAN} --poses 30 --hold-out 0 --candidates 40", "plan.json"),
        (f"{PLAN} --measure plane-line --groups 9 --points 6", "plan.json"),
        ("regularize hexapod-42 data.csv -o out", "curves.json"),
    ],
)
def test_printed_document_is_that_of_the_folder(loopcal, words, name) -> None:
    printed = loopcal(f"{words} --json").json
    written = json.loads(Path("out", name).read_text("utf-8"))
    assert name in written.pop("files")
    assert printed == written
    assert printed["made_by"]["command"] == ["loopcal", *words.split(), "--json"]
    assert next(iter(printed)) == "format"
