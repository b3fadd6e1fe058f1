"""Driving over one connection: messages to the relay, and the effects of its answers."""

from __future__ import annotations

import pytest

from robot_client.apps.connection import Lost, RosbridgeConnection
from robot_client.apps.driver import (
    LOST_SECONDS,
    PING_SECONDS,
    UNRESPONSIVE_SECONDS,
    ZERO_VELOCITY,
    Driver,
    MaximumSpeeds,
    StopRequest,
    VelocityCommand,
)
from tests.worlds.memory_socket import Socket


class Scene:
    """A driver, its messages, and the time."""

    def __init__(self) -> None:
        self.now = 100.0
        self.stop = StopRequest()
        self.connect()
        self.beat()

    def connect(self) -> None:
        """Makes a new connection."""
        self.socket = Socket()
        self.driver = Driver(
            RosbridgeConnection(self.socket), "/cmd_vel", "test", lambda: self.now, self.stop
        )

    def beat(self) -> None:
        """Answers the first ping through the relay."""
        self.driver.poll(0.0)
        self.socket.answer(service="/relay/ping")
        self.hear()

    def hear(self) -> None:
        """Reads all messages."""
        while self.socket.coming:
            self.driver.poll(0.0)

    def take(self) -> None:
        """Takes control."""
        self.driver.request_control()
        self.socket.answer(service="/relay/take_control")
        self.hear()


def test_it_drives_only_in_control() -> None:
    """Before and after it has control, no command is sent."""
    scene = Scene()
    scene.driver.drive(VelocityCommand(0.2, 0.0))
    assert scene.socket.driven() == []
    scene.take()
    scene.driver.drive(VelocityCommand(0.2, 0.1))
    scene.driver.release_control()
    scene.driver.drive(VelocityCommand(0.2, 0.0))
    assert scene.socket.driven() == [(0.2, 0.1), (0.0, 0.0)]
    assert scene.socket.asked()[-1]["service"] == "/relay/release_control"


def test_control_is_asked_for_once_until_it_is_answered() -> None:
    """For any number of attempts."""
    scene = Scene()
    scene.driver.request_control()
    scene.driver.request_control()
    assert len(scene.socket.asked("/relay/take_control")) == 1


def test_refused_control_is_reported_in_the_relays_words() -> None:
    """For both forms of a refusal."""
    scene = Scene()
    scene.driver.request_control()
    scene.socket.answer(success=False, service="/relay/take_control")
    scene.hear()
    assert (scene.driver.in_control, scene.driver.refusal) == (False, "no")
    scene.driver.request_control()
    assert scene.driver.refusal == ""
    scene.socket.answer(result=False, service="/relay/take_control")
    scene.hear()
    assert scene.driver.refusal == "you may not"


def test_control_released_before_the_answer_is_not_acquired() -> None:
    """The release was sent to the relay as well."""
    scene = Scene()
    scene.driver.request_control()
    number = len(scene.socket.sent)
    scene.driver.release_control()
    assert scene.socket.sent[number]["service"] == "/relay/release_control"
    scene.socket.answer(service="/relay/take_control")
    scene.hear()
    assert not scene.driver.in_control


def test_loss_of_control_is_received() -> None:
    """With the reason; then not even a zero is sent, which would be refused."""
    scene = Scene()
    scene.take()
    scene.driver.drive(VelocityCommand(0.2, 0.0))
    scene.socket.control(holder="somebody")
    scene.hear()
    assert (scene.driver.in_control, scene.driver.blocked_by) == (False, "somebody has control")
    scene.driver.halt()
    assert scene.socket.driven() == [(0.2, 0.0)]


def test_a_robot_that_is_stopped_can_not_be_driven() -> None:
    """Until it is resumed."""
    scene = Scene()
    scene.socket.control(holder="me", you=True, stopped="somebody")
    scene.hear()
    assert "stopped by somebody" in scene.driver.blocked_by
    scene.socket.control(holder="me", you=True)
    scene.hear()
    assert scene.driver.blocked_by == ""
    assert scene.driver.in_control


def test_the_robots_limits_of_the_level_count() -> None:
    """Those of the other level do not; without limits the command is unchanged."""
    scene = Scene()
    scene.take()
    scene.driver.drive(VelocityCommand(2.0, -3.0))
    limits = {"operator": {"linear": 0.5, "angular": None}, "owner": {"linear": 9.0, "angular": 9.0}}
    scene.socket.control(holder="me", you=True, limits=limits)
    scene.socket.status("operator")
    scene.hear()
    assert scene.driver.limits.within(MaximumSpeeds(1.0, 1.0)) == MaximumSpeeds(0.5, 1.0)
    scene.driver.drive(VelocityCommand(-2.0, -3.0))
    assert scene.socket.driven() == [(2.0, -3.0), (-0.5, -3.0)]


def test_zero_is_sent_once() -> None:
    """Not if there was no motion."""
    scene = Scene()
    scene.take()
    scene.driver.halt()
    scene.driver.drive(VelocityCommand(0.2, 0.0))
    scene.driver.halt()
    scene.driver.halt()
    assert scene.socket.driven() == [(0.2, 0.0), ZERO_VELOCITY]


