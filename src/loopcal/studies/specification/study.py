# SPDX-License-Identifier: Apache-2.0
"""A study: its specification, its cells, its blocks and the columns of their results.

study file ──> Study ──> cells (product of the levels of all factors) ──> blocks of B trials
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import msgspec

from loopcal.checks import Limit, Limited, check_choice, whole_numbers
from loopcal.errors import DataError, UnitError
from loopcal.io.core import limits
from loopcal.results.result import Result
from loopcal.studies.specification.levels import (
    FACTORS,
    EffectsLevel,
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    NoiseLevel,
    PosesLevel,
    Question,
    Robot,
    Scores,
    list_chains,
)
from loopcal.units import SI_SYMBOLS, Dimension, find_unit, parse_quantity


@dataclass(frozen=True)
class ScoreColumn:
    """A column of the results of trials. `unit` : "m", "rad" or "1"."""

    name: str
    unit: str
    meaning: str


COLUMNS = (
    ScoreColumn("outcome", "1", "0 for a trial that converged, else the number of a code"),
    ScoreColumn("position_before", "m", "held-out position error before calibration, rms"),
    ScoreColumn("position_before_max", "m", "held-out position error before calibration, largest"),
    ScoreColumn("position", "m", "held-out position error after calibration, rms"),
    ScoreColumn("position_max", "m", "held-out position error after calibration, largest"),
    ScoreColumn("orientation_before", "rad", "held-out rotation error before calibration, rms"),
    ScoreColumn(
        "orientation_before_max", "rad", "held-out rotation error before calibration, largest"
    ),
    ScoreColumn("orientation", "rad", "held-out rotation error after calibration, rms"),
    ScoreColumn("orientation_max", "rad", "held-out rotation error after calibration, largest"),
    ScoreColumn("parameters", "1", "error of the parameters over their tolerances, rms"),
    ScoreColumn("parameters_max", "1", "error of the parameters over their tolerances, largest"),
    ScoreColumn("lengths", "m", "error of the parameters that are lengths, rms"),
    ScoreColumn("angles", "rad", "error of the parameters that are angles, rms"),
    ScoreColumn("covered_parameters", "1", "share of the parameters in their 95 % intervals"),
    ScoreColumn("covered_position", "1", "share of held-out poses with position error below U95"),
    ScoreColumn(
        "covered_orientation", "1", "share of held-out poses with rotation error below U95"
    ),
    ScoreColumn("rank", "1", "number of combinations of parameters that the data determine"),
    ScoreColumn("condition", "1", "condition number of the scaled rows"),
    ScoreColumn("iterations", "1", "steps of the fit"),
    ScoreColumn("noise_scale", "1", "residuals over given noise"),
)
"""Columns of every study."""

VERDICT_COLUMNS = (
    ScoreColumn("verdict", "1", "0 calibrated, 1 with reservations, 2 undecided, 3 not calibrated"),
)
"""Further columns of a study that calibrates every trial in full."""

BASE_COLUMNS = (
    ScoreColumn("position_base_before", "m", "position error before, in the base frame, rms"),
    ScoreColumn("position_base", "m", "position error after, in the base frame, rms"),
    ScoreColumn("orientation_base_before", "rad", "rotation error before, in the base frame, rms"),
    ScoreColumn("orientation_base", "rad", "rotation error after, in the base frame, rms"),
)
"""Further columns of a study that states errors in both frames."""


def list_columns(scores: Scores) -> tuple[ScoreColumn, ...]:
    """Return the columns of the results of trials."""
    verdict = VERDICT_COLUMNS if scores.verdict else ()
    return (*COLUMNS, *verdict, *(BASE_COLUMNS if scores.frame == "both" else ()))


MORE_IS_BETTER = ("covered_", "rank")
"""Beginning of the names of scores that have no upper limit."""


def check_question(study: Study, question: Question) -> float:
    """Return the limit of a question [SI].

    Raises DataError: a factor or a score that the study does not have, a factor whose levels have
    no order, a score of which more is better, or a limit in another unit.
    """
    factors = tuple(FACTORS.values())
    check_choice("factor", question.factor, factors, DataError)
    chains = list_chains(study, question.factor)
    if len(chains) > 1 and all(len(chain.levels) == 1 for chain in chains):
        named = ", ".join(chain.levels[0] for chain in chains)
        raise DataError(
            f"factor is {question.factor!r}, whose levels ({named}) have no order, so none is the "
            f"{question.wanted}; ask for a factor whose levels differ in a number"
        )
    columns = {
        column.name: column
        for column in list_columns(study.scores)[1:]
        if not column.name.startswith(MORE_IS_BETTER)
    }
    check_choice("score", question.score, columns, DataError)
    unit = columns[question.score].unit
    try:
        if unit == SI_SYMBOLS[Dimension.RATIO]:
            return float(question.limit)
        return parse_quantity(str(question.limit), find_unit(unit).dimension)
    except UnitError as error:
        raise DataError(f"limit: {error}") from None
    except ValueError:
        raise DataError(
            f"limit is {question.limit!r}, but {question.score} has no unit. Give a number"
        ) from None


@dataclass(frozen=True)
class Cell:
    """One combination of levels.

    number : from 0, in the order of the study. levels : factor -> name of its level, for every
        factor, such as {"robot": "linear-delta", "poses": "20"}.
    """

    number: int
    levels: Mapping[str, str]

    def __str__(self) -> str:
        return ", ".join(f"{factor} {level}" for factor, level in self.levels.items())


NUMERICS = 2
"""Version of the numbers of a block; another one makes all blocks anew.

