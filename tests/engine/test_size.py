# SPDX-License-Identifier: Apache-2.0
"""The NumPy engine is the specification of every other engine, so it stays readable in one sitting.

The limit: ten files and 2,000 lines of at most 100 columns, about an hour of reading, with the
docstrings that state shapes, units and formulas (a third of the lines). Paths that only saved time,
which native engines save, are gone since 2,300. It was 800 lines until each
attribute of a limb's chain was declared with its type, on a line of its own, 850 until rows could
end near a known goal, by which `inverse` tests the working mode, 870 (five files) until limbs were
closed one by one at a given platform, 1,000 (six files) until the engine differentiated the
platform by parameters, which made blocks of rows for other modules to multiply, 1,250 (seven files)
until proofs replaced most tests of the working mode, and 1,400 (eight files) until rows of poses
were folded as they are made, and 1,500 (nine files) until one call led from coordinates to closed
limbs in a proven mode, and 1,700 until rows that begin at one state shared one factorization and
rows that close after their last step had none, a sixth of the time of forward kinematics, and 1,800
until trials that begin with a factor of zeros were folded by themselves, for bits of their own, and
1,900 until bodies with three or more joints became nodes, which are eliminated one by one, and
2,100 until joints that only couplings and the pose determine became one more node, and 2,200 until
readings along a path were followed pose after pose in one call, and 2,250 until full steps of a fit
were one call, whose record states when they end.
"""

import ast
from pathlib import Path


def list_files(root: Path) -> list[Path]:
    """Return the files of the NumPy engine and of its input and output."""
    folder = root / "src" / "loopcal" / "engine"
    return [folder / "program.py", *sorted((folder / "numpy_engine").glob("*.py"))]


def test_engine_has_at_most_ten_files_and_2000_lines(root: Path):
    files = list_files(root)
    assert len(files) <= 10
    assert sum(len(file.read_text("utf-8").splitlines()) for file in files) <= 2000


def test_engine_imports_numpy_only(root: Path):
    result = set()
    for file in list_files(root):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            result |= {name for name in names if not name.startswith("loopcal.engine")}
    assert result <= {
        "numpy",
        "numpy.typing",
        "__future__",
        "collections.abc",
        "dataclasses",
        "functools",
        "typing",
        "loopcal.typing",
    }
