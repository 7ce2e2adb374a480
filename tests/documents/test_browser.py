# SPDX-License-Identifier: Apache-2.0
"""The report in Chromium: no requests, no errors, accessible, at most 9 pages, complete as it is.

These tests need Chromium, which `.ci/run` installs, and the packages of the extra `test`.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.documents import find_browser, is_root

BROWSER = find_browser()
playwright = pytest.importorskip("playwright.sync_api")
axe = pytest.importorskip("axe_playwright_python")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="Chromium is not installed"),
]

MOST_PAGES = 9

WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Options with which Chromium computes WebGL without a graphics card."""


@pytest.fixture(scope="module")
def program() -> Iterator[Any]:
    with playwright.sync_playwright() as started:
        yield started


def launch(program: Any, *options: str) -> Any:
    """Return a started Chromium."""
    options += ("--no-sandbox",) * is_root()
    return program.chromium.launch(executable_path=BROWSER, args=list(options))


@pytest.fixture(scope="module")
def browser(program) -> Iterator[Any]:
    started = launch(program, *WEBGL)
    yield started
    started.close()


def count_pages(pdf: bytes) -> int:
    return len(re.findall(rb"/Type\s*/Page\b", pdf))


def open_view(tab: Any) -> Any:
    """Return the figure of the 3-D view, which opens when it is near the screen."""
    tab.locator("figure.scene").scroll_into_view_if_needed()
    tab.wait_for_selector("figure.live canvas")
    return tab.locator("figure.live")


