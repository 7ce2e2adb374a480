# SPDX-License-Identifier: Apache-2.0
"""`loopcal example` and `loopcal completion`: files to begin with, and a shell that completes."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import terminal
from loopcal.cli.options.shared_options import file_option, json_option

SHELLS = ("bash", "zsh", "fish")
"""Shells whose completion click can write."""


@click.command()
@click.argument("name", metavar="[NAME]", required=False)
@file_option("-o", "--output", help="Folder to make; by default one with the name of the example.")
@json_option
def example(name: str | None, output: Path | None, as_json: bool) -> int:
    """Write the files of an example into a new folder; without NAME, list the examples.

    \b
    Examples:
      loopcal example
      loopcal example hexapod-42
      loopcal example delta-printer -o printer
    """  # noqa: D301
    from loopcal.io.example_folders import describe_example, list_examples, write_example
    from loopcal.report.tables import Table, word_column

    if name is None:
        titles = {name: describe_example(folder) for name, folder in list_examples().items()}
        if as_json:
            terminal.print_json({"examples": titles})
            return 0
        columns = (word_column("example"), word_column("content", wraps=True))
        table = Table("Examples; loopcal example NAME writes one", columns, tuple(titles.items()))
        terminal.print_page([table])
        return 0
    folder = Path(name) if output is None else output
    files = write_example(name, folder)
    if as_json:
        terminal.print_json({"example": name, "folder": str(folder), "files": files})
    else:
        terminal.print_page([f"Written to {folder}: {', '.join(files)}"])
    return 0


@click.command()
@click.argument("shell", type=click.Choice(SHELLS))
@json_option
def completion(shell: str, as_json: bool) -> int:
    """Print the script with which SHELL completes commands, options, names of robots and files.

    \b
    Add to the start-up file of your shell:
      bash  ~/.bashrc                        eval "$(loopcal completion bash)"
      zsh   ~/.zshrc                         eval "$(loopcal completion zsh)"
      fish  ~/.config/fish/config.fish       loopcal completion fish | source

    \b
    Examples:
      loopcal completion bash
    """  # noqa: D301
    from click.shell_completion import get_completion_class

    from loopcal.cli.entry_point import command_line

    writer = get_completion_class(shell)
    assert writer is not None  # SHELLS are those of click
    script = writer(command_line, {}, "loopcal", "_LOOPCAL_COMPLETE")
    text = script.source_template % script.source_vars()
    if as_json:
        terminal.print_json({"shell": shell, "script": text})
    else:
        terminal.print_text(text)
    return 0
