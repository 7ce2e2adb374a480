# SPDX-License-Identifier: Apache-2.0
"""`loopcal reproduce` repeats a published study; `loopcal per-leg` uses the method of one."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import loopcal as lc
from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.terminal import Output

if TYPE_CHECKING:
    from loopcal.papers.published import Reproduction
    from loopcal.papers.published import Table as PaperTable
    from loopcal.results.tables import Block, Table
    from loopcal.studies.simulation.published_steps import PerLegEstimate

RUN = "loopcal.papers.paper:Paper.run"
HEADING = 18
"""Characters of a line of a heading."""


@opt.command()
def reproduce(
    paper: str | None = opt.argument("[PAPER]", required=False),
    output: Path | None = opt.path(
        "Folder for a page, all tables (CSV, JSON) and figures (PNG).", "-o", metavar="FOLDER"
    ),
    seed: int = opt.option("Seed of all random choices.", of=RUN, type=int, metavar="N"),
    trials: int = opt.option(
        "Number of trials behind each statistical number.", of=RUN, type=opt.Count("TRIALS")
    ),
    robot: str | None = opt.option(
        "Robot, or its file, in place of the paper's robot.", metavar="ROBOT"
    ),
    epsilon: float | None = opt.EPSILON,
    force: bool = opt.flag("Replace an earlier result in FOLDER."),
) -> Output:
    """Repeat the study PAPER. Without PAPER, list the studies.

    Every number called computed comes from this run. The output lists unconfirmed statements of the
    paper with the reason. With --robot, the study is for another robot, and the output begins with
    the replaced sizes.

    Examples:
      loopcal reproduce
      loopcal reproduce hexapod-42
      loopcal reproduce hexapod-42 -o hexapod-42 --seed 1
      loopcal reproduce tsvd-2016 --robot mine.yaml -o study
      loopcal reproduce hexapod-42 --epsilon 1e-3
    """
    from loopcal.papers.paper import PAPERS, find_paper

    if paper is None:
        opt.refuse_given(
            ("output", "seed", "trials", "robot", "epsilon", "force"), "without the name of a study"
        )
        rows = [{"name": p.name, "title": p.title, "source": p.source} for p in PAPERS.values()]
        lines = [
            text for r in rows for text in (r["name"], f"    {r['title']}", f"    {r['source']}")
        ]
        return Output({"papers": rows}, lambda: lines)
    from loopcal.io.core.outputs import refuse_folder
    from loopcal.io.runs.run_folder import collect_provenance
    from loopcal.papers.published import FOLDER, build_document, write_folder

    chosen = find_paper(paper)
    if output is not None:
        refuse_folder(output, FOLDER, force)

    def print_step(text: str) -> None:
        if sys.stderr.isatty():
            terminal.print_message(text)

    result = chosen.run(seed, trials, print_step, robot, epsilon)
    made_by = collect_provenance(opt.list_words(), {}, {"seed": seed})
    last = "Add -o FOLDER for all tables and figures."
    if output is not None:
        write_folder(output, result, made_by, force)
        last = f"Written to {output}: page.md, tables, figures"
    return Output(build_document(result, made_by), lambda: [*_view_reproduction(result), "", last])


@opt.command()
def per_leg(
    robot: str = opt.ROBOT,
    data: tuple[Path, ...] = opt.data(),
    steps: int = opt.option(
        "Gauss-Newton steps.",
        of="loopcal.studies.simulation.published_steps:identify_per_leg",
        type=opt.Count("STEPS", 1),
    ),
    epsilon: float | None = opt.EPSILON,
    output: Path | None = opt.path("Robot file to write, with the identified values.", "-o"),
    force: bool = opt.force("the output file"),
    allowed: dict[str, bool] = opt.ALLOWED,
) -> Output:
    """Identify the hexapod ROBOT leg by leg from full poses DATA, as the study hexapod-42 does.

    All equations have weight one, without the noise that the legs share. The result lacks
    uncertainties and has larger errors than a calibration: the command is for comparisons.

    Examples:
      loopcal per-leg hexapod-42 measurements.csv
      loopcal per-leg hexapod-42 measurements.csv --steps 2 -o per-leg.yaml
      loopcal per-leg hexapod-42 measurements.csv --steps 20 --epsilon 1e-3
    """
    from loopcal.studies.simulation.published_steps import identify_per_leg

    machine = opt.open_robot(robot, (output,), data, force)
    measurements = opt.read_fitted_measurements(data, machine, allowed)
    estimate = identify_per_leg(machine, measurements, steps, epsilon or 0.0)
    if output is not None:
        lc.save_robot(estimate.robot, output)
    poses = len(measurements.readings)
    if not estimate.is_converged:
        reached, wanted = estimate.integrated_errors[-1], epsilon
        terminal.print_finding("fit.epsilon-not-met", steps=steps, reached=reached, wanted=wanted)
    return Output(estimate.to_dict(), lambda: _view_legs(estimate, poses, output))


def _view_legs(estimate: PerLegEstimate, poses: int, output: Path | None) -> list[Block]:
    """Return the steps, the condition numbers of the legs and the parameters."""
    from loopcal.findings.wording import name_count
    from loopcal.results.tables import Column, Table, word_column

    columns = (word_column("parameter"), *map(Column, ("unit", "nominal", "estimate", "change")))
    parameters = estimate.to_dict()["parameters"]

    def show(row: Mapping[str, Any], key: str) -> str:
        """Return six digits; 0 below a hundredth of the last digit of the largest in its unit."""
        size = max(abs(other[key]) for other in parameters if other["unit"] == row["unit"])
        return f"{row[key] if abs(row[key]) > 1e-8 * size else 0.0:.6g}"

    rows = [
        (row["name"], row["unit"], show(row, "nominal"), show(row, "estimate"),
         f"{row['estimate'] - row['nominal']:+.3g}")
        for row in parameters
    ]  # fmt: skip
    conditions = ", ".join(f"{condition:.0f}" for condition in estimate.conditions)
    errors = ", ".join(f"{error:.2g}" for error in estimate.integrated_errors)
    name, count = estimate.robot.name, name_count(estimate.steps, "step")
    note = "No uncertainties: this method ignores the noise of the instrument."
    page: list[Block] = [
        f"{name} identified leg by leg from {poses} full poses: {count}",
        f"Largest error of a pose, max dQint, before and after each step: {errors} mm + rad",
        f"Condition numbers of the legs: {conditions}",
        Table("Parameters", columns, tuple(rows)),
        f"{note} For calibrations use loopcal calibrate.",
    ]
    return page if output is None else [*page, f"Written to {output}"]


def _view_reproduction(result: Reproduction) -> list[Block]:
    """Return the summary, the tables and the statements of the paper."""
    page: list[Block] = [f"{result.paper}: {result.title}", *result.replaced]
    summary = (result.summary(),) if result.content.comparisons else ()
    for table in (*summary, *result.content.tables):
        page += [_make_table(table), *([f"{table.cut} All: -o FOLDER."] if table.cut else [])]
    for title, verdicts in result.verdict_groups.items():
        page += ["", title]
        for number, verdict in verdicts:
            word = verdict.word.upper() if verdict.agrees is False else verdict.word.lower()
            place = "" if verdict.is_own_check else f" ({verdict.where})"
            page += [f"{number:2}. {word}: {verdict.claim}{place}", f"    {verdict.reason}"]
    return page


def _make_table(printed: PaperTable) -> Table:
    """Return a table of a study; long headings are broken."""
    from loopcal.results.tables import Column, Table, word_column

    headings = ["\n".join(textwrap.wrap(column, HEADING)) for column in printed.columns]
    columns = (word_column(headings[0], wraps=True), *(Column(title) for title in headings[1:]))
    return Table(printed.title, columns, tuple(printed.text()))
