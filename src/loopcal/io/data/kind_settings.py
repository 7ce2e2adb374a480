# SPDX-License-Identifier: Apache-2.0
"""A sensor in the settings of a measurement file: its kind, what is fixed about the kind, and its
noise.

    kind: pose                                the name of a kind, of `loopcal.measure.KINDS`
    orientation: euler-xyz                    then the kind's own settings: the fields of its dataclass
    T_base_frame: {x: 12 mm, yaw: 90 deg}     poses: x y z and R = Rz(yaw) Ry(pitch) Rx(roll), each with its unit
    places: [[100 mm, 0 mm, 20 mm]]           points and other lengths with their units; directions as plain numbers
    noise: {x: 1 um, y: 1 um, z: 1 um, a: 5 urad, b: 5 urad, c: 5 urad}     standard deviations of the noise columns,
                                              by name or pattern ("*.x": 5 um); of two that mean one
                                              the last counts

A new kind needs nothing here, its fields are its settings: arrays called T_.. are poses, those in
DIRECTIONS unit vectors, other arrays and floats lengths, the rest text.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError, UnitError, suggest_names
from loopcal.io.core.numbers import shortest
from loopcal.io.core.yaml_file import Location, YamlFile, refuse_unknown_keys, words
from loopcal.units import EXAMPLES, Dimension, parse_quantity

if TYPE_CHECKING:
    import numpy as np

    from loopcal.measure import Kind

DIRECTIONS = ("along", "axis", "normal", "up")
POSE_KEYS = {
    **dict.fromkeys(("x", "y", "z"), Dimension.LENGTH),
    **dict.fromkeys(("roll", "pitch", "yaw"), Dimension.ANGLE),
}
NOISE_SYMBOLS = {
    Dimension.LENGTH: ("um", 1e-6),
    Dimension.ANGLE: ("urad", 1e-6),
    Dimension.RATIO: ("1", 1.0),
}
SYMBOLS = {
    Dimension.LENGTH: ("mm", 1e-3),
    Dimension.ANGLE: ("deg", math.pi / 180.0),
    Dimension.RATIO: ("1", 1.0),
}
SI = {"mm": "m", "um": "m", "deg": "rad", "urad": "rad", "1": "1"}
"""What the units of a length, an angle and a ratio are multiples of."""


def read_kind(file: YamlFile, node: Mapping[str, Any], location: Location) -> Kind:
    """Return the kind that settings describe.

    Parameters
    ----------
    file : YamlFile
        For lines.
    node : mapping
        The sensor's settings; keys that are not the kind's are left to the caller.
    location : Location
        Of `node` in the file.

    Raises
    ------
    FileError
        No or an unknown kind, a setting that does not fit it.
    """
    from loopcal.measure import KINDS

    name, known = node.get("kind"), ", ".join(KINDS)
    if name is None:
        example = (
            "write '# kind: pose' at the top, or 'kind: pose' in a .yaml file of the same name"
        )
        raise file.error(
            f"these settings do not say what kind of measurement this is; {example} (kinds: "
            f"{known})",
            location,
        )
    if name not in KINDS:
        hint = suggest_names(str(name), KINDS)
        raise file.error(
            f"{name!r} is not a kind of measurement{hint}; known are {known}", (*location, "kind")
        )
    kind = KINDS[name]
    settings = {}
    for key, annotation in list_kind_settings(kind).items():
        if key in node:
            settings[key] = _setting(file, node[key], annotation, (*location, key))
    try:
        return kind(**settings)
    except DataError as error:
        raise file.error(f"{error}", (*location, next(iter(settings), "kind"))) from None


def list_kind_settings(kind: type[Kind]) -> dict[str, Any]:
    """Return name -> annotation of what can be set about a kind."""
    hints = typing.get_type_hints(kind)
    return {f.name: hints[f.name] for f in dataclasses.fields(typing.cast(Any, kind)) if f.init}


def read_noise(
    file: YamlFile, node: Mapping[str, Any], kind: Kind, location: Location
) -> dict[str, float]:
    """Return noise column -> standard deviation [SI] of the columns for which the settings state
    one.

    Raises
    ------
    FileError
        An unknown column, no unit or a wrong one, or a number that is not above zero.
    """
    stated = node.get("noise", {})
    place = (*location, "noise")
    dimensions = {column.name: column.dimension for column in kind.noise_columns}
    if not isinstance(stated, dict):
        example = ", ".join(f"{name}: {EXAMPLES[d]}" for name, d in dimensions.items())
        raise file.error(
            f"'noise' must state a standard deviation for each column; write 'noise: {{{example}}}'",
            place,
        )
    noise: dict[str, float] = {}
    for name, text in stated.items():
        meant = (
            [name]
            if name in dimensions
            else [column for column in dimensions if fnmatchcase(column, name)]
        )
        if not meant:
            refuse_unknown_keys(file, [name], list(dimensions), place)
        for column in meant:
            noise[column] = _quantity(file, text, dimensions[column], (*place, name))
            if not noise[column] > 0:
                raise file.error(
                    f"the noise of {name!r} is {text}; give a number above zero", (*place, name)
                )
    return noise


def write_sensor(kind: Kind, noise: Mapping[str, float], tool: np.ndarray) -> dict[str, str]:
    """Return key -> text of a sensor's settings; those by keyword only where they differ from
    default or `tool`.
    """
    lines = {"kind": kind.name}
    for field in dataclasses.fields(typing.cast(Any, kind)):
        if field.init:
            value, usual = (
                getattr(kind, field.name),
                tool if field.name == "T_platform_tool" else _default(field),
            )
            if value is not None and (
                not _same(value, usual) or (not field.kw_only and isinstance(value, (str, tuple)))
            ):
                lines[field.name] = _setting_text(field.name, value)
    if noise:
        dimensions = {column.name: column.dimension for column in kind.noise_columns}
        texts = [f"{name}: {_noise_text(sigma, dimensions[name])}" for name, sigma in noise.items()]
        lines["noise"] = f"{{{', '.join(texts)}}}"
    return lines


def _default(field: dataclasses.Field[Any]) -> Any:
    """Return a field's default, None where it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def _same(value: Any, usual: Any) -> bool:
    """Tell whether two values of a setting are equal, arrays included."""
    import numpy as np

    return usual is not None and bool(np.array_equal(value, usual))


