"""A command group that imports a command only when it is called, so that the others start fast."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import click

from relay_protocol.errors import SwitchboardError
from relay_server.cli.failure import Failure


class CommandEntry(NamedTuple):
    """Where a command lives, and its line in the help."""

    module: str
    name: str
    help: str


class LazyGroup(click.Group):
    """:param entries: commands by name, in the order of the help; modules that don't exist are left out"""

    def __init__(self, *args: Any, entries: Mapping[str, CommandEntry], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._entries = {name: entry for name, entry in entries.items() if find_spec(entry.module)}

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._entries)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        entry = self._entries.get(cmd_name)
        if entry is None:
            return None
        command = getattr(import_module(entry.module), entry.name)
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.help) for name, entry in self._entries.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; what the product reports in words becomes a sentence and an exit code."""
        try:
            return super().invoke(ctx)
        except SwitchboardError as error:
            raise Failure.of(error) from error
        except ModuleNotFoundError as error:
            if (error.name or "").startswith(("relay_", "robot_")):
                raise
            raise Failure(
                f"this needs the server's packages ({error.name} is missing): install the extra 'server'"
            ) from error
