"""The relay as a node of every robot's graph: its own services and topics."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec

from relay_protocol import link
from relay_protocol.rights import Operation
from relay_server.control import view
from relay_server.relay_node import control, rosapi
from relay_server.robots.link_quality import joined, milliseconds
from relay_server.sessions.presence import PresenceReader, PresenceService, client_rows
from relay_server.sessions.session import Session, thin_words
from relay_server.video.stream import CameraStream
from relay_server.video.streams import CameraStreams

CONTROL = "/relay/control"


async def ping(session: Session, args: Any) -> dict[str, Any]:
    """``/relay/ping``: answered at once, or with ``{"robot": true}`` after a round trip to the robot."""
    robot_rtt = session.robot.rtt
    if isinstance(args, dict) and args.get("robot"):
        robot_rtt = await session.channel.asking.round_trip()
    return {"relay_time_ns": time.time_ns(), "robot_rtt_ms": milliseconds(robot_rtt)}


class RelayNode:
    """Finds the relay's own services and topics by name.

    :param sessions: all sessions of a robot, by its id
    :param videos: all streams of cameras
    :param people: who is at which robot
    """

    def __init__(
        self, sessions: Callable[[int], list[Session]], videos: CameraStreams, people: PresenceService
    ) -> None:
        self._sessions = sessions
        self._videos = videos
        self._people = people
        self._services: dict[str, Callable[[Session, Any], Awaitable[Any]]] = {
            "/relay/ping": ping,
            **control.SERVICES,
            **rosapi.SERVICES,
        }
        self._topics: dict[str, Callable[[Session], dict[str, Any]]] = {
            "/relay/status": self.status,
            CONTROL: control.told,
        }

    def service(self, name: str) -> Callable[[Session, Any], Awaitable[Any]] | None:
        """The handler of a service the relay itself offers."""
        return self._services.get(name)

    def topic(self, name: str) -> Callable[[Session], dict[str, Any]] | None:
        """What makes the messages of a topic the relay itself publishes."""
        return self._topics.get(name)

    def pushed(self, name: str) -> bool:
        """Whether a topic is published when it changes, and not once a second."""
        return name == CONTROL

    def status(self, session: Session) -> dict[str, Any]:
        """``/relay/status``: who is here, how well the links do, what was dropped, for the one who asks."""
        robot = session.robot
        rules = session.permit.rules
        near, far = session.reading(), robot.reading()
        standing = session.desk.standing
        people, more = self._people.told(robot, PresenceReader(session.name, rules, session.number))
        return {
            "robot": robot.name,
            "state": robot.state.value,
            "level": str(rules.level or ""),
            "clients": client_rows(robot, self._sessions(robot.robot_id), rules),
            "rtt_ms": {"client_relay": milliseconds(session.rtt), "relay_robot": milliseconds(robot.rtt)},
            "links": {
                "client_relay": near.told(),
                "relay_robot": far.told(),
                "client_robot": joined(near, far).told(),
            },
            "people": people,
            "more": more,
            "drops": session.outbox.dropped,
            "topic_drops": [
                {"topic": topic, "drops": drops} for topic, drops in session.listening.drops().items()
            ],
            "lost": [
                {"topic": topic, "reason": reason, "count": count}
                for topic, lost in session.listening.lost().items()
                for reason, count in lost.items()
                if count
            ],
            "downlink": _downlink(session),
            "plain_instead": session.plain_instead,
            "refusals": session.refusals,
            "stale_commands": session.stale_commands,
            "unmatched": [
                {"topic": topic, "nodes": nodes}
                for part in (session.channel.subscriptions, session.channel.publications)
                for topic, nodes in part.unmatched(session)
            ],
            "uplink": self._uplink(session),
            "video": [
                _shown(stream)
                for stream in self._videos.of(robot)
                if session.permit.judge(Operation.VIEW, stream.camera).allowed
            ],
            "motion": msgspec.structs.asdict(robot.description.motion),
            "health": msgspec.structs.asdict(robot.health),
            "control": {
                "state": view.state(standing),
                "holder": view.holder(standing) or "",
                "you": standing.lease.held_by(session),
                **view.overrides(robot, session.permit.rules),
            },
            "stopped": standing.stopped is not None,
        }

    def _uplink(self, session: Session) -> dict[str, Any]:
        ends = session.channel.ends()
        return {
            "state": session.channel.state.value,
            "subscribed": len(ends.subscribes),
            "published": len(ends.publishes),
            "sim_time": session.robot.description.sim_time,
        }


def _downlink(session: Session) -> dict[str, Any]:
    rate = session.outbox.rate
    return {
        "thin": rate is not None,
        "bytes_per_second": None if rate is None else round(rate),
        "waiting_bytes": session.outbox.waiting_bytes,
        "advice": "" if rate is None else thin_words(rate),
    }


def _shown(stream: CameraStream) -> dict[str, Any]:
    told = stream.told or link.Playing(width=0, height=0, quality=stream.settings.quality)
    return {
        "camera": stream.camera,
        "codec": stream.settings.codec,
        "state": stream.state.value,
        "viewers": len(stream.viewers),
        "width": told.width,
        "height": told.height,
        "quality": told.quality,
        "fps": told.fps,
        "reduced": told.reduced,
        "delay_ms": told.delay_ms,
    }
