# SPDX-License-Identifier: Apache-2.0
"""JSON text without NaN: numbers that are not finite become null, with the reason under `nulls`.

Reading has one function, which turns every fault of the text into one sentence. What it returns is
plain: finite numbers, and no key twice.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from loopcal.errors import FileError
from loopcal.io.core.limits import JSON_DEPTH, JSON_VALUES, PROGRAM_SIZE, FileLimit
from loopcal.io.core.text_file import read_text
from loopcal.plain_text import escape_json
from loopcal.results import serialization

SHOWN = 20
"""Characters of a number that a message shows."""

LONGEST_WHOLE = 400
"""Digits of a whole number that are read; a double has 309."""


def to_json(document: Mapping[str, Any]) -> str:
    """Return a document (dataclasses, arrays, enums, paths, numbers, text, lists, mappings) as
    JSON text that ends with a line break.

    A number that is not finite becomes null. The key `nulls` then maps its place, such as
    `parameters/3/plus_minus`, to the reason.
    """
    return format_content(convert_document(document))


def convert_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of the JSON text of a document, see `to_json`."""
    nulls: dict[str, str] = {}
    content = serialization.to_json(document, nulls)
    return {**content, "nulls": nulls} if nulls else content


def format_content(content: Mapping[str, Any]) -> str:
    """Return the JSON text of what `convert_document` returns."""
    return escape_json(json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)) + "\n"


def read_json(path: str | Path, what: str, action: str, limit: FileLimit = PROGRAM_SIZE) -> Any:
    """Return the content of a JSON file; `what` it should be and the `action` to take are for
    messages.

    FileError : see `read_text`; or not JSON, a number that is not finite, a key that is there
    twice, or nested too deeply.
    """
    text = read_text(path, what, limit=limit)
    JSON_VALUES.check(sum(text.count(sign) for sign in ",:[{"), what, path)
    try:
        content = json.loads(
            text,
            parse_float=lambda number: _refuse_infinite(float(number), number),
            parse_int=lambda number: _refuse_infinite(
                int(number) if len(number) <= LONGEST_WHOLE else math.inf, number
            ),
            parse_constant=lambda name: _refuse_infinite(math.nan, name),
            object_pairs_hook=_refuse_duplicates,
        )
    except json.JSONDecodeError as error:
        sentence = f"not valid JSON ({error.msg}); {action}"
        raise FileError(sentence, path, error.lineno) from None
    except ValueError as error:
        raise FileError(f"not valid JSON ({error}); {action}", path) from None
    except RecursionError:
        raise JSON_DEPTH.make_error(what, path) from None
    depth, layer = 0, [content]
    while layer := [node for node in layer if isinstance(node, list | dict)]:
        depth += 1
        layer = [c for n in layer for c in (n.values() if isinstance(n, dict) else n)]
    JSON_DEPTH.check(depth, what, path)
    return content


def _refuse_infinite(value: float, text: str) -> float:
    """Return a number that fits a double."""
    try:
        is_finite = math.isfinite(float(value))
    except OverflowError:
        is_finite = False
    if not is_finite:
        if len(text) > SHOWN:
            raise ValueError(f"the number {text[:SHOWN]}… is too large")
        raise ValueError(f"the number {text} is not finite")
    return value


def _refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the mapping of a JSON object whose keys are different."""
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"the key {key!r} is there twice")
        content[key] = value
    return content
