# SPDX-License-Identifier: Apache-2.0
"""Printed boards (their file, and their drawing as SVG and PDF in true scale) and pictures of them
(corners found by OpenCV, poses by name, and the measurement file).

A board is a chessboard with a marker in each white square (ChArUco), by which corners are found
and numbered where a picture shows a part of it. The black square at the top left is the first. The
inner corners have the numbers of the kind `image`: from the top left along the rows.
"""

from __future__ import annotations

import base64
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.environment import import_optional
from loopcal.errors import DataError, FileError
from loopcal.estimate.result import KindResiduals
from loopcal.findings import Finding, report_finding
from loopcal.io.core.csv_table import format_row, read_table
from loopcal.io.core.limits import make_name
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import format_flow, format_yaml, read_yaml
from loopcal.io.data.kind_settings import describe_kind, describe_stated_values
from loopcal.io.robot.robot_file import check_format
from loopcal.measure.kinds.image import (
    GRAZING,
    NARROW,
    PRINT_SD,
    Image,
    shows_board,
    solve_homography,
    state_camera,
)
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension, Length

FORMAT = 1
# Markers of the dictionaries; the smallest that suffices has the most different markers.
DICTIONARY_SIZES = (50, 100, 250, 1000)
MODULES = 7  # rows and columns of a marker: 5 of bits, and a black border
CALIPER = 0.140  # length that a common caliper can measure [m]
CALIPER_SD = 5e-5  # standard deviation of a length that was measured with it from line to line [m]
MOST_SCALE = 0.1  # scale of a print, as a share, beyond which other lines were measured
# Width and height of a sheet [m].
PAPERS = {"a4": (0.297, 0.210), "a3": (0.420, 0.297), "letter": (0.2794, 0.2159)}
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

    @property
    def scales(self) -> tuple[tuple[float, float], ...]:
        """Scales of the print along x and y by its lengths, with their standard deviations."""
        if self.measured is None:
            return ((0.0, PRINT_SD),) * 2
        return tuple(
            (round(found / mark - 1.0, 9), round(self.measured_sd / mark, 9))
            for found, mark in zip(self.measured, self.marks, strict=True)
        )


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
    return read_record(file, content, Board, None)


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


# Pictures of a printed board.

# Endings of files that are taken for pictures, also of those that cannot be read.
ENDINGS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".heif", ".dng")
LEAST_CORNERS = 8  # corners below which a picture is left out: two more than determine a pose well
BLUR = 3.0  # standard deviation of the blur of edges [px] from which a picture is left out
REDUCED = (2, 4)  # times that a picture is reduced to see whether only blur hides the board
# Half of the window around a corner, as a share of the white margins of two markers beside it.
WINDOW = 0.48
THUMBNAIL = 480  # width of a picture on the contact sheet [px]
ARROW = 0.03  # length of an arrow of the rms of the residuals, as a share of that width
SAME_PIXEL = 1e-3  # difference up to which two corners are the same: files have three decimals [px]
FULL_FRAME = 43.2666  # diagonal of the film that focal lengths of phones refer to [mm]
# Difference of focal lengths, as a share, from which a picture is of another zoom.
SAME_FOCAL = 0.01
# Pictures of one of two cameras at least, how often they are divided anew, and how many times
# smaller the residuals of two cameras are from where they are named: those of one camera, divided
# at random, up to 1.3 times.
LEAST_PICTURES, DIVISIONS, TWO_CAMERAS = 4, 6, 1.6


@dataclass(frozen=True)
class PictureTask:
    """A picture to examine, which a worker process can be given."""

    path: Path
    board: Board
    most_blur: float = BLUR

    @property
    def key(self) -> str:
        """The path."""
        return str(self.path)


@dataclass(frozen=True, eq=False)
class Picture:
    """What a picture shows.

    path : the file. size : width and height. focal : focal length by EXIF [px]; None without.
    corners : (n,) numbers. pixels : (n, 2), pixel (0, 0) being the middle of the first one.
    blur : standard deviation of the blur of edges [px], in the worse direction; NaN if unknown.
    fault : why it is left out. thumbnail : JPEG.
    """

    path: Path
    size: tuple[int, int] = (0, 0)
    focal: float | None = None
    corners: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    pixels: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    blur: float = float("nan")
    fault: Finding | None = None
    thumbnail: bytes = field(default=b"", repr=False)


