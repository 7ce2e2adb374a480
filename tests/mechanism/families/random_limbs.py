# SPDX-License-Identifier: Apache-2.0
"""Mechanisms of random structure, closed by construction: random joint frames and axes, all joint
values zero at home.
"""

import numpy as np
from numpy.typing import NDArray

from loopcal import engine, geometry
from loopcal.engine import State
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.limbs import JointRecord, LimbRecord, Limbs, Prismatic, Revolute
from loopcal.mechanism.families.placement import Point, PoseRecord
from loopcal.mechanism.kinematics import compute_readings
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.states import select_poses
from loopcal.units import Dimension

Array = NDArray[np.float64]
PASSIVE = {"rigid": 6, "ball": 3, "distance": 1}
"""Closure equations of each ending. A limb with c passive joints fewer constrains c freedoms."""


def random_mechanism(seed: int, limbs: int) -> Limbs:
    """Draw 6, 3 or 2 limbs, each with one actuated joint and 6 / `limbs` constrained freedoms."""
    rng = np.random.default_rng(seed)
    taken = 6 // limbs
    allowed = [ending for ending, rows in PASSIVE.items() if rows >= taken]
    result = tuple(
        _limb(rng, f"limb{i + 1}", str(rng.choice(allowed)), taken) for i in range(limbs)
    )
    controlled = {6: ("x", "y", "z", "roll", "pitch", "yaw"), 3: ("x", "y", "z"), 2: ("x", "y")}[
        limbs
    ]
    return Limbs(name=f"random {seed}", limbs=result, controlled=controlled, error_model="complete")


def expected_rank(record: Limbs) -> int:
    """Sum over limbs of 4 r + 2 p + 6 (7 with a rod) less the passive joints."""
    total = 0
    for limb in record.limbs:
        turning = sum(isinstance(j, Revolute) for j in limb.chain)
        passive = sum(
            j.actuated is None for j in limb.chain if isinstance(j, (Revolute, Prismatic))
        )
        total += (
            4 * turning
            + 2 * (len(limb.chain) - turning)
            + (7 if limb.ending == "distance" else 6)
            - passive
        )
    return total


def sample_near_home(machine: Mechanism, n: int, seed: int) -> tuple[State, Array]:
    """Return states (1, m) within 0.3 rad and 60 mm of home in each reading, and the readings
    (1, m, a).
    """
    rng = np.random.default_rng(seed)
    width = [0.3 if a.dimension is Dimension.ANGLE else 0.06 for a in machine.actuators]
    q = (
        compute_readings(machine, machine.values[None], machine.home_state)
        + rng.uniform(-1, 1, (1, n, len(width))) * width
    )
    e, drives = machine.slots(machine.values[None])
    state = engine.solve(machine.program, e, drives.find_joints(q), machine.home_state)
    # random machines have small workspaces: keep rows that closed in the mode of home
    good = (state.status[0] == 0) & (state.closure_sign[0] == machine.home_state.closure_sign[0, 0])
    return select_poses(state, good), q[:, good]


def _limb(rng: np.random.Generator, name: str, ending: str, taken: int) -> LimbRecord:
    """Draw a limb of (rows - taken) passive joints and one actuated joint."""
    passive = PASSIVE[ending] - taken
    drive = f"{name}.q"
    rod_drives = ending == "distance" and rng.random() < 0.4
    count = passive + (0 if rod_drives else 1)
    # a tip must be able to turn about three axes if its orientation is tied, so at most two of six
    # joints slide
    slides = int(rng.integers(0, min(2, count) + 1)) if count else 0
    driven = -1 if rod_drives else int(rng.integers(count))
    kinds = rng.permutation(["P"] * slides + ["R"] * (count - slides))
    # two passive slides in a row are one sliding plane, in which their directions have no meaning
    while any(
        kinds[i] == kinds[i + 1] == "P" and driven not in (i, i + 1) for i in range(count - 1)
    ):
        kinds = rng.permutation(kinds)
    T, chain = np.eye(4), []
    for i, kind in enumerate(kinds):
        place = _place(rng)
        T = T @ place.matrix
        chain.append(
            _joint(str(kind), place, rng.standard_normal(3), drive if i == driven else None)
        )
    tip = _place(rng)
    T = T @ tip.matrix
    if ending == "distance":
        attach = tuple(float(x) for x in rng.uniform(-0.3, 0.3, 3))
        length = float(np.linalg.norm(T[:3, 3] - attach))
        return LimbRecord(
            name, ending, _point(attach), tuple(chain), tip, length, drive if rod_drives else None
        )
    return LimbRecord(name, "ball" if ending == "ball" else "rigid", _pose(T), tuple(chain), tip)


def _joint(kind: str, place: PoseRecord, axis: Array, drive: str | None) -> JointRecord:
    if kind == "R":
        return Revolute("R", at=place, axis=_point(axis), actuated=drive)
    return Prismatic("P", at=place, axis=_point(axis), actuated=drive)


def _place(rng: np.random.Generator) -> PoseRecord:
    x, y, z = (float(v) for v in rng.uniform(-0.4, 0.4, 3))
    roll, pitch, yaw = (float(v) for v in rng.uniform(-1.0, 1.0, 3))
    return PoseRecord(x, y, z, roll, pitch, yaw)


def _pose(T: Array) -> PoseRecord:
    x, y, z = (float(v) for v in T[:3, 3])
    roll, pitch, yaw = (float(v) for v in geometry.matrix_to_euler(T[:3, :3], "xyz"))
    return PoseRecord(x, y, z, roll, pitch, yaw)


def _point(values: Array | tuple[float, ...]) -> Point:
    x, y, z = (float(v) for v in values)
    return x, y, z


def build_mechanism(record: Limbs) -> Mechanism:
    return build(record.expand())
