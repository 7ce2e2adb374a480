# SPDX-License-Identifier: Apache-2.0
"""Names of a package, and entries of a registry, that are imported when they are first used.

A package that re-exports the names of its modules would import all of them for whoever needs one. A
command that calibrates needs half of the modules of loopcal, and spends as long on importing as on
computing. So a package states its names twice: for type checkers as imports, and for Python as a
table, from which `__getattr__` imports. A test compares the two.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import Any, TypeVar

T = TypeVar("T")


def import_lazily(package: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package.

    Parameters
    ----------
    package : its name. names : module -> names of the package in it, between blanks.
    """
    modules = {name: module for module, listed in names.items() for name in listed.split()}

    def load(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(modules[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return load


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
