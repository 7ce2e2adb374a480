# SPDX-License-Identifier: Apache-2.0
"""Prior knowledge of setup parameters (frames, targets, surfaces, offsets) in measurement files.

    unknowns:
      tracker.x: {start: 12 mm, sd: 1 mm}     a prior: this value with this standard deviation
      tracker.r?: {sd: 2 mrad}                a prior about the value in the settings of the kind
      "probe.*": fixed                        fixed at the value in the settings of the kind
      tracker.z: {start: 1.2 m, fixed: true}  fixed at this value

Names are those of results, or patterns of them, and denote parameters of this file. Without the
session in front, a name denotes the parameter of every session. The last matching line counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import make_dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from loopcal.errors import suggest_names
from loopcal.io.core.records import read_record
from loopcal.io.core.yaml_file import Location, YamlFile
from loopcal.io.core.yaml_text import format_flow_mapping
from loopcal.io.data.kind_settings import format_quantity
from loopcal.units import Angle, Dimension, Length, Ratio, find_sd_fault

if TYPE_CHECKING:
    from loopcal.measure import Observations, StatedValue
    from loopcal.parameters import Parameter

KEY, FIXED = "unknowns", "fixed"
EXAMPLE = (
    f"write '{FIXED}', {{sd: 1 mm}}, {{start: 12 mm, sd: 1 mm}} or {{start: 12 mm, {FIXED}: true}}"
)


def _make_record(quantity: Any) -> type:
    """Return a record of the knowledge of a parameter of one dimension."""
    number = quantity | None
    fields = [("start", number, None), ("sd", number, None), ("fixed", bool, False)]
    return make_dataclass("KnownParameter", fields, frozen=True)


RECORDS = {
    Dimension.LENGTH: _make_record(Length),
    Dimension.ANGLE: _make_record(Angle),
    Dimension.RATIO: _make_record(Ratio),
}


def read_stated_values(
    files: Sequence[tuple[YamlFile, Sequence[Observations], Mapping[str, float]]],
    labels: tuple[str, ...],
) -> tuple[StatedValue, ...]:
    """Return the knowledge that files state of the setup parameters of their own rows.

    Parameters
    ----------
    files : settings of each file, its rows, and the standard deviations of their biases and drifts
        by name without the session, 0 where there is none. labels : names of the poses.

    Raises
    ------
    FileError : a name that is not a parameter of the file, a bad statement, contradicting files.
    DataError : two kinds of a file state one parameter differently.
    """
    from loopcal.measure import StatedValue, collect_nuisance_parameters

    known: dict[str, tuple[StatedValue, YamlFile, Location]] = {}
    for file, observations, shared in files:
        stated = file.content.get(KEY, {})
        if not isinstance(stated, dict):
            sentence = f"{KEY!r} must name parameters, as {KEY}: {{tracker.x: {{sd: 1 mm}}}}"
            raise file.error(sentence, (KEY,))
        of_file: dict[str, tuple[StatedValue, YamlFile, Location]] = {}
        entries: tuple[Parameter, ...] = ()
        if stated or shared:
            entries = collect_nuisance_parameters(observations, labels).table.entries
        for name, sd in shared.items():
            of_sessions = [e.name for e in entries if e.name == name or e.name.endswith(f".{name}")]
            of_file |= {n: (StatedValue(n, sd), file, (KEY,)) for n in of_sessions}
        for pattern, node in stated.items():
            place = (KEY, pattern)
            matching = _match(file, entries, pattern)
            of_file |= {k.name: (k, file, place) for k in _read_one(file, node, matching, place)}
        for name, (value, _, place) in of_file.items():
            if name in known and known[name][0] != value:
                _, other, other_place = known[name]
                line = f"{other.path}:{other.line(other_place)}"
                sentence = f"parameter {name!r} is stated differently in {line}; state it once"
                raise file.error(sentence, place)
        known = of_file | known
    return tuple(value for value, _, _ in known.values())


def format_stated_values(known: Sequence[StatedValue], entries: Sequence[Parameter]) -> str:
    """Return the setting `unknowns` as text, for the parameters among `entries`."""
    dimensions = {entry.name: entry.dimension for entry in entries}
    texts: dict[str, str] = {}
    for value in known:
        if value.name not in dimensions:
            continue
        dimension = dimensions[value.name]
        text = FIXED
        if value.sd:
            text = f"{{sd: {format_quantity(value.sd, dimension)}}}"
        if value.nominal is not None:
            start = f"start: {format_quantity(value.nominal, dimension)}"
            text = f"{{{start}, {text[1:]}" if value.sd else f"{{{start}, {FIXED}: true}}"
        texts[value.name] = text
    return format_flow_mapping(texts) if texts else ""


def _match(file: YamlFile, entries: Sequence[Parameter], pattern: str) -> list[Parameter]:
    """Return the parameters that a name or pattern denotes."""
    exact = [entry for entry in entries if entry.name == pattern]
    whole = exact or [entry for entry in entries if fnmatchcase(entry.name, pattern)]
    matching = whole or [entry for entry in entries if fnmatchcase(entry.name, f"*.{pattern}")]
    if not matching:
        names = [entry.name for entry in entries]
        allowed = ", ".join(names[:12]) or "none; state some, as 'unknown: [frame]' of the kind"
        sentence = f"this file has no setup parameter {pattern!r}{suggest_names(pattern, names)}"
        raise file.error(f"{sentence}; it has {allowed}", (KEY, pattern))
    return matching


def _read_one(
    file: YamlFile, node: Any, matching: Sequence[Parameter], place: Location
) -> list[StatedValue]:
    """Return the knowledge that one line states of each parameter that it denotes."""
    from loopcal.measure import StatedValue

    if node == FIXED:
        return [StatedValue(entry.name) for entry in matching]
    if not isinstance(node, dict):
        raise file.error(f"{node!r} does not state knowledge of a parameter; {EXAMPLE}", place)
    dimensions = {entry.dimension for entry in matching}
    if len(dimensions) > 1 and ("start" in node or "sd" in node):
        sentence = "this pattern matches lengths and angles; state them in separate lines"
        raise file.error(sentence, place)
    stated = read_record(file, node, RECORDS[matching[0].dimension], None, place)
    if stated.fixed == ("sd" in node):
        raise file.error(f"state either 'sd' or '{FIXED}: true'; {EXAMPLE}", place)
    if not stated.fixed and (fault := find_sd_fault(stated.sd or 0.0)):
        sentence = f"the standard deviation is {node['sd']}; {fault}, or {FIXED}"
        raise file.error(sentence, (*place, "sd"))
    sd = 0.0 if stated.fixed else stated.sd or 0.0
    return [StatedValue(entry.name, sd, stated.start) for entry in matching]
