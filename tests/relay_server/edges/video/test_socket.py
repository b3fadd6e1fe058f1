"""Pictures over a websocket, on real sockets."""

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
from tests.relay_server.edges.video.show import CAMERA, SECRET, STREAM, Looker, Show, jpeg, until
from tests.relay_server.video.watching import DELTA, KEY

HANDSHAKE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
}
"""Of a client of the test's own making."""


class Eye:
    """A viewer's websocket."""

    def __init__(self, end: ClientConnection) -> None:
        self._end = end

    async def picture(self) -> tuple[dict[str, Any], bytes]:
        """The next picture."""
        head = json.loads(await self._next())
        body = await self._next()
        assert (head.pop("op"), head.pop("size")) == ("picture", len(body))
        assert isinstance(body, bytes)
        return head, body

    async def playing(self) -> dict[str, Any]:
        """The next message, which says what is sent."""
        told: dict[str, Any] = json.loads(await self._next())
        assert told.pop("op") == "playing"
        return told

    async def told(self) -> dict[str, Any]:
        """The next message that says what is sent, after what pictures there may be."""
        while True:
            message = await self._next()
            if isinstance(message, str) and '"playing"' in message:
                told: dict[str, Any] = json.loads(message)
                return told

    async def _next(self) -> str | bytes:
        return await deferToThread(self._end.recv, 10)

    async def quiet(self, seconds: float = 0.3) -> bool:
        """Whether nothing comes for so long."""
        try:
            await deferToThread(self._end.recv, seconds)
        except TimeoutError:
            return True
        return False

    async def took(self, number: int) -> None:
        """Open the way for the next."""
        await self.says(json.dumps({"op": "took", "number": number}))

    async def says(self, text: str) -> None:
        """Anything."""
        await deferToThread(self._end.send, text)

    async def closed(self) -> tuple[int, str]:
        """Code and reason of the close that follows, whatever comes before."""
        try:
            while True:
                await self._next()
        except ConnectionClosed as error:
            assert error.rcvd is not None
            return error.rcvd.code, error.rcvd.reason

    async def leave(self) -> None:
        """Close."""
        await deferToThread(self._end.close)


async def opens(show: Show, query: str = "", token: str = "ann's", **options: Any) -> Eye:
    """A websocket to the camera."""
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    url = f"ws://127.0.0.1:{show.port}/robots/rover/video/ws?topic={CAMERA}{query}"
    return Eye(await deferToThread(connect, url, additional_headers=headers, close_timeout=2, **options))


async def watched(show: Show, query: str = "") -> tuple[Eye, CameraStream]:
    """An open websocket and its stream, joined by the robot."""
    control = show.robot_comes()
    eye = await opens(show, query)
    return eye, await show.joined(control)


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
    """One for the robot's own websocket is not."""
    show.robot_comes()
    ann = await show.desk.token("ann's")
    query = f"&ticket={show.auth.issue_ticket(ann, ticket)}"
    if good:
        await (await opens(show, query, token="")).leave()
    else:
        with pytest.raises(InvalidStatus) as refused:
            await opens(show, query, token="")
        assert refused.value.response.status_code == 401
    await until(lambda: not show.access._permits)


@pytest_twisted.ensureDeferred
async def test_a_picture_is_a_header_and_then_the_bytes(show: Show) -> None:
    """What is sent from now on is told before, and when it changes."""
    eye, stream = await watched(show)
    assert (await eye.playing())["quality"] == 80
    number = show.shows(stream, jpeg())
    head, body = await eye.picture()
    assert head == {
        "number": number,
        "stamp": 1000.5,
        "width": 32,
        "height": 24,
        "codec": "jpeg",
        "key": True,
    }
    assert body == jpeg()
    stream.message(link.Playing(width=16, height=12, quality=40, reduced=0.25, delay_ms=80))
    told = await eye.playing()
    assert (told["width"], told["reduced"], told["delay_ms"]) == (16, 0.25, 80)
    await eye.leave()
    await until(lambda: not show.access._permits)
    assert not stream.viewers


