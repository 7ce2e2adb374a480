# SPDX-License-Identifier: Apache-2.0
"""
Which poses should I measure?
=============================

An hour with a laser tracker is expensive. Poses that are chosen for their information make the same
accuracy with fewer measurements than poses spread evenly. A plan states how far it is from the best
possible choice, and leaves some poses for validation.
"""

# %%
# The instrument: a tracker with one reflector, 15 mm above the platform of a 3-PRS tripod head.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/planning.png"
import numpy as np

import loopcal as lc

robot = lc.load_robot("3-prs")
kind = lc.Position(targets=("ball",), places=np.array([[0.03, 0.0, 0.015]]))
tracker = lc.Instrument((lc.Sensor(kind, lc.Gaussian(np.full(3, 5e-6))),))

plan = lc.plan(robot, tracker, n_poses=14, options=lc.PlanOptions(n_candidates=300, hold_out=5))
print(plan)

# %%
# The poses in their order of visiting. Extreme tilts carry the most information.

plan.plot()

# %%
# Is it true? Draw 40 machines from the expected spreads, measure each at the planned poses and at
# as many random ones, and compare the calibrated machines with the true ones at 30 other poses.

truth = lc.sample_truth(robot, 40, seed=1)
chosen = plan.poses.coordinates[~plan.poses.held_out]
random = lc.sample_workspace(robot, len(chosen), seed=2).coordinates
others = lc.inverse(robot, lc.sample_workspace(robot, 30, seed=3).coordinates).q


def locate_ball(values):
    """Return where the reflector is at the other poses, for these parameter values [m]."""
    T = lc.forward(robot.with_values(values), others).T
    return T[:, :3, :3] @ kind.places[0] + T[:, :3, 3]


for name, poses in {"planned": chosen, "random": random}.items():
    fits = lc.identify_trials(robot, lc.simulate_trials(robot, truth, poses, tracker, seed=4))
    pairs = zip(fits.values, truth, strict=True)
    errors = [np.linalg.norm(locate_ball(v) - locate_ball(t), axis=1) for v, t in pairs]
    print(f"{name}: error of the reflector {1e6 * np.sqrt(np.mean(np.square(errors))):.1f} um rms")