def list_pictures(folder: Path) -> tuple[Path, ...]:
    """Return the pictures of a folder in the order of their names, IMG_9 before IMG_10."""
    if not folder.is_dir():
        raise FileError("this folder does not exist. Name the folder with the pictures", folder)
    found = [path for path in folder.iterdir() if path.suffix.lower() in ENDINGS]
    if not found:
        raise FileError(f"this folder has no pictures ({', '.join(ENDINGS)})", folder)

    def order(path: Path) -> list[tuple[int, str]]:
        return [(int(p) if p.isdigit() else -1, p) for p in re.split(r"(\d+)", path.name.lower())]

    return tuple(sorted(found, key=order))


def examine_picture(task: PictureTask) -> Picture:
    """Return the corners of a picture, or why it is left out."""
    cv2 = import_optional("cv2", "camera")
    try:
        gray, focal = _load_picture(task.path)
    except (OSError, ValueError, SyntaxError, MemoryError) as error:  # what Pillow raises
        reason = " ".join(str(error).split()) or type(error).__name__
        reason = reason.replace(repr(str(task.path)), "it")[:120]
        return Picture(task.path, fault=report_finding("pictures.unreadable", reason=reason))
    size = gray.shape[1], gray.shape[0]
    corners, pixels = find_corners(cv2, gray, task.board)
    blur = measure_blur(cv2, gray, task.board, corners, pixels)
    least, fault = min(LEAST_CORNERS, task.board.corners[0] * task.board.corners[1]), None
    if len(corners) < least:
        # in reduced pictures blur is less
        reduced = (
            cv2.resize(gray, (size[0] // n, size[1] // n), interpolation=cv2.INTER_AREA)
            for n in REDUCED
            if min(size) >= n
        )
        flipped = np.ascontiguousarray(gray[:, ::-1])
        if len(find_corners(cv2, flipped, task.board)[0]) >= least:
            fault = report_finding("pictures.mirrored")
        elif any(len(find_corners(cv2, r, task.board)[0]) >= least for r in reduced):
            fault = report_finding("pictures.blurred", blur=None, limit=task.most_blur)
        else:
            data = {"found": len(corners), "least": least, "narrow": NARROW}
            fault = report_finding("pictures.few-corners", **data)
    elif blur > task.most_blur:
        fault = report_finding("pictures.blurred", blur=round(blur, 1), limit=task.most_blur)
    scale = min(1.0, THUMBNAIL / gray.shape[1])
    shown = max(1, round(scale * gray.shape[1])), max(1, round(scale * gray.shape[0]))
    small = cv2.resize(gray, shown, interpolation=cv2.INTER_AREA)
    thumbnail = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 75])[1].tobytes()
    return Picture(task.path, size, focal, corners, pixels, blur, fault, thumbnail)


