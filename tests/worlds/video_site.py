"""A relay's site on a real port, with real services behind it; the test plays the robot."""

from __future__ import annotations

import email.parser
import itertools
import json
import socket
import ssl
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from twisted.internet import reactor, task
from twisted.internet.task import LoopingCall
from twisted.internet.threads import deferToThread

from relay_db import queries
from relay_protocol import link
from relay_protocol.frames import VideoFrame
from relay_server.access import Access
from relay_server.auth import passwords
from relay_server.auth.authenticator import Authenticator
from relay_server.auth.origins import Origins
from relay_server.auth.service import AuthService
from relay_server.auth.url_tokens import UrlTokens
from relay_server.channels.channel import Channels
from relay_server.cluster.homes import SingleHome
from relay_server.common.clock import PeriodicTimers
from relay_server.common.database import AsyncDatabase
from relay_server.common.freshness_tokens import FreshnessTokens
from relay_server.control.controllers import Controllers
from relay_server.control.service import ControlService
from relay_server.control.types import ControlRules
from relay_server.events.bus import BusEvent, EventBus
from relay_server.http.cross_origin import CrossOrigin
from relay_server.http.limits import ConnectionLimits, RequestLimits
from relay_server.http.site import Missing, RelaySite, RobotAddress, Root
from relay_server.listeners import ServerTls
from relay_server.modules.report_store import ModuleReportStore
from relay_server.modules.robot_modules import ModuleRegistry
from relay_server.modules.service import ModuleService
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.manager import SessionManager
from relay_server.sessions.ports import Timing
from relay_server.video.http import VideoResource
from relay_server.video.stream import CameraStream
from relay_server.video.streams import CameraStreams
from relay_server.video.websocket import VideoFactory
from relay_server.ws.connection import ClientFactory
from relay_server.ws.handshake import WebSocketUpgrade
from tests.worlds.control_audit import MemoryRecord
from tests.worlds.http_client import router_of
from tests.worlds.relay import MemoryLink
from tests.worlds.waiting import PATIENCE

HOST = "127.0.0.1:9090"
CAMERA = "/camera/image"
SECRET = "/secret/image"
PAGE = "https://pages.example"
"""A listed origin."""
STREAM = f"/robots/rover/video/stream?topic={CAMERA}"
SNAPSHOT = f"/robots/rover/video/snapshot?topic={CAMERA}"
CAMERAS = "/robots/rover/video/cameras"


def png() -> bytes:
    """The same as PNG."""
    return cv2.imencode(".png", np.zeros((24, 32, 3), np.uint8))[1].tobytes()


def jpeg(size: int = 0) -> bytes:
    """A black image of 32×24, extended by comments to at least this many bytes."""
    picture = cv2.imencode(".jpg", np.zeros((24, 32, 3), np.uint8))[1].tobytes()
    comments = b""
    while len(picture) + len(comments) < size:
        comments += b"\xff\xfe\x80\x00" + bytes(0x7FFE)
    return picture[:2] + comments + picture[2:]


