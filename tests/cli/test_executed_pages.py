# SPDX-License-Identifier: Apache-2.0
"""Pages whose commands and Python code run from top to bottom, and print what the pages show.

The conventions of these pages: `tests/cli/page_commands.py`. Pages of studies run in
`test_question_pages.py`.
"""

import json
import re
from pathlib import Path

import pytest

from tests.cli.page_commands import check_shown_lines, list_blocks, run_page

DOCS = Path(__file__).resolve().parents[2] / "docs"
STUDIES = ("instrument", "method", "poses")
PAGES = [
    f"{folder}/{path.stem}"
    for folder in ("questions",)
    for path in sorted((DOCS / folder).glob("*.md"))
    if path.stem not in (*STUDIES, "README")
]


def read_page(name: str) -> str:
    return (DOCS / f"{name}.md").read_text("utf-8")


def read_estimates(run: str) -> dict[str, float]:
    """Return the estimates of a run by name, in the units of its robot file."""
    parameters = json.loads(Path(run, "result.json").read_text("utf-8"))["fit"]["parameters"]
    return {parameter["name"]: parameter["estimate"] for parameter in parameters}


@pytest.mark.parametrize("name", PAGES)
def test_page_runs_and_prints_what_it_shows(name, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = read_page(name)
    run_page(page)
    shown = [block for block in list_blocks(page) if block.language == "text"]
    assert shown, "a page shows what its commands print"
    if name == "questions/rods-get-shorter":
        check_table_of_rods(page)


def check_table_of_rods(page: str) -> None:
    """Check that the three probings give the rods of the table, all flat within the noise."""
    rows = re.findall(r"^\| (\w+) \| ([\d.]+) mm \| ([\d.]+) mm \| ([\d.]+) mm", page, re.MULTILINE)
    assert len(rows) == 3
    for run, *arms in rows:
        estimates = read_estimates(run)
        found = [f"{estimates[f'arm{k}.length']:.1f}" for k in (1, 2, 3)]
        assert found == arms


def test_readme_of_questions_lists_every_page() -> None:
    listed = re.findall(r"\]\(([\w-]+)\.md\)", read_page("questions/README"))
    assert sorted(listed) == sorted(
        path.stem for path in (DOCS / "questions").glob("*.md") if path.stem != "README"
    )


def test_line_that_was_not_printed_is_an_error() -> None:
    check_shown_lines("a  1 mm\n...\nb 2 mm", "a 1 mm\nother\nb  2 mm\n")
    with pytest.raises(AssertionError, match="b 3 mm"):
        check_shown_lines("a 1 mm\nb 3 mm", "a 1 mm\nb 2 mm\n")
    with pytest.raises(AssertionError, match="a 1 mm"):
        check_shown_lines("b 2 mm\na 1 mm", "a 1 mm\nb 2 mm\n")
