# SPDX-License-Identifier: Apache-2.0
"""A kind of measurement in the settings of a file: its name, its own settings and its noise.

    kind: pose                                the name of a kind of `loopcal.measure.KINDS`
    orientation: euler-xyz                    the fields of its dataclass
    T_base_frame: {x: 12 mm, yaw: 90 deg}     poses: x y z, and R = Rz(yaw) Ry(pitch) Rx(roll)
    places: [[100 mm, 0 mm, 20 mm]]           lengths with units; directions as plain numbers
    noise: {x: 1 um, "*": 5 urad}             standard deviations of the noise columns, by name or
                                              pattern; the last one that matches counts
    noise_source: assumed                     nobody stated this noise

The record of a kind's settings is made from its dataclass, so that a new kind needs nothing here:
arrays called T_.. are poses, those in DIRECTIONS are directions, other arrays and numbers are
lengths, the rest is text.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError, suggest_names
from loopcal.io.core.numbers import format_scaled
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import Location, YamlFile, refuse_unknown_keys
from loopcal.io.core.yaml_text import format_flow_mapping, quote_scalar
from loopcal.io.data.column_names import find_column_fault
from loopcal.mechanism import PoseRecord
from loopcal.plain_text import quote
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS, EXAMPLES, SI_SYMBOLS, Dimension, find_sd_fault

if TYPE_CHECKING:
    from loopcal.measure import Kind

DIRECTIONS = ("along", "axis", "normal", "up")
NOISE_UNITS = {
    Dimension.LENGTH: ("um", 1e-6),
    Dimension.ANGLE: ("urad", 1e-6),
    Dimension.RATIO: ("1", 1.0),
}
ASSUMED = "assumed"
"""Word for noise that a program assumed."""

MANY_SIGMAS = 3
"""Number of columns above which an equal noise is written once."""

LENGTHS = Annotated[list[Any], Dimension.LENGTH]
LENGTH = Annotated[float, Dimension.LENGTH]
NUMBERS = Annotated[list[Any], Dimension.RATIO]


def read_kind(file: YamlFile, node: Mapping[str, Any], location: Location) -> Kind:
    """Return the kind that settings describe.

    Parameters
    ----------
    file : for lines. node : settings; keys of others than the kind are left to the caller.
    location : of `node` in the file.

    Raises
    ------
    FileError : no or an unknown kind, a setting that does not fit it, or a name of a target that no
        column can have.
    """
    from loopcal.measure import KINDS

    name, known = node.get("kind"), ", ".join(KINDS)
    if name is None:
        example = "write '# kind: pose' at the top, or 'kind: pose' in a .yaml file of this name"
        raise file.error(f"no kind of measurement is stated; {example} (kinds: {known})", location)
    if not isinstance(name, str) or name not in KINDS:
        sentence = f"{quote(name)} is not a kind of measurement{suggest_names(str(name), KINDS)}"
        raise file.error(f"{sentence}; allowed: {known}", (*location, "kind"))
    kind = KINDS[name]
    record = _make_record(kind)
    settings = {key: node[key] for key in list_kind_settings(kind) if key in node}
    values = vars(read_record(file, settings, record, None, location))
    for key, value in values.items():
        if isinstance(value, list) and not _is_array(value):
            sentence = f"{key!r} must be a list of numbers, or of lists of equal length; correct it"
            raise file.error(sentence, (*location, key))
    given = {key: _to_setting(values[key], kind, key) for key in settings}
    try:
        made = kind(**given)
    except DataError as error:
        raise file.error(f"{error}", (*location, next(iter(settings), "kind"))) from None
    for column in made.columns:
        if fault := find_column_fault(column.name, "measured value"):
            raise file.error(fault, (*location, "targets" if "targets" in settings else "kind"))
    return made


def list_kind_settings(kind: type[Kind]) -> dict[str, Any]:
    """Return name -> annotation of the settings of a kind."""
    hints = typing.get_type_hints(kind)
    return {f.name: hints[f.name] for f in dataclasses.fields(typing.cast(Any, kind)) if f.init}


def read_noise(
    file: YamlFile, node: Mapping[str, Any], kind: Kind, location: Location
) -> dict[str, float]:
    """Return noise column -> standard deviation [SI], of the columns for which one is stated.

    Raises
    ------
    FileError : an unknown column, a missing or wrong unit, a number that is not positive.
    """
    stated, place = node.get("noise", {}), (*location, "noise")
    dimensions = {column.name: column.dimension for column in kind.noise_columns}
    if not isinstance(stated, dict):
        example = ", ".join(f"{name}: {EXAMPLES[d]}" for name, d in dimensions.items())
        sentence = "'noise' must state a standard deviation for each column"
        raise file.error(f"{sentence}; write 'noise: {{{example}}}'", place)
    noise: dict[str, float] = {}
    for name, text in stated.items():
        matching = [c for c in dimensions if c == name or fnmatchcase(c, name)]
        matching = [name] if name in dimensions else matching
        if not matching:
            refuse_unknown_keys(file, [name], list(dimensions), place)
        for column in matching:
            noise[column] = file.quantity(text, dimensions[column], (*place, name))
            if fault := find_sd_fault(noise[column]):
                raise file.error(f"the noise of {name!r} is {text}; {fault}", (*place, name))
    return noise


def read_noise_source(file: YamlFile, node: Mapping[str, Any], location: Location) -> bool:
    """Return whether settings say that the noise is assumed.

    Raises
    ------
    FileError : another word than `stated` or `assumed`.
    """
    source = node.get("noise_source", "stated")
    if source not in (ASSUMED, "stated"):
        sentence = f"noise_source is {source!r}; write {ASSUMED} where nobody stated the noise"
        raise file.error(f"{sentence}, or stated", (*location, "noise_source"))
    return bool(source == ASSUMED)


def format_kind(
    kind: Kind, noise: Mapping[str, float], tool: FloatArray, is_noise_assumed: bool = False
) -> dict[str, str]:
    """Return key -> text of the settings of a kind.

    Keyword-only settings are left out where they are the default, or the robot's `tool`.
    """
    texts = {"kind": kind.name}
    for field in dataclasses.fields(typing.cast(Any, kind)):
        if not field.init or (value := getattr(kind, field.name)) is None:
            continue
        usual = field.default
        if field.name == "T_platform_tool":
            usual = tool
        elif field.default_factory is not dataclasses.MISSING:
            usual = field.default_factory()
        is_usual = usual is not dataclasses.MISSING and bool(np.array_equal(value, usual))
        if not is_usual or (not field.kw_only and isinstance(value, str | tuple)):
            texts[field.name] = _format_setting(field.name, value)
    if noise:
        units = {column.name: NOISE_UNITS[column.dimension] for column in kind.noise_columns}
        # nine digits: more would be rounding
        sigmas = {name: f"{s / units[name][1]:.9g} {units[name][0]}" for name, s in noise.items()}
        if len(sigmas) > MANY_SIGMAS and len(set(sigmas.values())) == 1:
            sigmas = {"*": next(iter(sigmas.values()))}
        texts["noise"] = format_flow_mapping(sigmas)
    return {**texts, "noise_source": ASSUMED} if is_noise_assumed else texts


def format_quantity(value: float, dimension: Dimension) -> str:
    """Return a number with its unit, in SI where only that reads back as the same double."""
    shown = DISPLAY_UNITS[dimension]
    text = format_scaled(value, shown.factor_to_si)
    if float(text) * shown.factor_to_si == value:
        return f"{text} {shown.symbol}"
    return f"{value!r} {SI_SYMBOLS[dimension]}"


@cache
def _make_record(kind: type[Kind]) -> type:
    """Return a record of the settings of a kind (cached); all may be left out."""
    types = {name: _setting_type(name, a) for name, a in list_kind_settings(kind).items()}
    fields = [(name, annotation, None) for name, annotation in types.items()]
    return dataclasses.make_dataclass(f"{kind.__name__}Settings", fields, frozen=True)


def _setting_type(name: str, annotation: Any) -> Any:
    """Return the annotation of a setting in a file, from that of the kind's field."""
    text = str(annotation)
    if "ndarray" in text:
        if name.startswith("T_"):
            return PoseRecord
        return NUMBERS if name in DIRECTIONS else LENGTHS
    if annotation is float:
        return LENGTH
    return tuple[str, ...] | str if "tuple" in text else str


