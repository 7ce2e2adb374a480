# SPDX-License-Identifier: Apache-2.0
"""A study of some seconds, and its stored blocks."""

from __future__ import annotations

from pathlib import Path

from loopcal.studies.store import NAME, read_store
from loopcal.studies.study import Study
from loopcal.studies.study_folder import load_specification

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

Contents = dict[tuple[str, int], bytes]
"""Levels and number of a block -> its scores."""


def write_study(folder: Path, replicates: int = 20, block: int = 5, text: str = TEXT) -> Path:
    """Write the study file, and return it."""
    file = folder / "small.yaml"
    file.write_text(text.format(replicates=replicates, block=block))
    return file


def read_contents(folder: Path) -> Contents:
    """Return every stored block, by its cell and number."""
    assert (folder / NAME).is_file()
    with read_store(folder) as store:
        study: Study = load_specification(store)
        return {
            (str(cell), number): scores.tobytes()
            for cell in study.cells
            for number, scores in store.read_blocks(cell.levels)
        }
