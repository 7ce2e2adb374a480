# SPDX-License-Identifier: Apache-2.0
"""Comparison of parameters with a truth: unidentifiable combinations are removed from the error
and named.
"""

import json

import numpy as np
import pytest

from loopcal.apply import validate
from loopcal.diagnose import compare_with_truth
from loopcal.errors import DataError, EstimationError
from loopcal.estimate import LeastSquares, identify
from loopcal.io.core.json_text import to_json
from loopcal.measure import Instrument, Pose, Sensor, simulate
from tests import zoo
from tests.estimate.problems import UM, URAD, hexapod, hexapod_data, hexapod_poses, noise


def simulate_in_unknown_frame(n: int = 30, seed: int = 0):
    """Simulate poses of the true hexapod in an unknown frame."""
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    kind = Pose(unknown=("frame",))
    sensor = Sensor(kind, noise(*[0.1 * URAD] * 3, *[0.02 * UM] * 3))
    placed = {"frame.x": 0.02, "frame.ry": 0.1}
    return simulate(
        truth, hexapod_poses(n, seed), Instrument((sensor,)), seed, nuisance_values=placed
    )


@pytest.fixture(scope="module")
def fit():
    return identify(hexapod(), simulate_in_unknown_frame(), LeastSquares())


def test_unidentifiable_combinations_are_removed_from_the_error_and_named(fit):
    result = compare_with_truth(fit, zoo.hexapod_truth())
    assert len(result.dropped) == 6
    assert np.abs(result.raw).max() > 0.01e-3  # [m] the base frame is free
    assert (
        np.abs(result.error).max() < 0.001e-3
    )  # [m] noise of 0.02 um and 0.1 urad, condition about 100
    finding = result.finding
    assert (finding.data["parameters"], finding.data["compared"]) == (42, 36)
    assert [c["names"] for c in finding.data["excluded"]] == [c.names for c in result.dropped]
    np.testing.assert_allclose(
        result.tolerances * fit.tolerance, result.error, rtol=1e-12, atol=1e-18
    )
    assert json.loads(to_json(result.to_dict()))["rms"] == pytest.approx(result.rms)


def test_truth_moved_along_the_null_space_gives_the_same_error(fit):
    known = fit.posterior
    rng = np.random.default_rng(0)
    null_space = known.directions[:, ~known.determined]
    move = known.unit * (null_space @ rng.standard_normal(null_space.shape[1]))
    one, other = (compare_with_truth(fit, zoo.hexapod_truth() + step) for step in (0.0, move))
    np.testing.assert_allclose(one.error, other.error, atol=1e-15)  # [m] double rounding
    seen = known.unit * known.directions[:, known.determined][:, 0]
    assert (
        np.abs(compare_with_truth(fit, zoo.hexapod_truth() + seen).error - one.error).max() > 1e-6
    )


def test_error_of_an_identifiable_robot_is_the_plain_difference():
    fit = identify(hexapod(), hexapod_data(20), LeastSquares())
    result = compare_with_truth(fit, zoo.hexapod_truth())
    assert result.dropped == ()
    np.testing.assert_array_equal(result.error, result.tolerances * fit.tolerance)
    np.testing.assert_allclose(result.error, result.raw, rtol=1e-12)
    assert result.finding.data["compared"] == 42


@pytest.mark.parametrize(
    ("truth", "message"), [(np.zeros(41), r"shape \(41,\)"), (np.full(42, np.nan), "not finite")]
)
def test_truth_with_wrong_shape_or_nan_is_refused(fit, truth, message):
    with pytest.raises(
        EstimationError, match=f"{message}.*give 42 values for all parameters of 'hexapod'"
    ):
        compare_with_truth(fit, truth)


def test_validation_keeps_the_frame_of_the_fit_unless_a_refit_is_requested(fit):
    others = simulate_in_unknown_frame(8, seed=5)
    kept = validate(fit, others)
    assert kept.alignment == {"kept": ("frame",), "fitted": ()}
    by_name = validate(fit.robot, others, before=fit.initial, nuisance_values=fit.nuisance.values)
    np.testing.assert_allclose(by_name.after.position, kept.after.position, rtol=1e-9)
    anew = validate(fit, others, refit=("fra*",))
    assert anew.alignment == {"kept": (), "fitted": ("frame",)}
    assert "validation.setup-fitted" in [f.code for f in anew.findings]
    assert anew.after.statistics("position").rms <= kept.after.statistics("position").rms
    assert json.loads(to_json(anew.to_dict()))["alignment"]["fitted"] == ["frame"]
    with pytest.raises(DataError, match=r"is called 'tracker'; the data have: frame"):
        validate(fit, others, refit=("tracker",))
