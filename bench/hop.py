"""One hop through the relay: processor time per message, against websockify on the same machine in the same run.

The relay is a real one, with database, token and rights; every message is parsed, judged and, towards a robot
that speaks CDR, converted. The ends are plain (``bench/wire.py``), in this process, and count that all has come.
"""

from __future__ import annotations

import contextlib
import random
import statistics
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.cpu import measured
from bench.messages import STRING, TWIST, text_of
from bench.relay import Relay
from bench.report import Options, Row, Unavailable
from bench.websockify import Websockify
from bench.wire import End, Loop, PlainRobot, WebEnd, flood, one_at_a_time, text_frame
from relay_protocol import jsontext
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.processes import running

SMALL, LARGE = 200, 64 * 1024
WINDOW_SMALL, WINDOW_LARGE = 256, 8
"""Messages under way: less than a transport buffers before it holds the sender up, so that no sample is dropped."""
AGAINST = "websockify"


def text_message(topic: str, size: int) -> bytes:
    """A ``publish`` of a string, so many bytes in all."""
    empty = jsontext.encode({"op": "publish", "topic": topic, "msg": {"data": ""}})
    return empty.replace(b'""', b'"%s"' % (b"x" * (size - len(empty))))


def twist_message(topic: str, size: int) -> bytes:
    """A ``publish`` of a Twist with numbers as a joystick makes them, filled up with blanks."""
    twist = {
        "linear": {"x": 0.4173829374651, "y": 0.0, "z": 0.0},
        "angular": {"x": 0.0, "y": 0.0, "z": -0.88273645},
    }
    message = jsontext.encode({"op": "publish", "topic": topic, "msg": twist})
    return message[:-1].ljust(size - 1) + b"}"


VOCABULARY = """
the robot is at charger door corridor room kitchen waits for goal blocked by a person battery low near arrived left
right turn back stopped resumed speed zero obstacle ahead Tür geöffnet naïve 21°C
""".split()  # noqa: SIM905


def different_texts(topic: str, count: int) -> list[bytes]:
    """Different strings of a log, as ``publish`` of :data:`SMALL` bytes."""
    chance = random.Random(1)
    empty = jsontext.encode({"op": "publish", "topic": topic, "msg": {"data": ""}})
    room = SMALL - len(empty)
    messages = []
    for number in range(count):
        words = f"[{number}] {chance.random() * 100:.3f} s: " + " ".join(chance.choices(VOCABULARY, k=40))
        data = words.encode()[:room].decode(errors="ignore").ljust(room)
        messages.append(empty.replace(b'""', b'"%s"' % data.encode()[:room]))
    return messages


def different_twists(topic: str, count: int) -> list[bytes]:
    """Different commands, as :func:`twist_message` has one."""
    chance = random.Random(1)
    messages = []
    for _ in range(count):
        twist = {
            "linear": {"x": chance.uniform(-1.0, 1.0), "y": 0.0, "z": 0.0},
            "angular": {"x": 0.0, "y": 0.0, "z": chance.uniform(-2.0, 2.0)},
        }
        message = jsontext.encode({"op": "publish", "topic": topic, "msg": twist})
        messages.append(message[:-1].ljust(SMALL - 1) + b"}")
    return messages


@dataclass
class Hop:
    """A way to measure: what is sent, by whom, and how it is known to have come.

    :param messages: one that is sent again and again, or different ones
    :param pids: processes whose processor time counts
    :param window: messages under way at most; with ``single`` one
    :param receiver: where it arrives
    """

    sender: End
    messages: Sequence[bytes]
    received: Callable[[], int]
    pids: tuple[int, ...]
    window: int
    single: bool = False
    receiver: End | None = None

    def run(self, loop: Loop, total: int) -> float:
        """Microseconds of processor time per message."""
        with measured(*self.pids, children=True) as watch:
            if self.single:
                one_at_a_time(loop, self.sender, self.messages, total, self.received)
            else:
                flood(loop, self.sender, self.messages, total, self.received, self.window)
        return watch.seconds * 1e6 / total


