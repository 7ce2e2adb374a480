# SPDX-License-Identifier: Apache-2.0
"""A study: its specification, its cells, its blocks and the columns of their results.

study file ──> Study ──> cells (product of the levels of all factors) ──> blocks of B trials

A factor is what a study varies. Each of its levels is one of these records, with a name. Numbers
are in SI; the reader of study files converts them.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin, get_type_hints

import msgspec

from loopcal.checks import NOT_NEGATIVE, POSITIVE, Limit, Limited, check_choice, whole_numbers
from loopcal.errors import DataError, UnitError
from loopcal.estimate.losses import LOSSES
from loopcal.estimate.methods import METHODS, SETTINGS
from loopcal.estimate.options import NO_LOSS, Noise
from loopcal.io.core import limits
from loopcal.measure.instrument import SIGMA, Distribution
from loopcal.results.result import Result
from loopcal.units import SI_SYMBOLS, Angle, Dimension, Length, find_unit, parse_quantity

# Key of a factor in a study file -> its name in cells and tables.
FACTORS: Mapping[str, str] = {
    "robots": "robot",
    "instruments": "instrument",
    "noise": "noise",
    "poses": "poses",
    "errors": "errors",
    "methods": "method",
    "effects": "effects",
}

PER_LEG = "per-leg"  # method of a level beside those of `loopcal.estimate.methods`
FEWEST_POINTS = 4  # smallest number of points of a plane with its line


@dataclass(frozen=True)
class Robot:
    """A robot. `text` : of its robot file. `source` : the name or file that the study states."""

    source: str
    text: str


@dataclass(frozen=True)
class InstrumentLevel(Limited):
    """An instrument, as the command line and `build_instrument` describe it.

    kinds : kinds of measurement. components : coordinates that the kind `component` measures.
    orientation : form of measured angles. sigma_position, sigma_angle : standard deviation of each
        length and each angle, by default 10 um and 50 urad.
    unknown_frames : which of "base" and "tool" the fit estimates. distribution : of the noise. A
        sigma is its standard deviation, so uniform noise lies within sqrt(3) of it.
    unused : measured columns that the fit does not get, such as psi, for a comparison on equal
        measurements.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "sigma_position": Limit(lambda value: value > 0.0, "above 0 m"),
        "sigma_angle": Limit(lambda value: value > 0.0, "above 0 rad"),
    }
    kinds: tuple[str, ...] = ("pose",)
    components: tuple[str, ...] = ()
    orientation: str | None = None
    sigma_position: Length = SIGMA[Dimension.LENGTH]
    sigma_angle: Angle = SIGMA[Dimension.ANGLE]
    unknown_frames: tuple[str, ...] = ()
    distribution: Distribution = "normal"
    unused: tuple[str, ...] = ()


@dataclass(frozen=True)
class NoiseLevel(Limited):
    """A factor on all sigmas of the instrument, which the fit knows."""

    PLAIN: ClassVar[str] = "factor"
    LIMITS: ClassVar[Mapping[str, Limit]] = {"factor": POSITIVE}
    factor: float = 1.0


