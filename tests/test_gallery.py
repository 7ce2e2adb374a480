# SPDX-License-Identifier: Apache-2.0
"""The examples of the gallery: they use public names only, draw a figure and know the truth.

`make site` runs them; the test marked `evidence` does the same without Sphinx.
"""

import ast
import importlib
import re
import runpy
import warnings
from pathlib import Path

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure

import loopcal as lc

GALLERY = Path(__file__).parent.parent / "docs" / "gallery"
EXAMPLES = sorted(GALLERY.glob("*.py"))
TOPICS = """
    klipper reprap hexapod_tracker ball_bar datum_cube dial_gauge tilt_meter cable_readings
    repeatability own_mechanism own_estimator study
"""
"""What users look for in the gallery; each is a script."""

LONGEST_LINE, LONGEST_BLOCK = 100, 55
"""Characters of a line, and lines of a code block between two comments."""

of_each_example = pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)


def read_blocks(path: Path) -> list[str]:
    """Return the blocks of a script, which `# %%` separates."""
    return path.read_text().split("\n# %%\n")


def list_public_uses(tree: ast.AST) -> set[str]:
    """Return the names that a script takes from loopcal."""
    return {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "lc"
    }


def test_every_topic_has_its_example() -> None:
    names = {path.stem for path in EXAMPLES}
    assert names >= {f"plot_{topic}" for topic in TOPICS.split()}
    assert all(name.startswith("plot_") for name in names)


@of_each_example
def test_example_has_a_title_and_a_context(path) -> None:
    title, underline, _, *text = (ast.get_docstring(ast.parse(path.read_text())) or "").splitlines()
    assert underline == "=" * len(title)
    assert len(title) <= 70
    assert len(" ".join(text).split(". ")) >= 2


@of_each_example
def test_example_uses_public_names_only(path) -> None:
    tree = ast.parse(path.read_text())
    assert list_public_uses(tree) <= set(lc.__all__)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules = [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [node.module or ""]
        else:
            continue
        assert not [name for name in modules if name.startswith("loopcal.")]
        for name in modules:
            importlib.import_module(name)


@of_each_example
def test_example_does_not_reach_into_private_attributes(path) -> None:
    names = [node.attr for node in ast.walk(ast.parse(path.read_text()))
             if isinstance(node, ast.Attribute)]  # fmt: skip
    assert not [name for name in names if name.startswith("_")]


@of_each_example
def test_example_draws_a_figure_of_loopcal_and_prints_numbers(path) -> None:
    """A figure is the last expression of a block, as in a notebook."""
    last = [ast.parse(block).body[-1:] for block in read_blocks(path)]
    calls = [
        node.value.func.attr
        for body in last
        for node in body
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Call)
        and isinstance(node.value.func, ast.Attribute)
    ]
    drawn = {"plot", "draw", "residuals", "parameters", "correlation", "convergence"}
    assert set(calls) & drawn, calls
    assert "print(" in path.read_text()


@of_each_example
def test_example_is_short_and_readable(path) -> None:
    text = path.read_text()
    assert max(map(len, text.splitlines())) <= LONGEST_LINE
    assert max(len(block.splitlines()) for block in read_blocks(path)) <= LONGEST_BLOCK


def test_site_shows_figures_as_pictures_and_not_as_text() -> None:
    """The site leaves out the text of results whose type matches this pattern."""
    text = (GALLERY.parent / "conf.py").read_text()
    pattern = re.search(r'"ignore_repr_types": r"(.*)"', text)
    assert pattern is not None
    assert re.search(pattern[1], str(type(lc.load_robot("five-bar").plot())))


@pytest.mark.evidence
@of_each_example
def test_example_runs_without_warnings(path, monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    mpl.use("Agg")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        names = runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out
    assert not [name for name, value in names.items() if isinstance(value, Figure)]
