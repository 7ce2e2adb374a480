# SPDX-License-Identifier: Apache-2.0
"""What a fit found of poses and readings that are not known exactly: where the machine stood, and
what its readings were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.estimate.latent import LatentRows
from loopcal.measure import Measurements
from loopcal.typing import BoolArray, FloatArray

SHOWN = 5
"""Poses named in a note; the others are counted."""


@dataclass(frozen=True, eq=False)
class LatentEstimate:
    """Poses as they stood, by all that was measured there and the identified machine.

    Attributes
    ----------
    labels : (n,). poses : (n, 4, 4) T_base_platform [m], NaN where out of reach or left out.
    readings : (n, a) [SI], the true ones, NaN where left out.
    sigma : (n, a) [SI] with which the recorded ones were believed: 0 exact, infinite not at all.
    kept : (n,) poses that were not left out as asked.
    open : (n,) those of them that the data leave open in some direction; what stands there is where
        the search began.
    calm : whether the search came to rest.
    """

    labels: tuple[str, ...]
    poses: FloatArray
    readings: FloatArray
    sigma: FloatArray
    kept: BoolArray
    open: BoolArray
    calm: bool

    def notes(self) -> list[str]:
        """Sentences on what is not known."""
        found = []
        if self.open.any():
            found.append(
                f"not determined by what was measured there: {_some(self.labels, self.open)}"
            )
        if not self.calm:
            found.append(
                "the search for poses and true readings did not come to rest; look for wrong rows "
                "or readings"
            )
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return numbers of readings by how they were believed, but of poses left out, for JSON;
        the arrays are in `arrays`.
        """
        sigma = self.sigma[self.kept]
        return {
            "exact": int((sigma == 0.0).sum()),
            "uncertain": int(((sigma > 0.0) & np.isfinite(sigma)).sum()),
            "not_taken": int(np.isinf(sigma).sum()),
            "open": [label for label, lost in zip(self.labels, self.open, strict=True) if lost],
            "calm": self.calm,
        }

    def arrays(self) -> dict[str, FloatArray]:
        """Return the arrays by name [SI], for the run folder."""
        return {"pose_estimate": self.poses, "reading_estimate": self.readings}


def latent_estimate(
    rows: LatentRows, data: Measurements, drop: Sequence[str] = ()
) -> LatentEstimate:
    """Return what rows (t = 1) say of the poses of their measurements, where they were looked at
    last.

    `drop` : labels of poses that were left out as asked: nothing is said of them.
    """
    memory, (ok, here) = rows.memory, rows.standing()
    kept = ~np.isin(data.labels, drop)
    known = ok[0] & kept
    T = np.where(known[:, None, None], here.state.T[0], np.nan)
    readings = np.where(kept[:, None], here.q[0], np.nan)
    sigma = np.zeros(data.readings.shape) if data.reading_sigma is None else data.reading_sigma
    return LatentEstimate(
        data.labels, T, readings, sigma, kept, memory.open[0] & known, bool(memory.calm[0])
    )


def _some(labels: Sequence[str], chosen: BoolArray) -> str:
    """Poses by name, the first few."""
    names = [label for label, here in zip(labels, chosen, strict=True) if here]
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return f"{'pose' if len(names) == 1 else 'poses'} {', '.join(names[:SHOWN])}{more}"
