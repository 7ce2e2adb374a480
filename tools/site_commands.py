# SPDX-License-Identifier: Apache-2.0
"""Pages of the commands for the site: for each command what its `--help` prints, as markup."""

import inspect
import re
from collections.abc import Iterator

import click

from loopcal.cli.entry_point import command_line
from tools.site_docstrings import escape_markup

UNDERLINES = "=-"
"""Of the heading of a command, and of a command of a group."""

WIDE = 10_000
"""Columns, so that no text is wrapped."""


def format_command_pages() -> Iterator[tuple[str, str]]:
    """Return each command with the text of its page."""
    program = click.Context(
        command_line,
        info_name="loopcal",
        max_content_width=WIDE,
        terminal_width=WIDE,
        show_default=True,
    )
    for name in command_line.list_commands(program):
        yield name, "\n".join([*format_command(name, program, 0), ""])


def format_command(name: str, parent: click.Context, level: int) -> Iterator[str]:
    """Return the lines of one command, and of the commands of a group below it."""
    assert isinstance(parent.command, click.Group)
    command = parent.command.get_command(parent, name)
    assert command
    context = click.Context(command, info_name=name, parent=parent)
    path = context.command_path
    yield from (path, UNDERLINES[level] * len(path), "")
    yield from format_block("text", [command.get_usage(context).removeprefix("Usage: ")])
    yield from format_help(command.help or "")
    yield from (f".. program:: {path}", "")
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record and isinstance(parameter, click.Option):
            text = escape_help(" ".join(record[1].split()))
            yield from (f".. option:: {record[0]}", "", f"   {text}", "")
    if isinstance(command, click.Group):
        for member in command.list_commands(context):
            yield from format_command(member, context, level + 1)


def format_help(text: str) -> Iterator[str]:
    """Return the markup of a help text: paragraphs, and blocks that click does not wrap."""
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        lines = paragraph.strip("\n").split("\n")
        if lines[0] != "\b":
            yield from (escape_help(" ".join(lines)), "")
            continue
        block = lines[1:]
        if len(block) > 1 and all(line.startswith(" ") for line in block[1:]):
            yield from (escape_help(block[0]), "")
            block = inspect.cleandoc("\n".join(block[1:])).split("\n")
        are_commands = all(line.startswith(("loopcal ", "eval ")) for line in block)
        yield from format_block("sh" if are_commands else "text", block)


def format_block(language: str, lines: list[str]) -> Iterator[str]:
    """Return the markup of a block of code."""
    yield from (f".. code-block:: {language}", "", *(f"   {line}" for line in lines), "")


def escape_help(text: str) -> str:
    """Return a text in which an underscore behind a word is no link."""
    return re.sub(r"(?<=\w)_(?!\w)", r"\\_", escape_markup(text))
