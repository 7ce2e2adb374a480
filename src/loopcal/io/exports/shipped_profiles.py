# SPDX-License-Identifier: Apache-2.0
"""Profiles that come with loopcal, and what differs between two computers with the same software.

A shipped profile is a file of `loopcal/profiles`, which states its source. Unit and decimal mark
depend on the settings of the job and of the computer, so they can be stated beside a profile.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import resources
from pathlib import Path

from loopcal.errors import FileError, UnitError, suggest_names
from loopcal.findings import report_finding
from loopcal.io.core.text_file import as_path
from loopcal.io.exports.profile import ColumnSource, Profile
from loopcal.io.exports.profile_reader import check_columns
from loopcal.units import Dimension, find_unit


def list_shipped_profiles() -> dict[str, Path]:
    """Return name -> file of the profiles that come with loopcal."""
    folder = Path(str(resources.files("loopcal"))) / "profiles"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def find_profile_file(source: str | Path) -> Path:
    """Return the file of a profile that is given as a file or by the name of a shipped one.

    Raises
    ------
    FileError : neither of them.
    """
    path, shipped = as_path(source, "profile of an export"), list_shipped_profiles()
    if str(source) in shipped and not path.is_file():
        return shipped[str(source)]
    if path.exists():
        return path
    similar = suggest_names(str(source), shipped)
    raise FileError(
        report_finding("files.profile-missing", similar=similar, shipped=tuple(shipped)), path
    )


def with_local_settings(
    profile: Profile, unit: str | None = None, has_decimal_comma: bool = False
) -> Profile:
    """Return a profile with another unit of lengths, or with decimal commas.

    A computer that writes decimal commas separates columns by semicolons in place of commas.

    Raises
    ------
    FileError : the profile names its columns with another unit.
    """
    record = profile.record
    if unit is not None:
        columns = {name: _with_length(source, unit) for name, source in record.columns.items()}
        readings = {name: _with_length(source, unit) for name, source in record.readings.items()}
        record = replace(record, columns=columns, readings=readings)
    if has_decimal_comma:
        is_comma = record.delimiter == "comma"
        delimiter = "semicolon" if is_comma else record.delimiter
        record = replace(record, decimal="comma", delimiter=delimiter)
    changed = replace(profile, record=record)
    check_columns(changed)
    return changed


def _with_length(source: ColumnSource, unit: str) -> ColumnSource:
    """Return the source with another unit where it has one of length."""
    if source.symbol is None:
        return source
    try:
        find_unit(source.symbol, Dimension.LENGTH)
    except UnitError:
        return source
    return replace(source, unit=unit)
