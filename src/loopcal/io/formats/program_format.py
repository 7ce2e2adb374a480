# SPDX-License-Identifier: Apache-2.0
"""The interface of a format of another program: options, imported content, exported text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError, FileError
from loopcal.findings import Finding, report_finding
from loopcal.findings.wording import count_decimals
from loopcal.io.core.names import format_comment
from loopcal.io.core.numbers import parse_finite
from loopcal.io.core.text_file import read_bytes
from loopcal.io.core.yaml_text import quote_scalar
from loopcal.mechanism import Mechanism
from loopcal.plain_text import quote
from loopcal.units import LARGEST

if TYPE_CHECKING:
    from loopcal.measure import Measurements

ASSUMED_NOISE: Mapping[str, float] = {
    "height": 20e-6,
    "distance": 0.1e-3,
    "line": 1e-3,
    "position": 1e-3,
    "tape": 10e-3,
}
"""Standard deviations [m] that are assumed where nobody states them: of a probed height, of a
distance on a printed part, of line lengths, of known positions and of taped lengths of a cable
robot.
"""


@dataclass(frozen=True)
class ImportOptions:
    """Options of reading a file.

    Attributes
    ----------
    name : of the robot.
    sigma_height, sigma_distance : noise of probed heights and distances [m], which no format
        states. sigma_line, sigma_position : noise of lines and known positions of a cable robot
        [m]. sigma_tape : of lengths that were measured by hand [m], which are prior knowledge.
        Where one is None it is assumed, see `choose_noise`.
    sigma_anchor : of anchors that the file states [m]; None leaves them to the data.
    length_unit : symbol of the unit of lengths, for formats that state none.
    home_height : z of the home pose [m].
    closures : file of loop closures, for formats that keep them apart.
    platform : the link that is the platform.
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

    Attributes
    ----------
    plus_minus : parameter -> half of the 95 % interval, in the unit of the robot file; None where
        there is none. nulls : parameter -> reason why there is none.
    is_for_people : whether the numbers are to be read and typed: an identified value then has the
        digits that its interval supports. Files for programs have all digits.
    """

    robot: Mechanism
    plus_minus: Mapping[str, float | None] = field(default_factory=dict)
    nulls: Mapping[str, str] = field(default_factory=dict)
    is_for_people: bool = False

    def round_number(self, number: float, name: str, factor: float, most: int) -> float:
        """Return a number as it is written: for people to the third digit of the interval of a
        parameter, with at most `most` decimals; for programs as it is.

        Parameters
        ----------
        name : of the parameter. factor : from the unit in which the number is written to SI.
        """
        half = self.plus_minus.get(name)
        if not self.is_for_people or half is None or not 0.0 < half < math.inf:
            return number
        table = self.robot.parameters
        unit = self.robot.get_unit(table.entries[table.index(name)].dimension)
        return round(number, min(count_decimals(half * unit.factor_to_si / factor), most))

    def values(self) -> dict[str, float]:
        """Return parameter -> value [SI]."""
        return dict(zip(self.robot.parameters.names, self.robot.values.tolist(), strict=True))


@dataclass(frozen=True)
class Exported:
    """The text of a file of another program.

    Attributes
    ----------
    findings : changes, and what it cannot express.
    """

    text: str
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class Format:
    """A format of another program.

    Attributes
    ----------
    name, what : name of the format, and a line about it. endings : of file names.
    read : function that reads a file. write : function that writes a source, into an existing file
        (everything else in it stays as it is) or as a text of its own.
    takes_file : whether `write` can correct an existing file.
    read_options : options of `ImportOptions` that `read` uses.
    stores_fit : whether a file contains a geometry together with the measurements that its firmware
        fitted it to, so that `loopcal.diagnose` can compare the two.
    """

    name: str
    what: str
    endings: tuple[str, ...] = ()
    read: Callable[[Path, ImportOptions], Imported] | None = None
    write: Callable[[ExportSource, Path | None], Exported] | None = None
    takes_file: bool = True
    read_options: tuple[str, ...] = ()
    stores_fit: bool = False


def get_record(
    source: ExportSource, family: type | tuple[type, ...], format_name: str, needed: str
) -> Any:
    """Return the family's record of a robot; DataError where it is not `needed`."""
    record = getattr(source.robot.record, "record", None)
    if not isinstance(record, family):
        sentence = (
            f"{source.robot.name} is not {needed}, and the format {format_name} holds no other"
        )
        raise DataError(f"{sentence}; use json or csv")
    return record


def format_head(
    path: Path, what: str, family: str, name: str, units: tuple[str, str], remark: str = ""
) -> str:
    """Return the first lines of a robot file that is read from `path`.

    Parameters
    ----------
    what : the content of that file. units : of length and angle. remark : for people.
    """
    origin = format_comment(f"{path.name}, {what}")
    return "\n".join(
        [
            *(f"# {line}" for line in textwrap.wrap(f"Read from {origin}. {remark}", 98)),
            "format: 1",
            f"family: {family}",
            f"name: {quote_scalar(name)}",
            f"source: {quote_scalar(origin)}",
            f"units: {{length: {units[0]}, angle: {units[1]}}}\n\n",
        ]
    )


def parse_number(text: str, what: str, path: Path, line: int) -> float:
    """Return a number of a file; FileError with its line for other text, or beyond `LARGEST`."""
    value = parse_finite(text)
    if value is None:
        sentence = f"{what} is {quote(text)}, but a finite number is needed; correct it"
        raise FileError(sentence, path, line)
    if not abs(value) <= LARGEST:
        sentence = f"{what} is {quote(text)}, beyond {LARGEST:g}; correct it"
        raise FileError(sentence, path, line)
    return value


def report_changes(changes: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return the changes of a file; the finding that nothing changed where there are none."""
    return tuple(changes) or (report_finding("files.unchanged"),)


def get_byte_order_mark(path: Path) -> str:
    """Return the byte order mark of a file that has one, to keep it in the corrected file."""
    return "\ufeff" if read_bytes(path, "file").startswith(b"\xef\xbb\xbf") else ""
