# SPDX-License-Identifier: Apache-2.0
"""Names of other files in a file: they stay in the folder of the file that names them.

A relative path counts from that folder, wherever the command runs, and must not leave it, neither
by `..` nor through a symbolic link. An absolute path is allowed, and reported.
"""

from __future__ import annotations

from pathlib import Path

from loopcal.findings import Finding, report_finding
from loopcal.io.core.yaml_file import Location, YamlFile, name_location
from loopcal.plain_text import escape

KEYS = ("poses", "controller")
"""Settings of measurement files that name another file."""


def find_reference(file: YamlFile, key: str) -> Path | None:
    """Return the file that the setting `key` names; None where there is no such file.

    Raises
    ------
    FileError : the path leaves the folder of `file`; at its line.
    """
    return find_file_beside(file, str(file.content[key]), (key,))


def find_file_beside(file: YamlFile, name: str, location: Location) -> Path | None:
    """Return the file that `file` names at a location; None where there is no such file.

    Raises
    ------
    FileError : the path leaves the folder of `file`; at its line.
    """
    path = file.path.parent / name
    if not Path(name).is_absolute() and not _is_inside(path, file.path.parent):
        key = name_location(location)
        finding = report_finding("files.reference-outside", key=key, path=escape(name))
        raise file.error(finding, location)
    return path if path.is_file() else None


def list_absolute_references(file: YamlFile) -> tuple[Finding, ...]:
    """Return a finding for each absolute path in the settings of a file."""
    stated = ((key, str(file.content[key])) for key in KEYS if key in file.content)
    return tuple(
        report_finding("files.reference-absolute", file=str(file.path), path=path, key=key)
        for key, path in stated
        if Path(path).is_absolute()
    )


def _is_inside(path: Path, folder: Path) -> bool:
    """Return whether a path, with its symbolic links followed, is in a folder."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # a loop of links
        return False
