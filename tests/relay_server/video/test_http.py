"""Video over HTTP: rights, cameras, snapshots, and invalid requests."""

from __future__ import annotations

import json

import pytest
import pytest_twisted

from relay_protocol import link
from relay_server.auth.authenticator import TicketPurpose
from relay_server.video import streams
from tests.worlds.video_site import (
    CAMERA,
    CAMERAS,
    PAGE,
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
    return await show.logins.issue_ticket(
        await show.logins.token("ann's"), TicketPurpose("rover", video, camera)
    )


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
        (COOKIE | {"Sec-Fetch-Site": "same-site", "Origin": PAGE}, 200),
        (COOKIE | {"Sec-Fetch-Site": "same-site", "Origin": f"{PAGE}:8443"}, 403),
    ],
)
@pytest_twisted.ensureDeferred
async def test_a_cookie_needs_no_origin_but_serves_no_other_site(
    show: Show, headers: dict[str, str], status: int
) -> None:
    """An ``<img>`` sends no Origin; browsers send the site of its page."""
    answer, heads, body = await show.request(CAMERAS, **headers).answer()
    assert answer == status
    assert (heads["www-authenticate"] == "Bearer") is (status == 401)
    assert "cameras" in json.loads(body) or json.loads(body)["status"] == status


@pytest_twisted.ensureDeferred
async def test_a_ticket_shows_one_stream_of_its_robot(show: Show) -> None:
    """It works once, and never for another robot."""
    control = show.robot_comes()
    for_img = await ticket(show)
    client = show.request(f"{STREAM}&ticket={for_img}", Authorization="", Sec_Fetch_Site="cross-site")
    stream = await show.joined(control)
    show.shows(stream, jpeg())
    assert (await client.head())[0] == 200
    again = show.request(f"{STREAM}&ticket={for_img}", Authorization="")
    assert (await again.problem())[0] == 401
    other = show.request(STREAM.replace("rover", "tank") + f"&ticket={await ticket(show)}", Authorization="")
    assert (await other.problem())[0] == 401
    client.leave()


@pytest_twisted.ensureDeferred
async def test_a_ticket_for_something_else_shows_nothing(show: Show) -> None:
    """Neither one for the robot's websocket nor one for another camera."""
    show.robot_comes()
    for address, used in (
        (STREAM, await ticket(show, video=False)),
        (STREAM, await ticket(show, "/other")),
        (CAMERAS, await ticket(show, CAMERA)),
    ):
        join = "&" if "?" in address else "?"
        client = show.request(f"{address}{join}ticket={used}", Authorization="")
        assert (await client.problem())[0] == 401


@pytest_twisted.ensureDeferred
async def test_a_head_request_spends_no_ticket(show: Show) -> None:
    """Players send HEAD before GET."""
    control = show.robot_comes()
    address = f"{STREAM}&ticket={await ticket(show, CAMERA)}"
    for _ in range(2):
        assert (await show.request(address, method="HEAD", Authorization="").answer())[0] == 200
    client = show.request(address, Authorization="")
    show.shows(await show.joined(control), jpeg())
    assert (await client.head())[0] == 200
    client.leave()
    assert (await show.request(address, method="HEAD", Authorization="").answer())[0] == 401


@pytest_twisted.ensureDeferred
async def test_cameras_are_those_one_may_view(show: Show) -> None:
    """With their present streams; unknown values are null."""
    control = show.robot_comes()
    client = show.request(STREAM + "&width=16")
    stream = await show.joined(control)
    show.shows(stream, jpeg())
    assert (await client.head())[0] == 200
    _, headers, body = await show.request(CAMERAS).answer()
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
    assert (shown["settings"]["width"], shown["stream_status"]["quality"]) == (16, 80)
    client.leave()


@pytest.mark.parametrize("topic", [SECRET, "/no/such"])
@pytest_twisted.ensureDeferred
async def test_a_camera_one_may_not_view_is_like_none(show: Show, topic: str) -> None:
    """For streams and snapshots, with GET and HEAD."""
    show.robot_comes()
    await show.deny("/no/*")
    for what in ("stream", "snapshot"):
        path = f"/robots/rover/video/{what}?topic={topic}"
        words = "there is no such camera, or you have no right to view it"
        assert await show.request(path).problem() == (404, words)
        assert (await show.request(path, "HEAD").head())[0] == 404


