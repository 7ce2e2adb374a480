# SPDX-License-Identifier: Apache-2.0
"""JSON without NaN: a number that is not finite becomes null, and `nulls` says at which place and
why.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from loopcal import serialization


def to_json(document: Mapping[str, Any]) -> str:
    """Return a document as JSON text with a final line break.

    Parameters
    ----------
    document : mapping
        Values may be dataclasses, arrays, enums, paths, numbers, text, lists and mappings of these.

    Returns
    -------
    str
        Where a number was not finite there is null, and the key `nulls` of the document maps its
        place, such as `parameters/3/plus_minus`, to the reason.
    """
    nulls: dict[str, str] = {}
    content = serialization.to_json(document, nulls)
    if nulls:
        content["nulls"] = nulls
    return json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
