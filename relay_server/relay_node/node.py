"""The relay as a node of every robot's graph: its own services and topics."""

from __future__ import annotations

import time
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec

from relay_protocol import link
from relay_protocol.rights import Operation
from relay_server.control import view
from relay_server.control.service import ControlService
from relay_server.modules.service import ModuleService
from relay_server.relay_node import control, modules, rosapi
from relay_server.robots.link_quality import joined, milliseconds
from relay_server.sessions.context import ClientContext, StartOwnGoal
from relay_server.sessions.presence import PresenceReader, PresenceService, client_rows, visible_clients
from relay_server.sessions.rosbridge_port import slow_connection_advice
from relay_server.video.stream import CameraStream
from relay_server.video.streams import CameraStreams

CONTROL = "/relay/control"


async def ping(client: ClientContext, args: Any) -> dict[str, Any]:
    """``/relay/ping``: answered at once, or with ``{"robot": true}`` after a round trip to the robot."""
    robot_rtt = client.robot.rtt
    if isinstance(args, dict) and args.get("robot"):
        robot_rtt = await client.channel.requests.round_trip()
    return {"relay_time_ns": time.time_ns(), "robot_rtt_ms": milliseconds(robot_rtt)}


class RelayNode:
    """Finds the relay's own services and topics by name.

    :param clients: all clients of a robot, by its id
    :param videos: all streams of cameras
    :param people: who uses which robot
    """

    def __init__(
        self,
        clients: Callable[[int], list[ClientContext]],
        videos: CameraStreams,
        people: PresenceService,
        control_service: ControlService,
        module_service: ModuleService,
    ) -> None:
        own_modules = modules.ModuleRosServices(module_service)
        self._clients = clients
        self._videos = videos
        self._people = people
        self._services: dict[str, Callable[[ClientContext, Any], Coroutine[Any, Any, Any]]] = {
            "/relay/ping": ping,
            **control.ControlRosServices(control_service).handlers(),
            **own_modules.handlers(),
            **rosapi.SERVICES,
        }
        self._actions: dict[str, StartOwnGoal] = {}
        self._topics: dict[str, Callable[[ClientContext], dict[str, Any]]] = {
            "/relay/status": self.status,
            CONTROL: control.control_state,
            **own_modules.topics(),
        }

    def service(self, name: str) -> Callable[[ClientContext, Any], Coroutine[Any, Any, Any]] | None:
        """The handler of a service the relay itself offers."""
        return self._services.get(name)

    def add_services(
        self, handlers: dict[str, Callable[[ClientContext, Any], Coroutine[Any, Any, Any]]]
    ) -> None:
        """Add services of a feature that itself needs sessions."""
        self._services.update(handlers)

    def action(self, name: str) -> StartOwnGoal | None:
        """The function that begins goals of an action that the relay itself offers."""
        return self._actions.get(name)

    def add_actions(self, handlers: dict[str, StartOwnGoal]) -> None:
        """Add actions of a feature that itself needs sessions."""
        self._actions.update(handlers)

    def topic(self, name: str) -> Callable[[ClientContext], dict[str, Any]] | None:
        """The function that makes the messages of a topic that the relay itself publishes."""
        return self._topics.get(name)

    def pushed(self, name: str) -> bool:
        """Whether a topic is published when it changes, and not once a second."""
        return name == CONTROL

    def status(self, client: ClientContext) -> dict[str, Any]:
        """``/relay/status``: clients, quality of links, dropped samples and more, as this client may see it."""
        robot = client.robot
        rules = client.permit.rules
        near, far = client.link_quality(), robot.link_quality()
        standing = client.controller.snapshot
        people, more = self._people.users(robot, PresenceReader(client.name, rules, client.number))
        return {
            "robot": robot.name,
            "state": robot.state.value,
            "level": str(rules.level or ""),
            "clients": visible_clients(client_rows(robot, self._clients(robot.robot_id)), rules),
            "rtt_ms": {"client_relay": milliseconds(client.rtt), "relay_robot": milliseconds(robot.rtt)},
            "links": {
                "client_relay": near.summary(),
                "relay_robot": far.summary(),
                "client_robot": joined(near, far).summary(),
            },
            "people": people,
            "more": more,
            "drops": client.drops,
            "topic_drops": [
                {"topic": topic, "drops": drops} for topic, drops in client.port.drops_by_topic.items()
            ],
            "lost": [
                {"topic": topic, "reason": reason, "count": count}
                for topic, reason, count in client.channel.subscriptions.losses(client)
            ],
            "publish_drops": [
                {"topic": topic, "drops": drops}
                for topic, drops in client.channel.publications.dropped(client)
            ],
            "downlink": _downlink(client),
            "plain_instead": client.plain_instead,
            "refusals": client.refusals,
            "stale_commands": client.stale_commands,
            "unmatched": [
                {"topic": topic, "nodes": nodes}
                for part in (client.channel.subscriptions, client.channel.publications)
                for topic, nodes in part.unmatched(client)
            ],
            "uplink": self._uplink(client),
            "video": [
                _shown(stream)
                for stream in self._videos.streams_of(robot)
                if client.permit.decide(Operation.VIEW, stream.camera).allowed
            ],
            "motion": msgspec.structs.asdict(robot.description.motion),
            "health": msgspec.structs.asdict(robot.health),
            "control": {
                "state": view.state(standing),
                "holder": view.holder(standing) or "",
                "you": standing.lease.held_by(client),
                **view.visible_overrides(view.overrides(robot), rules),
            },
            "stopped": standing.stopped is not None,
        }

    def _uplink(self, client: ClientContext) -> dict[str, Any]:
        ends = client.channel.own_endpoints()
        return {
            "state": client.channel.state.value,
            "subscribed": len(ends.subscribes),
            "published": len(ends.publishes),
            "sim_time": client.robot.description.sim_time,
        }


def _downlink(client: ClientContext) -> dict[str, Any]:
    rate = client.port.rate
    return {
        "thin": rate is not None,
        "bytes_per_second": None if rate is None else round(rate),
        "waiting_bytes": client.port.waiting_bytes,
        "advice": "" if rate is None else slow_connection_advice(rate),
    }


def _shown(stream: CameraStream) -> dict[str, Any]:
    status = stream.status or link.StreamStatus(width=0, height=0, quality=stream.settings.quality)
    return {
        "camera": stream.camera,
        "codec": stream.settings.codec,
        "state": stream.state.value,
        "viewers": len(stream.viewers),
        "width": status.width,
        "height": status.height,
        "quality": status.quality,
        "fps": status.fps,
        "reduced": status.reduced,
        "delay_ms": status.delay_ms,
        "damaged": status.damaged,
    }
