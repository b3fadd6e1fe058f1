"""Foxglove URLs with a real relay: many connections, revocation while connected, a viewer's rights, logs."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

import httpx
import pytest
from playwright.sync_api import Browser, Page, Route, expect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from relay_server.common import close_codes
from tests.worlds.accessibility import violations
from tests.worlds.browser import checked_pages, open_session, portal, seen
from tests.worlds.relay_process import Relay
from tests.worlds.small_robot import SmallRobot
from tests.worlds.waiting import PATIENCE, wait_for

SDK, LEGACY = Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1")
URLS = "/api/v1/robots/rover/foxglove-urls"


class Scene:
    """A relay that logs all it can, a robot that speaks JSON, and its operator ann."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder, "--debug", "--requests-per-second", "0")
        self.token = self.relay.user("ann")
        self.robot = SmallRobot(self.relay, "rover", {}).comes()
        self.relay.cli("right", "grant", "ann", "rover", "operator")
        self.http = httpx.Client(
            base_url=f"http://127.0.0.1:{self.relay.http_port}",
            headers={"Authorization": f"Bearer {self.token}"},
            timeout=PATIENCE,
        )

    def made(self, level: str = "viewer") -> dict[str, Any]:
        """A new URL."""
        answer = self.http.post(URLS, json={"level": level})
        assert answer.status_code == 201, answer.text
        made: dict[str, Any] = answer.json()
        return made

    def revoke_all(self) -> None:
        """Revoke all URLs of ann."""
        for each in self.http.get(URLS).json()["urls"]:
            self.http.delete(f"{URLS}/{each['id']}")


def opened(url: str, *protocols: Subprotocol, **options: Any) -> ClientConnection:
    """A websocket; :data:`LEGACY` if no subprotocol is named."""
    return connect(
        url, subprotocols=protocols or (LEGACY,), open_timeout=PATIENCE, close_timeout=1, **options
    )


def until(client: ClientConnection, op: str) -> dict[str, Any]:
    """The next message with this op."""
    while True:
        data = client.recv(PATIENCE)
        message: dict[str, Any] = json.loads(data) if isinstance(data, str) else {}
        if message.get("op") == op:
            return message


def cut(client: ClientConnection) -> ConnectionClosed:
    """Read until the relay closes the connection."""
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            client.recv(PATIENCE)
    return closed.value


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """One relay for all tests."""
    made = Scene(tmp_path_factory.mktemp("foxglove-urls"))
    yield made
    made.http.close()
    made.robot.goes()
    made.relay.stop()


def test_one_url_connects_a_hundred_times_from_any_origin(scene: Scene) -> None:
    url = scene.made()["url"]
    for number in range(100):
        protocol = (SDK, LEGACY)[number % 2]
        with opened(url, protocol, origin="https://app.foxglove.dev") as client:
            assert client.subprotocol == protocol
            assert until(client, "serverInfo")["name"] == "rover"


def test_a_url_that_is_revoked_while_connected_is_cut_with_the_reason(scene: Scene) -> None:
    made, kept = scene.made(), scene.made()
    with opened(made["url"]) as client, opened(kept["url"]) as other:
        until(client, "serverInfo")
        wait_for(
            "the connection is listed",
            lambda: (
                {"id": made["id"], "connections": 1}.items()
                <= next(
                    each for each in scene.http.get(URLS).json()["urls"] if each["id"] == made["id"]
                ).items()
            ),
        )
        assert scene.http.delete(f"{URLS}/{made['id']}").status_code == 204
        closed = cut(client)
        assert closed.rcvd is not None
        assert closed.rcvd.code == close_codes.UNAUTHENTICATED
        assert "revoked" in closed.rcvd.reason
        until(other, "serverInfo")
    with pytest.raises(InvalidStatus) as refused:
        opened(made["url"])
    assert refused.value.response.status_code == 401


def test_a_url_revoked_on_the_command_line_is_cut_too(scene: Scene) -> None:
    made = scene.relay.cli("foxglove-url", "create", "rover", "ann", "--relay", str(scene.http.base_url))
    with opened(made["url"]) as client:
        until(client, "serverInfo")
        scene.relay.cli("foxglove-url", "revoke", str(made["id"]))
        cut(client)


