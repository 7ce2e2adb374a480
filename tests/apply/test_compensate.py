# SPDX-License-Identifier: Apache-2.0
"""Compensation: commands that make the identified robot reach its targets, as far as its actuators
allow, and the remaining errors.
"""

import csv

import numpy as np
import pytest

from loopcal import geometry, load_robot
from loopcal.apply.compensation import Reach, compensate
from loopcal.errors import DataError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.runs.result_files import format_compensation
from loopcal.mechanism.platform_coordinates import compare_coordinates
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from tests.estimate.problems import hexapod, hexapod_data, hexapod_poses

ROBOTS = ("hexapod-42", "3-prs", "linear-delta", "ru-pus-prs", "five-bar")


def make_identified_robot(name, seed=1):
    """Return a robot with random errors of its spreads (default 0.1 mm and 0.1 mrad)."""
    robot = load_robot(name)
    spread = np.nan_to_num(robot.parameters.tolerance, nan=1e-4)
    return robot.with_values(
        robot.values + spread * np.random.default_rng(seed).standard_normal(len(spread))
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_readings_reach_the_controlled_coordinates_and_commands_give_these_readings(name):
    robot = make_identified_robot(name)
    targets = sample_workspace(robot, 20, 2).coordinates
    best, result = compensate(robot, targets), compensate(robot, targets, "commands", steps=6)
    reached = forward(robot, best.readings).T
    demanded = compare_coordinates(reached, targets, robot.controlled, robot.size)[0]
    assert np.abs(demanded).max() < 1e-12  # [m], closure solved to rounding
    assert best.usable.all()
    assert best.uncertainty is None
    assert result.commands is not None
    commanded = inverse(robot.nominal, result.commands).q
    for readings in (result.readings, commanded):  # [m, rad] six steps of a hundredth each
        np.testing.assert_allclose(readings, best.readings, rtol=0, atol=1e-10)
    left = (result.residual_position + robot.size * result.residual_orientation)[:4]
    assert result.residual_position.shape == (7, 20)
    assert (left[1:] < 0.1 * left[:-1] + 1e-12).all()  # [m], each step reduces it tenfold


def test_four_targets_in_four_coordinates_are_not_a_pose():
    robot = make_identified_robot("par4")
    targets = sample_workspace(robot, 5, 2).coordinates
    some, all_of_them = compensate(robot, targets[:4]), compensate(robot, targets)
    np.testing.assert_allclose(some.readings, all_of_them.readings[:4], rtol=0, atol=1e-12)


def test_hexapod_is_compensated_in_full():
    targets = sample_workspace(load_robot("hexapod-42"), 10, 3).solution.T
    result = compensate(make_identified_robot("hexapod-42"), targets)
    assert set(result.reach) == {Reach.REACHED}
    assert np.linalg.norm(result.before[:, 3:], axis=1).min() > 1e-6
    np.testing.assert_allclose(result.remaining, 0, atol=1e-12)


def test_remaining_error_of_a_tripod_is_the_minimum_over_readings():
    robot = make_identified_robot("3-prs")
    targets = sample_workspace(load_robot("3-prs"), 10, 3).solution.T
    result = compensate(robot, targets)
    assert set(result.reach) == {Reach.IN_PART}
    assert result.findings[0].code == "compensation.reached-in-part"
    assert result.findings[0].data["names"] == ("z", "phi", "theta")
    assert 0.0 < result.findings[0].data["position"].value < 1.0  # [mm]

    def distance(readings):
        gap = geometry.pose_difference(forward(robot, readings).T, targets)
        return (gap[:, 3:] ** 2).sum(axis=1) + robot.size**2 * (gap[:, :3] ** 2).sum(axis=1)

    here = distance(result.readings)
    np.testing.assert_allclose(result.not_compensable, result.remaining)
    for step in np.random.default_rng(0).standard_normal((20, 3)) * 2e-6:
        assert (distance(result.readings + step) > here).all()


def test_compensated_commands_converge_at_zero_tilt():
    result = compensate(
        make_identified_robot("3-prs"),
        [[0.7, 0.0, 0.0], [0.7, 2.0, 0.0], [0.7, -1.0, 1e-9]],
        "commands",
    )
    assert result.usable.all()
    assert result.residual_orientation[-1].max() < 1e-9  # [rad]


def test_targets_out_of_reach_or_beyond_strokes_are_reported():
    robot = load_robot("hexapod-42")
    targets = [
        [0, 0, 0.2, 0, 0, 0],
        [0, 0, 0.30, 0, 0, 0],
        [0, 0, 5.0, 0, 0, 0],
        [np.nan, 0, 0.2, 0, 0, 0],
    ]
    result = compensate(robot, targets, labels=("home", "high", "moon", "nowhere"))
    assert result.labels[1] == "high"
    assert result.reach[:2] == (Reach.REACHED, Reach.OUTSIDE)
    assert result.usable.tolist() == [True, False, False, False]
    assert "stroke of q1" in result.findings[1].data["limit"]
    assert result.findings[3].code == "compensation.unreachable"


def test_failed_target_does_not_change_other_targets():
    robot = make_identified_robot("hexapod-42")
    good = sample_workspace(robot, 4, 3).coordinates
    alone = compensate(robot, good, "commands")
    mixed = compensate(robot, np.vstack([good, np.full(6, np.nan)]), "commands")
    np.testing.assert_allclose(mixed.readings[:4], alone.readings, rtol=0, atol=1e-12)
    assert mixed.reach[4] is Reach.UNREACHABLE


def test_compensation_from_a_fit_gives_the_uncertainty_of_each_target():
    fit = identify(hexapod(), hexapod_data(), LeastSquares())
    result = compensate(fit, hexapod_poses(4, seed=5))
    assert result.uncertainty is not None
    assert result.uncertainty.expanded.shape == (4, 6)
    assert (result.uncertainty.position < 2e-6).all()  # [m], instrument 1 um
    assert result.to_dict()["uncertainty"]["frame"].startswith("tool point, base axes")


def test_invalid_compensation_arguments_are_refused():
    robot = load_robot("3-prs")
    with pytest.raises(DataError, match=r"mode is 'poses'.*must be one of 'readings', 'commands'"):
        compensate(robot, [[0.7, 0, 0]], "poses")  # pyright: ignore[reportArgumentType]
    with pytest.raises(DataError, match="steps is 0, but must be 1 or more"):
        compensate(robot, [[0.7, 0, 0]], "commands", steps=0)
    with pytest.raises(DataError, match="a target has the shape"):
        compensate(robot, [[0.7, 0.0]])
    with pytest.raises(DataError, match="0 labels for 0 targets: give at least one target"):
        compensate(robot, np.zeros((0, 3)))


@pytest.mark.parametrize("mode", ["readings", "commands"])
@pytest.mark.parametrize("labels", [("a",), ("a", "b", "c", "d")])
def test_another_number_of_labels_than_of_targets_is_refused(labels, mode) -> None:
    robot = load_robot("3-prs")
    for given in (np.tile([0.7, 0.0, 0.0], (3, 1)), np.tile(robot.home, (3, 1, 1))):
        with pytest.raises(DataError, match=f"{len(labels)} labels? for 3 targets"):
            compensate(robot, given, mode, labels=labels)


@pytest.mark.parametrize(("mode", "passes"), [("readings", 4), ("commands", 7)])
def test_compensation_progress_counts_passes_over_all_targets(mode, passes) -> None:
    reports = []
    robot = hexapod()
    compensate(robot, robot.home[None], mode, progress=lambda *report: reports.append(report))
    assert [(done, total) for done, total, _ in reports] == [(i, passes) for i in range(passes)]


def test_no_error_is_stated_where_the_machine_does_not_get_to_a_pose():
    robot = load_robot("3-prs")
    targets = np.array([[0.7, 0.2, 0.2], [0.5, 3.0, 2.0]])
    for mode in ("readings", "commands"):
        result = compensate(robot, targets, mode)
        assert result.usable.tolist() == [True, False]
        assert np.isfinite(result.before[0]).all()
        assert np.isnan(result.before[1]).all()
        assert np.isnan(result.remaining[1]).all() or mode == "commands"


@pytest.mark.parametrize("name", ["hexapod-42", "linear-delta"])
def test_file_states_errors_that_are_rounding_as_0(name) -> None:
    robot = make_identified_robot(name)
    result = compensate(robot, sample_workspace(robot, 8, 2).coordinates, "commands")
    header, *rows = csv.reader(format_compensation(result).splitlines())
    is_note = [title.startswith("note ") and title != "note status" for title in header]
    stated = np.array(rows)[:, is_note].astype(float)
    assert not ((stated != 0.0) & (np.abs(stated) < 1e-9)).any()  # [mm, deg]
    assert (stated == 0.0).any()
    assert (np.abs(stated) > 1e-3).any()
