# SPDX-License-Identifier: Apache-2.0
"""Requirements on every kind of measurement.

The tests loop over `KINDS` and the examples of each, so that a new kind is tested at once.
"""

import copy
import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.position import Bearing
from loopcal.measure.observations import Observations
from loopcal.units import Dimension
from tests.jacobians import check_jacobian

INSTANCES = [
    (f"{name}-{i}", kind) for name, cls in KINDS.items() for i, kind in enumerate(cls.examples())
]
EXAMPLES = [pytest.param(kind, id=name) for name, kind in INSTANCES]
WITH_UNKNOWNS = [
    pytest.param(kind, id=name) for name, kind in INSTANCES if kind.nuisance_parameters
]
WITH_MOST_UNKNOWNS = [
    max((kind for _, kind in INSTANCES if type(kind) is cls), key=lambda k: len(k.nominal_values))
    for cls in KINDS.values()
    if cls.examples()[0].columns
]
"""One example of each kind: compiling its derivative takes a second."""
WITH_JOINTS = [pytest.param(kind, id=name) for name, kind in INSTANCES if kind.sensed_joints]
T_BASE_FRAME = geometry.apply_twist(np.eye(4), np.array([0.5, 0.1, -0.9, 1.1, -0.7, 0.3]))
T_PLATFORM_TOOL = geometry.apply_twist(np.eye(4), np.array([0.3, -0.5, 0.2, 0.02, -0.05, 0.11]))
every_kind = pytest.mark.parametrize("kind", EXAMPLES)
every_kind_with_columns = pytest.mark.parametrize(
    "kind", [pytest.param(kind, id=name) for name, kind in INSTANCES if kind.columns]
)


def size_of(kind):
    """Return the size of the measured numbers: pixels are larger than lengths and angles."""
    return float(max(kind.nominal_lens[:2])) if kind.name == "image" else 1.0


def platform_poses(kind, t, r, seed=0, spread=0.4):
    """Return random platform poses (t, r, 4, 4), or (t, r, 2, 4, 4) for kinds of pose pairs."""
    shape = (t, r, 6) if kind.poses_per_row == 1 else (t, r, kind.poses_per_row, 6)
    return geometry.apply_twist(
        np.eye(4), np.random.default_rng(seed).uniform(-spread, spread, shape)
    )


def attach_frame_and_tool(kind):
    """Return the kind with a tool, and with a stated frame if it has one."""
    stated = getattr(kind, "T_base_frame", None)
    if stated is not None and np.array_equal(stated, np.eye(4)):
        kind = dataclasses.replace(kind, T_base_frame=T_BASE_FRAME)
    return kind.with_tool(T_PLATFORM_TOOL)


def draw_nuisance_values(kind, seed=2):
    """Return values of the unknowns (1, 1, u) that differ from nominal, None without unknowns."""
    if not kind.nuisance_parameters:
        return None
    return kind.nominal_values[None, None] + np.random.default_rng(seed).uniform(
        -0.2, 0.2, (1, 1, len(kind.nuisance_parameters))
    )


def draw_joint_values(kind, T, seed=3):
    """Return values of the sensed joints (t, r, j), None without sensed joints."""
    if not kind.sensed_joints:
        return None
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (*T.shape[:2], len(kind.sensed_joints)))


def measure_with_errors(kind, T, size, seed=1):
    """Return measurements of the true poses with errors of this size, and the errors."""
    noise = size * np.random.default_rng(seed).uniform(
        -1.0, 1.0, (*T.shape[:2], len(kind.noise_columns))
    )
    return kind.measure(T, noise, draw_nuisance_values(kind), draw_joint_values(kind, T)), noise


def evaluate_kind(kind, T, measured):
    """Evaluate the kind at drawn values of its unknowns and joints."""
    return kind.evaluate(T, measured, draw_nuisance_values(kind), draw_joint_values(kind, T))


@every_kind
def test_kind_is_registered_and_its_columns_have_dimensions(kind):
    assert KINDS[kind.name] is type(kind)
    assert len({c.name for c in kind.columns}) == len(kind.columns)
    assert bool(kind.columns) == (kind.name != "closure"), "only readings have no column"
    assert all(isinstance(c.dimension, Dimension) for c in (*kind.columns, *kind.noise_columns))
    assert all(p.scope in ("machine", "session", "group", "pose") for p in kind.nuisance_parameters)


@every_kind
def test_shapes_follow_the_numbers_of_trials_and_rows(kind):
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 3, 5)
    measured, _ = measure_with_errors(kind, T, 1e-3)
    m, links = len(kind.noise_columns), () if kind.poses_per_row == 1 else (kind.poses_per_row,)
    assert measured.shape == (3, 5, len(kind.columns))
    assert kind.detect_present(measured).shape == (3, 5, m)
    assert kind.linearize_noise(measured).shape == (3, 5, m, m)
    for rows in (measured, measured[:1]):
        result = evaluate_kind(kind, T, rows)
        assert result.residual.shape == (3, 5, m)
        assert result.jacobian.shape == (3, 5, *links, m, 6)
        assert (result.nuisance is None) == (not kind.nuisance_parameters)


