# SPDX-License-Identifier: Apache-2.0
"""Files of other programs: read as robot file and measurements, written corrected.

A format is a `Format` with `read`, `write` or both, in a module of its own, and an entry here.
"""

from collections.abc import Mapping

from loopcal.io.formats import delta_gcode, hangprinter, klipper, linuxcnc, parameter_table
from loopcal.io.formats.program_format import Format
from loopcal.io.formats.urdf import urdf_format

FORMATS: Mapping[str, Format] = {
    entry.name: entry
    for entry in (
        klipper.FORMAT,
        delta_gcode.MARLIN,
        delta_gcode.REPRAP,
        linuxcnc.FORMAT,
        linuxcnc.INI_FORMAT,
        urdf_format.FORMAT,
        hangprinter.FORMAT,
        parameter_table.JSON,
        parameter_table.CSV,
    )
}
"""Name -> format."""
