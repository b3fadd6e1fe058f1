"""Cameras from the simulated robot to viewers: real relay, daemon, camera process and sockets."""

from __future__ import annotations

import contextlib
import itertools
import socket
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import av
import cv2
import numpy as np
import pytest
from playwright.sync_api import expect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from tests.worlds.browser import chromium
from tests.worlds.http_requests import ask
from tests.worlds.relay_process import Relay
from tests.worlds.video_clients import (
    CAMERA,
    Mjpeg,
    MjpegViewers,
    VideoViewer,
    decoded,
    get,
    known,
    path,
    streams,
)
from tests.worlds.waiting import PATIENCE, wait_for


def url(relay: Relay, token: str, what: str, **parameters: Any) -> str:
    """A URL with a ticket, for programs without headers and cookies."""
    answer = ask(relay.http_port, "POST", "/api/v1/tickets", {"robot": "rover", "for": "video"}, token=token)
    return f"http://127.0.0.1:{relay.http_port}{path(what, **parameters, ticket=answer.json['ticket'])}"


def unread(relay: Relay, token: str, **parameters: Any) -> socket.socket:
    """A connection that has requested the stream, which the test reads or not."""
    sock = socket.socket()
    # A small buffer, so that the relay soon sees that the client does not read.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.settimeout(PATIENCE)
    sock.connect(("127.0.0.1", relay.http_port))
    asked = path("stream", **parameters)
    sock.sendall(f"GET {asked} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {token}\r\n\r\n".encode())
    return sock


@pytest.fixture(scope="module")
def shown(world: Any) -> Any:
    """The world, once the relay knows its camera and the robot stands."""
    known(world.relay, world.viewer)
    world.left_alone()
    return world


def test_a_snapshot_has_the_size_that_was_asked_for(shown: Any) -> None:
    """JPEG or PNG, not cacheable, with its capture time."""
    for kind, start in (("mjpeg", b"\xff\xd8"), ("png", b"\x89PNG")):
        before = time.time()
        answer = get(shown.relay, shown.viewer, "snapshot", width=320, type=kind)
        assert answer.status == 200
        assert answer.headers["Content-Type"] == ("image/png" if kind == "png" else "image/jpeg")
        assert answer.headers["Cache-Control"] == "no-store"
        assert before - 20 < float(answer.headers["X-Timestamp"]) <= time.time()
        assert answer.body.startswith(start)
        assert decoded(answer.body).shape == (240, 320, 3)


def test_a_snapshot_of_a_slow_stream_is_the_frame_that_others_see(shown: Any) -> None:
    """At one frame per 20 s the request does not wait for the next; the frame's time shows its age."""
    with contextlib.closing(Mjpeg(shown.relay, shown.viewer, fps=0.05)) as viewer:
        part = viewer.part()
        assert part is not None
        stamp = part.headers["X-Timestamp"]
        wait_for("it is older than others may be", lambda: time.time() - float(stamp) > 1)
        answer = get(shown.relay, shown.viewer, "snapshot", fps=0.05)
    assert (answer.status, answer.headers["X-Timestamp"]) == (200, stamp)
    assert answer.body == part.body


def test_edits_are_those_that_were_asked_for(shown: Any) -> None:
    """For a standing robot, the upper left corner of the rotated picture is the lower right one of the other."""
    whole, turned, cut = (
        decoded(get(shown.relay, shown.viewer, "snapshot", **edit).body).astype(int)
        for edit in ({}, {"invert": ""}, {"crop": "100,50,200,100"})
    )
    assert cut.shape == (100, 200, 3)
    assert np.abs(cut - whole[50:150, 100:300]).mean() < 6
    # Without the line with the clock.
    assert np.abs(turned[60:] - whole[::-1, ::-1][60:]).mean() < 6