def _load_picture(path: Path) -> tuple[np.ndarray[Any, np.dtype[np.uint8]], float | None]:
    """Return the gray values of the sensor, as it was held, and the focal length by EXIF [px]."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            details = picture.getexif().get_ifd(0x8769)
            film = float(details.get(0xA405) or 0.0)  # FocalLengthIn35mmFilm
            if picture.mode[0] in "IF":  # 16 bits and more, as of industrial cameras
                deep = np.asarray(picture).astype(float)
                gray = (255.0 * deep / max(deep.max(), 1e-9)).clip(0.0).astype(np.uint8)
            else:
                gray = np.asarray(picture.convert("L"))
    except UnidentifiedImageError as error:
        raise ValueError("its format is unknown") from error
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from error
    focal = film / FULL_FRAME * float(np.hypot(*gray.shape))
    return gray, focal if focal > 0.0 and np.isfinite(focal) else None


def find_corners(cv2: Any, gray: Any, board: Board) -> tuple[IntArray, FloatArray]:
    """Return numbers (n,) and pixels (n, 2) of the inner corners of a board that look wide enough,
    and not from the side; none where these do not determine the pose of the board.
    """
    dictionary = load_dictionary(cv2, board)
    layout = cv2.aruco.CharucoBoard(board.squares, board.square, board.marker, dictionary)
    pixels, corners, _, _ = cv2.aruco.CharucoDetector(layout).detectBoard(gray)
    none = np.zeros(0, dtype=np.intp), np.zeros((0, 2))
    if corners is None or len(corners) == 0:
        return none
    corners, pixels = corners.ravel().astype(np.intp), pixels.reshape(-1, 2).astype(float)
    pairs = _pair_neighbors(board, corners)
    side = max(np.linalg.norm(pixels[b] - pixels[a], axis=1).max(initial=0.0) for a, b in pairs)
    place = side * (np.stack(np.divmod(corners, board.corners[0])[::-1], axis=1) + 1.0)
    if not side or not shows_board(place, pixels[None])[0]:
        return none
    # once more as seen from the front, where the edges of all squares are at right angles, in a
    # window without the markers; blurred, because steps between pixels mislead
    H = solve_homography(place, pixels)
    size = [round(side * n) for n in board.squares]
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    front = cv2.warpPerspective(gray.astype(np.float32), H, size, flags=how)
    smooth = cv2.GaussianBlur(front, (0, 0), 1.0)
    half = int(np.clip(WINDOW * (1.0 - board.marker / board.square) * side, 2, 20))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    start = cv2.perspectiveTransform(pixels[:, None], np.linalg.inv(H)).astype(np.float32)
    found = cv2.cornerSubPix(smooth, start, (half, half), (-1, -1), criteria)
    pixels = cv2.perspectiveTransform(found.astype(float), H)[:, 0]
    slope = H[:2, :2] - pixels[:, :, None] * H[2, :2]  # of pixels by places
    slope = slope / (found[:, 0] @ H[2, :2] + H[2, 2])[:, None, None]
    wide, narrow = np.linalg.svd(slope, compute_uv=False).T
    is_clear = (side * narrow > NARROW) & (narrow > GRAZING * wide)
    return corners[is_clear], pixels[is_clear]


def _pair_neighbors(board: Board, corners: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Return the places in `corners` of neighbors along a row, and of those along a column."""
    columns, rows = board.corners
    place = np.full(columns * rows, -1)
    place[corners] = np.arange(len(corners))
    grid = place.reshape(rows, columns)
    pairs = ((grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:]))
    found = [(a.ravel(), b.ravel()) for a, b in pairs]
    return [(a[(a >= 0) & (b >= 0)], b[(a >= 0) & (b >= 0)]) for a, b in found]


def measure_blur(cv2: Any, gray: Any, board: Board, corners: IntArray, pixels: FloatArray) -> float:
    """Return the standard deviation of the blur [px] of edges between neighboring corners, along
    rows or along columns, whichever is larger; NaN without neighbors.

    A step of height h that a Gaussian blurs has the slope `h / (sigma sqrt(2 pi))`.
    """
    found = []
    for a, b in _pair_neighbors(board, corners):
        if not len(a):
            continue
        along = pixels[b] - pixels[a]
        length = np.linalg.norm(along, axis=1)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None]
        reach = float(np.clip(0.12 * np.median(length), 3.0, 30.0))
        steps = np.linspace(-reach, reach, 61)
        # the mean of several profiles, away from the corners, against noise
        shares = np.linspace(0.25, 0.75, 9)
        middle = pixels[a][:, None] + shares[:, None] * along[:, None]
        points = middle[:, :, None] + steps[:, None] * across[:, None, None]
        flat = points.reshape(len(a), -1, 2).astype(np.float32)
        values = cv2.remap(gray, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR).astype(float)
        profile = values.reshape(len(a), len(shares), len(steps)).mean(axis=1)
        height = np.ptp(profile, axis=1)
        slope = np.abs(np.gradient(profile, steps, axis=1)).max(axis=1)
        sigma = height / np.maximum(slope, 1e-9) / np.sqrt(2.0 * np.pi)
        found.append(float(np.median(sigma)))
    return max(found, default=float("nan"))


