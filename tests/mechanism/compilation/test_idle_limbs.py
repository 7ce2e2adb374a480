# SPDX-License-Identifier: Apache-2.0
"""A limb that constrains nothing does not decide in which mode a machine is.

The machine is an octahedral hexapod with a probe, a passive limb of six joints whose wrist is three
hinges. The wrist is straight at a pitch of -5 degrees, which is a singularity of the limb alone.
The same hexapod without the probe states the truth.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse

Array = NDArray[np.float64]
BASE = [
    [500, -40, 0],
    [500, 40, 0],
    [-215, 453, 0],
    [-285, 413, 0],
    [-285, -413, 0],
    [-215, -453, 0],
]
PLATFORM = [
    [185, -240, 0],
    [185, 240, 0],
    [115, 280, 0],
    [-300, 40, 0],
    [-300, -40, 0],
    [115, -280, 0],
]
PROBE = """  - name: probe
    ending: rigid
    chain:
      - {joint: U, name: lower, axes: [x, y]}
      - {joint: P, name: slide, axis: z, start: 600}
      - {joint: R, name: first, axis: z}
      - {joint: R, name: middle, axis: y, start: 5}
      - {joint: R, name: last, axis: z}
    attach: {pitch: 5}
"""


def load_hexapod(folder: Path, limbs: str = "") -> Mechanism:
    """Return the hexapod with further limbs."""
    lines = ["format: 1", "family: limbs", "name: hexapod", "units: {length: mm, angle: deg}"]
    lines += ["controlled: [x, y, z, roll, pitch, yaw]", "actuators:"]
    lines += [f"  q{i}: {{reads: length}}" for i in range(1, 7)] + ["limbs:"]
    for i, (tip, attach) in enumerate(zip(BASE, PLATFORM, strict=True), 1):
        lines += [f"  - name: leg{i}", "    ending: distance", f"    tip: {tip}"]
        lines += [f"    attach: {attach}", f"    actuated: q{i}"]
        lines += ["    errors: [{of: base, shift: [x, y, z], tolerance: {sd: 0.1}}]"]
    path = folder / f"hexapod{len(limbs)}.yaml"
    path.write_text("\n".join(lines) + "\n" + limbs + "home: {z: 600}\n", "utf-8")
    return load_robot(path)


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory) -> tuple[Mechanism, Mechanism]:
    folder = tmp_path_factory.mktemp("robots")
    return load_hexapod(folder), load_hexapod(folder, PROBE)


def draw_poses(n: int) -> Array:
    """Draw coordinates (n, 6), shifts up to 0.6 m and turns up to 1.5 rad."""
    wide, middle = np.repeat([0.6, 1.5], 3), np.array([0, 0, 0.6, 0, 0, 0])
    return middle + np.random.default_rng(2).uniform(-wide, wide, (n, 6))


def test_the_wrist_of_a_probe_passes_its_singularity(machines: tuple[Mechanism, Mechanism]) -> None:
    plain, probed = machines
    target = np.zeros((9, 6))
    target[:, 2], target[:, 4] = 0.6, np.linspace(-0.3, 0.3, 9)
    solution = inverse(probed, target)
    assert solution.converged.all()  # those below -5 degrees were in another mode
    assert_allclose(solution.q, inverse(plain, target).q, atol=1e-12)  # [m] rounding
    back = forward(probed, solution.q)
    assert back.converged.all()
    assert np.abs(geometry.pose_difference(back.T, solution.T)).max() < 1e-9
    middle = solution.passive[:, list(solution.passive_names).index("probe.middle")]
    assert middle.min() < -0.1 < 0.1 < middle.max()


def test_modes_of_the_actuated_loops_are_those_without_the_probe(machines):
    plain, probed = machines
    target = draw_poses(40)
    expected, solution = inverse(plain, target), inverse(probed, target)
    both = expected.closed & solution.closed
    assert both.sum() > 30
    assert 2 < expected.converged.sum() < 38
    # the probe needs more steps of a path, so that a row may be refused, but no other is taken
    assert not (solution.converged & ~expected.converged).any()
    assert (solution.converged & expected.converged).sum() > 0.9 * expected.converged.sum()
