# SPDX-License-Identifier: Apache-2.0
"""Run folders: one result with its numbers, arrays, corrected robot file and provenance.

result.json    the result, and under `made_by` its provenance (see MADE_BY); a number that is
not finite is null, with the reason under `nulls`
arrays.npz     the arrays of the result, by name, SI (no pickles)
robot.yaml     the corrected robot file: the nominal file plus its `identified:` table
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loopcal.errors import FileError
from loopcal.io.core.folders import refuse_folder_in_use, replace_folder
from loopcal.io.core.json_text import to_json
from loopcal.io.core.text_file import as_path, read_text, sha256

FORMAT = 1
RESULT, ARRAYS, ROBOT = "result.json", "arrays.npz", "robot.yaml"

MADE_BY: Mapping[str, str] = {
    "command": "the command line, as a list of words",
    "versions": "versions of loopcal, python, numpy and scipy",
    "seeds": "all seeds in use, by name",
    "inputs": "each input file: its name as given, and its sha256",
}
"""Keys of `made_by` and their meanings, for the file reference."""


@dataclass(frozen=True)
class RunFolder:
    """The content of a run folder.

    Parameters
    ----------
    path : of the folder. result : content of result.json. arrays : content of arrays.npz, SI.
    """

    path: Path
    result: dict[str, Any]
    arrays: dict[str, np.ndarray]

    @property
    def robot_path(self) -> Path:
        """The corrected robot file."""
        return self.path / ROBOT


def collect_provenance(
    command: Sequence[str], inputs: Mapping[str, Path], seeds: Mapping[str, int]
) -> dict[str, Any]:
    """Return the provenance of a result, with the keys of MADE_BY.

    Parameters
    ----------
    command : the command line. inputs : role ("robot", "data") -> file. seeds : name -> seed.

    Raises
    ------
    FileError : an input cannot be read.
    """
    import platform
    from importlib.metadata import version

    versions = {name: version(name) for name in ("loopcal", "numpy", "scipy")}
    versions["python"] = platform.python_version()
    files = {role: {"path": str(path), "sha256": sha256(path)} for role, path in inputs.items()}
    return {"command": list(command), "versions": versions, "seeds": dict(seeds), "inputs": files}


def list_inputs(result: Mapping[str, Any]) -> dict[str, Mapping[str, str]]:
    """Return role -> `path` and `sha256` of the input files of a result."""
    return dict(result.get("made_by", {}).get("inputs", {}))


def find_fitted_file(result: Mapping[str, Any], inputs: Mapping[str, Path]) -> Path | None:
    """Return the first data file (by its role in `inputs`) that a result was made from, or None.

    Raises
    ------
    FileError : a file cannot be read.
    """
    used = {f.get("sha256") for role, f in list_inputs(result).items() if _is_data(role)}
    given = (path for role, path in inputs.items() if _is_data(role))
    return next((path for path in given if sha256(path) in used), None)


def refuse_used_folder(path: str | Path, force: bool) -> None:
    """Raise FileError where a run folder would replace something else, or a run without `force`."""
    refuse_folder_in_use(as_path(path, "run folder"), "run", RESULT, force)


def refuse_run_folder(folder: Path, inputs: Sequence[Path], force: bool) -> None:
    """Raise FileError as `refuse_used_folder`, or where the folder contains an input."""
    refuse_used_folder(folder, force)
    for path in inputs:
        if path.exists() and path.resolve().is_relative_to(folder.resolve()):
            sentence = f"this folder contains the input {path} and cannot be replaced"
            raise FileError(f"{sentence}; choose another name", folder)


def write_run_folder(
    path: str | Path,
    result: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    robot_text: str,
    force: bool = False,
) -> Path:
    """Write a run folder whole or not at all, and return it.

    Parameters
    ----------
    path : the folder to make. result : content of result.json; `format` is added.
    arrays : name -> array, SI. robot_text : of the corrected robot file.
    force : replace an older run.

    Raises
    ------
    FileError : the folder is in use, or cannot be written.
    """
    path = as_path(path, "run folder")
    refuse_used_folder(path, force)
    text = to_json({"format": FORMAT, **result})
    with replace_folder(path) as folder:
        (folder / RESULT).write_text(text, encoding="utf-8")
        (folder / ROBOT).write_text(robot_text, encoding="utf-8")
        with (folder / ARRAYS).open("wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
    return path


def read_run_folder(path: str | Path) -> RunFolder:
    """Read a run folder.

    Raises
    ------
    FileError : not a run folder, made by a newer loopcal, or damaged.
    """
    path = as_path(path, "run folder")
    if not (path / RESULT).is_file():
        sentence = f"this is not a run folder (it has no {RESULT})"
        raise FileError(f"{sentence}; name a folder that a calibration wrote", path)
    try:
        result = json.loads(read_text(path / RESULT, "run result"))
        with np.load(path / ARRAYS, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError) as error:
        raise FileError(f"this run folder is damaged ({error}); repeat the run", path) from error
    if not isinstance(result, dict) or result.get("format", 0) > FORMAT:
        sentence = f"this run has a newer format than {FORMAT}"
        raise FileError(f"{sentence}; use a newer loopcal, or repeat the run", path)
    return RunFolder(path, result, arrays)


def _is_data(role: str) -> bool:
    return role.partition("-")[0] == "data"
