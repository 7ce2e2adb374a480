# SPDX-License-Identifier: Apache-2.0
"""Rules of the repository: layers, licenses, and consistent documentation."""

import ast
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

# Folders that exist on one machine only; assembled here so that this file does not contain them.
MACHINE_PATH = re.compile(
    "|".join(f"(?<![\\w.])/{name}/" for name in ("work", "root", "tmp", "home", "Users"))
)


@pytest.fixture(scope="module")
def repository_files(root: Path) -> list[Path]:
    """Return the files that belong to the repository: committed, or new and not ignored."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(
        command, cwd=root, check=True, capture_output=True, text=True
    ).stdout.split("\0")
    return [root / name for name in names if name and (root / name).is_file()]


def test_changelog_has_an_unreleased_section(root: Path) -> None:
    assert re.search(
        r"^## \[Unreleased\]$", (root / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE
    )


def test_every_package_has_a_layer(root: Path) -> None:
    settings = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))
    contract = settings["tool"]["importlinter"]["contracts"][0]
    layers = set(re.findall(r"\w+", " ".join(contract["layers"]))) | set(
        contract["exhaustive_ignores"]
    )
    package = root / "src" / "loopcal"
    modules = {path.stem for path in package.glob("*.py")} - {"__init__"}
    packages = {path.name for path in package.iterdir() if any(path.rglob("*.py"))}
    assert modules | packages <= layers


def test_every_package_has_an_init_file(root: Path) -> None:
    folders = {path.parent for path in (root / "src" / "loopcal").rglob("*.py")}
    assert [folder.name for folder in folders if not (folder / "__init__.py").is_file()] == []


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_every_make_command_in_documentation_exists(root: Path, page: str) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (root / "Makefile").read_text("utf-8"), re.MULTILINE))
    named = set(
        re.findall(
            r"(?:^|`)make (?:PYTHON=\S+ )?([a-z-]+)", (root / page).read_text("utf-8"), re.MULTILINE
        )
    )
    assert named, "the page names no make command"
    assert named <= targets


def test_list_of_decisions_is_complete(root: Path) -> None:
    folder = root / "docs" / "decisions"
    listed = re.findall(
        r"^\| \[\d\d\]\(([^)]+)\)", (folder / "README.md").read_text("utf-8"), re.MULTILINE
    )
    assert listed == sorted(
        path.name for path in folder.glob("[0-9]*.md") if not path.name.startswith("00")
    )


def test_links_between_pages_lead_to_existing_files(
    root: Path, repository_files: list[Path]
) -> None:
    pages = [path for path in repository_files if path.suffix == ".md"]
    links = [
        (page, link)
        for page in pages
        for link in re.findall(r"\]\(([^)#:]+)\)", page.read_text("utf-8"))
    ]
    assert [
        f"{page.relative_to(root)}: {link}"
        for page, link in links
        if not (page.parent / link).exists()
    ] == []


@pytest.mark.slow
def test_no_file_contains_a_path_of_one_machine(root: Path, repository_files: list[Path]) -> None:
    result = []
    for path in repository_files:
        try:
            text = path.read_text("utf-8")
        except UnicodeDecodeError:
            continue
        result += [f"{path.relative_to(root)}: {match[0]}" for match in MACHINE_PATH.finditer(text)]
    assert result == []


def test_every_python_file_begins_with_its_license(
    root: Path, repository_files: list[Path]
) -> None:
    spdx = "# SPDX-License-Identifier: Apache-2.0\n"
    files = [path for path in repository_files if path.suffix == ".py"]
    assert [
        str(f.relative_to(root)) for f in files if not f.read_text("utf-8").startswith(spdx)
    ] == []


def test_every_path_in_the_architecture_page_exists(root: Path) -> None:
    text = (root / "ARCHITECTURE.md").read_text("utf-8")
    named = set(re.findall(r"`([\w/]+(?:\.py|\.toml|/))`", text))
    assert len(named) > 40
    places = (root, root / "src" / "loopcal")
    assert {name for name in named if not any((place / name).exists() for place in places)} == set()


def test_no_repr_formats_a_number_itself(root) -> None:
    """`round_to_digits` does, and has words for what is not finite."""
    formatted = [
        f"{path.name}:{node.lineno}"
        for path in (root / "src").rglob("*.py")
        if "def __repr__" in path.read_text("utf-8")
        for function in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(function, ast.FunctionDef) and function.name == "__repr__"
        for node in ast.walk(function)
        if isinstance(node, ast.FormattedValue) and node.format_spec is not None
    ]
    assert formatted == []
