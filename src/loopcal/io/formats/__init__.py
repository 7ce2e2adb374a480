# SPDX-License-Identifier: Apache-2.0
"""Files of other programs: read as robot file and measurements, written corrected.

A format is a `Format` with `read`, `write` or both, in a module of its own, and a line here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from loopcal.registry import Registry

if TYPE_CHECKING:
    from loopcal.io.formats.program_format import Format

# Name -> format, which is imported when it is looked up.
FORMATS: Registry[Format] = Registry(
    "format of another program",
    "loopcal.formats",
    {
        "klipper": "loopcal.io.formats.klipper:FORMAT",
        "marlin": "loopcal.io.formats.delta_gcode:MARLIN",
        "reprap": "loopcal.io.formats.delta_gcode:REPRAP",
        "linuxcnc": "loopcal.io.formats.linuxcnc:FORMAT",
        "linuxcnc-ini": "loopcal.io.formats.linuxcnc:INI_FORMAT",
        "urdf": "loopcal.io.formats.linkages.urdf:FORMAT",
        "sdf": "loopcal.io.formats.linkages.sdf:FORMAT",
        "mjcf": "loopcal.io.formats.linkages.mjcf:FORMAT",
        "hangprinter": "loopcal.io.formats.hangprinter:FORMAT",
        "maslow": "loopcal.io.formats.maslow:FORMAT",
        "linuxcnc-kinematics": "loopcal.io.formats.linuxcnc_kinematics:FORMAT",
        "c": "loopcal.io.formats.c_kinematics:FORMAT",
        "grid": "loopcal.io.formats.correction_files:GRID",
        "grid-klipper": "loopcal.io.formats.correction_files:KLIPPER",
        "klipper-skew": "loopcal.io.formats.correction_files:SKEW",
        "grid-reprap": "loopcal.io.formats.correction_files:REPRAP",
        "grid-linuxcnc": "loopcal.io.formats.correction_files:COMPENSATION",
        "json": "loopcal.io.formats.import_export:JSON",
        "csv": "loopcal.io.formats.import_export:CSV",
    },
)


def register_format(entry: Format) -> Format:
    """Add a format of another program, and return it. See docs/extending.md.

    Raises
    ------
    DataError : it is no format, or its name is one of loopcal.
    """
    from loopcal.io.formats.program_format import Format
    from loopcal.measure.array_checks import check_type

    check_type(entry, Format, "entry", "such as Format('name', ..)")
    return FORMATS.register(entry)
