# SPDX-License-Identifier: Apache-2.0
"""The interface of a format of another program: options, imported content, exported text.

`ValueFile` is the general form of a text file whose values are read and replaced by name.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError, FileError
from loopcal.findings import Finding, report_finding
from loopcal.findings.wording import count_decimals
from loopcal.io.core.csv_table import parse_finite
from loopcal.io.core.limits import format_comment
from loopcal.io.core.text_file import read_bytes, read_text
from loopcal.io.core.yaml_file import format_yaml
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.plain_text import quote
from loopcal.units import LARGEST

if TYPE_CHECKING:
    from loopcal.apply.compensation import CorrectionTable, What

MM = 1e-3
# Standard deviations [m] that are assumed where nobody states them: of a probed height, of a
# distance on a printed part, of line lengths, known positions and taped lengths of a cable robot.
ASSUMED_NOISE = {"height": 20e-6, "distance": 0.1e-3, "line": 1e-3, "position": 1e-3, "tape": 10e-3}


@dataclass(frozen=True)
class ImportOptions:
    """Options of reading a file.

    name : of the robot.
    sigma_height, sigma_distance, sigma_line, sigma_position : noise [m] of probed heights and
        distances, and of lines and known positions of a cable robot, which no format states.
    sigma_tape : of lengths that were measured by hand [m], which are prior knowledge. Where one of
        these is None it is assumed, see `choose_noise`.
    sigma_anchor : of anchors that the file states [m]; None leaves them to the data.
    length_unit : symbol of the unit of lengths, for formats that state none.
    home_height : z of the home pose [m].
    closures, platform : file of loop closures, and link that is the platform, of a URDF.
    probes : files with the heights that a firmware reported, and with their points.
    """

    name: str
    sigma_height: float | None = None
    sigma_distance: float | None = None
    length_unit: str | None = None
    home_height: float | None = None
    closures: Path | None = None
    platform: str | None = None
    sigma_line: float | None = None
    sigma_position: float | None = None
    sigma_tape: float | None = None
    sigma_anchor: float | None = None
    probes: tuple[Path, ...] = ()

    def choose_noise(self, what: str) -> float:
        """Return the noise [m] of a sort of numbers in `ASSUMED_NOISE`: stated or assumed."""
        stated: float | None = getattr(self, f"sigma_{what}")
        return ASSUMED_NOISE[what] if stated is None else stated

    def is_noise_assumed(self, *what: str) -> bool:
        """Return whether any of these is assumed."""
        return any(getattr(self, f"sigma_{of}") is None for of in what)

    def observe(self, kind: Kind, rows: ArrayLike, measured: ArrayLike, *what: str) -> Observations:
        """Return values measured in the platform frame, with the noise of the last of `what`; it is
        marked as assumed where any of them is.
        """
        sigma = self.choose_noise(what[-1])
        observed = Observations.from_sigma(kind.with_tool(np.eye(4)), rows, measured, sigma)
        return replace(observed, is_noise_assumed=self.is_noise_assumed(*what))


@dataclass(frozen=True)
class Imported:
    """The content of a file of another program.

    Attributes
    ----------
    robot_text : text of the robot file. measurements : of the file; None where it has none.
    findings : assumptions, and content that a robot file cannot express.
    doubt : what is probably wrong with the file where the robot cannot be built.
    """

    robot_text: str
    measurements: Measurements | None = None
    findings: tuple[Finding, ...] = ()
    doubt: Finding | None = None


@dataclass(frozen=True)
class ExportSource:
    """A robot to export, with intervals where a run provides them.

    plus_minus : parameter -> half of the 95 % interval, in the unit of the robot file; None where
        there is none. nulls : parameter -> reason why there is none.
    is_for_people : whether the numbers are to be read and typed: an identified value then has the
        digits that its interval supports. Files for programs have all digits.
    findings : about these values in any controller. tables : corrections, for a format of tables.
    stem : first part of the names of files beside the one that is written.
    """

    robot: Mechanism
    plus_minus: Mapping[str, float | None] = field(default_factory=dict)
    nulls: Mapping[str, str] = field(default_factory=dict)
    is_for_people: bool = False
    findings: tuple[Finding, ...] = ()
    tables: tuple[CorrectionTable, ...] = ()
    stem: str = ""

    def round_number(self, number: float, name: str, factor: float, most: int) -> float:
        """Return a number as it is written, in a unit of `factor` to SI: for people to the third
        digit of the interval of parameter `name`, with at most `most` decimals.
        """
        half = self.plus_minus.get(name)
        if not self.is_for_people or half is None or not 0.0 < half < math.inf:
            return number
        table = self.robot.parameters
        unit = self.robot.get_unit(table.entries[table.index(name)].dimension)
        return round(number, min(count_decimals(half * unit.factor_to_si / factor, 3), most))

    def values(self) -> dict[str, float]:
        """Return parameter -> value [SI]."""
        return dict(zip(self.robot.parameters.names, self.robot.values.tolist(), strict=True))


@dataclass(frozen=True)
class Exported:
    """The text of a file of another program; findings are changes, and what it cannot express.
    `beside` : name -> text of files that it refers to, in its folder.
    """

    text: str
    findings: tuple[Finding, ...] = ()
    beside: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Format:
    """A format of another program.

    Attributes
    ----------
    name, what : name of the format, and a line about it. endings : of file names.
    read : function that reads a file. write : function that writes a source, into an existing file
        (everything else in it stays as it is) or as a text of its own.
    takes_file : whether `write` can correct an existing file.
    read_options : options of `ImportOptions` that `read` uses -> what is particular to this format,
        such as which lengths are taped, for help texts.
    table : of a format of corrections what it corrects, and the most nodes that it may have, in all
        and along an axis: see `loopcal.apply.compensation.TableSize`.
    mark : pattern of a text that files have, by which those with another ending are recognized.
    stores_fit : whether a file contains a geometry together with the measurements that its firmware
        fitted it to, so that `loopcal.diagnose` can compare the two.
    """

    name: str
    what: str
    endings: tuple[str, ...] = ()
    read: Callable[[Path, ImportOptions], Imported] | None = None
    write: Callable[[ExportSource, Path | None], Exported] | None = None
    takes_file: bool = True
    read_options: Mapping[str, str] = field(default_factory=dict)
    stores_fit: bool = False
    table: tuple[What, int, int] | None = None
    mark: str = ""


def get_record(
    source: ExportSource, family: type | tuple[type, ...], format_name: str, needed: str
) -> Any:
    """Return the family's record of a robot; DataError where it is not `needed`."""
    record = getattr(source.robot.record, "record", None)
    if not isinstance(record, family):
        sentence = f"the format {format_name} holds {needed}, not {source.robot.name}"
        raise DataError(f"{sentence}. Use json or csv")
    return record


