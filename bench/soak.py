"""Load for a minute or longer, a real ROS 2 publisher, daemon, relay and client: what it cost, and what was lost.

A thousand small messages a second and ten of 20 KB, numbered, to one client that takes all of them.
"""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import Any

from bench.relay import Relay
from bench.report import Options, Row
from tests.worlds.processes import running
from tests.worlds.robot_process import Robot
from tests.worlds.ros_load import Counter, Publisher, meter_of, status_of
from tests.worlds.waiting import wait_for

TOPICS = ("small", "big")
RATE = 1000.0
SECONDS = 60.0
WARM_SECONDS = 5.0


def run(options: Options) -> list[Row]:
    """Watch one load from its beginning to its end."""
    seconds = options.seconds or options.pick(2, SECONDS)
    warm = options.pick(0.2, WARM_SECONDS)
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, contextlib.ExitStack() as stack:
        relay = Relay(Path(folder))
        stack.enter_context(running(relay))
        robot = Robot(relay, "rover")
        stack.enter_context(running(robot))
        token = relay.user("watcher")
        relay.cli("right", "grant", "watcher", "rover", "viewer")
        client = relay.connect("rover", token)
        messages = int(seconds * RATE)
        publisher = Publisher(robot, messages, RATE, window=messages)
        stack.enter_context(running(publisher))
        publisher.start()
        publisher.is_enough()
        publisher.known_to(client)
        counter = Counter(client, dict.fromkeys((*TOPICS, "unsure", "burst"), 0))
        stack.enter_context(running(counter))
        meter = meter_of(relay, robot)
        wait_for("it is warm", lambda: counter.last("small") > warm * RATE, 120)
        memory, cpu, first = meter.memory(), meter.cpu(), counter.last("small")
        sent = publisher.sent()
        for name in TOPICS:
            wait_for(f"the last of {name} comes", lambda name=name: counter.last(name) == sent[name] - 1, 60)
        grown = {name: now - memory[name] for name, now in meter.memory().items()}
        thousands = (sent["small"] - first) / 1000
        used = {name: (now - cpu[name]) * 1000 / thousands for name, now in meter.cpu().items()}
        status = status_of(relay, robot.name)
        return rows(sent, counter, grown, used, status)


def rows(
    sent: dict[str, Any],
    counter: Counter,
    grown: dict[str, int],
    used: dict[str, float],
    status: dict[str, Any],
) -> list[Row]:
    """What must hold, and what it cost."""
    lost = sum(len(counter.lost(name)) for name in TOPICS)
    lost += sum(each["drops"] for each in status["clients"]) + status["health"]["dropped_samples"]
    total = sum(sent[name] for name in TOPICS)
    found = [
        Row("soak", f"lost or dropped, of {total} messages", "messages", lost, bar=0),
        Row("soak", "bytes that wait at the end", "bytes", _waiting(status), bar=0),
        Row(
            "soak", "topics out of order", "topics", sum(not counter.in_order(each) for each in TOPICS), bar=0
        ),
    ]
    for name in ("relay", "daemon"):
        found.append(Row("soak", f"growth of the {name}'s memory", "MiB", grown[name] / 2**20, bar=8.0))
        found.append(Row("soak", f"{name}'s processor time", "ms/1000 messages", used[name]))
    for row in found:
        print(f"    {row.what}: {row.ours:.3g} {row.unit}", flush=True)
    return found


def _waiting(status: dict[str, Any]) -> int:
    return int(sum(each["waiting_bytes"] for each in status["clients"]))
