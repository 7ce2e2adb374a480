# SPDX-License-Identifier: Apache-2.0
"""Build an instrument from a short description: kinds, noise, and which frames are unknown."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from loopcal.errors import DataError, suggest_names
from loopcal.measure import KINDS, Gaussian, Instrument, Noise, Sensor, Uniform
from loopcal.typing import FloatArray
from loopcal.units import Dimension

FRAMES: Mapping[str, tuple[str, ...]] = {"base": ("frame",), "tool": ("tool", "targets")}
"""A frame that may be unknown -> the names that kinds have for it."""

DISTRIBUTIONS: Mapping[str, Callable[[FloatArray], Noise]] = {
    "normal": Gaussian,
    "uniform": lambda sigma: Uniform(np.sqrt(3.0) * sigma),
}
"""Name of a distribution -> noise with given standard deviations (m,) [SI]."""


@dataclass(frozen=True)
class InstrumentDescription:
    """What is known of an instrument before anything is measured.

    Parameters
    ----------
    kinds : names of kinds of measurement. components : coordinates that the kind `component`
        measures. orientation : form of measured angles; None for the default of the kind.
    sigma_position, sigma_angle : standard deviations of each length [m] and angle [rad].
    unknown_frames : of "base" (the frame of the instrument in the base) and "tool".
    distribution : of simulated noise, one of DISTRIBUTIONS; both have the stated standard
        deviations. Uniform noise lies within sqrt(3) of them.
    """

    kinds: Sequence[str] = ("pose",)
    components: Sequence[str] = ()
    orientation: str | None = None
    sigma_position: float = 1e-5
    sigma_angle: float = 5e-5
    unknown_frames: Sequence[str] = ()
    distribution: str = "normal"


def build_instrument(description: InstrumentDescription) -> Instrument:
    """Return the instrument of a description.

    Raises
    ------
    DataError : an unknown kind, frame or component, or a setting that belongs to none of the kinds.
    """
    possible = {"components": tuple(description.components), "orientation": description.orientation}
    settings = {name: value for name, value in possible.items() if value}
    sigma = {Dimension.LENGTH: description.sigma_position, Dimension.ANGLE: description.sigma_angle}
    sensors = []
    for i, name in enumerate(description.kinds):
        _check_kind(name, description.kinds[:i])
        fields = _setting_names(name)
        kind: Any = KINDS[name](**{k: v for k, v in settings.items() if k in fields})
        noise = np.array([sigma[column.dimension] for column in kind.noise_columns])
        if description.unknown_frames:
            kind = replace(kind, unknown=_name_unknown_frames(description.unknown_frames, kind))
        sensors.append(Sensor(kind, DISTRIBUTIONS[description.distribution](noise)))
    for setting in settings:
        if not any(setting in _setting_names(name) for name in description.kinds):
            kinds = ",".join(description.kinds)
            raise DataError(
                f"the setting {setting!r} does not belong to the kind {kinds!r}; remove it, or "
                "choose another kind"
            )
    return Instrument(tuple(sensors))


def _check_kind(name: str, earlier: Sequence[str]) -> None:
    """Raise DataError for an unknown kind, or one that is named twice."""
    if name not in KINDS:
        raise DataError(
            f"{name!r} is not a kind of measurement{suggest_names(name, KINDS)}; known kinds are "
            f"{', '.join(KINDS)}"
        )
    if name in earlier:
        raise DataError(
            f"the kind {name!r} is named twice; name it once, and add the second one to the "
            "measurement file by hand"
        )


def _setting_names(kind: str) -> set[str]:
    """Return the settings of a kind: the fields of its dataclass."""
    return {f.name for f in dataclasses.fields(cast(Any, KINDS[kind])) if f.init}


def _name_unknown_frames(frames: Sequence[str], kind: object) -> tuple[str, ...]:
    """Return the names that a kind has for unknown frames."""
    possible: tuple[str, ...] = getattr(kind, "allowed_unknown", ())
    names = []
    for frame in frames:
        if frame not in FRAMES:
            raise DataError(
                f"{frame!r} is not a frame that can be unknown; allowed are base, tool, or both"
            )
        names_of_frame = [name for name in FRAMES[frame] if name in possible]
        if not names_of_frame:
            raise DataError(
                f"this kind of measurement has no {frame} frame that could be unknown; remove it"
            )
        names.append(names_of_frame[0])
    return tuple(names)
