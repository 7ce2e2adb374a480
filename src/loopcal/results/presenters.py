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

_PRESENTERS: dict[tuple[str, str], Presenter] = {}
# Beginning of a name of presenters -> modules that register them.
_MODULES: dict[str, list[str]] = {}


def name_presenters(**modules: Sequence[str]) -> None:
    """Name modules that register presenters, such as `page=["package.pages"]`; they are imported
    when the first such presenter is looked for.
    """
    for name, named in modules.items():
        _MODULES.setdefault(name, []).extend(named)


def register(name: str, *classes: type | str) -> Callable[[Registered], Registered]:
    """Return a decorator of the function that makes the "page" or a "figure" of these classes, or
    of classes at places such as `package.module:Class`, which are not imported for it.

    The name of a figure of several is `figure NAME`.
    """

    def add(function: Registered) -> Registered:
        places = (_name_place(of) if isinstance(of, type) else of for of in classes)
        _PRESENTERS.update({(name, place): function for place in places})
        return function

    return add


def _name_place(of_class: type) -> str:
    return f"{of_class.__module__}:{of_class.__qualname__}"


def find_presenter(name: str, of_class: type) -> Presenter | None:
    """Return the registered function of a class; None where there is none."""
    for module in _MODULES.get(name.partition(" ")[0], ()):
        import_module(module)
    for base in of_class.__mro__:
        if (function := _PRESENTERS.get((name, _name_place(base)))) is not None:
            return function
    return None


def draw(result: object, name: str = "figure") -> Figure:
    """Return the registered figure of a result."""
    function = find_presenter(name, type(result))
    assert function is not None, f"{type(result).__name__} has no {name}"
    return function(result)
