"""``python -m bench.cluster_rights``: how soon a right that is revoked at one relay ends a websocket at another one.

Three relays, three NATS servers, one PostgreSQL, a robot at the first relay, and a viewer at the third one whose
right is revoked at the first. Then the same while NATS is down, so that the relays find the change in the database.
Times are from the begin of the command to the end of the websocket. It is a trial, not a measurement: nothing is
kept.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from bench.cluster import ClusterRelay, database, start_relays
from bench.cluster_failures import Rover
from tests.worlds.nats_servers import nats_cluster

LIMIT = 1.0
REVOKED = 4403
PATIENCE = 60.0


def cut_after(first: ClusterRelay, third: ClusterRelay, token: str) -> float:
    """Seconds from the begin of the command that revokes the right to the end of the websocket."""
    first.cli("right", "grant", "vic", "rover", "viewer")
    url, headers = f"ws://127.0.0.1:{third.http_port}/robots/rover", {"Authorization": f"Bearer {token}"}
    ended: list[float] = []

    def read(socket: ClientConnection) -> None:
        try:
            while True:
                socket.recv(PATIENCE)
        except ConnectionClosed as error:
            if error.rcvd is not None and error.rcvd.code == REVOKED:
                ended.append(time.monotonic())

    with connect(url, additional_headers=headers, open_timeout=PATIENCE) as socket:
        socket.send('{"op": "call_service", "service": "/rosapi/topics", "id": "1"}')
        socket.recv(PATIENCE)
        reading = threading.Thread(target=read, args=(socket,), daemon=True)
        reading.start()
        began = time.monotonic()
        first.cli("right", "revoke", "vic", "rover")
        reading.join(PATIENCE)
    assert ended, "the websocket was not closed"
    return ended[0] - began


def main() -> int:
    """Try it; the code is 1 when a right held longer than a second with NATS."""
    parser = argparse.ArgumentParser(prog="python -m bench.cluster_rights", description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    asked = parser.parse_args()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-")))
        url = stack.enter_context(database())
        nats = stack.enter_context(nats_cluster(folder / "nats"))
        relays = start_relays(stack, folder / "relays", url, nats, "1")
        robot = Rover(relays)
        robot.begin()
        stack.callback(robot.end)
        token = relays[0].user("vic")
        worst = {}
        for bus in ("with NATS", "without NATS"):
            if bus == "without NATS":
                for each in nats:
                    each.kill()
            times = [cut_after(relays[0], relays[2], token) for _ in range(asked.runs)]
            worst[bus] = max(times)
            print(
                f"{bus}, {len(times)} times: p50 {statistics.median(times):.3f} s, worst {worst[bus]:.3f} s",
                flush=True,
            )
    return int(worst["with NATS"] > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
