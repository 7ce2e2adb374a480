# SPDX-License-Identifier: Apache-2.0
"""The folder of a study: the study file as written, its robot files, and the store.

A new folder takes its name when it is complete, so a driver that is killed leaves no half of one.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from loopcal.engine import get_current_engine
from loopcal.errors import FileError, LoopcalError
from loopcal.findings import report_finding
from loopcal.io.core.limits import YAML_SIZE
from loopcal.io.core.outputs import replace_folder, resolve_folder
from loopcal.io.core.replacement import remove_leftovers
from loopcal.io.core.text_file import read_bytes
from loopcal.studies.files.store import (
    NAME,
    StoreHeader,
    StudyStore,
    make_store,
    open_store,
    read_store,
    refuse_network,
)
from loopcal.studies.specification.study import NUMERICS, Study, list_conflicts
from loopcal.typing import Progress, report_no_progress
from loopcal.version import __version__

STUDY_FILE = "study.yaml"
"""Name of the study file in the folder."""

PROGRAM, NUMERICS_PART, ENGINE = "loopcal", "numerics", "engine"
"""What has a version in a store; the engine is that of the process that made the store."""


@dataclass(frozen=True)
class StudySource:
    """A study, and the file that describes it (None where it was made in Python)."""

    study: Study
    file: Path | None = None


@contextmanager
def open_study(folder: Path, source: StudySource, resume: bool = False) -> Iterator[StudyStore]:
    """Open the folder of a study as its driver; it is made where it does not exist.

    A folder that was made is removed where the body raises a LoopcalError before it stored a block,
    as where no worker can be reached.

    Parameters
    ----------
    resume : a folder of the same study is continued. The study may have more replicates or further
        levels than there.

    Raises FileError: the folder contains something else, or another study, or (without `resume`)
    any; or see `open_store`.
    """
    is_new, was_folder, is_used = not (folder / NAME).is_file(), folder.is_dir(), True
    if is_new:
        _make_folder(folder, source)
    elif not resume:
        raise FileError(report_finding("store.in-use"), folder)
    try:
        with open_store(folder) as store:
            header, study = store.header, source.study
            if changes := list_conflicts(load_specification(store).to_json(), study.to_json()):
                finding = report_finding("store.specification-changed", changes=changes)
                raise FileError(finding, folder)
            if header.specification != study.to_json():
                store.set_header(replace(header, specification=study.to_json()))
            try:
                yield store
            except LoopcalError:
                is_used = not is_new or any(store.ask("SELECT 1 FROM blocks LIMIT 1"))
                raise
    finally:
        if not is_used:
            shutil.rmtree(folder, ignore_errors=True)
            if was_folder:
                folder.mkdir(exist_ok=True)


@contextmanager
def extend_study(folder: Path, replicates: int | None = None) -> Iterator[StudyStore]:
    """Open the folder of a study as its driver, with more replicates where these are given.

    Raises FileError: fewer replicates than before; or see `open_store`.
    """
    study = read_study(folder)
    if replicates is not None:
        study = replace(study, replicates=replicates)
    with open_study(folder, StudySource(study), resume=True) as store:
        yield store


def read_study(folder: Path) -> Study:
    """Return the study of a folder."""
    with read_store(folder) as store:
        return load_specification(store)


def load_specification(store: StudyStore) -> Study:
    """Return the study of a store; settings that are new in this version have their defaults.

    Raises FileError: another version made it, whose blocks or settings differ.
    """
    header, part, known = store.header, NUMERICS_PART, str(NUMERICS)
    try:
        if header.versions.get(NUMERICS_PART, "") == str(NUMERICS):
            return Study.from_json(header.specification)
    except ValueError:  # it has settings that this version does not know
        part, known = PROGRAM, __version__
    found = header.versions.get(part, "")
    finding = report_finding("store.other-numbers", part=part, found=found, known=known)
    raise FileError(finding, store.path)


def _make_folder(folder: Path, source: StudySource) -> None:
    """Make the folder of a study, with an empty store."""
    refuse_network(folder)
    names = {STUDY_FILE, *(f"{NAME}{end}" for end in ("", "-journal", "-wal", "-shm"))}
    names |= {Path(name).parts[0] for name, _ in _list_files(source)}

    def is_ours(left: Path) -> bool:
        return left.is_dir() and all(path.name in names for path in left.iterdir())

    remove_leftovers(resolve_folder(folder), is_ours)
    _refuse_content(folder)
    files = {name: read_bytes(path, "file", YAML_SIZE) for name, path in _list_files(source)}
    with replace_folder(folder, check=_refuse_content) as temporary:
        for name, content in files.items():
            file = temporary / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        study = source.study
        engine = str(get_current_engine())
        versions = {PROGRAM: __version__, NUMERICS_PART: str(NUMERICS), ENGINE: engine}
        columns = tuple(column.name for column in study.columns)
        make_store(temporary, StoreHeader(study.to_json(), columns, versions))


def _refuse_content(folder: Path) -> None:
    """Raise FileError where a folder contains something, or where its name is that of a file."""
    target = resolve_folder(folder)
    if target.exists() and not target.is_dir():
        sentence = "this is a file, but a study is a folder; choose another name"
        raise FileError(sentence, folder)
    if target.is_dir() and any(target.iterdir()):
        code = "store.in-use" if (target / NAME).is_file() else "store.folder-of-others"
        raise FileError(report_finding(code), folder)


def _list_files(source: StudySource) -> Iterator[tuple[str, Path]]:
    """Yield the name in the folder, and the path, of the study file and of the robots and the poses
    in files beside it.
    """
    if source.file is None:
        return
    yield STUDY_FILE, source.file
    robots = (robot.source for robot in source.study.robots.values())
    poses = (level.file for level in source.study.poses.values() if level.file is not None)
    for name in dict.fromkeys((*robots, *poses)):
        path = source.file.parent / name
        is_inside = not Path(name).is_absolute() and ".." not in Path(name).parts
        if is_inside and path.is_file() and name not in (STUDY_FILE, NAME):
            yield name, path


def merge_studies(
    part_folders: Sequence[Path], folder: Path, progress: Progress = report_no_progress
) -> int:
    """Copy the blocks of several folders of one study, which jobs computed, into one folder that is
    made or continued, and return how many are new.

    Raises FileError: a part is of another study or damaged, or a folder cannot be used.
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
