"""``python -m bench.cluster_failures``: what drivers see when a part of a cluster dies, and what the robot executes.

Three relays, three NATS servers, one PostgreSQL, a robot that dials the relays in turn, and two drivers at two other
relays than the robot's: one drives, the other tries to. They call a service that moves the robot ten times a second,
and connect again at the next relay when they are cut. Each fault comes once while they drive, and once with a stop that
must still hold afterwards: confirmed before the fault, or, where it is the network between relays, sent to a relay that
can't reach the robot's, by HTTP or by a websocket that was open before. All the time a user logs in at one relay after
another, and each login that was answered must count at the next relay. The figures are a table for
docs/operate/cluster.md.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import sys
import tempfile
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError

import psutil
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import connect

from bench.cluster import ClusterRelay, database, start_relays
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.nats_servers import NatsServer, nats_cluster
from tests.worlds.small_robot import SmallRobot
from tests.worlds.waiting import wait_for

CUT, SILENT = "the network to the home is cut", "the network to the home is silent"
DATABASE_STILL, DATABASE_KILLED = "PostgreSQL stands still", "PostgreSQL is killed and started again"
FAULTS = (
    "a door",
    "the home",
    "the home stands still",
    CUT,
    SILENT,
    "one NATS server",
    "all of NATS",
    DATABASE_STILL,
    DATABASE_KILLED,
)
DOWN_SECONDS = 2.0
"""For as long a part is gone."""
DATABASE_SECONDS = 8.0
"""The same of the database."""
NOTICE_SECONDS = 3.75
"""After so long a robot's daemon connects to another relay, if its own says nothing."""
SILENT_SECONDS = 14.0
"""The same of a network: longer than it takes a relay to notice."""

PERIOD = 0.1
LET_GO_SECONDS = 1.0
ANSWER_SECONDS = 5.0
LATE_SECONDS = 0.5
"""A call that the robot executes so long after its driver was told of the end is late."""

QUIET_SECONDS = 90.0


class Rover(SmallRobot):
    """A robot that dials the next relay when its link ends, and remembers who moved it when."""

    def __init__(self, relays: list[ClusterRelay]) -> None:
        self.moved: list[tuple[float, int, int]] = []
        """Times of calls, their source, and who had control."""
        self._relays = relays
        self._ends = False
        super().__init__(relays[0], "rover", {"/drive": _drive}, moving=("/drive",))
        self._dialling = threading.Thread(target=self._keep, daemon=True)

    def begin(self) -> None:
        """Stay connected from now on."""
        self._dialling.start()

    def end(self) -> None:
        """Leave."""
        self._ends = True
        self._dialling.join(30)
        with contextlib.suppress(OSError):
            self.goes()

    def drop(self) -> None:
        """Close the links, as a daemon does when the relay does not answer for long."""
        for each in self._links:
            with contextlib.suppress(OSError):
                each.socket.shutdown(2)

    @property
    def connected(self) -> bool:
        """Whether its control link is open."""
        return bool(self._threads) and self._threads[0].is_alive()

    def _keep(self) -> None:
        number = 0
        while not self._ends:
            if self.connected:
                time.sleep(0.02)
                continue
            with contextlib.suppress(OSError, AssertionError, IndexError, KeyError):
                self.goes()
                self.relay = self._relays[number % len(self._relays)]
                number += 1
                self.comes()
                continue
            time.sleep(0.5)


def _drive(robot: Any, arguments: Any) -> dict[str, Any]:
    if robot.stopped is not None:
        return {"success": False, "message": "stopped"}
    source = robot.calls[-1][1]
    robot.moved.append((time.monotonic(), source, robot.holders[-1] if robot.holders else 0))
    return {"success": True, "message": ""}


