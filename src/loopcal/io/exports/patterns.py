# SPDX-License-Identifier: Apache-2.0
"""Regular expressions of users, with a limit on their time.

A short pattern such as `(a+)+$` can take longer than the age of the universe for a line of forty
characters. Python's `re` cannot be stopped and no simple rule recognizes all such patterns, so the
module `regex` matches them: it has the same syntax, and a time after which it gives up. It writes
out what has to occur n times; therefore `refuse_pattern` limits these counts.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from typing import Any

import regex

from loopcal.findings import report_finding
from loopcal.io.core.limits import PATTERN_COUNTS, PATTERN_LENGTH, PATTERN_SECONDS
from loopcal.io.core.yaml_file import Location, YamlFile
from loopcal.plain_text import quote

SECONDS_PER_LINE = 1e-4
"""Time that each line of an export adds to the limit [s]."""

Pattern = regex.Pattern[str]

_COUNT = re.compile(r"\{\s*(\d*)\s*(?:,\s*(\d*)\s*)?\}")


class PatternClock:
    """The time that the patterns of one profile may still take for one export.

    Parameters
    ----------
    file : the profile. seconds : at first; each match adds SECONDS_PER_LINE.
    """

    def __init__(self, file: YamlFile, seconds: float = PATTERN_SECONDS.most) -> None:
        self.file: YamlFile = file
        self.seconds: float = seconds
        self.remaining: float = seconds

    def search(self, pattern: Pattern, text: str, location: Location) -> bool:
        """Return whether the pattern at `location` of the profile occurs; raise FileError."""
        return self._measure(pattern.search, text, location) is not None

    def match_all(
        self, pattern: Pattern, text: str, location: Location
    ) -> dict[str, str | None] | None:
        """Return the groups of the pattern where it is the whole text, else None; FileError."""
        match = self._measure(pattern.fullmatch, text, location)
        return None if match is None else match.groupdict()

    def _measure(self, match: Callable[..., Any], text: str, location: Location) -> Any:
        start = time.process_time()
        self.remaining += SECONDS_PER_LINE
        try:
            return match(text, timeout=max(self.remaining, SECONDS_PER_LINE))
        except TimeoutError:
            finding = report_finding("files.pattern-too-slow", seconds=self.seconds)
            raise self.file.error(finding, location) from None
        finally:
            self.remaining -= time.process_time() - start


def compile_pattern(text: str) -> Pattern:
    """Return a pattern that `refuse_pattern` accepted, as a PatternClock matches it."""
    return regex.compile(text)


def refuse_pattern(file: YamlFile, text: str, location: Location) -> None:
    """Raise FileError for text that is no regular expression, or beyond a limit."""
    for limit, count in ((PATTERN_LENGTH, len(text)), (PATTERN_COUNTS, _multiply_counts(text))):
        limit.check(count, f"pattern {_name_pattern(text)}", file.path, file.line(location))
    try:
        re.compile(text)
        compile_pattern(text)
    except (re.error, regex.error) as error:
        sentence = f"{_name_pattern(text)} is not a regular expression ({error}); correct it"
        raise file.error(sentence, location) from None
    except (RecursionError, OverflowError):
        sentence = f"the pattern {_name_pattern(text)} is too deeply nested; simplify it"
        raise file.error(sentence, location) from None


def _name_pattern(text: str) -> str:
    """Return a pattern in quotes, shortened for messages."""
    return quote(text if len(text) <= 40 else f"{text[:40]}..")


def _multiply_counts(text: str) -> int:
    """Return the product of all counts in braces, the larger one of each pair."""
    counts = (
        max(int(n) for n in (*match.groups("0"), "1") if n) for match in _COUNT.finditer(text)
    )
    return math.prod(counts)
