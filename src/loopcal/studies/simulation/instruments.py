# SPDX-License-Identifier: Apache-2.0
"""The instrument of a cell."""

from __future__ import annotations

from loopcal.measure import Instrument
from loopcal.studies.specification.levels import InstrumentLevel, NoiseLevel
from loopcal.workflow.instrument_description import InstrumentDescription, build_instrument


def make_instrument(level: InstrumentLevel, noise: NoiseLevel) -> Instrument:
    """Return the instrument of a level, with its sigmas times the factor of the noise.

    Raises
    ------
    DataError : as `build_instrument`.
    """
    return build_instrument(
        InstrumentDescription(
            kinds=level.kinds,
            components=level.components,
            orientation=level.orientation,
            sigma_position=noise.factor * level.sigma_position,
            sigma_angle=noise.factor * level.sigma_angle,
            unknown_frames=level.unknown_frames,
            distribution=level.distribution,
        )
    )
