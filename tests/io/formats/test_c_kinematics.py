# SPDX-License-Identifier: Apache-2.0
"""The exported C file computes what loopcal does: its test compares 50 poses and derivatives."""

import ctypes
import re
import shutil
import subprocess
from pathlib import Path
from textwrap import indent

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.io.core.yaml_file import format_yaml, parse_yaml
from loopcal.io.formats.c_kinematics import fill_template, list_movable, write
from loopcal.io.formats.program_format import ExportSource
from loopcal.units import Dimension
from tests.mechanism.actuation.test_couplings import BELT, PINION
from tests.mechanism.actuation.test_summed_drives import CELL, THIRD
from tests.over_constrained import EXECHON
from tests.robot_texts import load_text
from tests.zoo import ROBOTS, load_cached_robot

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


def compile_and_run(text: str, folder: Path, compiler: str = "gcc") -> str:
    """Return what the test of a C file prints; it ends with 0. Compiled by -Og it runs as fast as
    by -O1, and the hexapods whose time counts have all warnings of -O2.
    """
    source, program = folder / "kinematics.c", folder / "kinematics"
    source.write_text(text, "utf-8")
    command = [compiler, "-Og", *FLAGS, "-DKINEMATICS_TEST", source, "-o", program, "-lm"]
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


def add_terms(name: str, folder: Path) -> lc.Mechanism:
    """Return a shipped robot whose first drive has an unknown gain, harmonics and a table."""
    path = Path(lc.__file__).parent / "robots" / f"{name}.yaml"
    content = dict(parse_yaml(path.read_text("utf-8"), path, "robot file").content)
    drive = next(a for a in load_cached_robot(name).actuators if a.reference is None)
    key = "actuators" if "actuators" in content else "drives"
    drives = dict(content.get(key, {}))
    own = next((n for n in drives if drive.name.startswith(n)), drive.name)
    kind, unit = ("length", 1e-3) if drive.dimension is Dimension.LENGTH else ("angle", np.pi / 180)
    low, high = (round(float(end) / unit, 6) for end in drive.stroke or (-1.0, 1.0))
    known = {"reads": kind, "stroke": [low, high], **drives.get(own, {})}
    added = {"unknown": ["sin1", "cos1"], "interpolation": "cubic", "length": {"sd": 0.01}}
    if "radius" not in known:  # of a spool, which gives a length in place of a gain
        added = {"unknown": ["gain", "sin1", "cos1"], "interpolation": "cubic"}
        added |= {"ratio": {"sd": 0.001}, kind: {"sd": 0.01}}
    added |= {"period": 0.1 * (high - low), "sin1": 0.002, "cos2": -0.001}
    added["table"] = [[low, 0.01], [0.5 * (low + high), -0.01], [high, 0.02]]
    drives[own] = known | added
    return load_text(folder, format_yaml(content | {key: drives}))


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_shipped_robot_with_errors_agrees(name: str, compiler: str, tmp_path: Path) -> None:
    """As drawn, and with terms of a drive, which the drive of a triangle cannot have."""
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    robots = [load_cached_robot(name)]
    if compiler == "gcc" and name != "solar-tracker":
        robots.append(add_terms(name, tmp_path))
    for robot in robots:
        printed = compile_and_run(export_text(draw_machine(robot)), tmp_path, compiler=compiler)
        assert printed.startswith("50 poses, 0 failed")
        # [m, 1], also of a large machine
        assert float(re.findall(r"at most (\S+) of poses", printed)[0]) < 1e-12


