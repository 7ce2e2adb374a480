# SPDX-License-Identifier: Apache-2.0
"""
A dial gauge and a flat plate: is that enough?
==============================================

A dial gauge on the tool of a delta robot touches a granite plate. The plate is flat, but nobody
leveled it: its height and its two tilts are unknown. This example shows what the gauge determines,
what it leaves open, and which cheap measurement closes the gap.
"""

# %%
# A gauge that reads the gap between the tool and a plane is the measurement kind ``Plane``. It
# has a standard deviation of 3 um. The plate is probed at 36 points.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/dial_gauge.png"
import numpy as np

import loopcal as lc

robot = lc.load_robot("linear-delta")
machine = robot.with_values(lc.sample_truth(robot, 1, seed=4)[0])
plate = lc.Plane(surface="plate", unknown=("surface",))
gauge = lc.Sensor(plate, lc.Gaussian(np.array([3e-6])), rows=np.arange(36))
x, y = np.meshgrid(np.linspace(-0.055, 0.055, 6), np.linspace(-0.055, 0.055, 6))
poses = np.column_stack([x.ravel(), y.ravel(), np.zeros(36)])
setup = {"plate.u": np.radians(0.2), "plate.v": np.radians(-0.1), "plate.height": 0.0004}

# %%
# Flatness says little about size. The radius and the arms are hardly better known than from the
# drawing: many combinations have a singular value below 1, the weight of the expected spreads.

data = lc.simulate(machine, poses, lc.Instrument((gauge,)), seed=2, nuisance_values=setup)
result = lc.identifiability(robot, data)
result.plot()

# %%
# One combination cannot be determined at all, and loopcal names the measurement that would.

for suggestion in lc.suggest_measurements(result):
    print(suggestion)

# %%
# Calipers measure six distances between marks on paper to 20 um. Each row of the sensor names two
# poses, here corners of the plate.

pairs = np.array([[0, 5], [30, 35], [0, 30], [5, 35], [0, 35], [5, 30]])
calipers = lc.Sensor(lc.Separation(), lc.Gaussian(np.array([20e-6])), rows=pairs)
both = lc.simulate(machine, poses, lc.Instrument((gauge, calipers)), 2, nuisance_values=setup)

for name, measured in {"gauge": data, "gauge and calipers": both}.items():
    report = lc.calibrate(robot, measured)
    check = lc.compare_with_truth(report.identification, machine.values)
    expected = 1e3 * report.budget.position.rms
    print(f"{name}: expected position error {expected:.3f} mm")
    print(
        f"  against the truth: chi-square {check.chi_square:.1f} of {check.compared} combinations"
    )

# %%
# With the calipers, the arms are known to a fraction of their expected spread.

report.identification.plot.parameters()
