# SPDX-License-Identifier: Apache-2.0
"""What all repeated papers share: printed numbers, claims, pages, folders, the command."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from loopcal.cli.entry_point import main
from loopcal.errors import DataError, FileError
from loopcal.io.core.text_file import to_json
from loopcal.papers.paper import PAPERS, Paper, find_paper
from loopcal.papers.published import (
    Figure,
    PaperText,
    Series,
    Verdict,
    build_document,
    choose_styles,
    decide,
    draw,
    write_folder,
    write_page,
)
from tests.papers.small_reproduction import MADE_BY, build_reproduction

ROOT = Path(__file__).parents[2]


def test_number_agrees_within_one_unit_of_its_last_printed_digit() -> None:
    comparison = build_reproduction().content.comparisons[0]
    np.testing.assert_array_equal(comparison.step, [[0.01, 1e-5], [1.0, 0.01]])
    np.testing.assert_array_equal(comparison.within, [[True, True], [False, True]])
    assert (comparison.within.sum(), comparison.within.size) == (3, 4)
    assert comparison.difference[1, 0] == 2.0
    assert [row[2] for row in comparison.table().rows] == ["0.12", "-3E-05", "7", "1.50"]


def test_page_shows_numbers_that_differ_from_the_published_ones_and_says_how_many_agree() -> None:
    text = write_page(build_reproduction(), MADE_BY)
    for part in (
        "3 of 4 numbers within one unit",
        "| B | x [mm] | 7 | 9 | 2 | 1e+00 | no |",
        (
            "## Our own checks\n\n1. **Not confirmed:** It holds.\n"
            "   True in 0 of 2 draws (95 % interval of the share: 0 to 84 %). It does not."
        ),
        "| q | - |",
        "2 of 3 rows. All rows",
        "(figures/curve.png)",
    ):
        assert part in text
    assert "| A | x [mm] |" not in text


def test_statements_of_the_paper_and_own_checks_have_two_lists() -> None:
    both = build_reproduction(Verdict("It is said.", True, "It is.", "section 1"))
    counts = {title: len(verdicts) for title, verdicts in both.verdict_groups.items()}
    assert list(counts.items()) == [("Statements of the paper", 1), ("Our own checks", 1)]
    text = write_page(both, MADE_BY)
    first = text.index("1. **Agrees:** It is said. (section 1)")
    assert first < text.index("2. **Not confirmed:**")


@pytest.mark.parametrize(
    ("agrees", "verdict", "word", "reason"),
    [
        (True, True, "Agrees", "x is 0.5."),
        (np.False_, False, "Does not agree", "x is 0.5."),
        (decide(False, np.False_), None, "Undecided", "x is 0.5."),
        (decide(False, True), False, "Does not agree", "x is 0.5."),
        ([True, False, True, True, True], None, "Undecided",
         "True in 4 of 5 draws (95 % interval of the share: 28 to 99 %). x is 0.5."),
        ([True] * 18 + [False] * 2, True, "Agrees",
         "True in 18 of 20 draws (95 % interval of the share: 68 to 99 %). x is 0.5."),
        (np.zeros(6, dtype=bool), False, "Does not agree",
         "True in 0 of 6 draws (95 % interval of the share: 0 to 46 %). x is 0.5."),
        ([None, None], None, "Undecided",
         ("True in 0 of 2 draws (2 decide nothing; 95 % interval of the share: 0 to 100 %). "
          "x is 0.5.")),
    ],
)  # fmt: skip
def test_claim_is_judged_by_one_decision_or_by_that_of_each_draw(
    tmp_path, agrees, verdict, word, reason
) -> None:
    record = "{claim: x is small., where: section 1, evidence: 'x is {x:g}.'}"
    (tmp_path / "text.yaml").write_text(f"claims:\n  small: {record}\n")
    judged = PaperText(str(tmp_path / "results.py")).judge("small", agrees, x=0.5)
    assert (judged.agrees, judged.word, judged.reason) == (verdict, word, reason)


def test_claim_about_one_machine_is_not_refuted_by_other_dimensions(tmp_path) -> None:
    record = "{claim: x., where: section 1, of: these machines, evidence: 'It is {x}.'}"
    (tmp_path / "text.yaml").write_text(f"claims:\n  small: {record}\n")
    text = PaperText(str(tmp_path / "results.py"))
    elsewhere, there = (text.judge("small", False, elsewhere=e, x=1) for e in (True, False))
    assert (elsewhere.word, there.word) == ("Undecided", "Does not agree")
    assert elsewhere.reason == "The claim is about machines of other dimensions. It is 1."
    assert text.judge("small", True, x=1).word == "Agrees"


@pytest.mark.parametrize("paper", PAPERS)
def test_sizes_that_another_robot_replaces_are_stated(paper, tmp_path) -> None:
    robot = tmp_path / "mine.yaml"
    text = (ROOT / "src/loopcal/robots/hexapod-42.yaml").read_text()
    robot.write_text(text)
    case = PAPERS[paper].make_case(robot)
    sentences = case.list_replaced()
    assert sentences[0].startswith("The robot is ")
    assert any("standard deviations" in sentence for sentence in sentences)
    *_, own = PAPERS[paper].robots
    stated = (f"{own} is a robot of the paper: the study runs for all, 3-prs and {own}.",)
    assert PAPERS[paper].make_case(own).list_replaced() == stated * (paper == "tsvd-2016")
    assert PAPERS[paper].make_case().list_replaced() == ()
    assert [level.text for level in case.load_study().robots.values()] == [text]


@pytest.mark.slow
def test_folder_contains_page_tables_and_figures_and_needs_force(tmp_path) -> None:
    folder = write_folder(tmp_path / "a" / "out", build_reproduction(), MADE_BY)
    names = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert names == {"page.md", "result.json", "figures/curve.png"} | {
        f"tables/{name}.{end}" for name in ("one", "extra", "summary") for end in ("csv", "json")
    }
    documents = [json.loads(p.read_text("utf-8")) for p in folder.rglob("*.json")]
    assert [document["format"] for document in documents] == [1] * 4
    assert (folder / "figures" / "curve.png").read_bytes().startswith(b"\x89PNG")
    with (folder / "tables" / "extra.csv").open() as stream:
        rows = list(csv.reader(stream))
    assert rows == [["case", "value"], ["p", "1.0"], ["q", ""], ["r", "3.0"]]
    with pytest.raises(FileError, match="not empty"):
        write_folder(folder, build_reproduction(), MADE_BY)
    (folder / "figures" / "curve.png").unlink()
    write_folder(folder, build_reproduction(), MADE_BY, force=True)
    assert (folder / "figures" / "curve.png").exists()
    (folder / "figures" / "mine.png").touch()
    with pytest.raises(FileError, match=r"contains figures/mine\.png, which is foreign"):
        write_folder(folder, build_reproduction(), MADE_BY, force=True)
    assert [p.name for p in folder.parent.iterdir()] == ["out"]


@pytest.mark.slow
@pytest.mark.parametrize(("count", "log"), [(1, "xy"), (4, ""), (9, "y"), (14, "xy")])
def test_legend_covers_no_curve_and_lies_within_the_picture(count, log) -> None:
    """Curves that fill the axes to their corners, with as many labels as the studies have."""
    rng, x = np.random.default_rng(count), np.geomspace(1e-5, 1.0, 30)
    names = [f"MAP, errors of {i} mm, aligned" for i in range(count)]
    series = tuple(Series.of(name, x, 10 ** rng.uniform(-4, 2, 30)) for name in names)
    levels = {"before, errors of 0.01 mm": 1e-4, "MAP, phi and theta [deg]": 99.0}
    small = Figure("f", "Title", "lambda [1]", "error [mm]", "Of 1.", series, levels, log)
    canvas = draw(small, choose_styles([small]))
    canvas.draw_without_rendering()
    legend, axes = canvas.legends[0].get_window_extent(), canvas.axes[0]
    x0, y0, x1, y1 = legend.extents
    for line in axes.lines[:count]:
        xy = axes.transData.transform(line.get_xydata())
        inside = (xy[:, 0] >= x0) & (xy[:, 0] <= x1) & (xy[:, 1] >= y0) & (xy[:, 1] <= y1)
        assert not inside.any()
    drawn = axes.get_tightbbox()
    assert drawn is not None
    assert not legend.overlaps(drawn)
    assert canvas.bbox.x0 <= x0
    assert x1 <= canvas.bbox.x1
    assert canvas.bbox.y0 <= y0
    assert axes.get_window_extent().height > 0.22 * canvas.bbox.height  # the curves keep room


@pytest.mark.slow
def test_markers_of_a_line_lie_apart_and_single_points_are_all_drawn() -> None:
    x = np.geomspace(1.0, 1e6, 500)
    line = Series.of("steps", x, x**-0.5)
    few = Series.of("few", [1.0, 1.1, 1.2], [1.0, 0.9, 0.8], joined=False)
    figure = Figure("f", "Title", "step", "size", "", (line, few), log="xy")
    axes = draw(figure, choose_styles([figure])).axes[0]
    apart, every = (drawn.get_markevery() for drawn in axes.lines)
    assert isinstance(apart, float)
    diagonal = np.hypot(*axes.get_window_extent().size)
    assert apart * diagonal > 1.5 * axes.lines[0].get_markersize()
    assert every is None


def test_labels_of_one_figure_differ_in_color_and_keep_it_in_others() -> None:
    lines = [Series(label, (1.0,), (1.0,)) for label in ("a", "b", "c", "_unnamed")]
    figures = [
        Figure(name, "", "", "", "", series)
        for name, series in (("f", tuple(lines[:2])), ("g", tuple(lines[1:])))
    ]
    styles = choose_styles(figures)
    assert list(styles) == ["a", "b", "c"]
    assert styles["b"]["color"] not in {styles["a"]["color"], styles["c"]["color"]}


def test_unknown_paper_and_invalid_seed_or_trials_are_refused() -> None:
    with pytest.raises(DataError, match="hexapod-42"):
        find_paper("hexapod")
    for seed, trials in ((-1, 5), (0, 1)):
        with pytest.raises(DataError, match="give a seed of 0 or more"):
            PAPERS["hexapod-42"].run(seed, trials)


@pytest.mark.parametrize("paper", PAPERS.values(), ids=PAPERS)
def test_page_of_papers_has_a_section_of_each_and_lists_the_files_of_its_study(paper) -> None:
    page = (ROOT / "docs" / "papers.md").read_text("utf-8")
    assert f"\n## {paper.name}: " in page
    folder = ROOT / "src" / "loopcal" / "papers" / paper.name.replace("-", "_")
    named = set(re.findall(r"`(\w+\.(?:py|yaml))`", page))
    files = {path.name for path in folder.iterdir() if path.suffix in {".py", ".yaml"}}
    assert files - {"__init__.py"} <= named
    assert paper.title
    assert paper.source


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


def test_reproduce_prints_tables_and_statements(capsys, monkeypatch) -> None:
    monkeypatch.setattr(Paper, "run", lambda _, seed=0, trials=2, *__: build_reproduction())
    assert main(["reproduce", "hexapod-42"]) == 0
    printed = capsys.readouterr().out
    for part in ("small: A title", "Extra", "2 of 3 rows. All: -o FOLDER.", "Our own checks",
                 "NOT CONFIRMED: It holds.", "True in 0 of 2 draws (95 %",
                 "Add -o FOLDER"):  # fmt: skip
        assert part in printed


def test_reproduce_writes_the_document_that_it_prints(capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(Paper, "run", lambda _, seed=0, trials=2, *__: build_reproduction())
    folder = tmp_path / "out"
    assert main(["reproduce", "hexapod-42", "--trials", "2", "-o", str(folder), "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    document = json.loads(out, parse_constant=pytest.fail)
    written = json.loads((folder / "result.json").read_text("utf-8"))
    assert written["made_by"]["seeds"] == {"seed": 0}
    assert "figures/curve.png" in written.pop("files")
    assert written == document
    assert (folder / "figures" / "curve.png").is_file()


@pytest.mark.evidence
def test_same_seed_gives_the_same_document() -> None:
    first, again = (to_json(build_document(PAPERS["hexapod-42"].run(0, 2), {})) for _ in range(2))
    assert first == again
