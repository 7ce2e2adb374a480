# SPDX-License-Identifier: Apache-2.0
"""Options for the workers of a study, and what commands that compute one say."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli import terminal
from loopcal.cli.options.shared_options import Count, add_options, flag_option, refuse_given

if TYPE_CHECKING:
    from loopcal.studies.driver import RunReport, Share
    from loopcal.studies.execution import Executor
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


worker_options = add_options(
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


@dataclass(frozen=True)
class Work:
    """Who computes a study, and which share of it."""

    executor: Executor
    share: Share


def choose_work(share: Share | None, workers: int | None, dask: str | None, ray: bool) -> Work:
    """Return what the values of `worker_options` mean."""
    from loopcal.studies.driver import WHOLE

    return Work(_make_executor(workers, dask, ray), share or WHOLE)


def run_and_report(
    chosen: Study, store: StudyStore, folder: Path, work: Work, as_json: bool
) -> int:
    """Compute what is missing in an open store, print the report, and return the exit code."""
    from loopcal.studies.driver import run_blocks

    with _keep_when_stopped(chosen, store, work.share, folder) as stop:
        with terminal.ProgressBar() as progress:
            report = run_blocks(chosen, store, work.executor, work.share, progress)
        _print_report(report, folder, as_json)
        return 0 if report.is_complete else INCOMPLETE
    return stop[0]


def _make_executor(workers: int | None, dask: str | None, ray: bool) -> Executor:
    """Return the workers that the options name."""
    from loopcal.studies.execution import Dask, Ray
    from loopcal.studies.running import make_local

    if dask is not None:
        refuse_given(("workers", "ray"), "with --dask")
        return Dask(dask)
    if ray:
        refuse_given(("workers",), "with --ray")
        return Ray()
    return make_local(count_processors() if workers is None else workers)


def round_duration(seconds: float) -> str:
    """Return a duration to two digits, in the largest unit in which it is at least one."""
    unit, factor = next((u for u in (("h", 3600.0), ("min", 60.0)) if seconds >= u[1]), ("s", 1.0))
    return f"{float(f'{seconds / factor:.2g}'):.6g} {unit}"


def count_processors() -> int:
    """Return the number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


@contextmanager
def _keep_when_stopped(
    chosen: Study, store: StudyStore, share: Share, folder: Path
) -> Iterator[list[int]]:
    """Say what is kept where the body is stopped by Ctrl-C.

    Yields a list that receives the exit code.
    """
    from loopcal.findings import report_finding
    from loopcal.studies.driver import count_blocks, count_stored

    codes: list[int] = []
    try:
        yield codes
    except KeyboardInterrupt:
        done, total = count_stored(chosen, store, share), count_blocks(chosen, share)
        finding = report_finding("store.stopped", done=done, total=total, folder=str(folder))
        terminal.print_message(f"loopcal: {finding}")
        terminal.print_message("Hint: use --resume to continue")
        codes.append(STOPPED)


def _print_report(report: RunReport, folder: Path, as_json: bool) -> None:
    """Print what a driver did."""
    for finding in report.findings:
        terminal.print_message(f"loopcal: {finding}")
    if as_json:
        terminal.print_json({**_list_numbers(report), "folder": str(folder)})
        return
    stored = report.before + report.computed
    blocks = f"{stored} of {report.total} blocks are stored in {folder}"
    trials = f"{report.computed} new, {report.trials} trials in {round_duration(report.seconds)}"
    page = [f"{blocks}: {trials}"]
    if report.is_complete:
        page.append(f"Next: loopcal study summary {folder}")
    terminal.print_page(page)


def _list_numbers(report: RunReport) -> dict[str, Any]:
    """Return a report for JSON."""
    from loopcal.serialization import to_json

    return {**to_json(report), "is_complete": report.is_complete}
