# SPDX-License-Identifier: Apache-2.0
"""The page of `loopcal app` (docs/app.md) in Chromium: by keyboard, on a phone, in two tabs,
without the server.

These tests need Chromium, which `.ci/run` installs, and the packages of the extra `test`.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from loopcal.cli.entry_point import main
from loopcal.documents import find_browser, is_root
from loopcal.findings import report_finding
from tests.app.conftest import Server

BROWSER = find_browser()
playwright = pytest.importorskip("playwright.sync_api")
axe = pytest.importorskip("axe_playwright_python")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="Chromium is not installed"),
]
AXE = (Path(axe.__file__).parent / "axe.min.js").read_text("utf-8")
DONE = 120_000  # ms; both processors may be busy with other tests


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as program:
        started = program.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox"] * is_root()
        )
        yield started
        started.close()


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Measurements of a five-bar with a wrong row, and a plan with its filled-in sheet."""
    folder = tmp_path_factory.mktemp("made")
    words = ["simulate", "five-bar", "-o", str(folder / "good.csv"), "--kind", "position"]
    assert main([*words, "--draw", "20", "--draw-errors"]) == 0
    lines = (folder / "good.csv").read_text().splitlines()
    cells = lines[-3].split(",")
    cells[-1] = f"{float(cells[-1]) + 5.0:.6f}"
    lines[-3] = ",".join(cells)
    (folder / "data.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[Server]:
    """A server for the tests of this module that change what it has in turn."""
    started = Server(tmp_path_factory.mktemp("server"))
    yield started
    started.process.kill()
    started.process.communicate()


@pytest.fixture
def visit(browser) -> Iterator[Any]:
    """Open the page of a server; nothing is logged but what the test expects."""
    contexts = []

    def begin(server: Server, width: int = 1200, **settings: Any) -> Any:
        size = {"width": width, "height": 900}
        context = browser.new_context(viewport=size, bypass_csp=False, **settings)
        contexts.append(context)
        tab = context.new_page()
        tab.set_default_timeout(DONE)
        tab.errors = []
        tab.on("pageerror", lambda error: tab.errors.append(str(error)))
        tab.goto(server.address)
        tab.wait_for_selector("#robot option:nth-child(9)", state="attached")
        return tab

    yield begin
    for context in contexts:
        assert all(tab.errors == [] for tab in context.pages)
        context.close()


def check(tab: Any, width: int) -> None:
    """Check that the page fits and that axe finds nothing; dark has other colors and no more."""
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    tab.evaluate(f"() => {{ {AXE} }}")
    for scheme, rules in (("light", ""), ("dark", "runOnly: ['cat.color'], ")):
        tab.emulate_media(color_scheme=scheme)
        options = f"{{{rules}resultTypes: ['violations']}}"
        answer = tab.evaluate(f"axe.run({{exclude: ['iframe']}}, {options})")
        found = [(v["id"], v["nodes"][0]["html"]) for v in answer["violations"]]
        assert found == []


def walk_to(tab: Any, name: str) -> None:
    """Press Tab until a control of this name has the focus, which shows."""
    script = "e => e.ariaLabel || e.textContent.trim() || e.id"
    for _ in range(80):
        tab.keyboard.press("Tab")
        focused = tab.evaluate_handle("document.activeElement")
        if focused.evaluate(script) == name:
            assert focused.evaluate("e => getComputedStyle(e).outlineStyle") == "solid"
            return
    raise AssertionError(f"{name} is not reached")


def finish(tab: Any) -> None:
    tab.wait_for_selector("#calibrate:enabled")
    tab.wait_for_selector("#progress[hidden]", state="attached")


def begin(tab: Any, data: Path) -> None:
    """Give a page measurements of a five-bar."""
    tab.set_input_files("#choose", data)
    tab.wait_for_selector(f"#list b:text-is('{data.name}')")
    tab.select_option("#robot", "five-bar")
    finish(tab)


def stop_report(tab: Any) -> None:
    """Wait for the calibration alone."""
    tab.wait_for_selector("#doing:has-text('report')")
    tab.click("#stop")
    finish(tab)


def test_a_wrong_row_is_corrected_and_left_out_by_keyboard_alone(server, visit, made) -> None:
    tab = visit(server)
    check(tab, 1200)
    begin(tab, made / "data.csv")
    tab.focus("#choose")
    walk_to(tab, "Calibrate")
    tab.keyboard.press("Enter")
    stop_report(tab)
    tab.wait_for_selector("#result-title:focus")
    assert tab.locator("#verdict.failed").count() == 1
    assert "Not calibrated" in tab.inner_text("#verdict")
    worst = tab.locator("#tables tbody tr").first
    worst.locator("th", has_text="18").wait_for()  # the rows follow the verdict
    # leave it out
    tab.locator("#sorted").focus()
    walk_to(tab, "Use pose 18")
    tab.keyboard.press("Space")
    tab.wait_for_selector("#stale:not([hidden])")
    tab.locator("#choose").focus()
    walk_to(tab, "Calibrate")
    tab.keyboard.press("Enter")
    stop_report(tab)
    assert tab.locator("#verdict.failed").count() == 0
    assert tab.locator("#tables tr.out th").inner_text() == "18"
    out = server.ask("GET", "/result/run/result.json")[2]
    # use it again, corrected: what the command says of the good file
    tab.locator("#sorted").focus()
    walk_to(tab, "Use pose 18")
    tab.keyboard.press("Space")
    tab.wait_for_selector("#tables tr.out", state="detached")
    walk_to(tab, "Correct the row of pose 18")
    tab.keyboard.press("Enter")
    tab.wait_for_selector("dialog[open]")
    check(tab, 1200)
    right = (made / "good.csv").read_text().splitlines()[-3].split(",")[-1]
    field = tab.locator("#cells input").last
    field.focus()
    tab.keyboard.press("Control+A")
    tab.keyboard.type("5 mm")
    tab.keyboard.press("Enter")
    tab.wait_for_selector("#dialog-error:not(:empty)")
    assert "must be a number" in tab.inner_text("#dialog-error")
    tab.keyboard.press("Control+A")
    tab.keyboard.type(right)
    tab.keyboard.press("Enter")
    tab.wait_for_selector("dialog", state="hidden")
    assert server.ask("GET", "/data.csv")[2] == (made / "good.csv").read_bytes()
    tab.click("#calibrate")
    tab.wait_for_selector("#stale", state="hidden")
    finish(tab)
    assert tab.locator("#verdict.failed").count() == 0
    assert server.ask("GET", "/result/run/result.json")[2] != out
    with tab.expect_download() as downloaded:
        tab.click("text=Corrected robot file")
    assert downloaded.value.suggested_filename == "robot.yaml"
    assert (
        Path(downloaded.value.path()).read_bytes() == server.ask("GET", "/result/run/robot.yaml")[2]
    )


@pytest.mark.parametrize("width", [390, 820, 1200])
def test_a_result_fits_and_passes_axe(server, visit, made, width: int) -> None:
    tab = visit(server, width)
    if "result/run/robot.yaml" not in server.state["downloads"]:
        begin(tab, made / "good.csv")
        tab.click("#calibrate")
        tab.wait_for_selector("#result:not([hidden])")
    finish(tab)
    tab.wait_for_selector("#tables tbody tr")
    check(tab, width)
    report = tab.frame_locator("iframe")
    report.locator("h1").wait_for()
    assert "five-bar" in report.locator("h1").inner_text()


def test_two_tabs_show_the_same_and_a_reload_goes_on(server, visit, made) -> None:
    one, two = visit(server), visit(server, 390)
    begin(one, made / "good.csv")
    two.wait_for_selector("#list b:text-is('good.csv')")
    two.wait_for_selector("#calibrate:enabled")
    one.click("#calibrate")
    two.wait_for_selector("#progress:not([hidden])")
    children = server.list_children()
    for child in children:  # the work may be shorter than a reload
        child.suspend()
    two.reload()
    two.wait_for_selector("#progress:not([hidden])")
    assert two.locator("#calibrate").is_disabled()
    for child in children:
        child.resume()
    finish(one)
    finish(two)
    for tab in (one, two):
        tab.wait_for_selector("#tables tbody tr")
        assert tab.inner_text("#verdict") == one.inner_text("#verdict")
    two.click("[aria-label='Remove good.csv']")
    one.wait_for_selector("#result", state="hidden")


def test_stop_ends_the_work(server, visit, made) -> None:
    tab = visit(server)
    begin(tab, made / "good.csv")
    tab.click("#calibrate")
    tab.click("#stop")
    finish(tab)
    assert tab.locator("#result").is_hidden()
    assert server.list_children() == []


def test_wrong_files_get_a_sentence(server, visit, tmp_path) -> None:
    tab = visit(server)
    large, binary, text = (tmp_path / f"{name}.csv" for name in ("large", "binary", "text"))
    text.write_text("pose,q1 [mm]\n1,2\n")
    with large.open("wb") as file:
        file.truncate(100_000_000)
    binary.write_bytes(bytes(range(256)))
    tab.set_input_files("#choose", large)
    tab.wait_for_selector("#alert:not(:empty)")
    assert "at most 50 MB" in tab.inner_text("#alert")
    tab.set_input_files("#choose", binary)
    tab.wait_for_selector("#alert:has-text('binary.csv')")
    begin(tab, text)
    assert tab.inner_text("#alert") == ""
    tab.focus("#calibrate")
    tab.keyboard.press("Enter")
    tab.wait_for_selector("#messages:focus li")  # the focus follows the work
    assert "text.csv" in tab.inner_text("#messages")
    check(tab, 1200)
    tab.click("[aria-label='Remove text.csv']")
    tab.wait_for_selector("[aria-label='Remove text.csv']", state="detached")


def test_a_lost_connection_is_said_and_typed_values_stay(visit, start, tmp_path) -> None:
    server = start()
    tab = visit(server)
    tab.click("#planning summary")
    tab.fill("[name=sigma]", "7um")
    tab.context.set_offline(True)
    tab.click("#plan button")
    tab.wait_for_selector("#alert:not(:empty)")
    assert "does not answer" in tab.inner_text("#alert")
    tab.context.set_offline(False)
    tab.wait_for_selector("#alert:empty", state="attached")  # when the server is heard again
    assert tab.input_value("[name=sigma]") == "7um"
    server.end()
    tab.wait_for_selector("#alert:not(:empty)")
    check(tab, 1200)
    tab.select_option("#robot", "five-bar")
    assert "does not answer" in tab.inner_text("#alert")


def test_the_page_without_its_token_says_what_to_open(server, browser) -> None:
    tab = browser.new_page()
    tab.goto(server.root)
    assert tab.inner_text("body") == str(report_finding("app.denied"))
    tab.goto(server.address)
    tab.wait_for_selector("#robot option:nth-child(9)", state="attached")
    assert tab.url == server.root  # the token is in no history and in no picture of the screen
    tab.close()


def test_the_companion_leads_to_a_calibration(visit, start, tmp_path) -> None:
    kept = tmp_path / "kept"
    server = start("--keep", str(kept))
    tab = visit(server, 820)
    tab.select_option("#robot", "five-bar")
    tab.click("#planning summary")
    tab.fill("[name=sigma]", "20um")
    tab.fill("[name=poses]", "5")
    tab.click("#plan button")
    tab.click("#measure:enabled")
    tab.wait_for_selector("#companion:not([hidden])")
    filled = tmp_path / "filled.csv"
    words = ["simulate", "five-bar", "--fill", str(kept / "plan" / "measurements.csv")]
    assert main([*words, "-o", str(filled), "--draw-errors"]) == 0
    rows = {
        row["pose"]: row
        for row in csv.DictReader(
            line for line in filled.read_text().splitlines() if line[0] != "#"
        )
    }
    names = tab.locator("#row label").all_inner_texts()
    count, wrong = 0, 4
    while tab.inner_text("#pose-title").startswith("Pose"):
        row = rows[tab.inner_text("#pose-title").removeprefix("Pose ")]
        values = [float(row[name]) for name in names]
        values[0] += 3.0 * (count == wrong) + 1e-4 * count  # noise, as repeats have
        for value in values:  # the first field has the focus
            if value is values[0]:
                tab.wait_for_selector("[data-key='field 0']:focus")
            tab.keyboard.type(f"{value:.5f}")
            tab.keyboard.press("Tab" if value is not values[-1] else "Enter")
        count += 1
        tab.wait_for_selector(f"#visits tbody tr:nth-child({count})")
        tab.wait_for_selector("#row:not([aria-busy=true])", state="attached")
        if count == wrong + 1:
            tab.wait_for_selector("#said.doubt")
            assert "does not fit" in tab.inner_text("#said")
            check(tab, 820)
            tab.reload()
            tab.wait_for_selector("#said.doubt")
            tab.click("text=Take back")
            count -= 1
            wrong = -1
            tab.wait_for_selector(f"#visits tbody tr:nth-child({count + 1})", state="detached")
            tab.focus("[data-key='field 0']")
        assert count < 40
    tab.set_viewport_size({"width": 390, "height": 844})
    check(tab, 390)
    server.end()
    again = start("--keep", str(kept))  # goes on where it ended
    tab.goto(again.address)
    tab.click("#measure:enabled")
    tab.wait_for_selector("#companion:not([hidden])")
    assert tab.inner_text("#pose-title") == "All poses are measured"
    assert tab.locator("#visits tbody tr").count() == count
    tab.click("#finish")
    tab.click("#calibrate:enabled")
    stop_report(tab)
    tab.wait_for_selector("#result:not([hidden])")
    assert re.search(r"five-bar, \d+ parameters", tab.inner_text("#verdict"))
