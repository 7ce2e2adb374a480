# SPDX-License-Identifier: Apache-2.0
"""What all repeated papers share: printed numbers, comparisons, pages, folders, the command."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.errors import DataError, FileError
from loopcal.io.core.json_text import to_json
from loopcal.papers import PAPERS, Paper, paper
from loopcal.papers.drawing import choose_styles, draw
from loopcal.papers.reproduction import Figure, Series, Verdict
from loopcal.papers.wording import Wording
from loopcal.papers.writing import page, write_folder
from tests.papers.small_reproduction import MADE_BY, build_reproduction


def test_number_agrees_within_one_unit_of_its_last_printed_digit() -> None:
    comparison = build_reproduction().comparisons[0]
    np.testing.assert_array_equal(comparison.step, [[0.01, 1e-5], [1.0, 0.01]])
    np.testing.assert_array_equal(comparison.within, [[True, True], [False, True]])
    assert (comparison.agreeing, comparison.count, comparison.largest) == (3, 4, 2.0)


def test_published_numbers_are_shown_as_printed() -> None:
    rows = build_reproduction().comparisons[0].table().rows
    assert [row[2] for row in rows] == ["0.12", "-3E-05", "7", "1.50"]


def test_page_shows_published_and_computed_numbers_and_marks_differences() -> None:
    text = page(build_reproduction(), MADE_BY)
    assert (
        "| B | published | 7 | 1.50 |\n|  | computed | 9.0 | 1.500 |\n|  | difference | "
        "**2.0e+00** | 0 |" in text
    )
    assert (
        "## Our own checks\n\n1. **Not confirmed:** It holds.\n"
        "   True in 0 of 2 draws. It does not." in text
    )
    assert "| q | - |" in text
    assert "The first 2 of 3 rows" in text
    assert "(figures/curve.png)" in text


def build_wording(**claim: object) -> Wording:
    text = {"claim": "x is small.", "where": "section 1", "evidence": "x is {x:g}.", **claim}
    return Wording((), {"small": text}, {}, {})


def test_claim_is_undecided_between_its_two_lists_of_comparisons() -> None:
    words = build_wording(agrees=["x < 1"], disagrees=["x > 2"])
    verdicts = [words.judge("small", x=x) for x in (0.5, 1.5, 2.5)]
    assert [v.agrees for v in verdicts] == [True, None, False]
    assert [v.word for v in verdicts] == ["Agrees", "Undecided", "Does not agree"]
    two_valued = build_wording(agrees=["x < 1"])
    assert [two_valued.judge("small", x=x).agrees for x in (0, 2)] == [True, False]


def test_claim_whose_draws_differ_is_labelled_so() -> None:
    words = build_wording(agrees=["x < 1"])
    mixed = words.judge("small", x=0.5, draws=[{"x": x} for x in (0.5, 3.0, 0.1, 0.2, 0.9)])
    assert (mixed.agrees, mixed.word) == (None, "Depends on the draw")
    assert mixed.stability == "True in 4 of 5 draws."
    same = words.judge("small", x=0.5, draws=[{"x": x} for x in (3.0, 2.0)])
    assert (same.agrees, same.word, same.why) == (False, "Does not agree", "x is 0.5.")
    assert words.judge("small", x=0.5).stability == ""


def test_statements_of_the_paper_and_own_checks_have_two_lists() -> None:
    small = build_reproduction()
    both = replace(
        small, verdicts=(*small.verdicts, Verdict("It is said.", True, "It is.", "section 1"))
    )
    assert {title: len(v) for title, v in both.verdict_groups.items()} == {
        "Statements of the paper": 1,
        "Our own checks": 1,
    }
    text = page(both, MADE_BY)
    assert text.index("1. **Agrees:** It is said. (section 1)") < text.index(
        "2. **Not confirmed:**"
    )


@pytest.mark.slow
def test_folder_contains_page_tables_and_figures_and_needs_force(tmp_path) -> None:
    folder = write_folder(tmp_path / "a" / "out", build_reproduction(), MADE_BY)
    names = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert names == {"page.md", "result.json", "figures/curve.png"} | {
        f"tables/{name}.{end}" for name in ("one", "extra", "summary") for end in ("csv", "json")
    }
    assert (folder / "figures" / "curve.png").read_bytes().startswith(b"\x89PNG")
    with (folder / "tables" / "extra.csv").open() as stream:
        assert list(csv.reader(stream)) == [
            ["case", "value"],
            ["p", "1.0"],
            ["q", ""],
            ["r", "3.0"],
        ]
    with pytest.raises(FileError, match="not empty"):
        write_folder(folder, build_reproduction(), MADE_BY)
    (folder / "figures" / "curve.png").unlink()
    write_folder(folder, build_reproduction(), MADE_BY, force=True)
    assert (folder / "figures" / "curve.png").exists()
    (folder / "figures" / "mine.png").touch()
    with pytest.raises(FileError, match=r"contains figures/mine\.png, which does not belong"):
        write_folder(folder, build_reproduction(), MADE_BY, force=True)
    assert [p.name for p in folder.parent.iterdir()] == ["out"]


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 4, 9, 14])
@pytest.mark.parametrize("log", ["", "y", "xy"])
def test_legend_covers_no_curve_and_lies_within_the_picture(count, log) -> None:
    """Curves that fill the axes to their corners, with as many labels as the studies have."""
    rng = np.random.default_rng(count)
    x = tuple(map(float, np.geomspace(1e-5, 1.0, 30)))
    series = [
        Series(
            f"MAP, errors of {i} mm, aligned", x, tuple(map(float, 10 ** rng.uniform(-4, 2, 30)))
        )
        for i in range(count)
    ]
    levels = {"before, errors of 0.01 mm": 1e-4, "MAP, phi and theta [deg]": 99.0}
    small = Figure("f", "Title", "lambda [1]", "error [mm]", "Of 1.", tuple(series), levels, log)
    canvas = draw(small, choose_styles([small]))
    canvas.canvas.draw()
    legend = canvas.legends[0].get_window_extent()
    axes = canvas.axes[0]
    points = [axes.transData.transform(line.get_xydata()) for line in axes.lines[:count]]
    x0, y0, x1, y1 = legend.extents
    for xy in points:
        inside = (xy[:, 0] >= x0) & (xy[:, 0] <= x1) & (xy[:, 1] >= y0) & (xy[:, 1] <= y1)
        assert not inside.any()
    drawn = axes.get_tightbbox()
    assert drawn is not None
    assert not legend.overlaps(drawn)
    assert canvas.bbox.x0 <= x0
    assert x1 <= canvas.bbox.x1
    assert canvas.bbox.y0 <= y0
    assert axes.get_window_extent().height > 150  # [pixels] the curves keep room


def test_unknown_paper_and_invalid_seed_or_trials_are_refused() -> None:
    with pytest.raises(DataError, match="hexapod-42"):
        paper("hexapod")
    for seed, trials in ((-1, 5), (0, 1)):
        with pytest.raises(DataError, match="give a seed of 0 or more"):
            PAPERS["hexapod-42"].run(seed, trials)


def test_every_paper_has_its_registered_name_a_title_and_a_source() -> None:
    assert all(
        isinstance(one, Paper) and name == one.name and one.title and one.source
        for name, one in PAPERS.items()
    )


def test_reproduce_lists_papers(capsys) -> None:
    assert main(["reproduce"]) == 0
    assert "hexapod-42" in capsys.readouterr().out
    assert main(["reproduce", "--json"]) == 0
    assert [p["name"] for p in json.loads(capsys.readouterr().out)["papers"]] == list(PAPERS)


def test_reproduce_refuses_an_unknown_paper_and_a_used_folder(capsys, tmp_path) -> None:
    assert main(["reproduce", "hexapod42"]) == 1
    assert capsys.readouterr().err.startswith("loopcal: 'hexapod42' is not a paper")
    (tmp_path / "mine.txt").touch()
    for words in ([], ["--force"]):
        assert main(["reproduce", "hexapod-42", "-o", str(tmp_path), *words]) == 1
        assert "this folder" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.slow
def test_reproduce_writes_the_document_that_it_prints(capsys, tmp_path) -> None:
    folder = tmp_path / "out"
    assert main(["reproduce", "hexapod-42", "--trials", "2", "-o", str(folder), "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    document = json.loads(out, parse_constant=pytest.fail)
    written = json.loads((folder / "result.json").read_text("utf-8"))
    assert written.pop("made_by")["seeds"] == {"seed": 0}
    assert "figures/figure_4.png" in written.pop("files")
    assert written == document
    assert (folder / "figures" / "figure_4.png").is_file()
    again = PAPERS["hexapod-42"].run(0, 2)  # the same seed gives the same numbers
    assert json.loads(to_json(again.to_dict())) == document
    assert main(["reproduce", "hexapod-42", "--trials", "2", "--seed", "8"]) == 0
    assert "DOES NOT AGREE" in capsys.readouterr().out
