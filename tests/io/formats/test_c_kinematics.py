# SPDX-License-Identifier: Apache-2.0
"""The exported C file computes what loopcal does: its test compares 50 poses and derivatives."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.io.formats.c_kinematics import write
from loopcal.io.formats.program_format import ExportSource
from tests.robot_texts import load_text
from tests.zoo import ROBOTS

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror")
DRIVES = """
drives:
  q1: {reads: length, period: 5, sin1: 0.02, cos1: 0.01, sin2: 0.005, cos2: -0.003}
  q2: {reads: length, curve: 0.3, gain: 1.001, offset: 0.2, stroke: [-60, 60]}
  q3: {reads: length, interpolation: cubic, table: [[-60, 0.1], [-9, -0.05], [30, 0.08], [60, 0]]}
  q4: {reads: length, table: [[-60, 0.1], [0, 0], [60, 0.2]], interpolation: linear}
"""

FOUR_ARMS = """
format: 1
family: limbs
name: four-arms
units: {length: mm, angle: deg}
freedoms: [x, y, rz]
controlled: [x, y, yaw]
actuators:
  q: {reads: angle, stroke: [60, 200], sigma: 0.01, unknown: [offset], angle: {sd: 0.1}}
limbs:
  - name: leg
    chain:
      - {joint: R, name: motor, at: [300, 0, 0], axis: z, actuated: q, start: 129}
ELBOW
    attach: [75, 0, 0]
    copies: {count: 4}
workspace: {x: [-50, 50], y: [-50, 50], yaw: [-15, 15]}
"""
ROD = "    tip: [180, 0, 0]\n    ending: distance\n    length: 180"
ELBOW = """      - {joint: R, name: elbow, at: [180, 0, 0], axis: z, start: 90}
    tip: [180, 0, 0]
    ending: ball"""


def compile_and_run(text: str, folder: Path, *options: str, compiler: str = "gcc") -> str:
    """Return what the test of a C file prints; it ends with 0."""
    source, program = folder / "kinematics.c", folder / "kinematics"
    source.write_text(text, "utf-8")
    command = [compiler, "-O1", *FLAGS, "-DKINEMATICS_TEST", *options, source, "-o", program, "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    ran = subprocess.run([program], capture_output=True, text=True, check=False, timeout=60)
    assert ran.returncode == 0, ran.stdout
    return ran.stdout


def draw_machine(robot: lc.Mechanism, seed: int = 1) -> lc.Mechanism:
    """Return a robot with errors of half its expected spread."""
    spread = np.nan_to_num(robot.parameters.tolerance)
    errors = 0.5 * spread * np.random.default_rng(seed).standard_normal(len(spread))
    return robot.with_values(robot.values + np.where(robot.parameters.free, errors, 0.0))


def export_text(robot: lc.Mechanism) -> str:
    """Return the C file of a robot."""
    return write(ExportSource(robot, {}, {}), None).text


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_a_shipped_robot_with_errors_agrees(name: str, tmp_path: Path) -> None:
    printed = compile_and_run(export_text(draw_machine(lc.load_robot(name))), tmp_path)
    assert printed.startswith("50 poses, 0 failed")


def test_every_term_of_a_transmission_agrees(tmp_path: Path) -> None:
    shipped = (Path(lc.__file__).parent / "robots" / "hexapod-42.yaml").read_text("utf-8")
    robot = draw_machine(load_text(tmp_path, shipped + DRIVES))
    assert compile_and_run(export_text(robot), tmp_path).startswith("50 poses, 0 failed")


def test_the_command_writes_a_file_that_both_compilers_accept(tmp_path: Path) -> None:
    assert main(["export", "five-bar", "-o", str(tmp_path / "model.c")]) == 0
    text = (tmp_path / "model.c").read_text("utf-8")
    for compiler in filter(shutil.which, ("gcc", "clang")):
        assert "0 failed" in compile_and_run(text, tmp_path, compiler=compiler)


CALLER = """
#define KINEMATICS_DECLARATIONS
#include "kinematics.c"
#include <math.h>
#include <stdio.h>
#include <string.h>
int main(void)
{
    static const double wanted[4][6] = {
        {0, 0, 9, 0, 0, 0}, {0, 0, NAN, 0, 0, 0}, {0, 0, 0.2, 0, 0, 0}, {0, 0, INFINITY, 0, 0, 0}};
    double readings[6] = {7, 7, 7, 7, 7, 7}, pose[12] = {7};
    kinematics_state s, before;
    int i, j;
    memset(&s, 0, sizeof s);
    kinematics_home(&s);
    before = s;
    for (i = 0; i < 4; i++) {
        int status = kinematics_inverse(wanted[i], &s, readings);
        printf("%d %d %d\\n", status, memcmp(&s, &before, sizeof s) == 0, readings[5] == 7);
        before = s;
    }
    for (i = 0; i < 2; i++) {
        for (j = 0; j < 6; j++)
            readings[j] = i ? NAN : 90.0 * (j == 0);
        printf("%d %d %d\\n", kinematics_forward(readings, &s, pose) != KINEMATICS_OK,
               memcmp(&s, &before, sizeof s) == 0, pose[0] == 7);
    }
    return 0;
}
"""


def test_a_call_that_fails_says_so_and_leaves_state_and_output(tmp_path: Path) -> None:
    (tmp_path / "kinematics.c").write_text(export_text(lc.load_robot("hexapod-42")), "utf-8")
    (tmp_path / "caller.c").write_text(CALLER.replace("\\\\", "\\"), "utf-8")
    units = [tmp_path / "kinematics.c", tmp_path / "caller.c"]
    command = ["gcc", *FLAGS, *units, "-o", tmp_path / "caller", "-lm"]
    subprocess.run(command, check=True)
    printed = subprocess.run([tmp_path / "caller"], capture_output=True, text=True, check=True)
    # a hexapod at 9 m is reachable: its rods have no ends
    assert printed.stdout.splitlines() == ["0 0 0", "1 1 0", "0 0 0", "1 1 0", "1 1 1", "1 1 1"]


def test_more_drives_than_freedoms_agree_or_are_refused(tmp_path: Path) -> None:
    robot = load_text(tmp_path, FOUR_ARMS.replace("ELBOW", ROD))
    assert "0 failed" in compile_and_run(export_text(robot), tmp_path)
    with pytest.raises(lc.LoopcalError, match="more drives than freedoms"):
        export_text(load_text(tmp_path, FOUR_ARMS.replace("ELBOW", ELBOW)))
