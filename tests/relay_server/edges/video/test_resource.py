"""Video over HTTP: who may see what, cameras, snapshots, and what is no question."""

from __future__ import annotations

import json

import pytest
import pytest_twisted

from relay_protocol import link
from relay_server.auth.authenticator import TicketPurpose
from relay_server.video import streams
from tests.relay_server.edges.video.show import (
    CAMERA,
    CAMERAS,
    SECRET,
    SNAPSHOT,
    STREAM,
    Show,
    jpeg,
    png,
    until,
)

COOKIE = {"Authorization": "", "Cookie": "sb=ann's"}


async def ticket(show: Show, camera: str = "", *, video: bool = True) -> str:
    """A ticket of ann's."""
    return await show.desk.issue_ticket(await show.desk.token("ann's"), TicketPurpose("rover", video, camera))


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Authorization": "Bearer ann's"}, 200),
        ({"Authorization": "Bearer nobody's"}, 401),
        ({"Authorization": ""}, 401),
        (COOKIE, 200),
        (COOKIE | {"Sec-Fetch-Site": "same-origin"}, 200),
        (COOKIE | {"Sec-Fetch-Site": "none"}, 200),
        (COOKIE | {"Sec-Fetch-Site": "cross-site"}, 403),
        (COOKIE | {"Sec-Fetch-Site": "same-site"}, 403),
        (COOKIE | {"Authorization": "Basic eDp5", "Sec-Fetch-Site": "cross-site"}, 403),
        ({"Authorization": "Bearer ann's", "Sec-Fetch-Site": "cross-site"}, 200),
    ],
)
@pytest_twisted.ensureDeferred
async def test_a_cookie_needs_no_origin_but_serves_no_other_site(
    show: Show, headers: dict[str, str], status: int
) -> None:
    """An ``<img>`` sends no Origin; browsers say which pages it is on."""
    answer, heads, body = await show.looks(CAMERAS, **headers).answer()
    assert answer == status
    assert (heads["www-authenticate"] == "Bearer") is (status == 401)
    assert "cameras" in json.loads(body) or json.loads(body)["status"] == status


@pytest_twisted.ensureDeferred
async def test_a_ticket_shows_one_stream_of_its_robot(show: Show) -> None:
    """Once; then it is worth nothing, and for another robot never was anything."""
    control = show.robot_comes()
    for_img = await ticket(show)
    looker = show.looks(f"{STREAM}&ticket={for_img}", Authorization="", Sec_Fetch_Site="cross-site")
    stream = await show.joined(control)
    show.shows(stream, jpeg())
    assert (await looker.head())[0] == 200
    again = show.looks(f"{STREAM}&ticket={for_img}", Authorization="")
    assert (await again.problem())[0] == 401
    other = show.looks(STREAM.replace("rover", "tank") + f"&ticket={await ticket(show)}", Authorization="")
    assert (await other.problem())[0] == 401
    looker.leave()


@pytest_twisted.ensureDeferred
async def test_a_ticket_for_something_else_shows_nothing(show: Show) -> None:
    """Neither one for the robot's websocket, nor one for another camera."""
    show.robot_comes()
    for address, used in (
        (STREAM, await ticket(show, video=False)),
        (STREAM, await ticket(show, "/other")),
        (CAMERAS, await ticket(show, CAMERA)),
    ):
        join = "&" if "?" in address else "?"
        looker = show.looks(f"{address}{join}ticket={used}", Authorization="")
        assert (await looker.problem())[0] == 401


@pytest_twisted.ensureDeferred
async def test_a_look_at_the_head_spends_no_ticket(show: Show) -> None:
    """Players ask for it before they ask for the rest."""
    control = show.robot_comes()
    address = f"{STREAM}&ticket={await ticket(show, CAMERA)}"
    for _ in range(2):
        assert (await show.looks(address, method="HEAD", Authorization="").answer())[0] == 200
    looker = show.looks(address, Authorization="")
    show.shows(await show.joined(control), jpeg())
    assert (await looker.head())[0] == 200
    looker.leave()
    assert (await show.looks(address, method="HEAD", Authorization="").answer())[0] == 401


@pytest_twisted.ensureDeferred
async def test_cameras_are_those_one_may_view(show: Show) -> None:
    """With how they are shown now; what is not known is null."""
    control = show.robot_comes()
    looker = show.looks(STREAM + "&width=16")
    stream = await show.joined(control)
    show.shows(stream, jpeg())
    assert (await looker.head())[0] == 200
    _, headers, body = await show.looks(CAMERAS).answer()
    assert headers["content-type"] == "application/json"
    (camera,) = json.loads(body)["cameras"]
    (shown,) = camera.pop("streams")
    assert camera == {
        "name": CAMERA,
        "type": "",
        "encoding": None,
        "width": 32,
        "height": 24,
        "fps": None,
        "seen": None,
    }
    assert (shown["viewers"], shown["state"]) == (1, "open")
    assert (shown["settings"]["width"], shown["playing"]["quality"]) == (16, 80)
    looker.leave()


