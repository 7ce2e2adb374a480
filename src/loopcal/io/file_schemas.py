# SPDX-License-Identifier: Apache-2.0
"""JSON Schemas of the files that people write, from the records that read them, for editors.

A schema states keys, types, allowed words and meanings. What depends on the numbers, such as
whether loops close, only loopcal checks.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin

from loopcal.io.core.records import get_field_types
from loopcal.io.data.kind_settings import SCALED, SETTINGS, make_settings_record
from loopcal.io.exports.profile import ProfileRecord
from loopcal.io.robot.robot_file import (
    FORMAT,
    HEADER,
    KEYS,
    PLUS_MINUS,
    TABLE,
    list_keys,
    name_record,
)
from loopcal.measure.kinds import KINDS
from loopcal.mechanism.families import FAMILIES
from loopcal.units import Dimension, list_symbols

DIALECT = "https://json-schema.org/draft/2020-12/schema"
PLAIN: Mapping[type, str] = {
    str: "string",
    float: "number",
    int: "integer",
    bool: "boolean",
    types.NoneType: "null",
}
Schema = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class SchemaMaker:
    """Makes schemas of records.

    units : whether the file states units once, so that lengths are plain numbers; else each number
        is a text such as `5 um`. definitions : of the records met so far, by name.
    """

    units: bool
    definitions: dict[str, Schema] = dataclasses.field(default_factory=dict)

    def describe(self, annotation: Any, of: Dimension | None = None) -> Schema:
        """Return the schema of what an annotation allows; `of` is the dimension of its numbers."""
        origin, arguments = get_origin(annotation), get_args(annotation)
        if origin is Annotated:
            marks = [mark for mark in arguments[1:] if isinstance(mark, Dimension)]
            return self.describe(arguments[0], marks[0] if marks else of)
        if origin in (Union, types.UnionType):
            return {"anyOf": [self.describe(branch, of) for branch in arguments]}
        if origin is Literal:
            return {"enum": list(arguments)}
        if origin in (tuple, list):
            if origin is list or arguments[-1] is Ellipsis:
                return {"type": "array", "items": self.describe(arguments[0], of)}
            items = [self.describe(item, of) for item in arguments]
            return {"type": "array", "prefixItems": items, "minItems": len(items), "items": False}
        if isinstance(origin, type) and issubclass(origin, Mapping):
            return {"type": "object", "additionalProperties": self.describe(arguments[1], of)}
        if dataclasses.is_dataclass(annotation) and isinstance(annotation, type):
            return self.refer(annotation)
        if annotation is Any:
            return {}
        if of is None or annotation not in (float, int) or self.units:
            return {"type": PLAIN[cast(type, annotation)]}
        symbols = "|".join(list_symbols(of))
        text = {"type": "string", "pattern": rf"^\s*[-+.\w]+\s*({symbols})\s*$"}
        return {"anyOf": [text, {"type": "number"}]} if of is Dimension.RATIO else text

    def refer(self, record: type) -> Schema:
        """Return a reference to the schema of a record, which is made where it is not known."""
        name = name_record(record)
        if name not in self.definitions:
            self.definitions[name] = {}  # a record may contain itself
            self.definitions[name] = self.list_keys(record)
        return {"$ref": f"#/$defs/{name}"}

    def list_keys(self, record: type) -> Schema:
        """Return the schema of a record: its keys, which of them are needed, and their meaning."""
        stated, hints, keys = list_keys(record), get_field_types(record), dict[str, Schema]()
        for key in stated:
            text = "; ".join(filter(None, (key.meaning, key.holds)))
            keys[key.name] = {**self.describe(hints[key.name]), "description": text}
        others: Mapping[str, str] = getattr(record, "OTHER_NAMES", {})
        keys |= {name: keys[field] for name, field in others.items()}
        needed = {key.name for key in stated if key.default == "needed"}
        return {
            "type": "object",
            "properties": keys,
            "required": sorted(needed - {*others.values()}),
            "additionalProperties": getattr(record, "OTHER_KEYS", False),
        }

    def finish(self, title: str, schema: Schema) -> Schema:
        """Return a schema with the records that it refers to."""
        return {"$schema": DIALECT, "title": title, **schema, "$defs": self.definitions}


def build_robot_schema() -> Schema:
    """Return the schema of robot files: the keys that all have, and those of each family."""
    make = SchemaMaker(units=True)
    units = {d.value: {"enum": list(list_symbols(d))} for d in (Dimension.LENGTH, Dimension.ANGLE)}
    cells = {key: {"type": ["string", "number", "null"]} for key in KEYS}
    row = {"type": "object", "properties": cells, "additionalProperties": False}
    header = {
        "format": {"const": FORMAT},
        "units": {
            "type": "object",
            "properties": units,
            "required": list(units),
            "additionalProperties": False,
        },
        "family": {"enum": list(FAMILIES)},
        TABLE: {
            "type": "array",
            "items": {**row, "required": [key for key in KEYS if key != PLUS_MINUS]},
            "description": "values that a calibration identified; without this table the robot "
            "is nominal",
        },
    }
    assert set(header) == set(HEADER)
    families = []
    for name, record in FAMILIES.items():
        own = make.list_keys(record)
        own["properties"] |= {**header, "family": {"const": name}}
        families.append({**own, "required": ["units", "family", *own["required"]]})
    choices = [
        {"if": {"properties": {"family": family["properties"]["family"]}}, "then": family}
        for family in families
    ]
    whole = {"type": "object", "required": ["units", "family"], "properties": header}
    return make.finish("loopcal robot file", {**whole, "allOf": choices})


def build_settings_schema() -> Schema:
    """Return the schema of the settings of a measurement file, as a file of its name states them:
    those of all kinds, and for each kind its own.
    """
    make = SchemaMaker(units=False)
    common: dict[str, Schema] = {
        key: {"description": text, **(make.refer(SCALED[key]) if key in SCALED else {})}
        for key, text in SETTINGS.items()
    }
    known = dict(common)
    choices = []
    for name, kind in KINDS.items():
        own = make.list_keys(make_settings_record(kind))["properties"]
        known |= {key: {} for key in own if key not in known}
        choices.append(
            {"if": {"properties": {"kind": {"const": name}}}, "then": {"properties": own}}
        )
    known["kind"] = {"enum": list(KINDS), **common["kind"]}
    whole = {"type": "object", "properties": known, "additionalProperties": False}
    choices = [{"if": {"required": ["kind"]}, "then": {"allOf": choices}}]
    return make.finish("settings of a loopcal measurement file", {**whole, "allOf": choices})


def build_profile_schema() -> Schema:
    """Return the schema of profiles of exports."""
    make = SchemaMaker(units=False)
    return make.finish("loopcal profile of an export", make.list_keys(ProfileRecord))
