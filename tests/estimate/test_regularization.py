# SPDX-License-Identifier: Apache-2.0
"""Ridge parameter and truncation of a fit are reported with rule and score."""

import json

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.information import collect_information
from loopcal.estimate.penalties import (
    GCV,
    MAP,
    LeastSquares,
    MarginalLikelihood,
    Ridge,
    TruncatedSVD,
    TruncationGCV,
)
from loopcal.results.serialization import to_json


@pytest.fixture(scope="module")
def data():
    robot = lc.load_robot("3-prs")
    truth = robot.with_values(lc.sample_truth(robot, 1, 1)[0])
    kind = lc.Component(("x", "y", "z", "phi", "theta"), "tilt-torsion")
    instrument = lc.Instrument((lc.Sensor(kind, lc.Gaussian(np.array([2e-4] * 3 + [5e-4] * 2))),))
    coordinates = lc.sample_workspace(robot, 15, 2).coordinates
    return robot, lc.simulate(truth, coordinates, instrument, 3)


def rows_at(robot, data):
    """Return singular values, projections of the total deviation, and the rest."""
    free = select_free_parameters(robot)
    factor = collect_information(free, data)[0][0]
    A, r = factor[:, :-1], factor[:, -1]
    u, s, _ = np.linalg.svd(A, full_matrices=False)
    b = A @ free.deviation(robot.values[None])[0] - r
    c = u.T @ b
    return s, c, float(b @ b - c @ c)


def gcv(s, c, rest, filters, equations):
    left = equations - filters.sum()
    return float((((1.0 - filters) * c) ** 2).sum() + rest) / left**2


def test_score_and_value_of_gcv_are_the_minimum_of_its_formula(data):
    robot, measured = data
    fit = identify(robot, measured, Ridge(GCV()))
    chosen = fit.regularization
    assert chosen is not None
    assert (chosen.parameter, chosen.rule) == ("lam", "GCV")
    s, c, rest = rows_at(fit.robot, measured)
    m = measured.n_rows

    def score(lam):
        return gcv(s, c, rest, s**2 / (s**2 + lam), m)

    assert chosen.score == pytest.approx(score(chosen.value), rel=1e-3)
    grid = chosen.value * np.logspace(-1, 1, 41)
    assert min(map(score, grid)) >= score(chosen.value) * (1.0 - 1e-4)
    assert chosen.effective == pytest.approx((s**2 / (s**2 + chosen.value)).sum(), rel=1e-3)
    assert not chosen.is_at_limit


def test_truncation_reports_the_directions_that_remain(data):
    robot, measured = data
    fit = identify(robot, measured, TruncatedSVD(TruncationGCV()))
    chosen = fit.regularization
    assert chosen is not None
    assert (chosen.parameter, chosen.rule) == ("k", "TruncationGCV")
    assert chosen.effective == chosen.value <= chosen.rank == fit.rank == 32
    s, c, rest = rows_at(fit.robot, measured)
    scores = [
        gcv(s, c, rest, (np.arange(len(s)) < k).astype(float), measured.n_rows) for k in range(33)
    ]
    assert chosen.score == pytest.approx(scores[int(chosen.value)], rel=1e-3)
    assert np.argmin(scores) == chosen.value


@pytest.mark.parametrize(
    ("method", "parameter", "value", "rule"),
    [
        (Ridge(2.5), "lam", 2.5, "fixed"),
        (Ridge(tuple([2.0] * 32 + [3.0])), "lam", 3.0, "each"),
        (TruncatedSVD(20), "k", 20.0, "fixed"),
        (Ridge(MarginalLikelihood()), "lam", None, "MarginalLikelihood"),
    ],
)
def test_every_rule_is_reported(data, method, parameter, value, rule):
    robot, measured = data
    fit = identify(robot, measured, method)
    chosen = fit.regularization
    assert chosen is not None
    assert (chosen.parameter, chosen.rule) == (parameter, rule)
    assert value is None or chosen.value == value
    assert (chosen.score is None) == (rule in ("fixed", "each"))
    assert chosen.finding.code in [finding.code for finding in fit.findings]
    document = to_json(fit.to_dict()["regularization"])
    assert document["value"] == chosen.value
    assert document["rule"] == rule


