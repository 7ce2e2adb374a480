# SPDX-License-Identifier: Apache-2.0
"""Pose accuracy and repeatability: the formulas of ISO 9283, coverage of the intervals, frames."""

from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.repeatability import (
    Estimate,
    VisitedPose,
    compute_repeatability,
    describe_visits,
)
from loopcal.cli.entry_point import main
from loopcal.errors import DataError
from tests.estimate.problems import UM, hexapod_poses, tracker

MM = 1e-3
SHIFT = np.array([0.02, -0.03, 0.05]) * MM


def get_estimates(pose: VisitedPose) -> tuple[Estimate, Estimate]:
    """Return AP and RP of a position."""
    assert pose.accuracy is not None
    assert pose.repeatability is not None
    return pose.accuracy, pose.repeatability


def visit_poses(robot, poses, visits, sigma, shift):
    """Return measured full poses of a machine whose tool is shifted, at repeated visits."""
    commanded = np.repeat(poses, visits, axis=0)
    instrument = tracker(sigma, 5e-6)
    data = lc.simulate(robot, commanded, instrument, seed=4)
    (rows,) = data.observations
    columns = [c.name for c in rows.kind.columns]
    moved = rows.measured.copy()
    moved[:, [columns.index(c) for c in "xyz"]] += shift
    return replace(data, observations=(replace(rows, measured=moved),))


def test_numbers_equal_those_of_the_formulas() -> None:
    """A direct transcription of ISO 9283, 7.2.1 and 7.2.2, with sums over the visits."""
    robot = lc.load_robot("hexapod-42")
    data = visit_poses(robot, hexapod_poses(2), 6, 10 * UM, SHIFT)
    result = lc.assess_repeatability(robot, data)
    (rows,) = data.observations
    names = [c.name for c in rows.kind.columns]
    for k, pose in enumerate(result.poses["position"]):
        attained = rows.measured[6 * k : 6 * k + 6][:, [names.index(c) for c in "xyz"]]
        commanded = lc.forward(robot, data.readings[6 * k : 6 * k + 1]).T[0] @ robot.tool
        bary = [sum(row[i] for row in attained) / 6 for i in range(3)]
        ap = sum((bary[i] - commanded[i, 3]) ** 2 for i in range(3)) ** 0.5
        lengths = [sum((row[i] - bary[i]) ** 2 for i in range(3)) ** 0.5 for row in attained]
        mean = sum(lengths) / 6
        rp = mean + 3 * (sum((x - mean) ** 2 for x in lengths) / 5) ** 0.5
        assert pose.visits == 6
        accuracy, repeatability = get_estimates(pose)
        assert accuracy.value == pytest.approx(ap, rel=1e-6)
        assert repeatability.value == pytest.approx(rp, rel=1e-6)
        assert pose.mean == pytest.approx(SHIFT, abs=15 * UM)  # attained minus commanded
    turns = result.poses["orientation"][0]
    assert turns.accuracy is None
    assert turns.components == ("rx", "ry", "rz")
    assert turns.repeatabilities[0].value == pytest.approx(3 * 5e-6, rel=0.8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("visits", "bias", "sd"),
    [
        (5, 0.0, (1.0, 1.0, 1.0)),
        (30, 2.0, (1.0, 0.5, 0.2)),
        *(
            pytest.param(*case, marks=pytest.mark.evidence)
            for case in (
                (5, 0.0, (1.0, 0.5, 0.2)),
                (30, 2.0, (1.0, 1.0, 1.0)),
                *((5, 5.0, sd) for sd in ((1.0, 1.0, 1.0), (1.0, 0.5, 0.2))),
                *((30, 0.3, sd) for sd in ((1.0, 1.0, 1.0), (1.0, 0.5, 0.2))),
            )
        ),
    ],
)
def test_intervals_contain_the_truth(visits, bias, sd) -> None:
    rng, true_mean, tests = np.random.default_rng(1), np.array([bias, 0.0, 0.0]), 100
    true = float(compute_repeatability(rng.standard_normal((200_000, 3)) * sd))
    inside = np.zeros(4)
    for _ in range(tests):
        pose = describe_visits(true_mean + rng.standard_normal((visits, 3)) * sd, True)
        accuracy, repeatability = get_estimates(pose)
        inside += [
            accuracy.low <= bias <= accuracy.high,
            repeatability.low <= true <= repeatability.high,
            pose.accuracies[1].low <= 0.0 <= pose.accuracies[1].high,
            pose.repeatabilities[1].low <= 3.0 * sd[1] <= pose.repeatabilities[1].high,
        ]
    assert (inside / tests >= 0.88).all(), inside


