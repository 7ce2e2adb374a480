# SPDX-License-Identifier: Apache-2.0
"""A study of some seconds, and its stored blocks."""

from __future__ import annotations

from pathlib import Path

TEXT = """\
format: 1
title: A small study
seed: 3
replicates: {replicates}
block: {block}
robots: [five-bar]
instruments:
  tracker: {{kinds: [position], sigma_position: 20 um}}
poses: [8, 12]
methods: [map, least-squares]
scores: {{held_out: 3}}
"""
CELLS = 4


def write_study(folder: Path, replicates: int = 20, block: int = 5, text: str = TEXT) -> Path:
    """Write the study file, and return it."""
    file = folder / "small.yaml"
    file.write_text(text.format(replicates=replicates, block=block))
    return file
