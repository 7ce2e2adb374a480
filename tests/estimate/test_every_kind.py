# SPDX-License-Identifier: Apache-2.0
"""Every measurement kind alone: it recovers the robot up to its gauge freedom, reports what it
cannot determine, and has correct intervals.

The cases are the examples of the registry, so a new kind is included automatically. `make
evidence` runs all settings at full size (evidence/kinds.py); these tests run those with most
unknowns.
"""

import json

import numpy as np
import pytest

from evidence.kinds import (
    FITS,
    POSES,
    ROBOTS,
    SEED,
    Coverage,
    DoubledNoise,
    NoNoise,
    compare_along_gauge,
    compute_coverage,
    coverage_band,
    list_cases,
    load_machine,
    make_instrument,
    pose_error,
    recover_machine,
    select_most_unknown,
)
from loopcal import geometry
from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.directions import Inclination
from loopcal.measure.kinds.distance import Separation
from loopcal.measure.kinds.joints import Locked
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Bearing, Position
from loopcal.measure.kinds.surfaces import Plane
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.workspace import sample_workspace

EXACT = 1e-9
"""[share of the robot's size, rad]: ranks are decided at 1e-11, and 1e-13 of rounding comes back
through conditions of 1e3
to 1e4."""

KINDS_BLIND_ON_A_DELTA = {"direction", "inclination", "autocollimation", "joint", "locked"}
"""What the platform of a delta, which does not turn, and its driven joints, whose values are the
readings, cannot show.
"""

RECOVERED_CASES = [  # other machines: in the evidence, which computes all cases for its table
    pytest.param(case, marks=() if case.robot == "hexapod-42" else pytest.mark.evidence)
    for case in select_most_unknown()
    if case.robot != "linear-delta" or case.kind.name not in KINDS_BLIND_ON_A_DELTA
]
BLIND_CASES = [
    case
    for case in select_most_unknown(("linear-delta",))
    if case.kind.name in KINDS_BLIND_ON_A_DELTA
]

RANKS = {
    "pose": 30, "component": 30, "position": 30, "bearing": 30, "distance": 30, "separation": 30, "plane": 30, "line": 36,  # noqa: E501
    "sphere": 33, "direction": 30, "inclination": 30, "autocollimation": 30, "joint": 33, "locked": 33,  # noqa: E501
}  # fmt: skip
"""Of the hexapod's 42, with most unknowns. 30: the machine without base and platform frame. Targets
of line and sphere are known here, and turns about each of the three lines are seen, as its gaps
have stated directions. Joints turn about axes that
stand in the base, whose orientation they see."""


def test_every_registered_kind_has_a_case_on_every_robot():
    assert {(case.robot, case.kind.name) for case in list_cases()} == {
        (robot, name) for robot in ROBOTS for name in KINDS if name not in ("closure", "image")
    }


@pytest.mark.slow
@pytest.mark.parametrize("case", RECOVERED_CASES, ids=str)
def test_noise_free_rows_of_one_kind_recover_the_robot_up_to_its_gauge(case):
    result = recover_machine(case)
    assert not result.refused
    assert result.machine == 0, "only motions of frames stay open"
    # 1e4 while an error was the norm over both targets of a row: it is that of one target now
    assert result.before > 5e3 * EXACT
    assert result.seen < EXACT
    assert result.pose < EXACT
    assert result.parameters < EXACT
    if case.robot == "hexapod-42":
        assert result.rank == RANKS[case.kind.name]


@pytest.mark.parametrize("case", BLIND_CASES, ids=str)
def test_kinds_blind_on_a_delta_have_rank_zero_and_a_finding(case):
    robot = load_machine(case)
    data = simulate(
        robot,
        sample_workspace(robot, POSES, SEED).coordinates,
        make_instrument(case.kind, POSES, NoNoise),
        SEED,
    )
    fit = identify(robot, data, LeastSquares(), options=FitOptions(allow_fewer_equations=True))
    assert fit.rank == 0
    assert np.isinf(fit.standard_deviations).all()
    assert {"fit.unidentifiable", "fit.note"} & {f.code for f in fit.findings}
    assert identifiability(robot, data).rank == 0


def pool_coverage(found: list[Coverage], what: str) -> float:
    """Return the share of the intervals of all kinds that contain the truth."""
    return float(np.concatenate([getattr(one, what).ravel() for one in found]).mean())


