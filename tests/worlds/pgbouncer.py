"""PgBouncer in front of a PostgreSQL server, on a port from the OS."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import psycopg

from tests.worlds.processes import Process
from tests.worlds.waiting import wait_for


@contextmanager
def pgbouncer(url: str, folder: Path) -> Iterator[str]:
    """URL of a database behind a PgBouncer that gives each transaction any of two servers (transaction pooling).

    :param url: of the database, by a socket in a folder of the server's user
    :param folder: readable by that user
    """
    program = shutil.which("pgbouncer", path=os.environ["PATH"] + os.pathsep + "/usr/sbin")
    assert program is not None, (
        "pgbouncer is not installed; run scripts/setup.sh broker, or: apt install pgbouncer"
    )
    parts = urlsplit(url)
    sockets = Path(parse_qs(parts.query)["host"][0])
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    settings = {
        "listen_addr": "127.0.0.1",
        "listen_port": port,
        "unix_socket_dir": "",
        "auth_type": "any",
        "pool_mode": "transaction",
        "default_pool_size": 2,
        # It does not run as root; the server's user may use the socket.
        **({"user": sockets.owner()} if os.getuid() == 0 else {}),
    }
    config = folder / "pgbouncer.ini"
    lines = [f"{name} = {value}" for name, value in settings.items()]
    config.write_text(
        f"[databases]\n* = host={sockets} user=postgres\n[pgbouncer]\n" + "\n".join(lines) + "\n"
    )
    config.chmod(0o644)
    process = Process([program, str(config)], folder, "pgbouncer")
    behind = f"postgresql://postgres@127.0.0.1:{port}{parts.path}"
    try:
        wait_for("PgBouncer answers", lambda: _answers(behind))
        yield behind
    finally:
        process.stop()


def _answers(url: str) -> bool:
    try:
        psycopg.connect(url).close()
    except psycopg.OperationalError:
        return False
    return True
