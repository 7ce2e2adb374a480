# SPDX-License-Identifier: Apache-2.0
"""What combinations of parameters that data leave open do: move frames only, or change poses."""

from __future__ import annotations

from dataclasses import dataclass

from loopcal.diagnose import FrameMotions, find_frame_motions
from loopcal.estimate import Combination, Posterior


@dataclass(frozen=True)
class OpenFreedoms:
    """The combinations that data do not determine.

    Attributes
    ----------
    motions : of frames by these combinations. count : of all. changing : combinations that may
        change poses. names : of the parameters in these.
    """

    motions: FrameMotions
    count: int
    changing: tuple[Combination, ...]
    names: tuple[str, ...]

    @property
    def changing_count(self) -> int:
        """Number of combinations that change poses."""
        return self.count - self.motions.count


def sort_open_freedoms(
    posterior: Posterior, unidentifiable: tuple[Combination, ...], count: int
) -> OpenFreedoms:
    """Separate the combinations that only move frames from those that change poses.

    A combination with a meaning, such as the place of a frame, changes no pose. Where all have one,
    but they are more than the motions of frames, the parameters of all are named.
    """
    changing = tuple(c for c in unidentifiable if not c.meaning)
    names = dict.fromkeys(name for c in changing or unidentifiable for name in c.names)
    return OpenFreedoms(find_frame_motions(posterior), count, changing, tuple(names))