def format_head(
    path: Path, what: str, family: str, name: str, units: tuple[str, str], remark: str = ""
) -> str:
    """Return the first lines of a robot file that is read from `path`, whose content is `what`."""
    origin = format_comment(f"{path.name}, {what}")
    remarks = textwrap.wrap(f"Read from {origin}. {remark}", 98)
    content = {
        "format": 1,
        "family": family,
        "name": name,
        "source": origin,
        "units": {"length": units[0], "angle": units[1]},
    }
    return "".join(f"# {line}\n" for line in remarks) + format_yaml(content) + "\n"


def parse_number(text: str, what: str, path: Path, line: int) -> float:
    """Return a number of a file; FileError with its line for other text, or beyond `LARGEST`."""
    value = parse_finite(text)
    if value is not None and abs(value) <= LARGEST:
        return value
    reason = ", but must be a finite number" if value is None else f", above {LARGEST:g}"
    raise FileError(f"{what} is {quote(text)}{reason}. Correct it", path, line)


def report_changes(changes: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return the changes of a file; the finding that nothing changed where there are none."""
    return tuple(changes) or (report_finding("files.unchanged"),)


def get_byte_order_mark(path: Path) -> str:
    """Return the byte order mark of a file that has one, to keep it in the corrected file."""
    return "\ufeff" if read_bytes(path, "file").startswith(b"\xef\xbb\xbf") else ""


DECIMALS = 6  # decimals of written numbers [mm, deg]: those that Klipper itself saves, a nanometer

Name = tuple[str, str]
Numbers = Mapping[Name, float | str]


@dataclass(frozen=True)
class Value:
    """The text of a value, with its line and column (both from 0)."""

    text: str
    line: int
    column: int


@dataclass(frozen=True)
class ValueFile:
    """A text file of a controller: its lines with their ends, and the values that count, by group
    and name; nothing else in it is changed.

    `what` names the sort of file; `title` and `phrase` word a name in a list of changes and in
    sentences, `missing` is the sentence about a value that does not exist. Of a file with one value
    in a line: `entry` matches its name and text, `section` the group of the lines below (`group`
    above the first), and `new` are the lines of a new value.
    """

    path: Path
    lines: tuple[str, ...]
    values: Mapping[Name, Value]

    what: ClassVar[str]
    title: ClassVar[str] = "{0} {1}"
    phrase: ClassVar[str] = "{1} of {0}"
    missing: ClassVar[str]
    entry: ClassVar[re.Pattern[str]]
    section: ClassVar[re.Pattern[str] | None] = None
    group: ClassVar[str] = ""
    new: ClassVar[str]
    does_first_count: ClassVar[bool] = False

    @classmethod
    def parse(cls, lines: Sequence[str], path: Path) -> Self:
        """Find the values in complete lines."""
        group, values = cls.group, dict[Name, Value]()
        for i, line in enumerate(lines):
            if cls.section is not None and (match := cls.section.match(line)):
                group = match[1]
            elif (match := cls.entry.match(line)) and not (
                cls.does_first_count and (group, match[1]) in values
            ):
                values[group, match[1]] = Value(match[2], i, match.start(2))
        return cls(path, tuple(lines), values)

    def insert(self, lines: list[str], name: Name, text: str) -> None:
        """Insert a new value into complete lines, at the end."""
        lines += [line + self.line_end for line in self.new.format(*name, text).split("\n")]

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file and find its values."""
        return cls.parse(read_text(path, cls.what).splitlines(keepends=True), path)

    def describe_missing(self, group: str, name: str) -> str:
        """Return the sentence about a value that does not exist."""
        return self.missing.format(group, name)

    def finish_line(self, line: str) -> str:
        """Return a line after a change of a value."""
        return line

    def format(self, number: float) -> str:
        """Return a number as it is written."""
        return format_number(number)

    def is_same(self, a: float, b: float) -> bool:
        """Return whether two numbers count as the same."""
        return is_same((a, b))

    @property
    def line_end(self) -> str:
        """The end of lines in this file."""
        return "\r\n" if self.lines and self.lines[0].endswith("\r\n") else "\n"

    def has(self, *name: str) -> bool:
        """Return whether a value exists."""
        return name in self.values

    def error(self, sentence: str | Finding, *name: str) -> FileError:
        """Return an error at the line of a value, without a line where it does not exist."""
        line = self.values[name[0], name[1]].line + 1 if name in self.values else None
        return FileError(sentence, self.path, line)

    def text(self, group: str, name: str) -> str:
        """Return the text of a value; FileError where it does not exist."""
        if not self.has(group, name):
            raise FileError(self.describe_missing(group, name), self.path)
        return self.values[group, name].text

    def number(self, group: str, name: str, default: float | None = None) -> float:
        """Return a number, or the default where there is none; FileError for other text."""
        if default is not None and not self.has(group, name):
            return default
        return self.numbers(group, name)[0]

    def numbers(self, group: str, name: str, separator: str | None = None) -> tuple[float, ...]:
        """Return the numbers of a value; FileError for other text."""
        text = self.text(group, name)
        what, line = self.phrase.format(group, name), self.values[group, name].line + 1
        number_texts = [text] if separator is None else text.split(separator)
        return tuple(parse_number(part.strip(), what, self.path, line) for part in number_texts)

    def correct(
        self, wanted: Numbers, defaults: Mapping[Name, float]
    ) -> tuple[Self, tuple[Finding, ...]]:
        """Return the file with other numbers (or texts), and the changes.

        A value that does not exist is added only where it differs from its default.
        """
        file, changes = self, []
        for name, number in wanted.items():
            before = file.values.get(name)
            if not isinstance(number, str):
                present = defaults.get(name) if before is None else file.number(*name)
                if present is not None and self.is_same(present, number):
                    continue
            text = number if isinstance(number, str) else self.format(number)
            lines = list(file.lines)
            if before is not None:
                line, end = lines[before.line], before.column + len(before.text)
                changed = line[: before.column] + text + line[end:]
                lines[before.line] = self.finish_line(changed)
            else:
                if lines and not lines[-1].endswith("\n"):
                    lines[-1] += file.line_end
                file.insert(lines, name, text)
            file = self.parse(lines, self.path)
            changes.append(
                report_finding(
                    "files.value-changed",
                    line=file.values[name].line + 1,
                    name=self.title.format(*name),
                    before=None if before is None else before.text,
                    after=text,
                )
            )
        return file, tuple(changes)

    def export(
        self,
        into: Path | None,
        wanted: Numbers,
        defaults: Mapping[Name, float],
        findings: Sequence[Finding] = (),
    ) -> Exported:
        """Return the text with other numbers; with all of them, where `into` names no file."""
        if into is None:
            file, mark = self.correct(wanted, {})[0], ""
        else:
            file, changes = self.correct(wanted, defaults)
            findings, mark = (*report_changes(changes), *findings), get_byte_order_mark(into)
        return Exported(mark + "".join(file.lines), tuple(findings))


def format_number(value: float) -> str:
    """Return a number with the decimals that firmware of printers uses."""
    return f"{value:.{DECIMALS}f}"


def round_digits(value: float, digits: int = 7) -> float:
    """Return a number with so many significant digits."""
    return float(f"{float(value):.{digits}g}")


def round_length(value: float) -> float:
    """Return a length in whole millimeters; as it is where it would be 0."""
    return round(value) or value


def is_same(*pairs: tuple[float, float]) -> bool:
    """Return whether the two numbers of each pair are written alike."""
    return all(format_number(a) == format_number(b) for a, b in pairs)


def format_short(number: float, decimals: int) -> str:
    """Return a number with at most so many decimals, without zeros at its end and without -0."""
    text = f"{number:.{decimals}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return "0" if text == "-0" else text


def shorten_numbers(wanted: Numbers, decimals: int) -> dict[Name, float | str]:
    """Return numbers as texts for people, without zeros at their ends; lists are `a:b:c`."""
    return {
        name: ":".join(
            format_short(float(number), decimals)
            for number in (value.split(":") if isinstance(value, str) else (value,))
        )
        for name, value in wanted.items()
    }