def _setting(file: YamlFile, value: Any, annotation: Any, location: Location) -> Any:
    """Return one setting of a kind as its field wants it: a pose, numbers, a tuple of text, or
    text.
    """
    key = str(location[-1])
    if "ndarray" in str(annotation) and key.startswith("T_"):
        return _pose(file, value, location)
    if "ndarray" in str(annotation) or annotation is float:
        return _numbers(file, value, None if key in DIRECTIONS else Dimension.LENGTH, location)
    if isinstance(value, list) and all(isinstance(item, str) for item in value):
        return tuple(value)
    if isinstance(value, str):
        return (value,) if "tuple" in str(annotation) else value
    raise file.error(
        f"{words(location)!r} is {value!r} where text is needed; see the kinds in the file "
        "reference",
        location,
    )


def _numbers(file: YamlFile, value: Any, dimension: Dimension | None, location: Location) -> Any:
    """Return a number, or lists of them, in SI: each with its unit, or plain where they have no
    dimension.
    """
    if isinstance(value, list):
        return [_numbers(file, item, dimension, (*location, i)) for i, item in enumerate(value)]
    if dimension is not None:
        return _quantity(file, value, dimension, location)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise file.error(
            f"{words(location)!r} is {value!r} where a plain number is needed; write a number",
            location,
        )
    return float(value)


def _setting_text(key: str, value: Any) -> str:
    """Return a setting as text that `_setting` reads."""
    if key.startswith("T_"):
        return _pose_text(value)
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return f"[{', '.join(_setting_text(key, item) for item in value)}]"
    if isinstance(value, float):
        return repr(value) if key in DIRECTIONS else quantity_text(value, SYMBOLS[Dimension.LENGTH])
    return _setting_text(key, list(value) if isinstance(value, tuple) else value.tolist())


def _pose(file: YamlFile, node: Any, location: Location) -> np.ndarray:
    """Return T (4, 4) of `{x: 1 mm, ..., yaw: 90 deg}`."""
    import numpy as np

    from loopcal import geometry

    if not isinstance(node, dict):
        raise file.error(
            f"{words(location)!r} must be a pose such as {{x: 12 mm, yaw: 90 deg}}; correct it",
            location,
        )
    refuse_unknown_keys(file, list(node), list(POSE_KEYS), location)
    found = {
        key: _quantity(file, node[key], d, (*location, key)) if key in node else 0.0
        for key, d in POSE_KEYS.items()
    }
    angles = np.array([found[key] for key in ("roll", "pitch", "yaw")])
    return geometry.make_pose(
        geometry.euler_to_matrix(angles, "xyz"), np.array([found[key] for key in ("x", "y", "z")])
    )


def _pose_text(T: np.ndarray) -> str:
    """Return a pose as text that `_pose` reads."""
    from loopcal import geometry

    numbers = (*T[:3, 3], *geometry.matrix_to_euler(T[:3, :3], "xyz"))
    texts = [
        f"{key}: {quantity_text(float(v) + 0.0, SYMBOLS[POSE_KEYS[key]])}"
        for key, v in zip(POSE_KEYS, numbers, strict=True)
    ]
    return f"{{{', '.join(texts)}}}"


def _quantity(file: YamlFile, node: Any, dimension: Dimension, location: Location) -> float:
    """Return the SI value of a number with its unit."""
    try:
        return parse_quantity(str(node), dimension)
    except UnitError as error:
        raise file.error(f"{words(location)!r}: {error}", location) from None


def quantity_text(value: float, shown: tuple[str, float]) -> str:
    """Return a number with its unit (symbol, factor), or in SI where only that reads back as the
    same double.
    """
    symbol, factor = shown
    text = shortest(value, factor)
    return f"{text} {symbol}" if float(text) * factor == value else f"{value!r} {SI[symbol]}"


def _noise_text(sigma: float, dimension: Dimension) -> str:
    """Return a standard deviation with its unit, to nine digits: more would be rounding."""
    symbol, factor = NOISE_SYMBOLS[dimension]
    return f"{sigma / factor:.9g} {symbol}"
