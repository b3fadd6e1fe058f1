"""Output of command lines: on any terminal, to a full disk and to a closed pipe."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

FAILED = 1
"""The exit code when the output cannot be written."""

_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})


class OutputCommand(click.Command):
    """A command that replaces characters its terminal lacks, and reports output that cannot be written."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """See :meth:`click.Command.main`."""
        with written_output():
            return super().main(*args, **kwargs)


class OutputGroup(OutputCommand, click.Group):
    """A group of commands with the same output; its commands need nothing of it themselves."""


@contextlib.contextmanager
def written_output() -> Iterator[None]:
    """The context of a program that writes to standard output.

    :raises SystemExit: with :data:`FAILED`, if that cannot be written
    """
    _open_missing()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace" if stream is sys.stdout else "backslashreplace")
    try:
        try:
            yield
        finally:
            # At the end of the interpreter an error would be a traceback.
            sys.stdout.flush()
    except BrokenPipeError:
        _discard_output()
        sys.exit(FAILED)
    except OSError as error:
        if error.errno not in _FULL:
            raise
        _discard_output()
        target = error.filename or "the output"
        with contextlib.suppress(OSError):
            sys.stderr.write(f"Error: {target} cannot be written: {error.strerror}\n")
        sys.exit(FAILED)


def _open_missing() -> None:
    """What is written to a descriptor that was closed before the start goes nowhere; Python has no stream for it."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w"))  # noqa: SIM115


def _discard_output() -> None:
    """What is left in the buffer goes nowhere, so that the end of the interpreter does not fail."""
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