def compare_pictures(pictures: Sequence[Picture]) -> tuple[Picture, ...]:
    """Return pictures, without those of another size or focal length than most have, and without
    a file that is another one once more.
    """
    good = [picture for picture in pictures if picture.fault is None]
    if not good:
        return tuple(pictures)
    size = Counter(picture.size for picture in good).most_common(1)[0][0]
    focals = [p.focal for p in good if p.focal is not None and p.size == size]
    focal = float(np.median(focals)) if focals else None
    checked, first = [], dict[bytes, Picture]()
    for picture in pictures:
        fault = picture.fault
        earlier = first.setdefault(picture.pixels.tobytes() if fault is None else b"", picture)
        if fault is None and picture.size != size:
            sizes = [f"{width} x {height}" for width, height in (picture.size, size)]
            fault = report_finding("pictures.other-size", size=sizes[0], other=sizes[1])
        elif fault is None and earlier is not picture:
            fault = report_finding("pictures.repeated", other=earlier.path.name)
        elif fault is None and focal is not None:
            own = picture.focal or focal
            if abs(own / focal - 1.0) > SAME_FOCAL:
                fault = report_finding("pictures.zoomed", focal=round(own), other=round(focal))
        checked.append(replace(picture, fault=fault))
    return tuple(checked)


def find_two_cameras(board: Board, pictures: Sequence[Picture]) -> dict[str, Any] | None:
    """Return the pictures of each of two cameras that fit the corners far better than one, with
    free poses of the board, and how many times; None without such, where EXIF has focal lengths,
    and of too few pictures.

    Pictures are divided by the focal lengths that each has alone, with the lens of all and without
    distortion, and then by the camera that fits them better.
    """
    good = [picture for picture in pictures if picture.fault is None]
    if len(good) < 2 * LEAST_PICTURES or all(picture.focal for picture in good):
        return None
    cv2, names = import_optional("cv2", "camera"), [picture.path.name for picture in good]
    seen = [picture.pixels[:, None].astype(np.float32) for picture in good]
    places = [np.stack(np.divmod(p.corners, board.corners[0])[::-1], axis=1) for p in good]
    flat = [np.pad(board.square * place, ((0, 0), (0, 1))).astype(np.float32) for place in places]
    size, every = good[0].size, np.arange(len(good))

    def fit(chosen: IntArray, lens: Any = (None, None), fixed: int = 0) -> tuple[float, Any]:
        of_chosen = [[rows[i] for i in chosen] for rows in (flat, seen)]
        start = (None if part is None else part.copy() for part in lens)
        rms, *lens = cv2.calibrateCamera(*of_chosen, size, *start, flags=fixed)[:3]
        return rms, lens

    def measure(lens: Any) -> FloatArray:
        found = []
        for place, pixels in zip(flat, seen, strict=True):
            _, *pose = cv2.solvePnP(place, pixels, *lens)
            found.append(np.square(cv2.projectPoints(place, *pose, *lens)[0] - pixels).sum())
        return np.array(found)

    one, lens = fit(every)
    middle = 0.5 * (np.array(size) - 1.0)
    plain = np.array([[size[0], 0.0, middle[0]], [0.0, size[0], middle[1]], [0.0, 0.0, 1.0]])
    only_focal = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT
    only_focal |= cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_TANGENT_DIST
    only_focal |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    best, groups = np.inf, (every, every)
    for begin in (lens, (plain, np.zeros(5))):
        focal = np.array([fit(every[i : i + 1], begin, only_focal)[1][0][0, 0] for i in every])
        order = np.argsort(focal)
        cuts = range(LEAST_PICTURES, len(good) - LEAST_PICTURES + 1)
        halves = {k: (focal[order[:k]], focal[order[k:]]) for k in cuts}
        cut = min(cuts, key=lambda k: sum(len(half) * half.var() for half in halves[k]))
        is_first = np.isin(every, order[:cut])
        for _ in range(DIVISIONS):
            if min(is_first.sum(), (~is_first).sum()) < LEAST_PICTURES:
                break
            two = [measure(fit(every[own])[1]) for own in (is_first, ~is_first)]
            is_first = two[0] < two[1]
            square = float(np.minimum(*two).sum())
            if square < best:
                best, groups = square, (every[is_first], every[~is_first])
    times = one / np.sqrt(best / sum(map(len, seen)))
    if times < TWO_CAMERAS or min(map(len, groups)) < LEAST_PICTURES:
        return None
    first, second = (tuple(names[i] for i in group) for group in groups)
    return {"times": times, "first": first, "second": second}