def test_the_stream_has_one_jpeg_a_part(shown: Any) -> None:
    """Each has its stated length, a later time than the one before, and the requested size."""
    with contextlib.closing(Mjpeg(shown.relay, shown.viewer, width=320)) as viewer:
        assert viewer.answer.headers["Cache-Control"] == "no-store"
        parts = [viewer.part() for _ in range(10)]
    stamps = []
    for part in parts:
        assert part is not None
        assert part.headers["Content-Type"] == "image/jpeg"
        assert int(part.headers["Content-Length"]) == len(part.body)
        assert decoded(part.body).shape == (240, 320, 3)
        stamps.append(float(part.headers["X-Timestamp"]))
    assert stamps == sorted(set(stamps))


def test_a_token_for_one_camera_opens_it_again_and_again_until_it_is_revoked(shown: Any) -> None:
    """As for a recorder with a fixed address; it opens no other camera, and no command."""
    scope = f"view:{CAMERA}@rover"
    made = shown.relay.cli(
        "token", "create", "operator", "--scope", scope, "--ttl", "365d", "--label", "recorder"
    )
    token = made["token"]
    for _ in range(2):
        with contextlib.closing(Mjpeg(shown.relay, token, width=320)) as viewer:
            assert viewer.part() is not None
    other = ask(
        shown.relay.http_port, "GET", "/robots/rover/video/snapshot?topic=/depth/image_raw", token=token
    )
    assert other.status in (403, 404)
    drive = ask(shown.relay.http_port, "PUT", "/api/v1/robots/rover/control", {}, token=token)
    assert drive.status in (403, 404)
    shown.relay.cli("token", "revoke", str(made["id"]))
    assert get(shown.relay, token, "snapshot").status == 401


def opencv(address: str) -> Iterator[Any]:
    """The frames of an address, read by OpenCV's ffmpeg."""
    capture = cv2.VideoCapture(address, cv2.CAP_FFMPEG)
    try:
        assert capture.isOpened()
        while True:
            there, picture = capture.read()
            assert there
            yield picture
    finally:
        capture.release()


def pyav(address: str) -> Iterator[Any]:
    """The frames of an address, read by PyAV's ffmpeg."""
    with av.open(address, timeout=PATIENCE) as container:
        assert container.format.name == "mpjpeg"
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="bgr24")


@pytest.mark.parametrize("player", [opencv, pyav])
def test_ffmpeg_reads_the_stream(shown: Any, player: Callable[[str], Iterator[Any]]) -> None:
    """By a ticket in the address; its frames equal a snapshot."""
    with contextlib.closing(player(url(shown.relay, shown.viewer, "stream"))) as pictures:
        for picture in itertools.islice(pictures, 5):
            assert picture.shape == (480, 640, 3)
    whole = decoded(get(shown.relay, shown.viewer, "snapshot").body)
    assert np.abs(picture.astype(int) - whole).mean() < 6


def test_the_camera_process_is_among_the_processes_of_the_robot(shown: Any) -> None:
    with contextlib.closing(Mjpeg(shown.relay, shown.viewer, width=320)) as viewer:
        assert viewer.part() is not None
        rows = shown.relay.cli("top", "rover", "--every", "0.1")["processes"]
    assert {"daemon", "guard", "camera"} <= {each["part"] for each in rows}


def test_a_browser_shows_the_stream(shown: Any) -> None:
    """An ``<img>`` on another site's page, by a ticket: it has the camera's size, and changes."""
    with chromium() as browser:
        page = browser.new_page()
        page.set_content(f'<img src="{url(shown.relay, shown.viewer, "stream")}">')
        image = page.locator("img")
        expect(image).to_have_js_property("naturalWidth", 640, timeout=PATIENCE * 1000)
        expect(image).to_have_js_property("naturalHeight", 480)
        first = image.screenshot()
        wait_for("the clock in the picture goes on", lambda: image.screenshot() != first)


