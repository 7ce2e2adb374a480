# SPDX-License-Identifier: Apache-2.0
"""Every command and every line of Python on the pages runs in a test.

Pages run from top to bottom by `run_page` (here, or in `tests/cli/test_executed_pages.py`), or in a
test file of their own, which must name them.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from loopcal.findings.catalog import load_catalog
from tests.cli.page_commands import run_command, run_page
from tests.cli.test_executed_pages import PAGES as EXECUTED_PAGES

OWN_TESTS = {
    "README.md": "tests/test_readme.py",
    "docs/app.md": "tests/app/test_page.py",
    "docs/extending.md": "tests/test_extending.py",
    "docs/hexapod-with-tracker.md": "tests/cli/test_hexapod_page.py",
    "docs/python.md": "tests/report/test_python_page.py",
    "docs/phone-and-board.md": "tests/cli/test_pictures.py",
    "docs/planning.md": "tests/cli/test_planning_page.py",
    "docs/report.md": "tests/documents/test_report_page.py",
    "docs/studies.md": "tests/cli/test_studies_page.py",
    "docs/papers.md": "tests/papers/test_reproductions.py",
    "examples/studies/README.md": "tests/cli/test_question_pages.py",
}
"""From a page to the test file that runs its blocks."""

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def list_pages(root: Path) -> dict[str, str]:
    """Return the text of each committed page by its path."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"]
    names = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout
    return {
        name: (root / name).read_text("utf-8")
        for name in names.splitlines()
        if (root / name).is_file()
    }


def has_blocks_to_run(text: str) -> bool:
    """Return whether a page has a block of Python or of the shell, or one with a command."""
    return any(
        language in ("sh", "python") or re.search(r"^(\$ )?loopcal ", code, re.MULTILINE)
        for language, code in BLOCK.findall(text)
    )


def find_theory(pages: dict[str, str]) -> set[str]:
    """Return the pages whose examples `tests/test_theory.py` runs."""
    return {name for name in pages if name.startswith("docs/theory/")}


def test_every_page_with_commands_or_code_is_run_by_a_test(root) -> None:
    pages = list_pages(root)
    with_blocks = {name for name, text in pages.items() if has_blocks_to_run(text)}
    run = {f"docs/{name}.md" for name in EXECUTED_PAGES} | find_theory(pages)
    run |= set(OWN_TESTS) | set(PREPARATIONS)
    assert sorted(with_blocks - run) == []
    assert sorted(set(OWN_TESTS) - with_blocks) == []
    assert not set(OWN_TESTS) & set(PREPARATIONS)
    assert [name for name in find_theory(pages) if "```sh" in pages[name]] == []


LOOKED_UP = {
    *("README", "api", "coming-from", "commands", "engines", "evidence", "exports", "extending"),
    *("files", "findings", "glossary", "papers", "python", "robots"),
}
"""Pages that are looked up; all others answer a question, and begin with a picture."""


def test_pages_that_answer_a_question_begin_with_a_picture(root) -> None:
    pages = {page.stem: page.read_text("utf-8") for page in (root / "docs").glob("*.md")}
    assert pages.keys() > LOOKED_UP
    for name in pages.keys() - LOOKED_UP:
        match = re.search(r"!\[[^]]{20,}\]\(([^)]+)\)", pages[name][:900])
        assert match is not None, name
        assert (root / "docs" / match[1]).is_file(), name


@pytest.mark.parametrize("page", OWN_TESTS)
def test_test_file_of_a_page_names_it(page, root) -> None:
    text = (root / OWN_TESTS[page]).read_text("utf-8")
    assert Path(page).name in text


@pytest.mark.parametrize("language", ["sh", "", "text"])
def test_block_with_a_command_has_to_run_whatever_its_language(language) -> None:
    assert has_blocks_to_run(f"```{language}\nloopcal check a.yaml\n```\n")
    assert not has_blocks_to_run("```text\nprinted\n```\n")


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def copy_example(root: Path, name: str, **renamed: str) -> None:
    """Copy the files of an example, or some of them under other names (`_` for `.`)."""
    source = root / "examples" / name
    for target, file in (renamed or {p.name: p.name for p in source.iterdir()}).items():
        shutil.copy(source / file, target.replace("_", ".") if renamed else target)


def prepare_calibration(root: Path, data: Path) -> None:
    copy_example(root, "hexapod-42", measurements_csv="measurements.csv")
    shutil.copytree(root / "examples", "examples")