@every_kind
def test_residual_of_a_noise_free_measurement_is_zero(kind):
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 2, 50)
    measured, _ = measure_with_errors(kind, T, 0.0)
    residual = evaluate_kind(kind, T, measured).residual
    assert_allclose(
        residual, 0.0, atol=1e-13 * size_of(kind)
    )  # [m, rad], ulps over the sine of the smallest tilt, about 0.01


@every_kind
def test_residual_of_a_noisy_measurement_is_minus_the_mapped_noise(kind):
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 2, 50)
    measured, noise = measure_with_errors(kind, T, 1e-6)
    residual = evaluate_kind(kind, T, measured).residual
    expected = -(kind.linearize_noise(measured) @ noise[..., None])[..., 0]
    assert_allclose(
        residual, expected, atol=1e-11 * size_of(kind)
    )  # [m, rad], the square of the noise times the bend of the angles


def check_derivatives(kind, error, *, with_jax):
    """Check derivatives by the platform's twist (of every pose of a row) and by the unknowns."""
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 2, 4, seed=5)
    measured, _ = measure_with_errors(kind, T, error)
    values, joints = draw_nuisance_values(kind), draw_joint_values(kind, T)
    found = kind.evaluate(T, measured, values, joints)
    parts = (
        [found.jacobian]
        if kind.poses_per_row == 1
        else [found.jacobian[:, :, link] for link in range(kind.poses_per_row)]
    )
    if kind.sensed_joints:  # differences of nothing prove nothing
        assert not found.jacobian.any()
        parts = []
    n = 6 * len(parts)
    shape = (6,) if kind.poses_per_row == 1 else (kind.poses_per_row, 6)

    whole = copy.copy(kind)
    vars(whole)["divided"] = None  # jax takes no assignment to places in arrays

    def residual(x):
        """Return residuals at x (k,), with the same small motion in every row and trial."""
        moved = geometry.apply_twist(T, x[:n].reshape(shape)) if n else T
        unknown = None if values is None else values + x[n:]
        return whole.evaluate(moved, measured, unknown, joints).residual

    def residuals(points):
        """Return residuals at points (m, k), each in trials of its own."""

        def repeat(rows):
            """Return rows (t, r, c) once for each point, (m t, r, c)."""
            return None if rows is None else np.tile(rows, (len(points), 1, 1))

        twist = points[:, :n].reshape(-1, 1, 1, *shape) if n else np.zeros((len(points), 1, 1, 6))
        moved = geometry.apply_twist(T, twist).reshape(-1, *T.shape[1:])
        unknown = None
        if values is not None:
            unknown = np.repeat(values[0] + points[:, None, n:], len(T), axis=0)
        result = kind.evaluate(moved, repeat(measured), unknown, repeat(joints))
        return result.residual.reshape(len(points), *found.residual.shape)

    if found.nuisance is not None:
        parts.append(found.nuisance)
    if parts:
        jacobian = np.concatenate(parts, axis=-1)
        reason = "[rad] per 0.05 rad, rounding of angles near small tilt"
        automatic = residual if with_jax else None
        zero = np.zeros(jacobian.shape[-1])
        check_jacobian(
            residuals,
            jacobian,
            zero,
            scale=0.05,
            automatic=automatic,
            atol=1e-13 * size_of(kind),
            atol_reason=reason,
            is_batched=True,
        )


@every_kind_with_columns
@pytest.mark.parametrize("error", [1e-4, 0.3])
def test_derivatives_by_twist_and_unknowns_agree_with_finite_differences(kind, error):
    check_derivatives(kind, error, with_jax=False)


@pytest.mark.evidence
@pytest.mark.parametrize("kind", WITH_MOST_UNKNOWNS)
def test_derivatives_by_twist_and_unknowns_agree_with_automatic_ones(kind):
    check_derivatives(kind, 0.1, with_jax=True)


@pytest.mark.parametrize("kind", WITH_JOINTS)
def test_derivatives_by_joints_agree_with_finite_differences(kind):
    T = platform_poses(kind, 2, 4)
    measured, _ = measure_with_errors(kind, T, 1e-3)
    joints = draw_joint_values(kind, T)
    found = kind.evaluate(T, measured, draw_nuisance_values(kind), joints).joints

    def residual(x):
        return kind.evaluate(T, measured, draw_nuisance_values(kind), joints + x).residual

    check_jacobian(residual, found, np.zeros(len(kind.sensed_joints)), scale=0.05, atol=1e-13)
    with pytest.raises(DataError, match="needs the values of"):
        kind.evaluate(T, measured, draw_nuisance_values(kind))


