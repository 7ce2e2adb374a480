# SPDX-License-Identifier: Apache-2.0
"""A registry whose entries are imported when they are looked up.

A command that calibrates needs half of the modules; importing takes as long as computing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TypeVar

T = TypeVar("T")


class LazyRegistry(Mapping[str, T]):
    """A registry whose entries are imported when they are looked up.

    Parameters
    ----------
    places : key -> module and name of the entry, as in `package.module:Name`.
    """

    def __init__(self, places: Mapping[str, str]) -> None:
        self._places = dict(places)

    def __getitem__(self, key: str) -> T:
        module, _, name = self._places[key].partition(":")
        return getattr(import_module(module), name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, key: object) -> bool:
        return key in self._places

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._places})"
