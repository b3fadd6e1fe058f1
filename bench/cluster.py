"""Three relays with PostgreSQL and NATS: one hop more, viewers at all of them, and the death of one with its robots.

The relays, NATS servers and the database are real, and all on this machine, with the robots and clients. So figures of
processor time count, and times of many at once say how long this machine needs for all of it.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from click.testing import CliRunner

from bench.child import Child
from bench.cpu import measured, resident
from bench.hop import SMALL, WINDOW_SMALL, Hop, text_message
from bench.latency import delays
from bench.light_fleet import PERIOD
from bench.light_fleet import TOPIC as STATE
from bench.messages import STRING, text_of
from bench.native import Receivers
from bench.relay import Relay
from bench.report import Options, Row, Unavailable
from bench.wire import Loop, PlainRobot, WebEnd, handshake, text_frame
from relay_db import queries
from relay_db.engine import Database
from relay_protocol import identity, jsontext, link
from relay_protocol.ros_types import TypeRegistry
from relay_server.auth import passwords
from relay_server.cli import main
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.nats_servers import NatsServer, nats_cluster
from tests.worlds.processes import running
from tests.worlds.waiting import wait_for

NAME = "fleet.example.org"
RATE = 100.0
SIZE = 1000
USERS = 20
A_SECOND = 15
"""Robots that connect in a second, and then clients: what two cores can take beside the simulated ones."""


class ClusterRelay(Relay):
    """A relay whose database is not in its folder."""

    def cli(self, *arguments: str, stdin: str = "") -> Any:
        """See :meth:`Relay.cli`."""
        environment = {"SWITCHBOARD_DB": self._database or ""}
        words = ["--data", str(self.data), *arguments, "--json"]
        done = CliRunner().invoke(main, words, input=stdin, env=environment)
        assert done.exit_code == 0, f"{arguments}: {done.stderr}"
        return json.loads(done.stdout) if done.stdout.strip() else None


@contextlib.contextmanager
def database() -> Iterator[str]:
    """URL of an empty database. Its folder is none that other users can't enter."""
    try:
        import psycopg
        from pgserver.postgres_server import get_server
    except ImportError:
        raise Unavailable("no PostgreSQL (pip install pgserver 'psycopg[binary]')") from None
    folder = Path(tempfile.mkdtemp(prefix="bench-postgresql-"))
    server: Any = get_server(folder / "data", cleanup_mode="stop")
    try:
        with psycopg.connect(server.get_uri(), autocommit=True) as connection:
            connection.execute("CREATE DATABASE relay")
        yield str(server.get_uri("relay"))
    finally:
        server.cleanup()
        shutil.rmtree(folder, ignore_errors=True)


def start_relays(
    stack: contextlib.ExitStack,
    folder: Path,
    url: str,
    bus: list[NatsServer],
    heartbeat: str,
    links: Sequence[ChaosProxy] = (),
) -> list[ClusterRelay]:
    """Three relays, which end with the stack.

    :param links: networks by which the others reach each of them, with twin ports
    """
    folder.mkdir()
    secret = folder / "secret"
    secret.write_text("0123456789abcdef" * 2 + "\n")
    options = ["--cluster-bus", ",".join(each.url for each in bus), "--cluster-secret", str(secret)]
    options += ["--name", NAME, "--heartbeat", heartbeat, "--requests-per-second", "0"]
    options += ["--connections-per-network", "0"]
    relays = []
    for at, name in enumerate(("one", "two", "three")):
        more = []
        if links:
            port = links[at].port
            more = ["--cluster-listen", f"127.0.0.1:{port}", "--cluster-host", "127.0.0.2"]
        relay = ClusterRelay(folder / name, *options, *more, database=url)
        stack.enter_context(running(relay))
        relays.append(relay)
    return relays


