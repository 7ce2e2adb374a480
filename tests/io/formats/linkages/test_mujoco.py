# SPDX-License-Identifier: Apache-2.0
"""MJCF files stand where MuJoCo itself closes their constraints."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from loopcal import forward, inverse
from loopcal.io.formats import FORMATS
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.program_format import ImportOptions
from tests.io.formats.linkages.linkage_texts import write_mjcf
from tests.io.formats.linkages.urdf_chains import make_digger, make_leg

WELDED = """\
<mujoco><compiler angle="radian"/><worldbody>
<body name="crank" pos="0 0 0"><joint name="m" axis="0 0 1"/>
<body name="rod" pos="0.1 0.1 0"><joint name="p" axis="0 0 1"/>
<body name="tool" pos="0.2 0.05 0.01"/><body name="end" pos="0.4 0 0" euler="0 0 0.3"/></body>
</body>
<body name="rocker" pos="0.5 -0.1 0"><joint name="r" axis="0 0 1"/>
<body name="head" pos="0 0.2 0"><joint name="s" axis="0 0 1"/>
<body name="pin" euler="0 0 0.3"/></body>
</body>
</worldbody><equality><weld body1="end" body2="pin"/></equality>
<actuator><motor joint="m"/></actuator></mujoco>
"""
COUPLED = """\
<mujoco><worldbody><body name="a" pos="0.1 0 0"><joint name="m" axis="0 0 1"/>
<body name="b" pos="0.3 0 0"><joint name="n" axis="0 0 1"/><body name="tool" pos="0.2 0 0"/></body>
</body></worldbody><equality><joint joint1="n" joint2="m" polycoef="0.2 -1.5 0 0 0"/></equality>
<actuator><motor joint="m"/></actuator></mujoco>
"""
TEXTS = {
    "leg: connect": lambda: write_mjcf(make_leg()),
    "digger: connect": lambda: write_mjcf(make_digger(has_rocker=True)),
    "four-bar: weld": lambda: WELDED,
    "arm: joint": lambda: COUPLED,
}
INERTIA = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
# MuJoCo's residuals are in m and rad; its closure ends where they are below 1e-13.
AGREES = 1e-9


def close_by_mujoco(text: str, motors: dict[str, float]) -> np.ndarray:
    """Return the pose (4, 4) of the body `tool` with motors at given angles [rad] or lengths [m],
    by Newton's method on the residuals and Jacobians of MuJoCo's constraints.
    """
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(re.sub(r"(<body [^>/]*>)", rf"\1{INERTIA}", text))
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data, passive = mujoco.MjData(model), np.ones(model.nv, bool)
    for name, value in motors.items():
        joint = model.joint(name)
        data.qpos[joint.qposadr[0]] += value
        passive[joint.dofadr[0]] = False
    gap = np.array([np.inf])
    for _ in range(60):
        mujoco.mj_fwdPosition(model, data)
        gap = np.array(data.efc_pos[: data.ne])
        if np.abs(gap).max() < 1e-13:
            break
        J = data.efc_J.reshape(-1, model.nv)[: data.ne, passive]
        step = np.zeros(model.nv)
        step[passive] = -np.linalg.lstsq(J, gap, rcond=1e-9)[0]
        mujoco.mj_integratePos(model, data.qpos, step, 1.0)
    assert np.abs(gap).max() < 1e-12
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = data.body("tool").xmat.reshape(3, 3), data.body("tool").xpos
    return T


@pytest.mark.parametrize("name", TEXTS)
def test_forward_kinematics_agrees_with_mujoco(tmp_path: Path, name: str) -> None:
    pytest.importorskip("mujoco")
    text, path = TEXTS[name](), tmp_path / "robot.xml"
    path.write_text(text)
    read = FORMATS["mjcf"].read
    assert read is not None
    robot = build_imported_robot(path, read(path, ImportOptions("machine", platform="tool")))
    home = inverse(robot, robot.home[None]).q
    q = home + np.random.default_rng(4).uniform(-0.05, 0.05, (10, home.shape[1]))
    found, motors = forward(robot, q).T, [actuator.name for actuator in robot.actuators]
    for T, readings in zip(found, q, strict=True):
        expected = close_by_mujoco(text, dict(zip(motors, readings, strict=True)))
        np.testing.assert_allclose(T, expected, rtol=0, atol=AGREES)  # [m, 1]
