# SPDX-License-Identifier: Apache-2.0
"""Comparison of parameters with a truth or a stored answer: unidentifiable combinations are removed
and named, and the p value of a right answer is uniform.
"""

import json
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import scipy.stats

from loopcal.apply.validation import validate
from loopcal.diagnose.value_comparison import compare_with_truth, compare_with_values
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares, TruncatedSVD
from loopcal.io.core.text_file import to_json
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Noise, Sensor
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.workspace import sample_workspace
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
        EstimationError, match=f"{message}.*Give 42 values for all parameters of 'hexapod'"
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
    with pytest.raises(DataError, match=r"has the name 'tracker'; the data have: frame"):
        validate(fit, others, refit=("tracker",))


ROBOT = load_robot("linear-delta")
SIGMA = 20e-6  # [m]
SIZES = [(16, 0.392), pytest.param(100, 0.163, marks=pytest.mark.evidence)]
"""Simulated machines, and how far their p values may be from uniform ones (KS test, 1 %)."""


class UnderstatedNoise(Noise):
    """Noise that is larger than the sigma that is stated."""

    def __init__(self, scale: float) -> None:
        self.scale = scale

    @property
    def sigma(self) -> np.ndarray:
        return np.array([SIGMA])

    def draw(self, generator: np.random.Generator, n: int) -> np.ndarray:
        return self.scale * SIGMA * generator.standard_normal((n, 1))


def simulate_printers(scale: float, count: int):
    """Simulate heights of machines with drawn errors; the noise is `scale` times the stated one."""
    poses = np.random.default_rng(7).uniform([-0.06, -0.06, 0.0], [0.06, 0.06, 0.02], (14, 3))
    free = [name for name in ROBOT.parameters.names if "arm" not in name and name != "tower3.angle"]
    robot = replace(ROBOT, parameters=ROBOT.parameters.with_free(free))
    instrument = Instrument((Sensor(Component(("z",)), UnderstatedNoise(scale)),))
    for i, values in enumerate(sample_truth(robot, count, seed=3)):
        yield robot, simulate(robot.with_values(values), poses, instrument, seed=i), values


def measure_uniformity(p_values: list[float]) -> float:
    """Return the largest distance of the distribution of p values from the uniform one."""
    ordered = np.sort(p_values)
    steps = np.arange(len(ordered) + 1) / len(ordered)
    return float(np.max(np.maximum(ordered - steps[:-1], steps[1:] - ordered)))


@pytest.mark.slow
@pytest.mark.parametrize(("count", "limit"), SIZES)
@pytest.mark.parametrize(
    ("options", "scale"),
    [
        (FitOptions(method=LeastSquares()), 1.0),
        (FitOptions(method=MAP()), 1.0),
        (FitOptions(method=LeastSquares(), noise="estimated"), 3.0),
    ],
    ids=["least squares", "tolerances as prior", "sigma three times too small, estimated"],
)
def test_p_value_of_a_right_answer_is_uniform_and_a_wrong_one_is_rejected(
    options, scale, count, limit
) -> None:
    right, some, wrong = [], [], []
    for robot, data, truth in simulate_printers(scale, count):
        fit = identify(robot, data, options=options)
        values = dict(zip(robot.parameters.names, truth, strict=True))
        result = compare_with_values(fit, values)
        right.append(result.p_value)
        part = {name: values[name] for name in ("radius", "tower1.stop")}
        some.append(compare_with_values(fit, part).p_value)
        moved = {**values, "tower1.stop": values["tower1.stop"] + 2e-3}
        wrong.append(compare_with_values(fit, moved).agrees)
    assert measure_uniformity(right) < limit
    assert measure_uniformity(some) < limit
    assert not any(wrong)


def test_stated_sigma_that_is_wrong_decides_unless_it_is_estimated() -> None:
    """A sigma three times too small rejects right answers; estimated noise does not.

    Fewer than 12 of 15 intervals of 95 % contain the truth with a probability of 0.5 %.
    """
    accepted: dict[Literal["given", "estimated"], int] = {"given": 0, "estimated": 0}
    for robot, data, truth in simulate_printers(3.0, 15):
        for basis in accepted:
            options = FitOptions(method=LeastSquares(), noise=basis)
            fit = identify(robot, data, options=options)
            result = compare_with_truth(fit, truth)
            assert result.noise == ("estimated" if basis == "estimated" else "widened")
            accepted[basis] += result.p_value > 0.05
    assert accepted["estimated"] >= 12
    assert accepted["given"] >= 12  # the residuals contradict the sigma and widen the uncertainty


