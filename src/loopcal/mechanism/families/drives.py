# SPDX-License-Identifier: Apache-2.0
"""Drives of a `limbs` file: the actuator that each makes, and the terms of it that are unknown.

Every unknown is a named quantity in a unit that people measure: a spool's radius and build-up stand
for gain and curve. Formulas: docs/theory/parameters.md.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Actuator, Address, LinearMap
from loopcal.mechanism.families.error_models import Errors, quantity
from loopcal.mechanism.families.limb_records import AngleDrive, Drive, LengthDrive, SpoolDrive
from loopcal.mechanism.families.records import (
    AngleTolerance,
    LengthTolerance,
    RatioTolerance,
    standard_deviation,
)
from loopcal.units import Dimension

HARMONICS = ("sin1", "cos1", "sin2", "cos2")
CURVE_OF_BUILDUP = 1 / (4 * np.pi)
"""Term `curve` per unit of build-up: radius + buildup * reading / (2 pi), integrated over the
reading.
"""

Tolerance = LengthTolerance | AngleTolerance | RatioTolerance | None


def actuator(name: str, drive: Drive) -> Actuator:
    """A drive for the engine."""
    if isinstance(drive, SpoolDrive):
        terms = {"gain": drive.radius, "curve": CURVE_OF_BUILDUP * drive.buildup}
    else:
        terms = {"gain": drive.gain}
    dimension = Dimension.LENGTH if isinstance(drive, LengthDrive) else Dimension.ANGLE
    return Actuator(
        name, dimension, drive.stroke, {"offset": drive.offset, **terms}, drive.period, drive.sigma
    )


def drive_errors(name: str, drive: Drive, turns: bool) -> Errors:
    """The unknown terms of a drive, `q1.offset` and so on; `turns` where its joint turns.

    Raises
    ------
    MechanismError
        A term that the drive does not have, or a harmonic without a period.
    """
    known, found = _terms(drive, Dimension.ANGLE if turns else Dimension.LENGTH), Errors()
    for term in drive.unknown:
        if term not in known:
            raise MechanismError(
                f"actuator {name!r} has no term {term!r}; allowed are {', '.join(known)}"
            )
        if term in HARMONICS and not drive.period:
            raise MechanismError(
                f"actuator {name!r} has an unknown {term}, but no period; state the reading's "
                "period"
            )
        dimension, nominal, tolerance, axis, coefficient = known[term]
        full = f"{name}.{term}"
        sd = standard_deviation(tolerance, full)
        found += quantity(
            full,
            dimension,
            nominal,
            sd,
            LinearMap(full, Address(name, "transmission", axis), coefficient),
        )
    return found


def _terms(
    drive: Drive, own: Dimension
) -> Mapping[str, tuple[Dimension, float, Tolerance, str, float]]:
    """Name -> dimension, nominal value, tolerance, term of the transmission, and its change per
    unit.
    """
    tolerance = drive.angle if isinstance(drive, AngleDrive) else drive.length
    known: dict[str, tuple[Dimension, float, Tolerance, str, float]] = {
        "offset": (own, drive.offset, tolerance, "offset", 1.0)
    }
    if isinstance(drive, SpoolDrive):
        known["radius"] = (Dimension.LENGTH, drive.radius, drive.radii, "gain", 1.0)
        known["buildup"] = (
            Dimension.LENGTH,
            drive.buildup,
            drive.buildups,
            "curve",
            CURVE_OF_BUILDUP,
        )
    else:
        known["gain"] = (Dimension.RATIO, drive.gain, drive.ratio, "gain", 1.0)
    for term in ("backlash", *HARMONICS):
        known[term] = (own, 0.0, tolerance, term, 1.0)
    return known
