# SPDX-License-Identifier: Apache-2.0
"""The commands import and export offer the formats that the library reads and writes."""

from loopcal.cli.commands.exchange_commands import READ_FORMATS, WRITTEN_FORMATS
from loopcal.io.formats import FORMATS


def test_commands_offer_every_format_and_no_other():
    assert tuple(name for name, entry in FORMATS.items() if entry.read) == READ_FORMATS
    assert tuple(name for name, entry in FORMATS.items() if entry.write) == WRITTEN_FORMATS
