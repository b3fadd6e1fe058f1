"""Cameras over HTTP on transports in memory: filters, formats and rights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from relay_protocol.errors import NotFound
from relay_server.access import Principal
from relay_server.common.freshness_tokens import HEADER
from relay_server.http.media_types import FORMS
from relay_server.in_process_sessions.pool import RobotCaller
from relay_server.resources.robots_http import CameraEndpoints, CameraService
from tests.worlds.http_client import World

HERE = "/api/v1/robots/rover/cameras"
ANN = {"Authorization": "Bearer ann"}
FACTS = {
    "type": "sensor_msgs/msg/Image",
    "encoding": None,
    "width": 640,
    "height": 480,
    "fps": 15.0,
    "seen": 5.5,
}
CAMERAS = [{"name": name, **FACTS, "streams": []} for name in ("/back", "/front/left")]


async def look(principal: Principal, robot: str) -> list[dict[str, Any]]:
    """All cameras."""
    if robot != "rover":
        raise NotFound("there is no such robot, or you have no right on it")
    return CAMERAS


class FakeResources:
    """Converts at once."""

    async def convert(self, caller: RobotCaller, work: Callable[[], Any]) -> Any:
        """Converts it here."""
        return work()


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site with the cameras of one robot."""
    made = World(tmp_path)
    fake: Any = FakeResources()
    made.router.add(CameraEndpoints(CameraService(look), fake))
    return made


@pytest.mark.parametrize("media", [each.media for each in FORMS])
@pytest.mark.parametrize("address", [HERE, f"{HERE}/front/left"])
def test_cameras_are_served_in_every_media_type(world: World, address: str, media: str) -> None:
    """Each answer has a freshness token, and an entity tag for its format."""
    answer = world.ask("GET", address, Accept=media, **ANN)
    assert (answer.status, answer.headers["content-type"].partition(";")[0]) == (200, media)
    assert answer.headers[HEADER][:2] == "1." and answer.headers["vary"] == "Accept"
    assert b"/front/left" in answer.body
    known = world.ask("GET", address, Accept=media, If_None_Match=answer.headers["etag"], **ANN)
    assert (known.status, known.body) == (304, b"")


def test_a_page_of_cameras_is_filtered(world: World) -> None:
    """With the filters of topics; other parameters are refused."""
    page = world.ask("GET", f"{HERE}?name=/front/*&limit=1", **ANN).json
    assert page == {"cameras": CAMERAS[1:], "next": ""}
    assert world.ask("GET", f"{HERE}?limit=1", **ANN).json["next"] == "/back"
    assert world.ask("GET", f"{HERE}?colour=red", **ANN).status == 400


def test_camera_has_addresses(world: World) -> None:
    """Beside its properties."""
    reported = world.ask("GET", f"{HERE}/back", **ANN).json
    assert reported.pop("addresses")["snapshot"] == "/robots/rover/video/snapshot?topic=%2Fback"
    assert reported == CAMERAS[0]


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        ("GET", HERE, {}, 401),
        ("GET", f"{HERE}/back", {}, 401),
        ("GET", f"{HERE}/other", ANN, 404),
        ("GET", HERE.replace("rover", "other"), ANN, 404),
        ("GET", HERE, {**ANN, "Accept": "image/png"}, 406),
        ("POST", HERE, ANN, 405),
        ("DELETE", f"{HERE}/back", ANN, 405),
    ],
)
def test_missing_resource_is_reported(
    world: World, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    """As problem details."""
    answer = world.ask(method, path, **headers)
    assert (answer.status, answer.json["status"]) == (status, status)
