# SPDX-License-Identifier: Apache-2.0
"""Settings and rows that make no sense are refused in one sentence."""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.errors import EstimationError
from loopcal.estimate import FitOptions, LeastSquares, StepControl, TruncatedSVD, identify
from tests.estimate.problems import hexapod, hexapod_data
from tests.findings.reported import one_of, refused


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("relative", 0.0),
        ("relative", np.nan),
        ("absolute", -1.0),
        ("absolute", np.inf),
        ("iterations", -1),
        ("damping", -1.0),
    ],
)
def test_step_control(name, value) -> None:
    with pytest.raises(EstimationError, match=name):
        StepControl(**{name: value})


def test_truncation_at_no_integer() -> None:
    with pytest.raises(EstimationError, match="integer"):
        TruncatedSVD(2.5)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("method", ["ls", LeastSquares])
def test_a_method_that_is_no_instance(method) -> None:
    with pytest.raises(EstimationError, match=r"LeastSquares\(\)"):
        identify(hexapod(), hexapod_data(), method)


@pytest.mark.parametrize("tolerance", [0.0, 1.0, np.nan])
def test_rank_tolerance(tolerance) -> None:
    with pytest.raises(EstimationError, match="above 0 and below 1"):
        identify(hexapod(), hexapod_data(), options=FitOptions(rank_tolerance=tolerance))


@pytest.mark.filterwarnings("error")
def test_a_huge_reading_is_named() -> None:
    data = hexapod_data()
    (pose,) = data.observations
    values = pose.measured.copy()
    values[3, 5] = 1e300
    with refused("fit.residuals-not-finite", poses=(data.labels[3],)):
        identify(hexapod(), replace(data, observations=(replace(pose, measured=values),)))


def test_fewer_equations_than_parameters_say_what_rests_on_tolerances() -> None:
    fit = identify(hexapod(), hexapod_data(5))
    few = one_of(fit.findings, "fit.few-equations")
    assert few.data == {"equations": 30, "parameters": 42, "directions": 12}
