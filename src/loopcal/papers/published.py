# SPDX-License-Identifier: Apache-2.0
"""What a paper prints and says, read from its data files, and what a run puts beside it.

published.yaml holds the printed numbers as text, digit by digit. The last printed digit is the
yardstick: a computed number agrees if it is within one unit of it ("0.0352" has the unit 1e-4,
"-9E-05" the unit 1e-5). sizes.yaml holds the sizes that are ours. text.yaml holds the words:

    about: paragraphs at the beginning of the page
    claims:
      NAME:
        claim: a sentence
        where: place in the paper; a claim without it is a check of our own
        of: "these machines" for a claim about the machines of the paper alone
        evidence: sentences that show the numbers
    tables:
      NAME: {title: ..., columns: [...], formats: [...], note: ..., shown: rows on a page}
    figures:
      NAME: {title: ..., x: label, y: label, caption: ..., log: y}

Braces hold numbers in the formats of `loopcal.findings.wording`. A repeated paper is a folder:

    page.md        what agrees, what does not and why, with all tables and figures
    result.json    the same for programs, and under `made_by` where it comes from
    tables/        NAME.csv and NAME.json, one row for each number
    figures/       NAME.png
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache, cached_property
from io import StringIO
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from loopcal.findings.wording import fill_template
from loopcal.io.core.outputs import FolderKind, write_result_folder
from loopcal.io.core.text_file import to_json
from loopcal.io.core.yaml_file import read_yaml
from loopcal.report.pictures import render_figure
from loopcal.results import serialization
from loopcal.results.description import Field, fields
from loopcal.studies.study_result import Interval, compute_binomial_interval
from loopcal.typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

Cell = str | float | int | bool | None
Row = dict[str, Any]
"""A row of a table: its cells by name, in the order of the columns."""
# Of a unit, by which a difference may exceed it: decimal numbers are no binary ones.
ROUNDING = 1e-9


@dataclass(frozen=True)
class Table:
    """Rows of text and numbers; name : of its file. formats : of the columns on a page ("" for
    text). shown : places of the rows on a page, None for all.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    formats: tuple[str, ...]
    note: str = ""
    shown: tuple[int, ...] | None = None

    FIELDS: ClassVar[tuple[Field, ...]] = fields("name", "title", "note", "columns", "rows")

    @property
    def cut(self) -> str:
        """How many of its rows a page shows, as a sentence; empty where it shows all."""
        shown, count = self.shown, len(self.rows)
        return "" if shown is None or len(shown) == count else f"{len(shown)} of {count} rows."

    def text(self) -> list[tuple[str, ...]]:
        """Rows as a page shows them; a dash for what does not exist."""

        def show(cell: Cell, spec: str) -> str:
            if cell is None or (isinstance(cell, float) and np.isnan(cell)):
                return "-"
            if isinstance(cell, bool):
                return "yes" if cell else "no"
            return cell if isinstance(cell, str) else format(cell, spec)

        assert all(len(row) == len(self.formats) for row in self.rows), self.name
        shown = self.rows if self.shown is None else [self.rows[i] for i in self.shown]
        return [tuple(map(show, row, self.formats)) for row in shown]


@dataclass(frozen=True)
class Series:
    """A line of a figure: points x, y. A label that begins with _ is not in the legend. joined :
    whether a line joins the points.
    """

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    joined: bool = True

    @classmethod
    def of(cls, label: str, x: Iterable[Any], y: Iterable[Any], joined: bool = True) -> Series:
        """Return a line of numbers."""
        return cls(label, tuple(map(float, x)), tuple(map(float, y)), joined)


@dataclass(frozen=True)
class Figure:
    """A figure as data."""

    name: str  # of its file
    title: str
    x_label: str
    y_label: str
    caption: str
    series: tuple[Series, ...]
    levels: Mapping[str, float] = field(default_factory=dict)  # horizontal lines by label
    log: str = "y"  # logarithmic axes: "", "x", "y" or "xy"
    joined: bool = True  # whether lines join points; not if the order along x means nothing


