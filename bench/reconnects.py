"""A Foxglove client that connects again and again by one URL, 3 s after each close, as the apps do."""

from __future__ import annotations

import contextlib
import json
import statistics
import time

import psutil
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from bench.report import Options, Row
from bench.robot import RealRobot, real_robot, settle
from tests.worlds.waiting import wait_for

PAUSE_SECONDS = 3.0
"""Seconds after which Foxglove and Lichtblick connect again."""

TIMES = 100
CUTS = 20
PATIENCE = 20.0
TOPIC = "/bench/scan"
STREAMS = [{"topic": TOPIC, "kind": "scan", "rate": 40.0, "size": 0}]
PROTOCOLS = [Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1")]
MIB = 1 << 20


def subscribe(client: ClientConnection) -> None:
    """Subscribe to the scan, as soon as it is advertised."""
    while True:
        data = client.recv(PATIENCE)
        message = json.loads(data) if isinstance(data, str) else {}
        for channel in message.get("channels", ()):
            if channel["topic"] == TOPIC:
                entry = {"id": 1, "channelId": channel["id"]}
                client.send(json.dumps({"op": "subscribe", "subscriptions": [entry]}))
                return


def first_sample_ms(url: str) -> float:
    """Connect, and wait for the first scan; milliseconds."""
    began = time.monotonic()
    with connect(url, subprotocols=PROTOCOLS, open_timeout=PATIENCE, close_timeout=1) as client:
        subscribe(client)
        while isinstance(client.recv(PATIENCE), str):
            pass
        return 1000 * (time.monotonic() - began)


def cut_ms(robot: RealRobot, address: str) -> float:
    """Milliseconds from the begin of ``foxglove-url revoke`` to the end of a client that receives samples."""
    made = robot.relay.cli("foxglove-url", "create", "rover", "watcher", "--relay", address)
    with connect(made["url"], subprotocols=PROTOCOLS, open_timeout=PATIENCE, close_timeout=1) as client:
        subscribe(client)
        began = time.monotonic()
        robot.relay.cli("foxglove-url", "revoke", str(made["id"]))
        with contextlib.suppress(ConnectionClosed):
            while True:
                client.recv(PATIENCE)
        return 1000 * (time.monotonic() - began)


def run(options: Options) -> list[Row]:
    """One URL, many connections one after the other."""
    pause, times = options.pick(0, PAUSE_SECONDS), int(options.pick(3, options.runs or TIMES))
    took: list[float] = []
    failures: list[str] = []
    with real_robot(STREAMS) as robot:
        relay = robot.relay
        settle(options)
        robot.viewer("watcher")
        address = f"http://127.0.0.1:{relay.http_port}"
        url = relay.cli("foxglove-url", "create", "rover", "watcher", "--relay", address)["url"]
        first_sample_ms(url)
        process = psutil.Process(relay.pid)
        before = process.memory_info().rss
        for _ in range(times):
            time.sleep(pause)
            try:
                took.append(first_sample_ms(url))
            except Exception as error:
                failures.append(repr(error))
        grown = max(0, process.memory_info().rss - before) / MIB
        cut = [cut_ms(robot, address) for _ in range(int(options.pick(1, CUTS)))]
        wait_for("the robot is not in use", lambda: relay.state_of("rover") == "online", PATIENCE)
    print(f"    failures: {failures}; milliseconds {sorted(round(each) for each in took)}", flush=True)
    what = f"{times} connections by one Foxglove URL, {pause:g} s apart"
    took = took or [PATIENCE * 1000]
    return [
        Row("reconnects", f"{what}: failed", "connections", len(failures), bar=0),
        Row("reconnects", f"{what}: until the first scan, median", "ms", statistics.median(took)),
        Row("reconnects", f"{what}: until the first scan, longest", "ms", max(took)),
        Row("reconnects", f"{what}: growth of the relay's memory", "MiB", grown, bar=8),
        Row(
            "reconnects",
            f"{len(cut)} revoked URLs: until the client is cut, longest",
            "ms",
            max(cut),
            bar=1000,
        ),
    ]