def test_the_websocket_waits_for_took(shown: Any) -> None:
    """No second frame before the first is acknowledged; then the newest."""
    with VideoViewer(shown.relay, shown.viewer) as watching_socket:
        first = watching_socket.untaken()
        assert first.head["codec"] == "jpeg"
        assert decoded(first.body).shape == (first.head["height"], first.head["width"], 3) == (480, 640, 3)
        with pytest.raises(TimeoutError):
            watching_socket.untaken(1)
        with VideoViewer(shown.relay, shown.viewer) as other:
            later = other.watch_until(
                "pictures go by", lambda each: each.head["stamp"] > first.head["stamp"] + 0.5, PATIENCE
            )
        watching_socket.took(first)
        second = watching_socket.picture()
        assert second.head["number"] > first.head["number"]
        assert second.head["stamp"] >= later.head["stamp"]


def test_h264_begins_with_a_key_frame_and_decodes(shown: Any) -> None:
    """For later viewers too; it needs fewer bytes than JPEG of the same size."""
    with VideoViewer(shown.relay, shown.viewer, codec="h264") as early:
        early.picture()
        with VideoViewer(shown.relay, shown.viewer, codec="h264") as late:
            pictures = [late.picture() for _ in range(20)]
    assert pictures[0].head["key"]
    assert {each.head["codec"] for each in pictures} == {"h264"}
    decoder = av.CodecContext.create("h264", "r")
    frames = [frame for each in pictures for frame in decoder.decode(av.Packet(each.body))]
    frames += decoder.decode(None)
    assert len(frames) == len(pictures)
    assert {(frame.width, frame.height) for frame in frames} == {(640, 480)}
    with VideoViewer(shown.relay, shown.viewer) as watching_socket:
        jpeg = watching_socket.picture()
    assert statistics.median(len(each.body) for each in pictures) < len(jpeg.body)


def code_of(relay: Relay, token: str) -> int:
    """The websocket's refusal: the status of the handshake, or the close code."""
    try:
        with VideoViewer(relay, token) as watching_socket:
            watching_socket.untaken()
    except InvalidStatus as error:
        return error.response.status_code
    except ConnectionClosed as error:
        assert error.rcvd
        return error.rcvd.code
    raise AssertionError("a picture came")


def test_frames_need_the_right_to_view(shown: Any) -> None:
    """Unauthenticated: 401; no right, or a denied camera: 404 as for a missing one; 403 in a handshake."""
    shown.relay.user("blinkered")
    shown.relay.cli("right", "grant", "blinkered", "rover", "viewer", "--deny", "view:/camera/**")
    blinkered = shown.relay.token("blinkered")
    for token, status, handshake in (("swb_x", 401, 401), (shown.stranger, 404, 403), (blinkered, 404, 403)):
        for what in ("stream", "snapshot"):
            assert get(shown.relay, token, what).status == status
        assert code_of(shown.relay, token) == handshake
    assert get(shown.relay, blinkered, "cameras").json["cameras"] == []


def test_a_revoked_right_ends_what_runs(shown: Any) -> None:
    """Streams and websockets end, and new requests fail."""
    shown.relay.user("invited")
    invited = shown.relay.token("invited")
    shown.relay.cli("right", "grant", "invited", "rover", "viewer")

    def watch_to_the_end(watch: Callable[[], Any]) -> None:
        with contextlib.suppress(ConnectionClosed):
            while watch() is not None:
                pass

    with (
        contextlib.closing(Mjpeg(shown.relay, invited)) as viewer,
        VideoViewer(shown.relay, invited) as watching_socket,
        ThreadPoolExecutor(2) as pool,
    ):
        assert viewer.part() is not None
        watching_socket.picture()
        ends = [pool.submit(watch_to_the_end, each) for each in (viewer.part, watching_socket.picture)]
        shown.relay.cli("right", "revoke", "invited", "rover")
        for each in ends:
            each.result(PATIENCE)
    assert get(shown.relay, invited, "stream").status == 404


