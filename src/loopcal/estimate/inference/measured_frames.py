# SPDX-License-Identifier: Apache-2.0
"""Which frames the measurements of a fit determine, and where the instruments stand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from loopcal.typing import FloatArray

PREFIX = "frames_"
"""Beginning of the names of the arrays of a run folder."""

COMMON = 1.0 - 1e-9
"""Cosine of the angle above which motions of two sets are the same motion."""


class InstrumentFrame(NamedTuple):
    """The frame of an instrument after a fit.

    Its error is a twist (rotation about base axes [rad], displacement of its origin [m]):
    `by_parameters` times the error of the parameters, plus `own` times independent errors of unit
    variance, which the noise causes at a known machine.

    Attributes
    ----------
    T : (4, 4) T_base_frame [m]. by_parameters : (6, p) [per SI]. own : (6, 6); both are zero for a
        frame that is stated.
    """

    T: FloatArray
    by_parameters: FloatArray
    own: FloatArray


@dataclass(frozen=True, eq=False)
class MeasuredFrames:
    """How the measurements of a fit determine the frames of the base and the platform.

    Attributes
    ----------
    unfixed : (12, k) orthonormal motions of both frames that change no measured value, see
        `loopcal.estimate.frame_freedoms`; k = 0 where the measurements determine both frames.
    readings : (m, a) of measured poses, at most some hundred [m, rad].
    instruments : name, such as "tracker" or "monday.tracker" -> its frame.
    """

    unfixed: FloatArray
    readings: FloatArray
    instruments: Mapping[str, InstrumentFrame] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return the number of motions and the names of the frames."""
        names = ", ".join(self.instruments) or "none"
        return f"<MeasuredFrames: {self.unfixed.shape[1]} unfixed motions; instruments: {names}>"

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of the run folder, which `frames_from_arrays` reads."""
        p = next((f.by_parameters.shape[1] for f in self.instruments.values()), 0)
        of_frames = {"T": (4, 4), "by_parameters": (6, p), "own": (6, 6)}
        count = len(self.instruments)
        stacked = {
            name: np.reshape([getattr(f, name) for f in self.instruments.values()], (count, *size))
            for name, size in of_frames.items()
        }
        content = {"unfixed": self.unfixed, "readings": self.readings, **stacked}
        content["names"] = np.array(tuple(self.instruments), dtype=np.str_)
        return {PREFIX + name: array for name, array in content.items()}


def frames_from_arrays(arrays: Mapping[str, np.ndarray]) -> MeasuredFrames | None:
    """Return the frames in the arrays of a run folder; None where it does not hold them."""
    names = ("unfixed", "readings", "names", "T", "by_parameters", "own")
    if any(PREFIX + name not in arrays for name in names):
        return None
    unfixed, readings, labels, *stacked = (arrays[PREFIX + name] for name in names)
    frames = {
        str(name): InstrumentFrame(*fields)
        for name, *fields in zip(labels.tolist(), *stacked, strict=True)
    }
    return MeasuredFrames(unfixed, readings, frames)


def intersect_motions(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return an orthonormal basis (12, k) of the motions that two bases (12, ..) have in common."""
    u, cosine, _ = np.linalg.svd(first.T @ second, full_matrices=False)
    return first @ u[:, cosine > COMMON]
