# SPDX-License-Identifier: Apache-2.0
"""JSON text without NaN: numbers that are not finite become null, with the reason under `nulls`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from loopcal import serialization


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
    return json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
