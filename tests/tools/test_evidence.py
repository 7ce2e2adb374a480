# SPDX-License-Identifier: Apache-2.0
"""Tables in the documentation are generated from docs/evidence/*.json and agree with it."""

import ast
import json
from pathlib import Path

import pytest

from tools import evidence

TABLE = {
    "columns": ["step", "median [mm]"],
    "formats": ["d", ".2g"],
    "rows": [[1, 0.3123], [2, None]],
}


def test_missing_value_is_shown_as_a_dash() -> None:
    assert (
        evidence.render_table(TABLE)
        == "| step | median [mm] |\n| --- | --- |\n| 1 | 0.31 |\n| 2 | - |\n"
    )


def test_fill_tables_replaces_the_block_and_keeps_the_text_around_it(tmp_path: Path) -> None:
    evidence.write_json(tmp_path / "recovery.json", {"tables": {"steps": TABLE}})
    page = "before\n<!-- evidence: recovery.steps -->\nold\n<!-- end -->\nafter\n"
    filled = evidence.fill_tables(page, tmp_path)
    assert filled == page.replace("old\n", evidence.render_table(TABLE))
    assert evidence.fill_tables(filled, tmp_path) == filled


def test_block_with_a_value_shows_the_rows_that_have_it(tmp_path: Path) -> None:
    table = {"columns": ["case", "met"], "rows": [["clean", "yes"], ["drift", "no"]]}
    evidence.write_json(tmp_path / "cases.json", {"tables": {"all": table}})
    page = "<!-- evidence: cases.all, met = no -->\n<!-- end -->\n"
    filled = evidence.fill_tables(page, tmp_path)
    assert filled.splitlines()[1:-1] == ["| case | met |", "| --- | --- |", "| drift | no |"]
    assert evidence.fill_tables(filled, tmp_path) == filled
    short = page.replace("= no", "= no, columns to case")
    assert evidence.fill_tables(short, tmp_path).splitlines()[1:-1] == [
        "| case |",
        "| --- |",
        "| drift |",
    ]


@pytest.mark.parametrize(
    ("block", "number"),
    [
        ("cases.all, met = no, rows", "2 of 3"),
        ("cases.all, range of share [%]", "1.0 to 3.0"),
        ("cases.all, met = yes, range of share [%]", "3.0"),
        ("cases.all, met = no, sum of fits", "50"),
    ],
)
def test_block_in_a_sentence_is_a_number(block: str, number: str, tmp_path: Path) -> None:
    rows = [["no", 20, 1.04], ["no", 30, None], ["yes", 40, 2.96]]
    table = {"columns": ["met", "fits", "share [%]"], "formats": ["", "d", ".1f"], "rows": rows}
    evidence.write_json(tmp_path / "cases.json", {"tables": {"all": table}})
    page = "It is <!-- evidence: {} -->{}<!-- end --> now."
    assert evidence.fill_tables(page.format(block, "?"), tmp_path) == page.format(block, number)


@pytest.mark.parametrize(
    ("block", "sentence"),
    [
        (
            "recover.steps",
            (
                "docs/page.md: there is no {folder}/recover.json; run `python -m tools.evidence "
                "recover` to make it"
            ),
        ),
        (
            "recovery.step",
            "docs/page.md: {folder}/recovery.json has no table 'step'; there are steps",
        ),
    ],
)
def test_missing_evidence_is_reported_with_its_page(
    block: str, sentence: str, tmp_path: Path, monkeypatch, capsys
) -> None:
    folder, page = tmp_path / "docs" / "evidence", tmp_path / "docs" / "page.md"
    evidence.write_json(folder / "recovery.json", {"tables": {"steps": TABLE}})
    (tmp_path / "README.md").write_text("nothing\n")
    page.write_text(f"<!-- evidence: {block} -->\n<!-- end -->\n")
    monkeypatch.setattr(evidence, "ROOT", tmp_path)
    assert evidence.main(["--tables"]) == 1
    assert capsys.readouterr().err == f"evidence: {sentence.format(folder=folder)}\n"
    assert page.read_text() == f"<!-- evidence: {block} -->\n<!-- end -->\n"


