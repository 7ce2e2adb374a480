# SPDX-License-Identifier: Apache-2.0
"""Places of the values of a document of JSON or YAML, and the document with another value there."""

import copy
from collections.abc import Iterator
from typing import Any


def list_places(node: Any, place: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Return the places of all values, of lists those of the first entry."""
    if place:
        yield place
    if isinstance(node, dict):
        for key in node:
            yield from list_places(node[key], (*place, key))
    if isinstance(node, list) and node:
        yield from list_places(node[0], (*place, 0))


def change_value(document: Any, place: tuple[str | int, ...], value: Any) -> Any:
    """Return a document with another value at a place; without it for `...`."""
    changed = copy.deepcopy(document)
    node = changed
    for step in place[:-1]:
        node = node[step]
    if value is ...:
        del node[place[-1]]
    else:
        node[place[-1]] = value
    return changed
