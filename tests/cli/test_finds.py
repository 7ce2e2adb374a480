# SPDX-License-Identifier: Apache-2.0
"""Inputs at which random inputs (tools/fuzz) found a traceback, a warning or a wrong answer: the
smallest that shows it, and the right answer.
"""

import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import click
import numpy as np
import pytest

import loopcal as lc
from loopcal.diagnose.conventions.misfit import guess_frames
from loopcal.diagnose.error_frames import fit_frames
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.io.robot.robot_file import find_robot_file
from loopcal.measure.kinds.position import Position
from tests.diagnose.test_conventions import simulate_data
from tools.fuzz.commands import list_commands
from tools.fuzz.study_corpus import POSES, STUDY

DATA = """\
# kind: {kind}
# noise: {noise}
pose,q1 [mm],q2 [mm],q3 [mm],{columns}
"""
POSITION = DATA.format(
    kind="position", noise="{x: 20 um, y: 20 um, z: 20 um}", columns="x [mm],y [mm],z [mm]"
)
ROWS = "a,180,190,200,1,2,3\nb,190,180,200,1,2,3\n"
SEPARATION = DATA.format(kind="separation", noise="{separation: 20 um}", columns="separation [mm]")
TRIPOD = Path(find_robot_file("3-prs")).read_text("utf-8")
SAMPLES = Path(__file__).parents[2] / "examples" / "cable-robot" / "samples.json"
EXPORTS = Path(__file__).parents[2] / "examples" / "exports"
LIMB = '<link name="{0}"/><joint name="{0}j" type="revolute"><parent link="base"/><child link="{0}"/><axis xyz="0 0 1"/></joint>'  # noqa: E501
URDF = f"<robot name='r'><link name='base'/>{LIMB.format('a')}{LIMB.format('b')}</robot>"