class Show:
    """A robot with the cameras ``CAMERA`` and ``SECRET``; ann may view the first.

    :param tls: listen by TLS
    """

    def __init__(self, store: AsyncDatabase, tls: ServerTls | None = None) -> None:
        self.store = store
        clock: Any = reactor
        self.registry = RobotRegistry(time.time)
        self.access = Access(store, time.time)
        self.auth = Authenticator(clock, store, time.monotonic, time.time)
        self.videos = CameraStreams(clock, new_ticket=passwords.new_token)
        channels = Channels(clock, linger=5.0, new_ticket=passwords.new_token, wall_ns=time.time_ns)
        origins = Origins("http", [PAGE])
        self.bus = EventBus()
        self.published: list[BusEvent] = []
        self.bus.subscribe(self.published.append)
        url_tokens = UrlTokens(store, lambda: self.access.refreshed, time.monotonic, time.time)
        self.logins = AuthService(clock, store, self.auth, self.access, self.bus, origins, "sb", url_tokens)
        modules = ModuleRegistry(clock, time.time)
        self.service = SessionManager(
            clock,
            store,
            self.access,
            self.registry,
            channels,
            self.videos,
            ControlService(
                clock,
                Controllers(
                    clock, MemoryRecord(), MemoryRecord(), ControlRules(), self.registry.changed, time.time
                ),
            ),
            ModuleService(
                modules,
                self.registry,
                store,
                self.bus,
                time.time,
                ModuleReportStore(clock, store, modules),
                SingleHome(),
            ),
            self.bus,
            Timing(2.0, 0.1, 5.0),
            clock_ns=time.monotonic_ns,
            wall=time.time,
        )
        router = router_of(clock, self.service, origins, FreshnessTokens(lambda: 1), auth=self.logins)
        cap, rounds = ConnectionLimits(100), PeriodicTimers(clock)
        limits = self.limits = RequestLimits(0.0, time.monotonic)
        self.connections = cap
        websocket = WebSocketUpgrade(
            ClientFactory(clock, time.monotonic_ns, self.logins, self.service, cap, limits)
        )
        pictures = WebSocketUpgrade(
            VideoFactory(clock, time.monotonic_ns, self.logins, self.service, cap, rounds, limits)
        )
        video = VideoResource(
            clock, rounds, self.logins, self.service, router.authenticator.principal, pictures
        )
        robots = RobotAddress(websocket, video, "1.2.3")
        root = Root(robots, router, Missing(), Missing())
        site = RelaySite(root, clock, cap, tls is not None, limits, cross_origin=CrossOrigin(origins))
        self._listening = (
            clock.listenTCP(0, site, interface="127.0.0.1")
            if tls is None
            else clock.listenSSL(0, site, tls, interface="127.0.0.1")
        )
        self.port: int = self._listening.getHost().port
        self.numbers = itertools.count(1)
        self._filming: list[LoopingCall] = []
        self._people()

    def _people(self) -> None:
        with self.store.database.begin() as session:
            self.ann = queries.add_user(session, "ann", None)
            self.rover = queries.add_robot(session, "rover")
            queries.add_robot(session, "hidden")
            queries.grant_right(
                session, self.rover.id, "viewer", user_id=self.ann.id, deny=[f"view:{SECRET}"]
            )
            queries.create_token(
                session,
                self.ann.id,
                passwords.token_hash("ann's"),
                kind="session",
                label="",
                expires=time.time() + 3600,
                now=time.time(),
            )

    async def end(self) -> None:
        for each in self._filming:
            each.stop()
        self.service.shutdown("the test is over")
        self.videos.close()
        await self._listening.stopListening()

    # --- the robot ----------------------------------------------------------------------------------------

    @property
    def robot(self) -> RobotState:
        """The robot as the relay sees it."""
        return self.registry.robot(self.rover.id, "rover", self.rover.realm)

    def robot_comes(self) -> MemoryLink:
        """It registers and reports its cameras."""
        control = MemoryLink()
        self.registry.registered(self.robot, control)
        cameras = [link.Camera(name=CAMERA, width=32, height=24), link.Camera(name=SECRET)]
        self.registry.cameras(self.robot, link.Cameras(cameras=cameras))
        return control

    def makes(self, streams: int) -> None:
        """The robot reports its limit of streams."""
        self.registry.cameras(self.robot, link.Cameras(cameras=list(self.robot.cameras), streams=streams))

    async def joined(self, control: MemoryLink) -> CameraStream:
        """The requested stream, once the robot has joined it."""
        (asked,) = await until(lambda: control.take(link.OpenVideo))
        stream = self.videos.redeem(asked.ticket)
        assert stream is not None
        stream.joined(MemoryLink())
        stream.message_received(link.StreamStatus(width=32, height=24, quality=80))
        return stream

    def shows(self, stream: CameraStream, body: bytes, stamp: float = 1000.5) -> int:
        """Sends one frame; returns its number."""
        number = next(self.numbers)
        stream.frame_received(VideoFrame(number=number, stamp=round(stamp * 1e9), body=body))
        return number

    def films(self, stream: CameraStream, body: bytes, fps: float = 20.0) -> None:
        """Sends frames from now on, stamped with the monotonic clock."""
        filming = LoopingCall(lambda: self.shows(stream, body, time.monotonic()))
        filming.start(1 / fps)
        self._filming.append(filming)

    async def deny(self, *cameras: str) -> None:
        """From now on ann may not view these."""
        patterns = [f"view:{camera}" for camera in (SECRET, *cameras)]
        await self.store.write(
            queries.grant_right, self.rover.id, "viewer", user_id=self.ann.id, deny=patterns
        )
        await self.access.refresh()

    # --- users --------------------------------------------------------------------------------------------

    def request(self, *arguments: Any, **headers: str) -> RawClient:
        """A client with a request by HTTP."""
        return RawClient(self.port, *arguments, **headers)

    def events(self, kind: str) -> list[BusEvent]:
        """Events of a kind that were published so far."""
        return [each for each in self.published if each.kind == kind]