@pytest_twisted.ensureDeferred
async def test_who_is_shown_another_form_is_told_so_until_he_gets_his_own(show: Show) -> None:
    """With what is played: the parameters in which it differs from what he asked for."""
    control = show.robot_comes()
    show.makes(1)
    first = show.looks(f"{STREAM}&width=32")
    stream = await show.joined(control)
    show.shows(stream, jpeg())
    eye = await opens(show, "&width=64&fps=5")
    assert (await eye.playing())["instead"] == {"width": 32, "fps": 0.0}
    first.leave()
    await show.joined(control)
    assert (await eye.told())["instead"] is None
    await eye.leave()


@pytest_twisted.ensureDeferred
async def test_the_next_picture_comes_when_the_last_was_taken_and_is_the_newest(show: Show) -> None:
    """What came meanwhile is left out; a number that is not awaited opens nothing."""
    eye, stream = await watched(show)
    await eye.playing()
    first = show.shows(stream, jpeg())
    assert (await eye.picture())[0]["number"] == first
    numbers = [show.shows(stream, jpeg()) for _ in range(3)]
    await eye.took(numbers[-1])
    assert await eye.quiet()
    await eye.took(first)
    assert (await eye.picture())[0]["number"] == numbers[-1]
    await eye.leave()


@pytest_twisted.ensureDeferred
async def test_of_h264_what_came_meanwhile_follows_at_once(show: Show) -> None:
    """It begins with a picture that stands alone; the way is open again when the last is taken."""
    eye, stream = await watched(show, "&codec=h264")
    await eye.playing()
    show.shows(stream, DELTA)
    numbers = [show.shows(stream, body) for body in (KEY, DELTA, DELTA)]
    head, body = await eye.picture()
    assert (head["number"], head["key"], head["codec"], body) == (numbers[0], True, "h264", KEY)
    await eye.took(numbers[0])
    assert [(await eye.picture())[0]["number"] for _ in range(2)] == numbers[1:]
    later = show.shows(stream, DELTA)
    await eye.took(numbers[1])
    assert await eye.quiet()
    await eye.took(numbers[2])
    assert (await eye.picture())[0]["number"] == later
    await eye.leave()


