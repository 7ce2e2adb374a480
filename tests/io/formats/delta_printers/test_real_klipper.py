# SPDX-License-Identifier: Apache-2.0
"""Klipper itself, Marlin's and RepRapFirmware's formulas judge what loopcal writes for them."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.errors import DataError, FileError
from loopcal.io.formats import FORMATS
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.program_format import ExportSource, ImportOptions
from tests.io.formats.delta_printers.real_klipper import PINS, Printer, install

MM = 1e-3
ROUNDED = 5e-6
"""Motion [mm] by values that are rounded to six decimals: nine of them, up to 5e-7 mm or degrees
each, which are 2e-6 mm at the end of a radius."""
EXACT = 1e-9
"""Difference [mm] of two computations of the same numbers."""


@pytest.fixture(scope="module")
def klipper() -> None:
    """Klipper's package, on the path."""
    install()


DELTA = (
    "[include fans.cfg]\n[mcu]\nserial: x\n[printer]\nkinematics: delta\nmax_velocity: 300\n"
    "delta_radius: 130.25 ; mm\nminimum_z_position: -5\n[delta_calibrate]\nradius: 70\n"
    "[stepper_a]\narm_length = 250\nposition_endstop: 300\nrotation_distance: 40\n"
    + PINS.format(0)
    + "[stepper_b]\nangle: 329.6\nrotation_distance: 40.01\n"
    + PINS.format(1)
    + "[stepper_c]\nrotation_distance: 40\ngear_ratio: 80:40\n"
    + PINS.format(2)
)
SAVED = """
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
#*# [printer]
#*# delta_radius = 131.000000
#*#
#*# [stepper_c]
#*# position_endstop = 300.4
#*# arm_length = 250.3
#*#
#*# [delta_calibrate]
"""
STEPS = np.array([40, 40.01, 20]) / (200 * 16)
"""Length of a step of each tower [mm]."""


def read(path: Path, name: str = "klipper"):
    """Return the robot and the measurements of a file."""
    imported = FORMATS[name].read(path, ImportOptions("printer"))  # type: ignore[misc]
    return build_imported_robot(path, imported), imported.measurements


def disturb(robot: lc.Mechanism, seed: int) -> lc.Mechanism:
    """Return a robot with errors of 0.3 mm and 0.2 degrees, also of what its file fixes."""
    rng = np.random.default_rng(seed)
    scales = [{"angle": 3e-3}.get(d.value, 3e-4) for d in robot.parameters.dimensions]
    return robot.with_values(robot.values + rng.standard_normal(len(scales)) * scales)


def write_delta(folder: Path, end: str = "\n") -> tuple[Path, np.ndarray]:
    """Write a printer.cfg with heights; return it with the steps (n, 3) of its poses."""
    rng, path = np.random.default_rng(1), folder / "printer.cfg"
    steps = np.round(np.array([300, 300, 300]) / STEPS * rng.uniform(0.5, 0.6, (12, 3)), 3)
    steps[:, 1:] = np.round(steps[:, :1] * STEPS[0] / STEPS[1:], 3) + rng.uniform(
        -900, 900, (12, 2)
    )
    lines = [
        f"#*# height{i} = {0.1 * i}\n#*# height{i}_pos = {','.join(f'{s:.3f}' for s in row)}\n"
        for i, row in enumerate(steps)
    ]
    text = (DELTA + SAVED + "".join(lines)).rstrip("\n") + "\n"
    path.write_bytes(text.replace("\n", end).encode())
    (folder / "fans.cfg").write_text("[fan]\npin: PD1\n")
    return path, np.round(steps, 3)


def get_positions(calibration, steps: np.ndarray) -> np.ndarray:
    """Return where Klipper sees the nozzle (n, 3) [mm] at steps below the stops (n, 3)."""
    return np.array([calibration.get_position_from_stable(row) for row in steps.tolist()])