def name_poses(paths: Sequence[Path], names: Path | None = None) -> dict[Path, str]:
    """Return the pose of each picture: its file name without ending, or by a table of poses.

    A table with the column `picture` assigns names of files. Otherwise the pictures have the names
    of its poses, or are as many as its poses and in their order.

    FileError : the table does not fit the pictures.
    """
    if names is None:
        stems = Counter(path.stem for path in paths)
        if double := [stem for stem, times in stems.items() if times > 1]:
            raise DataError(f"two pictures have the name {double[0]!r}. Rename one of them")
        return {path: make_name(path.stem) for path in paths}
    table = read_table(names)
    poses = table.pose_names()
    if "picture" in table.names:
        listed = dict(zip(table.text("picture"), poses, strict=True))
        missing = [path.name for path in paths if not {path.name, path.stem} & listed.keys()]
        if missing:
            raise FileError(f"the column 'picture' lacks {missing[0]!r}. Add it", names)
        return {path: listed.get(path.name) or listed[path.stem] for path in paths}
    unique = list(dict.fromkeys(poses))
    others = [path.name for path in paths if path.stem not in unique]
    if not others:
        return {path: path.stem for path in paths}
    if len(unique) != len(paths) or len(others) < len(paths):
        sentence = (
            f"{len(paths)} pictures and {len(unique)} poses, but {others[0]} has the name of none. "
            "Name all pictures like the poses, or none of as many, or add the column 'picture'"
        )
        raise FileError(sentence, names)
    return dict(zip(paths, unique, strict=True))


def list_cameras(poses: Path | None) -> dict[str, str]:
    """Return the cameras of the poses of a table with the column `camera`; empty without one."""
    table = None if poses is None else read_table(poses)
    if table is None or "camera" not in table.units:
        return {}
    return dict(zip(table.pose_names(), table.text("camera"), strict=True))


def refer_to_poses(poses: Path | None, output: Path) -> dict[str, str]:
    """Return the setting by which a measurement file names a table with readings beside it."""
    if poses is None or poses.resolve().parent != output.resolve().parent:
        return {}
    has_readings = any(unit is not None for unit in read_table(poses).units.values())
    return {"poses": poses.name} if has_readings else {}


def format_pictures(
    board: Board,
    pictures: Sequence[Picture],
    names: Mapping[Path, str],
    mount: str,
    sigma: float,
    beside: Mapping[str, str],
    cameras: Mapping[str, str] | None = None,
) -> str:
    """Return the measurement file of the pictures without a fault. mount : of the kind `image`.
    sigma : [px] of u and v. beside : setting that names the table with the readings. cameras : of
    the poses, stations of one camera with one lens; by default one station.
    """
    good = [picture for picture in pictures if picture.fault is None]
    if not good:
        name, reason = pictures[0].path.name, str(pictures[0].fault)
        raise DataError.of("pictures.none", count=len(pictures), name=name, reason=reason)
    focals = [picture.focal for picture in good if picture.focal is not None]
    focal = round(float(np.median(focals))) if focals else None
    camera = Image(mount=mount, corners=board.corners, square=board.square, size=good[0].size)
    if focal is not None:
        camera = replace(camera, focal=(focal, focal))
    camera, stated = state_camera(camera, board.scales)
    of_picture = [(cameras or {}).get(names[picture.path], camera.camera) for picture in good]
    kinds = {name: replace(camera, camera=name, lens=camera.lens or of_picture[0])
             for name in dict.fromkeys(of_picture)}  # fmt: skip
    noise = dict.fromkeys("uv", sigma)
    described = {name: describe_kind(kind, noise, np.eye(4), is_noise_assumed=True)
                 for name, kind in kinds.items()}  # fmt: skip
    known: dict[str, Any] = {"kinds": described} if cameras else described[camera.camera]
    known |= beside
    known["unknowns"] = describe_stated_values(stated, camera.nuisance_parameters)
    lines = [f"# {key}: {format_flow(value)}" for key, value in known.items()]
    lines.append(f"pose,{'camera,' if cameras else ''}corner,u [px],v [px]")
    for picture, name in zip(good, of_picture, strict=True):
        first = (names[picture.path], *([name] if cameras else ()))
        for corner, (u, v) in zip(picture.corners, picture.pixels, strict=True):
            lines.append(format_row((*first, f"{corner}", f"{u:.3f}", f"{v:.3f}")))
    return "\n".join(lines) + "\n"


