# SPDX-License-Identifier: Apache-2.0
"""Check a wheel of loopcal-native: `python -m tools.check_wheel WHEEL FOLDER`.

It contains the package, its license and one library. The library offers the C interface only,
starts no threads, and names no file of the machine that built it, such as FOLDER.
"""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LIBRARY = re.compile(r"loopcal_native/libloopcal\.(so|dylib|dll)")
PARALLEL = re.compile(r"pthread_create|thrd_create|_M_start_thread|fork|clone|GOMP")
"""Functions that start threads or processes."""


def list_expected(names: list[str]) -> set[str]:
    """Return the files of the package, and those that describe a distribution."""
    package = ROOT / "native" / "src" / "loopcal_native"
    info = next(name for name in names if ".dist-info/" in name).split("/")[0]
    about = ("METADATA", "WHEEL", "RECORD", "entry_points.txt", "top_level.txt", "licenses/LICENSE")
    files = {f"loopcal_native/{path.name}" for path in package.glob("*.py")}
    return files | {f"{info}/{name}" for name in about}


def find_faults(wheel: Path, folder: str) -> list[str]:
    """List, a sentence each, what is wrong with a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        libraries = [name for name in names if LIBRARY.fullmatch(name)]
        faults = [] if "-py3-none-" in wheel.name else [f"{wheel.name} is for one Python"]
        if len(libraries) != 1:
            return [*faults, f"it has the libraries {libraries}, not one"]
        different = set(names) - set(libraries) ^ list_expected(names)
        faults += [f"{name} is missing or unexpected" for name in sorted(different)]
        content = archive.read(libraries[0])
    for path in {str(ROOT), folder} - {""}:
        if path.encode() in content:
            faults.append(f"the library names {path}")
    return faults + find_foreign_symbols(content, Path(folder))


def find_foreign_symbols(content: bytes, folder: Path) -> list[str]:
    """List symbols that the library offers beside the C interface, and functions of threads and
    processes that it calls; by `nm`, on Linux.
    """
    if not content.startswith(b"\x7fELF"):
        return []
    copy = folder / "checked-library"
    copy.write_bytes(content)
    offered, called = (list_symbols(copy, kind) for kind in ("--defined-only", "--undefined-only"))
    copy.unlink()
    faults = [f"the library offers {name}" for name in offered if name[:8] != "loopcal_"]
    faults += [f"the library calls {name}" for name in called if PARALLEL.search(name)]
    return faults if offered else ["the library offers no function"]


def list_symbols(library: Path, kind: str) -> list[str]:
    """Return the sorted names of the dynamic symbols of a kind, an option of `nm`."""
    command = ["nm", "--dynamic", kind, "--format=posix", str(library)]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return sorted(line.split()[0] for line in lines)


def main() -> int:
    """Print the faults of a wheel; return 1 if there are any."""
    wheel, folder = Path(sys.argv[1]), sys.argv[2]
    faults = find_faults(wheel, folder)
    print("\n".join(faults) or f"wheel: {wheel.name}, {wheel.stat().st_size} bytes, is as expected")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
