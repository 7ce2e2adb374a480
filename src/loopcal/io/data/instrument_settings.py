# SPDX-License-Identifier: Apache-2.0
"""The instrument in the settings of a measurement file: a name, or facts for traceability.

instrument: AT960                            for information
instrument: {name: AT960, serial_number: "750123", certificate: D-K-15123, calibrated: 2026-01-15,
due: 2027-01-15, laboratory: Metrology Ltd, measured: 2026-05-31}
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import Location, YamlFile
from loopcal.io.core.yaml_text import format_flow_mapping, quote_scalar

if TYPE_CHECKING:
    from loopcal.measure import InstrumentRecord

KEY = "instrument"


def read_instrument(
    file: YamlFile, node: Mapping[str, Any], location: Location
) -> InstrumentRecord | None:
    """Return the instrument that settings state; None where they state none.

    Raises
    ------
    FileError : an unknown key, a number without quotes, or not a date, at its line.
    """
    from loopcal.measure import InstrumentRecord

    stated, place = node.get(KEY), (*location, KEY)
    if stated is None:
        return None
    if isinstance(stated, str):
        return InstrumentRecord(name=stated)
    if not isinstance(stated, dict) or not stated:
        sentence = f"{KEY!r} is neither a name nor facts of an instrument; write its name, or"
        example = f'{KEY}: {{name: AT960, serial_number: "750123", certificate: D-K-15123}}'
        raise file.error(f"{sentence} '{example}'", place)
    try:
        return read_record(file, stated, InstrumentRecord, None, place)
    except DataError as error:
        raise file.error(str(error), place) from None


def format_instrument(record: InstrumentRecord) -> str:
    """Return the setting of an instrument as YAML text in one line."""
    stated = record.to_dict()
    if list(stated) == ["name"]:
        return quote_scalar(record.name)
    return format_flow_mapping({name: quote_scalar(value) for name, value in stated.items()})