FINDS = {
    "study of a robot file that cannot be read": (
        "study new study.yaml --robot mine.yaml",
        {"mine.yaml": "format: 1\nfamily: none\n"},
        "loopcal: mine.yaml",
    ),
    "kind that is a list": (
        "identifiability linear-delta d.csv",
        {"d.csv": POSITION.replace("kind: position", "kind: [position]") + ROWS},
        "d.csv:1: ['position'] is not a kind of measurement",
    ),
    "places of different length": (
        "identifiability linear-delta d.csv",
        {"d.csv": "# places: [[1 mm, 2 mm, 3 mm], [1 mm]]\n# targets: [a, b]\n" + POSITION + ROWS},
        "'places' must be a list of numbers, or of lists of equal length",
    ),
    "kind without a measured value": (
        "validate linear-delta d.csv",
        {"d.csv": SEPARATION + "a,180,190,200,\nb,190,180,200,\n"},
        "Fill in the measured values",
    ),
    "tilt beyond half a turn": (
        "check robot.yaml",
        {"robot.yaml": TRIPOD.replace("theta: [0, 35]", "theta: [650, 750]")},
        "the workspace of theta runs to 13.09 rad; a tilt is above 0 and at most 180 degrees",
    ),
    "known position of 1e308 mm": (
        "import s.json --format hangprinter -o new.yaml",
        {"s.json": SAMPLES.read_text("utf-8").replace("-0.72", "-1e308", 1)},
        "'xyz_of_samp' contains a number above 1e+09. Correct it",
    ),
    "output of no study": (
        "reproduce -o out",
        {},
        "--output has no effect without the name of a study",
    ),
    "anchor that is used again": (
        "check robot.yaml",
        {"robot.yaml": "a: &x 1\nb: &x 2\nc: *x\n"},
        "robot.yaml: this file has no format",
    ),
    "key that is a mapping in a list": (
        "check robot.yaml",
        {"robot.yaml": "format: 1\nlegs:\n  ? [{a: 1}]\n  : 2\n"},
        "robot.yaml:3: a key is a list or a mapping. Write text there",
    ),
    "key that an alias makes a mapping": (
        "check robot.yaml",
        {"robot.yaml": "format: 1\nlegs: &x {a: 1}\n*x : 2\n"},
        "robot.yaml:3: a key is a list or a mapping. Write text there",
    ),
    "format of times that states the year twice": (
        "import e.txt --profile p.yaml -o new.csv",
        {
            "e.txt": (EXPORTS / "six-dof.txt").read_text("utf-8"),
            "p.yaml": (EXPORTS / "six-dof.yaml").read_text("utf-8").replace("%S'", "%S %Y'"),
        },
        "format' is '%Y-%m-%d %H:%M:%S %Y', which is not a format of times",
    ),
    "target whose name no column can have": (
        "import e.txt --profile p.yaml -o new.csv",
        {
            "e.txt": (EXPORTS / "tracker-points.txt").read_text("utf-8"),
            "p.yaml": (EXPORTS / "tracker-points.yaml").read_text("utf-8").replace("SMR2", "'[a'"),
        },
        "the measured value '[a.x' is not a valid name of a column",
    ),
    "measurements with such a target": (
        "identifiability linear-delta d.csv",
        {"d.csv": "# targets: [a, 'b]']\n" + POSITION + ROWS},
        "the measured value 'b].x' is not a valid name of a column",
    ),
    "closure of a list": (
        "import r.urdf --closures c.yaml -o new.yaml",
        {"r.urdf": URDF, "c.yaml": "closed_loop: [[[aj], bj]]\ntype: ['6d']\nname_mot: [aj]\n"},
        "must be the names of two frames",
    ),
    "repeatability of poses that are measured once": (
        "repeatability linear-delta d.csv",
        {"d.csv": POSITION + ROWS},
        "loopcal: linear-delta and d.csv: Repeatability needs several visits",
    ),
    "frame that no robot has": (
        "new gough -o new.yaml --frames position",
        {},
        "loopcal: gough: an unknown frame is 'position'",
    ),
    "frame without a family": (
        "new --report-facts facts.yaml --joints base --frames x,tip",
        {},
        "loopcal: --frames: an unknown frame is 'x', but must be one of",
    ),
    "sheet without its names of poses": (
        "fill linear-delta s.csv e.txt --profile spatial-analyzer -o new.csv",
        {
            "e.txt": "A, G, 1_T, 1, 2, 3\n",
            "s.csv": POSITION.replace("pose,", "") + "180,190,200,,,\n",
        },
        "s.csv:3: no column 'pose', to join the points of an export with. Add it\n",
    ),
}
"""Case -> a command line, the files that it reads, and what it says."""


@pytest.mark.parametrize(("command", "files", "says"), FINDS.values(), ids=FINDS)
def test_input_found_at_random_has_its_answer(loopcal, tmp_path, command, files, says) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text, "utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loopcal(command, says, code=1)
    assert {path.name for path in tmp_path.iterdir()} == set(files)


def test_link_to_itself_is_refused_as_an_output(loopcal, tmp_path) -> None:
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    loopcal("new limbs -o loop.yaml", "loop.yaml: this symbolic link has no target", code=1)


