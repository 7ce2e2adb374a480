# SPDX-License-Identifier: Apache-2.0
"""Hexapods: sensitivities against the leg equation, rod legs and chain legs, screws against
genhexkins, ranks.
"""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from loopcal import geometry as rigid
from loopcal.errors import MechanismError
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.gough import Gough, GoughCones, Screw
from loopcal.mechanism.families.placement import LengthTolerance, PoseRecord
from loopcal.mechanism.families.records import Workspace
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import check_limits
from tests import zoo
from tests.mechanism.families.ranks import rank, scaled_sensitivity, solve_random_poses

Array = NDArray[np.float64]


def to_points(array: Array) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(x), float(y), float(z)) for x, y, z in array)


ROD = Gough(
    name="hexapod",
    base=to_points(zoo.HEXAPOD_BASE * zoo.MM),
    platform=to_points(zoo.HEXAPOD_PLATFORM * zoo.MM),
    lengths=zoo.HEXAPOD_LENGTH * zoo.MM,
    home=PoseRecord(z=0.2),
    workspace=Workspace(
        x=(-0.04, 0.04),
        y=(-0.04, 0.04),
        z=(0.17, 0.23),
        roll=(-0.25, 0.25),
        pitch=(-0.25, 0.25),
        yaw=(-0.25, 0.25),
    ),
)
CHAIN = replace(ROD, legs="ups")


@cache
def build_cached_robot(record: Gough) -> Mechanism:
    return build(record.expand())


def with_published_errors(machine: Mechanism) -> Mechanism:
    """Add ten times the published errors of all 42 parameters: up to 0.5 mm."""
    return machine.with_values(machine.values + 10 * zoo.HEXAPOD_ERRORS.reshape(-1)[ORDER] * zoo.MM)


# the table lists base, length, platform; the package base, platform, length
ORDER = np.concatenate([7 * leg + np.array([0, 1, 2, 4, 5, 6, 3]) for leg in range(6)])


# --- the 42 parameters
# -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("record", [ROD, CHAIN], ids=["rod", "ups"])
def test_sensitivities_equal_those_of_the_leg_equation(record: Gough) -> None:
    """u . dt + (R p x u) . omega = dl + u . db - u . R dp, six legs: D = J^-1 G."""
    machine = with_published_errors(build_cached_robot(record))
    solution = solve_random_poses(machine)
    D = differentiate_pose(
        machine, machine.values[None], solution.q[None], solution.state
    ).parameters[0]
    value = machine.values.reshape(6, 7)
    for T, result in zip(solution.T, D, strict=True):
        N, R = T[:3, 3], T[:3, :3]
        J, G = np.zeros((6, 6)), np.zeros((6, 42))
        for leg, (b, p) in enumerate(zip(value[:, :3], value[:, 3:6], strict=True)):
            u = N + R @ p - b
            u /= np.linalg.norm(u)
            J[leg] = np.concatenate([np.cross(R @ p, u), u])
            G[leg, 7 * leg : 7 * leg + 7] = np.concatenate([u, -u @ R, [1.0]])
        expected = np.linalg.solve(J, G)
        # [m/m, rad/m] rounding times the condition of J, about 1e2
        assert_allclose(result, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_rod_legs_and_chain_legs_agree_in_poses_and_sensitivities() -> None:
    rod, chain = (
        with_published_errors(build_cached_robot(ROD)),
        with_published_errors(build_cached_robot(CHAIN)),
    )
    assert rod.parameters.names == chain.parameters.names
    assert_array_equal(rod.parameters.nominal, chain.parameters.nominal)
    one = solve_random_poses(rod)
    two = inverse(chain, one.T)
    assert two.converged.all()
    assert_allclose(two.q, one.q, rtol=0, atol=1e-12)  # [m]
    solution, back = forward(rod, one.q), forward(chain, one.q)
    assert_allclose(back.T, solution.T, rtol=0, atol=1e-12)  # [m, 1]
    assert max(solution.residual.max(), back.residual.max()) < 1e-12  # [m]
    D = [
        differentiate_pose(machine, machine.values[None], one.q[None], result.state)
        for machine, result in ((rod, solution), (chain, back))
    ]
    size = np.abs(D[0].parameters).max()  # [rad/m] about 10
    assert_allclose(D[1].parameters, D[0].parameters, rtol=0, atol=1e-12 * max(size, 1.0))
    assert_allclose(D[1].readings, D[0].readings, rtol=0, atol=1e-12 * max(size, 1.0))


COMPLETE_AXES = replace(CHAIN, error_model="complete", spherical="axes")


def test_complete_model_spans_the_sensitivities_of_the_ideal_model() -> None:
    """The columns of the complete model span those of the 42 parameters."""
    solution = solve_random_poses(build_cached_robot(ROD))
    small = scaled_sensitivity(build_cached_robot(ROD), solution)
    machine = build_cached_robot(COMPLETE_AXES)
    large = scaled_sensitivity(machine, inverse(machine, solution.T))
    assert rank(np.concatenate([large, small], axis=2)) == rank(large) == 66


# --- refusals
# --------------------------------------------------------------------------------------------------------  # noqa: E501
@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        (replace(ROD, error_model="complete"), "legs: rod with error_model.*Give legs: ups"),
        (replace(ROD, spherical="axes"), "legs: rod with spherical: axes.*Give legs: ups"),
        (replace(ROD, screw=Screw()), "legs: rod with a screw.*Give legs: ups"),
        (replace(CHAIN, spherical="axes"), "spherical: axes.*Give error_model: complete"),
        (
            replace(CHAIN, screw=Screw(0.004, ((0, 0, 1),) * 5, ((1, 0, 0),) * 6)),
            "5 values under `base_axes:`",
        ),
        (
            replace(CHAIN, screw=Screw(0.004, ((0, 0, 0),) * 6, ((1, 0, 0),) * 6)),
            r"joint axis of leg1 is \[0, 0, 0\]",
        ),
        (replace(ROD, base=ROD.base[:5]), "5 values under `base:`"),
        (
            replace(ROD, tolerances=replace(ROD.tolerances, base=LengthTolerance())),
            "give exactly one of sd and limits",
        ),
    ],
)
def test_unsupported_options_of_a_hexapod_are_refused_with_the_alternative(record, sentence):
    with pytest.raises(MechanismError, match=sentence):
        record.expand()