@pytest.mark.parametrize("topic", [SECRET, "/no/such"])
@pytest_twisted.ensureDeferred
async def test_a_camera_one_may_not_view_is_like_none(show: Show, topic: str) -> None:
    """Whether somebody asks for a stream or a snapshot, with GET or HEAD."""
    show.robot_comes()
    await show.deny("/no/*")
    for what in ("stream", "snapshot"):
        path = f"/robots/rover/video/{what}?topic={topic}"
        words = "there is no such camera, or you have no right to view it"
        assert await show.looks(path).problem() == (404, words)
        assert (await show.looks(path, "HEAD").head())[0] == 404


@pytest.mark.parametrize("robot", ["tank", "hidden"])
@pytest_twisted.ensureDeferred
async def test_a_robot_without_rights_is_like_none(show: Show, robot: str) -> None:
    """On every address."""
    for path in (STREAM, SNAPSHOT, CAMERAS):
        status, detail = await show.looks(path.replace("rover", robot)).problem()
        assert (status, detail) == (404, "there is no such robot, or you have no right on it")


@pytest.mark.parametrize(("query", "codec"), [("", "jpeg"), ("&type=png", "png")])
@pytest_twisted.ensureDeferred
async def test_a_snapshot_is_the_first_picture_that_comes(show: Show, query: str, codec: str) -> None:
    """Not to be kept; the connection serves the next request."""
    body = {"jpeg": jpeg(), "png": png()}[codec]
    control = show.robot_comes()
    looker = show.looks(SNAPSHOT + query)
    stream = await show.joined(control)
    assert stream.settings == link.VideoSettings(codec=codec)  # type: ignore[arg-type]
    stream.message(link.Playing(width=16, height=12, quality=40, reduced=0.5))
    show.shows(stream, body)
    status, headers, got = await looker.answer()
    assert (status, got) == (200, body)
    assert headers["content-type"] == f"image/{codec}"
    assert headers["cache-control"] == "no-store"
    assert (float(headers["x-timestamp"]), float(headers["x-reduced"])) == (1000.5, 0.5)
    assert not stream.viewers
    looker.asks(CAMERAS)
    assert (await looker.answer())[0] == 200


@pytest_twisted.ensureDeferred
async def test_that_another_form_is_shown_than_was_asked_for_is_told(show: Show) -> None:
    """By the parameters in which it differs; nothing is told to who gets what he asked for."""
    control = show.robot_comes()
    show.makes(1)
    first = show.looks(STREAM + "&width=32")
    stream = await show.joined(control)
    show.films(stream, jpeg())
    assert "x-instead" not in (await first.head())[1]
    second = show.looks(STREAM + "&width=64&quality=50")
    assert (await second.head())[1]["x-instead"] == "width=32&quality=80"
    snapshot = show.looks(SNAPSHOT)
    assert (await snapshot.answer())[1]["x-instead"] == "width=32"
    first.leave()
    second.leave()


@pytest_twisted.ensureDeferred
async def test_a_snapshot_of_a_slow_stream_is_the_newest_picture_whose_time_it_tells(show: Show) -> None:
    """Nobody waits twenty seconds for one that somebody else has just seen."""
    control = show.robot_comes()
    viewer = show.looks(STREAM + "&fps=0.05")
    stream = await show.joined(control)
    # It took five seconds more on its way than the one before.
    for stamp in (1000.5, 995.5):
        show.shows(stream, jpeg(), stamp)
    status, headers, got = await show.looks(SNAPSHOT + "&fps=0.05").answer()
    assert (status, got) == (200, jpeg())
    assert float(headers["x-timestamp"]) == 995.5
    viewer.leave()


@pytest.mark.parametrize(("path", "kind"), [(STREAM, "multipart/x-mixed-replace"), (SNAPSHOT, "image/jpeg")])
@pytest_twisted.ensureDeferred
async def test_head_tells_what_there_would_be_without_waking_the_robot(
    show: Show, path: str, kind: str
) -> None:
    """And has no body."""
    control = show.robot_comes()
    looker = show.looks(path, "HEAD")
    status, headers = await looker.head()
    assert (status, headers.get_content_type()) == (200, kind)
    looker.asks(CAMERAS)
    assert (await looker.answer())[0] == 200
    assert not control.all(link.OpenVideo)
    assert not show.access._permits


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", STREAM + "&width=wide", 400),
        ("GET", STREAM + "&type=vp8", 400),
        ("GET", STREAM.replace("/stream", "/stream_viewer") + "&width=wide", 400),
        ("GET", SNAPSHOT + "&codec=h264", 400),
        ("POST", STREAM, 405),
        ("GET", "/robots/rover/video", 404),
        ("GET", "/robots/rover/video/", 404),
        ("GET", "/robots/rover/video/stream/x", 404),
        ("GET", "/robots/rover/video/ws", 426),
    ],
)
@pytest_twisted.ensureDeferred
async def test_what_is_no_question_is_answered_in_words(
    show: Show, method: str, path: str, status: int
) -> None:
    """As problem details."""
    assert (await show.looks(path, method).problem())[0] == status