class Driver(threading.Thread):
    """Calls the service again and again, at one relay after another."""

    def __init__(self, relays: list[ClusterRelay], token: str, robot: Rover) -> None:
        super().__init__(daemon=True)
        self.at = relays[0]
        self._robot = robot
        self.calls: list[tuple[float, float, str]] = []
        """Begin and end of each call, and how it ended."""
        self._relays = relays
        self._token = token
        self.ends = False

    def run(self) -> None:
        number = 0
        while not self.ends:
            self.at = self._relays[number % len(self._relays)]
            if self.at is self._robot.relay:
                number += 1
                self.at = self._relays[number % len(self._relays)]
            try:
                self._drive_at(self.at)
            except ConnectionClosed as error:
                self._told(f"closed: {error.rcvd.code if error.rcvd else 'without a word'}")
            except (InvalidHandshake, OSError) as error:
                self._told(type(error).__name__)
            number += 1
            time.sleep(0.2)

    def _told(self, what: str) -> None:
        now = time.monotonic()
        self.calls.append((now, now, what))

    def _drive_at(self, relay: ClusterRelay) -> None:
        url = f"ws://127.0.0.1:{relay.http_port}/robots/rover"
        headers = {"Authorization": f"Bearer {self._token}"}
        with connect(url, additional_headers=headers, open_timeout=5, close_timeout=1) as socket:
            for number in range(1_000_000):
                if self.ends:
                    return
                began = time.monotonic()
                call = {"op": "call_service", "service": "/drive", "id": str(number), "args": {}}
                try:
                    socket.send(json.dumps(call))
                    said = self._answer(socket, str(number), began + ANSWER_SECONDS)
                except ConnectionClosed:
                    self.calls.append((began, time.monotonic(), "cut"))
                    raise
                self.calls.append((began, time.monotonic(), said))
                # Who is refused must let go first: commands that go on never take control.
                time.sleep(LET_GO_SECONDS if said.startswith("refused") else PERIOD)

    def _answer(self, socket: Any, number: str, until: float) -> str:
        while (left := until - time.monotonic()) > 0:
            try:
                message = json.loads(socket.recv(left))
            except TimeoutError:
                break
            if message.get("op") == "service_response" and message.get("id") == number:
                if not message["result"]:
                    return f"refused: {str(message['values'])[:60]}"
                return "ok" if message["values"]["success"] else "stopped"
        return "no answer"


class Logins(threading.Thread):
    """Logs in once a second, at one relay after another, and uses the session at the next one.

    :ivar seen: times, and what came of each login but those that worked
    :ivar done: logins that worked
    :ivar lost: sessions that another relay did not know
    """

    def __init__(self, relays: list[ClusterRelay]) -> None:
        super().__init__(daemon=True)
        self.seen: list[tuple[float, str]] = []
        self.done = 0
        self.lost = 0
        self.ends = False
        self._relays = relays

    def run(self) -> None:
        for number in itertools.count():
            if self.ends:
                return
            status, cookie = self._ask(number, {"user": "ann", "password": "correct horse"})
            if status == 200:
                self.done += 1
                self._use(number + 1, cookie)
            else:
                self.seen.append((time.monotonic(), f"login: {status or 'no answer'}"))
            time.sleep(1.0)

    def _use(self, number: int, cookie: str) -> None:
        """Show the session to other relays until one says whether it counts."""
        while not self.ends:
            status, _ = self._ask(number, None, Cookie=cookie)
            if status in (200, 401):
                self.lost += status == 401
                return
            number += 1
            time.sleep(0.5)

    def _ask(self, number: int, body: dict[str, str] | None, **headers: str) -> tuple[int, str]:
        """Status and cookie; 0 if there is no answer."""
        relay = self._relays[number % len(self._relays)]
        url = f"http://127.0.0.1:{relay.http_port}/api/v1/session"
        sent = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(url, sent, {"Content-Type": "application/json", **headers})
        try:
            with urllib.request.urlopen(request, timeout=10) as answer:
                return answer.status, str(answer.headers.get("Set-Cookie", "")).partition(";")[0]
        except HTTPError as error:
            return error.code, ""
        except OSError:
            return 0, ""