@pytest.mark.parametrize("robot", ["tank", "hidden"])
@pytest_twisted.ensureDeferred
async def test_a_robot_without_rights_is_like_none(show: Show, robot: str) -> None:
    for path in (STREAM, SNAPSHOT, CAMERAS):
        status, detail = await show.request(path.replace("rover", robot)).problem()
        assert (status, detail) == (404, "there is no such robot, or you have no right on it")


@pytest.mark.parametrize(("query", "codec"), [("", "jpeg"), ("&type=png", "png")])
@pytest_twisted.ensureDeferred
async def test_a_snapshot_is_the_first_frame_that_comes(show: Show, query: str, codec: str) -> None:
    """It must not be cached; the connection serves the next request."""
    body = {"jpeg": jpeg(), "png": png()}[codec]
    control = show.robot_comes()
    client = show.request(SNAPSHOT + query)
    stream = await show.joined(control)
    assert stream.settings == link.VideoSettings(codec=codec)  # type: ignore[arg-type]
    stream.message_received(link.StreamStatus(width=16, height=12, quality=40, reduced=0.5))
    show.shows(stream, body)
    status, headers, got = await client.answer()
    assert (status, got) == (200, body)
    assert headers["content-type"] == f"image/{codec}"
    assert headers["cache-control"] == "no-store"
    assert (float(headers["x-timestamp"]), float(headers["x-reduced"])) == (1000.5, 0.5)
    assert not stream.viewers
    client.asks(CAMERAS)
    assert (await client.answer())[0] == 200


@pytest_twisted.ensureDeferred
async def test_another_format_than_requested_is_reported(show: Show) -> None:
    """By the differing parameters; an exact stream has no such header."""
    control = show.robot_comes()
    show.makes(1)
    first = show.request(STREAM + "&width=32")
    stream = await show.joined(control)
    show.films(stream, jpeg())
    assert "x-instead" not in (await first.head())[1]
    second = show.request(STREAM + "&width=64&quality=50")
    assert (await second.head())[1]["x-instead"] == "width=32&quality=80"
    snapshot = show.request(SNAPSHOT)
    assert (await snapshot.answer())[1]["x-instead"] == "width=32"
    first.leave()
    second.leave()


@pytest_twisted.ensureDeferred
async def test_a_snapshot_of_a_slow_stream_is_the_newest_frame_with_its_time(show: Show) -> None:
    """The request does not wait 20 s for a frame that another viewer has just seen."""
    control = show.robot_comes()
    viewer = show.request(STREAM + "&fps=0.05")
    stream = await show.joined(control)
    # It was 5 s longer under way than the one before.
    for stamp in (1000.5, 995.5):
        show.shows(stream, jpeg(), stamp)
    status, headers, got = await show.request(SNAPSHOT + "&fps=0.05").answer()
    assert (status, got) == (200, jpeg())
    assert float(headers["x-timestamp"]) == 995.5
    viewer.leave()


@pytest.mark.parametrize(("path", "kind"), [(STREAM, "multipart/x-mixed-replace"), (SNAPSHOT, "image/jpeg")])
@pytest_twisted.ensureDeferred
async def test_head_describes_the_stream_without_waking_the_robot(show: Show, path: str, kind: str) -> None:
    control = show.robot_comes()
    client = show.request(path, "HEAD")
    status, headers = await client.head()
    assert (status, headers.get_content_type()) == (200, kind)
    client.asks(CAMERAS)
    assert (await client.answer())[0] == 200
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
async def test_invalid_query_is_refused_with_a_reason(
    show: Show, method: str, path: str, status: int
) -> None:
    """As problem details."""
    assert (await show.request(path, method).problem())[0] == status


@pytest_twisted.ensureDeferred
async def test_the_page_around_a_stream_asks_for_it_with_the_same_words(show: Show) -> None:
    """It needs no credentials, and the text of its address is escaped."""
    path = STREAM.replace("/stream", "/stream_viewer") + "&width=320&x=%22><script>1</script>"
    status, headers, body = await show.request(
        path.replace(">", "%3E").replace("<", "%3C"), Authorization=""
    ).answer()
    assert (status, headers.get_content_type()) == (200, "text/html")
    assert "default-src 'self'" in headers["content-security-policy"]
    assert f'<img src="stream?topic={CAMERA}&amp;width=320&amp;x=%22%3E%3Cscript'.encode() in body
    assert body.count(b"<script") == body.count(b'<script src="/stream_viewer.js">') == 1