TIMED = """
#include "kinematics.c"
#undef main
#include <time.h>
int main(void)
{
    double readings[KINEMATICS_READINGS], pose[12], seconds[2], least[2] = {1.0, 1.0};
    int turn, n, k;
    for (turn = 0; turn < 200; turn++) {
        kinematics_state s;
        for (k = 0; k < 2; k++) {
            clock_t begin = clock();
            kinematics_home(&s);
            for (n = 0; n < 4 * TESTS; n++)
                if (k ? kinematics_forward(TEST_READINGS[n % TESTS], &s, pose)
                      : kinematics_inverse(TEST_COORDINATES[n % TESTS], &s, readings))
                    return 1;
            seconds[k] = (double)(clock() - begin) / CLOCKS_PER_SEC / (4 * TESTS);
            least[k] = seconds[k] < least[k] ? seconds[k] : least[k];
        }
    }
    printf("%.2f %.2f", 1e6 * least[0], 1e6 * least[1]);
    return 0;
}
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "hexapod-42",
        "hexapod-octahedral",
        "hexapod-nategh-agheli",
        "hexapod-elastic",
        "6-pus",
        "6-rus",
    ],
)
def test_a_hexapod_takes_microseconds_from_pose_to_pose_of_its_workspace(
    name: str, tmp_path: Path
) -> None:
    """Of the processor, on one core, from a state anywhere in the workspace."""
    (tmp_path / "kinematics.c").write_text(
        export_text(draw_machine(load_cached_robot(name))), "utf-8"
    )
    (tmp_path / "timed.c").write_text(TIMED, "utf-8")
    options = ["-O2", *FLAGS, "-DKINEMATICS_TEST", "-Dmain=test", "timed.c", "-o", "timed", "-lm"]
    subprocess.run(["gcc", *options], cwd=tmp_path, check=True)
    ran = subprocess.run([tmp_path / "timed"], capture_output=True, text=True, check=True)
    inverse, forward = map(float, ran.stdout.split())
    assert inverse < 10.0  # [us] measured: 3 to 7
    assert forward < 30.0  # [us] measured: 7 to 11


def test_every_term_of_a_transmission_agrees(tmp_path: Path) -> None:
    shipped = (Path(lc.__file__).parent / "robots" / "hexapod-42.yaml").read_text("utf-8")
    robot = draw_machine(load_text(tmp_path, shipped + DRIVES))
    assert compile_and_run(export_text(robot), tmp_path).startswith("50 poses, 0 failed")


def test_the_command_writes_a_file_that_passes_its_test(tmp_path: Path) -> None:
    assert main(["export", "five-bar", "-o", str(tmp_path / "model.c")]) == 0
    assert "0 failed" in compile_and_run((tmp_path / "model.c").read_text("utf-8"), tmp_path)


def test_a_compiler_of_cpp_accepts_the_file_and_links_it_from_c(tmp_path: Path) -> None:
    robot = lc.load_robot("excavator")
    (tmp_path / "kinematics.c").write_text(fill_template(robot, list_movable(robot)), "utf-8")
    for language, source in (("c", "kinematics.c"), ("c++", "caller.cpp")):
        call = "int main() { kinematics_state s; kinematics_home(&s); }"
        head = '#define KINEMATICS_DECLARATIONS\n#include "kinematics.c"\n'
        (tmp_path / "caller.cpp").write_text(head + call, "utf-8")
        command = ["gcc", "-x", language, "-c", source, "-o", f"{language}.o"]
        subprocess.run(command, cwd=tmp_path, check=True)
    subprocess.run(["gcc", "c.o", "c++.o", "-lm"], cwd=tmp_path, check=True)
    cpp = ["gcc", "-x", "c++", "-Wall", "-Wextra", "-Werror", "-c", "kinematics.c"]
    subprocess.run(cpp, cwd=tmp_path, check=True)


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


LEAST_SQUARES = EXECHON.replace("family: limbs", "family: limbs\nclosure: least-squares")


@pytest.mark.parametrize("text", [LEAST_SQUARES, BELT, PINION], ids=["exechon", "belt", "pinion"])
def test_loops_that_stay_open_agree(text: str, tmp_path: Path) -> None:
    """Readings hold while the gaps are minimized, and lead to the coordinates."""
    robot = draw_machine(load_text(tmp_path, text))
    assert lc.forward(robot, lc.inverse(robot, robot.home[None]).q).residual[0] > 1e-6
    assert compile_and_run(export_text(robot), tmp_path).startswith("50 poses, 0 failed")


TENDONS = """format: 1
family: limbs
name: tendons
units: {length: m, angle: rad}
freedoms: [x, y, rz]
controlled: [x, y]
drives:
  t1: {reads: length, sigma: 1e-5, radius: {q1: 0.02}}
  t2: {reads: length, sigma: 3e-5, radius: {q1: -0.018, q2: 0.015}, unknown: [radius.q2], radii: {sd: 1e-4}}
  t3: {reads: length, sigma: 1e-5, radius: {q1: -0.017, q2: -0.016}}
