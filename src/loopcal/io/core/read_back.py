# SPDX-License-Identifier: Apache-2.0
"""Comparison of what was written with what is read from the written file (`read_back`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError

LONGEST = 200
"""Characters of a value in a message."""


def require_same(what: str, written: Any, read: Any) -> None:
    """Raise DataError where what was read differs from what was written."""
    if written != read:
        raise DataError(f"{what}: {_shorten(written)} was written, but {_shorten(read)} is read")


def _shorten(value: Any) -> str:
    """Return the beginning of what Python shows for a value."""
    text = repr(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}..."


def require_same_numbers(
    what: str, written: ArrayLike, read: ArrayLike, relative: float = 0.0
) -> None:
    """Raise DataError where numbers differ by more than a relative difference; NaN equals NaN."""
    a, b = np.asarray(written), np.asarray(read)
    require_same(f"shape of {what}", a.shape, b.shape)
    with np.errstate(invalid="ignore"):
        is_same = (a == b) | (np.abs(a - b) <= relative * np.abs(a)) | (np.isnan(a) & np.isnan(b))
    if not is_same.all():
        place = np.argmin(is_same)
        require_same(f"{what} [{place}]", float(a.flat[place]), float(b.flat[place]))
