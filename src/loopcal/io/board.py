# SPDX-License-Identifier: Apache-2.0
"""Printed boards: their file, and their drawing as SVG and PDF in true scale.

A board is a chessboard with a marker in each white square (ChArUco), by which corners are found
and numbered where a picture shows a part of it. The black square at the top left is the first. The
inner corners have the numbers of the kind `image`: from the top left along the rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loopcal.environment import import_optional
from loopcal.errors import DataError
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import format_yaml, read_yaml
from loopcal.io.robot.robot_file import check_format
from loopcal.units import Length

FORMAT = 1
DICTIONARY_SIZES = (50, 100, 250, 1000)
"""Markers of the dictionaries; the smallest that suffices has the most different markers."""
MODULES = 7
"""Rows and columns of a marker: 5 of bits, and a black border."""
CALIPER = 0.140
"""Length that a common caliper can measure [m]."""
CALIPER_SD = 5e-5
"""Standard deviation of a length that was measured with it from line to line [m]."""
MOST_SCALE = 0.1
"""Scale of a print, as a share, beyond which other lines were measured."""
PAPERS = {"a4": (0.297, 0.210), "a3": (0.420, 0.297), "letter": (0.2794, 0.2159)}
"""Width and height of a sheet [m]."""
SIDE, BELOW = 0.020, 0.016
"""Space that the marks need beside and below the squares [m]."""

POINT = 25.4 / 72.0  # [mm]
TEXT = 3.0  # height of a line of text [mm]
LINE = 0.2  # width of a mark [mm]


@dataclass(frozen=True)
class Board:
    """A ChArUco board.

    squares : columns and rows of squares. square, marker : their sides.
    dictionary : of OpenCV, such as 5X5_50.
    measured : the lengths along x and y between the marks of the print, as measured.
    measured_sd : standard deviation of these.

    DataError : there are too few or too many squares, or a length that cannot be.
    """

    squares: tuple[int, int] = (10, 7)
    square: Length = 0.025
    marker: Length = 0.01875
    dictionary: str = "5X5_50"
    measured: tuple[Length, Length] | None = None
    measured_sd: Length = CALIPER_SD

    def __post_init__(self) -> None:
        most = 2 * DICTIONARY_SIZES[-1]
        if min(self.squares) < 3 or self.squares[0] * self.squares[1] > most:
            raise DataError(
                f"a board of {self.squares[0]} x {self.squares[1]} squares. Use at least 3 columns "
                f"and rows, and at most {most} squares"
            )
        if not 0.0 < self.marker < self.square:
            raise DataError("a marker must be smaller than a square, and both above 0")
        if not self.measured_sd > 0.0:
            raise DataError("the standard deviation of the measured lengths must be above 0")
        for axis, found, mark in zip("xy", self.measured or self.marks, self.marks, strict=True):
            if not abs(found / mark - 1.0) < MOST_SCALE:
                raise DataError(
                    f"the measured length along {axis} is {1e3 * found:g} mm, but the lines are "
                    f"{1e3 * mark:g} mm apart as designed. Measure from line to line"
                )

    @property
    def corners(self) -> tuple[int, int]:
        """Columns and rows of inner corners."""
        return self.squares[0] - 1, self.squares[1] - 1

    @property
    def marks(self) -> tuple[Length, Length]:
        """Distances along x and y of the marks to measure [m]: squares that a caliper spans."""
        spans = (max(1, min(n, int(CALIPER / self.square + 1e-9))) for n in self.squares)
        x, y = (span * self.square for span in spans)
        return x, y


def choose_board(columns: int, rows: int, square: float) -> Board:
    """Return a board of so many squares of a side [m]; see `Board`."""
    enough = [n for n in DICTIONARY_SIZES if n >= columns * rows // 2]
    return Board((columns, rows), square, 0.75 * square, f"5X5_{(enough or DICTIONARY_SIZES)[0]}")


def load_dictionary(cv2: Any, board: Board) -> Any:
    """Return the dictionary of a board; DataError if OpenCV has none of this name."""
    number = getattr(cv2.aruco, f"DICT_{board.dictionary}", None)
    if number is None:
        raise DataError(f"OpenCV has no dictionary {board.dictionary!r}. Write one such as 5X5_50")
    return cv2.aruco.getPredefinedDictionary(number)


def read_board(path: str | Path) -> Board:
    """Return the board that a file describes; FileError where it describes none."""
    file = read_yaml(path, "board file")
    check_format(file, FORMAT)
    content = {key: value for key, value in file.content.items() if key != "format"}
    try:
        return read_record(file, content, Board, None)
    except DataError as error:
        raise file.error(str(error)) from None


def format_board(board: Board) -> str:
    """Return a board as a file, with a place for the measured lengths."""
    x, y = (f"{1e3 * length:.2f} mm" for length in board.marks)
    columns, rows = board.corners
    content = {
        "format": FORMAT,
        "squares": board.squares,
        "square": f"{1e3 * board.square:g} mm",
        "marker": f"{1e3 * board.marker:g} mm",
        "dictionary": board.dictionary,
    }
    comments = {
        "squares": "columns and rows",
        "square": "side of a square, as designed",
        "marker": "side of a marker",
        "dictionary": "of OpenCV",
    }
    return (
        "# A printed board (ChArUco). Print it at 100 %, without fit to page, and glue it to a\n"
        f"# flat plate. It has {columns} x {rows} inner corners: 0 at the top left, x to the right,"
        " y down.\n"
        f"{format_yaml(content, comments)}"
        "# Measure from line to line along x and y, and enter the lengths without the # in front:\n"
        f"# measured: [{x}, {y}]\n"
        f"# measured_sd: {1e3 * board.measured_sd:g} mm\n"
    )


# Drawings: lengths in mm, y down from the top left of the sheet.

Shape = tuple[float, float, float, float, bool]  # x, y, width, height, whether black
Words = tuple[float, float, str]  # left end of the base line, text


def draw_board(board: Board, paper: tuple[float, float]) -> tuple[list[Shape], list[Words]]:
    """Return the rectangles and texts of a sheet (width, height) [m].

    DataError : the board does not fit on the sheet. MissingPackageError : OpenCV, which has the
        markers, is not installed.
    """
    cv2 = import_optional("cv2", "camera")
    size = [1e3 * n * board.square for n in board.squares]
    sheet = [1e3 * side for side in paper]
    room = [sheet[0] - 2e3 * SIDE, sheet[1] - 1e3 * BELOW - 10.0]
    if size[0] > room[0] or size[1] > room[1]:
        raise DataError(
            f"the board is {size[0]:g} mm x {size[1]:g} mm, but the sheet has room for "
            f"{room[0]:g} mm x {room[1]:g} mm. Use fewer or smaller squares, or a larger sheet"
        )
    left = 0.5 * (sheet[0] - size[0])
    top = max(10.0, 0.5 * (sheet[1] - size[1] - 1e3 * BELOW))
    shapes = list(_draw_squares(cv2, board, left, top))
    x, y = (1e3 * mark for mark in board.marks)
    below = top + size[1] + 4.0
    shapes += [(left + at - LINE / 2, below, LINE, 6.0, True) for at in (0.0, x)]
    shapes += [(left - 10.0, top + at - LINE / 2, 6.0, LINE, True) for at in (0.0, y)]
    columns, rows = board.squares
    words = [
        (left + 3.0, below + 4.0, f"x: {x:g} mm from line to line"),
        (left - 19.0, top + 0.5 * y, f"y: {y:g} mm"),
        (
            left,
            below + 10.0,
            (
                f"{columns} x {rows} squares of {1e3 * board.square:g} mm, {board.dictionary}. "
                "Print at 100 %, without fit to page"
            ),
        ),
    ]
    return shapes, words


def _draw_squares(cv2: Any, board: Board, left: float, top: float) -> Iterator[Shape]:
    """Yield the squares, and the markers with rows of white modules."""
    dictionary = load_dictionary(cv2, board)
    side, marker = 1e3 * board.square, 1e3 * board.marker
    module, gap, number = marker / MODULES, 0.5 * (side - marker), 0
    for row in range(board.squares[1]):
        for column in range(board.squares[0]):
            x, y = left + column * side, top + row * side
            if (row + column) % 2 == 0:
                yield x, y, side, side, True
                continue
            yield x + gap, y + gap, marker, marker, True
            bits = cv2.aruco.generateImageMarker(dictionary, number, MODULES) > 0
            number += 1
            for i, j in zip(*bits.nonzero(), strict=True):
                if not bits[i, j - 1]:  # the first of a row of white modules
                    run = int(bits[i, j:].argmin())
                    where = x + gap + j * module, y + gap + i * module
                    yield *where, run * module, module, False


def format_svg(shapes: list[Shape], words: list[Words], paper: tuple[float, float]) -> str:
    """Return a sheet as SVG in true scale."""
    width, height = (f"{1e3 * side:g}" for side in paper)
    lines = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
            f'viewBox="0 0 {width} {height}">'
        ),
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for x, y, w, h, is_black in shapes:
        color = "#000" if is_black else '#fff" shape-rendering="crispEdges'  # no gray seams
        lines.append(
            f'<rect x="{x:.4f}" y="{y:.4f}" width="{w:.4f}" height="{h:.4f}" fill="{color}"/>'
        )
    for x, y, text in words:
        place = f'x="{x:.4f}" y="{y:.4f}" font-size="{TEXT}"'
        lines.append(f'<text {place} font-family="Helvetica, Arial, sans-serif">{text}</text>')
    return "\n".join((*lines, "</svg>\n"))


def format_pdf(shapes: list[Shape], words: list[Words], paper: tuple[float, float]) -> bytes:
    """Return a sheet as PDF in true scale, which asks viewers to print it so."""
    width, height = (1e3 * side for side in paper)
    drawn = [f"{1 / POINT:.8f} 0 0 {1 / POINT:.8f} 0 0 cm"]
    for x, y, w, h, is_black in shapes:
        drawn.append(f"{0 if is_black else 1} g {x:.4f} {height - y - h:.4f} {w:.4f} {h:.4f} re f")
    for x, y, text in words:
        drawn.append(f"0 g BT /F1 {TEXT} Tf {x:.4f} {height - y:.4f} Td ({text}) Tj ET")
    stream = "\n".join(drawn)
    box = f"0 0 {width / POINT:.4f} {height / POINT:.4f}"
    objects = (
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        (
            f"<< /Type /Page /Parent 2 0 R /MediaBox [{box}] /Contents 4 0 R "
            "/Resources << /Font << /F1 5 0 R >> >> >>"
        ),
        f"<< /Length {len(stream)} >>\nstream\n{stream}\nendstream",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    )
    text, places = "%PDF-1.6\n", []
    for number, body in enumerate(objects, 1):
        places.append(f"{len(text):010d} 00000 n \n")
        text += f"{number} 0 obj\n{body}\nendobj\n"
    table = f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{''.join(places)}"
    trailer = (
        f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(text)}\n%%EOF\n"
    )
    return (text + table + trailer).encode("ascii")
