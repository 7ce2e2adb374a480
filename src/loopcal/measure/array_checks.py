# SPDX-License-Identifier: Apache-2.0
"""Checks of arrays that measurements and kinds store: float64, read-only, of a stated shape."""

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from inspect import signature
from numbers import Integral, Real
from types import ModuleType, NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.typing import BoolArray, FloatArray, IntArray

WIDE: dict[type, Any] = {float: Real, int: Integral, np.ndarray: (np.ndarray, Sequence)}
"""What is also accepted for a class of an annotation."""
SOURCES = {
    "Mechanism": ", as from loopcal.load_robot('hexapod-42')",
    "Measurements": ", as from load_measurements('data.csv', robot)",
}
"""How to obtain an instance of a class."""


def check_array(
    value: ArrayLike, what: str, shape: Sequence[int | None], *, allow_nan: bool = False
) -> FloatArray:
    """Return a read-only float64 copy of an array of this shape, where None is any length.

    DataError : the value, which messages call `what`, is not numeric, has another shape, or a
        number is infinite or, unless `allow_nan`, not measured.
    """
    wanted = ", ".join("any" if n is None else str(n) for n in shape)
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise DataError(
            f"{what}: got {describe(value)}. Give an array of numbers of shape ({wanted})"
        ) from None
    if array.ndim != len(shape) or any(
        n is not None and n != m for n, m in zip(shape, array.shape, strict=True)
    ):
        raise DataError(f"{what} has shape {array.shape}. Give an array of shape ({wanted})")
    wrong = np.isinf(array) if allow_nan else ~np.isfinite(array)

    def describe_entry(*place: int) -> str:
        where = f"row {place[0] + 1}" + (f", column {place[1] + 1}" if len(place) > 1 else "")
        advice = "Give a finite number" + (" or NaN" if allow_nan else "")
        return f"{what}: {where} is {array[place]}. {advice}"

    refuse_first(wrong, describe_entry)
    array.setflags(write=False)
    return array


def refuse_first(wrong: BoolArray, describe: Callable[..., str]) -> None:
    """Raise a DataError with the description of the first wrong entry, by its indices, if any."""
    if np.any(wrong):
        raise DataError(describe(*(int(i) for i in np.argwhere(wrong)[0])))


def broadcast_array(value: ArrayLike, shape: tuple[int, ...], what: str, wanted: str) -> FloatArray:
    """Return a read-only copy of an array, broadcast to a shape, in which equal entries that shared
    their memory still do; DataError if it does not fit.
    """
    try:
        if np.iscomplexobj(value):
            raise TypeError
        given = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise DataError(f"{what}: got {describe(value)}. Give {wanted}") from None
    try:
        return np.broadcast_to(np.array(drop_repeats(given)), shape)
    except ValueError:
        raise DataError(f"{what} has shape {given.shape}. Give {wanted}") from None


def drop_repeats(array: FloatArray) -> FloatArray:
    """Return an array with length one along the axes along which broadcasting repeats it; an empty
    one, whose strides say nothing about repeats, as it is.
    """
    steps = array.strides if array.size else (1,) * array.ndim
    return array[tuple(slice(None) if step else slice(1) for step in steps)]


def take_rows(array: FloatArray, rows: IntArray | BoolArray) -> FloatArray:
    """Return rows (k, ..), by index or mask, of an array (r, ..); shared memory stays shared."""
    if not array.size or array.strides[0]:
        return array[rows]
    count = int(np.count_nonzero(rows)) if rows.dtype == bool else len(rows)
    return np.broadcast_to(array[0], (count, *array.shape[1:]))


def check_pose(value: ArrayLike, what: str) -> FloatArray:
    """Return a read-only pose (4, 4); DataError unless it is one to 1e-9."""
    T = check_array(value, what, (4, 4))
    R = T[:3, :3]
    error = float(np.max(np.abs(R @ R.T - np.eye(3))))
    if error > 1e-9 or np.linalg.det(R) < 0.0 or not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise DataError(
            f"{what} is not a pose: its rotation part deviates by {error:.2g} from a right-handed "
            "rotation, or its last row is not 0 0 0 1. Give R with R R' = 1 to 1e-9 and det R = 1, "
            "and the translation [m] in the last column"
        )
    return T


def check_point(value: ArrayLike, what: str) -> FloatArray:
    """Return a read-only point (3,) [m]."""
    return check_array(value, what, (3,))


def check_direction(value: ArrayLike, what: str) -> FloatArray:
    """Return the read-only unit vector (3,) along a vector; DataError where its length is zero."""
    vector = check_point(value, what)
    length = float(np.linalg.norm(vector))
    if not length > 0.0:
        raise DataError(f"{what} is 0, 0, 0. Give a vector of any length above 0")
    # a vector of length 1 is kept bit by bit, so that files are written as they were read
    return vector if abs(length - 1.0) < 1e-15 else check_point(vector / length, what)


def check_names(names: str | Iterable[str], what: str) -> tuple[str, ...]:
    """Return names as a tuple; DataError where there is none, or one twice."""
    given = (names,) if isinstance(names, str) else tuple(names)
    if not given or len(set(given)) < len(given):
        listed = ", ".join(given) or "empty"
        raise DataError(f"the {what} are {listed}. Name at least one, and each once")
    return given


def check_type(value: object, wanted: type, what: str, hint: str) -> None:
    """Raise a DataError that calls an argument `what`, and says how to obtain one of the class."""
    if not isinstance(value, wanted):
        raise DataError(f"{what}: got {describe(value)}. Give {wanted.__name__}, {hint}")


def name_wrong_arguments(function: Callable[..., Any], package: ModuleType) -> Callable[..., Any]:
    """Return a function whose calls that fail raise a DataError for the first argument that is not
    of the type of its annotation, with names from the package. Other calls take no longer.
    """

    @wraps(function)
    def call(*given: Any, **named: Any) -> Any:
        try:
            return function(*given, **named)
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            if error.__traceback__ is None or error.__traceback__.tb_next is None:
                raise  # the number of arguments is wrong
            names = {
                name: getattr(package, name) for name in ("Run", "CalibrationReport", "Format")
            }
            hints = get_type_hints(function, localns=names)
            for name, value in signature(function).bind(*given, **named).arguments.items():
                _refuse_wrong_type(name, value, hints.get(name))
            raise

    return call


def _refuse_wrong_type(name: str, value: object, hint: Any) -> None:
    parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    classes = [get_origin(part) or part for part in parts]
    if any(not isinstance(each, type) or hasattr(each, "_is_protocol") for each in classes):
        return
    if not isinstance(value, tuple(WIDE.get(each, each) for each in classes)):
        words = [c.__name__ + SOURCES.get(c.__name__, "") for c in classes if c is not NoneType]
        raise DataError(f"{name}: got {describe(value)}. Give {' or '.join(words)}") from None


def check_seed(seed: int) -> None:
    """Raise a DataError for a seed of a random stream below 0."""
    if seed < 0:
        raise DataError(f"seed is {seed}. Give a whole number, 0 or more")


def describe(value: object) -> str:
    """Return a value as error messages show it: its text and its type."""
    if isinstance(value, str):
        return f"the text {value[:60]!r}"
    name = type(value).__name__
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"


def set_fields(instance: object, **values: object) -> None:
    """Set fields of a frozen dataclass to their checked values, or those of a copy."""
    for name, value in values.items():
        object.__setattr__(instance, name, value)
