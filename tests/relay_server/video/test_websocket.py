"""Video over a websocket, on real sockets."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest
import pytest_twisted
from twisted.internet.defer import Deferred
from twisted.internet.task import LoopingCall
from twisted.internet.threads import deferToThread
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from relay_db import queries
from relay_protocol import link
from relay_server.access import Principal
from relay_server.auth.authenticator import TicketPurpose
from relay_server.common import close_codes, websocket_frames
from relay_server.video import streams
from relay_server.video import websocket as module
from relay_server.video.stream import CameraStream
from tests.worlds.video_site import CAMERA, SECRET, STREAM, RawClient, Show, jpeg, until
from tests.worlds.viewers import DELTA, KEY

HANDSHAKE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
}
"""Of a client of the test's own making."""


class ViewerSocket:
    """A viewer's websocket."""

    def __init__(self, end: ClientConnection) -> None:
        self._end = end

    async def picture(self) -> tuple[dict[str, Any], bytes]:
        """The next frame."""
        head = json.loads(await self._next())
        body = await self._next()
        assert (head.pop("op"), head.pop("size")) == ("frame", len(body))
        assert isinstance(body, bytes)
        return head, body

    async def playing(self) -> dict[str, Any]:
        """The next message, a status."""
        reported: dict[str, Any] = json.loads(await self._next())
        assert reported.pop("op") == "stream_status"
        return reported

    async def reported(self) -> dict[str, Any]:
        """The next status, skipping frames."""
        while True:
            message = await self._next()
            if isinstance(message, str) and '"stream_status"' in message:
                reported: dict[str, Any] = json.loads(message)
                return reported

    async def _next(self) -> str | bytes:
        return await deferToThread(self._end.recv, 10)

    async def quiet(self, seconds: float = 0.3) -> bool:
        """Whether no message arrives for this time."""
        try:
            await deferToThread(self._end.recv, seconds)
        except TimeoutError:
            return True
        return False

    async def took(self, number: int) -> None:
        """Acknowledges a frame."""
        await self.says(json.dumps({"op": "frame_ack", "number": number}))

    async def says(self, text: str) -> None:
        """Sends a message."""
        await deferToThread(self._end.send, text)

    async def closed(self) -> tuple[int, str]:
        """Code and reason of the next close frame."""
        try:
            while True:
                await self._next()
        except ConnectionClosed as error:
            assert error.rcvd is not None
            return error.rcvd.code, error.rcvd.reason

    async def leave(self) -> None:
        """Closes it."""
        await deferToThread(self._end.close)


async def opens(show: Show, query: str = "", token: str = "ann's", **options: Any) -> ViewerSocket:
    """Opens a websocket to the camera."""
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    url = f"ws://127.0.0.1:{show.port}/robots/rover/video/ws?topic={CAMERA}{query}"
    return ViewerSocket(
        await deferToThread(connect, url, additional_headers=headers, close_timeout=2, **options)
    )


async def watched(show: Show, query: str = "") -> tuple[ViewerSocket, CameraStream]:
    """An open websocket and its stream, joined by the robot."""
    control = show.robot_comes()
    viewer = await opens(show, query)
    return viewer, await show.joined(control)


@pytest.mark.parametrize(
    ("ticket", "good"),
    [
        (TicketPurpose("rover", video=True, camera=CAMERA), True),
        (TicketPurpose("rover", video=True), True),
        (TicketPurpose("rover", video=True, camera=SECRET), False),
        (TicketPurpose("rover"), False),
        (TicketPurpose("tank", video=True), False),
    ],
)
@pytest_twisted.ensureDeferred
async def test_a_ticket_must_be_for_this_camera(show: Show, ticket: TicketPurpose, good: bool) -> None:
    """A ticket for the robot's own websocket is not."""
    show.robot_comes()
    ann = await show.logins.token("ann's")
    query = f"&ticket={show.auth.issue_ticket(ann, ticket)}"
    if good:
        await (await opens(show, query, token="")).leave()
    else:
        with pytest.raises(InvalidStatus) as refused:
            await opens(show, query, token="")
        assert refused.value.response.status_code == 401
    await until(lambda: not show.access._permits)


@pytest_twisted.ensureDeferred
async def test_a_frame_is_a_header_and_then_the_bytes(show: Show) -> None:
    """A status precedes the first frame and each change."""
    viewer, stream = await watched(show)
    assert (await viewer.playing())["quality"] == 80
    number = show.shows(stream, jpeg())
    head, body = await viewer.picture()
    assert head == {
        "number": number,
        "stamp": 1000.5,
        "width": 32,
        "height": 24,
        "codec": "jpeg",
        "key": True,
    }
    assert body == jpeg()
    stream.message_received(link.StreamStatus(width=16, height=12, quality=40, reduced=0.25, delay_ms=80))
    reported = await viewer.playing()
    assert (reported["width"], reported["reduced"], reported["delay_ms"]) == (16, 0.25, 80)
    await viewer.leave()
    await until(lambda: not show.access._permits)
    assert not stream.viewers