class Scene:
    """The cluster, its robot and its drivers."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path, url: str, nats: list[NatsServer]) -> None:
        self.nats = nats
        self.links = [ChaosProxy(0, host="127.0.0.2") for _ in range(3)]
        for link in self.links:
            stack.callback(link.close)
        self.relays = start_relays(stack, folder, url, nats, "1", self.links)
        first = self.relays[0]
        tokens = [first.user(name) for name in ("ann", "bob")]
        self._token = tokens[0]
        self.robot = Rover(self.relays)
        for name in ("ann", "bob"):
            first.cli("right", "grant", name, "rover", "owner")
        self.robot.begin()
        stack.callback(self.robot.end)
        doors = [[*self.relays[at:], *self.relays[:at]] for at in (1, 2)]
        self.drivers = [Driver(each, token, self.robot) for each, token in zip(doors, tokens, strict=True)]

        self.logins = Logins(self.relays)
        threads = [*self.drivers, self.logins]

        def over() -> None:
            for each in threads:
                each.ends = True
            for each in threads:
                each.join(30)

        stack.callback(over)
        for each in threads:
            each.start()
        time.sleep(0.5)

    def drives(self, since: float) -> bool:
        """Whether a driver has moved the robot since then."""
        return any(
            began > since and said == "ok" for each in self.drivers for began, _, said in each.calls[-20:]
        )

    def ask(self, method: str, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
        """A request to any relay that answers."""
        for relay in reversed(self.relays):
            url = f"http://127.0.0.1:{relay.http_port}/api/v1/robots/rover{path}"
            more = {"Authorization": f"Bearer {self._token}", "Content-Type": "application/json", **headers}
            body = None if method == "GET" else b"{}"
            request = urllib.request.Request(url, body, more, method=method)
            with contextlib.suppress(OSError):
                try:
                    with urllib.request.urlopen(request, timeout=10) as answer:
                        return answer.status, dict(answer.headers), answer.read()
                except HTTPError as error:
                    return error.code, dict(error.headers), error.read()
        return 0, {}, b""

    def stop(self) -> bool:
        """Stop the robot; whether the robot has confirmed it."""
        status, _, body = self.ask("POST", "/stop")
        return status == 200 and json.loads(body).get("confirmed", True) is not False

    def stop_by_another_way(self) -> float:
        """Stop the robot by a relay that can't reach its own; returns the seconds until the robot has stopped."""
        began = time.monotonic()
        url = f"http://127.0.0.1:{self._other().http_port}/api/v1/robots/rover/stop"
        headers = {"Authorization": f"Bearer {self._token}", "Content-Type": "application/json"}
        with urllib.request.urlopen(urllib.request.Request(url, b"{}", headers), timeout=10) as answer:
            assert answer.status == 202, answer.status
        wait_for("the robot has stopped", lambda: self.robot.stopped is not None, QUIET_SECONDS)
        return time.monotonic() - began

    @contextlib.contextmanager
    def open_websocket(self) -> Iterator[Any]:
        """A websocket at a relay that is not the robot's."""
        url = f"ws://127.0.0.1:{self._other().http_port}/robots/rover"
        headers = {"Authorization": f"Bearer {self._token}"}
        with connect(url, additional_headers=headers, open_timeout=5, close_timeout=1) as socket:
            yield socket

    def stop_by_websocket(self, socket: Any) -> float:
        """Stop the robot so; returns the seconds until it has stopped. The client has an answer then, or soon."""
        began = time.monotonic()
        socket.send(json.dumps({"op": "call_service", "service": "/relay/stop", "id": "stop", "args": {}}))
        wait_for("the robot has stopped", lambda: self.robot.stopped is not None, QUIET_SECONDS)
        stopped = time.monotonic() - began
        while True:
            message = json.loads(socket.recv(ANSWER_SECONDS))
            if message.get("op") == "service_response" and message.get("id") == "stop":
                assert message["values"]["success"], message
                return stopped

    def _home(self) -> ClusterRelay:
        return next((each for each in self.relays if each is self.robot.relay), self.relays[0])

    def _other(self) -> ClusterRelay:
        """The relay that a driver drives by."""
        home = self._home()
        driving = max(self.drivers, key=lambda each: sum(said == "ok" for _, _, said in each.calls[-20:]))
        return (
            driving.at if driving.at is not home else next(each for each in self.relays if each is not home)
        )

    def stopped(self) -> bool:
        """Whether a relay shows it stopped."""
        status, _, body = self.ask("GET", "")
        return status == 200 and bool(json.loads(body).get("stopped"))

    def resume(self) -> bool:
        """Resume it."""
        _, headers, _ = self.ask("POST", "/resume")
        token = {key: value for key, value in headers.items() if key.lower() == "switchboard-freshness"}
        return self.ask("POST", "/resume", **token)[0] == 200

    @contextlib.contextmanager
    def broken(self, fault: str) -> Iterator[None]:
        """Something is gone meanwhile."""
        home, door = self._home(), self._other()
        if fault in ("a door", "the home"):
            relay = door if fault == "a door" else home
            relay.kill()
            yield
            relay.start()
        elif fault == "the home stands still":
            home.freeze()
            time.sleep(NOTICE_SECONDS)
            self.robot.drop()
            yield
            home.thaw()
        elif fault in (CUT, SILENT):
            link = self.links[self.relays.index(home)]
            link.black_hole()
            if fault == CUT:
                link.reset()
            yield
            link.heal()
        elif fault == DATABASE_KILLED:
            server = _postgres_server()
            for each in _own_postgres():
                with contextlib.suppress(psutil.Error):
                    each.kill()
            yield
            server.ensure_postgres_running()
        elif fault == DATABASE_STILL:
            processes = _own_postgres()
            for each in processes:
                with contextlib.suppress(psutil.Error):
                    each.suspend()
            yield
            for each in processes:
                with contextlib.suppress(psutil.Error):
                    each.resume()
        else:
            servers = self.nats if fault == "all of NATS" else self.nats[:1]
            for each in servers:
                each.kill()
            yield
            for each in servers:
                each.start()


