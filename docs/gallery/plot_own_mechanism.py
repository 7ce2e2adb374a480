# SPDX-License-Identifier: Apache-2.0
"""
My own mechanism, which no program knows
========================================

A desktop plotter moves its pen with two slides and two rods, as a planar parallel robot. No program
has a model of it. Its description takes thirty lines: chains of joints and how each one ends. From
this loopcal derives kinematics, parameters and calibration, without a line of code.
"""

# %%
# Two slides run along x at y = 0 and y = 300 mm. Each pushes a rod, and both rods meet in the
# pen. ``errors`` and ``unknown`` name what may differ from the drawing: where each slide is, how
# far it is tilted, how long its rod is, and the zero and the scale of each drive.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/own_mechanism.png"
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import loopcal as lc

DESCRIPTION = """
format: 1
family: limbs
name: plotter
units: {length: mm, angle: deg}
freedoms: [x, y]
controlled: [x, y]
drives:
  left: &drive
    reads: length
    stroke: [-200, 200]
    unknown: [offset, gain]
    length: {sd: 0.3}
    ratio: {sd: 0.001}
  right: *drive
limbs:
  - name: lower
    chain: [{joint: P, name: slide, axis: x, actuated: left}]
    ending: distance
    length: 260
    errors: &errors
      - {of: slide, shift: [y], tolerance: {sd: 0.2}}
      - {of: slide, tilt: [rz], tolerance: {sd: 0.1}}
      - {of: rod, shift: [length], tolerance: {sd: 0.2}}
  - name: upper
    chain: [{joint: P, name: slide, at: [0, 300, 0], axis: x, actuated: right}]
    ending: distance
    length: 260
    errors: *errors
home: {x: 212.37, y: 150}
workspace: {x: [130, 290], y: [80, 220]}
"""
file = Path(tempfile.mkdtemp()) / "plotter.yaml"
file.write_text(DESCRIPTION)
robot = lc.load_robot(file)
print(robot)

# %%
# A planar robot is drawn in its plane, at home.

robot.plot()

# %%
# How far is the pen from where it cannot be controlled? The sheet of paper is well inside.

sheet = lc.sample_workspace(robot, 200, seed=1)
print(f"{100 * sheet.reachable_share:.0f} % of the stated workspace is reachable")

# %%
# A scanner reads where the pen drew 40 crosses, to 20 um. The sheet lies in the scanner somehow,
# so its frame is unknown: two coordinates and an angle. It lies flat, so the other three are
# stated.

machine = robot.with_values(lc.sample_truth(robot, 1, seed=6)[0])
scanner = lc.Component(("x", "y"), unknown=("frame",), frame="scanner")
crosses = lc.Instrument((lc.Sensor(scanner, lc.Gaussian(np.full(2, 20e-6))),))
setup = {"scanner.x": 0.012, "scanner.y": -0.007, "scanner.rz": np.radians(0.6)}
poses = sheet.coordinates[:40]
data = lc.simulate(machine, poses, crosses, seed=2, nuisance_values=setup)
flat = tuple(lc.StatedValue(f"scanner.{name}") for name in ("z", "rx", "ry"))
data = replace(data, stated_values=flat)

report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
print(report)

# %%
report.validation.plot()

# %%
# The truth, in standard deviations of the estimate, and what a scan cannot determine.

check = lc.compare_with_truth(report.identification, machine.values)
print(f"{check.compared} combinations: chi-square {check.chi_square:.1f} (p = {check.p_value:.2f})")
report.identification.plot.parameters()
