# SPDX-License-Identifier: Apache-2.0
"""Files of other programs, one format in each module: read as a robot file and measurements,
written corrected.

A format is a `Format` with `read`, `write` or both; its line in `FORMATS` is all that the command
line needs.
"""

from collections.abc import Mapping

from loopcal.io.formats import hangprinter, klipper, linuxcnc, marlin, parameter_table, reprap, urdf
from loopcal.io.formats.program_format import Format

FORMATS: Mapping[str, Format] = {
    found.name: found
    for found in (
        klipper.FORMAT,
        marlin.FORMAT,
        reprap.FORMAT,
        linuxcnc.FORMAT,
        urdf.FORMAT,
        hangprinter.FORMAT,
        parameter_table.JSON,
        parameter_table.CSV,
    )
}