@pytest_twisted.ensureDeferred
async def test_viewer_of_another_format_is_notified_until_it_gets_its_own(show: Show) -> None:
    """The status lists the parameters that differ from the request."""
    control = show.robot_comes()
    show.makes(1)
    first = show.request(f"{STREAM}&width=32")
    stream = await show.joined(control)
    show.shows(stream, jpeg())
    viewer = await opens(show, "&width=64&fps=5")
    assert (await viewer.playing())["instead"] == {"width": 32, "fps": 0.0}
    first.leave()
    await show.joined(control)
    assert (await viewer.reported())["instead"] is None
    await viewer.leave()


@pytest_twisted.ensureDeferred
async def test_the_next_frame_comes_when_the_last_was_taken_and_is_the_newest(show: Show) -> None:
    """Frames in between are dropped; an unexpected number has no effect."""
    viewer, stream = await watched(show)
    await viewer.playing()
    first = show.shows(stream, jpeg())
    assert (await viewer.picture())[0]["number"] == first
    numbers = [show.shows(stream, jpeg()) for _ in range(3)]
    await viewer.took(numbers[-1])
    assert await viewer.quiet()
    await viewer.took(first)
    assert (await viewer.picture())[0]["number"] == numbers[-1]
    await viewer.leave()


@pytest_twisted.ensureDeferred
async def test_of_h264_what_came_meanwhile_follows_at_once(show: Show) -> None:
    """The first frame is a key frame; the next ones are sent when the last one was acknowledged."""
    viewer, stream = await watched(show, "&codec=h264")
    await viewer.playing()
    show.shows(stream, DELTA)
    numbers = [show.shows(stream, body) for body in (KEY, DELTA, DELTA)]
    head, body = await viewer.picture()
    assert (head["number"], head["key"], head["codec"], body) == (numbers[0], True, "h264", KEY)
    await viewer.took(numbers[0])
    assert [(await viewer.picture())[0]["number"] for _ in range(2)] == numbers[1:]
    later = show.shows(stream, DELTA)
    await viewer.took(numbers[1])
    assert await viewer.quiet()
    await viewer.took(numbers[2])
    assert (await viewer.picture())[0]["number"] == later
    await viewer.leave()


