# SPDX-License-Identifier: Apache-2.0
"""Certified designs are near the efficiency bound and no worse than twenty exchange starts."""

import json
from pathlib import Path

import numpy as np
import pytest

from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.information import observe_poses
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.workspace import sample_workspace
from loopcal.planning.design_space import (
    A,
    D,
    I,
    PriorInformation,
    compute_efficiency,
    evaluate_criterion,
    factor_design,
)
from loopcal.planning.exchange import choose_design, fedorov_exchange
from tests.planning.design_problems import Array, draw_rows

SIGMA = np.array([5e-5] * 3 + [1e-5] * 3)  # [rad, m]


def linearize_drawn_poses(robot: str, count: int, components: slice = slice(0, 6)) -> Array:
    """Return whitened rows (count, r, p) of poses drawn from a shipped robot's workspace."""
    free = select_free_parameters(load_robot(robot))
    twists = observe_poses(free, sample_workspace(free.robot, count, 0).solution.q).twists[0]
    return (twists / SIGMA[:, None])[:, components]


@pytest.mark.slow
def test_efficiency_of_20_out_of_1000_hexapod_poses_exceeds_95_percent() -> None:
    rows = linearize_drawn_poses("hexapod-42", 1000)
    start = PriorInformation.none(rows.shape[2])
    found = choose_design(rows, 20, D(), start)
    assert found.relaxed.converged
    assert len(found.design.space) == 42
    assert found.efficiency > 0.95  # 0.980 measured
    even = np.arange(20)
    random = evaluate_criterion(
        D(), factor_design(rows[even], start, found.design.space), found.design.space.machine
    )
    assert found.relaxed.efficiency(random) < 0.5  # the first twenty drawn: 0.4 measured


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "components"), [("hexapod-42", slice(3, 6)), ("3-prs", slice(0, 6))]
)
def test_certified_design_is_no_worse_than_the_best_of_20_exchange_starts(
    robot: str, components: slice
) -> None:
    rows = linearize_drawn_poses(robot, 120, components)
    start = PriorInformation.none(rows.shape[2])
    found = choose_design(rows, 20, D(), start)
    best = fedorov_exchange(rows, 20, D(), start, starts=20)
    assert found.design.value >= best.value - 1e-6 * len(
        found.design.space
    )  # to a millionth of the efficiency
    assert 0.9 < found.relaxed.efficiency(best.value) <= found.efficiency + 1e-6


def test_tolerance_prior_changes_the_design_only_for_coarse_data() -> None:
    cut, prior = PriorInformation.none(42), PriorInformation.from_tolerances(42)
    kept = []
    for precision in (1.0, 1e3):
        rows = precision * linearize_drawn_poses(
            "hexapod-42", 150, slice(3, 6)
        )  # position only: three directions that no pose shows
        plain, bayes = (
            choose_design(rows, 20, D(), start, perturbations=5) for start in (cut, prior)
        )
        space = plain.design.space
        assert (len(space), len(bayes.design.space)) == (39, 42)
        values = [
            evaluate_criterion(D(), factor_design(rows[c.design.chosen], cut, space), space.machine)
            for c in (plain, bayes)
        ]
        kept.append(compute_efficiency(D(), values[1], values[0], 39))
    assert (
        kept[0] < 0.9
    )  # with coarse data other poses are better: what the tolerances say need not be measured
    assert 0.98 < kept[1] < 1.02


@pytest.mark.slow
def test_design_by_criterion_i_predicts_better_than_by_criterion_d() -> None:
    rows = draw_rows(N=60, machine=6, seed=2)
    L = np.random.default_rng(3).normal(size=(4, 6)) * np.array([9.0, 3.0, 1.0, 0.3, 0.1, 0.03])
    start = PriorInformation.none(6)
    wanted = I(L, 4)
    for_I, for_D = (choose_design(rows, 8, criterion, start).design for criterion in (wanted, D()))
    other = evaluate_criterion(
        wanted, factor_design(rows[for_D.chosen], start, for_D.space), for_D.space.machine
    )
    assert for_I.value < other


@pytest.mark.parametrize("criterion", [D(), A()], ids=["D", "A"])
def test_efficiency_is_at_most_one_and_repeats_do_not_worsen_the_design(criterion: D | A) -> None:
    rows = draw_rows(N=30)
    once, often = (
        choose_design(rows, 7, criterion, PriorInformation.none(4), repeats=repeats)
        for repeats in (False, True)
    )
    assert 0.8 < once.efficiency <= 1.0 + 1e-9
    assert 0.8 < often.efficiency <= 1.0 + 1e-9
    assert compute_efficiency(criterion, once.design.value, often.design.value, 4) <= 1.0 + 1e-9


def test_same_seed_gives_the_same_design() -> None:
    rows = draw_rows(N=80, machine=6)
    first, second = (
        choose_design(rows, 9, D(), PriorInformation.none(6), seed=4) for _ in range(2)
    )
    np.testing.assert_array_equal(first.design.chosen, second.design.chosen)


def test_design_of_all_candidates_has_efficiency_one() -> None:
    found = choose_design(draw_rows(), 12, D(), PriorInformation.none(4))
    np.testing.assert_array_equal(found.design.chosen, np.arange(12))
    assert found.efficiency == pytest.approx(1.0, abs=1e-9)


def test_incomplete_first_design_is_completed() -> None:
    rows = draw_rows(N=30)
    found = choose_design(
        rows,
        7,
        D(),
        PriorInformation.none(4),
        first=[np.array([3, 5]), np.array([], dtype=np.int64)],
    )
    assert len(found.design.chosen) == 7


@pytest.mark.evidence
def test_evidence_certified_designs_are_no_worse_than_exchange(root: Path) -> None:
    path = root / "docs" / "evidence" / "plan_designs.json"
    if not path.is_file():
        pytest.skip("docs/evidence/plan_designs.json is made by `make evidence`")
    table = json.loads(path.read_text("utf-8"))["tables"]["designs"]
    best, certified = (
        table["columns"].index(name) for name in ("exchange, best start", "certified design")
    )
    assert table["rows"]
    for row in table["rows"]:
        assert row[certified] >= row[best] - 1e-6, row  # to a millionth of the efficiency
        assert row[:3] != ["hexapod-42", "full pose", "D"] or row[certified] >= 0.95


def test_candidates_without_information_leave_the_prior_unchanged() -> None:
    found = choose_design(np.zeros((6, 2, 3)), 2, D(), PriorInformation.from_tolerances(3))
    assert found.efficiency == 1.0
    assert found.design.value == pytest.approx(0.0, abs=1e-12)  # log det of the unit matrix
