# SPDX-License-Identifier: Apache-2.0
"""Figures of pages, written as SVG in a hundredth of the time of matplotlib.

A page figure has those methods of a matplotlib figure that the figures of documents call, with the
same names and arguments; one function thus draws for pages and for notebooks. Positions are points
(1/72 inch), from the upper left corner.
"""

from __future__ import annotations

import base64
import itertools
import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from html import escape as escape_html
from typing import Any, NamedTuple

import numpy as np

from loopcal.plain_text import escape
from loopcal.typing import FloatArray

FAMILY = "DejaVu Sans, Verdana, Arial, sans-serif"
"""Fonts of all texts; a browser takes the first that it has."""

BLACK, GRID_COLOR = "#000000", "#b0b0b0"
MINUS = "\u2212"

WIDTHS = {  # [1/100 of the size], of characters of DejaVu Sans
    28: "ijl'", 32: " ,.:;|I", 34: "/\\", 39: "()[]frt", 55: "csxyzJkv-", 69: "ABCKPRVX",
    61: "abdeghnopquEFLST?_YZ", 64: "0123456789$*µ", 77: "DGHNOQU&", 84: "+<=>±~^", 87: "wmMW%@#",
}  # fmt: skip
CHARACTERS = {character: width / 100.0 for width, every in WIDTHS.items() for character in every}
CHARACTERS[MINUS] = CHARACTERS["+"]

VIRIDIS = "440154 482475 414487 355f8d 2a788e 21918c 22a884 44bf70 7ad151 bddf26 fde725"
RED_BLUE = "053061 2166ac 4393c3 92c5de d1e5f0 f7f7f7 fddbc7 f4a582 d6604d b2182b 67001f"
COLOR_MAPS = {
    name: np.array([[int(color[i : i + 2], 16) for i in (0, 2, 4)] for color in text.split()])
    for name, text in {"viridis": VIRIDIS, "RdBu_r": RED_BLUE}.items()
}
"""Name of a color map -> its colors (11, 3) at even steps, 0 to 255."""

NICE = (1.0, 2.0, 2.5, 5.0, 10.0)
"""Steps between numbers at an axis, times powers of ten."""


def measure_text(text: str, size: float) -> float:
    """Return the width of the longest line of a text [pt]."""
    return max(sum(CHARACTERS.get(c, 0.62) for c in line) for line in text.split("\n")) * size


def pick_colors(name: str, shares: FloatArray) -> FloatArray:
    """Return the colors (.., 3), 0 to 255, at shares (..) of a color map."""
    colors = COLOR_MAPS[name]
    places = np.linspace(0.0, 1.0, len(colors))
    channels = [np.interp(shares, places, channel) for channel in colors.T]
    return np.rint(np.stack(channels, axis=-1))


def name_color(color: Any) -> str:
    """Return a color as SVG has it; a number as text is a grey."""
    if isinstance(color, str):
        try:
            grey = round(255 * float(color))
        except ValueError:
            return {"k": BLACK, "black": BLACK, "white": "#ffffff"}.get(color, color)
        return f"#{grey:02x}{grey:02x}{grey:02x}"
    return "#" + "".join(f"{round(float(channel)):02x}" for channel in color)


def choose_ticks(low: float, high: float, most: float, is_whole: bool = False) -> list[float]:
    """Return round numbers from low to high, at most about so many."""
    if not high > low:
        return [low]
    rough = (high - low) / max(most, 1.0)
    power = 10.0 ** math.floor(math.log10(rough))
    steps = [power * n for n in NICE if power * n >= rough * (1.0 - 1e-9)]
    step = steps[0] if steps else 10.0 * power
    step = max(round(step), 1) if is_whole else step
    first, slack = math.ceil(low / step - 1e-9), 1e-9 * step
    ticks = []
    while first * step <= high + slack:
        ticks.append(first * step)
        first += 1
    return ticks


def word_ticks(ticks: Sequence[float]) -> list[str]:
    """Return numbers with the decimals that all of them need."""
    step = min((b - a for a, b in itertools.pairwise(ticks)), default=0.0)
    largest = max(map(abs, ticks), default=0.0)
    if largest >= 1e5 or 0.0 < step < 1e-4:
        return [f"{tick:.4g}".replace("-", MINUS) for tick in ticks]
    decimals = 0
    while step and decimals < 6 and abs(step * 10**decimals - round(step * 10**decimals)) > 1e-6:
        decimals += 1
    return [f"{tick + 0.0:.{decimals}f}".replace("-", MINUS) for tick in ticks]


def _join(values: FloatArray) -> list[str]:
    """Return numbers with two decimals, without zeros at the end."""
    return [f"{value:.2f}".rstrip("0").rstrip(".") for value in np.ravel(values).tolist()]


def _make_marker(marker: str, r: float) -> str:
    """Return the shape of a marker of this radius as a path that begins at its center."""
    corners = {
        "s": [(-1, -1), (1, -1), (1, 1), (-1, 1)],
        "^": [(0, -1), (1, 1), (-1, 1)],
        "v": [(0, 1), (-1, -1), (1, -1)],
        "<": [(-1, 0), (1, -1), (1, 1)],
        ">": [(1, 0), (-1, 1), (-1, -1)],
        "D": [(0, -1.3), (1.3, 0), (0, 1.3), (-1.3, 0)],
        "P": [(-.4, -1), (.4, -1), (.4, -.4), (1, -.4), (1, .4), (.4, .4), (.4, 1), (-.4, 1),
              (-.4, .4), (-1, .4), (-1, -.4), (-.4, -.4)],
        "*": [(math.sin(k * math.pi / 5) * size, -math.cos(k * math.pi / 5) * size)
              for k, size in zip(range(10), (1.0, 0.382) * 5, strict=True)],
    }  # fmt: skip
    if marker == "x":
        return f"m{-r:.2f} {-r:.2f}l{2 * r:.2f} {2 * r:.2f}m0 {-2 * r:.2f}l{-2 * r:.2f} {2 * r:.2f}"
    if marker == "+":
        return f"m{-r:.2f} 0h{2 * r:.2f}m{-r:.2f} {-r:.2f}v{2 * r:.2f}"
    if marker not in corners:  # a circle; a point is half as large
        r *= 0.5 if marker == "." else 1.0
        arc = f"a{r:.2f} {r:.2f} 0 1 0"
        return f"m{-r:.2f} 0{arc} {2 * r:.2f} 0{arc} {-2 * r:.2f} 0z"
    points = np.array(corners[marker]) * r
    steps = np.diff(points, axis=0, prepend=0.0)
    (x, y), *rest = steps.tolist()
    return f"m{x:.2f} {y:.2f}l" + " ".join(f"{x:.2f} {y:.2f}" for x, y in rest) + "z"


class Style(NamedTuple):
    """How a line with markers is drawn, from the words of matplotlib."""

    color: str
    face: str
    edge: str
    width: float
    line: str
    marker: str
    size: float
    edge_width: float
    alpha: float
    cap: str


