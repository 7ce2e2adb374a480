# SPDX-License-Identifier: Apache-2.0
"""Commands build their figures, but write a placeholder for each picture: drawing takes a third of
the time of a plan, and tests/report draws every figure.
"""

from pathlib import Path

import pytest

PLACEHOLDER = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(autouse=True)
def do_not_draw(monkeypatch) -> None:
    """Leave out the layout and the drawing of pictures in this process."""

    def save(_, out, **_options) -> None:
        if isinstance(out, str | Path):
            Path(out).write_bytes(PLACEHOLDER)
        else:
            out.write(PLACEHOLDER)

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", save)
    monkeypatch.setattr("matplotlib.figure.Figure.draw_without_rendering", lambda _: None)
