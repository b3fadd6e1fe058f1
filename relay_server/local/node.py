"""The relay as a node of every robot's graph: its own services and topics."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec

from relay_protocol import link
from relay_protocol.rights import Operation
from relay_server.local import rosapi
from relay_server.session import Session
from relay_server.video import Stream, Videos


async def ping(session: Session, args: Any) -> dict[str, Any]:
    """``/relay/ping``: answered at once, or with ``{"robot": true}`` after a round trip to the robot."""
    robot_rtt = session.robot.rtt
    if isinstance(args, dict) and args.get("robot"):
        robot_rtt = await session.channel.asking.round_trip()
    return {"relay_time_ns": time.time_ns(), "robot_rtt_ms": milliseconds(robot_rtt)}


def milliseconds(seconds: float | None) -> float | None:
    """Seconds as milliseconds with two decimals; ``None`` stays."""
    return None if seconds is None else round(seconds * 1000, 2)


class RelayNode:
    """Finds the relay's own services and topics by name.

    :param sessions: all sessions of a robot, by its id
    :param videos: all streams of cameras
    """

    def __init__(self, sessions: Callable[[int], list[Session]], videos: Videos) -> None:
        self._sessions = sessions
        self._videos = videos
        self._services: dict[str, Callable[[Session, Any], Awaitable[Any]]] = {
            "/relay/ping": ping,
            **rosapi.SERVICES,
        }
        self._topics: dict[str, Callable[[Session], dict[str, Any]]] = {"/relay/status": self.status}

    def service(self, name: str) -> Callable[[Session, Any], Awaitable[Any]] | None:
        """The handler of a service the relay itself offers."""
        return self._services.get(name)

    def topic(self, name: str) -> Callable[[Session], dict[str, Any]] | None:
        """What makes the messages of a topic the relay itself publishes."""
        return self._topics.get(name)

    def status(self, session: Session) -> dict[str, Any]:
        """``/relay/status``: who is here, how well the links do, what was dropped, for the one who asks."""
        robot = session.robot
        rules = session.permit.rules
        return {
            "robot": robot.name,
            "state": robot.state.value,
            "level": str(rules.level or ""),
            "clients": [{"user": each.name, "since": each.since} for each in self._sessions(robot.robot_id)],
            "rtt_ms": {"client_relay": milliseconds(session.rtt), "relay_robot": milliseconds(robot.rtt)},
            "drops": session.outbox.dropped,
            "topic_drops": [
                {"topic": topic, "drops": drops} for topic, drops in session.listening.drops().items()
            ],
            "plain_instead": session.plain_instead,
            "refusals": session.refusals,
            "stale_commands": session.stale_commands,
            "uplink": self._uplink(session),
            "video": [
                _shown(stream)
                for stream in self._videos.of(robot)
                if session.permit.judge(Operation.VIEW, stream.camera).allowed
            ],
            "motion": msgspec.structs.asdict(robot.description.motion),
            "health": msgspec.structs.asdict(robot.health),
        }

    def _uplink(self, session: Session) -> dict[str, Any]:
        ends = session.channel.ends()
        return {
            "state": session.channel.state.value,
            "subscribed": len(ends.subscribes),
            "published": len(ends.publishes),
            "sim_time": session.robot.description.sim_time,
        }


def _shown(stream: Stream) -> dict[str, Any]:
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
