# SPDX-License-Identifier: Apache-2.0
"""
A hexapod and a laser tracker that stands somewhere
===================================================

A laser tracker measures three reflectors on the platform of a hexapod. Nobody knows where the
tracker stands, and the reflectors are glued on by hand. Both become unknowns of the calibration,
beside the 42 numbers of the hexapod: joint centers and leg lengths.

The machine is simulated, so the result can be compared with the truth.
"""

# %%
# The robot file states the drawing and its expected spreads. The true machine deviates from the
# drawing; here its errors are drawn from the expected spreads.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/hexapod_tracker.png"
import numpy as np

import loopcal as lc

robot = lc.load_robot("hexapod-octahedral")
machine = robot.with_values(lc.sample_truth(robot, 1, seed=7)[0])
robot.plot()

# %%
# The tracker measures each reflector to 5 um in x, y and z. ``unknown`` names what is not known
# beforehand. The stated places are first guesses [m].

kind = lc.Position(
    targets=("ball1", "ball2", "ball3"),
    places=np.array([[0.10, 0.00, 0.02], [-0.05, 0.09, 0.02], [-0.05, -0.09, 0.02]]),
    unknown=("frame", "targets"),
    frame="tracker",
)
tracker = lc.Instrument((lc.Sensor(kind, lc.Gaussian(np.full(9, 5e-6))),))

# %%
# In truth the tracker stands 1.9 m away and is rotated by 30 degrees, and the first reflector is
# 1.2 mm beside its nominal place [m, rad].

setup = {"tracker.x": 1.8, "tracker.y": -0.6, "tracker.z": 0.4, "tracker.rz": np.radians(30.0)}
setup["ball1.x"] = 0.1012
poses = lc.sample_workspace(robot, 50, seed=1).coordinates
data = lc.simulate(machine, poses, tracker, seed=2, nuisance_values=setup)

# %%
# A fifth of the poses is kept out of the fit. They show what the calibration is worth.

report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.2))
print(report)

# %%
report.validation.plot()

# %%
# The fit also states where the tracker stands. The 95 % intervals are wide, because the frame of
# the base can move with the tracker: no measurement can tell the two apart.

print(report.identification.nuisance)

# %%
# Compare with the truth. Twelve combinations only move the base frame or the platform frame as a
# whole. They are left out, and the other thirty are tested together. Chi-square is the sum of the
# squared errors in standard deviations, so it should be near the number of combinations.

check = lc.compare_with_truth(report.identification, machine.values)
print(f"{check.compared} combinations: chi-square {check.chi_square:.1f} (p = {check.p_value:.2f})")

# %%
report.identification.plot.parameters()
