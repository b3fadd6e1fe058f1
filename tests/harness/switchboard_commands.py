"""The admin command line in processes of its own, forked from one that has imported it already.

A fresh interpreter spends a second on imports, and the tests run hundreds of commands.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from multiprocessing.context import ForkServerContext
from pathlib import Path

SECONDS = 60.0


def run_command(
    arguments: Sequence[str], *, env: Mapping[str, str] | None = None, stdin: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run ``switchboard`` as a shell would.

    :param env: all of its environment; this process's where there is none
    :raises subprocess.TimeoutExpired: it takes longer than a minute
    """
    with tempfile.TemporaryDirectory(prefix="command-") as name:
        folder = Path(name)
        (folder / "in").write_text(stdin)
        process = _context().Process(target=_be, args=(list(arguments), dict(env or os.environ), name))
        process.start()
        process.join(SECONDS)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired(list(arguments), SECONDS)
        code = process.exitcode
        process.close()
        return subprocess.CompletedProcess(
            list(arguments), code, (folder / "out").read_text(), (folder / "err").read_text()
        )


def _context() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    # What the commands import when they are run; no threads and no reactor are begun by it.
    context.set_forkserver_preload(
        [
            "relay_server.cli",
            *(f"relay_server.cli.{each}" for each in ("alerts", "audit", "database", "fleet", "groups")),
            *(f"relay_server.cli.{each}" for each in ("rights", "robots", "status", "stopping")),
            *(f"relay_server.cli.{each}" for each in ("tokens", "users")),
            "relay_db.queries",
            "relay_db.schema",
        ]
    )
    return context


def _be(arguments: list[str], env: dict[str, str], folder: str) -> None:
    """Become the command: its environment, its three streams, its exit code."""
    os.environ.clear()
    os.environ.update(env)
    for descriptor, name, flags in (
        (0, "in", os.O_RDONLY),
        (1, "out", os.O_WRONLY | os.O_CREAT),
        (2, "err", os.O_WRONLY | os.O_CREAT),
    ):
        opened = os.open(Path(folder) / name, flags, 0o600)
        os.dup2(opened, descriptor)
        os.close(opened)
    from relay_server.cli import main

    with contextlib.ExitStack() as streams:
        sys.stdin = streams.enter_context(open(0, encoding="utf-8", closefd=False))
        sys.stdout = streams.enter_context(open(1, "w", encoding="utf-8", closefd=False))
        sys.stderr = streams.enter_context(open(2, "w", encoding="utf-8", closefd=False))
        main.main(arguments, prog_name="switchboard")
