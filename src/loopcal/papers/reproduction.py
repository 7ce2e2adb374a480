# SPDX-License-Identifier: Apache-2.0
"""A repeated paper as data, and as a folder.

page.md        what agrees, what does not and why, with all tables and figures
result.json    the same for programs, and under `made_by` where it comes from
tables/        NAME.csv and NAME.json, one row for each number
figures/       NAME.png
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from loopcal.io.core.outputs import FolderKind, write_result_folder
from loopcal.io.core.text_file import to_json
from loopcal.papers.published import Comparison, Figure, Table, Verdict
from loopcal.report.pictures import render_figure
from loopcal.results import serialization

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

FOLDER = FolderKind(
    "study",
    "result.json",
    ("made_by", "paper"),
    ("page.md", "tables/*.csv", "tables/*.json", "figures/*.png"),
)


APART = 0.04
"""Least distance of the markers of a line, as a share of the diagonal of the axes."""


class Content(NamedTuple):
    """What a study shows: published beside computed numbers, one comparison for each table of the
    paper; further tables; the judged claims; figures.
    """

    comparisons: tuple[Comparison, ...]
    tables: tuple[Table, ...]
    verdicts: tuple[Verdict, ...]
    figures: tuple[Figure, ...]


@dataclass(frozen=True)
class Reproduction:
    """A repeated paper."""

    paper: str
    title: str
    source: str
    about: tuple[str, ...]  # paragraphs on what was done
    settings: Mapping[str, Any]  # seed and sizes of this run
    content: Content  # its results
    replaced: tuple[str, ...] = ()  # sizes of the study that another robot replaces, in sentences

    @property
    def verdict_groups(self) -> dict[str, tuple[tuple[int, Verdict], ...]]:
        """Verdicts with their numbers on a page, by title: statements of the paper, own checks."""
        ordered = sorted(self.content.verdicts, key=lambda verdict: verdict.is_own_check)
        robot = self.settings.get("robot")
        on = f", tested on {robot}" if robot else ""
        titles = {False: f"Statements of the paper{on}", True: f"Our own checks{on}"}
        groups = groupby(enumerate(ordered, 1), lambda pair: pair[1].is_own_check)
        return {titles[is_own]: tuple(group) for is_own, group in groups}

    def summary(self) -> Table:
        """Return how many numbers of each published table agree to one unit of their last digit."""
        columns = ("table", "numbers", "within one unit of the last digit",
                   "largest difference [units of the last digit]")  # fmt: skip
        rows = tuple(
            (c.title, c.within.size, int(c.within.sum()), float((abs(c.difference) / c.step).max()))
            for c in self.content.comparisons
        )
        return Table("summary", "Published and computed", columns, rows, ("", "d", "d", ".2g"))

    def to_dict(self) -> dict[str, Any]:
        """Return all content by name, for JSON."""
        return {
            **{name: value for name, value in vars(self).items() if name != "content"},
            "verdicts": self.content.verdicts,
            "figures": self.content.figures,
            "summary": self.summary().to_dict(),
            "comparisons": [c.table().to_dict() for c in self.content.comparisons],
            "tables": [table.to_dict() for table in self.content.tables],
        }


def write_page(reproduction: Reproduction, made_by: Mapping[str, Any]) -> str:
    """Return the page as Markdown; made_by : see `io.runs.run_folder.collect_provenance`."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    template = environment.get_template("page.md.j2")
    return template.render(reproduction=reproduction, content=reproduction.content, made_by=made_by)


def build_document(reproduction: Reproduction, made_by: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of result.json."""
    return {"made_by": made_by, **reproduction.to_dict()}


def write_folder(
    path: str | Path, reproduction: Reproduction, made_by: Mapping[str, Any], force: bool = False
) -> Path:
    """Write a reproduction whole or not at all, see `write_result_folder`; return the folder.

    made_by : where the results come from. force : replace an earlier one.
    """
    content, path = reproduction.content, Path(path)
    files = {"page.md": write_page(reproduction, made_by).encode("utf-8", "backslashreplace")}
    compared = [c.table() for c in content.comparisons]
    for table in (reproduction.summary(), *compared, *content.tables):
        rows = serialization.to_json(table.rows)  # numbers in full, null where one is not finite
        stream = StringIO()
        csv.writer(stream, lineterminator="\n").writerows([table.columns, *rows])
        files[f"tables/{table.name}.csv"] = stream.getvalue().encode()
        files[f"tables/{table.name}.json"] = to_json(table.to_dict()).encode()
    styles = choose_styles(content.figures)
    for figure in content.figures:
        files[f"figures/{figure.name}.png"] = render_figure(draw(figure, styles), ".png")
    write_result_folder(path, FOLDER, build_document(reproduction, made_by), files, force)
    return path


def choose_styles(figures: Sequence[Figure]) -> dict[str, dict[str, Any]]:
    """Return color and marker of each label of the legends: the same in all figures of a study;
    labels of one figure differ in color as far as there are colors.
    """
    from loopcal.report.figures.style import COLORS, MARKERS

    legends = [[s.label for s in f.series if not s.label.startswith("_")] for f in figures]
    chosen: dict[str, int] = {}
    for label in dict.fromkeys(label for legend in legends for label in legend):
        taken = {chosen.get(other) for legend in legends if label in legend for other in legend}
        free = (i for i in range(len(COLORS)) if i not in taken)
        chosen[label] = next(free, len(chosen) % len(COLORS))
    return {
        label: {"color": COLORS[color], "marker": MARKERS[i % len(MARKERS)]}
        for i, (label, color) in enumerate(chosen.items())
    }


def draw(figure: Figure, styles: Mapping[str, Mapping[str, Any]]) -> Canvas:
    """Draw a figure with its legend below the axes; styles : see `choose_styles`."""
    from matplotlib.ticker import MaxNLocator

    from loopcal.report.figures import style

    canvas = style.start_figure(7.2, 4.6)
    axes = canvas.add_subplot()
    handles = []
    for series in sorted(figure.series, key=lambda series: not series.label.startswith("_")):
        if series.label.startswith("_"):
            axes.plot(series.x, series.y, color=style.PALE, lw=style.THIN)
            continue
        is_line = figure.joined and series.joined
        handles += axes.plot(
            series.x, series.y, label=series.label, ms=style.DOT, lw=style.LINE * is_line,
            markevery=APART if is_line else None,
            fillstyle="full" if figure.joined else "none",  # points on points stay visible
            **styles[series.label],
        )  # fmt: skip
    for i, (label, value) in enumerate(figure.levels.items()):
        own = (styles[s.label]["color"] for s in figure.series if s.label in label)
        color, dashes = next(own, style.REFERENCE), ("--", ":", "-.")[i % 3]
        handles.append(axes.axhline(value, color=color, ls=dashes, lw=style.LINE, label=label))
    axes.set_xscale("log" if "x" in figure.log else "linear")
    axes.set_yscale("log" if "y" in figure.log else "linear")
    if "x" not in figure.log and all(x.is_integer() for s in figure.series for x in s.x):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.label_axes(axes, figure.x_label, figure.y_label)
    style.add_legend(canvas, handles)
    canvas.suptitle(figure.title, fontsize=style.TITLE)
    return canvas
