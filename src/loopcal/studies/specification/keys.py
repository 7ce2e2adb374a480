# SPDX-License-Identifier: Apache-2.0
"""Keys of blocks: a hash of everything that determines their numbers, and of nothing else.

Titles, names of levels, the order of the file, replicates, questions and other cells are not part
of it, so that more replicates and further levels keep all finished blocks. Values that equal their
default are left out, so that a new setting of a later version changes no key.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from loopcal.studies.specification.cells import Cell, select_levels

if TYPE_CHECKING:
    from loopcal.studies.specification.study import Study

T = TypeVar("T")

NUMERICS = 2
"""Version of the numbers of a block; another one makes all blocks anew.

2: fits begin with chords, so that estimates differ from those of version 1 by less than 1e-3
standard deviations, and the iterations are fewer.
"""


def describe_block(study: Study, cell: Cell, block: int) -> dict[str, Any]:
    """Return everything that determines the numbers of a block, as plain values."""
    levels = select_levels(study, cell)
    robot = levels.pop("robot")
    levels["poses"] = replace(levels["poses"], file=None)  # its poses count, not its name
    return {
        "numerics": NUMERICS,
        "seed": study.seed,
        "block": block,
        "trials": study.block,
        "robot": robot.text,
        **{name: describe_record(level) for name, level in levels.items()},
        "scores": describe_record(study.scores),
    }


def compute_key(content: Mapping[str, Any]) -> str:
    """Return the hash of the description of a block."""
    return hashlib.sha256(format_json(content).encode()).hexdigest()


def format_json(content: Mapping[str, Any]) -> str:
    """Return plain values as canonical JSON: sorted keys, shortest numbers, ASCII."""
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)


def describe_record(record: Any) -> dict[str, Any]:
    """Return the fields of a record that differ from their defaults, as plain values."""
    fields: dict[str, Any] = _make_adapter(type(record)).dump_python(
        record, mode="json", exclude_defaults=True
    )
    return fields


def read_record(record: type[T], fields: Mapping[str, Any]) -> T:
    """Return the record of `describe_record`."""
    return load_json(record, json.dumps(fields))


def dump_json(record: Any) -> str:
    """Return a record as JSON."""
    text: bytes = _make_adapter(type(record)).dump_json(record)
    return text.decode()


def load_json(record: type[T], text: str) -> T:
    """Return the record of a text of `dump_json`."""
    value: T = _make_adapter(record).validate_json(text, strict=True)
    return value


@cache
def _make_adapter(record: type) -> Any:
    """Return pydantic's reader and writer of a record; made once, because that takes long."""
    from pydantic import TypeAdapter

    return TypeAdapter(record)
