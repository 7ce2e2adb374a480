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
from loopcal.mechanism.assembly import (
    MOST_ACTUATORS,
    MOST_COPIES,
    MOST_JOINTS,
    MOST_LIMBS,
    MOST_PARAMETERS,
)
from loopcal.plain_text import escape, find_not_plain, name_character, quote

MEGABYTE = 10**6


@dataclass(frozen=True)
class FileLimit:
    """The most that a file may contain of one thing: `most` of it, in `unit`; sizes are in MB.

    `of` and `meaning` say what is limited and where, for documentation; `action` is what a user
    who meets the limit does.
    """

    of: str
    most: float
    unit: str
    meaning: str
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
    "size of YAML text",
    1,
    "MB",
    "robot files, settings, profiles, lists of loop closures, front matter with its remarks",
    "shorten its comments, or remove what does not belong there",
)
YAML_NODES = FileLimit(
    "values in YAML text",
    50_000,
    "values",
    "keys, values and lists. An alias counts as all values that it stands for",
    "write less, or use fewer aliases",
)
YAML_DEPTH = FileLimit(
    "nesting of YAML text",
    50,
    "levels of nesting",
    "lists and mappings inside each other",
    "write it with fewer levels",
)
COPIES = FileLimit("copies of a limb", MOST_COPIES, "copies", "`copies: {count: ..}` of a limb")
LIMBS = FileLimit("limbs of a robot", MOST_LIMBS, "limbs", "copies included")
JOINTS = FileLimit("joints of a limb", MOST_JOINTS, "joints", "a universal joint counts as two")
ACTUATORS = FileLimit("actuators of a robot", MOST_ACTUATORS, "actuators", "of all limbs together")
PARAMETERS = FileLimit(
    "parameters of a robot", MOST_PARAMETERS, "parameters", "including fixed ones"
)
NAME_LENGTH = FileLimit(
    "length of a name",
    200,
    "characters",
    "robots, limbs, actuators, sessions, targets, and every other text of a YAML file",
    "shorten it",
)
COMPOSED_LENGTH = FileLimit(
    "length of a composed name",
    1_000,
    "characters",
    "names such as `monday.tracker.x`, headers of columns, names of poses",
    "shorten it",
)
TEXT_LENGTH = FileLimit(
    "length of a text that is not a name", 10_000, "characters", "`source` of a robot", "shorten it"
)
TABLE_SIZE = FileLimit(
    "size of a measurement file",
    500,
    "MB",
    "measurement files, exports of instruments, `result.json` of a run",
    "divide it into several files",
)
TABLE_ROWS = FileLimit(
    "rows of a measurement file",
    2_000_000,
    "rows",
    "rows below the header",
    "divide it into several files, or average repeated measurements",
)
TABLE_LINES = FileLimit(
    "lines of a measurement file",
    5_000_000,
    "lines",
    "blank lines and remarks included",
    "remove other lines, or divide it into several files",
)
TABLE_COLUMNS = FileLimit(
    "columns of a measurement file",
    1_000,
    "columns",
    "columns of the header",
    "leave out columns that loopcal does not read",
)
LINE_LENGTH = FileLimit(
    "length of a line of a table",
    100_000,
    "characters in one line",
    "lines of measurement files and exports",
    "check that this is a table of text, one row in a line",
)
PATTERN_LENGTH = FileLimit(
    "length of a pattern of a profile",
    1_000,
    "characters",
    "`match` and `ignore`",
    "write a shorter pattern",
)
PATTERN_COUNTS = FileLimit(
    "repetitions in a pattern of a profile",
    1_000,
    "repetitions",
    "the product of all counts in braces: 8 for `\\d{4}-\\d{2}`",
    "write smaller counts, or `*` and `+`",
)
PATTERN_SECONDS = FileLimit(
    "time of the patterns of a profile",
    2,
    "seconds",
    "for one export, and 0.1 ms more for each of its lines",
)
PROGRAM_SIZE = FileLimit(
    "size of a file of another program",
    5,
    "MB",
    "files that `loopcal import` and `loopcal export` read",
    "check that this is the right file, or remove other content",
)
JSON_VALUES = FileLimit(
    "values in JSON text",
    25_000_000,
    "values",
    "`result.json` of a run, samples of a cable robot, keys included",
    "check that this is the file that was meant",
)
JSON_DEPTH = FileLimit(
    "nesting of JSON text",
    200,
    "levels of nesting",
    "lists and objects inside each other",
    "simplify it",
)
XML_JOINTS = FileLimit(
    "joints of a URDF",
    300,
    "joints",
    "fixed ones included",
    "leave out joints that belong to no loop",
)
XML_ELEMENTS = FileLimit(
    "elements of a URDF",
    20_000,
    "elements",
    "elements of every kind",
    "leave out what loopcal does not read, such as visuals",
)
XML_DEPTH = FileLimit(
    "nesting of a URDF",
    50,
    "levels of nesting",
    "elements inside each other",
    "check that this is the file that was meant",
)
ARRAYS_SIZE = FileLimit(
    "size of `arrays.npz`",
    4_000,
    "MB",
    "arrays of a run folder, as a file and in memory, never compressed",
    "repeat the calibration with fewer poses",
)
ARRAYS_COUNT = FileLimit(
    "arrays of a run folder", 1_000, "arrays", "members of `arrays.npz`", "repeat the calibration"
)
UPLOAD_SIZE = FileLimit("size of a file of the page", 50, "MB", "`loopcal app`", "divide it")
UPLOADS = FileLimit("files of the page", 50, "files", "`loopcal app`", "remove one")

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
