"""The relay's HTTP site as a whole: all that is served on its port, behind one count of connections."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import relay_server
from relay_server.config import Settings
from relay_server.edges.api import Api
from relay_server.edges.caps import AddressCap
from relay_server.edges.documents import Documents
from relay_server.edges.handshake import Handshake
from relay_server.edges.limiting import RequestLimits
from relay_server.edges.oauth import resource
from relay_server.edges.pages import PageFactory, PageGate
from relay_server.edges.site import RelaySite, Robots, Root
from relay_server.edges.static_files import Portal
from relay_server.edges.video import Video, VideoFactory
from relay_server.edges.websocket import ClientFactory
from relay_server.frontdesk import FrontDesk
from relay_server.oauth import OAuthDesk
from relay_server.rounds import Rounds


def site_of(
    reactor: Any,
    clock_ns: Callable[[], int],
    desk: FrontDesk,
    api: Api,
    oauth: OAuthDesk,
    pages: PageGate,
    settings: Settings,
    limits: RequestLimits,
    cookie: str,
) -> RelaySite:
    """The site.

    :param clock_ns: monotonic nanoseconds
    :param limits: how many requests there may be, those to the API among them
    :param cookie: name of the session cookie
    """
    cap, rounds = AddressCap(settings.connections_per_address), Rounds(reactor)
    clients = Handshake(ClientFactory(reactor, clock_ns, desk, cap, limits, settings.largest_message))
    pictures = Handshake(VideoFactory(reactor, clock_ns, desk, cap, rounds, limits))
    told = Handshake(PageFactory(reactor, clock_ns, pages, cap, limits))
    video = Video(reactor, rounds, desk, api.principal, pictures)
    robots = Robots(clients, video, relay_server.VERSION)
    documents = Documents(limits, relay_server.VERSION, cookie).app.resource()
    portal = Portal(relay_server.PORTAL)
    root = Root(robots, api.app.resource(), resource(oauth, limits), portal, told, documents)
    return RelaySite(root, reactor, cap, settings.tls, limits)