@pytest.mark.evidence
def test_intervals_of_a_hexapod_and_setup_parameters_have_95_percent_coverage():
    result = [compute_coverage(case, 5) for case in select_most_unknown(("hexapod-42",))]
    total = sum(one.fits for one in result)
    assert total == 5 * len(result), "every fit converged"
    for what in ("directions", "parameters", "setup"):
        assert pool_coverage(result, what) == pytest.approx(0.95, abs=coverage_band(total)), what


@pytest.mark.slow
def test_coverage_is_too_low_if_the_stated_noise_is_half_the_true_noise():
    case = next(case for case in list_cases() if case.kind.name == "position")
    result = compute_coverage(case, 60, DoubledNoise)
    # half the width: a normal value lies within 0.98 sd in 67 % of the draws; the prior holds the
    # weaker directions
    assert result.directions.mean() < 0.95 - coverage_band(60)


STATION = geometry.make_pose(np.eye(3), np.array([-1.5, -0.8, 0.1]))
POINT = np.array([[0.03, -0.02, 0.05]])
FIVE_KINDS = (
    Position(places=POINT, unknown=("frame",)),
    Inclination(unknown=("gravity", "mounting")),
    Bearing(places=POINT, T_base_frame=STATION, unknown=("frame",), frame="station"),
    Separation(places=POINT),
    Plane(places=POINT, unknown=("surface",)),
)
MACHINES, MINIMUM_WINS = 20, 17
"""Machines, and in how many of them the better one of two equals is better: 17 or more of 20 in
0.13 % of all cases.
"""


def compute_variances_and_errors(kinds):
    """Return predicted variances and squared errors (MACHINES,) of parameters in spreads."""
    robot = load_robot("hexapod-42")
    truth = sample_truth(robot, MACHINES, SEED)
    # 5 um and 5 urad: angles tell as much as lengths on a machine of this size
    looking = Instrument(
        tuple(Sensor(kind, Gaussian(np.full(len(kind.noise_columns), 5e-6))) for kind in kinds)
    )
    trials = simulate_trials(
        robot, truth, sample_workspace(robot, 40, SEED).coordinates, looking, SEED
    )
    result = identify_trials(robot, trials, MAP())
    assert result.converged.all()
    free = result.free_parameters
    off = free.deviation(result.values) - free.deviation(truth)
    return ((result.standard_deviations() / free.tolerance) ** 2).sum(axis=1), (off**2).sum(axis=1)


@pytest.mark.evidence
def test_weighted_fit_of_five_kinds_is_better_than_each_kind_alone():
    predicted, made = compute_variances_and_errors(FIVE_KINDS)
    for kind in FIVE_KINDS:
        alone, worse = compute_variances_and_errors((kind,))
        assert (predicted < alone).all(), kind.name
        assert np.count_nonzero(made < worse) >= MINIMUM_WINS, kind.name
        assert made.mean() < worse.mean(), kind.name


THREE = np.array([[0.1, 0.0, 0.02], [-0.06, 0.1, 0.03], [-0.05, -0.1, 0.01]])
KINDS_WITH_FRAMES = (
    Position(targets=("a", "b", "c"), places=THREE, unknown=("frame", "targets")),
    Pose(unknown=("frame", "tool")),
    Bearing(places=POINT, unknown=("frame",)),
    Component(("x", "y", "z", "phi", "theta"), "tilt-torsion", unknown=("frame",)),
)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS_WITH_FRAMES, ids=lambda kind: kind.name)
def test_unknown_frame_gives_the_robot_of_the_known_frame_up_to_its_gauge(kind):
    robot = load_robot("hexapod-42")
    truth = robot.with_values(sample_truth(robot, 1, SEED)[0])
    poses, elsewhere = (
        sample_workspace(robot, 50, SEED).coordinates,
        sample_workspace(robot, 15, SEED + 1).solution.q,
    )
    known = identify(
        robot, simulate(truth, poses, make_instrument(Pose(), 50, NoNoise), SEED), LeastSquares()
    )
    for seed in range(2):
        rng = np.random.default_rng(seed)
        quaternion = rng.normal(size=4)
        turn = geometry.log_so3(
            geometry.quaternion_to_matrix(quaternion / np.linalg.norm(quaternion))
        )
        frame = np.concatenate([turn, rng.uniform(1.0, 2.0, 3)])
        true = dict(
            zip(
                [f"frame.{axis}" for axis in ("rx", "ry", "rz", "x", "y", "z")],
                frame.tolist(),
                strict=True,
            )
        )
        data = simulate(
            truth, poses, make_instrument(kind, 50, NoNoise), SEED, nuisance_values=true
        )
        fit = identify(robot, data, LeastSquares())
        assert fit.converged
        assert pose_error(fit.robot, known.robot, elsewhere, ("base", "platform")) < EXACT, seed


