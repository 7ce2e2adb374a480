# SPDX-License-Identifier: Apache-2.0
"""`loopcal study`: many simulated calibrations, described by a file. `loopcal reproduce` repeats a
published study, and `loopcal per-leg` uses the method of one.
"""

from __future__ import annotations

import os
import re
import sys
import textwrap
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import loopcal as lc
from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.entry_point import CommandGroup
from loopcal.cli.hints import hint_for, suggest_command
from loopcal.cli.terminal import Output
from loopcal.errors import StudyError

if TYPE_CHECKING:
    from loopcal.papers.published import Reproduction
    from loopcal.papers.published import Table as PaperTable
    from loopcal.results.tables import Block, Table
    from loopcal.studies.executors import Executor
    from loopcal.studies.files.store import StudyStore
    from loopcal.studies.running import Share
    from loopcal.studies.simulation.published_steps import PerLegEstimate
    from loopcal.studies.specification import Study

STOPPED, INCOMPLETE = 1, 2
"""Exit codes of a study that was stopped, and of one with blocks that could not be computed."""


def _parse_share(text: str) -> Share:
    """Return a share such as 3/10: the third of ten parts."""
    from loopcal.studies.running import Share

    match = re.fullmatch(r"([1-9]\d{0,8})/([1-9]\d{0,8})", text)
    if match is None or int(match[1]) > int(match[2]):
        raise StudyError(f"{text!r} is not a share. Write 3/10 for the third of ten parts")
    return Share(int(match[1]), int(match[2]))


def _choose_work(stated: Mapping[str, Any]) -> tuple[Executor, Share]:
    """Return who computes a study, and which share of it, from the values of `WORK`."""
    from loopcal.studies.running import WHOLE, make_local

    share, workers = stated["share"] or WHOLE, stated["workers"]
    if stated["dask"] is not None:
        opt.refuse_given(("workers", "ray"), "with --dask")
        return lc.Dask(stated["dask"]), share
    if stated["ray"]:
        opt.refuse_given(("workers",), "with --ray")
        return lc.Ray(), share
    return make_local(count_processors() if workers is None else workers), share


STUDY: Any = opt.argument("STUDY", type=opt.FILE)
FOLDER: Any = opt.argument("FOLDER", type=opt.FILE)
QUICK: Any = opt.flag("Use the quick tier of STUDY, which takes seconds.")
WORK: Any = opt.Group(
    _choose_work,
    workers=opt.option(
        "Processes that compute.  [default: the number of processors]", type=opt.Count("WORKERS", 1)
    ),
    dask=opt.option("Use a dask cluster, by the address of its scheduler.", metavar="ADDRESS"),
    ray=opt.flag("Use the ray cluster of the variable RAY_ADDRESS, or start one here."),
    share=opt.option(
        "Compute a share only, such as 3/10 for the third of ten jobs. Join their folders with "
        "merge.",
        "--cells",
        type=opt.Parsed("part", _parse_share),
        metavar="PART/PARTS",
    ),
)


def run_and_report(
    chosen: Study, store: StudyStore, folder: Path, work: tuple[Executor, Share]
) -> Output:
    """Compute what is missing in an open store; Ctrl-C ends it with what is kept."""
    from loopcal.findings import report_finding
    from loopcal.results.serialization import to_json
    from loopcal.studies.running import count_blocks, count_stored, run_blocks

    executor, share = work
    try:
        with terminal.TerminalProgress() as progress:
            report = run_blocks(chosen, store, executor, share, progress)
    except KeyboardInterrupt:
        done, total = count_stored(chosen, store, share), count_blocks(chosen, share)
        finding = report_finding("store.stopped", done=done, total=total, folder=str(folder))
        terminal.print_message(f"loopcal: {finding}")
        terminal.print_message("Hint: use --resume to continue")
        raise click.exceptions.Exit(STOPPED) from None
    for finding in report.findings:
        terminal.print_message(f"loopcal: {finding}")
    stored = f"{report.before + report.computed} of {report.total} blocks are stored in {folder}"
    spent = f"{report.trials} trials in {round_duration(report.seconds)}"
    page = [f"{stored}: {report.computed} new, {spent}"]
    page += [suggest_command("study", "summary", folder)] if report.is_complete else []
    document = {**to_json(report), "is_complete": report.is_complete, "folder": str(folder)}
    return Output(document, lambda: page, exit_code=0 if report.is_complete else INCOMPLETE)


