# SPDX-License-Identifier: Apache-2.0
"""Templates of sentences: `str.format` with formats for names, numbers and optional parts.

In addition to the formats of Python, where `...` is a template again:

| field | words |
| --- | --- |
| `{names:list}` | `a, b and c`; of many names the first ones `and 3 more` |
| `{n:count pose}`, `{n:count axis/axes}` | a number with its noun: 1 pose, 3 poses; 2 axes |
| `{share:percent}`, `{ratio:factor}` | a share as per cent; a factor, in full where it is large |
| `{clause:sentence}` | a clause as a sentence, with a capital letter and a full stop |
| `{value:if|...|...}` | the first part where there is a value other than zero, else the second |
| `{n:plural|...|...}` | the first part for one (a number, or a sequence of one), else the second |
| `{key:choose|a=...|b=...|...}` | the part of this key; the last part for any other |
| `{rows:each|...}` | a part for each row (fields: its keys, or `item`), joined like names |
| `{rows:each 3|...}`, `{rows:each; |...}` | the same, for the first 3 rows; joined by `; ` |
| `{names+units:each|...}` | rows from tuples of equal length, with their names as fields |
| `{name()}` | a phrase of the catalog: of `phrases.toml`, or a function of `phrases.py` |
| `{subject.code()}`, `{row:finding}` | the text of another finding with these data, or of a row |

A number without a format has three significant digits; a `Quantity` also its unit.
"""

from __future__ import annotations

import math
import string
from collections.abc import Mapping, Sequence, Sized
from functools import cache
from typing import Any, NamedTuple

SHOWN_NAMES = 10  # names that a sentence lists before it counts the others
_PYTHON = string.Formatter()


def add_advice(sentence: object, advice: str | None) -> str:
    """Return a sentence, such as a finding, with advice in parentheses where there is any."""
    return str(sentence) if advice is None else f"{sentence} (Hint: {advice})"


FINER = {"m": ("mm", 1e3), "mm": ("um", 1e3), "um": ("nm", 1e3), "rad": ("mrad", 1e3)}
FINER |= {"mrad": ("urad", 1e3), "deg": ("urad", 1e6 * math.pi / 180.0)}
"""Unit -> the next finer one, and its number of them."""

SMALL, FINE = 0.01, 0.1
"""Numbers below which a finer unit is read, 7 um instead of 0.007 mm; and in what people sign."""


def choose_symbol(size: float, symbol: str, small: float = SMALL) -> tuple[str, float]:
    """Return the unit in which a number of this size is read, and how many of it make up `symbol`;
    a size of 0 keeps its unit. small : see `SMALL`.
    """
    factor = 1.0
    while symbol in FINER and 0.0 < round(abs(size) * factor, 12) < small:  # 0.01 may be rounded
        symbol, finer = FINER[symbol]
        factor *= finer
    return symbol, factor


class Quantity(NamedTuple):
    """A number with the symbol of its unit, such as `Quantity(0.19, "mm")`."""

    value: float
    unit: str

    def __str__(self) -> str:
        """Return three significant digits, whole numbers below a million, and a fitting unit."""
        symbol, factor = choose_symbol(self.value, self.unit)
        value = factor * self.value
        if 999.5 <= abs(value) < 1e6:
            return f"{value:.0f} {symbol}".rstrip()
        return f"{round_to_digits(value)} {symbol}".rstrip()


def round_to_digits(value: float, digits: int = 3) -> str:
    """Return a number with this many significant digits; what is not finite is a word."""
    if math.isnan(value):
        return "unknown"
    if math.isinf(value):
        return "unbounded"
    return write_small(f"{value:.{digits}g}")


SMALLEST = 7  # largest negative power of ten that is written as zeros, as beside larger numbers


def write_small(number: str) -> str:
    """Return a number as text with zeros in place of a power of ten, such as 0.0000828."""
    digits, _, power = number.partition("e-")
    if not power or int(power) > SMALLEST:
        return number
    return f"{float(number):.{len(digits.partition('.')[2]) + int(power)}f}"


def name_count(count: float, singular: str, plural: str = "") -> str:
    """Return a number with its noun, whose plural has an s unless it is stated."""
    return f"{count} {singular if count == 1 else plural or singular + 's'}"


def count_decimals(uncertainty: float, digits: int = 2) -> int:
    """Return the decimals that show so many significant digits of a number above 0, at most 12.

    Two are those of an uncertainty (JCGM 100, 7.2.6).
    """
    rounded = float(f"{uncertainty:.{digits - 1}e}")  # 9.96 shows as 10, which has one decimal less
    return min(max(digits - 1 - math.floor(math.log10(rounded)), 0), 12)


