# SPDX-License-Identifier: Apache-2.0
"""Check the built site: every link leads somewhere, and no page loads anything from the network.

python -m tools.check_site build/site            links and files that pages load
python -m tools.check_site build/site --external also list the links that lead out of the site
python -m tools.check_site build/site --browser  also search it in Chromium, from disk

Without Chromium, --browser does nothing, and with LOOPCAL_STRICT=1 it fails.
"""

import argparse
import os
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from loopcal.documents import find_browser, is_root

LOADS = {("img", "src"), ("script", "src"), ("link", "href"), ("iframe", "src"), ("source", "src")}
"""Attributes whose target a browser loads without being asked."""

SEARCHES = {"hexapod": "Hexapod", "hold-out": "calibrate", "auto": "Files"}
"""Words to search for, and a word of a result."""


@dataclass
class Page(HTMLParser):
    """The anchors of an HTML page, and what it links: pairs (attribute, target)."""

    anchors: set[str] = field(default_factory=set)
    links: list[tuple[tuple[str, str], str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the anchor of an element, and its links."""
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            elif name in ("href", "src") and value:
                self.links.append(((tag, name), value))


def read_site(site: Path) -> dict[Path, Page]:
    """Return the pages of a site."""
    pages = {}
    for path in sorted(site.rglob("*.html")):
        pages[path] = Page()
        pages[path].feed(path.read_text("utf-8"))
    return pages


def list_problems(site: Path, pages: dict[Path, Page]) -> Iterator[str]:
    """Return a sentence for each link that leads nowhere, and each file from the network."""
    for path, page in pages.items():
        name = path.relative_to(site)
        for attribute, link in page.links:
            target = urlsplit(link)
            if target.scheme == "data":
                continue
            if target.scheme or target.netloc:
                if attribute in LOADS:
                    yield f"{name}: loads {link} from the network"
                continue
            file = (path.parent / unquote(target.path)).resolve() if target.path else path
            if not file.is_file():
                yield f"{name}: {link} leads to no file"
            elif target.fragment and file.suffix == ".html":
                anchor = unquote(target.fragment)
                if anchor not in pages[file].anchors:
                    yield f"{name}: {link} leads to no anchor"


def list_external_links(site: Path, pages: dict[Path, Page]) -> dict[str, list[str]]:
    """Return the pages that link each address outside of the site."""
    result: dict[str, list[str]] = defaultdict(list)
    for path, page in pages.items():
        for _, link in page.links:
            if urlsplit(link).scheme in ("http", "https"):
                result[link].append(str(path.relative_to(site)))
    return dict(sorted(result.items()))


def search_in_browser(site: Path) -> Iterator[str]:
    """Return a sentence for each search that fails in Chromium, and for each error or request."""
    executable = find_browser()
    if executable is None:
        if os.environ.get("LOOPCAL_STRICT"):
            yield "Chromium is not installed, so that the search was not tried"
        return
    from playwright.sync_api import TimeoutError as NotFound
    from playwright.sync_api import sync_playwright

    requests: list[str] = []
    errors: list[str] = []
    with sync_playwright() as program:
        browser = program.chromium.launch(
            executable_path=executable, args=["--no-sandbox"] * is_root()
        )
        page = browser.new_page()
        page.on("request", lambda request: requests.append(request.url))
        page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        for words, expected in SEARCHES.items():
            page.goto(f"{site.resolve().as_uri()}/search.html?q={words}")
            result = page.locator("#search-results li", has_text=expected).first
            try:  # the page adds its results one by one
                result.wait_for()
            except NotFound:
                yield f"searching for {words}: no result with {expected}"
        page.goto(f"{site.resolve().as_uri()}/index.html")
        page.wait_for_selector("text=Your machine in six steps >> visible=true")
        browser.close()
    yield from (f"the browser asked for {url}" for url in requests if not url.startswith("file:"))
    yield from (f"the browser reports: {error}" for error in errors)


def main() -> int:
    """Print every problem; exit 1 when there is one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("site", type=Path)
    parser.add_argument("--external", action="store_true")
    parser.add_argument("--browser", action="store_true")
    options = parser.parse_args()
    pages = read_site(options.site.resolve())
    problems = [*list_problems(options.site.resolve(), pages)]
    if options.browser:
        problems += search_in_browser(options.site)
    if options.external:
        for link, names in list_external_links(options.site.resolve(), pages).items():
            print(f"{link}  ({names[0]}{' and others' if len(names) > 1 else ''})")
    links = sum(len(page.links) for page in pages.values())
    print("\n".join(problems) or f"site: {len(pages)} pages, {links} links, all of them lead on")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
