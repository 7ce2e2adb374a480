# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can cause and repair: one tree, `LoopcalError`.

The text of an error says what was found, what is allowed and what to do next. The command line
prints it and exits with 1. Any other exception is a defect of loopcal.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import Any, Self

from loopcal.findings import Finding, report_finding
from loopcal.plain_text import escape

MOST_NAMES = 2000  # names that are compared with a wrong one, which takes some microseconds each


class LoopcalError(Exception):
    """Base of all errors that a user can cause and repair; made from a sentence or a finding."""

    @classmethod
    def of(cls, code: str, /, *place: Any, **data: Any) -> Self:
        """Return the error of a finding of the catalog; place : path and line of a `FileError`."""
        return cls(report_finding(code, **data), *place)

    @property
    def code(self) -> str | None:
        """Code of the finding behind this error, or behind the error that caused it; None where
        both were made from sentences.
        """
        return None if self.finding is None else self.finding.code

    @property
    def finding(self) -> Finding | None:
        """The finding behind this error, or behind the error that caused it; None where both were
        made from sentences.
        """
        content = self.args[0] if self.args else None
        if isinstance(content, Finding):
            return content
        return self.__cause__.finding if isinstance(self.__cause__, LoopcalError) else None


class UnitError(LoopcalError):
    """A unit that is missing, unknown or of the wrong dimension."""


class MechanismError(LoopcalError):
    """A robot that cannot be built as described (mobility, joints, dimensions)."""


class DataError(LoopcalError):
    """Measurements that do not fit the robot, or are too few, or contradict themselves."""


class EstimationError(LoopcalError):
    """An estimate that cannot be made from these data with this method."""


class StudyError(LoopcalError):
    """A study that cannot be computed as asked, such as without workers."""


class MissingPackageError(LoopcalError, ImportError):
    """An optional package that is not installed; the text says how to install it."""


class FileError(LoopcalError):
    """A file that cannot be read or written; `str` gives `path:line: sentence`.

    Parameters
    ----------
    sentence : what was found, what is allowed, what to do.
    path : the file (or folder) as the user named it.
    line : line number, counted from 1; None where the whole file is meant.
    """

    def __init__(self, sentence: object, path: str | Path, line: int | None = None) -> None:
        super().__init__(sentence, path, line)
        self.sentence = sentence
        self.path: Path = Path(path)
        self.line = line

    def __str__(self) -> str:
        path = escape(str(self.path))
        place = path if self.line is None else f"{path}:{self.line}"
        return f"{place}: {self.sentence}"


def suggest_names(name: str, allowed: Iterable[str], n: int = 3) -> str:
    """Return ` (did you mean 'a' or 'b'?)` with the allowed names closest to `name`.

    The text is empty if no name is similar, or where there are more names than `MOST_NAMES`, such
    as those of all poses: then any wrong name is similar to many.
    """
    names = list(islice(allowed, MOST_NAMES + 1))
    if len(names) > MOST_NAMES:
        return ""
    close = difflib.get_close_matches(name, names, n=n, cutoff=0.6)
    return f" (did you mean {' or '.join(repr(c) for c in close)}?)" if close else ""
