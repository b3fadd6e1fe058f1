"""Driving by one line: what is said to the relay, and what follows from what it says."""

from __future__ import annotations

import pytest
from switchboard_socket import Socket

from robot_client.apps.connection import Lost, RosbridgeConnection
from robot_client.apps.driver import (
    BEAT,
    LATE,
    SILENT,
    STILL,
    Driver,
    MaximumSpeeds,
    StopNotice,
    VelocityCommand,
)


class Scene:
    """A driver, what it says, and the time."""

    def __init__(self) -> None:
        self.now = 100.0
        self.stop = StopNotice()
        self.connect()
        self.beat()

    def connect(self) -> None:
        """A new line."""
        self.socket = Socket()
        self.driver = Driver(
            RosbridgeConnection(self.socket), "/cmd_vel", "test", lambda: self.now, self.stop
        )

    def beat(self) -> None:
        """Have the first look at the way answered."""
        self.driver.hear(0.0)
        self.socket.answer(service="/relay/ping")
        self.hear()

    def hear(self) -> None:
        """All that comes."""
        while self.socket.coming:
            self.driver.hear(0.0)

    def take(self) -> None:
        """Have control."""
        self.driver.take()
        self.socket.answer(service="/relay/take_control")
        self.hear()


def test_it_drives_only_in_control() -> None:
    """Before it has it, and after, nothing is said to the robot."""
    scene = Scene()
    scene.driver.drive(VelocityCommand(0.2, 0.0))
    assert scene.socket.driven() == []
    scene.take()
    scene.driver.drive(VelocityCommand(0.2, 0.1))
    scene.driver.give_back()
    scene.driver.drive(VelocityCommand(0.2, 0.0))
    assert scene.socket.driven() == [(0.2, 0.1), (0.0, 0.0)]
    assert scene.socket.asked()[-1]["service"] == "/relay/release_control"


def test_control_is_asked_for_once_until_it_is_answered() -> None:
    """However often somebody wants it."""
    scene = Scene()
    scene.driver.take()
    scene.driver.take()
    assert len(scene.socket.asked("/relay/take_control")) == 1


def test_control_that_is_refused_is_told_in_the_relays_words() -> None:
    """Both ways of saying no."""
    scene = Scene()
    scene.driver.take()
    scene.socket.answer(success=False, service="/relay/take_control")
    scene.hear()
    assert (scene.driver.in_control, scene.driver.said) == (False, "no")
    scene.driver.take()
    assert scene.driver.said == ""
    scene.socket.answer(result=False, service="/relay/take_control")
    scene.hear()
    assert scene.driver.said == "you may not"


def test_control_that_was_given_back_before_the_answer_came_is_not_had() -> None:
    """The relay has been told so as well."""
    scene = Scene()
    scene.driver.take()
    number = len(scene.socket.sent)
    scene.driver.give_back()
    assert scene.socket.sent[number]["service"] == "/relay/release_control"
    scene.socket.answer(service="/relay/take_control")
    scene.hear()
    assert not scene.driver.in_control


def test_control_that_is_lost_is_heard() -> None:
    """And why; then not even a zero is said, which nobody would obey."""
    scene = Scene()
    scene.take()
    scene.driver.drive(VelocityCommand(0.2, 0.0))
    scene.socket.control(holder="somebody")
    scene.hear()
    assert (scene.driver.in_control, scene.driver.obstacle) == (False, "somebody has control")
    scene.driver.still()
    assert scene.socket.driven() == [(0.2, 0.0)]


def test_a_robot_that_is_stopped_can_not_be_driven() -> None:
    """Until it is not."""
    scene = Scene()
    scene.socket.control(holder="me", you=True, stopped="somebody")
    scene.hear()
    assert "stopped by somebody" in scene.driver.obstacle
    scene.socket.control(holder="me", you=True)
    scene.hear()
    assert scene.driver.obstacle == ""
    assert scene.driver.in_control


def test_the_robots_limits_of_the_level_count() -> None:
    """Those of the other level do not; without any the command goes as it is."""
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


def test_zero_is_said_once() -> None:
    """And not where nothing was under way."""
    scene = Scene()
    scene.take()
    scene.driver.still()
    scene.driver.drive(VelocityCommand(0.2, 0.0))
    scene.driver.still()
    scene.driver.still()
    assert scene.socket.driven() == [(0.2, 0.0), STILL]


