# SPDX-License-Identifier: Apache-2.0
"""The study files of the papers: read for `reproduce`, and written for users."""

from __future__ import annotations

from pathlib import Path

from loopcal.studies import Study, load_study

FILE = "study.yaml"
"""Name of the study file in the folder of a paper."""


def load_paper_study(module: str) -> Study:
    """Return the study of the paper in whose folder the file `module` is."""
    return load_study(Path(module).with_name(FILE))
