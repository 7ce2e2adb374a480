# SPDX-License-Identifier: Apache-2.0
"""A covariance added to a fit: covariance, directions, setup parameters and degrees agree."""

import numpy as np
import pytest

from loopcal.apply.accuracy import pose_uncertainty
from loopcal.estimate.fit_linearization import collect_uncertainty
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares, TruncatedSVD
from loopcal.estimate.posterior import CovariancePart, posterior_from_arrays
from loopcal.estimate.prior import prior_from
from loopcal.estimate.result import add_covariance
from loopcal.findings import report_finding
from loopcal.measure.instrument import Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.simulation import simulate
from tests import zoo
from tests.estimate.problems import (
    UM,
    URAD,
    Instrument,
    five_dof,
    hexapod,
    hexapod_data,
    hexapod_poses,
    noise,
    tracker,
)

REASON = report_finding("residuals.explained")
UNKNOWN_FRAME = Instrument((Sensor(Pose(unknown=("frame",)), noise(*[5 * URAD] * 3, *[UM] * 3)),))
CASES = {
    "tolerances": (tracker(), None),
    "null direction with tolerances": (five_dof(), None),
    "null direction": (five_dof(), LeastSquares()),
    "truncated": (tracker(), TruncatedSVD(36)),
    "unknown frame": (UNKNOWN_FRAME, None),
}


def make_fit(name):
    """Identify the hexapod with the instrument and the method of a case."""
    instrument, method = CASES[name]
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    return identify(hexapod(), simulate(truth, hexapod_poses(15), instrument, 3), method)


def draw_root(fit, columns, seed=0):
    """Draw a covariance root of the size of the standard deviations of the fit [SI]."""
    size = np.where(np.isfinite(fit.standard_deviations), fit.standard_deviations, 10 * UM)
    return size[:, None] * np.random.default_rng(seed).standard_normal((len(size), columns))


@pytest.mark.parametrize("name", CASES)
def test_covariance_and_directions_agree_after_two_additions(name):
    fit = make_fit(name)
    first, second = draw_root(fit, 2, 1), draw_root(fit, 5, 2)
    added = add_covariance(add_covariance(fit, first, 3.0, REASON), second, np.inf, REASON)
    expected = fit.covariance + first @ first.T + second @ second.T
    np.testing.assert_array_equal(np.isinf(added.covariance), np.isinf(fit.covariance))
    np.testing.assert_array_equal(np.isnan(added.covariance), np.isnan(fit.covariance))
    known = np.isfinite(added.standard_deviations)
    among = np.ix_(known, known)
    scale = np.sqrt(np.diag(expected)[known])
    np.testing.assert_allclose(
        (added.covariance[among] - expected[among]) / scale / scale[:, None], 0, atol=1e-12
    )
    root = added.posterior.root[known]
    np.testing.assert_allclose(
        (root @ root.T - expected[among]) / scale / scale[:, None], 0, atol=1e-9
    )
    assert added.estimate is not None
    np.testing.assert_array_equal(added.estimate, fit.estimate)
    assert added.findings[-2:] == (REASON, REASON)


@pytest.mark.parametrize("name", CASES)
def test_undetermined_directions_stay_the_same_space(name):
    fit = make_fit(name)
    added = add_covariance(fit, draw_root(fit, 4), np.inf, REASON).posterior
    before = fit.posterior
    np.testing.assert_array_equal(added.determined, before.determined)
    np.testing.assert_array_equal(np.isinf(added.variance), np.isinf(before.variance))
    for chosen in (~before.determined, np.isinf(before.variance)):
        basis = before.directions[:, chosen]
        outside = added.directions[:, chosen] - basis @ (basis.T @ added.directions[:, chosen])
        np.testing.assert_allclose(outside, 0, atol=1e-9)


def test_an_addition_to_what_is_unknown_changes_nothing_else():
    fit = make_fit("null direction")
    posterior = fit.posterior
    unknown = posterior.unit[:, None] * posterior.directions[:, np.isinf(posterior.variance)]
    added = add_covariance(fit, unknown, np.inf, REASON).posterior
    finite = np.isfinite(posterior.variance)
    order = np.sort(posterior.variance[finite])
    np.testing.assert_allclose(np.sort(added.variance[finite]), order, rtol=1e-9)