@pytest_twisted.ensureDeferred
async def test_the_page_around_a_stream_asks_for_it_with_the_same_words(show: Show) -> None:
    """It needs no credential, says nothing of its own, and what is in its address is text to it."""
    path = STREAM.replace("/stream", "/stream_viewer") + "&width=320&x=%22><script>1</script>"
    status, headers, body = await show.looks(
        path.replace(">", "%3E").replace("<", "%3C"), Authorization=""
    ).answer()
    assert (status, headers.get_content_type()) == (200, "text/html")
    assert "default-src 'self'" in headers["content-security-policy"]
    assert f'<img src="stream?topic={CAMERA}&amp;width=320&amp;x=%22%3E%3Cscript'.encode() in body
    assert b"<script" not in body


@pytest_twisted.ensureDeferred
async def test_a_camera_that_is_only_compressed_may_be_named_by_its_raw_topic(show: Show) -> None:
    """As users of image_transport do."""
    control = show.robot_comes()
    show.registry.cameras(show.robot, link.Cameras(cameras=[link.Camera(name="/usb/image/compressed")]))
    looker = show.looks("/robots/rover/video/stream?topic=/usb/image&type=ros_compressed")
    stream = await show.joined(control)
    assert (stream.camera, stream.settings.transport) == ("/usb/image", "compressed")
    looker.leave()
    await until(lambda: not stream.viewers)


@pytest.mark.parametrize(
    ("camera", "transport", "denied"),
    [
        ("/front", "compressed", "/front/compressed"),
        ("/front/compressed", "raw", "/front"),
        ("/front", "raw", None),
        ("/front", "", None),
    ],
)
@pytest_twisted.ensureDeferred
async def test_the_topic_shown_in_a_cameras_stead_may_have_to_be_viewed_too(
    show: Show, camera: str, transport: str, denied: str | None
) -> None:
    """Another transport is another topic, with rights of its own, also while it is watched."""
    await show.deny("/front/compressed" if camera == "/front" else "/front")
    path = f"/robots/rover/video/stream?topic={camera}&default_transport={transport}"
    looker = show.looks(path)
    if denied is not None:
        assert (await looker.problem())[0] == 404
        await show.deny()
        looker = show.looks(path)
    await until(lambda: show.access._permits)
    if denied is not None:
        await show.deny(denied)
        assert (await looker.problem())[0] == 403
    looker.leave()
    await until(lambda: not show.access._permits)


@pytest.mark.parametrize("address", [STREAM, SNAPSHOT])
@pytest_twisted.ensureDeferred
async def test_head_judges_the_topic_shown_in_a_cameras_stead_too(show: Show, address: str) -> None:
    """Its answer is that of GET."""
    await show.deny(f"{CAMERA}/compressed")
    path = f"{address}&default_transport=compressed"
    assert (await show.looks(path).problem())[0] == 404
    assert (await show.looks(path, "HEAD").head())[0] == 404
    assert (await show.looks(address, "HEAD").head())[0] == 200


@pytest_twisted.ensureDeferred
async def test_a_viewer_who_leaves_before_the_first_picture_leaves_nothing(show: Show) -> None:
    """Neither at the stream nor with the judge."""
    show.robot_comes()
    lookers = [show.looks(STREAM), show.looks(SNAPSHOT)]
    await until(lambda: sum(len(stream.viewers) for stream in show.videos) == 2)
    for looker in lookers:
        looker.leave()
    await until(lambda: not show.access._permits)
    assert not any(stream.viewers for stream in show.videos)


@pytest_twisted.ensureDeferred
async def test_a_relay_that_goes_down_ends_streams_and_takes_no_new_ones(show: Show) -> None:
    """With 503."""
    show.robot_comes()
    looker = show.looks(STREAM)
    await until(lambda: list(show.videos))
    show.desk.say_goodbye("the relay is going down")
    assert await looker.problem() == (503, "the relay is going down")
    assert (await show.looks(STREAM).problem())[0] == 503


@pytest_twisted.ensureDeferred
async def test_who_begins_streams_too_fast_is_told_when_he_may_again(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With 429, in words and in a header; a stream that there is he may watch."""
    monkeypatch.setattr(streams, "STREAMS_AT_ONCE", 1)
    monkeypatch.setattr(streams, "STREAMS_A_SECOND", 1 / 60)
    control = show.robot_comes()
    first = show.looks(STREAM)
    stream = await show.joined(control)
    status, headers, body = await show.looks(SNAPSHOT + "&width=16").answer()
    assert status == 429
    assert 55 <= int(headers["retry-after"]) <= 60
    assert json.loads(body)["detail"].endswith(f"try again in {headers['retry-after']} s")
    same = show.looks(SNAPSHOT)
    await until(lambda: len(stream.viewers) == 2)
    show.shows(stream, jpeg())
    assert (await same.answer())[0] == 200
    first.leave()
