# SPDX-License-Identifier: Apache-2.0
"""Start values of unknown frames, targets and surfaces, in any orientation, without a guess."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from evidence.starts import (
    DRAWS,
    FULL_SIZE_KINDS,
    KINDS,
    NO_PLACE,
    compute_start,
    draw_poses,
    load_any_robot,
    simulate_rows,
    whitened_residuals,
)
from loopcal import geometry
from loopcal.errors import DataError
from loopcal.estimate.pose_estimate import fit_nuisance_values
from loopcal.geometry import OCTAHEDRAL_ROTATIONS, solve_trilateration
from loopcal.measure import initial_values
from loopcal.measure.initial_values import guess_nuisance_values
from loopcal.measure.kinds.directions import Direction
from loopcal.measure.kinds.distance import Distance
from loopcal.measure.kinds.position import Position
from loopcal.measure.kinds.setup_parameters import shorten_rotations
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import collect_nuisance_parameters
from loopcal.measure.observations import Observations

N = 30


def fit_values(*given):
    return fit_nuisance_values(load_any_robot(), *given)


def poses(rng):
    return draw_poses(rng, N)


@pytest.mark.parametrize("name", KINDS)
def test_start_values_of_every_unknown_explain_exact_data(name):
    for seed in range(9):
        rng = np.random.default_rng(seed)
        T = poses(rng)
        try:
            data, local, _ = simulate_rows(KINDS[name], T, rng)
        except DataError:  # a truth that cannot be measured, such as a sensor upside down
            continue
        found = fit_values(data, T, local)
        # [sigma] noise-free rows with sigma 1e-5 m or rad: 1e-8 m
        assert_allclose(
            whitened_residuals(data, T, local, found), 0.0, atol=1e-3, err_msg=f"seed {seed}"
        )
        return
    pytest.fail("no truth can be measured")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["targets in a frame", "frame and tool of poses"])
def test_start_values_are_found_for_8_random_frames_and_machine_errors(name):
    for seed in range(8):
        one = compute_start(name, seed)
        assert one is not None
        assert one.is_successful, (seed, one)


@pytest.mark.evidence
def test_evidence_every_frame_and_99_5_percent_of_others_are_found(root):
    path = root / "docs" / "evidence" / "starts.json"
    if not path.exists():
        pytest.skip("docs/evidence/starts.json is made by `make evidence`")
    rows = json.loads(path.read_text())["tables"]["found"]["rows"]
    assert [name for name, *_ in rows] == list(FULL_SIZE_KINDS)
    for name, draws, found, _, turned in rows:
        if turned is not None:
            assert found == draws == DRAWS, name
        else:  # a truth can be a length below zero, which nothing measures
            assert draws > 0.7 * DRAWS, name
            assert found >= 0.995 * draws, name


def test_kinds_that_share_a_frame_get_one_start_value():
    rng = np.random.default_rng(0)
    T = poses(rng)
    balls = Position(targets=("ball",), places=NO_PLACE, unknown=("frame", "targets"))
    data, _, truth = simulate_rows(balls, T, rng)
    axis = Direction(unknown=("frame",))
    seen = axis.measure(T[None], np.zeros((1, N, 2)), truth[None, None, :3])[0]
    both = replace(
        data,
        observations=(Observations.from_sigma(axis, np.arange(N), seen, 1e-5), *data.observations),
    )
    local = collect_nuisance_parameters(both.observations, both.labels)
    assert len(local) == 9
    assert_allclose(whitened_residuals(both, T, local, fit_values(both, T, local)), 0.0, atol=1e-3)


def test_sessions_get_separate_start_values():
    rng = np.random.default_rng(1)
    T = poses(rng)
    parts = [
        simulate_rows(KINDS["targets in a frame"], T[half], rng)[0].observations[0]
        for half in (slice(0, 15), slice(15, N))
    ]
    kind = parts[0].kind
    measured = np.concatenate([part.measured for part in parts])
    rows = Observations.from_sigma(
        kind, np.arange(N), measured, 1e-5, session=np.repeat(["mon", "tue"], 15)
    )
    data = Measurements("toy", np.zeros((N, 1)), (rows,))
    local = collect_nuisance_parameters(data.observations, data.labels)
    assert len(local) == 2 * 15
    assert_allclose(whitened_residuals(data, T, local, fit_values(data, T, local)), 0.0, atol=1e-3)


@pytest.mark.parametrize("name", ["targets in a frame", "a frame"])
def test_start_values_of_all_sessions_are_sought_together(name, monkeypatch):
    rng = np.random.default_rng(1)
    T = poses(rng)
    _, local, truth = simulate_rows(KINDS[name], T, rng)
    kind = KINDS[name].with_tool(np.eye(4))
    values = truth + rng.normal(0.0, 0.3, (6, len(local)))  # of six sessions, five poses each
    session = np.repeat([f"s{i}" for i in range(6)], 5)
    no_noise = np.zeros((1, N, len(kind.noise_columns)))
    measured = kind.measure(T[None], no_noise, values[np.repeat(np.arange(6), 5)][None])[0]
    measured[7] = np.nan  # a session with fewer rows
    rows = Observations.from_sigma(kind, np.arange(N), measured, 1e-5, session=session)
    data = Measurements("toy", np.zeros((N, 1)), (rows,))
    calls = []
    minimize = initial_values.minimize_from_starts
    monkeypatch.setattr(
        initial_values, "minimize_from_starts", lambda *a: (calls.append(0), minimize(*a))[1]
    )
    nuisance = data.nuisance_parameters
    found = guess_nuisance_values(data, [rows.measured[None]], T[None], nuisance)[0]
    assert len(calls) <= 2  # sessions with about as many rows
    assert_allclose(whitened_residuals(data, T, nuisance, found), 0.0, atol=1e-3)
    none = guess_nuisance_values(data, [rows.measured[None][:0]], T[None], nuisance)
    assert none.shape == (0, len(found))  # such as readings with which the robot reaches no pose


def test_a_frame_is_sought_with_a_few_of_many_targets(monkeypatch):
    rng, widths = np.random.default_rng(1), []
    names = tuple(f"t{i}" for i in range(20))
    kind = Position(targets=names, places=np.zeros((20, 3)), unknown=("frame", "targets"))
    T = poses(rng)
    data, local, _ = simulate_rows(kind, T, rng)

    def record(name):
        compute = getattr(initial_values, name)

        def recorded(*given):
            found = compute(*given)
            widths.append(found[0].shape[-1])
            return found

        monkeypatch.setattr(initial_values, name, recorded)

    record("_collect_candidates")
    record("minimize_from_starts")
    found = fit_values(data, T, local)
    assert set(widths) == {6 + 3 * 8}  # a fit to all rows follows
    assert_allclose(whitened_residuals(data, T, local, found), 0.0, atol=1e-3)


def test_fixed_values_are_kept_and_priors_change_start_values():
    rng = np.random.default_rng(2)
    T = poses(rng)
    data, local, truth = simulate_rows(KINDS["a frame"], T, rng)
    held = local.with_nominal(truth + np.array([0.0, 0.0, 0.0, 1e-3, 0.0, 0.0]))
    found = fit_values(data, T, held.with_fixed("frame.x"))
    assert found[3] == truth[3] + 1e-3
    loose = fit_values(data, T, held.with_prior("*", 1.0))
    assert_allclose(loose, truth, atol=1e-8)
    tight = fit_values(data, T, held.with_prior("*", 1e-9))
    assert_allclose(tight[3], truth[3] + 1e-3, atol=1e-5)


def test_points_in_one_plane_need_a_stated_side():
    rng = np.random.default_rng(3)
    T = poses(rng)
    T[:, 2, 3] = 0.8
    data, local, truth = simulate_rows(Distance(places=NO_PLACE, unknown=("anchor",)), T, rng)
    with pytest.raises(
        DataError, match=r"'anchor' begin at points of one plane, so it can be on either side"
    ):
        fit_values(data, T, local)
    side = np.array([0.0, 0.0, 0.8 + np.sign(truth[2] - 0.8)])
    rows = replace(
        data.observations[0], kind=Distance(places=NO_PLACE, unknown=("anchor",), anchor=side)
    )
    found = fit_values(replace(data, observations=(rows,)), T)
    assert_allclose(found, truth, atol=1e-7)


def test_collinear_points_with_an_unknown_frame_are_refused():
    rng = np.random.default_rng(3)
    T = poses(rng)
    T[:, :3, 3] = np.array([0.1, 0.2, 0.3]) * np.linspace(0, 1, N)[:, None]
    data, local, _ = simulate_rows(Position(places=NO_PLACE, unknown=("frame",)), T, rng)
    with pytest.raises(
        DataError, match=r"the 30 positions are collinear, so the rotation of the frame 'frame'"
    ):
        fit_values(data, T, local)


def test_every_rotation_is_within_63_deg_of_a_rotation_of_the_cube():
    assert OCTAHEDRAL_ROTATIONS.shape == (24, 3, 3)
    assert_allclose(
        OCTAHEDRAL_ROTATIONS @ np.swapaxes(OCTAHEDRAL_ROTATIONS, 1, 2),
        np.broadcast_to(np.eye(3), (24, 3, 3)),
        atol=0.0,
    )
    quaternion = np.random.default_rng(0).normal(size=(2000, 4))
    R = geometry.quaternion_to_matrix(
        quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    )
    trace = np.einsum("nij,kij->nk", R, OCTAHEDRAL_ROTATIONS).max(axis=1)
    assert np.rad2deg(np.arccos((trace.min() - 1.0) / 2.0)) < 63.0


def test_trilateration_gives_both_sides_of_a_plane():
    flat = np.random.default_rng(0).uniform(-1, 1, (10, 3)) * [1, 1, 0]
    centre = np.array([0.3, -0.2, 0.7])
    found, offsets = solve_trilateration(
        flat, np.linalg.norm(flat - centre, axis=1) + 0.1, with_offset=True
    )
    assert_allclose(np.sort(found[:, 2]), [-0.7, 0.7], atol=1e-9)
    assert_allclose(found[:, :2], np.tile(centre[:2], (2, 1)), atol=1e-9)
    assert_allclose(offsets, 0.1, atol=1e-9)


def test_rotations_of_a_start_are_at_most_half_a_turn():
    """A descent may end one or more complete turns away, where the values say another angle."""
    names = ["camera.rx", "camera.ry", "camera.rz", "camera.x", "plate.u", "plate.rx"]
    rng = np.random.default_rng(4)
    axis = rng.normal(size=(200, 3))
    angle = rng.uniform(0.0, 20.0, 200)
    axis *= (angle / np.linalg.norm(axis, axis=1))[:, None]
    values = np.concatenate([axis, rng.normal(size=(200, 2)), np.full((200, 1), 6.0)], axis=1)
    shortest = shorten_rotations(names, values)
    assert np.linalg.norm(shortest[:, :3], axis=1).max() <= np.pi + 1e-12
    assert_allclose(
        geometry.exp_so3(shortest[:, :3]),
        geometry.exp_so3(axis),
        atol=1e-13,  # rounding of 20 rad
    )
    assert_array_equal(shortest[:, 3:], values[:, 3:])
    assert_array_equal(shortest[angle <= np.pi], values[angle <= np.pi])
