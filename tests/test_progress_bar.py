# SPDX-License-Identifier: Apache-2.0
"""The progress bar draws a line in a terminal, and nothing elsewhere."""

import io
import sys
from types import SimpleNamespace

import pytest

import loopcal as lc


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_bar_of_a_terminal_is_one_line_that_ends_with_the_work(monkeypatch) -> None:
    stream = Terminal()
    monkeypatch.setattr("sys.stderr", stream)
    bar = lc.ProgressBar()
    for done in range(101):
        bar(done, 100, "re\x1bsamples")
    text = stream.getvalue()
    assert text.startswith("\rre\\x1bsamples: 0 of 100")
    assert text.endswith(": 100 of 100\n")
    assert text.count("\r") < 20  # not one for each step


def test_bar_is_silent_without_terminal_and_notebook(capsys) -> None:
    bar = lc.ProgressBar()
    bar(1, 2, "steps")
    bar(2, 2, "steps")
    assert capsys.readouterr() == ("", "")


def test_two_pieces_of_work_have_a_line_each(monkeypatch) -> None:
    stream = Terminal()
    monkeypatch.setattr("sys.stderr", stream)
    bar = lc.ProgressBar()
    bar(2, 2, "folds")
    bar(3, 3, "resamples")
    assert stream.getvalue().splitlines() == ["", "folds: 2 of 2", "", "resamples: 3 of 3"]


def test_two_pieces_of_work_of_equal_size_have_a_bar_each_in_a_notebook(monkeypatch) -> None:
    shown: list[list[str]] = []

    def display(content: str, display_id: bool) -> SimpleNamespace:
        shown.append([content])
        return SimpleNamespace(update=shown[-1].append)

    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    drawing = SimpleNamespace(HTML=str, display=display)
    monkeypatch.setitem(sys.modules, "IPython.display", drawing)
    bar = lc.ProgressBar()
    for what in ("folds", "resamples"):
        for done in (0, 1, 2):
            bar(done, 2, what)
    assert [len(updates) for updates in shown] == [2, 2]  # 1 of 2 comes too early to be drawn
    assert ["folds: 2 of 2" in shown[0][-1], "resamples: 2 of 2" in shown[1][-1]] == [True, True]


@pytest.mark.slow
def test_notebook_shows_bar_page_and_figure(tmp_path) -> None:
    client, formats = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    cells = [
        "import loopcal as lc\nbar = lc.ProgressBar()\nbar(1, 2, '<b>')\nbar(2, 2, '<b>')",
        "lc.load_robot('five-bar')",
        "lc.load_robot('five-bar').plot()",
    ]
    notebook = formats.v4.new_notebook(cells=[formats.v4.new_code_cell(cell) for cell in cells])
    client.NotebookClient(notebook, timeout=60).execute()
    bar, page, figure = (cell["outputs"] for cell in notebook["cells"])
    assert len(bar) == 1
    assert "2 of 2" in bar[0]["data"]["text/html"]
    assert "<b>" not in bar[0]["data"]["text/html"]
    assert "west.motor.x" in page[0]["data"]["text/html"]
    assert "image/png" in figure[0]["data"]
