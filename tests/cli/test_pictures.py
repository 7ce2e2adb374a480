# SPDX-License-Identifier: Apache-2.0
"""The commands `loopcal board` and `loopcal photos`."""

import sys

from loopcal.io.board import read_board


def test_without_opencv_the_extra_is_named(loopcal, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    loopcal("board -o b.yaml", "pip install 'loopcal[camera]'", code=1)
    assert not list(tmp_path.iterdir())


def test_command_writes_the_file_and_both_drawings(loopcal, tmp_path) -> None:
    words = "board -o b.yaml --columns 8 --rows 6 --square 20mm"
    loopcal(words, "Measure 140 mm along x and 120 mm along y")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.pdf", "b.svg", "b.yaml"]
    assert read_board(tmp_path / "b.yaml").corners == (7, 5)
    loopcal("board -o b.yaml", "--force", code=1)
    loopcal("board -o b.csv", ".yaml", code=1)
