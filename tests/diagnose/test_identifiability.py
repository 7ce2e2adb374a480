# SPDX-License-Identifier: Apache-2.0
"""Identifiability: rank of the hexapod, null directions at rounding level, and unidentifiable
combinations with their meaning.
"""

import json

import numpy as np
import pytest

from loopcal.diagnose.identifiable_parameters import compute_observability, identifiability
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import (
    Combination,
    describe_null_space,
    select_free_parameters,
)
from loopcal.findings import Finding
from loopcal.io.core.text_file import to_json
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.directions import Inclination
from loopcal.measure.kinds.distance import Separation
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.numerics.decomposition import decompose
from tests.estimate.problems import UM, five_dof, fold_rows, hexapod, hexapod_data, noise, tracker

FRAMES = {(): 42, ("frame",): 36, ("tool",): 36, ("frame", "tool"): 30}


def moved_frame(combination: Combination) -> str | None:
    """Return the frame of a rigid motion, or None for another combination."""
    meaning = combination.meaning
    return meaning.data.get("frame") if isinstance(meaning, Finding) else None


TURN_ABOUT_Z = {"frame": "platform", "motion": "rotation", "axis": "z", "through_origin": True}


def position_instrument() -> Instrument:
    return Instrument((Sensor(Component(("x", "y", "z")), noise(UM, UM, UM)),))


def pose_instrument(*unknown: str) -> Instrument:
    return Instrument((Sensor(Pose(unknown=unknown), tracker().sensors[0].noise),))


@pytest.mark.parametrize(
    ("instrument", "rank"), [(None, 42), (five_dof(), 41), (position_instrument(), 39)]
)
def test_rank_of_the_hexapod_equals_the_count_of_measured_freedoms(instrument, rank):
    result = identifiability(hexapod(), hexapod_data(60, instrument=instrument))
    assert result.rank == rank
    assert len(result.unidentifiable) == 42 - rank
    assert result.n_parameters == 42
    if rank < 42:
        assert result.singular_values[rank] < 1e-13 * result.singular_values[0]
        assert result.gap > 1e8


@pytest.mark.parametrize(("unknown", "rank"), FRAMES.items())
def test_unknown_frame_lowers_the_rank_by_six_rigid_motions_of_that_frame(unknown, rank):
    result = identifiability(hexapod(), hexapod_data(60, instrument=pose_instrument(*unknown)))
    assert result.rank == rank
    moved = [moved_frame(c) for c in result.unidentifiable]
    assert moved.count("base") == (6 if "frame" in unknown else 0)
    assert moved.count("platform") == (6 if "tool" in unknown else 0)


@pytest.mark.parametrize(
    ("kind", "rank"),
    [(Inclination(unknown=("gravity",)), 33), (Separation(), 33), (Position(), 39)],
)
def test_rank_of_kinds_with_setup_parameters_and_of_kinds_that_link_poses(kind, rank):
    sigma = noise(*[5 * UM] * len(kind.noise_columns))
    # a closed chain of neighbors and one of pairs further apart
    far = (
        None
        if kind.poses_per_row == 1
        else np.array([(i, (i + k) % 60) for k in (1, 7, 19) for i in range(60)])
    )
    result = identifiability(
        hexapod(), hexapod_data(60, instrument=Instrument((Sensor(kind, sigma, rows=far),)))
    )
    assert result.rank == rank


def test_unmeasured_torsion_leaves_platform_rotation_unidentifiable():
    result = identifiability(hexapod(), hexapod_data(60, instrument=five_dof()))
    (turn,) = result.unidentifiable
    moved = dict(zip(turn.names, turn.changes, strict=True))
    assert all(".platform.x" in n or ".platform.y" in n for n in moved)
    # a turn about z: dx = -w y, dy = w x at every joint
    robot = hexapod()
    values = dict(zip(robot.parameters.names, robot.values, strict=True))
    w = [moved[f"leg{i}.platform.y"] / values[f"leg{i}.platform.x"] for i in range(1, 7)]
    w += [-moved[f"leg{i}.platform.x"] / values[f"leg{i}.platform.y"] for i in range(1, 7)]
    np.testing.assert_allclose(w, w[0], rtol=1e-6)
    assert isinstance(turn.meaning, Finding)
    assert turn.meaning.data == TURN_ABOUT_Z


def test_3_prs_without_torsion_has_rank_32_of_33_and_names_three_balls():
    result = identifiability(load_robot("3-prs"), five_dof(), poses=36)
    (turn,) = result.unidentifiable
    assert (result.rank, result.n_parameters) == (32, 33)
    assert turn.names == ("a1y", "a2y", "a3y")
    np.testing.assert_allclose(turn.weights, 1 / np.sqrt(3), rtol=1e-6)
    assert isinstance(turn.meaning, Finding)
    assert turn.meaning.data == TURN_ABOUT_Z
    (finding,) = [f for f in result.findings if f.code == "fit.unidentifiable"]
    assert finding.data["names"] == turn.names
    assert "a1y, a2y and a3y, in equal parts" in str(result)


def test_ru_pus_prs_without_torsion_has_rank_24():
    result = identifiability(load_robot("ru-pus-prs"), five_dof(), poses=36)
    (turn,) = result.unidentifiable
    assert result.rank == 24
    assert set(turn.names) == {"a1y", "a2x", "thU2z"}


