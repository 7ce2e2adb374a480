# SPDX-License-Identifier: Apache-2.0
"""From the code of a finding or an error to the command-line option that helps (`hints.toml`).

Messages of the library do not know the command line; `main` and the views add these hints.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import click

from loopcal.cli import terminal
from loopcal.findings import Finding
from loopcal.findings.wording import add_advice


@cache
def load_hints() -> dict[str, str]:
    """Return code -> advice, in the imperative."""
    import tomllib

    subjects = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    return {f"{of}.{name}": text for of, texts in subjects.items() for name, text in texts.items()}


def find_hint(code: str | None, command: click.Command | None) -> str | None:
    """Return the hint for a code; None where there is none, on the page of `loopcal app`, or where
    this command, if it is known, lacks an option in it. What follows the word `type` is another
    command.
    """
    if terminal.PAGE in os.environ:
        return None
    hint = load_hints().get(code or "")
    if hint is None or command is None or hint.startswith("type loopcal "):
        return hint
    options = {name for parameter in command.params for name in parameter.opts}
    return hint if options.issuperset(re.findall(r"--[a-z][a-z-]*", hint)) else None


def hint_for(finding: Finding) -> str | None:
    """Return the hint for a finding, with the names it contains, for the command that runs."""
    context = click.get_current_context(silent=True)
    command = None if context is None else context.command
    return word_hint(finding, find_hint(finding.code, command))


def word_hint(finding: Finding, hint: str | None) -> str | None:
    """Return a hint with the names that its finding contains; None where it does not help."""
    from loopcal.findings.catalog.phrases import MACHINE

    code, data = finding.code, finding.data
    is_useless = (
        (code == "prior.rows-reused" and not data["others"])  # no row would be left
        or (code == "prior.machine-changed" and data["subject"] != MACHINE)  # free already
        or (code == "files.base-moves" and data["keeps"] not in ("both", "turn"))  # kept already
    )
    if hint is None or is_useless:
        return None
    if "--platform LINK" in hint and data.get("links"):
        return hint.replace("--platform LINK", name_options("--platform", data["links"][:1]))
    if code == "files.groups-in-plan" and data["kind"] in ("plane", "line"):
        return "use --measure plane-line"
    if code in ("workflow.next-check-outliers", "outliers.all-poses"):
        poses = [str(label).removeprefix("pose ") for label in data["poses"]]
        return f"use {name_options('--drop', poses)}, or --loss huber"
    if code == "validation.setup-moved":
        return f"use {name_options('--refit', data['names'])}"
    return hint


def name_options(option: str, values: Iterable[str]) -> str:
    """Return an option with each of these values, to copy: a shell reads them as they are."""
    return " ".join(f"{option} {shlex.quote(value)}" for value in values)


def suggest_command(*words: object) -> str:
    """Return a line with the command to type next, to copy."""
    from loopcal.results.tables import COMMAND

    return f"{COMMAND}{shlex.join(map(str, words))}"


def with_hint(finding: Finding) -> str:
    """Return the text of a finding, with the hint for the command that runs."""
    return add_advice(finding, hint_for(finding))


def list_hints(findings: Iterable[Finding]) -> list[str]:
    """Return the lines of the hints for findings."""
    return [f"Hint: {hint}" for finding in findings if (hint := hint_for(finding))]
