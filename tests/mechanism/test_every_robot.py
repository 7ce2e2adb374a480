# SPDX-License-Identifier: Apache-2.0
"""Every robot that comes with loopcal, 1e5 random rows inside its strokes: each returns to its
mode, or it is said why not.

A new file in src/loopcal/robots is picked up by itself.
"""

from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.mechanism import Mechanism, Solution, Status, forward, inverse

Array = NDArray[np.float64]
ROBOTS = tuple(list_shipped_robots())
ROWS, BLOCK = 100_000, 5_000
SHARE = 0.999  # of rows that must return to the mode they came from
FAR = 20.0  # times the workspace: no machine reaches all of it


@cache
def robot(name: str) -> Mechanism:
    return load_robot(name)


def drawn(machine: Mechanism, rng: np.random.Generator, n: int, wide: float = 1.0) -> Array:
    """Random controlled coordinates (n, c), evenly in ranges of the workspace widened about their
    middle.
    """
    low, high = np.array([machine.assembly.workspace[name] for name in machine.controlled]).T
    middle, half = (low + high) / 2, (high - low) / 2
    return middle + wide * half * rng.uniform(-1.0, 1.0, (n, len(low)))


def inside(machine: Mechanism, q: Array) -> NDArray[np.bool_]:
    """Rows whose readings are within every stroke."""
    low, high = np.array([a.stroke for a in machine.actuators]).T
    return ((q >= low) & (q <= high)).all(axis=1)


def rows_inside(machine: Mechanism, seed: int) -> Iterator[Solution]:
    """Blocks of solutions inside strokes, 1e5 rows in all; at least half of the workspace must be."""  # noqa: E501
    rng, found, tried = np.random.default_rng(seed), 0, 0
    while found < ROWS:
        there = inverse(machine, drawn(machine, rng, BLOCK))
        tried += BLOCK
        some = there.take(
            np.flatnonzero(there.converged & inside(machine, there.q))[: ROWS - found]
        )
        found += len(some.q)
        assert found >= 0.5 * min(tried, ROWS)
        yield some


def returned(there: Solution, back: Solution) -> NDArray[np.bool_]:
    """Rows that came back to where they were."""
    # [rad, m] Newton stops below 1e-13 of the size; the rest is the condition of the mechanism
    return back.converged & (np.abs(geometry.pose_difference(back.T, there.T)).max(axis=1) < 1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_a_hundred_thousand_rows_inside_the_strokes_return_to_their_mode_and_the_rest_say_why(
    name: str,
) -> None:
    machine, total, home = robot(name), 0, 0
    for there in rows_inside(machine, seed=20):
        back = forward(machine, there.q)
        good = returned(there, back)
        total, home = total + len(good), home + int(good.sum())
        elsewhere = np.flatnonzero(~good & back.converged)
        if len(elsewhere):
            # another true mode: the loops are closed there by the same readings
            other = back.take(elsewhere)
            again = inverse(machine, other.T, start=other)
            np.testing.assert_allclose(again.q, there.q[elsewhere], rtol=0, atol=1e-8)
        for row in np.flatnonzero(~back.converged):
            assert back.explain(int(row)).code == Status(int(back.status[row])).code
    assert total == ROWS
    assert home >= SHARE * total


@pytest.mark.parametrize("name", ROBOTS)
def test_what_cannot_be_reached_is_marked_and_never_raised(name: str) -> None:
    machine = robot(name)
    there = inverse(machine, drawn(machine, np.random.default_rng(21), 500, wide=FAR))
    # a row called closed is closed, whatever was asked for
    assert there.residual[there.converged].max(initial=0.0) <= 1e-9 * machine.size
    for row in np.flatnonzero(~there.converged)[:20]:
        assert Status(int(there.status[row])) is not Status.CONVERGED
        assert there.explain(int(row))


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_readings_beyond_all_strokes_and_nonsense_are_marked_and_never_raised(name: str) -> None:
    machine = robot(name)
    low, high = np.array([a.stroke for a in machine.actuators]).T
    q = np.random.default_rng(22).uniform(
        low - 3 * (high - low), high + 3 * (high - low), (100, len(low))
    )
    q[0], q[1] = np.nan, np.inf
    back = forward(machine, q)
    assert back.status[0] == back.status[1] == Status.NOT_FINITE
    assert np.isfinite(back.T[back.converged]).all()
    if len(machine.actuators) == len(
        machine.controlled
    ):  # lines that contradict each other leave a residual
        assert back.residual[back.converged].max(initial=0.0) <= 1e-9 * machine.size
    for row in np.flatnonzero(~back.converged):
        assert back.explain(int(row))
