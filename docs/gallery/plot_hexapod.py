# SPDX-License-Identifier: Apache-2.0
"""
A hexapod and a pose probe
==========================

Forty measured poses determine all 42 parameters of a hexapod. The machine is simulated: its errors
are drawn from the tolerances in the robot file.
"""

import loopcal as lc

robot = lc.load_robot("hexapod-42")
machine = robot.with_values(lc.sample_truth(robot, 1, seed=1)[0])
poses = lc.forward(robot, lc.sample_workspace(robot, 40, seed=2).solution.q).T
probe = lc.Instrument((lc.Sensor(lc.Pose(), lc.Gaussian([10e-6] * 3 + [50e-6] * 3)),))
data = lc.simulate(machine, poses, probe, seed=3, controller=robot)
fit = lc.identify(robot, data)
print(f"{fit.rank} of {len(fit.names)} parameter combinations")

# %%
# The shift of each parameter from nominal, with its interval.
fit.plot.parameters()
