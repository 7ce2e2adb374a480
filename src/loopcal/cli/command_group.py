# SPDX-License-Identifier: Apache-2.0
"""A command that consists of commands: `loopcal` itself, and `loopcal study`."""

from __future__ import annotations

import click

from loopcal.cli.time_limit import add_time_limit
from loopcal.errors import suggest_names


class CommandGroup(click.Group):
    """A group whose commands have the option --time-limit, and which suggests similar names."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the work, which is that of the code."""
        return list(self.commands)

    def find_command(self, name: str) -> click.Command | None:
        """Return a command as it is defined; None where there is none of this name."""
        return self.commands.get(name)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command; None where there is none of this name."""
        command = self.find_command(cmd_name)
        if command is None or isinstance(command, click.Group):
            return command
        return add_time_limit(command)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command of the first word, or fail with the names of similar ones."""
        names = self.list_commands(ctx)
        if args[0] not in names and not args[0].startswith("-"):
            similar = suggest_names(args[0], names)
            ctx.fail(f"{args[0]!r} is not a command{similar}; see {ctx.command_path} --help")
        return super().resolve_command(ctx, args)
