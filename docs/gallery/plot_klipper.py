# SPDX-License-Identifier: Apache-2.0
"""
My Klipper delta prints bowls: what belongs in printer.cfg?
===========================================================

``DELTA_CALIBRATE`` has probed thirteen points, and Klipper keeps them in printer.cfg. loopcal reads
this file, finds the numbers that make the bed flat, says how certain they are, and writes them into
a copy of the file. The commands need no Python; here Python simulates the printer and draws.
"""

# %%
# The true printer: its radius is 0.7 mm larger than printer.cfg says, a tower is turned by 0.2
# degrees, and two end stops are off.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/klipper.png"
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import loopcal as lc

folder = Path(tempfile.mkdtemp())
errors = {"radius": 0.7e-3, "tower1.angle": np.radians(0.2)}  # [m, rad]
errors |= {"tower1.stop": -0.2e-3, "tower3.stop": 0.4e-3}
nominal = lc.load_robot("linear-delta")
changes = np.array([errors.get(name, 0.0) for name in nominal.parameters.names])
printer = nominal.with_values(nominal.values + changes)

# %%
# The probe touches the bed at thirteen points, to 0.02 mm. Klipper saves the motor steps of the
# towers below their end stops.

angles = np.radians(np.arange(0, 360, 60))
rings = [35.0 * np.exp(1j * angles), 70.0 * np.exp(1j * (angles + np.pi / 6))]
points = np.concatenate([[0.0], *rings]) * 1e-3
touched = np.random.default_rng(4).normal(0.0, 0.02e-3, 13)
carriages = lc.inverse(printer, np.column_stack([points.real, points.imag, touched])).q
steps = carriages / (40e-3 / (200 * 16))
probes = [
    f"#*# height{i} = 0.0\n#*# height{i}_pos = {a:.3f},{b:.3f},{c:.3f}\n"
    for i, (a, b, c) in enumerate(steps)
]
HEAD = """
[printer]
kinematics: delta
delta_radius: 105
[stepper_a]
arm_length: 220
position_endstop: 300
rotation_distance: 40
microsteps: 16
[stepper_b]
rotation_distance: 40
microsteps: 16
[stepper_c]
rotation_distance: 40
microsteps: 16
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
#*# [delta_calibrate]
"""
(folder / "printer.cfg").write_text(HEAD + "".join(probes))
print("".join(probes[:2]))

# %%
# Read printer.cfg. This is what you type, with ``loopcal`` in front:


def run(command):
    """Run a command of loopcal, and print what it prints."""
    words = [sys.executable, "-m", "loopcal", *shlex.split(command)]
    done = subprocess.run(words, cwd=folder, check=True, capture_output=True, text=True)
    print(done.stdout)


run("import printer.cfg -o printer.yaml --data heights.csv --sigma-height 0.02mm")

# %%
# Calibrate, and keep five points to check the result. The recommendation says whether the new
# numbers are worth typing.

robot = lc.load_robot(folder / "printer.yaml")
heights = lc.load_measurements(folder / "heights.csv", robot)
report = lc.calibrate(robot, heights, lc.CalibrationOptions(hold_out=0.4))
print(report)

# %%
# The bed as the printer sees it, before and after.

report.height_errors.plot()

# %%
# The new numbers, and how far they are from the truth.

table = report.identification.to_frame().set_index("parameter")
true = printer.to_frame().set_index("parameter")["value"]
table["true"], table["error in sd"] = true, (table.estimate - true) / table.sd
columns = ["nominal", "estimate", "plus_minus", "true", "unit", "error in sd"]
print(table[columns].round(3).to_string())

# %%
# Write them into a copy of printer.cfg: everything else in it stays as it is.

lc.save_run(report, folder / "run")
run("export run --format klipper --into printer.cfg -o corrected.cfg")
