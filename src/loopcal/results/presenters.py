# SPDX-License-Identifier: Apache-2.0
"""The registry of what a description cannot say: figures, and pages of a special form, by class.

The modules that register them are above the results; `loopcal/__init__.py` names these modules.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Presenter = Callable[..., Any]
Registered = TypeVar("Registered", bound=Presenter)

_PRESENTERS: dict[tuple[str, type], Presenter] = {}
_MODULES: dict[str, list[str]] = {}
"""Beginning of a name of presenters -> modules that register them."""


def name_presenters(**modules: Sequence[str]) -> None:
    """Name modules that register presenters, such as `page=["package.pages"]`; they are imported
    when the first such presenter is looked for.
    """
    for name, named in modules.items():
        _MODULES.setdefault(name, []).extend(named)


def register(name: str, *classes: type) -> Callable[[Registered], Registered]:
    """Return a decorator of the function that makes the "page" or a "figure" of these classes.

    The name of a figure of several is `figure NAME`.
    """

    def add(function: Registered) -> Registered:
        _PRESENTERS.update({(name, of_class): function for of_class in classes})
        return function

    return add


def find_presenter(name: str, of_class: type) -> Presenter | None:
    """Return the registered function of a class; None where there is none."""
    for module in _MODULES.get(name.partition(" ")[0], ()):
        import_module(module)
    for base in of_class.__mro__:
        if (name, base) in _PRESENTERS:
            return _PRESENTERS[name, base]
    return None


def draw(result: object, name: str = "figure") -> Figure:
    """Return the registered figure of a result."""
    function = find_presenter(name, type(result))
    assert function is not None, f"{type(result).__name__} has no {name}"
    return function(result)