def published(scene: Scene, url: str, text: str) -> list[dict[str, Any]]:
    """Publishes on the robot's topic; returns all statuses until the client closes the connection."""
    channel = {"id": 1, "topic": "/mode", "encoding": "json", "schemaName": "std_msgs/String"}
    with opened(url) as client:
        until(client, "serverInfo")
        wait_for("the type is known", lambda: "/mode" in json.dumps(until(client, "advertise")))
        client.send(json.dumps({"op": "advertise", "channels": [channel]}))
        client.send(b"\x01\x01\x00\x00\x00" + json.dumps({"data": text}).encode())
        # This operation is always answered, after all other statuses.
        client.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [99]}))
        statuses = []
        while not statuses or "subscription 99" not in statuses[-1]["message"]:
            statuses.append(until(client, "status"))
        return statuses


def test_a_viewers_url_cannot_publish_and_an_operators_can(scene: Scene) -> None:
    for level, may in (("viewer", False), ("operator", True)):
        with opened(scene.made(level)["url"]) as client:
            assert ("clientPublish" in until(client, "serverInfo")["capabilities"]) is may
    refused = published(scene, scene.made()["url"], "by a viewer")
    assert any(each["level"] == 2 and "/mode" in each["message"] for each in refused), refused
    published(scene, scene.made("operator")["url"], "by an operator")
    wait_for("the operator's message has arrived", lambda: {"data": "by an operator"} in scene.robot.heard)
    assert {"data": "by a viewer"} not in scene.robot.heard


def test_the_token_opens_nothing_but_foxglove(scene: Scene) -> None:
    made = scene.made("operator")
    token = made["url"].partition("token=")[2]
    for path in ("/api/v1/robots/rover", "/api/v1/session"):
        answers = (
            scene.http.get(path, headers={"Authorization": f"Bearer {token}"}),
            httpx.get(f"{scene.http.base_url}{path}?token={token}"),
        )
        assert [each.status_code for each in answers] == [401, 401]
    for url in (
        made["url"],
        made["url"].replace("/rover?", "/rover/video?"),
        made["url"].replace("robots/rover", "api/v1/robots/stream"),
    ):
        with pytest.raises(InvalidStatus) as refused:
            opened(url, Subprotocol("rosbridge_v2"))
        assert refused.value.response.status_code in (401, 403, 404)


def test_no_token_is_in_the_log_the_audit_log_or_the_metrics(scene: Scene) -> None:
    made = scene.made()
    token = made["url"].partition("token=")[2]
    with opened(made["url"]) as client:
        until(client, "serverInfo")
    httpx.get(made["url"].replace("ws", "http", 1))
    with pytest.raises(InvalidStatus):
        opened(made["url"].replace("/rover?", "/tank?"))
    for wrong in ("?stride=4?", "?throttle=fast;", "?voxel=1%26", "&", "%3F"):
        with pytest.raises(InvalidStatus):
            opened(made["url"].replace("?", wrong))
    scene.http.delete(f"{URLS}/{made['id']}")
    with pytest.raises(InvalidStatus):
        opened(made["url"])
    shown = (
        scene.relay.log,
        json.dumps(scene.relay.cli("audit", "list")),
        json.dumps(scene.relay.cli("token", "list")),
        scene.http.get("/metrics").text,
        scene.http.get("/api/v1/events").text,
    )
    assert "is refused" in shown[0]
    assert "separate options by &" in shown[0]
    parts = [token[at : at + 8] for at in range(4, len(token) - 8, 4)]
    assert [any(part in each for part in parts) for each in shown] == [False] * len(shown)


@contextlib.contextmanager
def urls_page(browser: Browser, scene: Scene, user: str, width: int = 1280) -> Iterator[Page]:
    """A user's Foxglove URLs in the cockpit."""
    portal()
    with checked_pages(browser, f"http://127.0.0.1:{scene.relay.http_port}", PATIENCE) as new_page:
        page = new_page(width, 900)
        open_session(page, user, "correct horse")
        page.goto("/cockpit/rover")
        seen(page, "foxglove-open").click()
        yield page