async def until(condition: Callable[[], Any], seconds: float = PATIENCE) -> Any:
    """The value of ``condition`` once it is true."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "it has not happened in time"
        await task.deferLater(reactor, 0.01)  # type: ignore[arg-type]
    return found


class RawClient:
    """A client on a real socket, whose blocking calls run in a thread.

    :param window: bytes its kernel accepts unread, 0 for the default
    :param tls: over TLS; any certificate is accepted
    """

    def __init__(
        self,
        port: int,
        path: str,
        method: str = "GET",
        *,
        window: int = 0,
        tls: bool = False,
        **headers: str,
    ) -> None:
        self.socket = socket.socket()
        if window:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, window)
            # On loopback a segment has 64 KiB, and the kernel never asks for less.
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, 1400)
        self.socket.settimeout(PATIENCE)
        self.socket.connect(("127.0.0.1", port))
        self._data = b""
        self._request = (path, method, headers)
        if not tls:
            self.asks(path, method, **headers)

    async def asks_by_tls(self) -> None:
        """The handshake, which uses the reactor's turns as well, and then the request."""
        context = ssl._create_unverified_context()
        self.socket = await deferToThread(context.wrap_socket, self.socket)
        path, method, headers = self._request
        self.asks(path, method, **headers)

    def asks(self, path: str, method: str = "GET", **headers: str) -> None:
        """A request, with ann's token unless another ``Authorization`` (or none, ``""``) is given."""
        lines = {"Host": HOST, "Authorization": "Bearer ann's"}
        lines |= {name.replace("_", "-"): value for name, value in headers.items()}
        head = "".join(f"{name}: {value}\r\n" for name, value in lines.items() if value)
        self.socket.sendall(f"{method} {path} HTTP/1.1\r\n{head}\r\n".encode())

    async def head(self) -> tuple[int, Any]:
        """Status and headers of the answer."""
        return await deferToThread(self._head)

    async def answer(self) -> tuple[int, Any, bytes]:
        """Status, headers and the complete body."""
        status, headers = await self.head()
        body = await deferToThread(self._take, int(headers.get("content-length", 0)))
        return status, headers, body

    async def problem(self) -> tuple[int, str]:
        """Status and text of an error."""
        status, headers, body = await self.answer()
        assert headers["content-type"] == "application/problem+json"
        return status, json.loads(body)["detail"]

    async def part(self) -> tuple[Any, bytes]:
        """The next part of a stream: its headers, and its body by its length."""
        return await deferToThread(self._part)

    async def slowly(self, rate: float, seconds: float) -> bytes:
        """Reads this many bytes per second for this time."""
        return await deferToThread(self._slowly, rate, seconds)

    async def closed(self) -> bool:
        """Reads to the end; returns whether it is a regular one, not a reset."""
        return await deferToThread(self._closed)

    def leave(self) -> None:
        self.socket.close()

    def _head(self) -> tuple[int, Any]:
        first, _, rest = self._until(b"\r\n\r\n").partition(b"\r\n")
        return int(first.split()[1]), email.parser.BytesParser().parsebytes(rest)

    def _part(self) -> tuple[Any, bytes]:
        if not self._data.startswith(b"--boundarydonotcross\r\n"):
            assert self._until(b"--boundarydonotcross\r\n").strip() == b""
        else:
            self._data = self._data.partition(b"\r\n")[2]
        headers = email.parser.BytesParser().parsebytes(self._until(b"\r\n\r\n"))
        return headers, self._take(int(headers["content-length"]))

    def _slowly(self, rate: float, seconds: float) -> bytes:
        began = time.monotonic()
        data, self._data = self._data, b""
        while (gone := time.monotonic() - began) < seconds:
            if len(data) < rate * gone:
                data += self.socket.recv(min(2048, int(rate * gone) - len(data) + 1))
            else:
                time.sleep(0.01)  # a slow reader
        return data

    def _closed(self) -> bool:
        try:
            while self.socket.recv(65536):
                pass
        except ConnectionResetError:
            return False
        return True

    def _until(self, mark: bytes) -> bytes:
        while mark not in self._data:
            self._more()
        found, _, self._data = self._data.partition(mark)
        return found

    def _take(self, count: int) -> bytes:
        while len(self._data) < count:
            self._more()
        found, self._data = self._data[:count], self._data[count:]
        return found

    def _more(self) -> None:
        data = self.socket.recv(65536)
        assert data, f"the connection ended after {self._data!r}"
        self._data += data
