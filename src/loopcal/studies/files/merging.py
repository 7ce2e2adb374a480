# SPDX-License-Identifier: Apache-2.0
"""Join the folders of jobs that each computed a share of one study."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from loopcal.errors import FileError
from loopcal.findings import report_finding
from loopcal.studies.files.store import read_store
from loopcal.studies.files.study_folder import (
    STUDY_FILE,
    StudySource,
    load_specification,
    open_study,
    read_study,
)
from loopcal.studies.specification.changes import list_conflicts
from loopcal.typing import Progress, report_no_progress


def merge_studies(
    part_folders: Sequence[Path], folder: Path, progress: Progress = report_no_progress
) -> int:
    """Copy the blocks of several folders of one study into one folder, and return how many are new.

    Parameters
    ----------
    part_folders : folders of jobs, complete or not. folder : to make, or one of the same study.

    Raises
    ------
    FileError : a part is of another study or damaged, or a folder cannot be used.
    """
    studies = [read_study(part) for part in part_folders]
    first, largest = max(enumerate(studies), key=lambda item: item[1].replicates)
    for part, study in zip(part_folders, studies, strict=True):
        if changes := list_conflicts(study.to_json(), largest.to_json()):
            code = "store.part-of-other-study"
            raise FileError(
                report_finding(code, other=str(part_folders[first]), changes=changes), part
            )
    for part in part_folders:
        with read_store(part) as other:
            other.check_pages()
    file = part_folders[0] / STUDY_FILE
    source = StudySource(largest, file if file.is_file() else None)
    count = 0
    with open_study(folder, source, resume=True) as store:
        for i, part in enumerate(part_folders):
            progress(i, len(part_folders), "joining folders")
            with read_store(part) as other:
                for cell in load_specification(other).cells:
                    count += store.copy_blocks(other, cell.levels)
    return count
