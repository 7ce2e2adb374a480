# SPDX-License-Identifier: Apache-2.0
"""The cells of a study: all combinations of the levels of its factors."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from loopcal.studies.specification.levels import FACTORS

if TYPE_CHECKING:
    from loopcal.studies.specification.study import Study


@dataclass(frozen=True)
class Cell:
    """One combination of levels.

    Attributes
    ----------
    number : from 0, in the order of the study. levels : factor -> name of its level, for every
        factor, such as {"robot": "linear-delta", "poses": "20"}.
    """

    number: int
    levels: Mapping[str, str]

    def __str__(self) -> str:
        return ", ".join(f"{factor} {level}" for factor, level in self.levels.items())


def list_cells(study: Study) -> tuple[Cell, ...]:
    """Return the product of the levels of all factors; the last factor varies fastest."""
    names = list_factors(study)
    keys = {name: key for key, name in FACTORS.items()}
    levels = itertools.product(*(getattr(study, keys[name]) for name in names))
    return tuple(Cell(i, dict(zip(names, chosen, strict=True))) for i, chosen in enumerate(levels))


def list_factors(study: Study) -> tuple[str, ...]:
    """Return the names of all factors: those of the file in its order, then the others."""
    return tuple(dict.fromkeys((*study.order, *FACTORS.values())))


def list_varied_factors(study: Study) -> tuple[str, ...]:
    """Return the names of the factors that have more than one level."""
    keys = {name: key for key, name in FACTORS.items()}
    return tuple(name for name in list_factors(study) if len(getattr(study, keys[name])) > 1)


def select_levels(study: Study, cell: Cell) -> dict[str, Any]:
    """Return the levels of a cell by the name of their factor."""
    return {name: getattr(study, key)[cell.levels[name]] for key, name in FACTORS.items()}
