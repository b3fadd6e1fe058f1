"""Bystanders: clients that read while others misbehave, and must not be affected."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.worlds.client_threads import Listener
from tests.worlds.machine_pauses import Pulse
from tests.worlds.relay_process import Relay
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

STAMP_GAP = 1.0
"""Seconds between two odometry stamps that a busy machine can explain; the simulator sends 20 a second or more."""


class Watcher(Listener):
    """A client that reads odometry all the time and stores the stamps."""

    def __init__(self, client: Client) -> None:
        super().__init__(client)
        self.stamps: list[float] = []
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")

    def take(self, message: dict[str, Any]) -> None:
        """Stores its stamp."""
        stamp = message["msg"]["header"]["stamp"]
        self.stamps.append(stamp["sec"] + stamp["nanosec"] / 1e9)


@contextmanager
def bystanders(relay: Relay, robot: str, *tokens: str) -> Iterator[list[Watcher]]:
    """A bystander for each token."""
    watchers = [Watcher(relay.connect(robot, token)) for token in tokens]
    for each in watchers:
        each.start()
    try:
        yield watchers
    finally:
        for each in watchers:
            each.stop()


@contextmanager
def undisturbed(relay: Relay, watchers: list[Watcher]) -> Iterator[None]:
    """During the block no bystander loses a message, the process is the same, and the log shows no traceback."""
    for each in watchers:
        wait_for("odometry comes", lambda each=each: each.stamps)
    begun = [len(each.stamps) for each in watchers]
    logged = len(relay.log)
    process = relay.process.popen
    with Pulse() as pulse:
        yield
        for each in watchers:
            seen = len(each.stamps)
            wait_for("odometry still comes", lambda each=each, seen=seen: len(each.stamps) > seen + 3)
        held_up = pulse.held_up()
    for each, start in zip(watchers, begun, strict=True):
        assert each.broken == ""
        stamps = each.stamps[start - 1 :]
        gaps = [later - earlier for earlier, later in itertools.pairwise(stamps)]
        assert min(gaps) > 0
        # A stalled machine sends nothing meanwhile.
        assert max(gaps) < STAMP_GAP + held_up
    assert relay.process.popen is process
    assert process.poll() is None
    assert "Traceback" not in relay.log[logged:]
