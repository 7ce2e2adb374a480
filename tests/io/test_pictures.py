# SPDX-License-Identifier: Apache-2.0
"""Corners in rendered pictures against the truth, and pictures that are left out."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from loopcal.errors import DataError, FileError
from loopcal.geometry import exp_so3, make_pose
from loopcal.io.pictures import (
    Picture,
    PictureTask,
    choose_board,
    compare_pictures,
    examine_picture,
    find_two_cameras,
    format_contact_sheet,
    list_pictures,
    name_poses,
)
from tests.io.boards import project_corners, render

pytestmark = pytest.mark.slow  # pictures are rendered

BOARD = choose_board(8, 6, 0.02)
SIZE = (1000, 750)
LENS = np.array([1010.0, 1013.0, 504.0, 371.0, 0.09, -0.16, 0.05, 0.0008, -0.0006])
VIEWS = {
    "straight": ((0.02, -0.01, 0.03), (-0.06, -0.04, 0.2)),
    "tilted": ((0.5, -0.4, 0.3), (-0.06, -0.04, 0.27)),
    "steep": ((0.8, -0.75, 0.3), (-0.06, -0.04, 0.23)),  # 62 deg
    "upside-down": ((0.1, -0.2, 3.1), (0.06, 0.04, 0.22)),
    "cut": ((0.3, 0.2, -0.2), (-0.15, -0.04, 0.2)),
}


def place(name: str) -> np.ndarray:
    rotation, position = VIEWS[name]
    return make_pose(exp_so3(np.array(rotation)), np.array(position))


def save(folder: Path, picture: np.ndarray, name: str = "a.png", film: int = 0) -> Path:
    exif = Image.Exif()
    if film:
        exif.get_ifd(0x8769)[0xA405] = film
    Image.fromarray(picture).save(folder / name, exif=exif)
    return folder / name


def examine(path: Path) -> Picture:
    return examine_picture(PictureTask(path, BOARD))


@pytest.mark.parametrize("name", VIEWS)
def test_corners_are_found_within_a_tenth_of_a_pixel(name, tmp_path) -> None:
    T = place(name)
    found = examine(save(tmp_path, render(BOARD, T, LENS, SIZE)))
    assert found.fault is None
    truth = project_corners(BOARD, T, LENS)
    inside = ((truth > 25.0) & (truth < np.array(SIZE) - 25.0)).all(axis=1)
    assert set(np.flatnonzero(inside)) - set(found.corners) == set() or name == "cut"
    error = found.pixels - truth[found.corners]
    assert np.linalg.norm(error, axis=1).max() < 0.1
    assert np.abs(error.mean(axis=0)).max() < 0.02  # a pixel begins half a pixel before its middle
    assert 0.4 < found.blur < 1.6  # 0.7 px, and the width of a pixel
    assert found.thumbnail.startswith(b"\xff\xd8")


def test_picture_rotated_by_half_a_turn_has_the_same_numbers(tmp_path) -> None:
    picture = render(BOARD, place("tilted"), LENS, SIZE)
    plain = examine(save(tmp_path, picture, "a.png"))
    turned = examine(save(tmp_path, np.ascontiguousarray(picture[::-1, ::-1]), "b.png"))
    np.testing.assert_array_equal(np.sort(plain.corners), np.sort(turned.corners))
    back = np.array(SIZE) - 1.0 - turned.pixels[np.argsort(turned.corners)]
    assert np.abs(back - plain.pixels[np.argsort(plain.corners)]).max() < 0.05


def test_picture_of_sixteen_bits_shows_the_same_corners(tmp_path) -> None:
    picture = render(BOARD, place("straight"), LENS, SIZE)
    plain = examine(save(tmp_path, picture))
    deep = examine(save(tmp_path, picture.astype(np.uint16) * 200, "deep.png"))
    np.testing.assert_array_equal(plain.corners, deep.corners)
    assert np.abs(plain.pixels - deep.pixels).max() < 0.02


def test_pictures_that_show_no_sharp_board_are_left_out_with_their_reason(tmp_path) -> None:
    T = place("straight")
    sharp = render(BOARD, T, LENS, SIZE)
    moved = [cv2.filter2D(sharp, -1, np.full((1, n), 1.0 / n)) for n in (9, 15)]  # [px]
    cases = {
        "pictures.blurred": [render(BOARD, T, LENS, SIZE, blur=4.0), *moved],
        "pictures.few-corners": [np.full(SIZE[::-1], 128, dtype=np.uint8)],
        "pictures.mirrored": [np.ascontiguousarray(sharp[:, ::-1])],
    }
    for code, pictures in cases.items():
        for picture in pictures:
            fault = examine(save(tmp_path, picture)).fault
            assert fault is not None
            assert fault.code == code


def test_files_that_are_no_pictures_are_named(tmp_path) -> None:
    whole = save(tmp_path, render(BOARD, place("straight"), LENS, SIZE), "whole.jpg")
    (tmp_path / "cut.jpg").write_bytes(whole.read_bytes()[:5000])
    (tmp_path / "phone.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    (tmp_path / "empty.png").write_bytes(b"")
    for name in ("cut.jpg", "phone.HEIC", "empty.png"):
        fault = examine(tmp_path / name).fault
        assert fault is not None
        assert fault.code == "pictures.unreadable"
    assert len(list_pictures(tmp_path)) == 4


def test_other_sizes_other_zooms_and_copies_are_left_out(tmp_path) -> None:
    pictures = [render(BOARD, place("straight"), LENS, SIZE, seed=i) for i in range(5)]
    paths = [save(tmp_path, pictures[i], f"{i}.jpg", 26) for i in range(3)]
    paths.append(save(tmp_path, pictures[3], "zoom.jpg", 52))
    paths.append(save(tmp_path, np.ascontiguousarray(pictures[4][:700]), "crop.jpg", 26))
    paths.append(save(tmp_path, pictures[1], "copy.jpg", 26))
    found = compare_pictures([examine(path) for path in paths])
    codes = [None if p.fault is None else p.fault.code for p in found]
    others = ["pictures.zoomed", "pictures.other-size", "pictures.repeated"]
    assert codes == [None, None, None, *others]
    assert "1.jpg" in str(found[-1].fault)
    assert found[0].focal == pytest.approx(26.0 / 43.27 * 1250.0, rel=1e-3)
    names = dict.fromkeys(paths, "<b>")
    page = format_contact_sheet(found, names)
    assert page.count("<img") == 6
    assert "<b><b>" not in page
    assert "http" not in page
    with pytest.raises(DataError, match="no residuals of these pictures"):
        format_contact_sheet(found, names, [])


def test_pictures_of_two_cameras_without_exif_are_divided() -> None:
    rng, pictures = np.random.default_rng(2), []
    other = LENS * np.array([1.05, 1.05, 1.01, 0.99, 1.2, 1.2, 1.2, 1.2, 1.2])
    number = np.arange(BOARD.corners[0] * BOARD.corners[1])
    for i in range(12):
        T = make_pose(exp_so3(0.25 * rng.normal(size=3)), np.array([-0.06, -0.04, 0.24]))
        pixels = project_corners(BOARD, T, other if i % 3 == 0 else LENS)
        pixels = pixels + 0.03 * rng.normal(size=pixels.shape)
        pictures.append(Picture(Path(f"{i}.jpg"), SIZE, None, number, pixels))
    found = find_two_cameras(BOARD, pictures)
    assert found is not None
    groups = {found["first"], found["second"]}
    assert ("0.jpg", "3.jpg", "6.jpg", "9.jpg") in groups
    one = [picture for i, picture in enumerate(pictures) if i % 3]
    assert find_two_cameras(BOARD, one) is None
    assert find_two_cameras(BOARD, [replace(p, focal=1010.0) for p in pictures]) is None


def test_poses_are_names_of_pictures_or_rows_of_a_table(tmp_path) -> None:
    for name in ("IMG_10.jpg", "IMG_9.jpg", "note.txt"):
        (tmp_path / name).write_bytes(b"")
    paths = list_pictures(tmp_path)
    assert [path.name for path in paths] == ["IMG_9.jpg", "IMG_10.jpg"]
    assert list(name_poses(paths).values()) == ["IMG_9", "IMG_10"]
    table = tmp_path / "poses.csv"
    for text, expected in {
        "pose,q1 [mm]\nhome,1\naway,2\n": ["home", "away"],
        "pose,q1 [mm]\nIMG_10,1\nIMG_9,2\nother,3\n": ["IMG_9", "IMG_10"],
        "pose,picture\na,IMG_10.jpg\nb,IMG_9\n": ["b", "a"],
    }.items():
        table.write_text(text)
        assert list(name_poses(paths, table).values()) == expected
    for text, named in {
        "pose,q1 [mm]\na,1\nb,2\nc,3\n": "IMG_9.jpg has the name of none",
        "pose,picture\na,IMG_10.jpg\n": "IMG_9.jpg",
        # a name with a slip: the order of the rows would exchange the pictures
        "pose,q1 [mm]\nIMG_10,1\nIMG_09,2\n": "IMG_9.jpg has the name of none",
    }.items():
        table.write_text(text)
        with pytest.raises(FileError, match=named):
            name_poses(paths, table)
    with pytest.raises(DataError, match="Rename"):
        name_poses([Path("a.jpg"), Path("a.png")])
    with pytest.raises(FileError):
        list_pictures(tmp_path / "none")
