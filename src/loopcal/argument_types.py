# SPDX-License-Identifier: Apache-2.0
"""Types of the arguments of public functions, checked in one place by their annotations.

`loopcal.NAME` of a function is the function behind this check (`loopcal/__init__.py`). Calls inside
the library do not pass it. What an annotation cannot express, such as a range or a shape, the
functions check themselves.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import wraps
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar, get_args

import numpy as np

from loopcal.errors import ArgumentTypeError, DataError

ORIGINS: Mapping[str, str] = {
    "CalibrationOptions": "such as CalibrationOptions(hold_out=0.25)",
    "CalibrationReport": "as from calibrate(robot, data)",
    "Disturbance": "such as Disturbance()",
    "FitOptions": "such as FitOptions(noise='estimated')",
    "Identifiability": "as from identifiability(robot, data)",
    "Identification": "as from identify(robot, data)",
    "Instrument": "such as Instrument((sensor,))",
    "Measurements": "as from load_measurements('data.csv', robot)",
    "Mechanism": "as from loopcal.load_robot('hexapod-42')",
    "PlanOptions": "such as PlanOptions(n_poses=30)",
    "Posterior": "as identify(robot, data).posterior",
    "Solution": "as from forward(robot, readings)",
    "SurfaceOptions": "such as SurfaceOptions(groups=10)",
    "Trials": "as from simulate_trials(...)",
}
"""How to obtain an argument of each type."""

_P = ParamSpec("_P")
_R = TypeVar("_R")

LARGEST = 2**63 - 1
"""Whole number that arrays can hold."""


def describe(value: object) -> str:
    """Return a value as error messages show it: its text and its type."""
    if isinstance(value, str):
        return f"the text {value[:60]!r}"
    name = type(value).__name__
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"


def check_seed(seed: object) -> None:
    """Raise an error unless the seed of a random stream is a whole number, 0 or more."""
    if not isinstance(seed, Integral):
        raise ArgumentTypeError(f"seed: got {describe(seed)}; give a whole number, 0 or more")
    if seed < 0:
        raise DataError(f"seed is {seed}; give a whole number, 0 or more")


def check_call(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that raises ArgumentTypeError for arguments that it cannot use."""
    signature = inspect.signature(function)
    checks: dict[str, list[_Check]] = {}

    @wraps(function)
    def checked(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if not checks:
            for name, parameter in signature.parameters.items():
                checks[name] = list_checks(str(parameter.annotation), function)
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:  # a missing or unknown name; Python says which
            return function(*args, **kwargs)
        for name, value in given.items():
            _check(name, value, checks[name])
            if name == "seed" and isinstance(value, Integral):
                check_seed(value)
        return function(*args, **kwargs)

    checked.__module__ = "loopcal"  # where pickle finds it
    return checked


def check_fields(instance: Any) -> None:
    """Raise ArgumentTypeError for a field of a dataclass that it cannot use."""
    for field in fields(instance):
        kind = field.type if isinstance(field.type, str) else getattr(field.type, "__name__", "")
        checks = list_checks(kind, type(instance).__init__)
        _check(field.name, getattr(instance, field.name), checks)


_Check = tuple[str, Callable[[Any], bool]]
"""Words for what is allowed, and whether a value is that."""


def _check(name: str, value: object, checks: Sequence[_Check]) -> None:
    """Raise ArgumentTypeError unless a value passes one of the checks, or there are none."""
    if checks and not any(is_allowed(value) for _, is_allowed in checks):
        wanted = ", or ".join(words for words, _ in checks if words)
        raise ArgumentTypeError(f"{name}: got {describe(value)}; give {wanted}")


def list_checks(annotation: str, function: Callable[..., Any]) -> list[_Check]:
    """Return one check for each part of `A | B`; none where a part is not known here."""
    checks = [_find_check(part, function) for part in annotation.split(" | ")]
    return [check for check in checks if check] if all(checks) else []


def _find_check(part: str, function: Callable[..., Any]) -> _Check | None:
    """Return the check of one type of an annotation; None where it is not known here."""
    if part in _CHECKS:
        return _CHECKS[part]
    known = getattr(function, "__globals__", {}).get(part)
    if isinstance(known, type) and known.__name__ in ORIGINS:
        origin = f"{known.__name__}, {ORIGINS[known.__name__]}"
        return origin, lambda value: isinstance(value, known)
    choices = get_args(known)
    if choices and all(isinstance(choice, str) for choice in choices):
        words = f"one of {', '.join(repr(choice) for choice in choices)}"
        return words, lambda value: isinstance(value, str)  # functions refuse other texts
    return None


def _is_whole(value: object) -> bool:
    """Return whether a value is a whole number that arrays can hold."""
    if not isinstance(value, Integral) or isinstance(value, bool):
        return False
    return -LARGEST <= int(value) <= LARGEST


def _is_number(value: object) -> bool:
    """Return whether a value is a real number, which may be infinite or NaN."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        float(value)
    except (OverflowError, ValueError):
        return False
    return True


def _is_array(value: object) -> bool:
    """Return whether numpy can make an array of real numbers of a value."""
    if value is None or isinstance(value, (str, bytes, bytearray, memoryview)):
        return False
    if isinstance(value, Integral):
        return _is_whole(value)
    try:
        array = np.asarray(value)
        if array.dtype.kind == "O":
            array = array.astype(float)
    except Exception:  # noqa: BLE001 the method __array__ of an unknown object may raise anything
        return False
    return array.dtype.kind in "biuf"


def _are_names(value: object) -> bool:
    """Return whether a value is a list or tuple of texts."""
    return isinstance(value, (list, tuple)) and all(isinstance(name, str) for name in value)


def _are_two_numbers(value: object) -> bool:
    """Return whether a value is a list or tuple of two numbers."""
    return isinstance(value, (list, tuple)) and len(value) == 2 and all(map(_is_number, value))


def _are_named_numbers(value: object) -> bool:
    """Return whether a value maps names to numbers."""
    return isinstance(value, Mapping) and all(
        isinstance(name, str) and _is_number(number) for name, number in value.items()
    )


def _are_named_names(value: object) -> bool:
    """Return whether a value maps names to lists of names."""
    return isinstance(value, Mapping) and all(
        isinstance(name, str) and _are_names(names) for name, names in value.items()
    )


def _are_two_lists_of_names(value: object) -> bool:
    """Return whether a value is a list or tuple of two lists of texts."""
    return isinstance(value, (list, tuple)) and len(value) == 2 and all(map(_are_names, value))


_CHECKS: Mapping[str, _Check] = {
    "None": ("", lambda value: value is None),
    "bool": ("True or False", lambda value: isinstance(value, (bool, np.bool_))),
    "int": ("a whole number below 2^63", _is_whole),
    "float": ("a number (lengths in metres, angles in rad)", _is_number),
    "str": ("text", lambda value: isinstance(value, str)),
    "ArrayLike": ("an array of numbers", _is_array),
    "FloatArray": ("an array of numbers", _is_array),
    "Sequence[str]": ("a list of names", _are_names),
    "tuple[str, ...]": ("a list of names", _are_names),
    "tuple[Sequence[str], Sequence[str]]": ("two lists of names", _are_two_lists_of_names),
    "Mapping[str, float]": ("a dict of numbers by name", _are_named_numbers),
    "Mapping[str, Sequence[str]]": ("a dict of lists of names by name", _are_named_names),
    "tuple[float, float]": ("two numbers", _are_two_numbers),
    "np.random.Generator": (
        "a numpy Generator",
        lambda value: isinstance(value, np.random.Generator),
    ),
    "Progress": ("a function of (done, total, what)", callable),
}
