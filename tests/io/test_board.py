# SPDX-License-Identifier: Apache-2.0
"""Boards to print: their drawings against OpenCV's own picture of the same board."""

import re

import numpy as np
import pytest

from loopcal.errors import DataError, FileError
from loopcal.io.pictures import (
    PAPERS,
    Board,
    Shape,
    choose_board,
    draw_board,
    format_board,
    format_pdf,
    format_svg,
    read_board,
)
from tests.io.boards import make_charuco

SCALE = 2  # pixels per mm: all edges of a board with squares of 28 mm lie between pixels


def read_svg(text: str) -> list[Shape]:
    """Return the rectangles behind the sheet itself [mm]."""
    found = re.findall(
        r'<rect x="(.*?)" y="(.*?)" width="(.*?)" height="(.*?)" fill="(#\w+)"', text
    )
    return [
        (float(x), float(y), float(w), float(h), color == "#000") for x, y, w, h, color in found
    ]


def read_pdf(content: bytes) -> list[Shape]:
    """Return the rectangles of a PDF [mm], y from the top."""
    text = content.decode()
    height = float(re.findall(r"MediaBox \[0 0 \S+ (\S+)\]", text)[0]) * 25.4 / 72.0
    found = re.findall(r"^(\d) g (\S+) (\S+) (\S+) (\S+) re f$", text, re.MULTILINE)
    shapes = []
    for gray, *numbers in found:
        x, y, w, h = map(float, numbers)
        shapes.append((x, height - y - h, w, h, gray == "0"))
    return shapes


def paint(shapes, paper) -> np.ndarray:
    """Return the sheet as a picture of some pixels per mm."""
    width, height = (round(1e3 * side * SCALE) for side in paper)
    picture = np.full((height, width), 255, dtype=np.uint8)
    for x, y, w, h, is_black in shapes:
        x0, x1, y0, y1 = (round(v * SCALE) for v in (x, x + w, y, y + h))
        picture[y0:y1, x0:x1] = 0 if is_black else 255
    return picture


@pytest.mark.parametrize("form", ["svg", "pdf"])
def test_drawn_squares_and_markers_are_those_of_opencv(form) -> None:
    board, paper = choose_board(6, 5, 0.028), PAPERS["a4"]
    shapes, words = draw_board(board, paper)
    if form == "svg":
        drawn = read_svg(format_svg(shapes, words, paper))
    else:
        drawn = read_pdf(format_pdf(shapes, words, paper))
    sheet = paint(drawn, paper)
    side = 28 * SCALE
    left, top = (round(SCALE * v) for v in shapes[0][:2])
    found = sheet[top : top + 5 * side, left : left + 6 * side]
    expected = make_charuco(board).generateImage((6 * side, 5 * side))
    np.testing.assert_array_equal(found, expected)


def test_marks_are_as_far_apart_as_the_file_states() -> None:
    board, paper = choose_board(10, 7, 0.025), PAPERS["a4"]
    marks = [shape for shape in draw_board(board, paper)[0] if min(shape[2:4]) < 0.5]
    x, y = (m for m in (marks[:2], marks[2:]))
    assert board.marks == pytest.approx((0.125, 0.125))  # a caliper of 150 mm spans them
    assert x[1][0] - x[0][0] == pytest.approx(125.0)
    assert y[1][1] - y[0][1] == pytest.approx(125.0)
    squares = [s for s in draw_board(board, paper)[0] if s[2] == s[3] == 25.0]
    right, below = (max(s[k] + 25.0 for s in squares) for k in (0, 1))
    assert x[0][1] > below
    assert y[0][0] + y[0][2] < min(s[0] for s in squares)
    assert right < 297.0 - 5.0


def test_written_file_is_read_back_with_the_measured_lengths(tmp_path) -> None:
    board = choose_board(12, 8, 0.015)
    path = tmp_path / "board.yaml"
    path.write_text(format_board(board))
    assert read_board(path) == board
    path.write_text(format_board(board).replace("# measured", "measured"))
    assert read_board(path).measured == pytest.approx(board.marks)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("squares: [12, 8]", "squares: [2, 8]"),
        ("marker: 11.25 mm", "marker: 15.1 mm"),
        ("square: 15 mm", "square: 15"),
        ("format: 1", "format: 2"),
        ("# measured: [135.00", "measured: [-1"),
        ("# measured: [135.00", "measured: [165.00"),  # the whole board, not the lines
        ("dictionary", "dictionnary"),
    ],
)
def test_file_of_no_board_is_refused(tmp_path, old, new) -> None:
    text = format_board(choose_board(12, 8, 0.015))
    assert old in text
    path = tmp_path / "board.yaml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(FileError):
        read_board(path)


def test_board_larger_than_the_sheet_is_refused() -> None:
    with pytest.raises(DataError, match="room for 257 mm x 184 mm"):
        draw_board(choose_board(11, 7, 0.025), PAPERS["a4"])
    with pytest.raises(DataError, match="at least 3 columns"):
        Board((2, 7))
    assert choose_board(20, 15, 0.01).dictionary == "5X5_250"
