# SPDX-License-Identifier: Apache-2.0
"""`loopcal reproduce`: repeat a published study and put what it printed beside what is computed."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import click

from loopcal.cli import show
from loopcal.cli.options import FILE, json_option

if TYPE_CHECKING:
    from loopcal.papers.printed import Table
    from loopcal.papers.reproduction import Reproduction


@click.command(short_help="Repeat a published study, printed numbers beside computed ones.")
@click.argument("paper", metavar="[PAPER]", required=False)
@click.option(
    "-o",
    "--output",
    type=FILE,
    metavar="FOLDER",
    help="Write a page, all tables (CSV, JSON) and figures (PNG).",
)
@click.option("--seed", default=0, show_default=True, help="Of everything that is drawn.")
@click.option(
    "--trials",
    type=int,
    metavar="N",
    help="Drawings behind each statistical number.  [default: 50]",
)
@click.option("--force", is_flag=True, help="Replace an earlier result in FOLDER.")
@json_option
def reproduce(
    paper: str | None,
    output: Path | None,
    seed: int,
    trials: int | None,
    force: bool,
    as_json: bool,
) -> None:
    """Repeat the study PAPER; without PAPER, list those that can be repeated.

    Every number called computed comes from running the code now; statements of the paper that it
    does not bear out are named, with the reason.

    \b
    Examples:
      loopcal reproduce
      loopcal reproduce hexapod-42
      loopcal reproduce hexapod-42 -o hexapod-42 --seed 1
    """  # noqa: D301
    from loopcal.papers import PAPERS, TRIALS
    from loopcal.papers import paper as paper_called

    if paper is None:
        _list(as_json)
        return
    chosen = PAPERS[paper] if paper in PAPERS else paper_called(paper)
    if output is not None:
        from loopcal.io.runs.run_folder import refuse_used_folder

        refuse_used_folder(output, force)
    found = chosen.run(seed, TRIALS if trials is None else trials, show.progress)
    if output is not None:
        from loopcal.io.runs.run_folder import collect_provenance
        from loopcal.papers.writing import write_folder

        write_folder(
            output, found, collect_provenance(["loopcal", *sys.argv[1:]], {}, {"seed": seed}), force
        )
    if as_json:
        show.json_document(found.to_dict())
        return
    _print(found)
    show.say(
        f"\nwritten to {output}: page.md, tables, figures"
        if output
        else "\nall tables and figures: add -o FOLDER"
    )


def _list(as_json: bool) -> None:
    """Print the papers."""
    from loopcal.papers import PAPERS

    if as_json:
        show.json_document(
            {
                "papers": [
                    {"name": p.name, "title": p.title, "source": p.source} for p in PAPERS.values()
                ]
            }
        )
        return
    for one in PAPERS.values():
        show.say(f"{one.name}\n    {one.title}\n    {one.source}")


def _print(found: Reproduction) -> None:
    """Print summary, tables of the studies and verdicts."""
    show.say(f"{found.paper}: {found.title}")
    for table in (found.summary(), *found.tables):
        _table(table)
    show.say()
    for i, verdict in enumerate(found.verdicts, 1):
        word = verdict.word.upper() if verdict.agrees is False else verdict.word.lower()
        show.say(
            textwrap.fill(
                f"{i:2}. {word}: {verdict.claim} ({verdict.where})", 112, subsequent_indent="    "
            )
        )
        show.say(textwrap.fill(verdict.why, 112, initial_indent="    ", subsequent_indent="    "))


def _table(table: Table) -> None:
    """Print a table, its text columns on the left; long headers are broken."""
    headers = ["\n".join(textwrap.wrap(column, 18)) for column in table.columns]
    show.table(table.title, headers, table.text())
