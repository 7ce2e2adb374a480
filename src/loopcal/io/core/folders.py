# SPDX-License-Identifier: Apache-2.0
"""Result folders: written whole or not at all, and never over other files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from loopcal.errors import FileError
from loopcal.findings import report_finding
from loopcal.io.core.text_file import report_write_errors


def refuse_folder_in_use(path: Path, content: str, marker: str, force: bool) -> None:
    """Raise FileError where a folder would replace something it must not.

    Parameters
    ----------
    path : of the folder to write. content : "run" or "plan", for messages.
    marker : the file by which such a folder is recognized.
    force : an older folder of the same sort may be replaced.
    """
    if path.exists() and not path.is_dir():
        raise FileError(f"this is a file, but the {content} is a folder; choose another name", path)
    if not path.is_dir() or not any(path.iterdir()):
        return
    if not force:
        raise FileError(report_finding("files.folder-in-use", content=content), path)
    if not (path / marker).exists():
        raise FileError(report_finding("files.folder-of-others", content=content), path)


@contextmanager
def replace_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder that takes the place of `path` where the body succeeds.

    An older folder is removed only when the new one is in place.

    Raises
    ------
    FileError : in place of every OSError.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    old = path.with_name(f".{path.name}.{os.getpid()}.old")
    with report_write_errors(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.mkdir()
            yield temporary
            if path.is_dir():
                path.rename(old)
            try:
                temporary.rename(path)
            except OSError:
                with suppress(OSError):
                    old.rename(path)
                raise
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
