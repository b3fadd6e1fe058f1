"""One message to a topic: what is known of it when something goes wrong."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol import rosbridge
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_server.common import close_codes, websocket_frames
from relay_server.common.clock import with_timeout
from relay_server.http_sessions.loopback_client import LoopbackClient, MaybeDone
from relay_server.http_sessions.one_shot_publisher import LOOK_SECONDS, MATCHING_SECONDS, OneShotPublisher
from tests.relay_server.steering import outcome

TOPIC, TYPE = "/said", "std_msgs/msg/String"
BODY = msgspec.Raw(b"{}")


class Stage:
    """A session at a robot that speaks ROS 2, and who publishes there."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.done: list[rosbridge.ClientOp] = []
        self.active = [(TOPIC, TYPE)]
        publications = SimpleNamespace(holders=lambda topic: (), active=lambda: self.active)
        topics = {TOPIC: SimpleNamespace(subscribers=["/ear"], types=[TYPE])}
        robot = SimpleNamespace(
            name="rover", control=object(), encodings=("cdr",), graph=SimpleNamespace(topics=topics)
        )
        lease = SimpleNamespace(coming_to=lambda session: False)
        session: Any = SimpleNamespace(
            robot=robot,
            channel=SimpleNamespace(publications=publications),
            desk=SimpleNamespace(lease=lease),
            start=lambda: None,
            do=lambda operation, since: self.done.append(operation),
        )
        self.robot: Any = robot
        self.client = LoopbackClient()
        self.client.begin(session)
        self.speaker = OneShotPublisher(self.clock, self.client, session, TOPIC)

    def says(self) -> list[Any]:
        """Publish a message that waits for nobody; what comes of it."""
        late = with_timeout(self.clock, 5.0, self.speaker.say(BODY, TYPE), "too late")
        return outcome(late)

    def commands(self) -> list[Any]:
        """Publish a command, which the robot takes up within a second or not; what comes of it."""
        self.active = []
        return outcome(self.speaker.command(BODY, TYPE, 0, 1.0))

    def refuses(self, words: str) -> None:
        """The relay refuses the first message after all."""
        status = {"op": "status", "level": "error", "msg": words, "id": self.said[0]}
        self.client.send(websocket_frames.text(json.dumps(status).encode()))

    @property
    def said(self) -> list[str]:
        """The ids of messages that went out."""
        return [str(each.id) for each in self.done if isinstance(each, rosbridge.Publish)]


@pytest.fixture
def stage() -> Stage:
    """Where nothing was said yet."""
    return Stage()


def test_a_message_that_was_said_may_have_arrived(stage: Stage) -> None:
    """When the session is cut after it, not before."""
    before = stage.says()
    assert stage.said == []
    told = stage.says()
    stage.clock.advance(MATCHING_SECONDS)
    assert len(stage.said) == 2 and (before, told) == ([], [])
    stage.client.close(close_codes.FORBIDDEN, "your right was revoked")
    stage.clock.advance(MATCHING_SECONDS)
    assert [type(each) for each in before + told] == [MaybeDone, MaybeDone]
    (never,) = stage.says()
    assert type(never) is Refused and len(stage.said) == 2


def test_a_message_that_was_not_said_has_not(stage: Stage) -> None:
    """The session was cut while it waited to be."""
    told = stage.says()
    stage.client.close(close_codes.GOING_AWAY, "the relay is going down")
    stage.clock.advance(MATCHING_SECONDS)
    assert [type(each) for each in told] == [Unavailable] and stage.said == []


def test_a_message_that_is_refused_later_was_not_taken(stage: Stage) -> None:
    """Which is said in words."""
    told = stage.says()
    stage.clock.advance(MATCHING_SECONDS)
    stage.refuses("no such field")
    stage.clock.advance(MATCHING_SECONDS)
    assert [(type(each), str(each)) for each in told] == [(Refused, "no such field")]


def test_a_message_that_is_given_up_when_it_was_said_may_have_arrived(stage: Stage) -> None:
    """It has come to be said just before too much time had passed."""
    running = Deferred.fromCoroutine(stage.speaker.say(BODY, TYPE))
    stage.clock.advance(MATCHING_SECONDS)
    running.cancel()
    assert [type(each) for each in outcome(running)] == [MaybeDone] and len(stage.said) == 1


@pytest.mark.parametrize("why", ["cut", "offline", "late"])
def test_a_command_that_was_said_may_have_moved_the_robot(stage: Stage, why: str) -> None:
    """When nothing is heard of it any more."""
    told = stage.commands()
    assert len(stage.said) == 1 and told == []
    if why == "cut":
        stage.client.close(close_codes.FORBIDDEN, "your right was revoked")
    elif why == "offline":
        stage.robot.control = None
    for _ in range(int(1 / LOOK_SECONDS) + 2):
        stage.clock.advance(LOOK_SECONDS)
    (error,) = told
    assert isinstance(error, MaybeDone) and isinstance(error.reason, SwitchboardError)


def test_a_command_that_is_refused_has_not(stage: Stage) -> None:
    """Somebody else has control."""
    told = stage.commands()
    stage.refuses("ben has control")
    stage.active = [(TOPIC, TYPE)]
    stage.clock.advance(LOOK_SECONDS)
    assert [(type(each), str(each)) for each in told] == [(Refused, "ben has control")]