def test_unknown_frame_hides_a_common_shift_but_not_the_scatter() -> None:
    robot = lc.load_robot("hexapod-42")
    known = visit_poses(robot, hexapod_poses(5), 5, 10 * UM, SHIFT)
    (rows,) = known.observations
    free = replace(rows, kind=replace(rows.kind, unknown=("frame",), frame="tracker"))
    fitted = lc.assess_repeatability(robot, replace(known, observations=(free,)))
    stated = lc.assess_repeatability(robot, known)
    for a, b in zip(stated.poses["position"], fitted.poses["position"], strict=True):
        (stated_ap, stated_rp), (fitted_ap, fitted_rp) = get_estimates(a), get_estimates(b)
        assert stated_ap.value > 40 * UM > fitted_ap.value
        assert stated_rp.value == pytest.approx(fitted_rp.value, rel=1e-3)
    assert stated.frame == "in the stated frame"
    assert "best fit of tracker" in fitted.frame
    codes = {f.code for f in fitted.findings}
    assert {"repeatability.frame-fitted", "repeatability.few-visits"} <= codes
    assert "repeatability.frame-fitted" not in {f.code for f in stated.findings}


def test_directions_of_approach_have_numbers_of_their_own() -> None:
    robot = lc.load_robot("hexapod-42")
    data = visit_poses(robot, hexapod_poses(1), 10, 1 * UM, 0.0)
    (rows,) = data.observations
    side = np.array(["up"] * 5 + ["down"] * 5)
    moved = rows.measured.copy()
    moved[:5, [c.name for c in rows.kind.columns].index("z")] += 30 * UM
    rows = replace(rows, measured=moved, group=side)
    result = lc.assess_repeatability(robot, replace(data, observations=(rows,)))
    assert [p.direction for p in result.poses["position"]] == ["up", "down"]
    assert result.variations["1", ""] == pytest.approx(30 * UM, abs=2 * UM)
    assert all(get_estimates(p)[1].value < 10 * UM for p in result.poses["position"])


@pytest.mark.parametrize("visits", [2, 5])
def test_equal_visits_have_no_scatter_and_no_finding_on_noise(visits) -> None:
    robot = lc.load_robot("hexapod-42")
    data = visit_poses(robot, hexapod_poses(2), visits, 10 * UM, SHIFT)
    (rows,) = data.observations
    equal = np.repeat(rows.measured[::visits], visits, axis=0)
    result = lc.assess_repeatability(
        robot, replace(data, observations=(replace(rows, measured=equal),))
    )
    assert {p.visits for of in result.poses.values() for p in of} == {visits}
    for pose in result.poses["position"]:
        assert [e.value for e in pose.repeatabilities] == pytest.approx([0.0] * 3, abs=1e-15)
    assert {f.code for f in result.findings} == {"repeatability.few-visits"}


def measure_with_gauges(robot, visits, *kinds):
    """Return readings of gauges, each of one kind, at repeated visits of one pose."""
    sensors = [lc.Sensor(kind, lc.Gaussian(np.full(len(kind.columns), 10 * UM))) for kind in kinds]
    poses = np.repeat(hexapod_poses(1), visits, axis=0)
    return lc.simulate(robot, poses, lc.Instrument(tuple(sensors)), seed=4)


@pytest.mark.parametrize("axes", [("x", "y"), ("z", "xy"), ("xz", "y", "zx")])
def test_gauges_of_several_axes_are_instruments_of_their_own(axes) -> None:
    """Each has the numbers it has alone, under the names of its axes."""
    robot = lc.load_robot("hexapod-42")
    data = measure_with_gauges(robot, 6, *(lc.Component(tuple(each)) for each in axes))
    together = lc.assess_repeatability(robot, data).poses["position"]
    assert [pose.components for pose in together] == [tuple(each) for each in axes]
    for pose, rows in zip(together, data.observations, strict=True):
        (alone,) = lc.assess_repeatability(robot, replace(data, observations=(rows,))).poses[
            "position"
        ]
        assert pose.visits == alone.visits == 6
        assert pose.mean == pytest.approx(alone.mean, rel=1e-12)
        assert get_estimates(pose) == get_estimates(alone)


