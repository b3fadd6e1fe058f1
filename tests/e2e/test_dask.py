"""A relay whose functions run on a worker of a Dask scheduler: without it, with it, and after its end."""

from __future__ import annotations

import shutil
from pathlib import Path

from tests.worlds import offload_functions
from tests.worlds.dask_processes import DaskScheduler, FunctionWorker
from tests.worlds.http_requests import Answer, ask
from tests.worlds.processes import running
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import wait_for


def test_functions_run_on_workers_and_jobs_outlast_them(tmp_path: Path) -> None:
    functions = tmp_path / "functions"
    functions.mkdir()
    shutil.copy(offload_functions.__file__, functions)
    with running(scheduler := DaskScheduler(tmp_path)):
        relay = Relay(tmp_path, "--offload-scheduler", scheduler.address)
        with running(relay):
            relay.cli("robot", "add", "rover")
            ann = relay.user("ann")
            relay.cli("right", "grant", "ann", "rover", "operator")

            def call(name: str, prefer: str = "wait=30", **arguments: object) -> Answer:
                path, body = f"/api/v1/functions/{name}", {"arguments": arguments}
                return ask(relay.http_port, "POST", path, body, headers={"Prefer": prefer}, token=ann)

            def job(id: str) -> dict[str, object]:
                return dict(ask(relay.http_port, "GET", f"/api/v1/jobs/{id}", token=ann).json)

            refused = call("add", a=1)
            assert (refused.status, "no worker is connected" in refused.json["detail"]) == (503, True)
            with running(worker := FunctionWorker(scheduler, "one", functions)):
                wait_for("an answer", lambda: call("add", a=1, b=2).status == 200)
                assert call("add", a=1, b=2).json["result"]["sum"] == 3
                once, often = tmp_path / "once", tmp_path / "often"
                lost = call("sleep", "respond-async", duration=25, began=str(once)).json["id"]
                wait_for("it runs", once.exists)
                kept = call("repeat", "respond-async", duration=2, began=str(often)).json["id"]
                worker.kill()
            wait_for("the loss", lambda: job(lost)["code"] == "lost")
            with running(FunctionWorker(scheduler, "two", functions)):
                wait_for("its result", lambda: job(kept)["state"] == "done")
            assert once.read_bytes() == b"x"
