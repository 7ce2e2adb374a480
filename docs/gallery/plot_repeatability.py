# SPDX-License-Identifier: Apache-2.0
"""
How repeatable is my robot? ISO 9283
====================================

Pose accuracy AP and repeatability RP are the two numbers of every robot's data sheet. ISO 9283 asks
for five poses and thirty visits of each. A tracker measures the position of the tool, and loopcal
computes both, each with the interval that thirty visits leave.
"""

# %%
# The simulated delta robot scatters by 10 um in x, y and z, and its geometry has errors of the
# size of its expected spreads. The tracker is five times better than the scatter. The standard
# asks for four.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/repeatability.png"
import numpy as np

import loopcal as lc

robot = lc.load_robot("linear-delta")
machine = robot.with_values(lc.sample_truth(robot, 1, seed=2)[0])
corners = [[50, 50, 20], [-50, 50, 120], [-50, -50, 20], [50, -50, 120], [0, 0, 70]]  # [mm]
commanded = np.repeat(np.array(corners) * 1e-3, 30, axis=0)

scatter, noise = 10e-6, 2e-6  # one standard deviation of each component [m]
reached = commanded + np.random.default_rng(3).normal(0.0, scatter, commanded.shape)
tracker = lc.Instrument((lc.Sensor(lc.Position(), lc.Gaussian(np.full(3, noise))),))
measured = lc.simulate(machine, reached, tracker, seed=3)

# The controller believes to be at the commanded poses: thirty visits have the same readings.
readings = lc.inverse(robot, commanded).q
visits = lc.Measurements(robot.name, readings, measured.observations)

result = lc.assess_repeatability(robot, visits)
print(result)

# %%
# AP says how far the mean of thirty visits is from the command: this is geometry, and calibration
# removes it. RP says how far the visits scatter, and no calibration changes it.

result.plot()

# %%
# Check with the truth. For three equal normal components the distance from the mean has a known
# distribution, so RP = mean + 3 standard deviations = 3.62 times the scatter of one component.

one = np.hypot(scatter, noise)  # scatter of one measured component [m]
expected = (np.sqrt(8 / np.pi) + 3 * np.sqrt(3 - 8 / np.pi)) * one
table = result.to_frame()
whole = table[table.component == "all"]
print(whole[["pose", "AP", "RP", "RP_low", "RP_high"]].to_string(index=False))
inside = ((whole.RP_low < expected) & (expected < whole.RP_high)).sum()
print(f"{inside} of {len(whole)} intervals contain the true RP, {1e6 * expected:.1f} um")

# %%
# The same visits calibrate the robot. Afterwards AP is a matter of noise, and RP is as before.

fit = lc.identify(robot, visits)
after = lc.assess_repeatability(fit.robot, visits)
print(after)
