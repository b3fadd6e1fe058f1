"""How commands fail: a sentence on stderr and an exit code that means something."""

from __future__ import annotations

from typing import IO, Any

import click

from relay_protocol.errors import SwitchboardError, Unavailable
from relay_protocol.text import inert

REFUSED = 1
USAGE = 2
UNREACHABLE = 3


class Failure(click.ClickException):
    """Ends the command: refused, or failed."""

    exit_code = REFUSED

    @staticmethod
    def of(error: SwitchboardError) -> Failure:
        """The same in the words of the command line."""
        return Unreachable(str(error)) if isinstance(error, Unavailable) else Failure(str(error))

    def show(self, file: IO[Any] | None = None) -> None:
        click.echo(f"Error: {inert(self.message)}", file=file, err=file is None)


class Unreachable(Failure):
    """Ends the command: the relay or the database can't be reached."""

    exit_code = UNREACHABLE