@pytest.mark.parametrize("method", [None, MAP(), LeastSquares()])
def test_methods_without_a_parameter_report_none(data, method):
    robot, measured = data
    if isinstance(method, LeastSquares):
        measured = lc.simulate(robot, lc.sample_workspace(robot, 30, 2).coordinates, _pose(), 3)
    fit = identify(robot, measured, method)
    assert fit.regularization is None
    assert not any(finding.code.startswith("fit.regularization") for finding in fit.findings)


def test_a_minimum_at_the_end_of_the_range_is_a_warning():
    """A machine as designed, measured with much noise: the data are best explained by no change."""
    robot = lc.load_robot("3-prs")
    at_limit = []
    for seed in range(8):
        measured = lc.simulate(robot, lc.sample_workspace(robot, 20, 2).coordinates, _pose(), seed)
        chosen = identify(robot, measured, Ridge(MarginalLikelihood())).regularization
        assert chosen is not None
        at_limit.append(chosen.is_at_limit)
        if chosen.is_at_limit:
            assert chosen.finding.code == "fit.regularization-at-limit"
            assert chosen.effective < 1e-2
    assert any(at_limit)


def _pose() -> lc.Instrument:
    return lc.Instrument((lc.Sensor(lc.Pose(), lc.Gaussian(np.full(6, 1e-2))),))


@pytest.mark.parametrize(
    ("options", "sentence", "rule"),
    [
        ("--method ridge", "chosen by generalized cross-validation, score", "GCV"),
        (
            "--method ridge --lam 2",
            "Ridge regression: lam = 2 (sigma per expected spread, squared)",
            "fixed",
        ),
        ("--method tsvd", "chosen by generalized cross-validation, score", "TruncationGCV"),
        ("--method tsvd --keep 20", "Truncated SVD: 20 of the 42 directions", "fixed"),
    ],
)
def test_screen_and_run_folder_name_value_and_rule(
    tmp_path, monkeypatch, capsys, options, sentence, rule
):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "hexapod-42", "--draw-errors", "-o", "data.csv", "--draw", "20"]) == 0
    capsys.readouterr()
    assert main(f"calibrate hexapod-42 data.csv -o run {options}".split()) in {0, 2}
    assert sentence in " ".join(capsys.readouterr().out.split())
    stored = json.loads((tmp_path / "run" / "result.json").read_text())["fit"]["regularization"]
    assert stored["rule"] == rule


def test_weak_ridges_of_right_data_agree_with_the_noise():
    """The penalty is no prior: with it, 240 equations counted as 240 degrees of freedom, and three
    of four right data sets had residuals that were too small."""
    robot, codes, ratios = lc.load_robot("hexapod-42"), [], []
    sensor = lc.Sensor(lc.Pose(), lc.Gaussian(np.array([5e-5] * 3 + [1e-5] * 3)))
    for seed in range(6):
        truth = robot.with_values(lc.sample_truth(robot, 1, seed)[0])
        coordinates = lc.sample_workspace(robot, 15, seed).coordinates
        data = lc.simulate(truth, coordinates, lc.Instrument((sensor,)), seed)
        test = lc.identify(robot, data, lc.Ridge(1e-6)).residual_test
        least = lc.identify(robot, data, lc.LeastSquares()).residual_test
        assert test.chi_square == pytest.approx(least.chi_square, rel=1e-3)
        assert test.degrees == least.degrees
        codes.append(test.finding.code)
        ratios.append(test.finding.data["ratio"])
    assert codes.count("noise.consistent") >= 5
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)
