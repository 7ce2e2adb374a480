# SPDX-License-Identifier: Apache-2.0
"""
Calibrate with nothing but a ball bar
=====================================

A telescoping ball bar measures one number in each pose: the distance between a ball on the table
and a ball on the platform. It is cheap, and many workshops have one. With the table ball at three
places it determines everything about this hexapod but where its frames are.
"""

# %%
# The three places of the table ball are three sessions, each with an unknown place of its own.
# The ball on the platform is not known exactly either.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/ball_bar.png"
import numpy as np

import loopcal as lc

robot = lc.load_robot("hexapod-octahedral")
machine = robot.with_values(lc.sample_truth(robot, 1, seed=21)[0])
poses = lc.sample_workspace(robot, 90, seed=1).coordinates


def mount_bar(name, place, first):
    """Return the ball bar with its table ball at this place [m], for 30 poses from `first` on."""
    kind = lc.Distance(
        anchor=np.array(place),
        anchor_name=name,
        targets=("ball",),
        places=np.array([[0.0, 0.0, 0.05]]),
        unknown=("anchor", "targets"),
    )
    return lc.Sensor(kind, lc.Gaussian(np.array([2e-6])), rows=np.arange(first, first + 30))


bar = lc.Instrument(
    (
        mount_bar("east", [0.25, 0.0, 0.10], 0),
        mount_bar("northwest", [-0.13, 0.22, 0.10], 30),
        mount_bar("southwest", [-0.13, -0.22, 0.10], 60),
    )
)

# %%
# Before anything is measured: what can a ball bar determine? The gap separates what 90 distances
# determine from what they cannot, which is how the base frame and the platform frame lie.

plan = lc.simulate(robot, poses, bar, seed=0)
lc.identifiability(robot, plan).plot()

# %%
# Measure the true machine, and calibrate. The true places of the balls differ from the guesses.

setup = {"east.x": 0.2513, "northwest.z": 0.0991, "southwest.y": -0.2188, "ball.z": 0.0504}
data = lc.simulate(machine, poses, bar, seed=2, nuisance_values=setup)
report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.2))
print(report)

# %%
# The lengths that the bar shows at the held-out poses, before and after calibration.

report.validation.plot()

# %%
# The errors of the estimate, in standard deviations. Combinations that no distance can determine
# are left out.

check = lc.compare_with_truth(report.identification, machine.values)
print(f"{check.compared} combinations: chi-square {check.chi_square:.1f} (p = {check.p_value:.2f})")
