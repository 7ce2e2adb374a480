# SPDX-License-Identifier: Apache-2.0
"""The folder of regularization curves.

curves.json   scores, standard errors and chosen values
curves.csv    the points of both curves
curves.png    the picture
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from loopcal.io.core.result_folder import FolderKind, refuse_folder, write_result_folder

FORMAT = 1
RESULT, POINTS, PICTURE = "curves.json", "curves.csv", "curves.png"
CURVES = FolderKind(
    "folder of curves", RESULT, ("robot", "ridge", "truncation", "made_by"), (POINTS, PICTURE)
)


def refuse_curves(path: Path, force: bool, inputs: Sequence[Path] = ()) -> None:
    """Raise FileError where the folder must not be written; see `refuse_folder`."""
    refuse_folder(path, CURVES, force, inputs)


def write_curves(
    path: Path, document: Mapping[str, Any], points: str, picture: bytes, force: bool = False
) -> None:
    """Write the folder whole or not at all.

    Parameters
    ----------
    document : content of curves.json; `format` and `files` are added. points : the text of
        curves.csv. picture : the content of curves.png. force : replace an older, unchanged folder.

    Raises
    ------
    FileError : see `write_result_folder`.
    """
    files = {POINTS: points.encode(), PICTURE: picture}

    write_result_folder(path, CURVES, {"format": FORMAT, **document}, files, force)
