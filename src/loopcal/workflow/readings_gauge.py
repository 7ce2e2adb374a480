# SPDX-License-Identifier: Apache-2.0
"""What redundant readings alone leave open, in one sentence."""

from __future__ import annotations

from loopcal.diagnose import FrameMotions
from loopcal.findings import Finding, report_finding
from loopcal.measure import Closure, Measurements


def is_readings_alone(data: Measurements) -> bool:
    """Return whether measurements have no measured column."""
    return all(isinstance(rows.kind, Closure) for rows in data.observations)


def report_readings_gauge(motions: FrameMotions, count: int) -> Finding:
    """Return what `count` open combinations are: the place of frames, the size, and others."""
    others = count - motions.count - motions.has_scale
    combinations = (
        {"what": "frames", "frames": motions.frames, "count": motions.count},
        {"what": "scale", "frames": (), "count": int(motions.has_scale)},
        {"what": "others", "frames": (), "count": others},
    )
    kept = tuple(part for part in combinations if part["count"])
    return report_finding("identifiability.readings-gauge", parts=kept)
