# SPDX-License-Identifier: Apache-2.0
"""`loopcal simulate` with targets on the base: what it counts, and where its help sends."""

import loopcal as lc
from loopcal.cli.entry_point import main
from tests.io.test_base_target_files import BASE, POSES, ROBOT


def test_filled_in_rows_of_the_base_are_counted(loopcal, tmp_path) -> None:
    for name, text in (("poses.csv", POSES), ("base.csv", BASE)):
        (tmp_path / name).write_text(text)
    sheet, filled = tmp_path / "sheet.csv", tmp_path / "filled.csv"
    data = lc.load_measurements([tmp_path / "poses.csv", tmp_path / "base.csv"], ROBOT)
    lc.save_measurements(data, sheet, ROBOT)
    words = ["simulate", "linear-delta", "--fill", str(sheet), "-o", str(filled)]
    loopcal(words, "9 measured values and 27 of targets on the base")
    assert lc.load_measurements(filled, ROBOT).n_base_rows == 27
    counts = loopcal([*words, "--force", "--json"]).json
    assert (counts["n_poses"], counts["n_rows"], counts["n_base_rows"]) == (3, 9, 27)


def test_help_says_how_targets_on_the_base_are_simulated(capsys) -> None:
    main(["simulate", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "of: base" in text
    assert "need --fill" in text
