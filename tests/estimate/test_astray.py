# SPDX-License-Identifier: Apache-2.0
"""A fit that did not converge, or left what was known of the robot, promises nothing."""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.diagnose import StartVerdict, check_start_values
from loopcal.errors import EstimationError
from loopcal.estimate import MAP, LeastSquares, identify
from loopcal.estimate.descent import StepControl
from loopcal.estimate.inference.prior import prior_from
from tests.estimate.problems import hexapod, hexapod_data

ONE_STEP = StepControl(iterations=1)


@pytest.mark.parametrize("method", [LeastSquares(), MAP(), None])
@pytest.mark.parametrize("noise", ["given", "estimated"])
def test_a_fit_that_did_not_converge_says_nothing_of_the_noise_and_gives_no_interval(method, noise):
    data = hexapod_data(12)
    rows = data.observations[0]
    # with sigmas a hundred times too large even the first step leaves less than noise explains
    loose = replace(data, observations=(replace(rows, covariance=rows.covariance * 1e4),))
    for some in (data, loose):
        fit = identify(hexapod(), some, method, noise=noise, control=ONE_STEP)
        assert not fit.converged
        assert np.isnan(fit.interval()).all()
        assert np.isnan(fit.p_value)
        assert not fit.check.failed
        notes = " ".join(fit.notes)
        assert "no interval is given and nothing is said of the noise" in notes
        assert "sigma is too large" not in notes
        assert "stated noise explains" not in notes
        assert ("--method map" in notes) == (method == LeastSquares())
        assert check_start_values(fit).verdict is StartVerdict.OPEN
        assert "did not converge" in check_start_values(fit).sentence


def test_a_fit_that_did_not_converge_cannot_be_a_prior():
    with pytest.raises(EstimationError, match=r"uncertainty \(it did not converge"):
        prior_from(identify(hexapod(), hexapod_data(12), control=ONE_STEP).posterior)


def test_an_estimate_far_outside_its_stated_tolerance_is_named_with_the_remedy():
    robot, data = hexapod(), hexapod_data(12)
    place = robot.parameters.names.index("leg1.length")
    entries = list(robot.parameters.entries)
    entries[place] = replace(
        entries[place], nominal=entries[place].nominal + 40 * (entries[place].tolerance or 0.0)
    )
    wrong = replace(robot, parameters=replace(robot.parameters, entries=tuple(entries)))
    fit = identify(wrong, data, LeastSquares())
    assert fit.converged
    (note,) = [note for note in fit.notes if "left the stated tolerance" in note]
    assert note.startswith("leg1.length left the stated tolerance, by up to ")
    assert "--method map" in note
    assert not any(
        "left the stated tolerance" in note for note in identify(robot, data, LeastSquares()).notes
    )
    assert not any(
        "left the stated tolerance" in note for note in identify(wrong, data, MAP()).notes
    )
