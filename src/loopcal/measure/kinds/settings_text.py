# SPDX-License-Identifier: Apache-2.0
"""The settings of a kind that differ from their defaults, as text."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, fields
from typing import Any, cast

import numpy as np


def list_changed_settings(kind: Any) -> Iterator[str]:
    """Give `name=value` of each setting of a kind (a dataclass) that differs from its default."""
    for setting in fields(kind):
        value, factory = getattr(kind, setting.name), setting.default_factory
        usual = cast(Any, setting.default) if factory is MISSING else factory()
        if setting.init and not np.array_equal(value, usual):
            text = repr(value)
            if isinstance(value, np.ndarray):
                is_small = value.size <= 16
                text = f"{np.round(value, 6).tolist() if is_small else f'<array {value.shape}>'}"
            yield f"{setting.name}={text}"
