# SPDX-License-Identifier: Apache-2.0
"""The records of a study file: the levels of its factors, its scores and its quick tier.

A factor is what a study varies. Each of its levels is one of these records, with a name. Numbers
are in SI; the reader of study files converts them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from loopcal.units import Angle, Length

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

Distribution = Literal["normal", "uniform"]
MethodName = Literal["auto", "map", "least-squares", "ridge", "truncated-svd"]


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
    orientation : form of measured angles. sigma_position, sigma_angle : standard deviations of each
        length and angle. unknown_frames : of "base" and "tool". distribution : of the noise.
    """

    kinds: tuple[str, ...] = ("pose",)
    components: tuple[str, ...] = ()
    orientation: str | None = None
    sigma_position: Length = 1e-5
    sigma_angle: Angle = 5e-5
    unknown_frames: tuple[str, ...] = ()
    distribution: Distribution = "normal"


@dataclass(frozen=True)
class NoiseLevel:
    """A factor on all sigmas of the instrument, which the fit knows."""

    PLAIN: ClassVar[str] = "factor"
    factor: float = 1.0


@dataclass(frozen=True)
class PosesLevel:
    """The measured poses.

    Parameters
    ----------
    count : number of poses. choice : "random" draws them evenly from the workspace, "planned" plans
        them for the robot and the instrument. seed : of the draw or the plan; by default that of
        the study. Every trial of a cell measures the same poses.
    """

    PLAIN: ClassVar[str] = "count"
    count: int = 40
    choice: Literal["random", "planned"] = "random"
    seed: int | None = None


@dataclass(frozen=True)
class ErrorsLevel:
    """The errors of the true machines, and the tolerances that the fit states for them.

    Parameters
    ----------
    tolerance_factor : on the tolerances, which the fit knows.
    error_factor : true errors over tolerances, which the fit does not know.
    distribution : of the errors; a tolerance is their standard deviation in both. Uniform errors
        lie within sqrt(3) of it.
    tolerances : other tolerances by name of a parameter or by pattern, such as `leg*.length`.
    deviations : the same true deviations from nominal in all trials, by name or pattern; other
        parameters are nominal.
    """

    PLAIN: ClassVar[str] = "tolerance_factor"
    tolerance_factor: float = 1.0
    error_factor: float = 1.0
    distribution: Distribution = "normal"
    tolerances: Mapping[str, str] = field(default_factory=dict)
    deviations: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class MethodLevel:
    """How the parameters are estimated.

    Parameters
    ----------
    method : "auto" is the default of `identify`, see `loopcal.estimate.methods.penalties`.
    lam : weight of the penalty of ridge. keep : directions of truncated-svd. Both are chosen by
        cross-validation where they are not stated.
    loss, noise : as in `FitOptions`.
    """

    PLAIN: ClassVar[str] = "method"
    method: MethodName = "auto"
    lam: float | None = None
    keep: int | None = None
    loss: Literal["none", "huber", "tukey"] = "none"
    noise: Literal["given", "estimated"] = "given"


@dataclass(frozen=True)
class Outliers:
    """`share` of the rows lie `size` sigmas off, in a random direction."""

    share: float = 0.05
    size: float = 20.0


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


@dataclass(frozen=True)
class Scores:
    """What is computed of every trial.

    Parameters
    ----------
    held_out : number of poses at which the errors are computed; they are drawn from the workspace
        and are not measured. frame : in which the errors are stated, "fitted" or "base".
    verdict : calibrate every trial as `loopcal calibrate` does, with all its checks, and record its
        verdict; this takes much longer. limit_position, limit_angle : limits of the verdict.
    """

    held_out: int = 20
    frame: Literal["fitted", "base"] = "fitted"
    verdict: bool = False
    limit_position: Length | None = None
    limit_angle: Angle | None = None


@dataclass(frozen=True)
class Question:
    """A question that the summary answers: the smallest or largest level of a factor that reaches
    a limit of a score on a share of the machines.
    """

    factor: str
    score: str
    limit: str
    share: float = 0.95
    wanted: Literal["smallest", "largest"] = "smallest"