def round_duration(seconds: float) -> str:
    """Return a duration to two digits, in the largest unit in which it is at least one."""
    unit, factor = next((u for u in (("h", 3600.0), ("min", 60.0)) if seconds >= u[1]), ("s", 1.0))
    return f"{float(f'{seconds / factor:.2g}'):.6g} {unit}"


def count_processors() -> int:
    """Return the number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


@click.group(cls=CommandGroup)
def study() -> None:
    """Simulate thousands of calibrations to answer questions before anything is measured: which
    instrument, how many poses, which method.

    \b
    From a question to its answer:
      loopcal study new study.yaml
      loopcal study check study.yaml
      loopcal study run study.yaml -o results
      loopcal study summary results
    """


@opt.command(of=study)
def new(
    study_file: Path = STUDY,
    robot: str | None = opt.option(
        "A robot, or its file.  [default: linear-delta, or the robot of PAPER]", metavar="ROBOT"
    ),
    paper: str | None = opt.option(
        "Write the study of a paper that reproduce repeats.", metavar="PAPER"
    ),
    force: bool = opt.force("STUDY"),
) -> Output:
    """Write a study file to fill in, with a comment for each setting.

    With --paper, write the study of a paper: its errors, noises and methods. With --robot,
    replace its robot, and list the sizes that change with it.

    Examples:
      loopcal study new study.yaml
      loopcal study new study.yaml --robot hexapod-42
      loopcal study new study.yaml --paper cmm-constraint-2011 --robot hexapod-42
    """
    from loopcal.io.core.outputs import refuse_outputs, write_files
    from loopcal.studies.files.study_file import write_template

    following = suggest_command("study", "check", study_file)
    if paper is not None:
        from loopcal.papers.paper import find_paper, make_paper_study

        chosen = find_paper(paper)
        replaced = chosen.make_case(robot).list_replaced()  # refuses a robot that does not fit
        made = make_paper_study(chosen, study_file, robot)
        refuse_outputs(tuple(made), (), force)
        write_files(made)
        written = [*map(str, made)]
        page = [f"Written: {', '.join(written)}", *replaced, following]
        document = {"written": written, "paper": paper, "robot": robot or chosen.robots[0]}
        return Output(document | {"replaced": replaced}, lambda: page)
    robot = "linear-delta" if robot is None else robot
    refuse_outputs((study_file,), (), force)
    write_template(study_file, robot)
    page = [f"Written: {study_file}", following]
    return Output({"written": str(study_file), "robot": robot}, lambda: page)


@opt.command(of=study)
def check(study_file: Path = STUDY, quick: bool = QUICK) -> Output:
    """Read STUDY, show its cells, and estimate the time that it takes from one block of each robot.

    Examples:
      loopcal study check study.yaml
      loopcal study check study.yaml --quick
    """
    from loopcal.studies.running import estimate_time, read_source, view_estimate

    chosen = read_source(study_file, quick).study
    with terminal.TerminalProgress() as progress:
        estimate = estimate_time(chosen, count_processors(), progress)
    following = suggest_command("study", "run", study_file, "-o", "FOLDER")
    return Output(estimate, lambda: [*view_estimate(chosen, estimate, round_duration), following])


@opt.command(of=study)
def run(
    study_file: Path = STUDY,
    folder: Path = opt.path("Folder to make.", "-o", "--output", required=True, metavar="FOLDER"),
    work: tuple[Executor, Share] = WORK,
    resume: bool = opt.flag(
        "Continue FOLDER if it exists. STUDY may have more replicates or levels than before."
    ),
    quick: bool = QUICK,
) -> Output:
    """Compute STUDY, and store its trials in FOLDER.

    FOLDER gets every block of trials when it is complete. A stopped study only loses the blocks in
    work. --resume continues it.

    Examples:
      loopcal study run study.yaml -o results
      loopcal study run study.yaml -o results --resume --workers 4
      loopcal study run study.yaml -o results --dask tcp://scheduler:8786
      loopcal study run study.yaml -o part-3 --cells 3/10
    """
    from loopcal.studies.files.store import open_study
    from loopcal.studies.running import read_source

    source = read_source(study_file, quick)
    with open_study(folder, source, resume) as store:
        return run_and_report(source.study, store, folder, work)


@opt.command(of=study)
def extend(
    folder: Path = FOLDER,
    replicates: int = opt.option(
        "Trials of a cell.", type=opt.Count("REPLICATES", 1), required=True
    ),
    work: tuple[Executor, Share] = WORK,
) -> Output:
    """Compute further trials of each cell of a study, until there are N. Finished ones stay.

    Examples:
      loopcal study extend results --replicates 5000
    """
    from loopcal.studies.files.store import StudySource, open_study, read_study

    source = StudySource(replace(read_study(folder), replicates=replicates))
    with open_study(folder, source, resume=True) as store:
        return run_and_report(source.study, store, folder, work)


@opt.command(of=study)
def status(folder: Path = FOLDER) -> Output:
    """Show the progress of a study, also while it runs.

    Examples:
      loopcal study status results
    """
    from loopcal.studies.study_result import read_status, view_status

    state = read_status(folder)
    return Output(state, lambda: view_status(state, round_duration))


@opt.command(of=study)
def summary(
    folder: Path = FOLDER,
    scores: tuple[str, ...] = opt.option(
        "Score to show. Repeatable.", "--score", multiple=True, metavar="NAME"
    ),
    against: str | None = opt.option(
        "Factor along the axis of figures, such as poses.", metavar="FACTOR"
    ),
) -> Output:
    """Show medians and coverage of each cell, with intervals, the failed trials by reason, and the
    answers to the questions of the study file.

    It also writes summary.json and summary.csv, with all scores, and a figure of each shown score
    into FOLDER.

    Examples:
      loopcal study summary results
      loopcal study summary results --score position_max --score condition
      loopcal study summary results --score position --against instrument
    """
    from loopcal.studies import study_result
    from loopcal.studies.summary_drawing import render_figures

    result = study_result.StudyResult(folder)
    with terminal.TerminalProgress("summarizing trials"):
        summarized, answered = result.summarize(), result.answer_questions()
        shown = study_result.list_shown(result.study, summarized, scores)
        page = study_result.view_summary(result.study, summarized, shown)
        figures = render_figures(result.study, summarized, shown, against)
        study_result.write_summary(folder, result.study, summarized, answered, figures)
    written = f"Written to {folder}: {', '.join(('summary.json', 'summary.csv', *figures))}"
    return Output(
        study_result.build_document(summarized, answered),
        lambda: [*page, "", *study_result.view_answers(answered), written],
    )


@opt.command(of=study)
def ask(
    folder: Path = FOLDER,
    smallest: str | None = opt.option(
        "Ask for its smallest level, such as poses.", metavar="FACTOR"
    ),
    largest: str | None = opt.option("Ask for its largest level, such as noise.", metavar="FACTOR"),
    score: str = opt.option(
        "Score that stays within the limit.", default="position", metavar="NAME"
    ),
    limit: str = opt.option(
        "Of the score, with its unit, such as 10um.", required=True, metavar="LIMIT"
    ),
    share: float = opt.option(
        "Share of the machines that stay within the limit.", type=opt.OPEN_SHARE, default=0.95
    ),
) -> Output:
    """Find the smallest or largest level of a factor that reaches a limit on a share of machines.

    The answer says which levels reach it for certain, and which may. For uncertain levels, run more
    replicates with loopcal study extend.

    Examples:
      loopcal study ask results --smallest poses --limit 10um
      loopcal study ask results --largest noise --score position_max --limit 0.05mm --share 0.9
    """
    from loopcal.studies.study_result import StudyResult, view_answers

    if (smallest is None) == (largest is None):
        raise click.UsageError("give --smallest FACTOR or --largest FACTOR, one of them")
    result = StudyResult(folder)
    answered = (
        result.find_smallest(smallest, score, limit, share)
        if smallest is not None
        else result.find_largest(largest or "", score, limit, share)
    )
    return Output(answered, lambda: view_answers([answered]))


@opt.command(of=study)
def export(
    folder: Path = FOLDER,
    output: Path = opt.path("Table: .csv or .parquet.", "-o", required=True, metavar="FILE"),
    force: bool = opt.force("FILE"),
) -> Output:
    """Write all trials of a study as one table, with all factors as columns and numbers in SI.

    Examples:
      loopcal study export results -o trials.csv
      loopcal study export results -o trials.parquet
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.studies.files.store import read_store
    from loopcal.studies.study_result import export_trials

    refuse_outputs((output,), (), force)
    with read_store(folder) as store, terminal.TerminalProgress() as progress:
        count = export_trials(store, output, progress)
    document = {"written": str(output), "trials": count}
    return Output(document, lambda: [f"Written: {output} ({count} trials)"])


