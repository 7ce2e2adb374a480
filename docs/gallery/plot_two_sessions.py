# SPDX-License-Identifier: Apache-2.0
"""
Has the machine changed since the last calibration?
===================================================

A hexapod was calibrated in May. In June one leg was repaired, and the machine was measured again.
Both calibrations differ in all 42 numbers, because both have noise. Comparing them shows whether
the machine itself has changed, and where.
"""

# %%
# Both sessions use a six-degree-of-freedom tracker: 5 um and 20 urad.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/two_sessions.png"
import tempfile
from pathlib import Path

import numpy as np

import loopcal as lc

robot = lc.load_robot("hexapod-octahedral")
tracker = lc.Instrument((lc.Sensor(lc.Pose(), lc.Gaussian(np.array([20e-6] * 3 + [5e-6] * 3))),))
may = robot.with_values(lc.sample_truth(robot, 1, seed=11)[0])

# In truth the repair moved the upper joint of leg 4 by 60 um.
values, moved = may.values.copy(), "leg4.platform.x"
values[robot.parameters.names.index(moved)] += 60e-6
june = robot.with_values(values)

# %%
# Calibrations are compared as run folders, as ``loopcal calibrate -o may`` writes them.

folder = Path(tempfile.mkdtemp())
for seed, (name, machine) in enumerate({"may": may, "june": june}.items()):
    poses = lc.sample_workspace(robot, 40, seed=seed).coordinates
    data = lc.simulate(machine, poses, tracker, seed=seed)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.2))
    lc.save_run(report, folder / name)

comparison = lc.compare_runs([lc.load_run(folder / "may"), lc.load_run(folder / "june")])
print(comparison)

# %%
# Each shift is divided by its standard deviation, while all other parameters may have changed,
# too. One of 42 shifts is too large for noise: that of the repaired joint.

comparison.plot()

# %%
# The estimated change against the true one, 0.06 mm. If only the named cause has changed, its
# change is known better.

row = comparison.to_frame().set_index("parameter").loc[moved]
shift, sd = row["june shift"], row["june shift_sd"]
error = (shift - 0.06) / sd
print(f"{moved}: {shift:+.3f} {row.unit} (k = 1: {sd:.3f}), error {error:+.1f} sd")

cause = comparison.pairs[0]
shift, sd = 1e3 * cause.cause_shift[0], 1e3 * cause.cause_sd[0]
print(f"the cause alone: {shift:+.4f} mm (k = 1: {sd:.4f})")