def predict(robot: lc.Mechanism, readings: np.ndarray) -> np.ndarray:
    """Return where loopcal sees the nozzle (n, 3) [mm] at readings (n, 3) [mm]."""
    found = lc.forward(robot, readings * MM)
    assert found.converged.all()
    return found.T[:, :3, 3] / MM


@pytest.mark.slow
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_klipper_moves_as_loopcal_states(klipper, tmp_path, end) -> None:
    path, steps = write_delta(tmp_path, end)
    robot, measured = read(path)
    assert measured is not None
    before = Printer(path).load_kinematics("delta").get_calibration()
    # what loopcal reads is what Klipper reads, whichever part of the file states it
    np.testing.assert_allclose(measured.readings / MM, steps * STEPS, rtol=0, atol=EXACT)
    np.testing.assert_allclose(
        predict(robot, steps * STEPS), get_positions(before, steps), rtol=0, atol=EXACT
    )

    identified = disturb(robot, 2)
    written = tmp_path / "corrected.cfg"
    exported = FORMATS["klipper"].write(ExportSource(identified), path)  # type: ignore[misc]
    written.write_bytes(exported.text.encode())
    printer = Printer(written)
    kinematics = printer.load_kinematics("delta")
    positions = get_positions(kinematics.get_calibration(), steps)
    np.testing.assert_allclose(predict(identified, steps * STEPS), positions, rtol=0, atol=ROUNDED)
    again = read(written)[0]
    np.testing.assert_allclose(predict(again, steps * STEPS), positions, rtol=0, atol=EXACT)
    # heights of DELTA_CALIBRATE
    from klippy.extras.delta_calibrate import DeltaCalibrate  # type: ignore[import-not-found]

    probed = DeltaCalibrate(printer.config.getsection("delta_calibrate")).last_probe_positions
    assert [height for height, _ in probed] == pytest.approx(0.1 * np.arange(12))
    np.testing.assert_array_equal([pos for _, pos in probed], steps)
    # the motors that step (the C code) go where loopcal's inverse kinematics says, from the stops
    points = np.random.default_rng(3).uniform([-60, -60, 0], [60, 60, 60], (20, 3))
    rails = kinematics.rails
    heights = np.array([[r.calc_position_from_coord(p) for r in rails] for p in points.tolist()])
    readings = lc.inverse(again, points * MM).q / MM
    np.testing.assert_allclose(
        np.array(kinematics.abs_endstops) - heights, readings, rtol=0, atol=EXACT
    )
    # and at the stops the nozzle is where Klipper homes
    home = predict(again, np.zeros((1, 3)))[0]
    np.testing.assert_allclose(home, kinematics.home_position, rtol=0, atol=EXACT)


@pytest.mark.slow
def test_klipper_calibrates_to_what_loopcal_identifies(klipper, tmp_path, monkeypatch) -> None:
    """DELTA_CALIBRATE of Klipper and loopcal have the same optimum of the same heights."""
    path = write_delta(tmp_path)[0]
    robot = read(path)[0]
    points = np.random.default_rng(4).uniform([-70, -70, 0], [70, 70, 0.01], (24, 3))
    free = robot.parameters.free  # heights determine no arms
    truth = robot.with_values(np.where(free, disturb(robot, 5).values, robot.values))
    steps = np.round(lc.inverse(truth, points * MM).q / MM / STEPS, 3)
    noise = np.random.default_rng(6).normal(0, 0.02, len(steps))
    lines = [
        f"#*# height{i} = {points[i, 2] + noise[i]:.6f}\n"
        f"#*# height{i}_pos = {','.join(f'{s:.3f}' for s in row)}\n"
        for i, row in enumerate(steps)
    ]
    path.write_text(DELTA + SAVED + "".join(lines))
    robot, measured = read(path)
    assert measured is not None
    fit = lc.calibrate(robot, measured).robot
    printer = Printer(path)
    start = printer.load_kinematics("delta").get_calibration()

    from klippy import mathutil  # type: ignore[import-not-found]
    from klippy.extras.delta_calibrate import DeltaCalibrate  # type: ignore[import-not-found]

    found = []

    def descend(_printer, names, params, error):
        found.append(mathutil.coordinate_descent(names, params, error))
        return found[-1]

    monkeypatch.setattr(mathutil, "background_coordinate_descent", descend)
    calibrate = DeltaCalibrate(printer.config.getsection("delta_calibrate"))
    calibrate.calculate_params(calibrate.last_probe_positions, [])
    own = start.new_calibration(found[0])
    difference = get_positions(own, steps) - predict(fit, steps * STEPS)
    assert np.abs(difference[:, 2]).max() < 1e-3  # [mm], where Klipper's descent ends


