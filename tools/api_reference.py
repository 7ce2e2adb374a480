# SPDX-License-Identifier: Apache-2.0
"""Write docs/api.md: every public name with its signature and one line.

python -m tools.api_reference            rewrite the page
"""

from __future__ import annotations

import ast
import enum
import inspect
import re
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import loopcal
from tools.markdown import format_table

PAGE = Path(__file__).resolve().parent.parent / "docs" / "api.md"

SECTIONS = {
    "loopcal.apply": "Whole tasks, and use of a calibration",
    "loopcal.io": "Files",
    "loopcal.mechanism": "Robots and kinematics",
    "loopcal.measure": "Instruments and measurements",
    "loopcal.estimate": "Estimation",
    "loopcal.diagnose": "Diagnosis, resampling and posterior draws",
    "loopcal.planning": "Planning",
    "loopcal.studies": "Simulation studies",
    "loopcal.documents": "Documents",
    "loopcal.progress_bar": "Notebooks",
    "loopcal.findings": "Findings",
    "loopcal.errors": "Errors",
    "loopcal.units": "Units",
}
"""Headings by the package that defines the names."""

HEAD = """\
# Python API

`import loopcal as lc` gives these names, and no other name is public. Inside, all numbers are SI:
meters and radians. Arrays have the poses first; `T` has shape (n, 4, 4) and maps platform
coordinates to base coordinates. Terms are in the [glossary](glossary.md). `help(lc.NAME)` shows
shapes, units and errors. A function comes with the classes of its options and result, `Kind` with
the [kinds](files.md#settings).
"""


def write_page() -> str:
    """Return the text of the page."""
    names = list_names()
    if set(SECTIONS) != set(names):
        raise SystemExit(f"SECTIONS lacks {set(names) - set(SECTIONS)}")
    sections = [HEAD]
    for package, heading in SECTIONS.items():
        results = {name: find_results(name, names[package]) for name in names[package]}
        with_function = {result for found in results.values() for result in found}
        rows = [
            (", ".join(f"`{name}`" for name in (first, *found)), describe_name(first))
            for first, found in results.items()
            if first not in with_function
        ]
        sections.append(f"\n## {heading}\n\n{format_table(('name', 'purpose'), rows)}")
    return "".join(sections)


def list_names() -> dict[str, list[str]]:
    """Return the public names of each package, in the order of the alphabet."""
    stub = Path(loopcal.__file__).with_suffix(".pyi")
    names: dict[str, list[str]] = {}
    for node in ast.parse(stub.read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            package = f"loopcal.{str(node.module).split('.')[0]}"
            names.setdefault(package, []).extend(alias.name for alias in node.names)
    return {
        package: sorted(members, key=lambda name: (name.lower(), name))
        for package, members in names.items()
    }


def find_results(name: str, names: Collection[str]) -> tuple[str, ...]:
    """Return the names of a package that belong to one of them: the classes of the options and
    result of a function, and the kinds, which docs/files.md describes, of `Kind`.
    """
    value = getattr(loopcal, name)
    if value is loopcal.Kind:
        return tuple(name for name in names if getattr(loopcal, name) in loopcal.KINDS.values())
    if not inspect.isfunction(value):
        return ()
    signature = inspect.signature(value)
    options = signature.parameters.get("options")
    annotations = [options.annotation if options else "", signature.return_annotation]
    found = [str(a).removesuffix(" | None").rpartition(".")[2] for a in annotations]
    return tuple(result for result in found if result in names)


def describe_name(name: str) -> str:
    """Return the first sentence of a public name's docstring."""
    value: Any = getattr(loopcal, name)
    if isinstance(value, Mapping):
        return f"Mapping: {', '.join(f'`{key}`' for key in value)}."
    text = inspect.getdoc(value) or ""
    if not text or (isinstance(value, type) and text.startswith(f"{name}(")):
        raise SystemExit(f"{name} has no docstring of its own")
    paragraph = " ".join(text.split("\n\n")[0].split())
    sentence = re.split(r"(?<=[.!?]) (?=[A-Z`])", paragraph)[0]
    members = ""
    if isinstance(value, enum.EnumMeta) and len(value) < 10:
        members = f" ({', '.join(value.__members__)})"
    return sentence.rstrip(".") + members + "."


def main() -> int:
    """Rewrite the page."""
    PAGE.write_text(write_page(), encoding="utf-8")
    print(f"wrote {PAGE.name}: {len(loopcal.__all__) - 1} names")
    return 0


if __name__ == "__main__":
    sys.exit(main())