# --- the screw, against LinuxCNC's genhexkins
# ------------------------------------------------------------------------
LEAD = 4.0  # unit of the file, here taken as a meter


@pytest.fixture(scope="module")
def genhexkins(data_folder: Path) -> tuple[dict[str, Array], Array, Array]:
    """Return geometry, poses (200, 4, 4) and strut lengths (200, 6) printed by LinuxCNC."""
    folder = data_folder / "kinematics_oracles"
    geometry = json.loads((folder / "genhexkins_geometry.json").read_text())
    rows = np.genfromtxt(folder / "genhexkins_screwlead4_200poses.csv", delimiter=",", names=True)
    angles = np.radians(np.stack([rows[c] for c in ("a_deg", "b_deg", "c_deg")], axis=1))
    T = rigid.make_pose(
        rigid.euler_to_matrix(angles, "xyz"), np.stack([rows[c] for c in "xyz"], axis=1)
    )
    struts = np.stack([rows[f"L{leg}"] for leg in range(6)], axis=1)
    return (
        {
            key: np.array(geometry[key])
            for key in geometry
            if not key.startswith("_") and key != "units"
        },
        T,
        struts,
    )


def is_folded(geometry: dict[str, Array], T: Array) -> NDArray[np.bool_]:
    """Return whether platform and base joint axes differ by more than 90 degrees about the leg
    (n, 6).
    """
    R = T[:, None, :3, :3]
    v = T[:, None, :3, 3] + (R @ geometry["platform"][..., None])[..., 0] - geometry["base"]
    s = v / np.linalg.norm(v, axis=2, keepdims=True)
    low, high = (
        geometry["base_joint_axis"] + 0 * v,
        (R @ geometry["platform_joint_axis"][..., None])[..., 0],
    )
    return (low * high).sum(2) - (low * s).sum(2) * (high * s).sum(2) < 0


def screw_hexapod(geometry: dict[str, Array], fold: NDArray[np.bool_], home: Array) -> Mechanism:
    """Build a hexapod whose screws agree with genhexkins, which uses asin(sin a) for the angle a.

    Past a quarter turn that is the screw of the other hand, counted from the other side of its
    axis.
    """
    sign = np.where(fold, -1.0, 1.0)
    x, y, z = home[:3, 3]
    roll, pitch, yaw = rigid.matrix_to_euler(home[:3, :3], "xyz")
    axes = (
        to_points(geometry["base_joint_axis"]),
        to_points(geometry["platform_joint_axis"] * sign[:, None]),
    )
    record = Gough(
        name="genhexkins",
        base=to_points(geometry["base"]),
        platform=to_points(geometry["platform"]),
        legs="ups",
        screw=Screw(tuple(LEAD * sign), *axes),
        home=PoseRecord(x, y, z, roll, pitch, yaw),
    )
    return build(record.expand())


