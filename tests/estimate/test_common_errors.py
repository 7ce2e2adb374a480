# SPDX-License-Identifier: Apache-2.0
"""Errors that several parameters share: stated in a robot file, drawn, and known to the fit."""

from pathlib import Path

import numpy as np
import pytest

from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.engine import fold
from loopcal.errors import FileError, MechanismError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import MAP, LeastSquares, Ridge
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.decomposition import decompose, empty_factor

RODS = "{name: batch of rods, of: [arm*.length], length: {sd: 0.6}}"
LENGTHS = ("arm1.length", "arm2.length", "arm3.length")
OWN, COMMON = 1e-4, 6e-4


def delta_with(common: str, folder: Path) -> Mechanism:
    """Return the rotary delta with a common error in its file."""
    shipped = load_robot("rotary-delta").record.path.read_text()
    path = folder / "delta.yaml"
    path.write_text(f"{shipped}\ncommon_errors:\n  - {common}\n")
    return load_robot(path)


@pytest.fixture(scope="module")
def delta(tmp_path_factory: pytest.TempPathFactory) -> Mechanism:
    return delta_with(RODS, tmp_path_factory.mktemp("robot"))


def places(robot: Mechanism) -> list[int]:
    return [robot.parameters.index(name) for name in LENGTHS]


def test_tolerances_contain_the_common_error_and_lengths_correlate(delta: Mechanism) -> None:
    table, rods = delta.parameters, places(delta)
    whole = np.hypot(OWN, COMMON)
    np.testing.assert_allclose(table.tolerance[rods], whole)
    correlation = table.correlation()
    np.testing.assert_allclose(correlation[rods[0], rods[1:]], COMMON**2 / whole**2)
    others = np.setdiff1d(np.arange(len(table)), rods)
    np.testing.assert_array_equal(correlation[np.ix_(others, others)], np.eye(len(others)))


def test_true_machines_are_drawn_with_the_common_error(delta: Mechanism) -> None:
    truth = sample_truth(delta, 4000, 3)[:, places(delta)] - 0.480
    np.testing.assert_allclose(truth.std(axis=0), np.hypot(OWN, COMMON), rtol=0.05)
    np.testing.assert_allclose((truth[:, 0] - truth[:, 1]).std(), np.sqrt(2.0) * OWN, rtol=0.05)


def test_robots_without_common_errors_are_drawn_as_before(delta: Mechanism) -> None:
    plain = load_robot("rotary-delta")
    others = np.setdiff1d(np.arange(len(plain.parameters)), places(plain))
    drawn = sample_truth(delta, 3, 5)[:, others]
    np.testing.assert_array_equal(drawn, sample_truth(plain, 3, 5)[:, others])


@pytest.mark.parametrize("unpenalized", [None, np.array([True] + [False] * 4)])
def test_a_correlated_prior_gives_the_solution_of_the_normal_equations(
    unpenalized: np.ndarray | None,
) -> None:
    rng = np.random.default_rng(4)
    A, b = rng.standard_normal((12, 5)), rng.standard_normal(12)
    correlation = np.eye(5)
    correlation[2, 3] = correlation[3, 2] = 0.9
    method = MAP(free=() if unpenalized is None else tuple(unpenalized), correlation=correlation)
    factor = fold(empty_factor(1, 5), np.column_stack([A, b])[None])
    d = decompose(factor, np.array([12]), unpenalized=method.unpenalized(5), root=method.root(5))
    penalty = method.penalty(d)
    known = np.ones(5) if unpenalized is None else (~unpenalized).astype(float)
    precision = A.T @ A + np.linalg.inv(correlation) * known * known[:, None]
    np.testing.assert_allclose(
        d.deviation(d.solution(penalty))[0], np.linalg.solve(precision, A.T @ b), atol=1e-12
    )
    np.testing.assert_allclose(d.covariance(penalty)[0], np.linalg.inv(precision), atol=1e-12)
    directions, variance, _ = d.knowledge(penalty)
    np.testing.assert_allclose(
        (directions * variance) @ directions.T, np.linalg.inv(precision), atol=1e-12
    )
    plain = decompose(factor, np.array([12])).plain()
    np.testing.assert_allclose(d.plain().singular_values, plain.singular_values, rtol=1e-12)


