# SPDX-License-Identifier: Apache-2.0
"""`loopcal study`: many simulated calibrations, described by a file."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli import terminal
from loopcal.cli.entry_point import CommandGroup
from loopcal.cli.options import (
    FILE,
    Count,
    OptionGroup,
    file_option,
    flag_option,
    force_option,
    refuse_given,
)
from loopcal.cli.terminal import Output, shows_output

if TYPE_CHECKING:
    from loopcal.results.tables import Block
    from loopcal.studies.driver import Share
    from loopcal.studies.execution.executors import Executor
    from loopcal.studies.files.store import StudyStore
    from loopcal.studies.specification.study import Study


STOPPED, INCOMPLETE = 1, 2
"""Exit codes of a study that was stopped, and of one with blocks that could not be computed."""


class ShareType(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]  # generic since 8.4
    """A share such as 3/10: the third of ten parts."""

    name = "share"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the share, or fail with what is allowed."""
        from loopcal.studies.driver import Share

        match = re.fullmatch(r"([1-9]\d{0,8})/([1-9]\d{0,8})", str(value))
        if match is None or int(match[1]) > int(match[2]):
            sentence = f"{value!r} is not a share; write 3/10 for the third of ten parts"
            self.fail(sentence, param, ctx)
        return Share(int(match[1]), int(match[2]))


worker_options = OptionGroup(
    click.option(
        "--workers",
        type=Count("WORKERS", 1),
        metavar="N",
        help="Processes that compute.  [default: the number of processors]",
    ),
    click.option(
        "--dask", metavar="ADDRESS", help="Use a dask cluster, by the address of its scheduler."
    ),
    flag_option(
        "--ray",
        help="Use the ray cluster of the variable RAY_ADDRESS, or one that is started here.",
    ),
    click.option(
        "--cells",
        "share",
        type=ShareType(),
        metavar="PART/PARTS",
        help="Compute a share only, such as 3/10 for the third of ten jobs; join their folders "
        "with merge.",
    ),
)


def choose_work(
    share: Share | None, workers: int | None, dask: str | None, ray: bool
) -> tuple[Executor, Share]:
    """Return who computes a study, and which share of it, from the values of `worker_options`."""
    from loopcal.studies.driver import WHOLE
    from loopcal.studies.execution.executors import Dask, Ray
    from loopcal.studies.running import make_local

    share = share or WHOLE
    if dask is not None:
        refuse_given(("workers", "ray"), "with --dask")
        return Dask(dask), share
    if ray:
        refuse_given(("workers",), "with --ray")
        return Ray(), share
    return make_local(count_processors() if workers is None else workers), share


def run_and_report(
    chosen: Study, store: StudyStore, folder: Path, work: tuple[Executor, Share]
) -> Output:
    """Compute what is missing in an open store; Ctrl-C ends it with what is kept."""
    from loopcal.findings import report_finding
    from loopcal.results.serialization import to_json
    from loopcal.studies.driver import count_blocks, count_stored, run_blocks

    executor, share = work
    try:
        with terminal.ProgressBar() as progress:
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
    page += [f"Next: loopcal study summary {folder}"] if report.is_complete else []
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


