# SPDX-License-Identifier: Apache-2.0
"""Nuisance parameters of measurements: sharing between rows, names, priors and refusals."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.initial_values import evaluate_measurements, whiten_rows
from loopcal.measure.kinds.directions import Direction
from loopcal.measure.kinds.distance import Separation
from loopcal.measure.kinds.poses import Component
from loopcal.measure.kinds.position import Position
from loopcal.measure.kinds.surfaces import Plane
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import collect_nuisance_parameters
from loopcal.measure.observations import Observations

TRACKER = Position(
    targets=("ball",), places=np.zeros((1, 3)), unknown=("frame", "targets"), frame="tracker"
)
AXIS = Direction(unknown=("frame",), frame="tracker")
BED = Plane(unknown=("surface",), places=np.zeros((1, 3)), surface="bed")
LEVEL = ("0", "1", "2", "3")


def make_rows(kind, count=4, **labels):
    seen = (
        np.arange(count)
        if kind.poses_per_row == 1
        else np.stack([np.arange(count), np.roll(np.arange(count), 1)], axis=1)
    )
    measured = np.ones((count, len(kind.columns)))
    if isinstance(kind, Direction):
        measured = np.tile([0.0, 0.0, 1.0], (count, 1))
    return Observations.from_sigma(kind, seen, measured, 1e-3, **labels)


def test_kinds_with_the_same_frame_share_its_parameters():
    local = collect_nuisance_parameters([make_rows(TRACKER), make_rows(AXIS)], LEVEL)
    turns = ["tracker.rx", "tracker.ry", "tracker.rz"]
    assert list(local.table.names) == [
        *turns,
        "tracker.x",
        "tracker.y",
        "tracker.z",
        "ball.x",
        "ball.y",
        "ball.z",
    ]
    assert np.array_equal(local.indices[1], np.tile([0, 1, 2], (4, 1)))


def test_every_session_and_group_has_separate_parameters():
    sessions = np.array(["mon", "mon", "tue", "tue"])
    local = collect_nuisance_parameters([make_rows(TRACKER, session=sessions)], LEVEL)
    assert len(local) == 18
    assert local.table.names[0] == "mon.tracker.rx"
    assert np.array_equal(local.indices[0][:, 0], [0, 0, 9, 9])
    groups = collect_nuisance_parameters(
        [make_rows(BED, group=np.array(["a", "b", "a", "b"]))], LEVEL
    )
    assert groups.table.names == (
        "a.bed.u",
        "a.bed.v",
        "a.bed.height",
        "b.bed.u",
        "b.bed.v",
        "b.bed.height",
    )
    assert np.array_equal(groups.indices[0][:, 2], [2, 5, 2, 5])
    both = collect_nuisance_parameters(
        [make_rows(BED, session=sessions, group=np.array(["a", "b", "a", "b"]))], LEVEL
    )
    assert "mon.a.bed.u" in both.table.names


def test_name_with_two_different_statements_is_refused():
    elsewhere = Position(targets=("ball",), places=np.ones((1, 3)), unknown=("targets",))
    with pytest.raises(
        DataError, match=r"defines the parameter 'ball.x' as 1 .*another kind defines it as 0"
    ):
        collect_nuisance_parameters([make_rows(TRACKER), make_rows(elsewhere)], LEVEL)
    turned = Direction(
        unknown=("frame",),
        frame="tracker",
        T_base_frame=geometry.make_pose(geometry.rotation_about_axis(0.1, 0), np.zeros(3)),
    )
    with pytest.raises(DataError, match=r"another orientation or place of 'tracker'"):
        collect_nuisance_parameters([make_rows(TRACKER), make_rows(turned)], LEVEL)
    clash = Position(targets=("frame",), places=np.zeros((1, 3)), unknown=("frame", "targets"))
    with pytest.raises(DataError, match=r"two parameters called 'frame\.x'"):
        collect_nuisance_parameters([make_rows(clash)], LEVEL)


def test_priors_and_values_are_set_by_name_or_pattern():
    local = (
        collect_nuisance_parameters([make_rows(TRACKER)], LEVEL)
        .with_prior("tracker.r?", 1e-3)
        .with_fixed("ball.*")
    )
    assert_allclose(local.table.tolerance[:3], 1e-3)
    assert np.isnan(local.table.tolerance[3:]).all()
    assert local.table.free.tolist() == [True] * 6 + [False] * 3
    assert local.values({"tracker.y": 2.0})[4] == 2.0
    assert local.with_nominal(np.arange(9.0)).table.nominal[8] == 8.0
    with pytest.raises(DataError, match=r"no setup parameter 'traker.x'.*tracker.x"):
        local.values({"traker.x": 1.0})
    with pytest.raises(DataError, match="no setup parameter 'camera"):
        local.with_fixed("camera.*")
    with pytest.raises(DataError, match="Give a number above 0, or fix"):
        local.with_prior("ball.*", 0.0)


def test_whitened_matrix_has_a_derivative_column_for_every_unknown():
    rng = np.random.default_rng(3)
    T = geometry.apply_twist(np.eye(4), rng.uniform(-0.3, 0.3, (2, 4, 6)))
    parts = (
        make_rows(TRACKER, session=np.array(["a", "a", "b", "b"])),
        make_rows(Separation(places=np.ones((1, 3)))),
        make_rows(AXIS),
    )
    data = Measurements("toy", np.zeros((4, 1)), parts)
    local = collect_nuisance_parameters(parts, data.labels).with_fixed("a.ball.x")
    values = local.values() + rng.uniform(-0.1, 0.1, len(local))
    D = rng.normal(size=(1, 4, 6, 5))

    def white(machine, step):
        moved = geometry.apply_twist(T, (D @ machine)[..., :])
        return whiten_rows(evaluate_measurements(data, moved, (values + step)[None], local), D)

    found = white(np.zeros(5), np.zeros(len(local)))
    M = 4 * (3 + 1 + 2)
    assert found.shape == (2, M, 5 + len(local) + 1)
    assert np.array_equal(
        found, whiten_rows(evaluate_measurements(data, T, values[None], local), D)
    )
    for column in range(5 + len(local)):
        step = np.zeros(5 + len(local))
        step[column] = 1e-6
        difference = (white(step[:5], step[5:]) - white(-step[:5], -step[5:]))[..., -1] / 2e-6
        fixed = column - 5 == local.table.index("a.ball.x")
        # [1 / SI] over whitened residuals of size 1e3: second derivatives times the step, and
        # rounding over it
        assert_allclose(found[..., column], 0.0 if fixed else difference, atol=2e-4)


def test_rows_of_weight_zero_and_missing_components_are_zero():
    measured = np.ones((4, 3))
    measured[1, 2] = np.nan
    part = Observations.from_sigma(TRACKER, np.arange(4), measured, 1e-3).with_weights(
        [1.0, 1.0, 0.0, 1.0]
    )
    data = Measurements("toy", np.zeros((4, 1)), (part,))
    T = np.broadcast_to(np.eye(4), (1, 4, 4, 4))
    found = whiten_rows(
        evaluate_measurements(
            data, T, collect_nuisance_parameters([part], data.labels).values()[None]
        ),
        np.zeros((1, 4, 6, 2)),
    )
    empty = ~found[0].any(axis=1)
    assert found.shape == (1, 12, 2 + 9 + 1)
    assert np.flatnonzero(empty).tolist() == [5, 6, 7, 8]


def test_kind_without_unknowns_has_no_nuisance_columns():
    data = Measurements("toy", np.zeros((4, 1)), (make_rows(Component(T_platform_tool=np.eye(4))),))
    found = evaluate_measurements(data, np.broadcast_to(np.eye(4), (1, 4, 4, 4)), np.zeros((1, 0)))
    assert found[0].nuisance.shape == (1, 4, 1, 0)
    assert found[0].jacobian.shape == (1, 4, 1, 1, 6)
