# SPDX-License-Identifier: Apache-2.0
"""`loopcal validate` recognizes fitted rows in another file and refuses them."""

import shutil
from pathlib import Path

from loopcal.cli import main

EXAMPLE = Path(__file__).parents[2] / "examples" / "hexapod-42"


def test_validate_refuses_fitted_rows_in_another_file_and_accepts_held_out_ones(
    tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(EXAMPLE / "measurements.csv", "all.csv")
    lines = Path("all.csv").read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("pose,")) + 1
    head, rows = lines[:first], lines[first:]
    Path("fit.csv").write_text("\n".join(head + rows[:30]) + "\n")
    Path("part.csv").write_text("\n".join(["## a copy", *head, *rows[7::-1]]) + "\n")
    Path("mixed.csv").write_text("\n".join(head + rows[28:]) + "\n")
    Path("rest.csv").write_text("\n".join(head + rows[30:]) + "\n")
    assert main(["calibrate", "hexapod-42", "fit.csv", "-o", "run"]) == 0
    capsys.readouterr()
    assert main(["validate", "run", "part.csv"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("loopcal: The calibration used 8 of 8 rows (poses ")
    assert "--allow-fitted-data" in err
    assert main(["validate", "run", "part.csv", "--allow-fitted-data"]) == 0
    assert main(["validate", "run", "rest.csv"]) == 0
    assert capsys.readouterr().err == ""
    assert main(["validate", "run", "mixed.csv"]) == 0
    assert capsys.readouterr().err.startswith("loopcal: note: The calibration used 2 of 12 rows")