def test_a_fit_without_intervals_stays_without():
    data = hexapod_data(7, instrument=tracker())
    fit = identify(hexapod(), data, LeastSquares(), options=FitOptions(noise="estimated"))
    assert np.isnan(fit.standard_deviations).all()
    added = add_covariance(fit, np.ones((len(fit.names), 1)), 3.0, REASON)
    assert np.isnan(added.standard_deviations).all()
    assert np.isnan(added.posterior.variance).all()


def test_poses_setup_parameters_and_a_later_prior_contain_the_addition():
    fit = make_fit("unknown frame")
    root = draw_root(fit, 3)
    added = add_covariance(fit, root, np.inf, REASON)
    poses = hexapod_poses(4, seed=9)
    before, after = pose_uncertainty(fit, poses), pose_uncertainty(added, poses)
    assert (after.position > 1.05 * before.position).all()
    # a setup parameter follows the machine
    slope = fit.nuisance.slope / fit.tolerance
    np.testing.assert_allclose(
        added.nuisance.sd**2, fit.nuisance.sd**2 + ((slope @ root) ** 2).sum(axis=1), rtol=1e-12
    )
    joint = collect_uncertainty(added)
    own = (joint.root.values**2).sum(axis=1) + ((joint.slope @ joint.spread) ** 2).sum(axis=1)
    np.testing.assert_allclose(np.sqrt(own), added.nuisance.sd, rtol=1e-7)
    rows = prior_from(added.posterior).rows
    np.testing.assert_allclose(rows @ added.covariance @ rows.T, np.eye(len(rows)), atol=1e-7)


def test_effective_degrees_of_freedom_are_those_of_welch_and_satterthwaite():
    data = hexapod_data(10)
    options = FitOptions(noise="estimated")
    fit = identify(hexapod(), data, LeastSquares(), options=options)
    (noise_part,) = fit.posterior.parts
    assert (noise_part.source, noise_part.degrees) == ("noise", fit.residual_test.dof)
    np.testing.assert_allclose(noise_part.root @ noise_part.root.T, fit.covariance, rtol=1e-9)
    each = np.eye(len(fit.names))[:, None]
    np.testing.assert_allclose(fit.posterior.count_degrees(each), 18.0, rtol=1e-9)
    root = draw_root(fit, 2)
    added = add_covariance(add_covariance(fit, root, 4.0, REASON), 2 * root, np.inf, REASON)
    u1, u2 = np.diag(fit.covariance), (root**2).sum(axis=1)
    expected = (u1 + 5 * u2) ** 2 / (u1**2 / 18.0 + u2**2 / 4.0)
    np.testing.assert_allclose(added.posterior.count_degrees(each), expected, rtol=1e-9)
    # of a length, all components together
    trace = np.trace(fit.covariance[:3, :3]), (root[:3] ** 2).sum()
    of_three = (trace[0] + 5 * trace[1]) ** 2 / (trace[0] ** 2 / 18.0 + trace[1] ** 2 / 4.0)
    assert added.posterior.count_degrees(np.eye(len(fit.names))[:3]) == pytest.approx(of_three)


def test_the_noise_of_a_prior_is_the_part_that_the_rows_cause():
    fit = make_fit("null direction with tolerances")
    (part,) = fit.posterior.parts
    assert part.degrees == fit.residual_test.noise_degrees == 8 + fit.residual_test.degrees
    rest = fit.covariance - part.root @ part.root.T
    assert np.linalg.eigvalsh(rest / fit.tolerance / fit.tolerance[:, None]).min() > -1e-12
    # least squares has nothing but noise
    alone = make_fit("unknown frame")
    bare = alone.posterior.parts[0].root
    assert (np.diag(bare @ bare.T) <= np.diag(alone.covariance) * (1 + 1e-12)).all()


def test_a_run_folder_keeps_the_parts_of_the_covariance():
    fit = make_fit("tolerances")
    added = add_covariance(fit, draw_root(fit, 3), 7.0, REASON)
    arrays = added.arrays()
    read = posterior_from_arrays(added.robot, arrays)
    for part, same in zip(added.posterior.parts, read.parts, strict=True):
        assert (part.source, part.degrees) == (same.source, same.degrees)
        np.testing.assert_array_equal(part.root, same.root)
    assert isinstance(read.parts[0], CovariancePart)
