# SPDX-License-Identifier: Apache-2.0
"""Rank counts first-order facts: residuals do not make motions of the base identifiable. Gaps that
no pose can have do not keep the search for consistent poses busy.
"""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import loopcal as lc
from loopcal import engine, geometry
from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Huber
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.problem import Problem, problem_of
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.kinds import KINDS
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.gauss_newton import DescentStatus
from tests.estimate.plane_line_data import plan_groups, simulate_plan

FIRST_ORDER, PARAMETERS = 33, 42


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sigma", "method"), [(1e-6, LeastSquares()), (1e-5, None), (1e-4, LeastSquares())]
)
def test_planes_and_lines_determine_33_of_42_at_every_noise(sigma, method):
    robot = lc.load_robot("hexapod-nategh-agheli")
    truth, data = simulate_plan(plan_groups(), sigma, seed=1)
    fit = identify(robot, data, method)
    assert fit.converged
    assert fit.rank == FIRST_ORDER
    assert len(fit.unidentifiable) == PARAMETERS - FIRST_ORDER
    assert _orientation_error(fit.robot, truth) < 0.5 * _orientation_error(robot, truth)
    assert fit.history.iterations <= 8


@cache
def fit_example() -> tuple[lc.Identification, Problem]:
    """Return a least-squares fit with a noise of 10 um, and its problem."""
    robot = lc.load_robot("hexapod-nategh-agheli")
    _, data = simulate_plan(plan_groups(), 1e-5, seed=1)
    fit = identify(robot, data, LeastSquares())
    return fit, problem_of(select_free_parameters(robot), data)


def test_without_the_rule_the_residuals_determine_rotations_of_the_base():
    """The complaint: 36 singular values above the tolerance, whose rotations are anything."""
    fit, problem = fit_example()
    problem = replace(problem, consistent=None)
    z = problem.free.deviation(fit.robot.values[None])
    s = np.linalg.svd(problem.linearize(z, problem.start(z)).factor[0, :-1, :-1], compute_uv=False)
    assert (s > 1e-11 * s[0]).sum() == 36
    assert 1e-7 * s[0] < s[35] < s[33] < 1e-5 * s[0]


def test_the_sum_of_squares_does_not_depend_on_the_removed_rotations():
    """Finite rotations of the base, which the rows contain, leave the residuals as large."""
    fit, problem = fit_example()
    for axis in np.eye(3):
        z = problem.free.deviation(_rotate_base(fit.robot, 0.02 * axis)[None])
        cost = problem.linearize(z, problem.start(z)).cost[0]
        assert cost == pytest.approx(fit.chi_square, rel=1e-6)


def test_curvature_supports_every_direction_that_counts_and_no_other():
    """Second differences of the sum of squares, with the best setup at each point."""
    fit, problem = fit_example()
    z0 = problem.free.deviation(fit.robot.values[None])
    start = problem.start(z0)
    linearization = problem.linearize(z0, start)
    _, s, vt = np.linalg.svd(linearization.factor[0, :-1, :-1])

    measured = replace(problem, consistent=None)

    def cost(z):
        return float(measured.linearize(z[None], start).cost[0])

    step = 0.1  # tolerances
    # every second of those that count, the last ones among them, and all others
    for i in (*range(0, FIRST_ORDER, 2), *range(FIRST_ORDER, PARAMETERS)):
        direction = vt[i]
        up, down = (cost(z0[0] + sign * step * direction) for sign in (1, -1))
        curvature = (up + down - 2.0 * float(linearization.cost[0])) / (2.0 * step**2)
        if i < FIRST_ORDER:
            assert curvature == pytest.approx(s[i] ** 2, rel=0.05)
        else:
            assert abs(curvature) < 0.05 * s[FIRST_ORDER - 1] ** 2


def test_identifiability_of_a_filled_sheet_is_that_of_its_plan():
    plan = plan_groups()
    for sigma, seed in ((1e-6, 1), (1e-4, 3)):
        _, data = simulate_plan(plan, sigma, seed)
        result = identifiability(plan.robot, data)
        assert result.rank == plan.rank == FIRST_ORDER
        assert result.gap > 1e9


