"""The relay's HTTP site as a whole: all that is served on its port, behind one count of connections."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import relay_server
from relay_server.common.timers import PeriodicTimers
from relay_server.config import RelaySettings
from relay_server.http.api import Api
from relay_server.http.connection_limits import ConnectionLimits
from relay_server.http.openapi.http import ApiDocuments
from relay_server.http.rate_limits import RequestLimits
from relay_server.http.site import RelaySite, RobotAddress, Root
from relay_server.http.static_files import Portal
from relay_server.oauth.http import resource
from relay_server.oauth.service import OAuthService
from relay_server.sessions.manager import SessionManager
from relay_server.video.http import VideoResource
from relay_server.video.websocket import VideoFactory
from relay_server.ws.client import ClientFactory
from relay_server.ws.updates import UpdatesFactory, UpdatesGate
from relay_server.ws.upgrade import WebSocketUpgrade


def build_site(
    reactor: Any,
    clock_ns: Callable[[], int],
    desk: SessionManager,
    api: Api,
    oauth: OAuthService,
    pages: UpdatesGate,
    settings: RelaySettings,
    limits: RequestLimits,
    cookie: str,
) -> RelaySite:
    """The site.

    :param clock_ns: monotonic nanoseconds
    :param limits: how many requests there may be, those to the API among them
    :param cookie: name of the session cookie
    """
    cap, rounds = ConnectionLimits(settings.connections_per_address), PeriodicTimers(reactor)
    clients = WebSocketUpgrade(ClientFactory(reactor, clock_ns, desk, cap, limits, settings.largest_message))
    pictures = WebSocketUpgrade(VideoFactory(reactor, clock_ns, desk, cap, rounds, limits))
    told = WebSocketUpgrade(UpdatesFactory(reactor, clock_ns, pages, cap, limits))
    video = VideoResource(reactor, rounds, desk, api.principal, pictures)
    robots = RobotAddress(clients, video, relay_server.VERSION)
    documents = ApiDocuments(limits, relay_server.VERSION, cookie).app.resource()
    portal = Portal(relay_server.PORTAL)
    root = Root(robots, api.app.resource(), resource(oauth, limits), portal, told, documents)
    return RelaySite(root, reactor, cap, settings.tls, limits)