def find_residuals(picture: Picture, pose: str, residuals: Sequence[KindResiduals]) -> FloatArray:
    """Return the residuals (n, 2) [px] of the corners of a picture in a fit; NaN without one."""
    found = np.full_like(picture.pixels, np.nan)
    for rows in residuals:
        own = np.flatnonzero(np.array(rows.poses) == pose)
        if set(rows.dimensions) == {Dimension.PIXEL}:
            apart = np.abs(picture.pixels[:, None] - rows.measured[own]).max(axis=2)
            corner, row = np.nonzero(apart < SAME_PIXEL)
            found[corner] = rows.raw[own[row]]
    return found


def format_contact_sheet(
    pictures: Sequence[Picture],
    names: Mapping[Path, str],
    residuals: Sequence[KindResiduals] | None = None,
) -> str:
    """Return one HTML page of all pictures with their corners, and with arrows to the predicted
    corners where a fit has residuals of them.

    DataError : it has residuals of none.
    """
    moved = [find_residuals(p, names[p.path], residuals or ()) for p in pictures]
    every = np.concatenate(moved)
    every = every[np.isfinite(every)]
    if residuals is not None and not len(every):
        raise DataError(
            "the calibration has no residuals of these pictures. Name the run folder of one that "
            "used their corners"
        )
    rms = float(np.sqrt((every**2).mean())) if len(every) else 0.0
    times = ARROW * pictures[0].size[0] / max(rms, 1e-9)
    cards = []
    for picture, arrows in zip(pictures, moved, strict=True):
        source = base64.b64encode(picture.thumbnail).decode()
        image = f'<img alt="" src="data:image/jpeg;base64,{source}">' if source else ""
        name = escape(f"{picture.path.name}: pose {names[picture.path]}")
        size = np.sqrt(np.nanmean(arrows**2)) if np.isfinite(arrows).any() else None
        words = describe_picture(picture) + ("" if size is None else f", residuals {size:.2g} px")
        cards.append(
            f'<figure class="{"bad" if picture.fault else "good"}"><div>{image}'
            f"{_draw_corners(picture, times * arrows)}</div>"
            f"<figcaption><b>{name}</b><br>{escape(words)}</figcaption></figure>"
        )
    used = sum(picture.fault is None for picture in pictures)
    note = f"<p>Arrows: predicted - seen, {times:.0f} times. rms {rms:.2g} px</p>" if rms else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Pictures</title>'
        "<style>body{font:15px sans-serif;margin:1rem;color:#222;background:#fff}"
        "main{display:grid;grid-template-columns:repeat(auto-fill,minmax(18rem,1fr));gap:1rem}"
        "figure{margin:0;border:2px solid #8a8;padding:.5rem}.bad{border-color:#b22}"
        "div{position:relative}img{width:100%}div svg{position:absolute;left:0;width:100%}"
        "circle{fill:none;stroke:#e65a00}path{stroke:#0072b2;marker-end:url(#tip)}"
        "</style></head><body>"
        f"<h1>Pictures of the board: {used} of {len(pictures)} are used</h1>{note}"
        '<svg width="0" height="0"><marker id="tip" orient="auto" refX="2" refY="2" '
        'markerWidth="4" markerHeight="4"><polygon points="0,0 4,2 0,4" fill="#0072b2"/></marker>'
        "</svg><main>" + "\n".join(cards) + "</main></body></html>\n"
    )


def _draw_corners(picture: Picture, arrows: FloatArray) -> str:
    """Return the corners of a picture and arrows (n, 2) from them as SVG."""
    width, height = picture.size
    shapes = [f'<circle cx="{u:.0f}" cy="{v:.0f}" r="1%"/>' for u, v in picture.pixels]
    shapes += [
        f'<path d="M{u:.0f} {v:.0f}l{du:.0f} {dv:.0f}"/>'
        for (u, v), (du, dv) in zip(picture.pixels, arrows, strict=True)
        if np.isfinite(du)
    ]
    lines = f'viewBox="0 0 {width} {height}" stroke-width="{width / THUMBNAIL:.1f}"'
    return f"<svg {lines}>{''.join(shapes)}</svg>"


def describe_picture(picture: Picture) -> str:
    """Return a line on a picture: what was found, or why it is left out."""
    if picture.fault is not None:
        return f"left out: {picture.fault}"
    blur = "" if np.isnan(picture.blur) else f", blur {picture.blur:.1f} px"
    return f"{len(picture.corners)} corners{blur}"
