# SPDX-License-Identifier: Apache-2.0
"""Pages of docs/theory: pages cited by code exist, links are valid, and examples give the printed
output.
"""

import doctest
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
THEORY = ROOT / "docs" / "theory"
INDEX = THEORY / "README.md"
PAGES = sorted(page for page in THEORY.glob("*.md") if page != INDEX)
TEXTS = {page: page.read_text("utf-8") for page in [*PAGES, INDEX]}
FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
EXAMPLE = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def anchors(text: str) -> set[str]:
    """Return the names under which the headings of a page can be linked to."""
    headings = re.findall(r"^#+ (.*)$", FENCED.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_theory_page_cited_by_code_exists() -> None:
    files = (ROOT / "src").rglob("*.py")
    cited = {
        name
        for f in files
        for name in re.findall(r"docs/theory/([\w-]+\.md)", f.read_text("utf-8"))
    }
    assert cited, "the code cites no page of theory"
    assert sorted(cited - {page.name for page in PAGES}) == []


def test_every_theory_page_is_in_the_index() -> None:
    assert [page.name for page in PAGES if f"({page.name})" not in TEXTS[INDEX]] == []


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.name)
def test_every_link_leads_to_an_existing_page_and_heading(page: Path) -> None:
    wrong = []
    for link in re.findall(r"\]\(([^)\s]+)\)", FENCED.sub("", TEXTS[page])):
        if link.startswith("http"):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name) if name else page
        if not target.exists() or (anchor and anchor not in anchors(target.read_text("utf-8"))):
            wrong.append(link)
    assert wrong == []


def test_citations_and_list_of_references_agree() -> None:
    known = set(re.findall(r"^- \*\*\[(\w+)\]\*\*", TEXTS[THEORY / "references.md"], re.MULTILINE))
    cited = {
        key
        for text in TEXTS.values()
        for key in re.findall(r"\[([A-Z]\w+\d{2,4})\]\(references\.md\)", text)
    }
    assert sorted(cited - known) == []
    assert sorted(known - cited) == []


@pytest.mark.parametrize(
    "page", [page for page in PAGES if EXAMPLE.search(TEXTS[page])], ids=lambda page: page.name
)
def test_examples_of_a_theory_page_give_the_printed_output(page: Path) -> None:
    source = "\n".join(EXAMPLE.findall(TEXTS[page]))
    example = doctest.DocTestParser().get_doctest(source, {}, page.name, str(page), 0)
    report: list[str] = []
    failed, tried = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(
        example, out=report.append
    )
    assert tried > 0
    assert failed == 0, "".join(report)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_code_that_a_page_names_exists(page: Path) -> None:
    for line in re.findall(r"Code: .*?(?=; |\. |\.$|\n\n)", TEXTS[page], re.MULTILINE | re.DOTALL):
        named = re.findall(r"`([^`]+)`", line)
        assert named, line
        assert [n for n in named if not (ROOT / "src" / "loopcal" / n).exists()] == []
