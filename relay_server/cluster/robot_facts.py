"""What lists show of the robots of other relays: each relay publishes the facts of its own robots on the bus.

They are sent when something of them changes, and all again within ten seconds, for relays that have missed some. A
reader's rights are applied where the list is made. What changes all the time is sent every ten seconds only, so that no
reader learns from it when something has changed that is hidden from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import msgspec
from twisted.internet.task import LoopingCall
from twisted.logger import Logger

from relay_protocol.limits import KIB
from relay_server.cluster.bus import ClusterBus
from relay_server.cluster.homes import RobotHomes
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.presence import RobotFacts

SUBJECT = "robots"
PERIOD = 0.5
"""Seconds between looks for changes."""
ROUNDS = 20
"""Number of looks in which the facts of all robots are sent once, changed or not."""
MOST_BYTES = 64 * KIB
"""Most bytes of one notice. Of a robot with more, only the first clients and viewers are sent."""
FORGET_SECONDS = 15.0
"""Seconds after which facts that were not sent again are no longer shown."""

PASSING = ("rtt_ms", "last_seen")
"""Facts that change all the time, and are no reason to send the others."""


class RobotFactsNotice(msgspec.Struct, array_like=True, frozen=True):
    """Facts of some robots that are connected to a relay.

    :param relay: its id
    :param robots: by number
    """

    relay: str
    robots: list[tuple[int, RobotFacts]]


class _OthersFacts(NamedTuple):
    """:param at: monotonic seconds"""

    at: float
    facts: RobotFacts


class _SentFacts(NamedTuple):
    lasting: dict[str, Any]
    passing: dict[str, Any]


class RobotFactsNotices:
    """Publishes the facts of this relay's robots, and knows those of the others.

    :param own: id of this relay
    :ivar facts_of: what is to be published of a robot
    """

    log = Logger()

    def __init__(
        self, reactor: Any, bus: ClusterBus, robots: RobotRegistry, homes: RobotHomes, own: str
    ) -> None:
        self.facts_of: Callable[[RobotState], RobotFacts] | None = None
        self._seconds = reactor.seconds
        self._bus = bus
        self._robots = robots
        self._homes = homes
        self._own = own
        self._sent: dict[int, _SentFacts] = {}
        """The facts of this relay's robots that were sent last."""
        self._known: dict[tuple[int, str], _OthersFacts] = {}
        """Facts by robot and relay. One that a robot has left may send them later than the one that it came to."""
        self._changed = True
        """Whether robots may have changed since the last look."""
        self._round = 0
        self._ends: list[Callable[[], None]] = []
        self._loop = LoopingCall(self._look)
        self._loop.clock = reactor
        bus.on_state(self._bus_state)

    def start(self) -> None:
        """Publish, and follow the others."""
        self._ends = [self._bus.subscribe(SUBJECT, self._received), self._robots.on_change(self._note_change)]
        self._loop.start(PERIOD, now=False)

    def stop(self) -> None:
        """Do neither any more."""
        if self._loop.running:
            self._loop.stop()
        for end in self._ends:
            end()
        self._ends = []

    def find(self, robot_id: int) -> RobotFacts | None:
        """Facts of a robot that is connected to another relay; ``None``: they are not known."""
        home = self._homes.elsewhere(robot_id) if self._bus.connected else None
        known = None if home is None else self._known.get((robot_id, home.id))
        return None if known is None or self._seconds() - known.at > FORGET_SECONDS else known.facts

    def _bus_state(self, connected: bool) -> None:
        if connected:
            # What was published meanwhile is lost.
            self.send_all()
        self._robots.changed()

    def send_all(self) -> None:
        """Send all facts with the next look: a relay has come that knows none."""
        self._sent.clear()
        self._changed = True

    # --- own robots ---------------------------------------------------------------------------------------

    def _note_change(self) -> None:
        self._changed = True

    def _look(self) -> None:
        changed, self._changed = self._changed, False
        self._round = (self._round + 1) % ROUNDS
        try:
            self._send(self._news(changed))
        except Exception:
            self.log.failure("what other relays show of robots could not be sent", limited="facts")
        if self._round == 0:
            self._forget()

    def _news(self, changed: bool) -> Iterator[tuple[int, RobotFacts]]:
        """What is to be sent now.

        :param changed: whether robots may have changed
        """
        for robot in self._robots:
            due = robot.robot_id % ROUNDS == self._round
            if robot.control_link is None or self.facts_of is None:
                self._sent.pop(robot.robot_id, None)
            elif changed or due:
                facts = self.facts_of(robot)
                lasting, before = _lasting(facts), self._sent.get(robot.robot_id)
                if due or before is None or before.lasting != lasting:
                    passing: Any = (
                        {"rtt_ms": facts["rtt_ms"], "last_seen": facts["last_seen"]}
                        if due or before is None
                        else before.passing
                    )
                    self._sent[robot.robot_id] = _SentFacts(lasting, passing)
                    yield robot.robot_id, {**facts, **passing}

    def _send(self, robots: Iterable[tuple[int, RobotFacts]]) -> None:
        together: list[tuple[int, RobotFacts]] = []
        size = 0
        for number, facts in robots:
            while (length := len(msgspec.json.encode(facts))) > MOST_BYTES and facts["clients"]:
                facts = {**facts, "clients": facts["clients"][: len(facts["clients"]) // 2]}
            if together and size + length > MOST_BYTES:
                self._publish(together)
                together, size = [], 0
            together.append((number, facts))
            size += length
        if together:
            self._publish(together)

    def _publish(self, robots: list[tuple[int, RobotFacts]]) -> None:
        self._bus.publish(SUBJECT, msgspec.json.encode(RobotFactsNotice(self._own, robots)))

    # --- robots of the others -----------------------------------------------------------------------------

    def _received(self, subject: str, body: bytes) -> None:
        try:
            notice = msgspec.json.decode(body, type=RobotFactsNotice)
        except msgspec.DecodeError as error:
            self.log.error("a notice of the bus can't be read: {error}", error=error, limited="notice")
            return
        if notice.relay == self._own:
            return
        now, changed = self._seconds(), False
        for robot_id, facts in notice.robots:
            key = robot_id, notice.relay
            before = self._known.get(key)
            changed = changed or before is None or _lasting(before.facts) != _lasting(facts)
            self._known[key] = _OthersFacts(now, facts)
        if changed:
            self._robots.changed()

    def _forget(self) -> None:
        now = self._seconds()
        self._known = {key: each for key, each in self._known.items() if now - each.at <= FORGET_SECONDS}


def _lasting(facts: RobotFacts) -> dict[str, Any]:
    return {name: value for name, value in facts.items() if name not in PASSING}
