"""Valid options of ``switchboard serve``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from relay_server import logs
from relay_server import run as running
from relay_server.cluster.workers import WorkerSupervisor
from relay_server.config import RelaySettings

POSTGRESQL = ("--db", "postgresql://db/relay")


@pytest.fixture
def began(monkeypatch: pytest.MonkeyPatch) -> list[RelaySettings]:
    """Settings of the relays that were started."""
    found: list[RelaySettings] = []
    monkeypatch.setattr(running, "run", lambda settings, ready: found.append(settings))
    monkeypatch.setattr(logs, "begin", lambda *how, **later: None)
    return found


def test_a_request_for_control_lapses_after_the_grace_time(cli: Any, began: list[RelaySettings]) -> None:
    """Otherwise an owner could never take over."""
    cli.ok("serve")
    cli.ok("serve", "--control-grace", "5", "--control-request", "10")
    assert [(each.control_grace, each.control_request) for each in began] == [(30, 60), (5, 10)]
    for options in (("--control-grace", "60"), ("--control-request", "30"), ("--control-request", "90000")):
        assert "owners may take over in between" in cli.fails("serve", *options)
    assert len(began) == 2


def test_the_free_space_of_recordings_is_not_negative(cli: Any, began: list[RelaySettings]) -> None:
    cli.ok("serve")
    cli.ok("serve", "--recordings-gb", "0.5", "--recordings-reserve-gb", "2.5")
    found = [(each.recordings, each.recordings_reserve) for each in began]
    assert found == [(10 * 10**9, 10**9), (500_000_000, 2_500_000_000)]
    for option in ("--recordings-gb", "--recordings-reserve-gb"):
        assert "must be from 0 to" in cli.fails("serve", option, "-1")
    assert len(began) == 2


def test_requests_are_limited_unless_they_are_not(cli: Any, began: list[RelaySettings]) -> None:
    cli.ok("serve")
    cli.ok("serve", "--requests-per-second", "0")
    assert [each.requests for each in began] == [500, 0]
    cli.ok("serve", "--streams-per-user", "0")
    assert [each.streams for each in began] == [128, 128, 0]
    cli.ok("serve", "--connections-per-network", "0")
    assert [each.connections for each in began] == [512, 512, 512, 0]
    assert "--requests-per-second must be from 0" in cli.fails("serve", "--requests-per-second", "-1")


def test_functions_run_here_or_on_the_workers_of_a_scheduler(cli: Any, began: list[RelaySettings]) -> None:
    scheduler = ("--offload-scheduler", "tls://10.0.0.5:8786")
    cli.ok("serve", *scheduler, "--offload-tls", "ca.pem", "relay.pem", "relay.key")
    offload = began[0].offload
    assert (offload.scheduler, offload.tls) == ("tls://10.0.0.5:8786", ("ca.pem", "relay.pem", "relay.key"))
    for options in (("--offload-processes", "2"), ("--offload-folder", "/")):
        assert "options of 'switchboard worker'" in cli.fails("serve", *scheduler, *options)
    assert "goes with --offload-scheduler" in cli.fails("serve", "--offload-tls", "a", "b", "c")
    assert len(began) == 1


@pytest.mark.parametrize(
    ("database", "options", "reason"),
    [
        ((), (), "--workers needs PostgreSQL"),
        (POSTGRESQL, (), "--workers needs NATS"),
        (POSTGRESQL, ("--cluster-bus", "nats://x", "--cluster-listen", "0.0.0.0:0"), "loopback"),
    ],
)
def test_workers_need_postgresql_and_a_bus(
    cli: Any, database: tuple[str, ...], options: tuple[str, ...], reason: str
) -> None:
    assert reason in cli.fails(*database, "serve", "--workers", "2", *options)


def test_workers_of_one_machine_need_no_name_and_no_secret(
    cli: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The ports of the cluster are on loopback, so they need no TLS with a name of the certificate."""
    found: list[RelaySettings] = []
    monkeypatch.setattr(
        WorkerSupervisor, "__init__", lambda self, reactor, settings, count, *, secret: found.append(settings)
    )
    monkeypatch.setattr(WorkerSupervisor, "run", lambda self: 0)
    monkeypatch.setattr(logs, "begin", lambda *how, **more: None)
    tls = ("--tls-cert", str(tmp_path / "chain.pem"), "--tls-key", str(tmp_path / "key.pem"))
    cli.ok(*POSTGRESQL, "serve", "--workers", "2", "--cluster-bus", "nats://x", *tls)
    (settings,) = found
    assert settings.cluster is not None
    assert settings.tls
    assert not settings.cluster.tls
