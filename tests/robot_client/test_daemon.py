"""Connection and daemon together, in memory, on a clock of ours."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import pytest

from relay_protocol import frames, link
from robot_client.alerts import HEARING_NS
from robot_client.motion.stop_store import MemoryStopStore
from robot_client.platforms.base import GraphView
from robot_client.platforms.memory import TWIST, twist
from tests.robot_client.breaking import broken
from tests.robot_client.daemon_scene import DRIVER, Scene


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_registered_robot_describes_itself(scene: Scene) -> None:
    """After the welcome come description, the whole graph and health, in this order."""
    heard = scene.register().heard()
    by_op = {each["op"]: each for each in heard}
    ops = [each["op"] for each in heard if each["op"] in ("describe", "graph", "health")]
    assert ops == ["describe", "graph", "health"]
    assert by_op["graph"]["full"] is True
    assert "/talker" in by_op["graph"]["nodes"]
    assert by_op["describe"]["platform"] == "memory"


def test_cameras_are_told_and_shown(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the graph, at once and when they change; streams are for the camera process, and end with the link."""
    done: list[Any] = []
    monkeypatch.setattr(scene.cameras, "open", lambda line: done.append(("open", line.topic)))
    monkeypatch.setattr(scene.cameras, "close", lambda stream, why: done.append(("close", stream)))
    monkeypatch.setattr(scene.cameras, "close_all", lambda why: done.append("all"))
    image = link.Topic(types=["sensor_msgs/msg/Image"], publishers=["/driver"])
    line = scene.register()
    assert [each for each in line.heard() if each["op"] == "cameras"] == [{"op": "cameras", "streams": 8}]
    scene.platform.view = GraphView(topics={"/front": image})
    scene.run(1.5)
    (told,) = [each for each in line.heard() if each["op"] == "cameras"]
    assert [each["name"] for each in told["cameras"]] == ["/front"]
    line.say(link.OpenVideo(stream="s", ticket="t", camera="/front", settings=link.VideoSettings()))
    line.say(link.CloseVideo(stream="s"))
    line.lose()
    assert done == [("open", "/front"), ("close", "s"), "all"]


def test_graph_is_told_in_differences(scene: Scene) -> None:
    """A change of the graph is told within half a second, as a difference; no change, nothing."""
    line = scene.register()
    line.heard()
    scene.run(1.0)
    assert "graph" not in line.ops()
    scene.platform.view = GraphView(nodes=frozenset({"/listener"}))
    scene.run(0.5)
    (told,) = [each for each in line.heard() if each["op"] == "graph"]
    assert told["nodes"] == {"/listener": {}, "/talker": None}
    assert "full" not in told


def test_a_graph_too_large_for_one_frame_is_told_in_several(scene: Scene) -> None:
    """The relay takes at most 1 MiB at a time."""
    scene.platform.view = GraphView(nodes=frozenset(f"/{'n' * 200}{number}" for number in range(8000)))
    line = scene.register()
    told = [each for each in line.heard() if each["op"] == "graph"]
    assert [each.get("full", False) for each in told] == [True, False]
    assert sum(len(each["nodes"]) for each in told) == 8000


def test_lost_link_is_dialled_again_and_told_all(scene: Scene) -> None:
    """After a loss the robot is back within half a second, and tells the whole graph anew."""
    scene.register().lose()
    scene.run(0.5)
    assert len(scene.lines) == 2
    heard = scene.register().heard()
    assert any(each["op"] == "graph" and each.get("full") for each in heard)


def test_robot_dials_for_ever(scene: Scene) -> None:
    """A relay that is away for an hour is asked all the time, and the robot is back 15 s after it is."""
    scene.listening = False
    scene.lines[-1].lose()
    scene.run(3600)
    waits = [
        later - earlier for (earlier, _), (later, _) in zip(scene.dialled, scene.dialled[1:], strict=False)
    ]
    assert max(waits) <= 15.1
    scene.listening = True
    scene.run(15.1)
    assert len(scene.lines) == 2


def test_relay_that_restarts_has_its_robots_back_within_3_s(scene: Scene) -> None:
    """After an outage of 20 s the robot dials within 3 s."""
    scene.register()
    scene.run(0.1)
    scene.listening = False
    scene.lines[-1].lose()
    scene.run(20)
    scene.listening = True
    scene.run(3)
    assert len(scene.lines) == 2


def test_retry_after_is_honoured(scene: Scene) -> None:
    """A relay that refuses with a time is not dialled before it."""
    scene.lines[-1].say(link.Refused(reason="full", retry_after=20))
    scene.run(19.9)
    assert len(scene.dialled) == 1
    scene.run(3)
    assert len(scene.dialled) == 2


def test_other_relay_is_refused_and_asked_slowly(scene: Scene) -> None:
    """A relay of another name gets no proof, and is asked again after 30 s at the earliest."""
    line = scene.lines[-1]
    line.heard()
    line.say(link.Challenge(nonce=link.to_base64(bytes(32)), relay="evil"))
    assert line.ops() == []
    assert not line.transport.connected
    scene.run(29)
    assert len(scene.dialled) == 1
    scene.run(32)
    assert len(scene.dialled) > 1


