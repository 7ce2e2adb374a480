# SPDX-License-Identifier: Apache-2.0
"""Many numbers as text at once, to the same doubles as one after the other by `parse_exact`.

A plain decimal has a sign or none, up to 18 digits and a point or none: m / 10^k with a whole
number m < 2^63. It is multiplied by factor / 10^k in arithmetic of two doubles, whose relative
error is below 1e-30. The sum of the two doubles, rounded, is the double nearest to the exact
product, except where that product lies within 1e-25 of the middle between two doubles. Those, and
all other texts, are left to the caller. Source of the exact product of two doubles: Dekker, A
floating-point technique for extending the available precision, Numerische Mathematik 18 (1971).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from loopcal.typing import BoolArray, FloatArray, IntArray

MOST_DIGITS = 18
"""Digits of a plain decimal, so that its whole number is below 2^63."""

WIDTH = MOST_DIGITS + 2
"""Characters of the longest plain decimal: with its sign and its point."""

CHUNK = 1 << 16
"""Cells that are converted at once."""

UNDECIDED = 1e-9
"""Distance from the middle between two doubles, as a share of half their distance, below which the
rounded product is not certain: twice 10^-25 of the number, far beyond all rounding.
"""

SPLITTER = 2.0**27 + 1.0
"""Splits a double into two halves of 26 bits (Dekker)."""


def parse_decimals(cells: Sequence[str], factor: float) -> tuple[FloatArray, BoolArray]:
    """Return the products of plain decimals and a factor, each rounded once.

    Parameters
    ----------
    cells : (n,) texts without surrounding blanks. factor : positive, SI per unit of the text.

    Returns
    -------
    values : (n,) as `parse_exact` returns them; zero for the other cells.
    is_plain : (n,) whether a cell is a plain decimal whose product is certain.
    """
    values, is_plain = np.zeros(len(cells)), np.zeros(len(cells), dtype=bool)
    high, low = _scale_factor(factor)
    for begin in range(0, len(cells), CHUNK):
        part = slice(begin, begin + CHUNK)
        whole, decimals, is_negative, is_decimal = _read_digits(_encode(cells[part]))
        product, is_certain = _multiply(whole, high[decimals], low[decimals])
        is_plain[part] = is_decimal & is_certain
        signed = np.where(is_negative, -product, product)
        values[part] = np.where(is_plain[part], signed, 0.0)
    return values, is_plain


def _encode(cells: Sequence[str]) -> np.ndarray:
    """Return the characters (WIDTH + 1, n) of texts, 0 behind their end."""
    size = WIDTH + 1  # one more, so that a longer text is noticed
    try:
        texts = np.array(cells, dtype=f"S{size}")
    except UnicodeEncodeError:
        texts = np.array([cell.encode("ascii", "replace") for cell in cells], dtype=f"S{size}")
    return np.ascontiguousarray(texts.view(np.uint8).reshape(len(cells), size).T)


def _read_digits(characters: np.ndarray) -> tuple[IntArray, IntArray, BoolArray, BoolArray]:
    """Return the whole numbers (n,), their decimals (n,), whether they are negative, and whether
    the texts with these characters (c, n) are plain decimals; numbers of others mean nothing.
    """
    n = characters.shape[1]
    whole, digits, decimals = (np.zeros(n, dtype=np.int64) for _ in range(3))
    is_negative = characters[0] == ord("-")
    is_decimal = characters[-1] == 0
    has_point = np.zeros(n, dtype=bool)
    for place, column in enumerate(characters):
        if not column.any():
            break
        digit = column - np.uint8(ord("0"))  # wraps around below "0"
        is_digit, is_point = digit <= 9, column == ord(".")
        whole = np.where(is_digit & (digits < MOST_DIGITS), 10 * whole + digit, whole)
        digits += is_digit
        decimals += is_digit & has_point
        is_allowed = is_digit | (is_point & ~has_point) | (column == 0)
        if place == 0:
            is_allowed |= is_negative | (column == ord("+"))
        is_decimal &= is_allowed
        has_point |= is_point
    is_decimal &= (digits > 0) & (digits <= MOST_DIGITS)
    return whole, np.minimum(decimals, MOST_DIGITS), is_negative, is_decimal


def _scale_factor(factor: float) -> tuple[FloatArray, FloatArray]:
    """Return factor / 10^k for k = 0..MOST_DIGITS as sums of two doubles (k,)."""
    exact = [Fraction(repr(factor)) / 10**k for k in range(MOST_DIGITS + 1)]
    high = [float(value) for value in exact]
    low = [float(value - Fraction(h)) for value, h in zip(exact, high, strict=True)]
    return np.array(high), np.array(low)


def _multiply(whole: IntArray, high: FloatArray, low: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the doubles nearest to whole * (high + low), and where they are certain."""
    m = whole.astype(np.float64)
    rest = (whole - m.astype(np.int64)).astype(np.float64)
    product = m * high
    left = _find_rounding(m, high, product) + (m * low + rest * high)
    nearest = product + left
    left -= nearest - product
    half = 0.5 * np.abs(np.nextafter(nearest, np.where(left < 0.0, -np.inf, np.inf)) - nearest)
    return nearest, half - np.abs(left) >= UNDECIDED * half


def _find_rounding(a: FloatArray, b: FloatArray, product: FloatArray) -> FloatArray:
    """Return a * b - product exactly, where `product` is a * b rounded."""
    a_high, b_high = (x * SPLITTER - (x * SPLITTER - x) for x in (a, b))
    a_low, b_low = a - a_high, b - b_high
    error = a_high * b_high - product + a_high * b_low + a_low * b_high
    return np.asarray(error + a_low * b_low)