MANY = 1000
"""Markers of one series whose shapes can be seen."""

DASHES = {"--": (3.7, 1.6), ":": (1.0, 1.65), "-.": (6.4, 1.6, 1.0, 1.6)}
"""Line style -> its dashes, times the width."""


def read_style(format_: str = "", **words: Any) -> Style:
    """Return the style of a line; format_ : marker, line and color in short, such as "o-"."""
    line = next((ls for ls in ("--", "-.", ":", "-") if ls in format_), "")
    rest = format_.replace(line, "") if line else format_
    marker = "".join(c for c in rest if c in "os^Dv<>P*x+.")
    short = "".join(c for c in rest if c not in "os^Dv<>P*x+.")
    marker = words.get("marker", marker)
    line = words.get("ls", line or ("none" if marker and "marker" not in words else "-"))
    color = name_color(words.get("color", short or words.get("mec", "#0072b2")))
    return Style(
        color=color,
        face=name_color(words.get("mfc", color)),
        edge=name_color(words.get("mec", color)),
        width=words.get("lw", 1.5),
        line=line,
        marker=marker,
        size=words.get("ms", 6.0),
        edge_width=words.get("mew", 1.0),
        alpha=words.get("alpha", 1.0),
        cap=words.get("solid_capstyle", "butt"),
    )


def _write(tag: str, text: str | None = None, **attributes: Any) -> str:
    """Return an element; an attribute that is None is left out."""
    words = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{value}"'
        for key, value in attributes.items()
        if value is not None
    )
    return f"<{tag}{words}/>" if text is None else f"<{tag}{words}>{text}</{tag}>"


def draw_path(d: str, style: Style) -> str:
    """Return the line of a style along a path."""
    dashes = style.line if isinstance(style.line, tuple) else (0, DASHES.get(style.line))
    dashed = dashes[1] and " ".join(f"{dash * style.width:.2f}" for dash in dashes[1])
    opacity = None if style.alpha == 1.0 else style.alpha
    cap = None if style.cap == "butt" else style.cap
    return _write(
        "path", d=d, fill="none", stroke=style.color, stroke_width=style.width,
        stroke_dasharray=dashed, stroke_opacity=opacity, stroke_linecap=cap,
    )  # fmt: skip


def draw_markers(x: FloatArray, y: FloatArray, style: Style) -> str:
    """Return markers at places [pt] as one path: short ends of lines where these look the same, and
    in place of so many markers that their shapes cannot be seen.
    """
    is_many, is_filled = len(x) > MANY, style.face == style.edge
    x, y = (np.round(values, 1) if is_many else values for values in (x, y))
    places = dict.fromkeys(zip(_join(x), _join(y), strict=True))
    known = [f"M{a} {b}" for a, b in places if "n" not in a + b]
    opacity = None if style.alpha == 1.0 else style.alpha
    if is_many or (is_filled and style.marker in {"o", "s"}):
        return _write(
            "path", d="h.1".join([*known, ""]), stroke=style.edge, opacity=opacity,
            stroke_width=f"{style.size + style.edge_width:.2f}",
            stroke_linecap="square" if style.marker == "s" else "round",
        )  # fmt: skip
    shape, is_open = _make_marker(style.marker, 0.5 * style.size), style.marker in {"x", "+"}
    return _write(
        "path", d=shape.join([*known, ""]), fill="none" if is_open else style.face,
        stroke=style.edge, stroke_width=style.edge_width, opacity=opacity,
    )  # fmt: skip


def draw_line(x: FloatArray, y: FloatArray, style: Style) -> Iterator[str]:
    """Yield the line through places [pt], with gaps at NaN, and its markers."""
    if style.line not in {"none", ""}:
        parts, is_gap = [], True
        for a, b in zip(_join(x), _join(y), strict=True):
            if "n" in a + b:  # nan, inf
                is_gap = True
                continue
            parts.append(f"{'M' if is_gap else 'L'}{a} {b}")
            is_gap = False
        if parts:
            yield draw_path("".join(parts), style)
    if style.marker and len(x):
        yield draw_markers(x, y, style)


ANCHORS = {"left": None, "center": "middle", "right": "end"}
BASELINES = {"baseline": 0.0, "bottom": -0.2, "center": 0.36, "top": 0.76}
"""Vertical alignment -> place of the baseline below it, times the size of the text."""
LINE_HEIGHT = 1.2


def draw_text(
    x: float,
    y: float,
    text: str,
    size: float,
    *,
    ha: str = "center",
    va: str = "center",
    color: str = BLACK,
    rotation: float = 0.0,
    bold: bool = False,
) -> Iterator[str]:
    """Yield the lines of a text at a place [pt]; rotation [deg], counterclockwise."""
    lines = text.split("\n")
    above = {"top": 0.0, "center": 0.5}.get(va, 1.0) * (len(lines) - 1) * LINE_HEIGHT
    for k, line in enumerate(lines):
        place = _join(np.array([x, y + size * (BASELINES[va] + k * LINE_HEIGHT - above)]))
        turn = f"rotate({-rotation:g} {x:.2f} {y:.2f})" if rotation else None
        yield _write(
            "text", escape_html(escape(line)), x=place[0], y=place[1], font_size=f"{size:g}",
            text_anchor=ANCHORS[ha], fill=None if color == BLACK else color, transform=turn,
            font_weight="bold" if bold else None,
        )  # fmt: skip


def draw_image(colors: FloatArray, x: float, y: float, width: float, height: float) -> str:
    """Return colors (rows, columns, 3) as a picture with sharp edges."""
    fine = np.repeat(np.repeat(colors.astype(np.uint8), 6, axis=0), 6, axis=1)
    rows = np.concatenate([np.zeros((len(fine), 1), np.uint8), fine.reshape(len(fine), -1)], axis=1)

    def chunk(name: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4) + name + data + zlib.crc32(name + data).to_bytes(4)

    size = fine.shape[1].to_bytes(4) + fine.shape[0].to_bytes(4)
    content = [(b"IHDR", size + bytes((8, 2, 0, 0, 0))), (b"IDAT", zlib.compress(rows.tobytes()))]
    png = b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*c) for c in [*content, (b"IEND", b"")])
    return _write(
        "image", x=f"{x:.2f}", y=f"{y:.2f}", width=f"{width:.2f}", height=f"{height:.2f}",
        preserveAspectRatio="none", image_rendering="pixelated",
        href=f"data:image/png;base64,{base64.b64encode(png).decode()}",
    )  # fmt: skip


# Axes: what is drawn, in units of the data, and where it is on the page.

TICK, GAP, PAD = 3.5, 3.5, 9.0
"""Length of the mark of a number, space beside it, and space between panels [pt]."""

BAR = 9.0
"""Width of the scale of colors [pt]."""

