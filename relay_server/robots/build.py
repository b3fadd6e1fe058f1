"""Builds the factory of robots' connections."""

from __future__ import annotations

import time
from functools import partial

from relay_protocol.clocks import now_ns
from relay_server.common.socket_writer import FlushScheduler
from relay_server.core import Core
from relay_server.http.limits import ConnectionLimits
from relay_server.robots.connection import LinkTiming, RobotConnection, RobotFactory
from relay_server.robots.link_handlers import FunctionLinkHandlers, HandshakeHandler, RobotLinkContext


def build_robot_factory(core: Core, functions: FunctionLinkHandlers) -> RobotFactory:
    """The factory of robots' connections, with everything that their handlers need.

    :param functions: makes the handler of a function link
    """
    context = RobotLinkContext(
        relay=core.name,
        database=core.database,
        robots=core.robots,
        channels=core.channels,
        cameras=core.cameras,
        controllers=core.controllers,
        modules=core.modules,
        files=core.files.links,
        functions=functions,
        homes=core.homes,
        draining=lambda: core.draining,
        bus=core.bus,
        seconds=time.monotonic,
        wall=time.time,
    )
    limits = ConnectionLimits(core.settings.connections)
    timing = LinkTiming(core.settings.heartbeat, core.settings.largest_sample)
    flushes = FlushScheduler(core.reactor)

    def build() -> RobotConnection:
        return RobotConnection(
            core.reactor, now_ns, timing, partial(HandshakeHandler, context), limits, flushes
        )

    return RobotFactory(build)
