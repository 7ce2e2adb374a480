# SPDX-License-Identifier: Apache-2.0
"""Unknowns with derivatives at rounding level are unobservable: they keep their values and change
no result.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.stats import chi2

from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.linearization import Linearization, coordinate_derivative
from loopcal.estimate.pose_estimate import fit_nuisance_values
from loopcal.estimate.problem import problem_of
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.distance import Separation
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from loopcal.numerics.elimination import ROUNDING, eliminate_columns, without_rounding
from tests import zoo
from tests.estimate.problems import UM, URAD, hexapod, noise

POSES = 40
LINKS = np.array([[i, (i + k) % POSES] for k in (1, 7) for i in range(POSES)])


def simulate_parallel_poses(
    unknown: tuple[str, ...], truth: np.ndarray | None = None
) -> Measurements:
    """Simulate poses of equal orientation with full measurements and distances between poses, in
    which the position of a target cancels.
    """
    robot = hexapod()
    poses = np.tile(robot.home, (POSES, 1, 1))
    poses[:, :3, 3] += np.random.default_rng(0).uniform(-0.03, 0.03, (POSES, 3))
    distance = Sensor(Separation(unknown=unknown), noise(UM), LINKS)
    instrument = Instrument((distance, Sensor(Pose(), noise(*[5 * URAD] * 3, *[UM] * 3))))
    return simulate(
        robot if truth is None else robot.with_values(truth), poses, instrument, 1, controller=robot
    )


def linearize_nominal(data: Measurements) -> Linearization:
    """Linearize the problem at the nominal robot."""
    problem, z = problem_of(select_free_parameters(hexapod()), data), np.zeros((1, 42))
    return problem.linearize(z, problem.start(z))


def test_target_that_cancels_keeps_its_value_and_does_not_change_the_factor():
    known, unknown = (
        linearize_nominal(simulate_parallel_poses(())),
        linearize_nominal(simulate_parallel_poses(("targets",))),
    )
    assert unknown.nuisance is not None
    assert int(unknown.nuisance.elimination.rank[0]) == 0
    assert_array_equal(unknown.nuisance.values[0], 0.0)
    assert unknown.equations == known.equations
    # of factors: the rows may have been reflected
    gram, expected = (at.factor[0].T @ at.factor[0] for at in (unknown, known))
    np.testing.assert_allclose(gram, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_start_values_are_not_estimated_from_rounding():
    data = simulate_parallel_poses(("targets",))
    T = np.tile(hexapod().home, (POSES, 1, 1))
    T[:, :3, 3] += np.random.default_rng(0).uniform(-0.03, 0.03, (POSES, 3))
    T[:, :3, :3] += np.random.default_rng(1).uniform(-2e-16, 2e-16, (POSES, 3, 3))
    assert_array_equal(fit_nuisance_values(hexapod(), data, T), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [None, UM])
def test_fit_converges_from_an_unobservable_to_a_weakly_observable_target(sigma):
    """The true machine rotates by up to 0.2 mrad between commands of equal orientation, which makes
    the target weakly observable.
    """
    truth = zoo.hexapod_truth()
    data = simulate_parallel_poses(("targets",), truth)
    if sigma is not None:
        draws = np.random.default_rng(2).standard_normal(data.readings.shape)
        data = replace(data, readings=data.readings + sigma * draws, reading_sigma=sigma)
    fit = identify(hexapod(), data)
    assert fit.converged
    assert fit.rank == 42
    assert chi2.cdf(fit.chi_square, fit.residual_test.dof) < 0.9999
    assert np.abs((fit.estimate - truth) / fit.standard_deviations).max() < 4.5  # of 42: 3e-4
    assert np.abs(fit.nuisance.estimate / fit.nuisance.sd).max() < 4.0


def test_column_absorbed_by_the_poses_is_eliminated_to_zero():
    rng = np.random.default_rng(0)
    free = rng.standard_normal((1, 5, 12, 3)) * np.array([1.0, 1e3, 1e-3])
    whole, other = free @ rng.standard_normal((3, 1)), rng.standard_normal((1, 5, 12, 2))
    done = eliminate_columns(np.concatenate([free, 1e6 * whole, other], axis=-1), 3)
    assert_array_equal(done.rest[..., 0], 0.0)
    assert np.linalg.norm(done.rest[..., 1], axis=-1).min() > 1.0
    assert_array_equal(done.rank, 3)


def test_point_on_the_axis_of_a_motion_has_zero_derivative():
    rng = np.random.default_rng(3)
    point, turn = rng.standard_normal((50, 3)), rng.standard_normal((50, 3))
    move = np.concatenate([turn, -np.cross(turn, point)], axis=1)[None, :, :, None]
    jacobian = np.zeros((1, 50, 3, 6))
    jacobian[0, :, :, :3] = -np.cross(np.eye(3), -point[:, None, :]).swapaxes(1, 2)
    jacobian[0, :, :, 3:] = np.eye(3)
    assert np.any(jacobian @ move != 0.0)
    assert_array_equal(coordinate_derivative(jacobian, move), 0.0)
    shifted = move + 1e-9 * np.eye(6)[3, :, None]
    np.testing.assert_allclose(
        coordinate_derivative(jacobian, shifted)[0, :, 0, 0], 1e-9, rtol=1e-5
    )  # 1e-15 of rounding in 1e-9


def test_rounding_is_set_to_zero_but_small_and_nonfinite_values_are_kept():
    size = np.array([1e6, 1e6, 0.0, 1.0, np.inf])
    values = np.array([0.5e6 * ROUNDING, 2e6 * ROUNDING, 1e-300, np.nan, 1.0])
    assert_array_equal(without_rounding(values, size), [0.0, *values[1:]])