ROTARY = (
    "[printer]\nkinematics: rotary_delta\nmax_velocity: 300\nshoulder_radius: 33.9\n"
    "shoulder_height: 412.9\n[delta_calibrate]\nradius: 50\n[stepper_a]\nposition_endstop: 252\n"
    "gear_ratio: 107.000:16, 60:16\nupper_arm_length: 170.000\nlower_arm_length: 320.000\n"
    + PINS.format(0)
    + "[stepper_b]\ngear_ratio: 107.000:16, 60:16\nangle: 150.2\n"
    + PINS.format(1)
    + "[stepper_c]\ngear_ratio: 107.000:16, 60:16\nlower_arm_length: 320.3\n"
    + PINS.format(2)
    + SAVED[: SAVED.index("#*# [printer]")]
    + "#*# [stepper_b]\n#*# position_endstop = 251.7\n"
)
ANGLE = 2 * math.pi / (200 * 16 * 107 / 16 * 60 / 16)
"""Angle of a step of a motor [rad]."""


@pytest.mark.slow
def test_klipper_moves_a_rotary_delta_as_loopcal_states(klipper, tmp_path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(ROTARY)
    robot = read(path)[0]
    steps = np.random.default_rng(1).uniform(2000, 4500, (20, 3))
    own = Printer(path).load_kinematics("rotary_delta").get_calibration()
    places = lc.forward(robot, steps * ANGLE).T[:, :3, 3] / MM
    np.testing.assert_allclose(places, get_positions(own, steps), rtol=0, atol=EXACT)
    # exported with other values of all parameters, in place and as a block to paste
    identified = disturb(robot, 2)
    exported = FORMATS["klipper"].write(ExportSource(identified), path)  # type: ignore[misc]
    path.write_text(exported.text)
    assert "angle: 150.2" not in exported.text
    kinematics = Printer(path).load_kinematics("rotary_delta")
    positions = get_positions(kinematics.get_calibration(), steps)
    wanted = lc.forward(identified, steps * ANGLE).T[:, :3, 3] / MM
    np.testing.assert_allclose(positions, wanted, rtol=0, atol=ROUNDED)
    again = read(path)[0]
    points = np.random.default_rng(3).uniform([-50, -50, 0], [50, 50, 60], (20, 3))
    turns = [[r.calc_position_from_coord(p) for r in kinematics.rails] for p in points.tolist()]
    readings = lc.inverse(again, points * MM).q
    stops = kinematics.get_calibration().abs_endstops
    np.testing.assert_allclose(np.array(stops) - turns, readings, rtol=0, atol=1e-12)
    block = FORMATS["klipper"].write(ExportSource(identified), None)  # type: ignore[misc]
    for line in block.text.splitlines()[4:]:
        if " = " in line:
            assert line.removeprefix("#*# ").replace(" = ", ": ") in exported.text.replace(
                " = ", ": "
            )
    # a delta's numbers do not fit into it, nor its own into a delta's file
    (tmp_path / "delta").mkdir()
    delta, _ = write_delta(tmp_path / "delta")
    for machine, file in ((identified, delta), (read(delta)[0], path)):
        with pytest.raises(FileError):
            FORMATS["klipper"].write(ExportSource(machine), file)  # type: ignore[misc]


@pytest.mark.slow
def test_heights_of_a_rotary_delta_lead_to_its_geometry(klipper, tmp_path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(ROTARY)
    robot = read(path)[0]
    free = robot.parameters.free
    truth = robot.with_values(np.where(free, disturb(robot, 5).values, robot.values))
    assert free.sum() == 4  # as in Klipper: the height of the shoulders, and the end stops
    places = np.random.default_rng(4).uniform([-40, -40, 0], [40, 40, 0.01], (20, 3)) * MM
    steps = lc.inverse(truth, places).q / ANGLE
    probed = "#*# [delta_calibrate]\n" + "".join(
        f"#*# height{i} = {z / MM:.6f}\n#*# height{i}_pos = {','.join(f'{s:.3f}' for s in row)}\n"
        for i, (row, z) in enumerate(zip(steps.tolist(), places[:, 2].tolist(), strict=True))
    )
    path.write_text(ROTARY + probed)
    robot, measured = read(path)
    assert measured is not None
    fit = lc.calibrate(robot, measured).robot
    np.testing.assert_allclose(fit.values, truth.values, rtol=0, atol=2e-6)  # [m, rad]; 0.001 steps


def test_a_motor_without_gear_is_refused_as_by_klipper(tmp_path) -> None:
    path = tmp_path / "printer.cfg"
    probed = "#*# [delta_calibrate]\n#*# height0 = 0.1\n#*# height0_pos = 3000,3000,3000\n"
    path.write_text(
        ROTARY.replace("[stepper_b]\ngear_ratio: 107.000:16, 60:16", "[stepper_b]") + probed
    )
    with pytest.raises(FileError, match=r"'gear_ratio' of \[stepper_b"):
        read(path)


def test_arms_that_do_not_reach_are_refused_with_their_line(tmp_path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(ROTARY.replace("shoulder_height: 412.9", "shoulder_height: 912.9"))
    with pytest.raises(FileError) as refused:
        read(path)
    assert refused.value.code == "files.arms-out-of-reach"
    assert refused.value.line is not None
    path.write_text(ROTARY)
    robot = read(path)[0]
    short = np.where([n.endswith(".length") for n in robot.parameters.names], 0.1, robot.values)
    with pytest.raises(DataError):
        FORMATS["klipper"].write(ExportSource(robot.with_values(short)), None)  # type: ignore[misc]


POLAR = (
    "[printer]\nkinematics: polar\nmax_velocity: 300\n[stepper_bed]\ngear_ratio: 80:16\n"
    + PINS.format(0)
    + "[stepper_arm]\nrotation_distance: {0}\nposition_endstop: {1}\nposition_max: 170\n"
    + PINS.format(1)
    + "[stepper_z]\nrotation_distance: 8\nposition_endstop: 0.5\nposition_max: 200\n"
    + PINS.format(2)
)


@pytest.mark.slow
def test_klipper_moves_a_polar_printer_as_the_page_states(klipper, tmp_path, root) -> None:
    page = (root / "docs" / "controllers.md").read_text("utf-8")
    text = re.search(r"<!-- file: polar.yaml -->\n```yaml\n(.*?)```", page, re.DOTALL)
    assert text is not None
    (tmp_path / "polar.yaml").write_text(text[1])
    robot = lc.load_robot(tmp_path / "polar.yaml")
    identified = robot.with_values(
        robot.values + np.where([n == "arm.y" for n in robot.parameters.names], 0.0, 3e-4)
    )
    values = dict(zip(robot.parameters.names, identified.values / MM, strict=True))
    (tmp_path / "printer.cfg").write_text(
        POLAR.replace("{0}", f"{values['arm.arm.lead']:.9f}").replace(
            "{1}", f"{values['arm.arm.offset']:.9f}"
        )
    )
    kinematics = Printer(tmp_path / "printer.cfg").load_kinematics("polar")
    rng = np.random.default_rng(9)
    bed, steps = rng.uniform(-3, 3, 20), rng.integers(-9000, -1000, 20)
    arm = kinematics.rails[0].get_steppers()[0]
    at_stop, step = kinematics.rails[0].get_homing_info().position_endstop, arm.get_step_dist()
    names = [stepper.get_name() for stepper in kinematics.get_steppers()]
    own = [
        kinematics.calc_position(dict(zip(names, (b, at_stop + k * step, 1.0), strict=True)))
        for b, k in zip(bed.tolist(), steps.tolist(), strict=True)
    ]
    turns = 2 * math.pi * steps / 3200  # of the pulley, from the end stop
    places = lc.forward(identified, np.column_stack([bed, turns, np.full(20, MM)])).T
    np.testing.assert_allclose(places[:, :3, 3] / MM, own, rtol=0, atol=1e-6)


def intersect(centers: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the lower intersection of three spheres, by the plane that two differences span."""
    A = 2 * (centers[1:] - centers[0])
    b = (centers[1:] ** 2).sum(1) - (centers[0] ** 2).sum() - lengths[1:] ** 2 + lengths[0] ** 2
    along = np.cross(A[0], A[1])
    point = np.linalg.lstsq(A, b, rcond=None)[0]
    along /= np.linalg.norm(along) * (1 if along[2] < 0 else -1)
    off = point - centers[0]
    p = off @ along
    return point + along * (-p + math.sqrt(p * p - off @ off + lengths[0] ** 2))


def parse_words(text: str) -> dict[str, dict[str, str]]:
    """Return command -> letter -> text of its word."""
    lines = re.findall(r"^(M\d+) (.*)$", text, re.MULTILINE)
    return {command: dict(re.findall(r"([A-Z])([-\d.:]+)", words)) for command, words in lines}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("marlin", "M665 L250 R130 H300 A0.1 B-0.2 C0.1 X0.1 Y-0.2 Z0\nM666 X-0.1 Y0 Z-0.2\n"),
        ("reprap", "M665 L250:250.2:249.9 R130 H300 X0.1 Y-0.2 Z0\nM666 X-0.1 Y0.3 Z-0.2\n"),
    ],
)
def test_marlin_and_reprapfirmware_move_as_loopcal_states(tmp_path, name, text) -> None:
    """Their published formulas: carriages at their stops are H, less or plus the adjustment, above
    the height that the rods of this tower reach over the center.
    """
    path = tmp_path / "config.g"
    path.write_text(text)
    identified = disturb(read(path, name)[0], 7)
    words = parse_words(FORMATS[name].write(ExportSource(identified), path).text)  # type: ignore[misc]
    number = {letter: float(value) for letter, value in words["M665"].items() if ":" not in value}
    adjusted = np.array([float(words["M666"].get(tower, 0)) for tower in "XYZ"])
    if name == "marlin":
        assert (adjusted <= 0).all()  # a carriage backs off from its stop
        rods = number["L"] + np.array([number.get(letter, 0) for letter in "ABC"])
        stops = number["H"] - adjusted
    else:
        rods = np.array([float(rod) for rod in words["M665"]["L"].split(":")])
        stops = number["H"] + adjusted
    angles = np.radians(np.array([210, 330, 90]) + [number.get(tower, 0) for tower in "XYZ"])
    towers = number["R"] * np.column_stack([np.cos(angles), np.sin(angles)])
    at_stops = stops + np.sqrt(rods**2 - number["R"] ** 2)
    drops = 200 + np.random.default_rng(8).uniform(-20, 20, (15, 3))
    positions = [intersect(np.column_stack([towers, at_stops - drop]), rods) for drop in drops]
    np.testing.assert_allclose(predict(identified, drops), positions, rtol=0, atol=ROUNDED)
