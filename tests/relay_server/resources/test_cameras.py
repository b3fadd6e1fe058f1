"""Cameras as resources: their pages, each with the addresses of its pictures, and both as graphs."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted
from rdflib import RDF, RDFS, SOSA, XSD, Graph, Literal, Namespace, URIRef
from rdflib.compare import isomorphic

from relay_protocol.errors import Invalid, NotFound
from relay_server.access import Principal
from relay_server.http.media_types import FORMS, MediaType
from relay_server.http.rdf.encode import camera_graph, members_graph
from relay_server.http.rdf.serialize import read, write
from relay_server.in_process_sessions.pool import RobotCaller
from relay_server.resources.page import TypedPageQuery
from relay_server.resources.robots_http import CameraService
from relay_server.resources.states import ResourceLocation
from relay_server.video.errors import NO_CAMERA

CALLER = RobotCaller(Principal(1, "ann", "main", False, 1, None), "rover", "192.0.2.1")
PLACE = ResourceLocation("https://robots.example:8443", "rover")
OWN = Namespace("https://robots.example:8443/api/v1/vocabulary/switchboard#")
SHOWN = {
    "viewers": 2,
    "state": "open",
    "settings": {"width": 320, "crop": [0, 0, 0, 0]},
    "stream_status": None,
}


def camera(name: str, type_name: str = "sensor_msgs/msg/Image", **facts: Any) -> dict[str, Any]:
    """A camera in its JSON form."""
    plain = dict.fromkeys(("encoding", "width", "height", "fps", "seen"))
    return {"name": name, "type": type_name, **plain, "streams": [], **facts}


FRONT = camera("/front", encoding="rgb8", width=640, height=480, fps=15.0, seen=5.5, streams=[SHOWN])
GATE = camera("/gate/usb", "")
BACK = camera("/back")


async def look(principal: Principal, robot: str) -> list[dict[str, Any]]:
    """Cameras of rover that ann may view."""
    if (principal.name, robot) != ("ann", "rover"):
        raise NotFound("there is no such robot, or you have no right on it")
    return [FRONT, GATE, BACK]


@pytest_twisted.ensureDeferred
async def test_a_page_of_cameras() -> None:
    """Ordered by name, filtered by name and type, with a page size."""
    cameras = CameraService(look)

    async def names(**listing: Any) -> tuple[list[str], str]:
        page = await cameras.members(CALLER, TypedPageQuery(**listing))
        return [each["name"] for each in page["cameras"]], page["next"]

    assert await names() == (["/back", "/front", "/gate/usb"], "")
    assert await names(limit=1, after="/back") == (["/front"], "/front")
    assert await names(name="/gate/*") == (["/gate/usb"], "")
    assert await names(type="sensor_msgs/msg/Image") == (["/back", "/front"], "")
    with pytest.raises(NotFound):
        await cameras.members(CALLER._replace(robot="other"), TypedPageQuery())


@pytest_twisted.ensureDeferred
async def test_camera_links_to_its_frames() -> None:
    """With or without the leading slash; a camera without the right to view counts as missing."""
    cameras = CameraService(look)
    place = "/robots/rover/video"
    assert await cameras.camera(CALLER, "gate/usb") == {
        **GATE,
        "addresses": {
            "snapshot": f"{place}/snapshot?topic=%2Fgate%2Fusb",
            "stream": f"{place}/stream?topic=%2Fgate%2Fusb",
            "viewer": f"{place}/stream_viewer?topic=%2Fgate%2Fusb",
            "websocket": f"{place}/ws?topic=%2Fgate%2Fusb",
        },
    }
    assert (await cameras.camera(CALLER, "/front"))["width"] == 640
    with pytest.raises(NotFound, match=NO_CAMERA):
        await cameras.camera(CALLER, "hidden")
    with pytest.raises(Invalid):
        await cameras.camera(CALLER, "no name")


@pytest.mark.parametrize("form", FORMS[1:])
@pytest_twisted.ensureDeferred
async def test_a_camera_is_a_sensor(form: MediaType) -> None:
    """Numbers are numbers, unknown values are left out, and its pictures are resources."""
    graph = camera_graph(await CameraService(look).camera(CALLER, "front"), PLACE)
    node, robot = URIRef(PLACE.of("cameras", "/front")), URIRef(PLACE.address)
    assert str(node) == "https://robots.example:8443/api/v1/robots/rover/cameras/front"
    assert set(graph.objects(node, RDF.type)) == {OWN.Camera, SOSA.Sensor}
    assert graph.value(node, SOSA.isHostedBy) == robot
    assert graph.value(node, OWN.width) == Literal("640", datatype=XSD.integer)
    assert graph.value(node, OWN.fps) == Literal("15.0", datatype=XSD.double)
    assert graph.value(node, OWN.snapshot) == URIRef(
        "https://robots.example:8443/robots/rover/video/snapshot?topic=%2Ffront"
    )
    assert isomorphic(read(write(graph, form), form, str(node)), graph)
    bare = camera_graph(await CameraService(look).camera(CALLER, "back"), PLACE)
    assert not {OWN.width, OWN.fps, OWN.seen, OWN.encoding} & set(bare.predicates())


@pytest.mark.parametrize("form", FORMS[1:])
def test_cameras_are_members_of_their_collection(form: MediaType) -> None:
    """As topics are of theirs."""
    graph = members_graph("cameras", {"cameras": [FRONT, GATE], "next": ""}, PLACE)
    collection = URIRef(PLACE.of("cameras"))
    members = [URIRef(PLACE.of("cameras", each["name"])) for each in (FRONT, GATE)]
    assert set(graph.objects(collection, RDFS.member)) == set(members)
    assert all((each, RDF.type, OWN.Camera) in graph for each in members)
    reported: Graph = read(write(graph, form), form, str(collection))
    assert isomorphic(reported, graph)
