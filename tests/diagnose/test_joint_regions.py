# SPDX-License-Identifier: Apache-2.0
"""Joint regions and simultaneous intervals against scipy, and against draws from the covariance."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import chi2, f, multivariate_normal, norm, t

import loopcal as lc
from loopcal.errors import EstimationError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.posterior import CovariancePart
from tests.diagnose.test_cluster_covariance import THREE_TARGETS, measure
from tests.estimate.problems import hexapod, hexapod_data

NAMES = ["leg1.base.x", "leg1.base.y", "leg2.platform.z"]


@pytest.fixture(scope="module")
def fit() -> lc.Identification:
    return identify(
        hexapod(), hexapod_data(20), lc.LeastSquares(), options=lc.FitOptions(sigma_uncertainty=0.0)
    )


def with_degrees(fit: lc.Identification, degrees: float):
    """Return the posterior of a fit whose noise has these degrees of freedom."""
    posterior = fit.posterior
    return replace(posterior, parts=(CovariancePart("noise", posterior.root, degrees),))


@pytest.mark.parametrize("degrees", [np.inf, 7.0])
def test_a_region_contains_the_truth_as_often_as_it_says(fit, degrees) -> None:
    region = lc.compute_joint_region(with_degrees(fit, degrees), NAMES, 0.9)
    limit = chi2.ppf(0.9, 3) if np.isinf(degrees) else 3 * f.ppf(0.9, 3, degrees)
    assert region.square == pytest.approx(limit)
    assert region.degrees == pytest.approx(degrees)
    places = [fit.names.index(name) for name in NAMES]
    assert region.covariance == pytest.approx(fit.covariance[np.ix_(places, places)])
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(
        np.zeros(3), fit.covariance[np.ix_(places, places)] * 1e12, 4000
    )
    scale = 1.0 if np.isinf(degrees) else np.sqrt(degrees / rng.chisquare(degrees, 4000))[:, None]
    inside = region.contains(region.center + scale * drawn * 1e-6)
    assert inside.mean() == pytest.approx(0.9, abs=0.02)
    assert region.compute_p_value(region.center + region.axes[0]) == pytest.approx(0.1)
    assert region.measure_distance(region.center + region.axes) == pytest.approx(np.full(3, limit))


@pytest.mark.parametrize("degrees", [np.inf, 7.0])
def test_simultaneous_intervals_hold_together_as_often_as_they_say(fit, degrees) -> None:
    posterior, places = with_degrees(fit, degrees), np.arange(12)
    names = list(fit.names[:12])
    C = fit.covariance[np.ix_(places, places)] * 1e12
    rng = np.random.default_rng(1)
    drawn = rng.multivariate_normal(np.zeros(12), C, 8000) * 1e-6
    if np.isfinite(degrees):
        drawn *= np.sqrt(degrees / rng.chisquare(degrees, 8000))[:, None]
    rules = ("maximum", "sidak", "bonferroni", "scheffe")
    found = {r: lc.compute_simultaneous_intervals(posterior, names, 0.95, r) for r in rules}
    covered = {r: s.contains(s.center + drawn).mean() for r, s in found.items()}
    assert covered["maximum"] == pytest.approx(0.95, abs=0.012)
    assert covered["sidak"] > 0.94
    width = [found[r].factor[0] for r in rules]
    assert width == sorted(width)
    single = (np.abs(drawn) <= found["maximum"].single).all(axis=1).mean()
    assert single < 0.85  # one at a time they do not hold together
    normal = norm if np.isinf(degrees) else t(degrees)
    assert found["bonferroni"].factor == pytest.approx(normal.ppf(1.0 - 0.025 / 12))
    assert found["sidak"].factor == pytest.approx(normal.ppf(0.5 + 0.5 * 0.95 ** (1 / 12)))


def test_the_simulated_maximum_equals_the_normal_probability_of_the_box(fit) -> None:
    found = lc.compute_simultaneous_intervals(fit, NAMES, 0.95)
    region = lc.compute_joint_region(fit, NAMES)
    k = found.factor[0]
    box = multivariate_normal(np.zeros(3), cast(Any, region.correlation))
    inside = box.cdf(np.full(3, k), lower_limit=np.full(3, -k))
    assert inside == pytest.approx(0.95, abs=0.003)
    again = lc.compute_simultaneous_intervals(fit, NAMES, 0.95)
    assert (again.half_widths == found.half_widths).all()


def test_combinations_have_the_variance_of_their_factors(fit) -> None:
    factors = np.array([[1.0, -1.0, 0.0], [0.0, 1.0, 1.0]])
    region = lc.compute_joint_region(fit, NAMES, combinations=factors)
    places = [fit.names.index(name) for name in NAMES]
    C = fit.covariance[np.ix_(places, places)]
    assert region.covariance == pytest.approx(factors @ C @ factors.T)
    assert region.center == pytest.approx(factors @ fit.estimate[places])
    dependent = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    with pytest.raises(EstimationError, match="depend on each other"):
        lc.compute_joint_region(fit, NAMES, combinations=dependent)
    both = lc.compute_simultaneous_intervals(fit, NAMES, combinations=dependent)
    assert both.factor[0] == pytest.approx(1.96, abs=0.02)  # one quantity, twice


def test_names_are_patterns_and_unknown_ones_are_refused(fit) -> None:
    assert len(lc.compute_joint_region(fit, "leg1.*").names) == 7
    with pytest.raises(EstimationError, match="did you mean"):
        lc.compute_joint_region(fit, ["leg1.base.w"])
    with pytest.raises(EstimationError, match="between 0 and 1"):
        lc.compute_joint_region(fit, NAMES, 95)
    with pytest.raises(EstimationError, match="must be one of 'maximum'"):
        lc.compute_simultaneous_intervals(fit, NAMES, rule="tukey")  # pyright: ignore[reportArgumentType]


def test_what_the_data_do_not_determine_has_no_region() -> None:
    open_frame = identify(hexapod(), measure(THREE_TARGETS, 20, 3), lc.LeastSquares())
    unknown = open_frame.names[int(np.flatnonzero(np.isinf(open_frame.standard_deviations))[0])]
    with pytest.raises(EstimationError, match="do not determine"):
        lc.compute_joint_region(open_frame, [unknown])
    with pytest.raises(EstimationError, match="do not determine"):
        lc.compute_joint_region(open_frame, [unknown], combinations=np.eye(1))
    known = lc.compute_joint_region(open_frame).names
    assert len(known) == int(np.isfinite(open_frame.standard_deviations).sum())
    stopped = identify(
        hexapod(), hexapod_data(20), options=FitOptions(control=lc.StepControl(iterations=0))
    )
    with pytest.raises(EstimationError, match="no uncertainties"):
        lc.compute_joint_region(stopped)