def test_the_cockpit_makes_shows_lists_and_revokes_a_url(browser: Browser, scene: Scene) -> None:
    """By its button, on a phone's width; the URL works until it is revoked there."""
    scene.revoke_all()
    with urls_page(browser, scene, "ann", width=390) as page:
        expect(seen(page, "foxglove-watching")).to_contain_text("can’t drive")
        seen(page, "foxglove-label").fill("office screen")
        assert violations(page) == []
        seen(page, "foxglove-make").click()
        url = (seen(page, "foxglove-url").text_content() or "").strip()
        assert url.startswith(f"ws://127.0.0.1:{scene.relay.http_port}/robots/rover?token=")
        for app, scheme in (("desktop", "foxglove://"), ("lichtblick", "lichtblick://")):
            link = seen(page, f"foxglove-{app}").get_attribute("href") or ""
            assert link.startswith(scheme)
            assert quote(url, safe="") in link
        row = seen(page, "foxglove-row")
        expect(row).to_contain_text("office screen")
        with opened(url) as client:
            until(client, "serverInfo")
            row.get_by_test_id("foxglove-revoke").click()
            expect(row).to_have_count(0)
            cut(client)
        expect(seen(page, "foxglove-made")).to_have_count(0)


@pytest.mark.parametrize(
    ("address", "opens"), [("wss://relay.example.org", True), ("ws://relay.example.org", False)]
)
def test_the_link_to_the_web_app_is_there_where_it_works_and_sends_no_referrer(
    browser: Browser, scene: Scene, address: str, opens: bool
) -> None:
    """As with a relay at that address; the page's own address would name the relay and the robot."""
    scene.revoke_all()
    own = f"ws://127.0.0.1:{scene.relay.http_port}"

    def answered(route: Route) -> None:
        answer = route.fetch()
        body = answer.text().replace(own, address).replace(quote(own, safe=""), quote(address, safe=""))
        route.fulfill(response=answer, body=body)

    with urls_page(browser, scene, "ann") as page:
        page.route(f"**{URLS}", answered)
        seen(page, "foxglove-make").click()
        expect(seen(page, "foxglove-url")).to_contain_text(f"{address}/robots/rover?token=")
        url = (seen(page, "foxglove-url").text_content() or "").strip()
        link = page.get_by_test_id("foxglove-web")
        expect(link).to_have_count(int(opens))
        if opens:
            to = urlsplit(link.get_attribute("href") or "")
            assert (to.scheme, to.netloc) == ("https", "app.foxglove.dev")
            assert parse_qs(to.query) == {"ds": ["foxglove-websocket"], "ds.url": [url]}
            assert {"noreferrer", "noopener"} <= set((link.get_attribute("rel") or "").split())
        # The page reads the list now and then, also while it is being closed.
        page.unroute_all(behavior="wait")


def test_the_cockpits_list_follows_what_is_done_elsewhere(browser: Browser, scene: Scene) -> None:
    """A URL is made, used, revoked and expires, while the page is open."""
    scene.revoke_all()
    with urls_page(browser, scene, "ann", width=1280) as page:
        seen(page, "foxglove-make").click()
        url = (seen(page, "foxglove-url").text_content() or "").strip()
        row = page.get_by_test_id("foxglove-row")
        with opened(url) as client:
            until(client, "serverInfo")
            expect(row).to_contain_text("1 connected")
        expect(row).not_to_contain_text("connected")
        (mine,) = scene.http.get(URLS).json()["urls"]
        scene.made()
        expect(row).to_have_count(2)
        scene.http.delete(f"{URLS}/{mine['id']}")
        expect(row).to_have_count(1)
        expect(page.get_by_test_id("foxglove-made")).to_have_count(0)
        with sqlite3.connect(scene.relay.data / "switchboard.db") as database:
            database.execute(
                "UPDATE access_token SET expires = ? WHERE robot_id IS NOT NULL", (time.time() - 1,)
            )
        database.close()
        expect(row).to_have_count(0)


@pytest.mark.parametrize(("allow", "levels"), [((), 1), (("--allow", "publish:/mode"), 2)])
def test_the_cockpit_offers_the_levels_that_the_user_may_give(
    browser: Browser, scene: Scene, allow: tuple[str, ...], levels: int
) -> None:
    """A viewer who may publish by a pattern may make a URL that does."""
    user = f"viewer{levels}"
    scene.relay.user(user)
    scene.relay.cli("right", "grant", user, "rover", "viewer", *allow)
    with urls_page(browser, scene, user) as page:
        expect(page.get_by_test_id("foxglove-level").locator("option")).to_have_count(levels)
        needs = seen(page, "foxglove-watching")
        expect(needs).to_contain_text("choose" if allow else "you need the level operator")