limbs:
  - name: arm
    ending: rigid
    chain:
      - {joint: R, name: a, axis: z, actuated: q1, start: 0.3}
      - {joint: R, name: b, at: [0.3, 0, 0], axis: z, actuated: q2, start: 1}
    tip: [0.25, 0, 0]
home: {x: 0.33, y: 0.34, yaw: 1.4}
workspace: {x: [0.25, 0.4], y: [0.25, 0.4]}
"""  # noqa: E501


def test_redundant_sums_agree_where_readings_contradict_each_other(tmp_path: Path) -> None:
    robot = draw_machine(load_text(tmp_path, TENDONS))
    assert compile_and_run(export_text(robot), tmp_path).startswith("50 poses, 0 failed")
    library = Library(fill_template(robot, []), tmp_path)
    q = lc.inverse(robot, robot.home[None]).q[0] + [2e-4, -1e-4, 3e-4]
    wanted = lc.forward(robot, q[None])
    status, reached = library.call("forward", q, 12)
    assert (status, wanted.residual[0] > 1e-5) == (0, True)
    assert np.abs(reached[9:] - wanted.T[0, :3, 3]).max() < 1e-9


def test_a_stage_after_loops_that_stay_open_is_closed(tmp_path: Path) -> None:
    """The wrist of a Tricept on the head of an Exechon machine."""
    shipped = (Path(lc.__file__).parent / "robots" / "tricept.yaml").read_text("utf-8")
    head, wrist = shipped.split("  - name: head\n    family: limbs\n")
    keys = EXECHON[EXECHON.index("controlled:") : EXECHON.index("workspace:")]
    own = "  - name: head\n    family: limbs\n    closure: least-squares\n" + indent(keys, "    ")
    wrist = wrist[wrist.index("  - name: w1") :]
    wrist = re.sub(r"^(home|fixed|workspace):.*\n", "", wrist, flags=re.M)
    robot = draw_machine(load_text(tmp_path, head + own + wrist))
    assert lc.forward(robot, lc.inverse(robot, robot.home[None]).q).residual[0] > 1e-6
    assert compile_and_run(export_text(robot), tmp_path).startswith("50 poses, 0 failed")


class Library:
    """The compiled functions of a C file; `state` is the home pose at first."""

    def __init__(self, text: str, folder: Path) -> None:
        (folder / "kinematics.c").write_text(text, "utf-8")
        command = ["gcc", *FLAGS, "-shared", "-fPIC", "-Og", "kinematics.c", "-o", "kinematics.so"]
        subprocess.run([*command, "-lm"], cwd=folder, check=True)
        self.functions = ctypes.CDLL(str(folder / "kinematics.so"))
        self.state = ctypes.create_string_buffer(100_000)
        self.functions.kinematics_home(self.state)

    def call(self, name: str, given: np.ndarray, size: int) -> tuple[int, np.ndarray]:
        """Return the status and the `size` numbers that a function gives, NaN where it fails."""
        numbers, out = np.ascontiguousarray(given, float), np.full(size, np.nan)
        pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (numbers, out)]
        function = getattr(self.functions, f"kinematics_{name}")
        return function(pointers[0], self.state, pointers[1]), out

    def set_parameters(self, values: np.ndarray) -> None:
        numbers = np.ascontiguousarray(values, float)
        self.functions.kinematics_set_parameters(numbers.ctypes.data_as(ctypes.c_void_p))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm-6r", "3-prs", "core-xy", "par4", "pentapod", "excavator"])
def test_parameters_can_change_without_compiling(name: str, tmp_path: Path) -> None:
    robot = load_cached_robot(name)
    places = list_movable(robot)
    library = Library(fill_template(robot, places), tmp_path)
    values, own = robot.values.copy(), draw_machine(robot).values
    values[places] = own[places]
    sample = lc.sample_workspace(robot.with_values(values), 10, 1)
    library.set_parameters(values[places])
    for q, pose in zip(sample.solution.q, sample.solution.T, strict=True):
        status, reached = library.call("forward", q, 12)
        assert status == 0
        assert np.abs(reached[:9] - pose[:3, :3].ravel()).max() < 1e-12
        assert np.abs(reached[9:] - pose[:3, 3]).max() < 1e-12 * max(1.0, robot.size)


def test_a_file_whose_parameters_move_no_link_compiles(tmp_path: Path) -> None:
    robot = lc.load_robot("core-xy")
    gain = robot.parameters.names.index("z.gain")
    library = Library(fill_template(robot, [gain]), tmp_path)
    library.set_parameters(np.array([1.5]))
    home = lc.inverse(robot, robot.home[None]).q[0]
    assert abs(library.call("forward", home, 12)[1][11] - 0.15) < 1e-12


@pytest.mark.parametrize("workspace", ["", "workspace: {x: [900, 901], y: [900, 901]}\n"])
def test_without_a_workspace_that_is_reached_poses_are_around_home(
    workspace: str, tmp_path: Path
) -> None:
    text = (Path(lc.__file__).parent / "robots" / "five-bar.yaml").read_text("utf-8")
    robot = load_text(tmp_path, re.sub(r"^workspace:.*\n", workspace, text, flags=re.M))
    with pytest.raises(lc.MechanismError, match="workspace"):
        lc.sample_workspace(robot, 1)
    assert compile_and_run(export_text(robot), tmp_path).startswith("50 poses, 0 failed")


def test_a_steep_cam_agrees(tmp_path: Path) -> None:
    """Newton's method alone does not end from its flat part."""
    shipped = (Path(lc.__file__).parent / "robots" / "hexapod-42.yaml").read_text("utf-8")
    points = "[[-75, -60], [-70, -50], [-60, 50], [75, 60]]"
    drive = f"{{reads: length, gain: 0, table: {points}, interpolation: linear}}"
    robot = load_text(tmp_path, f"{shipped}drives: {{q1: {drive}}}\n")
    assert compile_and_run(export_text(robot), tmp_path).startswith("50 poses, 0 failed")


