"""``switchboard worker``: runs functions for a relay, as a worker of its Dask scheduler."""

from __future__ import annotations

import asyncio
import signal
import socket
from pathlib import Path

import click

from relay_protocol.errors import Invalid
from relay_server.cli.app import examples


@click.command(
    epilog=examples(
        "switchboard worker tls://10.0.0.5:8786 --tls ca.pem worker.pem worker.key",
        "switchboard worker tcp://127.0.0.1:8786 --processes 4 --label GPU=1",
    )
)
@click.argument("scheduler", metavar="ADDRESS")
@click.option(
    "--processes", type=click.IntRange(1, 256), default=1, show_default=True, help="Calls at a time."
)
@click.option("--name", default="", help="Name of the worker. Default: that of the machine.")
@click.option(
    "--label",
    "labels",
    multiple=True,
    metavar="NAME=N",
    help="A resource of this worker, as GPU=1. Repeatable.",
)
@click.option(
    "--memory-mib",
    type=click.IntRange(0),
    default=0,
    metavar="MIB",
    help="Most memory of a call. Default: as its function says.",
)
@click.option(
    "--folder",
    type=click.Path(file_okay=False, exists=True, path_type=Path),
    help="Folder of functions (*.py), beside those of installed packages.",
)
@click.option(
    "--tls",
    nargs=3,
    default=("", "", ""),
    metavar="CA CERT KEY",
    help="PEM files for a tls:// scheduler: its CA, the certificate of this worker and its key.",
)
def worker(
    scheduler: str,
    processes: int,
    name: str,
    labels: tuple[str, ...],
    memory_mib: int,
    folder: Path | None,
    tls: tuple[str, str, str],
) -> None:
    """Run functions for a relay, as a worker of its Dask scheduler at ADDRESS.

    The scheduler is started by 'dask scheduler', the relay with --offload-scheduler. The worker prints READY each time
    it is connected; without the scheduler it tries again.
    """
    try:
        from relay_server.offload.dask_worker import WorkerOptions, security_of, serve_worker
    except ImportError as error:
        raise Invalid(f"a worker needs the extra 'dask' ({error})") from None
    options = WorkerOptions(
        scheduler=scheduler,
        name=name or socket.gethostname(),
        processes=processes,
        labels=dict(map(_label, labels)),
        folder=folder,
        memory_mib=memory_mib,
        security=security_of(scheduler, tls),
    )

    async def run() -> None:
        serving = asyncio.ensure_future(serve_worker(options, click.echo))
        for each in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(each, serving.cancel)
        try:
            await serving
        except asyncio.CancelledError:
            return

    asyncio.run(run())


def _label(text: str) -> tuple[str, float]:
    name, equals, number = text.partition("=")
    try:
        value = float(number) if equals else 1.0
    except ValueError:
        value = 0.0
    if not name or not 0 < value < float("inf"):
        raise Invalid(f"'{text}' is no label; write NAME=NUMBER, as in GPU=1")
    return name, value
