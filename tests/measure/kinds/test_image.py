# SPDX-License-Identifier: Apache-2.0
"""Pictures of a printed board: the projection is written here a second time, in plain loops."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from loopcal import geometry, identify, load_robot
from loopcal.errors import DataError, LoopcalError
from loopcal.io.data.measurement_file import load_measurements, save_measurements
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.image import (
    Image,
    calibrate_camera,
    find_rays,
    locate_boards,
    project,
    solve_focal_length,
)
from loopcal.measure.simulation import sample_truth, simulate

LENS_VALUES = np.array([3000.0, 1.0 / 30.0, 2000.0, 1500.0, 0.1, -0.2, 0.05, 0.001, -0.002])
BOARD = np.array([[0.02 * (i % 9), 0.02 * (i // 9), 0.0] for i in range(54)])


def project_by_hand(point, lens):
    """The formulas of OpenCV's documentation, for one point."""
    x, y, z = point
    fx, aspect, cx, cy, k1, k2, k3, p1, p2 = lens
    fy = fx * (1 + aspect)
    a, b = x / z, y / z
    r2 = a**2 + b**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a**2)
    v = b * radial + p1 * (r2 + 2 * b**2) + 2 * p2 * a * b
    return fx * u + cx, fy * v + cy


def draw_pictures(n: int = 12, seed: int = 0):
    """Return poses (n, 4, 4) of a board in front of a camera, and its exact pixels (n, 54, 2)."""
    rng = np.random.default_rng(seed)
    R = geometry.exp_so3(rng.uniform(-0.6, 0.6, (n, 3)))
    t = rng.uniform([-0.15, -0.1, 0.4], [-0.05, 0.0, 0.6], (n, 3))
    pixels = [
        [project_by_hand(of @ p + at, LENS_VALUES) for p in BOARD]
        for of, at in zip(R, t, strict=True)
    ]
    return geometry.make_pose(R, t), np.array(pixels)


def test_projection_and_its_slopes_agree_with_plain_formulas_and_complex_steps() -> None:
    x = np.random.default_rng(1).normal(size=(7, 3)) * 0.3 + [0.0, 0.0, 1.0]
    pixels, by_point, by_lens = project(x, LENS_VALUES)
    expected = [project_by_hand(point, LENS_VALUES) for point in x]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)  # [px], rounding of 3000 px
    step = 1e-30
    for i, d in enumerate(np.eye(3)):
        complex_x: Any = x + 1j * step * d
        moved = project(complex_x, LENS_VALUES, False)[0].imag / step
        np.testing.assert_allclose(by_point[..., i], moved, rtol=1e-12, atol=1e-8)
    for i, d in enumerate(np.eye(9)):
        lens: Any = LENS_VALUES + 1j * step * d
        moved = project(x, lens, False)[0].imag / step
        np.testing.assert_allclose(by_lens[..., i], moved, rtol=1e-12, atol=1e-8)
    np.testing.assert_allclose(find_rays(pixels, LENS_VALUES), x / x[:, 2:], atol=1e-12)


