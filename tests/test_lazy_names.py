# SPDX-License-Identifier: Apache-2.0
"""Names that packages import on first use: type checkers and Python see the same ones."""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

import loopcal
from loopcal.measure import KINDS
from loopcal.mechanism import FAMILIES

SOURCE = Path(loopcal.__file__).parent
PACKAGES = sorted(
    path for path in SOURCE.rglob("__init__.py") if "import_lazily(" in path.read_text("utf-8")
)


def name_package(path: Path) -> str:
    return ".".join(path.parent.relative_to(SOURCE.parent).parts)


def list_checked_imports(tree: ast.Module) -> set[tuple[str, str]]:
    """Return (module, name) of all imports for type checkers."""
    blocks = [node for node in tree.body if isinstance(node, ast.If)]
    imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
    return {(str(node.module), alias.name) for node in imports for alias in node.names}


def list_lazy_imports(tree: ast.Module) -> set[tuple[str, str]]:
    """Return (module, name) of the table of `import_lazily`."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    call = next(c for c in calls if isinstance(c.func, ast.Name) and c.func.id == "import_lazily")
    table = ast.literal_eval(call.args[1])
    return {(module, name) for module, names in table.items() for name in names.split()}


def test_packages_with_lazy_names_are_found() -> None:
    assert {"loopcal.apply", "loopcal.diagnose", "loopcal.io"} <= {*map(name_package, PACKAGES)}


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("__init__.py")), ids=name_package)
def test_no_name_that_a_package_exports_is_that_of_its_module(path) -> None:
    package, folder = import_module(name_package(path)), path.parent
    modules = {file.stem for file in folder.glob("*.py")}
    modules |= {file.parent.name for file in folder.glob("*/__init__.py")}
    exported = {name: getattr(package, name, None) for name in modules - {"__init__"}}
    assert not [n for n, value in exported.items() if not isinstance(value, ModuleType | None)]


@pytest.mark.parametrize("path", PACKAGES, ids=name_package)
def test_imports_for_type_checkers_equal_the_lazy_names(path) -> None:
    tree = ast.parse(path.read_text("utf-8"))
    assert list_checked_imports(tree) == list_lazy_imports(tree)


@pytest.mark.parametrize("path", PACKAGES, ids=name_package)
def test_a_lazy_name_is_that_of_its_module_and_is_kept(path) -> None:
    package = import_module(name_package(path))
    for module, name in list_lazy_imports(ast.parse(path.read_text("utf-8"))):
        value = getattr(package, name)
        assert value is getattr(import_module(module), name)
        assert vars(package)[name] is value


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match=r"'loopcal\.diagnose' has no attribute 'guess'"):
        _ = import_module("loopcal.diagnose").guess


def test_entries_of_registries_have_the_names_of_their_keys() -> None:
    assert [kind.name for kind in KINDS.values()] == list(KINDS)
    assert [family.family for family in FAMILIES.values()] == list(FAMILIES)
    assert "pose" in KINDS
    assert "Pose" in repr(KINDS)
    assert len(FAMILIES) == len({*FAMILIES.values()})
    with pytest.raises(KeyError):
        _ = KINDS["poses"]


def test_a_registry_imports_an_entry_when_it_is_looked_up() -> None:
    code = (
        "import sys; from loopcal.mechanism import FAMILIES; list(FAMILIES); 'gough' in FAMILIES; "
        "name = 'loopcal.mechanism.families.gough'; before = name in sys.modules; "
        "FAMILIES['gough']; print(before, name in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False True\n"