class Hops:
    """A robot at the first relay, a client there, and one at the second relay."""

    def __init__(self, loop: Loop, relays: list[ClusterRelay]) -> None:
        home, door, _ = relays
        self.loop = loop
        texts = text_of(STRING)
        types = TypeRegistry()
        types.add(STRING, texts[STRING])
        self.robot = PlainRobot(loop, home, "plain", "cdr", texts)
        token = home.user("driver")
        home.cli("right", "grant", "driver", "plain", "operator")
        self.clients = {
            "at home": (self._client(home, token), (home.pid,)),
            "by another relay": (self._client(door, token), (home.pid, door.pid)),
        }
        body = types.from_json(STRING, jsontext.decode_any(text_message("/told", SMALL))["msg"], 0)
        self._sample = self.robot.sample("/told", body)

    def _client(self, relay: ClusterRelay, token: str) -> WebEnd:
        client = WebEnd(self.loop, relay.http_port, "/robots/plain", token)
        client.say(op="advertise", topic="/chatter", type=STRING)
        client.say(op="subscribe", topic="/told", type=STRING)
        self.loop.until("the relay has subscribed", lambda: "/told" in self.robot.subscriptions)
        before = self.robot.received
        client.send(text_frame(text_message("/chatter", SMALL)))
        self.loop.until("the first message comes", lambda: self.robot.received > before)
        return client

    def up(self, where: str) -> Hop:
        """Client to robot."""
        client, pids = self.clients[where]
        message = text_frame(text_message("/chatter", SMALL))
        robot = self.robot
        return Hop(client, [message], lambda: robot.received, pids, WINDOW_SMALL, receiver=robot.channel)

    def down(self, where: str) -> Hop:
        """Robot to client; both clients receive each sample."""
        client, pids = self.clients[where]
        assert self.robot.channel is not None
        return Hop(self.robot.channel, [self._sample], lambda: client.messages, pids, 1, True, client)


def hops(loop: Loop, relays: list[ClusterRelay], options: Options) -> list[Row]:
    """Processor time and one-way time of one message, at home and by another relay, in turn."""
    here = Hops(loop, relays)
    total, rounds = int(options.pick(200, 20_000)), int(options.pick(1, 3))
    cpu: dict[str, list[float]] = {where: [] for where in here.clients}
    times: dict[str, list[float]] = {where: [] for where in here.clients}
    for _ in range(rounds):
        for where in here.clients:
            cpu[where].append(here.up(where).run(loop, total))
            times[where] += delays(loop, here.up(where), int(options.pick(10, 1000)))
    home, door = here.clients
    return [
        Row(
            "cluster",
            "client → CDR robot, 200 B, by another relay: both relays",
            "µs/message",
            statistics.median(cpu[door]),
            statistics.median(cpu[home]),
            "at the robot's relay",
        ),
        Row(
            "cluster",
            "client → CDR robot, 200 B, by another relay, 500/s, p50",
            "µs",
            statistics.median(times[door]) * 1e6,
            statistics.median(times[home]) * 1e6,
            "at the robot's relay",
        ),
    ]


def viewers(loop: Loop, folder: Path, relays: list[ClusterRelay], options: Options) -> list[Row]:
    """One topic to many viewers, at one relay and spread over three, in turn: processor time of all relays."""
    count = int(options.pick(6, 501))
    here = Watched(loop, relays)
    figures: dict[int, list[tuple[float, float]]] = {1: [], 3: []}
    for _ in range(int(options.pick(1, 3))):
        for places, taken in figures.items():
            with contextlib.ExitStack() as stack:
                taken.append(here.run(stack, folder, relays[:places], count, options.pick(0.3, 6)))
    return [
        Row(
            "cluster",
            f"1 KB at 100 Hz to {count} viewers at three relays: {which}",
            "µs/delivery",
            statistics.median(each[place] for each in figures[3]),
            statistics.median(each[place] for each in figures[1]),
            "at one relay",
        )
        for place, which in enumerate(("all relays", "the robot's relay"))
    ]