def _is_array(value: list[Any]) -> bool:
    """Return whether a list holds numbers only, or lists of numbers of one length."""
    if not any(isinstance(item, list) for item in value):
        return all(isinstance(item, float | int) and not isinstance(item, bool) for item in value)
    lengths = {len(item) if isinstance(item, list) else -1 for item in value}
    return len(lengths) == 1 and all(_is_array(item) for item in value)


def _to_setting(value: Any, kind: type[Kind], key: str) -> Any:
    """Return a setting as the field of the kind takes it."""
    if isinstance(value, PoseRecord):
        return value.matrix
    is_single = isinstance(value, str) and "tuple" in str(list_kind_settings(kind)[key])
    return (value,) if is_single else value


def _format_setting(key: str, value: Any) -> str:
    """Return a setting as text that `read_kind` reads."""
    if key.startswith("T_"):
        return _format_frame(value)
    if isinstance(value, str):
        return quote_scalar(value)
    if isinstance(value, float):
        return repr(value) if key in DIRECTIONS else format_quantity(value, Dimension.LENGTH)
    items = value if isinstance(value, list | tuple) else value.tolist()
    if not isinstance(items, list | tuple):
        return _format_setting(key, items)
    return f"[{', '.join(_format_setting(key, item) for item in items)}]"


def _format_frame(T: FloatArray) -> str:
    """Return a pose (4, 4) as text of a `PoseRecord`."""
    lengths = zip("xyz", T[:3, 3], strict=True)
    turns = zip(("roll", "pitch", "yaw"), geometry.matrix_to_euler(T[:3, :3], "xyz"), strict=True)
    texts = {k: format_quantity(float(v) + 0.0, Dimension.LENGTH) for k, v in lengths}
    texts |= {k: format_quantity(float(v) + 0.0, Dimension.ANGLE) for k, v in turns}
    return format_flow_mapping(texts)
