# SPDX-License-Identifier: Apache-2.0
"""Findings about files: outputs, data that were fitted before, and files of other programs."""

from __future__ import annotations

from loopcal.findings.finding import Severity
from loopcal.findings.wording import Entry

ENTRIES: tuple[Entry, ...] = (
    Entry(
        "files.output-exists",
        Severity.REFUSAL,
        "this file exists; choose another name or allow replacing it",
        "An output file exists and replacing it was not allowed.",
        "Choose another name or allow replacing the file.",
    ),
    Entry(
        "files.folder-in-use",
        Severity.REFUSAL,
        "this folder is not empty; choose another name or allow replacing the {content} in it",
        "The folder of a run or plan is not empty and replacing it was not allowed.",
        "Choose another folder or allow replacing the old result.",
    ),
    Entry(
        "files.folder-of-others",
        Severity.REFUSAL,
        "this folder contains something other than a {content}, which is never replaced; choose "
        "another name",
        "The folder of a run or plan contains other files.",
        "Choose another folder.",
    ),
    Entry(
        "files.noise-missing",
        Severity.REFUSAL,
        "no noise is stated for {column!r}; add '{example}' to the settings, or a column {sigma!r} "
        "(if it is unknown, state a guess and have the noise estimated)",
        "A measurement file states no standard deviation of a measured value.",
        "State the standard deviation in the settings or in a column.",
    ),
    Entry(
        "files.groups-in-plan",
        Severity.REFUSAL,
        "rows of the kind {kind!r} have setup parameters for each group ({parameters:list}), and no "
        "pose is measured by all groups; describe the instrument in another way",
        "A plan takes its instrument from a file whose groups have parameters of their own.",
        "Describe the instrument by its kind, noise and frames.",
    ),
    Entry(
        "files.surfaces-in-plan",
        Severity.REFUSAL,
        "rows of the kind {kind!r} have setup parameters for each group ({parameters:list}), and no "
        "pose is measured by all groups; plan planes and lines as surfaces",
        "A plan of poses takes its instrument from a file of planes or lines.",
        "Plan surfaces in place of poses.",
    ),
    Entry(
        "files.prior-data-reused",
        Severity.REFUSAL,
        "{file}: the earlier run was fitted to these measurements, which would count twice; use "
        "new measurements",
        "Data for a recalibration are the data of the run that serves as the prior.",
        "Measure again, or calibrate without the prior.",
    ),
    Entry(
        "files.other-times",
        Severity.INFO,
        "{count:count line} of further targets state another time than the first line of their "
        "pose; the time of the first line is kept",
        "An instrument's export has a line for each target, with different times.",
    ),
)