class Watched:
    """A robot with a topic, and one client that keeps it subscribed."""

    def __init__(self, loop: Loop, relays: list[ClusterRelay]) -> None:
        self._loop = loop
        self._relays = relays
        texts = text_of(STRING)
        types = TypeRegistry()
        types.add(STRING, texts[STRING])
        robot = PlainRobot(loop, relays[0], "watched", "cdr", texts)
        token = relays[0].user("watcher")
        relays[0].cli("right", "grant", "watcher", "watched", "viewer")
        self._request = handshake("/robots/watched", token)
        subscribe = {"op": "subscribe", "topic": "/told", "type": STRING}
        self._subscribe = text_frame(jsontext.encode(subscribe))
        keeper = WebEnd(loop, relays[0].http_port, "/robots/watched", token)
        keeper.say(**subscribe)
        loop.until("the relay has subscribed", lambda: "/told" in robot.subscriptions)
        body = types.from_json(STRING, {"data": "x" * SIZE}, 0)
        assert robot.channel is not None
        self._send, self._frame = robot.channel.send, robot.sample("/told", body)

    def run(
        self,
        stack: contextlib.ExitStack,
        folder: Path,
        places: list[ClusterRelay],
        count: int,
        seconds: float,
    ) -> tuple[float, float]:
        """Microseconds of processor time for a delivery to one of these viewers: of all relays, and of the robot's."""
        receivers = []
        for relay in places:
            share = count // len(places)
            each = self._receivers(folder, relay, share)
            stack.callback(each.stop)
            receivers.append(each)
        self._warm(receivers, count)
        messages = int(seconds * RATE)
        began = time.monotonic()
        home, *others = (each.pid for each in self._relays)
        with measured(home) as at_home, measured(*others) as elsewhere:
            for number in range(messages):
                self._send(self._frame)
                while (wait := began + (number + 1) / RATE - time.monotonic()) > 0:
                    self._loop.turn(wait)
            came = self._wait_for(receivers, messages * count)
        assert came == messages * count, f"{came} deliveries of {messages * count}"
        return (at_home.seconds + elsewhere.seconds) * 1e6 / came, at_home.seconds * 1e6 / came

    def _receivers(self, folder: Path, relay: ClusterRelay, count: int) -> Receivers:
        """So many viewers at a relay. They take seconds to connect, in which the client that watches answers pings."""
        with ThreadPoolExecutor(1) as pool:
            starting = pool.submit(
                Receivers, folder, relay.http_port, count, self._request, self._subscribe, every_ms=1
            )
            while not starting.done():
                self._loop.turn(0.1)
            return starting.result()

    def _warm(self, receivers: list[Receivers], count: int) -> None:
        """Until one message has come to all."""
        end = time.monotonic() + 60
        while time.monotonic() < end:
            self._send(self._frame)
            if self._wait_for(receivers, count, 1.0) == count:
                return
        raise AssertionError("not all viewers receive")

    def _wait_for(self, receivers: list[Receivers], wanted: int, seconds: float = 10.0) -> int:
        came, end = 0, time.monotonic() + seconds
        while came < wanted and time.monotonic() < end:
            self._loop.turn(0.1)
            came += sum(each.report()["messages"] for each in receivers)
        return came


