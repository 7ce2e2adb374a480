# SPDX-License-Identifier: Apache-2.0
"""Check the sizes of files and functions, unless `# size: reason` lifts a limit.

The comment is in the first ten lines of a file, or on the `def` line of a function or above it.
"""

import ast
import re
import sys
from pathlib import Path

FILE_LIMIT, TEST_FILE_LIMIT = 400, 550
"""Lines of a file. Tests are lists of cases, which read well at some length."""

FUNCTION_LIMIT = 75
"""Lines of a function with its docstring, at 100 columns."""

FOLDERS = ("src", "tests", "tools", "benchmarks", "evidence", "native")
REASON = re.compile(r"#\s*size:\s*\S")


def check_text(name: str, text: str) -> list[str]:
    """List what is too long in one Python file, a sentence each."""
    lines = text.splitlines()
    problems = []
    limit = TEST_FILE_LIMIT if name.startswith("tests/") else FILE_LIMIT
    if len(lines) > limit and not any(REASON.search(line) for line in lines[:10]):
        problems.append(
            f"{name}: {len(lines)} lines, at most {limit}; split it or give `# size: reason` on top"
        )
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        length = (node.end_lineno or node.lineno) - node.lineno + 1
        beside = lines[max(node.lineno - 2, 0) : node.body[0].lineno]
        if length > FUNCTION_LIMIT and not any(REASON.search(line) for line in beside):
            problems.append(
                f"{name}:{node.lineno}: {node.name} has {length} lines, at most {FUNCTION_LIMIT}"
            )
    return problems


def check_folders(root: Path) -> list[str]:
    """List what is too long in the Python files of `root`, a sentence each."""
    files = sorted(path for folder in FOLDERS for path in (root / folder).rglob("*.py"))
    return [
        p
        for path in files
        for p in check_text(path.relative_to(root).as_posix(), path.read_text("utf-8"))
    ]


def main() -> int:
    """Print every problem; exit 1 when there is one."""
    problems = check_folders(Path(__file__).resolve().parent.parent)
    print("\n".join(problems) or "sizes: all files and functions within their limits")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
