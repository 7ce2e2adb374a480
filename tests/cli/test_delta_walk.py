# SPDX-License-Identifier: Apache-2.0
"""A printer owner probes 13 points, types what loopcal prints, and the real bed becomes flat.

The simulated printer is known. Its firmware has other numbers, and its probe has noise. The bed is
judged by what matters: the true height of the nozzle where the firmware believes it at z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from tests.io.test_probe_reports import MARLIN, POINTS, REPRAP, TRUE, probe, write_points

NOISE = 0.02
"""Of the simulated probe [mm]."""
STEP = 0.01
"""Length of a motor step of the Klipper printer [mm]."""
KLIPPER = """\
[printer]
kinematics: delta
delta_radius: 105
[stepper_a]
rotation_distance: 32
microsteps: 16
position_endstop: 300
arm_length: 220
angle: 210
[stepper_b]
rotation_distance: 32
microsteps: 16
angle: 330
[stepper_c]
rotation_distance: 32
microsteps: 16
angle: 90
[delta_calibrate]
radius: 70
"""
IMPORT = {
    "marlin": "m503.gcode --probes report.txt",
    "reprap": "config.g --probes report.txt --probes bed.g",
    "klipper": "printer.cfg",
}


def probe_marlin(robot: lc.Mechanism, truth: lc.Mechanism, noise: np.ndarray) -> None:
    Path("m503.gcode").write_text(MARLIN)
    write_points(POINTS, np.add(probe(robot, truth, POINTS), noise))


def probe_reprap(robot: lc.Mechanism, truth: lc.Mechanism, noise: np.ndarray) -> None:
    heights = np.add(probe(robot, truth, POINTS), noise)
    cells = " ".join(f"{height:.3f}" for height in heights)
    Path("report.txt").write_text(f"G32 bed probe heights: {cells}, mean 0, deviation 0")
    lines = [f"G30 P{i} X{x:.3f} Y{y:.3f} Z-99999" for i, (x, y) in enumerate(POINTS)]
    Path("bed.g").write_text("\n".join(lines) + " S-1\n")


def probe_klipper(robot: lc.Mechanism, truth: lc.Mechanism, noise: np.ndarray) -> None:
    """Write what DELTA_CALIBRATE METHOD=manual saves: steps where the nozzle touches z = 0."""
    heights = np.add(probe(robot, truth, POINTS), noise)
    touched = [[1e-3 * x, 1e-3 * y, 1e-3 * h] for (x, y), h in zip(POINTS, heights, strict=True)]
    steps = 1e3 * lc.inverse(robot, touched).q / STEP
    lines = [
        f"height{i} = 0.0\nheight{i}_pos = {','.join(f'{s:.3f}' for s in row)}"
        for i, row in enumerate(steps)
    ]
    Path("printer.cfg").write_text(KLIPPER + "\n".join(lines) + "\n")


PRINTERS: dict[str, tuple[str, str, Callable]] = {
    "marlin": ("m503.gcode", MARLIN, probe_marlin),
    "reprap": ("config.g", REPRAP, probe_reprap),
    "klipper": ("printer.cfg", KLIPPER, probe_klipper),
}


def compute_bed(robot: lc.Mechanism, truth: lc.Mechanism) -> np.ndarray:
    """Return the true heights [mm] of the nozzle where the firmware believes it at z = 0."""
    axis = 1e-3 * np.linspace(-70.0, 70.0, 9)
    grid = np.array([(x, y, 0.0) for x in axis for y in axis if np.hypot(x, y) < 0.075])
    return 1e3 * lc.forward(truth, lc.inverse(robot, grid).q).T[:, 2, 3]


def type_in(name: str, text: str) -> None:
    """Change the firmware as its owner does: by the printed lines, and nothing else."""
    file, old, _ = PRINTERS[name]
    typed = text
    if name == "klipper":  # each option in its section, in place of the old one
        typed, section = old, ""
        for line in text.splitlines():
            section = line if line.startswith("[") else section
            option = line.partition(":")[0]
            head, body = typed.split(f"{section}\n")
            own, mark, rest = body.partition("\n[")
            kept = [other for other in own.splitlines() if not other.startswith(option)]
            added = [] if line == section else [line]
            typed = "\n".join([head + section, *added, *kept]) + mark + rest
    assert old != typed
    Path(file).write_text(typed)


@pytest.mark.slow
@pytest.mark.parametrize("name", PRINTERS)
def test_typing_what_is_printed_makes_the_real_bed_flat(loopcal, name):
    file, text, write_report = PRINTERS[name]
    Path(file).write_text(text)
    loopcal(f"import {file} --format {name} -o firmware.yaml")
    robot = lc.load_robot("firmware.yaml")
    change = np.array([TRUE.get(parameter, 0.0) for parameter in robot.parameters.names])
    truth = robot.with_values(robot.values + change)
    write_report(robot, truth, NOISE * np.random.default_rng(11).standard_normal(len(POINTS)))
    words = f"import {IMPORT[name]} --format {name} -o printer.yaml --data heights.csv"
    loopcal([*words.split(), "--sigma-height", "0.02mm"])
    page = loopcal("calibrate printer.yaml heights.csv -o run --hold-out 0.4")
    assert "Recommendation: Apply the identified values." in page.out
    assert "opposite sign" not in page.err  # the import knows the sign
    type_in(name, loopcal(["export", "run", "--format", name]).out)
    loopcal(f"import {file} --format {name} -o typed.yaml")
    before, after = compute_bed(robot, truth), compute_bed(lc.load_robot("typed.yaml"), truth)
    assert np.sqrt(np.mean(before**2)) > 0.1  # [mm]
    assert np.sqrt(np.mean(after**2)) < 0.03  # [mm], from eight points with 0.02 mm of noise
    assert np.ptp(after) < np.ptp(before) / 4.0
