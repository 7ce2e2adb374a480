# SPDX-License-Identifier: Apache-2.0
"""Accuracy after calibration with planned and with random poses.

Few machines here; `make evidence` (evidence/planned.py) uses twenty seeds.
"""

import json
from itertools import pairwise

import numpy as np
import pytest

from evidence.planned import (
    CASES,
    SEEDS,
    find_equal_number,
    measure_planned,
    measure_random,
    prepare_study,
)

FEW, MACHINES, POSES = 6, 4, 16
ONE_OF_EACH = (CASES[1], CASES[2], CASES[4])
"""Hexapod by positions, 3-PRS by full poses, delta."""
LEAST_SEEDS = 15
"""If planned poses were no better than random ones, so many of 20 seeds would favour them with a
chance of 2 %.
"""


@pytest.mark.slow
@pytest.mark.parametrize("case", ONE_OF_EACH, ids=lambda case: case.robot)
def test_planned_poses_give_smaller_errors_than_as_many_random_poses(case):
    study = prepare_study(case, FEW, MACHINES, POSES, candidates=200)
    found = [
        (e, study.target_error(e.position, e.orientation))
        for e in (measure_planned(study, POSES), measure_random(study, POSES))
    ]
    (_, planned), (_, random) = found
    assert np.median(planned) < np.median(random)
    for errors, error in found:
        # an rms of 24 machines whose error has 9 or more degrees of freedom: standard deviation 1 /
        # sqrt(2 * 24 * 9), of which four; 0.05 more for what the prediction, linear and at the
        # nominal machine, leaves out
        rms, expected = np.sqrt((error**2).mean()), np.sqrt((errors.expected**2).mean())
        assert rms / expected == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * error.size * 9) + 0.05)


def test_equal_number_of_poses_is_interpolated_by_the_square_root_law():
    numbers = (8, 16, 64)
    errors = [1.0 / np.sqrt(n) for n in numbers]
    assert find_equal_number(numbers, errors, 1.0 / np.sqrt(30.0)) == pytest.approx(30.0, rel=1e-12)
    assert find_equal_number(numbers, errors, errors[0]) == pytest.approx(8.0, rel=1e-12)


def test_random_increase_of_the_error_does_not_change_the_equal_number():
    assert find_equal_number((8, 16, 32), [2.0, 1.0, 1.1], 1.0) == pytest.approx(16.0, rel=1e-12)


@pytest.mark.parametrize("error", [1.1, 0.1])
def test_error_outside_the_measured_range_has_no_equal_number(error):
    assert find_equal_number((8, 16, 64), [1.0, 0.7, 0.35], error) is None


@pytest.fixture(scope="module")
def tables(root):
    path = root / "docs" / "evidence" / "planned.json"
    if not path.exists():
        pytest.skip("docs/evidence/planned.json is made by `make evidence`")
    return json.loads(path.read_text())["tables"]


@pytest.mark.evidence
def test_planned_poses_have_smaller_errors_on_every_robot_at_every_number(tables):
    rows = tables["accuracy"]["rows"]
    assert {(row[0], row[1]) for row in rows} == {(case.robot, case.measured) for case in CASES}
    for *_, position, other, orientation, turned, better in rows:
        assert position < other
        assert orientation is None or orientation < turned
        assert LEAST_SEEDS <= better <= SEEDS


@pytest.mark.evidence
def test_plan_saves_a_quarter_of_the_poses_as_predicted(tables):
    assert tables["saving"]["rows"]
    for _, _, n, equal, saved, predicted, boundary, *ratios in tables["saving"]["rows"]:
        assert saved > 25.0
        # medians of 100 machines with 9 or more degrees of freedom: 3 % of an error, 6 % of a
        # number of poses, of both medians 8 %; nearer than three of that
        assert equal == pytest.approx(predicted, rel=0.25)
        # what is left of the saving where random poses, too, are drawn at the boundary
        assert 0.1 < 1.0 - n / boundary < 1.0 - n / predicted
        assert ratios == pytest.approx([1.0, 1.0], abs=0.1)


@pytest.mark.evidence
def test_plan_saves_poses_at_any_noise_and_fewer_at_high_noise(tables):
    assert tables["noise"]["rows"]
    for _, _, n, *numbers in tables["noise"]["rows"]:
        assert min(numbers) > n
        # 3 %: interpolation, and the last percent of efficiency that a plan does not look for
        assert all(louder < 1.03 * quieter for quieter, louder in pairwise(numbers))