@dataclass(frozen=True)
class Printed:
    """A block of printed numbers: a row of texts under each label."""

    rows: Mapping[str, tuple[str, ...]]

    @classmethod
    def parse(cls, lines: Mapping[str, str]) -> Printed:
        """Read lines of numbers separated by blanks."""
        return cls({label: tuple(line.split()) for label, line in lines.items()})

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the rows."""
        return tuple(self.rows)

    @cached_property
    def values(self) -> FloatArray:
        """(r, c) the numbers, in the units they are printed in."""
        return np.array([list(map(float, row)) for row in self.rows.values()])

    @cached_property
    def unit(self) -> FloatArray:
        """(r, c) one unit of the last digit."""
        return np.array([list(map(last_digit, row)) for row in self.rows.values()])


@dataclass(frozen=True, eq=False)
class Comparison:
    """A published table beside computed numbers (r, c), which agree within a step (r, c)."""

    name: str
    title: str
    columns: tuple[str, ...]
    published: Printed
    computed: FloatArray
    step: FloatArray
    note: str = ""

    @cached_property
    def difference(self) -> FloatArray:
        """(r, c) computed - published."""
        return self.computed - self.published.values

    @cached_property
    def within(self) -> BoolArray:
        """(r, c) which numbers agree."""
        return np.abs(self.difference) <= self.step * (1.0 + ROUNDING)

    def table(self) -> Table:
        """One row for each number, of which a page shows those that differ by more than a unit."""
        numbers = (self.computed, self.difference, self.step, self.within)
        rows = [
            (label, column, printed, *(array[i, j].item() for array in numbers))
            for i, (label, texts) in enumerate(self.published.rows.items())
            for j, (column, printed) in enumerate(zip(self.columns, texts, strict=True))
        ]
        columns = ("row", "column", "published", "computed", "difference",
                   "unit of the last digit", "within one unit")  # fmt: skip
        formats = ("", "", "", ".9g", ".2g", ".0e", "")
        shown = tuple(np.flatnonzero(~self.within).tolist())
        return Table(self.name, self.title, columns, tuple(rows), formats, self.note, shown)


@dataclass(frozen=True)
class PaperFile:
    """A file beside a module of a paper (its `__file__`), read when it is first asked."""

    module: str
    name: str

    def find(self, *keys: str) -> Any:
        """Return the text, number, list or mapping at these keys."""
        found = _read_file(self.module, self.name)
        for key in keys:
            found = found[key]
        return found

    def number(self, *keys: str) -> float:
        """Return the printed number at these keys."""
        return float(self.find(*keys))

    def table(self, *keys: str) -> Printed:
        """Return the block of printed numbers at these keys."""
        return Printed.parse(self.find(*keys))


@cache
def _read_file(module: str, name: str) -> dict[str, Any]:
    return read_yaml(Path(module).with_name(name), "file of a paper", has_names=False).content


# Place of a claim that the paper does not make.
OWN_CHECK = "our own check, not a statement of the paper"


@dataclass(frozen=True)
class Verdict:
    """The judgement of one claim."""

    claim: str
    # whether the numbers support it; None if they cannot decide, or if draws differ
    agrees: bool | None
    why: str  # the evidence in a sentence or two, with the numbers of this run
    where: str  # place in the paper, or OWN_CHECK
    name: str = ""  # in text.yaml
    # whether each repeated draw of a random study supports the claim (None: cannot decide)
    draws: tuple[bool | None, ...] = ()
    is_elsewhere: bool = False  # contradicted by machines other than those it speaks about

    @property
    def is_own_check(self) -> bool:
        """Whether the claim is a check of ours and not a statement of the paper."""
        return self.where == OWN_CHECK

    @property
    def word(self) -> str:
        """The judgement as a word: a claim of the paper agrees, a check of ours is confirmed."""
        if self.agrees is None:
            return "Undecided"
        if self.is_own_check:
            return "Confirmed" if self.agrees else "Not confirmed"
        return "Agrees" if self.agrees else "Does not agree"

    @property
    def reason(self) -> str:
        """How many of the repeated draws support the claim, and the evidence."""
        sentences = [self.why]
        if self.is_elsewhere:
            sentences.insert(0, "The claim is about machines of other dimensions.")
        if self.draws:
            share, count = estimate_share(self.draws), sum(map(bool, self.draws))
            idle = f"{n} decide nothing; " if (n := self.draws.count(None)) else ""
            sentences.insert(
                0, f"True in {count} of {len(self.draws)} draws ({idle}95 % interval of the share: "
                f"{100 * share.low:.0f} to {100 * share.high:.0f} %)."
            )  # fmt: skip
        return " ".join(sentences)


Decision = bool | np.bool_ | None


def estimate_share(draws: Sequence[bool | None]) -> Interval:
    """Return the share of draws that support a claim, with its exact 95 % interval; draws that
    decide nothing (None) do not count.
    """
    decided = [draw for draw in draws if draw is not None]
    return compute_binomial_interval(sum(decided), len(decided))


def decide_share(draws: Sequence[bool | None]) -> bool | None:
    """Return whether draws support a claim: the 95 % interval of their share lies above one half;
    False where it lies below, None where it contains one half.
    """
    share = estimate_share(draws)
    return decide(share.low > 0.5, share.high < 0.5)


def decide_each(holds: BoolArray, usable: BoolArray) -> list[bool | None]:
    """Return of each machine (t,) whether a statement holds; None where it is not usable."""
    return [*map(decide, holds & usable, ~holds & usable)]


def decide(agrees: Decision, disagrees: Decision) -> bool | None:
    """Return whether numbers support a claim; None if they neither do nor contradict it."""
    return True if agrees else False if disagrees else None


@dataclass(frozen=True)
class PaperText:
    """The text.yaml beside a module of a paper (its `__file__`), filled with numbers `data`."""

    module: str

    def find(self, *keys: str) -> Any:
        """Return the text or mapping at these keys."""
        return PaperFile(self.module, "text.yaml").find(*keys)

    def about(self, robot: str = "") -> tuple[str, ...]:
        """Return the paragraphs at the beginning of the page; robot : name of another one."""
        source = PaperFile(self.module, "published.yaml").find("source")
        return tuple(fill_template(text, source=source, robot=robot) for text in self.find("about"))

    def list_replaced(self, names: Iterable[str], **data: Any) -> tuple[str, ...]:
        """Return the sentences of these names on sizes that another robot or rule replaces."""
        return tuple(fill_template(self.find("replaced", name), **data) for name in names)

    def judge(
        self, name: str, agrees: Decision | Sequence[Decision] | BoolArray, /,
        *, elsewhere: bool = True, **data: Any,
    ) -> Verdict:  # fmt: skip
        """Return the verdict on a claim.

        agrees : one decision, or that of each repeated draw, see `decide_share`. elsewhere :
        whether the machines have other dimensions than those of the paper. They do not refute a
        claim that is marked with `of: these machines`.
        """
        record, draws = self.find("claims", name), ()
        if isinstance(agrees, (Sequence, np.ndarray)):
            draws = tuple(None if a is None else bool(a) for a in agrees)
            agrees = decide_share(draws)
        claim, why = (fill_template(record[key], **data) for key in ("claim", "evidence"))
        agrees = None if agrees is None else bool(agrees)
        is_elsewhere = agrees is False and elsewhere and record.get("of") == "these machines"
        agrees = None if is_elsewhere else agrees
        where = record.get("where", OWN_CHECK)
        return Verdict(claim, agrees, why, where, name, draws, is_elsewhere)

    def table(
        self, name: str, rows: Iterable[Row | Sequence[Any]], file_name: str = "",
        more: Sequence[tuple[str, str]] = (), shown: Iterable[int] | None = None, /, **data: Any,
    ) -> Table:  # fmt: skip
        """Return a table of computed rows; more : titles and formats of further columns. shown :
        places of the rows on a page, by default the first ones, as many as text.yaml says.
        """
        text = self.find("tables", name)
        titles = (text["title"], text.get("note", ""), *text["columns"], *(t for t, _ in more))
        title, note, *columns = (fill_template(part, **data) for part in titles)
        formats = (*text["formats"], *(spec for _, spec in more))
        cells = tuple(
            tuple(
                cell.item() if isinstance(cell, np.generic) else cell
                for cell in (row.values() if isinstance(row, Mapping) else row)
            )
            for row in rows
        )
        if shown is None and "shown" in text:
            shown = range(min(text["shown"], len(cells)))
        places = None if shown is None else tuple(shown)
        return Table(file_name or name, title, tuple(columns), cells, formats, note, places)

    def compare(
        self, name: str, published: Printed, computed: FloatArray, step: FloatArray | None = None,
        /, **data: Any,
    ) -> Comparison:  # fmt: skip
        """Return a published table beside computed numbers (r, c), which agree within `step` (r,
        c), by default one unit of the last printed digit.
        """
        text = self.find("tables", name)
        step = published.unit if step is None else step
        note, columns = fill_template(text.get("note", ""), **data), tuple(text["columns"])
        return Comparison(name, text["title"], columns, published, computed, step, note)

    def figure(
        self, name: str, series: Iterable[Series], levels: Mapping[str, float] | None = None,
        file_name: str = "", log: str | None = None, /, *, joined: bool = True, **data: Any,
    ) -> Figure:  # fmt: skip
        """Return a figure; log : default that of text.yaml."""
        text = self.find("figures", name)
        title, x, y, caption = (
            fill_template(text[key], **data) for key in ("title", "x", "y", "caption")
        )
        log = str(text.get("log", "y")) if log is None else log
        name, lines = file_name or name, tuple(series)
        return Figure(name, title, x, y, caption, lines, levels or {}, log, joined)


def last_digit(text: str) -> float:
    """Return one unit of the last digit of a printed number.

    Examples
    --------
    >>> last_digit("-0.0352"), last_digit("-9E-05"), last_digit("200"), last_digit("1.20E-09")
    (0.0001, 1e-05, 1.0, 1e-11)
    """
    return float(Decimal(1).scaleb(int(Decimal(text).as_tuple().exponent)))


# A repeated paper as data, and as a folder.

FOLDER = FolderKind(
    "study",
    "result.json",
    ("made_by", "paper"),
    ("page.md", "tables/*.csv", "tables/*.json", "figures/*.png"),
)


APART = 0.04  # least distance of the markers of a line, as a share of the diagonal of the axes


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

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("paper", "title", "source", "about", "settings", "replaced"),
        verdicts="content.verdicts",
        figures="content.figures",
        summary=lambda made: made.summary(),
        comparisons=lambda made: [c.table() for c in made.content.comparisons],
        tables="content.tables",
    )

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
    return {"format": 1, "made_by": made_by, **serialization.json_fields(reproduction)}


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
        document = {"format": 1, **serialization.json_fields(table)}
        files[f"tables/{table.name}.json"] = to_json(document).encode()
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
    from loopcal.report.figures import style

    canvas = style.start_figure(7.2, 4.6)
    axes = canvas.add_subplot()
    for series in sorted(figure.series, key=lambda series: not series.label.startswith("_")):
        if series.label.startswith("_"):
            axes.plot(series.x, series.y, color=style.PALE, lw=style.THIN)
            continue
        is_line = figure.joined and series.joined
        axes.plot(
            series.x, series.y, label=series.label, ms=style.DOT, lw=style.LINE * is_line,
            markevery=APART if is_line else None,
            fillstyle="full" if figure.joined else "none",  # points on points stay visible
            **styles[series.label],
        )  # fmt: skip
    for i, (label, value) in enumerate(figure.levels.items()):
        own = (styles[s.label]["color"] for s in figure.series if s.label in label)
        color, dashes = next(own, style.REFERENCE), ("--", ":", "-.")[i % 3]
        axes.axhline(value, color=color, ls=dashes, lw=style.LINE, label=label)
    axes.set_xscale("log" if "x" in figure.log else "linear")
    axes.set_yscale("log" if "y" in figure.log else "linear")
    if "x" not in figure.log and all(x.is_integer() for s in figure.series for x in s.x):
        style.label_sparsely(axes.xaxis)
    style.label_axes(axes, figure.x_label, figure.y_label)
    style.add_legend(canvas)
    return style.finish_figure(canvas, figure.title)