def test_page_opens_without_requests_errors_and_javascript(browser, page) -> None:
    context = browser.new_context(java_script_enabled=False, offline=True)
    tab, logged, asked = context.new_page(), [], []
    tab.on("console", lambda message: logged.append(message.text))
    tab.on("pageerror", lambda error: logged.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(page.as_uri())
    assert asked == [page.as_uri()]
    assert logged == []
    assert tab.locator("h2").count() == 12
    assert tab.locator("figure > svg").count() == 8
    for i in range(7):
        box = tab.locator("figure > svg").nth(i).bounding_box()
        assert box["width"] > 300.0
        assert box["height"] > 150.0
    assert tab.locator("main p").first.is_visible()
    context.close()


def test_page_of_a_comparison_opens_without_requests_and_passes_axe(browser, run, tmp_path) -> None:
    second = tmp_path / "second"
    shutil.copytree(run.path, second)
    comparison = lc.compare_runs([run, lc.load_run(second)])
    written = lc.save_comparison(comparison, tmp_path / "comparison.html")
    context = browser.new_context(
        offline=True, bypass_csp=True, viewport={"width": 420, "height": 800}
    )
    tab, logged, asked = context.new_page(), [], []
    tab.on("console", lambda message: logged.append(message.text))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(written.as_uri())
    assert (asked, logged) == ([written.as_uri()], [])
    assert tab.evaluate("document.documentElement.scrollWidth") <= 420
    tab.evaluate((Path(axe.__file__).parent / "axe.min.js").read_text("utf-8"))
    answer = tab.evaluate(f"axe.run({EVERY_RULE})")
    assert [(v["id"], v["nodes"][0]["html"]) for v in answer["violations"]] == []
    context.close()


def test_colors_of_figures_and_page_survive_the_policy(browser, page) -> None:
    context = browser.new_context(offline=True, color_scheme="dark")
    tab = context.new_page()
    tab.goto(page.as_uri())
    paper = tab.eval_on_selector("body", "e => getComputedStyle(e).backgroundColor")
    assert paper == "rgb(21, 24, 28)"
    colors = tab.eval_on_selector_all(
        "figure > svg [stroke]", "all => all.map(e => getComputedStyle(e).stroke)"
    )
    assert len(set(colors)) > 5
    context.close()


EVERY_RULE = "{exclude: [['svg > g']]}, {resultTypes: ['violations']}"
CONTRAST = "{exclude: [['svg']]}, {resultTypes: ['violations'], runOnly: ['color-contrast']}"
"""Arguments of axe. Its rules concern the name and the role of a figure, not its thousand lines;
figures have the same colors in both schemes.
"""


@pytest.fixture
def written_page(request, tmp_path, monkeypatch) -> Path:
    """Return the report of a robot; axe needs a time that grows with the rows of the tables."""
    if request.param == "hexapod-42":
        return request.getfixturevalue("page")
    monkeypatch.chdir(tmp_path)
    words = f"simulate {request.param} -o data.csv --kind position --draw 12 --draw-errors"
    assert main(words.split()) == 0
    words = f"calibrate {request.param} data.csv -o run --hold-out 0.25"
    assert main(words.split()) in (0, 2)
    return lc.save_report(lc.load_run("run"), tmp_path / "report.html")


@pytest.mark.parametrize(
    "written_page",
    ["five-bar", pytest.param("hexapod-42", marks=pytest.mark.evidence)],
    indirect=True,
)
def test_page_passes_axe_in_both_color_schemes(browser, written_page) -> None:
    context = browser.new_context(offline=True, color_scheme="light", bypass_csp=True)
    tab = context.new_page()
    tab.goto(written_page.as_uri())
    open_view(tab)
    tab.evaluate((Path(axe.__file__).parent / "axe.min.js").read_text("utf-8"))
    for scheme, rules in (("light", EVERY_RULE), ("dark", CONTRAST)):
        tab.emulate_media(color_scheme=scheme)
        answer = tab.evaluate(f"axe.run({rules})")
        assert [(v["id"], v["nodes"][0]["html"]) for v in answer["violations"]] == []
    context.close()


def test_result_table_fits_a_phone(browser, page) -> None:
    tab = browser.new_page(viewport={"width": 390, "height": 844})
    tab.goto(page.as_uri())
    widths = "e => [e.scrollWidth, e.clientWidth]"
    for selector in ("html", "[aria-labelledby='summary'] .table"):
        needed, given = tab.locator(selector).evaluate(widths)
        assert needed <= given, selector
    tab.close()


def test_page_can_be_used_with_the_keyboard_alone(browser, page) -> None:
    context = browser.new_context(offline=True)
    tab = context.new_page()
    tab.goto(page.as_uri())
    tab.keyboard.press("Tab")
    assert tab.evaluate("document.activeElement.textContent") == "Go to the content"
    tab.keyboard.press("Enter")
    assert tab.evaluate("location.hash") == "#content"
    tab.evaluate("document.querySelector('nav a').focus()")
    assert tab.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    tab.keyboard.press("Tab")
    tab.keyboard.press("Enter")
    assert tab.evaluate("location.hash") == "#verdict"
    wide = "[...document.querySelectorAll('main *')].filter(e => e.scrollWidth > e.clientWidth + 1"
    wide += " && getComputedStyle(e).overflowX === 'auto' && e.tabIndex < 0).length"
    assert tab.evaluate(wide) == 0
    context.close()


def test_view_opens_without_requests_and_errors_and_turns_by_keys(browser, page) -> None:
    context = browser.new_context(offline=True, reduced_motion="reduce")
    tab, logged, asked = context.new_page(), [], []
    tab.on("console", lambda message: logged.append(message.text))
    tab.on("pageerror", lambda error: logged.append(str(error)))
    tab.on("request", lambda request: asked.append(request.url))
    tab.goto(page.as_uri())
    figure = open_view(tab)
    assert not figure.locator("> svg").is_visible()
    canvas, said = figure.locator("canvas"), figure.locator("output")
    assert "hexapod-42" in canvas.get_attribute("aria-label")
    legend = " ".join(figure.locator(".legend li").all_inner_texts())
    assert re.search(r"before calibration, [0-9]+ times magnified.* mm", legend)
    first = figure.locator(".names").inner_html()
    canvas.focus()
    tab.keyboard.press("ArrowLeft")
    turned = wait_for_change(figure, first)
    frames = "new Promise(done => {let n = 0; const ask = window.requestAnimationFrame;"
    frames += (
        "window.requestAnimationFrame = f => {n++; return ask(f)}; setTimeout(() => done(n), 300)})"
    )
    assert tab.evaluate(frames) == 0  # nothing moves by itself
    tab.keyboard.press("Home")
    assert wait_for_change(figure, turned) == first
    figure.get_by_label("Robot at pose").select_option(label="4")
    place = "x [-0-9.]+, y [-0-9.]+, z [-0-9.]+ mm"
    text = rf"Pose 4: tool at {place}; error before calibration [0-9.]+ mm\."
    assert re.fullmatch(text, said.inner_text())
    figure.get_by_label("errors", exact=True).uncheck()
    tab.emulate_media(media="print")
    assert tab.get_by_text("simultaneously at all points").is_visible()
    assert figure.locator("> svg").is_visible()
    assert not canvas.is_visible()
    assert count_pages(tab.pdf(prefer_css_page_size=True)) <= MOST_PAGES
    assert asked == [page.as_uri()]
    assert logged == []
    context.close()


def wait_for_change(figure: Any, before: str) -> str:
    """Return the names with their places after the next drawing."""
    names = figure.locator(".names")
    for _ in range(100):
        if (after := names.inner_html()) != before:
            return after
        figure.page.wait_for_timeout(20)
    raise AssertionError("the view was not drawn again")


def test_sliders_change_errors_and_the_second_robot(browser, page) -> None:
    tab, logged = browser.new_page(), []
    tab.on("pageerror", lambda error: logged.append(str(error)))
    tab.goto(page.as_uri())
    figure = open_view(tab)
    errors, motion = (figure.locator("input[type=range]").nth(k) for k in (0, 1))
    assert figure.get_by_text("x 200", exact=True).is_visible()
    errors.fill("1")
    assert figure.get_by_text("x 2000", exact=True).is_visible()
    play = figure.get_by_text("play", exact=True)
    assert not motion.is_visible()
    figure.get_by_label("Second robot").select_option("before calibration")
    assert motion.is_visible()
    assert figure.get_by_text("The second robot is the geometry before").is_visible()
    play.click()
    tab.wait_for_function("i => Number(i.value) < 0.9", arg=motion.element_handle())
    figure.get_by_text("stop", exact=True).click()
    still = motion.input_value()
    tab.wait_for_timeout(200)
    assert motion.input_value() == still
    assert logged == []


def test_picture_stays_where_a_browser_has_no_webgl(program, page) -> None:
    started = launch(program, "--disable-3d-apis")
    tab, logged = started.new_page(), []
    tab.on("console", lambda message: logged.append(message.text))
    tab.on("pageerror", lambda error: logged.append(str(error)))
    tab.goto(page.as_uri())
    tab.locator("figure.scene").scroll_into_view_if_needed()
    tab.wait_for_timeout(200)
    assert tab.locator("figure.scene > svg").is_visible()
    assert tab.locator("canvas").count() == 0
    assert logged == []
    started.close()


@pytest.mark.usefixtures("do_not_draw")
def test_option_pdf_prints_at_most_9_pages(run, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["report", str(run.path), "--pdf"]) == 0
    assert capsys.readouterr().out == "Written to report.html, report.json, report.pdf\n"
    content = Path("report.pdf").read_bytes()
    assert 1 < count_pages(content) <= MOST_PAGES
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["report.html", "report.json", "report.pdf"]