def test_point_beside_or_behind_the_camera_has_a_finite_residual() -> None:
    x = np.array([[0.1, 0.2, -1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert all(np.isfinite(part).all() for part in project(x, LENS_VALUES))


def test_pose_of_a_board_follows_from_one_picture() -> None:
    poses, pixels = draw_pictures()
    np.testing.assert_allclose(locate_boards(BOARD, pixels, LENS_VALUES), poses, atol=1e-9)


def test_focal_lengths_follow_in_closed_form_without_distortion() -> None:
    poses, _ = draw_pictures()
    lens = np.where(np.arange(9) < 4, LENS_VALUES, 0.0)
    x = (poses[:, None, :3, :3] @ BOARD[..., None])[..., 0] + poses[:, None, :3, 3]
    pixels = project(x, lens)[0]
    focal = solve_focal_length(BOARD, pixels, lens[2:4])
    assert focal is not None
    np.testing.assert_allclose(focal, lens[:2], rtol=1e-8)
    for place in np.random.default_rng(1).uniform([-0.1, -0.1, 0.4], [0.1, 0.1, 0.6], (20, 3)):
        level = np.tile(geometry.make_pose(np.eye(3), place), (4, 1, 1))
        x = (level[:, None, :3, :3] @ BOARD[..., None])[..., 0] + level[:, None, :3, 3]
        assert solve_focal_length(BOARD, project(x, lens)[0], lens[2:4]) is None


@pytest.mark.slow
def test_camera_alone_is_calibrated_within_its_stated_uncertainty() -> None:
    _, exact = draw_pictures()
    start = np.array([np.nan, np.nan, 1990.0, 1510.0, *[0.0] * 5])
    errors = []
    for seed in range(12):
        pixels = exact + 0.2 * np.random.default_rng(seed).standard_normal(exact.shape)
        pixels[3, :10] = np.nan
        fit = calibrate_camera(BOARD, pixels, start, np.ones(9, dtype=bool))
        errors.append((fit.lens - LENS_VALUES) / fit.sd)
        assert fit.sigma == pytest.approx(0.2, rel=0.08)  # four standard deviations of it
    # 108 correlated values: the mean square of a lens parameter is 1 +- 0.41
    assert np.mean(np.square(errors)) == pytest.approx(1.0, abs=0.5)


def test_board_that_never_turns_leaves_the_center_in_the_middle() -> None:
    """As on a delta or five-bar: such pictures determine no center, whatever fits them best."""
    kind = Image(focal=(3150.0, 3150.0), unknown=Image.allowed_unknown[:6], corners=(9, 6))
    corner = np.tile(np.arange(54.0), 12)[:, None]
    for seed in range(8):
        rng = np.random.default_rng(seed)
        R = geometry.exp_so3(np.array([rng.uniform(0.4, 0.7), rng.uniform(-0.3, 0.3), 0.0]))
        t = rng.uniform([-0.15, -0.1, 0.4], [-0.05, 0.0, 0.6], (12, 3))
        pixels = np.array([[project_by_hand(R @ p + at, LENS_VALUES) for p in BOARD] for at in t])
        noisy = (pixels + rng.normal(size=pixels.shape)).reshape(-1, 2)  # and errors of a machine
        T = np.repeat(geometry.make_pose(np.eye(3), t), 54, axis=0)
        guesses = kind.guess_values(T, np.hstack([corner, noisy]))
        names = [parameter.name for parameter in kind.nuisance_parameters]
        center = guesses[:, [names.index("camera.cx"), names.index("camera.cy")]]
        assert np.abs(center - [1999.5, 1499.5]).max() < 300.0  # [px]


@pytest.mark.parametrize("focal", [(0.0, 3000.0), (3000.0, 0.0), (-1.0, 1.0), (3000.0, np.nan)])
def test_a_focal_length_that_is_none_is_refused(focal) -> None:
    with pytest.raises(DataError, match="the focal length must be above 0"):
        Image(focal=focal)


def test_pictures_with_too_few_corners_are_refused() -> None:
    _, pixels = draw_pictures(3)
    pixels[1, 9:] = np.nan  # a row of corners: on a line
    with pytest.raises(DataError, match="picture 2 shows too little"):
        calibrate_camera(BOARD, pixels, LENS_VALUES, np.zeros(9, dtype=bool))


def test_corners_of_the_kind_are_those_of_the_plain_formulas() -> None:
    """Board on the platform and camera on the base, and the reverse, with print and bend."""
    rng = np.random.default_rng(5)
    T, camera, board = geometry.apply_twist(np.eye(4), rng.uniform(-0.2, 0.2, (3, 6)))
    camera[2, 3] -= 1.0
    stated = {"focal": (3000.0, 3100.0), "center": (2000.0, 1500.0), "corners": (4, 3)}
    kind = Image(
        T_camera=camera,
        T_board=board,
        distortion=tuple(LENS_VALUES[4:]),
        unknown=("print", "bend"),
        **stated,
    )
    values = np.array([0.01, -0.02, 0.003, 0.001, -0.002])
    sx, sy, bx, by, bxy = values
    for mount in ("board", "camera"):
        found = replace(kind, mount=mount).measure(
            np.tile(T, (1, 12, 1, 1)), np.zeros((1, 12, 2)), values[None, None]
        )[0]
        for i in range(12):
            column, row = i % 4, i // 4
            h, k = column / 1.5 - 1.0, row / 1.0 - 1.0
            p = [
                column * 0.02 * (1 + sx),
                row * 0.02 * (1 + sy),
                bx * h**2 + by * k**2 + bxy * h * k,
                1,
            ]
            body = T if mount == "board" else np.linalg.inv(T)
            x = (np.linalg.inv(camera) @ body @ board @ p)[:3]
            np.testing.assert_allclose(found[i, 1:], project_by_hand(x, LENS_VALUES), atol=1e-8)


def look_down(height):
    return geometry.make_pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, height]))


