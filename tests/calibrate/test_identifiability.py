# SPDX-License-Identifier: Apache-2.0
"""What can be known: ranks of the hexapod, null directions at rounding level, and combinations in words."""

import json

import numpy as np
import pytest

from loopcal.calibrate import identifiability
from loopcal.calibrate.combinations import combinations
from loopcal.calibrate.scaling import unknowns
from loopcal.io.json_text import to_json
from loopcal.measure import Component, Instrument, Sensor
from tests.calibrate.problems import UM, five_dof, hexapod, hexapod_data, noise


def positions() -> Instrument:
    return Instrument((Sensor(Component(("x", "y", "z")), noise(UM, UM, UM)),))


@pytest.mark.parametrize(("instrument", "rank"), [(None, 42), (five_dof(), 41), (positions(), 39)])
def test_ranks_of_the_hexapod_are_those_of_the_measured_freedoms(instrument, rank):
    found = identifiability(hexapod(), hexapod_data(60, instrument=instrument))
    assert found.rank == rank
    assert len(found.unidentifiable) == 42 - rank
    assert found.n_parameters == 42
    if rank < 42:
        assert found.singular_values[rank] < 1e-13 * found.singular_values[0]
        assert found.gap > 1e8


def test_torsion_that_is_not_measured_leaves_the_turn_of_the_platform_open():
    found = identifiability(hexapod(), hexapod_data(60, instrument=five_dof()))
    (turn,) = found.unidentifiable
    moved = dict(zip(turn.names, turn.changes, strict=True))
    assert all(".platform.x" in n or ".platform.y" in n for n in moved)
    # a turn about z: dx = -w y, dy = w x at every joint
    robot = hexapod()
    values = dict(zip(robot.parameters.names, robot.values, strict=True))
    w = [moved[f"leg{i}.platform.y"] / values[f"leg{i}.platform.x"] for i in range(1, 7)]
    w += [-moved[f"leg{i}.platform.x"] / values[f"leg{i}.platform.y"] for i in range(1, 7)]
    np.testing.assert_allclose(w, w[0], rtol=1e-6)


def test_combinations_span_the_null_space_and_each_has_a_parameter_of_its_own():
    free = unknowns(hexapod())
    null = np.linalg.qr(np.random.default_rng(0).standard_normal((42, 4))).Q
    found = combinations(free, null)
    z = np.zeros((4, 42))
    for row, combination in zip(z, found, strict=True):
        for name, change in zip(combination.names, combination.changes, strict=True):
            row[free.names.index(name)] = change
    np.testing.assert_allclose(z @ null @ null.T, z, atol=1e-10)
    assert np.linalg.matrix_rank(z) == 4


def test_the_words_are_sentences_and_the_json_has_the_attributes():
    found = identifiability(hexapod(), hexapod_data(6))
    text = str(found)
    assert "36 of 42 parameter combinations can be identified from 36 equations" in text
    assert text.count("change nothing that was measured") == 6
    document = json.loads(to_json(found.to_dict()))
    assert document["rank"] == 36
    assert len(document["singular_values"]) == 42
