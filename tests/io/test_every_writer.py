# SPDX-License-Identifier: Apache-2.0
"""Files are written by `loopcal.io.core` alone, whole or not at all."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import loopcal

PACKAGE = Path(loopcal.__file__).parent

LIBRARY = {"savez", "save", "savetxt", "savefig", "dump", "to_csv", "tofile", "writelines"}
LIBRARY |= {"mkstemp", "fdopen", "mkdir", "makedirs", "hardlink_to", "copy2", "NamedTemporaryFile"}
"""Functions of Python and libraries that can write."""

USES_LIBRARY = {
    "app/project.py": "makes the folders of a machine",
    "cli/commands/session_commands.py": "makes the folder that --keep names",
    "cli/entry_point.py": "the report of a defect is for people, and must not fail",
    "io/example_folders.py": "writes the files of a new folder",
    "io/core/outputs.py": "writes folders",
    "io/core/text_file.py": "writes files; makes, renames and restores temporary files",
    "studies/study_result.py": "writes a long table row by row, and makes one in memory",
    "studies/files/store.py": "writes the files of a new folder",
    "cli/commands/calibration_commands.py": "makes a table in memory",
    "io/formats/correction_files.py": "makes tables in memory",
    "io/runs/session_folder.py": "appends rows that are on the disk before the next",
    "io/runs/run_folder.py": "makes arrays.npz in memory",
    "report/pictures.py": "draws into memory",
}
"""Modules that use them, and why they may."""


@cache
def parse_source() -> tuple[tuple[str, ast.AST], ...]:
    """Return module and node of all names and calls."""
    nodes = []
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text("utf-8")
        if any(name in text for name in (*LIBRARY, "write_text", "write_bytes", "open(")):
            module = path.relative_to(PACKAGE).as_posix()
            nodes += [(module, node) for node in ast.walk(ast.parse(text))]
    return tuple(nodes)


def list_names() -> Iterator[tuple[str, str, ast.AST]]:
    """Yield module, name and node of all names in use."""
    for module, node in parse_source():
        if isinstance(node, ast.Name | ast.Attribute):
            yield module, node.id if isinstance(node, ast.Name) else node.attr, node


def list_openings() -> Iterator[str]:
    """Yield the modules that open a file with a mode that writes."""
    for module, call in parse_source():
        function = getattr(call, "func", None)
        name = getattr(function, "attr", getattr(function, "id", ""))
        if isinstance(call, ast.Call) and name == "open":
            words = [*call.args, *(keyword.value for keyword in call.keywords)]
            modes = [word.value for word in words if isinstance(word, ast.Constant)]
            if any(re.fullmatch(r"[wax][bt+]*|r.?\+", str(mode)) for mode in modes):
                yield module


def test_no_module_writes_files_itself() -> None:
    """Only the core does, and what writes into memory or to nobody."""
    methods = {
        module
        for module, name, node in list_names()
        if isinstance(node, ast.Attribute) and name in ("write_text", "write_bytes")
    }
    library = {module for module, name, *_ in list_names() if name in LIBRARY}
    assert methods | library | set(list_openings()) == set(USES_LIBRARY)
