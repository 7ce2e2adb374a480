# SPDX-License-Identifier: Apache-2.0
"""JSON text without NaN: numbers that are not finite become null, with the reason under `nulls`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from loopcal import serialization

_SURROGATE = re.compile("[\ud800-\udfff]")
"""Half a character: part of a file name that is not UTF-8."""


def to_json(document: Mapping[str, Any]) -> str:
    """Return a document as JSON text that ends with a line break.

    Parameters
    ----------
    document : values may be dataclasses, arrays, enums, paths, numbers, text, lists and mappings.

    Returns
    -------
    A number that is not finite becomes null. The key `nulls` then maps its place, such as
    `parameters/3/plus_minus`, to the reason.
    """
    nulls: dict[str, str] = {}
    content = serialization.to_json(document, nulls)
    if nulls:
        content["nulls"] = nulls
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    return _SURROGATE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)