def test_a_stop_needs_no_control() -> None:
    """With control a zero comes first."""
    scene = Scene()
    scene.driver.stop()
    assert scene.socket.sent[-1]["service"] == "/relay/stop"
    scene.take()
    scene.driver.drive(VelocityCommand(0.2, 0.0))
    scene.driver.stop()
    zero, stop = scene.socket.sent[-2:]
    assert (zero["op"], stop["service"]) == ("publish", "/relay/stop")


def test_how_long_the_robot_takes_to_answer_is_known() -> None:
    """It is pinged repeatedly, one ping at a time."""
    scene = Scene()
    scene.now += PING_SECONDS
    scene.driver.poll(0.0)
    scene.now += 0.05
    scene.driver.poll(0.0)
    assert len(scene.socket.asked("/relay/ping")) == 2
    scene.socket.answer(service="/relay/ping")
    scene.hear()
    assert scene.driver.round_trip == pytest.approx(0.05)
    assert not scene.driver.unresponsive


def test_a_robot_that_does_not_answer_is_late_and_then_lost() -> None:
    """For any state of the connection in the system."""
    scene = Scene()
    scene.now += PING_SECONDS
    scene.driver.poll(0.0)
    scene.now += UNRESPONSIVE_SECONDS + 0.1
    scene.driver.poll(0.0)
    assert scene.driver.unresponsive
    scene.now += LOST_SECONDS
    with pytest.raises(Lost, match="has not answered"):
        scene.driver.poll(0.0)


def test_suppression_of_the_topic_is_known() -> None:
    """This topic, with or without a leading slash; other topics do not matter."""
    scene = Scene()
    reported = []
    for names in (["/other"], ["/other", "cmd_vel"], []):
        scene.socket.control(holder="me", you=True)
        scene.socket.coming[-1]["msg"]["suppressed"] = [{"resource": each} for each in names]
        scene.hear()
        reported.append(scene.driver.suppressed)
    assert reported == [False, True, False]


def test_a_stop_that_was_not_answered_comes_first_by_the_next_line() -> None:
    """Its answer ends it."""
    scene = Scene()
    scene.driver.stop()
    scene.connect()
    assert scene.socket.sent[0]["service"] == "/relay/stop"
    scene.socket.answer(service="/relay/stop")
    scene.hear()
    scene.connect()
    assert scene.socket.asked("/relay/stop") == []


def test_a_stop_that_a_broken_line_does_not_take_is_not_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if the zero before it breaks the connection."""
    scene = Scene()
    scene.take()
    scene.driver.drive(VelocityCommand(0.2, 0.0))

    def broken(text: str) -> None:
        raise OSError("broken")

    monkeypatch.setattr(scene.socket, "send", broken)
    with pytest.raises(OSError, match="broken"):
        scene.driver.stop()
    scene.connect()
    assert scene.socket.sent[0]["service"] == "/relay/stop"


@pytest.mark.parametrize(
    ("result", "values", "words", "done"),
    [
        (True, {"success": True, "message": "", "done": True}, "is stopped until it is resumed", True),
        (True, {"success": True, "message": "", "done": False}, "as soon as it is online", False),
        (True, {"success": False, "message": "no brakes", "done": False}, "stop not done: no brakes", False),
        (
            True,
            {"success": False, "message": "it is stopped, but", "done": False, "stopped": {"by": "ann"}},
            "stop: it is stopped, but",
            False,
        ),
        (False, "you may not", "you may not", False),
    ],
    ids=["done", "later", "not done", "done in part", "refused"],
)
def test_result_of_a_stop_is_worded(result: bool, values: object, words: str, done: bool) -> None:
    """Before the answer it is only "requested"."""
    scene = Scene()
    scene.driver.stop()
    assert (scene.stop.pending, scene.stop.text) == (True, "stop requested, not confirmed yet")
    scene.socket.answer(service="/relay/stop")
    scene.socket.coming[-1].update(result=result, values=values)
    scene.hear()
    assert words in scene.stop.text
    assert (scene.stop.pending, scene.stop.done) == (False, done)


def test_of_two_stops_the_answer_to_the_last_one_counts() -> None:
    """The first answer may belong to a stop that has been resumed."""
    scene = Scene()
    scene.driver.stop()
    scene.socket.answer(service="/relay/stop")
    scene.driver.stop()
    scene.hear()
    assert scene.stop.pending
    scene.socket.answer(service="/relay/stop")
    scene.hear()
    assert not scene.stop.pending


def test_a_request_is_taken_back() -> None:
    """A later answer gives no control."""
    scene = Scene()
    scene.driver.request_control()
    scene.driver.withdraw_request()
    assert scene.socket.asked()[-1]["service"] == "/relay/release_control"
    scene.socket.answer(service="/relay/take_control")
    scene.hear()
    assert not scene.driver.in_control


def test_messages_on_the_programs_topics_are_delivered() -> None:
    """Unchanged."""
    heard: list[tuple[str, object]] = []
    socket = Socket()
    driver = Driver(
        RosbridgeConnection(socket),
        "/cmd_vel",
        "test",
        lambda: 0.0,
        StopRequest(),
        lambda *each: heard.append(each),
    )
    socket.coming.append({"op": "publish", "topic": "/scan", "msg": {"ranges": []}})
    driver.poll(0.0)
    assert heard == [("/scan", {"ranges": []})]
