# SPDX-License-Identifier: Apache-2.0
"""Plane and perpendicular line in two forms: unknown surfaces, and elimination as in the paper.

Both forms use the same points of a hexapod, four groups of twelve, and give the same results.
"""

from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.information import collect_information
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.findings import Finding
from loopcal.measure.instrument import Gaussian
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import sample_truth
from loopcal.papers.paper import PAPERS
from loopcal.planning.plane_line_planning import (
    PlaneLineGroups,
    find_line_axes,
    linearize_surfaces,
    make_plane_line_instrument,
)
from loopcal.studies.simulation.block import calibrate_cells, find_cells, set_size
from loopcal.studies.simulation.published_steps import (
    Layout,
    PaperRows,
    identify_from_rows,
    map_displacements,
)

MM = 1e-3
NOISE = 1e-6  # [m]
GROUPS, POINTS = 4, 12


@pytest.fixture(scope="module")
def planned() -> PlaneLineGroups:
    return PlaneLineGroups(lc.load_robot("hexapod-nategh-agheli"), POINTS, MM, ("z",))


@pytest.fixture(scope="module")
def layout(planned) -> Layout:
    return Layout(planned.robot, planned.place_points(planned.draw(GROUPS, 0)))


def build_measurements(layout: Layout, q: np.ndarray, sigma: float) -> Measurements:
    """Return points on planes and lines with readings (n, a) [SI] as measurements; sigma : of a
    held coordinate [m].

    Kinds `plane` and `line` that name the same surface share the unknowns of that name (direction,
    height, shifts), so that the line is perpendicular to the plane by construction. Measured gaps
    are zero: the coordinates were held.
    """
    number = np.arange(layout.points).reshape(layout.groups, -1)
    axis = find_line_axes(layout.robot, layout.flat, layout.groups)
    instrument = make_plane_line_instrument(
        layout.robot, axis, number, lambda _, gaps: Gaussian(np.full(gaps, sigma))
    )
    observations = tuple(
        Observations.from_sigma(
            s.kind, s.assigned_rows, np.zeros((len(s.assigned_rows), len(s.noise.sigma))), sigma,
            group=s.group,
        )
        for s in instrument.sensors
    )  # fmt: skip
    return Measurements(layout.robot.name, q, observations)


def compare_covariances(layout: Layout) -> float:
    """Return the largest relative difference of the variances that both forms give any direction,
    on surfaces reached exactly.
    """
    q = solve_exact_readings(layout)
    free = select_free_parameters(layout.robot)
    factor = collect_information(free, build_measurements(layout, q[0], NOISE))[0]
    A = PaperRows(layout, q, free.tolerance[0], NOISE).whiten(np.zeros((1, len(free))))[0][0]
    _, s, vt = np.linalg.svd(A[:, :-1], full_matrices=False)
    kept = s > 1e-10 * s[0]
    by_free = factor[0, : len(free), : len(free)] @ (vt[kept].T / s[kept])
    return float(np.abs(np.linalg.svd(by_free, compute_uv=False) ** 2 - 1.0).max())


def solve_exact_readings(layout: Layout) -> np.ndarray:
    """Return readings (1, n, 6) at which the nominal machine touches its surfaces."""
    return layout.hold_points(layout.robot.parameters.nominal[None])[1]


def test_plane_and_line_on_the_same_surface_share_its_direction(layout) -> None:
    local = build_measurements(layout, solve_exact_readings(layout)[0], NOISE).nuisance_parameters
    names = {
        f"group{g + 1}.surface-z.{part}"
        for g in range(GROUPS)
        for part in ("u", "v", "height", "a", "b")
    }
    assert set(local.table.names) == names
    assert len(local) == 5 * GROUPS


def test_shared_surface_is_read_from_a_measurement_file_as_saved(layout, tmp_path) -> None:
    data = build_measurements(layout, solve_exact_readings(layout)[0], NOISE)
    lc.save_measurements(data, tmp_path / "points.csv", layout.robot)
    read = lc.load_measurements(tmp_path / "points.csv", layout.robot)
    assert sorted(read.nuisance_parameters.table.names) == sorted(
        data.nuisance_parameters.table.names
    )


@pytest.mark.slow
def test_rank_is_33_of_42_and_nine_directions_are_rigid_motions(layout) -> None:
    known = identifiability(
        layout.robot, build_measurements(layout, solve_exact_readings(layout)[0], NOISE)
    )
    assert known.rank == 33
    assert known.singular_values[32] > 1e6 * known.singular_values[33]
    motions = [c.meaning.data for c in known.unidentifiable if isinstance(c.meaning, Finding)]
    assert [m["frame"] for m in motions].count("base") == 6
    turns = [m for m in motions if m["frame"] == "platform" and m["motion"] == "rotation"]
    assert sum(m["through_origin"] for m in turns) == 3
    rows, _ = PaperRows(layout, solve_exact_readings(layout), MM, NOISE).whiten(np.zeros((1, 42)))
    s = np.linalg.svd(rows[0, :, :42], compute_uv=False)
    assert s[33] < 1e-13 * s[0]
    assert s[32] > 1e-7 * s[0]


