# SPDX-License-Identifier: Apache-2.0
"""The catalog: the only place where findings are worded, one module for each subject."""

from __future__ import annotations

from importlib import import_module

from loopcal.findings.wording import Entry

SUBJECTS: tuple[str, ...] = (
    "gates",
    "workflow",
    "fit",
    "noise",
    "prior",
    "poses",
    "identifiability",
    "outliers",
    "conventions",
    "residuals",
    "model",
    "mechanism",
    "data",
    "apply",
    "plan",
    "files",
)
"""Modules of this package, in the order of docs/findings.md. Each defines `ENTRIES`."""


def _collect() -> dict[str, Entry]:
    catalog: dict[str, Entry] = {}
    for subject in SUBJECTS:
        for entry in import_module(f"{__name__}.{subject}").ENTRIES:
            assert entry.code not in catalog, f"{entry.code} is worded twice"
            catalog[entry.code] = entry
    return catalog


CATALOG = _collect()
"""From a code to its entry."""