def find_locked_coordinates(truth, joint, constant, rng, n=12):
    """Solve for z, phi, theta (n, 3) at which a passive joint of a true 3-PRS has this value."""
    z, phi = rng.uniform(0.66, 0.74, 60), rng.uniform(-np.pi, np.pi, 60)

    def off(theta):
        result = inverse(truth, np.column_stack([z, phi, theta]))
        return result.passive[:, result.passive_names.index(joint)] - constant

    low, high = np.full(60, 0.02), np.full(60, 0.5)
    side = np.sign(off(low))
    solution = side * np.sign(off(high)) < 0.0
    for _ in range(10):
        middle = 0.5 * (low + high)
        before = np.sign(off(middle)) == side
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    # what is left of 0.5 rad is half a milliradian: secants do the rest
    at, at_off, before, before_off = high, off(high), low, off(low)
    for _ in range(5):
        change = at_off - before_off
        step = np.where(
            change == 0.0, 0.0, -at_off * (at - before) / np.where(change == 0.0, 1.0, change)
        )
        before, before_off, at = at, at_off, at + step
        at_off = off(at)
    return np.column_stack([z, phi, at])[solution][:n]


def test_joints_locked_at_unknown_values_recover_a_tripod_up_to_its_frames():
    robot, rng = load_robot("3-prs"), np.random.default_rng(SEED)
    truth = robot.with_values(sample_truth(robot, 1, SEED)[0])
    joints = inverse(truth, np.array([[0.7, 0.0, 0.1]])).passive_names
    usual = inverse(truth, sample_workspace(robot, 60, SEED).coordinates).passive
    sensors, coordinates, constants = [], [], {}
    for i, joint in enumerate(joints):
        for k, constant in enumerate(np.quantile(usual[:, i], [0.3, 0.5, 0.7])):
            constants[f"at{k}.{joint}.locked"] = constant
            coordinates.append(find_locked_coordinates(truth, joint, constant, rng))
        kind = Locked(joints=(joint,), measures="angle")
        group = np.repeat(["at0", "at1", "at2"], 12)
        sensors.append(
            Sensor(kind, NoNoise(np.full(1, 5e-6)), rows=36 * i + np.arange(36), group=group)
        )
    data = simulate(
        truth,
        np.concatenate(coordinates),
        Instrument(tuple(sensors)),
        SEED,
        controller=truth,
        nuisance_values=constants,
    )
    # [rad]: a lock without play shows zeros, which is all that is measured
    assert max(np.abs(o.measured).max() for o in data.observations) < 1e-12
    fit = identify(robot, data, LeastSquares(), options=FitOptions(allow_fewer_equations=True))
    assert fit.rank == 21
    assert compare_along_gauge(fit, data, truth.values) < EXACT
    assert (
        pose_error(
            fit.robot, truth, sample_workspace(robot, 15, SEED).solution.q, ("base", "platform")
        )
        < EXACT
    )
    assert fit.nuisance.values.keys() == constants.keys()


@pytest.fixture(scope="module")
def evidence_tables(root):
    path = root / "docs" / "evidence" / "kinds.json"
    if not path.exists():
        pytest.skip("docs/evidence/kinds.json is made by `make evidence`")
    return {name: table["rows"] for name, table in json.loads(path.read_text())["tables"].items()}


@pytest.mark.evidence
def test_published_recovery_of_every_kind_and_robot_is_exact(evidence_tables):
    assert len(evidence_tables["recovery"]) == len(list_cases(("linear-delta",)))
    for row in evidence_tables["recovery"]:
        assert all(error is None or error < EXACT for error in row[2::2]), row[0]
    refused = [row[0] for row in evidence_tables["recovery"] if None in row[1::2]]
    assert refused == ["component, c a b"], (
        "angles of euler-ZXZ are none where a delta does not turn"
    )


@pytest.mark.evidence
def test_published_coverage_of_every_kind_is_within_its_band(evidence_tables):
    *true, loud = evidence_tables["coverage"]
    kinds = {case.kind.name for case in list_cases(("linear-delta",))}
    assert kinds == {name for name in KINDS if name not in ("closure", "image")}
    assert len(true) == len(ROBOTS) * len(kinds)
    for robot, setting, fits, *shares in true:
        assert fits == FITS, setting
        for share in shares:
            assert share is None or abs(share / 100.0 - 0.95) < coverage_band(fits), (
                robot,
                setting,
            )
    assert loud[3] / 100.0 < 0.95 - coverage_band(FITS)
