"""The MJPEG stream on real sockets."""

from __future__ import annotations

import time
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor, task
from twisted.internet.defer import DeferredList, ensureDeferred

from relay_protocol import limits, link
from relay_protocol.errors import Unavailable
from relay_server.http import site
from relay_server.video import frame_waits, multipart
from tests.worlds.video_site import CAMERA, STREAM, Show, jpeg, until


async def together(*work: Any) -> list[Any]:
    """Results of concurrent work."""
    found = await DeferredList([ensureDeferred(each) for each in work], fireOnOneErrback=True)
    return [result for _, result in found]


@pytest_twisted.ensureDeferred
async def test_a_stream_is_a_jpeg_a_part_as_any_parser_of_mime_reads_it(show: Show) -> None:
    """Each part has its length, the time at the robot and the reduction; the headers forbid caching and
    sniffing.
    """
    control = show.robot_comes()
    client = show.request(STREAM)
    stream = await show.joined(control)
    show.shows(stream, jpeg())
    status, headers = await client.head()
    assert status == 200
    assert headers.get_content_type() == "multipart/x-mixed-replace"
    assert headers.get_boundary() == "boundarydonotcross"
    assert headers["cache-control"] == "no-store"
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert headers["connection"] == "close"
    assert headers["transfer-encoding"] is None
    part, body = await client.part()
    assert body == jpeg()
    assert part.get_content_type() == "image/jpeg"
    assert float(part["x-timestamp"]) == 1000.5
    assert part["x-reduced"] is None
    stream.message_received(link.StreamStatus(width=16, height=12, quality=40, reduced=0.25))
    show.shows(stream, jpeg(100_000))
    part, body = await client.part()
    assert (body, float(part["x-reduced"])) == (jpeg(100_000), 0.25)
    client.leave()
    await until(lambda: not stream.viewers)


@pytest_twisted.ensureDeferred
async def test_stalled_or_slow_viewers_do_not_delay_fast_ones(show: Show) -> None:
    """A viewer that reads nothing is cut after 5 s; one with 20 KB/s stays and gets recent frames."""
    control = show.robot_comes()
    fast = [show.request(STREAM) for _ in range(5)]
    stalled = show.request(STREAM, window=4096)
    slow = show.request(STREAM, window=4096)
    stream = await show.joined(control)
    await until(lambda: len(stream.viewers) == 7)
    began, body = time.monotonic(), jpeg(20_000)
    reading = ensureDeferred(slow.slowly(20_000, 8.0))
    show.shows(stream, body, time.monotonic())
    await together(*[each.head() for each in fast])
    while not reading.called:
        # A frame only follows when all fast viewers have this one.
        assert [part for _, part in await together(*[each.part() for each in fast])] == [body] * len(fast)
        await task.deferLater(reactor, 0.05)  # type: ignore[arg-type]
        show.shows(stream, body, time.monotonic())
    data = await reading
    await until(lambda: len(stream.viewers) == 6)
    assert time.monotonic() - began > 5
    # A frame takes this viewer a second, so it does not get each.
    times = [line for line in data.split(b"\r\n") if line.startswith(b"X-Timestamp: ")]
    assert 1 < len(times) < next(show.numbers) / 2
    for each in (*fast, slow, stalled):
        each.leave()
    await until(lambda: not stream.viewers)


@pytest_twisted.ensureDeferred
async def test_single_frame_is_in_flight_for_any_kernel_buffer(show: Show) -> None:
    """A viewer that stalled for a while gets the frame in flight and then the newest; those between are
    dropped.
    """
    control = show.robot_comes()
    client = show.request(STREAM, window=4096)
    stream = await show.joined(control)
    for size in range(40_000, 160_000, 20_000):
        show.shows(stream, jpeg(size))
        await task.deferLater(reactor, 0.05)  # type: ignore[arg-type]
    await client.head()
    assert [len((await client.part())[1]) for _ in range(2)] == [len(jpeg(40_000)), len(jpeg(140_000))]
    client.leave()