def list_names(names: Sequence[Any], shown: int = SHOWN_NAMES) -> str:
    """Return `a, b and c`; of more than `shown` names the first ones and `and 3 more`."""
    words = [str(name) for name in names]
    if len(words) > shown:
        return f"{', '.join(words[:shown])} and {len(words) - shown} more"
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


def fill_template(template: str, /, **data: Any) -> str:
    """Return a template filled with data."""
    words = []
    for text, name, spec, conversion in parse_template(template):
        words.append(text)
        if name is not None:
            value = _PYTHON.convert_field(_look_up(name, data), conversion)
            words.append(_word_parts(value, spec, data) if "|" in spec else _word(value, spec))
    return "".join(words)


def list_fields(template: str) -> frozenset[str]:
    """Return the names of the data that a template shows, those of optional parts included."""
    fields: set[str] = set()
    for _, name, spec, _ in parse_template(template):
        if name and not name.endswith("()"):
            fields.update(part.split(".")[0].split("[")[0] for part in name.split("+"))
        if "|" in spec and not spec.startswith("each"):
            fields |= list_fields(spec)
    return frozenset(fields)


def depends_on_data(template: str) -> bool:
    """Return whether the sentences of a template differ in more than names and numbers."""
    return any(
        name is not None and ("|" in spec or name.endswith("()"))
        for _, name, spec, _ in parse_template(template)
    )


@cache
def parse_template(template: str) -> tuple[tuple[str, str | None, str, str | None], ...]:
    """Return literal text, name, format and conversion of each field."""
    return tuple(
        (text, name, spec or "", conversion)
        for text, name, spec, conversion in _PYTHON.parse(template)
    )


@cache
def split_branches(text: str) -> tuple[str, ...]:
    """Return the branches between bars that are outside of braces."""
    branches, depth = [""], 0
    for character in text:
        depth += {"{": 1, "}": -1}.get(character, 0)
        if character == "|" and depth == 0:
            branches.append("")
        else:
            branches[-1] += character
    return tuple(branches)


def _look_up(name: str, data: Mapping[str, Any]) -> Any:
    """Return the value of a field: data, rows of several data, a phrase, or another finding."""
    if name.endswith("()"):
        from loopcal.findings.catalog import word_phrase

        return word_phrase(name.removesuffix("()"), data)
    if "+" in name:
        names = name.split("+")
        rows = zip(*(data[name] for name in names), strict=True)
        return [dict(zip(names, row, strict=True)) for row in rows]
    return _PYTHON.get_field(name, (), data)[0]


def _word_parts(value: Any, spec: str, data: Mapping[str, Any]) -> str:
    """Word a field that chooses or repeats templates."""
    rule, _, text = spec.partition("|")
    if rule.startswith("each"):
        rows = [{"item": row, **(row if isinstance(row, Mapping) else {})} for row in value]
        words = [fill_template(text, **{**data, **row}) for row in rows]
        joint = rule.removeprefix("each")
        if joint and not joint.strip().isdigit():
            return joint.join(words)
        return list_names(words, int(joint or SHOWN_NAMES))
    branches = split_branches(text)
    if rule == "choose":
        named = dict(part.split("=", 1) for part in branches[:-1])
        return fill_template(named.get(str(value), branches[-1]), **data)
    if rule == "plural":
        is_first = (len(value) if isinstance(value, Sized) else value) == 1
    else:
        assert rule == "if", spec
        is_first = bool(value)
    return fill_template((*branches, "")[0 if is_first else 1], **data)


def _word(value: Any, spec: str) -> str:
    """Word a value in one of the formats, or in one of Python's."""
    if spec == "list":
        return list_names(value)
    if spec == "finding":
        from loopcal.findings.catalog import find_entry

        return find_entry(value["code"]).word(value)
    if isinstance(value, float) and not math.isfinite(value):
        return round_to_digits(value)
    if spec == "percent":
        if 0.9995 <= value < 1.0:
            return "more than 99.9 %"
        return "less than 0.0001 %" if 0.0 < value < 1e-6 else f"{round_to_digits(100.0 * value)} %"
    if spec == "factor":
        return f"{value:.0f}" if 100.0 <= value < 1e6 else f"{value:.2g}"
    if spec == "sentence":
        text = str(value)
        return f"{text[0].upper()}{text[1:].rstrip('.')}."
    if spec.startswith("count "):
        singular, _, plural = spec.removeprefix("count ").partition("/")
        return name_count(value, singular, plural)
    if isinstance(value, Quantity):
        return str(value)
    if spec == "" and isinstance(value, float):
        return round_to_digits(value)
    return format(value, spec)