@pytest.mark.slow
def test_uncertain_readings_and_a_loss_do_not_change_the_rank():
    robot = lc.load_robot("hexapod-nategh-agheli")
    _, data = simulate_plan(plan_groups(), 1e-5, seed=4)
    uncertain = replace(data, reading_sigma=np.full(data.readings.shape, 2e-6))
    assert identify(robot, uncertain).rank == FIRST_ORDER
    assert identifiability(robot, uncertain).rank == FIRST_ORDER
    assert identify(robot, data, loss=Huber()).rank == FIRST_ORDER
    excluded = FitOptions(excluded_poses=(data.labels[3],))
    assert identify(robot, data, options=excluded).rank == FIRST_ORDER


@pytest.mark.parametrize(("gap", "rank"), [(1e-5, 33), (3e-4, 36)])
def test_only_gaps_beyond_their_noise_determine_rotations(gap, rank):
    """A recorded gap of 0.3 mm has a direction, which a noise of 10 um does not hide."""
    robot = lc.load_robot("hexapod-nategh-agheli")
    _, data = simulate_plan(plan_groups(), 1e-5, seed=5)
    rng = np.random.default_rng(0)
    rows = tuple(
        replace(o, measured=gap * rng.standard_normal(o.measured.shape)) for o in data.observations
    )
    assert identify(robot, replace(data, observations=rows)).rank == rank


TOUCHED = {name for name, kind in KINDS.items() if not kind.changes_with_pose}


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(example, id=f"{name}-{'-'.join(example.unknown) or 'known'}")
        for name, kind in KINDS.items()
        if name not in TOUCHED and name != "joint"
        for example in kind.examples()
        if example.unknown and not example.sensed_joints
    ],
)
def test_residuals_do_not_change_the_rank_of_other_kinds(kind):
    """Only kinds that say so mix the components of their residuals: a machine far from nominal has
    the rank of one without residuals."""
    assert not kind.mixes_components
    robot = lc.load_robot("hexapod-42")
    sigma = np.full(len(kind.noise_columns), 1e-5)
    instrument = lc.Instrument((lc.Sensor(kind, lc.Gaussian(sigma)),))
    wrong = robot.with_values(lc.sample_truth(robot, 1, 1)[0])
    exact, far = (identifiability(robot, _simulate(r, instrument)).rank for r in (robot, wrong))
    assert exact == far


def _simulate(truth: Mechanism, instrument: lc.Instrument) -> lc.Measurements:
    coordinates = sample_workspace(truth.nominal, 30, 1).coordinates
    return lc.simulate(truth, coordinates, instrument, 1)


def _orientation_error(robot: Mechanism, truth: Mechanism) -> float:
    """Return the root mean square error of orientation [rad] over the workspace."""
    coordinates = sample_workspace(robot.nominal, 60, 5).coordinates
    q = inverse(robot.nominal, coordinates).q
    R, true = forward(robot, q).T[:, :3, :3], forward(truth, q).T[:, :3, :3]
    return float(np.sqrt((geometry.log_so3(np.swapaxes(R, 1, 2) @ true) ** 2).sum(1).mean()))


def _rotate_base(robot: Mechanism, rotation: np.ndarray) -> np.ndarray:
    """Return the values of a hexapod whose base points are rotated about the origin."""
    values, R = robot.values.copy(), geometry.exp_so3(rotation)
    for leg in range(1, 7):
        places = [robot.parameters.index(f"leg{leg}.base.{axis}") for axis in "xyz"]
        values[places] = R @ values[places]
    return values


ROWS = """\
# kind: line
# noise: {gap_a: "10 um", gap_b: "10 um"}
pose,left [deg],right [deg],gap_a [mm],gap_b [mm]
1,135.66,43.15,2.8,1e5
2,119.84,6.85,108.1,1e5
3,157.29,59.91,-85.4,1e5
4,109.98,26.77,107.7,1e5
5,156.93,45.07,-45.2,1e5
6,145.38,42.90,-18.4,1e5
7,128.11,12.07,78.7,1e5
8,153.38,37.63,-21.8,1e5
"""


def test_gaps_of_a_hundred_meters_end_early_and_without_a_warning(tmp_path, monkeypatch) -> None:
    (tmp_path / "line.csv").write_text(ROWS, "utf-8")
    robot = load_robot("five-bar")
    data = load_measurements(tmp_path / "line.csv", robot)
    calls, solve = [], engine.solve

    def counted(*args, **options):
        calls.append(1)
        return solve(*args, **options)

    monkeypatch.setattr(engine, "solve", counted)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = identify(robot, data, MAP())
    assert fit.history.status != DescentStatus.CONVERGED
    assert len(calls) < 600  # more than a thousand where each step is halved to its end
