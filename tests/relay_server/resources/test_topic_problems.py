"""Clients by HTTP are told of messages that do not arrive: readers of a stream by an event, publishers by a header."""

from __future__ import annotations

import json
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from relay_protocol import link
from relay_server.common.send_queue import DATA_PER_TOPIC
from relay_server.http.idempotency import Idempotency
from relay_server.in_process_sessions.in_process_port import InProcessPort
from relay_server.in_process_sessions.pool import PooledSession, RobotCaller
from relay_server.resources.service import RobotResourceService
from relay_server.resources.topics_http import TopicEndpoints
from tests.worlds.http_client import HOST, Transport, parse
from tests.worlds.http_client import World as Site
from tests.worlds.relay import STRING, TWIST, World, text
from tests.worlds.robot_channel_link import RobotLink

TOPICS = "/api/v1/robots/rover/topics"


class Sessions:
    """One session of ann in place of the pool."""

    def __init__(self, world: World) -> None:
        self.port = InProcessPort()
        self.port.begin(world.session(world.permit(), self.port, world.message_age()))
        self.pooled = PooledSession(world.clock, self.port)

    @asynccontextmanager
    async def unshared(self, caller: RobotCaller) -> AsyncIterator[InProcessPort]:
        """The session."""
        yield self.port

    @asynccontextmanager
    async def at(self, caller: RobotCaller) -> AsyncIterator[PooledSession]:
        """The session."""
        yield self.pooled


@pytest.fixture
def robot(world: World) -> RobotLink:
    """The robot, on a link of bytes."""
    return RobotLink(world)


@pytest.fixture
def site(world: World, robot: RobotLink, tmp_path: Path) -> Site:
    """An HTTP site with the robot's topics."""
    made = Site(tmp_path)
    sessions: Any = Sessions(world)
    unused: Any = None
    service = RobotResourceService(world.clock, sessions, unused, world.now_ns, lambda: 1.7e9)
    made.router.add(TopicEndpoints(made.clock, service, Idempotency(made.clock)))
    return made


def stream(site: Site, topic: str) -> Transport:
    """Requests a stream of a topic."""
    transport = site.connect()
    head = f"GET {TOPICS}/{topic} HTTP/1.1\r\nHost: {HOST}\r\nAuthorization: Bearer ann\r\n"
    site.send(transport, f"{head}Accept: text/event-stream\r\n\r\n".encode())
    return transport


def publish(site: Site, topic: str = "chatter", value: bytes = b'{"data":"by http"}') -> Transport:
    """Requests that a message is published."""
    transport = site.connect()
    body = b'{"value":' + value + b"}"
    head = (
        f"PUT {TOPICS}/{topic} HTTP/1.1\r\nHost: {HOST}\r\nAuthorization: Bearer ann\r\nConnection: close\r\n"
    )
    head += f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    site.send(transport, head.encode() + body)
    return transport


@pytest.mark.parametrize("number", [b"NaN", b"null"])
def test_a_command_that_is_not_finite_is_refused_in_words(
    site: Site, robot: RobotLink, number: bytes
) -> None:
    robot.world.robot.description = link.Describe()
    answer = publish(site, "cmd_vel", b'{"linear":{"x":' + number + b"}}")
    robot.joins().advertised("/cmd_vel", TWIST, motion=True)
    for _ in range(50):
        robot.world.clock.advance(0.1)
        site.clock.advance(0.1)
    told = parse(answer.value())
    assert told.status == 400
    assert b"linear.x must be finite" in told.body


def statuses(transport: Transport) -> list[dict[str, Any]]:
    """The statuses in a stream so far."""
    return [json.loads(each) for each in re.findall(rb"event: status\ndata: (.*)\n", transport.value())]


def messages(transport: Transport) -> list[str]:
    """The texts in a stream so far."""
    found = re.findall(rb"event: message\ndata: (.*)\n", transport.value())
    return [json.loads(each)["data"] for each in found]


def test_a_stream_says_that_messages_are_too_large_for_the_robots_link(site: Site, robot: RobotLink) -> None:
    reader = stream(site, "chatter")
    number = robot.joins().subscribed("/chatter")
    robot.says(link.SamplesDropped(number=number, reason="too_large", count=1, size=99_000_000))
    (status,) = statuses(reader)
    assert status["level"] == "error"
    assert "a message of 99000000 bytes is too large to be sent" in status["msg"]


def test_a_stream_says_that_the_robots_link_is_too_slow(site: Site, robot: RobotLink) -> None:
    reader = stream(site, "chatter")
    number = robot.joins().subscribed("/chatter")
    for _ in range(2):
        robot.says(link.SamplesDropped(number=number, reason="slow_link", count=1))
    (status,) = statuses(reader)
    assert status["level"] == "warning"
    assert "the robot's link is too slow" in status["msg"]


def test_a_slow_reader_of_a_stream_is_told_of_drops_when_it_reads_again(site: Site, robot: RobotLink) -> None:
    reader = stream(site, "chatter")
    number = robot.joins().subscribed("/chatter")
    assert reader.producer is not None
    reader.producer.pauseProducing()
    for words in "abc":
        robot.sample(number, text(words))
    assert (messages(reader), statuses(reader)) == ([], [])
    reader.producer.resumeProducing()
    assert messages(reader) == ["c"]
    (status,) = statuses(reader)
    assert status["level"] == "warning"
    assert "you read them too slowly" in status["msg"]


def test_a_slow_reader_gets_a_latched_message_of_each_publisher(site: Site, robot: RobotLink) -> None:
    reader = stream(site, "chatter")
    number = robot.joins().subscribed("/chatter", latched=True, publishers=3)
    assert reader.producer is not None
    reader.producer.pauseProducing()
    for stamp, words in enumerate("abc", 1):
        robot.sample(number, text(words), stamp)
    reader.producer.resumeProducing()
    assert (messages(reader), statuses(reader)) == (["a", "b", "c"], [])


def test_a_publisher_is_told_by_a_header_that_earlier_messages_were_dropped(
    world: World, site: Site, robot: RobotLink
) -> None:
    robot.joins()
    client = world.person()
    client.says("advertise", topic="/chatter", type=STRING)
    robot.advertised("/chatter")
    first = publish(site)
    for _ in range(20):
        world.clock.advance(0.1)
    assert parse(first.value()).status == 204
    robot.stalls()
    publish(site)
    for number in range(DATA_PER_TOPIC):
        client.says("publish", topic="/chatter", msg={"data": str(number)})
    told, after = (parse(publish(site).value()) for _ in range(2))
    assert (told.status, after.status) == (204, 204)
    assert "messages are dropped, as the robot's link is too slow" in told.headers["switchboard-warning"]
    assert "switchboard-warning" not in after.headers