TITLE_SIZE, LABEL_SIZE, TICK_SIZE = 10.0, 9.0, 8.0


class Ticks(NamedTuple):
    """Numbers or names at an axis."""

    places: Sequence[float]
    labels: Sequence[str]
    rotation: float = 0.0
    size: float = TICK_SIZE

    def measure(self) -> tuple[float, float]:
        """Return width and height of the largest label [pt]."""
        width = max((measure_text(label, self.size) for label in self.labels), default=0.0)
        lines = max((label.count("\n") + 1 for label in self.labels), default=0)
        height, turn = lines * LINE_HEIGHT * self.size, math.radians(self.rotation)
        across = width * abs(math.cos(turn)) + height * abs(math.sin(turn))
        return across, width * abs(math.sin(turn)) + height * abs(math.cos(turn))


class PageAxis:
    """Limits and numbers along x, y or z."""

    def __init__(self, name: str, owner: PageAxes) -> None:
        self.axis_name, self.axes = name, owner
        self.values: list[float] = []  # ends of what is drawn
        self.floor: float | None = None  # below which there is no margin
        self.fixed: list[float | None] = [None, None]
        self.margin, self.most, self.is_whole = 0.05, 9, False
        self.decades: tuple[Sequence[float], int] | None = None  # of a logarithmic axis
        self.stated: Ticks | None = None
        self.is_far = False  # labels are on the other side
        self.label = ""
        self.length = 200.0  # [pt]

    def include(self, values: Any) -> None:
        """Widen the limits to values."""
        known = np.asarray(values, dtype=float)
        known = known[np.isfinite(known)]
        if known.size:
            self.values += [float(known.min()), float(known.max())]

    @property
    def limits(self) -> tuple[float, float]:
        """Both ends of the axis."""
        values = [v for v in self.values if v > 0.0 or self.decades is None] or [0.0, 1.0]
        low, high = min(values), max(values)
        if self.decades is not None:
            low, high = math.log10(low), math.log10(high)
        room = self.margin * (high - low) or 0.05 * max(abs(high), 0.02)
        low, high = low if low == self.floor else low - room, high + room
        if self.decades is not None:
            low, high = 10.0**low, 10.0**high
        start, end = self.fixed
        return (low if start is None else start, high if end is None else end)

    def fix(self, low: Any = None, high: Any = None, **ends: Any) -> None:
        """Fix the ends that are stated, also by the words of matplotlib."""
        low, high = (
            ends.get(a, ends.get(b, value))
            for a, b, value in (("left", "bottom", low), ("right", "top", high))
        )
        self.fixed = [o if n is None else n for n, o in zip((low, high), self.fixed, strict=True)]

    def state_ticks(self, places: Any, labels: Any = None, **how: Any) -> None:
        """Write names at places; numbers without names."""
        places = [float(place) for place in places]
        labels = word_ticks(places) if labels is None else list(labels)
        size = how.get("fontsize", TICK_SIZE)
        self.stated = Ticks(places, labels, how.get("rotation", 0.0), size)

    def get_view_interval(self) -> tuple[float, float]:
        """Return both ends of the axis, as matplotlib names it."""
        return self.limits

    def scale_logarithmically(self, numbers: Sequence[float], decades: int) -> None:
        """Make the axis logarithmic; arguments as of the function of `style`."""
        self.decades = (numbers, decades)

    def label_sparsely(self, most: int, is_whole: bool) -> None:
        """Write at most so many numbers."""
        self.most, self.is_whole = most, is_whole

    def tick_right(self) -> None:
        """Write the numbers at the other side."""
        self.is_far = True

    def locate(self, values: Any) -> FloatArray:
        """Return values as shares of the axis."""
        low, high = self.limits
        values = np.asarray(values, dtype=float)
        if self.decades is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                values, low, high = np.log10(values), math.log10(low), math.log10(high)
        return (values - low) / ((high - low) or 1.0)

    def list_ticks(self) -> Ticks:
        """Return the numbers at the axis."""
        low, high = sorted(self.limits)
        if self.stated is not None:
            return self.stated
        if self.decades is None:
            space = self.length / (TICK_SIZE * (3.0 if self.axis_name == "x" else 2.0))
            places = choose_ticks(low, high, min(self.most, max(space, 1.0)), self.is_whole)
            return Ticks(places, word_ticks(places))
        numbers, decades = self.decades
        first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
        is_short = high < 100.0 * low
        if decades and not (is_short and numbers):
            step = -(-(last - first) // decades)
            places = [10.0**power for power in range(first, last + 1, max(step, 1))]
        elif high > 3.0 * low:
            subs = numbers if is_short else (1.0,)
            places = [n * 10.0**power for power in range(first, last + 1) for n in subs]
        else:
            places = choose_ticks(low, high, 6)
        places = [place for place in places if low * 0.9999 <= place <= high * 1.0001]
        return Ticks(places, [f"{place:g}" for place in places])


class Colors(NamedTuple):
    """A scale of colors of what was drawn."""

    name: str
    low: float
    high: float

    def pick(self, values: FloatArray) -> FloatArray:
        """Return the colors (.., 3) of values."""
        return pick_colors(self.name, (values - self.low) / ((self.high - self.low) or 1.0))


class ColorBar:
    """The scale of colors at the right of axes."""

    def __init__(self, colors: Colors, shrink: float) -> None:
        self.colors, self.shrink, self.label = colors, shrink, ""
        self.ax = self.solids = self
        places = choose_ticks(colors.low, colors.high, 8)
        self.ticks = Ticks(places, word_ticks(places))
        self.width = 2.5 * GAP + BAR + TICK + self.ticks.measure()[0] + 1.4 * LABEL_SIZE

    def set_label(self, label: str, **_: Any) -> None:
        """Set the words beside the scale."""
        self.label = label

    def tick_params(self, *_: Any, **__: Any) -> None:
        """Leave as it is what is the same in all figures of pages."""

    set_alpha = tick_params

    def draw(self, x: float, y: float, height: float, name: str) -> Iterator[str]:
        """Yield the scale at x, in the middle of a height that begins at y [pt]."""
        x, y, height = x + 2.0 * GAP, y + 0.5 * (1.0 - self.shrink) * height, self.shrink * height
        stops = "".join(
            _write("stop", offset=f"{share:.1f}", stop_color=name_color(color))
            for share, color in zip(
                np.linspace(0, 1, 11), COLOR_MAPS[self.colors.name], strict=True
            )
        )
        yield _write("linearGradient", stops, id=name, x1="0", y1="1", x2="0", y2="0")
        box = {"x": f"{x:.2f}", "y": f"{y:.2f}", "width": BAR, "height": f"{height:.2f}"}
        yield _write("rect", fill=f"url(#{name})", stroke=BLACK, stroke_width=0.8, **box)
        span = (self.colors.high - self.colors.low) or 1.0
        for place, label in zip(self.ticks.places, self.ticks.labels, strict=True):
            at = y + height * (1.0 - (place - self.colors.low) / span)
            yield _write(
                "path", d=f"M{x + BAR:.2f} {at:.2f}h{TICK}", stroke=BLACK, stroke_width=0.8
            )
            yield from draw_text(x + BAR + TICK + GAP, at, label, TICK_SIZE, ha="left")
        right = x + self.width - 2.0 * GAP - 0.5 * LABEL_SIZE
        yield from draw_text(right, y + 0.5 * height, self.label, LABEL_SIZE, rotation=90.0)


class PageAxes:
    """A panel of a figure; methods as of the axes of matplotlib."""

    name = "rectilinear"

    def __init__(self, figure: PageFigure, cell: tuple[slice, slice]) -> None:
        self.figure, self.cell = figure, cell
        self.ends = {axis: PageAxis(axis, self) for axis in "xyz"}
        self.xaxis, self.yaxis = self.ends["x"], self.ends["y"]
        self.items: list[tuple[float, bool, Callable[[], Iterable[str]]]] = []
        self.title = ""
        self.has_grid, self.shows_names, self.face = False, True, "#ffffff"
        self.aspect = "auto"
        self.box = (0.0, 0.0, 1.0, 1.0)  # x, y of the upper left corner, width, height [pt]
        self.color_bar: ColorBar | None = None

    def _add(
        self, draw: Callable[[], Iterable[str]], zorder: float, *, is_clipped: bool = True
    ) -> None:
        self.items.append((zorder, is_clipped, draw))

    def place(self, x: Any, y: Any) -> tuple[FloatArray, FloatArray]:
        """Return points [pt] of values."""
        left, top, width, height = self.box
        return left + width * self.xaxis.locate(x), top + height * (1.0 - self.yaxis.locate(y))

    def plot(self, x: Any, y: Any, form: str = "", *, zorder: float = 2.0, **words: Any) -> None:
        """Draw a line or markers; of a table one line for each column."""
        x, y = np.atleast_1d(np.asarray(x, float)), np.atleast_1d(np.asarray(y, float))
        self.xaxis.include(x)
        self.yaxis.include(y)
        style = read_style(form, **words)
        for column in y.T if y.ndim > 1 else (y,):
            self._add(lambda y=column: draw_line(*self.place(x, y), style), zorder)

    def _draw_across(
        self, axis: int, value: float, zorder: float, words: Mapping[str, Any]
    ) -> None:
        (self.yaxis, self.xaxis)[axis].include(value)
        style = read_style(**words)

        def draw() -> Iterator[str]:
            left, top, width, height = self.box
            x, y = (float(v) for v in self.place(*((np.nan, value), (value, np.nan))[axis]))
            d = (f"M{left:.2f} {y:.2f}h{width:.2f}", f"M{x:.2f} {top:.2f}v{height:.2f}")[axis]
            yield draw_path(d, style)

        self._add(draw, zorder)

    def axhline(self, y: float, *, zorder: float = 2.0, **words: Any) -> None:
        """Draw a line from left to right."""
        self._draw_across(0, y, zorder, words)

    def axvline(self, x: float, *, zorder: float = 2.0, **words: Any) -> None:
        """Draw a line from bottom to top."""
        self._draw_across(1, x, zorder, words)

    def hlines(self, y: Any, low: Any, high: Any, **words: Any) -> None:
        """Draw a line at y between two ends."""
        self.plot([low, high], [y, y], **words)

    def vlines(self, x: Any, low: Any, high: Any, **words: Any) -> None:
        """Draw a line at x between two ends."""
        self.plot([x, x], [low, high], **words)

    def _draw_boxes(self, x: Any, y: Any, zorder: float, **words: Any) -> None:
        """Draw rectangles between ends x (n, 2) and y (n, 2); None are those of the axes."""
        fill = name_color(words.get("fc", words.get("color", COLORED)))
        edge = words.get("ec")

        def draw() -> Iterator[str]:
            left, top, width, height = self.box
            a = np.array([[left, left + width]]) if x is None else self.place(x, 0.0)[0]
            b = np.array([[top + height, top]]) if y is None else self.place(0.0, y)[1]
            for (x1, x2), (y1, y2) in zip(a.tolist(), b.tolist(), strict=True):
                yield _write(
                    "rect", x=f"{min(x1, x2):.2f}", y=f"{min(y1, y2):.2f}",
                    width=f"{abs(x2 - x1):.2f}", height=f"{abs(y2 - y1):.2f}", fill=fill,
                    fill_opacity=words.get("alpha"), stroke=edge and name_color(edge),
                )  # fmt: skip

        self._add(draw, zorder)

    def axvspan(self, low: float, high: float, *, zorder: float = 1.0, **words: Any) -> None:
        """Fill the axes between two values of x."""
        self.xaxis.include([low, high])
        self._draw_boxes(np.array([[low, high]]), None, zorder, **words)

    def bar(self, x: Any, height: Any, width: float = 0.8, **words: Any) -> None:
        """Draw bars that begin at zero."""
        x, height = np.atleast_1d(x).astype(float), np.atleast_1d(height).astype(float)
        self.xaxis.include([x - 0.5 * width, x + 0.5 * width])
        self.yaxis.include(np.append(height, 0.0))
        self.yaxis.floor = 0.0
        sides, zero = np.stack([x - 0.5 * width, x + 0.5 * width], axis=1), np.zeros(len(x))
        self._draw_boxes(sides, np.stack([zero, height], axis=1), 1.0, **words)

    def barh(self, y: Any, length: Any, *, height: float = 0.8, **words: Any) -> None:
        """Draw bars from the left that begin at zero."""
        y, length = np.asarray(y, float), np.asarray(length, float)
        self.yaxis.include([y - 0.5 * height, y + 0.5 * height])
        self.xaxis.include(np.append(length, 0.0))
        sides, zero = np.stack([y - 0.5 * height, y + 0.5 * height], axis=1), np.zeros(len(y))
        self._draw_boxes(np.stack([zero, length], axis=1), sides, 1.0, **words)

    def hist(self, values: Any, edges: Any, *, density: bool, **words: Any) -> None:
        """Draw the density of values, or their numbers, between edges."""
        counts, edges = np.histogram(values, edges, density=density and len(values) > 0)
        self.xaxis.include(edges)
        self.yaxis.include(np.append(counts, 0.0))
        self.yaxis.floor = 0.0
        heights = np.stack([np.zeros(len(counts)), counts], axis=1)
        self._draw_boxes(np.stack([edges[:-1], edges[1:]], axis=1), heights, 1.0, **words)

    def errorbar(self, x: Any, y: Any, xerr: Any, *, fmt: str = "", **words: Any) -> None:
        """Draw markers with horizontal intervals; xerr : half-widths, or those below and above."""
        x, y, half = (np.atleast_1d(np.asarray(v, float)) for v in (x, y, xerr))
        width, cap = words.pop("elinewidth", words.get("lw", 1.5)), words.pop("capsize", 0.0)
        low, high = (x - half, x + half) if half.ndim == 1 else (x - half[0], x + half[1])
        words = {"ls": "none", **words} if fmt else words
        style = read_style(ls="-", color=words["color"], lw=width)
        self.xaxis.include([low, high])

        def draw() -> Iterator[str]:
            (left, place), (right, _) = self.place(low, y), self.place(high, y)
            ends = zip(_join(left), _join(right), place.tolist(), strict=True)
            end = f"m0 {-cap:g}v{2.0 * cap:g}" if cap else ""
            lines = (
                f"M{a} {b:.2f}{end}M{a} {b:.2f}H{c}{end}" for a, c, b in ends if "n" not in a + c
            )
            yield draw_path("".join(lines), style)

        if len(x):
            self._add(draw, 2.0)
        self.plot(x, y, fmt, **words)

    def scatter(
        self, x: Any, y: Any, *, s: float = 36.0, c: Any = None, zorder: float = 1.0, **words: Any
    ) -> Colors | None:
        """Draw markers of an area, in the colors of numbers c; return their scale."""
        self.xaxis.include(x)
        self.yaxis.include(y)
        scale, draw = _color_markers(lambda: self.place(x, y), s, c, words)
        self._add(draw, zorder)
        return scale

    def imshow(
        self, values: FloatArray, *, cmap: str, vmin: float, vmax: float, **_: Any
    ) -> Colors:
        """Draw a matrix as a picture, the first row on top; return its scale of colors."""
        rows, columns = values.shape
        scale = Colors(cmap, vmin, vmax)
        self.xaxis.fixed, self.yaxis.fixed = [-0.5, columns - 0.5], [rows - 0.5, -0.5]
        self.aspect = "box"

        def draw() -> Iterator[str]:
            blank = int(self.face[1:], 16)
            empty = [blank >> 16, blank >> 8 & 255, blank & 255]
            colors = np.where(
                np.isfinite(values)[..., None], scale.pick(np.nan_to_num(values)), empty
            )
            yield draw_image(colors, *self.box)

        self._add(draw, 0.0)
        return scale

    def annotate(
        self,
        text: str,
        xy: Any,
        xytext: Any = (0.0, 0.0),
        xycoords: Any = "data",
        *_: Any,
        **how: Any,
    ) -> None:
        """Write a text at a value, moved by points; with other coordinates, at a share of y."""
        size, place = how.get("fontsize", TITLE_SIZE), {"ha": "left", "va": "baseline"}
        place |= {key: how[key] for key in ("ha", "va", "rotation") if key in how}
        place["color"] = name_color(how.get("color", BLACK))

        def draw() -> Iterator[str]:
            x, y = (float(v) for v in self.place(*xy))
            y = y if xycoords == "data" else self.box[1] + self.box[3] * (1.0 - xy[1])
            x, y = x + xytext[0], y - xytext[1]
            if "bbox" in how:
                width = measure_text(text, size) + 2.0
                yield _write(
                    "rect", x=f"{x - 0.5 * width:.2f}", y=f"{y - 0.6 * size:.2f}", rx=1.5,
                    width=f"{width:.2f}", height=f"{1.2 * size:.2f}", fill="#ffffff",
                    fill_opacity=how["bbox"]["alpha"],
                )  # fmt: skip
            yield from draw_text(x, y, text, size, **place)

        self._add(draw, how.get("zorder", 3.0), is_clipped=False)

    # --- Limits, numbers and words.

    def __getattr__(self, name: str) -> Any:
        """Return `set_xlim`, `get_ylim`, `set_zlabel`, `set_xticks` and the like."""
        verb, _, what = name.partition("_")
        axis = vars(self).get("ends", {}).get(what[:1])
        methods = {
            "get_lim": lambda: axis.limits,
            "set_lim": lambda low=None, high=None, **ends: axis.fix(low, high, **ends),
            "set_label": lambda label, **_: setattr(axis, "label", label),
            "set_ticks": axis and axis.state_ticks,
        }
        if axis is None or (kind := f"{verb}_{what[1:]}") not in methods:
            raise AttributeError(name)
        return methods[kind]

    def set_title(self, title: str, **_: Any) -> None:
        """Write a title above the axes."""
        self.title = title

    def set_facecolor(self, color: str) -> None:
        """Set the color behind everything."""
        self.face = name_color(color)

    def set_aspect(self, _aspect: str, adjustable: str = "box") -> None:
        """Draw x and y in equal scale."""
        self.aspect = adjustable

    def margins(self, both: float | None = None, *, y: float | None = None) -> None:
        """Set the room around what is drawn, as a share."""
        self.xaxis.margin = self.xaxis.margin if both is None else both
        self.yaxis.margin = y if both is None and y is not None else both or self.yaxis.margin

    def update_datalim(self, points: Any) -> None:
        """Widen the limits to points (n, 2)."""
        self.xaxis.include(np.asarray(points)[:, 0])
        self.yaxis.include(np.asarray(points)[:, 1])

    def grid(self, **_: Any) -> None:
        """Draw lines at the numbers."""
        self.has_grid = True

    def tick_params(self, *_: Any, **__: Any) -> None:
        """Leave as it is what is the same in all figures of pages."""

    autoscale_view = set_axisbelow = tick_params

    # --- Writing.

    def measure(self) -> tuple[float, float, float, float]:
        """Return the room that words take at the left, top, right and bottom [pt]."""
        across, down = self.yaxis.list_ticks(), self.xaxis.list_ticks()
        side = across.measure()[0] * self.shows_names
        side += (TICK + GAP) * bool(across.labels)
        left = 0.0 if self.yaxis.is_far else side
        right = side if self.yaxis.is_far else 0.0
        left += (LABEL_SIZE * LINE_HEIGHT + GAP) * bool(self.ends["y"].label)
        bottom = (TICK + GAP + down.measure()[1]) * bool(down.labels)
        bottom += (LABEL_SIZE * LINE_HEIGHT + 1.0) * bool(self.xaxis.label)
        right += 0.0 if self.color_bar is None else self.color_bar.width
        if down.labels and not down.rotation:  # the outermost numbers
            right = max(right, 0.5 * measure_text(down.labels[-1], down.size))
        top = (LABEL_SIZE * LINE_HEIGHT * (1 + self.title.count("\n")) + GAP) * bool(self.title)
        return left, top, right, bottom

    def fit_aspect(self) -> None:
        """Make the scales of x and y equal: by the limits, or by the size of the axes."""
        x, y, width, height = self.box
        self.xaxis.length, self.yaxis.length = width, height
        if self.aspect == "auto":
            return
        (left, right), (bottom, top) = self.xaxis.limits, self.yaxis.limits
        across, up = abs(right - left) / width, abs(top - bottom) / height
        if self.aspect == "box":
            scale = max(across, up)
            fitted = abs(right - left) / scale, abs(top - bottom) / scale
            self.box = (x + 0.5 * (width - fitted[0]), y + 0.5 * (height - fitted[1]), *fitted)
        elif across < up:
            middle, half = 0.5 * (left + right), 0.5 * up * width
            self.xaxis.fixed = [middle - half, middle + half]
        else:
            middle, half = 0.5 * (bottom + top), 0.5 * across * height
            self.yaxis.fixed = [middle - half, middle + half]

    def write(self, name: str) -> Iterator[str]:
        """Yield the elements of the axes; name : prefix of their identifiers."""
        x, y, width, height = self.box
        box = {"x": f"{x:.2f}", "y": f"{y:.2f}", "width": f"{width:.2f}", "height": f"{height:.2f}"}
        yield _write("clipPath", _write("rect", **box), id=f"{name}-clip")
        yield _write("rect", fill=self.face, **box)
        down, across = self.xaxis.list_ticks(), self.yaxis.list_ticks()
        columns, rows = self.place(down.places, 0.0)[0], self.place(0.0, across.places)[1]
        if self.has_grid:
            lines = [f"M{a} {y:.2f}v{height:.2f}" for a in _join(columns)]
            lines += [f"M{x:.2f} {b}h{width:.2f}" for b in _join(rows)]
            yield _write("path", d="".join(lines), stroke=GRID_COLOR, stroke_width=0.3)
        ordered = sorted(self.items, key=lambda item: item[0])
        drawn = "".join(part for _, is_clipped, draw in ordered if is_clipped for part in draw())
        yield _write("g", drawn, clip_path=f"url(#{name}-clip)")
        end = x + width if self.yaxis.is_far else x
        out = 1.0 if self.yaxis.is_far else -1.0
        marks = [f"M{a} {y + height:.2f}v{TICK}" for a in _join(columns)]
        marks += [f"M{end:.2f} {b}h{out * TICK}" for b in _join(rows)]
        yield _write("path", d="".join(marks), stroke=BLACK, stroke_width=0.8)
        yield _write("rect", fill="none", stroke=BLACK, stroke_width=0.8, **box)
        for _, is_clipped, draw in ordered:
            if not is_clipped:
                yield from draw()
        below = y + height + TICK + GAP
        for a, label in zip(columns.tolist(), down.labels, strict=True):
            ha, va = ("right", "center") if down.rotation else ("center", "top")
            how = {"ha": ha, "va": va, "rotation": down.rotation}
            yield from draw_text(a, below, label, down.size, **how)
        if self.shows_names:
            at = end + out * (TICK + GAP)
            side = "left" if self.yaxis.is_far else "right"
            for b, label in zip(rows.tolist(), across.labels, strict=True):
                yield from draw_text(at, b, label, across.size, ha=side)
        left, _, _, bottom = self.measure()
        middle = x + 0.5 * width, y + 0.5 * height
        if self.xaxis.label:
            place = y + height + bottom - 0.6 * LABEL_SIZE
            yield from draw_text(middle[0], place, self.xaxis.label, LABEL_SIZE)
        if self.ends["y"].label:
            place = x - left + 0.6 * LABEL_SIZE
            yield from draw_text(place, middle[1], self.ends["y"].label, LABEL_SIZE, rotation=90.0)
        if self.title:
            yield from draw_text(middle[0], y - GAP, self.title, LABEL_SIZE, va="bottom")
        if self.color_bar is not None:
            right = x + width + self.measure()[2] - self.color_bar.width
            yield from self.color_bar.draw(right, y, height, f"{name}-colors")


COLORED = "#0072b2"
"""Color of what has none."""


def _color_markers(
    place: Callable[[], tuple[FloatArray, FloatArray]],
    area: float,
    values: Any,
    words: Mapping[str, Any],
) -> tuple[Colors | None, Callable[[], Iterator[str]]]:
    """Return the scale of colors, and a function that draws markers at places [pt]."""
    marker, width = words.get("marker", "o"), words.get("lw", 1.0)
    edge = name_color(words["ec"]) if "ec" in words else "none"
    shape = _make_marker(marker, 0.5 * math.sqrt(area))
    scale = fills = None
    if values is not None:
        values = np.asarray(values, float)
        low = words.get("vmin", float(np.nanmin(values)) if values.size else 0.0)
        high = words.get("vmax", float(np.nanmax(values)) if values.size else 1.0)
        scale = Colors(words["cmap"], low, high)
        fills = [name_color(color) for color in scale.pick(values).tolist()]

    def draw() -> Iterator[str]:
        x, y = place()
        alike: dict[str, list[str]] = {}
        for k, (a, b) in enumerate(zip(_join(x), _join(y), strict=True)):
            alike.setdefault(fills[k] if fills else "none", []).append(f"M{a} {b}{shape}")
        for fill, parts in alike.items():
            yield _write(
                "path", d="".join(parts), fill=fill, stroke=edge, stroke_width=width,
                opacity=words.get("alpha"),
            )  # fmt: skip

    return scale, draw


class Handle(NamedTuple):
    """An entry of a legend: a line with a marker, or an area."""

    label: str
    style: Style
    is_area: bool = False

    def get_label(self) -> str:
        """Return the words."""
        return self.label

    def draw(self, x: float, y: float) -> Iterator[str]:
        """Yield the sample at x, in the middle of a line of text at y [pt]."""
        if self.is_area:
            box = {"x": f"{x:.2f}", "y": f"{y - 3.0:.2f}", "width": SAMPLE, "height": 6}
            yield _write("rect", fill=self.style.color, **box)
            return
        ends = np.array([x, x + SAMPLE]), np.array([y, y])
        yield from draw_line(*ends, self.style._replace(marker=""))
        if self.style.marker:
            yield draw_markers(np.array([x + 0.5 * SAMPLE]), np.array([y]), self.style)


SAMPLE, BETWEEN = 16.0, 14.0
"""Length of a sample in a legend, and space between its columns [pt]."""


class Grid(NamedTuple):
    """Rows and columns of panels, with their relative sizes."""

    heights: Sequence[float]
    widths: Sequence[float]


class PageFigure:
    """A figure of a page; methods as of a figure of matplotlib."""

    def __init__(self, width: float, height: float) -> None:
        self.size = (width, height)  # [inch]
        self.grid = Grid((1.0,), (1.0,))
        self.axes: list[Any] = []
        self.title, self.handles, self.columns = "", [], 1

    def get_size_inches(self) -> tuple[float, float]:
        """Return width and height [inch]."""
        return self.size

    def add_gridspec(self, rows: int, columns: int, **how: Any) -> Any:
        """Divide the figure into panels of relative sizes."""
        heights, widths = how.get("height_ratios"), how.get("width_ratios")
        self.grid = Grid(heights or [1.0] * rows, widths or [1.0] * columns)
        return _Cells(self.grid)

    def add_subplot(self, *place: Any, projection: str | None = None) -> Any:
        """Return new axes: in a cell, or rows, columns and number, or the whole figure."""
        if len(place) == 3:
            rows, columns, number = place
            self.add_gridspec(rows, columns)
            row, column = divmod(number - 1, columns)
            cell = slice(row, row + 1), slice(column, column + 1)
        else:
            cell = place[0] if place else (slice(0, 1), slice(0, 1))
        kind = PageAxes if projection is None else SpaceAxes
        self.axes.append(kind(self, cell))
        return self.axes[-1]

    def subplots(
        self, rows: int, columns: int, *, sharey: bool = False, gridspec_kw: Any = None, **how: Any
    ) -> FloatArray:
        """Return axes (rows, columns); with `sharey` those of a row have one y axis."""
        self.add_gridspec(rows, columns, **how, **(gridspec_kw or {}))
        panels: Any = np.empty((rows, columns), dtype=object)
        for row in range(rows):
            for column in range(columns):
                axes = self.add_subplot((slice(row, row + 1), slice(column, column + 1)))
                panels[row, column] = axes
                if sharey and column:
                    axes.yaxis, axes.shows_names = panels[row, 0].yaxis, False
                    axes.ends["y"] = PageAxis("y", axes)  # with its own label
        return panels

    def suptitle(self, title: str, **_: Any) -> None:
        """Write a title above everything."""
        self.title = title

    def legend(self, handles: Sequence[Handle], ncols: int, **_: Any) -> None:
        """Write a legend below everything."""
        self.handles, self.columns = list(handles), ncols

    def colorbar(self, drawn: Colors, ax: Any, *, shrink: float = 1.0, **_: Any) -> ColorBar:
        """Write the scale of colors at the right of axes, or of the last of several."""
        axes = ax[-1] if isinstance(ax, list) else ax
        axes.color_bar = ColorBar(drawn, shrink)
        return axes.color_bar

    def findobj(self, _kind: Any) -> list[Any]:
        """Return nothing: texts are written as they are."""
        return []

    def _arrange(self, top: float, bottom: float) -> None:
        """Place the axes between the title and the legend [pt]."""
        width = 72.0 * self.size[0]
        n = len(self.grid.heights), len(self.grid.widths)
        before, after = ([np.zeros(n[axis]) for axis in (0, 1)] for _ in range(2))
        for axes in self.axes:
            left, above, right, below = axes.measure()
            for axis, (first, last) in enumerate(((above, below), (left, right))):
                start, end = axes.cell[axis].start, axes.cell[axis].stop - 1
                before[axis][start] = max(before[axis][start], first)
                after[axis][end] = max(after[axis][end], last)
        places = []
        for axis, (start, end) in enumerate(((top, bottom), (PAD, width - PAD))):
            ratios = np.array((self.grid.heights, self.grid.widths)[axis])
            room = end - start - before[axis].sum() - after[axis].sum() - PAD * (n[axis] - 1)
            inner = max(room, 10.0) * ratios / ratios.sum()
            steps = before[axis] + inner + after[axis] + PAD
            first = start + np.concatenate([[0.0], np.cumsum(steps)[:-1]]) + before[axis]
            places.append((first, first + inner))
        for axes in self.axes:
            (y1, y2), (x1, x2) = (
                (float(place[0][cell.start]), float(place[1][cell.stop - 1]))
                for place, cell in zip(places, axes.cell, strict=True)
            )
            axes.box = (x1, y1, x2 - x1, y2 - y1)
            axes.fit_aspect()

    def _draw_legend(self, bottom: float) -> Iterator[str]:
        """Yield the entries of the legend, in lines that end at the bottom [pt]."""
        if not self.handles:
            return
        rows = -(-len(self.handles) // self.columns)
        columns = [self.handles[i * rows : (i + 1) * rows] for i in range(self.columns)]
        widths = [
            SAMPLE + GAP + max((measure_text(h.label, TICK_SIZE) for h in column), default=0.0)
            for column in columns
        ]
        x = 0.5 * (72.0 * self.size[0] - sum(widths) - BETWEEN * (len(widths) - 1))
        for column, width in zip(columns, widths, strict=True):
            for k, handle in enumerate(column):
                y = bottom - (rows - k - 0.5) * 1.5 * TICK_SIZE
                yield from handle.draw(x, y)
                yield from draw_text(x + SAMPLE + GAP, y, handle.label, TICK_SIZE, ha="left")
            x += width + BETWEEN

    def write_svg(self, name: str) -> str:
        """Return the figure as SVG elements for HTML; name : prefix of all identifiers."""
        width, height = (72.0 * inches for inches in self.size)
        top = PAD + (1 + self.title.count("\n")) * LINE_HEIGHT * TITLE_SIZE * bool(self.title)
        rows = -(-len(self.handles) // self.columns) if self.handles else 0
        bottom = height - 0.6 * PAD - rows * 1.5 * TICK_SIZE
        for _ in range(2):  # axes of another size have other numbers
            self._arrange(top, bottom - 0.3 * PAD)
        parts = [_write("rect", width=f"{width:g}", height=f"{height:g}", fill="#ffffff")]
        parts += draw_text(0.5 * width, 0.6 * PAD, self.title, TITLE_SIZE, va="top")
        for k, axes in enumerate(self.axes):
            parts += axes.write(f"{name}-{k}")
        parts += self._draw_legend(bottom + rows * 1.5 * TICK_SIZE)
        return _write(
            "svg", "".join(parts), width=f"{width:g}pt", viewBox=f"0 0 {width:g} {height:g}",
            font_family=FAMILY, stroke_linejoin="round", role="img",
            aria_labelledby=f"{name}-description", focusable="false",
        )  # fmt: skip


class _Cells:
    """The cells of a grid, by rows and columns."""

    def __init__(self, grid: Grid) -> None:
        self.grid = grid

    def __getitem__(self, index: tuple[Any, Any]) -> tuple[slice, slice]:
        sizes = len(self.grid.heights), len(self.grid.widths)
        row, column = (
            slice(*i.indices(n)) if isinstance(i, slice) else slice(i, i + 1)
            for i, n in zip(index, sizes, strict=True)
        )
        return slice(row.start, row.stop), slice(column.start, column.stop)


DISTANCE = 10.0
"""Distance of the eye from the middle of a picture in space, in diagonals of its box."""


class SpaceAxes(PageAxes):
    """Axes in space, in perspective; methods as of `mplot3d`."""

    name = "3d"

    def __init__(self, figure: PageFigure, cell: tuple[slice, slice]) -> None:
        super().__init__(figure, cell)
        self.spans, self.angles = np.ones(3), (0.4, -1.0)
        self.scale, self.middle = 1.0, (0.0, 0.0)

    def _project(self, points: FloatArray) -> FloatArray:
        """Return places (n, 2) and depth (n, 1) of points (n, 3) before they are scaled."""
        low, high = np.array([self.ends[axis].limits for axis in "xyz"]).T
        unit = ((points - low) / (high - low) - 0.5) * self.spans / np.linalg.norm(self.spans)
        (up, around) = self.angles
        c, s = math.cos(around), math.sin(around)
        right = unit @ np.array([-s, c, 0.0])
        top = unit @ np.array([-math.sin(up) * c, -math.sin(up) * s, math.cos(up)])
        depth = unit @ np.array([math.cos(up) * c, math.cos(up) * s, math.sin(up)])
        near = DISTANCE / (DISTANCE - depth)
        return np.stack([right * near, -top * near, depth], axis=1)

    def locate(self, *xyz: Any) -> tuple[FloatArray, FloatArray]:
        """Return points [pt] of values in space."""
        points = np.stack([np.atleast_1d(np.asarray(v, float)) for v in xyz], axis=1)
        places = self._project(points)
        return (self.middle[0] + self.scale * places[:, 0],
                self.middle[1] + self.scale * places[:, 1])  # fmt: skip

    def plot(  # type: ignore[override]
        self, x: Any, y: Any, z: Any, form: str = "", *, zorder: float = 2.0, **words: Any
    ) -> None:
        """Draw a line or markers."""
        style = read_style(form, **words)
        for axis, values in zip("xyz", (x, y, z), strict=True):
            self.ends[axis].include(values)
        self._add(lambda: draw_line(*self.locate(x, y, z), style), zorder)

    def scatter(  # type: ignore[override]
        self, x: Any, y: Any, z: Any, *, s: float, c: Any, zorder: float = 1.0, **words: Any
    ) -> Colors | None:
        """Draw markers in the colors of numbers c; return their scale."""
        scale, draw = _color_markers(lambda: self.locate(x, y, z), s, c, words)
        self._add(draw, zorder)
        return scale

    def text(
        self, x: float, y: float, z: float, text: str, *, fontsize: float, color: str, zorder: float
    ) -> None:
        """Write a text beside a point."""

        def draw() -> Iterator[str]:
            a, b = (float(v[0]) for v in self.locate(x, y, z))
            how = {"ha": "left", "va": "bottom", "color": color}
            yield from draw_text(a + GAP, b, text.strip(), fontsize, **how)

        self._add(draw, zorder, is_clipped=False)

    def view_init(self, elev: float, azim: float) -> None:
        """Choose the direction of the eye [deg]."""
        self.angles = (math.radians(elev), math.radians(azim))

    def set_box_aspect(self, spans: Any, **_: Any) -> None:
        """Set the lengths of the edges of the box."""
        self.spans = np.asarray(spans, float)

    def locator_params(self, nbins: int) -> None:
        """Write at most so many numbers at each axis."""
        for axis in self.ends.values():
            axis.most = nbins

    def measure(self) -> tuple[float, float, float, float]:
        """Return the room that the title takes; that of numbers is inside the box."""
        return 0.0, (LABEL_SIZE * LINE_HEIGHT + GAP) * bool(self.title), 0.0, 0.0

    def fit_aspect(self) -> None:
        """Fill the panel with the box."""
        x, y, width, height = self.box
        corners = np.array(np.meshgrid(*(self.ends[axis].limits for axis in "xyz"))).reshape(3, -1)
        places = self._project(corners.T)[:, :2]
        low, high = places.min(axis=0), places.max(axis=0)
        room = 4.5 * LABEL_SIZE
        self.scale = min((width - room) / (high[0] - low[0]), (height - room) / (high[1] - low[1]))
        middle = np.array([x + 0.5 * width, y + 0.5 * height]) - 0.5 * self.scale * (low + high)
        self.middle = (float(middle[0]), float(middle[1]))

    def write(self, name: str) -> Iterator[str]:  # nothing has an identifier
        """Yield the three planes behind everything, with numbers, then what is drawn."""
        limits = np.array([self.ends[axis].limits for axis in "xyz"])  # (3, 2)
        up, around = self.angles
        is_high = np.array([math.cos(around) > 0.0, math.sin(around) > 0.0, math.sin(up) > 0.0])
        near, far = limits[range(3), is_high.astype(int)], limits[range(3), 1 - is_high.astype(int)]
        center = np.array([v[0] for v in self.locate(*limits.mean(axis=1))])
        for normal in range(3):
            a, b = (axis for axis in range(3) if axis != normal)
            corners = np.tile(far, (4, 1))
            corners[[1, 2], a], corners[[2, 3], b] = near[a], near[b]
            places = [f"{p} {q}" for p, q in zip(*map(_join, self.locate(*corners.T)), strict=True)]
            yield _write("path", d="M" + "L".join(places) + "z", fill="#f5f5f5", stroke=GRID_COLOR)
        lines, words = [], []
        for i, axis in enumerate("xyz"):
            ticks = self.ends[axis].list_ticks()
            j, k = (n for n in range(3) if n != i)
            # the edge with the numbers, and the two lines from it over planes
            edge = np.tile(far, (len(ticks.places), 1))
            edge[:, i] = ticks.places
            edge[:, 0 if i == 2 else j] = near[0 if i == 2 else j]
            if i == 2:
                edge[:, 1] = far[1]
            for other in (j, k):
                start, end = np.tile(far, (len(edge), 1)), np.tile(far, (len(edge), 1))
                start[:, i] = end[:, i] = ticks.places
                end[:, other] = near[other]
                pairs = [map(_join, self.locate(*points.T)) for points in (start, end)]
                (x1, y1), (x2, y2) = pairs
                lines += [f"M{a} {b}L{c} {d}" for a, b, c, d in zip(x1, y1, x2, y2, strict=True)]
            ends = np.stack([edge[0], edge[0]]) if len(edge) else np.stack([far, far])
            ends[:, i] = limits[i]
            first, last = np.array(self.locate(*ends.T)).T
            along = (last - first) / (np.linalg.norm(last - first) or 1.0)
            out = np.array([along[1], -along[0]])
            out *= 1.0 if out @ (0.5 * (first + last) - center) > 0.0 else -1.0
            at = np.array(self.locate(*edge.T)).T + 1.3 * TICK_SIZE * out
            for place, label in zip(at.tolist(), ticks.labels, strict=True):
                words += draw_text(*place, label, TICK_SIZE - 1.0)
            at = 0.5 * (first + last) + 3.2 * TICK_SIZE * out
            words += draw_text(*at.tolist(), self.ends[axis].label, LABEL_SIZE)
        yield _write("path", d="".join(lines), stroke=GRID_COLOR, stroke_width=0.3)
        for _, _, draw in sorted(self.items, key=lambda item: item[0]):
            yield from draw()
        yield from words
        x, y, width, _ = self.box
        if self.title:
            yield from draw_text(x + 0.5 * width, y - GAP, self.title, LABEL_SIZE, va="bottom")
