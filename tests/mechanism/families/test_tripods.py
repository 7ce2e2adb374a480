# SPDX-License-Identifier: Apache-2.0
"""3-PRS and RU-PUS-PRS: sensitivities against derivations by hand, ranks, null directions.

The formulas are those of docs/theory/tripods.md, from the loops |v_i| = l_i, v_i . r_i = 0 and so
on. They share no code with the package.
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
from loopcal.mechanism.families.prs import LEFT_OUT, RuPusPrs, ThreePrs
from loopcal.mechanism.families.records import PoseRecord, Workspace
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


# --- the error models by hand


def rotation_about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def sphere_row(
    N: Array, R: Array, a: Array, b: Array, q: float, Z: Array, tags: dict[str, str]
) -> tuple[Array, dict]:
    """w . dN + (R a x w) . om = dl + w . [Z db + s dq + q Z (dthBy, -dthBx, 0)] - w . R Z da: twist
    row, parameter slopes.
    """
    v = N + R @ a - b - q * EZ
    w = v / np.linalg.norm(v)
    slopes = {tags["l"]: 1.0} | guide_derivatives(w, R, q, Z, tags)
    return np.concatenate([np.cross(R @ a, w), w]), slopes


def hinge_row(
    N: Array, R: Array, a: Array, b: Array, q: float, Z: Array, r: Array, tags: dict
) -> tuple[Array, dict]:
    """r . dN + (R a x r) . om = r . [Z db + s dq + q Z (dthBy, -dthBx, 0)] - r . R Z da - v . dr,
    dr = (Z dthC) x r.
    """
    v = N + R @ a - b - q * EZ
    slopes = guide_derivatives(r, R, q, Z, tags)
    for axis in "xyz":
        if f"thC{axis}" in tags:
            slopes[tags[f"thC{axis}"]] = -float(v @ np.cross(Z @ np.eye(3)["xyz".index(axis)], r))
    return np.concatenate([np.cross(R @ a, r), r]), slopes


def guide_derivatives(w: Array, R: Array, q: float, Z: Array, tags: dict[str, str]) -> dict:
    """Return the derivatives of joint centers, offset and guide along w."""
    result = {tags["q"]: w @ EZ, tags["thBx"]: -q * (w @ Z @ EY), tags["thBy"]: q * (w @ Z @ EX)}
    result |= {tags[f"b{axis}"]: w @ Z @ np.eye(3)["xyz".index(axis)] for axis in "xy"}
    return result | {tags[f"a{axis}"]: -w @ R @ Z @ np.eye(3)["xyz".index(axis)] for axis in "xyz"}


def parameter_names(i: int, joint: str) -> dict[str, str]:
    """Return the paper's names of the parameters of chain i."""
    keys = ["ax", "ay", "az", "bx", "by", "q", "l", "thBx", "thBy"]
    keys += [f"thC{axis}" for axis in joint]
    return {key: f"{key[:-1]}{i}{key[-1]}" if key[-1] in "xyz" else f"{key}{i}" for key in keys}


def three_prs_rows(N: Array, R: Array, q: Array) -> list[tuple[Array, dict]]:
    """Return the six loop equations of the 3-PRS."""
    result = []
    for i in range(3):
        Z = rotation_about_z(2 * np.pi / 3 * i)
        a, b, names = Z @ [0.2, 0, 0], Z @ [0.35, 0, 0], parameter_names(i + 1, "xz")
        result.append(sphere_row(N, R, a, b, q[i], Z, names))
        result.append(hinge_row(N, R, a, b, q[i], Z, Z @ EY, names))
    return result


def ru_pus_prs_rows(N: Array, R: Array, q: Array) -> list[tuple[Array, dict]]:
    """Return the six loop equations of the RU-PUS-PRS.

    They are two rods, the hinge of chain 2, |N| = r, n . N = 0 and u1 . R u2 = 0.
    """
    a1, b1, a2, b2 = -0.3 * EX, -0.4 * EX, 0.3 * EY, 0.4 * EY
    eye, u1, u2 = np.eye(3), EX, R @ EY
    zero = np.zeros(3)
    post = {
        "thU1y": -u2 @ np.cross(EY, u1),
        "thU1z": -u2 @ np.cross(EZ, u1),
        "thOz": -u2 @ np.cross(EZ, u1),
    }
    post |= {"thU2x": -u1 @ R @ np.cross(EX, EY), "thU2z": -u1 @ R @ np.cross(EZ, EY)}
    return [
        sphere_row(N, R, a1, b1, q[0], eye, parameter_names(1, "")),
        sphere_row(N, R, a2, b2, q[1], eye, parameter_names(2, "")),
        hinge_row(N, R, a2, b2, q[1], eye, EX, parameter_names(2, "yz")),
        (np.concatenate([zero, N / np.linalg.norm(N)]), {"r": 1.0}),
        # the pivot along n = y: its turn about x tips the post sideways, that about z leaves N
        # where it is
        (
            np.concatenate([zero, EY]),
            {"thOx": -N @ np.cross(EX, EY), "thOz": -N @ np.cross(EZ, EY)},
        ),
        # u1 is carried by the post: it turns with the pivot about z, and about y with N, du1 = dN_x
        # / r (y x x)
        (np.concatenate([np.cross(u2, u1), -EX * (u2 @ EZ) / np.linalg.norm(N)]), post),
    ]