2: fits begin with chords, so that estimates differ from those of version 1 by less than 1e-3
standard deviations, and the iterations are fewer.
"""


@dataclass(frozen=True)
class CellContent:
    """What determines the numbers of all blocks of a cell, see `describe_cell`.

    robot : text of its file. trials : of a block. measured, held_out : poses (n, c) [m, rad], of
        the content of a task.
    """

    seed: int
    robot: str
    trials: int = 0
    instrument: InstrumentLevel = field(default_factory=InstrumentLevel)
    noise: NoiseLevel = field(default_factory=NoiseLevel)
    poses: PosesLevel = field(default_factory=PosesLevel)
    errors: ErrorsLevel = field(default_factory=ErrorsLevel)
    method: MethodLevel = field(default_factory=MethodLevel)
    effects: EffectsLevel = field(default_factory=EffectsLevel)
    scores: Scores = field(default_factory=Scores)
    measured: tuple[tuple[float, ...], ...] = ()
    held_out: tuple[tuple[float, ...], ...] = ()


def describe_cell(study: Study, cell: Cell) -> dict[str, Any]:
    """Return the content of a cell as plain values: what differs from the defaults."""
    levels: dict[str, Any] = {n: of_factor[cell.levels[n]] for n, of_factor in study.levels.items()}
    robot = levels.pop("robot")
    levels["poses"] = replace(levels["poses"], file=None)  # its poses count, not its name
    return {
        "numerics": NUMERICS,
        "seed": study.seed,
        "trials": study.block,
        "robot": robot.text,
        **{name: describe_record(level) for name, level in levels.items()},
        "scores": describe_record(study.scores),
    }


def compute_key(content: Mapping[str, Any]) -> str:
    """Return the hash of the description of a block."""
    return hashlib.sha256(format_json(content).encode()).hexdigest()


def format_json(content: Mapping[str, Any]) -> str:
    """Return plain values as canonical JSON: sorted keys, shortest numbers, ASCII."""
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)


def describe_record(record: Any) -> dict[str, Any]:
    """Return the fields of a record that differ from their defaults, as plain values."""
    default = type(record)()
    return {
        item.name: describe_record(value) if is_dataclass(value) else value
        for item in fields(record)
        if (value := getattr(record, item.name)) != getattr(default, item.name)
    }


BLOCK, REPLICATES = 50, 1000
"""Trials of a block, and of a cell, by default."""


MOST_TRIALS = 2000
"""Largest number of trials of a block."""


@dataclass(frozen=True)
class StudySettings(Limited):
    """The settings of a study file beside its factors.

    Parameters
    ----------
    title : what the study is about. seed : of all random numbers, 0 or more.
    replicates : trials of each cell. block : trials of a block, the unit of work; at most 2000, as
        a block of a hexapod needs about half a megabyte of memory for each trial.
    scores : what is computed of every trial. questions : name -> what the summary answers.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "seed": whole_numbers(0, 2**63),
        "replicates": whole_numbers(1, limits.REPLICATES.most),
        "block": whole_numbers(1, MOST_TRIALS),
    }
    title: str
    seed: int = 1
    replicates: int = REPLICATES
    block: int = BLOCK
    scores: Scores = field(default_factory=Scores)
    questions: dict[str, Question] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Study(StudySettings, Result):
    """The specification of a study; equal specifications give equal numbers.

    Parameters
    ----------
    title, seed, replicates, block, scores, questions : see `StudySettings`.
    robots, instruments, noise, poses, errors, methods, effects : name of a level -> level.
    order : names of the factors, in the order of the file; the last one varies fastest.
    """

    robots: Mapping[str, Robot]
    instruments: Mapping[str, InstrumentLevel] = field(
        default_factory=lambda: {"pose": InstrumentLevel()}
    )
    noise: Mapping[str, NoiseLevel] = field(default_factory=lambda: {"1": NoiseLevel()})
    poses: Mapping[str, PosesLevel] = field(default_factory=lambda: {"40": PosesLevel()})
    errors: Mapping[str, ErrorsLevel] = field(default_factory=lambda: {"1": ErrorsLevel()})
    methods: Mapping[str, MethodLevel] = field(default_factory=lambda: {"auto": MethodLevel()})
    effects: Mapping[str, EffectsLevel] = field(default_factory=lambda: {"none": EffectsLevel()})
    order: tuple[str, ...] = ("robot",)

    def _repr_html_(self) -> str:
        """Return title, size and factors as HTML."""
        from loopcal.results.notebook import render_html

        factors = [f"{name}: {', '.join(self.levels[name])}" for name in self.order]
        size = f"{len(self.cells)} cells of {self.replicates} trials, seed {self.seed}"
        return render_html(["\n".join([f"{self.title}: {size}", *factors])])

    @cached_property
    def levels(self) -> dict[str, Mapping[str, Any]]:
        """Factor -> its levels by name: factors of the file in its order, then the others."""
        levels = {name: getattr(self, key) for key, name in FACTORS.items()}
        return {name: levels[name] for name in dict.fromkeys((*self.order, *levels))}

    @property
    def varied_factors(self) -> tuple[str, ...]:
        """Names of the factors that have more than one level."""
        return tuple(name for name, levels in self.levels.items() if len(levels) > 1)

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """All combinations of levels; the last factor of the file varies fastest."""
        chosen = enumerate(itertools.product(*self.levels.values()))
        return tuple(Cell(i, dict(zip(self.levels, names, strict=True))) for i, names in chosen)

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
        return compute_key(describe_cell(self, cell) | {"block": block})

    def to_json(self) -> str:
        """Return the study as JSON, which `from_json` reads."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def from_json(cls, text: str) -> Study:
        """Return the study of a text of `to_json`."""
        return msgspec.json.decode(text, type=cls)


FREE = frozenset({"title", "order", "questions"})
"""Keys that change no number."""

NAMES_OF_FILES = {"robots": "source", "poses": "file"}
"""Factor -> setting that says where a level was read."""

LONGEST = 40
"""Characters of a value that is shown."""


def list_conflicts(old: str, new: str) -> tuple[str, ...]:
    """Return the changes of a study (as JSON) by which its finished blocks would not belong to it
    any more, such as `errors/wide/error_factor: 2 -> 3`.

    More replicates, further levels, other names of files with the same content, and another title,
    order or question are none.
    """
    return tuple(_compare(json.loads(old), json.loads(new)))


def _compare(old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    for key in dict.fromkeys((*old, *new)):
        before: Any = old.get(key)
        after: Any = new.get(key)
        if key in FREE:
            continue
        if key == "replicates":
            if after < before:
                yield f"replicates: {before} -> {after} (more are allowed, but not fewer)"
        elif key in FACTORS:
            for level in before:
                if level not in after:
                    yield f"{key}/{level}: removed"
                    continue
                file = {NAMES_OF_FILES.get(key): None}  # its content counts
                yield from _compare_values(
                    f"{key}/{level}", before[level] | file, after[level] | file
                )
        else:
            yield from _compare_values(key, before, after)


def _compare_values(path: str, old: Any, new: Any) -> Iterator[str]:
    """Yield the differences of two values, with their places."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys((*old, *new)):
            yield from _compare_values(f"{path}/{key}", old.get(key), new.get(key))
    elif old != new:
        texts = [json.dumps(value, ensure_ascii=False) for value in (old, new)]
        is_short = all(len(text) <= LONGEST for text in texts)
        yield f"{path}: {texts[0]} -> {texts[1]}" if is_short else f"{path}: changed"
