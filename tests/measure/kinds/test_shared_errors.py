# SPDX-License-Identifier: Apache-2.0
"""Every kind can have a bias and a drift of each session; one that measures lengths, a scale."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.errors import DataError
from loopcal.measure.instrument import Gaussian, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.distance import Distance, Separation
from loopcal.measure.kinds.kind import SCALES, measure_progress
from loopcal.measure.kinds.poses import Component
from loopcal.measure.kinds.position import Bearing
from loopcal.measure.nuisance import collect_nuisance_parameters
from loopcal.measure.observations import Observations
from loopcal.units import Dimension
from tests.measure.kinds.test_contract import (
    attach_frame_and_tool,
    check_derivatives,
    draw_joint_values,
    platform_poses,
)

CONSTANTS = ("bias", "drift")


def measures_lengths(kind):
    return any(column.dimension is Dimension.LENGTH for column in kind.columns)


KINDS_WITH_ERRORS = [
    pytest.param(
        dataclasses.replace(
            kind, unknown=(*kind.unknown, *CONSTANTS, *(SCALES if measures_lengths(kind) else ()))
        ),
        id=f"{name}-{i}",
    )
    for name, cls in KINDS.items()
    for i, kind in enumerate(cls.examples()[:2])
    if kind.columns
]


@pytest.mark.parametrize("kind", KINDS_WITH_ERRORS)
def test_what_is_measured_with_a_bias_has_no_residual_and_right_derivatives(kind):
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 1, 3)
    joints = draw_joint_values(kind, T)
    u = len(kind.nuisance_parameters)
    shared = u - len(kind.without_shared_errors().nuisance_parameters)
    assert shared > 0
    # the bias of a length is its offset, which is no error that all kinds have
    own = 2 if kind.bias_item == "bias" else 1
    scales = len(SCALES) if measures_lengths(kind) else 0
    assert kind.is_drift[-shared:].sum() * own == shared - scales
    values = np.tile(kind.nominal_values, (1, 3, 1))
    values[..., -shared:] += 1e-5 * np.random.default_rng(1).standard_normal((1, 3, shared))
    measured = kind.measure(T, np.zeros((1, 3, len(kind.noise_columns))), values, joints)
    evaluated = kind.evaluate(T, measured, values, joints)
    assert_allclose(evaluated.residual, 0.0, atol=1e-8)  # second order where rotations are measured
    plain = kind.evaluate(T, measured, None, joints)
    assert np.abs(plain.residual).max() > 1e-6
    for i in range(u - shared, u):
        moved = values.copy()
        moved[..., i] += 1e-3
        change = kind.evaluate(T, measured, moved, joints).residual - evaluated.residual
        assert_allclose(evaluated.nuisance[..., i], change / 1e-3, atol=1e-9)


SCALED = [
    pytest.param(dataclasses.replace(kind, unknown=(*kind.unknown, "scale")), id=f"{name}-{i}")
    for name, cls in KINDS.items()
    for i, kind in enumerate(cls.examples())
    if measures_lengths(kind)
]


@pytest.mark.parametrize("kind", SCALED)
def test_derivatives_of_scaled_lengths_agree_with_finite_differences(kind):
    check_derivatives(kind, 1e-4, with_jax=False)


@pytest.mark.parametrize("kind", SCALED)
def test_a_scale_multiplies_lengths_and_leaves_angles(kind):
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 2, 5)
    noise = 1e-3 * np.random.default_rng(4).standard_normal((2, 5, len(kind.noise_columns)))
    joints, values = draw_joint_values(kind, T), np.array(kind.nominal_values)
    exact, plain = (kind.measure(T, n, values, joints) for n in (0.0 * noise, noise))
    values[-1] = 0.5
    is_length = np.array([column.dimension is Dimension.LENGTH for column in kind.columns])
    assert_allclose(
        kind.measure(T, noise, values, joints), plain + 0.5 * exact * is_length, atol=1e-14
    )  # [m, rad] rounding


@pytest.mark.parametrize("kind", [Bearing(), KINDS["direction"](), KINDS["inclination"]()])
def test_what_measures_angles_has_no_scale(kind):
    with pytest.raises(DataError, match=r"measures angles, which have no scale. Remove 'scale'"):
        dataclasses.replace(kind, unknown=("scale",))


def test_progress_is_that_in_time_within_each_session():
    session = np.array(["a", "b", "a", "b", "a"])
    assert_allclose(measure_progress(session, None), [-0.5, -0.5, 0.0, 0.5, 0.5])
    time = np.array([30.0, 5.0, 0.0, 1.0, 10.0])
    expected = [0.5, 0.5, -0.5, -0.5, -1.0 / 6.0]
    assert_allclose(measure_progress(session, time), expected, atol=1e-15)
    time[2] = np.nan  # not all known: the order counts
    assert_allclose(measure_progress(session, time), [-0.5, -0.5, 0.0, 0.5, 0.5])
    assert_allclose(measure_progress(np.array(["one"]), None), [0.0])


def test_rows_take_their_part_of_a_drift():
    kind = Component(("x", "z"), unknown=("bias", "drift")).with_tool(np.eye(4))
    rows = Observations.from_sigma(kind, np.arange(3), np.zeros((3, 2)), 1e-6, session="s")
    setup = collect_nuisance_parameters([rows], ("1", "2", "3"))
    assert setup.table.names == tuple(
        f"s.component.{item}.{axis}" for item in ("bias", "drift") for axis in "xz"
    )
    used = setup.select(0, np.array([[1.0, 2.0, 10.0, 20.0]]))
    assert_allclose(used[0], [[1, 2, -5, -10], [1, 2, 0, 0], [1, 2, 5, 10]])
    sensor = Sensor(
        kind, Gaussian(np.full(2, 1e-6)), np.arange(3), session=np.array("s")
    ).assign_rows(3)
    factors = collect_nuisance_parameters([sensor], ("1", "2", "3")).factors[0]
    assert factors is not None
    assert_allclose(factors, used[0] / [1, 2, 10, 20])


def test_two_instruments_have_errors_of_their_own():
    cameras = [
        Bearing(frame=name, unknown=("bias",), T_base_frame=np.eye(4)) for name in ("left", "right")
    ]
    names = [p.name for kind in cameras for p in kind.nuisance_parameters]
    assert len(set(names)) == len(names)
    assert all(name.startswith(("left.bias.", "right.bias.")) for name in names)


def test_the_bias_of_a_length_is_its_offset():
    wires = [
        Distance(anchor=np.ones(3), anchor_name=name, unknown=unknown)
        for name in ("wire1", "wire2")
        for unknown in (("bias",), ("offset",), ("offset", "bias"))
    ]
    names = [[p.name for p in kind.nuisance_parameters] for kind in wires]
    assert names == [["wire1.offset"]] * 3 + [["wire2.offset"]] * 3
    (name,) = Separation(unknown=("bias",)).nuisance_parameters
    assert name.name == "separation.offset"
