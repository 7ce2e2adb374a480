# SPDX-License-Identifier: Apache-2.0
"""The order of the levels of a factor: levels that differ in numbers only, from small to large."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

from loopcal.studies.specification.levels import FACTORS
from loopcal.units import SI_SYMBOLS, Dimension

if TYPE_CHECKING:
    from loopcal.studies.specification.study import Study


@dataclass(frozen=True)
class LevelChain:
    """Levels of a factor that differ in numbers only, which increase together.

    Attributes
    ----------
    label : what distinguishes these levels from those of other chains, such as "choice planned";
        empty where there is only one chain. quantity : name of the number, such as "count"; empty
        for a single level.
    unit : "m", "rad" or "1". levels : names. values : their numbers [SI], increasing; None of a
        level without a number.
    """

    label: str
    quantity: str
    unit: str
    levels: tuple[str, ...]
    values: tuple[float | None, ...]


def list_chains(study: Study, factor: str) -> tuple[LevelChain, ...]:
    """Return the chains of levels of a factor, in the order of the study.

    Levels whose words differ are in different chains. Levels whose numbers do not increase together
    have no order: each is a chain of its own.
    """
    levels = _levels_of(study, factor)
    records = {name: _flatten(level) for name, level in levels.items()}
    names = list(dict.fromkeys(key for record in records.values() for key in record))
    numbers = [n for n in names if all(_is_number(r.get(n)) for r in records.values())]
    words = [name for name in names if name not in numbers]
    groups: dict[str, list[str]] = {}
    for name, settings in records.items():
        groups.setdefault(repr([settings.get(word) for word in words]), []).append(name)
    differing = [w for w in words if len({repr(r.get(w)) for r in records.values()}) > 1]
    record = type(next(iter(levels.values())))
    plain, units = getattr(record, "PLAIN", ""), _list_units(record)
    chains: list[LevelChain] = []
    for group in groups.values():
        first = records[group[0]]
        label = ", ".join(f"{_say(word)} {_say_value(first.get(word))}" for word in differing)
        chains += _order({name: records[name] for name in group}, numbers, plain, label, units)
    return tuple(chains)


def _order(
    records: Mapping[str, Mapping[str, Any]],
    numbers: list[str],
    plain: str,
    label: str,
    units: Mapping[str, str],
) -> list[LevelChain]:
    """Return one chain of levels that have an order, else a chain for each level."""
    varied = [n for n in numbers if len({r[n] for r in records.values()}) > 1]
    if not varied and plain in numbers:
        varied = [plain]
    ordered = sorted(records, key=lambda name: tuple(records[name][n] for n in varied))
    columns = [[float(records[name][n]) for name in ordered] for n in varied]
    has_order = bool(columns) and all(column == sorted(column) for column in columns)
    if not has_order:
        ratio = SI_SYMBOLS[Dimension.RATIO]
        return [LevelChain(label or name, "", ratio, (name,), (None,)) for name in records]
    unit = units.get(varied[0], SI_SYMBOLS[Dimension.RATIO])
    return [LevelChain(label, _say(varied[0]), unit, tuple(ordered), tuple(columns[0]))]


def _levels_of(study: Study, factor: str) -> Mapping[str, Any]:
    """Return name -> level of a factor, by its name in tables."""
    keys = {name: key for key, name in FACTORS.items()}
    return getattr(study, keys[factor])


def _flatten(level: Any, prefix: str = "") -> dict[str, Any]:
    """Return setting -> value of a record, with those of inner records by `outer.inner`."""
    settings: dict[str, Any] = {}
    for item in fields(level):
        value = getattr(level, item.name)
        if is_dataclass(value):
            settings |= _flatten(value, f"{prefix}{item.name}.")
        else:
            settings[prefix + item.name] = value
    return settings


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _list_units(record: type, prefix: str = "") -> dict[str, str]:
    """Return setting -> SI symbol of the numbers of a record with a dimension."""
    units: dict[str, str] = {}
    for name, hint in get_type_hints(record, include_extras=True).items():
        for part in (hint, *get_args(hint)):
            if get_origin(part) is Annotated:
                units[prefix + name] = SI_SYMBOLS[get_args(part)[1]]
            elif isinstance(part, type) and is_dataclass(part):
                units |= _list_units(part, f"{prefix}{name}.")
    return units


def _say(setting: str) -> str:
    return setting.replace("_", " ").replace(".", " ")


def _say_value(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