@pytest_twisted.ensureDeferred
async def test_who_takes_no_picture_is_cut(show: Show, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if he answers pings."""
    monkeypatch.setattr(module, "STALL_SECONDS", 0.5)
    monkeypatch.setattr(module, "LOOK_SECONDS", 0.1)
    eye, stream = await watched(show)
    show.shows(stream, jpeg())
    assert (await eye.closed())[0] == close_codes.TOO_SLOW
    assert not stream.viewers


@pytest_twisted.ensureDeferred
async def test_who_takes_a_picture_slowly_is_not_cut(show: Show, monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as something of it arrives, however long its answers to pings wait behind it."""
    monkeypatch.setattr(module, "STALL_SECONDS", 1.0)
    monkeypatch.setattr(module, "LOOK_SECONDS", 0.1)
    control = show.robot_comes()
    looker = show.looks(f"/robots/rover/video/ws?topic={CAMERA}", window=4096, **HANDSHAKE)
    stream = await show.joined(control)
    await looker.head()
    show.shows(stream, jpeg(60_000))
    assert len(await looker.slowly(15_000, 3.5)) > 40_000
    assert stream.viewers
    await until(lambda: not stream.viewers)
    looker.leave()


async def stuffed(show: Show) -> tuple[Looker, CameraStream, int]:
    """A viewer who reads nothing, and the number of a picture that is more than the kernel takes."""
    control = show.robot_comes()
    looker = show.looks(f"/robots/rover/video/ws?topic={CAMERA}", window=4096, **HANDSHAKE)
    stream = await show.joined(control)
    await looker.head()
    return looker, stream, show.shows(stream, jpeg(3_900_000))


@pytest_twisted.ensureDeferred
async def test_who_says_that_he_took_what_he_does_not_read_is_cut(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However much he says meanwhile, as long as the connection takes nothing more."""
    monkeypatch.setattr(module, "STALL_SECONDS", 0.5)
    monkeypatch.setattr(module, "LOOK_SECONDS", 0.1)
    looker, stream, number = await stuffed(show)
    took = json.dumps({"op": "took", "number": number}).encode()
    talking = LoopingCall(looker.socket.sendall, b"\x81" + bytes([0x80 + len(took)]) + bytes(4) + took)
    talking.start(0.2).addErrback(lambda failure: failure.trap(OSError))
    await until(lambda: not stream.viewers)
    if talking.running:
        talking.stop()
    looker.leave()


@pytest_twisted.ensureDeferred
async def test_a_revoked_right_ends_a_picture_that_is_under_way(show: Show) -> None:
    """At once: nothing of it that the viewer has not taken goes any more, nor is there a code behind it."""
    looker, stream, _ = await stuffed(show)
    await show.deny(CAMERA)
    assert not stream.viewers
    assert await deferToThread(_bytes_until_reset, looker) < 1_000_000
    looker.leave()


def _bytes_until_reset(looker: Looker) -> int:
    """What still comes before the connection is reset."""
    count = 0
    with pytest.raises(ConnectionResetError):
        while data := looker.socket.recv(65536):
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
    eye, _ = await watched(show)
    other = await opens(show)
    await until(lambda: len(show.access._permits) == 2)
    await show.deny(CAMERA)
    assert await eye.closed() == (close_codes.FORBIDDEN, f"your right to view {CAMERA} was revoked")
    assert (await other.closed())[0] == close_codes.FORBIDDEN
    await show.deny()
    eye = await opens(show)
    await until(lambda: show.access._permits)
    token = (await show.desk.token("ann's")).token_id
    await show.store.write(queries.revoke_token, token)
    await show.access.refresh()
    assert (await eye.closed())[0] == close_codes.UNAUTHENTICATED


@pytest.mark.parametrize(
    ("query", "token", "status", "code"),
    [
        ("", "nobody's", 401, close_codes.UNAUTHENTICATED),
        ("&quality=best", "ann's", 400, close_codes.INVALID),
        (f"&topic={SECRET}", "ann's", 400, close_codes.INVALID),
    ],
)
@pytest_twisted.ensureDeferred
async def test_who_may_not_come_in_reads_a_status_or_a_close_code(
    show: Show, query: str, token: str, status: int, code: int
) -> None:
    """Programs the one, browsers the other."""
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
    """Bytes close at once, nonsense when it is too much."""
    eye, stream = await watched(show)
    for _ in range(module.MISTAKES):
        await eye.says('{"op":"subscribe"}')
    assert (await eye.closed())[0] == close_codes.TOO_MANY_ERRORS
    eye = await opens(show)
    await eye.says(b"\x00")  # type: ignore[arg-type]
    assert (await eye.closed())[0] == close_codes.FORBIDDEN
    assert not stream.viewers


@pytest_twisted.ensureDeferred
async def test_who_takes_what_was_not_sent_is_cut_when_it_is_too_much(show: Show) -> None:
    """In a row: of several pictures at once each may be said to be taken, though only the last counts."""
    eye, stream = await watched(show)
    await eye.playing()
    for _ in range(2):
        for _ in range(module.MISTAKES - 1):
            await eye.took(0)
        number = show.shows(stream, jpeg())
        assert (await eye.picture())[0]["number"] == number
        await eye.took(number)
    for _ in range(module.MISTAKES):
        await eye.took(0)
    assert (await eye.closed())[0] == close_codes.TOO_MANY_ERRORS
    assert not stream.viewers


@pytest_twisted.ensureDeferred
async def test_what_is_sent_is_put_into_words_once_for_all_viewers(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many watch, and however often a robot says it."""
    made: list[bytes] = []

    def text(words: bytes) -> bytes:
        made.append(words)
        return websocket_frames.text(words)

    monkeypatch.setattr(module, "websocket_frames", SimpleNamespace(text=text))
    control = show.robot_comes()
    eyes = [await opens(show) for _ in range(5)]
    stream = await show.joined(control)
    for width in range(100, 1100):
        stream.message(link.Playing(width=width, height=13, quality=40))
    for eye in eyes:
        assert [(await eye.playing())["width"] for _ in range(2)] == [32, 1099]
        await eye.leave()
    assert len(made) <= 2


@pytest_twisted.ensureDeferred
async def test_h264_that_the_robot_can_not_make_is_told_with_a_code_of_its_own(show: Show) -> None:
    """4415: another codec may do; 4503 when the robot makes too many streams as it is."""
    eye, stream = await watched(show, "&codec=h264")
    stream.message(link.NotPlaying(reason="no module named av"))
    assert await eye.closed() == (close_codes.NOT_MADE, "no module named av")
    eye, stream = await watched(show, "&codec=h264")
    stream.message(link.NotPlaying(reason="I have eyes for four", busy=True))
    assert await eye.closed() == (close_codes.UNAVAILABLE, "I have eyes for four")


@pytest_twisted.ensureDeferred
async def test_what_ends_a_stream_is_told_with_a_code(show: Show) -> None:
    """4503 from the robot, 1001 when the relay goes down."""
    eye, stream = await watched(show)
    stream.message(link.NotPlaying(reason="I have eyes for four"))
    assert await eye.closed() == (close_codes.UNAVAILABLE, "I have eyes for four")
    eye = await opens(show)
    await until(lambda: show.access._permits)
    show.desk.say_goodbye("the relay is going down")
    assert await eye.closed() == (close_codes.GOING_AWAY, "the relay is going down")


@pytest_twisted.ensureDeferred
async def test_who_begins_streams_too_fast_is_told_so(show: Show, monkeypatch: pytest.MonkeyPatch) -> None:
    """4503, with the words; it helps to try again later."""
    monkeypatch.setattr(streams, "STREAMS_AT_ONCE", 1)
    monkeypatch.setattr(streams, "STREAMS_A_SECOND", 1 / 60)
    eye, _ = await watched(show)
    code, words = await (await opens(show, "&width=16")).closed()
    assert code == close_codes.UNAVAILABLE
    assert words.startswith("you begin streams of robot rover faster than it can; try again in ")
    await eye.leave()


@pytest.mark.parametrize("by_message", [True, False])
@pytest_twisted.ensureDeferred
async def test_a_viewer_who_leaves_while_he_is_looked_up_counts_for_no_stream(
    show: Show, monkeypatch: pytest.MonkeyPatch, by_message: bool
) -> None:
    """Whether he proves himself in the handshake or by a message: nothing is counted that nobody counts out."""
    found: Deferred[None] = Deferred()
    bearer = show.desk.bearer
    asked = 0

    async def slow(token: str) -> Principal:
        nonlocal asked
        asked += 1
        await found
        return await bearer(token)

    monkeypatch.setattr(show.desk, "bearer", slow)
    show.robot_comes()
    if by_message:
        eye = await opens(show, token="")
        await deferToThread(eye._end.send, json.dumps({"op": "auth", "mac": "ann's"}))
        await until(lambda: asked)
        eye._end.socket.close()
    else:
        looker = Looker(show.port, f"/robots/rover/video/ws?topic={CAMERA}", **HANDSHAKE)
        await until(lambda: asked)
        looker.socket.close()
    await until(lambda: not show.connections._counts)
    found.callback(None)
    monkeypatch.undo()
    eye = await opens(show)
    await until(lambda: show.limits._streams)
    assert dict(show.limits._streams) == {show.ann.id: 1}
    await eye.leave()
    await until(lambda: not show.limits._streams)