def _own_postgres() -> list[psutil.Process]:
    """The server that :func:`bench.cluster.database` has started, and its processes."""
    found = []
    for each in psutil.process_iter(["name", "cmdline"]):
        if each.info["name"] == "postgres" and any(
            "bench-postgresql-" in word for word in each.info["cmdline"] or ()
        ):
            found += [each, *each.children(recursive=True)]
    return found


def _postgres_server() -> Any:
    """The server itself, which can be started again."""
    from pgserver.postgres_server import get_server

    words = next(each.cmdline() for each in _own_postgres() if "-D" in each.cmdline())
    return get_server(Path(words[words.index("-D") + 1]))


class Ended:
    """What one fault did.

    :ivar gap: longest time in which no driver moved the robot, seconds
    :ivar stop: time until a stop by another way has stopped the robot, seconds
    :ivar late: calls that the robot executed after their end
    :ivar two: calls of one who had no control
    :ivar unconfirmed: whether a stop before the fault was not confirmed
    :ivar said: how calls and logins ended that did not work
    """

    def __init__(self) -> None:
        self.gap = 0.0
        self.stop = 0.0
        self.late = 0
        self.two = 0
        self.lost_stop = False
        self.unconfirmed = False
        self.never = False
        self.said: Counter[str] = Counter()


