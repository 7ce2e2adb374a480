# SPDX-License-Identifier: Apache-2.0
"""What the site has beside the Markdown pages of docs/: tables of contents, and pages of the code.

* A README.md below docs/ is an index. The pages that its tables and lists link become its table of
  contents, so that the order of pages is stated once, in a form that every reader of the repository
  sees.
* The addresses of former pages lead to the present ones (docs/site/moved.toml).
* Each section of docs/api.md has a page with the docstrings of its names, and each command of
  docs/commands.md has one with its help. They are written into docs/generated, which git ignores.
"""

import re
import tomllib
from itertools import chain
from pathlib import Path
from typing import Any

from pygments.lexers.special import TextLexer

from tools.api_reference import SECTIONS, describe_name, list_names
from tools.site_commands import format_command_pages
from tools.site_docstrings import convert_docstring

ROOT = Path(__file__).resolve().parent.parent
GENERATED = ROOT / "docs" / "generated"

MOVED: dict[str, str] = tomllib.loads((ROOT / "docs/site/moved.toml").read_text("utf-8"))
"""Former page of docs/ -> present page, or a section of it."""

LINE = re.compile(r"^(?:\||[*-]) .*$", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#]+\.(?:md|rst))\)")
"""A line of a table or of a list, and a link to a page."""

API_ROW = re.compile(r"^\| `\w+`(?:, `\w+`)* \|", re.MULTILINE)
API_NAME = re.compile(r"`(\w+)`")
COMMAND_ROW = re.compile(r"^\| (`loopcal ([\w-]+)[^`]*`) \|", re.MULTILINE)
"""A name in a table of docs/api.md, and a command in the table of docs/commands.md."""


def setup(app: Any) -> dict[str, bool]:
    """Connect the functions of this module with a build."""
    app.add_lexer("csv", TextLexer)
    app.connect("builder-inited", write_pages_of_the_code)
    app.connect("source-read", add_contents)
    app.connect("autodoc-process-docstring", rewrite_docstring)
    app.connect("build-finished", write_redirects)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def add_contents(app: Any, page: str, source: list[str]) -> None:
    """Append to an index its table of contents, and link what has a page in docs/generated."""
    del app
    text = source[0]
    if page == "docs/api":
        text = API_ROW.sub(lambda row: API_NAME.sub(r"{py:obj}`\1 <loopcal.\1>`", row[0]), text)
        text += format_contents(
            "", [f"generated/api/{name}.rst" for name in map(name_page, SECTIONS)]
        )
    elif page == "docs/commands":
        names = dict.fromkeys(match[2] for match in COMMAND_ROW.finditer(text))
        text = COMMAND_ROW.sub(r"| [\1](generated/commands/\2.rst) |", text)
        text += format_contents("", [f"generated/commands/{name}.rst" for name in names])
    elif page.startswith("docs/") and page.endswith("/README"):
        text = text.replace("gallery/GALLERY_HEADER.rst", "generated/gallery/index.rst")
        parts = re.split(r"^## (.*)\n", text, flags=re.MULTILINE)
        for caption, part in zip(["", *parts[1::2]], parts[::2], strict=True):
            text += format_contents(caption, list_entries(part))
    source[0] = text


def write_redirects(app: Any, exception: Exception | None) -> None:
    """Write pages at the addresses of former ones, which lead to the present ones."""
    if exception or app.builder.name != "html":
        return
    for old, new in MOVED.items():
        page, mark, section = new.partition("#")
        link = "../" * old.count("/") + f"{page}.html{mark}{section}"
        text = f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>loopcal</title>
<meta http-equiv="refresh" content="0; url={link}">
<a href="{link}">This page has moved.</a>
</html>
"""
        write_if_changed(Path(app.outdir, "docs", f"{old}.html"), text)


def rewrite_docstring(
    app: Any, what: str, name: str, value: object, options: object, lines: list[str]
) -> None:
    """Replace the lines of a docstring by the markup of docutils."""
    del app, what, name, value, options
    lines[:] = convert_docstring(lines)


def list_entries(text: str) -> list[str]:
    """Return the pages that a text links in the lines of its lists, and in those of its tables in
    the first cell with a link; each once. Lines with pictures lead to pages that are listed, too.
    """
    pages = []
    for line in (line for line in LINE.findall(text) if "![" not in line):
        cells = (LINK.findall(cell) for cell in line.split("|"))
        pages += next((links for links in cells if links), [])
    return list(dict.fromkeys(pages))


def format_contents(caption: str, files: list[str]) -> str:
    """Return a table of contents that only the side bar shows."""
    if not files:
        return ""
    options = [":hidden:", *([f":caption: {caption}"] if caption else [])]
    return "\n".join(["", "```{toctree}", *options, "", *files, "```", ""])


def write_pages_of_the_code(app: Any) -> None:
    """Write docs/generated: a page for each section of the API, and one for each command."""
    del app
    pages = {
        GENERATED / "api" / f"{name_page(package)}.rst": format_api_page(
            heading, list_names()[package]
        )
        for package, heading in SECTIONS.items()
    }
    for name, text in format_command_pages():
        pages[GENERATED / "commands" / f"{name}.rst"] = text
    for path in GENERATED.rglob("*.rst"):
        example = ROOT / "docs" / "gallery" / f"{path.stem}.py"
        if path not in pages and path.stem != "index" and not example.exists():
            path.unlink()  # of a section, a command or an example that no longer exists
    for path, text in pages.items():
        write_if_changed(path, text)


def name_page(package: str) -> str:
    """Return the name of the page of a section of the API."""
    return package.removeprefix("loopcal.")


def format_api_page(heading: str, names: list[str]) -> str:
    """Return the page of some public names with their docstrings."""
    title = [heading, "=" * len(heading), "", ".. currentmodule:: loopcal", ""]
    return "\n".join([*title, *chain.from_iterable(map(format_directive, names)), ""])


def format_directive(name: str) -> list[str]:
    """Return the lines that document one public name."""
    import loopcal

    value = getattr(loopcal, name)
    if isinstance(value, type):
        return [f".. autoclass:: {name}", "   :members:", ""]
    if not callable(value):
        return [f".. data:: {name}", "", f"   {describe_name(name)}", ""]
    return [f".. autofunction:: {name}", ""]


def write_if_changed(path: Path, text: str) -> None:
    """Write a file, unless it has this text: Sphinx reads again what is newer."""
    if not path.exists() or path.read_text("utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