def test_silent_relay_is_left(scene: Scene) -> None:
    """A relay that is silent for three heartbeats counts as lost, and is dialled anew."""
    scene.register()
    scene.run(9)
    assert len(scene.lines) >= 2


def test_relay_that_never_answers_is_left(scene: Scene) -> None:
    """A connection on which nothing is said is given up after ten seconds."""
    scene.run(10.1)
    assert not scene.lines[0].transport.connected


def test_channel_is_joined_by_ticket(scene: Scene) -> None:
    """An order to open a channel is followed by a connection to the address given, with the ticket."""
    control = scene.register()
    control.say(link.OpenChannel(channel="c", ticket="tick", address="host:99"))
    assert scene.dialled[-1][1] == "host:99"
    assert [each["ticket"] for each in scene.lines[-1].heard() if each["op"] == "join"] == ["tick"]


def test_several_channels_live_side_by_side(scene: Scene) -> None:
    """Two channels have their own subscriptions; the end of one leaves the other."""
    control = scene.register()
    first, second = scene.channel(control, "a"), scene.channel(control, "b")
    for line in (first, second):
        line.say(link.Subscribe(number=1, topic="/t", type="x/msg/Y"))
    control.say(link.CloseChannel(channel="a"))
    assert len(scene.platform.sources) == 1
    scene.platform.emit("/t", b"z")
    scene.clock.advance(0)
    assert [each.body for each in second.heard() if isinstance(each, frames.SampleFrame)] == [b"z"]


@pytest.mark.parametrize("how", ["channel lost", "control lost", "closed", "daemon leaves", "hostile frame"])
def test_every_loss_stops_the_robot_at_once(scene: Scene, how: str) -> None:
    """Whatever link is lost or closed, zero goes out in the same moment, and publishers end."""
    control = scene.register()
    line = scene.driving(control)
    {
        "channel lost": line.lose,
        "control lost": control.lose,
        "closed": lambda: control.say(link.CloseChannel(channel="c1")),
        "daemon leaves": scene.daemon.stop,
        "hostile frame": lambda: line.protocol.dataReceived(b"\xff\xff\xff\xff\x00"),
    }[how]()
    assert scene.platform.published[-1] == ("/cmd_vel", twist())
    scene.run(0.5)
    assert scene.platform.sinks == []


