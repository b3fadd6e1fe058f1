"""Publishing a single message: the result after each failure."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol import rosbridge
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_server.common import close_codes
from relay_server.common.concurrency import with_timeout
from relay_server.in_process_sessions.in_process_port import InProcessPort, MaybeDone
from relay_server.in_process_sessions.one_shot_publisher import (
    LOOK_SECONDS,
    MATCHING_SECONDS,
    OneShotPublisher,
)
from tests.worlds.control import outcome

TOPIC, TYPE = "/said", "std_msgs/msg/String"
BODY = msgspec.Raw(b"{}")


class Stage:
    """A session on a ROS 2 robot, and a one-shot publisher."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.done: list[rosbridge.ClientOp] = []
        self.active = [(TOPIC, TYPE)]
        publications = SimpleNamespace(advertisers=lambda topic: (), active=lambda: self.active)
        topics = {TOPIC: SimpleNamespace(subscribers=["/ear"], types=[TYPE])}
        robot = SimpleNamespace(
            name="rover", control_link=object(), encodings=("cdr",), graph=SimpleNamespace(topics=topics)
        )
        lease = SimpleNamespace(pending_for=lambda session: False)
        context: Any = SimpleNamespace(
            robot=robot,
            channel=SimpleNamespace(publications=publications),
            controller=SimpleNamespace(lease=lease),
            age=SimpleNamespace(as_of=lambda moment: nullcontext()),
        )
        session: Any = SimpleNamespace(client=context, start=lambda: None, perform=self.done.append)
        self.robot: Any = robot
        self.client = InProcessPort()
        self.client.begin(session)
        self.speaker = OneShotPublisher(self.clock, self.client, TOPIC)

    def says(self) -> list[Any]:
        """Publishes a message without waiting for subscribers; returns the result."""
        late = with_timeout(self.clock, 5.0, self.speaker.publish(BODY, TYPE), "too late")
        return outcome(late)

    def commands(self) -> list[Any]:
        """Publishes a command, which the robot accepts within a second or not; returns the result."""
        self.active = []
        return outcome(self.speaker.publish_command(BODY, TYPE, 0, 1.0))

    def refuses(self, words: str) -> None:
        """The relay refuses the first message later."""
        self.client.status("error", words, self.said[0])

    @property
    def said(self) -> list[str]:
        """Ids of messages that were sent."""
        return [str(each.id) for each in self.done if isinstance(each, rosbridge.Publish)]


@pytest.fixture
def stage() -> Stage:
    """A stage without messages."""
    return Stage()


def test_a_message_that_was_sent_may_have_arrived(stage: Stage) -> None:
    """The session was cut after it was sent."""
    before = stage.says()
    assert stage.said == []
    reported = stage.says()
    stage.clock.advance(MATCHING_SECONDS)
    assert len(stage.said) == 2 and (before, reported) == ([], [])
    stage.client.disconnect(close_codes.FORBIDDEN, "your right was revoked")
    stage.clock.advance(MATCHING_SECONDS)
    assert [type(each) for each in before + reported] == [MaybeDone, MaybeDone]
    (never,) = stage.says()
    assert type(never) is Refused and len(stage.said) == 2


def test_a_message_that_was_not_sent_has_not_arrived(stage: Stage) -> None:
    """The session was cut while it waited to be sent."""
    reported = stage.says()
    stage.client.disconnect(close_codes.GOING_AWAY, "the relay is going down")
    stage.clock.advance(MATCHING_SECONDS)
    assert [type(each) for each in reported] == [Unavailable] and stage.said == []


def test_a_message_that_is_refused_later_was_not_taken(stage: Stage) -> None:
    """The error says so."""
    reported = stage.says()
    stage.clock.advance(MATCHING_SECONDS)
    stage.refuses("no such field")
    stage.clock.advance(MATCHING_SECONDS)
    assert [(type(each), str(each)) for each in reported] == [(Refused, "no such field")]


def test_a_message_given_up_after_it_was_sent_may_have_arrived(stage: Stage) -> None:
    """It was sent just before the timeout."""
    running = Deferred.fromCoroutine(stage.speaker.publish(BODY, TYPE))
    stage.clock.advance(MATCHING_SECONDS)
    running.cancel()
    assert [type(each) for each in outcome(running)] == [MaybeDone] and len(stage.said) == 1


@pytest.mark.parametrize("why", ["cut", "offline", "late"])
def test_a_command_that_was_sent_may_have_moved_the_robot(stage: Stage, why: str) -> None:
    """The robot's answer is missing."""
    reported = stage.commands()
    assert len(stage.said) == 1 and reported == []
    if why == "cut":
        stage.client.disconnect(close_codes.FORBIDDEN, "your right was revoked")
    elif why == "offline":
        stage.robot.control_link = None
    for _ in range(int(1 / LOOK_SECONDS) + 2):
        stage.clock.advance(LOOK_SECONDS)
    (error,) = reported
    assert isinstance(error, MaybeDone) and isinstance(error.reason, SwitchboardError)


def test_a_command_that_is_refused_has_not(stage: Stage) -> None:
    """Another user has control."""
    reported = stage.commands()
    stage.refuses("ben has control")
    stage.active = [(TOPIC, TYPE)]
    stage.clock.advance(LOOK_SECONDS)
    assert [(type(each), str(each)) for each in reported] == [(Refused, "ben has control")]