def test_joint_test_equals_the_inverse_of_the_covariance(fit) -> None:
    (robot, data, truth), *_ = simulate_printers(1.0, 1)
    exact = FitOptions(sigma_uncertainty=0.0)
    estimated = identify(robot, data, LeastSquares(), options=exact)
    names = ("radius", "tower2.angle", "tower3.stop")
    at = [estimated.names.index(name) for name in names]
    all_values = dict(zip(robot.parameters.names, truth, strict=True))
    result = compare_with_values(estimated, {name: all_values[name] for name in names})
    off = estimated.estimate[at] - [all_values[name] for name in names]
    scale = estimated.standard_deviations[at]
    correlation = estimated.covariance[np.ix_(at, at)] / np.outer(scale, scale)
    expected = (off / scale) @ np.linalg.solve(correlation, off / scale)
    assert result.chi_square == pytest.approx(expected, rel=1e-8)
    assert result.degrees == 3
    assert result.p_value == pytest.approx(scipy.stats.chi2.sf(expected, 3), rel=1e-8)
    # stated sigmas that are partly known: F of their degrees of freedom and those of the residuals
    partly = identify(robot, data, LeastSquares())
    again = compare_with_values(partly, {name: all_values[name] for name in names})
    test = partly.residual_test
    square = expected / test.sigma_scale**2
    assert again.chi_square == pytest.approx(square, rel=1e-8)
    left = 8 + test.degrees
    assert again.p_value == pytest.approx(scipy.stats.f.sf(square / 3, 3, left), rel=1e-6)


def test_answer_in_another_frame_has_the_same_chi_square_and_names_the_frame(fit) -> None:
    """Of the hexapod in an unknown frame six motions are open; along them answers may differ."""
    known, truth = fit.posterior, zoo.hexapod_truth()
    null_space = known.unit[:, None] * known.directions[:, ~known.determined]
    moved = truth + null_space @ np.full(6, 3.0)  # three tolerances along each
    first, second = (compare_with_truth(fit, values) for values in (truth, moved))
    assert first.degrees == 36
    assert second.chi_square == pytest.approx(first.chi_square, rel=1e-6)
    assert first.agrees
    assert len(first.dropped) == 6
    assert "Not compared, because undetermined" in str(first.outcome)
    some = {name: value for name, value in zip(fit.names, moved, strict=True) if "base" in name}
    part = compare_with_values(fit, some)
    assert part.degrees == len(some) - 6  # the base joints alone hold the six motions
    assert part.agrees


def test_machine_that_reaches_nothing_is_compared_by_the_poses_of_the_stored_one() -> None:
    """A fit that failed may leave values with which no loop closes."""
    (robot, data, _), *_ = simulate_printers(1.0, 1)
    fit = identify(robot, data, LeastSquares())
    values = robot.values.copy()
    values[robot.parameters.index("radius")] = 5.0
    lost = robot.with_values(values)
    failed = replace(fit, robot=lost)
    assert compare_with_values(failed, robot).degrees
    with pytest.raises(EstimationError, match="share no reachable tested pose"):
        compare_with_values(failed, lost)


def test_values_that_cannot_be_compared_are_refused_or_undecided(tmp_path) -> None:
    (robot, data, truth), *_ = simulate_printers(1.0, 1)
    fit = identify(robot, data, LeastSquares())
    arm, tower = "arm1.length", "tower3.angle"
    with pytest.raises(EstimationError, match=r"stored value of arm1.length is .* fixes it at"):
        compare_with_values(fit, {"radius": 0.1, arm: 0.9})
    near = 1e3 * float(robot.values[robot.parameters.index(arm)]) + 0.05
    with pytest.raises(
        EstimationError, match=rf"{arm} is {near:.9g} mm, .* at {near - 0.05:.9g} mm"
    ):
        compare_with_values(fit, {arm: 1e-3 * near})
    with pytest.raises(EstimationError, match="another frame"):
        compare_with_values(fit, {tower: truth[robot.parameters.index(tower)] + 0.02})
    with pytest.raises(EstimationError, match=r"'radiu' is not a parameter.*radius"):
        compare_with_values(fit, {"radiu": 0.1})
    with pytest.raises(EstimationError, match="finite"):
        compare_with_values(fit, {"radius": np.nan})
    with pytest.raises(EstimationError, match="no value belongs to an estimated parameter"):
        compare_with_values(fit, {})
    with pytest.raises(EstimationError, match="does not have the parameters"):
        compare_with_values(fit, load_robot("five-bar"))
    few = data.take(np.arange(data.n_poses) < 6)
    estimated = identify(robot, few, options=FitOptions(method=LeastSquares(), noise="estimated"))
    result = compare_with_truth(estimated, truth)
    assert result.agrees is None
    assert str(result.outcome).startswith("loopcal cannot compare the stored values")


def test_least_squares_far_from_the_truth_decides_nothing_and_map_does() -> None:
    """On the 3-PRS second-order effects of a direction of 30 tolerances exceed the noise."""
    robot = load_robot("3-prs")
    (truth,) = sample_truth(robot, 1, seed=0)
    coordinates = sample_workspace(robot, 25, 0).coordinates
    instrument = Instrument((Sensor(Pose(), noise(*[1e-5] * 3, *[1e-5] * 3)),))
    data = simulate(robot.with_values(truth), coordinates, instrument, 0)
    wide, near = (
        compare_with_truth(identify(robot, data, method), truth)
        for method in (LeastSquares(), MAP())
    )
    assert wide.agrees is None
    assert wide.outcome.code == "comparison.not-linear"
    assert wide.second_order > 20.0
    assert near.second_order < 0.1
    assert near.agrees


def test_truncated_directions_are_not_tested() -> None:
    data = hexapod_data(20)
    fit = identify(hexapod(), data, TruncatedSVD(30))
    result = compare_with_truth(fit, zoo.hexapod_truth())
    assert (result.compared, result.degrees) == (42, 30)
    assert np.isfinite(result.chi_square)
