"""Orders on the robot itself."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.task import Clock
from twisted.internet.threads import deferToThread
from twisted.logger import capturedLogs

from relay_protocol.errors import Refused, Unavailable
from robot_client.modules.local_orders import LocalOrderServer, send_local_order
from robot_client.modules.settings import ModuleSettings
from robot_client.modules.supervisor import ModuleSupervisor
from robot_client.platforms.base import GraphView


@pytest.fixture
def server(tmp_path: Path) -> LocalOrderServer:
    base = ModuleSettings(name="base", command=["/no/such"], autostart=False, after=["first"])
    first = ModuleSettings(name="first", command=["/no/such"], autostart=False)
    supervisor = ModuleSupervisor(
        [base, first],
        tmp_path,
        reactor=Clock(),
        environment={},
        graph=GraphView,
        alert=lambda *args, **more: None,
        boot="",
    )
    return LocalOrderServer(supervisor, tmp_path)


def test_order_is_carried_out(server: LocalOrderServer) -> None:
    def states() -> dict[str, str]:
        return {each["name"]: each["state"] for each in server.carry_out(b'{"do": "list"}')["modules"]}

    assert states() == {"base": "stopped", "first": "stopped"}
    assert server.carry_out(b'{"do": "start", "module": "base"}') == {"error": ""}
    assert states() == {"base": "waiting", "first": "stopped"}
    assert server.carry_out(b'{"do": "stop", "module": "base"}') == {"error": ""}
    assert states() == {"base": "stopped", "first": "stopped"}


@pytest.mark.parametrize(
    ("order", "error"),
    [
        (b"nonsense", "this is not an order"),
        (b"[]", "this is not an order"),
        (b"7", "this is not an order"),
        (b"[" * 100_000, "this is not an order"),
        ({"do": "explode", "module": "base"}, "'explode' is not 'list', 'start', 'stop' or 'restart'"),
        ({"do": "start", "module": "arm"}, "the robot has no module 'arm'; it has base, first"),
        ({"do": "start"}, "the robot has no module ''; it has base, first"),
        ({"do": ["start"], "module": "base"}, "'['start']' is not 'list', 'start', 'stop' or 'restart'"),
    ],
)
def test_wrong_order_is_explained(server: LocalOrderServer, order: Any, error: str) -> None:
    line = order if isinstance(order, bytes) else json.dumps(order).encode()
    assert server.carry_out(line) == {"error": error}


@pytest_twisted.ensureDeferred
async def test_orders_come_by_a_socket_for_its_user_alone_however_long_its_path(
    server: LocalOrderServer, tmp_path: Path
) -> None:
    folder = tmp_path / ("long" * 30)
    folder.mkdir()
    (folder / "orders.sock").touch()  # of a daemon that was killed
    other = LocalOrderServer(server._supervisor, folder)
    other.start(reactor)
    assert stat.S_IMODE((folder / "orders.sock").stat().st_mode) == 0o600
    listed = await deferToThread(send_local_order, folder, "list")
    assert [each["name"] for each in listed["modules"]] == ["base", "first"]
    with pytest.raises(Refused, match="the robot has no module 'arm'"):
        await deferToThread(send_local_order, folder, "start", "arm")
    await other.stop()
    with pytest.raises(Unavailable):
        await deferToThread(send_local_order, folder, "list")


def test_folder_that_takes_no_socket_is_reported(server: LocalOrderServer, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    other = LocalOrderServer(server._supervisor, tmp_path / "file")
    with capturedLogs() as events:
        other.start(reactor)
    other.stop()
    assert [each["reason"] for each in events] == [f"[Errno 17] File exists: '{tmp_path}/file'"]


def test_missing_daemon_is_named(tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match=r"no daemon takes orders in .*: No such file or directory"):
        send_local_order(tmp_path, "list")