def test_frames_are_not_to_be_had_by_subscribing_to_them(shown: Any) -> None:
    """A denied camera ends its topic for the client; another topic continues."""
    shown.relay.user("listener")
    shown.relay.cli("right", "grant", "listener", "rover", "viewer")
    pictures = f"{CAMERA}/compressed"
    with shown.relay.connect("rover", shown.relay.token("listener")) as client:
        client.send(op="set_level", level="error")
        client.send(op="subscribe", topic="/odom", throttle_rate=200)
        client.send(op="subscribe", topic=pictures, throttle_rate=200)
        client.until(op="publish", topic=pictures)
        shown.relay.cli("right", "grant", "listener", "rover", "viewer", "--deny", "view:/camera/*")
        reported = client.until(op="status")["msg"]
        assert reported.startswith(f"unsubscribed from {pictures}: view on {pictures} is denied")
        client.until(op="publish", topic="/odom")
        client.send(op="subscribe", topic=pictures)
        assert client.until(op="status")["msg"].startswith(f"view on {pictures} is denied")
        assert pictures not in client.call("/rosapi/topics")["values"]["topics"]


def test_a_ticket_for_frames_does_not_allow_driving(shown: Any) -> None:
    """Nor does a ticket for the websocket show any."""
    with pytest.raises(InvalidStatus, match="401"):
        connect(f"{shown.relay.url('rover')}?{url(shown.relay, shown.operator, 'stream').partition('?')[2]}")
    wide = ask(shown.relay.http_port, "POST", "/api/v1/tickets", {"robot": "rover"}, token=shown.operator)
    address = path("snapshot", ticket=wide.json["ticket"])
    assert ask(shown.relay.http_port, "GET", address).status == 401


def test_viewer_is_a_user_of_the_robot(shown: Any) -> None:
    """By name, as long as the viewer stays."""

    def who() -> list[dict[str, Any]]:
        (robot,) = [each for each in shown.relay.cli("status")["robots"] if each["name"] == "rover"]
        return [each for each in robot["viewers"] if each["user"] == "onlooker"]

    shown.relay.user("onlooker")
    shown.relay.cli("right", "grant", "onlooker", "rover", "viewer")
    with VideoViewer(shown.relay, shown.relay.token("onlooker")) as watching_socket:
        watching_socket.picture()
        assert [each["camera"] for each in who()] == [CAMERA]
        assert shown.relay.state_of("rover") == "in_use"
    wait_for("nobody watches", lambda: not who())


def test_slow_viewers_are_nothing_to_fast_ones(shown: Any) -> None:
    """A viewer that stops reading is cut, one at 20 KB/s stays; ten others get as many frames as without
    them.
    """
    relay, token = shown.relay, shown.viewer

    def watching(count: int) -> bool:
        return sum(each["viewers"] for each in streams(relay, token)) == count

    with contextlib.ExitStack() as stack:
        fast = stack.enter_context(MjpegViewers(relay, token, 10, quality=50))
        wait_for("each has a picture", lambda: all(each.seen for each in fast.viewers))
        alone = statistics.median(fast.rates(3))
        stopped, slow = (stack.enter_context(unread(relay, token, quality=50)) for _ in range(2))
        sips: list[int] = []
        enough = threading.Event()

        def sip() -> None:
            while not enough.wait(0.1):
                sips.append(len(slow.recv(2000)))

        sipping = stack.enter_context(ThreadPoolExecutor(1)).submit(sip)
        stack.callback(enough.set)
        wait_for("both watch", lambda: watching(12))
        # A busy machine may become slower; a delayed viewer would have one a second.
        wait_for("the fast ones go on", lambda: min(fast.rates(3)) > alone / 3)
        wait_for("the stopped one is cut", lambda: watching(11))
        wait_for("they still have", lambda: min(fast.rates(2)) > alone / 3)
        assert watching(11)
        assert not sipping.done()
        assert all(sips)
        assert sum(sips) > 50_000
        with contextlib.suppress(ConnectionResetError):
            while stopped.recv(1 << 16):
                pass
