# SPDX-License-Identifier: Apache-2.0
"""Every limit of what a file may contain, and of counts on the command line, in two tables.

A limit lies far above what a machine needs, and low enough that a damaged or hostile file, or a
number with too many zeros, neither fills the memory nor takes minutes. It is checked before memory
is taken for what it limits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from loopcal.errors import FileError
from loopcal.findings import Finding, report_finding
from loopcal.mechanism import assembly
from loopcal.plain_text import escape, find_not_plain, name_character, quote

MEGABYTE = 10**6


@dataclass(frozen=True)
class FileLimit:
    """The most that a file may contain of one thing: `most` of it, in `unit`; sizes are in MB.

    `of` says what is limited, for documentation; `action` is what a user who meets the limit does.
    """

    of: str
    most: float
    unit: str
    action: str = ""

    def __str__(self) -> str:
        return f"{_format(self.most)} {self.unit}"

    @property
    def scale(self) -> int:
        """How many of what is counted a unit is: bytes, or one."""
        return MEGABYTE if self.unit == "MB" else 1

    @property
    def count(self) -> int:
        """The largest count that is allowed."""
        return round(self.most * self.scale)

    def make_error(
        self, what: str, path: str | Path, count: float | None = None, line: int | None = None
    ) -> FileError:
        """Return the error for a file beyond this limit; `count` is None where it is unknown."""
        finding = report_finding(
            "files.limit-exceeded",
            what=what,
            found=None if count is None else _format(math.ceil(100 * count / self.scale) / 100),
            most=_format(self.most),
            unit=self.unit,
            action=self.action,
        )
        return FileError(finding, path, line)

    def check(self, count: float, what: str, path: str | Path, line: int | None = None) -> None:
        """Raise FileError where a count is above this limit; see `make_error`."""
        if count > self.count:
            raise self.make_error(what, path, count, line)


def _format(value: float) -> str:
    """Return a number with two decimals at most, and commas between thousands."""
    text = f"{value:,.2f}"
    return text.rstrip("0").rstrip(".")


YAML_SIZE = FileLimit(
    "YAML text: robot files, settings, profiles, loop closures",
    1,
    "MB",
    "shorten its comments, or remove what does not belong there",
)
YAML_NODES = FileLimit(
    "keys, values and lists of YAML text, aliases written out",
    50_000,
    "values",
    "write less, or use fewer aliases",
)
YAML_DEPTH = FileLimit(
    "lists and mappings of YAML inside each other",
    50,
    "levels of nesting",
    "write it with fewer levels",
)
COPIES = FileLimit("`copies: {count: ..}` of a limb", assembly.MOST_COPIES, "copies")
LIMBS = FileLimit("limbs of a robot, copies included", assembly.MOST_LIMBS, "limbs")
JOINTS = FileLimit("joints of a limb (a universal joint: two)", assembly.MOST_JOINTS, "joints")
ACTUATORS = FileLimit("actuators of all limbs together", assembly.MOST_ACTUATORS, "actuators")
PARAMETERS = FileLimit(
    "parameters of a robot, fixed ones included", assembly.MOST_PARAMETERS, "parameters"
)
NAME_LENGTH = FileLimit(
    "names, and every other text of a YAML file", 200, "characters", "shorten it"
)
COMPOSED_LENGTH = FileLimit(
    "names such as `monday.tracker.x`, headers of columns, names of poses",
    1_000,
    "characters",
    "shorten it",
)
TEXT_LENGTH = FileLimit("`source` of a robot", 10_000, "characters", "shorten it")
TABLE_SIZE = FileLimit(
    "measurement files, exports, `result.json` of a run", 500, "MB", "divide it into several files"
)
TABLE_ROWS = FileLimit(
    "rows of a measurement file",
    2_000_000,
    "rows",
    "divide it into several files, or average repeated measurements",
)
TABLE_LINES = FileLimit(
    "lines of a measurement file, with remarks",
    5_000_000,
    "lines",
    "remove other lines, or divide it into several files",
)
TABLE_COLUMNS = FileLimit(
    "columns of a measurement file",
    1_000,
    "columns",
    "leave out columns that loopcal does not read",
)
LINE_LENGTH = FileLimit(
    "a line of a measurement file or an export",
    100_000,
    "characters in one line",
    "check that this is a table of text, one row in a line",
)
PATTERN_LENGTH = FileLimit(
    "a pattern of a profile (`match`, `ignore`)", 1_000, "characters", "write a shorter pattern"
)
PATTERN_COUNTS = FileLimit(
    "product of all counts in braces of a pattern: 8 for `\\d{4}-\\d{2}`",
    1_000,
    "repetitions",
    "write smaller counts, or `*` and `+`",
)
PATTERN_SECONDS = FileLimit(
    "the patterns of an export, and 0.1 ms more for each of its lines", 2, "seconds"
)
PROGRAM_SIZE = FileLimit(
    "files of other programs", 5, "MB", "check that this is the right file, or remove other content"
)
JSON_VALUES = FileLimit(
    "JSON of a run or of a cable robot, with keys",
    25_000_000,
    "values",
    "check that this is the file that was meant",
)
JSON_DEPTH = FileLimit(
    "lists and objects of JSON inside each other", 200, "levels of nesting", "simplify it"
)
XML_JOINTS = FileLimit(
    "joints of a URDF, fixed ones included",
    300,
    "joints",
    "leave out joints that belong to no loop",
)
XML_ELEMENTS = FileLimit(
    "elements of a URDF",
    20_000,
    "elements",
    "leave out what loopcal does not read, such as visuals",
)
XML_DEPTH = FileLimit(
    "elements of a URDF inside each other",
    50,
    "levels of nesting",
    "check that this is the file that was meant",
)
ARRAYS_SIZE = FileLimit(
    "`arrays.npz` of a run folder", 4_000, "MB", "repeat the calibration with fewer poses"
)
ARRAYS_COUNT = FileLimit("arrays in `arrays.npz`", 1_000, "arrays", "repeat the calibration")
UPLOAD_SIZE = FileLimit("a file of `loopcal app`", 50, "MB", "divide it")
UPLOADS = FileLimit("files of `loopcal app`", 50, "files", "remove one")

# All limits, in the order of docs/files.md.
LIMITS = tuple(value for value in vars().values() if isinstance(value, FileLimit))


class CountLimit(NamedTuple):
    """The largest number that an option takes."""

    most: int
    unit: str

    def __str__(self) -> str:
        return f"{self.most:,} {self.unit}"


DRAWN_POSES = CountLimit(1_000_000, "poses to draw")
PLANNED_POSES = CountLimit(2_000, "poses of a plan")
CANDIDATES = CountLimit(100_000, "candidate poses")
GROUPS = CountLimit(1_000, "groups of points")
POINTS = CountLimit(1_000, "points of a group")
STATIONS = CountLimit(20, "stations of a camera")
RESAMPLES = CountLimit(100_000, "resamples")
DRAWS = CountLimit(1_000_000, "draws")
TRIALS = CountLimit(10_000, "trials")
STEPS = CountLimit(1_000, "steps")
FOLDS = CountLimit(1_000, "folds")
REPLICATES = CountLimit(10**9, "trials of a cell")
WORKERS = CountLimit(4_096, "workers")
SQUARES = CountLimit(100, "squares")

# The rule for names in files: of robots, limbs, actuators, poses, sessions, targets, columns.

LONGEST_NAME, LONGEST_COMPOSED = NAME_LENGTH.count, COMPOSED_LENGTH.count
"""Characters of a name, and of one that is composed of others, such as `monday.tracker.x`."""

# Keys of YAML files with composed names in or below them.
COMPOSED_KEYS = frozenset(
    {"identified", "unknowns", "fixed", "stored_parameters", "of", "noise", "columns"}
)

# Keys of YAML files whose values are texts or patterns, not names.
TEXT_KEYS = frozenset({"source", "comment", "format", "from", "ignore", "match", "missing"})

_EQUALS, _SIGNS = r"=@\uff1d\uff20", r"+\-\uff0b\uff0d"
"""Characters that begin a formula, also as wide ones, which spreadsheets of East Asia accept."""

# A cell, or a part of a name that becomes one where a line is split, that is computed: it begins
# with `=` or `@`, or with a sign and calls a function or another program. Signs and numbers, such
# as the labels `+x` and `-1`, are none.
_FORMULA = re.compile(rf'(?:^|[,;])[\s"]*(?:[{_EQUALS}]\s*[^\s,;]|[{_SIGNS}][^,;]*[(|!])')


def find_fault(name: str, longest: int = LONGEST_NAME, is_text: bool = False) -> Finding | None:
    """Return why a file must not contain a name of at most `longest` characters, or a text that is
    no name, which may have several lines; None where it may.
    """
    what, length, facts = "text" if is_text else "name", len(name), dict[str, Any]()
    if (character := find_not_plain(name, "\n\t" if is_text else "")) is not None:
        code = "files.name-not-plain"
        facts |= {"what": what, "character": name_character(character)}
    elif length > longest:
        code = "files.name-too-long"
        facts |= {"what": what, "length": length, "longest": longest}
    elif is_formula(name) and not is_text:
        code = "files.name-computed"
    else:
        return None
    return report_finding(code, name=quote(name), **facts)


def find_fault_below(keys: Iterable[str | int], text: str) -> Finding | None:
    """Return why a YAML file must not contain a text below some keys, or as the last of them."""
    if not TEXT_KEYS.isdisjoint(keys):
        return find_fault(text, TEXT_LENGTH.count, is_text=True)
    is_composed = not COMPOSED_KEYS.isdisjoint(keys)
    return find_fault(text, LONGEST_COMPOSED if is_composed else LONGEST_NAME)


def is_formula(cell: str) -> bool:
    """Return whether a spreadsheet would compute a cell."""
    return _FORMULA.search(cell) is not None


def make_name(text: str) -> str:
    """Return a text of another origin, such as the name of a file, as a name."""
    name = escape(text)[:LONGEST_NAME].strip()
    return re.sub(rf"[{_EQUALS}(|!]", "_", name) if is_formula(name) else name


def format_comment(text: str) -> str:
    """Return a text, which may contain names of files, as one line behind the `#` of a comment.

    Measurement files have comments, too, and spreadsheets split these at commas.
    """
    line = escape(" ".join(text.split()))
    return re.sub("[,;]", " ", line) if is_formula(line) else line