def sensitivities_by_hand(rows: list[tuple[Array, dict]], names: tuple[str, ...]) -> Array:
    """D = J^-1 G (6, p), twist (rotation, translation) per parameter."""
    J = np.stack([row for row, _ in rows])
    G = np.array([[slopes.get(name, 0.0) for name in names] for _, slopes in rows])
    return np.asarray(np.linalg.solve(J, G), dtype=float)


MODELS = {
    "3-PRS": (THREE_PRS, three_prs_rows),
    "RU-PUS-PRS, 25": (RU_PUS_PRS, ru_pus_prs_rows),
    "RU-PUS-PRS, 27": (replace(RU_PUS_PRS, parameters="twenty-seven"), ru_pus_prs_rows),
}


@pytest.mark.parametrize("case", MODELS)
def test_sensitivities_equal_the_error_model_derived_by_hand(case: str) -> None:
    record, rows = MODELS[case]
    machine = build_cached_robot(record)
    solution = solve_random_poses(machine)
    D = differentiate_pose(
        machine, machine.values[None], solution.q[None], solution.state
    ).parameters[0]
    expected = np.stack(
        [
            sensitivities_by_hand(rows(T[:3, 3], T[:3, :3], q), machine.parameters.names)
            for T, q in zip(solution.T, solution.q, strict=True)
        ]
    )
    # [m/m, rad/m, ..] condition of the six loops 1e2 times rounding
    assert_allclose(D, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


# --- the closure by hand, at any parameters


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


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-3, 1e-2])
@pytest.mark.parametrize("case", MODELS)
def test_sensitivities_at_perturbed_parameters_equal_complex_steps(case: str, size: float) -> None:
    # [m] and angles of 5 (50) mrad: centers, guides, joints and post all displaced, also against
    # each other
    record, rows = MODELS[case]
    machine = perturb(build_cached_robot(record), size, seed=11)
    solution = solve_random_poses(machine, 10)
    D = differentiate_pose(
        machine, machine.values[None], solution.q[None], solution.state
    ).parameters[0]
    kind, names = rows.__name__.removesuffix("_rows"), machine.parameters.names
    result = [
        sensitivities_by_complex_steps(kind, names, machine.values, T, q)
        for T, q in zip(solution.T, solution.q, strict=True)
    ]
    expected = np.stack([slopes for _, slopes in result])
    # [m, 1] the machine stands on these loops
    assert max(np.abs(residual).max() for residual, _ in result) < 1e-12
    # [m/m, rad/m, ..] condition of the loops 1e2 times rounding
    assert_allclose(D, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("case", MODELS)
def test_hand_derivation_and_complex_steps_agree_at_nominal_parameters(case: str) -> None:
    record, rows = MODELS[case]
    machine = build_cached_robot(record)
    solution = solve_random_poses(machine, 6)
    names = machine.parameters.names
    for T, q in zip(solution.T, solution.q, strict=True):
        _, slopes = sensitivities_by_complex_steps(
            rows.__name__.removesuffix("_rows"), names, machine.values, T, q
        )
        expected = sensitivities_by_hand(rows(T[:3, 3], T[:3, :3], q), names)
        assert_allclose(slopes, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_parameter_names_of_3_prs_and_ru_pus_prs() -> None:
    names = build_cached_robot(THREE_PRS).parameters.names
    assert len(names) == 33
    assert " ".join(names[:11]) == "a1x a1y a1z b1x b1y q1 l1 thB1x thB1y thC1x thC1z"
    names = build_cached_robot(RU_PUS_PRS).parameters.names
    assert len(names) == 25
    more = build_cached_robot(MODELS["RU-PUS-PRS, 27"][0]).parameters.names
    assert set(more) - set(names) == set(LEFT_OUT)
    assert names[-5:] == ("r", "thOx", "thU1y", "thU2x", "thU2z")


# --- identifiability


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
    machine = build_cached_robot(replace(THREE_PRS, parameters="fourteen"))
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
    with pytest.raises(MechanismError, match="state error_model: complete"):
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