@pytest_twisted.ensureDeferred
async def test_viewer_that_reads_no_frame_is_cut(show: Show, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if it answers pings."""
    monkeypatch.setattr(module, "STALL_SECONDS", 0.5)
    monkeypatch.setattr(module, "CHECK_SECONDS", 0.1)
    viewer, stream = await watched(show)
    show.shows(stream, jpeg())
    assert (await viewer.closed())[0] == close_codes.TOO_SLOW
    assert not stream.viewers


@pytest_twisted.ensureDeferred
async def test_slow_reader_of_a_frame_is_not_cut(show: Show, monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as bytes arrive, however late its pongs are behind the frame."""
    monkeypatch.setattr(module, "STALL_SECONDS", 1.5)
    monkeypatch.setattr(module, "CHECK_SECONDS", 0.1)
    control = show.robot_comes()
    client = show.request(f"/robots/rover/video/ws?topic={CAMERA}", window=4096, **HANDSHAKE)
    stream = await show.joined(control)
    await client.head()
    show.shows(stream, jpeg(60_000))
    read = 0
    while read < 40_000:
        read += len(await client.slowly(15_000, 0.5))
    assert stream.viewers
    await until(lambda: not stream.viewers)
    client.leave()


async def stuffed(show: Show) -> tuple[RawClient, CameraStream, int]:
    """A viewer that reads nothing, and the number of a frame larger than the kernel's buffers."""
    control = show.robot_comes()
    client = show.request(f"/robots/rover/video/ws?topic={CAMERA}", window=4096, **HANDSHAKE)
    stream = await show.joined(control)
    await client.head()
    return client, stream, show.shows(stream, jpeg(3_900_000))


@pytest_twisted.ensureDeferred
async def test_viewer_that_acknowledges_without_reading_is_cut(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its messages do not matter while the connection takes no bytes."""
    monkeypatch.setattr(module, "STALL_SECONDS", 0.5)
    monkeypatch.setattr(module, "CHECK_SECONDS", 0.1)
    client, stream, number = await stuffed(show)
    took = json.dumps({"op": "frame_ack", "number": number}).encode()
    talking = LoopingCall(client.socket.sendall, b"\x81" + bytes([0x80 + len(took)]) + bytes(4) + took)
    talking.start(0.2).addErrback(lambda failure: failure.trap(OSError))
    await until(lambda: not stream.viewers)
    if talking.running:
        talking.stop()
    client.leave()


@pytest_twisted.ensureDeferred
async def test_a_revoked_right_ends_a_frame_that_is_under_way(show: Show) -> None:
    """At once: unsent bytes of the frame are discarded, without a close frame."""
    client, stream, _ = await stuffed(show)
    await show.deny(CAMERA)
    assert not stream.viewers
    assert await deferToThread(_bytes_until_reset, client) < 1_000_000
    client.leave()


def _bytes_until_reset(client: RawClient) -> int:
    """Bytes received before the connection is reset."""
    count = 0
    with pytest.raises(ConnectionResetError):
        while data := client.socket.recv(65536):
            count += len(data)
    return count


@pytest_twisted.ensureDeferred
async def test_the_topic_shown_in_a_cameras_stead_is_judged_before_the_handshake(show: Show) -> None:
    """As the camera itself."""
    await show.deny(f"{CAMERA}/compressed")
    with pytest.raises(InvalidStatus) as refused:
        await opens(show, "&default_transport=compressed")
    assert refused.value.response.status_code == 403


@pytest_twisted.ensureDeferred
async def test_a_revoked_right_closes_with_its_code(show: Show) -> None:
    """4403 for a right, 4401 for the session."""
    viewer, _ = await watched(show)
    other = await opens(show)
    await until(lambda: len(show.access._permits) == 2)
    await show.deny(CAMERA)
    assert await viewer.closed() == (close_codes.FORBIDDEN, f"your right to view {CAMERA} was revoked")
    assert (await other.closed())[0] == close_codes.FORBIDDEN
    await show.deny()
    viewer = await opens(show)
    await until(lambda: show.access._permits)
    token = (await show.logins.token("ann's")).token_id
    await show.store.write(queries.revoke_token, token)
    await show.access.refresh()
    assert (await viewer.closed())[0] == close_codes.UNAUTHENTICATED


@pytest.mark.parametrize(
    ("query", "token", "status", "code"),
    [
        ("", "nobody's", 401, close_codes.UNAUTHENTICATED),
        ("&quality=best", "ann's", 400, close_codes.INVALID),
        (f"&topic={SECRET}", "ann's", 400, close_codes.INVALID),
    ],
)
@pytest_twisted.ensureDeferred
async def test_refused_client_gets_a_status_or_a_close_code(
    show: Show, query: str, token: str, status: int, code: int
) -> None:
    """Programs get a status, browsers a close code."""
    with pytest.raises(InvalidStatus) as refused:
        await opens(show, query, token)
    assert refused.value.response.status_code == status
    browser = await opens(show, query, token, origin=f"http://127.0.0.1:{show.port}")
    assert (await browser.closed())[0] == code
    assert not show.access._permits


@pytest_twisted.ensureDeferred
async def test_a_camera_one_may_not_view_is_like_none_here_too(show: Show) -> None:
    """Before the handshake is answered."""
    await show.deny(CAMERA)
    with pytest.raises(InvalidStatus) as refused:
        await opens(show)
    assert refused.value.response.status_code == 403
    browser = await opens(show, origin=f"http://127.0.0.1:{show.port}")
    assert (await browser.closed())[0] == close_codes.NOT_FOUND
    assert not show.access._permits


@pytest_twisted.ensureDeferred
async def test_credentials_may_be_a_subprotocol_or_the_first_message(show: Show) -> None:
    """As on every websocket of the relay."""
    control = show.robot_comes()
    by_protocol = await opens(show, token="", subprotocols=["bearer.ann's"])
    stream = await show.joined(control)
    by_message = await opens(show, token="")
    await by_message.says(json.dumps({"op": "auth", "mac": "ann's"}))
    await until(lambda: len(stream.viewers) == 2)
    await by_protocol.leave()
    await by_message.leave()


@pytest_twisted.ensureDeferred
async def test_nonsense_and_bytes_are_not_for_here(show: Show) -> None:
    """Binary messages close at once, invalid ones after a limit."""
    viewer, stream = await watched(show)
    for _ in range(module.MAX_USELESS_MESSAGES):
        await viewer.says('{"op":"subscribe"}')
    assert (await viewer.closed())[0] == close_codes.TOO_MANY_ERRORS
    viewer = await opens(show)
    await viewer.says(b"\x00")  # type: ignore[arg-type]
    assert (await viewer.closed())[0] == close_codes.FORBIDDEN
    assert not stream.viewers


@pytest_twisted.ensureDeferred
async def test_too_many_false_acknowledgements_cut_the_viewer(show: Show) -> None:
    """In a row; several frames may be acknowledged one by one, though only the last counts."""
    viewer, stream = await watched(show)
    await viewer.playing()
    for _ in range(2):
        for _ in range(module.MAX_USELESS_MESSAGES - 1):
            await viewer.took(0)
        number = show.shows(stream, jpeg())
        assert (await viewer.picture())[0]["number"] == number
        await viewer.took(number)
    for _ in range(module.MAX_USELESS_MESSAGES):
        await viewer.took(0)
    assert (await viewer.closed())[0] == close_codes.TOO_MANY_ERRORS
    assert not stream.viewers


@pytest_twisted.ensureDeferred
async def test_message_is_encoded_once_for_all_viewers(show: Show, monkeypatch: pytest.MonkeyPatch) -> None:
    """For any number of viewers and repetitions by the robot."""
    made: list[bytes] = []

    def text(words: bytes) -> bytes:
        made.append(words)
        return websocket_frames.text(words)

    monkeypatch.setattr(module, "websocket_frames", SimpleNamespace(text=text))
    control = show.robot_comes()
    eyes = [await opens(show) for _ in range(5)]
    stream = await show.joined(control)
    for width in range(100, 1100):
        stream.message_received(link.StreamStatus(width=width, height=13, quality=40))
    for viewer in eyes:
        assert [(await viewer.playing())["width"] for _ in range(2)] == [32, 1099]
        await viewer.leave()
    assert len(made) <= 2


@pytest_twisted.ensureDeferred
async def test_h264_that_the_robot_can_not_encode_has_its_own_close_code(show: Show) -> None:
    """4415: another codec may work; 4503 if the robot has too many streams."""
    viewer, stream = await watched(show, "&codec=h264")
    stream.message_received(link.StreamRefused(reason="no module named av"))
    assert await viewer.closed() == (close_codes.NOT_MADE, "no module named av")
    viewer, stream = await watched(show, "&codec=h264")
    stream.message_received(link.StreamRefused(reason="I have eyes for four", busy=True))
    assert await viewer.closed() == (close_codes.UNAVAILABLE, "I have eyes for four")


@pytest_twisted.ensureDeferred
async def test_end_of_a_stream_has_a_code(show: Show) -> None:
    """4503 by the robot, 1001 at shutdown of the relay."""
    viewer, stream = await watched(show)
    stream.message_received(link.StreamRefused(reason="I have eyes for four"))
    assert await viewer.closed() == (close_codes.UNAVAILABLE, "I have eyes for four")
    viewer = await opens(show)
    await until(lambda: show.access._permits)
    show.service.shutdown("the relay is going down")
    assert await viewer.closed() == (close_codes.GOING_AWAY, "the relay is going down")


@pytest_twisted.ensureDeferred
async def test_too_frequent_streams_are_refused(show: Show, monkeypatch: pytest.MonkeyPatch) -> None:
    """4503 with a reason; a later retry works."""
    monkeypatch.setattr(streams, "STREAMS_AT_ONCE", 1)
    monkeypatch.setattr(streams, "STREAMS_A_SECOND", 1 / 60)
    viewer, _ = await watched(show)
    code, words = await (await opens(show, "&width=16")).closed()
    assert code == close_codes.UNAVAILABLE
    assert words.startswith("you start streams of robot rover too fast; try again in ")
    await viewer.leave()


@pytest.mark.parametrize("by_message", [True, False])
@pytest_twisted.ensureDeferred
async def test_a_viewer_that_leaves_during_authentication_counts_for_no_stream(
    show: Show, monkeypatch: pytest.MonkeyPatch, by_message: bool
) -> None:
    """By the handshake or by a message: no count is left."""
    found: Deferred[None] = Deferred()
    bearer = show.logins.bearer
    asked = 0

    async def slow(token: str) -> Principal:
        nonlocal asked
        asked += 1
        await found
        return await bearer(token)

    monkeypatch.setattr(show.logins, "bearer", slow)
    show.robot_comes()
    if by_message:
        viewer = await opens(show, token="")
        await deferToThread(viewer._end.send, json.dumps({"op": "auth", "mac": "ann's"}))
        await until(lambda: asked)
        viewer._end.socket.close()
    else:
        client = RawClient(show.port, f"/robots/rover/video/ws?topic={CAMERA}", **HANDSHAKE)
        await until(lambda: asked)
        client.socket.close()
    await until(lambda: not show.connections._counts)
    found.callback(None)
    monkeypatch.undo()
    viewer = await opens(show)
    await until(lambda: show.limits._streams)
    assert dict(show.limits._streams) == {show.ann.id: 1}
    await viewer.leave()
    await until(lambda: not show.limits._streams)
