# SPDX-License-Identifier: Apache-2.0
"""Size check: no file over 400 lines and no function over 60, unless `# size: reason` stands beside
it.

For a file the comment stands in its first ten lines; for a function on its `def` line or on the
line above.
"""

import ast
import re
import sys
from pathlib import Path

FILE_LIMIT = 400
FUNCTION_LIMIT = 60
FOLDERS = ("src", "tests", "tools", "benchmarks", "evidence")
REASON = re.compile(r"#\s*size:\s*\S")


def check_text(name: str, text: str) -> list[str]:
    """List what is too long in one Python file, a sentence each."""
    lines = text.splitlines()
    problems = []
    if len(lines) > FILE_LIMIT and not any(REASON.search(line) for line in lines[:10]):
        problems.append(
            f"{name}: {len(lines)} lines, at most {FILE_LIMIT}; split it or give `# size: reason` "
            "on top"
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
