# SPDX-License-Identifier: Apache-2.0
"""
Where in the workspace can I trust my robot?
============================================

A calibration is best where it was measured. This planar 3-RRR robot was measured in the middle of
its workspace only, because the camera sees no more. The accuracy map shows what that means for the
edge, and the budget shows what to improve.
"""

# %%
# Thirty poses in the inner part, measured with a camera: x and y to 20 um, yaw to 0.01 degrees.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/accuracy_map.png"
import numpy as np

import loopcal as lc

robot = lc.load_robot("3-rrr")
machine = robot.with_values(lc.sample_truth(robot, 1, seed=3)[0])
camera = lc.Instrument(
    (
        lc.Sensor(
            lc.Component(("x", "y", "psi"), "tilt-torsion"),
            lc.Gaussian(np.array([20e-6, 20e-6, np.radians(0.01)])),
        ),
    )
)
everywhere = lc.sample_workspace(robot, 400, seed=1).coordinates
center = everywhere.mean(axis=0)
near = np.abs(everywhere - center) < 0.25 * np.ptp(everywhere, axis=0)
inner = everywhere[near.all(axis=1)][:30]
data = lc.simulate(machine, inner, camera, seed=2)
report = lc.calibrate(robot, data)
fit = report.identification
print(report.headline)

# %%
# The uncertainty of the tool over the whole workspace. A ring marks poses that are less certain
# than every measured one: there the calibration extrapolates.

accuracy = lc.accuracy_map(fit, data.readings)
print(accuracy)
accuracy.plot()

# %%
# Is the stated uncertainty true? The errors of the calibrated robot at all 400 poses, over their
# stated standard deviations: the root mean square should be about 1, inside and outside.

readings = lc.inverse(fit.robot, everywhere).q
true = lc.forward(machine, readings).T[:, :2, 3]
believed = lc.forward(fit.robot, readings).T[:, :2, 3]
stated = lc.pose_uncertainty(fit, everywhere, frame="base").sd[:, 3:5]
ratio = (believed - true) / stated
for name, chosen in {"inside": near.all(axis=1), "outside": ~near.all(axis=1)}.items():
    error = 1e3 * np.sqrt(np.mean(np.sum((believed - true)[chosen] ** 2, axis=1)))
    print(f"{name}: error {error:.3f} mm, {np.sqrt(np.mean(ratio[chosen] ** 2)):.2f} sd")

# %%
# What would help? The diamonds show the error with half of one sigma.

report.budget.plot()