@pytest_twisted.ensureDeferred
async def test_a_camera_that_is_only_compressed_may_be_named_by_its_raw_topic(show: Show) -> None:
    """As users of image_transport do."""
    control = show.robot_comes()
    show.registry.cameras(show.robot, link.Cameras(cameras=[link.Camera(name="/usb/image/compressed")]))
    client = show.request("/robots/rover/video/stream?topic=/usb/image&type=ros_compressed")
    stream = await show.joined(control)
    assert (stream.camera, stream.settings.transport) == ("/usb/image", "compressed")
    client.leave()
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
    """Another transport is another topic with rights of its own, checked during the stream too."""
    await show.deny("/front/compressed" if camera == "/front" else "/front")
    path = f"/robots/rover/video/stream?topic={camera}&default_transport={transport}"
    client = show.request(path)
    if denied is not None:
        assert (await client.problem())[0] == 404
        await show.deny()
        client = show.request(path)
    await until(lambda: show.access._permits)
    if denied is not None:
        await show.deny(denied)
        assert (await client.problem())[0] == 403
    client.leave()
    await until(lambda: not show.access._permits)


@pytest.mark.parametrize("address", [STREAM, SNAPSHOT])
@pytest_twisted.ensureDeferred
async def test_head_judges_the_topic_shown_in_a_cameras_stead_too(show: Show, address: str) -> None:
    """Its answer equals that of GET."""
    await show.deny(f"{CAMERA}/compressed")
    path = f"{address}&default_transport=compressed"
    assert (await show.request(path).problem())[0] == 404
    assert (await show.request(path, "HEAD").head())[0] == 404
    assert (await show.request(address, "HEAD").head())[0] == 200


@pytest_twisted.ensureDeferred
async def test_a_viewer_that_leaves_before_the_first_frame_leaves_nothing(show: Show) -> None:
    """Neither the stream nor the access keeps state of it."""
    show.robot_comes()
    clients = [show.request(STREAM), show.request(SNAPSHOT)]
    await until(lambda: sum(len(stream.viewers) for stream in show.videos) == 2)
    for client in clients:
        client.leave()
    await until(lambda: not show.access._permits)
    assert not any(stream.viewers for stream in show.videos)


@pytest_twisted.ensureDeferred
async def test_a_relay_that_goes_down_ends_streams_and_takes_no_new_ones(show: Show) -> None:
    """With 503."""
    show.robot_comes()
    client = show.request(STREAM)
    await until(lambda: list(show.videos))
    show.service.shutdown("the relay is going down")
    assert await client.problem() == (503, "the relay is going down")
    assert (await show.request(STREAM).problem())[0] == 503


@pytest_twisted.ensureDeferred
async def test_too_frequent_streams_are_refused_with_retry_after(
    show: Show, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With 429, a reason and the header; existing streams may still be viewed."""
    monkeypatch.setattr(streams, "STREAMS_AT_ONCE", 1)
    monkeypatch.setattr(streams, "STREAMS_A_SECOND", 1 / 60)
    control = show.robot_comes()
    first = show.request(STREAM)
    stream = await show.joined(control)
    status, headers, body = await show.request(SNAPSHOT + "&width=16").answer()
    assert status == 429
    assert 55 <= int(headers["retry-after"]) <= 60
    assert json.loads(body)["detail"].endswith(f"try again in {headers['retry-after']} s")
    same = show.request(SNAPSHOT)
    await until(lambda: len(stream.viewers) == 2)
    show.shows(stream, jpeg())
    assert (await same.answer())[0] == 200
    first.leave()


@pytest_twisted.ensureDeferred
async def test_a_page_of_a_listed_origin_may_show_the_page_of_a_stream_in_a_frame(show: Show) -> None:
    """That page alone: no other answer can be in a frame."""
    path = STREAM.replace("/stream", "/stream_viewer")
    status, headers, _ = await show.request(path).answer()
    assert status == 200
    assert f"frame-ancestors {PAGE}" in headers["content-security-policy"]
    assert "'none'" not in headers["content-security-policy"].partition("frame-ancestors")[2]
    assert "x-frame-options" not in headers
    _, headers, _ = await show.request(CAMERAS).answer()
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["x-frame-options"] == "DENY"


@pytest_twisted.ensureDeferred
async def test_a_page_of_a_listed_origin_may_read_the_answer_to_a_ticket(show: Show) -> None:
    """For an image with the attribute ``crossorigin``, which a canvas can use."""
    for origin, allowed in ((PAGE, PAGE), ("https://other.example", None)):
        path = f"{CAMERAS}?ticket={await ticket(show)}"
        status, headers, _ = await show.request(path, Authorization="", Origin=origin).answer()
        assert status == 200
        assert headers.get("access-control-allow-origin") == allowed