@opt.command(of=study)
def merge(
    part_folders: tuple[Path, ...] = opt.argument(
        "PART...", nargs=-1, required=True, type=opt.FILE
    ),
    output: Path = opt.path("Folder to make or to add to.", "-o", required=True, metavar="FOLDER"),
) -> Output:
    """Join folders of jobs that each computed a share of one study (see run --cells).

    Examples:
      loopcal study merge part-1 part-2 part-3 -o results
    """
    from loopcal.studies.files.store import merge_studies
    from loopcal.studies.study_result import read_status, view_status

    with terminal.TerminalProgress() as progress:
        count = merge_studies(part_folders, output, progress)
    state = read_status(output)
    written = f"Written to {output}: {count} new blocks"
    return Output(
        {"new_blocks": count, "status": state},
        lambda: [written, *view_status(state, round_duration)],
    )


@opt.command(of=study)
def replay(
    folder: Path = FOLDER,
    trial: str = opt.argument("CELL/TRIAL"),
    output: Path = opt.path("Run folder to make.", "-o", required=True, metavar="RUN"),
    force: bool = opt.force("RUN"),
) -> Output:
    """Repeat one trial of a study as a normal calibration, with all its checks and a run folder.

    Cells and trials count from 0, as in study status. A second folder, RUN-input, gets the robot
    file, the measurements and the true machine.

    Examples:
      loopcal study replay results 3/17 -o trial
    """
    from loopcal.studies.running import calibrate_trial

    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", trial)
    if match is None:
        raise click.BadParameter(f"{trial!r} is not CELL/TRIAL, such as 3/17")
    from loopcal.report.calibration_view import view_calibration

    with terminal.TerminalProgress() as progress:
        done = calibrate_trial(
            folder, int(match[1]), int(match[2]), output, opt.list_words(), force, progress
        )

    def view() -> list[Block]:
        for finding in done.findings:
            terminal.print_note(finding)
        written = f"Written to {output}, and its inputs to {done.inputs}"
        return [*view_calibration(done.report, False, hint_for), "", written]

    return Output(done.document, view, exit_code=done.report.exit_code)


