# SPDX-License-Identifier: Apache-2.0
"""What a format of another program gives and takes: imported text, exported text, and what could
not be expressed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError, FileError

if TYPE_CHECKING:
    from loopcal.measure import Measurements
    from loopcal.mechanism import Mechanism

HEIGHT_SIGMA = 20e-6
"""Standard deviation of a probed height where nothing is known of the probe [m]."""

UNCHANGED = "every number was already this one; nothing was changed"

LINE_SIGMA = POSITION_SIGMA = 1e-3
"""Standard deviations of a line's length and of a known position of a cable robot, where nothing is
known [m].
"""

DISTANCE_SIGMA = 0.1e-3
"""Standard deviation of a distance by callipers on a printed part where nothing is known of them
[m].
"""


@dataclass(frozen=True)
class ImportOptions:
    """How to read a file.

    Attributes
    ----------
    name : of the robot. sigma_height, sigma_distance : noise of measurements in the file [m], which
        no format states.
    length_unit : symbol of the unit of lengths, for formats that state none. home_height : z of the
        home pose [m].
    closures : the file of loop closures, for formats that keep them apart. platform : the link that
        is the platform.
    sigma_line, sigma_position : noise of lines and of known positions of a cable robot [m], which
        no format states.
    """

    name: str
    sigma_height: float = HEIGHT_SIGMA
    sigma_distance: float = DISTANCE_SIGMA
    length_unit: str | None = None
    home_height: float | None = None
    closures: Path | None = None
    platform: str | None = None
    sigma_line: float = LINE_SIGMA
    sigma_position: float = POSITION_SIGMA


@dataclass(frozen=True)
class Imported:
    """A file as loopcal sees it.

    Attributes
    ----------
    robot_text : the robot file. measurements : what the file also holds, None where it holds none.
    notes : sentences on what was assumed, and on what has no place in a robot file.
    """

    robot_text: str
    measurements: Measurements | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ExportSource:
    """What is exported: a robot, and where a run made it, half of the 95 % interval by parameter
    (unit of the file).
    """

    robot: Mechanism
    plus_minus: Mapping[str, float | None] = field(default_factory=dict)
    nulls: Mapping[str, str] = field(default_factory=dict)

    def values(self) -> dict[str, float]:
        """Parameter -> value [SI]."""
        return dict(zip(self.robot.parameters.names, self.robot.values.tolist(), strict=True))


@dataclass(frozen=True)
class Exported:
    """The text to write, and sentences on what was changed and on what the format cannot express."""

    text: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Format:
    """A format of another program.

    Attributes
    ----------
    name, what : its name on the command line, and one line on it. endings : of file names that are
        taken for it.
    read : from a file. write : of a source, into the file given (all else in it stays as it is) or
        as a text of its own.
    takes_file : whether `write` can correct a file. reads : options of `ImportOptions` that `read` looks
        at.
    judged : sentences on what the other program stored, from the robot and the measurements that
        were read.
    """

    name: str
    what: str
    endings: tuple[str, ...] = ()
    read: Callable[[Path, ImportOptions], Imported] | None = None
    write: Callable[[ExportSource, Path | None], Exported] | None = None
    takes_file: bool = True
    reads: tuple[str, ...] = ()
    judged: Callable[[Mechanism, Measurements], tuple[str, ...]] | None = None


def record_of(source: ExportSource, family: type, format_name: str, words: str) -> Any:
    """The family's record of a robot that came from a file; DataError where it is of another
    family.
    """
    record = getattr(source.robot.record, "record", None)
    if not isinstance(record, family):
        raise DataError(
            f"{source.robot.name} is not {words}, which is all that the format {format_name} can "
            "hold; use json or csv"
        )
    return record


def number(text: str, what: str, path: Path, line: int) -> float:
    """A finite number of a file; FileError with its line where it is none."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if value - value != 0.0 or "_" in text:
        raise FileError(
            f"{what} is {text!r} where a finite number is needed; correct it", path, line
        )
    return value


def byte_order_mark(path: Path) -> str:
    """The byte order mark of a file that has one, to be kept where the file is written anew."""
    return "\ufeff" if path.read_bytes().startswith(b"\xef\xbb\xbf") else ""
