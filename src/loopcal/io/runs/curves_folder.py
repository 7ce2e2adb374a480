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

from loopcal.io.core.json_text import read_json
from loopcal.io.core.read_back import require_same
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

    def read_back(folder: Path) -> None:
        written = read_json(folder / RESULT, "result file", "repeat the command")
        require_same("robot", document["robot"], written["robot"])
        for name, content in files.items():
            require_same(name, content, (folder / name).read_bytes())

    write_result_folder(path, CURVES, {"format": FORMAT, **document}, files, read_back, force)
