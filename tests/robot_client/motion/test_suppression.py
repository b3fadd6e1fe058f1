"""Suppression of commands to a topic, and inhibition of its messages."""

from __future__ import annotations

import pytest

from relay_protocol import frames, link
from robot_client.platforms.base import GraphView
from tests.worlds.memory_platform import TWIST, twist
from tests.worlds.robot_commands import (
    GO,
    OTHER,
    ZERO,
    messages_of,
    order,
)
from tests.worlds.robot_daemon import RelayEnd, Scene


def test_suppression_stops_other_sources_and_ends_by_itself(scene: Scene, control: RelayEnd) -> None:
    """Its own movement is stopped at its end; then the holder is obeyed again."""
    line = scene.driving(control)
    done = order(control, link.Suppress(id=4, resource="cmd_vel", sources=[OTHER], ms=100, by="walls"))
    assert done == {"op": "order_result", "id": 4}
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    scene.command(line, GO)
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    scene.command(line, twist(0.2), OTHER)
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.2))
    scene.clock.advance(0.099)
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.2))
    scene.clock.advance(0.001)
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    scene.command(line, twist(0.6))
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.6))


def test_renewed_suppression_stops_nothing(scene: Scene, control: RelayEnd) -> None:
    line = scene.driving(control)
    control.send(link.Suppress(id=4, resource="/cmd_vel", sources=[OTHER], ms=100))
    scene.command(line, twist(0.2), OTHER)
    scene.clock.advance(0.09)
    control.send(link.Suppress(id=5, resource="/cmd_vel", sources=[OTHER], ms=100))
    scene.clock.advance(0.09)
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.2))
    assert order(control, link.Suppress(id=6, resource="/cmd_vel")) == {"op": "order_result", "id": 6}
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (link.Suppress(id=4, resource="/chat", ms=100), "does not move the robot"),
        (link.Suppress(id=4, resource="/none", ms=100), "no topic /none"),
        (link.Inhibit(id=4, resource="/none", ms=100), "no topic /none"),
    ],
)
def test_suppression_of_an_unknown_or_still_topic_is_refused(
    scene: Scene, message: link.Message, words: str
) -> None:
    scene.platform.view = GraphView(topics={"/chat": link.Topic(types=["std_msgs/msg/String"])})
    done = order(scene.register(), message)
    assert (done["ok"], words in done["reason"]) == (False, True)


def test_topic_can_be_suppressed_before_it_is_commanded(scene: Scene) -> None:
    """Also one that has just appeared in the graph."""
    control = scene.register()
    scene.platform.view = GraphView(topics={"/cmd_vel": link.Topic(types=[TWIST])})
    assert order(control, link.Suppress(id=4, resource="/cmd_vel", ms=100)) == {
        "op": "order_result",
        "id": 4,
    }


class SubscribedTopic:
    """A topic to which a channel of a daemon is subscribed."""

    def __init__(self, scene: Scene) -> None:
        scene.platform.view = GraphView(topics={"/chat": link.Topic(types=["std_msgs/msg/String"])})
        self.scene = scene
        self.control = scene.register()
        self.line = scene.channel(self.control)
        self.line.send(link.Subscribe(number=1, topic="/chat"))
        self.line.received()

    def emit(self, body: bytes) -> list[bytes]:
        self.scene.platform.emit("/chat", body)
        self.scene.clock.advance(0)
        return [each.body for each in self.line.received() if isinstance(each, frames.SampleFrame)]

    def inhibit(self, ms: int, hold: bool = False) -> None:
        assert order(self.control, link.Inhibit(id=4, resource="/chat", ms=ms, hold=hold))["id"] == 4


def test_inhibited_topic_sends_no_samples_for_its_time(scene: Scene) -> None:
    """Also to a subscription that begins meanwhile."""
    listening = SubscribedTopic(scene)
    assert listening.emit(b"a") == [b"a"]
    listening.inhibit(1000)
    later = scene.channel(listening.control, "c2")
    later.send(link.Subscribe(number=2, topic="/chat"))
    later.received()
    assert listening.emit(b"b") == []
    assert [each for each in later.received() if isinstance(each, frames.SampleFrame)] == []
    scene.clock.advance(0.999)
    assert listening.emit(b"c") == []
    scene.clock.advance(0.001)
    assert listening.emit(b"d") == [b"d"]


def test_held_topic_repeats_its_last_value(scene: Scene) -> None:
    """Without a value that was sent before, it sends none."""
    listening = SubscribedTopic(scene)
    listening.inhibit(1000, hold=True)
    assert listening.emit(b"a") == []
    listening.inhibit(0)
    assert listening.emit(b"b") == [b"b"]
    listening.inhibit(1000, hold=True)
    assert listening.emit(b"c") == [b"b"]
    assert listening.emit(b"d") == [b"b"]
    listening.inhibit(0)
    assert listening.emit(b"e") == [b"e"]


def test_inhibition_ends_with_the_control_link(scene: Scene) -> None:
    listening = SubscribedTopic(scene)
    listening.inhibit(60_000)
    listening.control.lose()
    scene.run(1)
    control = scene.register()
    (state,) = messages_of(control, "motion_state")
    assert "inhibited" not in state
    line = scene.channel(control)
    line.send(link.Subscribe(number=1, topic="/chat"))
    line.received()
    scene.platform.emit("/chat", b"a")
    scene.clock.advance(0)
    assert [each.body for each in line.received() if isinstance(each, frames.SampleFrame)] == [b"a"]
