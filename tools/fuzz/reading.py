# SPDX-License-Identifier: Apache-2.0
"""Read the files that loopcal wrote with its own readers."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from loopcal.errors import LoopcalError
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.robot.robot_file import load_robot
from loopcal.io.runs.run_folder import load_run
from tools.fuzz.cases import Case
from tools.fuzz.verdict import normalize

NO_ROWS = ("no rows", "Fill in")
"""What is said about a table that is still to be filled in."""


def read_back(
    case: Case, new: set[str], files: Mapping[str, bytes | str], folder: Path
) -> Iterator[tuple[str, str, str]]:
    """Read every new file with the reader of its kind; yield name, sentence and place of failures.

    Parameters
    ----------
    new : names of the files that were written or changed. files : content of all, by name.
    """
    runs = {str(Path(name).parent) for name in new if Path(name).name == "result.json"}
    for name in sorted(runs):
        yield from _try(name, "run folder", load_run, folder)
    for name in sorted(new):
        content = files[name]
        if not isinstance(content, bytes) or str(Path(name).parent) in runs:
            continue
        if _is_robot(content):
            yield from _try(name, "robot file", load_robot, folder)
        elif _is_data(content) and (robot := _find_robot(case, folder)) is not None:
            yield from _try(
                name,
                "measurement file",
                lambda path, robot=robot: load_measurements(path, robot),
                folder,
            )


def _is_robot(content: bytes) -> bool:
    return b"\nfamily:" in content and b"\nunits:" in content


def _is_data(content: bytes) -> bool:
    """Return whether this is a measurement file with rows, and not a table of targets or draws."""
    text = content.decode("utf-8", "replace")
    has_kind = any(line.startswith(("# kind", "kind")) for line in text.splitlines())
    rows = [line for line in text.splitlines() if line and not line.startswith("#")]
    return has_kind and len(rows) > 1 and rows[0].startswith("pose")


def _find_robot(case: Case, folder: Path) -> Any:
    """Return the robot of a command line; None where it cannot be read."""
    for name in (*case.words[1:], "new.yaml"):
        path = folder / name
        if name.endswith(".yaml") or not path.exists():
            try:
                return load_robot(path if path.exists() else name)
            except (LoopcalError, OSError):
                continue
    return None


def _try(
    name: str, kind: str, read: Callable[[Any], Any], folder: Path
) -> Iterator[tuple[str, str, str]]:
    try:
        read(folder / name)
    except LoopcalError as error:
        if not any(words in str(error) for words in NO_ROWS):
            what = error.code or normalize(str(error).partition(": ")[2])
            yield name, str(error), f"{kind}: {type(error).__name__} {what}"
    except Exception as error:  # noqa: BLE001  # whatever a reader raises is a find
        yield name, traceback.format_exc()[-3000:], f"{kind}: {type(error).__name__}"
