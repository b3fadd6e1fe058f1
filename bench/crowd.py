"""One robot, fifty clients of mixed speed, and beside them one that breaks every rule, for two minutes.

Ten topics, among them a 300 KB PointCloud2 at 10 Hz, from a real ROS 2 publisher through a real daemon. First one
client alone, who wants everything: what it costs the robot is what the crowd may cost it too. Every message carries its
number and the time it was published; the fast clients' numbers must have no gap.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from bench.child import Child
from bench.cpu import resident, seconds_of
from bench.native import Receivers
from bench.report import Options, Row
from bench.robot import RealRobot, real_robot, settle
from bench.viewers import subscribe
from bench.wire import handshake
from tests.worlds.processes import running
from tests.worlds.ros_load import status_of
from tests.worlds.waiting import wait_for

CLOUD, SCAN = "/bench/cloud", "/bench/scan"
SMALL = [f"/bench/s{number}" for number in range(8)]
STREAMS: list[dict[str, Any]] = [
    {"topic": CLOUD, "kind": "cloud", "rate": 10.0, "size": 300_000},
    {"topic": SCAN, "kind": "scan", "rate": 20.0, "size": 0},
    *({"topic": topic, "kind": "string", "rate": 20.0, "size": 200} for topic in SMALL),
]
TYPES = {
    CLOUD: "sensor_msgs/msg/PointCloud2",
    SCAN: "sensor_msgs/msg/LaserScan",
    **dict.fromkeys(SMALL, "std_msgs/msg/String"),
}
THROTTLE_MS = 500
SLOW_BYTES = 1000
WARM_SECONDS, ALONE_SECONDS, CROWD_SECONDS = 10.0, 15.0, 120.0


@dataclass(frozen=True)
class Group:
    """Clients of one kind, each kind a user of its own.

    :param rate: bytes a second each reads; 0 all, -1 none
    """

    name: str
    count: int
    topics: tuple[str, ...]
    throttle: int = 0
    rate: float = 0


ALL = (CLOUD, SCAN, *SMALL)
GROUPS = (
    Group("fast-all", 10, ALL),
    Group("fast-small", 15, (SCAN, *SMALL)),
    Group("throttled", 5, ALL, throttle=THROTTLE_MS),
    Group("slow", 10, ALL, rate=SLOW_BYTES),
    Group("stalled", 10, ALL, rate=-1),
)


@dataclass
class Spell:
    """What was seen over some time."""

    seconds: float = 0.0
    cpu: dict[str, float] = field(default_factory=dict)
    """Processor milliseconds a second, by process."""
    uplink: float = 0.0
    """Bytes a second from the robot."""
    sent: dict[str, int] = field(default_factory=dict)
    memory: list[int] = field(default_factory=list)
    reports: dict[str, dict[str, Any]] = field(default_factory=dict)


class Ground:
    """Relay, robot, and who watches."""

    def __init__(self, robot: RealRobot) -> None:
        self.relay = robot.relay
        self.robot = robot
        self.pids = {"daemon": robot.pid, "relay": robot.relay.pid}
        self.watching: dict[str, Receivers] = {}

    def come(self, group: Group, count: int) -> None:
        """A group connects and subscribes."""
        request = handshake(f"/robots/{self.robot.name}", self.robot.viewer(group.name))
        frames = subscribe(*((topic, TYPES[topic], group.throttle) for topic in group.topics))
        self.watching[group.name] = Receivers(
            self.relay.folder,
            self.relay.http_port,
            count,
            request,
            frames,
            rate=group.rate,
            again=group.rate != 0,
        )

    def spell(self, seconds: float) -> Spell:
        """Watch for a while, memory every second."""
        for each in self.watching.values():
            each.report()
        seen = Spell()
        sent, up, begun = self.robot.publisher.sent(), self.robot.proxy.up, time.monotonic()
        cpu = {name: seconds_of(pid, children=True) for name, pid in self.pids.items()}
        while (left := begun + seconds - time.monotonic()) > 0:
            seen.memory.append(resident(self.pids["relay"]))
            time.sleep(min(1.0, left))  # memory is looked at once a second
        seen.seconds = time.monotonic() - begun
        for name, pid in self.pids.items():
            seen.cpu[name] = (seconds_of(pid, children=True) - cpu[name]) * 1000 / seen.seconds
        seen.uplink = (self.robot.proxy.up - up) / seen.seconds
        now = self.robot.publisher.sent()
        seen.sent = {topic: now[topic] - sent[topic] for topic in now}
        seen.reports = {name: each.report() for name, each in self.watching.items()}
        return seen


@contextlib.contextmanager
def breaking(robot: RealRobot) -> Iterator[dict[str, int]]:
    """A client that breaks every rule, meanwhile; what it has done is there at the end."""
    token = robot.viewer("breaker")
    command = [sys.executable, "-m", "bench.breaker", str(robot.relay.http_port), robot.name, token]
    breaker = Child(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    breaker.ready(AssertionError("the one that breaks every rule does not start; see above"))
    with running(breaker):
        done: dict[str, int] = {}
        yield done
        assert breaker.popen.stdin is not None
        breaker.popen.stdin.close()
        done.update(json.loads(breaker.line()))


def run(options: Options) -> list[Row]:
    """One alone, then all."""
    seconds = options.seconds or options.pick(1, CROWD_SECONDS)
    part = 0.05 if options.quick else 1.0
    with real_robot(STREAMS) as robot, contextlib.ExitStack() as stack:
        ground = Ground(robot)
        stack.callback(lambda: [each.stop() for each in ground.watching.values()])
        ground.come(Group("alone", 1, ALL), 1)
        wait_for("the first client has something of all", lambda: _topics(ground, "alone") == set(ALL), 30)
        settle(options)
        alone = ground.spell(options.pick(0.3, ALONE_SECONDS))
        for group in GROUPS:
            ground.come(group, max(1, round(group.count * part)))
        time.sleep(options.pick(0.3, WARM_SECONDS))  # the crowd's coming is not to be measured
        peaceful = ground.spell(options.pick(0.3, ALONE_SECONDS))
        with breaking(robot) as broken:
            crowd = ground.spell(seconds)
        dropped = status_of(robot.relay, robot.name)["health"]["dropped_samples"]
    tell({"one client": alone, "all": peaceful, "all and a rule breaker": crowd}, broken, dropped)
    return rows(alone, peaceful, crowd, dropped)


def _topics(ground: Ground, name: str) -> set[str]:
    return set(ground.watching[name].report()["topics"])


def fast(spell: Spell) -> list[dict[str, Any]]:
    """The reports of those who lose nothing."""
    return [spell.reports[name] for name in ("alone", "fast-all", "fast-small") if name in spell.reports]


def count(reports: list[dict[str, Any]], what: str) -> int:
    """A sum over all topics."""
    return sum(topic[what] for report in reports for topic in report["topics"].values())


EDGE = 3
"""Messages under way when a spell begins or ends, by topic."""


def lost(spell: Spell) -> int:
    """What fast clients did not get: gaps in the numbers, and what is short of what was published."""
    reports = fast(spell)
    short = sum(
        max(0, spell.sent[topic] - EDGE - seen["least"])
        for report in reports
        for topic, seen in report["topics"].items()
    )
    return count(reports, "lost") + short


def missing(spell: Spell) -> float:
    """Percent of what a throttled client was due that the worst served did not get."""
    topics = spell.reports["throttled"]["topics"].values()
    due = spell.seconds * 1000 / THROTTLE_MS
    return max(0.0, 100 * (1 - min(each["least"] for each in topics) / due))


def delay(spell: Spell) -> float:
    """Milliseconds from the publisher to a fast client, 99th percentile, of the worst served group."""
    return max(report["delay_us"]["p99"] / 1e3 for report in fast(spell))


def cut(spell: Spell) -> int:
    """Clients that had done nothing wrong and were cut."""
    return sum(report["cuts"] for name, report in spell.reports.items() if name not in ("slow", "stalled"))


def growth(memory: list[int]) -> float:
    """MiB between the median of the first third and that of the last."""
    third = max(1, len(memory) // 3)
    return (statistics.median(memory[-third:]) - statistics.median(memory[:third])) / 2**20


def tell(spells: dict[str, Spell], broken: dict[str, int], dropped: int) -> None:
    """The run in words."""
    crowd = list(spells.values())[-1]
    for name, spell in spells.items():
        published = sum(spell.sent.values()) / spell.seconds
        cpu = ", ".join(f"{process} {used:.1f} ms/s" for process, used in spell.cpu.items())
        print(
            f"    {name}, {spell.seconds:.0f} s: {published:.0f} messages/s published, "
            f"uplink {spell.uplink / 1e6:.2f} MB/s, {cpu}"
        )
    for name, report in crowd.reports.items():
        delay = report["delay_us"]
        print(
            f"    {name:<11} {report['messages']:>8} messages, {report['bytes'] / 1e6:>7.1f} MB, "
            f"cut {report['cuts']:>3} times, delay p50 {delay['p50'] / 1e3:.1f} p99 {delay['p99'] / 1e3:.1f} ms"
        )
    step = max(1, len(crowd.memory) // 12)
    over_time = " ".join(f"{each / 2**20:.0f}" for each in crowd.memory[::step])
    print(
        f"    relay's memory, MiB: {over_time} (least {min(crowd.memory) / 2**20:.1f}, "
        f"most {max(crowd.memory) / 2**20:.1f})"
    )
    print(
        f"    the rule breaker: {sum(broken.values())} attacks: {broken}; the robot dropped {dropped}",
        flush=True,
    )


def rows(alone: Spell, peaceful: Spell, crowd: Spell, dropped: int) -> list[Row]:
    """What must hold."""
    reports = fast(crowd)
    delivered = count(reports, "messages")
    memory = f"the relay held {min(crowd.memory) / 2**20:.1f} to {max(crowd.memory) / 2**20:.1f} MiB"
    return [
        Row(
            "crowd",
            f"lost by fast clients, of {delivered} messages",
            "messages",
            lost(crowd) + dropped,
            bar=0,
        ),
        Row("crowd", "fast and throttled clients cut", "clients", cut(crowd), bar=0),
        Row("crowd", "out of order", "messages", count(reports, "disorder"), bar=0),
        Row("crowd", "missed by the worst served throttled client", "%", missing(crowd), bar=5.0),
        *(
            Row(
                "crowd",
                f"delay of the fast, p99, {who}",
                "ms",
                delay(spell),
                delay(alone),
                "one client alone",
            )
            for who, spell in (("all clients", peaceful), ("all and a rule breaker", crowd))
        ),
        Row(
            "crowd",
            "robot's processor time, all clients",
            "ms/s",
            peaceful.cpu["daemon"],
            alone.cpu["daemon"],
            "one client alone",
            1.1,
        ),
        Row(
            "crowd",
            "robot's processor time, all and a rule breaker",
            "ms/s",
            crowd.cpu["daemon"],
            alone.cpu["daemon"],
            "one client alone",
            1.1,
        ),
        Row("crowd", "robot's uplink", "bytes/s", crowd.uplink, alone.uplink, "one client alone", 1.05),
        Row("crowd", "growth of the relay's memory", "MiB", growth(crowd.memory), bar=8.0, note=memory),
    ]
