# SPDX-License-Identifier: Apache-2.0
"""Undetermined combinations of parameters count by what they do to poses of the workspace."""

import re
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal import Gaussian, Instrument, Pose, Sensor
from loopcal.apply.calibration_report import Verdict
from loopcal.apply.inspection import analyze_identifiability
from loopcal.findings import Quantity
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.model import Mechanism
from tests.diagnose.test_suggestions import TRANSLATIONAL
from tests.robot_texts import load_text

TOLERANCES = "tolerances: {lengths: {sd: 0.1}, angles: {sd: 0.02}}\n"


def build_complete(name: str, folder: Path) -> Mechanism:
    """Return a machine with its complete error model, in which errors of passive joints and of what
    follows them have the same effect.
    """
    if name == "tsai-3upu":
        head, rest = TRANSLATIONAL.split("    errors:")
        text = head + TOLERANCES + rest[rest.index("home:") :]
        text = text.replace("controlled:", "error_model: complete\ncontrolled:")
    elif name == "arm-6r":
        text = list_shipped_robots()[name].read_text("utf-8")
        text = re.sub(r" errors: \[[^\]]*\]", " errors: [x, y, z, rx, ry, rz, offset]", text)
    else:
        text = list_shipped_robots()[name].read_text("utf-8")
        text = text.replace("home:", "error_model: complete\nspherical: axes\nhome:")
    path = folder / f"{name}.yaml"
    path.write_text(text)
    return load_robot(path)


def measure_poses(robot: Mechanism, count: int, unknown: tuple[str, ...] = ()) -> Measurements:
    """Return full poses of a machine with drawn errors, in a known or an unknown frame."""
    tracker = Sensor(Pose(unknown=unknown), Gaussian(np.array([2e-5] * 3 + [1e-5] * 3)))
    truth = robot.with_values(sample_truth(robot, 1, 3)[0])
    poses = lc.sample_workspace(robot, count, 1).coordinates
    return lc.simulate(truth, poses, Instrument((tracker,)), 1, controller=robot)


@pytest.mark.parametrize(
    ("name", "ranks", "unknown", "count"),
    [
        ("tsai-3upu", {60}, (), 0),
        ("3-prs", {60}, ("frame",), 6),
        # two of 58 directions act by products of drawn errors only: 2e-12 to 7e-11 of the largest
        # singular value in six drawn machines, about the tolerance of 1e-11; the next has 4e-16
        ("ru-pus-prs", {56, 57, 58}, (), 0),
        pytest.param("arm-6r", {30}, ("frame",), 6, marks=pytest.mark.slow),
    ],
)
def test_combinations_that_change_no_pose_do_not_lower_the_verdict(
    name, ranks, unknown, count, tmp_path
):
    robot = build_complete(name, tmp_path)
    data = measure_poses(robot, 60, unknown)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    free = len(report.identification.names)
    rank = report.identification.rank + count
    assert rank in ranks
    (harmless,) = [f for f in report.findings if f.code == "workflow.frame-freedoms"]
    assert (harmless.data["still"], harmless.data["count"]) == (free - rank, count)
    assert "workflow.undetermined-combinations" not in {f.code for f in report.findings}
    assert report.verdict is Verdict.CALIBRATED
    for suggestion in report.suggestions or ():
        assert str(suggestion.combination.meaning) != "No pose depends on it"


GRIPPER = """
format: 1
family: limbs
name: gripper
source: ours
units: {length: mm, angle: deg}
freedoms: [x, y, rz]
controlled: [x]
drives:
  motor: {reads: angle, stroke: [-20, 100], unknown: [offset], angle: {sd: 0.3}}
bodies: [{name: disc}, {name: leftjaw}]
limbs:
  - name: shaft
    to: disc
    ending: rigid
    chain: [{joint: R, name: shaft, actuated: motor, start: 45}]
  - name: right
    ending: rigid
    chain: [{joint: P, name: rail, at: [0, 5, 0], axis: x, start: 60}]
  - name: left
    to: leftjaw
    ending: rigid
    chain: [{joint: P, name: rail, at: [0, -5, 0], axis: x, start: -60}]
    errors: [RAIL]
  - {name: rodr, on: disc, tip: [20, 0, 0], ending: distance, length: 50, errors: [ROD]}
  - {name: rodl, on: disc, to: leftjaw, tip: [-20, 0, 0], ending: distance, length: 50}
home: {x: 60, y: 5}
workspace: {x: [50, 66]}
""".replace("ROD", "{of: rod, shift: [length], tolerance: {sd: 0.1}}")


@pytest.mark.parametrize(("axes", "count"), [("x", 0), ("y", 1), ("x, y", 1)])
def test_what_moves_the_other_finger_is_not_harmless(axes, count, tmp_path):
    """Along its axis a rail shifts nothing. Across it, the finger moves and its travel changes."""
    path = tmp_path / "gripper.yaml"
    path.write_text(
        GRIPPER.replace("RAIL", f"{{of: rail, shift: [{axes}], tolerance: {{sd: 0.1}}}}")
    )
    robot = load_robot(path)
    report = analyze_identifiability(robot, measure_poses(robot, 20))
    findings = {f.code: f for f in report.summary}
    combinations = report.analysis.unidentifiable
    harmless = findings["identifiability.frames-only"]
    assert harmless.data["still"] == len(combinations) == len(axes.split(","))
    assert ("harmless" in str(harmless)) is not bool(count)
    moved = findings.get("identifiability.moves-bodies")
    assert (moved and dict(moved.data)) == (
        {"count": count, "bodies": ("leftjaw",)} if count else None
    )
    meanings = [getattr(c.meaning, "code", "") for c in combinations]
    assert meanings.count("identifiability.only-bodies-move") == count


