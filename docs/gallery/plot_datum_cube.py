# SPDX-License-Identifier: Apache-2.0
"""
A datum cube and the machine's own touch probe
==============================================

A machine tool with a touch probe can calibrate itself: it probes the faces of a cube that lies
somewhere on the table. The cube's faces are flat and perpendicular, and its edge length is known
from a certificate; where it lies is unknown. Here a hexapod probes five faces.
"""

# %%
# Each face is a plane in the frame of the cube. All five share this unknown frame. Opposite faces
# are 80 mm apart, as the certificate says, so they determine the scale. The probe repeats to 1
# um.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/datum_cube.png"
import numpy as np

import loopcal as lc

robot = lc.load_robot("hexapod-octahedral")
machine = robot.with_values(lc.sample_truth(robot, 1, seed=8)[0])

EDGE = 0.080  # [m], by certificate
NORMALS = {"top": (0, 0, 1), "east": (1, 0, 0), "west": (-1, 0, 0)}
NORMALS |= {"north": (0, 1, 0), "south": (0, -1, 0)}
CENTER = np.array([0.0, 0.0, 0.30])  # where the cube is about, in the base [m]


def place_cube(center):
    """Return the pose of the cube in the base."""
    T = np.eye(4)
    T[:3, 3] = center
    return T


# %%
# Every face is probed at twelve points with different tilts of the platform. The commanded pose
# brings the probe tip, which is the origin of the platform, onto the face.

random = np.random.default_rng(3)
coordinates, sensors = [], []
for name, normal in NORMALS.items():
    normal = np.array(normal, dtype=float)
    along = random.uniform(-0.035, 0.035, (12, 3)) * (normal == 0)
    tilts = np.radians(random.uniform(-8.0, 8.0, (12, 3)))
    tips = CENTER + EDGE / 2 * normal + along
    rows = np.arange(len(coordinates), len(coordinates) + 12)
    coordinates += np.hstack([tips, tilts]).tolist()
    kind = lc.Plane(
        surface=name,
        through=EDGE / 2 * normal,
        along=normal,
        T_base_frame=place_cube(CENTER),
        frame="cube",
        unknown=("frame", "targets"),
        targets=("tip",),
        places=np.zeros((1, 3)),
    )
    sensors.append(lc.Sensor(kind, lc.Gaussian(np.array([1e-6])), rows=rows))
probe = lc.Instrument(tuple(sensors))

# %%
# The cube really lies 0.7 mm beside this place and is rotated by half a degree.

setup = {"cube.x": 0.0007, "cube.rz": np.radians(0.5), "tip.x": 0.0002}
data = lc.simulate(machine, coordinates, probe, seed=5, nuisance_values=setup)
report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.2))
print(report)

# %%
report.validation.plot()

# %%
# In the truth, and what the certificate of the cube is worth: a cube that is 1 um larger than
# stated makes the machine larger by 1 um in 80 mm. Nothing in the data could tell.

check = lc.compare_with_truth(report.identification, machine.values)
print(f"{check.compared} combinations: chi-square {check.chi_square:.1f} (p = {check.p_value:.2f})")
print(report.identification.nuisance)
