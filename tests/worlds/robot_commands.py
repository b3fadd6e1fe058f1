"""Motion commands for a whole daemon in memory, and their results."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred

from relay_protocol import link
from robot_client.motion.guard_protocol import CANCEL
from robot_client.motion.hardware import Switches
from robot_client.motion.stop_store import MemoryStopStore
from robot_client.platforms.base import GraphView
from tests.worlds.memory_platform import twist
from tests.worlds.robot_daemon import RelayEnd, Scene

GO, ZERO = twist(1.0), twist()
BEFORE = link.Stopped(by="eve", since=1.0)
OTHER = 8
JOY = "sensor_msgs/msg/Joy"
NAVIGATE = "/navigate_to_pose"
ALL_GOALS = b"\0\1\0\0" + bytes(24)
NO_GOALS_ANSWER = b"\0\1\0\0" + bytes(8)
"""An action's answer where it has no goals."""


def messages_of(line: RelayEnd, op: str) -> list[Any]:
    return [each for each in line.received() if isinstance(each, dict) and each["op"] == op]


def order(line: RelayEnd, message: link.Message) -> dict[str, Any]:
    """Send one command; return its result."""
    line.received()
    line.send(message)
    (done,) = messages_of(line, "order_result")
    return dict(done)


def stop(id: int = 2) -> link.Stop:
    return link.Stop(id=id, by="eve", why="test")


def resume(id: int = 3) -> link.Resume:
    return link.Resume(id=id, by="ann")


class ActionsWorld:
    """A daemon whose graph has two actions, one of which moves the robot; :attr:`asked` has the cancel
    requests.
    """

    def __init__(self, stop_store: MemoryStopStore | None = None, switches: Switches | None = None) -> None:
        self.scene = Scene(stop_store, switches)
        self.asked: list[bytes] = []
        self.answers: list[Deferred[bytes]] = []
        """Those to come."""
        self.given_up = 0
        """Calls whose answer nobody waits for any more."""
        self.show(NAVIGATE, "/count")
        self.control = self.scene.register()
        self.control.received()

    def show(self, *actions: str) -> None:
        """Set the actions of the graph."""
        self.scene.platform.view = GraphView(
            actions={each: link.Service(types=["a/action/B"]) for each in actions}
        )
        for each in actions:
            self.scene.platform.services[each + CANCEL] = self._called

    def _called(self, request: bytes) -> Deferred[bytes]:
        def give_up(answer: Deferred[bytes]) -> None:
            self.given_up += 1

        self.asked.append(request)
        self.answers.append(Deferred(give_up))
        return self.answers[-1]

    def answer(self, code: int = 0) -> None:
        """Answer all pending requests."""
        answers, self.answers = self.answers, []
        for each in answers:
            if not each.called:
                each.callback(b"\0\1\0\0" + bytes([code]) + bytes(7))

    def pass_seconds(self, seconds: int, *channels: RelayEnd) -> None:
        for _ in range(seconds):
            for line in (self.control, *channels):
                line.send(link.Ping(t=1))
            self.scene.clock.advance(1)

    def pass_zeros(self, times: int) -> None:
        """Lets the time of this number of zeros pass."""
        for _ in range(times):
            self.scene.clock.advance(0.05)
        self.control.send(link.Ping(t=1))

    def messages(self, op: str) -> list[dict[str, Any]]:
        return messages_of(self.control, op)


class SwitchWorld:
    """A daemon with a service that stops its hardware; :attr:`answers` has the pending responses."""

    def __init__(self, type: str = "std_srvs/srv/SetBool", stopped: link.Stopped | None = None) -> None:
        self.scene = Scene(MemoryStopStore(stopped), Switches("/estop"))
        self.scene.platform.view = GraphView(services={"/estop": link.Service(types=[type])})
        self.scene.platform.services["/estop"] = self._called
        self.asked: list[bytes] = []
        self.answers: list[Deferred[bytes]] = []
        self.control = self.scene.register()
        if stopped is None:
            self.scene.driving(self.control)
        self.control.received()

    def _called(self, request: bytes) -> Deferred[bytes]:
        self.asked.append(request)
        self.answers.append(Deferred())
        return self.answers[-1]

    def answer(self, good: bool, words: str = "") -> None:
        """Answer all pending requests."""
        text = words.encode() + b"\0"
        body = b"\0\1\0\0" + bytes([good]) + b"\0\0\0" + len(text).to_bytes(4, "little") + text
        self.answers.pop(0).callback(body)

    def done(self) -> list[dict[str, Any]]:
        return messages_of(self.control, "order_result")

    def pass_seconds(self, seconds: int, good: bool | None = None) -> list[tuple[str, bool]]:
        """Lets time pass; returns the alerts: text, and whether it has ended.

        :param good: the response of the service; ``None``: none
        """
        alerts: list[tuple[str, bool]] = []
        for _ in range(seconds):
            self.control.send(link.Ping(t=1))
            self.scene.clock.advance(1)
            while self.answers and good is not None:
                if self.answers[0].called:
                    self.answers.pop(0)
                else:
                    self.answer(good)
            alerts += [(each["text"], each.get("over", False)) for each in messages_of(self.control, "alert")]
        return alerts


def subscribed_topic(*types: str) -> link.Topic:
    return link.Topic(types=list(types), subscribers=["/base"])
