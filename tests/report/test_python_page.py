# SPDX-License-Identifier: Apache-2.0
"""docs/python.md runs from top to bottom, and its panel for a journal has the width of a column."""

from pathlib import Path

import pandas as pd
import pytest
import xarray as xr

import loopcal as lc
from tests.cli.page_commands import run_page


@pytest.mark.slow
def test_page_runs_and_draws_a_panel_for_a_journal(root, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page((root / "docs" / "python.md").read_text("utf-8"))
    assert Path("residuals.svg").stat().st_size > 10_000
    assert Path("histogram.pdf").stat().st_size > 5_000
    place = names["panel"].get_tightbbox().transformed(names["figure"].dpi_scale_trans.inverted())
    assert 0.0 <= place.x0 < 0.5
    assert 3.0 < place.x1 <= 88 / 25.4
    assert isinstance(names["frame"], pd.DataFrame)
    assert isinstance(names["arrays"], xr.Dataset)
    assert isinstance(names["fit"], lc.Identification)
