# SPDX-License-Identifier: Apache-2.0
"""
A cable robot that measures itself
==================================

Four lines hold the point of this hanging robot, one more than it needs. So the four motor angles
must agree in every pose, although nobody measured where the point is. This example asks how much of
the robot these angles determine, and what a few measured positions add.
"""

# %%
# Each line has its anchor and a length. The file states ``sigma`` of every motor, so that the
# poses are unknowns of the fit: four angles for three coordinates leave one equation for each
# pose.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/cable_readings.png"
import numpy as np

import loopcal as lc

robot = lc.load_robot("cable-4")
machine = robot.with_values(lc.sample_truth(robot, 1, seed=3)[0])
robot.plot()

# %%
# The motors follow 60 poses. An operator measures the first three positions with a tape, to 1 mm:
# all other poses are measured by nobody.

poses = lc.sample_workspace(robot, 60, seed=1).coordinates
poses[:3] = [[0.0, 0.0, 0.1], [0.3, 0.2, 0.4], [-0.3, 0.1, 0.2]]
tape = lc.Sensor(lc.Position(), lc.Gaussian(np.full(3, 1e-3)), rows=np.arange(3))
data = lc.simulate(machine, poses, lc.Instrument((tape,)), seed=2)

# %%
# First the angles alone, without any measured position. They determine the shape of the robot,
# but neither where its frame is (six combinations) nor its size: a robot of twice the size with
# spools of twice the size has the same motor angles.

angles = lc.Measurements(robot.name, data.readings, (), reading_sigma=data.reading_sigma)
result = lc.identifiability(robot, angles)
print(f"{result.rank} of {result.n_parameters} parameter combinations")
result.plot()

# %%
# Calibrate from angles alone. At poses that were kept out of the fit, the four angles now agree
# with each other to the stated sigma.

report = lc.calibrate(robot, angles, lc.CalibrationOptions(hold_out=0.25))
print(report)
check = lc.compare_with_truth(report.identification, machine.values)
print(f"{check.compared} combinations: chi-square {check.chi_square:.1f} (p = {check.p_value:.2f})")

# %%
report.validation.plot()

# %%
# With the three measured positions, nothing is left open. The anchors are least certain along
# their lines, where an anchor and a length of line act alike.

fit = lc.identify(robot, data)
check = lc.compare_with_truth(fit, machine.values)
print(f"{fit.rank} of {len(fit.names)} parameter combinations")
print(f"{check.compared} combinations: chi-square {check.chi_square:.1f} (p = {check.p_value:.2f})")
fit.plot.correlation()
