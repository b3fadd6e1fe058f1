"""Assets of a robot: fetched in parts over the channel's link, once for all clients."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_protocol import limits, link
from relay_protocol.errors import SwitchboardError
from relay_server.channels import assets as module
from robot_client.channel.assets import ChannelAssets
from tests.worlds.relay import World
from tests.worlds.robot_channel import RecordingWriter

BASE = "package://arm/meshes/base.stl"


class Scene:
    """A robot that has joined, and the results of what is fetched."""

    def __init__(self) -> None:
        self.world = World()
        self.world.robot_comes()
        self.world.person()
        self.world.robot_joins()
        self.assets = self.world.channel.assets

    def fetch(self, uri: str = BASE, most: int = limits.ASSET) -> list[Any]:
        """Fetch an asset; the list gets its bytes or the reason."""
        results: list[Any] = []
        fetched: Deferred[bytes] = self.assets.fetch(uri, most)
        fetched.addCallbacks(results.append, lambda failure: results.append(str(failure.value)))
        return results

    def requests(self) -> list[link.GetAsset]:
        """Requests to the robot since the last call."""
        return self.world.link.take(link.GetAsset)

    def part(self, request: link.GetAsset, data: bytes, size: int, version: str = "1") -> None:
        """The robot's answer."""
        self.world.channel.message(
            link.AssetPart(
                number=request.number, offset=request.offset, size=size, version=version, data=data
            )
        )


@pytest.fixture
def scene() -> Scene:
    """A robot that is online."""
    return Scene()


def test_parts_are_requested_one_after_another_and_shared(scene: Scene) -> None:
    first, second = scene.fetch(), scene.fetch()
    (request,) = scene.requests()
    assert (request.uri, request.offset) == (BASE, 0)
    scene.part(request, b"abc", 5)
    (request,) = scene.requests()
    assert request.offset == 3
    scene.part(request, b"de", 5)
    assert (first, second) == ([b"abcde"], [b"abcde"])
    assert scene.requests() == []
    scene.fetch()
    assert len(scene.requests()) == 1


def test_each_spelling_of_a_path_is_fetched_once(scene: Scene) -> None:
    plain, quoted = (
        scene.fetch("package://arm/meshes/base.stl"),
        scene.fetch("package://arm/meshes/%62ase.stl"),
    )
    (request,) = scene.requests()
    scene.part(request, b"abc", 3)
    assert plain == quoted == [b"abc"]


def test_a_caller_that_takes_less_is_refused_with_the_size_and_others_are_not(scene: Scene) -> None:
    less, enough = scene.fetch(most=4), scene.fetch(most=5)
    (request,) = scene.requests()
    scene.part(request, b"abc", 5)
    assert less == ["the asset has 5 bytes"]
    assert scene.fetch(most=4) == ["the asset has 5 bytes"]
    again = scene.fetch(most=5)
    (request,) = scene.requests()
    assert request.offset == 3
    scene.part(request, b"de", 5)
    assert enough == again == [b"abcde"]


def test_an_asset_that_all_callers_refuse_makes_room(scene: Scene) -> None:
    scene.fetch(most=4)
    scene.part(scene.requests()[0], b"abc", 5)
    assert scene.requests() == []
    enough = scene.fetch(most=5)
    (request,) = scene.requests()
    assert request.offset == 0
    scene.part(request, b"abcde", 5)
    assert enough == [b"abcde"]


def test_a_file_that_grows_while_it_is_fetched_fails(scene: Scene) -> None:
    grown = scene.fetch(most=5)
    scene.part(scene.requests()[0], b"abc", 5)
    scene.part(scene.requests()[0], b"defgh", 8)
    assert "was changed" in grown[0]


@pytest.mark.parametrize(
    "uri", ["", "file:///etc/passwd", "http://x/y.stl", "package://" + "x" * limits.ASSET_URI]
)
def test_what_is_no_asset_does_not_reach_the_robot(scene: Scene, uri: str) -> None:
    assert "is no asset" in scene.fetch(uri)[0]
    assert scene.requests() == []