@dataclass(frozen=True)
class PosesLevel(Limited):
    """The measured poses.

    count : number of poses. choice : "random" in the workspace, "planned" for the robot and the
        instrument, "tilts" on three rings of equal tilt, or "plane-line" on planes and
        perpendicular lines. seed : of the draw or the plan (default: of the study).
    groups : planes with a line each, for "plane-line". count is the number of all their points.
    axis : along which their lines run. sweeps : of the coordinate exchange that improves the points
        (0: as drawn).
    file : CSV file of poses next to the study file, in place of these settings.
    coordinates : (n, c) controlled coordinates [m, rad] of that file.
    """

    PLAIN: ClassVar[str] = "count"
    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "count": whole_numbers(1, 10_000),
        "seed": NOT_NEGATIVE,
        "sweeps": whole_numbers(0, 100),
    }
    count: int = 40
    choice: Literal["random", "planned", "tilts", "plane-line"] = "random"
    groups: int = 10
    axis: Literal["x", "y", "z"] = "z"
    sweeps: int = 3
    seed: int | None = None
    file: str | None = None
    coordinates: tuple[tuple[float, ...], ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.choice == "plane-line":
            whole = self.groups >= 1 and self.count % self.groups == 0
            if not whole or self.count < FEWEST_POINTS * self.groups:
                raise ValueError(
                    f"{self.count} points do not make {self.groups} equal groups of at least "
                    f"{FEWEST_POINTS}. Change count or groups"
                )

    @property
    def is_on_surfaces(self) -> bool:
        """Whether the poses are points of planes and perpendicular lines."""
        return self.choice == "plane-line"


@dataclass(frozen=True)
class ErrorsLevel(Limited):
    """The errors of the true machines, and their expected spreads in the fit.

    tolerance_factor : on the expected spreads, which the fit knows.
    error_factor : true errors over expected spreads, which the fit does not know.
    distribution : of the errors. The spread is their standard deviation. Uniform errors
        lie within sqrt(3) of it.
    smallest : smallest size of a uniform error as a share of its largest (the spread stays its
        standard deviation).
    tolerances : other expected spreads by name or pattern, such as `leg*.length`.
    deviations : equal true deviations from nominal in all trials, by name or pattern. Other
        parameters are nominal.
    """

    PLAIN: ClassVar[str] = "tolerance_factor"
    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "tolerance_factor": POSITIVE,
        "error_factor": NOT_NEGATIVE,
        "smallest": Limit(lambda value: 0 <= value < 1, "0 or more, and less than 1"),
    }
    tolerance_factor: float = 1.0
    error_factor: float = 1.0
    distribution: Distribution = "normal"
    smallest: float = 0.0
    tolerances: Mapping[str, str] = field(default_factory=dict)
    deviations: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.smallest and self.distribution != "uniform":
            raise ValueError("smallest belongs to uniform errors. Add 'distribution: uniform'")
        is_drawn = self.error_factor != 1.0 or self.distribution != "normal"
        if self.deviations and is_drawn:
            raise ValueError(
                "deviations are equal in all trials, so error_factor and distribution have no "
                "effect with them. Remove these"
            )