def make_kind(**settings: Any) -> Image:
    """Return a board that lies on the platform, seen by a camera 0.5 m above it."""
    usual: dict[str, Any] = {"corners": (5, 4), "square": 0.02, "focal": (4000.0, 4000.0)}
    board = geometry.make_pose(np.diag([1.0, -1.0, -1.0]), np.array([-0.04, 0.03, 0.01]))
    usual |= {"T_camera": look_down(0.7), "T_board": board}
    usual |= settings
    return Image(**usual)


def make_poses(n=6, seed=3):
    low, high = np.array([-20, -20, 190, -8, -8, -8]), np.array([20, 20, 210, 8, 8, 8])
    return np.random.default_rng(seed).uniform(low, high, (n, 6)) * np.repeat(
        [1e-3, np.pi / 180], 3
    )


def test_file_of_two_cameras_assigns_rows_by_the_columns_camera_and_board(tmp_path) -> None:
    robot = load_robot("hexapod-42")
    kinds = [make_kind(camera=name, lens="phone", unknown=("camera",)) for name in ("a", "b")]
    sensors = [Sensor(kind, Gaussian(np.full(2, 0.1))) for kind in kinds]
    data = simulate(robot, make_poses(), Instrument(tuple(sensors)), 0)
    save_measurements(data, path := tmp_path / "data.csv", robot)
    text = path.read_text()
    loaded = load_measurements(path, robot)
    for old, new in zip(data.observations, loaded.observations, strict=True):
        np.testing.assert_allclose(new.measured, old.measured)
        assert isinstance(new.kind, Image)
        assert isinstance(old.kind, Image)
        assert (new.kind.camera, new.kind.lens) == (old.kind.camera, "phone")
    # the same with the columns of the cameras in place of the labels of the kinds
    named = text.replace("kind,", "camera,").replace(",image-1,", ",a,").replace(",image-2,", ",b,")
    path.write_text(named)
    again = load_measurements(path, robot)
    for old, new in zip(loaded.observations, again.observations, strict=True):
        np.testing.assert_array_equal(new.measured, old.measured)
    path.write_text(named.replace(",b,", ",c,"))
    with pytest.raises(LoopcalError, match="no kind has camera 'c'"):
        load_measurements(path, robot)
    path.write_text(named.replace(",19,", ",20,"))
    with pytest.raises(LoopcalError, match="has the corner 20, but the corners of the board are 0"):
        load_measurements(path, robot)


def test_a_bent_board_is_found_with_the_machine() -> None:
    robot = load_robot("hexapod-42")
    truth = robot.with_values(sample_truth(robot, 1, 2)[0])
    kind = make_kind(unknown=("camera", "board", "focal", "center", "bend"))
    instrument = Instrument((Sensor(kind, Gaussian(np.full(2, 0.1))),))
    bend = {"board.bend_x": 8e-4, "board.bend_y": -5e-4, "board.bend_xy": 3e-4}  # [m]
    fit = identify(robot, simulate(truth, make_poses(24), instrument, 3, nuisance_values=bend))
    assert fit.converged
    places = [fit.nuisance.names.index(name) for name in bend]
    sd = fit.nuisance.sd[places]
    assert (sd < 2e-5).all()
    assert (np.abs(fit.nuisance.estimate[places] - list(bend.values())) < 4.0 * sd).all()