RUN = "loopcal.papers.paper:Paper.run"
HEADING = 18  # characters of a line of a heading


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
    from loopcal.results.serialization import json_fields
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
    return Output(json_fields(estimate), lambda: _view_legs(estimate, poses, output))


def _view_legs(estimate: PerLegEstimate, poses: int, output: Path | None) -> list[Block]:
    """Return the steps, the condition numbers of the legs and the parameters."""
    from loopcal.findings.wording import name_count
    from loopcal.results.description import Field
    from loopcal.results.tables import Column, build_table

    parameters = estimate.list_parameters()

    def show(row: Mapping[str, Any], key: str) -> str:
        """Return six digits; 0 below a hundredth of the last digit of the largest in its unit."""
        size = max(abs(other[key]) for other in parameters if other["unit"] == row["unit"])
        return f"{row[key] if abs(row[key]) > 1e-8 * size else 0.0:.6g}"

    table = build_table(
        "Parameters",
        parameters,
        Field("name", title="parameter"),
        (Column("unit"), lambda row: row["unit"]),
        *((Column(key), lambda row, key=key: show(row, key)) for key in ("nominal", "estimate")),
        (Column("change"), lambda row: f"{row['estimate'] - row['nominal']:+.3g}"),
    )
    conditions = ", ".join(f"{condition:.0f}" for condition in estimate.conditions)
    errors = ", ".join(f"{error:.2g}" for error in estimate.integrated_errors)
    name, count = estimate.robot.name, name_count(estimate.steps, "step")
    note = "No uncertainties: this method ignores the noise of the instrument."
    page: list[Block] = [
        f"{name} identified leg by leg from {poses} full poses: {count}",
        f"Largest error of a pose, max dQint, before and after each step: {errors} mm + rad",
        f"Condition numbers of the legs: {conditions}",
        table,
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