@pytest.mark.parametrize("kind", WITH_UNKNOWNS)
def test_nuisance_values_may_differ_between_rows_and_trials(kind):
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 2, 3)
    joints = draw_joint_values(kind, T)
    values = kind.nominal_values + np.random.default_rng(8).uniform(
        -0.1, 0.1, (2, 3, len(kind.nuisance_parameters))
    )
    measured = kind.measure(T, np.zeros((2, 3, len(kind.noise_columns))), values, joints)
    together = kind.evaluate(T, measured, draw_nuisance_values(kind), joints)
    rounding = size_of(kind)
    residual = kind.evaluate(T, measured, values, joints).residual
    assert_allclose(residual, 0.0, atol=1e-13 * rounding)
    one = (slice(1, 2), slice(2, 3))
    alone = kind.measure(
        T[one],
        np.zeros((1, 1, len(kind.noise_columns))),
        values[one],
        None if joints is None else joints[one],
        measured[one][0, :, : kind.label_count],
    )
    assert_allclose(alone[0, 0], measured[1, 2], atol=1e-14 * rounding)
    assert np.abs(together.residual).max() > 1e-3


@every_kind
def test_missing_components_are_zero_and_do_not_change_the_others(kind):
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 2, 20)
    measured, _ = measure_with_errors(kind, T, 1e-3)
    whole = evaluate_kind(kind, T, measured)
    for column in range(len(kind.columns)):
        holed = measured.copy()
        holed[:, ::2, column] = np.nan
        present = kind.detect_present(holed)
        part = evaluate_kind(kind, T, holed)
        assert not present[:, ::2].all()
        assert present[:, 1::2].all()
        assert_allclose(part.residual[~present], 0.0, atol=0.0)
        absent = ~present[..., None] if kind.poses_per_row == 1 else ~present[..., None, :, None]
        assert_allclose(part.jacobian[np.broadcast_to(absent, part.jacobian.shape)], 0.0, atol=0.0)
        assert_allclose(part.residual[:, 1::2], whole.residual[:, 1::2], atol=0.0)
        assert np.isfinite(part.residual).all()
        assert np.isfinite(part.jacobian).all()


@every_kind
def test_rows_do_not_depend_on_their_batch(kind):
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 3, 6)
    measured, _ = measure_with_errors(kind, T, 1e-3)
    together = evaluate_kind(kind, T, measured)
    for i, j in ((0, 0), (2, 5)):
        one = (slice(i, i + 1), slice(j, j + 1))
        joints = draw_joint_values(kind, T)
        alone = kind.evaluate(
            T[one],
            measured[one],
            draw_nuisance_values(kind),
            None if joints is None else joints[one],
        )
        # numpy takes another path through vectorised sines and small products for other lengths: a
        # rounding each
        rounding = size_of(kind)
        assert_allclose(alone.residual[0, 0], together.residual[i, j], atol=1e-14 * rounding)
        assert_allclose(alone.jacobian[0, 0], together.jacobian[i, j], atol=1e-12 * rounding)


@pytest.mark.parametrize("spread", [0.4, 1e-14])
@pytest.mark.parametrize("kind", WITH_UNKNOWNS)
def test_rounding_is_sought_row_by_row_only_where_there_may_be_some(kind, spread, monkeypatch):
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 2, 5, spread=spread)
    measured, _ = measure_with_errors(kind, T, 1e-3)
    at_once = evaluate_kind(kind, T, measured).nuisance
    monkeypatch.setattr("loopcal.measure.kinds.kind.has_rounding", lambda *_: True)
    np.testing.assert_array_equal(at_once, evaluate_kind(kind, T, measured).nuisance)


@every_kind
def test_kind_without_a_tool_is_refused_and_keeps_the_first_tool(kind):
    if kind.has_tool:
        assert kind.with_tool(T_PLATFORM_TOOL) is kind
        return
    with pytest.raises(DataError, match=r"[Uu]se kind\.with_tool\(robot\.tool\)"):
        Observations(
            kind, np.array([0]), np.zeros((1, len(kind.columns))), np.eye(len(kind.noise_columns))
        )
    once = kind.with_tool(T_PLATFORM_TOOL)
    assert once.has_tool
    assert once.with_tool(np.eye(4)) is once


@every_kind_with_columns
def test_no_row_has_no_residual(kind):
    kind = attach_frame_and_tool(kind)
    T = platform_poses(kind, 1, 2)
    measured, joints = measure_with_errors(kind, T, 1e-4)[0], draw_joint_values(kind, T)
    none = [None if x is None else x[:, :0] for x in (T, measured, joints)]
    values = draw_nuisance_values(kind)
    found = kind.evaluate(none[0], none[1], None if values is None else values[:1], none[2])
    whole = kind.evaluate(T, measured, None if values is None else values[:1], joints)
    assert found.residual.shape == whole.residual[:1, :0].shape
    assert found.jacobian.shape[1:] == whole.jacobian[:, :0].shape[1:]


@every_kind
def test_arrays_of_a_kind_are_read_only(kind):
    for value in vars(kind.with_tool(T_PLATFORM_TOOL)).values():
        assert not isinstance(value, np.ndarray) or not value.flags.writeable


@pytest.mark.parametrize("form", ["theodolite", "camera"])
def test_bearing_of_a_target_in_the_instrument_has_no_derivative_and_no_warning(form):
    kind = Bearing(places=np.zeros((1, 3)), form=form)
    parts = kind.evaluate(np.eye(4)[None, None], np.zeros((1, 2)))
    assert not np.isfinite(parts[1]).all()
