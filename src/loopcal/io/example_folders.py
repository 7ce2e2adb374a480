# SPDX-License-Identifier: Apache-2.0
"""The examples that come with loopcal: folders of robots, measurements and studies, to be copied.

An installed package holds them as `loopcal/examples`; in a checkout they are at the top.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path

from loopcal.errors import DataError, FileError, suggest_names
from loopcal.io.core.outputs import replace_folder
from loopcal.io.core.text_file import as_path, read_text

README = "README.md"


def list_examples() -> Mapping[str, Path]:
    """Return name -> folder of the examples."""
    package = Path(str(resources.files("loopcal")))
    installed, checkout = package / "examples", package.parent.parent / "examples"
    folder = installed if installed.is_dir() else checkout
    return {path.name: path for path in sorted(folder.glob("*")) if path.is_dir()}


def describe_example(folder: Path) -> str:
    """Return the title of an example: the heading of its README."""
    text = read_text(folder / README, "example")
    return text.splitlines()[0].lstrip("# ").strip()


def write_example(name: str, path: str | Path) -> tuple[str, ...]:
    """Copy an example into a new folder; return the names of its files.

    DataError, FileError : no such example (`files.no-example`); the folder exists, or cannot be
    written.
    """
    path, examples = as_path(path, "folder"), list_examples()
    if name not in examples:
        similar, known = suggest_names(name, list(examples)), tuple(examples)
        raise DataError.of("files.no-example", name=name, similar=similar, examples=known)
    files = {file.name: file for file in sorted(examples[name].iterdir()) if file.is_file()}

    def refuse_existing(target: Path) -> None:
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise FileError.of("files.example-exists", path, name=name)

    refuse_existing(path)
    with replace_folder(path, refuse_existing, files) as folder:
        for file, source in files.items():
            (folder / file).write_bytes(source.read_bytes())
    return tuple(files)
