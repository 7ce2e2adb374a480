# SPDX-License-Identifier: Apache-2.0
"""Registries: from the name of a kind, loss, method or format to what implements it.

loopcal fills a registry by one line for each entry. Another package adds its own by a call of
`register`, or by an entry point of the registry's group, so that the command line finds it, too
(docs/extending.md). An entry is imported when it is looked up.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, TypeVar

from loopcal.errors import DataError, suggest_names

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")
E = TypeVar("E")


class UnknownNameError(DataError, KeyError):
    """A name that a registry does not have; the text lists those that it has."""

    def __str__(self) -> str:
        """Return the text; a KeyError would put it in quotes."""
        return Exception.__str__(self)


class Registry(Mapping[str, T]):
    """Entries by name; an unknown name is an `UnknownNameError`.

    noun : what an entry is, for messages. group : of entry points of other packages, which are
        read only if loopcal itself does not have a name, or if all names are listed; empty for
        entries of loopcal alone.
    places : name -> module and name of an entry of loopcal, as in `package.module:Name`.
    aliases : other names that are accepted, but not listed -> name.
    """

    def __init__(
        self,
        noun: str,
        group: str,
        places: Mapping[str, str] | None = None,
        aliases: Mapping[str, str] | None = None,
    ) -> None:
        self.noun: str = noun
        self.group: str = group
        self.aliases: dict[str, str] = dict(aliases or {})
        self._places = dict(places or {})
        self._registered: dict[str, T] = {}

    def register(self, entry: E, /) -> E:
        """Add an entry under its attribute `name`, and return it; also a decorator of classes.

        It replaces an earlier entry of this name, as when a notebook executes a cell again, but
        none of loopcal itself.

        DataError : the entry has no name, or the name of an entry of loopcal.
        """
        name = getattr(entry, "name", None)
        if not isinstance(name, str) or not name:
            raise DataError(f"{entry!r} has no name; a {self.noun} needs the attribute 'name'")
        if name in self._places or name in self.aliases:
            raise DataError(f"{name!r} is the name of a {self.noun} of loopcal. Choose another")
        self._registered[name] = entry  # type: ignore[assignment]  # what is registered is a T
        return entry

    def resolve(self, name: str) -> str:
        """Return the listed name of an entry for a name or alias.

        UnknownNameError : there is none.
        """
        name = self.aliases.get(name, name)
        if name in self._places or name in self._registered or name in self._offered:
            return name
        hint = suggest_names(str(name), self)
        raise UnknownNameError(f"{name!r} is not a {self.noun}{hint}. Known: {', '.join(self)}")

    def __getitem__(self, name: str) -> T:
        name = self.resolve(name)
        if name in self._places:
            module, _, attribute = self._places[name].partition(":")
            return getattr(import_module(module), attribute)
        if name in self._registered:
            return self._registered[name]
        try:
            return self._offered[name].load()
        except (ImportError, AttributeError) as error:
            place = f"the {self.noun} {name!r} of {self._offered[name].value}"
            raise DataError(f"cannot load {place}: {error}") from error

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._places, *self._registered, *sorted(self._offered))))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        known = (self._places, self._registered, self.aliases)
        return any(name in names for names in known) or name in self._offered

    # a registry is itself, not its entries: it may stand in an annotation
    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other

    def __repr__(self) -> str:
        return f"<Registry of {self.noun}: {', '.join(self)}>"

    @property
    def _offered(self) -> Mapping[str, EntryPoint]:
        """The entry points of other packages by name."""
        return _list_entry_points(self.group) if self.group else {}


@cache
def _list_entry_points(group: str) -> Mapping[str, EntryPoint]:
    """Return name -> entry point of all installed packages (cached: listing takes 30 ms)."""
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=group)}