# Two slides. The direction of the second one shows only where it moves: about z it is an error of
# squareness, and about x it turns the plane of motion, which is a motion of the base frame.
STAGES = """
format: 1
family: stages
name: table
units: {length: mm, angle: deg}
controlled: [x, y]
stages:
  - name: a
    joint: {kind: P, axis: x, stroke: [-100, 100], errors: [offset], length: {sd: OFFSET}}
  - name: b
    joint: {kind: P, axis: y, stroke: [-100, 100], errors: [rx, rz], platform_errors: [rx, rz]}
tolerances: {angles: {sd: 0.02}}
workspace: {x: [-100, 100], y: [-100, 100]}
"""


def measure_along_x(folder: Path, offset: float) -> tuple[Mechanism, Measurements]:
    """Return the table, the offset of whose first slide has this spread [mm], and full poses
    with the second slide at rest.
    """
    path = folder / "table.yaml"
    path.write_text(STAGES.replace("OFFSET", str(offset)))
    robot = load_robot(path)
    poses = np.stack([np.linspace(-0.1, 0.1, 20), np.zeros(20)], axis=1)
    sensor = Sensor(Pose(), Gaussian(np.array([2e-6] * 6)))
    return robot, lc.simulate(robot, poses, Instrument((sensor,)), 1)


@pytest.mark.parametrize("offset", [0.1, 1e6])
def test_size_of_a_change_outside_the_measured_region_is_stated(offset, tmp_path):
    """With directions (t, -t) / sqrt 2 of frame and platform, and t = 0.02 deg, the slide moves by
    t y / sqrt 2 along x. The best rotation takes half of it to x, so t rms(y) / 2 is left. A very
    wide tolerance of another parameter hides nothing.
    """
    summary = analyze_identifiability(*measure_along_x(tmp_path, offset)).summary
    (changing,) = [f for f in summary if f.code == "identifiability.changes-poses"]
    assert set(changing.data["names"]) == {"b.rz", "b.platform.rz"}
    assert (changing.data["count"], changing.data["where"]) == (1, "the workspace")
    (size,) = changing.data["sizes"]
    assert isinstance(size, Quantity)
    expected = np.radians(0.02) * 100.0 / np.sqrt(3.0) / 2.0
    assert size.unit == "mm"
    assert size.value == pytest.approx(expected, rel=0.25)  # 24 drawn poses: rms within 8 %, 3 sd
    (harmless,) = [f for f in summary if f.code == "identifiability.frames-only"]
    assert (harmless.data["count"], harmless.data["still"]) == (1, 0)


def test_verdict_is_lowered_by_what_changes_poses_outside_the_measured_region(tmp_path):
    robot, data = measure_along_x(tmp_path, 0.1)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.5))
    assert "workflow.undetermined-combinations" in {f.code for f in report.findings}
    assert report.verdict is Verdict.RESERVATIONS


def test_plan_states_which_undetermined_combinations_are_harmless(tmp_path):
    robot = build_complete("3-prs", tmp_path)
    tracker = Sensor(Pose(unknown=("frame",)), Gaussian(np.array([2e-5] * 3 + [1e-5] * 3)))
    plan = lc.plan(robot, Instrument((tracker,)), 20, options=lc.PlanOptions(n_candidates=60))
    (harmless,) = [f for f in plan.findings if f.code == "identifiability.frames-only"]
    assert (harmless.data["still"], harmless.data["count"]) == (33, 6)  # at nominal values
    assert "identifiability.changes-poses" not in {f.code for f in plan.findings}


SLIDE = """
format: 1
family: limbs
name: slide
units: {length: mm, angle: deg}
freedoms: [x]
controlled: [x]
drives: {q: {reads: length, stroke: [-50, 50], compliance: 1.0e-4, unknown: [offset, backlash,
  compliance], length: {sd: 0.1}, compliances: {sd: 2.0e-5}}}
conditions: {force.x: {range: [0, 500]}, temperature: {reference: 20, range: [15, 25]}}
couplings: {grow: {of: length, sum: {slide.growth: 1}, condition: temperature, slope: 0.01,
  unknown: [slope], slopes: {sd: 0.002}}}
limbs:
  - {name: slide, ending: rigid, chain: [{joint: P, name: way, axis: x, actuated: q},
     {joint: P, name: growth, axis: x}]}
workspace: {x: [-40, 40]}
"""


def test_what_shows_only_under_load_heat_or_reversal_is_not_harmless(tmp_path: Path) -> None:
    robot = load_text(tmp_path, SLIDE)
    data = measure_poses(robot.with_conditions({"force.x": 0.0, "temperature": 20.0}), 8)
    found = analyze_identifiability(robot, data).summary
    (changing,) = (f for f in found if f.code == "identifiability.changes-poses")
    assert set(changing.data["names"]) == {"q.backlash", "q.compliance", "grow.slope"}
    # 0.1 mm / 2, 2e-5 mm/N over 0 to 500 N, and 0.002 mm/K over 5 K to both sides
    expected = np.sqrt(0.05**2 + (0.02 * 500 / np.sqrt(3e3)) ** 2 / 1e3 + 0.01**2 / 3)
    assert changing.data["sizes"][0].value == pytest.approx(expected, rel=0.2)
    assert not any(f.code == "identifiability.frames-only" for f in found)
