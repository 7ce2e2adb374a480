# SPDX-License-Identifier: Apache-2.0
"""How catalog entries become sentences: templates with a few formats for numbers and names."""

from __future__ import annotations

import math
import string
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from loopcal.findings.finding import Severity

SHOWN_NAMES = 10
"""Names that a sentence lists before it counts the others."""


class Quantity(NamedTuple):
    """A number with the symbol of its unit, such as `Quantity(0.19, "mm")`."""

    value: float
    unit: str

    def __str__(self) -> str:
        """Return three significant digits and the unit."""
        return f"{round_to_digits(self.value)} {self.unit}".rstrip()


def round_to_digits(value: float, digits: int = 3) -> str:
    """Return a number with this many significant digits; what is not finite is a word."""
    if math.isnan(value):
        return "unknown"
    if math.isinf(value):
        return "unbounded"
    return f"{value:.{digits}g}"


def list_names(names: Sequence[Any], shown: int = SHOWN_NAMES) -> str:
    """Return `a, b and c`; of more than `shown` names the first ones and `and 3 more`."""
    words = [str(name) for name in names]
    if len(words) > shown:
        return f"{', '.join(words[:shown])} and {len(words) - shown} more"
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


class _Formatter(string.Formatter):
    """`str.format` with four more formats.

    `{names:list}` lists names. `{n:count pose}` counts with the right number: 1 pose, 3 poses;
    `{n:count axis/axes}` states the plural. `{share:percent}` is a share as per cent. A number
    without a format has three significant digits; a `Quantity` also its unit.
    """

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec == "list":
            return list_names(value)
        if format_spec == "percent":
            return f"{round_to_digits(100.0 * value)} %"
        if format_spec.startswith("count "):
            one, _, many = format_spec.removeprefix("count ").partition("/")
            return f"{value} {one if value == 1 else many or one + 's'}"
        if isinstance(value, Quantity):
            return str(value)
        if format_spec == "" and isinstance(value, float):
            return round_to_digits(value)
        return super().format_field(value, format_spec)


_FORMATTER = _Formatter()


@dataclass(frozen=True)
class Entry:
    """One message of the catalog.

    Parameters
    ----------
    code : `subject.what`. severity : how much it matters.
    text : the sentence, a template over the data; or a function of the data, for sentences that
        differ in more than their numbers.
    when : one sentence for docs/findings.md: when it is reported.
    action : one sentence for docs/findings.md: what to do next. Empty where there is nothing to do.
    example : data of one case, for tests and documentation. Needed where `text` is a function, and
        where the data hold more than the sentence shows.
    """

    code: str
    severity: Severity
    text: str | Callable[[Mapping[str, Any]], str]
    when: str
    action: str = ""
    example: Mapping[str, Any] = field(default_factory=dict)

    def word(self, data: Mapping[str, Any]) -> str:
        """Return the sentence for these data."""
        if callable(self.text):
            return self.text(data)
        return _FORMATTER.vformat(self.text, (), data)

    @property
    def fields(self) -> frozenset[str]:
        """Names of the data: those of the template and of the example."""
        parts = [] if callable(self.text) else string.Formatter().parse(self.text)
        shown = {name.split(".")[0].split("[")[0] for _, name, _, _ in parts if name}
        return frozenset(shown | self.example.keys())


def fill_template(template: str, **data: Any) -> str:
    """Return a template of the catalog filled with data, for entries whose text is a function."""
    return _FORMATTER.vformat(template, (), data)