def prepare_exports(root: Path, data: Path) -> None:
    copy_example(root, "exports")
    names = {"export_txt": "six-dof.txt", "tracker_yaml": "six-dof.yaml"}
    copy_example(root, "exports", **names, tracker_txt="six-dof.txt")
    profile = "format: 1\ndelimiter: semicolon\ncolumns: {pose: {from: pose}}\nreadings:\n"
    readings = "".join(f'  q{i}: {{from: "q{i} [mm]", unit: mm}}\n' for i in range(1, 7))
    Path("lengths.yaml").write_text(profile + readings)
    shutil.copy(root / "src" / "loopcal" / "robots" / "hexapod-42.yaml", "robot.yaml")
    rows = (root / "examples" / "exports" / "poses.csv").read_text("utf-8").splitlines()
    rows = [row for row in rows if row and not row.startswith("#")]
    Path("lengths.txt").write_text("\n".join(row.replace(",", ";") for row in rows) + "\n")
    copy_example(root, "hexapod-tracker", points_txt="points.txt", hexapod_yaml="hexapod.yaml")
    Path("plan").mkdir()
    shutil.copy(root / "examples" / "hexapod-tracker" / "sheet.csv", "plan/measurements.csv")


def prepare_files(root: Path, data: Path) -> None:
    copy_example(root, "exports")
    shutil.copy(root / "src" / "loopcal" / "robots" / "hexapod-42.yaml", "robot.yaml")
    run_command(
        "loopcal import tracker-points.txt --profile tracker-points.yaml -o observations.csv"
    )
    options = "--draw 10 --seed 3"
    for name, kind in (("tracker", "position"), ("inclinometer", "inclination")):
        run_command(f"loopcal simulate robot.yaml {options} --kind {kind} -o {name}.csv")


PREPARATIONS: dict[str, Callable[[Path, Path], object]] = {
    "docs/getting-started.md": lambda root, data: None,
    "docs/calibration.md": prepare_calibration,
    "docs/exports.md": prepare_exports,
    "docs/files.md": prepare_files,
    "CONTRIBUTING.md": lambda root, data: None,
    "evidence/README.md": lambda root, data: None,
    **{
        f"examples/{name}/README.md": lambda root, data, name=name: copy_example(root, name)
        for name in ("cable-robot", "delta-printer", "exports", "hexapod-42", "hexapod-tracker")
    },
}
"""From a page that runs here to the function that puts the files of its reader into the folder."""

ALTERNATIVES = ("docs/exports.md", "docs/files.md")
"""Pages whose commands show several ways to the same file; each replaces what is there."""

OTHER_ROBOTS = {"loopcal fill robot.yaml": "loopcal fill hexapod.yaml"}
"""Commands with another robot, or a run of one, than those before them: here its file."""


def adapt_commands(page: str, text: str) -> str:
    """Return a page with commands that can follow each other in one folder."""
    if page in ALTERNATIVES:
        writing = r"^(loopcal (?:import|calibrate|export) .* -o .*)$"
        text = re.sub(writing, r"\1 --force", text, flags=re.MULTILINE)
    for command, other in OTHER_ROBOTS.items():
        text = text.replace(command, other)
    return re.sub(r"^pytest .*\n", "", text, flags=re.MULTILINE)


def test_help_by_verdict_names_each_failure_and_only_findings_of_the_catalog(root) -> None:
    page, catalog = (root / "docs" / "not-calibrated.md").read_text("utf-8"), load_catalog()
    named = set(re.findall(r"`((?!robot|result)[a-z]+\.[a-z-]+)`", page))
    failures = {c for c, e in catalog.items() if c[:4] == "fit." and e.severity.value == "failure"}
    assert named <= catalog.keys()
    phrases = re.findall(r'"([^"|]+)"[^|`]*\(`([a-z.-]+)`', page)
    assert len(phrases) >= 18
    for phrase, code in phrases:
        words = " ".join(catalog[code].text.split())
        assert all(part.strip() in words for part in phrase.split("...")), code
    assert failures | {"noise.residuals-too-large"} <= named


@pytest.mark.slow
@pytest.mark.parametrize("page", PREPARATIONS)
def test_page_runs(page, folder, root, data_folder) -> None:
    PREPARATIONS[page](root, data_folder)
    run_page(adapt_commands(page, (root / page).read_text("utf-8")))
