# SPDX-License-Identifier: Apache-2.0
"""Measure the structure of the source: sizes, single uses, circles of imports, calls of a job.

python -m tools.structure            print a table
"""

from __future__ import annotations

import ast
import inspect
import io
import subprocess
import sys
import tempfile
import tokenize
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "src" / "loopcal"

JOB = """
import loopcal as lc
from tools.structure import profile_calls
robot = lc.load_robot("hexapod-42")
data = lc.load_measurements("examples/hexapod-42/measurements.csv", robot)
options = lc.CalibrationOptions(hold_out=0.25)
print(*profile_calls(lambda: lc.calibrate(robot, data, options)))
"""
COMMAND = """
import sys
from loopcal.cli.entry_point import main
main(["calibrate", "hexapod-42", "examples/hexapod-42/measurements.csv", "-o", sys.argv[1]])
print(sum(name.split(".")[0] == "loopcal" for name in sys.modules))
"""


def list_modules() -> dict[str, ast.Module]:
    """Return the syntax tree of each module of the source by its dotted name."""
    trees = {}
    for path in sorted(SOURCE.rglob("*.py")):
        parts = path.relative_to(SOURCE.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        trees[name] = ast.parse(path.read_text("utf-8"))
    return trees


def list_imports(tree: ast.Module, modules: Mapping[str, Any]) -> Iterator[str]:
    """Yield the modules that a module names: in imports at any depth, and in strings.

    Imports for type checkers alone do not count, nor does the name of the distribution in a string.
    """
    skipped: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            skipped |= {id(inner) for part in node.body for inner in ast.walk(part)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in modules else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and "." in node.value:
            yield node.value.partition(":")[0]


def find_circles() -> list[list[str]]:
    """Return the groups of modules that import each other, the largest first (Tarjan)."""
    trees = list_modules()
    graph = {
        name: {m for m in list_imports(tree, trees) if m in trees and m != name}
        for name, tree in trees.items()
    }
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    circles: list[list[str]] = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for other in graph[name]:
            if other not in index:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], index[other])
        if low[name] == index[name]:
            cut = stack.index(name)
            if len(stack) - cut > 1:
                circles.append(sorted(stack[cut:]))
            del stack[cut:]

    sys.setrecursionlimit(10_000)
    for name in graph:
        if name not in index:
            visit(name)
    return sorted(circles, key=len, reverse=True)


def count_lines(folder: Path) -> Counter[str]:
    """Count files, lines, docstrings, imports and blank lines of Python below a folder."""
    counts: Counter[str] = Counter()
    for path in folder.rglob("*.py"):
        text = path.read_text("utf-8")
        tree = ast.parse(text)
        counts["files"] += 1
        counts["lines"] += text.count("\n")
        counts["blank"] += sum(not line.strip() for line in text.splitlines())
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            counts["comments"] += (
                token.type == tokenize.COMMENT and not token.line[: token.start[1]].strip()
            )
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom):
                counts["imports"] += node.end_lineno - node.lineno + 1  # type: ignore[operator]
            elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                counts["docstrings"] += node.end_lineno - node.lineno + 1  # type: ignore[operator]
    counts["folders"] = len({path.parent for path in folder.rglob("*.py")})
    return counts


def count_single_uses() -> tuple[int, int]:
    """Return (module functions that are named once outside their definition, module functions)."""
    trees = list_modules()
    names = Counter(
        node.id if isinstance(node, ast.Name) else node.attr
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Name | ast.Attribute)
    )
    functions = [
        node.name
        for tree in trees.values()
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
    ]
    return sum(names[name] == 1 for name in functions), len(functions)


def profile_calls(work: Any) -> tuple[int, int]:
    """Return (functions of loopcal that work enters, their deepest stack)."""
    entered: set[Any] = set()
    depth = deepest = 0

    def watch(frame: FrameType, event: str, _: object) -> None:
        nonlocal depth, deepest
        if event not in {"call", "return"} or "/loopcal/" not in frame.f_code.co_filename:
            return
        is_function = frame.f_code.co_flags & inspect.CO_OPTIMIZED  # not the body of a class
        if not is_function or frame.f_code.co_name.startswith("<"):
            return
        if event == "call":
            entered.add(frame.f_code)
            depth += 1
            deepest = max(deepest, depth)
        else:
            depth -= 1

    sys.setprofile(watch)
    try:
        work()
    finally:
        sys.setprofile(None)
    return len(entered), deepest


def run_python(code: str) -> str:
    """Return the last line that a program prints in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-c", code, f"{folder}/run"]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]


def main() -> None:
    """Print the measurements, one a line."""
    source, tests = count_lines(SOURCE), count_lines(ROOT / "tests")
    circles = find_circles()
    once, functions = count_single_uses()
    entered, depth = run_python(JOB).split()
    rows = {
        "files of the source": source["files"],
        "folders": source["folders"],
        "lines": source["lines"],
        "docstrings": source["docstrings"],
        "imports": source["imports"],
        "blank lines and comments": source["blank"] + source["comments"],
        "module functions": functions,
        "module functions used once": once,
        "functions that lc.calibrate enters": entered,
        "deepest stack of them": depth,
        "modules that the command calibrate imports": run_python(COMMAND),
        "largest circle of imports": len(circles[0]) if circles else 1,
        "files of tests": tests["files"],
        "lines of tests": tests["lines"],
    }
    for name, value in rows.items():
        print(f"{name:45}{int(value):>9,}")


if __name__ == "__main__":
    main()
