# SPDX-License-Identifier: Apache-2.0
"""Interpretations of measurements with a frame, target or anchor that no file declares unknown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from loopcal.diagnose.conventions.interpretations.interpretation import Interpretation
from loopcal.measure import Kind, Measurements

DECLARED = ("frame", "targets", "tool", "anchor")
"""Setup items that a user may forget to declare unknown. Surfaces with their frames and offsets are
none of them: the errors of the machine explain those, too.
"""


@dataclass(frozen=True, eq=False)
class SetupInterpretation(Interpretation):
    """Measurements some setup items of which are estimated; their values stay as written.

    Attributes
    ----------
    items : of `DECLARED`, unknown in all kinds that allow them.
    """

    items: tuple[str, ...] = ()

    def apply(self, data: Measurements) -> Measurements:
        """Return the measurements with these items unknown."""
        changed = []
        for rows in data.observations:
            more = tuple(item for item in self.items if item in _list_known(rows.kind))
            unknown = (*rows.kind.unknown, *more)
            changed.append(replace(rows, kind=replace(rows.kind, unknown=unknown)))
        return replace(data, observations=tuple(changed))


def list_setup_interpretations(data: Measurements, count: int) -> Iterator[SetupInterpretation]:
    """Yield measurements with `count` setup items unknown that are known as written; two of them
    are the frame and another one.
    """
    known = [_list_known(rows.kind) if len(rows) else () for rows in data.observations]
    items = [item for item in DECLARED if any(item in names for names in known)]
    for chosen in combinations(items, count):
        if count > 1 and chosen[0] != "frame":
            continue
        first = next(i for i, names in enumerate(known) if chosen[0] in names)
        unknown = (*data.observations[first].kind.unknown, *chosen)
        details = {"items": chosen, "unknown": tuple(dict.fromkeys(unknown))}
        yield SetupInterpretation("undeclared-setup", details, "", first, np.array, chosen)


def _list_known(kind: Kind) -> tuple[str, ...]:
    """Return the items that a kind allows to be unknown, and that it states."""
    allowed = set(kind.allowed_unknown)
    if "surface" in allowed:
        allowed.discard("frame")
    return tuple(i for i in DECLARED if i in allowed and i not in kind.unknown)
