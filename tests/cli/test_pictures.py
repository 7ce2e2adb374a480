# SPDX-License-Identifier: Apache-2.0
"""The commands `loopcal board` and `loopcal photos`."""

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import loopcal as lc
from loopcal.geometry import exp_so3, make_pose
from loopcal.io.pictures import choose_board, format_board, read_board
from loopcal.measure.kinds.image import Image as ImageKind
from tests.cli.page_commands import run_page
from tests.io.boards import render

LENS = np.array([1000.0, 1003.0, 405.0, 297.0, 0.05, -0.1, 0.0, 0.0, 0.0])


def test_without_opencv_the_extra_is_named(loopcal, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    loopcal("board -o b.yaml", "pip install 'loopcal[camera]'", code=1)
    assert not list(tmp_path.iterdir())


def test_command_writes_the_file_and_both_drawings(loopcal, tmp_path) -> None:
    words = "board -o b.yaml --columns 8 --rows 6 --square 20mm"
    loopcal(words, "Measure 140 mm along x and 120 mm along y")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.pdf", "b.svg", "b.yaml"]
    assert read_board(tmp_path / "b.yaml").corners == (7, 5)
    loopcal("board -o b.yaml", "--force", code=1)
    loopcal("board -o b.csv", ".yaml", code=1)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory) -> Path:
    """Return a folder with a board on the platform of a hexapod, and pictures of it."""
    folder = tmp_path_factory.mktemp("photographed")
    robot, rng = lc.load_robot("hexapod-42"), np.random.default_rng(3)
    board = choose_board(6, 5, 0.012)
    text = format_board(board).replace("# measured", "measured")
    (folder / "board.yaml").write_text(text)
    T_camera = make_pose(exp_so3(np.array([0.05, 3.08, 0.1])), np.array([-0.01, 0.02, 0.43]))
    T_board = make_pose(exp_so3(np.array([np.pi, 0.0, 0.0])), np.array([-0.024, 0.018, 0.01]))
    (folder / "pictures").mkdir()
    coordinates = rng.uniform(-1.0, 1.0, (9, 6)) * [0.02, 0.02, 0.015, 0.2, 0.2, 0.2]
    coordinates[:, 2] += 0.2
    solution = lc.inverse(robot, coordinates)
    lines = ["pose," + ",".join(f"{actuator.name} [mm]" for actuator in robot.actuators)]
    for i, (T, q) in enumerate(zip(solution.T, solution.q, strict=True)):
        seen = np.linalg.inv(T_camera) @ T @ T_board
        picture = render(board, seen, LENS, (800, 600), seed=i)
        Image.fromarray(picture if i else picture // 32 + 90).save(
            folder / "pictures" / f"p{i}.png"
        )
        lines.append(",".join([f"p{i}", *(f"{1e3 * x:.6f}" for x in q)]))
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def calibrated(photographed, loopcal, monkeypatch) -> lc.Run:
    """Go to the folder, and return the calibration by its pictures, made once for all tests."""
    monkeypatch.chdir(photographed)
    if not Path("run").exists():
        loopcal("photos pictures --board board.yaml --poses poses.csv -o points.csv")
        loopcal("calibrate hexapod-42 points.csv -o run", code=(0, 2))
    return lc.load_run("run")


@pytest.mark.slow
def test_photos_become_a_measurement_file_that_calibrates(calibrated, loopcal) -> None:
    words = "photos pictures --board board.yaml --poses poses.csv -o points.csv"
    text, fitted = Path("points.csv").read_bytes(), calibrated.arrays["residual_0_image"]
    printed = loopcal(f"{words} --force", "p0.png: left out: it shows 0 corners", "blur 0.9 px")
    assert "points.csv: 8 of 9 pictures" in printed.out
    robot = lc.load_robot("hexapod-42")
    data = lc.load_measurements("points.csv", robot)
    (rows,) = data.observations
    assert isinstance(rows.kind, ImageKind)
    assert rows.kind.corners == (5, 4)
    page = Path("points.html").read_text("utf-8")
    assert page.count("data:image/jpeg") == 9
    fit = calibrated.result["fit"]
    assert fit["chi_square"] / fit["degrees"] < 1.0  # corners are better than the assumed 0.1 px
    loopcal(f"{words} --residuals run", "--force", code=1)
    loopcal(f"{words} --residuals run --force")
    page = Path("points.html").read_text("utf-8")
    assert Path("points.csv").read_bytes() == text
    (times,) = re.findall(r"predicted - seen, (\d+) times", page)
    drawn = [[float(x), float(y)] for x, y in re.findall(r'<path d="M\S+ \S+?l(\S+) (\S+?)"', page)]
    np.testing.assert_allclose(drawn, float(times) * fitted, rtol=0.01, atol=0.6)  # [px], rounded
    loopcal("report run -o report.html")
    report = Path("report.html").read_text("utf-8")
    assert 'id="arrow-figure' in report
    assert "held-out poses of which positions or orientations" in report  # these have pixels
    loopcal(words, "--force", code=1)
    found = loopcal(f"{words} --force --json --workers 1").json
    assert [entry["pose"] for entry in found["pictures"]] == [f"p{i}" for i in range(9)]
    assert found["used"] == 8
    assert found["pictures"][0]["fault"]["code"] == "pictures.few-corners"


