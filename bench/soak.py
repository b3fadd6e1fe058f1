"""Load for a minute or longer: a real ROS 2 publisher, daemon, relay and client; prints what it cost.

``python bench/soak.py [--minutes N] [--rate MESSAGES_PER_SECOND]``. Ends with code 1 when a message was lost or
something still waits in a queue.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / each) for each in (".", "protocol", "db", "tests/harness")]

from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from switchboard_harness import Relay, Robot, running, wait_for  # noqa: E402
from switchboard_load import Counter, Publisher, meter_of, status_of  # noqa: E402

TOPICS = ("small", "big")
WARM_SECONDS = 5


def soak(folder: Path, seconds: float, rate: float) -> bool:
    """Run, print the figures, and tell whether nothing was lost."""
    relay = Relay(folder)
    with running(relay):
        robot = Robot(relay, "rover")
        with running(robot):
            token = relay.user("watcher")
            relay.cli("right", "grant", "watcher", "rover", "viewer")
            client = relay.connect("rover", token)
            publisher = Publisher(robot, seconds, rate)
            with running(publisher):
                publisher.known_to(client)
                counter = Counter(client, dict.fromkeys((*TOPICS, "unsure", "burst"), 0))
                with running(counter):
                    return measured(relay, robot, publisher, counter, rate)


def measured(relay: Relay, robot: Robot, publisher: Publisher, counter: Counter, rate: float) -> bool:
    """Watch one load from its beginning to its end."""
    meter = meter_of(relay, robot)
    wait_for("it is warm", lambda: counter.last("small") > WARM_SECONDS * rate, 120)
    warm, cpu, first = meter.memory(), meter.cpu(), counter.last("small")
    sent = publisher.sent()
    for name in TOPICS:
        wait_for(f"the last of {name} comes", lambda name=name: counter.last(name) == sent[name] - 1, 60)
    end, used = meter.memory(), meter.cpu()
    status = status_of(relay, robot.name)
    show_messages(counter, sent)
    thousands = (sent["small"] - first) / 1000
    show_processes(warm, end, {name: (used[name] - cpu[name]) / thousands for name in used})
    waiting = sum(each["waiting_bytes"] for each in status["clients"])
    drops = sum(each["drops"] for each in status["clients"])
    lost_by_robot = status["health"]["dropped_samples"]
    print(
        f"waiting for clients {waiting} bytes, dropped for clients {drops}, dropped by the robot {lost_by_robot}"
    )
    return not (waiting or drops or lost_by_robot or any(counter.lost(name) for name in TOPICS))


def show_messages(counter: Counter, sent: dict[str, Any]) -> None:
    """What was sent and what came."""
    table = Table("topic", "sent", "per second", "came", "lost", "in order", title="Messages")
    for name in (*TOPICS, "unsure"):
        table.add_row(
            f"/load/{name}",
            str(sent[name]),
            f"{sent[name] / sent['seconds']:.0f}",
            str(len(counter.numbers[name])),
            str(len(counter.lost(name))),
            "yes" if counter.in_order(name) else "no",
        )
    Console().print(table)


def show_processes(warm: dict[str, int], end: dict[str, int], cpu: dict[str, float]) -> None:
    """What it cost."""
    table = Table("process", "MiB warm", "MiB at the end", "CPU s per 1000 messages", title="Processes")
    for name in warm:
        table.add_row(name, f"{warm[name] / 2**20:.1f}", f"{end[name] / 2**20:.1f}", f"{cpu[name]:.3f}")
    Console().print(table)


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--rate", type=float, default=1000.0, help="messages a second on the small topic")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        return 0 if soak(Path(folder), options.minutes * 60, options.rate) else 1


if __name__ == "__main__":
    sys.exit(main())