@pytest.mark.parametrize(
    "where",
    ["helm.unregistered", "motion.stop_all", "_alerts.tell", "_cameras.unregistered", "c1.close", "c1.say"],
)
def test_a_lost_link_ends_all_whatever_breaks(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """One part that fails keeps no goal under way, no wheel turning, no channel open, and the robot dials again."""
    scene.platform.actions = {"/spin"}
    control = scene.register()
    lines = [scene.driving(control), scene.channel(control, "c2")]
    lines[1].say(link.Advertise(number=5, topic="/joy/cmd_vel", type=TWIST))
    scene.command(lines[1], twist(1.0))
    for line in lines:
        line.say(link.SendActionGoal(id="g", action="/spin", type="t", source=DRIVER, cdr=""))
    scene.clock.advance(0.06)
    place, name = where.split(".")
    if place == "c1":
        end = scene.daemon._ends["c1"]
        part: object = end if name == "say" else end.channel
    else:
        part = getattr(scene.daemon, place)
    monkeypatch.setattr(part, name, broken)
    control.lose()
    assert [goal.cancelled for goal in scene.platform.goals] == [where != "c1.close", True]
    last = dict(scene.platform.published)
    assert last == {"/cmd_vel": twist(), "/joy/cmd_vel": twist()}
    assert not any(line.transport.connected for line in lines)
    scene.run(1)
    assert len(scene.lines) == 4


def test_nothing_behind_a_goodbye_is_done(scene: Scene) -> None:
    """A command that follows the relay's goodbye in the same bytes is not executed."""
    line = scene.driving(scene.register())
    late = frames.encode_command(5, scene.now(), DRIVER, twist(0.5))
    line.protocol.dataReceived(link.frame(link.Bye(reason="done")) + late)
    assert ("/cmd_vel", twist(0.5)) not in scene.platform.published
    assert scene.platform.published[-1] == ("/cmd_vel", twist())


def test_reconnecting_resumes_nothing(scene: Scene) -> None:
    """Who drives on through a loss moves nothing, though he has control again, until he has let go."""
    control = scene.register()
    scene.driving(control)
    control.lose()
    sent = len(scene.platform.published)
    scene.run(1)
    control = scene.register()
    control.say(link.Control(id=2, holder=DRIVER, user="ann", level="operator"))
    line = scene.channel(control)
    line.say(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    for _ in range(20):
        scene.command(line, twist(1.0))
        scene.clock.advance(0.05)
    assert {body for _, body in scene.platform.published[sent:]} == {twist()}
    scene.command(line, twist())
    scene.command(line, twist(1.0))
    assert scene.platform.published[-1] == ("/cmd_vel", twist(1.0))


@pytest.mark.parametrize("first", ["control", "channel"])
def test_who_drove_as_the_link_was_lost_is_told_to_the_next_relay(scene: Scene, first: str) -> None:
    """Once: one that was killed knows nothing of it. Whichever link is found lost first, for they go together."""
    scene.run(HEARING_NS / 1e9)
    control = scene.register()
    line = scene.driving(control)
    scene.clock.advance(0.06)
    for each in (control, line) if first == "control" else (line, control):
        each.lose()
    told = []
    for _ in range(2):
        scene.run(1)
        told += [each for each in scene.register().heard() if each["op"] == "alert"]
        scene.run(0.1)
        scene.daemon._tell_health()
        scene.lines[-1].lose()
    assert [(each["kind"], each["level"]) for each in told] == [("control", "error")]
    assert told[0]["text"] == "ann lost control while the robot moved: its link to the relay was lost"


def test_a_link_that_is_lost_while_the_robot_stands_is_nobodys_loss(scene: Scene) -> None:
    """Though somebody has control."""
    control = scene.register()
    line = scene.driving(control)
    scene.command(line, twist())
    scene.run(0.5)
    control.lose()
    scene.run(1)
    assert [each for each in scene.register().heard() if each["op"] == "alert"] == []


def test_alert_waits_for_the_relay(scene: Scene) -> None:
    """What a person should know while no relay is there is told when one is."""
    scene.daemon.alert("error", "look here")
    (told,) = [each for each in scene.register().heard() if each["op"] == "alert"]
    assert told["text"] == "look here"


def test_alert_said_into_a_dead_link_is_told_by_the_next(scene: Scene) -> None:
    """And that there is no other, once the daemon has had time to hear; what lasts is told by each link after it."""
    scene.run(HEARING_NS / 1e9)
    scene.register().heard()
    scene.daemon.alert("error", "the motor is hot", "diagnostics", "motor")
    for _ in range(2):
        scene.lines[-1].lose()
        scene.run(0.5)
        heard = scene.register().heard()
        (told,) = [each for each in heard if each["op"] == "alert"]
        assert (told["kind"], told["about"], told["text"]) == ("diagnostics", "motor", "the motor is hot")
        assert [each["op"] for each in heard if "alert" in each["op"]] == ["alert", "alerts_told"]


def test_stop_says_goodbye(scene: Scene) -> None:
    """A daemon that leaves says so on the control link and dials no more."""
    control = scene.register()
    control.heard()
    stopped: list[Any] = []
    scene.daemon.stop().addCallback(stopped.append)
    assert control.ops() == ["bye"]
    scene.run(60)
    assert stopped == [None]
    assert len(scene.dialled) == 1


def test_stuck_middleware_is_told_once(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A middleware that is stuck is an alert, once, and its recovery another."""
    control = scene.register()
    control.heard()
    trouble: list[str | None] = ["the executor is stuck"]
    monkeypatch.setattr(scene.platform, "trouble", lambda: trouble[0])
    scene.run(1)
    trouble[0] = None
    scene.run(1)
    alerts = [each["level"] for each in control.heard() if each["op"] == "alert"]
    assert alerts == ["error", "info"]


def test_battery_that_can_not_be_read_ends_nothing(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A platform that throws over its battery costs the charge, not the registration and not the health to come."""
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(scene.platform, "battery", broken)
        heard = scene.register().heard()
        assert "health" in [each["op"] for each in heard]
    scene.platform.charge = 0.5
    scene.run(4)
    told = [each for each in scene.lines[-1].heard() if each["op"] == "health"]
    assert told[-1]["battery"] == 0.5


def test_graph_that_can_not_be_read_at_first_is_told_later(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot whose graph throws is registered all the same, and tells it when it can be read."""
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(scene.platform, "graph", broken)
        control = scene.register()
        assert "health" in control.ops()
    scene.run(1)
    assert any("/talker" in each["nodes"] for each in control.heard() if each["op"] == "graph")


@pytest.mark.parametrize("where", ["platform.trouble", "helm._hardware.prepare", "_pursuits._sweep.actions"])
def test_what_is_done_every_second_goes_on_after_a_failure(
    monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """Stops are finished by it: a robot that ceased to look would have to be restarted, and nobody would know."""
    latch = MemoryStopStore()
    latch.noted = ["/spin"]
    scene = Scene(latch)
    *place, name = where.split(".")
    part = attrgetter(".".join(place))(scene if place == ["platform"] else scene.daemon)
    times: list[float] = []

    def fails() -> None:
        times.append(scene.clock.seconds())
        broken()

    monkeypatch.setattr(part, name, fails)
    scene.run(5.05)
    assert len(times) >= 5


def test_daemon_that_leaves_says_every_zero_first(scene: Scene) -> None:
    """Leaving is done when the last of the five zeros went out."""
    scene.driving(scene.register())
    left: list[Any] = []
    scene.daemon.stop().addCallback(left.append)
    assert left == []
    scene.run(0.5)
    assert left == [None]
    assert scene.platform.published[1:] == 5 * [("/cmd_vel", twist())]
