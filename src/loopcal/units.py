# SPDX-License-Identifier: Apache-2.0
"""Units of files and tables. Inside loopcal everything is in SI (meter, radian, second), but
temperatures, which are in degrees Celsius.

A record annotates its numbers with `Length`, `Angle` or `Ratio`; the reader of files multiplies
them by the factor of the stated unit, the writer divides by it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum
from typing import Annotated, Any

from loopcal.errors import UnitError, suggest_names


class Dimension(Enum):
    """Dimension of a number."""

    LENGTH = "length"
    ANGLE = "angle"
    RATIO = "ratio"
    PIXEL = "pixel"
    COUNT = "count"
    TEMPERATURE = "temperature"
    TIME = "time"
    FORCE = "force"
    MOMENT = "moment"
    RATIO_PER_TEMPERATURE = "ratio per temperature"
    LENGTH_PER_TEMPERATURE = "length per temperature"
    LENGTH_PER_TIME = "length per time"
    LENGTH_PER_FORCE = "length per force"
    ANGLE_PER_TEMPERATURE = "angle per temperature"
    ANGLE_PER_TIME = "angle per time"
    ANGLE_PER_MOMENT = "angle per moment"

    def per(self, other: Dimension) -> Dimension:
        """Return the dimension of a slope: that of a length or angle per unit of another one."""
        return Dimension(f"{self.value} per {other.value}")


LARGEST = 1e9  # largest number of a file [m, rad, 1]: beyond it, squares and cubes lose all meaning
# Smallest standard deviation above zero [m, rad, 1]: the size of an atom's nucleus.
SMALLEST_SD = 1e-15
ABSOLUTE_ZERO, ROUNDING = -273.15, 1e-9
"""Lowest temperature, and the rounding of a conversion that is accepted below it [degC]."""
# The allowed standard deviations, for messages.
SD_RANGE = f"from {SMALLEST_SD:g} to {LARGEST:g} m, rad or 1"

Length = Annotated[float, Dimension.LENGTH]
Angle = Annotated[float, Dimension.ANGLE]
Ratio = Annotated[float, Dimension.RATIO]
Pixel = Annotated[float, Dimension.PIXEL]
Temperature = Annotated[float, Dimension.TEMPERATURE]
Expansion = Annotated[float, Dimension.RATIO_PER_TEMPERATURE]


@dataclass(frozen=True)
class DimensionOf:
    """A dimension that the class of a record states under a name, for records that differ in it."""

    name: str


Given = Annotated[float, DimensionOf("GIVEN")]
Reading = Annotated[float, DimensionOf("READING")]


@dataclass(frozen=True)
class Unit:
    """A unit, with its symbol in files, e.g. "mm": `SI value = value * factor_to_si + offset`. Only
    temperatures have an offset, which differences lack.
    """

    symbol: str
    dimension: Dimension
    factor_to_si: float
    offset: float = 0.0

    def __str__(self) -> str:
        return self.symbol


UNITS: dict[str, Unit] = {
    u.symbol: u
    for u in (
        Unit("m", Dimension.LENGTH, 1.0),
        Unit("mm", Dimension.LENGTH, 1e-3),
        Unit("um", Dimension.LENGTH, 1e-6),
        Unit("nm", Dimension.LENGTH, 1e-9),
        Unit("in", Dimension.LENGTH, 0.0254),
        Unit("rad", Dimension.ANGLE, 1.0),
        Unit("mrad", Dimension.ANGLE, 1e-3),
        Unit("urad", Dimension.ANGLE, 1e-6),
        Unit("deg", Dimension.ANGLE, math.pi / 180.0),
        Unit("arcmin", Dimension.ANGLE, math.pi / 10800.0),
        Unit("arcsec", Dimension.ANGLE, math.pi / 648000.0),
        Unit("1", Dimension.RATIO, 1.0),
        Unit("ppm", Dimension.RATIO, 1e-6),
        Unit("um/m", Dimension.RATIO, 1e-6),
        Unit("px", Dimension.PIXEL, 1.0),
        Unit("degC", Dimension.TEMPERATURE, 1.0),
        Unit("K", Dimension.TEMPERATURE, 1.0, -273.15),
        Unit("degF", Dimension.TEMPERATURE, 5 / 9, -160 / 9),
        Unit("s", Dimension.TIME, 1.0),
        Unit("ms", Dimension.TIME, 1e-3),
        Unit("min", Dimension.TIME, 60.0),
        Unit("h", Dimension.TIME, 3600.0),
        Unit("N", Dimension.FORCE, 1.0),
        Unit("kN", Dimension.FORCE, 1e3),
        Unit("lbf", Dimension.FORCE, 4.4482216152605),
        Unit("Nm", Dimension.MOMENT, 1.0),
        Unit("kNm", Dimension.MOMENT, 1e3),
    )
}
# What slopes are per unit of -> the units of these slopes in SI.
SLOPES: dict[str, tuple[str, ...]] = {
    "degC": ("m", "rad"),
    "s": ("m", "rad"),
    "N": ("m",),
    "Nm": ("rad",),
}


def _make_slope(of: str, by: str) -> Unit:
    unit = UNITS[of]
    return Unit(f"{of}/{by}", unit.dimension.per(UNITS[by].dimension), unit.factor_to_si)


UNITS |= {
    f"{prefix}{of}/{by}": _make_slope(prefix + of, by)
    for by, all_of in SLOPES.items()
    for of in all_of
    for prefix in ("", "m", "u")
}
UNITS |= {
    f"{of}/{by}": Unit(
        f"{of}/{by}",
        Dimension.RATIO_PER_TEMPERATURE,
        UNITS[of].factor_to_si / UNITS[by].factor_to_si,
    )
    for of in ("1", "ppm", "um/m")
    for by in ("degC", "K", "degF")
}
SI_SYMBOLS: dict[Dimension, str] = {
    Dimension.LENGTH: "m",
    Dimension.ANGLE: "rad",
    Dimension.RATIO: "1",
    Dimension.PIXEL: "px",
    Dimension.COUNT: "",
    Dimension.TEMPERATURE: "degC",
    Dimension.TIME: "s",
    Dimension.FORCE: "N",
    Dimension.MOMENT: "Nm",
    Dimension.RATIO_PER_TEMPERATURE: "1/degC",
}
SI_SYMBOLS |= {UNITS[f"{of}/{by}"].dimension: f"{of}/{by}" for by in SLOPES for of in SLOPES[by]}

# Units of tables if the robot file states no others.
DISPLAY_UNITS: dict[Dimension, Unit] = {
    Dimension.LENGTH: UNITS["mm"],
    Dimension.ANGLE: UNITS["deg"],
    Dimension.RATIO: UNITS["1"],
    Dimension.PIXEL: UNITS["px"],
    Dimension.TEMPERATURE: UNITS["degC"],
    Dimension.TIME: UNITS["s"],
    Dimension.FORCE: UNITS["N"],
    Dimension.MOMENT: UNITS["Nm"],
    Dimension.RATIO_PER_TEMPERATURE: UNITS["ppm/K"],
}
DISPLAY_UNITS |= {
    unit.dimension: unit for unit in UNITS.values() if re.match("u(m|rad)/[^m]", unit.symbol)
}

# Examples of quantities, for messages.
EXAMPLES: Mapping[Dimension, str] = {
    Dimension.LENGTH: "0.02mm",
    Dimension.ANGLE: "0.01deg",
    Dimension.RATIO: "1.5 1",
    Dimension.PIXEL: "0.1px",
    Dimension.TEMPERATURE: "21.5degC",
    Dimension.TIME: "60s",
    Dimension.FORCE: "500N",
    Dimension.MOMENT: "20Nm",
    Dimension.RATIO_PER_TEMPERATURE: "11.5ppm/K",
}


def list_symbols(dimension: Dimension | None = None) -> tuple[str, ...]:
    """Return the allowed unit symbols, of one dimension or of all but slopes."""
    of = [d for d in Dimension if " per " not in d.value] if dimension is None else [dimension]
    return tuple(s for s, u in UNITS.items() if u.dimension in of)


ARTICLES = {
    Dimension.LENGTH: "a length",
    Dimension.ANGLE: "an angle",
    Dimension.RATIO: "a ratio",
    Dimension.PIXEL: "a number of pixels",
    Dimension.TEMPERATURE: "a temperature",
    Dimension.TIME: "a time",
}


def find_unit(symbol: str, dimension: Dimension | None = None) -> Unit:
    """Return the unit with this symbol.

    UnitError
        Unknown symbol, or a unit of another than the given dimension; lists the allowed ones.
    """
    known = UNITS.get(symbol)
    if known is not None and dimension in (None, known.dimension):
        return known
    allowed = list_symbols(dimension)
    if known is None:
        raise UnitError(
            f"unknown unit {symbol!r}{suggest_names(symbol, allowed)}. Allowed: "
            f"{', '.join(allowed)}"
        )
    assert dimension is not None
    needed = ARTICLES.get(dimension, f"a {dimension.value}")
    raise UnitError(
        f"{symbol!r} is a unit of {known.dimension.value}, not of {needed}. "
        f"Allowed: {', '.join(allowed)}"
    )


# A number of a file. Python also reads `1_000`, digits of other alphabets and longer exponents.
NUMBER = re.compile(
    r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d{1,5})?|inf(?:inity)?|nan)", re.ASCII | re.IGNORECASE
)


def parse_number(text: str) -> float | None:
    """Return the number that a text states, which may be infinite or NaN; None for other text."""
    return float(text) if NUMBER.fullmatch(text.strip()) else None


def parse_quantity(
    text: str, dimension: Dimension | None = None, is_difference: bool = False
) -> float:
    """Return the SI value of a number with its unit, such as `0.02mm` or `5 urad`, also as the
    difference of two values.

    UnitError : not a finite number, unit missing, unknown, or of another dimension.
    """
    stripped, example = text.strip(), EXAMPLES[dimension or Dimension.LENGTH]
    number = NUMBER.match(stripped)
    if number is None:
        raise UnitError(f"{text!r} is not a number with a unit. Write for example {example}")
    value, symbol = float(number[0]), stripped[number.end() :].strip()
    if not math.isfinite(value):
        raise UnitError(
            f"{text!r} is not finite. Write a finite number with a unit, for example {example}"
        )
    if not symbol:
        raise UnitError(
            f"{text!r} has no unit. Add one of {', '.join(list_symbols(dimension))}, for example "
            f"{example}"
        )
    unit = find_unit(symbol, dimension)
    return to_si(value, replace(unit, offset=0.0) if is_difference else unit)


def parse_goal(text: str) -> tuple[float, str]:
    """Return a length or an angle in SI, and the quantity that it limits."""
    with suppress(UnitError):
        return parse_quantity(text, Dimension.ANGLE), "orientation"
    try:
        return parse_quantity(text, Dimension.LENGTH), "position"
    except UnitError as error:
        raise UnitError(f"{error}, or give an angle, such as 10urad") from None


def scale(value: float, factor: float) -> float:
    """Return a number times a factor: 1e-3 is a division by 1000, which rounds once."""
    divisor = round(1.0 / factor)
    return value / divisor if divisor * factor == 1.0 else value * factor


def format_scaled(value: float, factor: float) -> str:
    """Return value / factor with the fewest digits whose double `scale` makes `value` again, with
    `factor` (SI per unit); all 17 digits where no shorter text returns it.
    """
    divisor = round(1.0 / factor)
    scaled = value * divisor if divisor * factor == 1.0 else value / factor
    texts = (f"{scaled:.{digits}g}" for digits in (15, 16, 17))
    return next((t for t in texts if scale(float(t), factor) == value), repr(float(scaled)))


def to_si(value: float, unit: Unit) -> float:
    """Return a finite number in SI.

    UnitError : the number is larger than LARGEST, or a temperature below absolute zero.
    """
    if not abs(value) <= LARGEST / unit.factor_to_si:
        shown = (
            f"{value:g}" if isinstance(value, float) else f"a number of {len(str(value))} digits"
        )
        raise UnitError(
            f"{shown} {unit} exceeds {LARGEST:g} {SI_SYMBOLS[unit.dimension]}. Write a number "
            "that a machine can have"
        )
    si = scale(value, unit.factor_to_si) + unit.offset
    if unit.offset and si < ABSOLUTE_ZERO - ROUNDING:
        raise UnitError(f"{value:g} {unit} is below absolute zero. Correct it")
    return si


def is_sd(value: Any) -> Any:
    """Return whether a number, or which of an array, can be a standard deviation: SD_RANGE."""
    return (value >= SMALLEST_SD) & (value <= LARGEST)


def find_sd_fault(value: float) -> str | None:
    """Return what to write in place of a standard deviation [SI]; None where it can be used."""
    if is_sd(value):
        return None
    return "write a positive number" if not value > 0.0 else f"write a number {SD_RANGE}"
