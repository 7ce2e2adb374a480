# SPDX-License-Identifier: Apache-2.0
"""Check that every public signature and attribute of loopcal has a complete type.

pyright's `--verifytypes` reads the package as a type checker of a user does. A type that is
unknown in part, or that checkers may infer differently, is an error. `loopcal.cli` is left out: it
is a program, not a library, and the types of click differ between the versions that we allow.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
COMMAND = ("--verifytypes", "loopcal", "--ignoreexternal", "--outputjson")
PROGRAM = "loopcal.cli"


def list_incomplete_types(report: dict[str, Any]) -> list[str]:
    """List the symbols of a report of pyright whose types are incomplete, a line each.

    Raises
    ------
    ValueError : pyright did not find the package, or read nothing of it.
    """
    completeness = report["typeCompleteness"]
    if not completeness["symbols"]:
        raise ValueError(
            "pyright found no symbol of loopcal; install it, with src/loopcal/py.typed"
        )
    lines = []
    for symbol in completeness["symbols"]:
        is_complete = symbol["isTypeKnown"] and not symbol["isTypeAmbiguous"]
        if is_complete or symbol["name"].startswith(PROGRAM):
            continue
        words = [problem["message"].replace("\n", " ") for problem in symbol["diagnostics"]]
        lines.append(f"{symbol['name']}: {'; '.join(words) or 'its type is incomplete'}")
    return lines


def main() -> int:
    """Print the public symbols without a complete type; return 1 if there are any."""
    pyright = Path(sys.executable).with_name("pyright")
    # `--verifytypes` ignores `--pythonpath`: the first `python` of PATH says what is installed. It
    # does not follow the link of an editable installation either
    path = os.pathsep.join([str(pyright.parent), os.environ.get("PATH", os.defpath)])
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT / "src")}
    run = subprocess.run(
        [pyright, *COMMAND], check=False, capture_output=True, text=True, env=environment
    )
    incomplete = list_incomplete_types(json.loads(run.stdout))
    print("\n".join(incomplete) or "Types of all public names are complete.")
    return int(bool(incomplete))


if __name__ == "__main__":
    sys.exit(main())