def test_screw_legs_agree_with_strut_lengths_and_poses_of_genhexkins(genhexkins):
    geometry, T, struts = genhexkins
    patterns, place = np.unique(is_folded(geometry, T), axis=0, return_inverse=True)
    checked = 0
    for i, pattern in enumerate(patterns):
        rows = np.flatnonzero(place.reshape(-1) == i)
        machine = screw_hexapod(geometry, pattern, T[rows[0]])
        # walk there in twenty steps: a screw that overtakes half a turn on the way stands a turn
        # further
        start = None
        twist = rigid.pose_difference(T[rows], T[rows[:1]] + 0 * T[rows])
        for part in np.linspace(0.05, 1.0, 20):
            pose = rigid.apply_twist(T[rows[:1]] + 0 * T[rows], part * twist)
            start = inverse(machine, pose, start)
        assert start is not None
        assert start.converged.all()
        assert_allclose(start.T, T[rows], rtol=0, atol=1e-12)
        assert_allclose(start.q, struts[rows], rtol=0, atol=1e-9)  # printed to 1e-12
        back = forward(machine, struts[rows])
        assert back.converged.all()
        # printed poses are exact to 1e-10
        assert_allclose(back.T, T[rows], rtol=0, atol=1e-7)
        checked += len(rows)
    assert checked == 200


def test_screw_without_lead_equals_a_plain_leg() -> None:
    axes = ((0.0, 0.0, 1.0),) * 6, ((1.0, 0.0, 0.0),) * 6
    machine, plain = (
        build_cached_robot(replace(CHAIN, screw=Screw(0.0, *axes))),
        build_cached_robot(CHAIN),
    )
    one = solve_random_poses(plain, 20)
    assert_allclose(inverse(machine, one.T).q, one.q, rtol=0, atol=1e-12)  # [m]


def test_screw_adds_its_lead_for_each_turn_of_the_upper_joint() -> None:
    """length + reading = |t + R p - b| + lead a / (2 pi), a from the lower axis to the upper one
    about the leg.
    """
    lead, low, high = 0.004, np.array([1.0, 0.0, 0.0]), np.array([0.6, 0.8, 0.0])
    machine = build_cached_robot(
        replace(
            CHAIN,
            screw=Screw(lead, to_points(np.tile(low, (6, 1))), to_points(np.tile(high, (6, 1)))),
        )
    )
    solution = solve_random_poses(machine, 30)
    for T, q in zip(solution.T, solution.q, strict=True):
        v = T[:3, 3] + to_array(ROD.platform) @ T[:3, :3].T - to_array(ROD.base)
        length = np.linalg.norm(v, axis=1)
        s, upper = v / length[:, None], T[:3, :3] @ high
        across = np.cross(s, low)  # with low's part across s, a right-handed frame about s
        a = np.arctan2(across @ upper, s * (s @ low)[:, None] @ -upper + low @ upper)
        assert_allclose(q, length + lead * a / (2 * np.pi) - ROD.lengths, rtol=0, atol=1e-12)


def to_array(listed: tuple[tuple[float, float, float], ...]) -> Array:
    return np.array(listed)


def test_inclination_limit_of_a_leg_is_reported() -> None:
    machine = build_cached_robot(replace(ROD, cones=GoughCones(base=0.1, platform=0.3)))
    q = inverse(machine, np.array([[0.0, 0, 0.2, 0, 0, 0], [0.1, 0, 0.2, 0, 0, 0]]))
    allowed, why = check_limits(machine, machine.values[None], q.q[None], q.state)
    assert allowed.tolist() == [[True, False]]
    assert why[0, 0] is None
    assert why[0, 1].code == "limits.exceeded"
    assert why[0, 1].data["name"] == "inclination of leg1 at its tip"
    with pytest.raises(MechanismError, match="legs: ups with cones"):
        replace(CHAIN, cones=GoughCones(base=0.1)).expand()
