"""The MJPEG stream on real sockets."""

from __future__ import annotations

import time
from typing import Any

import pytest
import pytest_twisted
from switchboard_pulse import Pulse
from twisted.internet import reactor, task
from twisted.internet.defer import DeferredList, ensureDeferred

from relay_protocol import limits, link
from relay_protocol.errors import Unavailable
from relay_server.http import site
from relay_server.video import first_frame_timeout, multipart
from tests.relay_server.edges.video.show import CAMERA, STREAM, Show, jpeg, until


async def together(*work: Any) -> list[Any]:
    """What becomes of several at the same time."""
    found = await DeferredList([ensureDeferred(each) for each in work], fireOnOneErrback=True)
    return [result for _, result in found]


@pytest_twisted.ensureDeferred
async def test_a_stream_is_a_jpeg_a_part_as_any_parser_of_mime_reads_it(show: Show) -> None:
    """With its length, the time at the robot, and how far it is reduced; the head forbids keeping and sniffing."""
    control = show.robot_comes()
    looker = show.looks(STREAM)
    stream = await show.joined(control)
    show.shows(stream, jpeg())
    status, headers = await looker.head()
    assert status == 200
    assert headers.get_content_type() == "multipart/x-mixed-replace"
    assert headers.get_boundary() == "boundarydonotcross"
    assert headers["cache-control"] == "no-store"
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert headers["connection"] == "close"
    assert headers["transfer-encoding"] is None
    part, body = await looker.part()
    assert body == jpeg()
    assert part.get_content_type() == "image/jpeg"
    assert float(part["x-timestamp"]) == 1000.5
    assert part["x-reduced"] is None
    stream.message(link.Playing(width=16, height=12, quality=40, reduced=0.25))
    show.shows(stream, jpeg(100_000))
    part, body = await looker.part()
    assert (body, float(part["x-reduced"])) == (jpeg(100_000), 0.25)
    looker.leave()
    await until(lambda: not stream.viewers)


