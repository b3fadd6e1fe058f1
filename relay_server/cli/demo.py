"""``switchboard demo``."""

from __future__ import annotations

import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

import click

from relay_server.cli.app import examples


@click.command(
    epilog=examples(
        "switchboard demo",
        "switchboard demo --http 127.0.0.1:9090 --data ./demo",
        "switchboard demo --http 0.0.0.0:9090   # reachable from other machines",
    )
)
@click.option(
    "--data",
    type=click.Path(file_okay=False, path_type=Path),
    help="Keep everything in this folder; else a temporary one.",
)
@click.option(
    "--http", default="127.0.0.1:0", metavar="HOST:PORT", show_default=True, help="Port 0: any free one."
)
@click.option("--robots", default="127.0.0.1:0", metavar="HOST:PORT", show_default=True)
def demo(data: Path | None, http: str, robots: str) -> None:
    """Run a relay with two simulated ROS 2 robots and three users, until Ctrl-C.

    Prints READY with the address once both robots are online.
    """
    from relay_server.config import ListenAddress
    from relay_server.demo import run_demo

    with ExitStack() as stack:
        if data is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="switchboard-demo-")))
        else:
            folder = data.absolute()
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        code = run_demo(folder, ListenAddress.parse(http), ListenAddress.parse(robots))
    sys.exit(code)
