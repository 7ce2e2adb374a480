# SPDX-License-Identifier: Apache-2.0
"""3-PRS and RU-PUS-PRS: sensitivities against the loops of docs/theory/families.md, |v_i| = l_i,
v_i . r_i = 0 and so on, which share no code with the package; ranks, null directions.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from loopcal.engine.numpy_engine.closure import place_links
from loopcal.errors import MechanismError
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.placement import PoseRecord
from loopcal.mechanism.families.prs import LEFT_OUT, RuPusPrs, ThreePrs
from loopcal.mechanism.families.records import Workspace
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from tests.mechanism.families.ranks import (
    null_vector,
    perturb,
    rank,
    scaled_sensitivity,
    select_measured_rows,
    solve_random_poses,
)

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
TILTS = {"phi": (-np.pi, np.pi), "theta": (0.02, 0.6)}
THREE_PRS = ThreePrs(
    name="3-prs",
    platform_radius=0.2,
    base_radius=0.35,
    rod=0.5,
    home=PoseRecord(z=0.7),
    workspace=Workspace(z=(0.65, 0.75), **TILTS),
)
RU_PUS_PRS = RuPusPrs(
    name="ru-pus-prs",
    platform_radius=0.3,
    base_radius=0.4,
    rod=0.5,
    post=0.6,
    home=PoseRecord(z=0.6),
    workspace=Workspace(**TILTS),
)
EX, EY, EZ = np.eye(3)


@cache
def build_cached_robot(record: ThreePrs | RuPusPrs) -> Mechanism:
    return build(record.expand())


def rotation_about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


MODELS = {
    "3-PRS": (THREE_PRS, "three_prs"),
    "RU-PUS-PRS, 25": (RU_PUS_PRS, "ru_pus_prs"),
    "RU-PUS-PRS, 27": (replace(RU_PUS_PRS, parameter_set="twenty-seven"), "ru_pus_prs"),
}


def cross_matrix(w: Array | Complex) -> Complex:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]], dtype=complex)


def rotation_series(w: Array | Complex) -> Complex:
    """exp of small angles as its series, which takes complex numbers; 0.1^12 / 12! is far below
    rounding.
    """
    W, term, total = cross_matrix(w), np.eye(3, dtype=complex), np.eye(3, dtype=complex)
    for k in range(1, 12):
        term = term @ W / k
        total = total + term
    return total


class Loops:
    """The loops as equations of (platform, pivot's angle, parameters), without first-order steps.

    The paper's derivatives hold at zero angles. Beyond, two angles of one axis act as one turn
    exp((x, y, z)), and the joint on a tilted guide takes that turn back and its own in one: r =
    exp(thB) exp(thC - thB) r0.
    """

    def __init__(self, names: tuple[str, ...], values: Array | Complex) -> None:
        self.of = dict(zip(names, values, strict=True))

    def vector(self, name: str) -> Complex:
        return np.array([self.of.get(f"{name}{axis}", 0.0) for axis in "xyz"], dtype=complex)

    def limb(
        self, i: int, N: Complex, R: Complex, q: float, Z: Array, hinge: Array | None
    ) -> list[complex]:
        guide = rotation_series(self.vector(f"thB{i}"))
        s = Z @ guide @ EZ
        v = N + R @ Z @ self.vector(f"a{i}") - Z @ self.vector(f"b{i}") - (self.of[f"q{i}"] + q) * s
        result = [np.sqrt(v @ v) - self.of[f"l{i}"]]
        if hinge is not None:
            r = Z @ guide @ rotation_series(self.vector(f"thC{i}") - self.vector(f"thB{i}")) @ hinge
            result.append(v @ r)
        return result

    def three_prs(self, N: Complex, R: Complex, pivot: complex, q: Array) -> Complex:
        """Return six equations, and one that fixes the unused pivot."""
        limbs = [
            self.limb(i + 1, N, R, q[i], rotation_about_z(2 * np.pi / 3 * i), EY) for i in range(3)
        ]
        return np.array([*limbs[0], *limbs[1], *limbs[2], pivot])

    def ru_pus_prs(self, N: Complex, R: Complex, pivot: complex, q: Array) -> Complex:
        """Return seven equations: three of the limbs, the post's end, its universal joint."""
        eye, c, s = np.eye(3), np.cos(pivot), np.sin(pivot)
        post = rotation_series(self.vector("thO")) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        u1, u2 = (
            post @ rotation_series(self.vector("thU1")) @ EX,
            R @ rotation_series(self.vector("thU2")) @ EY,
        )
        limbs = [*self.limb(1, N, R, q[0], eye, None), *self.limb(2, N, R, q[1], eye, EX)]
        return np.array([*limbs, *(N - self.of["r"] * post @ EZ), u1 @ u2])

    def pivot(self, N: Array) -> float:
        x, _, z = (rotation_series(self.vector("thO")).T @ N).real
        return float(np.arctan2(x, z))


def sensitivities_by_complex_steps(
    kind: str, names: tuple[str, ...], values: Array, T: Array, q: Array
) -> tuple[Array, Array]:
    """Return residuals (7,) and D (6, p) of the loops by complex steps.

    Complex steps have no truncation and no cancellation.
    """
    N, R, h = T[:3, 3], T[:3, :3], 1e-30
    start = Loops(names, values).pivot(N) if kind == "ru_pus_prs" else 0.0

    def loops(x: Array | Complex, p: Array | Complex) -> Complex:
        moved = Loops(names, values + p)
        return np.asarray(
            getattr(moved, kind)(N + x[3:6], (np.eye(3) + cross_matrix(x[:3])) @ R, start + x[6], q)
        )

    def steps(n: int) -> Complex:
        return np.asarray(1j * h * np.eye(n), dtype=complex)

    still, none = np.zeros(7), np.zeros(len(names))
    J = np.stack([loops(e, none).imag / h for e in steps(7)], axis=1)
    G = np.stack([loops(still, e).imag / h for e in steps(len(names))], axis=1)
    return loops(still, none).real, np.asarray(-np.linalg.solve(J, G)[:6], dtype=float)


@pytest.mark.parametrize("size", [0.0, 1e-3, pytest.param(1e-2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", MODELS)
def test_sensitivities_equal_complex_steps_of_the_loops(case: str, size: float) -> None:
    # nominal; then angles of 5 (50) mrad: centers, guides, joints and post all displaced, also
    # against each other
    record, kind = MODELS[case]
    machine = perturb(build_cached_robot(record), size, seed=11)
    solution = solve_random_poses(machine, 10)
    D = differentiate_pose(
        machine, machine.values[None], solution.q[None], solution.state
    ).parameters[0]
    names = machine.parameters.names
    result = [
        sensitivities_by_complex_steps(kind, names, machine.values, T, q)
        for T, q in zip(solution.T, solution.q, strict=True)
    ]
    expected = np.stack([slopes for _, slopes in result])
    # [m, 1] the machine stands on these loops
    assert max(np.abs(residual).max() for residual, _ in result) < 1e-12
    # [m/m, rad/m, ..] condition of the loops 1e2 times rounding
    assert_allclose(D, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_parameter_names_of_3_prs_and_ru_pus_prs() -> None:
    names = build_cached_robot(THREE_PRS).parameters.names
    assert len(names) == 33
    assert " ".join(names[:11]) == "a1x a1y a1z b1x b1y q1 l1 thB1x thB1y thC1x thC1z"
    names = build_cached_robot(RU_PUS_PRS).parameters.names
    assert len(names) == 25
    more = build_cached_robot(MODELS["RU-PUS-PRS, 27"][0]).parameters.names
    assert set(more) - set(names) == set(LEFT_OUT)
    assert names[-5:] == ("r", "thOx", "thU1y", "thU2x", "thU2z")


def test_null_vector_of_the_3_prs_without_torsion_rotates_three_balls() -> None:
    machine = build_cached_robot(THREE_PRS)
    solution = solve_random_poses(machine)
    result = null_vector(
        select_measured_rows(scaled_sensitivity(machine, solution), solution.T, "5-dof")
    )
    expected = np.isin(machine.parameters.names, ("a1y", "a2y", "a3y")) / np.sqrt(3)
    # rounding over the next singular value, 4e-5
    assert_allclose(np.abs(result @ expected), 1.0, atol=1e-9)


def test_fourteen_parameters_a_chain_have_the_rank_of_eleven() -> None:
    machine = build_cached_robot(replace(THREE_PRS, parameter_set="fourteen"))
    names = machine.parameters.names
    assert len(names) == 42
    solution = solve_random_poses(machine)
    D = scaled_sensitivity(machine, solution)
    assert rank(D) == 33
    dropped = [
        f"{letter}{chain}{axis}"
        for letter, axis in (("b", "z"), ("thB", "z"), ("thC", "y"))
        for chain in "123"
    ]
    # an angle about its own axis changes nothing, the foot's height what the offset changes
    for name in dropped:
        column = D[..., machine.parameters.index(name)]
        twin = D[..., machine.parameters.index(f"q{name[1]}")] if name[0] == "b" else 0.0 * column
        assert_allclose(column, twin, rtol=0, atol=1e-14 * np.abs(D).max())
    kept = np.array([name not in dropped for name in names])
    assert rank(D[..., kept]) == 33
    assert tuple(np.array(names)[kept]) == build_cached_robot(THREE_PRS).parameters.names


def test_tilted_guide_does_not_rotate_the_joint_on_the_carriage() -> None:
    machine = build_cached_robot(THREE_PRS)
    # 0.1 rad, far beyond first order: the hinge stays along y of its chain
    values = machine.values.copy()
    values[machine.parameters.index("thB1x")] = 0.1
    values[machine.parameters.index("thB1y")] = -0.1
    e, _ = machine.slots(values[None])
    group = machine.program.groups[0]
    g = place_links(group, e)
    assert_allclose(g.rotation[0][..., 0, 0] @ g.rotation[1][..., 0, 0] @ EZ, EY, atol=1e-15)


def test_twenty_seven_parameters_of_the_ru_pus_prs_have_rank_26() -> None:
    machine = build_cached_robot(MODELS["RU-PUS-PRS, 27"][0])
    solution = solve_random_poses(machine)
    D = scaled_sensitivity(machine, solution)
    assert rank(D) == 26
    names = machine.parameters
    pivot, first = D[..., names.index("thOz")], D[..., names.index("thU1z")]
    assert_allclose(pivot, first, rtol=0, atol=1e-14 * np.abs(D).max())
    # leaving out thOz alone keeps 26; the declared twenty-five leave out thU1z as well


def test_null_vector_of_the_ru_pus_prs_without_torsion_rotates_two_balls() -> None:
    machine = build_cached_robot(RU_PUS_PRS)
    solution = solve_random_poses(machine)
    result = null_vector(
        select_measured_rows(scaled_sensitivity(machine, solution), solution.T, "5-dof")
    )
    result *= np.sign(result[machine.parameters.index("a1y")])
    # mostly a1y = a2x, and a small angle of the second axis on the platform
    assert result[machine.parameters.index("a1y")] == pytest.approx(
        result[machine.parameters.index("a2x")], rel=1e-6
    )
    largest = np.array(machine.parameters.names)[np.argsort(-np.abs(result))[:3]]
    assert set(largest) == {"a1y", "a2x", "thU2z"}


def test_ideal_model_refuses_spherical_joints_of_axes() -> None:
    with pytest.raises(MechanismError, match="Give error_model: complete"):
        replace(THREE_PRS, spherical="axes").expand()


def test_rod_too_short_is_refused_with_both_lengths() -> None:
    with pytest.raises(
        MechanismError, match="rod of chain1 is 100 mm long, but its ball is 150 mm"
    ):
        replace(THREE_PRS, rod=0.1).expand()


def test_platform_origin_of_the_ru_pus_prs_does_not_move() -> None:
    solution = solve_random_poses(build_cached_robot(RU_PUS_PRS))
    # [m] rounding
    assert_allclose(solution.T[:, :3, 3], [[0, 0, 0.6]] * len(solution.T), atol=1e-12)