@dataclass(frozen=True)
class MethodLevel(Limited):
    """Estimation of the parameters.

    method : "auto" is the default of `identify`, see `loopcal.estimate.methods`. "per-leg"
        identifies a hexapod leg by leg from full poses, as a published study does.
    lam : weight of the penalty of ridge, or one by name or pattern of parameters, such as `{"*":
        0.01, "*.length": 1}`, see `Ridge.resolve`. keep : directions of truncated-svd. Without
        them cross-validation chooses both.
    loss, noise : as in `FitOptions`.
    rows : for comparisons. "raw" rows have the weight one in millimeters and radians, full steps
        and no rank detection: ridge and truncated-svd need `lam` and `keep`. "products" are
        products of points on planes and lines with their covariance. "-printed" have the weight
        one, "-distance" are distances from the plane, "-single" have own variances.
    epsilon : limit at which raw and per-leg fits end: of the largest component of a step [mm, rad]
        (raw fits, 1e-6 by default), or of what `stop` names. steps : of these fits, at most, or
        without epsilon exactly (3 by default for per-leg).
    stop : what epsilon limits of per-leg: "dQint", the default, is the largest error of a pose
        after a step, position [mm] plus angle [rad]. "step" is its largest component.
    """

    PLAIN: ClassVar[str] = "method"
    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "lam": Limit(
            lambda lam: all(x >= 0 for x in (lam.values() if isinstance(lam, Mapping) else [lam])),
            "0 or more",
        ),
        "keep": NOT_NEGATIVE,
        "epsilon": POSITIVE,
        "steps": whole_numbers(1, 1_000_000),
    }
    method: Annotated[str, METHODS, PER_LEG] = "auto"
    lam: float | Mapping[str, float] | None = None
    keep: int | None = None
    loss: Annotated[str, NO_LOSS, LOSSES] = NO_LOSS
    noise: Noise = "given"
    rows: Literal[
        "weighted", "raw", "products", "products-printed", "products-distance", "products-single"
    ] = "weighted"
    epsilon: float | None = None
    steps: int | None = None
    stop: Literal["step", "dQint"] | None = None

    @property
    def is_published(self) -> bool:
        """Whether the method is one of published studies, without uncertainties."""
        return self.rows != "weighted" or self.method == PER_LEG

    @property
    def has_steps(self) -> bool:
        """Whether the fit takes full steps until they are small."""
        return self.rows == "raw" or self.method == PER_LEG

    @property
    def is_of_products(self) -> bool:
        """Whether the rows are products of points on planes and lines."""
        return self.rows.startswith("products")

    def __post_init__(self) -> None:
        super().__post_init__()
        for key, registry, other in (("method", METHODS, PER_LEG), ("loss", LOSSES, NO_LOSS)):
            value = getattr(self, key)
            if value in registry:
                object.__setattr__(self, key, registry.resolve(value))
            else:
                check_choice(key, value, (*registry, other), ValueError)
        self._check_published()
        for key in ("lam", "keep"):
            method = SETTINGS[key][0]
            if getattr(self, key) is not None and self.method != method:
                raise ValueError(
                    f"{key} belongs to the method {method}, not to {self.method}. Remove it, or "
                    "change the method"
                )

    def _check_published(self) -> None:
        """Refuse settings that methods of published studies do not have, or alone have."""
        if not self.has_steps:
            for key in ("epsilon", "steps"):
                if getattr(self, key) is not None:
                    raise ValueError(
                        f"{key} belongs to 'rows: raw' and to the method per-leg. Remove it"
                    )
        if self.stop and (self.method != PER_LEG or self.epsilon is None):
            raise ValueError(
                "stop belongs to the method per-leg with epsilon. Add these, or remove it"
            )
        if not self.is_published:
            return
        what = "the method per-leg" if self.method == PER_LEG else f"'rows: {self.rows}'"
        if self.loss != NO_LOSS or self.noise != "given":
            raise ValueError(f"{what} has neither loss nor estimated noise. Remove them")
        if self.method == PER_LEG and self.rows != "weighted":
            raise ValueError("the rows of per-leg are raw ones always. Remove 'rows'")
        for needed in ("lam", "keep"):
            if SETTINGS[needed][0] == self.method and getattr(self, needed) is None:
                raise ValueError(f"{self.method} with {what} needs {needed}. Add it")
        if self.method == "auto" or (self.method == "map" and self.rows == "raw"):
            raise ValueError(
                f"{self.method} needs weighted rows. Remove {what}, or take another method"
            )


@dataclass(frozen=True)
class Outliers(Limited):
    """`share` of the rows lie `size` sigmas off, in a random direction.

    If the share is less than one row, one row is off in as many of the trials.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "share": Limit(lambda value: 0.0 <= value <= 1.0, "from 0 to 1")
    }
    share: float = 0.05
    size: float = 20.0


@dataclass(frozen=True)
class ThermalGrowth:
    """The machine's lengths grow during the measurement.

    expansion : of lengths, per kelvin. rise : temperature of the last pose over the first [K]. It
        rises linearly, with the mean of the nominal machine.
    """

    expansion: float = 11.5e-6
    rise: float = 1.0


@dataclass(frozen=True)
class Backlash:
    """Play of the actuators: the true joint lags its reading by half of it, by the direction in
    which the reading came from that of the pose before.
    """

    length: Length = 0.0
    angle: Angle = 0.0


@dataclass(frozen=True)
class EffectsLevel(Limited):
    """What happens although the fit does not know of it. The defaults change nothing.

    noise : true sigma over the sigma of the fit. degrees : of Student's t noise (default: the
        distribution of the instrument). correlation : of the noise of a row with the noise of the
        row before.
    outliers : rows far off. drift : displacement of the instrument from the first to the last pose.
        jump : its displacement half-way. thermal, backlash : of the machine.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "noise": NOT_NEGATIVE,
        "degrees": Limit(lambda value: value > 2.0, "above 2, for a finite sigma"),
        "correlation": Limit(lambda value: abs(value) < 1.0, "between -1 and 1"),
    }
    noise: float = 1.0
    degrees: float | None = None
    correlation: float = 0.0
    outliers: Outliers | None = None
    drift: Length = 0.0
    jump: Length = 0.0
    thermal: ThermalGrowth | None = None
    backlash: Backlash | None = None