class Fleet:
    """Light robots and clients in a process of their own."""

    def __init__(self, folder: Path, relays: list[ClusterRelay], count: int, url: str) -> None:
        keys = [identity.generate_key() for _ in range(count)]
        tokens = _fill(url, keys)
        robots = [
            {
                "name": f"light{number}",
                "key": link.to_base64(key),
                "dials": [each.robots_port for each in _from(relays, number)],
            }
            for number, key in enumerate(keys)
        ]
        # Each client at another relay than its robot, or two out of three of them.
        clients = [
            {
                "ports": [each.http_port for each in _from(relays, number // 3)],
                "path": f"/robots/light{number}",
                "token": tokens[number % USERS],
            }
            for number in range(count)
        ]
        spec = folder / "fleet.json"
        spec.write_text(json.dumps({"robots": robots, "clients": clients, "seconds": count / A_SECOND}))
        command = [sys.executable, "-m", "bench.light_fleet", str(spec)]
        self.count = count
        self._child = Child(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._child.ready(AssertionError("the light robots did not start; see above"))

    def report(self) -> dict[str, Any]:
        """Robots online, clients served and messages received."""
        return self._child.ask()

    @property
    def pid(self) -> int:
        """The process."""
        return self._child.pid

    def complete(self) -> bool:
        """Whether all robots are online, and all clients receive."""
        report = self.report()
        return bool(report["online"] == report["served"] == self.count)

    def stop(self) -> None:
        """End it."""
        self._child.stop()


def _from(relays: list[ClusterRelay], number: int) -> list[ClusterRelay]:
    first = number % len(relays)
    return [*relays[first:], *relays[:first]]


def _fill(url: str, keys: list[bytes]) -> list[str]:
    """Robots with their keys, and users with rights on all of theirs; the users' tokens."""
    store, now = Database(url), time.time()
    tokens = [passwords.new_token() for _ in range(USERS)]
    try:
        with store.begin() as session:
            users = []
            for number, token in enumerate(tokens):
                user = queries.add_user(session, f"light{number}", None)
                hashed = passwords.token_hash(token)
                queries.create_token(session, user.id, hashed, kind="access", expires=None, now=now)
                users.append(user.id)
            for number, key in enumerate(keys):
                robot = queries.add_robot(session, f"light{number}")
                queries.grant_right(session, robot.id, "viewer", user_id=users[number % USERS])
                code = passwords.token_hash(f"code{number}")
                queries.issue_enrolment_code(session, robot.id, code, now + 3600)
                public = identity.public_half(key)
                queries.redeem_enrolment_code(
                    session, robot.name, code, public, identity.fingerprint(public), "bench", now
                )
    finally:
        store.close()
    return tokens


def fleet(folder: Path, relays: list[ClusterRelay], url: str, options: Options) -> list[Row]:
    """Many light robots and clients at rest, and after the death of one of three relays."""
    count, seconds = int(options.pick(9, options.runs or 2000)), options.pick(0.3, 10)
    pids = [each.pid for each in relays]
    before = sum(resident(pid) for pid in pids)
    light = Fleet(folder, relays, count, url)
    began = time.monotonic()
    try:
        with measured(*pids) as relays_watch, measured(light.pid) as light_watch:
            wait_for("all are connected", light.complete, 600)
        connected = time.monotonic() - began
        grown = sum(resident(each.pid) for each in relays) - before
        first = light.report()["messages"]
        with measured(*pids) as watch, measured(light.pid) as light_rest:
            time.sleep(seconds)  # the length of the measurement
        messages = light.report()["messages"] - first
        relays[0].kill()
        began = time.monotonic()
        wait_for("all robots are online again", lambda: light.report()["online"] == count, 600)
        robots = time.monotonic() - began
        wait_for("all clients receive again", light.complete, 600)
        clients = time.monotonic() - began
    finally:
        light.stop()
    moved = (count + 2) // 3
    note = f"{count} robots publish {STATE} every {PERIOD:g} s, each to one client; {messages / seconds:.0f} messages/s"
    what = f"{count} robots and {count} clients at three relays"
    each_ms = 1e3 / count
    return [
        Row(
            "cluster",
            f"{what}: until all are connected",
            "s",
            connected,
            note=f"{A_SECOND} of each in a second",
        ),
        Row(
            "cluster",
            f"{what}: one robot and client connect: relays",
            "ms of CPU",
            relays_watch.seconds * each_ms,
        ),
        Row(
            "cluster",
            f"{what}: one robot and client connect: the simulated ones",
            "ms of CPU",
            light_watch.seconds * each_ms,
        ),
        Row("cluster", f"{what}: the simulated ones", "ms of CPU per s", light_rest.seconds * 1e3 / seconds),
        Row("cluster", f"{what}: all relays", "ms of CPU per s", watch.seconds * 1e3 / seconds, note=note),
        Row("cluster", f"{what}: memory of a robot with its client", "KiB", grown / count / 1024),
        Row("cluster", f"{what}: death of one, until all robots are online", "s", robots),
        Row("cluster", f"{what}: death of one, robots moved", "robots/s", moved / robots),
        Row("cluster", f"{what}: death of one, until all clients receive", "s", clients),
    ]


def run(options: Options) -> list[Row]:
    """All of it, with a cluster for single messages and one for many robots."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        folder = Path(name)
        with contextlib.ExitStack() as stack:
            url = stack.enter_context(database())
            bus = stack.enter_context(nats_cluster(folder / "nats"))
            # Heartbeats are rare, because nobody turns the loop while robots and users are added.
            relays = start_relays(stack, folder / "few", url, bus, "60")
            # Idle clients would be closed, since their pings are not answered while the next users are added.
            with contextlib.closing(Loop()) as loop:
                rows += hops(loop, relays, options)
            with contextlib.closing(Loop()) as loop:
                rows += viewers(loop, folder, relays, options)
        with contextlib.ExitStack() as stack:
            url = stack.enter_context(database())
            bus = stack.enter_context(nats_cluster(folder / "nats"))
            relays = start_relays(stack, folder / "many", url, bus, "1.25")
            rows += fleet(folder, relays, url, options)
    for row in rows:
        other = f", {row.against} {row.other:.4g}" if row.other else ""
        print(f"    {row.what}: {row.ours:.4g} {row.unit}{other}", flush=True)
    return rows
