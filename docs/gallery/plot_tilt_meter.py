# SPDX-License-Identifier: Apache-2.0
"""
A tripod head with a tilt meter
===============================

A 3-PRS tripod moves in z and tilts its platform. An electronic level on the platform measures two
angles against gravity, without any reference frame: how the level is mounted and the direction of
gravity relative to the base are unknowns. Angles alone cannot determine lengths, so a dial gauge
adds the height.
"""

# %%
# The level has a standard deviation of 5 urad, the gauge one of 2 um.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/tilt_meter.png"
import numpy as np

import loopcal as lc

robot = lc.load_robot("3-prs")
machine = robot.with_values(lc.sample_truth(robot, 1, seed=5)[0])
robot.plot()

# %%
level = lc.Sensor(
    lc.Inclination(sensor="level", unknown=("mounting", "gravity")),
    lc.Gaussian(np.array([5e-6, 5e-6])),
)
gauge = lc.Sensor(lc.Component(("z",)), lc.Gaussian(np.array([2e-6])))
poses = lc.sample_workspace(robot, 60, seed=1).coordinates
setup = {"level.rx": np.radians(0.4), "level.rz": np.radians(1.5), "gravity.u": np.radians(-0.1)}

# %%
# The level alone, and the level with the gauge: which share of each expected spread is left?

for name, sensors in {"level alone": (level,), "level and gauge": (level, gauge)}.items():
    data = lc.simulate(machine, poses, lc.Instrument(sensors), 2, nuisance_values=setup)
    result = lc.identifiability(robot, data)
    print(f"{name}: {result.rank} of {result.n_parameters} combinations")

# %%
report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
print(report)

# %%
report.identification.plot.residuals()

# %%
# The truth, in standard deviations of the estimate.

check = lc.compare_with_truth(report.identification, machine.values)
print(f"{check.compared} combinations: chi-square {check.chi_square:.1f} (p = {check.p_value:.2f})")
