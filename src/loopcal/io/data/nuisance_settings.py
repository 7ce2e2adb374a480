# SPDX-License-Identifier: Apache-2.0
"""What a measurement file knows of its instruments' own unknowns: priors, and values that are not
to be identified.

    unknowns:
      tracker.x: {start: 12 mm, sd: 1 mm}     a prior: this value, known to this standard deviation
      tracker.r?: {sd: 2 mrad}                a prior about the value that the kind's settings state
      "probe.*": fixed                        kept at the value that the kind's settings state
      tracker.z: {start: 1.2 m, fixed: true}  kept at this value

Names are those of results (`loopcal identifiability` and `loopcal calibrate` show them) or patterns
of them, and mean unknowns of this file; without the session before it a name means the unknown of
every session. Of several lines that mean one unknown the last one counts.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from loopcal.errors import UnitError, suggest_names
from loopcal.io.core.yaml_file import Location, YamlFile, refuse_unknown_keys
from loopcal.io.data.kind_settings import SYMBOLS, quantity_text
from loopcal.units import Dimension, parse_quantity

if TYPE_CHECKING:
    from loopcal.measure import Observations, StatedValue
    from loopcal.parameters import Parameter

KEY, FIXED = "unknowns", "fixed"


def read_known(
    files: Sequence[tuple[YamlFile, Sequence[Observations]]], labels: tuple[str, ...]
) -> tuple[StatedValue, ...]:
    """Return what files say of the unknowns of their own rows.

    Parameters
    ----------
    files : settings of each file, and its rows. labels : names of the poses.

    Raises
    ------
    FileError
        A name that is no unknown of the file, a statement without sense, or two files that
        contradict each other.
    DataError
        Two kinds of a file state one unknown differently.
    """
    from loopcal.measure import collect_nuisance_parameters

    found: dict[str, tuple[StatedValue, YamlFile, Location]] = {}
    for file, observations in files:
        stated = file.content.get(KEY, {})
        if not isinstance(stated, dict):
            raise file.error(
                f"{KEY!r} must name unknowns, as {KEY}: {{tracker.x: {{sd: 1 mm}}}}; correct it",
                (KEY,),
            )
        own: dict[str, tuple[StatedValue, YamlFile, Location]] = {}
        entries = collect_nuisance_parameters(observations, labels).table.entries if stated else ()
        for pattern, node in stated.items():
            place = (KEY, pattern)
            own |= {
                known.name: (known, file, place)
                for known in _known(file, node, _meant(file, entries, pattern), place)
            }
        for name, (known, _, place) in own.items():
            if name in found and found[name][0] != known:
                _, other, there = found[name]
                raise file.error(
                    f"the unknown {name!r} is stated otherwise in "
                    f"{other.path}:{other.line(there)}; state it once, or alike",
                    place,
                )
        found = own | found
    return tuple(known for known, _, _ in found.values())


def known_text(known: Sequence[StatedValue], entries: Sequence[Parameter]) -> str:
    """Return the setting as text that `read_known` reads; names that are not among the entries are
    left out.
    """
    dimensions = {entry.name: entry.dimension for entry in entries}
    parts = []
    for one in known:
        if one.name in dimensions:
            shown = SYMBOLS[dimensions[one.name]]
            said = [] if one.nominal is None else [f"start: {quantity_text(one.nominal, shown)}"]
            said += [f"sd: {quantity_text(one.sd, shown)}"] if one.sd else []
            text = (
                f"{{{', '.join(said if one.sd else [*said, f'{FIXED}: true'])}}}" if said else FIXED
            )
            parts.append(f"{json.dumps(one.name, ensure_ascii=False)}: {text}")
    return f"{{{', '.join(parts)}}}" if parts else ""


def _meant(file: YamlFile, entries: Sequence[Parameter], pattern: str) -> list[Parameter]:
    """Return the unknowns that a name or pattern means."""
    names = [entry.name for entry in entries]
    if pattern in names:
        return [entries[names.index(pattern)]]
    meant = [entry for entry in entries if fnmatchcase(entry.name, pattern)]
    meant = meant or [entry for entry in entries if fnmatchcase(entry.name, f"*.{pattern}")]
    if not meant:
        shown = ", ".join(names[:12]) or "none; say which are, as 'unknown: [frame]' of the kind"
        hint = suggest_names(pattern, names)
        raise file.error(
            f"no unknown of this file is called {pattern!r}{hint}; there are {shown}",
            (KEY, pattern),
        )
    return meant


def _known(
    file: YamlFile, node: Any, meant: Sequence[Parameter], place: Location
) -> list[StatedValue]:
    """Return what a statement says of each unknown that it means."""
    from loopcal.measure import StatedValue

    if node == FIXED:
        return [StatedValue(entry.name) for entry in meant]
    example = f"write '{FIXED}', {{sd: 1 mm}}, {{start: 12 mm, sd: 1 mm}} or {{start: 12 mm, {FIXED}: true}}"
    if not isinstance(node, dict):
        raise file.error(f"this says {node!r} of an unknown; {example}", place)
    refuse_unknown_keys(file, list(node), ["start", "sd", FIXED], place)
    fixed = node.get(FIXED, False)
    if not isinstance(fixed, bool) or fixed == ("sd" in node):
        raise file.error(
            f"this says not or not clearly how well the unknown is known; {example}", place
        )
    dimensions = {entry.dimension for entry in meant}
    if len(dimensions) > 1 and ("start" in node or "sd" in node):
        raise file.error(
            "this means lengths and angles together; state a number for each of the two apart",
            place,
        )
    values = {
        key: _number(file, node[key], meant[0].dimension, (*place, key))
        for key in ("start", "sd")
        if key in node
    }
    if not fixed and not values["sd"] > 0.0:
        raise file.error(
            f"the standard deviation is {node['sd']}; give a number above zero, or say {FIXED}",
            (*place, "sd"),
        )
    return [
        StatedValue(entry.name, 0.0 if fixed else values["sd"], values.get("start"))
        for entry in meant
    ]


def _number(file: YamlFile, text: Any, dimension: Dimension, place: Location) -> float:
    """Return the SI value of a number with its unit."""
    try:
        return parse_quantity(str(text), dimension)
    except UnitError as error:
        raise file.error(f"{place[-1]!r}: {error}", place) from None
