# SPDX-License-Identifier: Apache-2.0
"""Exports of instruments and their profiles as texts, and their conversion."""

from pathlib import Path

from loopcal.io.exports.conversion import Conversion, convert_export
from loopcal.io.exports.profile import read_profile

BY_NAME = """format: 1
delimiter: comma
columns:
  pose: {from: Name}
  x: {from: X, unit: mm}
  y: {from: Y, unit: mm}
  z: {from: Z, unit: mm}
settings: {kind: position, noise: {"*": 1 um}}
"""


def convert(folder: Path, export: str | bytes, profile: str) -> Conversion:
    """Convert an export by means of a profile."""
    (folder / "profile.yaml").write_text(profile, encoding="utf-8")
    raw = export if isinstance(export, bytes) else export.encode()
    (folder / "export.txt").write_bytes(raw)
    return convert_export(folder / "export.txt", read_profile(folder / "profile.yaml"))


def read_table_lines(text: str) -> list[str]:
    """Return the header and the rows of a measurement file."""
    return [line for line in text.rstrip("\n").split("\n") if not line.startswith("#")]


def read_rows(text: str) -> list[str]:
    """Return the rows below the header."""
    return read_table_lines(text)[1:]