@dataclass(frozen=True)
class Scores(Limited):
    """Results of every trial.

    held_out : number of poses for the errors, drawn from the workspace and not measured. frame : of
        the errors, "fitted" or "base", or "both": also errors in the base frame as further scores.
    intervals : "stated" computes them from the stated noise, "adjusted" as a calibration does, with
        the noise of the residuals, which takes longer.
    verdict : calibrate every trial as `loopcal calibrate` does, with adjusted intervals, and record
        the verdict. It takes much longer. limit_position, limit_angle : limits of the verdict.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {"held_out": whole_numbers(1, 10_000)}
    held_out: int = 20
    frame: Literal["fitted", "base", "both"] = "fitted"
    intervals: Literal["stated", "adjusted"] = "stated"
    verdict: bool = False
    limit_position: Length | None = None
    limit_angle: Angle | None = None

    @property
    def error_frame(self) -> Literal["fitted", "base"]:
        """Frame of the scores that every study has."""
        return "base" if self.frame == "base" else "fitted"

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.limit_position or self.limit_angle) and not self.verdict:
            raise ValueError("a limit needs 'verdict: true'. Add it, or remove the limit")


@dataclass(frozen=True)
class Question(Limited):
    """A question that the summary answers: which is the smallest or the largest level of a factor
    with which a score stays within a limit on a share of the machines.

    factor : name of the factor, such as "poses" or "noise". score : name of a score, such as
        "position". limit : of the score, with its unit if it has one. share : of the machines.
    wanted : "smallest" or "largest" level that reaches it.
    """

    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "share": Limit(lambda value: 0.0 < value < 1.0, "between 0 and 1")
    }
    factor: str
    score: str
    limit: str | float
    share: float = 0.95
    wanted: Literal["smallest", "largest"] = "smallest"


@dataclass(frozen=True)
class LevelChain:
    """Levels of a factor that differ in numbers only, which increase together.

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
    levels = study.levels[factor]
    record = type(next(iter(levels.values())))
    records = {name: _flatten(level) for name, level in levels.items()}
    names = list(dict.fromkeys(key for settings in records.values() for key in settings))
    numbers = [n for n in names if all(_is_number(r.get(n)) for r in records.values())]
    words = [name for name in names if name not in numbers]
    differing = [w for w in words if len({repr(r.get(w)) for r in records.values()}) > 1]
    groups: dict[str, dict[str, dict[str, Any]]] = {}
    for name, settings in records.items():
        alike = repr([settings.get(word) for word in words])
        groups.setdefault(alike, {})[name] = settings
    units, ratio = _list_units(record), SI_SYMBOLS[Dimension.RATIO]
    chains: list[LevelChain] = []
    for group in groups.values():
        first = next(iter(group.values()))
        values = {word: first.get(word) for word in differing}
        label = ", ".join(
            f"{_say(word)} {' '.join(map(str, v)) if isinstance(v, tuple) else v}"
            for word, v in values.items()
        )
        varied = [n for n in numbers if len({r[n] for r in group.values()}) > 1]
        plain = getattr(record, "PLAIN", "")
        varied = varied or [plain] * (plain in numbers)
        ordered = sorted(group, key=lambda name, of=group: tuple(of[name][n] for n in varied))
        columns = [[float(group[name][n]) for name in ordered] for n in varied]
        if columns and all(column == sorted(column) for column in columns):
            unit, column = units.get(varied[0], ratio), tuple(columns[0])
            chains.append(LevelChain(label, _say(varied[0]), unit, tuple(ordered), column))
        else:
            chains += [LevelChain(label or name, "", ratio, (name,), (None,)) for name in group]
    return tuple(chains)


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