def test_a_pose_that_no_reading_gives_has_a_status(tmp_path: Path) -> None:
    """The screw turns back before its leg is as long as the pose needs."""
    shipped = (Path(lc.__file__).parent / "robots" / "hexapod-42.yaml").read_text("utf-8")
    robot = load_text(tmp_path, shipped + "drives: {q1: {reads: length, curve: -20}}\n")
    library = Library(export_text(robot), tmp_path)
    before = library.state.raw
    for height, expected in ((0.4, 1), (0.23, 0)):
        assert before == library.state.raw
        status, q = library.call("inverse", np.array([0, 0, height, 0, 0, 0]), 6)
        assert status == expected
        assert np.isfinite(q).all() == (expected == 0)
        solved = lc.inverse(robot, np.array([[0, 0, height, 0, 0, 0]]))
        assert solved.converged[0] == (expected == 0)


def test_terms_without_an_input_in_the_file_are_named() -> None:
    exported = write(ExportSource(lc.load_robot("hexapod-elastic"), {}, {}), None)
    (finding,) = exported.findings
    assert "q1.compliance" in str(finding)
    assert write(ExportSource(lc.load_robot("warm-delta"), {}, {}), None).findings == ()


def test_a_stage_with_redundant_sums_agrees(tmp_path: Path) -> None:
    readings = "h: {reads: length}\n      k: {reads: length}"
    robot = draw_machine(load_text(tmp_path, CELL.replace(THIRD, readings)))
    assert compile_and_run(export_text(robot), tmp_path).startswith("50 poses, 0 failed")
