"""Robots, their nodes and their cameras as resources, and lists of them over HTTP (SPEC 1.13)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Protocol, TypedDict
from urllib.parse import quote

from twisted.web.server import Request

from relay_protocol import jsontext
from relay_protocol.errors import NotFound
from relay_server.access import NO_ROBOT, Principal
from relay_server.alerts.schemas import AlertsUpdate
from relay_server.channels.names import resolve
from relay_server.common.clock import Clock
from relay_server.common.concurrency import FairLock
from relay_server.common.database import BoundedThreadPool
from relay_server.common.etags import tag_of, weak
from relay_server.http.endpoint import ApiRequest, Representation, Streamed, Tagged, endpoint
from relay_server.http.live_updates import Sources, UpdateUnknown
from relay_server.http.media_types import EVENTS, FORMS, MediaType
from relay_server.http.rdf.encode import camera_graph, node_graph, robot_graph
from relay_server.http.rdf.serialize import write
from relay_server.http.streaming import UpdateStream
from relay_server.in_process_sessions.pool import InProcessSessionPool, RobotCaller
from relay_server.relay_node.arguments import absolute
from relay_server.relay_node.visible_graph import VisibleGraph, node_details_of, visible_graph
from relay_server.resources import representations
from relay_server.resources.collections_http import member_endpoint, page_endpoint
from relay_server.resources.page import PageQuery, TypedPageQuery
from relay_server.resources.representations import caller_at, location
from relay_server.resources.schemas import NodeInfo, NodePage
from relay_server.resources.service import RobotResourceService, require_online
from relay_server.sessions.presence import RobotInfo, RobotPage, RobotsUpdate, RobotUsers
from relay_server.sessions.summaries import RobotSummaries
from relay_server.video.errors import NO_CAMERA
from relay_server.video.parameters import AddressedCamera, CameraInfo

FLEETING = frozenset({"rtt_ms", "last_seen"})
"""Fields that change with every ping. They do not change a robot's entity tag."""


class RobotSource(Protocol):
    """Lists robots; see :class:`relay_server.sessions.manager.SessionManager`."""

    async def robots(self, principal: Principal) -> list[RobotInfo]:
        """The robots on which a principal has a right."""


class RobotService:
    """Lists and describes robots."""

    def __init__(self, overview: RobotSource) -> None:
        self._overview = overview

    async def members(self, principal: Principal, listing: PageQuery) -> RobotPage:
        """A page of the robots on which a principal has a right."""
        there = {each["name"]: each for each in await self._overview.robots(principal)}
        page, after = listing.page(there, lambda each: ())
        return {"robots": [each for _, each in page], "next": after}

    async def robot(self, principal: Principal, name: str) -> RobotInfo:
        """A robot.

        :raises NotFound: no such robot, or no right on it
        """
        for each in await self._overview.robots(principal):
            if each["name"] == name:
                return each
        raise NotFound(NO_ROBOT)


def robot_tag(robot: Mapping[str, Any]) -> str:
    """The weak entity tag of a robot's JSON, which ignores :data:`FLEETING`."""
    return tag_of(jsontext.encode(_lasting(robot)))


def robots_tag(page: RobotPage) -> str:
    """The weak entity tag of a page of robots."""
    return tag_of(jsontext.encode({**page, "robots": [_lasting(each) for each in page["robots"]]}))


def _lasting(robot: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in robot.items() if name not in FLEETING}


BASE_PATH = "/api/v1/robots"


class RobotEndpoints:
    """Robots.

    :param threads: convert to RDF
    :param sources: contents of the stream of changes
    """

    def __init__(
        self,
        clock: Clock,
        robots: RobotService,
        summaries: RobotSummaries,
        threads: BoundedThreadPool,
        sources: Sources,
    ) -> None:
        self._clock = clock
        self._robots = robots
        self._summaries = summaries
        self._threads = threads
        self._sources = sources
        self._fair_lock = FairLock()

    @endpoint(
        "GET",
        BASE_PATH,
        tag="robots",
        summary="A page of the robots the caller has a right on",
        more="The `ETag` does not depend on `rtt_ms` and `last_seen`.",
        returns="a page",
    )
    async def page(self, request: ApiRequest, query: PageQuery) -> Tagged[RobotPage]:
        found = await self._robots.members(request.principal, query)
        return Tagged(found, weak(robots_tag(found)))

    @endpoint(
        "GET",
        f"{BASE_PATH}/stream",
        tag="robots",
        summary="Live updates of robots and alerts",
        more="Server-sent events; over a websocket, the same as text messages (SPEC 1.7).",
        returns="events",
        forms=(EVENTS,),
        items=(RobotsUpdate, AlertsUpdate, UpdateUnknown),
        lasts="The stream lasts until the reader disconnects.",
    )
    async def stream(self, request: ApiRequest) -> Streamed:
        async def run(http: Request) -> None:
            await UpdateStream(self._clock, http, request.authenticate, self._sources).run()

        return Streamed(EVENTS.media, run, headers={"x-accel-buffering": "no"})

    @endpoint(
        "GET",
        f"{BASE_PATH}/{{robot}}",
        tag="robots",
        summary="One robot",
        more="The `ETag` does not depend on `rtt_ms` and `last_seen`.",
        returns="the robot",
        forms=FORMS,
    )
    async def one(self, request: ApiRequest, robot: str) -> Representation[RobotInfo]:
        found = await self._robots.robot(request.principal, robot)

        async def render(form: MediaType) -> bytes:
            place = location(request, robot)
            async with self._fair_lock.hold(request.principal.user_id):
                return await self._threads.run(lambda: write(robot_graph(found, place), form))

        return Representation(found, render, robot_tag(found), weak=True)

    @endpoint(
        "GET",
        f"{BASE_PATH}/{{robot}}/people",
        tag="robots",
        summary="The users at a robot, and the quality of its link",
        returns="the users",
    )
    async def people(self, request: ApiRequest, robot: str) -> RobotUsers:
        return await self._summaries.people(request.principal, robot)


