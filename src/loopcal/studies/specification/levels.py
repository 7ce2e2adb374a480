# SPDX-License-Identifier: Apache-2.0
"""The records of a study file: the levels of its factors, its scores and its quick tier.

A factor is what a study varies. Each of its levels is one of these records, with a name. Numbers
are in SI; the reader of study files converts them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    get_args,
    get_origin,
    get_type_hints,
)

from loopcal.errors import suggest_names
from loopcal.estimate.losses import LOSSES
from loopcal.estimate.methods import METHODS, SETTINGS
from loopcal.estimate.options import NO_LOSS, Noise
from loopcal.measure.instrument import Distribution
from loopcal.units import SI_SYMBOLS, Angle, Dimension, Length

if TYPE_CHECKING:
    from loopcal.studies.specification.study import Study

FACTORS: Mapping[str, str] = {
    "robots": "robot",
    "instruments": "instrument",
    "noise": "noise",
    "poses": "poses",
    "errors": "errors",
    "methods": "method",
    "effects": "effects",
}
"""Key of a factor in a study file -> its name in cells and tables."""

MOST_POSES = 10_000
"""Largest number of measured or held-out poses of a trial."""

MOST_STEPS = 1_000_000
"""Largest number of steps of a raw fit."""

MOST_SWEEPS, FEWEST_POINTS = 100, 4
"""Largest number of sweeps of an exchange; smallest number of points of a plane with its line."""

PER_LEG = "per-leg"
"""Method of a level beside those of `loopcal.estimate.methods`."""


@dataclass(frozen=True)
class Robot:
    """A robot. `text` : of its robot file. `source` : the name or file that the study states."""

    source: str
    text: str


@dataclass(frozen=True)
class InstrumentLevel:
    """An instrument, as the command line and `build_instrument` describe it.

    Parameters
    ----------
    kinds : kinds of measurement. components : coordinates that the kind `component` measures.
    orientation : form of measured angles. sigma_position, sigma_angle : standard deviation of each
        length and each angle, by default 10 um and 50 urad.
    unknown_frames : which of "base" and "tool" the fit estimates. distribution : of the noise; a
        sigma is its standard deviation in both, so uniform noise lies within sqrt(3) of it.
    unused : measured columns that the fit does not get, such as psi. The noise of the others is the
        same as without it, so that two such instruments are compared on the same measurements.
    """

    kinds: tuple[str, ...] = ("pose",)
    components: tuple[str, ...] = ()
    orientation: str | None = None
    sigma_position: Length = 1e-5
    sigma_angle: Angle = 5e-5
    unknown_frames: tuple[str, ...] = ()
    distribution: Distribution = "normal"
    unused: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _require(self.sigma_position > 0.0, "sigma_position", self.sigma_position, "above 0 m")
        _require(self.sigma_angle > 0.0, "sigma_angle", self.sigma_angle, "above 0 rad")


@dataclass(frozen=True)
class NoiseLevel:
    """A factor on all sigmas of the instrument, which the fit knows."""

    PLAIN: ClassVar[str] = "factor"
    factor: float = 1.0

    def __post_init__(self) -> None:
        _require(self.factor > 0.0, "factor", self.factor, "above 0")


@dataclass(frozen=True)
class PosesLevel:
    """The measured poses.

    Parameters
    ----------
    count : number of poses. choice : "random" draws them evenly from the workspace, "planned" plans
        them for the robot and the instrument, "plane-line" puts them on planes and perpendicular
        lines for an instrument of the kinds plane and line. seed : of the draw or the plan; by
        default that of the study. Every trial of a cell measures the same poses.
    groups : planes with a line each, for "plane-line"; count is the number of all their points.
    axis : along which their lines run. sweeps : of the coordinate exchange that improves the
        points; 0 leaves them as drawn.
    file : CSV file of poses beside the study file, in place of these settings.
    coordinates : (n, c) controlled coordinates [m, rad] of that file.
    """

    PLAIN: ClassVar[str] = "count"
    count: int = 40
    choice: Literal["random", "planned", "plane-line"] = "random"
    groups: int = 10
    axis: Literal["x", "y", "z"] = "z"
    sweeps: int = 3
    seed: int | None = None
    file: str | None = None
    coordinates: tuple[tuple[float, ...], ...] = ()

    def __post_init__(self) -> None:
        _require(1 <= self.count <= MOST_POSES, "count", self.count, f"from 1 to {MOST_POSES}")
        _require(self.seed is None or self.seed >= 0, "seed", self.seed, "0 or more")
        _require(0 <= self.sweeps <= MOST_SWEEPS, "sweeps", self.sweeps, f"0 to {MOST_SWEEPS}")
        if self.choice == "plane-line":
            whole = self.groups >= 1 and self.count % self.groups == 0
            if not whole or self.count < FEWEST_POINTS * self.groups:
                raise ValueError(
                    f"{self.count} points do not make {self.groups} equal groups of at least "
                    f"{FEWEST_POINTS}; change count or groups"
                )

    @property
    def is_on_surfaces(self) -> bool:
        """Whether the poses are points of planes and perpendicular lines."""
        return self.choice == "plane-line"


@dataclass(frozen=True)
class ErrorsLevel:
    """The errors of the true machines, and the tolerances that the fit states for them.

    Parameters
    ----------
    tolerance_factor : on the tolerances, which the fit knows.
    error_factor : true errors over tolerances, which the fit does not know.
    distribution : of the errors; a tolerance is their standard deviation in both. Uniform errors
        lie within sqrt(3) of it.
    smallest : smallest size of a uniform error as a share of its largest; the tolerance stays its
        standard deviation.
    tolerances : other tolerances by name of a parameter or by pattern, such as `leg*.length`.
    deviations : the same true deviations from nominal in all trials, by name or pattern; other
        parameters are nominal.
    """

    PLAIN: ClassVar[str] = "tolerance_factor"
    tolerance_factor: float = 1.0
    error_factor: float = 1.0
    distribution: Distribution = "normal"
    smallest: float = 0.0
    tolerances: Mapping[str, str] = field(default_factory=dict)
    deviations: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _require(self.tolerance_factor > 0, "tolerance_factor", self.tolerance_factor, "above 0")
        _require(self.error_factor >= 0, "error_factor", self.error_factor, "0 or more")
        _require(0 <= self.smallest < 1, "smallest", self.smallest, "0 or more, and less than 1")
        if self.smallest and self.distribution != "uniform":
            raise ValueError("smallest belongs to uniform errors; add 'distribution: uniform'")
        is_drawn = self.error_factor != 1.0 or self.distribution != "normal"
        if self.deviations and is_drawn:
            raise ValueError(
                "deviations are the same in all trials, so error_factor and distribution have no "
                "effect beside them; remove these"
            )


@dataclass(frozen=True)
class MethodLevel:
    """How the parameters are estimated.

    Parameters
    ----------
    method : "auto" is the default of `identify`, see `loopcal.estimate.methods`. "per-leg"
        identifies a hexapod leg by leg from full poses, as a published study does.
    lam : weight of the penalty of ridge. keep : directions of truncated-svd. Both are chosen by
        cross-validation where they are not stated.
    loss, noise : as in `FitOptions`.
    rows : "raw" gives all rows and parameters the weight one in millimeters and radians, takes full
        steps and filters the step, as published studies do; least-squares then has no rank
        detection, and ridge and truncated-svd need `lam` and `keep`. "products" takes products of
        points on planes and lines with their covariance, and "products-printed" with the weight
        one, as another study does. For comparisons.
    epsilon : largest component of a step [mm, rad] at which raw and per-leg fits end; 1e-6 by
        default. steps : of these fits, at most; without epsilon, exactly.
    """

    PLAIN: ClassVar[str] = "method"
    method: Annotated[str, METHODS, PER_LEG] = "auto"
    lam: float | None = None
    keep: int | None = None
    loss: Annotated[str, NO_LOSS, LOSSES] = NO_LOSS
    noise: Noise = "given"
    rows: Literal["weighted", "raw", "products", "products-printed"] = "weighted"
    epsilon: float | None = None
    steps: int | None = None

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
        for key, registry, other in (("method", METHODS, PER_LEG), ("loss", LOSSES, NO_LOSS)):
            value = getattr(self, key)
            if value in registry:
                object.__setattr__(self, key, registry.resolve(value))
            elif value != other:
                allowed = (*registry, other)
                hint = suggest_names(value, allowed)
                raise ValueError(f"{key} is {value!r}{hint}; it must be {' or '.join(allowed)}")
        self._check_published()
        stated = {"lam": self.lam, "keep": self.keep}
        for key, value in stated.items():
            method = SETTINGS[key][0]
            if value is not None and self.method != method:
                raise ValueError(
                    f"{key} belongs to the method {method}, not to {self.method}; remove it, or "
                    "change the method"
                )
            _require(value is None or value >= 0, key, value, "0 or more")

    def _check_published(self) -> None:
        """Refuse settings that methods of published studies do not have, or alone have."""
        if not self.has_steps:
            for key in ("epsilon", "steps"):
                if getattr(self, key) is not None:
                    raise ValueError(
                        f"{key} belongs to 'rows: raw' and to the method per-leg; remove it"
                    )
        if not self.is_published:
            return
        what = "the method per-leg" if self.method == PER_LEG else f"'rows: {self.rows}'"
        if self.loss != NO_LOSS or self.noise != "given":
            raise ValueError(f"{what} has no loss and no estimated noise; remove them")
        if self.method == PER_LEG and self.rows != "weighted":
            raise ValueError("the rows of per-leg are raw ones always; remove 'rows'")
        for needed in ("lam", "keep"):
            if SETTINGS[needed][0] == self.method and getattr(self, needed) is None:
                raise ValueError(f"{self.method} with {what} needs {needed}; add it")
        if self.method == "auto" or (self.method == "map" and self.rows == "raw"):
            raise ValueError(
                f"{self.method} needs weighted rows; remove {what}, or take another method"
            )
        _require(self.epsilon is None or self.epsilon > 0, "epsilon", self.epsilon, "above 0")
        most = f"1 to {MOST_STEPS}"
        _require(self.steps is None or 1 <= self.steps <= MOST_STEPS, "steps", self.steps, most)


@dataclass(frozen=True)
class Outliers:
    """`share` of the rows lie `size` sigmas off, in a random direction.

    It is rounded to whole rows; where that is none, one row is off in as many of the trials.
    """

    share: float = 0.05
    size: float = 20.0

    def __post_init__(self) -> None:
        _require(0.0 <= self.share <= 1.0, "share", self.share, "from 0 to 1")


@dataclass(frozen=True)
class ThermalGrowth:
    """The machine's lengths grow while it is measured.

    Parameters
    ----------
    expansion : of lengths, per kelvin. rise : temperature of the last pose over that of the first
        [K]; it rises linearly, and the mean is that of the nominal machine.
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
class EffectsLevel:
    """What happens although the fit does not know of it. The defaults change nothing.

    Parameters
    ----------
    noise : true over stated sigma. degrees : of Student's t noise; by default the distribution of
        the instrument. correlation : of the noise of a row with that of the row before.
    outliers : rows far off. drift : displacement of the instrument from the first to the last pose.
        jump : its displacement half-way. thermal, backlash : of the machine.
    """

    noise: float = 1.0
    degrees: float | None = None
    correlation: float = 0.0
    outliers: Outliers | None = None
    drift: Length = 0.0
    jump: Length = 0.0
    thermal: ThermalGrowth | None = None
    backlash: Backlash | None = None

    def __post_init__(self) -> None:
        _require(self.noise >= 0.0, "noise", self.noise, "0 or more")
        has_variance = self.degrees is None or self.degrees > 2.0
        _require(has_variance, "degrees", self.degrees, "above 2, so that a sigma exists")
        _require(abs(self.correlation) < 1.0, "correlation", self.correlation, "between -1 and 1")


