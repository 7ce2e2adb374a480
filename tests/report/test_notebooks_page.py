# SPDX-License-Identifier: Apache-2.0
"""docs/notebooks.md: its Python code runs as printed."""

import re
import shutil

import matplotlib.figure
import pandas as pd
import pytest
import xarray as xr

import loopcal as lc


@pytest.mark.slow
def test_python_code_of_the_page_runs(root, tmp_path, monkeypatch) -> None:
    shutil.copytree(root / "examples" / "hexapod-42", tmp_path / "examples" / "hexapod-42")
    monkeypatch.chdir(tmp_path)
    page = (root / "docs" / "notebooks.md").read_text("utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 6
    names: dict = {}
    exec(blocks[0], names)  # noqa: S102
    for line in blocks[1].splitlines():
        assert isinstance(eval(line, names), matplotlib.figure.Figure)
    for block in blocks[2:]:
        exec(block, names)  # noqa: S102
    assert (tmp_path / "residuals.svg").stat().st_size > 10_000
    assert (tmp_path / "histogram.pdf").stat().st_size > 5_000
    place = names["panel"].get_tightbbox().transformed(names["figure"].dpi_scale_trans.inverted())
    assert 0.0 <= place.x0 < 0.5
    assert 3.0 < place.x1 <= 88 / 25.4
    assert isinstance(names["frame"], pd.DataFrame)
    assert isinstance(names["arrays"], xr.Dataset)
    assert isinstance(names["fit"], lc.Identification)