def test_nan_is_refused_and_the_old_file_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    evidence.write_json(path, {"value": 1})
    with pytest.raises(ValueError, match="JSON compliant"):
        evidence.write_json(path, {"value": float("nan")})
    assert json.loads(path.read_text("utf-8")) == {"value": 1}


def test_figures_of_a_script_are_written_under_its_name_and_old_ones_removed(tmp_path) -> None:
    first = {"b.png": b"second", "a.svg": b"first"}
    assert evidence.write_figures(tmp_path, "poses", first) == ["poses-a.svg", "poses-b.png"]
    evidence.write_figures(tmp_path, "methods", {"a.svg": b"other"})
    (tmp_path / "poses.json").write_text("{}")
    assert evidence.write_figures(tmp_path, "poses", {"a.svg": b"new"}) == ["poses-a.svg"]
    assert [path.name for path in evidence.find_figures(tmp_path)] == [
        "methods-a.svg",
        "poses-a.svg",
    ]
    assert (tmp_path / "poses-a.svg").read_bytes() == b"new"


SCRIPT = """
DRAWS, SIZES = 1000, (1, 2, 3)
QUICK = {"DRAWS": 3}


def collect():
    table = {"columns": ["draws", "sizes"], "rows": [[DRAWS, len(SIZES)]]}
    return {"tables": {"counts": table}}


def check(tables):
    assert tables["counts"]["rows"][0] == [DRAWS, 2], "sizes"
"""


def test_a_reduced_size_replaces_constants_and_is_checked(tmp_path: Path) -> None:
    script = tmp_path / "counts.py"
    script.write_text(SCRIPT)
    assert evidence.collect(script)["tables"]["counts"]["rows"] == [[1000, 3]]
    with pytest.raises(AssertionError, match="sizes"):
        evidence.collect(script, is_quick=True)
    script.write_text(SCRIPT.replace("2, 3)", "2)"))
    assert evidence.collect(script, is_quick=True)["tables"]["counts"]["rows"] == [[3, 2]]


def test_every_script_has_a_reduced_size_of_names_that_it_has(root: Path) -> None:
    for script in sorted((root / "evidence").glob("*.py")):
        body = ast.parse(script.read_text("utf-8")).body
        assigned = {
            name.id
            for line in body
            if isinstance(line, ast.Assign | ast.AnnAssign)
            for name in ast.walk(line)
            if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)
        }
        functions = {line.name for line in body if isinstance(line, ast.FunctionDef)}
        (quick,) = (
            line.value
            for line in body
            if isinstance(line, ast.Assign) and ast.unparse(line.targets[0]) == "QUICK"
        )
        assert isinstance(quick, ast.Dict)
        assert {"collect", "check"} <= functions, script.name
        assert {ast.literal_eval(key) for key in quick.keys if key} <= assigned, script.name


def test_every_figure_belongs_to_evidence_and_is_shown_on_a_page(root: Path) -> None:
    folder = root / "docs" / "evidence"
    named = [
        name
        for path in folder.glob("*.json")
        for name in json.loads(path.read_text("utf-8")).get("figures", [])
    ]
    assert sorted(named) == [path.name for path in evidence.find_figures(folder)]
    pages = "".join(page.read_text("utf-8") for page in evidence.find_pages(root))
    assert [name for name in named if f"evidence/{name})" not in pages] == []


def test_tables_in_the_pages_agree_with_the_evidence_files(root: Path) -> None:
    assert list(evidence.find_outdated(root)) == [], "run `make docs`"


@pytest.mark.evidence
def test_every_evidence_file_has_a_script_and_states_its_processor(root: Path) -> None:
    written = {path.stem: path for path in (root / "docs" / "evidence").glob("*.json")}
    assert set(written) == {path.stem for path in (root / "evidence").glob("*.py")}
    for path in written.values():
        assert json.loads(path.read_text("utf-8"))["made"]["machine"]["processor"]
