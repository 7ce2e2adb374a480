# SPDX-License-Identifier: Apache-2.0
"""JSON without NaN: a number that is not finite becomes null, and `nulls` says at which place and
why.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

INFINITE = "infinite: these data do not determine it"
UNDEFINED = "undefined: there is nothing to compute it from"


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
    content = _jsonable(document, (), nulls)
    if nulls:
        content["nulls"] = nulls
    return json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _jsonable(value: Any, place: tuple[str, ...], nulls: dict[str, str]) -> Any:
    """Return `value` as what the json module writes; fill `nulls`."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Enum):
        return value.name.lower()
    if value is None or isinstance(value, (bool, str)):
        return value
    to_list = getattr(value, "tolist", None)  # numpy arrays and numpy numbers
    if to_list is not None:
        return _jsonable(to_list(), place, nulls)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if math.isfinite(value):
            return value
        nulls["/".join(place)] = UNDEFINED if math.isnan(value) else INFINITE
        return None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {_key(k): _jsonable(v, (*place, _key(k)), nulls) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_jsonable(v, (*place, str(i)), nulls) for i, v in enumerate(value)]
    raise TypeError(f"{'/'.join(place)}: {type(value).__name__} has no JSON form")


def _key(key: Any) -> str:
    """Return a mapping's key as text; an enum by its name."""
    return key.name.lower() if isinstance(key, Enum) else str(key)