def test_rows_of_the_paper_are_unchanged_by_motions_of_the_surfaces(layout) -> None:
    at, _, _ = layout.linearize_points(
        layout.robot.parameters.nominal[None], solve_exact_readings(layout)
    )
    each = np.eye(3 * POINTS).reshape(POINTS, 3, 3 * POINTS)
    F, A = linearize_surfaces(at[0], np.repeat(each[None], GROUPS, axis=0), np.full(GROUPS, 2))
    B = map_displacements(*layout.levers)  # rows by points; A: held coordinates by points
    for g in range(GROUPS):
        held = np.linalg.lstsq(A[g].T, B[g].T, rcond=None)[0].T  # rows as sums of held coordinates
        np.testing.assert_allclose(held @ A[g], B[g], atol=1e-12)  # [m], they are
        np.testing.assert_allclose(held @ F[g], 0.0, atol=1e-12)  # [m2], and no surface moves them
        assert np.linalg.matrix_rank(held) == POINTS - 2


def test_both_forms_and_the_rows_of_planning_give_the_same_covariance(layout, planned) -> None:
    assert compare_covariances(layout) < 1e-9  # relative, rounding by a condition of 1e4
    free = select_free_parameters(layout.robot)
    R = collect_information(free, build_measurements(layout, solve_exact_readings(layout)[0], MM))[
        0
    ][0, :42, :42]
    rows = planned.linearize(planned.draw(GROUPS, 0)).reshape(-1, 42)
    np.testing.assert_allclose(rows.T @ rows, R.T @ R, atol=1e-9 * np.abs(R.T @ R).max())


@pytest.mark.parametrize("name", ["6-pus", "linear-delta", "rotary-delta"])
def test_rows_of_planning_agree_with_unknown_surfaces_on_other_robots(name) -> None:
    robot = lc.load_robot(name)
    planned = PlaneLineGroups(robot, 8, MM)
    design = planned.draw(8, 0)
    layout = Layout(robot, planned.place_points(design))
    free = select_free_parameters(robot)
    R = collect_information(free, build_measurements(layout, solve_exact_readings(layout)[0], MM))[
        0
    ][0, : len(free), : len(free)]
    rows = planned.linearize(design).reshape(-1, len(free))
    np.testing.assert_allclose(rows.T @ rows, R.T @ R, atol=1e-9 * np.abs(R.T @ R).max())


def test_both_forms_agree_with_lines_along_different_axes(planned) -> None:
    mixed = replace(planned, axes=("x", "y", "z"))
    design = mixed.draw(GROUPS, 5)
    assert len(np.unique(design[:, 3])) > 1
    layout = Layout(mixed.robot, mixed.place_points(design))
    assert len(build_measurements(layout, solve_exact_readings(layout)[0], NOISE).observations) > 2
    assert compare_covariances(layout) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("method", [LeastSquares(), MAP()], ids=["least squares", "MAP"])
def test_both_forms_give_the_same_estimate_to_first_order(layout, method) -> None:
    truth = sample_truth(layout.robot, 1, 3)
    unlike = []
    for noise in (NOISE, 10.0 * NOISE):
        drawn = np.random.default_rng(3).normal(scale=noise, size=(1, layout.points, 3))
        q = layout.hold_points(truth, drawn)[1]
        problem = PaperRows(layout, q, MM, noise)
        paper = problem.values(identify_from_rows(problem, method, 1e-6).deviation)[0]
        found = identify(
            layout.robot,
            build_measurements(layout, q[0], noise),
            method,
            options=FitOptions(allow_fewer_equations=True),
        )
        A = problem.whiten(np.zeros((1, 42)))[0][0, :, :42]
        unlike.append(float(np.linalg.norm(A @ (found.robot.values - paper) / MM)))
    assert unlike[0] < 0.02  # [sd] of all rows together
    assert unlike[1] < 0.2
    assert unlike[1] > 1.5 * unlike[0]  # second order: it falls with the noise


@pytest.mark.slow  # 17 of 50 converged while rotations of the residuals counted as information, so
# that 6 of 6 had a chance of 0.2 %; the evidence has 50
def test_cells_of_a_study_converge_in_both_forms_on_every_machine() -> None:
    study = set_size(PAPERS["cmm-constraint-2011"].load_study(), 0, 6)
    ((name, level),), method = study.poses.items(), study.methods["LS"]
    methods = {"products": method, "surfaces": replace(method, rows="weighted")}
    study = replace(study, poses={name: replace(level, sweeps=1)}, methods=methods)
    cells = calibrate_cells(study, find_cells(study, errors="set 1", instrument="0.01 mm"))
    products, surfaces = cells
    assert products.is_converged.all()
    assert surfaces.is_converged.all()
    assert surfaces.iterations.max() <= 8
    # [m] 1e-3 of the noise times the weakest direction of some 300 mm per mm
    np.testing.assert_allclose(surfaces.values, products.values, rtol=0, atol=3e-6)


def test_covariance_of_the_rows_of_the_paper_agrees_with_drawn_noise(layout) -> None:
    d_1, d = layout.levers
    noise = np.random.default_rng(0).normal(size=(20000, 3 * POINTS)) * NOISE
    whitened = (
        PaperRows(layout, solve_exact_readings(layout), MM, NOISE).whitener[0]
        @ map_displacements(d_1, d)[0]
        @ noise.T
    )
    # an entry of a covariance of 20000 draws has sd sqrt(2 / 20000) = 0.01 on the diagonal; 5 sd
    np.testing.assert_allclose(np.cov(whitened), np.eye(POINTS - 2), atol=0.05)
