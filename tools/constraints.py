# SPDX-License-Identifier: Apache-2.0
"""Regenerate constraints/python3.XX.txt, by installing loopcal[dev] afresh for each Python found
and freezing it.

Run by `make constraints`. Pythons 3.11 to 3.14 are looked for on PATH and among pyenv's versions;
the file of a Python that is not found is left as it is.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MINORS = ("3.11", "3.12", "3.13", "3.14")


def find_python(minor: str) -> str | None:
    """Return the oldest interpreter of this minor version that can make virtual environments, or
    None: newer ones can install what it can, but some releases refuse Python 3.11.2 of Debian 12.
    """
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    installed = (str(path) for path in pyenv.glob(f"versions/{minor}.*/bin/python{minor}"))
    script, found = "import ensurepip, sys, venv; print(sys.version_info[2])", dict[int, str]()
    for candidate in (f"/usr/bin/python{minor}", f"python{minor}", *installed):
        try:
            done = subprocess.run([candidate, "-c", script], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            continue
        found.setdefault(int(done.stdout), candidate)
    return found[min(found)] if found else None


def freeze(python: str) -> list[str]:
    """Install loopcal[dev] into a fresh environment and return the installed versions."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([python, "-m", "venv", folder], check=True)
        pip = [
            str(Path(folder, "bin", "python")),
            "-m",
            "pip",
            "--quiet",
            "--disable-pip-version-check",
        ]
        subprocess.run([*pip, "install", f"{ROOT}[dev]"], check=True)
        frozen = subprocess.run(
            [*pip, "freeze", "--exclude", "loopcal"], check=True, capture_output=True, text=True
        )
    return frozen.stdout.splitlines()


def main() -> int:
    """Write the constraints of every Python found; exit 1 when there is none."""
    pythons = {minor: python for minor in MINORS if (python := find_python(minor))}
    for minor, python in pythons.items():
        header = f"# Versions of loopcal[dev] on Python {minor}, frozen by `make constraints`."
        path = ROOT / "constraints" / f"python{minor}.txt"
        path.write_text("\n".join([header, *freeze(python), ""]), encoding="utf-8")
        print(f"constraints: wrote {path.relative_to(ROOT)}")
    missing = [minor for minor in MINORS if minor not in pythons]
    if missing:
        print(f"constraints: no Python {', '.join(missing)} found, left as it was")
    return 0 if pythons else 1


if __name__ == "__main__":
    sys.exit(main())
