# SPDX-License-Identifier: Apache-2.0
"""
The rods get shorter with every auto-calibration (RepRapFirmware)
=================================================================

``G32`` with many factors also fits the lengths of the rods, and they change with every run. Heights
of a bed do not determine them. This example shows that from the heights of one ``G32``, calibrates
what heights do determine, and adds two distances on a printed part for the size of parts.
"""

# %%
# The true printer: all three rods are 0.3 mm longer than the firmware believes, and the radius is
# 0.6 mm larger. The firmware probes sixteen points; the probe repeats to 0.02 mm.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/reprap.png"
import shlex
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import loopcal as lc

folder = Path(tempfile.mkdtemp())
(folder / "config-override.g").write_text("M665 L220:220:220 R105 H300 B85\nM666 X0 Y0 Z0\n")
nominal = lc.load_robot("linear-delta")
errors = {"radius": 0.6e-3, "arm1.length": 0.3e-3, "arm2.length": 0.3e-3, "arm3.length": 0.3e-3}
changes = np.array([errors.get(name, 0.0) for name in nominal.parameters.names])
printer = nominal.with_values(nominal.values + changes)

# %%
# At each point the firmware lowers the nozzle, by its own geometry, until the probe touches. It
# reports the height at which it believes to be.

circles = {0.0: 1, 35.0: 6, 70.0: 9}
points = np.array(
    [
        (radius * np.cos(angle), radius * np.sin(angle))
        for radius, count in circles.items()
        for angle in np.arange(count) * 2 * np.pi / count
    ]
)
heights = np.zeros(len(points))
for _ in range(5):
    believed = np.column_stack([points, heights]) * 1e-3
    true = lc.forward(printer, lc.inverse(nominal, believed).q).T[:, 2, 3]
    heights -= 1e3 * true
heights += np.random.default_rng(1).normal(0.0, 0.02, len(points))
bed = [f"G30 P{i} X{x:.2f} Y{y:.2f} Z-99999" for i, (x, y) in enumerate(points)]
(folder / "bed.g").write_text("\n".join(bed) + " S-1\n")
report = "G32 bed probe heights:" + "".join(f" {h:.3f}" for h in heights) + ", mean 0, deviation 0"
(folder / "g32.txt").write_text(report)
print(report)

# %%
# Read the firmware's numbers and the heights. This is what you type, with ``loopcal`` in front:


def run(command):
    """Run a command of loopcal, and print what it prints."""
    words = [sys.executable, "-m", "loopcal", *shlex.split(command)]
    done = subprocess.run(words, cwd=folder, check=True, capture_output=True, text=True)
    print(done.stdout)


run(
    "import config-override.g --format reprap --probes g32.txt --probes bed.g "
    "-o printer.yaml --data heights.csv --sigma-height 0.02mm"
)
robot = lc.load_robot(folder / "printer.yaml")
data = lc.load_measurements(folder / "heights.csv", robot)

# %%
# With the rods free, three combinations of the nine numbers are known no better than from their
# tolerances: their singular values are below 1. The colors show which: the rods, with some radius
# and tower angles. A fit without expected spreads moves along them at every run.

free = lc.load_robot("linear-delta")
result = lc.identifiability(free, replace(data, robot_name=free.name))
result.plot()

# %%
# So loopcal keeps the rods, and the bed becomes flat.

flat = lc.calibrate(robot, data)
print(flat.headline)
flat.height_errors.plot()

# %%
# A flat bed does not mean true sizes: parts are still too large or too small. Print a cross of
# 100 mm and measure both of its arms with calipers, to 0.05 mm. Each row names two positions of
# the nozzle.

ends = np.array([[50, 0, 0], [-50, 0, 0], [0, 50, 0], [0, -50, 0]]) * 1e-3
readings = lc.inverse(nominal, ends).q
reached = lc.forward(printer, readings).T[:, :3, 3]
arms = reached[[0, 2]] - reached[[1, 3]]
lengths = np.linalg.norm(arms, axis=1) + np.random.default_rng(2).normal(0.0, 0.05e-3, 2)
print("measured:", np.round(1e3 * lengths, 2), "mm")

pairs = len(points) + np.array([[0, 1], [2, 3]])
part = lc.Separation().with_tool(free.tool)
calipers = lc.Observations.from_sigma(part, pairs, lengths[:, None], 0.05e-3)
both = lc.Measurements(
    free.name, np.vstack([data.readings, readings]), (*data.observations, calipers)
)

# %%
# Now all nine numbers are free, and each rod is held by its expected spread.

fit = lc.identify(free, both)
fit.plot.parameters()

# %%
# Which numbers print true sizes? Another bar of 100 mm, at 45 degrees, with each set of numbers.
# No single rod is known well, but the size is.

bar = np.array([[1, 1, 0], [-1, -1, 0]]) * 50e-3 / np.sqrt(2)
for name, numbers in {"old": nominal, "flat bed": flat.robot, "and cross": fit.robot}.items():
    one, other = lc.forward(printer, lc.inverse(numbers, bar).q).T[:, :3, 3]
    print(f"{name:<10} {1e3 * np.linalg.norm(one - other):.2f} mm")

# %%
# And the estimates, against the truth.

table = fit.to_frame().set_index("parameter")
true = printer.to_frame().set_index("parameter")["value"]
table["true"], table["error in sd"] = true, (table.estimate - true) / table.sd
columns = ["nominal", "estimate", "plus_minus", "true", "unit", "error in sd"]
print(table[columns].round(3).to_string())
