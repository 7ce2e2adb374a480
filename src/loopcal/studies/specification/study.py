# SPDX-License-Identifier: Apache-2.0
"""A study: its specification, its cells, its blocks and the columns of their results.

study file ──> Study ──> cells (product of the levels of all factors) ──> blocks of B trials
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from loopcal.presentation import HtmlResult
from loopcal.studies.specification.cells import Cell, list_cells
from loopcal.studies.specification.keys import compute_key, describe_block, dump_json, load_json
from loopcal.studies.specification.levels import (
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
    Question,
    Robot,
    Scores,
)
from loopcal.studies.specification.scores import ScoreColumn, list_columns

BLOCK, REPLICATES = 50, 1000
"""Trials of a block, and of a cell, by default."""


@dataclass(frozen=True)
class Study(HtmlResult):
    """The specification of a study; equal specifications give equal numbers.

    Parameters
    ----------
    title, seed : of the study. replicates : trials of each cell. block : trials of a block.
    robots, instruments, noise, poses, errors, methods, effects : name of a level -> level.
    order : names of the factors, in the order of the file; the last one varies fastest.
    scores : what is computed of every trial. questions : name -> what the summary answers.
    """

    title: str
    robots: Mapping[str, Robot]
    seed: int = 1
    replicates: int = REPLICATES
    block: int = BLOCK
    instruments: Mapping[str, InstrumentLevel] = field(
        default_factory=lambda: {"pose": InstrumentLevel()}
    )
    noise: Mapping[str, NoiseLevel] = field(default_factory=lambda: {"1": NoiseLevel()})
    poses: Mapping[str, PosesLevel] = field(default_factory=lambda: {"40": PosesLevel()})
    errors: Mapping[str, ErrorsLevel] = field(default_factory=lambda: {"1": ErrorsLevel()})
    methods: Mapping[str, MethodLevel] = field(default_factory=lambda: {"auto": MethodLevel()})
    effects: Mapping[str, EffectsLevel] = field(default_factory=lambda: {"none": EffectsLevel()})
    order: tuple[str, ...] = ("robot",)
    scores: Scores = field(default_factory=Scores)
    questions: Mapping[str, Question] = field(default_factory=dict)

    def _repr_html_(self) -> str:
        """Return title, size and factors as HTML."""
        from loopcal.report.notebook import render_html

        levels = {n: dict.fromkeys(c.levels[n] for c in self.cells) for n in self.order}
        factors = [f"{name}: {', '.join(names)}" for name, names in levels.items()]
        size = f"{len(self.cells)} cells of {self.replicates} trials, seed {self.seed}"
        return render_html(["\n".join([f"{self.title}: {size}", *factors])])

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """Return all combinations of levels, in the order of the file."""
        return list_cells(self)

    @property
    def columns(self) -> tuple[ScoreColumn, ...]:
        """Return the columns of the results of trials; the first is the outcome."""
        return list_columns(self.scores)

    @property
    def blocks(self) -> int:
        """Return the number of blocks of each cell."""
        return math.ceil(self.replicates / self.block)

    def count_trials(self, block: int) -> int:
        """Return the trials of a block that count: the last block may have more than are asked."""
        return min(self.block, self.replicates - block * self.block)

    def compute_key(self, cell: Cell, block: int) -> str:
        """Return the key of a block."""
        return compute_key(describe_block(self, cell, block))

    def to_json(self) -> str:
        """Return the study as JSON, which `from_json` reads."""
        return dump_json(self)

    @classmethod
    def from_json(cls, text: str) -> Study:
        """Return the study of a text of `to_json`."""
        return load_json(cls, text)