NO_NODE = "the robot has no node of this name"


class NodeService:
    """Nodes of robots, as the requesting client may see them.

    :param pool: sessions of the requesting clients
    """

    def __init__(self, pool: InProcessSessionPool) -> None:
        self._pool = pool

    async def members(self, caller: RobotCaller, listing: PageQuery) -> dict[str, Any]:
        """A page of the nodes; they have no types.

        :raises NotFound: no such robot, or no right on it
        """
        async with self._pool.at(caller) as pooled:
            visible = visible_graph(pooled.client)
            page, after = listing.page(dict.fromkeys(visible.nodes), lambda each: ())
            return {
                "nodes": _node_infos([name for name, _ in page], visible),
                "next": after,
                "online": pooled.client.robot.control_link is not None,
            }

    async def node(self, caller: RobotCaller, name: str) -> dict[str, Any]:
        """One node.

        :param name: with or without its first slash
        :raises NotFound: no such robot or node, or no right on the robot
        :raises Unavailable: the robot is offline
        """
        async with self._pool.at(caller) as pooled:
            visible, node = visible_graph(pooled.client), absolute(name)
            if node not in visible.nodes:
                require_online(pooled.client)
                raise NotFound(NO_NODE)
            return _node_infos([node], visible)[0]


def _node_infos(nodes: list[str], visible: VisibleGraph) -> list[dict[str, Any]]:
    return [{"name": node, **work._asdict()} for node, work in node_details_of(nodes, visible).items()]


class NodeEndpoints:
    """Nodes of robots.

    :param service: converts other forms than JSON
    """

    def __init__(self, nodes: NodeService, service: RobotResourceService) -> None:
        self._nodes = nodes
        self._service = service

    @page_endpoint("nodes")
    async def members(self, request: ApiRequest, robot: str, query: PageQuery) -> Representation[NodePage]:
        found = await self._nodes.members(caller_at(request, robot), query)
        return representations.page(self._service, request, robot, "nodes", found)

    @member_endpoint("nodes", "A node, with the parts that the caller may see")
    async def one(self, request: ApiRequest, robot: str, name: str) -> Representation[NodeInfo]:
        found = await self._nodes.node(caller_at(request, robot), name)
        return representations.facts(self._service, request, robot, found, node_graph)


ListCameras = Callable[[Principal, str], Awaitable[list[dict[str, Any]]]]
"""Returns the cameras of a robot that a principal may view."""

_ADDRESSES = {"snapshot": "snapshot", "stream": "stream", "viewer": "stream_viewer", "websocket": "ws"}
"""The kinds of a camera's addresses, and the last segments of these."""


class CameraService:
    """Lists and describes cameras.

    :param list_cameras: returns the cameras of a robot
    """

    def __init__(self, list_cameras: ListCameras) -> None:
        self._list_cameras = list_cameras

    async def members(self, caller: RobotCaller, listing: TypedPageQuery) -> dict[str, Any]:
        """A page of the cameras that the client may view.

        :raises NotFound: no such robot, or no right on it
        """
        there = {each["name"]: each for each in await self._list_cameras(caller.principal, caller.robot)}
        page, after = listing.page(there, lambda each: [each["type"]])
        return {"cameras": [each for _, each in page], "next": after}

    async def camera(self, caller: RobotCaller, name: str) -> dict[str, Any]:
        """A camera with the addresses of its streams.

        :raises NotFound: no such robot or camera, or no right to view it, with the same message
        """
        camera = resolve(name)
        for each in await self._list_cameras(caller.principal, caller.robot):
            if each["name"] == camera:
                return {**each, "addresses": addresses(caller.robot, camera)}
        raise NotFound(NO_CAMERA)


def addresses(robot: str, camera: str) -> dict[str, str]:
    """The addresses of a camera's streams, as paths on the relay."""
    place, topic = f"/robots/{quote(robot, safe='')}/video", quote(camera, safe="")
    return {kind: f"{place}/{end}?topic={topic}" for kind, end in _ADDRESSES.items()}


class CameraPage(TypedDict):
    """A page of cameras.

    :param next: ``after`` of the next page, or empty
    """

    cameras: list[CameraInfo]
    next: str


class CameraEndpoints:
    """Cameras of robots.

    :param service: converts other forms than JSON
    """

    def __init__(self, cameras: CameraService, service: RobotResourceService) -> None:
        self._cameras = cameras
        self._service = service

    @page_endpoint("cameras")
    async def members(
        self, request: ApiRequest, robot: str, query: TypedPageQuery
    ) -> Representation[CameraPage]:
        found = await self._cameras.members(caller_at(request, robot), query)
        return representations.page(self._service, request, robot, "cameras", found)

    @member_endpoint("cameras", "A camera with the paths of its images")
    async def one(self, request: ApiRequest, robot: str, name: str) -> Representation[AddressedCamera]:
        found = await self._cameras.camera(caller_at(request, robot), name)
        return representations.facts(self._service, request, robot, found, camera_graph)