def test_a_robot_that_refuses_changes_or_miscounts_a_file_fails_it_with_the_reason(scene: Scene) -> None:
    refused = scene.fetch()
    (request,) = scene.requests()
    scene.world.channel.message(
        link.Failed(request="get_asset", reference=str(request.number), reason="no such file")
    )
    assert refused == [f"{BASE}: no such file"]
    changed = scene.fetch()
    scene.part(scene.requests()[0], b"abc", 5)
    scene.part(scene.requests()[0], b"de", 5, version="2")
    assert "was changed" in changed[0]
    short = scene.fetch()
    scene.part(scene.requests()[0], b"", 5)
    assert "other bytes" in short[0]
    empty = scene.fetch()
    scene.part(scene.requests()[0], b"", 0)
    assert empty == [b""]


def test_a_robot_that_does_not_answer_or_leaves_ends_all_that_wait(scene: Scene) -> None:
    silent = scene.fetch()
    scene.world.clock.advance(module.PART_SECONDS)
    assert "sent nothing" in silent[0]
    many = [scene.fetch(f"{BASE}{number}") for number in range(2 * module.AT_A_TIME)]
    assert len(scene.requests()) == 1 + module.AT_A_TIME
    scene.world.channel.link_lost(scene.world.link)
    assert all("lost its connection" in each[0] for each in many)
    assert "is not connected" in scene.fetch()[0]


def test_waiting_assets_are_bounded(scene: Scene) -> None:
    for number in range(module.QUEUED + module.AT_A_TIME):
        scene.fetch(f"{BASE}{number}")
    assert "wait to be fetched" in scene.fetch(f"{BASE}x")[0]


def test_an_asset_that_nothing_waits_for_makes_room_when_the_robot_has_answered(scene: Scene) -> None:
    fetched = [scene.assets.fetch(f"{BASE}{n}", limits.ASSET) for n in range(6)]
    asked = scene.requests()
    assert [each.uri for each in asked] == [f"{BASE}{n}" for n in range(4)]
    for n in (4, 0):
        fetched[n].addErrback(lambda _: None)
        fetched[n].cancel()
    assert scene.requests() == []
    scene.part(asked[0], b"abc", 5)
    assert [each.uri for each in scene.requests()] == [f"{BASE}5"]


def test_a_client_that_leaves_does_not_fail_the_assets_of_another(scene: Scene, tmp_path: Path) -> None:
    """With the robot's own reader, which reads only a few parts at a time."""
    index = tmp_path / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "arm").touch()
    (tmp_path / "share/arm").mkdir()
    names = [f"{client}{n}.stl" for client in "ab" for n in range(module.AT_A_TIME)]
    for name in names:
        (tmp_path / "share/arm" / name).write_bytes(name.encode())
    writer, reads = RecordingWriter(), list[Callable[[], None]]()

    def run(work: Callable[[], link.AssetPart]) -> Deferred[link.AssetPart]:
        waiting: Deferred[link.AssetPart] = Deferred()
        reads.append(lambda: waiting.callback(work()))
        return waiting

    robot = ChannelAssets(writer, lambda: [tmp_path], run)

    def robot_takes_requests() -> None:
        for request in scene.requests():
            try:
                robot.get(request)
            except SwitchboardError as error:
                writer.send(
                    link.Failed(request="get_asset", reference=str(request.number), reason=str(error))
                )

    leaving = [
        scene.assets.fetch(f"package://arm/{name}", limits.ASSET) for name in names[: module.AT_A_TIME]
    ]
    staying = [scene.fetch(f"package://arm/{name}") for name in names[module.AT_A_TIME :]]
    robot_takes_requests()
    for each in leaving:
        each.addErrback(lambda _: None)
        each.cancel()
    # A mesh that the other one has requested too is fetched again.
    shared = scene.fetch(f"package://arm/{names[0]}")
    robot_takes_requests()
    while reads or writer.sent:
        while reads:
            reads.pop(0)()
        while writer.sent:
            scene.world.channel.message(writer.sent.pop(0))
        robot_takes_requests()
    assert staying == [[name.encode()] for name in names[module.AT_A_TIME :]]
    assert shared == [names[0].encode()]
