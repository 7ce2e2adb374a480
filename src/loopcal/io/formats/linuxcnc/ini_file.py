# SPDX-License-Identifier: Apache-2.0
"""LinuxCNC's INI file: HOME_OFFSET of the struts of a hexapod with the kinematics genhexkins.

    [TRAJ]
    LINEAR_UNITS = mm
    [JOINT_0]
    HOME_OFFSET = 233.238      joint position at the home switch or index pulse;  N = 0..5

The joint position of a strut is the distance between its joint centers. At the switch it changes by
what a calibration adds to the length of the strut at reading zero, so each HOME_OFFSET grows by the
identified length minus the nominal one. Without a file to correct, HOME_OFFSET is the length at
reading zero: that of a joint whose reading is zero at its switch. HOME, MIN_LIMIT and MAX_LIMIT are
positions on the same scale and stay as they are. Source: LinuxCNC, "INI Configuration" ([JOINT_n],
[TRAJ]) and "Homing Configuration".
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from loopcal.errors import DataError
from loopcal.findings import Finding, report_finding
from loopcal.io.core.text_file import read_text
from loopcal.io.formats.program_format import Exported, ExportSource, Format, get_record
from loopcal.io.formats.value_file import DECIMALS, Name, Value, ValueFile
from loopcal.mechanism.families.gough import Gough
from loopcal.units import Dimension, find_unit

STRUTS = 6
OFFSET = "HOME_OFFSET"
UNITS_NAME = ("TRAJ", "LINEAR_UNITS")
LINEAR_UNITS = {"mm": "mm", "metric": "mm", "in": "in", "inch": "in", "imperial": "in"}
"""Word of LINEAR_UNITS -> our unit."""

_SECTION = re.compile(r"\s*\[(\w+)\]")
_ENTRY = re.compile(r"\s*(\w+)\s*=\s*([^\s#;]+)")


@dataclass(frozen=True)
class IniFile(ValueFile):
    """An INI file, whose values are entries by section; of equal ones the first counts."""

    title = "[{0}]{1}"
    phrase = "{1} of [{0}]"

    def describe_missing(self, group: str, name: str) -> str:
        """Return the sentence about an entry that does not exist."""
        return f"[{group}] has no {name}; add the one of the machine"

    def with_lines(self, lines: Sequence[str]) -> IniFile:
        """Return the file with other lines."""
        return _parse_ini(lines, self.path)

    def insert(self, lines: list[str], name: Name, text: str) -> None:
        """Insert an entry with its section at the end."""
        lines += [f"[{name[0]}]{self.line_end}", f"{name[1]} = {text}{self.line_end}"]


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return an INI file with corrected offsets, or entries of their own."""
    get_record(source, Gough, "linuxcnc-ini", "a hexapod of the family gough")
    values, table = source.values(), source.robot.parameters
    nominal = dict(zip(table.names, table.nominal.tolist(), strict=True))
    lengths = [f"leg{n + 1}.length" for n in range(STRUTS)]
    own = source.robot.units[Dimension.LENGTH]
    if into is None:
        if source.is_for_people:
            return _list_changes(source, lengths, nominal, own)
        if not all(nominal[name] for name in lengths):
            raise DataError(report_finding("files.ini-needed", robot=source.robot.name))
        factor = find_unit(own).factor_to_si
        wanted: dict[Name, float | str] = {
            (f"JOINT_{n}", OFFSET): source.round_number(
                values[name] / factor, name, factor, DECIMALS
            )
            for n, name in enumerate(lengths)
        }
        notes = (
            report_finding("files.machine-unit", unit=own),
            report_finding("files.offset-at-reading-zero"),
        )
        return _parse_ini((), Path("machine.ini")).export(None, wanted, {}, notes)
    ini = _parse_ini(read_text(into, "INI file").splitlines(keepends=True), into)
    unit = _read_unit(ini, own)
    factor = find_unit(unit).factor_to_si
    wanted = {
        (f"JOINT_{n}", OFFSET): source.round_number(
            ini.number(f"JOINT_{n}", OFFSET) + (values[name] - nominal[name]) / factor,
            name,
            factor,
            DECIMALS,
        )
        for n, name in enumerate(lengths)
    }
    findings: tuple[Finding, ...] = ()
    if not ini.has(*UNITS_NAME):
        findings = (report_finding("files.machine-unit", unit=unit),)
    return ini.export(into, wanted, {}, findings)


def _list_changes(
    source: ExportSource, lengths: Sequence[str], nominal: Mapping[str, float], unit: str
) -> Exported:
    """Return what to add to each offset, as lines for people."""
    factor, values = find_unit(unit).factor_to_si, source.values()
    lines = []
    for n, name in enumerate(lengths):
        added = (values[name] - nominal[name]) / factor
        number = f"{source.round_number(added, name, factor, DECIMALS) + 0.0:+.{DECIMALS}f}"
        shown = number.rstrip("0").rstrip(".")
        lines += [f"[JOINT_{n}]", f"# add {shown} {unit} to {OFFSET}"]
    return Exported("\n".join(lines) + "\n")


def _read_unit(ini: IniFile, own: str) -> str:
    """Return the unit of lengths of the machine; the robot's where the file states none."""
    if not ini.has(*UNITS_NAME):
        return own
    text = ini.text(*UNITS_NAME)
    if text.lower() not in LINEAR_UNITS:
        allowed = ", ".join(LINEAR_UNITS)
        raise ini.error(f"{UNITS_NAME[1]} is {text!r}; allowed: {allowed}", *UNITS_NAME)
    return LINEAR_UNITS[text.lower()]


def _parse_ini(lines: Sequence[str], path: Path) -> IniFile:
    """Find the entries."""
    section, values = "", dict[Name, Value]()
    for i, line in enumerate(lines):
        if match := _SECTION.match(line):
            section = match[1]
        elif match := _ENTRY.match(line):
            values.setdefault((section, match[1]), Value(match[2], i, match.start(2)))
    return IniFile(path, tuple(lines), values)


FORMAT = Format(
    "linuxcnc-ini", "HOME_OFFSET of a LinuxCNC hexapod in its INI file", (".ini",), None, write
)