def trial(at: Scene, fault: str, stopped: bool, number: int) -> Ended:
    """One fault, and what came of it.

    :param number: of the trial; a stop to a silent network alternates between HTTP and a websocket
    """
    ended, began = Ended(), time.monotonic()
    wait_for("a driver drives", lambda: at.drives(began), QUIET_SECONDS)
    began = fault_began = time.monotonic()
    robot_from, calls_from = len(at.robot.moved), [len(each.calls) for each in at.drivers]
    network = fault in (CUT, SILENT)
    confirmed = stopped and not network and at.stop()
    ended.unconfirmed = stopped and not network and not confirmed
    seconds = DOWN_SECONDS
    if fault in (DATABASE_STILL, DATABASE_KILLED):
        seconds = DATABASE_SECONDS
    elif fault == SILENT:
        seconds = SILENT_SECONDS
    with contextlib.ExitStack() as stack:
        by_websocket = stopped and fault == SILENT and number % 2
        socket = stack.enter_context(at.open_websocket()) if by_websocket else None
        stack.enter_context(at.broken(fault))
        if stopped and network:
            ended.stop = at.stop_by_another_way() if socket is None else at.stop_by_websocket(socket)
            confirmed, began = True, time.monotonic()
        time.sleep(seconds)
    if ended.unconfirmed:
        wait_for("it is resumed", at.resume, QUIET_SECONDS)
    if confirmed:
        wait_for("the robot is back", lambda: at.robot.connected, QUIET_SECONDS)
        time.sleep(1.0)
        moved_since = [each for each in at.robot.moved[robot_from:] if each[0] > began + 1.0]
        ended.lost_stop = at.robot.stopped is None or bool(moved_since) or not at.stopped()
        wait_for("it is resumed", at.resume, QUIET_SECONDS)
    resumed = time.monotonic()
    try:
        wait_for("a driver drives again", lambda: at.drives(resumed), QUIET_SECONDS)
    except AssertionError:
        ended.never = True
    time.sleep(LATE_SECONDS)
    moved = at.robot.moved[robot_from:]
    spans = [
        (first, last)
        for each, since in zip(at.drivers, calls_from, strict=True)
        for first, last, _ in each.calls[max(0, since - 5) :]
    ]
    ended.late = sum(
        not any(first <= when <= last + LATE_SECONDS for first, last in spans) for when, _, _ in moved
    )
    ended.two = sum(source != holder for _, source, holder in moved)
    times = [began, *(when for when, _, _ in moved)]
    if not stopped:
        ended.gap = max((b - a for a, b in itertools.pairwise(times)), default=0.0)
    for each, since in zip(at.drivers, calls_from, strict=True):
        ended.said.update(said for _, _, said in each.calls[since:] if said != "ok")
    ended.said.update(said for when, said in at.logins.seen if when > fault_began)
    return ended


def main() -> int:
    """Try all; the code is 1 when a command was late, two had control, a stop was lost or driving never went on."""
    parser = argparse.ArgumentParser(prog="python -m bench.cluster_failures", description=__doc__)
    parser.add_argument("faults", nargs="*", help=f"of these: {', '.join(FAULTS)}; all, if none is named")
    parser.add_argument("--runs", type=int, default=20, help="of each fault, driven and stopped")
    asked = parser.parse_args()
    unknown = [each for each in asked.faults if each not in FAULTS]
    if unknown:
        parser.error(f"there is no fault '{unknown[0]}'; there are: {', '.join(FAULTS)}")
    bad = 0
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-")))
        url = stack.enter_context(database())
        nats = stack.enter_context(nats_cluster(folder / "nats"))
        at = Scene(stack, folder / "relays", url, nats)
        print(
            "| fault | times | late | without control | stops lost | longest without a driver | longest stop | seen |"
        )
        print("|---|---|---|---|---|---|---|---|", flush=True)
        for fault in asked.faults or FAULTS:
            ends = [
                trial(at, fault, stopped, number) for number in range(asked.runs) for stopped in (False, True)
            ]
            said: Counter[str] = sum((each.said for each in ends), Counter())
            wrong = {
                "late": sum(each.late for each in ends),
                "without control": sum(each.two for each in ends),
                "stops lost": sum(each.lost_stop for each in ends),
                "stops not confirmed": sum(each.unconfirmed for each in ends),
                "never again": sum(each.never for each in ends),
            }
            bad += sum(wrong.values())
            longest = max(each.gap for each in ends)
            stop = max(each.stop for each in ends)
            counts = " | ".join(str(wrong[each]) for each in ("late", "without control", "stops lost"))
            again = f", {wrong['never again']} times for ever" if wrong["never again"] else ""
            again += (
                f", {wrong['stops not confirmed']} stops not confirmed"
                if wrong["stops not confirmed"]
                else ""
            )
            longest_stop = f"{stop:.1f} s" if stop else "-"
            seen = ", ".join(f"{what} ({count})" for what, count in said.most_common(8))
            print(
                f"| {fault} | {len(ends)} | {counts} | {longest:.1f} s{again} | {longest_stop} | {seen} |",
                flush=True,
            )
        print(f"\n{at.logins.done} logins, {at.logins.lost} of them lost", flush=True)
        bad += at.logins.lost
    return int(bad > 0)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    sys.exit(main())
