# SPDX-License-Identifier: Apache-2.0
"""A run folder holds one result for good: numbers, arrays, the corrected robot file and where they
come from.

    result.json    what was found, and under `made_by` how (see MADE_BY); no NaN: null, with the reason under `nulls`
    arrays.npz     the arrays of the result, by name, SI (no pickles)
    robot.yaml     the corrected robot file: the nominal file plus its `identified:` table

The folder is written under a temporary name and renamed, so it is either whole or absent.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import FileError
from loopcal.io.core.json_text import to_json
from loopcal.io.core.text_file import read_text, sha256, report_write_errors

if TYPE_CHECKING:
    import numpy as np

FORMAT = 1
RESULT, ARRAYS, ROBOT = "result.json", "arrays.npz", "robot.yaml"

# The keys of `made_by` and what they mean; the file reference is made from this.
MADE_BY: Mapping[str, str] = {
    "command": "the command line, as a list of words",
    "versions": "versions of loopcal, python, numpy and scipy",
    "seeds": "every seed that was used, by name",
    "inputs": "each input file: its name as given, and its sha256",
}


@dataclass(frozen=True)
class RunFolder:
    """What a run folder holds.

    Parameters
    ----------
    path : Path
        The folder.
    result : dict
        Content of result.json.
    arrays : dict of ndarray
        Content of arrays.npz, SI.
    """

    path: Path
    result: dict[str, Any]
    arrays: dict[str, np.ndarray]

    @property
    def robot_path(self) -> Path:
        """The corrected robot file."""
        return self.path / ROBOT


def collect_provenance(command: Sequence[str], inputs: Mapping[str, Path], seeds: Mapping[str, int]) -> dict[str, Any]:
    """Return where a result comes from, with the keys of MADE_BY.

    Parameters
    ----------
    command : sequence of str
        The command line.
    inputs : mapping
        Role ("robot", "data") -> file.
    seeds : mapping
        Name -> seed.

    Raises
    ------
    FileError
        An input cannot be read.
    """
    import platform
    from importlib.metadata import version

    versions = {name: version(name) for name in ("loopcal", "numpy", "scipy")} | {"python": platform.python_version()}
    files = {role: {"path": str(path), "sha256": sha256(path)} for role, path in inputs.items()}
    return {"command": list(command), "versions": versions, "seeds": dict(seeds), "inputs": files}


def find_fitted_file(result: Mapping[str, Any], inputs: Mapping[str, Path]) -> Path | None:
    """Return the first file of measured values, by its role in `inputs`, that a run was made from;
    None where none is.

    Raises
    ------
    FileError
        A file cannot be read.
    """
    made = result.get("made_by", {}).get("inputs", {})
    used = {file.get("sha256") for role, file in made.items() if role.partition("-")[0] == "data"}
    given = (path for role, path in inputs.items() if role.partition("-")[0] == "data")
    return next((path for path in given if sha256(path) in used), None)


def refuse_used_folder(path: str | Path, force: bool) -> None:
    """Raise where a run folder would replace something; called before the work as well as after it.

    Raises
    ------
    FileError
        The path is a file, or a folder that holds something and `force` is not given, or something
        other than a run.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise FileError("this is a file where a run folder is to be written; choose another name", path)
    if not path.is_dir() or not any(path.iterdir()):
        return
    if not force:
        raise FileError("this folder is not empty; choose another name, or replace the run in it "
                        "with --force", path)
    if not (path / RESULT).exists():
        raise FileError(
            "this folder holds something other than a run, which --force does not replace; choose "
            "another name", path
        )


def refuse_run_folder(folder: Path, inputs: Sequence[Path], force: bool) -> None:
    """Refuse a run folder that would replace something it may not, or a file that is read.

    Raises
    ------
    FileError
        See `refuse_used_folder`; or an input is in the folder.
    """
    refuse_used_folder(folder, force)
    for path in inputs:
        if path.exists() and path.resolve().is_relative_to(folder.resolve()):
            raise FileError(
                f"this folder would be replaced, but {path} in it is read; choose another name",
                folder,
            )


def write_run_folder(
    path: str | Path, result: Mapping[str, Any], arrays: Mapping[str, np.ndarray], robot_text: str, force: bool = False
) -> Path:
    """Write a run folder whole or not at all.

    Parameters
    ----------
    path : str or Path
        The folder to make.
    result : mapping
        Content of result.json; `format` is added.
    arrays : mapping
        Name -> array, SI.
    robot_text : str
        Text of the corrected robot file.
    force : bool
        Replace a run that is there.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    FileError
        The folder is in use, or cannot be written.
    """
    import numpy as np

    path = Path(path)
    refuse_used_folder(path, force)
    text = to_json({"format": FORMAT, **result})
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with report_write_errors(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.mkdir()
            (temporary / RESULT).write_text(text, encoding="utf-8")
            (temporary / ROBOT).write_text(robot_text, encoding="utf-8")
            with (temporary / ARRAYS).open("wb") as stream:
                np.savez(stream, allow_pickle=False, **arrays)
            if path.is_dir():
                _replace(path, temporary)
            else:
                temporary.rename(path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return path


def read_run_folder(path: str | Path) -> RunFolder:
    """Read a run folder.

    Raises
    ------
    FileError
        Not a run folder, made by a newer loopcal, or damaged.
    """
    import numpy as np

    path = Path(path)
    if not (path / RESULT).is_file():
        raise FileError(f"this is not a run folder (it has no {RESULT}); name one made by 'loopcal "
                        "calibrate -o'", path)
    try:
        result = json.loads(read_text(path / RESULT, "run result"))
        with np.load(path / ARRAYS, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError) as error:
        raise FileError(f"this run folder is damaged ({error}); make the run again", path) from error
    if not isinstance(result, dict) or result.get("format", 0) > FORMAT:
        raise FileError(f"this run has a format newer than {FORMAT}; use a newer loopcal, or make "
                        "the run again", path)
    return RunFolder(path, result, arrays)


def _replace(path: Path, temporary: Path) -> None:
    """Put `temporary` in the place of the folder `path`; the old one goes only when the new one is
    there.
    """
    old = path.with_name(f".{path.name}.{os.getpid()}.old")
    path.rename(old)
    try:
        temporary.rename(path)
    except OSError:
        with suppress(OSError):
            old.rename(path)
        raise
    shutil.rmtree(old, ignore_errors=True)