def _list_units(record: type, prefix: str = "") -> dict[str, str]:
    """Return setting -> SI symbol of the numbers of a record with a dimension."""
    units: dict[str, str] = {}
    for name, hint in get_type_hints(record, include_extras=True).items():
        for part in (hint, *get_args(hint)):
            if get_origin(part) is Annotated and isinstance(mark := get_args(part)[1], Dimension):
                units[prefix + name] = SI_SYMBOLS[mark]
            elif isinstance(part, type) and is_dataclass(part):
                units |= _list_units(part, f"{prefix}{name}.")
    return units


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _say(setting: str) -> str:
    return setting.replace("_", " ").replace(".", " ")


# The study of these levels.


@dataclass(frozen=True)
class ScoreColumn:
    """A column of the results of trials. `unit` : "m", "rad" or "1"."""

    name: str
    unit: str
    meaning: str


@cache
def read_columns() -> Mapping[str, tuple[ScoreColumn, ...]]:
    """Return the columns of `scores.toml` by group: those of every study, of one that calibrates
    every trial in full, and of one that states errors in both frames.
    """
    groups = tomllib.loads(Path(__file__).with_name("scores.toml").read_text("utf-8"))
    return {
        group: tuple(ScoreColumn(name, *of) for name, of in listed.items())
        for group, listed in groups.items()
    }


def list_columns(scores: Scores) -> tuple[ScoreColumn, ...]:
    """Return the columns of the results of trials."""
    columns = read_columns()
    verdict = columns["verdict"] if scores.verdict else ()
    return (*columns["every"], *verdict, *(columns["base"] if scores.frame == "both" else ()))


MORE_IS_BETTER = ("covered_", "rank")  # beginning of the names of scores that have no upper limit


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
            f"factor is {question.factor!r}, whose levels ({named}) have no order to find the "
            f"{question.wanted}. Ask for a factor whose levels differ in a number"
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

MOST_TRIALS = 2000  # largest number of trials of a block


@dataclass(frozen=True)
class StudySettings(Limited):
    """The settings of a study file beside its factors.

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

    def page(self) -> list[Any]:
        """Return title, size and factors."""
        factors = [f"{name}: {', '.join(self.levels[name])}" for name in self.order]
        size = f"{len(self.cells)} cells of {self.replicates} trials, seed {self.seed}"
        return ["\n".join([f"{self.title}: {size}", *factors])]

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

    def to_json(self) -> str:
        """Return the study as JSON, which `from_json` reads."""
        return msgspec.json.encode(self).decode()

    @classmethod
    def from_json(cls, text: str) -> Study:
        """Return the study of a text of `to_json`."""
        return msgspec.json.decode(text, type=cls)


FREE = frozenset({"title", "order", "questions"})  # keys that change no number
# Factor -> setting that says where a level was read.
NAMES_OF_FILES = {"robots": "source", "poses": "file"}
LONGEST = 40  # characters of a value that is shown
REMOVED: Any = object()  # in place of a level that a study does not have any more


def list_conflicts(old: str, new: str) -> tuple[str, ...]:
    """Return the changes of a study (as JSON) by which its finished blocks would not belong to it
    any more, such as `errors/wide/error_factor: 2 -> 3`.

    More replicates, further levels, other names of files with the same content, and another title,
    order or question are none.
    """
    before, after = json.loads(old), json.loads(new)
    after |= {key: before[key] for key in FREE}
    after["replicates"] = min(after["replicates"], before["replicates"])
    for key in FACTORS:
        after[key] = {level: after[key].get(level, REMOVED) for level in before[key]}
        for level in (*before[key].values(), *after[key].values()):
            if level is not REMOVED:
                level.pop(NAMES_OF_FILES.get(key), None)  # its content counts
    return tuple(_compare("", before, after))


def _compare(path: str, old: Any, new: Any) -> Iterator[str]:
    """Yield the differences of two values, with their places."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys((*old, *new)):
            yield from _compare(f"{path}/{key}".lstrip("/"), old.get(key), new.get(key))
    elif new is REMOVED:
        yield f"{path}: removed"
    elif old != new:
        texts = [json.dumps(value, ensure_ascii=False) for value in (old, new)]
        is_short = all(len(text) <= LONGEST for text in texts)
        more = " (allowed: more)" if path == "replicates" else ""
        yield f"{path}: {texts[0]} -> {texts[1]}{more}" if is_short else f"{path}: changed"