def test_a_batch_that_is_off_is_found_by_whoever_declares_it(delta: Mechanism) -> None:
    """All rods of a delta are 0.5 mm too long, five of their own spreads."""
    plain = load_robot("rotary-delta")
    instrument = Instrument((Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, 5e-5))),))
    held_out = sample_workspace(plain, 40, 99).solution.q
    errors, inside = [], []
    for seed, drawn in enumerate(sample_truth(plain, 15, 8)):
        truth = drawn.copy()
        truth[places(plain)] += 5.0 * OWN
        machine = plain.with_values(truth)
        data = simulate(machine, sample_workspace(plain, 20, seed).coordinates, instrument, seed)
        fits = [
            identify(delta, data, MAP()),
            identify(plain, data, MAP()),
            identify(plain, data, LeastSquares()),
        ]
        reached = [forward(fit.robot, held_out).T[:, :3, 3] for fit in fits]
        true = forward(machine, held_out).T[:, :3, 3]
        errors.append([np.sqrt(((T - true) ** 2).sum(axis=1).mean()) for T in reached])
        inside.append(
            [
                np.mean(np.abs(fit.estimate - truth) <= 1.96 * fit.standard_deviations)
                for fit in fits
            ]
        )
    declared, ignored, least_squares = np.median(errors, axis=0)
    assert declared < 0.95 * ignored
    assert declared < 0.8 * least_squares
    assert np.mean(inside, axis=0)[0] > 0.93
    assert np.mean(inside, axis=0)[1] < 0.85


def test_identifiability_uses_the_common_errors(delta: Mechanism) -> None:
    """Standard deviations with the spreads as a prior are those of dense normal equations, and
    those of a fit. Independent spreads would promise 10 % less or more.
    """
    instrument = Instrument((Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, 5e-5))),))
    analysis = identifiability(delta, instrument, poses=20)
    table, free = delta.parameters, np.flatnonzero(delta.parameters.free)
    information = analysis.factor.T @ analysis.factor
    correlation = table.correlation()[np.ix_(free, free)]
    expected, independent = (
        np.sqrt(np.diag(np.linalg.inv(information + np.linalg.inv(prior))))
        for prior in (correlation, np.eye(len(free)))
    )
    left = np.array([parameter.left for parameter in analysis.parameters])
    np.testing.assert_allclose(left, expected, rtol=1e-9)
    sd = np.sqrt((analysis.posterior.root**2).sum(axis=1)) / table.tolerance[free]
    np.testing.assert_allclose(sd, expected, rtol=1e-9)
    assert np.abs(independent / expected - 1.0).max() > 0.1


def test_ridge_with_correlated_tolerances_advises_what_helps(delta: Mechanism) -> None:
    instrument = Instrument((Sensor(Component(("x", "y", "z")), Gaussian(np.full(3, 5e-5))),))
    data = simulate(delta, sample_workspace(delta, 20, 1).coordinates, instrument, 1)
    fit = identify(delta, data, Ridge(3.0))
    (finding,) = (f for f in fit.findings if f.code == "fit.ridge-without-intervals")
    assert "(their errors are correlated). Use the method map." in str(finding)


def test_names_of_common_errors_differ(tmp_path: Path) -> None:
    with pytest.raises(MechanismError, match="two common errors have the name 'batch of rods'"):
        delta_with(f"{RODS}\n  - {RODS}", tmp_path)


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        ("{name: rods, of: [rod*], length: {sd: 0.6}}", "matches no parameter"),
        ("{name: rods, of: [arm*.length]}", "has 0 expected spreads"),
        (
            "{name: rods, of: [arm*.length], length: {sd: 1}, angle: {sd: 1}}",
            "has 2 expected spreads",
        ),
        ("{name: rods, of: [arm*.length], angle: {sd: 0.6}}", "Use the key `length`"),
        ("{name: rods, of: [arm1.length], length: {sd: 0.6}}", "arm1.length alone"),
        ("{name: rods, of: [arm*.length], length: {sd: -1}}", "greater than zero"),
        ("{name: rods, of: [arm*.length], length: {}}", "exactly one of sd and limits"),
        ("{name: rods, length: {sd: 0.6}}", "of"),
    ],
)
def test_a_wrong_entry_is_refused_at_its_line(entry: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"delta\.yaml:\d+: ") as error:
        delta_with(entry, tmp_path)
    assert complaint in str(error.value)
