# SPDX-License-Identifier: Apache-2.0
"""The documentation site: its contents, its pages of the code, and the check of its links.

`make site` builds it with warnings as errors and searches it in Chromium; nothing is built here.
"""

import inspect
import re
from types import SimpleNamespace

import click
import pytest
from docutils.core import publish_string

import loopcal
from loopcal.cli.entry_point import command_line
from tools import check_site, site_commands, site_docstrings, site_pages, thumbnails
from tools.api_reference import SECTIONS

INDEX = """\
# Documentation

| page | content |
|---|---|
| [![six](six.png)](six.md) | |
| [one](one.md), [two](two.md) | see also [three](three.md) |
| - | [four](four.md) |

## Questions

- [all questions](questions/README.md)

## Gallery

- [Examples](gallery/GALLERY_HEADER.rst)

A paragraph that links [no page of its own](five.md).
"""


def read_source(page: str, text: str) -> str:
    """Return the text that Sphinx reads for a page."""
    source = [text]
    site_pages.add_contents(None, page, source)
    return source[0]


def test_links_of_an_index_become_its_contents_in_their_order() -> None:
    text = read_source("docs/README", INDEX)
    contents = [block.split("```")[0].split() for block in text.split("```{toctree}")[1:]]
    assert contents == [
        [":hidden:", "one.md", "two.md", "four.md"],
        [":hidden:", ":caption:", "Questions", "questions/README.md"],
        [":hidden:", ":caption:", "Gallery", "generated/gallery/index.rst"],
    ]


def test_each_example_has_its_thumbnail_and_no_other_exists(root) -> None:
    """`python -m tools.thumbnails` draws them."""
    folder = root / "docs" / "pictures" / "thumbnails"
    names = {path.stem.removeprefix("plot_") for path in (root / "docs/gallery").glob("plot_*.py")}
    assert {path.stem for path in folder.glob("*.png")} == names
    assert {name.removeprefix("plot_") for name in thumbnails.DRAWINGS} == names
    for name in names:
        text = (root / "docs" / "gallery" / f"plot_{name}.py").read_text("utf-8")
        path = f"docs/pictures/thumbnails/{name}.png"
        assert f'# sphinx_gallery_thumbnail_path = "{path}"' in text


def test_page_that_is_no_index_stays_as_it_is() -> None:
    assert read_source("docs/robots", INDEX) == INDEX


def test_each_page_of_docs_is_in_an_index(root) -> None:
    docs = root / "docs"
    listed = set()
    for index in docs.rglob("README.md"):
        entries = site_pages.list_entries(index.read_text("utf-8"))
        listed |= {(index.parent / entry).resolve() for entry in entries}
    pages = {path for path in docs.rglob("*.md") if "generated" not in path.parts}
    assert pages - listed == {docs / "README.md"}


def test_addresses_of_former_pages_lead_to_present_ones(root, tmp_path) -> None:
    app = SimpleNamespace(builder=SimpleNamespace(name="html"), outdir=tmp_path)
    site_pages.write_redirects(app, None)
    for old, new in site_pages.MOVED.items():
        page, _, section = new.partition("#")
        assert not (root / "docs" / f"{old}.md").exists()
        text = (root / "docs" / f"{page}.md").read_text("utf-8")
        headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
        anchors = {re.sub(r"[^\w -]", "", line.lower()).replace(" ", "-") for line in headings}
        assert not section or section in anchors, new
        written = tmp_path / "docs" / f"{old}.html"
        (link,) = re.findall(r'href="([^"#]+)', written.read_text("utf-8"))
        assert (written.parent / link).resolve() == tmp_path / "docs" / f"{page}.html"


def test_each_public_name_has_a_page_and_a_link_to_it(root) -> None:
    text = read_source("docs/api", (root / "docs" / "api.md").read_text("utf-8"))
    for package in SECTIONS:
        assert f"generated/api/{site_pages.name_page(package)}.rst" in text
    for name in set(loopcal.__all__) - {"__version__"}:
        assert f"{{py:obj}}`{name} <loopcal.{name}>`" in text


def test_each_command_has_a_page_with_its_options() -> None:
    pages = dict(site_commands.format_command_pages())
    assert list(pages) == command_line.list_commands(click.Context(command_line))
    assert ".. option:: --hold-out SHARE" in pages["calibrate"]
    assert "   loopcal calibrate hexapod-42 measurements.csv -o run --hold-out 0.25" in (
        pages["calibrate"].splitlines()
    )
    assert "loopcal study run\n-----------------\n" in pages["study"]


DOCSTRING = """\
Do it, with |z|^2 and `a*b`.

Parameters
----------
target : (n, 4, 4) poses
    in base. seed : of the draws.
a, b : two *numbers*.

Returns
-------
A sum; never an error.

Raises
------
DataError
    Too few.
FileError : no file.
"""


def test_docstring_becomes_definitions() -> None:
    lines = site_docstrings.convert_docstring(DOCSTRING.splitlines())
    assert [line for line in lines if line] == [
        r"Do it, with \|z\|^2 and `a*b`.",
        ".. rubric:: Parameters",
        "``target``",
        "    (n, 4, 4) poses",
        "    in base.",
        "``seed``",
        "    of the draws.",
        "``a, b``",
        r"    two \*numbers\*.",
        ".. rubric:: Returns",
        "A sum; never an error.",
        ".. rubric:: Raises",
        ":py:exc:`DataError`",
        "    Too few.",
        ":py:exc:`FileError`",
        "    no file.",
    ]


@pytest.mark.parametrize("name", sorted(set(loopcal.__all__) - {"__version__", "KINDS"}))
def test_docstring_of_a_public_name_is_valid_markup(name) -> None:
    lines = site_docstrings.convert_docstring(
        (inspect.getdoc(getattr(loopcal, name)) or "").split("\n")
    )
    text = ".. default-role:: literal\n\n" + "\n".join(lines).replace(":py:exc:", "")
    settings = {"report_level": 2, "halt_level": 2}
    assert publish_string(text, settings_overrides=settings)


def write_site(folder, body: str):
    """Write a site of two pages, and return its problems."""
    (folder / "a.html").write_text(f"<html><body id='top'>{body}</body></html>")
    (folder / "b.html").write_text("<p id='part'>text</p>")
    pages = check_site.read_site(folder)
    return list(check_site.list_problems(folder, pages))


def test_links_that_lead_on_are_no_problem(tmp_path) -> None:
    body = "<a href='b.html#part'></a><a href='#top'></a><a href='https://example.org'></a>"
    assert write_site(tmp_path, body) == []


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ("<a href='c.html'>", "a.html: c.html leads to no file"),
        ("<a href='b.html#other'>", "a.html: b.html#other leads to no anchor"),
        ("<img src='b.png'>", "a.html: b.png leads to no file"),
        (
            "<script src='https://example.org/x.js'></script>",
            "a.html: loads https://example.org/x.js from the network",
        ),
        ("<link href='//example.org/x.css'>", "a.html: loads //example.org/x.css from the network"),
    ],
)
def test_wrong_link_is_reported(body, problem, tmp_path) -> None:
    assert write_site(tmp_path, body) == [problem]
