"""Connection and daemon together, in memory."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import pytest

from relay_protocol import frames, link
from robot_client.alerts import STARTUP_NS
from robot_client.motion.stop_store import MemoryStopStore
from robot_client.platforms.base import GraphView
from tests.worlds.memory_platform import TWIST, twist
from tests.worlds.robot_daemon import DRIVER, Scene
from tests.worlds.robot_failures import broken


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_registration_is_followed_by_description_graph_and_health(scene: Scene) -> None:
    """In this order."""
    heard = scene.register().received()
    by_op = {each["op"]: each for each in heard}
    ops = [each["op"] for each in heard if each["op"] in ("describe", "graph", "health")]
    assert ops == ["describe", "graph", "health"]
    assert by_op["graph"]["full"] is True
    assert "/talker" in by_op["graph"]["nodes"]
    assert by_op["describe"]["platform"] == "memory"


def test_cameras_are_reported_and_streams_opened(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """They end with the link."""
    done: list[Any] = []
    monkeypatch.setattr(scene.cameras, "open", lambda line: done.append(("open", line.topic)))
    monkeypatch.setattr(scene.cameras, "close", lambda stream, why: done.append(("close", stream)))
    monkeypatch.setattr(scene.cameras, "close_all", lambda why: done.append("all"))
    image = link.Topic(types=["sensor_msgs/msg/Image"], publishers=["/driver"])
    line = scene.register()
    assert [each for each in line.received() if each["op"] == "cameras"] == [{"op": "cameras", "streams": 8}]
    scene.platform.view = GraphView(topics={"/front": image})
    scene.run(1.5)
    (reported,) = [each for each in line.received() if each["op"] == "cameras"]
    assert [each["name"] for each in reported["cameras"]] == ["/front"]
    line.send(link.OpenVideo(stream="s", ticket="t", camera="/front", settings=link.VideoSettings()))
    line.send(link.CloseVideo(stream="s"))
    line.lose()
    assert done == [("open", "/front"), ("close", "s"), "all"]


def test_graph_is_reported_in_differences(scene: Scene) -> None:
    """Within half a second."""
    line = scene.register()
    line.received()
    scene.run(1.0)
    assert "graph" not in line.ops()
    scene.platform.view = GraphView(nodes=frozenset({"/listener"}))
    scene.run(0.5)
    (reported,) = [each for each in line.received() if each["op"] == "graph"]
    assert reported["nodes"] == {"/listener": {}, "/talker": None}
    assert "full" not in reported


def test_a_graph_too_large_for_one_frame_is_reported_in_several(scene: Scene) -> None:
    scene.platform.view = GraphView(nodes=frozenset(f"/{'n' * 200}{number}" for number in range(8000)))
    line = scene.register()
    reported = [each for each in line.received() if each["op"] == "graph"]
    assert [each.get("full", False) for each in reported] == [True, False]
    assert sum(len(each["nodes"]) for each in reported) == 8000


def test_lost_link_is_dialled_again_and_gets_the_whole_graph(scene: Scene) -> None:
    scene.register().lose()
    scene.run(0.5)
    assert len(scene.lines) == 2
    heard = scene.register().received()
    assert any(each["op"] == "graph" and each.get("full") for each in heard)


def test_robot_dials_for_ever(scene: Scene) -> None:
    """After an hour it is back within 15 s."""
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
    """After an outage of 20 s."""
    scene.register()
    scene.run(0.1)
    scene.listening = False
    scene.lines[-1].lose()
    scene.run(20)
    scene.listening = True
    scene.run(3)
    assert len(scene.lines) == 2


def test_retry_after_is_honoured(scene: Scene) -> None:
    scene.lines[-1].send(link.Refused(reason="full", retry_after=20))
    scene.run(19.9)
    assert len(scene.dialled) == 1
    scene.run(3)
    assert len(scene.dialled) == 2


def test_other_relay_is_refused_and_dialled_rarely(scene: Scene) -> None:
    """It gets no proof."""
    line = scene.lines[-1]
    line.received()
    line.send(link.Challenge(nonce=link.to_base64(bytes(32)), relay="evil"))
    assert line.ops() == []
    assert not line.transport.connected
    scene.run(29)
    assert len(scene.dialled) == 1
    scene.run(32)
    assert len(scene.dialled) > 1


def test_silent_link_is_dialled_again(scene: Scene) -> None:
    """After three heartbeats."""
    scene.register()
    scene.run(9)
    assert len(scene.lines) >= 2


def test_handshake_times_out_after_ten_seconds(scene: Scene) -> None:
    scene.run(10.1)
    assert not scene.lines[0].transport.connected


def test_channel_is_joined_by_ticket(scene: Scene) -> None:
    """At the address of the request."""
    control = scene.register()
    control.send(link.OpenChannel(channel="c", ticket="tick", address="host:99"))
    assert scene.dialled[-1][1] == "host:99"
    assert [each["ticket"] for each in scene.lines[-1].received() if each["op"] == "join"] == ["tick"]


def test_channels_are_independent(scene: Scene) -> None:
    control = scene.register()
    first, second = scene.channel(control, "a"), scene.channel(control, "b")
    for line in (first, second):
        line.send(link.Subscribe(number=1, topic="/t", type="x/msg/Y"))
    control.send(link.CloseChannel(channel="a"))
    assert len(scene.platform.subscriptions) == 1
    scene.platform.emit("/t", b"z")
    scene.clock.advance(0)
    assert [each.body for each in second.received() if isinstance(each, frames.SampleFrame)] == [b"z"]


@pytest.mark.parametrize("how", ["channel lost", "control lost", "closed", "daemon leaves", "hostile frame"])
def test_every_loss_stops_the_robot_at_once(scene: Scene, how: str) -> None:
    """Of the control link or a channel."""
    control = scene.register()
    line = scene.driving(control)
    {
        "channel lost": line.lose,
        "control lost": control.lose,
        "closed": lambda: control.send(link.CloseChannel(channel="c1")),
        "daemon leaves": scene.daemon.stop,
        "hostile frame": lambda: line.protocol.dataReceived(b"\xff\xff\xff\xff\x00"),
    }[how]()
    assert scene.platform.published[-1] == ("/cmd_vel", twist())
    scene.run(0.5)
    assert scene.platform.publishers == []


@pytest.mark.parametrize(
    "where",
    [
        "order_handler.link_lost",
        "motion.stop_moving_topics",
        "_alerts.report",
        "_cameras.link_lost",
        "c1.close",
        "c1.send",
    ],
)
def test_unexpected_error_after_a_lost_link_does_not_prevent_the_stop(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """Goals end, channels close, and the robot dials again."""
    scene.platform.actions = {"/spin"}
    control = scene.register()
    lines = [scene.driving(control), scene.channel(control, "c2")]
    lines[1].send(link.Advertise(number=5, topic="/joy/cmd_vel", type=TWIST))
    scene.command(lines[1], twist(1.0))
    for line in lines:
        line.send(link.SendActionGoal(id="g", action="/spin", type="t", source=DRIVER, cdr=""))
    scene.clock.advance(0.06)
    place, name = where.split(".")
    if place == "c1":
        end = scene.daemon._channels["c1"]
        part: object = end if name == "send" else end.channel
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


def test_messages_after_bye_are_ignored(scene: Scene) -> None:
    """Also in the same bytes."""
    line = scene.driving(scene.register())
    late = frames.encode_command(5, scene.now(), DRIVER, twist(0.5))
    line.protocol.dataReceived(link.frame(link.Bye(reason="done")) + late)
    assert ("/cmd_vel", twist(0.5)) not in scene.platform.published
    assert scene.platform.published[-1] == ("/cmd_vel", twist())


def test_stream_through_a_reconnection_must_release(scene: Scene) -> None:
    control = scene.register()
    scene.driving(control)
    control.lose()
    sent = len(scene.platform.published)
    scene.run(1)
    control = scene.register()
    control.send(link.ControlGrant(id=2, holder=DRIVER, user="ann", level="operator"))
    line = scene.channel(control)
    line.send(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    for _ in range(20):
        scene.command(line, twist(1.0))
        scene.clock.advance(0.05)
    assert {body for _, body in scene.platform.published[sent:]} == {twist()}
    scene.command(line, twist())
    scene.command(line, twist(1.0))
    assert scene.platform.published[-1] == ("/cmd_vel", twist(1.0))


@pytest.mark.parametrize("first", ["control", "channel"])
def test_driver_at_the_loss_of_the_link_is_reported_once(scene: Scene, first: str) -> None:
    """Whichever link is found lost first."""
    scene.run(STARTUP_NS / 1e9)
    control = scene.register()
    line = scene.driving(control)
    scene.clock.advance(0.06)
    for each in (control, line) if first == "control" else (line, control):
        each.lose()
    reported = []
    for _ in range(2):
        scene.run(1)
        reported += [each for each in scene.register().received() if each["op"] == "alert"]
        scene.run(0.1)
        scene.daemon._report_health()
        scene.lines[-1].lose()
    assert [(each["kind"], each["level"]) for each in reported] == [("control", "error")]
    assert reported[0]["text"] == "ann lost control while the robot moved: its link to the relay was lost"


def test_loss_of_the_link_of_a_still_robot_is_not_reported(scene: Scene) -> None:
    control = scene.register()
    line = scene.driving(control)
    scene.command(line, twist())
    scene.run(0.5)
    control.lose()
    scene.run(1)
    assert [each for each in scene.register().received() if each["op"] == "alert"] == []


def test_alert_waits_for_a_registration(scene: Scene) -> None:
    scene.daemon.alert("error", "look here")
    (reported,) = [each for each in scene.register().received() if each["op"] == "alert"]
    assert reported["text"] == "look here"


def test_alert_sent_into_a_dead_link_is_sent_again(scene: Scene) -> None:
    """Active alerts are sent at each registration."""
    scene.run(STARTUP_NS / 1e9)
    scene.register().received()
    scene.daemon.alert("error", "the motor is hot", "diagnostics", "motor")
    for _ in range(2):
        scene.lines[-1].lose()
        scene.run(0.5)
        heard = scene.register().received()
        (reported,) = [each for each in heard if each["op"] == "alert"]
        assert (reported["kind"], reported["about"], reported["text"]) == (
            "diagnostics",
            "motor",
            "the motor is hot",
        )
        assert [each["op"] for each in heard if "alert" in each["op"]] == ["alert", "active_alerts_sent"]


def test_shutdown_sends_bye(scene: Scene) -> None:
    control = scene.register()
    control.received()
    stopped: list[Any] = []
    scene.daemon.stop().addCallback(stopped.append)
    assert control.ops() == ["bye"]
    scene.run(60)
    assert stopped == [None]
    assert len(scene.dialled) == 1


def test_stuck_middleware_is_reported_once(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """So is its end."""
    control = scene.register()
    control.received()
    fault: list[str | None] = ["the executor is stuck"]
    monkeypatch.setattr(scene.platform, "fault", lambda: fault[0])
    scene.run(1)
    fault[0] = None
    scene.run(1)
    alerts = [each["level"] for each in control.received() if each["op"] == "alert"]
    assert alerts == ["error", "info"]


def test_unreadable_battery_affects_neither_registration_nor_health(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(scene.platform, "battery", broken)
        heard = scene.register().received()
        assert "health" in [each["op"] for each in heard]
    scene.platform.charge = 0.5
    scene.run(4)
    reported = [each for each in scene.lines[-1].received() if each["op"] == "health"]
    assert reported[-1]["battery"] == 0.5


def test_graph_that_can_not_be_read_at_first_is_reported_later(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(scene.platform, "graph", broken)
        control = scene.register()
        assert "health" in control.ops()
    scene.run(1)
    assert any("/talker" in each["nodes"] for each in control.received() if each["op"] == "graph")


@pytest.mark.parametrize(
    "where", ["platform.fault", "order_handler._hardware.prepare", "_active_goals._goal_canceller.actions"]
)
def test_periodic_tasks_continue_after_a_failure(monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    """They complete stops."""
    stop_store = MemoryStopStore()
    stop_store.actions = ["/spin"]
    scene = Scene(stop_store)
    *place, name = where.split(".")
    part = attrgetter(".".join(place))(scene if place == ["platform"] else scene.daemon)
    times: list[float] = []

    def fails() -> None:
        times.append(scene.clock.seconds())
        broken()

    monkeypatch.setattr(part, name, fails)
    scene.run(5.05)
    assert len(times) >= 5


def test_shutdown_waits_for_the_last_zero(scene: Scene) -> None:
    scene.driving(scene.register())
    left: list[Any] = []
    scene.daemon.stop().addCallback(left.append)
    assert left == []
    scene.run(0.5)
    assert left == [None]
    assert scene.platform.published[1:] == 5 * [("/cmd_vel", twist())]


def test_robot_is_idle_while_nothing_moves_it(scene: Scene) -> None:
    """Not while a command or a zero is under way, nor with an open call."""
    control = scene.register()
    assert scene.daemon.is_idle
    line = scene.driving(control)
    assert not scene.daemon.is_idle
    scene.command(line, twist())
    scene.run(2.0)
    assert scene.daemon.is_idle
    scene.platform.services["/s"] = lambda request: request
    scene.platform.pending_discovery = []
    line.send(link.CallService(id="1", service="/s", type="x/srv/Y", timeout=5.0, cdr="AAEAAAA="))
    assert not scene.daemon.is_idle


def test_platform_that_is_made_again_loses_no_graph(scene: Scene) -> None:
    """Channels are closed, for the relay to open them again; nodes that are not discovered yet are not reported as
    gone.
    """
    control = scene.register()
    line = scene.channel(control)
    line.received()
    control.received()
    assert scene.daemon.release_platform("other addresses").called
    assert [each for each in line.received() if each["op"] == "bye"] == [
        {"op": "bye", "reason": "other addresses"}
    ]
    again = scene.channel(control)
    scene.daemon.renew_platform("other addresses")
    assert scene.platform.renewals == 1
    assert "bye" in again.ops()
    scene.platform.view = GraphView()
    scene.run(2.0)
    scene.platform.view = GraphView(nodes=frozenset({"/talker", "/new"}))
    scene.run(4.0)
    (reported,) = [each for each in control.received() if each["op"] == "graph"]
    assert reported["nodes"] == {"/new": {}}
