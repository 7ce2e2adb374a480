# SPDX-License-Identifier: Apache-2.0
"""Time and memory grow in proportion to rows, poses and targets."""

from __future__ import annotations

import gc
import math
import sys
import time
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.bench_growth import draw_sessions
from loopcal.apply.compensation import compensate
from loopcal.diagnose import bootstrap
from loopcal.diagnose.bootstrap import Clusters, choose_clusters, compute_robust_spread
from loopcal.diagnose.residual_patterns import ResidualRows
from loopcal.diagnose.row_errors import PosePredictions
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.observation_rows import list_block_labels
from loopcal.estimate.pose_estimate import fit_nuisance_values
from loopcal.io.core.csv_table import read_table
from loopcal.io.data.measurement_file import load_measurements, load_pose_names
from loopcal.io.robot.robot_file import load_robot
from loopcal.io.runs.result_files import format_compensation, load_targets
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.solutions import forward
from loopcal.numerics.elimination import UnknownRoot
from loopcal.report.calibration_view import view_compensation
from tests.diagnose.correlated_data import ROBOTS, draw_errors, make_rows, measure

MORE, MOST = 8, 24.0
"""Times as many rows, and the largest growth of the time: 8 in proportion, 64 for all pairs."""


def count_calls(function: Callable[[], object]) -> int:
    """Return the number of Python functions, generators included, that a call enters."""
    count = 0

    def notice(_frame: object, event: str, _argument: object) -> None:
        nonlocal count
        count += event == "call"

    sys.setprofile(notice)
    try:
        function()
    finally:
        sys.setprofile(None)
    return count


def measure_growth(make: Callable[[int], Callable[[], object]], small: int) -> float:
    """Return how much longer `MORE` times as much takes, by the shortest CPU time of three.

    Both are timed in turns: other programs then lengthen the times of both.
    """
    functions = make(small), make(MORE * small)
    gc.disable()
    try:
        rounds = [[time_call(function) for function in functions] for _ in range(3)]
    finally:
        gc.enable()
    few, many = map(min, zip(*rounds, strict=True))
    return many / few


def time_call(function: Callable[[], object]) -> float:
    """Return the CPU time of a call [s]."""
    begin = time.process_time()
    function()
    return time.process_time() - begin


def draw_targets(n: int) -> np.ndarray:
    """Return n positions in the workspace of the linear delta [m]."""
    robot = ROBOTS["linear-delta"]
    ranges = np.array([robot.assembly.workspace[name] for name in robot.controlled])
    return np.random.default_rng(0).uniform(ranges[:, 0], ranges[:, 1], (n, len(ranges)))


def test_compensation_and_its_table_are_linear_in_the_targets() -> None:
    robot = load_robot("linear-delta")

    def work(n: int) -> int:
        targets = draw_targets(n)

        def run() -> None:
            result = compensate(robot, targets)
            format_compensation(result)
            view_compensation(result)
            str(result)

        return count_calls(run)

    work(10)
    few, many = work(100), work(400)
    assert (many - few) / few < 3.5


def test_setup_parameters_of_all_sessions_are_fitted_at_once() -> None:
    robot = load_robot("hexapod-42")

    def work(sessions: int) -> int:
        data = draw_sessions(robot, 4 * sessions, sessions, 3)
        T, nuisance = forward(robot, data.readings).T, data.nuisance_parameters
        fit_nuisance_values(robot, data, T, nuisance)
        return count_calls(lambda: fit_nuisance_values(robot, data, T, nuisance))

    assert work(MORE * 4) < 3 * work(4)


@pytest.mark.parametrize("read", ["poses", "targets", "measurements"])
def test_files_are_read_in_time_proportional_to_their_rows(tmp_path, read) -> None:
    robot = load_robot("linear-delta")
    head = {
        "poses": "pose",
        "targets": "pose,x [mm],y [mm],z [mm]",
        "measurements": "# kind: component\n# components: [z]\n# noise: {z: 10 um}\n"
        "pose,q1 [mm],q2 [mm],q3 [mm],z [mm]",
    }[read]

    def make(n: int) -> Callable[[], object]:
        rows = ("", ",1.5,2,{0}", ",2{0}.5,2{0},2{0},{1}")
        row = "p{1}" + rows[("poses", "targets", "measurements").index(read)]
        file = tmp_path / f"{n}.csv"
        lines = (row.format(i % 90, i) for i in range(n))
        file.write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
        return {
            "poses": lambda: load_pose_names(file),
            "targets": lambda: load_targets(file, robot),
            "measurements": lambda: load_measurements(file, robot, allow_outside_stroke=True),
        }[read]

    assert measure_growth(make, 1500) < MOST