def test_visits_of_two_instruments_do_not_count_as_two() -> None:
    robot = lc.load_robot("hexapod-42")
    data = measure_with_gauges(robot, 1, lc.Component(("x",)), lc.Component(("y",)))
    with pytest.raises(DataError, match="Repeatability needs several visits of a pose"):
        lc.assess_repeatability(robot, data)


def test_directions_of_approach_are_compared_for_each_gauge() -> None:
    robot = lc.load_robot("hexapod-42")
    data = measure_with_gauges(robot, 10, lc.Component(("x",)), lc.Component(("y",)))
    side, shift = np.array(["up"] * 5 + ["down"] * 5), np.zeros((10, 1))
    shift[:5] = 300 * UM
    x, y = data.observations
    x, y = replace(x, measured=x.measured + shift, group=side), replace(y, group=side)
    result = lc.assess_repeatability(robot, replace(data, observations=(x, y)))
    assert result.variations["1", ""] == pytest.approx(300 * UM, abs=20 * UM)


def test_coarse_instruments_are_reported() -> None:
    robot = lc.load_robot("hexapod-42")
    result = lc.assess_repeatability(robot, visit_poses(robot, hexapod_poses(1), 8, 10 * UM, 0.0))
    noise = [f for f in result.findings if f.code == "repeatability.instrument-noise"]
    assert {f.data["quantity"] for f in noise} == {"position", "orientation"}


def test_expanded_uncertainty_is_compared_with_the_characteristic_of_iso_9283() -> None:
    """With u = 0.3 S, U is 0.2 of RP = 3 S of an angle, and about 0.29 of RP_l of a position."""
    robot = lc.load_robot("hexapod-42")
    data = visit_poses(robot, hexapod_poses(4), 30, 10 * UM, 0.0)
    (rows,) = data.observations
    better = replace(data, observations=(replace(rows, covariance=0.09 * rows.covariance),))
    (noise,) = [
        f
        for f in lc.assess_repeatability(robot, better).findings
        if f.code == "repeatability.instrument-noise"
    ]
    assert noise.data["quantity"] == "position"
    assert noise.data["share"] == pytest.approx(0.29, abs=0.03)  # of 120 visits


def test_data_without_repeats_or_poses_are_refused() -> None:
    robot = lc.load_robot("hexapod-42")
    with pytest.raises(DataError, match="Repeatability needs several visits of a pose"):
        lc.assess_repeatability(robot, visit_poses(robot, hexapod_poses(3), 1, UM, 0.0))
    legs = lc.Instrument((lc.Sensor(lc.Distance(), lc.Gaussian(np.array([UM]))),))
    data = lc.simulate(robot, hexapod_poses(3), legs, seed=0)
    with pytest.raises(DataError, match="contain neither position nor orientation"):
        lc.assess_repeatability(robot, data)


def test_jitter_of_recorded_readings_is_part_of_the_repeatability() -> None:
    """The command is one: each visit is compared with the mean of the recorded readings."""
    robot = lc.load_robot("hexapod-42")
    data = visit_poses(robot, hexapod_poses(4), 8, UM, SHIFT)
    jitter = np.random.default_rng(1).normal(0.0, UM / 5, data.readings.shape)
    jitter -= np.repeat(jitter.reshape(4, 8, -1).mean(axis=1), 8, axis=0)
    recorded = lc.assess_repeatability(robot, replace(data, readings=data.readings + jitter))
    for pose, equal in zip(
        recorded.poses["position"],
        lc.assess_repeatability(robot, data).poses["position"],
        strict=True,
    ):
        estimates = zip(get_estimates(pose), get_estimates(equal), strict=True)
        assert all(a.value == pytest.approx(b.value, abs=1e-3 * UM) for a, b in estimates)


def test_command_prints_the_page(tmp_path, capsys) -> None:
    robot = lc.load_robot("hexapod-42")
    lc.save_measurements(
        visit_poses(robot, hexapod_poses(2), 5, 10 * UM, SHIFT), tmp_path / "visits.csv", robot
    )
    assert main(["repeatability", "hexapod-42", str(tmp_path / "visits.csv")]) == 0
    text = capsys.readouterr().out
    assert "Position by ISO 9283 with intervals of 95 %, in the stated frame" in text
    assert "ISO 9283 asks for 30" in text