def test_a_stop_needs_no_control() -> None:
    """In control it is zero first."""
    scene = Scene()
    scene.driver.stop()
    assert scene.socket.sent[-1]["service"] == "/relay/stop"
    scene.take()
    scene.driver.drive(VelocityCommand(0.2, 0.0))
    scene.driver.stop()
    zero, stop = scene.socket.sent[-2:]
    assert (zero["op"], stop["service"]) == ("publish", "/relay/stop")


def test_how_long_the_robot_takes_to_answer_is_known() -> None:
    """It is asked again and again, once at a time."""
    scene = Scene()
    scene.now += BEAT
    scene.driver.hear(0.0)
    scene.now += 0.05
    scene.driver.hear(0.0)
    assert len(scene.socket.asked("/relay/ping")) == 2
    scene.socket.answer(service="/relay/ping")
    scene.hear()
    assert scene.driver.round_trip == pytest.approx(0.05)
    assert not scene.driver.late


def test_a_robot_that_does_not_answer_is_late_and_then_lost() -> None:
    """Whatever the system says of the connection."""
    scene = Scene()
    scene.now += BEAT
    scene.driver.hear(0.0)
    scene.now += LATE + 0.1
    scene.driver.hear(0.0)
    assert scene.driver.late
    scene.now += SILENT
    with pytest.raises(Lost, match="has not answered"):
        scene.driver.hear(0.0)


def test_that_somebody_suppresses_the_topic_is_known() -> None:
    """This topic, however its name begins; another does not matter."""
    scene = Scene()
    told = []
    for names in (["/other"], ["/other", "cmd_vel"], []):
        scene.socket.control(holder="me", you=True)
        scene.socket.coming[-1]["msg"]["suppressed"] = [{"resource": each} for each in names]
        scene.hear()
        told.append(scene.driver.suppressed)
    assert told == [False, True, False]


def test_a_stop_that_was_not_answered_comes_first_by_the_next_line() -> None:
    """Answered there it is over."""
    scene = Scene()
    scene.driver.stop()
    scene.connect()
    assert scene.socket.sent[0]["service"] == "/relay/stop"
    scene.socket.answer(service="/relay/stop")
    scene.hear()
    scene.connect()
    assert scene.socket.asked("/relay/stop") == []


def test_a_stop_that_a_broken_line_does_not_take_is_not_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor where the zero before it is what breaks."""
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
        (True, {"success": True, "message": "", "done": False}, "as soon as it is back", False),
        (True, {"success": False, "message": "no brakes", "done": False}, "no brakes", False),
        (False, "you may not", "you may not", False),
    ],
    ids=["done", "later", "not done", "refused"],
)
def test_what_became_of_a_stop_is_told_in_words(result: bool, values: object, words: str, done: bool) -> None:
    """Until the answer comes it was asked for, no more."""
    scene = Scene()
    scene.driver.stop()
    assert (scene.stop.asked, scene.stop.words) == (True, "stop asked for, not answered yet")
    scene.socket.answer(service="/relay/stop")
    scene.socket.coming[-1].update(result=result, values=values)
    scene.hear()
    assert words in scene.stop.words
    assert (scene.stop.asked, scene.stop.done) == (False, done)


def test_of_two_stops_the_answer_to_the_last_one_counts() -> None:
    """The first may be of a stop that was resumed since."""
    scene = Scene()
    scene.driver.stop()
    scene.socket.answer(service="/relay/stop")
    scene.driver.stop()
    scene.hear()
    assert scene.stop.asked
    scene.socket.answer(service="/relay/stop")
    scene.hear()
    assert not scene.stop.asked


def test_a_request_is_taken_back() -> None:
    """An answer that comes later gives no control."""
    scene = Scene()
    scene.driver.take()
    scene.driver.withdraw()
    assert scene.socket.asked()[-1]["service"] == "/relay/release_control"
    scene.socket.answer(service="/relay/take_control")
    scene.hear()
    assert not scene.driver.in_control


def test_what_comes_on_the_programs_own_topics_is_handed_over() -> None:
    """As it came."""
    heard: list[tuple[str, object]] = []
    socket = Socket()
    driver = Driver(
        RosbridgeConnection(socket),
        "/cmd_vel",
        "test",
        lambda: 0.0,
        StopNotice(),
        lambda *each: heard.append(each),
    )
    socket.coming.append({"op": "publish", "topic": "/scan", "msg": {"ranges": []}})
    driver.hear(0.0)
    assert heard == [("/scan", {"ranges": []})]