def test_a_table_holds_a_few_objects_whatever_its_length(tmp_path) -> None:
    file = tmp_path / "data.csv"
    lines = (f"p{i},{i}.5,2,3" for i in range(3000))
    file.write_text("\n".join(["pose,x [mm],y [mm],z [mm]", *lines]) + "\n", encoding="utf-8")
    gc.collect()
    before = len(gc.get_objects())
    table = read_table(file)
    assert len(table) == 3000
    assert len(gc.get_objects()) - before < 100  # each collection of garbage visits all of them


def test_a_table_takes_little_more_memory_than_its_text(tmp_path) -> None:
    file = tmp_path / "data.csv"
    head = ",".join(["pose", *(f"c{i} [mm]" for i in range(20))])
    lines = (f"p{i}" + f",{i % 90}.123456" * 20 for i in range(5000))
    file.write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
    tracemalloc.start()
    table = read_table(file)
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    size = file.stat().st_size
    assert held < 1.6 * size  # a tuple of texts for each column takes 6 times the file
    assert peak < 3.5 * size
    assert table.text("c3")[4321] == f"{4321 % 90}.123456"


def test_held_out_poses_are_checked_in_time_proportional_to_their_number() -> None:
    def make(n: int) -> Callable[[], object]:
        is_held_out = np.arange(n) % 2 == 0
        readings = np.zeros((n, 3))
        return lambda: Measurements("linear-delta", readings, (), is_held_out=is_held_out)

    assert measure_growth(make, 3000) < MOST


def test_labels_of_blocks_are_listed_in_time_proportional_to_the_poses() -> None:
    assert list_block_labels(("a", "b", "c"), np.array([1, 0, 1])) == (("b",), ("a", "c"))

    def make(n: int) -> Callable[[], object]:
        labels = tuple(map(str, range(n)))
        return lambda: list_block_labels(labels, np.arange(n))

    assert measure_growth(make, 5000) < MOST


def draw_rows(count: int, parameters: int) -> ResidualRows:
    """Return rows with random residuals of a fit of some parameters."""
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.standard_normal((count, parameters)))[0]
    return make_rows(basis, rng.standard_normal(count))


def test_rows_that_a_fit_does_not_use_are_as_good_as_those_with_an_error_of_their_own() -> None:
    rows, wrong = draw_rows(60, 5), np.array([3, 40, 41])
    kept = np.setdiff1d(np.arange(60), wrong)
    left, own = rows.without(wrong), rows.with_effects(np.eye(60)[:, wrong])
    np.testing.assert_allclose(left.residual, own.residual[kept], atol=1e-13)
    projector = np.eye(60) - own.basis.times(own.basis.toarray().T)
    np.testing.assert_allclose(
        np.eye(57) - left.basis.times(left.basis.toarray().T),
        projector[np.ix_(kept, kept)],
        atol=1e-12,
    )


def test_rows_are_left_out_without_a_square_matrix() -> None:
    rows, wrong = draw_rows(6000, 5), np.arange(0, 6000, 100)
    tracemalloc.start()
    rows.without(wrong)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 * rows.basis.wide.nbytes  # a matrix of all rows has 1200 times as many


def test_an_even_choice_of_clusters_stands_for_all(monkeypatch) -> None:
    _, data = measure("linear-delta", "component", draw_errors(240, 3, 4), 4)
    fit = identify(ROBOTS["linear-delta"], data)
    clusters = Clusters("pose", np.arange(240), 240)
    linear = linearize_fit(fit, data)
    whole = compute_robust_spread(linear, clusters)
    monkeypatch.setattr(bootstrap, "MOST_CLUSTERS", 80)
    chosen, times = choose_clusters(clusters)
    assert (chosen.count, times, int((chosen.member >= 0).sum())) == (80, 3.0, 80)
    part = compute_robust_spread(linear, clusters)
    effect = np.eye(len(fit.names))
    all_ratio, ratio = whole.compare(effect), part.compare(effect)
    assert len(part.scores) == 80
    assert ratio.degrees < all_ratio.degrees / 2.0
    # the square of a ratio has the standard deviation sqrt(2 / degrees)
    for each in (ratio, all_ratio):
        assert abs(each.ratio**2 - 1.0) < 4.0 * math.sqrt(2.0 / each.degrees)
        assert each.p_value > 1e-3


def test_predictions_of_many_targets_need_no_derivatives_of_all_rows_by_all_targets() -> None:
    robot = load_robot("hexapod-42")
    data = draw_sessions(robot, 80, 20, 40)
    setup, T = data.nuisance_parameters, forward(robot, data.readings).T[None]
    kept = frozenset(setup.table.names)
    prediction = PosePredictions(T, {}, setup, setup.values()[None], kept)
    root = UnknownRoot(np.arange(len(setup))[:, None], np.full((len(setup), 1), 1e-6), len(setup))
    tracemalloc.start()
    try:
        prediction.residuals(data.observations)
        prediction.setup_deviations(data.observations, root)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    dense = 8 * data.n_rows * setup.indices[0].shape[1]
    assert peak < dense  # half of it; with all derivatives four times as much