@pytest_twisted.ensureDeferred
async def test_a_stalled_viewer_costs_one_frame_and_is_cut(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At most 4 MiB, for any other traffic; its queued frame is freed."""
    connections: list[Any] = []

    def narrow(transport: Any) -> Any:
        connections.append(transport)
        return real(transport)

    real = multipart.limit_send_buffer
    monkeypatch.setattr(multipart, "limit_send_buffer", narrow)
    control = show.robot_comes()
    client = show.request(STREAM, window=4096)
    stream = await show.joined(control)
    began = time.monotonic()
    show.films(stream, jpeg(3_900_000), fps=5)
    await until(lambda: connections)
    most = 0

    def cut() -> bool:
        nonlocal most
        most = max(most, len(connections[0].dataBuffer) + connections[0]._tempDataLen)
        return not stream.viewers

    await until(cut)
    assert 3_000_000 < most < 4 * limits.MIB
    assert time.monotonic() - began >= 5.0
    await client.closed()
    assert show.events("video.left")


@pytest_twisted.ensureDeferred
async def test_a_revoked_right_ends_a_stream_that_runs(show: Show) -> None:
    """At once when the relay is notified; a new denying pattern ends it as well."""
    control = show.robot_comes()
    clients = [show.request(STREAM), show.request(STREAM)]
    stream = await show.joined(control)
    show.films(stream, jpeg())
    await until(lambda: len(stream.viewers) == 2)
    for client in clients:
        assert (await client.head())[0] == 200
    await show.deny(CAMERA)
    assert not stream.viewers
    for client in clients:
        await client.closed()
    kinds = [each.data["camera"] for each in show.events("video.joined")]
    assert kinds == [CAMERA, CAMERA]
    assert len(show.events("video.left")) == 2


@pytest_twisted.ensureDeferred
async def test_a_stream_outlives_the_deadlines_of_requests(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Deadlines are for bytes from clients."""
    monkeypatch.setattr(limits, "UNAUTHENTICATED_SECONDS", 0.2)
    monkeypatch.setattr(site, "IDLE_SECONDS", 0.2)
    control = show.robot_comes()
    client = show.request(STREAM)
    stream = await show.joined(control)
    show.films(stream, jpeg())
    await client.head()
    began = time.monotonic()
    while time.monotonic() - began < 1:
        await client.part()
    await client.part()
    client.leave()


@pytest.mark.parametrize("online", [False, True])
@pytest_twisted.ensureDeferred
async def test_without_frames_the_answer_has_the_reason(
    show: Show, monkeypatch: pytest.MonkeyPatch, online: bool
) -> None:
    """503 if the robot is offline, 504 if it is online; the connection serves the next request."""
    monkeypatch.setattr(frame_waits, "FIRST_FRAME_SECONDS", 0.2)
    if online:
        show.robot_comes()
    client = show.request(STREAM)
    status, detail = await client.problem()
    assert (status, "offline" in detail) == ((504, False) if online else (503, True))
    client.asks("/healthz")
    assert (await client.answer())[0] == 200


@pytest_twisted.ensureDeferred
async def test_a_missing_camera_is_reported_like_a_forbidden_one(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """404 in the same words, after the robot had time to report it."""
    monkeypatch.setattr(frame_waits, "FIRST_FRAME_SECONDS", 0.2)
    show.robot_comes()
    client = show.request(STREAM.replace(CAMERA, "/nowhere"))
    assert await client.problem() == (404, "there is no such camera, or you have no right to view it")


@pytest_twisted.ensureDeferred
async def test_a_busy_robot_is_503_in_its_words(show: Show) -> None:
    """Before the first frame; after it the connection ends."""
    control = show.robot_comes()
    client = show.request(STREAM)
    stream = await show.joined(control)
    stream.message_received(link.StreamRefused(reason="I have eyes for four", busy=True))
    assert await client.problem() == (503, "I have eyes for four")
    client = show.request(STREAM)
    stream = await show.joined(control)
    show.shows(stream, jpeg())
    assert (await client.head())[0] == 200
    stream.close(Unavailable("no more"))
    await client.closed()


@pytest_twisted.ensureDeferred
async def test_a_frame_right_before_the_end_still_comes(show: Show) -> None:
    """Even if it is still in the kernel's buffer for a slow viewer."""
    control = show.robot_comes()
    client = show.request(STREAM, window=4096)
    stream = await show.joined(control)
    show.shows(stream, jpeg(60_000))
    stream.close(Unavailable("no more"))
    assert (await client.head())[0] == 200
    assert (await client.part())[1] == jpeg(60_000)
    await client.closed()


@pytest_twisted.ensureDeferred
async def test_a_frame_that_holds_the_delimiter_is_left_out(show: Show) -> None:
    """Browsers look for it and ignore the length, so a robot could insert a page into the relay's site."""
    control = show.robot_comes()
    client = show.request(STREAM)
    stream = await show.joined(control)
    page = b"\r\n--boundarydonotcross\r\nContent-Type: text/html\r\n\r\n<script>"
    whole = jpeg()
    show.shows(stream, whole[:2] + b"\xff\xfe" + (len(page) + 2).to_bytes(2, "big") + page + whole[2:])
    show.shows(stream, whole)
    assert (await client.head())[0] == 200
    assert (await client.part())[1] == whole
    client.leave()
