# SPDX-License-Identifier: Apache-2.0
"""Fits that did not converge or left their tolerances state no noise, no intervals and no prior."""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.diagnose.fit_examination import StartVerdict, check_start_values
from loopcal.estimate.descent import StepControl
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.prior import prior_from
from loopcal.mechanism import kinematics as batch_kinematics
from tests.estimate.problems import hexapod, hexapod_data
from tests.findings.expectations import expect_refusal, get_finding, list_codes

ONE_STEP = StepControl(iterations=1)


@pytest.mark.parametrize("method", [LeastSquares(), MAP(), None])
@pytest.mark.parametrize("noise", ["given", "estimated"])
def test_fit_without_convergence_has_no_noise_test_and_no_intervals(method, noise):
    data = hexapod_data(12)
    rows = data.observations[0]
    # with sigmas a hundred times too large even the first step leaves less than noise explains
    loose = replace(data, observations=(replace(rows, covariance=rows.covariance * 1e4),))
    for some in (data, loose):
        fit = identify(hexapod(), some, method, options=FitOptions(noise=noise, control=ONE_STEP))
        assert not fit.converged
        assert np.isnan(fit.interval()).all()
        assert np.isnan(fit.residual_test.p_value)
        assert not fit.residual_test.failed
        codes = list_codes(fit.findings)
        assert {"fit.out-of-iterations", "noise.not-tested"} <= codes
        assert not {code for code in codes if code.startswith("noise.")} - {"noise.not-tested"}
        assert bool(codes & {"fit.no-prior", "fit.beyond-tolerance"}) == (method == LeastSquares())
        assert check_start_values(fit).verdict is StartVerdict.OPEN
        assert check_start_values(fit).finding.code == "residuals.start-not-comparable"


def test_fit_without_convergence_cannot_be_a_prior():
    with expect_refusal("prior.no-uncertainty"):
        prior_from(
            identify(hexapod(), hexapod_data(12), options=FitOptions(control=ONE_STEP)).posterior
        )


def test_estimate_far_outside_its_tolerance_is_reported():
    robot, data = hexapod(), hexapod_data(12)
    place = robot.parameters.names.index("leg1.length")
    entries = list(robot.parameters.entries)
    entries[place] = replace(
        entries[place], nominal=entries[place].nominal + 40 * (entries[place].tolerance or 0.0)
    )
    wrong = replace(robot, parameters=replace(robot.parameters, entries=tuple(entries)))
    fit = identify(wrong, data, LeastSquares())
    assert fit.converged
    far = get_finding(fit.findings, "fit.beyond-tolerance")
    assert far.data["names"][0] == "leg1.length"
    assert far.data["factor"] > 10.0
    findings = (
        identify(robot, data, LeastSquares()).findings + identify(wrong, data, MAP()).findings
    )
    assert "fit.beyond-tolerance" not in list_codes(findings)


def test_hopeless_fit_follows_no_paths_to_poses_that_its_steps_do_not_reach(monkeypatch):
    """Such a step is shortened. Paths from its own readings took most of the time of these fits."""
    followed = []
    follow = batch_kinematics.follow_path

    def count(loops, joints, begin, state, wrong):
        followed.append(int(wrong.sum()))
        return follow(loops, joints, begin, state, wrong)

    data = hexapod_data(12)
    rows = data.observations[0]
    measured = rows.measured.copy()
    measured[4, 3:] += 1000.0  # [m]
    wrong = replace(data, observations=(replace(rows, measured=measured),))
    monkeypatch.setattr(batch_kinematics, "follow_path", count)
    fit = identify(hexapod(), wrong, LeastSquares())
    assert not fit.converged
    assert followed == []
