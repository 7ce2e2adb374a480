# SPDX-License-Identifier: Apache-2.0
"""Every term of a transmission: derivatives are those of differences, readings come back."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.mechanism.assembly import Actuator
from loopcal.mechanism.transmission import (
    LOAD,
    SHAPES,
    SIDE,
    TABLE,
    TRIANGLE_TERMS,
    Transmissions,
    list_constants,
    name_terms,
    nominal_terms,
)
from loopcal.units import Dimension

# A drive with every registered term, one with a broken line, a cubic cam, a triangle, and sums.
EVERY = {"gain": 1.02, **{term: 0.01 / (1 + i) for i, term in enumerate(SHAPES) if term != "gain"}}
VALUES = {f"{TABLE}{k + 1}": v for k, v in enumerate((0.0, 0.02, 0.01, -0.02, 0.03))}
CAM = {f"{TABLE}{k + 1}": v for k, v in enumerate((-0.9, -0.4, 0.0, 0.6, 1.4))}
POINTS = (-0.4, -0.15, 0.1, 0.3, 0.5)
TRIANGLE = (0.5, 0.1, 0.02, -0.1, 0.4, -0.03, 0.1, -0.05, 1.0, 0.0)
LENGTH = Dimension.LENGTH
DRIVES = (
    Actuator("every", LENGTH, terms=EVERY, period=0.7),
    Actuator("line", LENGTH, terms={"gain": -1.1, "curve": 0.1, **VALUES}, points=POINTS),
    Actuator("cam", LENGTH, terms={"gain": 0.0, **CAM}, points=POINTS, interpolation="cubic"),
    Actuator(
        "arm",
        LENGTH,
        terms={"offset": 0.62, "gain": 0.3, **dict(zip(TRIANGLE_TERMS, TRIANGLE, strict=True))},
    ),
)
MACHINES = {
    "one joint each": DRIVES,
    "sums": tuple(
        Actuator(a.name, LENGTH, None, a.terms, a.period, weights=w, points=a.points)
        for a, w in zip(DRIVES[:2], ({"every": 1.0, "line": 0.4}, {"line": 1.2}), strict=True)
    ),
}
RNG = np.random.default_rng(5)
READINGS = RNG.uniform(-0.5, 0.6, (2, 40, 4))  # beyond the points of the tables, too
STEP = 1e-6


def describe(machine: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return readings with directions, terms of two trials, constants and names of terms."""
    drives = MACHINES[machine]
    tau = np.repeat(nominal_terms(drives)[None], 2, axis=0)
    tau[1, :, 1] *= 1.01
    q = READINGS[..., : len(drives)]
    q = np.concatenate([q, RNG.choice([-1.0, 1.0], q.shape)], axis=-1)
    return q, tau, list_constants(drives), name_terms(drives)


NAMES = [name for name in name_terms(DRIVES) if name not in ("side", "middle")]


@pytest.mark.parametrize("term", NAMES)
def test_the_derivative_by_a_term_is_that_of_differences(term: str) -> None:
    q, tau, constants, names = describe("one joint each")
    if term == "compliance":
        loads = [Actuator(f"{LOAD}{a.name}", Dimension.FORCE, reference=0.0) for a in DRIVES]
        constants = list_constants(DRIVES, (*DRIVES, *loads))
        q = np.concatenate([READINGS, READINGS[..., ::-1]], axis=-1)
    i = names.index(term)
    move = np.zeros_like(tau)
    move[..., i] = STEP
    low, high = (Transmissions(tau + s * move, constants).find_joints(q) for s in (-1.0, 1.0))
    slopes = Transmissions(tau, constants).differentiate_terms(q)
    found = np.broadcast_to(slopes[i], low.shape)
    acts = [a.name for k, a in enumerate(DRIVES) if np.abs(found[..., k]).max() > 1e-3]
    assert acts  # each term moves a joint of this machine
    drives = [k for k, a in enumerate(DRIVES) if a.is_triangle or term not in TRIANGLE_TERMS]
    difference = (high - low) / (2 * STEP)
    # second order of a step of 1e-6, and rounding over it
    assert_allclose(found[..., drives], difference[..., drives], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("machine", MACHINES)
def test_the_slope_of_a_transmission_is_that_of_differences(machine: str) -> None:
    q, tau, constants, _ = describe(machine)
    drives, move = Transmissions(tau, constants), np.zeros_like(q)
    move[..., : len(constants)] = STEP
    low, high = (drives.transmit(q + s * move) for s in (-1.0, 1.0))
    found = np.broadcast_to(drives.differentiate(q), low.shape)
    # a step across a corner of the broken line is excluded
    corner = np.abs(q[..., : len(constants), None] - np.array(POINTS)).min(axis=-1) > 2 * STEP
    assert_allclose(found[corner], ((high - low) / (2 * STEP))[corner], rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("machine", MACHINES)
def test_readings_come_back_from_joint_values(machine: str) -> None:
    q, tau, constants, _ = describe(machine)
    plain, drives = q[..., : len(constants)], Transmissions(tau, constants)
    joints = drives.find_joints(plain)
    assert_allclose(drives.find_readings(joints), plain, rtol=0, atol=1e-13)


def test_a_table_goes_through_its_points_and_straight_on() -> None:
    _, tau, constants, _ = describe("one joint each")
    q = np.zeros((1, 7, 4))
    q[0, :, 2] = [*POINTS, 0.6, 0.7]
    cam = Transmissions(tau[:1], constants).find_joints(q)[0, :, 2]
    assert_allclose(cam[:5], list(CAM.values()), atol=1e-15)
    assert_allclose(cam[6] - cam[5], cam[5] - cam[4], atol=1e-14)


def test_triangle_terms_keep_their_places_behind_the_shapes() -> None:
    assert name_terms(DRIVES)[SIDE] == "side"
    assert name_terms(DRIVES)[len(SHAPES) : SIDE + 2] == TRIANGLE_TERMS