class Ground:
    """A relay with two plain robots, one speaking JSON, one CDR, and a client at each."""

    def __init__(self, loop: Loop, relay: Relay) -> None:
        self.loop = loop
        self.pid = relay.pid
        token = relay.user("driver")
        texts = text_of(STRING, TWIST)
        self.types = TypeRegistry()
        self.types.add(STRING, texts[STRING])
        self.robots: dict[str, PlainRobot] = {}
        self.clients: dict[str, WebEnd] = {}
        for encoding in ("json", "cdr"):
            robot = self.robots[encoding] = PlainRobot(
                loop, relay, f"plain-{encoding}", encoding, texts, (TWIST,)
            )
            relay.cli("right", "grant", "driver", robot.name, "operator")
            client = self.clients[encoding] = WebEnd(loop, relay.http_port, f"/robots/{robot.name}", token)
            client.say(op="advertise", topic="/chatter", type=STRING)
            client.say(op="advertise", topic="/cmd_vel", type=TWIST)
            client.say(op="subscribe", topic="/told", type=STRING)
            loop.until("the relay has subscribed", lambda robot=robot: "/told" in robot.subscriptions)
            self._warm(robot, client)

    def _warm(self, robot: PlainRobot, client: WebEnd) -> None:
        """Types have come and the first pings are answered when a message of each kind has passed."""
        for message in (text_message("/chatter", SMALL), twist_message("/cmd_vel", SMALL)):
            before = robot.received
            client.send(text_frame(message))
            self.loop.until("the first message comes", lambda before=before: robot.received > before)
        before = client.messages
        robot.channel.send(self._sample(robot, SMALL))
        self.loop.until("the first sample comes", lambda: client.messages > before)

    def _sample(self, robot: PlainRobot, size: int) -> bytes:
        return self._sample_of(robot, text_message("/told", size))

    def _sample_of(self, robot: PlainRobot, message: bytes) -> bytes:
        body = jsontext.decode_any(message)["msg"]
        return robot.sample(
            "/told",
            jsontext.encode(body) if robot.encoding == "json" else self.types.from_json(STRING, body, 0),
        )

    def to_robot(self, encoding: str, messages: list[bytes], window: int, *, single: bool = False) -> Hop:
        """Client to robot."""
        robot = self.robots[encoding]
        sender = self.clients[encoding]
        sent = [text_frame(message) for message in messages]
        return Hop(sender, sent, lambda: robot.received, (self.pid,), window, single, robot.channel)

    def to_client(self, encoding: str, messages: list[bytes], window: int, *, single: bool = False) -> Hop:
        """Robot to client.

        :param messages: as a client would publish them
        """
        robot, client = self.robots[encoding], self.clients[encoding]
        samples = [self._sample_of(robot, message) for message in messages]
        assert robot.channel is not None
        return Hop(robot.channel, samples, lambda: client.messages, (self.pid,), window, single, client)


@contextlib.contextmanager
def proxies(loop: Loop) -> Iterator[Any]:
    """websockify for each size of message, started when asked for."""
    with contextlib.ExitStack() as stack:
        made: dict[int, Websockify] = {}

        def proxy(size: int) -> Websockify:
            if size not in made:
                made[size] = Websockify(loop, size)
                stack.callback(made[size].stop)
            return made[size]

        yield proxy