def test_each_parameter_has_a_state_and_the_parameters_of_its_combination():
    result = identifiability(load_robot("3-prs"), five_dof(), poses=36)
    verdict = {v.name: v for v in result.parameters}
    assert verdict["a2y"].state == "together"
    assert verdict["a2y"].others == ("a1y", "a3y")
    assert {v.state for name, v in verdict.items() if name not in {"a1y", "a2y", "a3y"}} == {
        "determined"
    }
    # the prior decides one direction of three equal parts: its share is at least 1 / sqrt 3
    assert 1 / np.sqrt(3) <= verdict["a2y"].left < 0.6


def test_weak_directions_are_listed_from_the_weakest():
    result = identifiability(load_robot("3-prs"), five_dof(), poses=36)
    assert [c.singular_value for c in result.weak] == sorted(result.singular_values[: result.rank])[
        :5
    ]
    assert result.improved == (result.singular_values > 1.0).sum() < result.rank
    assert [f.code for f in result.findings].count("fit.hardly-observable") == len(result.weak)


def test_observability_indices_equal_their_definitions():
    A = np.random.default_rng(0).normal(size=(30, 5))
    s = np.asarray(np.linalg.svd(A, compute_uv=False), dtype=float)
    result = compute_observability(s, 5, 30)
    assert result.o1**10 * 30**5 == pytest.approx(np.linalg.det(A.T @ A), rel=1e-12)  # rounding
    assert (result.o2, result.o3, result.o4) == pytest.approx(
        (1 / np.linalg.cond(A), s[-1], s[-1] ** 2 / s[0])
    )
    assert result.o5 == pytest.approx(1 / sum(1 / s))
    cut = compute_observability(np.append(s, 1e-17), 5, 30)
    assert (cut.o3, cut.left_out) == (result.o3, 1)
    assert compute_observability(np.zeros(3), 0, 4).o1 == 0.0
    assert "rows divided by sigma, columns multiplied by prior sd" in str(result)


def test_combinations_span_the_null_space():
    free = select_free_parameters(hexapod())
    null = np.linalg.qr(np.random.default_rng(0).standard_normal((42, 4))).Q
    result = describe_null_space(free, null)
    z = np.zeros((4, 42))
    for row, combination in zip(z, result, strict=True):
        for name, change in zip(combination.names, combination.changes, strict=True):
            row[free.names.index(name)] = change
    np.testing.assert_allclose(z @ null @ null.T, z, atol=1e-10)
    assert np.linalg.matrix_rank(z) == 4


def test_text_is_short_and_json_has_all_attributes():
    result = identifiability(hexapod(), hexapod_data(6))
    rank = result.findings[0]
    assert rank.code == "identifiability.rank"
    assert rank.data == {"rank": 36, "parameters": 42, "equations": 36, "tolerance": 1e-11}
    assert [f.code for f in result.findings].count("fit.unidentifiable") == 6
    assert len(str(result).splitlines()) < 42 + 40  # each parameter has a line
    assert len(repr(result)) < 120
    document = json.loads(to_json(result.to_dict()))
    assert document["rank"] == 36
    assert len(document["singular_values"]) == 42
    assert len(document["parameters"]) == 42
    assert document["unidentifiable"][0]["names"] == list(result.unidentifiable[0].names)
    assert document["findings"][0]["code"] == "identifiability.rank"


def test_collected_factor_equals_the_factor_of_a_fit_without_setup_parameters():
    from loopcal.estimate.information import collect_information, observe_poses, observe_rows

    free, data = select_free_parameters(hexapod()), hexapod_data(30)
    none = data.nuisance_parameters
    rows = observe_rows(observe_poses(free, data.readings), data, none, none.values())
    expected = decompose(fold_rows(rows), np.full(1, 180)).singular_values
    factor, reached = collect_information(free, data)
    np.testing.assert_allclose(
        decompose(factor, np.full(1, 180)).singular_values, expected, rtol=1e-11
    )  # [1] rounding
    assert reached.all()


def test_elimination_of_dependent_columns_is_the_projection_onto_their_complement():
    from loopcal.numerics.elimination import eliminate_from_factor

    rng = np.random.default_rng(1)
    F, A = rng.normal(size=(20, 3)), rng.normal(size=(20, 4))
    F = np.concatenate([F, F[:, :1] - 2 * F[:, 1:2]], axis=1)
    factor = eliminate_from_factor(
        fold_rows(np.concatenate([F, A, rng.normal(size=(20, 1))], axis=1)[None]), 4
    )
    left = A - F @ (np.linalg.pinv(F) @ A)
    R = factor[0, :4, :4]
    np.testing.assert_allclose(R.T @ R, left.T @ left, atol=1e-12)  # [1] rounding


def test_pose_out_of_reach_is_refused_with_its_name():
    data = hexapod_data(6)
    readings = data.readings.copy()
    readings[2, 0] += 5.0
    with pytest.raises(EstimationError) as error:
        identifiability(hexapod(), type(data)(data.robot_name, readings, data.observations))
    assert error.value.code == "fit.poses-out-of-reach"
    assert error.value.args[0].data["poses"] == ("3",)