def test_photos_without_any_board_are_refused_with_the_reason(loopcal, tmp_path) -> None:
    loopcal("board -o board.yaml")
    (tmp_path / "pictures").mkdir()
    loopcal("photos pictures --board board.yaml -o points.csv", "no pictures", code=1)
    Image.fromarray(np.full((60, 80), 90, dtype=np.uint8)).save(tmp_path / "pictures" / "a.png")
    words = "photos pictures --board board.yaml -o points.csv"
    loopcal(words, "The first one, a.png, has this fault: it shows 0 corners", code=1)
    assert not (tmp_path / "points.csv").exists()


def test_photos_without_opencv_name_the_extra(loopcal, tmp_path, monkeypatch) -> None:
    loopcal("board -o board.yaml")
    (tmp_path / "a.jpg").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "cv2", None)
    loopcal("photos . --board board.yaml -o points.csv", "pip install 'loopcal[camera]'", code=1)


@pytest.mark.slow
def test_page_leads_from_the_board_to_a_calibration(
    photographed, tmp_path, root, monkeypatch
) -> None:
    shutil.copytree(photographed / "pictures", tmp_path / "pictures")
    shutil.copy(photographed / "poses.csv", tmp_path)
    monkeypatch.chdir(tmp_path)
    run_page((root / "docs" / "phone-and-board.md").read_text("utf-8"))
    assert lc.load_run("run").result["fit"]["degrees"] > 0


@pytest.mark.slow
def test_measured_lengths_correct_a_board_printed_at_97_percent(calibrated, loopcal) -> None:
    """The file says squares of 12 mm / 0.97, and the caliper what the printer made of them."""
    text = Path("board.yaml").read_text("utf-8")
    text = text.replace("square: 12 mm", f"square: {12 / 0.97} mm")
    Path("shrunk.yaml").write_text(text.replace("marker: 9 mm", f"marker: {9 / 0.97} mm"))
    loopcal("photos pictures --board shrunk.yaml --poses poses.csv -o shrunk.csv")
    loopcal("calibrate hexapod-42 shrunk.csv -o shrunk", code=(0, 2))
    found = lc.load_run("shrunk").robot.values
    assert np.abs(found - calibrated.robot.values).max() < 2e-6  # [m, rad]
    assert "board.scale_x: {start: -30000 ppm," in Path("shrunk.csv").read_text("utf-8")


@pytest.mark.slow
def test_column_picture_of_the_poses_names_files_and_stays_in_the_table(
    photographed, loopcal, monkeypatch
) -> None:
    monkeypatch.chdir(photographed)
    head, *rows = Path("poses.csv").read_text("utf-8").splitlines()
    lines = [f"picture,{head}", *(f"p{i}.png,pose{row[1:]}" for i, row in enumerate(rows))]
    Path("named.csv").write_text("\n".join(lines) + "\n")
    loopcal("photos pictures --board board.yaml --poses named.csv -o named-points.csv")
    data = lc.load_measurements("named-points.csv", lc.load_robot("hexapod-42"))
    assert set(data.labels) == {f"pose{i}" for i in range(9)}


@pytest.mark.slow
def test_board_caliper_and_readings_in_inches_make_the_same_machine(calibrated, loopcal) -> None:
    text = Path("board.yaml").read_text("utf-8")
    inches = re.sub(r"([\d.]+) mm", lambda m: f"{float(m[1]) / 25.4!r} in", text)
    Path("inches.yaml").write_text(inches)
    head, *rows = Path("poses.csv").read_text("utf-8").splitlines()
    cells = [row.split(",") for row in rows]
    lines = [",".join([name, *(f"{float(x) / 25.4!r}" for x in q)]) for name, *q in cells]
    Path("inch.csv").write_text("\n".join([head.replace("[mm]", "[in]"), *lines]) + "\n")
    loopcal("photos pictures --board inches.yaml --poses inch.csv -o inches.csv")
    loopcal("calibrate hexapod-42 inches.csv -o inches", code=(0, 2))
    found = lc.load_run("inches").robot.values
    np.testing.assert_allclose(found, calibrated.robot.values, rtol=0, atol=1e-8)  # [m, rad]
    loopcal("board -o half.yaml --columns 6 --rows 5 --square 0.5in", "Measure 76.2 mm")
    half = Path("half.yaml").read_text("utf-8").replace("# measured", "measured")
    half = re.sub("76.20 mm, 63.50 mm", "2.997 in, 2.503 in", half)
    Path("half.yaml").write_text(re.sub("0.05 mm", "0.002 in", half))
    (x, sd), (y, _) = read_board("half.yaml").scales
    assert (x, y, sd) == pytest.approx((-0.001, 0.0012, 0.002 / 3.0), abs=1e-9)