@pytest.mark.slow
def test_two_cameras_with_one_lens_and_a_board_each_calibrate_a_machine(tmp_path) -> None:
    """A sheet with two kinds, from simulated pictures to parameters, frames and the shared lens."""
    robot = load_robot("hexapod-42")
    truth = robot.with_values(sample_truth(robot, 1, 4)[0])
    tilt = geometry.make_pose(geometry.exp_so3(np.array([0.5, 0.0, 0.0])), np.zeros(3))
    side = geometry.make_pose(np.eye(3), np.array([0.0, 0.0, 0.2])) @ tilt @ look_down(0.5)
    lower = geometry.make_pose(np.diag([1.0, -1.0, -1.0]), np.array([-0.02, 0.05, 0.02]))
    boards = {
        "front": {"board": "plate"},
        "side": {"board": "tile", "T_camera": side, "T_board": lower},
    }
    unknown = ("camera", "board", "focal", "center")
    kinds = [make_kind(camera=n, lens="phone", unknown=unknown, **of) for n, of in boards.items()]
    sensors = tuple(Sensor(kind, Gaussian(np.full(2, 0.1))) for kind in kinds)
    save_measurements(
        simulate(truth, make_poses(24), Instrument(sensors), 0), path := tmp_path / "d.csv", robot
    )
    fit = identify(robot, load_measurements(path, robot))
    assert fit.converged
    assert fit.residual_test.chi_square / fit.residual_test.degrees == pytest.approx(1.0, abs=0.1)
    names = [f"{name}.x" for name in ("front", "side", "plate", "tile")]
    assert {*names, "phone.fx", "phone.cy"} <= set(fit.nuisance.names)
    assert not {"front.fx", "side.fx"} & set(fit.nuisance.names)
    place = fit.nuisance.names.index("phone.fx")
    assert abs(fit.nuisance.estimate[place] - 4000.0) < 4.0 * fit.nuisance.sd[place]
    error = (fit.robot.values - truth.values)[robot.parameters.free]
    sd = np.sqrt(np.diag(fit.covariance))
    assert np.abs(error / sd).max() < 4.5  # of 42 parameters
    tolerance = fit.free_parameters.tolerance
    left = np.linalg.eigvalsh(fit.covariance / np.outer(tolerance, tolerance))
    assert left[3] < 0.1  # of the variance: pictures determine four combinations well


def test_lens_may_hold_in_all_sessions(tmp_path) -> None:
    robot = load_robot("hexapod-42")
    kind = make_kind(unknown=("camera", "focal"))
    data = simulate(robot, make_poses(), Instrument((Sensor(kind, Gaussian(np.full(2, 0.1))),)), 0)
    rows = data.observations[0]
    data = replace(
        data, observations=(replace(rows, session=np.where(rows.rows < 3, "one", "two")),)
    )
    save_measurements(data, path := tmp_path / "data.csv", robot)
    names = load_measurements(path, robot).nuisance_parameters.table.names
    assert {"one.camera.fx", "two.camera.fx", "one.camera.x"} <= set(names)
    path.write_text('# unknowns: {"*.f?": {scope: all}}\n' + path.read_text())
    names = load_measurements(path, robot).nuisance_parameters.table.names
    assert "camera.fx" in names
    assert "one.camera.fx" not in names


def test_simulation_hides_what_a_camera_does_not_see() -> None:
    robot, noise = load_robot("hexapod-42"), Gaussian(np.full(2, 0.1))
    part = make_kind(focal=(9000.0, 9000.0), square=0.05)
    rows = simulate(robot, make_poses(), Instrument((Sensor(part, noise),)), 0).observations[0]
    assert 0.1 < rows.is_measured.mean() < 0.9
    seen = rows.measured[rows.is_measured]
    assert (seen[:, 1:].min() >= 0.0, seen[:, 1].max() < 4000, seen[:, 2].max() < 3000) == (
        True,
        True,
        True,
    )
    for wrong in ({"T_board": np.eye(4)}, {"T_camera": geometry.make_pose(np.eye(3), np.zeros(3))}):
        kind = make_kind(**wrong)
        with pytest.raises(DataError, match="sees nothing at any pose"):
            simulate(robot, make_poses(), Instrument((Sensor(kind, noise),)), 0)