study_argument = click.argument("study_file", metavar="STUDY", type=FILE)
folder_argument = click.argument("folder", metavar="FOLDER", type=FILE)
quick_option = flag_option("--quick", help="Use the quick tier of STUDY, which takes seconds.")


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
    """  # noqa: D301


@study.command()
@study_argument
@click.option(
    "--robot",
    metavar="ROBOT",
    help="A robot, or its file.  [default: linear-delta, or that of PAPER]",
)
@click.option("--paper", metavar="PAPER", help="Write the study of a paper that reproduce repeats.")
@force_option("STUDY")
@shows_output
def new(study_file: Path, robot: str | None, paper: str | None, force: bool) -> Output:
    """Write a study file to fill in, with a comment for each setting.

    With --paper, write the study of a paper: its errors, noises and methods. --robot replaces its
    robot.

    \b
    Examples:
      loopcal study new study.yaml
      loopcal study new study.yaml --robot hexapod-42
      loopcal study new study.yaml --paper cmm-constraint-2011 --robot hexapod-42
    """  # noqa: D301
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.studies.files.study_file import write_template

    if paper is not None:
        from loopcal.papers.paper import find_paper, make_paper_study

        made = make_paper_study(find_paper(paper), study_file, robot)
        refuse_outputs(made.outputs, (), force)
        made.write()
        page = [f"Written: {', '.join(map(str, made.outputs))}"]
        if made.replaced:
            keys = " and ".join(made.replaced)
            page.append(f"The {keys} of the paper belong to its robot and were replaced, too.")
        page.append(f"Next: loopcal study check {study_file}")
        written = [str(path) for path in made.outputs]
        return Output(
            {"written": written, "paper": paper, "robot": made.robot, "replaced": made.replaced},
            lambda: page,
        )
    robot = "linear-delta" if robot is None else robot
    refuse_outputs((study_file,), (), force)
    write_template(study_file, robot)
    page = [f"Written: {study_file}", f"Next: loopcal study check {study_file}"]
    return Output({"written": str(study_file), "robot": robot}, lambda: page)


@study.command()
@study_argument
@quick_option
@shows_output
def check(study_file: Path, quick: bool) -> Output:
    """Read STUDY, show its cells, and estimate the time that it takes from one block of each robot.

    \b
    Examples:
      loopcal study check study.yaml
      loopcal study check study.yaml --quick
    """  # noqa: D301
    from loopcal.studies.driver import estimate_time, view_estimate
    from loopcal.studies.running import read_source

    chosen = read_source(study_file, quick).study
    with terminal.ProgressBar() as progress:
        estimate = estimate_time(chosen, count_processors(), progress)
    following = f"Next: loopcal study run {study_file} -o FOLDER"
    return Output(estimate, lambda: [*view_estimate(chosen, estimate, round_duration), following])


@study.command()
@study_argument
@file_option("-o", "--output", "folder", required=True, metavar="FOLDER", help="Folder to make.")
@worker_options
@flag_option(
    "--resume",
    help="Continue FOLDER where it exists. STUDY may have more replicates or levels than before.",
)
@quick_option
@shows_output
def run(study_file: Path, folder: Path, resume: bool, quick: bool, **options: Any) -> Output:
    """Compute STUDY, and store its trials in FOLDER.

    Every block of trials is stored when it is finished. A study that is stopped, by Ctrl-C or in
    any other way, loses only the blocks in work; --resume continues it.

    \b
    Examples:
      loopcal study run study.yaml -o results
      loopcal study run study.yaml -o results --resume --workers 4
      loopcal study run study.yaml -o results --dask tcp://scheduler:8786
      loopcal study run study.yaml -o part-3 --cells 3/10
    """  # noqa: D301
    from loopcal.studies.files.study_folder import open_study
    from loopcal.studies.running import read_source

    source, work = read_source(study_file, quick), choose_work(**options)
    with open_study(folder, source, resume) as store:
        return run_and_report(source.study, store, folder, work)


@study.command()
@folder_argument
@click.option(
    "--replicates",
    type=Count("REPLICATES", 1),
    required=True,
    metavar="N",
    help="Trials of a cell.",
)
@worker_options
@shows_output
def extend(folder: Path, replicates: int, **options: Any) -> Output:
    """Compute further trials of each cell of a study, until there are N; finished ones are kept.

    \b
    Examples:
      loopcal study extend results --replicates 5000
    """  # noqa: D301
    from loopcal.studies.files.study_folder import extend_study, load_specification

    work = choose_work(**options)
    with extend_study(folder, replicates) as store:
        return run_and_report(load_specification(store), store, folder, work)


@study.command()
@folder_argument
@shows_output
def status(folder: Path) -> Output:
    """Show how much of a study is stored, also while it runs.

    \b
    Examples:
      loopcal study status results
    """  # noqa: D301
    from loopcal.studies.results.study_result import read_status, view_status

    state = read_status(folder)
    return Output(state, lambda: view_status(state, round_duration))


@study.command()
@folder_argument
@click.option(
    "--score", "scores", multiple=True, metavar="NAME", help="Score to show; may be repeated."
)
@click.option(
    "--against", metavar="FACTOR", help="Factor along the axis of figures, such as poses."
)
@shows_output
def summary(folder: Path, scores: tuple[str, ...], against: str | None) -> Output:
    """Show medians and coverage of each cell, with intervals, the failed trials by reason, and the
    answers to the questions of the study file.

    It also writes summary.json and summary.csv, with all scores, and a figure of each shown score
    into FOLDER.

    \b
    Examples:
      loopcal study summary results
      loopcal study summary results --score position_max --score condition
      loopcal study summary results --score position --against instrument
    """  # noqa: D301
    from loopcal.studies.results.questions import (
        build_document,
        list_shown,
        view_answers,
        view_summary,
        write_summary,
    )
    from loopcal.studies.results.study_result import StudyResult
    from loopcal.studies.results.summary_drawing import render_figures

    result = StudyResult(folder)
    with terminal.ProgressBar() as progress:
        progress(0, 1, "summarizing trials")
        summarized, answered = result.summarize(), result.answer_questions()
        shown = list_shown(result.study, summarized, scores)
        page = view_summary(result.study, summarized, shown)
        figures = render_figures(result.study, summarized, shown, against)
        write_summary(folder, result.study, summarized, answered, figures)
    written = f"Written to {folder}: {', '.join(('summary.json', 'summary.csv', *figures))}"
    return Output(
        build_document(summarized, answered), lambda: [*page, "", *view_answers(answered), written]
    )


@study.command()
@folder_argument
@click.option("--smallest", metavar="FACTOR", help="Ask for its smallest level, such as poses.")
@click.option("--largest", metavar="FACTOR", help="Ask for its largest level, such as noise.")
@click.option(
    "--score", default="position", metavar="NAME", help="Score that stays within the limit."
)
@click.option(
    "--limit", required=True, metavar="LIMIT", help="Of the score, with its unit, such as 10um."
)
@click.option(
    "--share",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=0.95,
    metavar="SHARE",
    help="Share of the machines that stay within the limit.",
)
@shows_output
def ask(
    folder: Path, smallest: str | None, largest: str | None, score: str, limit: str, share: float
) -> Output:
    """Find the smallest or largest level of a factor that reaches a limit on a share of machines.

    The answer says which levels reach it for certain, and which may. Run more replicates where it
    is not certain, see loopcal study extend.

    \b
    Examples:
      loopcal study ask results --smallest poses --limit 10um
      loopcal study ask results --largest noise --score position_max --limit 0.05mm --share 0.9
    """  # noqa: D301
    from loopcal.studies.results.questions import view_answers
    from loopcal.studies.results.study_result import StudyResult

    if (smallest is None) == (largest is None):
        raise click.UsageError("give --smallest FACTOR or --largest FACTOR, one of them")
    result = StudyResult(folder)
    answered = (
        result.find_smallest(smallest, score, limit, share)
        if smallest is not None
        else result.find_largest(largest or "", score, limit, share)
    )
    return Output(answered, lambda: view_answers([answered]))


@study.command()
@folder_argument
@file_option("-o", "--output", required=True, metavar="FILE", help="Table: .csv or .parquet.")
@force_option("FILE")
@shows_output
def export(folder: Path, output: Path, force: bool) -> Output:
    """Write all trials of a study as one table, with all factors as columns and numbers in SI.

    \b
    Examples:
      loopcal study export results -o trials.csv
      loopcal study export results -o trials.parquet
    """  # noqa: D301
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.studies.files.store import read_store
    from loopcal.studies.files.study_folder import load_specification
    from loopcal.studies.results.export import export_trials

    refuse_outputs((output,), (), force)
    with read_store(folder) as store, terminal.ProgressBar() as progress:
        count = export_trials(load_specification(store), store, output, progress)
    document = {"written": str(output), "trials": count}
    return Output(document, lambda: [f"Written: {output} ({count} trials)"])


@study.command()
@click.argument("part_folders", metavar="PART...", nargs=-1, required=True, type=FILE)
@file_option("-o", "--output", required=True, metavar="FOLDER", help="Folder to make or to add to.")
@shows_output
def merge(part_folders: tuple[Path, ...], output: Path) -> Output:
    """Join folders of jobs that each computed a share of one study (see run --cells).

    \b
    Examples:
      loopcal study merge part-1 part-2 part-3 -o results
    """  # noqa: D301
    from loopcal.studies.files.study_folder import merge_studies
    from loopcal.studies.results.study_result import read_status, view_status

    with terminal.ProgressBar() as progress:
        count = merge_studies(part_folders, output, progress)
    state = read_status(output)
    written = f"Written to {output}: {count} new blocks"
    return Output(
        {"new_blocks": count, "status": state},
        lambda: [written, *view_status(state, round_duration)],
    )


@study.command()
@folder_argument
@click.argument("trial", metavar="CELL/TRIAL")
@file_option("-o", "--output", required=True, metavar="RUN", help="Run folder to make.")
@force_option("RUN")
@shows_output
def replay(folder: Path, trial: str, output: Path, force: bool) -> Output:
    """Repeat one trial of a study as a normal calibration, with all its checks and a run folder.

    Cells and trials count from 0; status lists the cells. A second folder beside the run folder,
    RUN-input, gets the robot file, the measurements and the true machine.

    \b
    Examples:
      loopcal study replay results 3/17 -o trial
    """  # noqa: D301
    from loopcal.studies.running import calibrate_trial

    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", trial)
    if match is None:
        raise click.BadParameter(f"{trial!r} is not CELL/TRIAL, such as 3/17")
    from loopcal.cli.hints import hint_for
    from loopcal.report.calibration_view import view_calibration

    with terminal.ProgressBar() as progress:
        done = calibrate_trial(
            folder, int(match[1]), int(match[2]), output, sys.argv, force, progress
        )

    def view() -> list[Block]:
        for finding in done.findings:
            terminal.print_note(str(finding))
        written = f"Written to {output}, and its inputs to {done.inputs}"
        return [*view_calibration(done.report, False, hint_for), "", written]

    return Output(done.document, view, exit_code=done.report.exit_code)