@dataclass(frozen=True)
class Scores:
    """What is computed of every trial.

    Parameters
    ----------
    held_out : number of poses at which the errors are computed; they are drawn from the workspace
        and are not measured. frame : in which the errors are stated, "fitted" or "base"; "both"
        states the fitted ones, and those in the base frame as further scores.
    intervals : "stated" computes them from the stated noise, for all trials of a block at once.
        "adjusted" computes them as a calibration does, which also uses what the residuals say about
        the noise; trials are then fitted one by one, which takes longer.
    verdict : calibrate every trial as `loopcal calibrate` does, with all its checks and with its
        held-out poses measured, and record the verdict. It takes much longer, and the intervals are
        adjusted ones. limit_position, limit_angle : limits of the verdict.
    """

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
        _require(1 <= self.held_out <= MOST_POSES, "held_out", self.held_out, f"1 to {MOST_POSES}")
        if (self.limit_position or self.limit_angle) and not self.verdict:
            raise ValueError("a limit needs 'verdict: true'; add it, or remove the limit")


@dataclass(frozen=True)
class Question:
    """A question that the summary answers: which is the smallest or the largest level of a factor
    with which a score stays within a limit on a share of the machines.

    Parameters
    ----------
    factor : name of the factor, such as "poses" or "noise". score : name of a score, such as
        "position". limit : of the score, with its unit where it has one. share : of the machines.
    wanted : "smallest" or "largest" level that reaches it.
    """

    factor: str
    score: str
    limit: str | float
    share: float = 0.95
    wanted: Literal["smallest", "largest"] = "smallest"

    def __post_init__(self) -> None:
        _require(0.0 < self.share < 1.0, "share", self.share, "between 0 and 1")


def _require(is_allowed: bool, key: str, value: object, allowed: str) -> None:
    """Raise ValueError with what is allowed; the reader of records adds the line."""
    if not is_allowed:
        shown = f"{value:g}" if isinstance(value, float) else str(value)
        raise ValueError(f"{key} is {shown}; it must be {allowed}")


# --- The order of the levels of a factor: levels that differ in numbers only, from small to large.


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
            if get_origin(part) is Annotated and isinstance(mark := get_args(part)[1], Dimension):
                units[prefix + name] = SI_SYMBOLS[mark]
            elif isinstance(part, type) and is_dataclass(part):
                units |= _list_units(part, f"{prefix}{name}.")
    return units


def _say(setting: str) -> str:
    return setting.replace("_", " ").replace(".", " ")


def _say_value(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
