"""Latched samples in a real graph, with each of the executors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import pytest_twisted
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from relay_protocol import link
from robot_client.platforms.ros2 import topics
from robot_client.platforms.ros2.platform import Ros2Platform
from robot_client.platforms.ros2.topics import LatchedStamps
from tests.robot_client.ros import until
from tests.worlds.ros_endpoints import STRING, Listener, node


@pytest.fixture(scope="module")
def three(environment: dict[str, str]) -> Iterator[list[Any]]:
    """Nodes other than the platform's."""
    with ExitStack() as stack:
        yield [stack.enter_context(node(f"node_{name}")) for name in "abc"]


def kept(depth: int = 1) -> QoSProfile:
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Receiver(Listener):
    """A subscription, and the stamps of its samples."""

    def __init__(self, ros: Ros2Platform, topic: str, qos: link.QoS | None = None) -> None:
        self.stamps: dict[str, int] = {}
        super().__init__(ros, topic, STRING, qos)
        self.source._on_sample = self._take

    def _take(self, body: bytes) -> None:
        self.bodies.append(body)
        self.stamps[self.texts[-1]] = self.source.stamp

    async def recalled(self, enough: Callable[[dict[int, str]], bool]) -> dict[int, str]:
        """Samples that publishers keep, by stamp."""
        found: dict[int, str] = {}

        def keep(stamp: int, body: bytes) -> None:
            found[stamp] = deserialize_message(body, String).data

        ended: list[bool] = []
        self.source.request_latched(keep, lambda: ended.append(True))
        await until(lambda: enough(found))
        self.source._end_request()
        assert ended == [True]
        return found


@pytest_twisted.ensureDeferred
async def test_latched_samples_of_each_publisher_are_fetched(ros: Ros2Platform, three: list[Any]) -> None:
    """By its depth, with the stamps of their first arrival."""
    topic = "/recalled"
    publishers = [
        each.create_publisher(String, topic, kept(depth))
        for each, depth in zip(three, (1, 2, 5), strict=True)
    ]
    for number in range(7):
        for name, publisher in zip("abc", publishers, strict=True):
            publisher.publish(String(data=f"{name}{number}"))
    await until(lambda: len(ros._node.get_publishers_info_by_topic(topic)) == 3)
    taker = Receiver(ros, topic)
    expected = {"a6", "b5", "b6", "c2", "c3", "c4", "c5", "c6"}
    await until(lambda: len(taker.bodies) >= len(expected))
    assert set(taker.texts) == expected
    publishers[0].publish(String(data="a7"))
    await until(lambda: "a7" in taker.texts)
    found = await taker.recalled(lambda found: len(found) >= len(expected))
    assert set(found.values()) == expected - {"a6"} | {"a7"}
    assert {word: stamp for stamp, word in found.items()} == {
        word: stamp for word, stamp in taker.stamps.items() if word != "a6"
    }
    three[1].destroy_publisher(publishers[1])
    await until(lambda: len(ros._node.get_publishers_info_by_topic(topic)) == 2)
    found = await taker.recalled(lambda found: len(found) >= 6)
    assert set(found.values()) == {"a7", "c2", "c3", "c4", "c5", "c6"}
    assert len(taker.texts) == len(set(taker.texts))
    taker.source.close()
    for each, publisher in ((three[0], publishers[0]), (three[2], publishers[2])):
        each.destroy_publisher(publisher)


@pytest_twisted.ensureDeferred
async def test_stamps_outlast_a_subscription(ros: Ros2Platform, three: list[Any]) -> None:
    """The same message has the same stamp."""
    topic = "/outlasts"
    publisher = three[0].create_publisher(String, topic, kept(3))
    for word in ("x", "y"):
        publisher.publish(String(data=word))
    await until(lambda: len(ros._node.get_publishers_info_by_topic(topic)) == 1)
    before = Receiver(ros, topic)
    other = Receiver(ros, topic)
    await until(lambda: len(before.bodies) == len(other.bodies) == 2)
    before.source.close()
    publisher.publish(String(data="z"))
    again = Receiver(ros, topic)
    await until(lambda: len(again.bodies) == 3)
    assert again.source.stamps_id == before.source.stamps_id != ""
    assert again.texts == ["x", "y", "z"]
    assert (
        {word: again.stamps[word] for word in ("x", "y")}
        == before.stamps
        == {word: other.stamps[word] for word in ("x", "y")}
    )
    assert again.stamps["x"] < again.stamps["y"] < again.stamps["z"]
    for each in (other, again):
        each.source.close()
    three[0].destroy_publisher(publisher)


@pytest_twisted.ensureDeferred
async def test_samples_of_all_kinds_of_publishers_arrive_once(ros: Ros2Platform, three: list[Any]) -> None:
    topic = "/kinds"
    taker = Receiver(ros, topic)
    latched = three[0].create_publisher(String, topic, kept(2))
    latched.publish(String(data="kept"))
    await until(lambda: ros.graph() and "kept" in taker.texts)
    volatile = three[1].create_publisher(String, topic, 10)
    await until(lambda: ros.graph() and taker.source.publishers == 2)
    assert taker.source.latched
    lossy = three[2].create_publisher(
        String, topic, QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    await until(lambda: ros.graph() and taker.source.publishers == 3)
    numbers = iter(range(10_000))

    def all_heard() -> bool:
        number = next(numbers)
        for name, publisher in (("latched", latched), ("volatile", volatile), ("lossy", lossy)):
            publisher.publish(String(data=f"{name} {number}"))
        return {"latched", "volatile", "lossy"} <= {text.split()[0] for text in taker.texts}

    await until(all_heard)
    late = Receiver(ros, topic)
    await until(lambda: sum(text.startswith("latched") for text in late.texts) >= 2)
    for each in (taker, late):
        assert len(each.texts) == len(set(each.texts))
        each.source.close()
    for each, publisher in zip(three, (latched, volatile, lossy), strict=True):
        each.destroy_publisher(publisher)


@pytest_twisted.ensureDeferred
async def test_rclpy_without_message_info(
    ros: Ros2Platform, three: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Humble's identifies no messages."""
    monkeypatch.setattr(topics, "IDENTIFIES_MESSAGES", False)
    topic = "/humble"
    publisher = three[0].create_publisher(String, topic, kept())
    publisher.publish(String(data="kept"))
    await until(lambda: len(ros._node.get_publishers_info_by_topic(topic)) == 1)
    taker = Receiver(ros, topic)
    await until(lambda: taker.texts == ["kept"])
    assert taker.source.stamps_id == ""
    assert taker.source.stamp == 0
    taker.source.close()
    three[0].destroy_publisher(publisher)


def test_stamps_increase_for_any_clock() -> None:
    """The memory is bounded."""
    now = iter([1000, 500, 2000, 9, *range(2001, 9000)])
    stamps = LatchedStamps(lambda: next(now))
    assert [stamps.stamp_of("/a", (number, 1)) for number in (7, 8)] == [1000, 1001]
    assert stamps.now() == 2000
    assert [stamps.stamp_of("/a", (number, 1)) for number in (9, 7)] == [2001, 1000]
    for number in range(topics.MAX_KNOWN + 5):
        stamps.stamp_of("/b", (number, 1))
    assert len(stamps._topics["/b"]) == topics.MAX_KNOWN
    for number in range(topics.MAX_KNOWN_TOPICS + 5):
        stamps.stamp_of(f"/t{number}", (1, 1))
    assert len(stamps._topics) == topics.MAX_KNOWN_TOPICS
