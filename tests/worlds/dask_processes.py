"""A Dask scheduler and workers (``switchboard worker``) as processes on loopback."""

from __future__ import annotations

import json
from pathlib import Path

from tests.worlds.alert_receivers import self_signed
from tests.worlds.processes import BIN, Process
from tests.worlds.waiting import wait_for


class DaskScheduler:
    """``dask scheduler``.

    :param tls: whether it accepts only clients with its certificate
    :ivar address: the same after a restart
    :ivar tls: files of its CA, a certificate and its key; empty without TLS
    """

    def __init__(self, folder: Path, *, tls: bool = False) -> None:
        self.folder = folder
        self.tls = ("", "", "")
        self._options: list[str] = []
        if tls:
            file = folder / "certificate.pem"
            file.write_bytes(self_signed("127.0.0.1"))
            self.tls = (str(file), str(file), str(file))
            self._options = ["--protocol", "tls", "--tls-ca-file", str(file), "--tls-cert", str(file)]
            self._options += ["--tls-key", str(file)]
        self._port = 0
        self.start()

    def start(self) -> None:
        """Starts it, on the port it had before."""
        file = self.folder / "scheduler.json"
        file.unlink(missing_ok=True)
        command = [str(BIN / "dask"), "scheduler", "--no-dashboard", "--no-show", "--host", "127.0.0.1"]
        command += ["--port", str(self._port), "--scheduler-file", str(file), *self._options]
        self.process = Process(command, self.folder, "scheduler")
        self.address = str(
            wait_for("the scheduler", lambda: file.exists() and json.loads(file.read_text() or "{}"), 60)[
                "address"
            ]
        )
        self._port = int(self.address.rpartition(":")[2])

    def kill(self) -> None:
        """kill -9."""
        self.process.kill()

    def stop(self) -> None:
        self.process.stop()


class FunctionWorker:
    """``switchboard worker``, connected."""

    def __init__(self, scheduler: DaskScheduler, name: str, functions: Path, *options: str) -> None:
        command = [str(BIN / "switchboard"), "worker", scheduler.address, "--name", name]
        command += ["--folder", str(functions), *options]
        command += ["--tls", *scheduler.tls] if any(scheduler.tls) else []
        self.process = Process(command, scheduler.folder, name)
        self.process.wait_to_say("READY")

    def connections(self) -> int:
        """The number of its connections so far."""
        return self.process.said().count("READY")

    def kill(self) -> None:
        """kill -9."""
        self.process.kill()

    def stop(self) -> None:
        self.process.stop()