@pytest_twisted.ensureDeferred
async def test_viewers_who_stop_or_crawl_cost_the_fast_ones_nothing(show: Show) -> None:
    """Who takes nothing is cut after 5 s; who takes 20 KB/s stays, and what he sees is not old."""
    control = show.robot_comes()
    fast = [show.looks(STREAM) for _ in range(5)]
    stalled = show.looks(STREAM, window=4096)
    slow = show.looks(STREAM, window=4096)
    stream = await show.joined(control)
    await until(lambda: len(stream.viewers) == 7)
    began = time.monotonic()
    show.films(stream, jpeg(20_000))
    *ages, data = await together(*[each.parts(8.0) for each in fast], slow.slowly(20_000, 8.0))
    ended = time.monotonic()
    shown = next(show.numbers) - 1
    for each in ages:
        # What is shown while its reader begins and ends does not count.
        assert len(each) > 0.9 * shown - 5
        assert sorted(each)[len(each) // 2] < 0.2
    assert len(stream.viewers) == 6
    assert ended - began > 5
    *_, last = [line for line in data.split(b"\r\n") if line.startswith(b"X-Timestamp: ")]
    assert ended - float(last.split()[1]) < 4.0
    for each in (*fast, slow, stalled):
        each.leave()
    await until(lambda: not stream.viewers)


@pytest_twisted.ensureDeferred
async def test_one_picture_is_under_way_however_many_the_kernel_would_take(show: Show) -> None:
    """Who could not read for a while gets what was on its way, and then the newest; what came between is left out."""
    control = show.robot_comes()
    looker = show.looks(STREAM, window=4096)
    stream = await show.joined(control)
    for size in range(40_000, 160_000, 20_000):
        show.shows(stream, jpeg(size))
        await task.deferLater(reactor, 0.05)  # type: ignore[arg-type]
    await looker.head()
    assert [len((await looker.part())[1]) for _ in range(2)] == [len(jpeg(40_000)), len(jpeg(140_000))]
    looker.leave()


@pytest_twisted.ensureDeferred
async def test_a_stalled_viewer_costs_one_picture_and_is_cut_in_time(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At most 4 MiB, whatever else is shown; what it does not read is let go at once."""
    connections: list[Any] = []

    def narrow(transport: Any) -> Any:
        connections.append(transport)
        return real(transport)

    real = multipart.limit_send_buffer
    monkeypatch.setattr(multipart, "limit_send_buffer", narrow)
    control = show.robot_comes()
    looker = show.looks(STREAM, window=4096)
    stream = await show.joined(control)
    began, pulse = time.monotonic(), Pulse()
    pulse.start()
    show.films(stream, jpeg(3_900_000), fps=5)
    await until(lambda: connections)
    most = 0

    def cut() -> bool:
        nonlocal most
        most = max(most, len(connections[0].dataBuffer) + connections[0]._tempDataLen)
        return not stream.viewers

    await until(cut)
    assert 3_000_000 < most < 4 * limits.MIB
    # Looked at once a second, and a busy machine takes its time.
    assert 5.0 <= time.monotonic() - began < 12.0 + pulse.lost()
    pulse.stop()
    assert await looker.closed() < 1
    assert await show.events("video.left")


@pytest_twisted.ensureDeferred
async def test_a_revoked_right_ends_a_stream_that_runs(show: Show) -> None:
    """At once when the relay has heard of it; the other way, a pattern that denies it, as well."""
    control = show.robot_comes()
    lookers = [show.looks(STREAM), show.looks(STREAM)]
    stream = await show.joined(control)
    show.films(stream, jpeg())
    await until(lambda: len(stream.viewers) == 2)
    for looker in lookers:
        assert (await looker.head())[0] == 200
    await show.deny(CAMERA)
    assert not stream.viewers
    for looker in lookers:
        assert await looker.closed() < 1
    kinds = [each.data["camera"] for each in await show.events("video.joined")]
    assert kinds == [CAMERA, CAMERA]
    assert len(await show.events("video.left")) == 2


@pytest_twisted.ensureDeferred
async def test_a_stream_outlives_the_deadlines_of_requests(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are for what comes from clients."""
    monkeypatch.setattr(limits, "UNPROVEN_SECONDS", 0.2)
    monkeypatch.setattr(site, "IDLE_SECONDS", 0.2)
    control = show.robot_comes()
    looker = show.looks(STREAM)
    stream = await show.joined(control)
    show.films(stream, jpeg())
    assert len(await looker.parts(1.0)) > 3
    looker.leave()


@pytest.mark.parametrize("online", [False, True])
@pytest_twisted.ensureDeferred
async def test_where_nothing_comes_the_answer_says_why(
    show: Show, monkeypatch: pytest.MonkeyPatch, online: bool
) -> None:
    """503 when the robot is not there, 504 when it is; the connection serves the next request."""
    monkeypatch.setattr(first_frame_timeout, "FIRST_PICTURE_SECONDS", 0.2)
    if online:
        show.robot_comes()
    looker = show.looks(STREAM)
    status, detail = await looker.problem()
    assert (status, "offline" in detail) == ((504, False) if online else (503, True))
    looker.asks("/healthz")
    assert (await looker.answer())[0] == 200


@pytest_twisted.ensureDeferred
async def test_a_camera_that_never_appears_is_told_like_one_that_may_not_be_viewed(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """404 in the same words; the robot had time to tell of it."""
    monkeypatch.setattr(first_frame_timeout, "FIRST_PICTURE_SECONDS", 0.2)
    show.robot_comes()
    looker = show.looks(STREAM.replace(CAMERA, "/nowhere"))
    assert await looker.problem() == (404, "there is no such camera, or you have no right to view it")


@pytest_twisted.ensureDeferred
async def test_a_busy_robot_is_503_in_its_words(show: Show) -> None:
    """Before the first picture; after it the connection ends."""
    control = show.robot_comes()
    looker = show.looks(STREAM)
    stream = await show.joined(control)
    stream.message(link.NotPlaying(reason="I have eyes for four", busy=True))
    assert await looker.problem() == (503, "I have eyes for four")
    looker = show.looks(STREAM)
    stream = await show.joined(control)
    show.shows(stream, jpeg())
    assert (await looker.head())[0] == 200
    stream.shut(Unavailable("no more"))
    assert await looker.closed() < 1


@pytest_twisted.ensureDeferred
async def test_a_picture_right_before_the_end_still_comes(show: Show) -> None:
    """Also what the kernel holds for somebody who is slow."""
    control = show.robot_comes()
    looker = show.looks(STREAM, window=4096)
    stream = await show.joined(control)
    show.shows(stream, jpeg(60_000))
    stream.shut(Unavailable("no more"))
    assert (await looker.head())[0] == 200
    assert (await looker.part())[1] == jpeg(60_000)
    assert await looker.closed() < 1


@pytest_twisted.ensureDeferred
async def test_a_picture_that_holds_the_delimiter_is_left_out(show: Show) -> None:
    """Browsers look for it, not at the length: behind it a robot could put a page of the relay's own site."""
    control = show.robot_comes()
    looker = show.looks(STREAM)
    stream = await show.joined(control)
    page = b"\r\n--boundarydonotcross\r\nContent-Type: text/html\r\n\r\n<script>"
    whole = jpeg()
    show.shows(stream, whole[:2] + b"\xff\xfe" + (len(page) + 2).to_bytes(2, "big") + page + whole[2:])
    show.shows(stream, whole)
    assert (await looker.head())[0] == 200
    assert (await looker.part())[1] == whole
    looker.leave()