def test_paths_that_the_system_does_not_open_state_what_is_wrong(loopcal, tmp_path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    (tmp_path / "file").touch()
    for path, says in (
        ("a", "a symbolic link that leads back to itself"),
        ("b/c.csv", "a symbolic link that leads back to itself"),
        ("file/c.csv", "part of its path is a file"),
    ):
        for command in (["compensate", "linear-delta", path], ["validate", "linear-delta", path]):
            printed = " ".join(loopcal(command, code=1).err.split())
            assert says in printed
            assert "permissions" not in printed


def test_document_of_a_result_folder_is_never_replaced_by_a_file(loopcal, tmp_path) -> None:
    (tmp_path / "run").mkdir()
    document, other = tmp_path / "run/result.json", tmp_path / "run/mine.json"
    document.write_text('{"files": {"robot.yaml": "0123"}}', "utf-8")
    other.write_text('{"files": 3}', "utf-8")
    before = document.read_bytes()
    words = ["export", "five-bar", "--format", "json", "--force", "-o"]
    loopcal([*words, str(document)], "whose folder needs it", code=1)
    assert document.read_bytes() == before
    loopcal([*words, str(other)])


NUMBERS = [
    (name, option.type)
    for name, command in list_commands().items()
    for option in command.params
    if isinstance(option.type, click.types.IntParamType | click.types.FloatParamType)
]


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e400", "", "1,000", "1 000", "½"])
def test_what_is_no_number_is_refused_as_no_number_by_every_option(text) -> None:
    assert len(NUMBERS) > 40
    for name, kind in NUMBERS:
        with pytest.raises(click.BadParameter) as caught:
            kind.convert(text, None, None)
        said = caught.value.message
        assert re.search(r"not a (valid (integer|number|share)|finite number)\.|[<>]", said), name
        assert "None" not in said


def test_summary_of_a_study_is_written_whole_or_not_at_all(loopcal, tmp_path) -> None:
    (tmp_path / "study.yaml").write_text(STUDY.replace("robot.yaml", "five-bar"), "utf-8")
    (tmp_path / "poses.csv").write_text(POSES, "utf-8")
    loopcal("study run study.yaml -o results --quick --workers 1")
    before = {path.name for path in (tmp_path / "results").iterdir()}
    (tmp_path / "results/summary.csv").mkdir()
    loopcal("study summary results", "results/summary.csv: this is a folder", code=1)
    assert {path.name for path in (tmp_path / "results").iterdir()} == before | {"summary.csv"}


def test_store_that_cannot_be_made_is_named_by_the_folder_of_its_study(tmp_path) -> None:
    (tmp_path / "study.yaml").write_text(STUDY.replace("robot.yaml", "five-bar"), "utf-8")
    (tmp_path / "poses.csv").write_text(POSES, "utf-8")
    run = 'ulimit -f 2 && exec "$0" -m loopcal study run study.yaml -o out --quick --workers 1'
    done = subprocess.run(
        ["sh", "-c", run, sys.executable],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(lc.__file__).parents[1])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "loopcal: out/study.sqlite: the disk is full" in done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"study.yaml", "poses.csv"}


def test_noise_that_no_fit_survives_is_no_warning(loopcal, tmp_path) -> None:
    text = STUDY.replace("robot.yaml", "five-bar").replace("more: {noise: 2", "more: {noise: 1e308")
    (tmp_path / "study.yaml").write_text(text, "utf-8")
    (tmp_path / "poses.csv").write_text(POSES, "utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loopcal("study check study.yaml --quick", "Failed trials: 4 of 4")


def test_readings_that_reach_no_pose_in_any_interpretation_are_undecided() -> None:
    robot = lc.load_robot("hexapod-octahedral")
    kind = Position(targets=("a", "b", "c"), unknown=("frame", "targets"))
    data = simulate_data("hexapod-octahedral", kind, n=8)
    near, start, size = guess_frames(
        select_free_parameters(robot), data, np.stack([data.readings + 1e3, data.readings - 1e3])
    )
    assert (near.shape, len(start), size.shape) == ((0,), 0, (0,))


def test_motions_that_move_nothing_fit_nothing() -> None:
    robot = lc.load_robot("linear-delta")
    fit = fit_frames(robot, robot.home[None], np.zeros((12, 2)))
    assert fit.solution.shape == (12, 6)
    assert not fit(np.ones((1, 6, 3))).any()


INTERRUPTED = """
import sys


class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "click":
            raise KeyboardInterrupt


sys.meta_path.insert(0, Interrupt())
from loopcal.__main__ import run

sys.exit(run())
"""


def test_ctrl_c_while_modules_are_imported_prints_no_traceback() -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "loopcal: stopped.\n")