def through_websockify(
    proxy: Any, size: int, *, to_server: bool, window: int, single: bool = False
) -> Hop | None:
    """The same messages through websockify; ``None`` where there is none."""
    try:
        ends = proxy(size)
    except Unavailable:
        return None
    payload = b"x" * size
    if to_server:
        message = text_frame(payload, binary=True)
        return Hop(ends.client, [message], lambda: ends.server.messages, (ends.pid,), window, single)
    client = ends.client
    # A stream has no messages: what comes together is sent as one. Bytes are counted.
    return Hop(ends.server, [payload], lambda: client.payload_bytes // size, (ends.pid,), window, single)


@dataclass
class Case:
    """One row to be: ours, theirs (or none), messages a round."""

    what: str
    ours: Hop
    theirs: Hop | None
    total: int
    ratio_bar: float | None = None
    note: str = ""


def cases(ground: Ground, proxy: Any, options: Options) -> list[Case]:
    """All that is measured, with the number of messages of a round."""
    many, few = int(options.pick(200, 50_000)), int(options.pick(10, 1000))
    singles = int(options.pick(10, 3000))
    up_small = through_websockify(proxy, SMALL, to_server=True, window=WINDOW_SMALL)
    down_single = through_websockify(proxy, SMALL, to_server=False, window=1, single=True)
    up_large = through_websockify(proxy, LARGE, to_server=True, window=WINDOW_LARGE)
    down_large = through_websockify(proxy, LARGE, to_server=False, window=WINDOW_LARGE)
    merged = "towards a client websockify merges small messages, so flooded ones can't be compared"
    if up_small is None:
        merged = "websockify is not installed (scripts/setup.sh bench): ours alone"
    found = []
    up = {
        "String": [text_message("/chatter", SMALL)],
        "String, each different": different_texts("/chatter", many),
        "Twist, a motion command": [twist_message("/cmd_vel", SMALL)],
        "Twist, each different": different_twists("/cmd_vel", many),
    }
    for encoding, bar in (("json", 0.25), ("cdr", None)):
        name = encoding.upper()
        for what, messages in up.items():
            hop = ground.to_robot(encoding, messages, WINDOW_SMALL)
            found.append(Case(f"client → {name} robot, 200 B, {what}", hop, up_small, many, bar))
    down = {"": [text_message("/told", SMALL)], ", each different": different_texts("/told", many)}
    for encoding in ("json", "cdr"):
        for what, messages in down.items():
            hop = ground.to_client(encoding, messages, WINDOW_SMALL)
            found.append(
                Case(f"{encoding.upper()} robot → client, 200 B{what}", hop, None, many, note=merged)
            )
    hop = ground.to_client("cdr", down[""], 1, single=True)
    found.append(Case("CDR robot → client, 200 B, one at a time", hop, down_single, singles))
    large = text_message("/chatter", LARGE)
    hop = ground.to_robot("json", [large], WINDOW_LARGE)
    found.append(Case("client → JSON robot, 64 KiB", hop, up_large, few))
    hop = ground.to_client("cdr", [text_message("/told", LARGE)], WINDOW_LARGE)
    found.append(Case("CDR robot → client, 64 KiB", hop, down_large, few))
    return found


def measure(loop: Loop, case: Case, rounds: int) -> Row:
    """Ours and theirs in turn; medians."""
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(case.ours.run(loop, case.total))
        if case.theirs is not None:
            theirs.append(case.theirs.run(loop, case.total))
    row = Row(
        "hop",
        case.what,
        "µs/message",
        statistics.median(ours),
        statistics.median(theirs) if theirs else None,
        AGAINST if theirs else "",
        case.ratio_bar if theirs else None,
        note=case.note,
    )
    print(
        f"    {row.what}: {row.ours:.2f} µs" + (f", {AGAINST} {row.other:.2f} µs" if row.other else ""),
        flush=True,
    )
    return row


def run(options: Options) -> list[Row]:
    """Measure every case."""
    rounds = int(options.pick(1, 3))
    loop = Loop()
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        # Heartbeats are rare, because nobody turns the loop while robots and users are added.
        relay = Relay(Path(folder), "--heartbeat", "60")
        with running(relay), contextlib.closing(loop):
            ground = Ground(loop, relay)
            with proxies(loop) as proxy:
                return [measure(loop, case, rounds) for case in cases(ground, proxy, options)]
