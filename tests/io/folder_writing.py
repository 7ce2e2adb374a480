# SPDX-License-Identifier: Apache-2.0
"""Folders of a small kind, written in this process or in one that is forked from it."""

import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

from loopcal.errors import FileError
from loopcal.io.core.outputs import FolderKind, write_result_folder

RUN = FolderKind("run", "result.json", ("made_by", "fit"), ("arrays.npz", "robot.yaml"))


def write(path: Path, value: int, force: bool = False, size: int = 100) -> str:
    """Write a folder with this value in each file; return why it was refused, if it was."""
    text = f"value: {value}\n"
    files = {"robot.yaml": text.encode(), "arrays.npz": text.encode() * size}
    document = {"made_by": {}, "fit": {}, "value": value}
    try:
        write_result_folder(path, RUN, document, files, force)
    except FileError as error:
        return str(error)
    return ""


def run_in_copy(function: Callable[[], Any]) -> tuple[int, Any]:
    """Run a function in a forked process; return its wait status and what the function returned."""
    reader, writer = os.pipe()
    copied = os.fork()
    if copied == 0:
        code = 1
        try:
            os.write(writer, pickle.dumps(function()))
            code = 0
        finally:
            os._exit(code)
    os.close(writer)
    with os.fdopen(reader, "rb") as stream:
        content = stream.read()
    status = os.waitpid(copied, 0)[1]
    return status, pickle.loads(content) if content else None  # noqa: S301 of our own process
