# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses that are defined in a tenth of the time.

The decorator of Python compiles up to six methods of a class when its module is imported, which
takes a third of a millisecond. A calibration imports 270 such classes and makes objects of a third
of them. Here a constructor is compiled when it is first used, and nothing else is compiled.
`dataclasses.fields`, `replace` and `is_dataclass` treat both alike, and one may extend the other.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import MISSING, Field, FrozenInstanceError, field, fields, replace
from dataclasses import dataclass as define_dataclass
from reprlib import recursive_repr
from typing import Any, Literal, TypeVar, dataclass_transform

__all__ = ["dataclass", "field", "fields", "replace"]

Class = TypeVar("Class", bound=type)

FIELDS, PARAMETERS = "__dataclass_fields__", "__dataclass_params__"
"""Attributes of a class with its fields, and with the arguments of the decorator."""


@dataclass_transform(field_specifiers=(field,))
def dataclass(
    *,
    frozen: Literal[True],
    eq: bool = True,
    repr: bool = True,  # noqa: A002  # as in Python
    kw_only: bool = False,
) -> Callable[[Class], Class]:
    """Return the decorator of a frozen dataclass; arguments as of `dataclasses.dataclass`."""

    def define(cls: Class) -> Class:
        own = cls.__annotations__  # of this class only
        stated = {name: getattr(cls, name) for name in own if hasattr(cls, name)}
        # what Python finds in the fields of a class that has nothing else
        names: Any = {"__module__": cls.__module__, "__doc__": "-", "__annotations__": own}
        plain = type(cls.__name__, (), {**names, **stated})
        plain = define_dataclass(init=False, repr=False, eq=False, kw_only=kw_only)(plain)
        parameters = getattr(plain, PARAMETERS)
        parameters.init, parameters.frozen, parameters.eq, parameters.repr = True, True, eq, repr
        known: dict[str, Field[Any]] = {}
        for base in cls.__mro__[:0:-1]:
            known |= getattr(base, FIELDS, {})
        setattr(cls, FIELDS, known | getattr(plain, FIELDS))
        setattr(cls, PARAMETERS, parameters)
        for name, value in stated.items():
            if isinstance(value, Field) and value.default is MISSING:
                delattr(cls, name)
            elif isinstance(value, Field):
                setattr(cls, name, value.default)
        all_fields = fields(cls)
        methods: dict[str, Any] = {"__init__": _Constructor(cls), "__setattr__": _refuse_setting}
        methods |= {"__delattr__": _refuse_deleting}
        methods |= {"__match_args__": tuple(f.name for f in all_fields if f.init and not f.kw_only)}
        if repr:
            methods["__repr__"] = _write_repr([f.name for f in all_fields if f.repr])
        if eq:
            methods |= _write_comparison([f.name for f in all_fields if f.compare])
        for name, method in methods.items():
            # Python adds a `__hash__` of None to a class with an `__eq__`
            if vars(cls).get(name) is None:
                setattr(cls, name, method)
        return cls

    return define


class _Constructor:
    """The constructor of a class, which a compiled one replaces when it is first asked for."""

    def __init__(self, cls: type) -> None:
        self.cls = cls

    def __get__(self, instance: object, owner: type | None = None) -> Any:
        compiled = _compile_constructor(self.cls)
        setattr(self.cls, "__init__", compiled)  # noqa: B010  # pyright knows no other constructor
        return compiled.__get__(instance, owner)


def _compile_constructor(cls: type) -> Any:
    """Return `__init__` of a dataclass without slots."""
    values: dict[str, Any] = {"__absent": MISSING}
    positional, named, lines = ["self"], ["*"], ["__own = self.__dict__"]
    for f in fields(cls):
        name, usual = f.name, f"__usual_{f.name}"
        makes, has_default = f.default_factory is not MISSING, f.default is not MISSING
        values[usual] = f.default_factory if makes else f.default
        if f.init:
            default = " = __absent" if makes else f" = {usual}" if has_default else ""
            (named if f.kw_only else positional).append(name + default)
            value = f"{usual}() if {name} is __absent else {name}" if makes else name
            lines.append(f"__own[{name!r}] = {value}")
        elif makes:
            lines.append(f"__own[{name!r}] = {usual}()")
    if hasattr(cls, "__post_init__"):
        lines.append("self.__post_init__()")
    parameters = ", ".join(positional + named * (len(named) > 1))
    body = "".join(f"  {line}\n" for line in lines)
    text = f" def __init__({parameters}):\n{body} return __init__\n"
    made: dict[str, Any] = {}
    text = f"def make({', '.join(values)}):\n{text}"
    exec(text, vars(sys.modules[cls.__module__]), made)  # noqa: S102  # only names of fields vary
    constructor = made["make"](**values)
    constructor.__qualname__ = f"{cls.__qualname__}.__init__"
    constructor.__annotations__ = {f.name: f.type for f in fields(cls) if f.init} | {"return": None}
    return constructor


def _refuse_setting(self: object, name: str, value: object) -> None:
    raise FrozenInstanceError(f"cannot assign to field {name!r}")


def _refuse_deleting(self: object, name: str) -> None:
    raise FrozenInstanceError(f"cannot delete field {name!r}")


def _write_repr(names: Sequence[str]) -> Callable[[object], str]:
    """Return `__repr__`, such as `Name(field=1)`."""

    @recursive_repr()
    def write(self: object) -> str:
        values = (f"{name}={getattr(self, name)!r}" for name in names)
        return f"{type(self).__qualname__}({', '.join(values)})"

    return write


def _write_comparison(names: Sequence[str]) -> dict[str, Any]:
    """Return `__eq__` and `__hash__` of an object, which are those of a tuple of its fields."""

    def collect(self: object) -> tuple[Any, ...]:
        return tuple([getattr(self, name) for name in names])

    def is_equal(self: object, other: object) -> Any:
        return collect(self) == collect(other) if type(other) is type(self) else NotImplemented

    return {"__eq__": is_equal, "__hash__": lambda self: hash(collect(self))}
