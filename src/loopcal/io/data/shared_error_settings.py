# SPDX-License-Identifier: Apache-2.0
"""Errors that the rows of a session share, in the settings of a kind.

    session_bias: unknown                     an unknown offset of every component in each session
    session_bias: {x: 20 um, y: 20 um}        a prior: offsets of this standard deviation
    session_drift: {z: unknown}               an unknown change of z from the first to the last row

Components are those of the noise, without targets. One that a mapping does not name has no such
error; names may be patterns, and the last one that matches counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, cast

from loopcal.io.core.yaml_file import Location, YamlFile, refuse_unknown_keys
from loopcal.units import EXAMPLES, find_sd_fault

if TYPE_CHECKING:
    from loopcal.measure import Kind

UNKNOWN = "unknown"
SETTINGS: Mapping[str, str] = {
    "session_bias": "`unknown`, or component -> standard deviation or `unknown`: an offset that "
    "all rows of a session share",
    "session_drift": "the same for a change from the first to the last row of a session, linear "
    "in time or, without the column `time`, in the order of the rows",
}
ITEMS: Mapping[str, str] = {"session_bias": "bias", "session_drift": "drift"}


def read_shared_errors(
    file: YamlFile, node: Mapping[str, Any], kind: Kind, location: Location
) -> tuple[Kind, dict[str, float]]:
    """Return a kind with its shared errors as unknowns, and parameter -> standard deviation [SI] of
    those with a prior; 0 where a component has no such error.

    Raises
    ------
    FileError : an unknown component, or not a standard deviation.
    """
    from loopcal.measure.kinds.shared_errors import list_components, name_shared_error

    priors: dict[str, float] = {}
    for key, item in ITEMS.items():
        if key not in node:
            continue
        place, stated = (*location, key), node[key]
        components = dict(list_components(kind))
        if stated != UNKNOWN and not (isinstance(stated, dict) and stated):
            example = ", ".join(f"{name}: {EXAMPLES[d]}" for name, d in components)
            sentence = f"{key!r} is {stated!r}; write '{key}: {UNKNOWN}', or standard deviations"
            raise file.error(f"{sentence}, as '{key}: {{{example}}}'", place)
        kind = replace(cast(Any, kind), unknown=tuple(dict.fromkeys((*kind.unknown, item))))
        if stated == UNKNOWN:
            continue
        priors |= {name_shared_error(kind, item, name): 0.0 for name, _ in components}
        for pattern, text in stated.items():
            matching = [(n, d) for n, d in components if fnmatchcase(n, str(pattern))]
            if not matching:
                refuse_unknown_keys(file, [pattern], [name for name, _ in components], place)
            for name, dimension in matching:
                parameter = name_shared_error(kind, item, name)
                priors.pop(parameter, None)
                if text == UNKNOWN:
                    continue
                priors[parameter] = file.quantity(text, dimension, (*place, pattern))
                if fault := find_sd_fault(priors[parameter]):
                    sentence = f"the standard deviation is {text}; {fault}, or {UNKNOWN}"
                    raise file.error(sentence, (*place, pattern))
    return kind, priors
