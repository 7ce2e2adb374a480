# SPDX-License-Identifier: Apache-2.0
"""A command that consists of commands: `loopcal` itself, and `loopcal study`."""

from __future__ import annotations

import click

from loopcal.errors import suggest_names


class CommandGroup(click.Group):
    """A group that suggests similar names of commands."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the work, which is that of the code."""
        return list(self.commands)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command of the first word, or fail with the names of similar ones."""
        names = self.list_commands(ctx)
        if args[0] not in names and not args[0].startswith("-"):
            similar = suggest_names(args[0], names)
            ctx.fail(f"{args[0]!r} is not a command{similar}; see {ctx.command_path} --help")
        return super().resolve_command(ctx, args)
